"""Tuning of linear heading controllers over a spread of vessels.

The gains are the fastest in the worst case among those that keep an overshoot limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from residnet.control.heading.controllers import LinearRows, Steering, TunedConfig
from residnet.control.heading.steering import fly
from residnet.core.errors import FitError


@dataclass(frozen=True)
class TuningTask:
    """What controllers are tuned for.

    Attributes:
        heading: change [rad].
        variations: of the vessel [V, 3], nominal first.
        overshoot: limit [rad] over all variations.
        band: that the change ends within [rad].
        duration: of a flight [s].
        bias, bias_error, bias_time: under a constant rudder bias [rad] the error [rad] of
            controllers with an integral after this time [s].
    """

    heading: float
    variations: Tensor
    overshoot: float
    band: float
    duration: float
    bias: float
    bias_error: float
    bias_time: float


@dataclass(frozen=True)
class Tuned:
    """Tuned parameters with their gains, worst settling time [s] and overshoot [rad].

    It counts the candidates that were tried.
    """

    parameters: dict[str, float]
    gains: dict[str, float]
    settling: float
    overshoot: float
    tried: int


def tune(
    config: TunedConfig, steering: Steering, task: TuningTask, points: int = 400, rounds: int = 6
) -> Tuned:
    """Search the missing parameters on grids around the best so far.

    Each grid is a fifth of the one before.

    Raises:
        FitError: where no candidate keeps the limits.
    """
    missing = [name for name, value in config.parameters().items() if value is None]
    span = {
        name: (torch.tensor(axis.low).log(), torch.tensor(axis.high).log())
        for name, axis in config.axes(steering.turning).items()
    }
    count = max(round(points ** (1.0 / max(len(missing), 1))), 2) if missing else 1
    best: tuple[float, dict[str, float], float, float] | None = None
    tried = 0
    for _ in range(rounds if missing else 1):
        grid = (
            torch.meshgrid(
                *[
                    torch.linspace(float(span[name][0]), float(span[name][1]), count)
                    for name in missing
                ],
                indexing="ij",
            )
            if missing
            else ()
        )
        parameters = {
            name: values.double().exp().flatten()
            for name, values in zip(missing, grid, strict=True)
        }
        size = count ** len(missing)
        fixed = {
            name: torch.full((size,), value, dtype=torch.float64)
            for name, value in config.parameters().items()
            if value is not None
        }
        cost, settling, over = _judge(config, steering, task, parameters | fixed)
        tried += size
        place = int(cost.argmin())
        if torch.isfinite(cost[place]) and (best is None or float(cost[place]) < best[0]):
            found = {name: float(values[place]) for name, values in (parameters | fixed).items()}
            best = (float(cost[place]), found, float(settling[place]), float(over[place]))
        if best is None:
            count = round(1.5 * count)
            continue
        for name in missing:
            low, high = span[name]
            middle, half = torch.tensor(best[1][name]).log(), 0.1 * (high - low)
            span[name] = (middle - half, middle + half)
    if best is None:
        raise FitError(
            f"no {config.model_dump()['kind']} controller of {tried} tried keeps the overshoot"
            f" within {task.overshoot:.3g} rad over the spread; allow more overshoot or narrow the"
            " spread"
        )
    kp, kd, ki = config.gains(
        {name: torch.tensor(value) for name, value in best[1].items()}, steering.turning
    )
    return Tuned(
        best[1], {"kp": float(kp), "kd": float(kd), "ki": float(ki)}, best[2], best[3], tried
    )


def _judge(
    config: TunedConfig, steering: Steering, task: TuningTask, parameters: dict[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the cost, worst settling time [s] and worst overshoot [rad] of each candidate [C].

    An infinite cost breaks a limit.
    """
    gains = config.gains(parameters, steering.turning)
    vessels, size = len(task.variations), len(gains[0])
    repeated = tuple(gain.repeat_interleave(vessels) for gain in gains)
    rows = LinearRows(steering, (repeated[0], repeated[1], repeated[2]))
    heading = torch.full((size * vessels,), task.heading)
    flights = fly(
        steering.vessel,
        rows,
        heading,
        task.variations.repeat(size, 1),
        dt=steering.dt,
        duration=task.duration,
    )
    settled, over = (
        values.reshape(size, vessels)
        for values in (flights.settled(task.band).double(), flights.overshoot())
    )
    cost = settled.amax(1) + 0.01 * settled.mean(1)
    cost = torch.where(over.amax(1) <= task.overshoot, cost, torch.inf)
    if bool((gains[2] > 0).any()):
        bias = torch.tensor([[1.0, 1.0, task.bias]]).expand(size, -1)
        slow = LinearRows(steering._replace(dt=0.1), gains)
        pushed = fly(
            steering.vessel,
            slow,
            torch.full((size,), task.heading),
            bias,
            dt=0.1,
            duration=task.bias_time,
        )
        cost = torch.where(pushed.error[:, -1].abs() <= task.bias_error, cost, torch.inf)
    return cost, settled.amax(1), over.amax(1)
