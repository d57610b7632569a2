"""The motion of a log at every sample, where sensors measured less: no velocities, or rare fixes.

Position and heading are brought into one motion by a smoother that knows where the antenna stands
and how old its positions are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import ALIVE, SIX, Live
from residnet.core.log import Log
from residnet.core.names import BOW_WIND, CHANNEL_UNITS, POSE, STATE, WIND_INPUTS
from residnet.data.channels import far_from_medians, noise_of, without_held
from residnet.data.readers.base import turned, unwrap
from residnet.data.readers.quantities import Antenna
from residnet.data.readers.recording import remark

_DENSE = 0.9
"""Share of the samples that hold a value in a channel that is measured at every sample."""
BRIDGED = 3.0
"""Usual intervals between the values of a channel that are bridged."""
_LEVELS = 10.0 ** (0.5 * np.arange(-8, 5))
"""Jerk in units of the noise over the cube of the usual interval between positions."""
_TRIED = 4000
"""Samples from which the intensity of the jerk is found."""


class MotionConfig(Config):
    """How position, heading and velocities become one motion at every sample.

    A channel of the motion that is measured at every sample stays as it is measured. One that the
    log lacks, or that has values at some samples only (a position at 1 Hz beside a heading at 10
    Hz, the samples between empty or the last value repeated), is made by a smoother from all
    others. Stretches without a position or heading for longer than three of their usual intervals
    stay gaps.

    Attributes:
        antenna: where the antenna stands; null where x and y are those of the vessel's centre.
        delay: age of the positions in s: x and y at t are where the antenna was at t - delay.
    """

    antenna: Antenna | None = None
    delay: Seconds = Field(default=0.0, ge=0.0)

    @property
    def moves(self) -> bool:
        """Whether positions are moved in place or time, so that all must be smoothed."""
        return self.delay > 0.0 or self.antenna is not None


def complete_motion(log: Log, config: MotionConfig, live: Live = ALIVE) -> Log:
    """Return the log with the states of a model at every sample, measured or smoothed.

    What was smoothed stands in `meta["smoothed"]`, and as a note in `meta["findings"]`. A wind that
    is told from the bow becomes the true wind.

    Args:
        log: in SI.
        live: velocities that the log tells; the others are zero, and so is what of the pose they
            alone would move. With p the roll angle is told, and p by it where it is not measured.

    Raises:
        UsageError: where the log lacks position or heading, or the roll angle of a roll.
        DataError: where these hold hardly a value.
    """
    return with_true_wind(_completed(log, config, live))


def _completed(log: Log, config: MotionConfig, live: Live) -> Log:
    log = _plunging(log, live) if live.upright else log
    log = _turning(log if live.whole else _still(log, live))
    log = _rolling(log) if live.rolls and not live.spatial else log
    if live.spatial:
        log = _submerged(log)
        held = [name for name in live.states if name in log.channels and _dense(log[name])]
        if lost := [name for name in live.states if name not in (*STATE, *held)]:
            raise UsageError(
                f"log {log.name}: {', '.join(lost)} {'are' if len(lost) > 1 else 'is'} not measured"
                f" at every sample, which a model of {', '.join(live.velocities)} needs; name the"
                " columns, or let it move on the surface alone (signals.velocities: [u, v, r])"
            )
    told = without_held(log)
    lacking = [name for name in STATE if name not in log.channels]
    made = {name for name in STATE if name in lacking or not _dense(told[name])}
    if not (made or config.moves):
        return log
    if missing := [name for name in POSE if name in lacking]:
        # a heading from the rate alone would not be that of positions which were measured
        if {"x", "y"} <= set(lacking) <= set(POSE):
            return _integrated(log, missing)
        live = Live.told(log.channels)
        few = ", ".join(live.velocities)
        few = f", or let the model be one of {few} alone (signals.velocities: [{few}])"
        raise UsageError(
            f"log {log.name}: no channel {', '.join(lacking)}; give position and heading, or u, v"
            " and r without a position: either makes the other where it was not measured; name"
            f" their columns{'' if live.whole else few}"
        )
    made |= set(POSE) if config.moves else set()
    names = [name for name in STATE if name in made]
    smooth = _smoothed(told, config)
    text = f"{', '.join(names)} come from a smoother of the measured motion: "
    text += ", ".join(f"{name} {_told(told, name)}" for name in names)
    return _with(log, {name: smooth[name] for name in names}, text, smoothed=names)


def _with(
    log: Log,
    made: Mapping[str, np.ndarray],
    text: str = "",
    code: str = "smoothed_motion",
    **meta: Any,
) -> Log:
    """Return the log with channels that were made, and a note of it where there is a text."""
    if text:
        note = remark("note", code, text, channels=len(made))
        meta["findings"] = [*log.meta.get("findings", ()), note]
    return log.replace(
        channels={**log.channels, **made},
        units={**log.units, **{name: CHANNEL_UNITS[name] for name in made}},
        meta={**log.meta, **meta},
    )


def with_true_wind(log: Log) -> Log:
    """Return the log with the true wind where it tells a wind from the bow.

    `wind_angle` is where the true wind comes from, clockwise from the bow; `apparent_wind_angle`
    and `apparent_wind_speed` are of the wind that the moving vessel feels. Without a heading it is
    counted from where the integral of the yaw rate begins.
    """
    felt = {"apparent_wind_angle", "apparent_wind_speed"} <= log.channels.keys()
    names = ("u", "v") if felt else ("wind_angle", "wind_speed")
    turning = "psi" if "psi" in log.channels else "r"
    if "wind_dir" in log.channels or not {turning, *names} <= log.channels.keys():
        return log
    if not _dense(log[turning]) or (felt and not all(_dense(log[name]) for name in names)):
        # the smoother will tell the motion at every sample
        return log
    if felt:
        # what the vessel's own speed adds comes from ahead
        wind = log["apparent_wind_speed"] * np.exp(1j * log["apparent_wind_angle"])
        wind = wind - (log["u"] + 1j * log["v"])
        speed, angle = np.abs(wind), np.angle(wind)
    else:
        speed, angle = log["wind_speed"], log["wind_angle"]
    psi = log["psi"] if turning == "psi" else _integral(log.t, log["r"])
    return _with(log, {"wind_speed": speed, "wind_dir": unwrap(psi + angle)})


def as_recorded(log: Log, inputs: Sequence[str]) -> list[str]:
    """Return inputs by the channels that tell them before the motion is complete.

    Without u and v of its own a log holds the wind that the moving vessel feels, not the true one.
    """
    missing = {*WIND_INPUTS} & {*inputs} - {*log.channels}
    bow = [name for name in (*BOW_WIND, *WIND_INPUTS) if missing and name in log.channels]
    return [*(name for name in inputs if not bow or name not in WIND_INPUTS), *bow]


def _still(log: Log, live: Live) -> Log:
    """Return the log with zeros where a velocity is dead, and no pose but that of the live ones.

    A heading stays where the vessel turns, and a position where it moves as well.
    """
    kept = {"psi"} if live.turns else set[str]()
    if live.turns and live.moves and log.channels.keys() >= {*POSE}:
        kept = {*POSE}
    channels = {n: values for n, values in log.channels.items() if n not in {*POSE} - kept}
    channels |= dict.fromkeys(live.dead, np.zeros(len(log)))
    return log.replace(
        channels=channels,
        units={name: log.units.get(name, CHANNEL_UNITS.get(name, "-")) for name in channels},
    )


def _turning(log: Log) -> Log:
    """Return a log without positions with the yaw rate that its heading tells."""
    if "psi" not in log.channels or {"x", "y"} & log.channels.keys():
        return log
    if "r" in log.channels and _dense(log["r"]):
        return log
    psi = unwrap(log["psi"])
    known = np.isfinite(psi)
    if known.sum() < 5:
        return log
    rate = np.where(_near(log.t, log.t[known]), _turned_by(log, psi, "r")[1], np.nan)
    log = log.replace(channels={**log.channels, "psi": psi})
    return _with(log, {"r": rate}, "r comes from a smoother of the heading", smoothed=["r"])


def _rolling(log: Log) -> Log:
    """Return a log with roll angle and roll rate at every sample, from both or the first."""
    phi = log.channels.get("phi", np.full(len(log), np.nan))
    known = np.isfinite(phi)
    if known.sum() < 5:
        raise UsageError(
            f"log {log.name}: no roll angle phi, which signals.velocities with p need; name its"
            " column, or leave p out"
        )
    lacking = [n for n in ("phi", "p") if n not in log.channels or not _dense(log[n])]
    if not lacking:
        return log
    near = _near(log.t, log.t[known])
    made = dict(zip(("phi", "p"), _turned_by(log, phi, "p"), strict=True))
    text = f"{', '.join(lacking)} come from a smoother of the roll: "
    text += ", ".join(f"{name} {_told(log, name)}" for name in lacking)
    return _with(log, {n: np.where(near, made[n], np.nan) for n in lacking}, text)


def _submerged(log: Log) -> Log:
    """Return a log under water with velocities and rates of turn that were not measured.

    They follow from attitude and depth, and from the position where u or v were not measured.
    """
    lacking = [n for n in SIX.velocities if n not in log.channels or not _dense(log[n])]
    linear = {"u", "v"} & {*lacking}
    needed = ("z", "phi", "theta", "psi", *(("x", "y") if linear else ()))
    if not lacking or not all(n in log.channels and _dense(log[n]) for n in needed):
        return log
    rate = {name: _turned_by(log, log[name], "")[1] for name in needed}
    phi, theta = log["phi"], log["theta"]
    # of the angles of Euler, roll within pitch within heading
    pitching, yawing = rate["theta"], rate["psi"] * np.cos(theta)
    made = {
        "p": rate["phi"] - rate["psi"] * np.sin(theta),
        "q": pitching * np.cos(phi) + yawing * np.sin(phi),
        "r": yawing * np.cos(phi) - pitching * np.sin(phi),
    }
    if linear:
        ahead, side = turned(rate["x"], rate["y"], -log["psi"])
        down = ahead * np.sin(theta) + rate["z"] * np.cos(theta)
        made["u"] = ahead * np.cos(theta) - rate["z"] * np.sin(theta)
        made["v"] = side * np.cos(phi) + down * np.sin(phi)
        made["w"] = down * np.cos(phi) - side * np.sin(phi)
    else:
        sunk = rate["z"] + log["u"] * np.sin(theta) - log["v"] * np.cos(theta) * np.sin(phi)
        made["w"] = sunk / (np.cos(theta) * np.cos(phi))
    text = f"{', '.join(lacking)} are not measured and follow from {', '.join(needed)}"
    return _with(log, {name: made[name] for name in lacking}, text)


def _plunging(log: Log, live: Live) -> Log:
    """Return a log of a motion in an upright plane with what of it follows from the rest.

    Pitch and its rate tell each other, heave and depth do with the speed forward. A depth and a
    pitch that come more slowly than the samples are smoothed over them.
    """
    known = {name: log[name] for name in log.channels if _dense(log[name])}
    made: dict[str, np.ndarray] = {}
    still, rates = np.zeros(len(log)), {}
    for angle, rate in (("theta", "q"), ("z", "w")):
        finite = np.isfinite(log.channels.get(angle, np.array(np.nan)))
        if rate not in live.velocities or not finite.any() or {angle, rate} <= known.keys():
            continue
        smooth, rates[angle] = _turned_by(log, log[angle], rate if angle == "theta" else "")
        if angle not in known:
            made[angle] = np.where(_near(log.t, log.t[finite]), smooth, np.nan)
    if "theta" in rates and "q" not in known:
        made["q"] = rates["theta"]
    elif "q" in known and "theta" not in {*known, *made}:
        made["theta"] = _integral(log.t, known["q"])
    theta = {**known, **made}.get("theta", still) if "q" in live.velocities else still
    ahead = known.get("u", still) if "u" in live.velocities else still
    if "z" in rates and "w" not in known:
        made["w"] = (rates["z"] + ahead * np.sin(theta)) / np.cos(theta)
    if "z" not in {*known, *made}:
        down = {**known, **made}.get("w", still) if "w" in live.velocities else still
        made["z"] = _integral(log.t, down * np.cos(theta) - ahead * np.sin(theta))
    if not made:
        return log
    text = f"{', '.join(made)} are not measured at every sample and follow from the motion"
    return _with(log, made, text)


def _turned_by(log: Log, angle: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a smoothed angle [T] in rad and its rate [T] in rad/s, from both or the first.

    Args:
        angle: as measured, [T].
    """
    rate = log.channels.get(name, np.full(angle.size, np.nan))
    ratio = max(noise_of(rate), 1e-7) / max(noise_of(angle), 1e-7)
    turning = smooth_track(log.t, np.stack((angle, rate), axis=1)[:, :, None], (1.0, ratio))
    return turning[:, 0, 0], turning[:, 1, 0]


def _integral(t: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the integral [T] of a rate [T] from the first sample on."""
    dt, known = np.diff(t, prepend=t[:1]), np.nan_to_num(rate)
    return np.asarray(np.cumsum(0.5 * dt * (known + np.concatenate((known[:1], known[:-1])))))


def _integrated(log: Log, missing: Sequence[str]) -> Log:
    """Return a log of velocities with the pose that they lead to, from the origin on.

    A model of velocities needs no pose. Errors of position and heading are then those of the
    integrated velocities, and not of a place.
    """
    pose = {"psi": _integral(log.t, log["r"]) if "psi" in missing else np.asarray(log["psi"])}
    heading = np.exp(1j * np.nan_to_num(pose["psi"]))
    ahead = np.nan_to_num(log["u"])
    if {"w", "theta"} <= log.channels.keys():
        theta = np.nan_to_num(log["theta"])
        ahead = ahead * np.cos(theta) + np.nan_to_num(log["w"]) * np.sin(theta)
    ground = heading * (ahead + 1j * np.nan_to_num(log["v"]))
    pose |= {"x": _integral(log.t, ground.real), "y": _integral(log.t, ground.imag)}
    made = {name: pose[name] for name in missing}
    text = (
        f"{', '.join(missing)} were not measured and are integrated from the velocities: errors of"
        " position and heading are those of integrated velocities, and not of a place"
    )
    return _with(log, made, text, "integrated_pose", integrated=list(missing))


def without_pauses(t: np.ndarray) -> np.ndarray:
    """Return times [T] in s from zero on, pauses of the recorder cut to what is bridged."""
    step = np.diff(t)
    return np.append(0.0, np.cumsum(np.minimum(step, BRIDGED * np.median(step))))


def fill_sparse(log: Log, names: tuple[str, ...], held: tuple[str, ...]) -> Log:
    """Return the log with values at every sample of channels that lack some, or come more rarely.

    Between two values a channel is interpolated, or held where `held` names it, unless they lie
    further apart than three of their usual intervals: as a grid does it with rows that lack.
    """
    new = {}
    for name in names:
        values = log[name]
        known = np.isfinite(values)
        if known.all() or known.sum() < 2:
            continue
        at = log.t[known]
        if name in held:
            before = np.clip(np.searchsorted(at, log.t, side="right") - 1, 0, at.size - 1)
            filled = np.where(log.t >= at[0], values[known][before], np.nan)
        else:
            steady = unwrap(values) if log.units[name] == "rad" else values
            filled = np.interp(log.t, at, steady[known], left=np.nan, right=np.nan)
        new[name] = np.where(_near(log.t, at), filled, np.nan)
    return log.replace(channels={**log.channels, **new}) if new else log


def _dense(values: np.ndarray) -> bool:
    """Return whether a channel has a value at nearly every sample between its first and last.

    One that fails in stretches, and is there at every sample otherwise, counts as such.
    """
    every = np.diff(np.flatnonzero(np.isfinite(values)))
    return bool(every.size and np.median(every) == 1 and np.quantile(every, _DENSE) == 1)


def _told(log: Log, name: str) -> str:
    """Return how a channel was measured, in words."""
    if name not in log.channels:
        return "was not measured"
    known = log.t[np.isfinite(log[name])]
    usual = float(np.median(np.diff(known))) if known.size > 1 else float("inf")
    return f"every {usual:.3g} s"


def _near(t: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return [T] bool: samples between values at `at` that are no further apart than usual."""
    usual = float(np.median(np.diff(at)))
    inside = (t >= at[0] - 1e-9) & (t <= at[-1] + 1e-9)
    right = at[np.clip(np.searchsorted(at, t, side="left"), 0, at.size - 1)]
    left = at[np.clip(np.searchsorted(at, t, side="right") - 1, 0, at.size - 1)]
    return np.asarray(inside & (right - left <= BRIDGED * usual * (1.0 + 1e-6)))


def _smoothed(log: Log, config: MotionConfig) -> dict[str, np.ndarray]:
    """Return the smoothed motion by channel [T], NaN in gaps of position or heading."""
    t, psi = log.t, unwrap(log["psi"])
    place = np.stack((log["x"], log["y"]), axis=1)
    turned_away, *moved_away = far_from_medians([psi, log["x"], log["y"]])
    psi[turned_away], place[np.logical_or(*moved_away)] = np.nan, np.nan
    fixes = np.flatnonzero(np.isfinite(place).all(axis=1))
    headings = np.flatnonzero(np.isfinite(psi))
    if min(fixes.size, headings.size) < 5:
        raise DataError(
            f"log {log.name}: {fixes.size} positions and {headings.size} headings, at least 5 of"
            " each are needed to tell the motion; leave the log out"
        )
    u, v = (log.channels.get(name, np.full(t.size, np.nan)) for name in ("u", "v"))
    heading, rate = _turned_by(log, psi, "r")
    # positions belong to times between the samples where they are older than their row
    seen_at = t[fixes] - config.delay
    clock = np.union1d(t, seen_at) if config.delay else t
    at, angle = np.searchsorted(clock, t), np.interp(clock, t, heading)
    seen = np.full((clock.size, 2, 2), np.nan)
    seen[np.searchsorted(clock, seen_at), 0] = place[fixes]
    lever = config.antenna or Antenna()
    seen[:, 0] -= np.stack(turned(lever.x, lever.y, angle), axis=1)
    ratio = 1.0
    if "u" in log.channels and "v" in log.channels:
        seen[at, 1] = np.stack(turned(u, v, angle[at]), axis=1)
        places = seen[np.isfinite(seen[:, 0]).all(axis=1), 0]
        noise = max(noise_of(places[:, 0]), noise_of(places[:, 1]))
        ratio = max(noise_of(u), noise_of(v), 1e-6) / max(noise, 1e-6)
    track = smooth_track(clock, seen, (1.0, ratio))[at]
    u, v = turned(track[:, 1, 0], track[:, 1, 1], -heading)
    there = _near(t, seen_at) & _near(t, t[headings])
    motion = zip(STATE, (track[:, 0, 0], track[:, 0, 1], heading, u, v, rate), strict=True)
    return {name: np.where(there, values, np.nan) for name, values in motion}


def smooth_motion(seen: np.ndarray, noise: Sequence[float], dt: float) -> np.ndarray:
    """Return the smoothed motion [N, 9] from x, y, psi, u, v, r, u_dot, v_dot, r_dot [N, 9], SI.

    Heading and its rates are smoothed first, then north and east in the earth with the smoothed
    heading.

    Args:
        seen: measured, the heading unwrapped; a quantity without a measurement has an infinite
            noise.
        noise: standard deviations of the nine.
        dt: sampling interval in s.
    """
    if not np.isfinite(seen).all():
        row, column = (int(part[0]) for part in np.nonzero(~np.isfinite(seen)))
        raise DataError(
            f"measured motion: column {column} is not finite at sample {row}; mask or fill the gap"
            " first"
        )
    t, spread = dt * np.arange(len(seen)), np.asarray(noise)
    x, y, psi, u, v, r, along, across, turning = seen.T
    yaw = np.stack((psi, r, turning), axis=1)[:, :, None]
    psi, r, turning = smooth_track(t, yaw, spread[[2, 5, 8]])[:, :, 0].T
    rates = turned(u, v, psi), turned(along - r * v, across + r * u, psi)
    earth = np.moveaxis(np.array(((x, y), *rates)), 2, 0)
    tracks = [smooth_track(t, earth[:, :, [a]], spread[[a, 3 + a, 6 + a]])[:, :, 0] for a in (0, 1)]
    (x, north, north_dot), (y, east, east_dot) = (track.T for track in tracks)
    u, v = turned(north, east, -psi)
    along, across = turned(north_dot, east_dot, -psi)
    return np.stack((x, y, psi, u, v, r, along + r * v, across - r * u, turning), axis=1)


def smooth_track(t: np.ndarray, seen: np.ndarray, noise: ArrayLike) -> np.ndarray:
    """Return smoothed position, rate and acceleration [T, 3, A] along axes measured together.

    A triple integrator driven by white jerk is filtered forwards and smoothed backwards (Rauch,
    Tung and Striebel, 1965), so that past and future of a sample count alike and nothing lags. The
    intensity of the jerk, and the size of the noise, are those under which the measurements are
    likeliest.

    Args:
        t: times [T] in s, increasing.
        seen: measured positions, then rates, then accelerations as far as there are any, [T, k, A];
            a row of NaN where there is no measurement.
        noise: standard deviations [k], of which ratios count; infinite where nothing is measured.
    """
    noise = np.maximum(np.asarray(noise, dtype=np.float64), 1e-9)
    seen = np.where(np.isfinite(noise)[None, :, None], seen, np.nan)
    there = np.isfinite(seen).all(axis=2)
    order = int(np.argmax(there.any(axis=0)))
    at = t[there[:, order]]
    usual = float(np.median(np.diff(at))) if at.size > 1 else 1.0
    jerks = _LEVELS * float(noise[order]) / usual ** (3 - order)
    head = slice(0, min(t.size, _TRIED))
    cost, _ = _filtered(t[head], seen[head], noise, jerks)
    level = int(np.argmin(cost))
    _, ((xb, pb), (xa, pa)) = _filtered(t, seen, noise, jerks[level : level + 1])
    steps = _transitions(np.diff(t, prepend=t[0]))
    gains = pa[:-1] @ steps[1:].transpose(0, 2, 1) @ np.linalg.pinv(pb[1:])
    for k in range(len(t) - 2, -1, -1):
        xa[k] += gains[k] @ (xa[k + 1] - xb[k + 1])
    return xa


_States = tuple[np.ndarray, np.ndarray]


def _filtered(
    t: np.ndarray, seen: np.ndarray, noise: np.ndarray, jerks: np.ndarray
) -> tuple[np.ndarray, tuple[_States, _States]]:
    """Return the cost of each intensity of jerk [K], and states and covariances of the first.

    Before each sample's measurements and after them: states [T, 3, A], covariances [T, 3, 3].
    """
    size, axes, dt = t.size, seen.shape[2], np.diff(t, prepend=t[0])
    there = np.isfinite(seen).all(axis=2)
    order = int(np.argmax(there.any(axis=0)))
    steps, driven = _transitions(dt), jerks[:, None, None] ** 2 * _driven(dt)[:, None]
    known = seen[there[:, order], order]
    x = np.zeros((jerks.size, 3, axes))
    x[:, order] = known[0]
    # nothing is known of what is not measured at the start
    wide = float(np.ptp(known, axis=0).max(initial=0.0)) + 1.0
    p = np.tile(wide**2 * np.eye(3), (jerks.size, 1, 1))
    before = np.empty((size, 3, axes)), np.empty((size, 3, 3))
    after = np.empty((size, 3, axes)), np.empty((size, 3, 3))
    misfit, spread = np.zeros(jerks.size), np.zeros(jerks.size)
    variance = noise**2
    for k in range(size):
        if k:
            x, p = steps[k] @ x, steps[k] @ p @ steps[k].T + driven[k]
        before[0][k], before[1][k] = x[0], p[0]
        for row in np.flatnonzero(there[k]):
            # rounding may leave less than nothing of a variance
            innovation = np.maximum(p[:, row, row], 0.0) + variance[row]
            gain = p[:, :, row] / innovation[:, None]
            miss = seen[k, row] - x[:, row]
            x = x + gain[:, :, None] * miss[:, None, :]
            p = p - gain[:, :, None] * p[:, row, None, :]
            misfit += (miss**2).sum(axis=1) / innovation
            spread += axes * np.log(innovation)
        after[0][k], after[1][k] = x[0], p[0]
    # the size of the noise is the one that suits each intensity best
    count = axes * int(there.sum())
    cost = count * np.log(np.maximum(misfit / max(count, 1), 1e-60)) + spread
    return cost, (before, after)


def _transitions(dt: np.ndarray) -> np.ndarray:
    """Return the transition over each step, [T, 3, 3]."""
    out = np.tile(np.eye(3), (dt.size, 1, 1))
    out[:, 0, 1] = out[:, 1, 2] = dt
    out[:, 0, 2] = dt**2 / 2
    return out


def _driven(dt: np.ndarray) -> np.ndarray:
    """Return the covariance that white jerk of unit intensity adds over each step, [T, 3, 3]."""
    a, b, c, d, e = dt**5 / 20, dt**4 / 8, dt**3 / 6, dt**3 / 3, dt**2 / 2
    return np.array([[a, b, c], [b, d, e], [c, e, dt]]).transpose(2, 0, 1)
