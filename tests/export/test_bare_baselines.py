"""Physical models without a head: they may hold numbers in parameters alone, and no buffers."""

from __future__ import annotations

from pathlib import Path

import pytest
from exported_models import spec_of

from residnet.baselines import BaselineConfig
from residnet.core.config import validate
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export import ExportedVessel, exporter, vessel
from residnet.physics.signals import SignalsConfig
from residnet.testing import example_samples

SHIP = {
    "kind": "mmg",
    "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
    "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
    "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
}


def ship() -> tuple[ModelSpec, HybridDynamics]:
    signals = SignalsConfig(inputs=("n", "delta"))
    samples = example_samples("example_rudder_boat", signals)
    config = validate(SHIP, BaselineConfig, "here").resolved()
    spec = spec_of(
        None,
        role="baseline",
        signals=signals.resolved().model_dump(),
        baseline=config.model_dump(),
        low=samples.z[:, :5].min(0).values.tolist(),
        high=samples.z[:, :5].max(0).values.tolist(),
    )
    model = spec.build()
    config.fit(model.baseline, samples)
    return spec, model


@pytest.mark.exporters
@pytest.mark.parametrize("name", ["torchscript", "onnx", "c", "casadi"])
def test_a_model_without_buffers_is_exported(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    spec, model = ship()
    assert not list(model.buffers())
    file = tmp_path / f"ship{exporter(name).suffix}"
    card = exporter(name).export(ExportedVessel(spec, model), file)
    assert card["format"] == name
