"""Errors of free runs: rows of metrics.json, their intervals, and the limits of a model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from residnet.core.files import file_stem, whole
from residnet.core.layout import PLANAR, VELOCITIES, Live
from residnet.core.names import END_UNITS
from residnet.data.prepare import Prepared
from residnet.judge.band import Bands
from residnet.judge.bands import counted, limits, run_errors
from residnet.judge.freerun import Candidate, Errors, FreeRun, drift
from residnet.judge.verdict import FEW_LOGS, diverged_note

if TYPE_CHECKING:
    import pandas as pd


LEVEL = 0.95
"""Of all intervals."""
_RESAMPLES = 10_000
"""Of the blocks: their 2.5 % tail then holds 250."""
MANY_LOGS, WANTED_BLOCKS, _LEAST_BLOCKS = 5, 8, 5
"""Logs from which on each is a block; blocks that fewer are cut into, and need at least.

Chosen by hand: to resample fewer blocks tells little, and smaller ones are alike.
"""


@dataclass(frozen=True)
class Blocks:
    """What is drawn together.

    Attributes:
        labels: number of each window's block, [W], from 0 on.
        of: `logs` where a block is all windows of a log, else `windows`: consecutive windows of one
            log.
        count: number of blocks.
    """

    labels: np.ndarray
    of: str
    count: int

    def row(self) -> dict[str, Any]:
        """Return the blocks as they stand in metrics.json."""
        return {"of": self.of, "count": self.count}


def blocks(logs: Sequence[int] | np.ndarray) -> Blocks | None:
    """Return blocks of windows from the number of the log that each comes from.

    Windows of a log are in time order.

    From five logs on a block is a log: the interval then speaks for other logs, whatever the
    windows of one have in common. Of three or four logs the mean cannot be resampled so; each is
    cut into as few equal runs of consecutive windows as make at least eight blocks, and the
    interval holds only as far as what lies between logs is small against what lies between such
    runs. None, and so no interval, where there are fewer than three logs or five blocks.
    """
    numbers = np.asarray(logs, dtype=int)
    names, sizes = np.unique(numbers, return_counts=True)
    if len(names) >= MANY_LOGS:
        return Blocks(np.searchsorted(names, numbers), "logs", len(names))
    if len(names) < FEW_LOGS:
        return None
    length = int(sizes.max())
    while length > 1 and sum(math.ceil(size / length) for size in sizes) < WANTED_BLOCKS:
        length -= 1
    labels, count = np.zeros(len(numbers), dtype=int), 0
    for name, size in zip(names, sizes, strict=True):
        for run in np.array_split(np.flatnonzero(numbers == name), math.ceil(size / length)):
            labels[run] = count
            count += 1
    return Blocks(labels, "windows", count) if count >= _LEAST_BLOCKS else None


def intervals(values: np.ndarray, blocks: Blocks | None) -> list[list[float] | None]:
    """Return 95 % intervals of the means of columns [W, C] over windows, [low, high] of each.

    None where there are no blocks.

    Percentile bootstrap over blocks drawn with replacement, with a fixed seed, at levels widened
    for few blocks as Student's t is against the normal distribution (Hesterberg 2015, The American
    Statistician 69, 371-386, section 5.3): plain percentiles cover some 83 % with five blocks.
    """
    if blocks is None:
        return [None] * values.shape[1]
    sums = np.stack(
        [np.bincount(blocks.labels, column, blocks.count) for column in values.T], axis=1
    )
    draws = _draws(blocks.count)
    means = (draws @ sums) / (draws @ np.bincount(blocks.labels, minlength=blocks.count))[:, None]
    low = tail(blocks.count)
    return [
        [float(lower), float(upper)]
        for lower, upper in np.quantile(means, [low, 1 - low], axis=0).T
    ]


def new_trials(values: np.ndarray, logs: np.ndarray) -> list[list[float] | None]:
    """Return 95 % intervals of the means of columns [W, C] over as many new logs, [low, high].

    The windows of a log have its manoeuvre, weather and speed in common, so that the means of logs
    are what scatters. Errors are positive and their size is drawn: Student's t holds for the
    logarithm of the mean over logs, twice over, for the logs seen and the new ones. It scatters as
    the logs do beside their mean, so that a log in which next to nothing goes wrong widens nothing.
    By how much logs differ is estimated from all columns, since the few logs of one alone tell too
    little by chance, and what looks best has too narrow an interval then. Columns hang together:
    they count as two.

    Args:
        values: errors of windows, none negative; a column is a model's error of one kind.
        logs: number [W] of the log that each window is of.

    Returns:
        An interval for each column; None where there are fewer than three logs.
    """
    names, places = np.unique(logs, return_inverse=True)
    count = len(names)
    if count < FEW_LOGS:
        return [None] * values.shape[1]
    sums = np.stack([np.bincount(places, column, count) for column in values.T], axis=1)
    sizes = (sums / np.bincount(places)[:, None])[:, sums.any(axis=0) & np.isfinite(sums).all(0)]
    told = (sizes / sizes.mean(axis=0)).var(axis=0, ddof=1)
    scatter = math.sqrt(told.mean()) if told.size else 0.0
    freedom = min(values.shape[1], 2) * (count - 1)
    wide = scipy.stats.t.ppf(0.5 + LEVEL / 2, freedom) * math.sqrt(2 / count)
    factor = math.exp(wide * scatter)
    return [[float(mean / factor), float(mean * factor)] for mean in values.mean(0)]


def tail(count: int) -> float:
    """Return the share of resampled means left out at either end, for at least 2 blocks.

    It is 0.025 for many blocks and less for few.
    """
    wide = math.sqrt(count / (count - 1)) * scipy.stats.t.ppf(0.5 + LEVEL / 2, count - 1)
    return float(scipy.stats.norm.cdf(-wide))


@lru_cache(maxsize=16)
def _draws(count: int) -> np.ndarray:
    """How often each block is drawn, [resamples, count]."""
    return (
        np.random.default_rng(0)
        .multinomial(count, np.full(count, 1 / count), size=_RESAMPLES)
        .astype(float)
    )


def difference(
    model: np.ndarray, reference: np.ndarray, to: str, blocks: Blocks | None
) -> dict[str, Any]:
    """Return the paired difference of two models' mean errors, as in metrics.json.

    Both are over the same windows.

    Args:
        model: error of each window, [W].
        reference: error of the reference model over the same windows, [W].

    Returns:
        to; nrmse_mean, the mean of model minus reference (negative where the model is better), with
        its interval ci95 (None where there is none) and excludes_zero; ratio of the means (None
        where the reference has no error) and worse, a ratio above 1.05.
    """
    apart = model - reference
    (interval,) = intervals(apart[:, None], blocks)
    level = float(reference.mean())
    ratio = float(model.mean()) / level if level > 0 else None
    return {
        "to": to,
        "nrmse_mean": float(apart.mean()),
        "ci95": interval,
        "excludes_zero": interval is not None and (interval[0] > 0 or interval[1] < 0),
        "ratio": ratio,
        "worse": ratio is not None and ratio > 1.05,
    }


SCHEMA = "residnet.metrics/1"
LIMITS_SCHEMA = "residnet.limits/1"
ZERO = "zero"
_WORST, _BANDS, _LEAST = 3, 3, 3
"""Worst windows that are told, bands of speed, and windows that a band needs; chosen by hand."""
_WIND = "wind_speed"
_HORIZONS = (10.0, 30.0, 100.0)
"""Times in s after which errors of the pose are told."""


class Judged:
    """The errors of all models over the W windows of one protocol, and what is read off them.

    Args:
        run: free runs of all models.
        scales: of what moves, which nrmse divides by.
    """

    def __init__(
        self,
        run: FreeRun,
        candidates: Sequence[Candidate],
        logs: Sequence[Prepared],
        scales: Mapping[str, float],
    ) -> None:
        self.run, self.candidates, self.logs = run, candidates, logs
        self.live = logs[0].live
        self.scale = np.array([scales.get(name, 1.0) for name in self.live.moving])
        self.parts = [(logs[w.log], slice(w.start, w.stop)) for w in run.windows]
        self.numbers = np.array([window.log for window in run.windows])
        self.found = {
            one.name: Errors.of(run.windows, run.predictions[one.name], logs) for one in candidates
        }
        self.nrmse = {name: found.nrmse(self.scale) for name, found in self.found.items()}

    def difference(
        self,
        name: str,
        other: str | None,
        chosen: np.ndarray,
        values: Mapping[str, np.ndarray] | None = None,
    ) -> dict[str, Any] | None:
        """Return the paired difference of two models over chosen windows [W] bool.

        None where the other is not among the models. `values` [W] by model stand for the nrmse.
        """
        values = self.nrmse if values is None else values
        if other is None or other not in values:
            return None
        drawn = blocks(self.numbers[chosen])
        return difference(values[name][chosen], values[other][chosen], other, drawn)

    def rows(self, groups: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
        """Return the rows of metrics.json.

        Every model, over all windows, every kind of manoeuvre and every named group of kinds.
        `difference` compares a model with its reference (`Candidate.reference`); None where it has
        none. Models with a band have its coverage and interval score, too.
        """
        kinds = [log.log.manoeuvre for log, _ in self.parts]
        subsets: dict[str, Sequence[str]] = {"all": kinds}
        subsets |= {kind: [kind] for kind in sorted(set(kinds))} | dict(groups)
        banded = {
            one.name: counted(
                run_errors(
                    self.run.windows,
                    self.run.predictions[one.name],
                    self.logs,
                    self.found[one.name],
                ),
                one.bands[self.run.protocol],
            )
            for one in self.candidates
            if self.run.protocol in one.bands
        }
        out = []
        for one in self.candidates:
            for name, members in subsets.items():
                chosen = np.isin(kinds, list(members))
                if not chosen.any():
                    continue
                labels = {
                    "model": one.name,
                    "kind": one.kind,
                    "split": self.run.split,
                    "protocol": self.run.protocol,
                    "manoeuvre": name,
                }
                row = labels | self._summary(one.name, chosen)
                row["difference"] = self.difference(one.name, one.reference, chosen)
                out.append(row | (banded[one.name].row(chosen) if one.name in banded else {}))
        return out

    def _summary(self, name: str, chosen: np.ndarray) -> dict[str, Any]:
        found, drawn = self.found[name], blocks(self.numbers[chosen])
        live, ends = self.live, found.ends()
        by_window = np.column_stack((found.rmse, self.nrmse[name], *ends.values()))[chosen]
        rmse, mae = by_window[:, : live.size].mean(0), found.mae[chosen].mean(0)
        nrmse = rmse / self.scale
        spread = intervals(by_window, drawn)
        samples = found.samples[chosen]

        def named(values: np.ndarray) -> dict[str, float]:
            return {live.moving[axis]: float(values[axis]) for axis in live.axes}

        out = {
            "windows": len(samples),
            "n": int(samples.sum()),
            "diverged": sum(
                one.diverged
                for one, taken in zip(self.run.predictions[name], chosen, strict=True)
                if taken
            ),
            "rmse": named(rmse),
            "mae": named(mae),
            "nrmse": named(nrmse) | {"mean": float(nrmse[live.axes].mean())},
            "rmse_ci95": {live.moving[axis]: spread[axis] for axis in live.axes},
            "nrmse_mean_ci95": spread[live.size],
            "ci95_blocks": drawn.row() if drawn is not None else None,
        }
        # they stand behind the errors of what moves and their mean
        for column, name in enumerate(ends, live.size + 1):
            out[f"{name}_error_end"] = float(by_window[:, column].mean())
            out[f"{name}_error_end_ci95"] = spread[column]
        return out

    def limits(self, step: float) -> dict[str, Any]:
        """Return the part of limits.json for one protocol and split; `step` of the grid in s."""
        return {
            "kinematics": self.kinematics(step),
            "bands": self.bands(),
            "worst": {name: self.worst(name) for name in self.found},
            "compared": self.compared(),
            "outside": self.outside(),
            "horizons": self.horizons(step),
        }

    def horizons(self, step: float) -> list[dict[str, Any]]:
        """Return how far models are off after some times that matter, in metres and radians.

        Returns:
            One entry for 10, 30 and 100 s, as far as the windows go, and for the end of the longest
            window: `seconds`; `windows` and `logs` that last so long, `slowest` and `fastest` of
            them (mean speeds, m/s) and the mean way `sailed` in m; `floor`: what integrated
            measured velocities are off in each of `Live.ends`; and by model the mean of each over
            the windows, with `intervals` for as many new logs, see `new_trials`.
        """
        laid, speeds = next(iter(self.found.values())), self._speeds()
        longest = int(laid.counts.max()) - 1
        after = [round(seconds / step) for seconds in _HORIZONS]
        out = []
        for k in [*(k for k in after if 0 < k < longest), longest]:
            there = laid.counts > k
            there[there] = laid.usable[(laid.begins + k)[there]]
            if not there.any():
                continue
            numbers = self.numbers[there]
            lasting = (self.parts[i] for i in np.flatnonzero(there).tolist())
            measured = [log.y[part][: k + 1] for log, part in lasting]
            sailed = [float(np.hypot(*y[:, VELOCITIES][:, :2].T).sum()) * step for y in measured]
            models = {
                name: found.ends((found.begins + k)[there]) for name, found in self.found.items()
            }
            floor = {"floor": drift(np.stack(measured), self.live, step)}
            out.append(
                {
                    "seconds": k * step,
                    "windows": len(measured),
                    "logs": len(set(numbers.tolist())),
                    "slowest": float(speeds[there].min()),
                    "fastest": float(speeds[there].max()),
                    "sailed": float(np.mean(sailed)),
                    "floor": _sizes(floor, numbers)["floor"],
                    "models": _sizes(models, numbers),
                }
            )
        return out

    def kinematics(self, step: float) -> dict[str, float]:
        """Return how far integrated measured velocities end from the measured pose.

        They are integrated over each window from its measured pose, as predictions are.

        Returns:
            windows; mean and root mean square of each of `Live.ends` at the ends of windows, as
            position_mean and position_rms. A model that predicted the measured velocities exactly
            would have these errors. Empty where only some velocities were recorded.
        """
        if self.live.dead:
            return {}
        of_length: dict[int, list[np.ndarray]] = {}
        for log, part in self.parts:
            of_length.setdefault(part.stop - part.start, []).append(log.y[part])
        found = [drift(np.stack(alike), self.live, step) for alike in of_length.values()]
        out: dict[str, float] = {"windows": len(self.parts)}
        for name in self.live.ends:
            values = np.concatenate([one[name] for one in found])
            out[f"{name}_mean"] = float(values.mean())
            out[f"{name}_rms"] = float(np.sqrt(np.mean(values**2)))
        return out

    def _speeds(self) -> np.ndarray:
        return np.array(
            [np.hypot(*log.y[part, VELOCITIES][:, :2].T).mean() for log, part in self.parts]
        )

    def bands(self) -> list[dict[str, Any]]:
        """Return errors by thirds of the windows in mean speed and in mean true wind speed.

        The wind only where every log has it. A band of fewer than three windows is left out, and
        so is a quantity of which one band remains. Each entry: `by` (speed or wind), `low` and
        `high` in m/s (extremes of the windows' means), `windows`, and by model `nrmse_mean` and
        `difference` as in metrics.json.
        """
        quantities = {"speed": self._speeds()}
        if all(_WIND in log.log.channels for log, _ in self.parts):
            winds = [log.log[_WIND][part].mean() for log, part in self.parts]
            quantities["wind"] = np.array(winds)
        out = []
        for quantity, values in quantities.items():
            if not np.isfinite(values).all():
                continue
            # equal values stay together
            edges = np.quantile(values, np.arange(1, _BANDS) / _BANDS)
            place = np.searchsorted(edges, values, side="left")
            thirds = [place == k for k in range(_BANDS) if (place == k).sum() >= _LEAST]
            out += [
                {
                    "by": quantity,
                    "low": float(values[chosen].min()),
                    "high": float(values[chosen].max()),
                    "windows": int(chosen.sum()),
                    "models": {
                        one.name: {
                            "nrmse_mean": float(self.nrmse[one.name][chosen].mean()),
                            "difference": self.difference(one.name, one.reference, chosen),
                        }
                        for one in self.candidates
                    },
                }
                for chosen in (thirds if len(thirds) > 1 else ())
            ]
        return out

    def worst(self, name: str) -> list[dict[str, Any]]:
        """Return the three windows with the largest nrmse of a model.

        Each with log, manoeuvre, t (start, the log's clock, s), nrmse, rmse, position_error_end
        (heading_error_end where no velocity moves the position).
        """
        found, nrmse, end = self.found[name], self.nrmse[name], self.live.ends[0]
        ends = found.ends()[end]
        return [
            {
                "log": self.parts[i][0].log.name,
                "manoeuvre": self.parts[i][0].log.manoeuvre,
                "t": float(self.parts[i][0].log.t[self.run.windows[i].start]),
                "nrmse": float(nrmse[i]),
                "rmse": {
                    self.live.moving[axis]: float(found.rmse[i, axis]) for axis in self.live.axes
                },
                f"{end}_error_end": float(ends[i]),
            }
            for i in np.argsort(-nrmse, kind="stable")[:_WORST].tolist()
        ]

    def compared(self) -> dict[str, dict[str, Any]]:
        """Return by model its paired differences to `zero` and to the first baseline."""
        everywhere = np.ones(len(self.numbers), dtype=bool)
        others = [ZERO] if ZERO in self.found else []
        others += [one.name for one in self.candidates if one.kind == "baseline"][:1]
        return {
            name: {
                other: self.difference(name, other, everywhere) for other in others if other != name
            }
            for name in self.found
        }

    def outside(self) -> dict[str, Any]:
        """Return how much of the windows lies outside the range of the training data.

        Returns:
            `share` of the usable samples with a velocity or an input outside its range, and
            `channels`: the share of each channel that is; empty where no model says its ranges. A
            depth, which drives nothing, does not count.
        """
        ranges = next((one.ranges for one in self.candidates if one.ranges), {})
        if not ranges:
            return {}
        values = np.concatenate(
            [
                np.concatenate((log.y[part, log.live.columns], log.w[part]), axis=1)[
                    log.usable[part]
                ]
                for log, part in self.parts
            ]
        )
        low, high = np.array(list(ranges.values())).T
        hidden = self.parts[0][0].live.hidden
        beyond = (values < low) | (values > high)
        beyond &= np.array([name not in hidden for name in ranges])
        shares = dict(zip(ranges, beyond.mean(0).tolist(), strict=True))
        return {
            "share": float(beyond.any(1).mean()),
            "channels": {name: share for name, share in shares.items() if share > 0},
        }


def _sizes(
    errors: Mapping[str, Mapping[str, np.ndarray]], numbers: np.ndarray
) -> dict[str, dict[str, Any]]:
    """Return means and intervals of sizes [W] of errors of the pose, by model and name."""
    values = np.column_stack([one for of in errors.values() for one in of.values()])
    told = zip(values.mean(0).tolist(), new_trials(values, numbers), strict=True)
    out: dict[str, dict[str, Any]] = {}
    for model, of in errors.items():
        found = {name: next(told) for name in of}
        # an angle is off by half a turn at most
        most = {name: math.pi if END_UNITS[name] == "rad" else math.inf for name in of}
        intervals = {
            name: ends and [ends[0], min(ends[1], most[name])] for name, (_, ends) in found.items()
        }
        out[model] = {name: mean for name, (mean, _) in found.items()} | {"intervals": intervals}
    return out


def find(table: Sequence[Mapping[str, Any]], **wanted: str) -> Mapping[str, Any]:
    """Return the one row of a model, split, protocol and manoeuvre (`all` where not given)."""
    keys = {"manoeuvre": "all"} | wanted
    found = [row for row in table if all(row[key] == value for key, value in keys.items())]
    if len(found) != 1:
        raise KeyError(f"{len(found)} rows with {keys}")
    return found[0]


_LABELS = ("model", "kind", "split", "protocol", "manoeuvre", "selected")
_COUNTS = ("windows", "diverged", "n")
_BY_CHANNEL = ("rmse", "mae", "nrmse")
_ENDS = tuple(f"{end}_error_end" for end in END_UNITS)


def metrics_content(
    run: str,
    units: Mapping[str, str],
    scales: Mapping[str, float],
    selected: str,
    selected_ensemble: str | None,
    predictor: str,
    rows: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the contents of metrics.json.

    Args:
        selected: name of the single model that the validation data chose.
        selected_ensemble: name of the best ensemble; None where there is none.
        predictor: name of the model that is reported first and exported where none is named.
        rows: of all splits, without `selected`.
    """
    marked = [{**row, "selected": row["model"] == selected} for row in rows]
    return {
        "schema": SCHEMA,
        "run": run,
        "channels": dict(units),
        "scales": dict(scales),
        "selected": selected,
        "selected_ensemble": selected_ensemble,
        "predictor": predictor,
        "rows": marked,
    }


def metrics_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of metrics.json as a table with one column per number.

    Args:
        rows: of metrics.json, as `evaluate` or the file gives them.

    Returns:
        Columns model, kind, split, protocol, manoeuvre (and selected where the rows have it),
        windows, diverged, n, then rmse_u, rmse_v, rmse_r (m/s, m/s, rad/s), the same for mae and
        nrmse with nrmse_mean, note (such as "2/12 diverged", where such windows count with the
        error of `zero`), and position_error_end (m), heading_error_end (rad), or depth_error_end
        (m) and attitude_error_end (rad) where the vessel dives.
    """
    import pandas as pd

    return pd.DataFrame([_flat(row) for row in rows])


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    out = {name: row[name] for name in (*_LABELS, *_COUNTS) if name in row}
    for name in _BY_CHANNEL:
        out |= {f"{name}_{channel}": value for channel, value in row[name].items()}
    # beside the score, since the diverged windows in it are no errors of the model
    out["note"] = diverged_note(row)
    return out | {name: row[name] for name in _ENDS if name in row}


INPUT = "input_"
"""Stands before the name of an input among the columns."""


def columns_of(live: Live) -> tuple[str, ...]:
    """Return the names of the columns of states: u, v, r, heading and position, then the rest."""
    planar, beside = live.moving[: PLANAR.dof], live.moving[PLANAR.dof :]
    return (*planar, "psi", "x", "y", *beside)


def rollout_columns(
    runs: Sequence[FreeRun],
    logs: Sequence[Prepared],
    inputs: Sequence[str] = (),
    bands: Bands | None = None,
) -> Iterator[tuple[Prepared, dict[str, np.ndarray]]]:
    """Yield each log that has a window, with a row for each step of each model's free runs.

    Columns: protocol, model, window, t (s, the log's clock), usable, diverged, then u, v, r, psi,
    x, y (and p and phi of a roll) as measured and with `_hat` as predicted (SI, rad), and the
    inputs that are held over the step after each sample with `input_` before their names. Where
    there are bands, `_low` and `_high` are their pointwise limits; those of x and y are the box
    about the circle that holds the position, and a model without a band has NaN.

    Args:
        inputs: names of the inputs, in the order of their columns.
        bands: by model and protocol; None for none.
    """
    known = bands or {}
    for number, log in enumerate(logs):
        parts: list[dict[str, np.ndarray]] = []
        order = {name: log.live.states.index(name) for name in columns_of(log.live)}
        for run in runs:
            of_log = [i for i, window in enumerate(run.windows) if window.log == number]
            for model, predictions in run.predictions.items():
                band = known.get(model, {}).get(run.protocol)
                for place, i in enumerate(of_log):
                    rows, found = slice(run.windows[i].start, run.windows[i].stop), predictions[i]
                    labels = {"protocol": run.protocol, "model": model, "window": place}
                    tables = {"": log.y[rows], "_hat": found.states}
                    if any(known.values()):
                        low = high = np.full_like(found.states, np.nan)
                        if band is not None:
                            width = band.half_widths(found.states, found.spread)
                            low, high = limits(found.states, width)
                        tables |= {"_low": low, "_high": high}
                    parts.append(
                        {name: np.full(len(found.states), label) for name, label in labels.items()}
                        | {"t": log.log.t[rows], "usable": log.usable[rows]}
                        | {"diverged": np.full(len(found.states), found.diverged)}
                        | {
                            f"{name}{ending}": values[:, column]
                            for ending, values in tables.items()
                            for name, column in order.items()
                        }
                        | {f"{INPUT}{n}": log.w[rows, k] for k, n in enumerate(inputs)}
                    )
        if parts:
            yield log, {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}


def write_rollouts(
    folder: Path,
    runs: Sequence[FreeRun],
    logs: Sequence[Prepared],
    inputs: Sequence[str],
    bands: Bands | None = None,
) -> None:
    """Write one file per log of a split, as `rollout_columns` gives it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    for log, columns in rollout_columns(runs, logs, inputs, bands):
        table = pa.table({name: pa.array(values) for name, values in columns.items()})
        with whole(folder / f"{file_stem(log.log.name)}.parquet") as file:
            # dictionaries of numbers that do not repeat take time and room
            pq.write_table(table, file, compression="zstd", use_dictionary=["protocol", "model"])
