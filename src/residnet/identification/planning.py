"""Which manoeuvre to run next: what each would tell about the parameters of a refitted baseline."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config, Metres, MetresPerSecond, Seconds
from residnet.core.errors import DataError, UsageError
from residnet.core.layout import ALIVE, MOVING, POSITION, SURGE, SWAY, Live
from residnet.data.simulated import Craft, Disturbance, Flight, Sea, SensorNoise, fly
from residnet.dynamics.actuated import ActuatedDynamics, GivenActuators, InputShare, commanded
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.identification.fitter import FittedModel
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.open_loop import AccelerationDeceleration, MultiSine, ThreeTwoOneOne
from residnet.physics.signals import SignalsConfig
from residnet.training.left_out import LeftOpen
from residnet.training.refit import RefitConfig, parametric, sensitivities


@torch.no_grad()
def moments(
    model: HybridDynamics, runs: Sequence[tuple[Tensor, Tensor]], horizon: int, scales: Tensor
) -> Tensor:
    """Return the sums over each run's samples of squared sensitivities of what moves, [R, P, P].

    They are in scales. Each run is cut into free runs of `horizon` steps, each from its own
    measured state, as a refit takes it; what is left at the end does not count.

    Args:
        model: a baseline without a head.
        runs: states [T + 1, 3 + n] and inputs held over each step [T, m] of R runs.
        horizon: steps of the free runs of a refit.
        scales: of what moves [n].
    """
    places = [
        (run, k * horizon) for run, (_, w) in enumerate(runs) for k in range(len(w) // horizon)
    ]
    size = len(parametric(model).free_indices())
    out = torch.zeros(len(runs), size, size, dtype=scales.dtype)
    if not places:
        return out
    number = torch.tensor([run for run, _ in places])
    x = torch.stack([runs[run][0][start : start + horizon] for run, start in places])
    w = torch.stack([runs[run][1][start : start + horizon] for run, start in places])
    for _, s in sensitivities(model, x, w):
        for seen in s[:, :, 1:] / scales[:, None]:
            out.index_add_(0, number, seen.transpose(1, 2) @ seen)
    return out


def after(covariance: Tensor, information: Tensor) -> Tensor:
    """Return the covariance [P, P] once data of some information [P, P] are in.

    Parameters that have no covariance stay as they are.
    """
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    left: Tensor = covariance @ torch.linalg.inv(eye + information @ covariance)
    return left


def volume_gain(covariance: Tensor, information: Tensor) -> float:
    """Return by how much the logarithm of the ellipsoid's volume shrinks (D-optimality)."""
    eye = torch.eye(len(covariance), dtype=covariance.dtype)
    return 0.5 * float(torch.linalg.slogdet(eye + information @ covariance)[1])


def spread(covariance: Tensor, goal: Tensor) -> float:
    """Return the root mean square uncertainty of what a goal [P, P] weighs (A-optimality)."""
    return float((goal * covariance).sum().clamp(min=0.0).sqrt())


_SIDES = {"port": 1.0, "stbd": -1.0, "starboard": -1.0, "left": 1.0, "right": -1.0}
"""Which way more of a side's thrust turns the vessel."""


class TrialLimits(Config):
    """What a trial may use.

    Attributes:
        time: that each candidate lasts, in s.
        area: largest distance from the start, in m; none where not given.
        speed: largest speed in m/s; none where not given.
        rudder: largest share of full steer.
        count: number of trials to choose.
    """

    time: Seconds = Field(default=120.0, gt=0)
    area: Metres | None = Field(default=None, gt=0)
    speed: MetresPerSecond | None = Field(default=None, gt=0)
    rudder: float = Field(default=1.0, gt=0, le=1)
    count: int = Field(default=3, ge=1)


def candidates(limits: TrialLimits, live: Live = ALIVE) -> list[Manoeuvre]:
    """Return zigzags, turns, 3-2-1-1, multi-sines and speed changes at several drives.

    Those that wait for a heading are for a vessel that turns, and several drives and changes of
    speed for one that moves ahead.
    """
    out: list[Manoeuvre] = []
    time, full = limits.time, limits.rudder
    early: dict[str, Any] = {"duration": time, "start": 0.05 * time}
    late: dict[str, Any] = {"duration": time, "start": 0.1 * time}
    for drive in (0.4, 0.7, 1.0) if live.moves else (1.0,):
        per = f"drive_{round(100 * drive)}"
        if live.turns:
            out += [
                Zigzag(
                    name=f"zigzag_{angle:.0f}_steer_{round(100 * share * full)}_{per}",
                    drive=drive,
                    steer=share * full,
                    heading=math.radians(angle),
                    **late,
                )
                for angle in (10.0, 20.0)
                for share in (0.5, 1.0)
            ]
            out += [
                TurningCircle(name=f"turn_{word}_{per}", drive=drive, steer=side * full, **late)
                for word, side in (("starboard", 1.0), ("port", -1.0))
            ]
        out += [
            ThreeTwoOneOne(
                name=f"3211_{unit * time:.0f}s_{per}",
                drive=drive,
                steer=full,
                unit=unit * time,
                **early,
            )
            for unit in (0.02, 0.05)
        ]
        out.append(
            MultiSine(
                name=f"multi_sine_{per}",
                drive=0.5 * drive,
                drive_amplitude=0.5 * drive,
                steer_amplitude=full,
                band=(2.0 / time, 20.0 / time),
                duration=time,
            )
        )
    if live.moves:
        times, levels = tuple(0.25 * time * k for k in range(4)), (1.0, 0.0, 0.6, 0.2)
        out.append(
            AccelerationDeceleration(
                name="speed_changes", times=times, levels=levels, duration=time
            )
        )
    return out


def shares_of(spec: ModelSpec) -> Mapping[str, InputShare]:
    """Return how the inputs of a model follow drive and steer, within what its data have seen.

    Raises:
        UsageError: where no input can be told to steer.
    """
    units, ranges, out = spec.signals.units(), spec.ranges, {}
    for name in spec.signals.inputs:
        most = max(map(abs, ranges[name]))
        side = next((sign for word, sign in _SIDES.items() if word in name.split("_")), 0.0)
        if units.get(name) == "rad" or name == "tau_n":
            out[name] = InputShare(steer=most, limit=most)
        elif side:
            out[name] = InputShare(drive=0.6 * most, steer=0.6 * side * most, limit=most)
        else:
            out[name] = InputShare(drive=most, limit=most)
    if spec.signals.live.turns and not any(share.steer for share in out.values()):
        raise UsageError(
            f"model {spec.name}: none of {', '.join(spec.signals.inputs)} is known to steer; say"
            " how inputs follow drive and steer in the run's `booklet.inputs`"
        )
    return out


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
        open_: what its refit has left open.
        scales: of what moves [n].
        shares: of the inputs in drive and steer.
        limit: of what moves [n] beyond which a flight has diverged.
        aim: what is to be predicted; None for all candidates alike.

    Raises:
        DataError: where no candidate stays within the limits, or nothing is open.
    """
    spec, model = fitted.spec, fitted.model.double()
    spec.signals.live.require_on_surface("the plan of a trial")
    horizon = round(refit.horizon / spec.dt)
    divisor, offered = torch.from_numpy(scales), candidates(limits, spec.signals.live)
    # those of one kind fly together
    every = Aim(sorted(offered, key=lambda one: one.kind), limits.time, {})
    flown = [(flight, *_path(flight, spec.signals)) for flight in _flights(fitted, shares, every)]
    kept = [one for one in flown if _allowed(one[1], limit, limits)]
    if not kept:
        raise DataError(
            f"none of {len(flown)} candidates stays within the limits; allow more area, speed or"
            " rudder, or less time"
        )
    told = moments(model, [(states, w) for _, states, w in kept], horizon, divisor)
    # so many samples hang together that they count as one
    each = spec.dt / refit.correlation / max(open_.square, 1e-12)
    goal = told.sum(dim=0)
    if aim is not None:
        paths = [_path(one, spec.signals) for one in _flights(fitted, shares, aim)]
        goal = moments(model, paths, horizon, divisor).sum(dim=0)
    before = spread(open_.covariance, goal)
    if not (np.isfinite(before) and before > 0.0):
        raise DataError(
            f"model {fitted.name}: its refit leaves nothing open of the manoeuvres to predict, or"
            f" it cannot fly them for {refit.horizon:g} s; add logs that cover their speeds and"
            " rudder angles, or shorten refit.horizon"
        )
    trials = []
    for (flight, states, _), own in zip(kept, told, strict=True):
        minutes, told_of = (len(states) - 1) * spec.dt / 60.0, each * own
        volume = volume_gain(open_.covariance, told_of) / minutes
        shrinks = 1.0 - spread(after(open_.covariance, told_of), goal) / before
        trials.append(Trial(flight, told_of, minutes, volume, shrinks, _reach(states)))
    trials.sort(key=lambda trial: -trial.shrinks / trial.minutes)
    chosen: list[Trial] = []
    now = open_.covariance
    for _ in range(min(limits.count, len(trials))):
        width = spread(now, goal)

        def gain(trial: Trial, now: Tensor = now, width: float = width) -> float:
            return (width - spread(after(now, trial.moments), goal)) / trial.minutes

        best = max((trial for trial in trials if trial not in chosen), key=gain)
        chosen.append(best)
        now = after(now, best.moments)
    total = sum((trial.moments for trial in chosen), torch.zeros_like(goal))
    return Plan(trials, chosen, 1.0 - spread(after(open_.covariance, total), goal) / before)


def _flights(fitted: FittedModel, shares: Mapping[str, InputShare], aim: Aim) -> list[Flight]:
    spec, model = fitted.spec, fitted.model.double()
    gear = GivenActuators(shares, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.columns, spec.hold, gear)
    start = actuated.approach(1)
    # trials begin at a speed in the middle of what the model knows
    start[:, SURGE] = 0.5 * (max(spec.low[0], 0.0) + spec.high[0])
    for name, value in aim.initial.items():
        start[:, actuated.state.index(name)] = float(value)
    craft = Craft(
        fitted.name, actuated, Helm(gear.demand, actuated.state, gear.inputs), gear.commands, start
    )
    sea = Sea(None, Disturbance(), SensorNoise(), 0)
    return fly(craft, list(aim.manoeuvres), sea, aim.duration, spec.dt)


def _path(flight: Flight, signals: SignalsConfig) -> tuple[Tensor, Tensor]:
    """Return states [T + 1, 3 + n] and inputs [T, m] of a flight."""
    motion = flight.motion
    known: dict[str, Any] = motion.channels
    still = np.zeros(len(motion))
    # what nobody commands, such as the wind, is left at rest
    w = [known.get(name, known.get(commanded(name), still)) for name in signals.columns]
    states = torch.from_numpy(motion.stack(signals.live.states))
    return states, torch.from_numpy(np.stack(w, axis=1))[:-1]


def _reach(states: Tensor) -> float:
    return float((states[:, POSITION] - states[0, POSITION]).norm(dim=1).max())


def _allowed(states: Tensor, limit: np.ndarray, limits: TrialLimits) -> bool:
    """Whether a flight stays sound and within the limits."""
    fastest = states[:, MOVING].abs().amax(0).numpy()
    speed = float(torch.hypot(states[:, SURGE], states[:, SWAY]).max())
    return bool(
        (fastest <= limit).all()
        and (limits.area is None or _reach(states) <= limits.area)
        and (limits.speed is None or speed <= limits.speed)
    )
