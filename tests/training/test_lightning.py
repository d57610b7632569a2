"""Data and trainings in an ordinary `lightning.Trainer`: fit, validate, test, resume, processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import lightning as L
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger
from tiny import TINY
from torch import Tensor, nn

import residnet
from residnet.core.errors import ConfigError, UsageError
from residnet.preprocessing.data_module import WindowBatch

TRAINING: dict[str, Any] = TINY["training"]["lstm"]
LSTM: dict[str, Any] = TINY["heads"]["lstm"]


class Accelerations(L.LightningModule):
    """A network of a user: accelerations from velocities and inputs, without residnet."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.network = nn.Sequential(nn.Linear(5, 8), nn.Tanh(), nn.Linear(8, 3))

    def loss(self, batch: tuple[WindowBatch, ...]) -> Tensor:
        (windows,) = batch
        z = torch.cat((windows.smoothed[..., 3:], windows.w / 20.0), dim=-1)
        return nn.functional.mse_loss(self.network(z), windows.nu_dot)

    def training_step(self, batch: tuple[WindowBatch, ...], index: int) -> Tensor:
        return self.loss(batch)

    def validation_step(self, batch: tuple[WindowBatch, ...], index: int) -> None:
        self.log("val_loss", self.loss(batch), batch_size=len(batch[0].y), sync_dist=True)

    def test_step(self, batch: tuple[WindowBatch, ...], index: int) -> None:
        self.log("test_loss", self.loss(batch), batch_size=len(batch[0].y), sync_dist=True)

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=1e-2)


@pytest.fixture(scope="module")
def data() -> residnet.Dataset:
    return residnet.prepare(
        TINY["data"],
        TINY["signals"]["inputs"],
        step=0.1,
        derivative=TINY["prepare"]["derivative"],
        protocols=TINY["evaluation"]["protocols"],
        scales=TINY["evaluation"]["scales"],
    )


def trainer(folder: Path, epochs: int, **settings: Any) -> L.Trainer:
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    return L.Trainer(
        max_epochs=epochs, default_root_dir=folder, accelerator="cpu", **quiet | settings
    )


def test_windows_train_validate_and_test_any_module(data: residnet.Dataset, tmp_path: Path) -> None:
    windows = data.module(windows="2 s", batch_size=8, batches=5)
    module = Accelerations()
    first = trainer(tmp_path, 4, callbacks=[ModelCheckpoint(tmp_path, save_last=True)])
    before = trainer(tmp_path, 1).validate(module, windows, verbose=False)[0]["val_loss"]
    first.fit(module, windows)
    after = first.validate(module, windows, verbose=False)[0]["val_loss"]
    assert after < 0.7 * before
    assert 0 < first.test(module, windows, verbose=False)[0]["test_loss"] < before
    # a resumed training has the result of an uninterrupted one
    longer = Accelerations()
    trainer(tmp_path, 6).fit(longer, windows)
    resumed = Accelerations()
    trainer(tmp_path, 6).fit(resumed, windows, ckpt_path=tmp_path / "last.ckpt")
    for one, other in zip(longer.parameters(), resumed.parameters(), strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=0)


def test_held_out_windows_are_consecutive_and_complete(data: residnet.Dataset) -> None:
    windows = data.module(windows="2 s", batch_size=7)
    loader = windows.test_dataloader()
    starts = loader.starts  # type: ignore[union-attr]
    assert int((starts[1:] - starts[:-1]).min()) >= 20
    samples = sum(len(log) for log in data.logs("test"))
    # windows fill the test logs but for their ends
    assert 0.8 * samples <= 20 * len(starts) <= samples
    assert sum(len(batch.y) for (batch,) in loader) == len(starts)
    assert {batch.y.shape[1] for (batch,) in loader} == {20}


def test_wrong_windows_are_refused_in_one_line(data: residnet.Dataset) -> None:
    with pytest.raises(ConfigError, match=r"module: windows: must be greater than 0"):
        data.module(windows=0.0)
    with pytest.raises(residnet.ResidnetError, match="no training log holds a window of 9000"):
        data.module(windows="900 s")


def test_the_users_trainer_gives_the_result_of_a_fit(
    data: residnet.Dataset, tmp_path: Path
) -> None:
    settings: dict[str, Any] = {"seed": 2, "bands": None}
    # a skip connection alone would be better than these few epochs
    lstm = LSTM | {"skip": "none"}
    fitted = residnet.fit(
        data, "regressors", {"lstm": lstm}, training={"lstm": TRAINING}, **settings
    )
    training = residnet.head_training(
        data, lstm, name="lstm", baseline="regressors", training=TRAINING, **settings
    )
    with pytest.raises(UsageError, match="no finished epoch; fit it with your trainer first"):
        training.finish()
    saved = ModelCheckpoint(tmp_path, monitor="validation", save_last=True)
    # the training stops by itself
    user_trainer = trainer(tmp_path, 100, callbacks=[saved])
    user_trainer.fit(training.module, training.data)
    models = training.finish()
    assert user_trainer.current_epoch == training.max_epochs == 7
    assert float(saved.best_model_score or 0) == pytest.approx(
        fitted["lstm"].notes["best_validation"], rel=1e-6
    )
    expected = fitted["lstm"].module.state_dict()
    for name, value in models["lstm"].module.state_dict().items():
        torch.testing.assert_close(value, expected[name], rtol=1e-6, atol=1e-6)
    assert models["lstm"].notes["validation"] == pytest.approx(
        fitted["lstm"].notes["validation"], rel=1e-6
    )
    # resumed from the trainer's own checkpoint after the last epoch: nothing is left to train
    again = residnet.head_training(
        data, lstm, name="lstm", baseline="regressors", training=TRAINING, **settings
    )
    trainer(tmp_path, 100).fit(again.module, again.data, ckpt_path=saved.last_model_path)
    for name, value in again.finish()["lstm"].module.state_dict().items():
        torch.testing.assert_close(value, expected[name], rtol=1e-6, atol=1e-6)


def test_callbacks_and_logger_of_the_user(data: residnet.Dataset, tmp_path: Path) -> None:
    epochs: list[int] = []

    class Count(L.Callback):
        def on_train_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
            epochs.append(trainer.current_epoch)

    logger = CSVLogger(tmp_path, name="mine", version="")
    residnet.fit(
        data,
        "regressors",
        {"lstm": LSTM},
        training={"lstm": TRAINING},
        bands=None,
        callbacks=[Count()],
        logger=logger,
    )
    assert epochs == list(range(7))
    lines = (tmp_path / "mine" / "metrics.csv").read_text().splitlines()
    assert "validation" in lines[0].split(",")
    assert len(lines) == 8
    callbacks: list[Any] = [print]
    with pytest.raises(
        UsageError, match=r"expected objects of lightning\.Callback, given a builtin"
    ):
        residnet.fit(data, "regressors", "mlp", callbacks=callbacks)


def test_a_closed_form_head_has_no_training(data: residnet.Dataset) -> None:
    with pytest.raises(UsageError, match="fitted in closed form and has no training"):
        residnet.head_training(data, "ridge")


@pytest.mark.long
def test_two_processes_give_the_result_of_one(data: residnet.Dataset, tmp_path: Path) -> None:
    windows = data.module(windows="2 s", batch_size=8, batches=5)
    modules = []
    for n_processes in (1, 2):
        modules.append(Accelerations())
        strategy = "auto" if n_processes == 1 else "ddp_spawn"
        users_trainer = trainer(tmp_path, 2, devices=n_processes, strategy=strategy)
        users_trainer.fit(modules[-1], windows)
        tested = users_trainer.test(modules[-1], windows, verbose=False)[0]
        assert 0.0 < tested["test_loss"] < 1.0
    start = Accelerations()
    for one, other, before in zip(
        *(module.parameters() for module in (*modules, start)), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
        assert not torch.equal(one, before)
