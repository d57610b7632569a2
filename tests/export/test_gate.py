"""A gated ensemble in the formats that controllers load."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from exported_models import NAMES, VARIANTS, fill, spec_of

from residnet.core.samples import Samples
from residnet.dynamics.gate import GatedHead
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.export import ExportedVessel, exporter, vessel


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


@pytest.mark.exporters
@pytest.mark.parametrize("name", ["torchscript", "c", "onnx", "casadi"])
def test_every_format_holds_a_gate(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    spec, model = gated()
    kind = exporter(name)
    file = tmp_path / f"gate{kind.suffix}"
    card = kind.export(ExportedVessel(spec, model), file)
    assert file.is_file()
    assert card["gated"] is True


def test_a_gated_model_is_stored_and_loaded(tmp_path: Path) -> None:
    spec, model = gated()
    save_model(tmp_path / "gate", spec, model)
    again, loaded = load_model(tmp_path / "gate")
    assert again == spec
    x, w = torch.rand(5, 6, dtype=torch.float64), torch.rand(5, 4, dtype=torch.float64)
    s = model.initial_state(5).double()
    torch.testing.assert_close(loaded.double().step(x, w, s)[0], model.double().step(x, w, s)[0])
