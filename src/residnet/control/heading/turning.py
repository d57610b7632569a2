"""A vessel's answer to its rudder: Nomoto's K, T and delay, from a model or from records."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import lfilter
from torch import Tensor

from residnet.core.errors import FitError
from residnet.dynamics.base import Dynamics

Array = NDArray[np.float64]
_TIMES, _DELAYS, _RATES = 20, 8, 10
"""Values of T, the delay and the rate of the gear that the coarse search tries."""
_THIN = 4000
"""Samples of a manoeuvre that the first, coarse search looks at."""
_GEARS = (math.radians(1.0), math.radians(40.0))
"""Rates of steering gears in rad/s that are searched: SOLAS II-1/29 asks ships for 2.3 deg/s, and
beyond the fastest a rudder of 20 deg is there within half a second.
"""
_EXPLAINED = 0.5
"""Least share of the yaw rate's variance that a response must explain."""
_SURE = 3.84
"""Point of chi squared with one degree of freedom that one value in twenty exceeds."""


@dataclass(frozen=True)
class SteeringResponse:
    """T r_dot + r = K (delta(t - delay) + bias), with a rudder that follows its command at a rate.

    Attributes:
        gain: K in 1/s.
        time: T in s.
        delay: in s.
        bias: rudder angle in rad that is felt with the rudder amidships.
        rms: error of the simulated yaw rate in rad/s.
        explained: share of the yaw rate's variance that the response explains.
        rate: of the rudder in rad/s; None where the records show none, or are of the rudder angle.
        spread: standard deviations of `gain`, `time` and `delay`, SI, from the fit's covariance
            with the residual's correlation over time counted in.
    """

    gain: float
    time: float
    delay: float
    bias: float
    rms: float
    explained: float
    rate: float | None = None
    spread: tuple[float, float, float] = (0.0, 0.0, 0.0)


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

    def thinned(self) -> Record:
        """Return every so many of the samples."""
        every = slice(None, None, -(-len(self.rudder) // _THIN))
        dt = self.dt * (every.step or 1)
        return Record(dt, self.rudder[every], self.rate[every], self.usable[every])


def slewed(command: Array, rate: float, dt: float) -> Array:
    """Return the angles [N] of a rudder that follows commands [N] in rad at a rate in rad/s.

    It begins at the first command.
    """
    most = rate * dt
    if not math.isfinite(most):
        return command
    angle, out = float(command[0]), []
    for wanted in command.tolist():
        angle += min(max(wanted - angle, -most), most)
        out.append(angle)
    return np.array(out)


def fit_response(
    records: Sequence[Record], longest_delay: float, *, commands: bool = False
) -> SteeringResponse:
    """Return K, T and delay that simulate the yaw rates of manoeuvres best, each in one run.

    K, the bias and the yaw rate that each manoeuvre begins with enter linearly and are solved for;
    T, the delay and the rate of the rudder are searched for on a grid, then refined. A rate is kept
    where the errors without one are larger than chance explains.

    Args:
        records: manoeuvres; turns to both sides tell most.
        longest_delay: that is searched for, in s.
        commands: whether the records are of rudder commands, which a rudder follows at a rate.

    Raises:
        FitError: where no response to the rudder is found.
    """
    longest = max(record.dt * len(record.rudder) for record in records)
    shortest = min(record.dt for record in records)
    thin = [record.thinned() for record in records]
    rates = [math.inf, *np.geomspace(*_GEARS, _RATES)] if commands else [math.inf]
    found: dict[float, tuple[float, tuple[float, float]]] = {}
    for rate in rates:
        known = [
            Record(one.dt, slewed(one.rudder, rate, one.dt), one.rate, one.usable) for one in thin
        ]
        found[rate] = min(
            (_fit(known, float(time), float(delay))[0], (float(time), float(delay)))
            for time in np.geomspace(shortest, longest, _TIMES)
            for delay in np.linspace(0.0, longest_delay, _DELAYS)
        )
    best = min(rates, key=lambda rate: found[rate][0])
    refined = {
        rate: _refined(records, *found[rate][1], rate, longest_delay) for rate in (best, math.inf)
    }
    gain, time, delay, bias, rate = refined[best].values
    values = np.concatenate([record.rate[record.usable] for record in records])
    explained = 1.0 - refined[best].square / max(
        float(((values - values.mean()) ** 2).sum()), 1e-30
    )
    if gain <= 0 or explained < _EXPLAINED:
        raise FitError(
            f"steering: the best response found has K {gain:.3g} 1/s and explains"
            f" {100 * explained:.0f} % of the yaw rate; check the rudder's sign and unit, and that"
            " the vessel answers its rudder"
        )
    # the rate must explain more than chance does
    gained = refined[math.inf].square / refined[best].square - 1.0
    chosen = refined[best if gained * refined[best].independent >= _SURE else math.inf]
    gain, time, delay, bias, rate = chosen.values
    return SteeringResponse(
        gain,
        time,
        delay,
        bias,
        float(np.sqrt(chosen.square / len(values))),
        explained,
        rate if math.isfinite(rate) else None,
        chosen.spread,
    )


class _Refined(NamedTuple):
    """K, T, delay, bias and rate of least error, and how sure they are.

    Attributes:
        values: SI.
        square: sum of squared errors.
        independent: number of errors that do not hang together over time.
        spread: standard deviations of K, T and delay.
    """

    values: tuple[float, float, float, float, float]
    square: float
    independent: float
    spread: tuple[float, float, float]


def _refined(
    records: Sequence[Record], time: float, delay: float, rate: float, longest_delay: float
) -> _Refined:
    """Return the response of least error near one of the grid; an infinite rate is kept."""
    from scipy.optimize import least_squares

    def moved(rate: float) -> list[Record]:
        return [replace(one, rudder=slewed(one.rudder, rate, one.dt)) for one in records]

    def errors(point: Array) -> Array:
        size = math.exp(point[4]) if len(point) > 4 else math.inf
        parts = [_answers(one, math.exp(point[1]), point[2]) for one in moved(size)]
        return np.concatenate([point[0] * (a[:, 0] + point[3] * a[:, 1]) - r for a, r in parts])

    _, gain, push = _fit(moved(rate), time, delay)
    first = [gain, math.log(time), delay, push / (gain or 1.0)]
    first += [math.log(rate)] if math.isfinite(rate) else []
    low, high = np.full((2, len(first)), math.inf) * [[-1.0], [1.0]]
    low[2], high[2] = -1e-9, longest_delay + 1e-9
    # steps of derivatives are a share of a sample: delays lie between samples
    found = least_squares(
        errors, first, bounds=(low, high), x_scale="jac", diff_step=np.full(len(first), 1e-4)
    )
    left, values = found.fun, [*found.x, math.inf][:5]
    along = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-30)
    # errors that hang together over time count less often
    independent = max(len(left) * (1.0 - along) / (1.0 + along), 8.0)
    square = float(left @ left)
    slopes = np.asarray(found.jac)
    covariance = np.linalg.pinv(slopes.T @ slopes) * (square / independent)
    deviation = np.sqrt(np.diag(covariance).clip(min=0.0))
    time = math.exp(values[1])
    return _Refined(
        (values[0], time, max(values[2], 0.0), values[3], math.exp(values[4])),
        square,
        independent,
        (float(deviation[0]), time * float(deviation[1]), float(deviation[2])),
    )


def _answers(record: Record, time: float, delay: float) -> tuple[Array, Array]:
    """Return the answers [N, 2] to the rudder and to a constant one at K = 1, and yaw rates [N].

    The answer to the yaw rate that the record begins with is projected out of all three.
    """
    count = len(record.rudder)
    shifted = np.interp(np.arange(count) - delay / record.dt, np.arange(count), record.rudder)
    keep = float(np.exp(-record.dt / time))
    answers = np.zeros((count, 2))
    answers[1:, 0] = lfilter([1.0 - keep], [1.0, -keep], shifted[:-1])
    first = keep ** np.arange(count)
    answers[:, 1] = 1.0 - first
    part, rate, own = answers[record.usable], record.rate[record.usable], first[record.usable]
    own = own / max(float(np.linalg.norm(own)), 1e-12)
    return part - own[:, None] * (own @ part), rate - own * (own @ rate)


def _fit(records: Sequence[Record], time: float, delay: float) -> tuple[float, float, float]:
    """Return the sum of squared errors, K and K bias of the best response with T and a delay."""
    total, right, square = np.zeros((2, 2)), np.zeros(2), 0.0
    for record in records:
        part, rate = _answers(record, time, delay)
        total += part.T @ part
        right += part.T @ rate
        square += float(rate @ rate)
    found = np.linalg.lstsq(total, right, rcond=1e-10)[0]
    return max(square - float(found @ right), 0.0), float(found[0]), float(found[1])


_STEPS = 400
"""Steps of one length before the next are twice as long."""
_STEADY = 0.1
"""Share of the yaw rate by which it may still change over the last half of the time."""
_OVERSHOOT = 0.02
"""Share of the steady yaw rate that a vessel of the first order may overshoot by."""
_PATIENCE = 8
"""Times the duration given that a turn is waited for."""
_SWITCHES = 6
"""Changes of rudder that a zigzag ends after."""
_FINE = 25
"""Steps until a zigzag's first change of rudder."""
_LONGEST = 12000
"""Steps after which a zigzag is given up."""


@dataclass(frozen=True)
class Turning:
    """T r_dot + r = K (delta - c psi) at a speed: K [1/s], T [s], u [m/s] and c [-].

    The heading of a vessel has no c; the dive angle of one that rights itself is held by planes.
    """

    gain: float
    time: float
    speed: float
    righting: float = 0.0


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
        rate: of the rudder in rad/s; infinite where it stands at its command, or K and T are to
            hold what moves it.
        side: sign of yaw rate and heading under a positive command.
        rights: whether the angle that is turned comes to rest under a held command, as a pitch
            that weight and buoyancy right.
    """

    build: Callable[[float], Dynamics]
    x: Tensor
    w: Tensor
    s: Tensor
    columns: tuple[int, int, int]
    steps: tuple[float, float]
    rate: float = math.inf
    side: float = 1.0
    rights: bool = False


def measure_turning(steered: Steered, angle: float, duration: float) -> Turning:
    """Return K and T of the answer to a rudder angle.

    The angle is held first: T is the area above the yaw rate's answer over its end, less that above
    the rudder's own way to the angle. The yaw rate of
    a vessel that hardly holds its course overshoots in hard turns, or is not steady for long. Then
    K and T are those that simulate its yaw rate best in a zigzag, with a delay beside them. An
    angle that comes to rest under the held rudder tells c, and the zigzag K and T.

    Args:
        angle: of the rudder in rad.
        duration: until the turn is steady, in s.

    Raises:
        FitError: where the vessel does not answer its rudder so that it can be steered.
    """
    speed = float(steered.x[0, steered.columns[0]])
    times, rates, headings = _held(steered, angle, duration)
    if steered.rights:
        half = np.array_split(headings, 2)[1]
        # an angle that is righted nears its end; one that is not goes round and round
        if not np.ptp(half) <= abs(half.mean()):
            raise FitError(
                f"at {angle:.3g} rad of planes the vessel is at {headings[-1]:.3g} rad after"
                f" {times[-1]:.3g} s and does not come to rest: nothing rights it. The planes hold"
                " an angle against what rights the vessel: check that its weight lies below its"
                " buoyancy (rigid_body.z_G, buoyancy.z_B) and its speed, or give turning_time more"
            )
        return _measure_righted(steered, angle, float(headings[-1]))
    while times[-1] < _PATIENCE * duration and not _settled(times, rates):
        times, rates, headings = _held(steered, angle, 2.0 * float(times[-1]))
    if not np.isfinite(rates).all():
        raise FitError(f"the vessel's motion does not stay finite at {angle:.3g} rad of rudder")
    steady = float(rates[-1])
    straight = steady * angle > 0 and _settled(times, rates)
    if straight and (rates / steady).max() <= 1.0 + _OVERSHOOT:
        time = float(np.trapezoid(steady - rates, times)) / steady
        time -= 0.5 * abs(angle) / steered.rate
        if time > 0:
            return Turning(gain=steady / angle, time=time, speed=speed)
    turned = np.flatnonzero(headings * np.sign(angle) >= abs(angle))
    if len(turned) == 0:
        raise FitError(
            f"at {angle:.3g} rad of rudder the vessel does not turn by as much to that side within"
            f" {times[-1]:.3g} s; it cannot be steered (check the sign of its rudder and the limit)"
        )
    first = float(times[turned[0]])
    found = fit_response([_zigzag(steered, angle, angle, first)[0]], 0.5 * first)
    return Turning(gain=found.gain, time=found.time, speed=speed)


def _measure_righted(steered: Steered, angle: float, end: float) -> Turning:
    """Return K, T and c of a vessel that has come to rest at an angle `end` under a held one."""
    if not (math.isfinite(end) and end * angle > 0):
        raise FitError(
            f"at {angle:.3g} rad of rudder the vessel comes to rest at an angle of {end:.3g} rad;"
            " it cannot be steered (check the sign of the command that steers)"
        )
    righting, first = angle / end, 2.0 * steered.steps[1]
    record, headings = _zigzag(steered, angle, min(abs(angle), 0.5 * abs(end)), first)
    known = replace(record, rudder=record.rudder - righting * headings)
    found = fit_response([known], _FINE * first)
    return Turning(float(found.gain), found.time, float(steered.x[0, steered.columns[0]]), righting)


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
                rates.append(steered.side * float(x[0, r]))
                headings.append(steered.side * float(x[0, psi] - steered.x[0, psi]))
            dt = min(2.0 * dt, steered.steps[1])
    return np.array(times), np.array(rates), np.array(headings)


def _zigzag(steered: Steered, angle: float, turned: float, first: float) -> tuple[Record, Array]:
    """Return a zigzag in which the heading goes to an angle `turned` on each side, and headings.

    `first` is the time in s until its first change of rudder.
    """
    _, r, psi = steered.columns
    low, high = steered.steps
    dt = low if high <= low else min(max(first / _FINE, low), high)
    model, x, w, s = steered.build(dt), steered.x, steered.w.clone(), steered.s
    side, switches = float(np.sign(angle)), 0
    rates: list[float] = []
    rudder: list[float] = []
    headings: list[float] = []
    with torch.no_grad():
        while switches < _SWITCHES:
            if len(rates) > _LONGEST:
                raise FitError(
                    f"a zigzag with {abs(angle):.3g} rad of rudder does not turn the vessel back"
                    f" within {dt * _LONGEST:.3g} s; it cannot be steered with so little rudder"
                )
            headings.append(steered.side * float(x[0, psi] - steered.x[0, psi]))
            if side * headings[-1] > abs(turned):
                side, switches = -side, switches + 1
            w[:, 0] = side * abs(angle)
            rates.append(steered.side * float(x[0, r]))
            rudder.append(side * abs(angle))
            x, s = model.step(x, w, s)
    rate = np.array(rates)
    angle_taken = slewed(np.array([0.0, *rudder]), steered.rate, dt)[1:]
    return Record(dt, angle_taken, rate, np.isfinite(rate)), np.array(headings)
