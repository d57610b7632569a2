"""A gated ensemble in the formats that controllers load."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from exported_models import NAMES, VARIANTS, fill, spec_of

from residnet.baselines import BaselineConfig
from residnet.core.config import validate
from residnet.core.samples import Samples
from residnet.dynamics.gate import GatedHead
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.export import exporter, vessel
from residnet.export.vessel import ExportedVessel
from residnet.physics.signals import SignalsConfig
from residnet.testing import example_samples


def gated() -> tuple[ModelSpec, HybridDynamics]:
    torch.manual_seed(0)
    members = tuple(spec_of(VARIANTS[kind], name=kind) for kind in ("mlp", "lstm"))
    spec = members[0].model_copy(
        update={"name": "gate", "role": "ensemble", "head": None, "members": members, "gated": True}
    )
    model = spec.build()
    for place, member in enumerate(members):
        alone = member.build()
        fill(alone, place)
        model.baseline.members[place].load_state_dict(alone.baseline.state_dict())  # type: ignore[union-attr,index]
        model.head.inner.members[place].load_state_dict(alone.head.state_dict())  # type: ignore[union-attr,index]
    model = model.double()
    assert isinstance(model.head, GatedHead)
    z = torch.randn(400, len(NAMES), dtype=torch.float64) * 0.2
    model.head.calibrate(
        Samples(z, z[:, :3], torch.arange(400) // 40, torch.zeros(400), ("zigzag",) * 10, NAMES)
    )
    model.head.fade.fill_(0.3)
    return spec, model.eval()


def ship() -> tuple[ModelSpec, HybridDynamics]:
    """A physical model without a head, which holds numbers in parameters alone."""
    content = {
        "kind": "mmg",
        "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
        "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
        "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
    }
    signals = SignalsConfig(inputs=("n", "delta"))
    samples = example_samples("example_rudder_boat", signals)
    config = validate(content, BaselineConfig, "here").resolved()
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
    assert not list(model.buffers())
    return spec, model


@pytest.mark.exporters
@pytest.mark.parametrize("make", [gated, ship])
@pytest.mark.parametrize("name", ["torchscript", "c", "onnx", "casadi"])
def test_every_format_holds_a_gate_and_a_hull(
    name: str, make: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    spec, model = make()
    file = tmp_path / f"boat{exporter(name).suffix}"
    card = exporter(name).export(ExportedVessel(spec, model), file)
    assert file.is_file()
    assert card["gated"] is spec.gated


def test_a_gated_model_is_stored_and_loaded(tmp_path: Path) -> None:
    spec, model = gated()
    save_model(tmp_path / "gate", spec, model)
    again, loaded = load_model(tmp_path / "gate")
    assert again == spec
    x, w = torch.rand(5, 6, dtype=torch.float64), torch.rand(5, 4, dtype=torch.float64)
    s = model.initial_state(5).double()
    torch.testing.assert_close(loaded.double().step(x, w, s)[0], model.double().step(x, w, s)[0])
