"""Topics that a log does not use, compared with the log: lag, and another point of the vessel."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from residnet.core.log import Log
from residnet.data.readers.recording import Recording, Remark, Series, key_of, remark

# lags that are looked for, s, and the least that is reported
_LONGEST, _STEP, _TELLING = 2.0, 0.05, 0.1
# correlation that calls two signals the same quantity, and rows that a verdict needs
_SAME, _ENOUGH = 0.9, 100
_MOST_ROWS = 4000
_LEVER = 0.2


def agreement(recording: Recording, log: Log, start: float, idle: Iterable[str]) -> list[Remark]:
    """Return the remarks on velocities and positions in topics that the log was not made of.

    `start` is the log's first sample on the recording's clock, s.
    """
    out: list[Remark] = []
    rates = _rates(log)
    for name in idle:
        series = recording.series.get(name)
        if series is None or len(series) < _ENOUGH:
            continue
        t = series.clock - start + log.t[0]
        for path in series.fields:
            if key_of(path).endswith(("linear_x", "linear_y", "angular_z")):
                out += _lag(series, path, t, log.t, rates)
        out += _lever(series, t, log)
    return out


def _rates(log: Log) -> dict[str, np.ndarray]:
    """Return the velocities of the log by name, in body and earth axes."""
    out: dict[str, np.ndarray] = {
        name: log[name] for name in ("u", "v", "r") if name in log.channels
    }
    if {"u", "v", "psi"} <= set(log.channels):
        c, s = np.cos(log["psi"]), np.sin(log["psi"])
        out["north velocity"], out["east velocity"] = (
            c * log["u"] - s * log["v"],
            s * log["u"] + c * log["v"],
        )
    return {name: values for name, values in out.items() if np.isfinite(values).sum() > _ENOUGH}


def _lag(
    series: Series, path: str, t: np.ndarray, clock: np.ndarray, rates: dict[str, np.ndarray]
) -> list[Remark]:
    every = max(1, len(series) // _MOST_ROWS)
    at, values = t[::every], series[path][::every]
    best = (0.0, 0.0, "", 0.0)
    for name, rate in rates.items():
        known = np.isfinite(rate)
        for lag in np.arange(-_LONGEST, _LONGEST + _STEP / 2, _STEP):
            size = abs(
                _correlation(
                    values,
                    np.interp(at - lag, clock[known], rate[known], left=np.nan, right=np.nan),
                )
            )
            if size > best[0]:
                still = abs(
                    _correlation(
                        values, np.interp(at, clock[known], rate[known], left=np.nan, right=np.nan)
                    )
                )
                best = (size, float(lag), name, still)
    size, lag, name, still = best
    # a lag is reported only where it explains a good part of what the two differ by
    if size < _SAME or abs(lag) < _TELLING or 1.0 - size > 0.7 * (1.0 - still):
        return []
    verb = (
        f"lags {name} of the log by {lag:.2f} s"
        if lag > 0.0
        else f"leads {name} of the log by {-lag:.2f} s"
    )
    text = (
        f"topic {series.name}: {path} {verb} (correlation {size:.3f}, {still:.3f} without the lag);"
        " give the topic's `delays` before it is used"
    )
    return [remark("note", "topic_lag", text, lag=lag, correlation=size, correlation_without=still)]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < _ENOUGH or np.ptp(a[known]) == 0.0 or np.ptp(b[known]) == 0.0:
        return 0.0
    return float(np.corrcoef(a[known], b[known])[0, 1])


def _lever_fit(
    north: np.ndarray, east: np.ndarray, psi: np.ndarray
) -> tuple[float, np.ndarray, float]:
    """Return the rms residual, the lever with its offset [4], and the spread of a distance.

    Args:
        north: distance [N] of the log's positions from the topic's in m.
        east: the same in m.
        psi: heading [N] in rad.
    """
    c, s, ones, zeros = np.cos(psi), np.sin(psi), np.ones(psi.size), np.zeros(psi.size)
    columns = np.concatenate(
        (np.stack((c, -s, ones, zeros), axis=1), np.stack((s, c, zeros, ones), axis=1))
    )
    offset = np.concatenate((north, east))
    lever, *_ = np.linalg.lstsq(columns, offset, rcond=None)
    residual = float(np.sqrt(np.mean((columns @ lever - offset) ** 2)))
    return residual, lever, float(np.std(north) + np.std(east))


def _lever(series: Series, t: np.ndarray, log: Log) -> list[Remark]:
    """Return whether a topic's positions turn about the log's.

    Both then belong to different points of the vessel.
    """
    pair = next(
        (
            p
            for p in ("pose.position", "pose.pose.position", "position")
            if series.has(f"{p}.x") and series.has(f"{p}.y")
        ),
        None,
    )
    if pair is None or not {"x", "y", "psi"} <= set(log.channels):
        return []
    first, second = series[f"{pair}.x"], series[f"{pair}.y"]
    known = np.isfinite(log["psi"]) & np.isfinite(log["x"]) & np.isfinite(log["y"])
    if known.sum() < _ENOUGH:
        return []
    x, y, psi = (
        np.interp(t, log.t[known], log[name][known], left=np.nan, right=np.nan)
        for name in ("x", "y", "psi")
    )
    fits = []
    for north, east in ((first, second), (second, first)):
        good = np.isfinite(north) & np.isfinite(east) & np.isfinite(x)
        if good.sum() < _ENOUGH or np.ptp(psi[good]) < np.pi / 3:
            return []
        fits.append(_lever_fit(x[good] - north[good], y[good] - east[good], psi[good]))
    residual, lever, spread = min(fits, key=lambda fit: fit[0])
    length = float(np.hypot(lever[0], lever[1]))
    if length < _LEVER or residual > 0.5 * spread or residual > length:
        return []
    text = (
        f"topic {series.name}: its positions and the log's belong to points {length:.2f} m apart:"
        f" the log's lies at ({lever[0]:.2f}, {lever[1]:.2f}) m (forward, starboard) of it, rest"
        f" {residual:.3f} m; give `position.antenna` where the log's is an antenna"
    )
    return [
        remark(
            "will mislead",
            "lever_arm",
            text,
            forward=float(lever[0]),
            starboard=float(lever[1]),
            residual=residual,
        )
    ]
