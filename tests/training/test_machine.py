"""Devices, precision and processes: no tensor is made without a device, processes share a batch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from kinds import of_kind
from made_system import LINEAR, SCALES, model_of, trials

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.errors import UsageError
from residnet.data.prepare import samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.lstm import LstmConfig
from residnet.heads.mlp import MlpConfig
from residnet.training.config import MachineConfig, TrainingConfig
from residnet.training.heads import HeadTraining, train
from residnet.training.score import Score

NAMES = ("u", "v", "r", "tau_x", "tau_n")
HEADS = {
    "mlp": MlpConfig(hidden=(6,)),
    "mirrored mlp": MlpConfig(hidden=(6,), mirror=True),
    "lstm": LstmConfig(hidden_size=4),
    "lstm of commands": LstmConfig(hidden_size=4, memory=("tau_x",), readout=5),
    "softsign lstm per axis": LstmConfig(hidden_size=4, activation="softsign", per_axis=True),
    "restoring lstm": LstmConfig(hidden_size=4, restoring=True),
}
SETTINGS: dict[str, Any] = {
    "steps": 10,
    "one_step": {"epochs": 1, "window": 1.0, "batch": 9, "washout": 0.2},
    "multi_step": [{"horizon": 0.5, "epochs": 4, "batch": 7}],
    "start_noise": 0.1,
    "beginnings": {"share": 0.3, "initial": 0.3},
}


def validated(model: HybridDynamics) -> Score:
    """A score that needs no free run."""
    return Score(0, float(sum(p.square().sum() for p in model.head.parameters())))


def training(
    head: Any, dtype: torch.dtype, **settings: Any
) -> tuple[HeadTraining, WindowStore, Any]:
    logs = trials()
    torch.manual_seed(1)
    model = model_of(LINEAR, head=head.build(NAMES))
    known = samples(logs, model.signals)
    RegressorsConfig(terms=LINEAR).fit(model.baseline, known)
    with torch.no_grad():
        residual = known.with_target(known.target - model.baseline(known.z))
    model.head.calibrate(residual)
    config = TrainingConfig.model_validate({**SETTINGS, **settings})
    store = WindowStore.gather(logs, dtype)
    module = HeadTraining(model.to(dtype), config, SCALES.to(dtype), validated, 0)
    return module, store, residual


def losses_of(
    module: HeadTraining, store: WindowStore, residual: Any, folder: Path | None = None
) -> list[float]:
    """Train; returns the loss of each epoch."""
    model, config = module.model, of_kind(module.settings, TrainingConfig)
    notes = train("net", model, residual, store, config, SCALES, validated, 0, folder)
    return [row["loss"] for row in notes["curve"]]


@pytest.mark.parametrize("name", HEADS)
def test_no_tensor_of_a_training_step_is_made_without_a_device(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the default device `meta`, a tensor made without one cannot meet the others."""
    # free runs in C are those of the CPU, and are there where an earlier test compiled the step
    monkeypatch.setattr("residnet.training.heads.compiled", lambda rollout, steps: rollout)
    module, store, _ = training(HEADS[name], torch.float32)
    for epochs in (0, 1):
        module.history = [{}] * epochs
        windows = next(iter(module.data(store).train_dataloader()))
        with torch.device("meta"):
            module._losses = []
            module.training_step(windows, 0).backward()
            module.on_train_batch_end(None, None, 0)
        assert len(module._losses) == 1


def test_the_default_device_meta_finds_a_forgotten_device() -> None:
    with torch.device("meta"), pytest.raises((RuntimeError, NotImplementedError)):
        (torch.ones(2, device="cpu") + torch.zeros(2)).sum().item()


def test_a_device_that_is_not_there_is_one_line() -> None:
    there = torch.cuda.device_count()
    with pytest.raises(UsageError, match=f"PyTorch finds {there}; give device: cpu"):
        MachineConfig(device=f"cuda:{there}").for_lightning()
    expected = "gpu" if there else "cpu"
    assert MachineConfig(device="auto").for_lightning()["accelerator"] == expected


def test_double_precision_trains_to_the_same_losses() -> None:
    losses = {}
    for precision, dtype in (("32-true", torch.float32), ("64-true", torch.float64)):
        module, store, residual = training(
            HEADS["mlp"], dtype, precision=precision, start_noise=0.0
        )
        losses[precision] = losses_of(module, store, residual)
    assert losses["64-true"] == pytest.approx(losses["32-true"], rel=1e-4)
    # were it single precision too, they would be equal
    assert losses["64-true"] != losses["32-true"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU is at hand")
def test_a_gpu_trains_to_the_same_losses() -> None:
    losses = {}
    for device in ("cpu", "cuda"):
        module, store, residual = training(
            HEADS["lstm"], torch.float64, device=device, precision="64-true"
        )
        losses[device] = losses_of(module, store, residual)
    assert losses["cuda"] == pytest.approx(losses["cpu"], rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("robust", [0.0, 0.3])
def test_two_processes_train_as_one(robust: float, tmp_path: Path) -> None:
    """The losses of the first 50 steps in float64, batches of odd size, two gloo processes."""
    found = {}
    for processes in (1, 2):
        # one step an epoch, so that the curve holds every loss
        module, store, residual = training(
            HEADS["lstm"],
            torch.float64,
            precision="64-true",
            processes=processes,
            robust=robust,
            steps=1,
            patience=100,
            one_step={**SETTINGS["one_step"], "epochs": 25},
            multi_step=[{**SETTINGS["multi_step"][0], "epochs": 25}],
        )
        found[processes] = losses_of(module, store, residual, tmp_path / str(processes))
        assert len(found[processes]) == 50
    assert found[2] == pytest.approx(found[1], rel=1e-6)
