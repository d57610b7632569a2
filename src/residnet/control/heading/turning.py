"""A vessel's response to its rudder about straight ahead, as Nomoto's K and T."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.dynamics.base import Dynamics


@dataclass(frozen=True)
class Turning:
    """T r_dot + r = K delta at a speed: K [1/s], T [s], u [m/s]."""

    gain: float
    time: float
    speed: float


def measure_turning(
    model: Dynamics,
    x: Tensor,
    w: Tensor,
    s: Tensor,
    columns: tuple[int, int],
    angle: float,
    duration: float,
) -> Turning:
    """Return K and T from the answer to a rudder angle that is held.

    Args:
        model: of the vessel.
        x: straight ahead at its speed, [1, nx].
        w: inputs [1, m] of that motion; the first is the rudder command.
        s: memory [1, n_state] of the model.
        columns: of u and r in the state.
        angle: of the rudder in rad.
        duration: until the turn is steady, in s.

    Raises:
        FitError: where the vessel does not turn towards the rudder and stay there.
    """
    u, r = columns
    speed = float(x[0, u])
    w = w.clone()
    w[:, 0] = angle
    rates = []
    with torch.no_grad():
        for _ in range(round(duration / model.dt)):
            x, s = model.step(x, w, s)
            rates.append(float(x[0, r]))
    steady = rates[-1]
    if not steady * angle > 0 or abs(rates[-1] - rates[len(rates) // 2]) > 0.1 * abs(steady):
        raise FitError(
            f"the vessel's turn at {angle:.3g} rad of rudder is not steady after {duration:g} s;"
            " train on a vessel that holds its course"
        )
    # T is the area above the rate's answer, in which lags and overshoots count as they matter
    gain = steady / angle
    area = (0.5 * steady + sum(steady - rate for rate in rates)) * model.dt
    return Turning(gain=gain, time=max(area / steady, model.dt), speed=speed)
