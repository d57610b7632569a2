"""Explain the logs that contradict the other logs of one vessel.

An outlier is predicted again under each of several hypotheses (dead record, sign, scale, offset,
delay, swapped sides, heading, current, other vessel). The most likely one is reported.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from residnet.core.names import port_starboard_pairs
from residnet.core.units import unit_confusions
from residnet.quality.consensus import (
    MAX_RMSE_RATIO,
    MIN_RELATIVE_STD,
    Consensus,
    Fleet,
    RidgeFit,
    replace_channels,
)
from residnet.quality.findings import describe_unit_confusion, format_quantity
from residnet.quality.statistics import LogStatistics


@dataclass(frozen=True)
class OutlierHypothesis:
    """One change under which the inliers' model explains a log.

    Attributes:
        kind: dead, scale, sign, offset, late, exchanged, heading, current or vessel.
        channel: affected channel; empty for current and vessel.
        size: factor, offset (SI), delay in s, angle in rad, or speed of the current in m/s.
        deviance: deviance of the log under the hypothesis; the smallest is the most likely.
        text: description for the user.
    """

    kind: str
    channel: str
    size: float
    deviance: float
    text: str


SCALE_FACTORS = (0.2, 0.33, 0.5, 0.67, 0.8, 1.25, 1.5, 2.0, 3.0, 5.0)
"""Candidate scale errors of a channel."""
SHIFTS = (-2.0, -1.0, -0.5, -0.25, 0.25, 0.5, 1.0, 2.0)
"""Candidate delays in block lengths, and offsets in standard deviations of the input."""
HEADING_STEP = math.radians(10.0)
"""Step in rad between candidate offsets of the heading."""
MANY_PARAMETERS_PENALTY = 2.0
"""Factor on the deviance of `vessel`, whose several factors fit more by chance than one."""
LINKED_CORRELATION = 0.9
"""Correlation from which two inputs are linked, such as twin rudders."""


def rank_hypotheses(consensus: Consensus, i: int) -> list[OutlierHypothesis]:
    """Rank the changes of an outlier under which the inliers' model explains it.

    Each hypothesis is evaluated by the deviance of the changed log; its size (factor, offset,
    delay, angle, current) is the minimum of the deviance.

    Args:
        consensus: inliers and outliers of the fleet.
        i: index of the log.

    Returns:
        Hypotheses by increasing deviance.
    """
    fleet = consensus.fleet
    fit = consensus.fit_inliers(excluding=i)
    log = fleet.logs[i]
    penalty = fit.compute_leverage_penalty(fleet.data[i])

    def deviance(channels: Mapping[str, np.ndarray]) -> float:
        return fit.compute_deviance(fleet.assemble_scaled(replace_channels(log, channels)))

    hypotheses: list[OutlierHypothesis] = []
    # velocities that follow from the position have its scale, and no sign of their own
    derived = log.log.meta.get("derived", ())
    single_channels = [
        (name,) for name in (*fleet.actuators, *fleet.velocities) if name not in derived
    ]
    linked_channels = _find_linked_inputs(log, fleet.actuators)
    for channels in dict.fromkeys(
        (*single_channels, *linked_channels, *([derived] if derived else []))
    ):
        name = channels[0]
        if len(channels) == 1 and name in fleet.actuators and is_constant(fleet, i, name):
            step = 0.01 * _typical_std(consensus, name)
            value = _deviance_with_free_input(consensus, fit, i, name, step) + penalty
            text = f"the record of {name} is dead: it is constant while the vessel responds to it"
            hypotheses.append(OutlierHypothesis("dead", name, 0.0, value, text))
        else:
            hypotheses += _rank_channel_changes(
                consensus, log, channels, deviance, is_derived=channels == derived
            )
    for port, stbd in port_starboard_pairs(fleet.actuators).items():
        value = deviance({port: log[stbd], stbd: log[port]})
        text = f"{port} and {stbd} would have to be exchanged"
        hypotheses.append(OutlierHypothesis("exchanged", port, 0.0, value, text))
    if {"u", "v"} <= set(fleet.velocities):
        hypotheses += _rank_velocity_changes(consensus, log, deviance)
    value = MANY_PARAMETERS_PENALTY * _deviance_with_free_factors(fleet, fit, i) + penalty
    text = (
        "it is another vessel or another loading, or something acted that was not recorded: no"
        " change of a single channel explains it"
    )
    hypotheses.append(OutlierHypothesis("vessel", "", 0.0, value, text))
    # a hypothesis under which the log is still unlikely explains nothing
    worst = MAX_RMSE_RATIO**2 * len(fleet.velocities) + penalty
    return sorted(hypotheses, key=lambda h: (h.kind != "vessel" and h.deviance > worst, h.deviance))


def _typical_std(consensus: Consensus, name: str) -> float:
    """Return the median standard deviation of a channel over the inliers; 1 if it is zero."""
    stds = [consensus.fleet.logs[j].std(name) for j in consensus.inliers]
    return float(np.nanmedian(stds)) or 1.0


def _rank_channel_changes(
    consensus: Consensus,
    log: LogStatistics,
    channels: tuple[str, ...],
    deviance: Callable[[Mapping[str, np.ndarray]], float],
    *,
    is_derived: bool,
) -> list[OutlierHypothesis]:
    """Return the most likely scale, sign, delay and offset of channels that change together.

    Args:
        consensus: inliers and outliers of the fleet.
        log: the outlier.
        channels: channels with one common fault.
        deviance: deviance of the outlier with some channels replaced.
        is_derived: whether the channels are velocities derived from the position.
    """
    fleet = consensus.fleet
    name = channels[0]
    is_input = name in fleet.actuators
    label = "x, y" if is_derived else " and ".join(channels)
    unit = "m" if is_derived else log.units[name]
    std = _typical_std(consensus, name)
    grids: dict[str, list[float]] = {"scale": [1.0 / factor for factor in unit_confusions(unit)]}
    if not is_derived:
        grids["sign"] = [-1.0]
    if is_input:
        grids["scale"] += SCALE_FACTORS
        grids["late"] = [shift * fleet.block_seconds for shift in SHIFTS]
        grids["offset"] = [shift * std for shift in SHIFTS]
    hypotheses = []
    for kind, grid in grids.items():
        if not grid:
            continue

        def objective(size: float, kind: str = kind) -> float:
            value = deviance({n: _change_channel(kind, log[n], log.t, size) for n in channels})
            # the density of a scaled response has the Jacobian of the scaling as a factor
            log_jacobian = 0.0 if is_input else math.log(abs(size))
            return value - 2.0 * len(channels) * log_jacobian

        size, value = _minimize(objective, grid, 8 if is_input and kind != "sign" else 0)
        text = f"{label} would have to {_CHANGES[kind](size, unit)}"
        hypotheses.append(OutlierHypothesis(kind, name, size, value, text))
    return hypotheses


def _rank_velocity_changes(
    consensus: Consensus,
    log: LogStatistics,
    deviance: Callable[[Mapping[str, np.ndarray]], float],
) -> list[OutlierHypothesis]:
    """Return the most likely error of the heading, and current, that change both u and v."""
    velocity = log["u"] + 1j * log["v"]

    def deviance_if_turned(angle: float) -> float:
        rotated = velocity * np.exp(1j * angle)
        return deviance({"u": rotated.real, "v": rotated.imag})

    angles = [HEADING_STEP * k for k in range(-17, 19) if k]
    angle, value = _minimize(deviance_if_turned, angles, 12)
    text = (
        f"psi would have to be {'larger' if angle < 0.0 else 'smaller'} by"
        f" {abs(math.degrees(angle)):.3g} deg, or u and v turned by as much"
    )
    hypotheses = [OutlierHypothesis("heading", "psi", angle, value, text)]
    if "psi" in log:
        to_body = np.exp(-1j * log["psi"])

        def deviance_in_current(current: complex) -> float:
            water = velocity - current * to_body
            return deviance({"u": water.real, "v": water.imag})

        typical_speed = float(
            np.nanmedian([consensus.fleet.logs[j].rms_speed for j in consensus.inliers])
        )
        current, value = _minimize_in_plane(deviance_in_current, typical_speed)
        # a weaker current than this cannot be distinguished from other errors
        if abs(current) >= 0.05 * typical_speed:
            towards = math.degrees(math.atan2(current.imag, current.real)) % 360.0
            text = (
                f"it ran in a current of {abs(current):.2g} m/s towards {towards:.0f} deg, and"
                " u and v are over ground"
            )
            hypotheses.append(OutlierHypothesis("current", "", abs(current), value, text))
    return hypotheses


def is_constant(fleet: Fleet, i: int, name: str) -> bool:
    """Return whether an input is constant in a log though it varies in the other logs."""
    other_std = [log.std(name) for j, log in enumerate(fleet.logs) if j != i]
    return fleet.logs[i].std(name) <= MIN_RELATIVE_STD * max(float(np.median(other_std)), 1e-12)


def _find_linked_inputs(log: LogStatistics, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return groups of linked inputs, which share a recorder and its faults."""
    correlation = np.atleast_2d(np.corrcoef(np.nan_to_num(log.log.stack([*names]).T)))
    commanded = np.array([[candidate == f"cmd_{name}" for candidate in names] for name in names])
    linked = (correlation > LINKED_CORRELATION) | np.eye(len(names), dtype=bool) | commanded
    return [tuple(np.array(names)[row].tolist()) for row in linked]


def _change_channel(kind: str, values: np.ndarray, t: np.ndarray, size: float) -> np.ndarray:
    """Return a channel [T] under a hypothesis on it."""
    if kind == "late":
        return np.asarray(np.interp(t - size, t, values))
    return np.asarray(values + size if kind == "offset" else values * size)


_CHANGES: dict[str, Callable[[float, str], str]] = {
    "sign": lambda size, unit: "have the opposite sign",
    "scale": lambda size, unit: (
        f"be {size:.3g} times as large{describe_unit_confusion(1.0 / size, unit)}"
    ),
    "offset": lambda size, unit: f"be larger by {format_quantity(size, unit)}",
    "late": lambda size, unit: (
        f"act {abs(size):.2g} s {'later' if size > 0.0 else 'earlier'}: the clocks differ"
    ),
}


def _minimize(
    objective: Callable[[float], float], grid: Iterable[float], iterations: int
) -> tuple[float, float]:
    """Return the minimum on a grid, refined between the neighbours if iterations > 0."""
    sizes = sorted(grid)
    values = [objective(size) for size in sizes]
    k = int(np.argmin(values))
    if iterations:
        bounds = sizes[max(k - 1, 0)], sizes[min(k + 1, len(sizes) - 1)]
        refined = scipy.optimize.minimize_scalar(
            objective, bounds=bounds, options={"maxiter": iterations}
        )
        if refined.fun < values[k]:
            return float(refined.x), float(refined.fun)
    return sizes[k], values[k]


def _minimize_in_plane(
    objective: Callable[[complex], float], scale: float
) -> tuple[complex, float]:
    """Return the minimum by pattern search, from a polar grid up to half the scale."""
    directions = np.exp(0.25j * np.pi * np.arange(8))
    grid = [complex(r * scale * d) for r in (0.1, 0.2, 0.3, 0.4, 0.5) for d in directions]
    value, k = min((objective(point), k) for k, point in enumerate(grid))
    best = grid[k]
    step = 0.05 * scale
    while step > 0.01 * scale:
        lower, k = min((objective(best + step * d), k) for k, d in enumerate(directions))
        if lower < value:
            best = best + step * complex(directions[k])
            value = lower
        else:
            step *= 0.5
    return best, value


def _deviance_with_free_input(
    consensus: Consensus, fit: RidgeFit, i: int, name: str, step: float
) -> float:
    """Return the deviance of a log if an input may have any value at any time."""
    fleet = consensus.fleet
    data = consensus.fleet.data[i]
    log = fleet.logs[i]
    up, down = (
        fleet.assemble_scaled(replace_channels(log, {name: log[name] + s})) for s in (step, -step)
    )
    direction = (up.X - down.X) @ fit.coef / np.sqrt(fit.residual_var + data.noise_var)
    norm = np.linalg.norm(direction, axis=1, keepdims=True)
    direction = direction / np.maximum(norm, 1e-300)
    z = fit.standardize_residuals(data)
    z = z - (z * direction).sum(1, keepdims=True) * direction
    # correct for the degree of freedom per block that the free input uses
    n = z.shape[1]
    return float((z**2).sum(1).mean()) * (n / (n - 1) if n > 1 else 1.0)


def _deviance_with_free_factors(fleet: Fleet, fit: RidgeFit, i: int) -> float:
    """Return the deviance of a log if each contribution has a free factor."""
    data = fleet.data[i]
    total = 0.0
    tables = fleet.compute_contributions(i, fit) / fit.compute_predictive_std(data).T[..., None]
    for table, z in zip(tables, fit.standardize_residuals(data).T, strict=True):
        factors = np.linalg.lstsq(table, z, rcond=1e-6)[0]
        total += float(np.mean((z - table @ factors) ** 2))
    return total
