"""Whether logs contradict a model that is unstable on a course.

A full hull may be unstable in truth, so that an unstable model is no fault by itself. It is one
where the vessel, its inputs held, settled from a disturbance such as the entry of a turn, and
stayed so for several times as long as the model's disturbances take to grow. A straight run that
nothing disturbs proves nothing: a simulated hull keeps its course on it, stable or not.

Disturbances have the size that they had in the log. A model of logs whose wind nobody measured may
swing a little in a steady turn, as the vessel did.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from residnet.core.layout import LATERAL, SURGE, VELOCITIES
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.judge.verdict.sanity import growth_rate
from residnet.judge.verdict.sanity_points import OperatingPoint, settled_memory

_HELD = 0.02
_GROWN = 20.0
_STAYED = 3.0
_DECAYED = 3.0
_MOST = 20
_SETTLING = 0.25
_SIGNS = ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0))


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
        scatter: standard deviations of the lateral velocities [2].
    """

    log: str
    seconds: float
    x: np.ndarray
    w: np.ndarray
    decay: float
    growth: float
    scatter: np.ndarray


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
            lateral = y[:, LATERAL]
            third = max(len(lateral) // 3, 1)
            left = np.abs(lateral[-third:] - lateral[-third:].mean(0)).mean(0)
            entry = log.smooth[begin : begin + max(third // 10, 1), LATERAL]
            began = np.abs(entry - lateral[-third:].mean(0)).mean(0)
            decay = float((began / np.maximum(left, 1e-9)).max())
            apart = np.abs(lateral - lateral[:third].mean(0))
            first, last = apart[:third].mean(0), apart[-third:].mean(0)
            growth = float((last / np.maximum(first, 1e-9)).max())
            seconds = len(y) * step
            w, scatter = log.w[rows].mean(0), lateral.std(0)
            out.append(SteadyRun(log.log.name, seconds, x, w, decay, growth, scatter))
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
    did not even grow threefold. The model itself, begun with the vessel's deviations, ends farther
    than three of them from where the vessel stayed. The twenty longest of such runs are looked at.

    Args:
        model: in float64 and evaluation mode.
        runs: of the training logs, see `steady_runs`.
    """
    telling = [run for run in runs if run.decay > _DECAYED and run.growth < _STAYED]
    for run in sorted(telling, key=lambda run: -run.seconds)[:_MOST]:
        x, w = torch.from_numpy(run.x), torch.from_numpy(run.w)
        rate = growth_rate(model, OperatingPoint("", float(run.x[SURGE]), x, w, True))
        if rate * run.seconds > math.log(_GROWN) and _departure(model, run) > _STAYED:
            return (
                "it is unstable where the logs are not (a disturbance would double in"
                f" {math.log(2.0) / rate:.2g} s; log {run.log} runs steadily for"
                f" {run.seconds:.0f} s)"
            )
    return ""


def _departure(model: HybridDynamics, run: SteadyRun) -> float:
    """How far the model ends from a steady run, in deviations of the vessel; infinite out of range.

    It begins with deviations of the vessel's size; the mean over the last third is looked at.
    """
    scatter = torch.from_numpy(np.maximum(run.scatter, 1e-9))
    begin = torch.from_numpy(run.x).repeat(len(_SIGNS), 1)
    begin[:, LATERAL] += torch.tensor(_SIGNS, dtype=torch.float64) * scatter
    w = torch.from_numpy(run.w).expand(len(begin), -1)
    memory = settled_memory(model, begin, w)
    alone = copy.deepcopy(model)
    alone.positions = False
    steps = max(round(run.seconds / model.dt), 3)
    with torch.no_grad():
        states, _, _ = Rollout(alone)(begin, w[:, None].expand(-1, steps, -1), memory)
    away = states[:, -(steps // 3) :, LATERAL] - torch.from_numpy(run.x)[LATERAL]
    return float(torch.nan_to_num(away.abs() / scatter, nan=math.inf).mean(1).max())
