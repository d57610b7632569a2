"""The next trials: candidates flown by the model, and chosen by what they would tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.core.errors import DataError
from residnet.core.layout import POSITION, SURGE, SWAY
from residnet.core.names import STATE
from residnet.data.simulated.environment import Disturbance
from residnet.data.simulated.flying import Craft, Flight, Sea, fly
from residnet.data.simulated.sensors import SensorNoise
from residnet.dynamics.actuated import ActuatedDynamics
from residnet.dynamics.gear import GivenGear, InputShare, commanded
from residnet.identification.models import FittedModel
from residnet.identification.planning.candidates import TrialLimits, candidates
from residnet.identification.planning.information import after, moments, spread, volume_gain
from residnet.manoeuvres import Helm, Manoeuvre
from residnet.training.free_runs.covariance import LeftOpen
from residnet.training.refit_config import RefitConfig


@dataclass(frozen=True)
class Aim:
    """Manoeuvres whose prediction is to become surer, such as those of a booklet.

    Attributes:
        manoeuvres: of them.
        duration: of those that give none, in s.
        initial: states by name that they start from.
    """

    manoeuvres: Sequence[Manoeuvre]
    duration: float
    initial: Mapping[str, float]


@dataclass(frozen=True)
class Trial:
    """A candidate as the model flies it.

    Attributes:
        flight: of the model.
        moments: summed squares of its sensitivities [P, P].
        minutes: that it lasts.
        volume: logarithm by which it shrinks the ellipsoid of the parameters, per minute.
        shrinks: share by which it narrows the intervals of predictions.
        reach: largest distance from the start in m.
    """

    flight: Flight
    moments: Tensor
    minutes: float
    volume: float
    shrinks: float
    reach: float


@dataclass(frozen=True)
class Plan:
    """Candidates, the most telling per minute first, and the trials to run.

    Attributes:
        trials: all candidates within the limits.
        chosen: the trials to run, in their order.
        shrinks: share by which they narrow the intervals of predictions together.
    """

    trials: Sequence[Trial]
    chosen: Sequence[Trial]
    shrinks: float


def plan(
    fitted: FittedModel,
    open_: LeftOpen,
    refit: RefitConfig,
    scales: np.ndarray,
    shares: Mapping[str, InputShare],
    limit: np.ndarray,
    limits: TrialLimits,
    aim: Aim | None = None,
) -> Plan:
    """Return the trials that narrow the intervals of predictions most per minute.

    Predictions are those of the velocities over the manoeuvres of `aim`. Trials are chosen one
    after the other, each given those before it.

    Args:
        fitted: a refitted baseline.
        open_: what its refit has left open.
        refit: settings of the refit.
        scales: of u, v, r [3].
        shares: of the inputs in drive and steer.
        limit: of |u, v, r| [3] beyond which a flight has diverged.
        limits: of the trials.
        aim: what is to be predicted; None for all candidates alike.

    Raises:
        DataError: where no candidate stays within the limits, or nothing is open.
    """
    spec, model = fitted.spec, fitted.model.double()
    horizon = round(refit.horizon / spec.dt)
    divisor = torch.from_numpy(scales)
    flown = [
        (flight, _path(flight, spec.signals.columns))
        for flight in _flights(
            fitted,
            shares,
            Aim(sorted(candidates(limits), key=lambda one: one.kind), limits.time, {}),
        )
    ]
    kept = [(flight, states, w) for flight, (states, w) in flown if _allowed(states, limit, limits)]
    if not kept:
        raise DataError(
            f"none of {len(flown)} candidates stays within the limits; allow more area, speed or"
            " rudder, or less time"
        )
    told = moments(model, [(states, w) for _, states, w in kept], horizon, divisor)
    found = [(flight, states, own) for (flight, states, _), own in zip(kept, told, strict=True)]
    # so many samples hang together that they count as one
    each = spec.dt / refit.correlation / max(open_.square, 1e-12)
    goal = told.sum(dim=0)
    if aim is not None:
        paths = [_path(one, spec.signals.columns) for one in _flights(fitted, shares, aim)]
        goal = moments(model, paths, horizon, divisor).sum(dim=0)
    before = spread(open_.covariance, goal)
    if not (np.isfinite(before) and before > 0.0):
        raise DataError(
            f"model {fitted.name}: its refit leaves nothing open of the manoeuvres to predict, or"
            f" it cannot fly them for {refit.horizon:g} s; add logs that cover their speeds and"
            " rudder angles, or shorten refit.horizon"
        )
    trials = []
    for flight, states, own in found:
        minutes = (len(states) - 1) * spec.dt / 60.0
        later = spread(after(open_.covariance, each * own), goal)
        trials.append(
            Trial(
                flight,
                each * own,
                minutes,
                volume_gain(open_.covariance, each * own) / minutes,
                1.0 - later / before,
                _reach(states),
            )
        )
    trials.sort(key=lambda trial: -trial.shrinks / trial.minutes)
    chosen = _greedy(trials, open_.covariance, goal, limits.count)
    total = sum((trial.moments for trial in chosen), torch.zeros_like(goal))
    return Plan(trials, chosen, 1.0 - spread(after(open_.covariance, total), goal) / before)


def _greedy(trials: Sequence[Trial], covariance: Tensor, goal: Tensor, count: int) -> list[Trial]:
    """Return so many trials, each the most telling per minute after those before it."""
    chosen: list[Trial] = []
    now = covariance
    for _ in range(min(count, len(trials))):
        width = spread(now, goal)

        def gain(trial: Trial, now: Tensor = now, width: float = width) -> float:
            return (width - spread(after(now, trial.moments), goal)) / trial.minutes

        best = max((trial for trial in trials if trial not in chosen), key=gain)
        chosen.append(best)
        now = after(now, best.moments)
    return chosen


def _flights(fitted: FittedModel, shares: Mapping[str, InputShare], aim: Aim) -> list[Flight]:
    spec, model = fitted.spec, fitted.model.double()
    gear = GivenGear(shares, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.columns, spec.hold, gear)
    start = gear.approach(1)
    # trials begin at a speed in the middle of what the model knows
    start[:, SURGE] = 0.5 * (max(spec.low[0], 0.0) + spec.high[0])
    for name, value in aim.initial.items():
        start[:, actuated.state.index(name)] = float(value)
    craft = Craft(
        fitted.name, actuated, Helm(gear.demand, actuated.state, gear.inputs), gear.commands, start
    )
    sea = Sea(None, Disturbance(), SensorNoise(), 0)
    return fly(craft, list(aim.manoeuvres), sea, aim.duration, spec.dt)


def _path(flight: Flight, columns: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Return states [T + 1, 6] and inputs [T, m] of a flight."""
    motion = flight.motion
    known: dict[str, Any] = motion.channels
    still = np.zeros(len(motion))
    # what nobody commands, such as the wind, is left at rest
    w = [known.get(name, known.get(commanded(name), still)) for name in columns]
    states = torch.from_numpy(motion.stack(STATE))
    return states, torch.from_numpy(np.stack(w, axis=1))[:-1]


def _reach(states: Tensor) -> float:
    return float((states[:, POSITION] - states[0, POSITION]).norm(dim=1).max())


def _allowed(states: Tensor, limit: np.ndarray, limits: TrialLimits) -> bool:
    """Whether a flight stays sound and within the limits."""
    fastest = states[:, 3:6].abs().amax(0).numpy()
    speed = float(torch.hypot(states[:, SURGE], states[:, SWAY]).max())
    return bool(
        (fastest <= limit).all()
        and (limits.area is None or _reach(states) <= limits.area)
        and (limits.speed is None or speed <= limits.speed)
    )
