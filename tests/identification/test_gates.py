"""Gates in a fit: chosen on validation logs, refused where they cannot be."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tiny import TINY

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.data.simulated.trials import SimulatedTrials
from residnet.data.sources import read_logs
from residnet.dynamics.gate import GatedHead
from residnet.identification.fit import fit
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings

SETTINGS: dict[str, Any] = {
    **{key: TINY[key] for key in ("prepare", "signals", "baseline", "evaluation")},
    "heads": {"ridge": {"kind": "ridge"}},
    "gates": {"gate": {"of": "ridge"}},
    "bands": None,
}


def test_a_gate_is_fitted_beside_its_residual() -> None:
    settings = validate(SETTINGS, FitSettings, "here")
    assert settings.model_names == ("baseline", "ridge", "gate")
    logs = prepare_logs(read_logs(validate(TINY["data"], SimulatedTrials, "here")), settings)
    models = fit(logs, settings)
    gate, ridge = models["gate"], models["ridge"]
    assert gate.spec.gated
    assert gate.notes["of"] == "ridge"
    head = gate.model.head
    assert isinstance(head, GatedHead)
    assert gate.notes["fade"] == head.fade.tolist()
    x, s = torch.zeros(1, 6, dtype=torch.float64), torch.zeros(1, 0, dtype=torch.float64)
    x[0, 3] = 1.0
    w = torch.tensor([[10.0, 10.0]], dtype=torch.float64)
    torch.testing.assert_close(gate.model.step(x, w, s), ridge.model.step(x, w, s))
    far = gate.model.channels(1e4 * torch.ones_like(x), w)
    none = torch.zeros(1, 3)
    assert float(head.kept(far, none + 1.0, none).max()) < 1e-3
    rows = {row["model"] for row in models.evaluate(logs["validation"]).rows}
    assert {"baseline", "ridge", "gate"} <= rows


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"gates": {"gate": {"of": "rigde"}}}, "did you mean 'ridge'"),
        ({"gates": {"gate": {"of": "baseline"}}}, "no residual is named 'baseline'"),
        (
            {
                "baseline": {"kind": "believed", "vessel": "wam_v_cal"},
                "heads": {"ridge": {"kind": "ridge", "space": "force"}},
            },
            "is in force space",
        ),
    ],
)
def test_what_cannot_fade_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        validate(SETTINGS | changes, FitSettings, "here")
