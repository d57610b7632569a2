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

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import scipy

from residnet.core.log import Log
from residnet.data.channels import SIGMA_OF_MAD, deviation, median
from residnet.data.derivatives import local_polynomials
from residnet.data.doctor.findings import Check, Finding, Level, correction, with_channels
from residnet.data.doctor.statistics import SECTIONS, WINDOW, Record, bridged, fit
from residnet.data.statistics import FEWEST

LEAST_LAG = 0.2
"""A lag below this matters to no rollout of a vessel, s."""
_MOST_CAUSES = 4
"""Causes of one difference; chosen by hand: further ones would explain one another."""
# a cause must lower the sum of squares by this many variances of the noise, and be this many
# standard errors from nothing
_WORTH, _SURE = 60.0, 3.5
_REACH = WINDOW // 2
_APART = np.abs(np.arange(-_REACH, _REACH + 1)) > 1
_BESIDE = np.zeros(WINDOW)
"""Weights of the samples about one in the parabola that leaves it and its neighbours out."""
_BESIDE[_APART] = np.linalg.pinv(np.vander(np.arange(-_REACH, _REACH + 1)[_APART], 3))[-1]
_DEPENDENT = 1e-9
"""Square of what others leave of columns of length 1, below which they are sums of theirs."""


@dataclass(frozen=True)
class Cause:
    """What explains a difference between two measurements.

    Attributes:
        values: its size, one number for each column.
        errors: their standard errors.
    """

    values: np.ndarray
    errors: np.ndarray

    @property
    def sure(self) -> bool:
        """Whether any of its numbers differs from zero."""
        return bool((np.abs(self.values) > _SURE * self.errors).any())


# standard deviations of a heading's noise by which it has to move before the scale of r is told:
# smoothing leaves .4 of them
_TURNED = 3.0


def yaw_causes(log: Record) -> dict[str, Cause]:
    """Return what makes the increments of psi differ from the integral of r.

    Causes: `gain` (r is too large by 1 + value), `lag` (r trails psi, s), `bias` (of r, rad/s, the
    negative of what psi gains over it) and `ramp` (its growth over the log, rad/s from start to
    end).
    """
    psi, r, t = log["psi"], log["r"], log.t
    dt = np.diff(t)
    smooth = log.of(_around, "r")
    time = (0.5 * (t[1:] + t[:-1]) - t.mean()) / max(float(t[-1] - t[0]), 1e-12)
    columns = {"bias": [-dt], "ramp": [-dt, -dt * time]}
    # where the heading does not move, a bias of r would be all gain
    turned = deviation(log.of(_around, "psi"))
    if _stands_out(log, "r") and turned > _TURNED * log.noise("psi"):
        columns = {"gain": [-_area(dt, smooth)], "lag": [np.diff(smooth)], **columns}
    rate = np.full(dt.size, log.noise("r"))
    return _explained(psi, _area(dt, r), dt, log.noise("psi"), rate, columns)


def position_causes(log: Record) -> dict[str, Cause]:
    """Return what makes the increments of x, y differ from the integral of R(psi) [u, v].

    Causes: `gain_u`, `gain_v`, `gain` (u, v, or both too large by 1 + value), `heading` (to be
    added to psi, rad), `lag_u`, `lag_v`, `lag` (they trail the position, s), `lag_psi` (psi trails,
    s), `lag_xy` (x, y trail all else, s), `lever_arm` (the receiver stands so far forward and to
    starboard, m), `current` (u, v are through water that moves north, east, m/s), `bias` (of u, v,
    m/s).
    """
    dt, psi = np.diff(log.t), log["psi"]
    turn, mid = np.exp(1j * psi), np.exp(0.5j * (psi[1:] + psi[:-1]))
    u, v = log.of(_around, "u"), log.of(_around, "v")
    along, across = _area(dt, turn * u), _area(dt, 1j * turn * v)
    lag_u, lag_v = mid * np.diff(u), 1j * mid * np.diff(v)
    ground = turn * (u + 1j * v)
    lag_psi = 0.5j * np.diff(log.of(_around, "psi")) * (ground[1:] + ground[:-1])
    columns = {
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
        "bias": [-_area(dt, turn), -1j * _area(dt, turn)],
    }
    quiet = {name for name in ("u", "v") if not _stands_out(log, name)}
    quiet |= {"psi"} if "r" in log and not _stands_out(log, "r") else set()
    columns = {
        name: parts
        for name, parts in columns.items()
        if not any(name in _NEEDS[channel] for channel in quiet)
    }
    speed = np.hypot(np.nan_to_num(log["u"]), np.nan_to_num(log["v"]))
    turned = log.noise("psi") * 0.5 * (speed[1:] + speed[:-1])
    rate = np.hypot(max(log.noise("u"), log.noise("v")), turned)
    measured = _area(dt, turn * (log["u"] + 1j * log["v"]))
    place = log["x"] + 1j * log["y"]
    return _explained(place, measured, dt, max(log.noise("x"), log.noise("y")), rate, columns)


# channel -> causes that cannot be found where it holds noise only: the noise would explain itself
_NEEDS = {
    "u": ("gain_u", "lag_u", "gain", "lag", "lag_xy", "heading"),
    "v": ("gain_v", "lag_v"),
    "psi": ("lag_psi", "lever_arm", "lag_v"),
}


def _area(dt: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Return the integrals [T - 1] of a rate [T] over each step."""
    return np.asarray(0.5 * dt * (rate[1:] + rate[:-1]))


def _stands_out(log: Record, name: str) -> bool:
    """Return whether a channel does more than its noise."""
    return float(np.sqrt(np.nanmean(log.of(_around, name) ** 2))) > 1.2 * log.noise(name)


def _around(log: Record, name: str) -> np.ndarray:
    """Return a channel [T] smoothed by a parabola over 15 samples; NaN stay where they are.

    The parabola is that of the samples around each one, without it and its neighbours: columns then
    share no noise with what they explain, which holds the noise of these samples. Near the ends of
    a log they do.
    """
    values = log[name]
    known = np.isfinite(values)
    if known.sum() < WINDOW:
        return values
    filled = bridged(np.arange(values.size), values)
    smooth = local_polynomials(filled[:, None], WINDOW, 2, 1.0)[0][:, 0]
    smooth[_REACH:-_REACH] = np.convolve(filled, _BESIDE, "valid")
    return np.where(known & ~log.torn(_REACH), smooth, np.nan)


def _explained(
    pose: np.ndarray,
    known: np.ndarray,
    dt: np.ndarray,
    noise: float,
    rate: np.ndarray,
    columns: Mapping[str, list[np.ndarray]],
) -> dict[str, Cause]:
    """Return the causes that it takes to explain a pose, in the order of their weight.

    Args:
        pose: [T] real or complex, NaN where it was not measured.
        known: its increments [T - 1] by the velocities, NaN where these are missing.
        dt: time steps [T - 1], s.
        noise: of the pose at each sample.
        rate: noise [T - 1] of the velocity.
        columns: what each cause adds to the increments, [T - 1] each.
    """
    at = np.flatnonzero(np.isfinite(pose))

    def between(steps: np.ndarray) -> np.ndarray:
        """Return the sums [K, ...] of steps [T - 1, ...] from one pose to the next, NaN as well."""
        if at.size == pose.size:
            return steps
        unknown, start = ~np.isfinite(steps), np.zeros((1, *steps.shape[1:]))
        total = np.concatenate((start, np.cumsum(np.where(unknown, 0.0, steps), axis=0)))[at]
        count = np.concatenate((start, np.cumsum(unknown, axis=0)))[at]
        return np.where(np.diff(count, axis=0) > 0, np.nan, np.diff(total, axis=0))

    if at.size < FEWEST:
        return {}
    excess, seconds, variance = np.diff(pose[at]) - between(known), between(dt), (dt * rate) ** 2
    table = between(np.stack([part for parts in columns.values() for part in parts], axis=-1))
    usable = np.isfinite(excess) & np.isfinite(table).all(axis=1) & np.isfinite(between(rate))
    keep = np.flatnonzero(usable & (seconds <= 3.0 * median(seconds)))
    if keep.size < FEWEST:
        return {}
    total = between(variance)[keep]
    shared = variance[np.minimum(at[keep], variance.size - 1)]
    shared = np.where(np.isfinite(shared), np.minimum(shared, total), total)
    floor = 1e-3 * median(np.abs(excess[keep])) + 1e-12
    # the trapezoid shares half a sample with its neighbour, which noise of the pose hides at least
    # in part: increments are never taken as more alike than independent ones, or the whitening
    # would look at the highest frequencies alone
    ends = np.maximum(noise**2 - 0.25 * shared, 0.0)
    adjacent = np.append(keep[1:] == keep[:-1] + 1, False)
    # noise of the pose alone is singular in the limit: a little of the diagonal keeps the factor
    band = np.stack((1.0001 * (total + 2.0 * ends + floor**2), np.where(adjacent, -ends, 0.0)))
    factor = scipy.linalg.cholesky_banded(band, lower=True)
    # real and imaginary parts of a sample side by side, so that sections hold both
    rows = np.column_stack((excess[keep], table[keep]))
    rows = scipy.linalg.solve_banded((1, 0), factor, rows, overwrite_b=True)
    if np.iscomplexobj(rows):
        rows = np.stack((rows.real, rows.imag), axis=1).reshape(-1, rows.shape[1])
    y, table = rows[:, 0], rows[:, 1:]
    # rows that stand far out and that no cause explains are jumps
    scale = np.maximum(np.abs(table).max(axis=0), 1e-300)
    unit = table / scale
    rest = np.abs(y - unit @ np.linalg.lstsq(unit.T @ unit, unit.T @ y, rcond=1e-12)[0])
    trust = rest <= 8.0 * SIGMA_OF_MAD * max(median(rest), 1e-300)
    names = np.array([name for name, parts in columns.items() for _ in parts])
    return _pursuit(np.where(trust, y, 0.0), np.where(trust[:, None], table, 0.0), names)


def _pursuit(y: np.ndarray, x: np.ndarray, names: np.ndarray) -> dict[str, Cause]:
    """Select groups of columns one at a time, then drop those that others made superfluous."""
    scale = np.linalg.norm(x, axis=0)
    x, names = x[:, scale > 0.0] / scale[scale > 0.0], names[scale > 0.0]
    scale = scale[scale > 0.0]
    gram, product, energy = x.T @ x, x.T @ y, float(y @ y)
    groups = {name: np.flatnonzero(names == name) for name in dict.fromkeys(names.tolist())}

    def left(chosen: Iterable[str]) -> float:
        """Return the sum of squares that some causes leave."""
        part = np.concatenate([groups[name] for name in chosen])
        values = np.linalg.lstsq(gram[part][:, part], product[part], rcond=_DEPENDENT)[0]
        return energy - float(product[part] @ values)

    if not groups:
        return {}
    variance = max(left(groups) / y.size, 1e-12 * energy / y.size)
    price = {n: _WORTH * variance * (1.0 + 0.2 * part.size) for n, part in groups.items()}
    chosen, rest = list[str](), energy
    while len(chosen) < _MOST_CAUSES:
        lower = {name: left([*chosen, name]) for name in groups if name not in chosen}
        # of causes that explain the same, as lags of all channels but one and of that one do, the
        # first counts
        more = {
            n: round((rest - one - price[n]) / max(energy, 1e-300), 9) for n, one in lower.items()
        }
        best = max(more, key=lambda name: more[name], default="")
        if not best or more[best] <= 0.0:
            break
        chosen, rest = [*chosen, best], lower[best]
    for name in list(chosen[:-1]):
        fewer = [cause for cause in chosen if cause != name]
        chosen = fewer if left(fewer) - left(chosen) < price[name] else chosen
    if not chosen:
        return {}
    part = np.isin(names, chosen)
    columns, names, scale = x[:, part], names[part], scale[part]
    fitted = fit(columns, y)
    plain = np.linalg.pinv(columns.T @ columns) * fitted.left / max(y.size - columns.shape[1], 1)
    spread = np.diag(fitted.spread) * SECTIONS / (SECTIONS - 1)
    errors = np.sqrt(np.maximum(spread, np.diag(plain))) / scale
    values = fitted.values / scale
    return {name: Cause(values[names == name], errors[names == name]) for name in chosen}


@dataclass(frozen=True)
class Limit:
    """What a cause of disagreement is called, and the size from which on it misleads.

    Attributes:
        text: before its size.
        unit: of the size as shown.
        least: size from which on it misleads, SI.
        fix: what to do about it.
        steps: least size in time steps.
        of_speed: least size as a share of the speed.
    """

    text: str
    unit: str
    least: float
    fix: str
    steps: float = 0.0
    of_speed: float = 0.0


def _lag(text: str, least: float = LEAST_LAG) -> Limit:
    fix = "shift it in time, or estimate the lag where the reader can"
    return Limit(text, "s", least, fix, steps=1.0)


def _gain(text: str, least: float, fix: str = "correct its unit or scale") -> Limit:
    return Limit(f"{text} by a share of", "", least, fix)


YAW_LIMITS = {
    "gain": _gain("r is too large against psi", 0.06),
    "lag": _lag("r trails psi by"),
}
POSITION_LIMITS = {
    "gain_u": _gain("u is too large against the position", 0.04),
    "gain_v": _gain("v is too large against the position", 0.25),
    "gain": _gain("u, v are too large against the position", 0.04, "correct their unit or scale"),
    "heading": Limit(
        "psi is off against course and drift by",
        "deg",
        math.radians(3.0),
        "take the offset off psi",
    ),
    "lag_u": _lag("u trails the position by"),
    "lag_v": _lag("v trails the position by"),
    "lag": _lag("u, v trail the position by"),
    "lag_psi": _lag("psi trails position and velocities by", 2.0 * LEAST_LAG),
    "lag_xy": _lag("x, y trail heading and velocities by"),
    "lever_arm": Limit(
        "x, y belong to a point forward and to starboard of where u, v hold by",
        "m",
        0.3,
        "move it to the vessel's centre (lever arm)",
        of_speed=0.05,
    ),
    "current": Limit(
        "u, v are through water that moves north and east by",
        "m/s",
        0.02,
        "give the current as an input",
        of_speed=0.1,
    ),
    "bias": Limit(
        "u, v are too large against the position by", "m/s", 0.02, "take the bias off", of_speed=0.1
    ),
}


def cause_findings(
    causes: Mapping[str, Cause], limits: Mapping[str, Limit], log: Record, found: Check
) -> Iterator[Finding]:
    """Return the findings for the causes that are certain and large enough to matter."""
    for name, cause in causes.items():
        limit = limits.get(name)
        if limit is None or not cause.sure:
            continue
        size = float(np.hypot.reduce(cause.values))
        least = max(limit.least, limit.steps * log.step, limit.of_speed * log.speed)
        if size < 0.3 * least:
            continue
        early = "trail" in limit.text and cause.values[0] < 0.0
        text = limit.text.replace("trail", "lead") if early else limit.text
        factor = (math.degrees(1.0) if limit.unit == "deg" else 1.0) * (-1.0 if early else 1.0)
        sizes = zip(factor * cause.values, np.abs(2.0 * factor * cause.errors), strict=True)
        shown = ", ".join(f"{value:+.3g} +- {error:.2g}" for value, error in sizes)
        level: Level = "will mislead" if size > least else "note"
        figures = {f"value_{i + 1}": float(value) for i, value in enumerate(cause.values)}
        yield found(
            f"{text}: {shown} {limit.unit}".rstrip(),
            {"size": size, **figures, "error": cause.errors.max()},
            code=name,
            level=level,
            fix=limit.fix if level != "note" else "",
            repair=_repair(name, cause.values, ("r",) if limits is YAW_LIMITS else ("u", "v")),
        )


def _repair(name: str, values: np.ndarray, pair: tuple[str, ...]) -> Callable[[Log], Log] | None:
    """Return what corrects a cause; `pair` are the channels that are compared with the pose."""
    what, _, channel = name.partition("_")
    names = {"": pair, "xy": ("x", "y")}.get(channel, (channel,))
    if what == "gain":
        return correction(names, factor=1.0 + values[0])
    if what == "lag":
        return correction(names, lag=values[0])
    if name == "heading":
        return correction(("psi",), offset=values[0])
    if name == "bias":
        return lambda log: with_channels(log, u=log["u"] - values[0], v=log["v"] - values[1])
    if name == "lever_arm":

        def moved(log: Log) -> Log:
            arm = (values[0] + 1j * values[1]) * np.exp(1j * log["psi"])
            return with_channels(log, x=log["x"] - arm.real, y=log["y"] - arm.imag)

        return moved
    return None
