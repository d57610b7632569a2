"""A log with another manoeuvre is accused of nothing where the check's model lacks terms."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.quality import inspect_log, inspect_log_set
from residnet.quality.actuators import estimate_neutral_angle
from residnet.quality.statistics import LogStatistics


def sail(
    seed: int, speed: float, rudder: float, *, rudder_scale: float = 1.0, side: float = 0.0
) -> Log:
    """Return a run of a boat with cubic damping and yaw damping that grows with the speed.

    Args:
        seed: seed of the commands and of the noise.
        speed: largest revolutions.
        rudder: largest rudder angle in rad.
        rudder_scale: factor by which the recorded rudder angle is too large.
        side: 1 for turns to starboard, -1 to port; 0 for both.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, 0.1)
    n = speed * rng.uniform(0.6, 1.0, 40)[(t / 4.0).astype(int)]
    delta = rudder * rng.uniform(-1.0, 1.0, 60)[(t / 3.0).astype(int)]
    delta = side * np.abs(delta) if side else delta
    u, v, r = np.zeros((3, t.size))
    u[0] = 0.7 * speed
    for k in range(t.size - 1):
        surge = 0.5 * n[k] ** 2 - 0.2 * u[k] - 0.12 * u[k] ** 3 - 1.5 * r[k] ** 2 * u[k]
        sway = -0.8 * v[k] - 2.0 * v[k] ** 3 - 0.5 * u[k] * r[k]
        yaw = 0.9 * u[k] ** 2 * np.sin(2.0 * delta[k]) - (1.0 + 0.5 * u[k] ** 2) * r[k]
        yaw -= 6.0 * r[k] ** 3 + 0.8 * np.abs(v[k]) * r[k]
        for values, rate in ((u, surge), (v, sway), (r, yaw)):
            values[k + 1] = values[k] + 0.1 * rate
    psi = np.cumsum(r) * 0.1
    velocity = (u + 1j * v) * np.exp(1j * psi)
    position = np.cumsum(velocity) * 0.1
    noise = {name: rng.normal(0.0, 0.005, t.size) for name in "uvr"}
    channels = {"x": position.real, "y": position.imag, "psi": psi}
    channels |= {"u": u + noise["u"], "v": v + noise["v"], "r": r + noise["r"]}
    return Log(f"run{seed}", t, {**channels, "n": n, "delta": rudder_scale * delta})


@pytest.mark.parametrize("seed", [0, 10, 20])
def test_other_manoeuvres_are_no_contradiction(seed: int) -> None:
    gentle = [sail(seed + k, 1.5 + 0.1 * k, 0.2) for k in range(6)]
    fast = [sail(seed + 7, 2.6, 0.6), sail(seed + 8, 2.4, 0.1)]
    report = inspect_log_set([*gentle, *fast], ["n", "delta"])
    accusing = [f for f in report.findings if f.code.startswith("contradicts")]
    assert [finding.line for finding in accusing] == []


def test_a_scaled_rudder_is_still_a_contradiction() -> None:
    logs = [sail(30 + k, 1.5 + 0.1 * k, 0.3) for k in range(7)]
    logs.append(sail(40, 1.8, 0.3, rudder_scale=2.0))
    report = inspect_log_set(logs, ["n", "delta"])
    accusing = [f for f in report.findings if f.code.startswith("contradicts")]
    assert [finding.code for finding in accusing] == ["contradicts_scale"]
    assert accusing[0].text.startswith("run40")


def test_turns_to_the_other_side_are_no_contradiction() -> None:
    starboard = [sail(50 + k, 1.5 + 0.1 * k, 0.5, side=1.0) for k in range(7)]
    report = inspect_log_set([*starboard, sail(60, 1.8, 0.5, side=-1.0)], ["n", "delta"])
    accusing = [f for f in report.findings if f.code.startswith("contradicts")]
    assert [finding.line for finding in accusing] == []


@pytest.mark.parametrize(("side", "is_identified"), [(0.0, True), (1.0, False)])
def test_neutral_angle_needs_turns_to_both_sides(side: float, *, is_identified: bool) -> None:
    log = sail(70, 1.8, 0.5, side=side)
    neutral = estimate_neutral_angle(LogStatistics(log, ["n", "delta"]))
    assert (neutral is not None) == is_identified


@pytest.mark.parametrize(
    ("speed", "channel", "is_reported"),
    [(-0.4, "delta", True), (-0.4, "nozzle", False), (0.0, "delta", False)],
)
def test_a_stop_or_a_water_jet_is_no_reversed_propeller(
    speed: float, channel: str, *, is_reported: bool
) -> None:
    """A propeller with n > 0 moves a vessel astern, by the bucket of a jet, or stops it."""
    t = np.arange(0.0, 100.0, 0.1)
    rng = np.random.default_rng(0)
    u = speed + rng.normal(0.0, 0.01, t.size) - (speed == 0.0) * np.exp(-t / 20.0)
    channels = {"u": u, "r": rng.normal(0.0, 0.01, t.size), "n": 4.0 + 0.0 * t}
    log = Log("astern", t, {**channels, channel: 0.1 * np.sin(t)})
    assert bool(inspect_log(log).find_by_code("propeller_sign")) == is_reported


def drive(seed: int, index: int, *, inertia: float = 1.0) -> Log:
    """Return a run of a catamaran whose propellers push less astern than ahead.

    Args:
        seed: seed of the fleet.
        index: number of the run; every third one reverses the propellers.
        inertia: factor on mass and moment of inertia.
    """
    rng = np.random.default_rng([seed, index])
    t = np.arange(0.0, 100.0, 0.1)
    lowest, difference = (-0.8, 0.6) if index % 3 == 1 else (0.6, 0.2)
    steps = (t / 5.0).astype(int)
    port, stbd = np.clip(
        rng.uniform(lowest, 1.4, 20)[steps]
        + np.array([[1.0], [-1.0]]) * difference * rng.uniform(-1.0, 1.0, 20)[steps],
        -0.8,
        1.4,
    )
    u, v, r = np.zeros((3, t.size))
    u[0] = 1.5
    for k in range(t.size - 1):
        thrusts = [(0.5 if n >= 0.0 else 0.3) * n * abs(n) for n in (port[k], stbd[k])]
        thrusts = [
            thrust - 0.08 * abs(n) * (u[k] + side * r[k])
            for thrust, n, side in zip(thrusts, (port[k], stbd[k]), (1.0, -1.0), strict=True)
        ]
        surge = sum(thrusts) - 0.1 * u[k] - 0.2 * u[k] * abs(u[k]) + v[k] * r[k]
        sway = -0.4 * v[k] - 0.6 * v[k] * abs(v[k]) - 0.6 * u[k] * r[k]
        yaw = 0.8 * (thrusts[0] - thrusts[1]) - 0.6 * r[k] - 0.9 * r[k] * abs(r[k])
        for values, rate in ((u, surge), (v, sway), (r, yaw)):
            values[k + 1] = values[k] + 0.1 * rate / inertia
    psi = np.cumsum(r) * 0.1
    position = np.cumsum((u + 1j * v) * np.exp(1j * psi)) * 0.1
    channels = {"x": position.real, "y": position.imag, "psi": psi}
    channels |= {
        name: values + rng.normal(0.0, 0.005, t.size)
        for name, values in (("u", u), ("v", v), ("r", r))
    }
    return Log(f"run{index}", t, {**channels, "n_port": port, "n_stbd": stbd})


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_terms_missing_in_few_manoeuvres_are_no_contradiction(seed: int) -> None:
    """Four of twelve logs go astern, where the model lacks terms; the median log does not."""
    report = inspect_log_set([drive(seed, k) for k in range(12)], ["n_port", "n_stbd"])
    accusing = [f for f in report.findings if f.code.startswith("contradicts")]
    assert [finding.line for finding in accusing] == []


@pytest.mark.parametrize("heavy", [1, 3])
def test_a_heavier_vessel_is_a_contradiction_where_terms_are_missing(heavy: int) -> None:
    logs = [drive(0, k, inertia=1.5 if k == heavy else 1.0) for k in range(12)]
    report = inspect_log_set(logs, ["n_port", "n_stbd"])
    accusing = [f for f in report.findings if f.code.startswith("contradicts")]
    assert [f.text.split(":")[0] for f in accusing] == [f"run{heavy}"]
