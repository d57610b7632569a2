"""What a finding does to a fit, measured: findings that change next to nothing become notes.

The fit is a cheap one of one step: the change of the velocities over a few seconds, by least
squares. Dead reckoning tells how far the velocities of a log lead from its positions and headings.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding
from residnet.data.doctor.statistics import Record, blocks_of, bridged, of_inputs, of_motion
from residnet.data.statistics import Blocks

LEAST_EFFECT = 0.04
"""Change of a fit's predictions, as a share of what they predict, below which none is misled."""
_RIDGE = 1e-6
"""Of columns of size 1: solves those that move together, and changes others by a millionth."""
# the predictions must change by so many times what no fit explains
_CLEAR = 1.3
# dead reckoning must change by this share of the way sailed
_LEAST_PLACE = 0.06
# a stretch is compared with so many others of its length, because every fit depends on its data
_OTHERS = 6
_ROWS_PER_COLUMN = 4
"""Rows for each coefficient; a fit to fewer follows their noise. Chosen by hand."""
_CERTAINLY = 20.0
"""Standard errors from which on a size is certain."""
_LEAST_MOVED = 0.1
"""Share of its spread by which a velocity has to be wrong to count by itself."""
_WINDOW = 60.0
"""Length of a free run by dead reckoning in s; a short log has at least three of them."""


class OneStep:
    """The rows of a one-step fit to one log.

    Args:
        log: with the inputs that drive the vessel.
        like: rows whose block length is taken; None takes what the noise asks for.

    Attributes:
        blocks: over which the equations are integrated, K of them.
        table: regressors [K, k], integrated over the blocks.
        change: of the velocities over the blocks [K, n].
        spread: standard deviation of the changes [n].
    """

    def __init__(self, log: Record, like: OneStep | None = None) -> None:
        blocks: Blocks = blocks_of(log, *log.moving)
        if like is not None:
            size = like.blocks.size
            first = np.arange(0, len(log) - size, max(size // 4, 1))
            blocks = dataclasses.replace(blocks, first=first, size=size)
        velocity = {name: log[name] for name in log.moving}
        driving = [log[name] for name in log.inputs if log.std(name) > 0.0]
        # a polynomial that knows no vessel; beyond four inputs each enters linearly only
        columns = [np.ones(len(log)), *of_motion(velocity)]
        columns += of_inputs(driving, velocity.get("u"), linear=len(driving) > 4)
        table = blocks.integrals(np.stack(columns, axis=-1))(0)
        change = blocks.change(np.stack([*velocity.values()] or [np.zeros(len(log))], axis=-1))
        known = np.isfinite(table).all(axis=1) & np.isfinite(change).all(axis=1)
        known &= blocks.change(log.t) <= (blocks.size + 3.0) * log.step
        self.blocks: Blocks = dataclasses.replace(blocks, first=blocks.first[known])
        self.table, self.change = table[known], change[known]
        self.spread = np.maximum(self.change.std(axis=0), 1e-12) if known.any() else np.ones(1)

    def __len__(self) -> int:
        return int(self.blocks.first.size)

    def fit(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return the coefficients [k, n] of a ridge fit, to rows [K] bool or to all."""
        x, y = (self.table, self.change) if rows is None else (self.table[rows], self.change[rows])
        size = np.maximum(np.sqrt(np.mean(x**2, axis=0)), 1e-300)
        x = x / size
        gram, moments = x.T @ x / len(x), x.T @ y / len(x)
        found = np.linalg.solve(gram + _RIDGE * np.eye(x.shape[1]), moments)
        return np.asarray(found / size[:, None])

    def left(self, fitted: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Return what a fit leaves of each velocity's changes [n], root mean square."""
        rest = self.change - self.table @ fitted
        return _rms(rest if rows is None else rest[rows])

    def harm(self, change: np.ndarray, fitted: np.ndarray) -> float:
        """Return the largest change of the predictions [n] over what there is to predict.

        Changes that drown in what no fit explains do not count.
        """
        counted = np.where(change > _CLEAR * self.left(fitted), change / self.spread, 0.0)
        return float(counted.max(initial=0.0))


def _rms(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def _beyond(value: np.ndarray, usual: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.maximum(value**2 - usual**2, 0.0)))


def _counted(place: np.ndarray) -> float:
    """Return the larger change of dead reckoning [2], 0 where it is within what receivers do."""
    return float(place.max()) if place.max() >= _LEAST_PLACE else 0.0


class Effects:
    """What single findings change in a one-step fit to a log, and in its dead reckoning.

    Args:
        log: of which a long one is told by a part.
        about: [T] bool, samples that this part has to hold; None for evenly spread ones.
    """

    def __init__(self, log: Record, about: np.ndarray | None = None) -> None:
        self._whole = log
        self._at, log = (log.few_rows, log.few) if about is None else log.near(about)
        self._log, self._rows = log, OneStep(log)
        enough = len(self._rows) >= _ROWS_PER_COLUMN * self._rows.table.shape[1]
        self._fit = self._rows.fit() if enough else None
        self._astray = reckoning_error(log)

    def measured(self, finding: Finding) -> Finding:
        """Return the finding with its effect, as a note where that is small.

        Only what concerns single samples, or says how it would be corrected, can be measured.
        """
        if finding.level != "will mislead" or finding.certain:
            return finding
        if finding.repair is not None:
            effect = self.of_repair(finding.repair(self._log.log), finding)
        elif finding.at is not None and finding.at.any():
            if not finding.at[self._at].any():
                return Effects(self._whole, finding.at).measured(finding)
            seen = {*self._log.moving, *self._log.inputs}
            effect = self.of_stretch(
                finding.at[self._at], not finding.channels or not seen.isdisjoint(finding.channels)
            )
        else:
            return finding
        if effect is None:
            return finding
        level = finding.level if effect >= LEAST_EFFECT else "note"
        return dataclasses.replace(finding, level=level, effect=effect)

    def of_stretch(self, at: np.ndarray, learned: bool = True) -> float | None:
        """Return what changes where the samples at [T] bool are left out; None if unknown.

        `learned` says whether a fit sees the channels concerned, and not dead reckoning alone.
        """
        others = [np.roll(at, round(at.size * (k + 0.5) / _OTHERS)) for k in range(_OTHERS)]
        chance = [_beyond(self._astray, reckoning_error(self._log, one)) for one in others]
        astray = _beyond(self._astray, reckoning_error(self._log, at))
        place = _counted(_beyond(astray, _rms(np.array(chance))))
        if not learned:
            return place
        rows, fitted = self._rows, self._fit
        if fitted is None or rows.blocks.clear_of(at).sum() < max(0.3 * len(rows), 1):
            return None if place < LEAST_EFFECT else place
        whole = rows.left(fitted)

        def without(bad: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return how far predictions [n] move, and what is left [n], without samples [T]."""
            kept = rows.blocks.clear_of(bad)
            refitted = rows.fit(kept)
            return _rms(rows.table[kept] @ (fitted - refitted)), rows.left(refitted, kept)

        change, left = without(at)
        usual, remains = zip(*(without(one) for one in others), strict=True)
        # how much of the fit's error the samples had made, where no others had made as much
        stands_out = (left < 0.95 * whole) & (left < 0.98 * np.min(remains, axis=0))
        made = np.where(stands_out, _beyond(whole, left) / rows.spread, 0.0)
        harm = rows.harm(_beyond(change, _rms(np.array(usual))), fitted)
        return max(harm, float(made.max(initial=0.0)), place)

    def of_repair(self, repaired: Log, finding: Finding) -> float | None:
        """Return what changes where the log is corrected; None if unknown."""
        after = self._log.on(repaired)
        place = _counted(_beyond(self._astray, reckoning_error(after)))
        rows = OneStep(after, self._rows)
        fitted, moved = self._fit, 0.0
        if abs(finding.figures.get("size", 0.0)) > _CERTAINLY * finding.figures.get(
            "error", np.inf
        ):
            # one-step predictions may stay as good while the coefficients they give are wrong
            for name in self._log.moving:
                apart = float(np.sqrt(np.nanmean((after[name] - self._log[name]) ** 2)))
                moved = max(moved, apart / max(self._log.std(name), 1e-12))
            moved = moved if moved >= _LEAST_MOVED else 0.0
        if fitted is None or rows.table.shape[1] != fitted.shape[0] or not len(rows):
            return None if place < LEAST_EFFECT else max(place, moved)
        new = rows.fit()
        # a correction that leaves the fit worse off is not what is wrong with the velocities
        before = _rms(self._rows.left(fitted) / self._rows.spread)
        if _rms(rows.left(new) / rows.spread) > 1.02 * before:
            return max(place, moved)
        return max(rows.harm(_rms(rows.table @ (fitted - new)), new), place, moved)


def reckoning_error(log: Record, without: np.ndarray | None = None) -> np.ndarray:
    """Return the errors [2] of dead reckoning over a minute in place and heading.

    They are shares of the way sailed; an error of the heading counts with the share by which it
    displaces the end of a straight way.

    Args:
        log: with an increasing clock.
        without: [T] bool, samples that no window may touch; where that leaves too few windows, in
            which none may begin or end.
    """
    size, out = min(round(_WINDOW / log.step), len(log) // 3), np.zeros(2)
    bad = log.torn(0) if without is None else without | log.torn(0)
    count = np.append(0, np.cumsum(bad))
    first = np.flatnonzero(count[size + 1 :] == count[: -size - 1])
    if first.size < 0.2 * (len(log) - size):
        first = np.flatnonzero(~bad[:-size] & ~bad[size:])
    if size < 2 or not first.size:
        return out

    def change(values: np.ndarray) -> np.ndarray:
        return np.asarray(values[first + size] - values[first])

    def sailed(rate: np.ndarray) -> np.ndarray:
        area = np.cumsum(0.5 * np.diff(log.t) * (rate[1:] + rate[:-1]))
        return change(np.append(0.0, area))

    def size_of(values: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.abs(values[known]) ** 2)))

    if all(name in log for name in ("x", "y", "psi", "u", "v")):
        velocity = bridged(log.t, (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"]))
        off = change(log["x"] + 1j * log["y"]) - sailed(velocity)
        known = np.isfinite(off)
        if known.any():
            out[0] = size_of(off) / max(size_of(sailed(np.abs(velocity))), 1e-9)
    if "psi" in log and "r" in log:
        off = change(log["psi"]) - sailed(bridged(log.t, log["r"]))
        known = np.isfinite(off)
        out[1] = 0.5 * size_of(off) if known.any() else 0.0
    return out
