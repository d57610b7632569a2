"""Whether logs contradict a model that is unstable on a course.

A full hull may be unstable in truth, so that an unstable model is no fault by itself. It is one
where the vessel, its inputs held, settled from a disturbance such as the entry of a turn, and
stayed so for several times as long as the model's disturbances take to grow. A straight run that
nothing disturbs proves nothing: a simulated hull keeps its course on it, stable or not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from residnet.core.layout import SURGE, SWAY, VELOCITIES, YAW_RATE
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.judge.verdict.sanity import growth_rate
from residnet.judge.verdict.sanity_points import OperatingPoint

_HELD = 0.02
_GROWN = 20.0
_STAYED = 3.0
_DECAYED = 3.0
_MOST = 20
_SETTLING = 0.25


@dataclass(frozen=True)
class SteadyRun:
    """A stretch of a log with held inputs.

    Attributes:
        log: name of the log.
        seconds: that it lasts, its settling left out.
        x: mean state [6] with the pose at zero.
        w: mean inputs [m].
        decay: how many times farther the lateral velocities lie from their last mean when the
            stretch begins than in the end.
        growth: how many times farther the lateral velocities lie from their first third's mean in
            the last third than in the first.
    """

    log: str
    seconds: float
    x: np.ndarray
    w: np.ndarray
    decay: float
    growth: float


def steady_runs(logs: Sequence[Prepared], step: float, shortest: float = 5.0) -> list[SteadyRun]:
    """Return the stretches of logs whose inputs hold within 2 % of their ranges.

    The first quarter of each is left out, in which the motion settles.

    Args:
        logs: prepared logs.
        step: of their grid in s.
        shortest: stretches of fewer seconds are left out.
    """
    used = [log.w[log.usable] for log in logs if log.usable.any()]
    ranges = np.max([w.max(0) for w in used], 0) - np.min([w.min(0) for w in used], 0)
    tolerance = _HELD * np.maximum(ranges, 1e-12)
    out = []
    for log in logs:
        for begin, end in _held(log, tolerance, round(shortest / step)):
            rows = slice(begin + int(_SETTLING * (end - begin)), end)
            y = log.smooth[rows]
            x = np.concatenate((np.zeros(VELOCITIES.start), y[:, VELOCITIES].mean(0)))
            lateral = y[:, SWAY : YAW_RATE + 1]
            third = max(len(lateral) // 3, 1)
            left = np.abs(lateral[-third:] - lateral[-third:].mean(0)).mean(0)
            entry = log.smooth[begin : begin + max(third // 10, 1), SWAY : YAW_RATE + 1]
            began = np.abs(entry - lateral[-third:].mean(0)).mean(0)
            decay = float((began / np.maximum(left, 1e-9)).max())
            apart = np.abs(lateral - lateral[:third].mean(0))
            first, last = apart[:third].mean(0), apart[-third:].mean(0)
            growth = float((last / np.maximum(first, 1e-9)).max())
            seconds = len(y) * step
            out.append(SteadyRun(log.log.name, seconds, x, log.w[rows].mean(0), decay, growth))
    return out


def _held(log: Prepared, tolerance: np.ndarray, shortest: int) -> Iterator[tuple[int, int]]:
    """First sample and end of each stretch whose inputs stay within a tolerance [m] of its first.

    Stretches follow each other and do not overlap.
    """
    for begin, end in zip(*stretches(log.piece), strict=True):
        start = int(begin)
        while end - start >= shortest:
            away = (np.abs(log.w[start:end] - log.w[start]) > tolerance).any(1)
            stop = start + (int(away.argmax()) if away.any() else end - start)
            if stop - start >= shortest:
                yield start, stop
            start = max(stop, start + 1)


def contradiction(model: HybridDynamics, runs: Sequence[SteadyRun]) -> str:
    """Return in a few words how logs contradict an unstable model; empty where they do not.

    A disturbance of the model, linearised about the mean of a steady run, would have grown
    twentyfold over it; the vessel had settled from three times its deviations at the end, and these
    did not even grow threefold. The twenty longest of such runs are looked at.

    Args:
        model: in float64 and evaluation mode.
        runs: of the training logs, see `steady_runs`.
    """
    telling = [run for run in runs if run.decay > _DECAYED and run.growth < _STAYED]
    for run in sorted(telling, key=lambda run: -run.seconds)[:_MOST]:
        x, w = torch.from_numpy(run.x), torch.from_numpy(run.w)
        rate = growth_rate(model, OperatingPoint("", float(run.x[SURGE]), x, w, True))
        if rate * run.seconds > math.log(_GROWN):
            return (
                "it is unstable where the logs are not (a disturbance would double in"
                f" {math.log(2.0) / rate:.2g} s; log {run.log} runs steadily for"
                f" {run.seconds:.0f} s)"
            )
    return ""
