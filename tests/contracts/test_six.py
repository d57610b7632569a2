"""The contracts of every head, baseline and format in six degrees of freedom, and rotations."""

from __future__ import annotations

import functools
from typing import Any, get_args

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.config import validate
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.frames import rotated, to_earth, turn_between, upright
from residnet.core.layout import ATTITUDE, SIX, Live, levelled
from residnet.core.log import Log
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.simulated import SimulatedTrials, fly_trials
from residnet.dynamics.base import Integrator
from residnet.dynamics.rollout import Rollout, scripted
from residnet.heads.linear import RidgeConfig
from residnet.heads.recurrent import RecurrentConfig
from residnet.identification.changes import causes
from residnet.identification.recipe import integrator
from residnet.judge.freerun import drift
from residnet.physics.hull import SubmergedConfig
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.testing import example_samples
from residnet.testing.checks import STEP, SUBMERGED, example_model, example_spec
from residnet.training import refit

DEPTH = SIX.names.index("z")
HULL = RegressorsConfig(sets=("fossen",), ridge=1e-4)


def test_rotations_are_those_of_quaternions() -> None:
    random = torch.Generator().manual_seed(0)
    angles, turn, vector = torch.randn(3, 40, 3, generator=random, dtype=torch.float64)
    angles[0] = torch.tensor([0.4, np.pi / 2, -0.3])

    def known(a: torch.Tensor) -> Rotation:
        return Rotation.from_euler("ZYX", a.numpy()[:, ::-1])

    after = rotated(angles, turn)
    wanted = known(angles) * Rotation.from_rotvec(turn.numpy())
    assert float((known(after).inv() * wanted).magnitude().max()) < 1e-7
    u, v, w = vector.T
    ahead, across, down = upright(u, v, w, angles[:, 0], angles[:, 1])
    north, east = to_earth(ahead, across, angles[:, 2])
    np.testing.assert_allclose(
        torch.stack((north, east, down), dim=1), known(angles).apply(vector.numpy()), atol=1e-12
    )
    size = turn_between(angles.numpy(), after.numpy())
    full = turn.norm(dim=-1).numpy() % (2.0 * np.pi)
    np.testing.assert_allclose(size, np.minimum(full, 2.0 * np.pi - full), atol=1e-7)
    # whole turns are counted, and a loop through the vertical ends where it began
    angles = torch.zeros(1, 3, dtype=torch.float64)
    for _ in range(100):
        angles = rotated(angles, torch.tensor([[0.0, 0.0, 0.1 * np.pi]]).double())
    assert float(angles[0, 2]) == pytest.approx(10 * np.pi)
    for _ in range(20):
        angles = rotated(angles, torch.tensor([[0.0, 0.1 * np.pi, 0.0]]).double())
    assert turn_between(angles.numpy(), np.array([[0.0, 0.0, 10 * np.pi]]))[0] < 1e-6


@pytest.mark.parametrize("integrator", get_args(Integrator))
@pytest.mark.parametrize("head", [RidgeConfig(), RecurrentConfig(hidden_size=6)])
def test_attitude_depth_and_place_follow_the_velocities(integrator: Integrator, head: Any) -> None:
    spec = example_spec(head, SUBMERGED).model_copy(update={"integrator": integrator})
    model = example_model(spec).double()
    n = len(SIX.moving)
    x = torch.zeros(2, len(SIX.names), dtype=torch.float64)
    x[:, 3:] = torch.tensor(np.array(spec.low[:n]) * 0.3 + np.array(spec.high[:n]) * 0.7)
    w = torch.tensor(np.array(spec.low[n:]) * 0.4 + np.array(spec.high[n:]) * 0.6)
    w, s = w.expand(2, 40, 3), model.initial_state(2).double()
    with torch.no_grad():
        states = Rollout(model)(x, w, s)[0]
        compiled = scripted(Rollout(model), 10_000)(x, w, s)[0]
    torch.testing.assert_close(compiled, states, rtol=0, atol=1e-9)
    # what the depth is changes nothing else
    deep = x.clone()
    deep[:, DEPTH] += 50.0
    with torch.no_grad():
        other = Rollout(model)(deep, w, s)[0]
    other[..., DEPTH] -= 50.0
    torch.testing.assert_close(other, states, rtol=0, atol=1e-9)
    path = states[0].numpy()
    turned = turn_between(path[1:, ATTITUDE], path[:-1, ATTITUDE])
    omega = np.linalg.norm(path[:, [7, 8, 5]], axis=1) * spec.dt
    # an angle of rotation is that of the velocities at one end of a step or between both
    assert np.abs(turned - 0.5 * (omega[1:] + omega[:-1])).max() < 0.6 * np.ptp(omega)
    attitude = Rotation.from_euler("ZYX", path[:, [2, 11, 10]])
    ground = attitude.apply(path[:, [3, 4, 6]])
    way = np.cumsum(0.5 * spec.dt * (ground[1:] + ground[:-1]), axis=0)
    np.testing.assert_allclose(
        path[1:, [0, 1, DEPTH]] - path[0, [0, 1, DEPTH]], way, atol=0.06 * np.abs(way).max()
    )


@pytest.mark.parametrize("integrator", get_args(Integrator))
def test_sensitivities_are_the_derivatives_of_the_step(integrator: Integrator) -> None:
    spec = example_spec(None, SUBMERGED)
    spec = spec.model_copy(update={"integrator": integrator, "baseline": HULL})
    model = spec.build().double()
    HULL.fit(model.baseline, example_samples(signals=SUBMERGED))
    random = torch.Generator().manual_seed(0)
    spread = torch.tensor([0, 0, 1, 0.3, 0.1, 0.3, 0.1, 0.3, 0.3, 1, 0.6, 0.6]).double()
    x = torch.randn(3, 12, generator=random, dtype=torch.float64) * spread
    x[:, 3] += 1.5
    p = model.signals.prepare(torch.tensor([[0.2, -0.1, 10.0]]).double().expand(3, 3))
    baseline: Any = model.baseline
    active = baseline.free_indices()
    s = 0.1 * torch.randn(3, 10, len(active), generator=random, dtype=torch.float64)
    found = refit.step_sensitivities(model, x, p, s)
    start, size = baseline.theta.detach().flatten()[active].clone(), 1e-6
    for j in range(0, len(active), 17):
        ends = []
        for sign in (1.0, -1.0):
            values, moved = start.clone(), x.clone()
            values[j] += sign * size
            moved[:, 2:] += sign * size * s[:, :, j]
            baseline.place(values)
            with torch.no_grad():
                ends.append(refit._ahead(model, moved, p)[:, 2:])
        wanted = (ends[0] - ends[1]) / (2.0 * size)
        torch.testing.assert_close(found[:, :, j].detach(), wanted, rtol=1e-6, atol=1e-6)


def test_a_drafted_model_swings_as_its_vessel() -> None:
    """The roll of a torpedo has a period of ten steps of its logs."""
    rate, none = 6.3, ("u v",)
    rows = dict.fromkeys(("u", "v", "r", "w", "q"), none) | {"p": ("cos(theta) sin(phi)",)}
    swing = RegressorsConfig.model_validate({"terms": rows})
    changes = {"integrator": integrator(SUBMERGED.live), "baseline": swing, "dt": 0.1}
    model = example_spec(None, SUBMERGED).model_copy(update=changes).build().double()
    baseline: Any = model.baseline
    with torch.no_grad():
        row = baseline.outputs.index("p_dot")
        baseline.theta[row, baseline.library.terms.index("cos(theta) sin(phi)")] = -(rate**2)
        x = torch.zeros(1, 12, dtype=torch.float64)
        x[0, ATTITUDE[0]] = 0.05
        run = Rollout(model)(x, torch.zeros(1, 50, 3).double(), model.initial_state(1).double())[0]
    wanted = 0.05 * np.cos(rate * 0.1 * np.arange(51))
    np.testing.assert_allclose(run[0, :, ATTITUDE[0]].numpy(), wanted, atol=0.1 * 0.05)


def trials(count: int, duration: float) -> SimulatedTrials:
    """Noiseless trials of the torpedo in depth and heading."""
    kinds_of: list[dict[str, Any]] = [
        {"kind": "depth_step", "depth": [3.0], "start": 1.0},
        {"kind": "helix", "drive": [0.5, 0.9], "start": 1.0},
        {"kind": "random_steps", "dive_amplitude": [0.2, 0.6], "drive_amplitude": [0.1, 0.3]},
    ]
    return SimulatedTrials.model_validate(
        {
            "vessel": "remus_100",
            "step": STEP,
            "substeps": 2,
            "duration": duration,
            "trials": [{**kind, "count": count} for kind in kinds_of],
            "identification": {},
            "validation": {},
            "noise": {"u": 0.0, "v": 0.0, "r": 0.0},
        }
    )


def test_what_logs_tell_and_lack() -> None:
    config = trials(2, 15.0)
    log = fly_trials(config.draw(), config)[0].log
    live = Live.told(log.channels)
    assert live.spatial
    assert live.whole
    assert live.channels == ("u", "v", "r", "w", "p", "q", "z", "phi", "theta")
    assert Live.shared([live, live]) == live
    assert Live.shared([live, Live()]).planar
    held = {name: values for name, values in log.channels.items() if name != "z"}
    assert not Live.told(held).spatial
    with pytest.raises(UsageError, match="z is not measured at every sample"):
        complete_motion(log.replace(channels=held), MotionConfig(), live)
    with pytest.raises(ResidnetError, match="all six"):
        validate({"inputs": ["n"], "velocities": ["u", "v", "w"]}, SignalsConfig, "here")
    assert {"damping heave", "damping pitch", "restoring pitch"} <= {
        c.name for c in causes(SUBMERGED)
    }
    # the rates of the pose are those of the log
    rate = np.gradient(log["psi"], log.t)
    assert np.abs(rate - levelled(log.stack(live.moving))[:, 2])[5:-5].max() < 0.03


@functools.cache
def flown() -> list[Log]:
    config = trials(4, 40.0)
    return [flight.log for flight in fly_trials(config.draw(), config)]


def test_measured_velocities_lead_to_the_measured_pose() -> None:
    y = np.stack([log.stack(SIX.names) for log in flown()])
    off = drift(y, SUBMERGED.live, STEP)
    assert list(off) == list(SUBMERGED.live.ends) == ["position", "depth", "attitude"]
    way = np.hypot(*np.diff(y[:, :, :2], axis=1).T).sum(axis=0)
    assert (off["position"] < 0.01 * way).all()
    assert (off["depth"] < 0.01 * way).all()
    assert (off["attitude"] < 0.01).all()


def test_a_depth_and_a_loop_are_no_runaway() -> None:
    low, high = -np.ones(12), 2.0 * np.ones(12)
    size = SUBMERGED.live.largest(low, high)
    assert size[:6].tolist() == [2.0] * 6
    assert np.isinf(size[6:]).all()
    assert Live().largest(low, high).tolist() == [2.0] * 3


@pytest.mark.parametrize("beside", ["samples", "means"])
def test_least_squares_find_the_vessel(beside: str) -> None:
    """Of noiseless trials: what the trials determine is that of the vessel's file."""
    signals = SUBMERGED.build()
    # means are right by a smoother that softens the swing in roll
    smoother = {"kind": "savitzky_golay", "window": 0.5, "order": 2 if beside == "means" else 4}
    how = PrepareConfig.model_validate(
        {"grid": {"step": STEP}, "derivative": smoother, "beside": beside, "hold": "mean"}
    )
    logs = [prepare(log, "train", SUBMERGED.columns, how, SUBMERGED.live) for log in flown()]
    found_in = samples(logs, signals)
    exact = RegressorsConfig(sets=("fossen",), ridge=1e-9)
    table = exact.fit(exact.build(found_in.names), found_in)
    vessel = load_vessel("remus_100")
    assert isinstance(vessel, SubmergedConfig)
    terms, rows = vessel.hull().equations()
    order = ("u", "v", "w", "p", "q", "r")
    true = {
        (axis, term): row[place]
        for axis, row in zip(order, rows, strict=True)
        for place, term in enumerate(terms)
    }
    for axis, term, most in (
        ("u", "u|u|", 0.05),
        ("r", "r|r|", 0.05),
        ("q", "sin(theta)", 0.05),
        ("q", "q", 0.05),
        ("v", "u r", 0.05),
        ("w", "u q", 0.05),
        ("p", "cos(theta) sin(phi)", 0.05),
    ):
        (found,) = (one.value for one in table if (one.axis, one.term) == (f"{axis}_dot", term))
        assert found == pytest.approx(true[axis, term], rel=most)
