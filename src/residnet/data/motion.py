"""The motion of a log at every sample, where sensors measured less: no velocities, or rare fixes.

Position and heading are brought into one motion by a smoother that knows where the antenna stands
and how old its positions are.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Metres, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, POSE, STATE
from residnet.data.held import without_held
from residnet.data.outliers import noise_of, spikes
from residnet.data.readers.base import unwrap
from residnet.data.readers.recording import remark
from residnet.data.sparse_smoother import Track, smooth_track

_DENSE = 0.9
"""Share of the samples that hold a value in a channel that is measured at every sample."""
_BRIDGED = 3.0
"""Usual intervals between the values of a channel that are bridged."""


class Antenna(Config):
    """The place of the antenna whose position a log holds, from the vessel's centre.

    Attributes:
        x: forward of the centre in m.
        y: to starboard of the centre in m.
    """

    x: Metres = 0.0
    y: Metres = 0.0


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
        always: smooth logs too in which everything is measured at every sample.
    """

    antenna: Antenna | None = None
    delay: Seconds = Field(default=0.0, ge=0.0)
    always: bool = False

    @property
    def moves(self) -> bool:
        """Whether positions are moved in place or time, so that all must be smoothed."""
        return self.always or self.delay > 0.0 or self.antenna is not None


def complete_motion(log: Log, config: MotionConfig) -> Log:
    """Return the log with x, y, psi, u, v, r at every sample, measured or smoothed.

    What was smoothed stands in `meta["smoothed"]`, and as a note in `meta["findings"]`.

    Raises:
        UsageError: where the log lacks position or heading.
        DataError: where these hold hardly a value.
    """
    told = without_held(log)
    sparse = [name for name in STATE if name in told.channels and not _dense(told[name])]
    lacking = [name for name in STATE if name not in log.channels]
    if not (sparse or lacking or config.moves):
        return log
    if missing := [name for name in POSE if name in lacking]:
        raise UsageError(
            f"log {log.name}: no channel {', '.join(missing)}; position and heading are needed,"
            " and give the velocities where these were not measured: name their columns"
        )
    made = _smoothed(told, config)
    kept = set(STATE) - set(sparse) - set(lacking) - (set(POSE) if config.moves else set())
    if config.always:
        kept = set()
    new = {name: log[name] if name in kept else made[name] for name in STATE}
    names = [name for name in STATE if name not in kept]
    text = f"{', '.join(names)} come from a smoother of the measured motion: " + ", ".join(
        f"{name} {_told(told, name)}" for name in names
    )
    meta = {
        **log.meta,
        "smoothed": names,
        "findings": [
            *log.meta.get("findings", ()),
            remark("note", "smoothed_motion", text, channels=len(names)),
        ],
    }
    units = {**log.units, **{name: CHANNEL_UNITS[name] for name in STATE}}
    return log.replace(channels={**log.channels, **new}, units=units, meta=meta)


def fill_sparse(log: Log, names: tuple[str, ...], held: tuple[str, ...]) -> Log:
    """Return the log with values at every sample of inputs that were recorded more rarely.

    Between two values an input is interpolated, or held where `held` names it, unless they lie
    further apart than three of their usual intervals.
    """
    new = {}
    for name in names:
        values = log[name]
        known = np.isfinite(values)
        if _dense(values) or known.sum() < 2:
            continue
        at = log.t[known]
        before = np.clip(np.searchsorted(at, log.t, side="right") - 1, 0, at.size - 1)
        near = _near(log.t, at)
        if name in held:
            filled = np.where(log.t >= at[0], values[known][before], np.nan)
        else:
            steady = unwrap(values) if log.units[name] == "rad" else values
            filled = np.interp(log.t, at, steady[known], left=np.nan, right=np.nan)
        new[name] = np.where(near, filled, np.nan)
    return log.replace(channels={**log.channels, **new}) if new else log


def _dense(values: np.ndarray) -> bool:
    """Return whether a channel has a value at nearly every sample between its first and last.

    One that fails in stretches, and is there at every sample otherwise, counts as such.
    """
    known = np.flatnonzero(np.isfinite(values))
    if known.size < 2:
        return False
    return bool(np.median(np.diff(known)) == 1 and np.quantile(np.diff(known), _DENSE) == 1)


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
    after = np.searchsorted(at, t, side="left")
    inside = (t >= at[0] - 1e-9) & (t <= at[-1] + 1e-9)
    right = at[np.clip(after, 0, at.size - 1)]
    left = at[np.clip(np.searchsorted(at, t, side="right") - 1, 0, at.size - 1)]
    near: np.ndarray = inside & (right - left <= _BRIDGED * usual * (1.0 + 1e-6))
    return near


def _smoothed(log: Log, config: MotionConfig) -> dict[str, np.ndarray]:
    """Return the smoothed motion by channel [T], NaN in gaps of position or heading."""
    t, psi = log.t, unwrap(log["psi"])
    psi[spikes(psi)] = np.nan
    place = np.stack((log["x"], log["y"]), axis=1)
    place[spikes(log["x"]) | spikes(log["y"])] = np.nan
    fixes = np.flatnonzero(np.isfinite(place).all(axis=1))
    headings = np.flatnonzero(np.isfinite(psi))
    if min(fixes.size, headings.size) < 5:
        raise DataError(
            f"log {log.name}: {fixes.size} positions and {headings.size} headings, at least 5 of"
            " each are needed to tell the motion; leave the log out"
        )
    nothing = np.full(t.size, np.nan)
    turning = log.channels.get("r", nothing)
    yaw = smooth_track(t, psi[:, None], turning[:, None], _ratio(psi, turning))
    clock, index = _with_delay(t, t[fixes], config.delay)
    angle = np.interp(clock, t, yaw.position[:, 0])
    seen = np.full((clock.size, 2), np.nan)
    seen[index] = place[fixes]
    c, s = np.cos(angle), np.sin(angle)
    lever = config.antenna or Antenna()
    seen -= np.stack((c * lever.x - s * lever.y, s * lever.x + c * lever.y), axis=1)
    track = _translation(log, clock, seen, angle)
    at = np.searchsorted(clock, t)
    speed = track.rate[at]
    c, s = np.cos(yaw.position[:, 0]), np.sin(yaw.position[:, 0])
    motion = {
        "x": track.position[at, 0],
        "y": track.position[at, 1],
        "psi": yaw.position[:, 0],
        "u": c * speed[:, 0] + s * speed[:, 1],
        "v": c * speed[:, 1] - s * speed[:, 0],
        "r": yaw.rate[:, 0],
    }
    there = _near(t, t[fixes] - config.delay) & _near(t, t[headings])
    return {name: np.where(there, values, np.nan) for name, values in motion.items()}


def _translation(log: Log, clock: np.ndarray, seen: np.ndarray, angle: np.ndarray) -> Track:
    """Return the track of the centre from positions [C, 2] and the log's u, v where it has both."""
    rates = np.full_like(seen, np.nan)
    ratio = 1.0
    if {"u", "v"} <= set(log.channels):
        at = np.searchsorted(clock, log.t)
        c, s = np.cos(angle[at]), np.sin(angle[at])
        u, v = log["u"], log["v"]
        rates[at] = np.stack((c * u - s * v, s * u + c * v), axis=1)
        places = seen[np.isfinite(seen).all(axis=1)]
        noise = max(noise_of(places[:, 0]), noise_of(places[:, 1]))
        ratio = max(noise_of(u), noise_of(v), 1e-6) / max(noise, 1e-6)
    return smooth_track(clock, seen, rates, ratio)


def _ratio(position: np.ndarray, rate: np.ndarray) -> float:
    """Return the noise of a rate over that of what it is the rate of, 1/s."""
    return max(noise_of(rate), 1e-7) / max(noise_of(position), 1e-7)


def _with_delay(t: np.ndarray, fixes: np.ndarray, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of samples and of what the fixes saw, and the places [F] of the latter."""
    if delay == 0.0:
        return t, np.searchsorted(t, fixes)
    clock = np.union1d(t, fixes - delay)
    return clock, np.searchsorted(clock, fixes - delay)
