"""A vessel's answer to its rudder: Nomoto's K, T and delay, from a model or from records."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from residnet.core.errors import FitError

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
    likely, square, independent = refined[best]
    if likely.gain <= 0 or likely.explained < _EXPLAINED:
        raise FitError(
            f"steering: the best response found has K {likely.gain:.3g} 1/s and explains"
            f" {100 * likely.explained:.0f} % of the yaw rate; check the rudder's sign and"
            " unit, and that the vessel answers its rudder"
        )
    # the rate must explain more than chance does
    gained = refined[math.inf][1] / square - 1.0
    return refined[best if gained * independent >= _SURE else math.inf][0]


def _refined(
    records: Sequence[Record], time: float, delay: float, rate: float, longest_delay: float
) -> tuple[SteeringResponse, float, float]:
    """Return the response of least error near one of the grid; an infinite rate is kept.

    The sum of its squared errors follows, and how many of them do not hang together over time.
    """
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
    time, rate = math.exp(values[1]), math.exp(values[4])
    rates = np.concatenate([record.rate[record.usable] for record in records])
    return (
        SteeringResponse(
            values[0],
            time,
            max(values[2], 0.0),
            values[3],
            math.sqrt(square / len(rates)),
            1.0 - square / max(float(((rates - rates.mean()) ** 2).sum()), 1e-30),
            rate if math.isfinite(rate) else None,
            (float(deviation[0]), time * float(deviation[1]), float(deviation[2])),
        ),
        square,
        independent,
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


@dataclass(frozen=True)
class Turning:
    """T r_dot + r = K (delta - c psi) at a speed: K [1/s], T [s], u [m/s] and c [-].

    The heading of a vessel has no c; the dive angle of one that rights itself is held by planes.
    """

    gain: float
    time: float
    speed: float
    righting: float = 0.0
