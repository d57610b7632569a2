"""The motion of logs that hold position and heading only, or rare positions."""

from __future__ import annotations

from unittest import mock

import numpy as np
import pytest
from known_logs import wavy
from scipy.spatial.transform import Rotation
from simulated_motion import BOATS, simulate_motion

from residnet.core.config import validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES
from residnet.preprocessing.align import GridConfig
from residnet.preprocessing.compatibility import sway
from residnet.preprocessing.motion import (
    Antenna,
    MotionConfig,
    complete_motion,
    fill_sparse,
    smooth_measured_motion,
)
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log

TRUTH = wavy(seconds=120.0)


def measured(
    every: int = 1,
    noise: tuple[float, float] = (0.0, 0.0),
    antenna: tuple[float, float] = (0.0, 0.0),
    delay: float = 0.0,
    kept: tuple[str, ...] = (),
) -> Log:
    """The log of a receiver and a compass, and of the rate sensors in `kept`."""
    random = np.random.default_rng(1)
    c = np.cos(TRUTH["psi"])
    s = np.sin(TRUTH["psi"])
    size = len(TRUTH)
    x = TRUTH["x"] + c * antenna[0] - s * antenna[1]
    y = TRUTH["y"] + s * antenna[0] + c * antenna[1]
    channels = {
        name: np.interp(TRUTH.t - delay, TRUTH.t, values) + noise[0] * random.standard_normal(size)
        for name, values in (("x", x), ("y", y))
    }
    for values in channels.values():
        values[np.arange(size) % every != 0] = np.nan
    channels["psi"] = TRUTH["psi"] + noise[1] * random.standard_normal(size)
    channels |= {name: TRUTH[name] for name in (*kept, "delta")}
    return Log("measured", TRUTH.t, channels)


def error(log: Log, name: str) -> float:
    """The rms error of a channel over the share of its spread, ends left out."""
    middle = slice(50, -50)
    miss = (log[name] - TRUTH[name])[middle]
    return float(np.sqrt(np.nanmean(miss**2)) / np.std(TRUTH[name]))


@pytest.mark.parametrize(
    ("log", "config", "most"),
    [
        (measured(), MotionConfig(), 0.002),
        (measured(every=10), MotionConfig(), 0.02),
        (measured(noise=(0.02, 0.003)), MotionConfig(), 0.12),
        (measured(every=10, noise=(0.02, 0.003)), MotionConfig(), 0.15),
        (
            measured(every=10, antenna=(3.0, -1.0), delay=0.4),
            MotionConfig(antenna=Antenna(x=3.0, y=-1.0), delay=0.4),
            0.02,
        ),
    ],
)
def test_complete_motion_estimates_velocities_from_pose(
    log: Log, config: MotionConfig, most: float
) -> None:
    out = complete_motion(log, config)
    assert {name: error(out, name) for name in STATE_NAMES} == {
        name: pytest.approx(0.0, abs=most) for name in STATE_NAMES
    }
    assert set(out.meta["smoothed"]) >= {"u", "v", "r"}


def test_complete_motion_leaves_dense_channels_unchanged() -> None:
    out = complete_motion(measured(every=10, kept=("u", "v", "r")), MotionConfig())
    assert all(np.array_equal(out[name], TRUTH[name]) for name in ("psi", "u", "v", "r"))
    assert error(out, "x") < 1e-3
    coarse = TRUTH.replace(channels={n: np.round(v, 2) for n, v in TRUTH.channels.items()})
    for whole in (TRUTH, coarse):
        assert complete_motion(whole, MotionConfig()) is whole
    # an antenna that is not told is seen in the velocities
    off = measured(antenna=(3.0, -1.0), delay=0.4)
    assert error(complete_motion(off, MotionConfig()), "v") > 0.2
    config = validate_config({"antenna": {"x": "30 cm"}, "delay": "400 ms"}, MotionConfig, "here")
    assert (config.antenna, config.delay) == (Antenna(x=0.3), 0.4)


def test_unmeasured_sway_is_reconstructed_with_its_derivative() -> None:
    motion = simulate_motion(BOATS["catamaran"], np.random.default_rng(3))
    t = np.arange(1.0, 119.0, 0.1)
    channels = {name: motion.sample(name, t) for name in STATE_NAMES}
    truth = Log("truth", t, {**channels, "delta": channels["r"]})
    noise = np.random.default_rng(4).standard_normal((5, t.size))
    stds = {"x": 0.3, "y": 0.3, "psi": 0.005, "u": 0.03, "r": 0.003}
    noisy = {
        name: channels[name] + std * row
        for (name, std), row in zip(stds.items(), noise, strict=True)
    }
    for name in ("x", "y"):
        noisy[name][np.arange(t.size) % 10 != 0] = np.nan
    log = Log("without sway", t, {**noisy, "delta": channels["r"]})
    config = PrepareConfig(grid=GridConfig(step=0.1))
    exact = prepare_log(truth, "train", ["delta"], config)
    prepared = prepare_log(log, "train", ["delta"], config)
    with mock.patch.object(sway, "reconstruct_without_sway", return_value=None):
        smoothed = prepare_log(log, "train", ["delta"], config)
    rows = prepared.trainable & smoothed.trainable & exact.trainable

    def compute_errors(estimate: PreparedLog) -> np.ndarray:
        """Return the standard deviations of the errors of sway velocity and acceleration."""
        errors = (
            estimate.smoothed[rows, 4] - exact.smoothed[rows, 4],
            estimate.nu_dot[rows, 1] - exact.nu_dot[rows, 1],
        )
        return np.std(errors, axis=1)

    assert (compute_errors(prepared) < 0.8 * compute_errors(smoothed)).all()
    # the reconstructed derivative itself is used; measured velocities are differentiated as before
    completed = complete_motion(log, MotionConfig())
    assert np.array_equal(prepared.nu_dot[rows, 1], completed["v_dot"][rows])
    assert np.array_equal(prepared.nu_dot[rows][:, [0, 2]], smoothed.nu_dot[rows][:, [0, 2]])


def test_sway_of_contradicting_surge_is_smoothed() -> None:
    log = measured(noise=(0.02, 0.003), kept=("u", "r"))
    wrong = log.replace(channels={**log.channels, "u": log["u"][::-1]})
    assert "v_dot" not in complete_motion(wrong, MotionConfig()).channels


@pytest.mark.parametrize(
    "boat",
    [pytest.param(boat, marks=[] if boat == "catamaran" else [pytest.mark.long]) for boat in BOATS],
)
def test_surge_that_other_sensors_contradict_is_not_used(boat: str) -> None:
    rng = np.random.default_rng(31)
    motion = simulate_motion(BOATS[boat], rng)
    t = np.arange(1.0, 119.0, 0.1)
    stds = {"x": 0.3, "y": 0.3, "psi": 0.005, "u": 0.03, "r": 0.003}
    channels = {
        name: motion.sample(name, t) + std * rng.standard_normal(t.size)
        for name, std in stds.items()
    }
    for name in ("x", "y"):
        channels[name][np.arange(t.size) % 10 != 0] = np.nan
    surge = channels["u"]
    walk = np.cumsum(rng.standard_normal(t.size))
    walk = surge.mean() + surge.std() * (walk - walk.mean()) / walk.std()
    wrong_values = {"reversed": surge[::-1], "late": np.roll(surge, t.size // 3), "walk": walk}
    for name, values in {"right": surge, **wrong_values}.items():
        log = Log(name, t, {**channels, "u": values, "delta": channels["r"]})
        completed = complete_motion(log, MotionConfig())
        assert ("v_dot" in completed.channels) == (name == "right"), name


def test_sway_beside_a_speed_log_is_smoothed() -> None:
    # surge through the water, in a current of 0.3 m/s to the north
    motion = simulate_motion(BOATS["dinghy"], np.random.default_rng(3))
    t = np.arange(1.0, 119.0, 0.1)
    noise = np.random.default_rng(4).standard_normal((4, t.size))
    stds = {"x": 0.3, "y": 0.3, "psi": 0.005, "u": 0.03}
    channels = {
        name: motion.sample(name, t) + std * row
        for (name, std), row in zip(stds.items(), noise, strict=True)
    }
    over_ground = Log("over ground", t, channels)
    through_water = {**channels, "u": channels["u"] - 0.3 * np.cos(channels["psi"])}
    assert "v_dot" in complete_motion(over_ground, MotionConfig()).channels
    assert (
        "v_dot"
        not in complete_motion(over_ground.replace(channels=through_water), MotionConfig()).channels
    )


def test_smooth_measured_motion_combines_nine_quantities() -> None:
    rates = [np.gradient(TRUTH[name], TRUTH.t) for name in "uvr"]
    truth = np.stack([*(TRUTH[name] for name in STATE_NAMES), *rates], axis=1)
    noise = np.array([0.05, 0.05, 0.01, 0.03, 0.03, 0.005, 0.05, 0.05, 0.01])
    seen = truth + noise * np.random.default_rng(0).standard_normal(truth.shape)
    for known in (noise, np.where(np.arange(9) > 5, np.inf, noise)):
        off = (smooth_measured_motion(seen, known.tolist(), 0.1) - truth)[100:-100]
        assert (np.sqrt(np.mean(off**2, axis=0)) < 0.25 * noise).all()
    seen[3, 4] = np.nan
    with pytest.raises(DataError, match="column 4 is not finite at sample 3"):
        smooth_measured_motion(seen, noise.tolist(), 0.1)


@pytest.mark.parametrize("every", [2, 10])
def test_complete_motion_replaces_held_values(every: int) -> None:
    slow = ("x", "y", "u", "v")
    last = np.arange(len(TRUTH)) // every * every
    held = TRUTH.replace(
        channels={n: v[last] if n in slow else v for n, v in TRUTH.channels.items()}
    )
    out = complete_motion(held, MotionConfig())
    assert set(out.meta["smoothed"]) == set(slow)
    assert all(error(out, name) < 0.2 * error(held, name) for name in slow)
    assert all(np.array_equal(out[name], TRUTH[name]) for name in ("psi", "r", "delta"))


def test_complete_motion_preserves_long_gaps() -> None:
    log = measured(every=10)
    lost = (log.t > 50.0) & (log.t < 60.0)
    x = np.where(lost, np.nan, log["x"])
    out = complete_motion(log.replace(channels={**log.channels, "x": x}), MotionConfig())
    assert np.isnan(out["u"][lost]).all()
    assert np.isfinite(out["u"][(log.t < 49.0) | ((log.t > 61.0) & (log.t < 119.0))]).all()


def test_prepare_log_from_position_and_heading() -> None:
    log = measured(every=10, noise=(0.02, 0.003))
    delta = np.where(np.arange(len(log)) % 2 == 0, log["delta"], np.nan)
    log = log.replace(channels={**log.channels, "delta": delta})
    config = PrepareConfig(grid=GridConfig(step=0.1))
    prepared = prepare_log(log, "train", ("delta",), config)
    assert prepared.usable.mean() > 0.9
    assert float(np.abs(prepared.w[50:-50, 0] - TRUTH["delta"][50:-50]).max()) < 2e-3


def test_complete_motion_without_heading_raises() -> None:
    channels = {name: TRUTH[name] for name in ("x", "y", "delta")}
    with pytest.raises(UsageError, match="no channel psi, u, v, r; a model needs"):
        complete_motion(Log("lost", TRUTH.t, channels), MotionConfig())
    channels["psi"] = np.full(len(TRUTH), np.nan)
    with pytest.raises(DataError, match="1200 positions and 0 headings"):
        complete_motion(Log("lost", TRUTH.t, channels), MotionConfig())


@pytest.mark.parametrize("lacking", [("x", "y", "psi"), ("x", "y")])
def test_complete_motion_integrates_a_missing_pose(lacking: tuple[str, ...]) -> None:
    channels = {name: values for name, values in TRUTH.channels.items() if name not in lacking}
    log = complete_motion(TRUTH.replace(channels=channels), MotionConfig())
    assert log.meta["integrated"] == list(lacking)
    assert "errors of the integrated velocities" in log.meta["findings"][0]["text"]
    away = np.exp(1j * (TRUTH["psi"][0] if "psi" in lacking else 0.0))
    place = (log["x"] + 1j * log["y"] - log["x"][0] - 1j * log["y"][0]) * away
    true = TRUTH["x"] + 1j * TRUTH["y"] - TRUTH["x"][0] - 1j * TRUTH["y"][0]
    assert np.abs(place - true).max() < 5e-3 * np.abs(true).max()
    turned = TRUTH["psi"] - (TRUTH["psi"][0] if "psi" in lacking else 0.0)
    np.testing.assert_allclose(log["psi"], turned, atol=2e-3)
    for name in ("u", "v", "r"):
        np.testing.assert_array_equal(log[name], TRUTH[name])


@pytest.mark.parametrize("lost", [("w",), ("p", "q"), ("u", "v", "w", "p", "q", "r")])
def test_complete_motion_derives_six_dof_velocities(
    lost: tuple[str, ...],
) -> None:
    t = np.arange(0.0, 60.0, 0.05)
    attitude = {
        "phi": 0.1 * np.sin(0.9 * t),
        "theta": 0.2 * np.sin(0.4 * t),
        "psi": 0.5 * t + 0.1 * np.cos(t),
    }
    nu = {"u": 1.5 + 0.2 * np.sin(0.3 * t), "v": 0.1 * np.cos(0.5 * t), "w": 0.1 * np.sin(0.6 * t)}
    turn = Rotation.from_euler("ZYX", np.stack([attitude[n] for n in ("psi", "theta", "phi")], 1))
    ground = turn.apply(np.stack([nu[name] for name in "uvw"], 1))
    place = np.cumsum(
        0.05 * np.concatenate((0.0 * ground[:1], 0.5 * (ground[1:] + ground[:-1]))), 0
    )
    rates = (turn[:-1].inv() * turn[1:]).as_rotvec() / 0.05
    rates = np.stack([np.interp(t, t[:-1] + 0.025, rate) for rate in rates.T], 1)
    truth = nu | dict(zip("pqr", rates.T, strict=True))
    channels = attitude | dict(zip("xyz", place.T, strict=True)) | truth
    kept = {name: values for name, values in channels.items() if name not in lost}
    log = Log("dive", t, kept)
    live = DegreesOfFreedom.from_channels(log.channels)
    assert live.is_six_dof
    whole = complete_motion(log, MotionConfig(), live)
    for name in lost:
        inside = slice(40, -40)
        np.testing.assert_allclose(whole[name][inside], truth[name][inside], atol=0.01)
    assert any("not measured" in one["text"] for one in whole.meta["findings"])


def test_fill_sparse_holds_commands_and_interpolates_states() -> None:
    t = np.arange(40.0)
    values = np.where((t % 4 == 2) & ~((t > 15) & (t < 33)), t, np.nan)
    log = Log("log", t, {"u": values, "delta": values})
    filled = fill_sparse(log, ("u", "delta"), held_channels=("delta",))
    between = (t >= 2) & (t <= 14) | (t >= 34) & (t <= 38)
    np.testing.assert_allclose(filled["u"][between], t[between])
    np.testing.assert_array_equal(filled["delta"][between], (2 + (t - 2) // 4 * 4)[between])
    for name in ("u", "delta"):
        assert np.isnan(filled[name][:2]).all()
        assert np.isnan(filled[name][20:30]).all()
