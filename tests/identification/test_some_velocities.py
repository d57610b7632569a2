"""Logs that tell some of u, v and r alone: their motion, a fit in Python, and what is judged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import residnet
from residnet.core.errors import ConfigError, UsageError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.log import Log
from residnet.identification.planning import TrialLimits, infer_input_shares, propose_manoeuvres
from residnet.identification.settings import FitSettings
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.motion import MotionConfig, complete_motion
from residnet.testing.checks import make_example_spec

STEP = 0.2


def trial(number: int, *channels: str) -> Log:
    """Return a boat's speed and yaw rate by first-order lags, with what drives them."""
    random = np.random.default_rng(number)
    t = np.arange(0.0, 80.0, STEP)
    n, delta = (random.uniform(low, 1.0, 17)[(t / 5.0).astype(int)] for low in (0.2, -1.0))
    u, r = np.zeros(t.size), np.zeros(t.size)
    for k in range(t.size - 1):
        u[k + 1] = u[k] + STEP * (0.8 * n[k] - 0.4 * u[k])
        r[k + 1] = r[k] + STEP * (0.2 * delta[k] - 0.5 * r[k])
    u, r = u + 0.005 * random.normal(size=t.size), r + 0.002 * random.normal(size=t.size)
    psi = np.concatenate(([0.0], np.cumsum(0.5 * STEP * (r[1:] + r[:-1]))))
    known = {"u": u, "r": r, "psi": psi, "n": n, "delta": delta, "x": t, "y": 0.0 * t}
    return Log(f"trial_{number}", t, {name: known[name] for name in channels}, {"delta": "rad"})


@pytest.mark.parametrize(
    ("channels", "velocities"),
    [
        # surge alone is the fast one
        (("u", "n"), ("u",)),
        pytest.param(("psi", "delta"), ("r",), marks=pytest.mark.long),
        pytest.param(("u", "psi", "n", "delta"), ("u", "r"), marks=pytest.mark.long),
    ],
)
def test_a_fit_is_of_what_the_logs_tell(
    channels: tuple[str, ...], velocities: tuple[str, ...]
) -> None:
    data = residnet.prepare([trial(number, *channels) for number in range(6)])
    assert data.signals.velocities == velocities
    models = residnet.fit(data, "regressors", ["ridge"] if len(velocities) > 1 else ())
    table = residnet.metrics(models, split="test")
    live = DegreesOfFreedom(velocities)
    assert {name for name in map(str, table) if name.startswith("rmse_")} == {
        f"rmse_{v}" for v in velocities
    }
    assert ("position_error_end" in table) == live.has_position
    assert ("heading_error_end" in table) == live.has_heading
    error = table.groupby("model")["nrmse_mean"].mean()
    assert error["baseline"] < 0.2 < error["constant_velocity"]
    x = np.array([0.0, 0.0, 0.3, 0.5, 0.7, 0.1])
    after, _ = models["baseline"].step(x, np.full(len(data.signals.inputs), 0.5))
    # a velocity that was not recorded is zero, whatever it is given as
    assert np.flatnonzero(after[3:]).tolist() == live.active_indices
    runs = models.runs["test"]
    assert len(runs.plot_history().axes) == len(velocities) + live.has_heading
    if not (live.has_position and live.has_heading):
        with pytest.raises(UsageError, match="has no track"):
            runs.plot_track()
    words = " ".join(models.verdict)
    assert (" m " in words or " m;" in words, " deg" in words) == (
        live.has_position,
        live.has_heading,
    )


def dive(number: int, *channels: str) -> Log:
    """Return a vehicle that dives by planes and a propeller, and rights itself in pitch."""
    random = np.random.default_rng(number)
    t = np.arange(0.0, 60.0, STEP)
    hold = (t / 5.0).astype(int)
    n = random.uniform(8.0, 16.0, 21)[hold]
    planes = random.uniform(-0.2, 0.2, 21)[hold]
    x = np.zeros((t.size, 5))
    x[0] = 1.2, 0.0, 0.0, 0.0, 20.0
    for k in range(t.size - 1):
        x[k + 1] = x[k]
        for _ in range(8):
            u, w, q, theta, _ = x[k + 1]
            force = (
                -0.1 * u * u + 1e-3 * n[k] ** 2,
                -0.8 * u * w + 0.5 * u * q - 0.25 * u * u * planes[k],
            )
            turn = -0.9 * q * u - 0.9 * np.sin(theta) - 0.35 * u * u * planes[k] - 0.6 * u * w
            down = w * np.cos(theta) - u * np.sin(theta)
            x[k + 1] += STEP / 8 * np.array([*force, turn, q, down])
    noise = 0.002 * random.normal(size=x.shape)
    known = dict(zip(("u", "w", "q", "theta", "z"), (x + noise).T, strict=True))
    known |= {"n": n, "delta_s": planes}
    return Log(f"dive_{number}", t, {name: known[name] for name in channels})


def slowly(made: Callable[..., Log]) -> Callable[..., Log]:
    """Return logs whose depth comes at every fifth sample."""

    def slow(number: int, *channels: str) -> Log:
        log = made(number, *channels)
        z = np.where(np.arange(len(log)) % 5 == 0, log["z"], np.nan)
        return log.replace(channels={**log.channels, "z": z})

    return slow


def sink(number: int, *channels: str) -> Log:
    """Return a float that a thrust moves down and up."""
    random = np.random.default_rng(number)
    t = np.arange(0.0, 100.0, STEP)
    thrust = random.uniform(-10.0, 10.0, 13)[(t / 8.0).astype(int)]
    w = np.zeros(t.size)
    for k in range(t.size - 1):
        w[k + 1] = w[k] + STEP * (0.01 * thrust[k] - 0.4 * w[k] * abs(w[k]) - 0.05 * w[k])
    z = STEP * np.cumsum(w) + 0.002 * random.normal(size=t.size)
    known = {"w": w, "z": z, "thrust": thrust}
    return Log(f"sink_{number}", t, {name: known[name] for name in channels}, {"thrust": "N"})


def test_a_boat_over_a_bottom_does_not_dive() -> None:
    """Its echo sounder and the pitch that waves and trim give do not follow from one another."""
    logs = []
    for number in range(3):
        random = np.random.default_rng(number)
        log = trial(number, "u", "n")
        z = 12.0 + 0.02 * np.cumsum(random.normal(size=len(log)))
        theta = 0.03 * np.sin(2.0 * log.t) + 0.02 * log["u"]
        logs.append(log.replace(channels={**log.channels, "z": z, "theta": theta}))
    assert residnet.prepare(logs).signals.velocities == ("u",)


DIVE = ("u", "theta", "z", "n", "delta_s")


@pytest.mark.parametrize(
    ("made", "channels", "velocities"),
    [
        (dive, ("w", "q", *DIVE), ("u", "w", "q")),
        (dive, DIVE, ("u", "w", "q")),
        (dive, ("w", "q", "n", "delta_s"), ("w", "q")),
        (slowly(dive), ("w", "q", *DIVE), ("u", "w", "q")),
        (sink, ("z", "thrust"), ("w",)),
        (slowly(sink), ("z", "thrust"), ("w",)),
        (sink, ("w", "thrust"), ("w",)),
    ],
)
def test_a_vehicle_that_only_dives_is_known_by_its_channels(
    made: Callable[..., Log], channels: tuple[str, ...], velocities: tuple[str, ...]
) -> None:
    logs = [made(number, *channels) for number in range(6)]
    assert residnet.prepare(logs).signals.velocities == velocities


@pytest.mark.parametrize(
    ("made", "channels"),
    [
        (dive, DIVE),
        pytest.param(dive, ("w", "q", "n", "delta_s"), marks=pytest.mark.long),
        pytest.param(sink, ("z", "thrust"), marks=pytest.mark.long),
    ],
)
def test_a_vehicle_that_only_dives(made: Callable[..., Log], channels: tuple[str, ...]) -> None:
    data = residnet.prepare([made(number, *channels) for number in range(4)])
    velocities = data.signals.velocities
    models = residnet.fit(data, {"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6})
    table = residnet.metrics(models, split="test")
    live = DegreesOfFreedom(velocities)
    assert {name for name in map(str, table) if name.startswith("rmse_")} == {
        f"rmse_{one}" for one in (*velocities, "z", *["theta"] * ("q" in velocities))
    }
    ends = {"position": "u" in velocities, "depth": True, "attitude": "q" in velocities}
    assert [f"{name}_error_end" in table for name in ends] == [*ends.values()]
    error = table.groupby("model")["nrmse_mean"].mean()
    assert error["baseline"] < error["constant_velocity"] * (
        1.0 if velocities == ("w", "q") else 0.3
    )
    x = np.full(len(live.state_names), 0.1)
    after, _ = models["baseline"].step(x, np.full(len(data.signals.inputs), 0.1))
    assert not after[[live.state_names.index(name) for name in live.fixed_states]].any()
    assert after[live.state_names.index("z")] != x[live.state_names.index("z")]


def test_the_pose_is_what_the_live_velocities_lead_to() -> None:
    straight = complete_motion(trial(0, "u", "x", "y"), MotionConfig(), DegreesOfFreedom(("u",)))
    assert not straight["psi"].any()
    assert straight["x"][-1] == pytest.approx(np.trapezoid(straight["u"], straight.t), rel=1e-2)
    turning = complete_motion(trial(0, "psi", "delta"), MotionConfig(), DegreesOfFreedom(("r",)))
    assert not any(turning[name].any() for name in ("x", "y", "u", "v"))
    assert np.abs(turning["r"] - trial(0, "r")["r"]).mean() < 0.01
    assert turning.meta["integrated"] == ["x", "y"]
    with pytest.raises(UsageError, match=r"signals\.velocities: \[u\]"):
        complete_motion(trial(0, "u", "n"), MotionConfig())


def test_scales_are_of_the_velocities_of_the_model() -> None:
    content = {
        "prepare": {"grid": {"step": 0.2}},
        "signals": {"inputs": ["n"], "velocities": ["u"]},
        "baseline": {"kind": "regressors"},
        "evaluation": {
            "protocols": {"T5": {"kind": "windows", "length": 5.0}},
            "selection": "T5",
            "scales": {"u": 0.3},
        },
    }
    assert FitSettings.model_validate(content).evaluation.scales.to_array().tolist() == [
        0.3,
        1.0,
        1.0,
    ]
    for part, key, value, told in (
        ("evaluation", "scales", {"u": 0.3, "v": 0.1, "r": 0.1}, "needs one scale for each"),
        ("signals", "velocities", ["r", "u"], "in this order"),
        ("signals", "exogenous", ["wind_speed", "wind_dir"], "wind needs u, v, r"),
    ):
        wrong = {**content, part: {**content[part], key: value}}  # type: ignore[dict-item]
        with pytest.raises((ValueError, ConfigError), match=told):
            FitSettings.model_validate(wrong)


def test_trials_are_those_that_a_vessel_can_run() -> None:
    def kinds(*velocities: str) -> set[str]:
        return {one.kind for one in propose_manoeuvres(TrialLimits(), DegreesOfFreedom(velocities))}

    both = {"three_two_one_one", "multi_sine"}
    assert kinds("u") == both | {"acceleration_deceleration"}
    assert kinds("r") == both | {"zigzag", "turning_circle"}
    assert kinds("u", "v", "r") == kinds("u") | kinds("r")
    named = {"inputs": ("n",), "velocities": ("u",)}
    spec = make_example_spec(None, SignalsConfig(inputs=("n_port", "n_stbd"), velocities=("u",)))
    one = spec.model_copy(
        update={
            "signals": SignalsConfig.model_validate(named),
            "low": spec.low[:4],
            "high": spec.high[:4],
        }
    )
    assert infer_input_shares(one)["n"].drive == pytest.approx(max(abs(one.low[3]), one.high[3]))
