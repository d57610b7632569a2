"""Gates in a fit: chosen on validation logs, refused where they cannot be."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from tiny import TINY

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.core.samples import Samples
from residnet.data.simulated import SimulatedTrials
from residnet.data.sources import read_logs
from residnet.dynamics.gate import GatedHead
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.linear import RidgeConfig
from residnet.identification.fit import fit
from residnet.identification.fitter import reach_in_free_runs
from residnet.identification.prepared import prepare_logs
from residnet.identification.settings import FitSettings
from residnet.training.heads import Score

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


@pytest.mark.parametrize(
    ("helps", "lost", "reaches"),
    [(0.5, 0.05, [100.0, 100.0, 100.0]), (0.5, 0.4, [1.0, 1.0, 5.0]), (-0.1, 0.0, [0.1] * 3)],
)
def test_a_residual_reaches_as_far_as_free_runs_leave_half_of_its_gain(
    helps: float, lost: float, reaches: list[float]
) -> None:
    """Fades beyond 1 lose some of what the residual helps, so that the farthest may lose most."""
    settings = validate(SETTINGS, FitSettings, "here")
    model = settings.baseline.build(settings.signals.build().names)
    signals = settings.signals.build()
    inner = RidgeConfig().build(signals.names)
    gate = GatedHead(inner, signals.count)
    gate.fade.copy_(torch.tensor([0.1, 0.5, 5.0]))
    hybrid = HybridDynamics(signals, model, gate, 0.1)
    z = torch.rand(100, signals.count, dtype=torch.float64)
    known = Samples(z, z[:, :3], torch.zeros(100), torch.zeros(100), ("zigzag",), signals.names)
    asked: list[float] = []

    def judged(tried: HybridDynamics) -> Score:
        if not isinstance(tried.head, GatedHead):
            return Score(0, 2.0)
        least = float(tried.head.fade.min())
        # a box of the range, and not the range itself
        assert (tried.head.low > z.amin(0)).all()
        asked.append(least)
        return Score(0, 2.0 * (1.0 - helps + (lost if least > 1.0 else 0.0)))

    error = reach_in_free_runs(hybrid, known, (0.1, 1.0, 5.0, 100.0), judged)
    assert gate.fade.tolist() == reaches
    assert error["at least 100"] == pytest.approx(1.0 - helps + lost)
    # three boxes for each fade, none of them twice
    assert len(asked) == 15


def test_a_residual_that_diverges_fades_at_once() -> None:
    settings = validate(SETTINGS, FitSettings, "here")
    signals = settings.signals.build()
    gate = GatedHead(RidgeConfig().build(signals.names), signals.count)
    model = HybridDynamics(signals, settings.baseline.build(signals.names), gate, 0.1)
    z = torch.rand(100, signals.count, dtype=torch.float64)
    known = Samples(z, z[:, :3], torch.zeros(100), torch.zeros(100), ("zigzag",), signals.names)

    def judged(tried: HybridDynamics) -> Score:
        gated = isinstance(tried.head, GatedHead)
        return Score(int(gated), 0.5 if gated else 1.0)

    error = reach_in_free_runs(model, known, (0.1, 100.0), judged)
    assert gate.fade.tolist() == [0.1, 0.1, 0.1]
    assert set(error.values()) == {float("inf")}
