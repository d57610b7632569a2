"""Whether position, heading and velocities describe one motion, to the accuracy of their noise.

Gains, lags, biases, lever arm and drift are estimated.

Increments of the pose between neighbouring samples are compared with the integral of the velocities
over them. White noise on pose and velocities gives the increments a tridiagonal covariance, by
which they are whitened; what remains is explained by as few causes as it takes, one after the
other, each by what it would add to the increments (orthogonal matching pursuit over groups of
columns). Intervals are those of a sandwich estimate over twenty sections of the log, because
filters leave errors that are not white.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from residnet.core.log import Log
from residnet.data.doctor.signals import noise_of

_FEWEST = 50
_SECTIONS = 20
_MOST_CAUSES = 4
# a cause must lower the sum of squares by this many variances of the noise, and be this many
# standard errors from nothing
_WORTH = 60.0
_SURE = 3.5
_REACH = 7
"""Samples on either side that smooth a velocity."""


@dataclass(frozen=True)
class Cause:
    """What explains a difference between two measurements.

    Attributes:
        name: of the cause.
        values: its size, one number for each column.
        errors: their standard errors.
    """

    name: str
    values: np.ndarray
    errors: np.ndarray

    @property
    def sure(self) -> bool:
        """Whether any of its numbers differs from zero."""
        return bool((np.abs(self.values) > _SURE * self.errors).any())


def yaw_causes(log: Log) -> dict[str, Cause]:
    """Return what makes the increments of psi differ from the integral of r.

    Causes: `gain` (r is too large by 1 + value), `lag` (r trails psi, s), `bias` (of r, rad/s, the
    negative of what psi gains over it) and `ramp` (its growth over the log, rad/s from start to
    end).
    """
    psi, r, t = log["psi"], log["r"], log.t
    dt = np.diff(t)
    turned = 0.5 * dt * (r[1:] + r[:-1])
    smooth = _smoothed(r)
    time = (0.5 * (t[1:] + t[:-1]) - t.mean()) / max(float(t[-1] - t[0]), 1e-12)
    columns = {
        "gain": -0.5 * (dt * (smooth[1:] + smooth[:-1]))[:, None],
        "lag": np.diff(smooth)[:, None],
        "bias": -dt[:, None],
        "ramp": np.stack((-dt, -dt * time), axis=-1),
    }
    if not _stands_out(r):
        columns = {name: part for name, part in columns.items() if name in ("bias", "ramp")}
    return _Rows(psi, turned, dt, noise_of(psi), np.full(dt.size, noise_of(r))).explained(columns)


def position_causes(log: Log) -> dict[str, Cause]:
    """Return what makes the increments of x, y differ from the integral of R(psi) [u, v].

    Causes: `gain_u`, `gain_v`, `gain` (u, v, or both too large by 1 + value), `heading` (to be
    added to psi, rad), `lag_u`, `lag_v`, `lag` (they trail the position, s), `lag_psi` (psi trails,
    s), `lag_xy` (x, y trail all else, s), `lever_arm` (the receiver stands so far forward and to
    starboard, m), `current` (u, v are through water that moves north, east, m/s), `bias` (of u, v,
    m/s).
    """
    t = log.t
    dt = np.diff(t)
    turn = np.exp(1j * log["psi"])
    mid = np.exp(0.5j * (log["psi"][1:] + log["psi"][:-1]))
    u, v = (_smoothed(log[name]) for name in ("u", "v"))
    ground = turn * (u + 1j * v)

    def area(rate: np.ndarray) -> np.ndarray:
        increments: np.ndarray = 0.5 * dt * (rate[1:] + rate[:-1])
        return increments

    measured = area(turn * (log["u"] + 1j * log["v"]))
    along, across = area(turn * u), area(1j * turn * v)
    lag_u, lag_v = mid * np.diff(u), 1j * mid * np.diff(v)
    lag_psi = 0.5j * np.diff(_smoothed(log["psi"])) * (ground[1:] + ground[:-1])
    complex_columns: dict[str, list[np.ndarray]] = {
        "gain_u": [-along],
        "gain_v": [-across],
        "gain": [-(along + across)],
        "heading": [-1j * (along + across)],
        "lag_u": [lag_u],
        "lag_v": [lag_v],
        "lag": [lag_u + lag_v],
        "lag_psi": [lag_psi],
        "lag_xy": [-(lag_u + lag_v + lag_psi)],
        "lever_arm": [np.diff(turn), 1j * np.diff(turn)],
        "current": [dt + 0j, 1j * dt],
        "bias": [-area(turn), -1j * area(turn)],
    }
    speed = np.hypot(np.nan_to_num(log["u"]), np.nan_to_num(log["v"]))
    noise = np.sqrt(
        max(noise_of(log["u"]), noise_of(log["v"])) ** 2
        + (noise_of(log["psi"]) * 0.5 * (speed[1:] + speed[:-1])) ** 2
    )
    rows = _Rows(
        log["x"] + 1j * log["y"], measured, dt, max(noise_of(log["x"]), noise_of(log["y"])), noise
    )
    noisy = {name for name in ("u", "v") if not _stands_out(log[name])}
    noisy |= {"psi"} if "r" in log.channels and not _stands_out(log["r"]) else set()
    without = {cause for name in noisy for cause in _NEEDS[name]}
    return rows.explained(
        {
            name: np.stack(parts, axis=-1)
            for name, parts in complex_columns.items()
            if name not in without
        }
    )


# channel -> causes that cannot be found where it holds noise only: the noise would explain itself
_NEEDS = {
    "u": ("gain_u", "lag_u", "gain", "lag", "lag_xy", "heading"),
    "v": ("gain_v", "lag_v"),
    "psi": ("lag_psi", "lever_arm", "lag_v"),
}


def _stands_out(values: np.ndarray) -> bool:
    """Return whether a channel does more than its noise."""
    smooth = _smoothed(values)
    return float(np.sqrt(np.nanmean(smooth**2))) > 1.2 * noise_of(values)


def _smoothed(values: np.ndarray) -> np.ndarray:
    """Return the values [T] smoothed by a parabola over 15 samples; NaN stay where they are.

    The parabola is that of the samples around each one, without it and its neighbours: columns then
    share no noise with what they explain, which holds the noise of these samples. Near the ends of
    a log they do.
    """
    known = np.isfinite(values)
    if known.sum() < 2 * _REACH + 1:
        return values
    at = np.arange(values.size)
    filled = np.interp(at, at[known], values[known])
    smooth = scipy.signal.savgol_filter(filled, 2 * _REACH + 1, 2)
    smooth[_REACH:-_REACH] = np.convolve(filled, _around(), "valid")
    return np.where(known, smooth, np.nan)


def _around() -> np.ndarray:
    """Return the weights [15] of a parabola through the samples around one, at that one."""
    offsets = np.arange(-_REACH, _REACH + 1)
    weights = np.zeros(offsets.size)
    others = np.abs(offsets) > 1
    weights[others] = np.linalg.pinv(np.vander(offsets[others], 3))[-1]
    return weights


class _Rows:
    """Whitened increments of a pose between its own samples.

    Args:
        pose: [T] real or complex, NaN where it was not measured.
        known: its increments [T - 1] by the velocities, NaN where these are missing.
        dt: time steps [T - 1], s.
        noise: of the pose at each sample.
        rate: noise [T - 1] of the velocity.
    """

    def __init__(
        self, pose: np.ndarray, known: np.ndarray, dt: np.ndarray, noise: float, rate: np.ndarray
    ) -> None:
        self._at = np.flatnonzero(np.isfinite(pose))
        self._excess = np.diff(pose[self._at]) - self._between(known)
        self._seconds = self._between(dt)
        self._dt, self._rate, self._noise = dt, rate, noise

    def _between(self, steps: np.ndarray) -> np.ndarray:
        """Return the sums [K, ...] of steps [T - 1, ...] between neighbouring pose samples.

        They are NaN where one of the steps is.
        """
        unknown = ~np.isfinite(steps)
        start = np.zeros((1, *steps.shape[1:]))
        total = np.concatenate((start, np.cumsum(np.where(unknown, 0.0, steps), axis=0)))[self._at]
        count = np.concatenate((start, np.cumsum(unknown, axis=0)))[self._at]
        return np.where(np.diff(count, axis=0) > 0, np.nan, np.diff(total, axis=0))

    def explained(self, columns: Mapping[str, np.ndarray]) -> dict[str, Cause]:
        """Return the causes that it takes, in the order of their weight.

        Columns [T - 1, m] real or complex.
        """
        if self._at.size < _FEWEST:
            return {}
        names = np.array([name for name, part in columns.items() for _ in range(part.shape[1])])
        table = self._between(np.concatenate(list(columns.values()), axis=1))
        longest = 3.0 * float(np.median(self._seconds))
        usable = (
            np.isfinite(self._excess)
            & np.isfinite(table).all(axis=1)
            & np.isfinite(self._between(self._rate))
            & (self._seconds <= longest)
        )
        keep = np.flatnonzero(usable)
        if keep.size < _FEWEST:
            return {}
        self._factorise(keep)
        y, x = self._white(self._excess[keep][:, None])[:, 0], self._white(table[keep])
        section = np.arange(keep.size) * _SECTIONS // keep.size
        if np.iscomplexobj(y):
            y, x, section = (
                np.concatenate((y.real, y.imag)),
                np.concatenate((x.real, x.imag)),
                np.concatenate((section, section)),
            )
        weight = self._trimmed(y, x)
        return _pursuit(y * weight, x * weight[:, None], names, section)

    def _factorise(self, keep: np.ndarray) -> None:
        variance = (self._dt * self._rate) ** 2
        total = self._between(variance)[keep]
        shared = variance[np.minimum(self._at[keep], variance.size - 1)]
        shared = np.where(np.isfinite(shared), np.minimum(shared, total), total)
        floor = 1e-3 * float(np.median(np.abs(self._excess[keep]))) + 1e-12
        # the trapezoid shares half a sample with its neighbour, which noise of the pose hides at
        # least in part: increments are never taken as more alike than independent ones, or the
        # whitening would look at the highest frequencies alone
        ends = np.maximum(self._noise**2 - 0.25 * shared, 0.0)
        adjacent = np.append(keep[1:] == keep[:-1] + 1, False)
        diagonal, off = total + 2.0 * ends + floor**2, np.where(adjacent, -ends, 0.0)
        # noise of the pose alone is singular in the limit: a little of the diagonal keeps the
        # factor
        self._factor = scipy.linalg.cholesky_banded(np.stack((1.0001 * diagonal, off)), lower=True)

    def _white(self, table: np.ndarray) -> np.ndarray:
        # rows of L: diagonal and the one below
        return np.asarray(scipy.linalg.solve_banded((1, 0), self._factor, table))

    @staticmethod
    def _trimmed(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Return [K] 1 or 0: 0 for rows that stand far out and that no cause explains (jumps)."""
        scale = np.maximum(np.abs(x).max(axis=0), 1e-300)
        coefficients = np.linalg.lstsq(x / scale, y, rcond=1e-9)[0]
        residual = np.abs(y - (x / scale) @ coefficients)
        kept: np.ndarray = (
            residual <= 8.0 * 1.4826 * max(float(np.median(residual)), 1e-300)
        ).astype(float)
        return kept


def _pursuit(
    y: np.ndarray, x: np.ndarray, names: np.ndarray, section: np.ndarray
) -> dict[str, Cause]:
    """Select groups of columns one at a time, then drop those that others made superfluous."""
    scale = np.linalg.norm(x, axis=0)
    alive = scale > 0.0
    x, names, scale = x[:, alive] / scale[alive], names[alive], scale[alive]
    gram, product, energy = x.T @ x, x.T @ y, float(y @ y)

    def residual_energy(chosen: list[str]) -> float:
        part = np.isin(names, chosen)
        return (
            energy
            - float(
                product[part]
                @ np.linalg.lstsq(gram[np.ix_(part, part)], product[part], rcond=1e-9)[0]
            )
            if chosen
            else energy
        )

    every = list(dict.fromkeys(names.tolist()))
    variance = max(residual_energy(every) / y.size, 1e-12 * energy / y.size)
    price = {name: _WORTH * variance * (1.0 + 0.2 * float((names == name).sum())) for name in every}
    chosen: list[str] = []
    while len(chosen) < _MOST_CAUSES:
        gain = {
            name: residual_energy(chosen) - residual_energy([*chosen, name]) - price[name]
            for name in every
            if name not in chosen
        }
        best = max(gain, key=lambda name: gain[name], default="")
        if not best or gain[best] <= 0.0:
            break
        chosen.append(best)
    for name in list(chosen[:-1]):
        fewer = [cause for cause in chosen if cause != name]
        if residual_energy(fewer) - residual_energy(chosen) < price[name]:
            chosen = fewer
    columns = np.isin(names, chosen)
    return (
        _causes(y, x[:, columns], names[columns], scale[columns], section, chosen) if chosen else {}
    )


def _causes(
    y: np.ndarray,
    x: np.ndarray,
    names: np.ndarray,
    scale: np.ndarray,
    section: np.ndarray,
    order: list[str],
) -> dict[str, Cause]:
    values = np.linalg.lstsq(x, y, rcond=1e-9)[0]
    residual = y - x @ values
    inverse = np.linalg.pinv(x.T @ x)
    scores = np.stack([x[section == i].T @ residual[section == i] for i in range(_SECTIONS)])
    spread = inverse @ (scores.T @ scores) @ inverse * _SECTIONS / (_SECTIONS - 1)
    plain = inverse * float(residual @ residual) / max(y.size - x.shape[1], 1)
    errors = np.sqrt(np.maximum(np.diag(spread), np.diag(plain)))
    return {
        name: Cause(name, (values / scale)[names == name], (errors / scale)[names == name])
        for name in order
    }
