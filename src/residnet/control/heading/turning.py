"""A vessel's answer to its rudder: Nomoto's K, T and delay, from a model or from records."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.signal import lfilter
from torch import Tensor

from residnet.core.errors import FitError
from residnet.dynamics.base import Dynamics

Array = NDArray[np.float64]
_TIMES, _DELAYS = 24, 12
_EXPLAINED = 0.5
"""Least share of the yaw rate's variance that a response must explain."""


@dataclass(frozen=True)
class SteeringResponse:
    """T r_dot + r = K (delta(t - delay) + bias).

    Attributes:
        gain: K in 1/s.
        time: T in s.
        delay: in s.
        bias: rudder angle in rad that is felt with the rudder amidships.
        rms: error of the simulated yaw rate in rad/s.
        explained: share of the yaw rate's variance that the response explains.
    """

    gain: float
    time: float
    delay: float
    bias: float
    rms: float
    explained: float


@dataclass(frozen=True)
class Record:
    """A manoeuvre on a uniform grid.

    Attributes:
        dt: step in s.
        rudder: angle or command [N] in rad.
        rate: yaw rate [N] in rad/s.
        usable: samples [N] that count.
    """

    dt: float
    rudder: Array
    rate: Array
    usable: NDArray[np.bool_]


def fit_response(records: Sequence[Record], longest_delay: float) -> SteeringResponse:
    """Return K, T and delay that simulate the yaw rates of manoeuvres best, each in one run.

    K, the bias and the yaw rate that each manoeuvre begins with enter linearly and are solved for;
    T and the delay are searched for on a grid, then refined.

    Args:
        records: manoeuvres; turns to both sides tell most.
        longest_delay: that is searched for, in s.

    Raises:
        FitError: where no response to the rudder is found.
    """
    longest = max(record.dt * len(record.rudder) for record in records)
    shortest = min(record.dt for record in records)
    grid = [
        (float(np.log(time)), float(delay))
        for time in np.geomspace(shortest, longest, _TIMES)
        for delay in np.linspace(0.0, longest_delay, _DELAYS)
    ]

    def cost(point: Sequence[float]) -> float:
        return _fit(records, float(np.exp(point[0])), min(max(point[1], 0.0), longest_delay))[0]

    begin = min(grid, key=cost)
    step = longest_delay / (_DELAYS - 1)
    # its types know no options of this method
    search: Any = minimize
    found = search(
        cost,
        begin,
        method="Nelder-Mead",
        options={
            "initial_simplex": [begin, (begin[0] + 0.3, begin[1]), (begin[0], begin[1] + step)],
            "xatol": 1e-4,
            "fatol": 0.0,
            "maxiter": 200,
        },
    )
    time, delay = float(np.exp(found.x[0])), float(np.clip(found.x[1], 0.0, longest_delay))
    square, gain, bias = _fit(records, time, delay)
    rates = np.concatenate([record.rate[record.usable] for record in records])
    explained = 1.0 - square / max(float(((rates - rates.mean()) ** 2).sum()), 1e-30)
    if gain <= 0 or explained < _EXPLAINED:
        raise FitError(
            f"steering: the best response found has K {gain:.3g} 1/s and explains"
            f" {100 * explained:.0f} % of the yaw rate; check the rudder's sign and unit, and that"
            " the vessel answers its rudder"
        )
    rms = float(np.sqrt(square / len(rates)))
    return SteeringResponse(gain, time, delay, bias / gain, rms, explained)


def _fit(records: Sequence[Record], time: float, delay: float) -> tuple[float, float, float]:
    """Return the sum of squared errors, K and K bias of the best response with T and a delay."""
    total = np.zeros((2, 2))
    right = np.zeros(2)
    square = 0.0
    for record in records:
        count = len(record.rudder)
        steps = np.arange(count) - delay / record.dt
        shifted = np.interp(steps, np.arange(count), record.rudder)
        keep = float(np.exp(-record.dt / time))
        # the answers to the rudder, to a constant rudder, and to the first yaw rate
        answers = np.zeros((count, 3))
        answers[1:, 0] = lfilter([1.0 - keep], [1.0, -keep], shifted[:-1])
        answers[:, 2] = keep ** np.arange(count)
        answers[:, 1] = 1.0 - answers[:, 2]
        part, rate = answers[record.usable], record.rate[record.usable]
        # each log's own first yaw rate is projected out
        own = part[:, 2] / max(float(np.linalg.norm(part[:, 2])), 1e-12)
        part, rate = part[:, :2] - own[:, None] * (own @ part[:, :2]), rate - own * (own @ rate)
        total += part.T @ part
        right += part.T @ rate
        square += float(rate @ rate)
    found = np.linalg.lstsq(total, right, rcond=1e-10)[0]
    return max(square - float(found @ right), 0.0), float(found[0]), float(found[1])


_STEPS = 400
_STEADY = 0.1
"""Share of the yaw rate by which it may still change over the last half of the time."""
_OVERSHOOT = 0.02
_PATIENCE = 8
"""Times the duration given that a turn is waited for."""
_SWITCHES = 6
_FINE = 25
"""Steps until a zigzag's first change of rudder."""
_LONGEST = 12000
"""Steps after which a zigzag is given up."""


@dataclass(frozen=True)
class Turning:
    """T r_dot + r = K delta at a speed: K [1/s], T [s], u [m/s]."""

    gain: float
    time: float
    speed: float


@dataclass(frozen=True)
class Steered:
    """What K and T are measured on.

    Attributes:
        build: returns the model of the vessel with steps of a length in s.
        x: straight ahead at its speed, [1, nx].
        w: inputs [1, m] of that motion; the first is the rudder command.
        s: memory [1, n_state] of the model.
        columns: of u, r and psi in the state.
        steps: the first length of a step and the largest, in s.
    """

    build: Callable[[float], Dynamics]
    x: Tensor
    w: Tensor
    s: Tensor
    columns: tuple[int, int, int]
    steps: tuple[float, float]


def measure_turning(steered: Steered, angle: float, duration: float) -> Turning:
    """Return K and T of the answer to a rudder angle.

    The angle is held first: T is the area above the yaw rate's answer over its end. The yaw rate of
    a vessel that hardly holds its course overshoots in hard turns, or is not steady for long. Then
    K and T are those that simulate its yaw rate best in a zigzag, with a delay beside them.

    Args:
        steered: the vessel.
        angle: of the rudder in rad.
        duration: until the turn is steady, in s.

    Raises:
        FitError: where the vessel does not answer its rudder so that it can be steered.
    """
    speed = float(steered.x[0, steered.columns[0]])
    times, rates, headings = _held(steered, angle, duration)
    while times[-1] < _PATIENCE * duration and not _settled(times, rates):
        times, rates, headings = _held(steered, angle, 2.0 * float(times[-1]))
    if not np.isfinite(rates).all():
        raise FitError(f"the vessel's motion does not stay finite at {angle:.3g} rad of rudder")
    steady = float(rates[-1])
    straight = steady * angle > 0 and _settled(times, rates)
    if straight and (rates / steady).max() <= 1.0 + _OVERSHOOT:
        area = float(np.trapezoid(steady - rates, times))
        if area > 0:
            return Turning(gain=steady / angle, time=area / steady, speed=speed)
    turned = np.flatnonzero(headings * np.sign(angle) >= abs(angle))
    if len(turned) == 0:
        raise FitError(
            f"at {angle:.3g} rad of rudder the vessel does not turn by as much to that side within"
            f" {times[-1]:.3g} s; it cannot be steered (check the sign of its rudder and the limit)"
        )
    first = float(times[turned[0]])
    found = fit_response([_zigzag(steered, angle, first)], 0.5 * first)
    return Turning(gain=found.gain, time=found.time, speed=speed)


def _settled(times: np.ndarray, rates: np.ndarray) -> bool:
    """Return whether a yaw rate is steady over the last half of the time."""
    half, steady = rates[np.searchsorted(times, 0.5 * times[-1]) :], rates[-1]
    overshoots = np.abs(rates).max() > (1.0 + _STEADY) * abs(steady)
    return bool(overshoots or np.abs(half - steady).max() <= _STEADY * abs(steady))


def _held(
    steered: Steered, angle: float, duration: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, yaw rates and headings [N] under a held rudder, in steps that grow."""
    _, r, psi = steered.columns
    x, w, s = steered.x, steered.w.clone(), steered.s
    w[:, 0] = angle
    times, rates, headings = [0.0], [0.0], [0.0]
    dt = steered.steps[0]
    with torch.no_grad():
        while times[-1] < duration - 0.5 * dt:
            model = steered.build(dt)
            for _ in range(min(_STEPS, round((duration - times[-1]) / dt))):
                x, s = model.step(x, w, s)
                times.append(times[-1] + dt)
                rates.append(float(x[0, r]))
                headings.append(float(x[0, psi] - steered.x[0, psi]))
            dt = min(2.0 * dt, steered.steps[1])
    return np.array(times), np.array(rates), np.array(headings)


def _zigzag(steered: Steered, angle: float, first: float) -> Record:
    """Return a zigzag in which the heading goes as far to each side as the rudder.

    `first` is the time in s until its first change of rudder.
    """
    _, r, psi = steered.columns
    low, high = steered.steps
    dt = low if high <= low else min(max(first / _FINE, low), high)
    model, x, w, s = steered.build(dt), steered.x, steered.w.clone(), steered.s
    side, switches = float(np.sign(angle)), 0
    rates: list[float] = []
    rudder: list[float] = []
    with torch.no_grad():
        while switches < _SWITCHES:
            if len(rates) > _LONGEST:
                raise FitError(
                    f"a zigzag with {abs(angle):.3g} rad of rudder does not turn the vessel back"
                    f" within {dt * _LONGEST:.3g} s; it cannot be steered with so little rudder"
                )
            heading = float(x[0, psi] - steered.x[0, psi])
            if side * heading > abs(angle):
                side, switches = -side, switches + 1
            w[:, 0] = side * abs(angle)
            rates.append(float(x[0, r]))
            rudder.append(side * abs(angle))
            x, s = model.step(x, w, s)
    rate = np.array(rates)
    return Record(dt, np.array(rudder), rate, np.isfinite(rate))
