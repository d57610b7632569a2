"""Nomoto's K and T and the delay of a steering response, identified from rudder and yaw rate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.signal import lfilter

from residnet.core.errors import FitError

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
