"""What makes a model unsound, on models and logs made by hand, whose answers are known."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from kinds import of_kind
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.records import SANITY_CHECKS, SanityFile, SanityRow
from residnet.evaluation.soundness import (
    BOUNDEDNESS,
    DAMPING,
    STABILITY,
    SYMMETRY,
    TrainingPoints,
    build_sanity_file,
    check_model,
    compute_growth_rate,
    find_contradicting_steady_run,
    find_operating_points,
    find_steady_runs,
    mirror_inputs,
    settled_acceleration,
)
from residnet.heads.base import ResidualHead
from residnet.heads.lstm import LstmHead
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log

STEP = 0.5
Terms = Mapping[str, tuple[float, float, float]]
# u_dot, v_dot, r_dot by term: a vessel that behaves
RUDDER: Terms = {
    "u": (-0.1, 0, 0),
    "v": (0, -0.3, 0.05),
    "r": (0, -0.2, -0.5),
    "n": (0.02, 0, 0),
    "delta": (0, 0.01, 0.1),
}
# delta from two thrusters, by differences
TWIN: Terms = {
    **{name: row for name, row in RUDDER.items() if name in "uvr"},
    "n_port": (0.01, 0, 0.02),
    "n_stbd": (0.01, 0, -0.02),
}
SIDES = ("n_port", "n_stbd")


def made(
    terms: Terms,
    inputs: tuple[str, ...] = ("n", "delta"),
    *,
    exogenous: tuple[str, ...] = (),
    head: dict[str, object] | None = None,
    low: tuple[float, ...] = (0.0, -0.4, -0.2, 0.0, -0.6),
    high: tuple[float, ...] = (2.0, 0.4, 0.2, 10.0, 0.6),
) -> tuple[ModelSpec, HybridDynamics]:
    spec = ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "made",
            "role": "baseline" if head is None else "head",
            "signals": SignalsConfig(inputs=inputs, exogenous=exogenous).model_dump(),
            "baseline": {"kind": "regressors", "terms": list(terms)},
            "head": head,
            "dt": STEP,
            "integrator": "rk4",
            "low": low,
            "high": high,
        }
    )
    torch.manual_seed(0)
    model = spec.build()
    theta = of_kind(model.baseline, RegressorBaseline).theta
    theta.data.copy_(torch.tensor(list(terms.values()), dtype=torch.float64).T)
    return spec, model


def recorded(spec: ModelSpec, count: int = 300) -> TrainingPoints:
    """Points drawn in the training ranges."""
    random = np.random.default_rng(0)
    drawn = random.uniform(spec.low, spec.high, size=(count, len(spec.low)))
    x = np.concatenate((np.zeros((count, 3)), drawn[:, :3]), axis=1)
    return TrainingPoints(torch.from_numpy(x), torch.from_numpy(drawn[:, 3:]), 100.0, ())


def findings(spec: ModelSpec, model: HybridDynamics) -> dict[str, SanityRow]:
    return {finding.check: finding for finding in check_model(spec, model, recorded(spec))}


def twin(**change: tuple[float, float, float]) -> tuple[ModelSpec, HybridDynamics]:
    low = (0.0, -0.4, -0.2, 0.0, 0.0)
    high = (2.0, 0.4, 0.2, 10.0, 10.0)
    return made({**TWIN, **change}, SIDES, low=low, high=high)


@pytest.mark.parametrize("vessel", [made(RUDDER), twin()])
def test_a_vessel_that_behaves_passes(vessel: tuple[ModelSpec, HybridDynamics]) -> None:
    threads = torch.get_num_threads()
    found = findings(*vessel)
    assert list(found) == list(SANITY_CHECKS)
    assert all(finding.ok and not finding.fault for finding in found.values())
    assert torch.get_num_threads() == threads
    # one without inputs is checked from rest
    coasting = {name: row for name, row in RUDDER.items() if name in "uvr"}
    found = findings(*made(coasting, (), low=(0.0, -0.4, -0.2), high=(2.0, 0.4, 0.2)))
    assert found[BOUNDEDNESS].ok
    assert "1 from zero speed" in found[BOUNDEDNESS].text


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"u": (0.02, 0, 0)}, "d(u_dot)/du +0.02 1/s, positive at 100 %"),
        ({"r": (0, -0.2, 0.1)}, "d(r_dot)/dr +0.1 1/s"),
        ({"v": (0, 0.1, 0.05)}, "d(v_dot)/dv +0.1 1/s"),
    ],
)
def test_damping_of_the_wrong_sign_and_running_away(change: Terms, said: str) -> None:
    found = findings(*made({**RUDDER, **change}))
    assert found[DAMPING].ok is False
    assert said in found[DAMPING].fault
    assert found[DAMPING].text.startswith("unsound: its damping")
    assert "diverges within" in found[BOUNDEDNESS].fault
    assert "recorded inputs (n " in found[BOUNDEDNESS].fault


@pytest.mark.parametrize(
    "change",
    [
        # d u_dot/du = -0.1 + 0.01 u^2 is positive only beyond 3.2 m/s; the data reach 2 m/s
        {"u^3": (0.01 / 3.0, 0, 0)},
        {"v": (0, 0, 0.05)},
        {"u": (0, 0, 0), "u|u|": (-0.1, 0, 0)},
    ],
)
def test_damping_outside_the_data_or_none_at_all_is_no_wrong_sign(change: Terms) -> None:
    assert findings(*made({**RUDDER, **change}))[DAMPING].ok


def test_running_away_at_inputs_that_no_log_holds_is_no_fault() -> None:
    spec, model = made({**RUDDER, "u n": (0.02, 0, 0)})
    seen = recorded(spec)
    seen.w[:, 0] *= 0.2
    found = check_model(spec, model, seen)[SANITY_CHECKS.index(BOUNDEDNESS)]
    assert found.ok is False
    assert found.fault == ""
    assert "held from rest" in found.text


def test_instability_is_flagged_with_its_doubling_time_and_where_it_is() -> None:
    # v and r feed each other
    found = findings(*made({**RUDDER, "v": (0, -0.3, -1.0), "r": (0, -1.0, -0.5)}))
    assert found[DAMPING].ok is True
    assert found[STABILITY].ok is False
    assert "inside the training data" in found[STABILITY].text
    rate = np.linalg.eigvalsh([[-0.3, -1.0], [-1.0, -0.5]]).max()
    assert f"doubles in {math.log(2) / rate:.2g} s" in found[STABILITY].text
    # yaw damping 0.5 - 0.2 u turns at u = 2.5 m/s; the data end at 2
    found = findings(*made({**RUDDER, "u r": (0, 0, 0.2)}))
    assert found[STABILITY].ok is False
    assert "only outside the training data" in found[STABILITY].text
    assert "u = 3.00 m/s (outside the training data)" in found[STABILITY].text


def test_growth_rate_with_a_memory_is_that_of_the_whole_step() -> None:
    spec, model = made(RUDDER, head={"kind": "lstm", "hidden_size": 3, "skip": "none"})
    model = model.double().eval()
    of_kind(model.head, LstmHead).scale.std.fill_(0.3)
    point = find_operating_points(spec, model)[2]
    s = model.warmup(point.x.expand(1, 20, 6), point.w.expand(1, 20, 2))[0]

    def step(z: torch.Tensor) -> torch.Tensor:
        x, memory = model.step(torch.cat((point.x[:4], z[:2]))[None], point.w[None], z[2:][None])
        return torch.cat((x[0, 4:], memory[0]))

    jacobian = torch.autograd.functional.jacobian(step, torch.cat((point.x[4:], s)))
    expected = math.log(float(torch.linalg.eigvals(jacobian).abs().max())) / STEP
    assert compute_growth_rate(model, point.x, point.w) == pytest.approx(expected, rel=1e-9)


def test_cruise_holds_its_speed_with_the_rudder_amidships() -> None:
    spec, model = made(RUDDER)
    points = {point.label: point for point in find_operating_points(spec, model.double())}
    cruise = points["cruise"]
    assert cruise.speed == pytest.approx(0.67 * 2.0)
    assert float(cruise.w[1]) == 0.0
    # u_dot = 0.02 n - 0.1 u vanishes at n = 6.7; the drives tried are 0.25 apart
    assert float(cruise.w[0]) == pytest.approx(6.7, abs=0.13)
    assert cruise.is_inside_training_range


@pytest.mark.parametrize(
    "vessel",
    [
        *(made({**RUDDER, one: (*RUDDER.get(one, (0, 0))[:2], 0.05)}) for one in ("1", "n", "u")),
        twin(n_stbd=(0.01, 0, -0.01)),
    ],
)
def test_a_vessel_that_turns_by_itself_or_has_unequal_thrusters_is_flagged(
    vessel: tuple[ModelSpec, HybridDynamics],
) -> None:
    found = findings(*vessel)
    assert found[SYMMETRY].ok is False
    assert "differ" in found[SYMMETRY].text


def test_symmetry_needs_to_know_what_steers() -> None:
    terms = {name: value for name, value in RUDDER.items() if name not in ("n", "delta")} | {
        "lever": (0.02, 0, 0),
        "wheel": (0, 0.01, 0.1),
    }
    found = findings(*made(terms, ("lever", "wheel")))
    assert found[SYMMETRY].ok is None
    assert "no steering input is recognised" in found[SYMMETRY].text


def test_wind_from_the_other_side_is_the_mirror_of_wind() -> None:
    wind = {"wind_u": (0.01, 0, 0), "wind_v": (0, 0.02, 0.01)}
    low = (0.0, -0.4, -0.2, 0.0, -0.6, 0.0, -3.2)
    high = (2.0, 0.4, 0.2, 10.0, 0.6, 8.0, 3.2)
    names = ("wind_speed", "wind_dir")
    spec, model = made({**RUDDER, **wind}, exogenous=names, low=low, high=high)
    assert findings(spec, model)[SYMMETRY].ok is True
    seen = recorded(spec)
    other = mirror_inputs(spec.signals.input_columns, seen.w)
    assert other is not None
    turned = seen.x * torch.tensor([1.0, -1, -1, 1, -1, -1], dtype=torch.float64)
    model = model.double()
    one, two = (
        settled_acceleration(model, seen.x, seen.w),
        settled_acceleration(model, turned, other),
    )
    torch.testing.assert_close(two, one * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    assert mirror_inputs(("n_port", "delta"), seen.w[:, :2]) is None


def test_a_network_on_top_is_checked_with_its_memory_settled() -> None:
    spec, model = made(RUDDER, head={"kind": "lstm", "hidden_size": 4, "skip": "none"})
    of_kind(model.head, LstmHead).scale.std.fill_(1e-6)
    # the memory of an untrained network may be unstable by itself
    assert all(found.ok for found in findings(spec, model).values() if found.check != STABILITY)
    of_kind(model.head, LstmHead).scale.std.fill_(0.5)
    assert findings(spec, model)[SYMMETRY].ok is False
    assert next(model.head.parameters()).dtype == torch.float32, "the model stays as it is"


class Carried(ResidualHead):
    """Adds twice the acceleration by which the past was predicted wrong."""

    def __init__(self) -> None:
        super().__init__()
        self.innovation_time_constant = 2.0

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return 2.0 * z[:, -self.n_dof :], s


def test_what_looks_for_an_unknown_force_is_asked_without_a_past() -> None:
    spec, plain = made(RUDDER)
    model = HybridDynamics(plain.signals, plain.baseline, Carried(), STEP, "rk4")
    low = spec.low[:3]
    high = spec.high[:3]
    for one in (model, MeanOfTrajectories([plain, model], low, high)):
        assert one.has_innovation
        found = findings(spec, one)
        assert found[DAMPING].ok, found[DAMPING].text
        slopes = re.findall(r"d[uvr] ([-+][.0-9]+)", found[DAMPING].text)
        # the mean's are those of a step, by its length
        np.testing.assert_allclose([*map(float, slopes)], [-0.1, -0.3, -0.5], rtol=0.15)
    # what runs away by itself is found all the same
    spec, plain = made({**RUDDER, "u": (0.1, 0, 0)})
    wrong = HybridDynamics(plain.signals, plain.baseline, Carried(), STEP, "rk4")
    for one in (wrong, MeanOfTrajectories([plain, wrong], low, high)):
        assert findings(spec, one)[DAMPING].fault


def log(seconds: float = 200.0, *, settles: bool = True) -> PreparedLog:
    """A log at constant drive: its rudder is put over once and it turns steadily, or it is held and
    it turns ever faster.
    """
    t = np.arange(0.0, seconds, STEP)
    random = np.random.default_rng(0)
    u = 2.0 * (1.0 - np.exp(-t / 10.0))
    over = t > (40.0 if settles else -1.0)
    turning = 0.1 * (1.0 - np.exp(-np.maximum(t - 40.0, 0.0) / 3.0))
    r = turning if settles else 0.001 * np.exp(t / 40.0)
    r, v = r + 0.001 * random.standard_normal(t.size), -0.5 * r
    channels = {
        "x": np.cumsum(u) * STEP,
        "y": np.zeros(t.size),
        "psi": np.cumsum(r) * STEP,
        "u": u,
        "v": v + 0.001 * random.standard_normal(t.size),
        "r": r,
        "n": np.full(t.size, 8.0),
        "delta": np.where(over, 0.5, 0.0),
    }
    derivative = {"kind": "savitzky_golay", "window": 5 * STEP, "order": 2}
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": derivative})
    return prepare_log(Log("made", t, channels), "train", ("n", "delta"), config)


def test_points_of_several_logs_are_recorded_ones_with_the_extreme_inputs() -> None:
    logs = [replace(log(), usable=np.arange(400) % 3 > 0), log(150.0, settles=False), log(300.0)]
    logs[2].w[77, 1], logs[0].w[1, 0] = -0.9, 55.0
    points = TrainingPoints.from_logs(logs, STEP)
    recorded = {
        (*state[3:], *inputs)
        for one in logs
        for state, inputs in zip(one.smoothed[one.usable], one.w[one.usable], strict=True)
    }
    found = list(map(tuple, np.hstack((points.x[:, 3:], points.w)).tolist()))
    assert set(found) <= recorded
    assert 90 <= len(found) <= 94
    assert points.w[:, 1].min() == -0.9
    assert points.w[:, 0].max() == 55.0
    speeds = [np.hypot(state[0], state[1]) for state in recorded]
    assert np.hypot(*points.x[:, 3:5].numpy().T).max() == max(speeds)
    assert points.longest_duration == 299.5


def test_an_unstable_model_is_contradicted_by_a_vessel_that_turns_steadily_only() -> None:
    # the faster mode of sway and yaw grows by about 0.1 1/s
    _, model = made({**RUDDER, "v": (0, -0.3, -0.6), "r": (0, -0.4, -0.3)})
    steady = find_steady_runs([log()], STEP)
    # the stretches of held inputs, without what settles
    assert [round(run.duration) for run in steady] == [30, 120]
    assert steady[1].mean_inputs.tolist() == pytest.approx([8.0, 0.5])
    assert steady[1].mean_state[5] == pytest.approx(0.1, abs=0.002)
    assert steady[1].growth < 2.0
    assert steady[0].decay < 3.0 < steady[1].decay
    assert "unstable where the logs are not" in find_contradicting_steady_run(model, steady)
    assert find_contradicting_steady_run(model, find_steady_runs([log(settles=False)], STEP)) == ""
    # a straight run that nothing disturbs proves nothing
    assert find_contradicting_steady_run(model, steady[:1]) == ""
    # one that grows too slowly for the logs to tell
    _, slow = made({**RUDDER, "v": (0, -0.3, -0.38), "r": (0, -0.4, -0.5)})
    assert find_contradicting_steady_run(slow, steady) == ""


def test_a_small_swing_in_a_turn_is_no_fault_where_the_vessel_swings_as_much() -> None:
    """Nobody measured the wind, and a model swings a little where it blew the vessel about: its
    linearised growth says nothing of how far it goes.
    """
    change = {"v": (0, -0.3, -0.6), "r": (0, -0.4, -0.3)}
    _, runs_off = made({**RUDDER, **change})
    _, swings = made({**RUDDER, **change, "v^3": (0, -30.0, 0)})
    steady = find_steady_runs([log()], STEP)
    blown = [replace(run, scatter=np.array([0.2, 0.2])) for run in steady]
    assert "unstable where the logs are not" in find_contradicting_steady_run(runs_off, blown)
    assert "unstable where the logs are not" in find_contradicting_steady_run(swings, steady)
    assert find_contradicting_steady_run(swings, blown) == ""


def test_findings_go_through_the_file_of_a_run(tmp_path: Path) -> None:
    spec, model = made({**RUDDER, "u": (0.02, 0, 0)})
    found = check_model(spec, model, recorded(spec))
    assert SanityFile.read_optional(tmp_path, "sanity.json") is None
    content = build_sanity_file({"made": found})
    (tmp_path / "sanity.json").write_text(content.to_json_text(), encoding="utf-8")
    assert SanityFile.read(tmp_path / "sanity.json").findings == tuple(found)
    (tmp_path / "sanity.json").write_text("{", encoding="utf-8")
    with pytest.raises(UsageError, match=r"sanity\.json: not readable as JSON"):
        SanityFile.read(tmp_path / "sanity.json")
