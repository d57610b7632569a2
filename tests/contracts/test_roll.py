"""The contracts of every head, baseline and format where the models roll."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest
import torch

from residnet.baselines import BaselineConfig
from residnet.baselines.regressors import RegressorsConfig
from residnet.core.config import validate
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.layout import ROLL, Live, levelled
from residnet.core.log import Log
from residnet.core.registry import kinds
from residnet.data.doctor import inspect
from residnet.dynamics.base import Integrator
from residnet.dynamics.rollout import Rollout, scripted
from residnet.dynamics.store import ModelSpec
from residnet.heads import HeadConfig
from residnet.heads.linear import RidgeConfig
from residnet.heads.recurrent import RecurrentConfig
from residnet.identification.monitoring import MonitorConfig, Watch
from residnet.judge.freerun import integrate
from residnet.testing import check_baseline, check_head, example_samples
from residnet.testing.examples import ROLLING, example_model, example_spec

HEADS: dict[str, dict[str, Any]] = {
    "genetic": {"evolution": {"population": 60, "generations": 3}},
    "kernel": {"folds": 2, "penalties": [0.1]},
    "mlp": {"hidden": [8]},
    "lstm": {"hidden_size": 6},
    "recurrent": {"hidden_size": 6},
}
PHI, P = ROLL.names.index("phi"), ROLL.names.index("p")


@pytest.mark.parametrize("kind", kinds(HeadConfig))
def test_head(kind: str) -> None:
    if kind == "genetic":
        pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    check_head(validate({"kind": kind, **HEADS.get(kind, {})}, HeadConfig, "here"), ROLLING)


@pytest.mark.parametrize("kind", kinds(BaselineConfig))
def test_baseline(kind: str) -> None:
    given: dict[str, dict[str, Any]] = {
        "believed": {"vessel": "wam_v_cal"},
        "equations": {"r": {"r": -1.0}},
        "linear_steady": {"settled": 10, "speed": ["zigzag"], "steering": ["zigzag"]},
        "mmg": {
            "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
            "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
            "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
        },
    }
    config = validate({"kind": kind, **given.get(kind, {})}, BaselineConfig, "here")
    if kind in ("regressors", "still"):
        check_baseline(config, example_samples(signals=ROLLING))
        return
    with pytest.raises(ResidnetError, match="knows no roll"):
        config.build(ROLLING.build().names)


def test_an_angle_has_no_equation_of_its_own_and_restores() -> None:
    samples = example_samples(signals=ROLLING)
    config = RegressorsConfig(bounded=True, dissipative=True)
    baseline = config.build(samples.names)
    table = config.fit(baseline, samples)
    assert {entry.axis for entry in table} == {"u_dot", "v_dot", "r_dot", "p_dot"}
    assert not samples.target[:, ROLL.moving.index("phi")].any()
    roll = {entry.term: entry.value for entry in table if entry.axis == "p_dot"}
    # 2 pi over the natural period of 6.76 s of document 004, Table 5.2
    assert (-roll["phi"]) ** 0.5 == pytest.approx(2 * np.pi / 6.76, rel=0.1)
    assert roll["p"] < 0.0


@pytest.mark.parametrize("integrator", get_args(Integrator))
@pytest.mark.parametrize("head", [RidgeConfig(), RecurrentConfig(hidden_size=6)])
def test_the_roll_angle_moves_by_the_roll_rate(integrator: Integrator, head: Any) -> None:
    spec = example_spec(head, ROLLING).model_copy(update={"integrator": integrator})
    model = example_model(spec).double()
    x = torch.zeros(2, len(ROLL.names), dtype=torch.float64)
    x[:, 3:] = torch.tensor(np.array(spec.low[:5]) * 0.3 + np.array(spec.high[:5]) * 0.7)
    w = torch.tensor(np.array(spec.low[5:]) * 0.4 + np.array(spec.high[5:]) * 0.6).expand(2, 60, 2)
    s = model.initial_state(2).double()
    states = scripted(Rollout(model), 10_000)(x, w, s)[0]
    alone, after = [x], x
    for k in range(60):
        after, s = model.step(after, w[:, k], s)
        alone.append(after)
    torch.testing.assert_close(states, torch.stack(alone, dim=1), rtol=0, atol=1e-9)
    moved = states[0].detach().numpy()
    rate = np.diff(moved[:, PHI]) / spec.dt
    ends = moved[:-1, P], moved[1:, P]
    # the angle's rate lies between the velocities at both ends of a step
    apart = np.abs(ends[1] - ends[0]).max() + 1e-9
    assert np.abs(rate - 0.5 * (ends[0] + ends[1])).max() <= 0.51 * apart
    assert np.ptp(moved[:, PHI]) > 0.01
    pose = integrate(moved[0, :3], moved[:, 3:], spec.dt)
    np.testing.assert_allclose(moved[:, :3], pose, atol=0.05 * np.ptp(moved[:, 0]))


def test_the_pose_moves_with_the_roll() -> None:
    nu = np.array([[1.0, 0.5, 0.2, 0.0, 1.0]])
    level = np.cos(1.0)
    np.testing.assert_allclose(levelled(nu), [[1.0, 0.5 * level, 0.2 * level]])
    assert levelled(nu[:, :3]) is not nu
    np.testing.assert_array_equal(levelled(nu[:, :3]), nu[:, :3])


def test_zero_holds_the_roll_angle() -> None:
    content = example_spec(None, ROLLING).model_dump(mode="json", by_alias=True)
    content |= {"role": "zero", "baseline": {"kind": "still"}}
    model = ModelSpec.model_validate(content).build().double()
    x = torch.tensor([[0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.1, 0.2]], dtype=torch.float64)
    after, _ = model.step(x, torch.zeros(1, 2).double(), model.initial_state(1).double())
    torch.testing.assert_close(after[:, 3:], x[:, 3:], rtol=0, atol=0)


def test_what_logs_tell() -> None:
    def told(*names: str, moving: bool = True) -> Live:
        return Live.told({name: moving * np.arange(99.0) for name in names})

    assert told("x", "y", "psi", "phi").velocities == ("u", "v", "r", "p")
    assert told("x", "y", "psi", "p").planar
    assert told("x", "y", "psi", "phi", "p", moving=False).planar
    motion, noise = 0.1 * np.sin(np.arange(0.0, 60.0, 0.1)), np.random.default_rng(0)
    for size, moves in ((0.05, True), (0.2, False)):
        phi = motion + size * noise.normal(size=motion.size)
        assert Live.told({"u": motion, "phi": phi}).rolls == moves
    rolls, planar = told("u", "r", "phi", "p"), Live()
    assert rolls.dead == ("v",)
    assert rolls.channels == ("u", "r", "p", "phi")
    assert Live.shared([rolls, planar]).velocities == ("u", "r")
    assert Live.shared([Live(("u",)), Live(("r",))]).planar


def test_what_knows_no_roll_says_so() -> None:
    spec = example_spec(RidgeConfig(), ROLLING)
    with pytest.raises(UsageError, match=r"a monitor knows no roll.*\[u, v, r\]"):
        Watch(spec, example_model(spec), [], MonitorConfig())


@pytest.mark.parametrize("gain", [1.0, -1.0, 57.3])
def test_the_doctor_sets_the_roll_rate_against_the_roll_angle(gain: float) -> None:
    random, t = np.random.default_rng(2), np.arange(0.0, 120.0, 0.1)
    phi = 0.05 * np.sin(0.9 * t) + 0.001 * random.normal(size=t.size)
    p = gain * 0.05 * 0.9 * np.cos(0.9 * t) + 0.001 * random.normal(size=t.size)
    still = dict.fromkeys(("x", "y", "psi", "u", "v", "r"), 0.0 * t)
    log = Log("rolls", t, {**still, "phi": phi, "p": p}, {"phi": "rad", "p": "rad/s"})
    found = [one.text for one in inspect(log, []).findings if one.code == "roll_rate"]
    assert len(found) == (gain != 1.0)
    assert all(text.startswith(f"phi moves by {1.0 / gain:.2g} times") for text in found)
