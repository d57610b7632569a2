"""Manoeuvring indices against closed forms: circles, a sinusoidal heading; IMO's limits; what was
steered, read off a log.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from scipy.integrate import cumulative_trapezoid

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.manoeuvres import indices
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.closed_loop import Spiral, Stopping, TurningCircle, Zigzag
from residnet.manoeuvres.indices import (
    INDEX_UNITS,
    LENGTH_INDICES,
    SmoothTrack,
    first_crossing,
    identify_zigzag,
    turning_circle_indices,
    zigzag_indices,
)

DEG = math.pi / 180
HALF = math.pi / 2


def motion(
    t: np.ndarray, psi: np.ndarray, r: np.ndarray, u: np.ndarray, v: np.ndarray | float = 0.0
) -> Log:
    """A log whose track is the fine quadrature of its velocities."""
    v = np.broadcast_to(v, t.shape).copy()
    north = u * np.cos(psi) - v * np.sin(psi)
    east = u * np.sin(psi) + v * np.cos(psi)
    x, y = (cumulative_trapezoid(rate, t, initial=0) for rate in (north, east))
    return Log("made", t, {"x": x, "y": y, "psi": psi, "u": u, "v": v, "r": r})


def thinned(log: Log, every: int) -> Log:
    return log.replace(
        t=log.t[::every], channels={name: values[::every] for name, values in log.channels.items()}
    )


@pytest.mark.parametrize(("side", "psi0"), [(1.0, 2.9), (-1.0, 0.0)])
def test_circle(side: float, psi0: float) -> None:
    """Straight on at 2 m/s, then at once a circle of 1.5 m/s with 5 deg of drift: all in closed
    form.
    """
    speed = 1.5
    rate = side * 0.06
    drift = 5 * DEG
    start = 20.5
    t = np.arange(0.0, 240.0, 0.001)
    turning_now = t > start
    psi = psi0 + np.where(turning_now, rate * (t - start), 0.0)
    r = np.where(turning_now, rate, 0.0)
    u = np.where(turning_now, speed * math.cos(drift), 2.0)
    v = np.where(turning_now, -side * speed * math.sin(drift), 0.0)
    found = turning_circle_indices(
        thinned(motion(t, psi, r, u, v), 500), start, side, 3 * math.pi, 5.0
    )
    radius = speed / abs(rate)

    # the course is drift behind the heading: integrate the velocity direction from -drift on
    advance = radius * (math.cos(drift) + math.sin(drift))
    transfer, diameter = (
        radius * (math.cos(drift) - math.cos(a - drift)) for a in (HALF, 2 * HALF)
    )
    assert found["approach_speed"] == pytest.approx(2.0, rel=1e-12)
    assert found["time_90"] == pytest.approx(math.pi / 2 / 0.06, abs=1e-3)
    assert found["time_180"] == pytest.approx(math.pi / 0.06, abs=1e-3)
    # the velocity jumps between two samples, which a spline of the track rounds off
    assert found["advance"] == pytest.approx(advance, abs=0.02)
    assert found["transfer"] == pytest.approx(transfer, abs=0.02)
    assert found["tactical_diameter"] == pytest.approx(diameter, abs=0.02)
    assert found["steady_diameter"] == pytest.approx(2 * radius, rel=1e-9)
    assert found["steady_drift_angle"] == pytest.approx(drift, rel=1e-9)
    assert found["steady_yaw_rate"] == pytest.approx(0.06, rel=1e-9)
    assert found["advance_lengths"] == pytest.approx(found["advance"] / 5.0)
    # half a circle has no steady turn
    half = motion(*(part[:80000] for part in (t, psi, r, u, v)))
    short = turning_circle_indices(thinned(half, 500), start, side, 3 * math.pi, None)
    whole = "approach_speed advance transfer time_90 tactical_diameter time_180"
    assert set(short) == set(whole.split())


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_sinusoidal_heading(side: float) -> None:
    """psi = a sin(w t), sampled coarsely: every crossing and peak lies between samples."""
    cycle = 29.4
    a = 0.37
    w = 2 * math.pi / cycle
    bound = 0.2
    psi0 = -1.0
    t = np.arange(0.0, 130.0, 0.001)
    psi, r = psi0 + side * a * np.sin(w * t), side * a * w * np.cos(w * t)
    # a whole cycle comes before it is steered
    log = thinned(motion(t, psi, r, np.full_like(t, 3.0)), 700)
    found = zigzag_indices(log, cycle, side, bound, 10.0)
    first = math.asin(bound / a) / w
    assert found["initial_turning_time"] == pytest.approx(first, abs=1e-4)
    assert found["initial_turning_distance"] == pytest.approx(3 * first, rel=1e-3)
    assert found["first_overshoot"] == pytest.approx(a - bound, abs=1e-5)
    assert found["second_overshoot"] == pytest.approx(a - bound, abs=1e-5)
    assert found["time_to_check_yaw"] == pytest.approx(math.pi / 2 / w - first, abs=1e-3)
    assert found["reach"] == pytest.approx(math.pi / w, abs=1e-4)
    assert found["period"] == pytest.approx(2 * math.pi / w, abs=1e-4)
    assert found["largest_yaw_rate"] == pytest.approx(a * w, rel=1e-9)
    # the track moves outward as long as the heading is on that side
    outside = np.linspace(first, math.pi / w, 4000)
    outward = np.trapezoid(3 * np.sin(a * np.sin(w * outside)), outside)
    assert found["overshoot_width"] == pytest.approx(outward, rel=1e-3)
    assert set(found) <= set(INDEX_UNITS) | {f"{name}_lengths" for name in LENGTH_INDICES}


def test_crossings_lie_between_samples() -> None:
    t = np.arange(0.0, 10.0, 0.5)
    assert first_crossing(lambda s: s - 3.14159, t, 0.0) == pytest.approx(3.14159, abs=1e-10)
    assert first_crossing(lambda s: s - 3.14159, t, 4.0) is None
    assert first_crossing(lambda s: np.sin(s), t, 0.1) == pytest.approx(2 * math.pi, abs=1e-10)
    assert first_crossing(lambda s: s - 2.5, t, 0.0) == 2.5


def test_stopping_with_constant_deceleration() -> None:
    """u = 4 - 0.25 t from t = 6: at rest after 16 s and 32 m."""
    t = np.arange(0.0, 40.0, 0.1)
    u = np.where(t < 6, 4.0, 4.0 - 0.25 * (t - 6))
    log = motion(t, np.full_like(t, 0.7), np.zeros_like(t), u)
    found = Stopping(drive=1.0, start=6.0).compute_indices(log, 8.0)
    assert found["stopping_time"] == pytest.approx(16.0, abs=1e-3)
    assert found["track_reach"] == pytest.approx(32.0, abs=1e-3)
    assert found["head_reach"] == pytest.approx(32.0, abs=1e-3)
    assert found["lateral_deviation"] == pytest.approx(0.0, abs=1e-9)
    assert found["track_reach_lengths"] == pytest.approx(4.0, abs=1e-3)


def test_spiral_takes_the_rate_before_each_change() -> None:
    t = np.arange(0.0, 50.0, 1.0)
    held = np.select([t < 5, t < 15, t < 25, t < 35], [0.0, 0.4, 0.0, -0.4], 0.0)
    r = 0.01 * np.floor(t / 5)
    channels = {"x": t, "y": t, "psi": 0 * t, "u": 0 * t + 1, "v": 0 * t, "r": r, "cmd_delta": held}
    found = Spiral(drive=0.5, steers=(0.4, 0.0, -0.4, 0.0), start=5.0).compute_indices(
        Log("made", t, channels)
    )
    assert found["yaw_rates"] == pytest.approx([0.02, 0.04, 0.06, 0.09])
    assert found["loop_height"] == pytest.approx(0.05)


@pytest.mark.parametrize(
    ("length", "first", "second"),
    [(90.0, 10.0, 25.0), (200.0, 15.0, 32.5), (300.0, 20.0, 40.0), (400.0, 20.0, 40.0)],
)
def test_imo_limits_of_the_10_10_zigzag(length: float, first: float, second: float) -> None:
    """MSC.137(76): 10 deg below L/V = 10 s, 20 deg from 30 s on, (5 + L/(2V)) deg between; 25, 40
    and (17.5 + 0.75 L/V) deg.
    """
    limits = indices.zigzag_limits(10.0, length, 10.0)
    assert limits["first_overshoot"] == pytest.approx(first * DEG)
    assert limits["second_overshoot"] == pytest.approx(second * DEG)
    assert limits["initial_turning_distance"] == pytest.approx(2.5 * length)


def _helm(size: float, thrust: torch.Tensor, steering: torch.Tensor) -> torch.Tensor:
    return torch.stack((size * steering, thrust), dim=-1)


def test_which_manoeuvres_imo_limits() -> None:
    rudder, twin = (
        Helm(partial(_helm, size), ("psi", "r", "u"), inputs)
        for size, inputs in ((35 * DEG, ("cmd_delta", "cmd_n")), (1.0, ("cmd_port", "cmd_stbd")))
    )
    assert rudder.max_rudder == pytest.approx(35 * DEG)
    assert twin.max_rudder is None
    ten = Zigzag(drive=1, rudder=10 * DEG, heading=10 * DEG)
    assert ten.steer_share(rudder) == pytest.approx(10 / 35)
    tens, twenties = (indices.zigzag_limits(angle, 100, 8) for angle in (10.0, 20.0))
    over = {"advance": 450, "tactical_diameter": 500}
    for manoeuvre, limits in (
        (ten, tens),
        (Zigzag(drive=1, rudder=-20 * DEG, heading=20 * DEG), twenties),
        (Zigzag(drive=1, rudder=10 * DEG, heading=20 * DEG), {}),
        (TurningCircle(drive=1, steer=-1), over),
        (TurningCircle(drive=1, steer=0.5), {}),
        (Stopping(drive=1), {"track_reach": 1500}),
        (Stopping(drive=1, astern=-0.5), {}),
    ):
        assert manoeuvre.imo_limits(rudder, 100, 8) == limits
    alone = Zigzag(drive=1, steer=0.5, heading=20 * DEG)
    assert alone.imo_limits(twin, 100, 8) == twenties, "without a rudder the heading tells"


def test_empty_samples_are_left_out() -> None:
    t = np.arange(0.0, 100.0, 0.1)
    log = motion(t, 0.3 * np.sin(0.2 * t), 0.06 * np.cos(0.2 * t), np.full_like(t, 2.0))
    holes = log.replace(
        channels=log.channels | {"x": np.where(np.arange(t.size) % 5 == 0, log["x"], np.nan)}
    )
    whole = zigzag_indices(log, 0.0, 1.0, 0.2, None)
    few = zigzag_indices(holes, 0.0, 1.0, 0.2, None)
    assert few["period"] == pytest.approx(whole["period"], abs=1e-4)
    with pytest.raises(DataError, match="indices need"):
        SmoothTrack(log.replace(channels=log.channels | {"r": np.full(t.size, np.nan)}))


def steered(angle: float, heading: float, side: float, offset: float = 0.0) -> Log:
    """Nomoto's ship (K = .15, T = 8 s) steered in a zigzag (deg) from 4 s on, its rudder resting at
    `offset` before and turning about it by 15 deg/s.
    """
    step = 0.1
    speed = 15.0 * DEG
    t = np.arange(0, 120.0, step)
    psi = 0.0
    r = 0.0
    delta = offset * DEG
    towards = side
    out = np.zeros((t.size, 2))
    for k, now in enumerate(t):
        out[k] = psi, delta
        if towards * psi >= heading * DEG:
            towards = -towards
        wanted = (towards * angle * (now >= 4.0) + offset) * DEG
        delta += float(np.clip(wanted - delta, -speed * step, speed * step))
        r += step * (0.15 * (delta - offset * DEG) - r) / 8.0
        psi += step * r
    return Log("zz", t + 3.0, {"psi": out[:, 0] + 0.7, "delta": out[:, 1]})


@pytest.mark.parametrize(
    ("angle", "heading", "side", "offset"),
    [(10, 10, 1, 0), (20, 5, -1, 0.8), (30, 20, 1, -1.0), (5, 1, -1, 0)],
)
def test_what_was_steered_is_read_off(
    angle: float, heading: float, side: float, offset: float
) -> None:
    log = steered(angle, heading, side, offset)
    # noise on the rudder does not make orders
    noise = 0.01 * DEG * np.random.default_rng(0).standard_normal(len(log))
    for one in (log, log.replace(channels=log.channels | {"delta": log["delta"] + noise})):
        found = identify_zigzag(one, "delta")
        assert found.first_sign == side
        assert found.angle / DEG == pytest.approx(angle, abs=0.02)
        assert found.start == pytest.approx(4.0, abs=0.15)
        # the order falls on the first sample beyond the heading
        assert found.heading / DEG == pytest.approx(heading, abs=0.4)


@pytest.mark.parametrize("every", [1, 3])
def test_where_the_rudder_left_does_not_hang_on_the_grid(every: int) -> None:
    """The order of the closed form: the rudder of the made zigzag leaves at the very sample that is
    the first beyond the heading.
    """
    log = steered(20, 10, 1.0)
    psi = log["psi"] - log["psi"][0]
    size = np.abs(log["delta"])
    left = np.isclose(size[:-1], 20 * DEG) & (np.diff(size) < -1e-6)
    turns = np.flatnonzero(left & (np.arange(len(log) - 1) >= 60))
    assert len(turns) > 2
    found = identify_zigzag(thinned(log, every), "delta")
    assert found.departure_heading / DEG == pytest.approx(np.abs(psi[turns]).mean() / DEG, abs=0.03)
    rates = np.abs(np.gradient(psi, log.t))[turns]
    assert found.departure_rate == pytest.approx(rates.mean(), rel=0.02)
    assert every > 1 or found.departure_heading > found.heading


def test_other_manoeuvres_are_refused() -> None:
    t = np.arange(0, 60, 0.1)
    turn = Log("turn", t, {"psi": 0.05 * t, "delta": np.where(t < 5, 0.0, 0.3)})
    with pytest.raises(DataError, match="turn: the rudder is reversed"):
        identify_zigzag(turn, "delta")
    log = steered(20, 20, 1.0)
    against = log.replace(channels={"psi": -log["psi"], "delta": log["delta"]})
    with pytest.raises(DataError, match="sign of delta"):
        identify_zigzag(against, "delta")
