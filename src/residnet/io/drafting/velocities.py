"""Meaning of columns of velocities: body axes, earth axes or speed, from position and heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

MAX_CONTRADICTION = 0.1
"""Largest share of the distance by which integrated velocities may leave the positions."""
_MAX_UNEXPLAINED_SHARE = 0.35
"""Largest unexplained share of the columns under a meaning that replaces the one of the names."""
_MAX_SHARE_RATIO = 0.5
"""Largest ratio of unexplained shares of two meanings that are distinguished."""
_CONSISTENT_SHARE = 0.1
"""Unexplained share below which columns have the meaning of their names."""
_MIN_JUMP_RATIO = 15.0
"""Smallest ratio of a jump of the position to the median of unexplained steps."""
_N_WINDOWS = 12
"""Windows of a log over which velocities are integrated."""
_MIN_HEADING_OFFSET = np.radians(2.0)
"""Heading offset in rad below which none is reported."""
_MAX_HEADING_OFFSET = np.radians(40.0)
"""Angle between velocities and positions in rad above which it is no offset of a compass."""


class Meaning(NamedTuple):
    """Meaning of columns mapped to u and v.

    Attributes:
        components: components of the motion of u and v.
        description: text for the user.
    """

    components: tuple[str, str]
    description: str


BODY_AXES = Meaning(("surge", "sway"), "velocities in body axes")
EARTH_AXES = Meaning(("north", "east"), "velocities in earth axes, north and east")
EXCHANGED_EARTH_AXES = Meaning(("east", "north"), "velocities in earth axes, east and north")
SPEED_AS_V = Meaning(("surge", "speed"), "v is the speed")
_PAIR_MEANINGS = (BODY_AXES, EARTH_AXES, EXCHANGED_EARTH_AXES, SPEED_AS_V)


@dataclass(frozen=True)
class MeasuredVelocities:
    """Columns of velocities of one log, and its motion from position and heading.

    Attributes:
        t: times [T] in s of a uniform grid.
        position: north and east [T, 2] in m.
        heading: heading [T] in rad.
        components: surge, sway, north, east, speed -> velocity [T] in m/s, from the positions.
        columns: u, v -> column [T] in any unit.
    """

    t: np.ndarray
    position: np.ndarray
    heading: np.ndarray
    components: Mapping[str, np.ndarray]
    columns: Mapping[str, np.ndarray]


class MeaningChoice(NamedTuple):
    """Chosen meaning.

    Attributes:
        meaning: most likely meaning.
        runner_up: second most likely meaning.
        share_ratio: unexplained share of the first meaning over that of the second; 0 if the names
            were not contradicted.
        text: reasons, one line.
    """

    meaning: Meaning
    runner_up: Meaning
    share_ratio: float
    text: str

    @property
    def is_ambiguous(self) -> bool:
        """Whether the user must choose."""
        return self.share_ratio > _MAX_SHARE_RATIO


def choose_meaning(logs: Sequence[MeasuredVelocities]) -> MeaningChoice:
    """Choose the meaning of the columns u and v.

    The columns are regressed on the components of the motion from positions. Another meaning than
    that of the names must leave at most half as much unexplained.

    Args:
        logs: logs with the same columns, at least one.
    """
    names = [name for name in ("u", "v") if name in logs[0].columns]
    meanings = _PAIR_MEANINGS if len(names) == 2 else (BODY_AXES, SPEED_AS_V)
    shares = {
        meaning: compute_unexplained_share(logs, names, meaning.components) for meaning in meanings
    }
    ranking = sorted(shares, key=lambda meaning: shares[meaning])
    best = ranking[0]
    if (
        "v" not in names
        or best == BODY_AXES
        or shares[BODY_AXES] < _CONSISTENT_SHARE
        or shares[best] > min(_MAX_UNEXPLAINED_SHARE, _MAX_SHARE_RATIO * shares[BODY_AXES])
    ):
        return MeaningChoice(BODY_AXES, best, 0.0, "")
    alternatives = "; ".join(
        f"{meaning.description}: {100.0 * shares[meaning]:.1f} %" for meaning in ranking[1:]
    )
    subject = "u and v are " if len(names) == 2 else ""
    text = (
        f"{subject}{best.description} (unexplained {100.0 * shares[best]:.1f} %; alternatives:"
        f" {alternatives})"
    )
    return MeaningChoice(best, ranking[1], shares[best] / max(shares[ranking[1]], 1e-12), text)


def _fit_factors(
    logs: Sequence[MeasuredVelocities], names: Sequence[str], components: tuple[str, str]
) -> dict[str, float]:
    """Regress columns on components of the motion; both columns have one factor up to the sign."""
    products = {}
    energies = {}
    for name in names:
        component = components[("u", "v").index(name)]
        pairs = [_select_pairs(log, name, component) for log in logs]
        products[name] = sum(float(column @ reference) for column, reference in pairs)
        energies[name] = sum(float(reference @ reference) for _, reference in pairs)
    size = sum(map(abs, products.values())) / max(sum(energies.values()), 1e-12)
    signs = {name: -1.0 if products[name] < 0.0 else 1.0 for name in names}
    if "speed" in components:
        signs[("u", "v")[components.index("speed")]] = 1.0
    return {name: signs[name] * size for name in names}


def _select_pairs(
    log: MeasuredVelocities, name: str, component: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of a column and of a component without jumps of the positions."""
    column = log.columns[name]
    reference = log.components[component]
    speed = log.components["speed"]
    is_valid = np.isfinite(column) & np.isfinite(reference)
    if is_valid.any():
        is_valid &= speed <= 3.0 * float(np.quantile(speed[is_valid], 0.95)) + 1e-9
    return column[is_valid], reference[is_valid]


def compute_unexplained_share(
    logs: Sequence[MeasuredVelocities], names: Sequence[str], components: tuple[str, str]
) -> float:
    """Return the RMS residual of the columns over their RMS."""
    factors = _fit_factors(logs, names, components)
    residual = total = 0.0
    for name in names:
        component = components[("u", "v").index(name)]
        for log in logs:
            column, reference = _select_pairs(log, name, component)
            residual += float(((column - factors[name] * reference) ** 2).sum())
            total += float((column**2).sum())
    return float(np.sqrt(residual / total)) if total > 0.0 else 1.0


class HeadingOffset(NamedTuple):
    """Constant angle by which a heading is too large.

    Attributes:
        angle: angle in rad.
        standard_error: standard error in rad, from the residuals of windows of all logs.
        source: method of the estimate in words, for the user.
    """

    angle: float
    standard_error: float
    source: str

    @property
    def is_determined(self) -> bool:
        """Whether the offset differs from zero by 3.5 standard errors and more than 2 deg."""
        return bool(abs(self.angle) > max(3.5 * self.standard_error, _MIN_HEADING_OFFSET))


class Contradiction(NamedTuple):
    """Difference between integrated velocities and positions.

    Attributes:
        share: share of the distance travelled that a heading offset, a scale and a current do not
            explain.
        heading_offset: common heading offset of all logs.
    """

    share: float
    heading_offset: HeadingOffset


def measure_contradiction(logs: Sequence[MeasuredVelocities]) -> Contradiction | None:
    """Compare displacements with integrals of u, v in body axes over windows of each log.

    A heading offset, a scale and a lever arm of the receiver (for all logs), and a current (for
    each log) are fitted, so that they are no contradiction. Windows with a jump of the position,
    such as a reset of its origin, are not used.

    Args:
        logs: logs with u and v in body axes in m/s.

    Returns:
        The difference; None without windows in motion.
    """
    windows = [np.zeros((5, 0), dtype=np.complex128)]
    for number, log in enumerate(logs):
        velocity = (log.columns["u"] + 1j * log.columns["v"]) * np.exp(1j * log.heading)
        track = log.position[:, 0] + 1j * log.position[:, 1]
        axis = np.exp(1j * log.heading)
        increments = 0.5 * np.diff(log.t) * (velocity[1:] + velocity[:-1])
        is_jump = _is_jump(np.diff(track), increments)
        bounds = np.unique(np.linspace(0, log.t.size - 1, _N_WINDOWS + 1).astype(int))
        window = np.stack(
            (
                np.diff(track[bounds]),
                np.add.reduceat(increments, bounds[:-1]),
                np.diff(axis[bounds]),
                np.diff(log.t[bounds]),
                np.full(bounds.size - 1, number),
            )
        )
        is_usable = np.isfinite(window).all(axis=0)
        is_usable &= ~np.logical_or.reduceat(is_jump, bounds[:-1])
        windows.append(window[:, is_usable])
    response, integrals, rotations, durations, numbers = np.concatenate(windows, axis=1)
    distance = float(np.abs(response).sum())
    if response.size < _N_WINDOWS or distance <= 0.0:
        return None
    columns = np.zeros((response.size, 2 + len(logs)), dtype=np.complex128)
    columns[:, 0] = integrals
    columns[np.arange(response.size), 1 + numbers.real.astype(int)] = durations
    columns[:, -1] = rotations
    solution = np.linalg.lstsq(columns, response, rcond=1e-10)[0]
    residual = response - columns @ solution
    gain = complex(solution[0])
    spread = float(np.sqrt(np.mean(np.abs(residual) ** 2) / max(response.size - 3, 1)))
    spread /= max(float(np.sqrt(np.mean(np.abs(columns[:, 0]) ** 2))), 1e-9)
    angle = -float(np.angle(gain))
    if abs(angle) > _MAX_HEADING_OFFSET or not 0.5 < abs(gain) < 2.0:
        residual = response - columns[:, 0]
        angle = 0.0
    offset = HeadingOffset(angle, spread, "from velocities against positions")
    return Contradiction(float(np.abs(residual).sum()) / distance, offset)


def _is_jump(steps: np.ndarray, increments: np.ndarray) -> np.ndarray:
    """Return whether steps of a track [T - 1] are jumps that the velocities do not explain.

    The steps of a noisy or contradictory track are all large, so that none of them is a jump.

    Args:
        steps: differences of the positions [T - 1] as complex numbers in m.
        increments: integrals of the velocities over the same steps [T - 1].
    """
    excess = np.nan_to_num(np.abs(steps - increments))
    largest_distance = float(np.nanmax(np.abs(increments), initial=0.0))
    return np.asarray(excess > max(_MIN_JUMP_RATIO * float(np.median(excess)), largest_distance))


def estimate_drift_free_offset(logs: Sequence[MeasuredVelocities]) -> HeadingOffset | None:
    """Estimate a heading offset as the mean angle from the track to the heading.

    Without measured velocities a mean drift angle and an offset cannot be separated.

    Args:
        logs: motion from positions and heading.
    """
    velocities = []
    for log in logs:
        velocity = log.components["surge"] + 1j * log.components["sway"]
        for part in np.array_split(velocity[np.isfinite(velocity)], _N_WINDOWS):
            if part.size:
                velocities.append(complex(part.mean()))
    total = complex(np.sum(velocities)) if velocities else 0j
    if abs(total) == 0.0:
        return None
    angles = np.angle(np.array(velocities) * np.conj(total))
    standard_error = float(np.std(angles) / np.sqrt(max(angles.size - 1, 1)))
    source = "if the mean drift angle is zero"
    return HeadingOffset(-float(np.angle(total)), standard_error, source)
