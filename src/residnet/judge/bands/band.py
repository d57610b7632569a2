"""The band of a model's free runs under one protocol: half widths against the horizon."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.dynamics.store import BandTable
from residnet.judge.bands.activity import MEASURES, Activity
from residnet.judge.bands.channels import CHANNELS

_MOST = 2.0
"""Largest logarithm of the factor by which liveliness changes a width."""


@dataclass(frozen=True)
class Band:
    """Half widths of the errors of a model's free runs.

    A half width at horizon k is `width[k]` times a factor by how lively the run has been so far.

    Attributes:
        level: share of the samples that it is to hold.
        step: in s.
        steps: horizons of the tables, numbers of steps [G], ascending.
        width: half widths of a run of usual liveliness [G, 5], SI and rad.
        plain: half widths that take every run for the same [G, 5].
        whole: factors [5] by which a band grows that is to hold a whole run.
        constant: half widths [5] that are the same at all horizons, for comparison.
        unit: root mean square errors of `zero` [5], which scores are given in.
        activity: measures of liveliness; None where the band knows none.
        slope: logarithm of the factor by each measure [6, 5].
        logs: number of logs that calibrated it.
        number: of independent scores among them.
        cautions: whole sentences about what the band does not promise.
    """

    level: float
    step: float
    steps: np.ndarray
    width: np.ndarray
    plain: np.ndarray
    whole: np.ndarray
    constant: np.ndarray
    unit: np.ndarray
    activity: Activity
    slope: np.ndarray
    logs: int
    number: float
    cautions: tuple[str, ...] = ()

    def half_widths(self, states: np.ndarray) -> np.ndarray:
        """Return half widths [L, 5] along a run with predicted states [L + 1, 6].

        Beyond the longest calibrated horizon they grow in proportion to time.
        """
        z = self.activity.of_run(states, self.step)
        return np.asarray(self.tabled(self.width, len(z)) * factor(z, self.slope))

    def tabled(self, table: np.ndarray, count: int) -> np.ndarray:
        """Return a table [G, 5] at steps 1 to `count`, [count, 5]."""
        k = np.arange(1, count + 1)
        found = np.stack([np.interp(k, self.steps, column) for column in table.T], axis=1)
        return np.asarray(found * np.maximum(k / self.steps[-1], 1.0)[:, None])

    @property
    def horizon(self) -> float:
        """The longest calibrated horizon in s."""
        return float(self.steps[-1] * self.step)

    def table(self) -> BandTable:
        """Return what an exported model carries: half widths that take every run for the same."""
        return BandTable.model_validate(
            {
                "level": self.level,
                "steps": self.steps.tolist(),
                **{
                    name: column.tolist()
                    for name, column in zip(CHANNELS, self.plain.T, strict=True)
                },
                "logs": self.logs,
                "cautions": self.cautions,
            }
        )

    def content(self) -> dict[str, Any]:
        """Return the band as JSON takes it."""

        def named(rows: np.ndarray) -> dict[str, list[float]]:
            return {name: rows[:, i].tolist() for i, name in enumerate(CHANNELS)}

        def single(values: np.ndarray) -> dict[str, float]:
            return dict(zip(CHANNELS, map(float, values), strict=True))

        return {
            "level": self.level,
            "step": self.step,
            "horizon": self.horizon,
            "logs": self.logs,
            "independent_scores": self.number,
            "cautions": list(self.cautions),
            "steps": self.steps.tolist(),
            "half_width": named(self.width),
            "half_width_of_any_run": named(self.plain),
            "whole_run_factor": single(self.whole),
            "constant_half_width": single(self.constant),
            "score_unit": single(self.unit),
            "activity": {
                "measures": list(MEASURES),
                "floor": self.activity.floor.tolist(),
                "centre": self.activity.centre.tolist(),
                "spread": self.activity.spread.tolist(),
                "slope": named(self.slope),
            },
        }

    @classmethod
    def read(cls, content: Mapping[str, Any]) -> Band:
        """Return the band from what `content` gave."""

        def table(name: str) -> np.ndarray:
            return np.array([content[name][channel] for channel in CHANNELS]).T

        def single(name: str) -> np.ndarray:
            return np.array([content[name][channel] for channel in CHANNELS])

        activity = content["activity"]
        return cls(
            float(content["level"]),
            float(content["step"]),
            np.array(content["steps"]),
            table("half_width"),
            table("half_width_of_any_run"),
            single("whole_run_factor"),
            single("constant_half_width"),
            single("score_unit"),
            Activity(*(np.array(activity[key]) for key in ("floor", "centre", "spread"))),
            np.array([activity["slope"][channel] for channel in CHANNELS]).T,
            int(content["logs"]),
            float(content["independent_scores"]),
            tuple(content["cautions"]),
        )


def factor(z: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Return the factors [..., 5] of half widths at measures of liveliness [..., 6]."""
    return np.asarray(np.exp(np.clip(z @ slope, -_MOST, _MOST)))


Bands = Mapping[str, Mapping[str, Band]]
"""Bands by model and protocol."""


def covered(error: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return 1 where an error [..., 5] is within its half width, 0 beyond, NaN where unscored."""
    return np.asarray(np.where(np.isfinite(error), error <= width, np.nan))


def interval_score(error: np.ndarray, width: np.ndarray, level: float) -> np.ndarray:
    """Return the interval score [..., 5] of half widths, NaN where nothing is scored.

    Source: Gneiting and Raftery (2007), eq. (43): the width, and what lies outside by 2 / (1 -
    level).
    """
    return np.asarray(2.0 * width + 2.0 / (1.0 - level) * np.maximum(error - width, 0.0))


def worst(errors: Sequence[np.ndarray], widths: Sequence[np.ndarray]) -> np.ndarray:
    """Return the largest error of each run in its half widths [W, 5]; NaN where unscored."""
    out = np.full((len(errors), len(CHANNELS)), np.nan)
    for i, (error, width) in enumerate(zip(errors, widths, strict=True)):
        seen = np.isfinite(error)
        ratio = np.where(seen, error / width, -np.inf).max(axis=0)
        out[i] = np.where(seen.any(axis=0), ratio, np.nan)
    return out
