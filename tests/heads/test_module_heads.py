"""Modules and config objects of the user as heads: fit, free run, ensemble, storage, export."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from tiny import TINY
from torch import Tensor, nn

import residnet
from residnet.core.errors import ConfigError, UsageError
from residnet.export import vessel
from residnet.heads.base import Features, ResidualHead, ResidualScale
from residnet.heads.config import BaseHeadConfig

TRAINING = {
    "steps": 3,
    "one_step": {"epochs": 1, "window": 2.0, "batch": 16},
    "multi_step": [{"horizon": 1.0, "epochs": 1, "batch": 16}],
}


class Memoryless(nn.Module):
    """A network of the five channels u, v, r, n_port, n_stbd."""

    def __init__(self) -> None:
        super().__init__()
        self.network = nn.Sequential(nn.Linear(5, 4), nn.Tanh(), nn.Linear(4, 3))

    def forward(self, z: Tensor) -> Tensor:
        result: Tensor = self.network(z)
        return result


class Recurrent(nn.Module):
    """A low-pass filter of the channels, and a linear map of its memory."""

    def __init__(self, n_inputs: int = 5) -> None:
        super().__init__()
        self.n_state = 4
        self.gate = nn.Linear(n_inputs + 4, 4)
        self.readout = nn.Linear(4, 3)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        s = torch.tanh(self.gate(torch.cat((z, s), dim=-1)))
        return self.readout(s), s


class DragHeadConfig(BaseHeadConfig):
    """Residual that is linear in the channels."""

    kind: Literal["linear_drag"] = "linear_drag"

    def build(self, names: Sequence[str]) -> DragHead:
        return DragHead(self, names)


class DragHead(ResidualHead):
    def __init__(self, config: DragHeadConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.features = Features(config.select_features(names), names, config.margin)
        self.scale = ResidualScale(self.n_dof)
        self.readout = nn.Linear(self.features.n_features, self.n_dof)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.scale(self.readout(self.features(z))), s


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


@pytest.fixture(scope="module")
def models(data: residnet.Dataset) -> residnet.Models:
    torch.manual_seed(3)
    names = ("plain", "filter", "drag")
    return residnet.fit(
        data,
        heads={"plain": Memoryless(), "filter": Recurrent(), "drag": DragHeadConfig()},
        training=dict.fromkeys(names, TRAINING),
        ensembles={"both": ["plain", "filter"]},
        bands=None,
    )


def test_modules_are_fitted_and_run_freely(models: residnet.Models) -> None:
    table = models.metrics.query("split == 'test' and protocol == 'T10' and manoeuvre == 'all'")
    errors = table.set_index("model").nrmse_mean
    assert set(errors.index) >= {"plain", "filter", "drag", "both"}
    assert np.isfinite(errors.to_numpy()).all()
    # three networks, three results
    assert len({round(errors[name], 9) for name in ("baseline", "plain", "filter", "drag")}) == 4
    # the module of the user is a template and keeps its weights
    assert models["plain"].notes["epochs"] == 2


# "both" holds the other two
@pytest.mark.parametrize(
    "name",
    [
        pytest.param("plain", marks=pytest.mark.long),
        pytest.param("filter", marks=pytest.mark.long),
        "both",
    ],
)
@pytest.mark.parametrize(("kind", "file"), [("torchscript", "model.pt"), ("c", "model.c")])
def test_modules_are_exported(
    models: residnet.Models,
    name: str,
    kind: str,
    file: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    # an export compares the written file with the model, and raises where they differ
    card = residnet.export_model(models[name], tmp_path / file, kind, allows_objections=True)
    assert (tmp_path / file).stat().st_size > 1000
    assert [entry["name"] for entry in card["inputs"]] == ["n_port", "n_stbd"]


def test_a_stored_module_is_loaded_with_its_class_only(
    models: residnet.Models, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    residnet.save(models["filter"], tmp_path / "filter")
    x, w = [0.0, 0.0, 0.0, 1.0, 0.1, 0.05], [20.0, 15.0]
    expected, _ = models["filter"].step(x, w)
    # as in another process
    monkeypatch.setattr("residnet.heads.module._templates", {})
    with pytest.raises(ConfigError, match="Python module Recurrent, and a stored model holds"):
        residnet.load(tmp_path / "filter")
    loaded = residnet.load(tmp_path / "filter", parts=[Recurrent()])
    np.testing.assert_allclose(loaded.step(x, w)[0], expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("head", "error", "message"),
    [
        (
            Recurrent(7),
            ConfigError,
            r"expected z \[B, 5\] with the channels u, v, r, n_port, n_stbd",
        ),
        (nn.Linear(5, 2), ConfigError, r"returns tensors of the shapes \[2, 2\] for two rows"),
        (nn.Bilinear(5, 5, 3), UsageError, "set self.n_state in __init__"),
    ],
)
def test_a_module_that_does_not_fit_is_refused_in_one_line(
    data: residnet.Dataset, head: nn.Module, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        residnet.fit(data, heads={"mine": head})
    assert "\n" not in str(caught.value)
