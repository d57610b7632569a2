"""What a finding does to a fit, measured: findings that change next to nothing become notes."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.effects.one_step import OneStep
from residnet.data.doctor.effects.reckoning import reckoning_error
from residnet.data.doctor.findings import Finding

LEAST_EFFECT = 0.04
"""Change of a fit's predictions, as a share of what they predict, below which none is misled."""

# faults of the record itself: they are to be corrected whatever a fit makes of them
_CERTAIN = (
    *("spikes", "fill_values", "repeated_fix", "interpolated", "frozen", "unit"),
    *("propeller_sign", "rudder_sign", "rudder_bias", "rudder_clipped", "acausal"),
    *("repeated_rows", "stuck", "yaw_drift"),
)
# the predictions must change by so many times what no fit explains
_CLEAR = 1.3
# dead reckoning must change by this share of the way sailed
_LEAST_PLACE = 0.06
# a stretch is compared with so many others of its length, because every fit depends on its data
_OTHERS = 6
_ROWS_PER_COLUMN = 4
_CERTAINLY = 20.0
"""Standard errors from which on a size is certain."""
_LEAST_MOVED = 0.1
"""Share of its spread by which a velocity has to be wrong to count by itself."""


class Effects:
    """What single findings change in a one-step fit to a log, and in its dead reckoning.

    Args:
        log: with an increasing clock, headings continuous.
        inputs: channels that drive the vessel.
    """

    def __init__(self, log: Log, inputs: Sequence[str]) -> None:
        self._log, self._inputs = log, inputs
        self._rows = OneStep(log, inputs)
        self._all = np.ones(len(self._rows), dtype=bool)
        self._usable = len(self._rows) >= _ROWS_PER_COLUMN * self._rows.table.shape[1]
        self._fit = self._rows.fit(self._all) if self._usable else None
        self._astray = reckoning_error(log)

    def measured(self, finding: Finding) -> Finding:
        """Return the finding with its effect, as a note where that is small.

        Only what concerns single samples, or says how it would be corrected, can be measured.
        """
        if finding.level != "will mislead" or finding.code in _CERTAIN:
            return finding
        if finding.repair is not None:
            repaired = finding.repair(self._log)
            effect = self.of_repair(repaired)
            if effect is not None and _certain(finding):
                effect = max(effect, self._moved(repaired))
        elif finding.at is not None and finding.at.any():
            fitted = {*self._rows.moving, *self._inputs}
            learned = not finding.channels or not fitted.isdisjoint(finding.channels)
            effect = self.of_stretch(finding.at, learned)
        else:
            return finding
        if effect is None:
            return finding
        if effect >= LEAST_EFFECT:
            return dataclasses.replace(finding, effect=effect)
        return dataclasses.replace(finding, level="note", effect=effect)

    def of_stretch(self, at: np.ndarray, learned: bool = True) -> float | None:
        """Return what changes where the samples at [T] bool are left out; None if unknown.

        `learned` says whether a fit sees the channels concerned, and not dead reckoning alone.
        """
        others = [np.roll(at, shift) for shift in self._shifts(at)]
        astray = _beyond(self._astray, reckoning_error(self._log, at))
        by_chance = [_beyond(self._astray, reckoning_error(self._log, one)) for one in others]
        chance = np.sqrt(np.mean(np.square(by_chance), axis=0))
        place = _counted(_beyond(astray, chance))
        if not learned:
            return place
        rows = self._rows.apart_from(at)
        if self._fit is None or rows.sum() < max(0.3 * rows.size, 1):
            return None if place < LEAST_EFFECT else place
        change, left = self._without(at)
        usual = [self._without(one) for one in others]
        by_data = np.mean([moved**2 for moved, _ in usual], axis=0)
        change = np.sqrt(np.maximum(change**2 - by_data, 0.0))
        contained = self._contained(left, np.min([part for _, part in usual], axis=0))
        return max(_harm(change, self._rows, self._fit), contained, place)

    def _contained(self, left: np.ndarray, usual: np.ndarray) -> float:
        """Return how much of a fit's error the samples left out had made, over the changes.

        Nothing where a stretch of any other samples would have made as much.

        Args:
            left: what is left without the samples [n].
            usual: the least that is left without other samples [n].
        """
        assert self._fit is not None
        whole = self._rows.residual(self._fit)
        part = np.sqrt(np.maximum(whole**2 - left**2, 0.0)) / self._rows.spread
        stands_out = (left < 0.95 * whole) & (left < 0.98 * usual)
        return float(np.where(stands_out, part, 0.0).max(initial=0.0))

    def of_repair(self, repaired: Log) -> float | None:
        """Return what changes where the log is corrected; None if unknown."""
        place = _counted(_beyond(self._astray, reckoning_error(repaired)))
        other = OneStep(repaired, self._inputs, self._rows.size)
        if self._fit is None or other.table.shape[1] != self._fit.shape[0] or not len(other):
            return None if place < LEAST_EFFECT else place
        rows = np.ones(len(other), dtype=bool)
        fitted = other.fit(rows)
        # a correction that leaves the fit worse off is not what is wrong with the velocities
        left = other.residual(fitted) / other.spread
        if _size(left) > 1.02 * _size(self._rows.residual(self._fit) / self._rows.spread):
            return place
        return max(_harm(other.apart(self._fit, fitted, rows), other, fitted), place)

    def _moved(self, repaired: Log) -> float:
        """Return by how much of its spread a correction moves a velocity; 0 where that is little.

        One-step predictions may stay as good while the coefficients that they give are wrong.
        """
        if len(repaired) != len(self._log):
            return 0.0
        shares = [
            float(np.sqrt(np.nanmean((repaired[name] - self._log[name]) ** 2)))
            / max(float(np.nanstd(self._log[name])), 1e-12)
            for name in self._rows.moving
        ]
        most = max(shares, default=0.0)
        return most if most >= _LEAST_MOVED else 0.0

    def _without(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return how far predictions [n] move, and what is left [n], without samples [T] bool."""
        rows = self._rows.apart_from(at)
        assert self._fit is not None
        fitted = self._rows.fit(rows)
        return self._rows.apart(self._fit, fitted, rows), self._rows.residual(fitted, rows)

    def _shifts(self, at: np.ndarray) -> Iterable[int]:
        return (round(at.size * (k + 0.5) / _OTHERS) for k in range(_OTHERS))


def _harm(change: np.ndarray, rows: OneStep, fitted: np.ndarray) -> float:
    """Return the largest change of the predictions [n] over what there is to predict.

    Changes that drown in what no fit explains do not count.
    """
    kept = np.where(change > _CLEAR * rows.residual(fitted), change / rows.spread, 0.0)
    return float(kept.max(initial=0.0))


def _certain(finding: Finding) -> bool:
    """Return whether the size of what a finding would correct is known to a twentieth."""
    figures = finding.figures
    return abs(figures.get("size", 0.0)) > _CERTAINLY * figures.get("error", np.inf)


def _size(values: Iterable[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(list(values))))))


def _beyond(value: np.ndarray, usual: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.maximum(value**2 - usual**2, 0.0)))


def _counted(place: np.ndarray) -> float:
    """Return the larger change of dead reckoning [2], 0 where it is within what receivers do."""
    largest = float(place.max())
    return largest if largest >= _LEAST_PLACE else 0.0
