"""What makes a model unsound inside its training data: damping of the wrong sign, running away.

Both are looked at where the logs have been, at recorded states and inputs. What a model does at
combinations that no log holds is reported by `residnet.judge.verdict.sanity`, and speaks against
no choice.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from residnet.core.layout import POSE, RANGE_VELOCITIES, SURGE, VELOCITIES
from residnet.core.names import VELOCITY
from residnet.data.prepare import Prepared
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout, scripted
from residnet.dynamics.store import ModelSpec
from residnet.judge.verdict.sanity_points import acceleration

_POINTS = 90
_NEGLIGIBLE = 0.05
_LONG_RUN = 300.0
_PAUSE = 10.0
_SETTLED = 1e-4


@dataclass(frozen=True)
class TrainingPoints:
    """Recorded states and inputs of training logs.

    Attributes:
        x: states [K, 6] with the pose at zero.
        w: inputs [K, m].
        longest: how long the longest log lasts in s.
    """

    x: Tensor
    w: Tensor
    longest: float


def training_points(logs: Sequence[Prepared]) -> TrainingPoints:
    """Return recorded points spread evenly over the speeds, and those of extreme inputs."""
    # all states of large data would fill the memory: only those of the points are put together
    used = [np.flatnonzero(log.usable) for log in logs]
    speed = np.concatenate(
        [np.hypot(*log.smooth[at, SURGE : SURGE + 2].T) for log, at in zip(logs, used, strict=True)]
    )
    order = np.argsort(speed, kind="stable")
    even = order[np.linspace(0, len(order) - 1, min(_POINTS, len(order))).round().astype(int)]
    extreme = []
    for column in range(logs[0].w.shape[1]):
        w = np.concatenate([log.w[at, column] for log, at in zip(logs, used, strict=True)])
        extreme += [w.argmin(), w.argmax()]
    rows = np.union1d(even, np.array(extreme, dtype=even.dtype))
    ends = np.cumsum([len(at) for at in used])
    picked = [
        (log, at[rows[(rows >= end - len(at)) & (rows < end)] - (end - len(at))])
        for log, at, end in zip(logs, used, ends, strict=True)
    ]
    x = np.concatenate([log.smooth[at] for log, at in picked])
    w = np.concatenate([log.w[at] for log, at in picked])
    x[:, POSE] = 0.0
    longest = max(float(log.log.t[-1] - log.log.t[0]) for log in logs)
    return TrainingPoints(torch.from_numpy(x), torch.from_numpy(w), longest)


def wrong_damping(model: HybridDynamics, points: TrainingPoints) -> str:
    """Return in a few words which damping has the wrong sign; empty where none has.

    The slopes du_dot/du, dv_dot/dv and dr_dot/dr are taken at the points, the memory settled. None
    may be positive at more than half of them, unless it is negligible beside what it is elsewhere.

    Args:
        model: in float64 and evaluation mode.
        points: of the training logs.
    """
    x = points.x.clone().requires_grad_()
    # a model may depend on no velocity at all
    nu_dot = acceleration(model, x, points.w) + 0.0 * x[:, VELOCITIES]
    slopes = np.stack(
        [
            torch.autograd.grad(nu_dot[:, i].sum(), x, retain_graph=True)[0][:, SURGE + i].numpy()
            for i in range(len(VELOCITY))
        ],
        axis=1,
    )
    middle, size = np.median(slopes, axis=0), np.quantile(np.abs(slopes), 0.9, axis=0)
    said = [
        f"d{name}′/d{name} {middle[i]:+.2g} 1/s, positive at {(slopes[:, i] > 0).mean():.0%} of it"
        for i, name in enumerate(VELOCITY)
        if middle[i] > _NEGLIGIBLE * size[i]
    ]
    return f"its damping has the wrong sign in most of the data ({'; '.join(said)})" if said else ""


def runaway(
    spec: ModelSpec, model: HybridDynamics, points: TrainingPoints, divergence: float
) -> str:
    """Return in a few words how the model runs away from recorded points; empty where it does not.

    Each point's inputs are held for 300 s, or as long as the longest log where that is longer.

    Args:
        spec: of the model; the largest training velocities are taken from it.
        model: in float64 and evaluation mode.
        points: of the training logs.
        divergence: a velocity beyond this many times its largest training value has run away.
    """
    reach = np.maximum(np.abs(spec.low), np.abs(spec.high))[RANGE_VELOCITIES]
    limit = torch.from_numpy(reach).clamp(min=1e-9)
    x, s = points.x, model.initial_state(len(points.x)).double()
    before, pause = x[:, VELOCITIES], max(round(_PAUSE / model.dt), 1)
    steps = round(max(_LONG_RUN, points.longest) / model.dt)
    held = points.w.unsqueeze(1).expand(-1, pause, -1)
    # where the vessel is says nothing of how fast it is
    alone = copy.deepcopy(model)
    alone.positions = False
    run = scripted(Rollout(alone), steps)
    with torch.no_grad():
        for k in range(pause, steps + 1, pause):
            states, _, s = run(x, held, s)
            x = states[:, -1]
            ratio = torch.nan_to_num(x[:, VELOCITIES].abs() / limit, nan=math.inf).amax(1)
            if float(ratio.max()) > divergence:
                row = int(ratio.argmax())
                inputs = ", ".join(
                    f"{name} {float(value):.3g}"
                    for name, value in zip(spec.signals.columns, points.w[row], strict=True)
                )
                return (
                    f"it runs away within {k * model.dt:.0f} s from a recorded state with recorded"
                    f" inputs ({inputs})"
                )
            if float(((x[:, VELOCITIES] - before).abs() / limit).max()) < _SETTLED:
                break
            before = x[:, VELOCITIES]
    return ""
