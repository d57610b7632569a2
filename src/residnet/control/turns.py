"""Turns as a vessel makes them: the track, heading and rudder of heading changes at a given rudder angle, from straight ahead to straight ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from residnet.control.base import ClosedLoop, Reference
from residnet.control.following import Following
from residnet.control.heading_pid import HeadingPID
from residnet.control.steering import SteeredVessel
from residnet.control.turning import Turning
from residnet.dynamics.rollout import Rollout

Array = NDArray[np.float64]
_TAIL = 4.0
"""Time constants that are flown after the planned end of a turn."""
_STEADY = math.radians(0.8)
"""A turn ends where the heading stays as near to the new one."""


@dataclass(frozen=True)
class Turn:
    """A turn to starboard from the origin, heading north; a turn to port is its mirror image.

    Attributes:
        angle: by which the heading changes, in rad.
        track: north, east [N, 2] in m.
        heading: [N] in rad.
        rudder: command [N] in rad.
    """

    angle: float
    track: Array
    heading: Array
    rudder: Array


@final
class TurnReference(Reference):
    """For `Following`: the rudder held at an angle until counter-rudder stops the turn at the new heading, as Nomoto's model stops.

    At a yaw rate r the rudder at -d stops the turn within T r - T K d ln(1 + r / (K d)) of heading. Until then the vessel turns as it does;
    from then on it follows that model, to the heading where that ends: within half a step's turn of the one asked for. Memory [B, 3]: yaw
    rate [rad/s] where the stop began, the time [s] since, below zero before, and the heading [rad] where it ends.

    Args:
        angles: heading changes [B] in rad, positive, from a heading of zero.
        rudder: angles [B] in rad, positive.
        turning: K and T.
        columns: of psi, u and r in the state.
        dt: step in s.
    """

    def __init__(self, angles: Tensor, rudder: Tensor, turning: Turning, columns: tuple[int, int, int], dt: float) -> None:
        super().__init__()
        self.angles, self.rudder, self.turning, self.columns, self.dt = angles, rudder, turning, columns, dt
        self.n_state = 3

    def initial_state(self, x: Tensor) -> Tensor:
        """Not stopping."""
        return torch.tensor([[0.0, -1.0, 0.0]], dtype=x.dtype).expand(x.shape[0], -1)

    def forward(self, x: Tensor, k: int, s: Tensor) -> tuple[Tensor, Tensor]:
        """Reference [B, 3] of `following.FOLLOWED` and memory."""
        psi, u, r = (x[:, column] for column in self.columns)
        # K and T as they are at the present speed
        ratio = u / self.turning.speed
        time, full = self.turning.time / ratio, self.turning.gain * self.rudder * ratio
        rate, since, end = s.unbind(-1)
        # the middle of the step decides
        left = self.angles - psi - 0.5 * self.dt * r
        stopping = time * (r - full * torch.log1p(r.clamp(min=0.0) / full))
        begins = (since < 0) & (left <= stopping)
        rate, end = torch.where(begins, r, rate), torch.where(begins, psi + stopping, end)
        since = torch.where(begins, torch.zeros_like(since), since)
        planned = ((rate + full) * torch.exp(-since / time) - full).clamp(min=0.0)
        heading = end - time * (planned - full * torch.log1p(planned / full))
        braking = torch.stack((heading, planned, torch.where(planned > 0, -self.rudder, 0.0)), dim=-1)
        stops = since >= 0
        reference = torch.where(stops.unsqueeze(-1), braking, torch.stack((psi, r, self.rudder), dim=-1))
        return reference, torch.stack((rate, torch.where(stops, since + self.dt, since), end), dim=-1)


def make_turns(vessel: SteeredVessel, turning: Turning, angles: Array, rudder: Array, limit: float, dt: float) -> list[Turn]:
    """Turns of the nominal vessel, each with a rudder angle held until it has to be stopped; their own angles say what came of those asked for.

    Args:
        vessel: that turns.
        turning: its K and T.
        angles: heading changes [B] in rad, positive.
        rudder: angles [B] in rad.
        limit: of the rudder in rad.
        dt: step of the simulation in s.
    """
    change, held = torch.as_tensor(angles, dtype=torch.float64), torch.as_tensor(rudder, dtype=torch.float64)
    # a vessel that slows down turns at down to two thirds of its first rate
    duration = 1.2 * float((change / (turning.gain * held)).max()) + _TAIL * turning.time
    steps = math.ceil(duration / dt)
    columns = (vessel.column("psi"), vessel.column("u"), vessel.column("r"))
    law = HeadingPID.placed(vessel.state, gain=turning.gain, time=turning.time, frequency=4.0 / turning.time, damping=1.0, limit=limit)
    follower = Following(law, vessel.state, limit=limit, dt=dt, rate=vessel.rate)
    loop = Rollout(vessel.model(dt), ClosedLoop(follower, TurnReference(change, held, turning, columns, dt)))
    x, w = vessel.start(torch.ones(len(change), dtype=torch.float64))
    nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(change), -1)
    with torch.no_grad():
        states, inputs, _ = loop(x, w.unsqueeze(1).expand(-1, steps, -1), nominal)
    place = [vessel.column("x"), vessel.column("y")]
    tracks = (states[:, :, place] - states[:, :1, place]).numpy()
    headings, commands = states[:, :, columns[0]].numpy(), torch.cat((inputs[:, :, 0], inputs[:, -1:, 0]), dim=1).numpy()
    turned = []
    for i, angle in enumerate(headings[:, -1].tolist()):
        # from where on the heading stays
        end = min(int(np.flatnonzero(np.abs(headings[i] - angle) > _STEADY)[-1]) + 2, steps + 1)
        turned.append(Turn(angle, tracks[i, :end], headings[i, :end], commands[i, :end]))
    return turned


@dataclass(frozen=True)
class SteadyTurn:
    """At a held rudder: radius of the track [m], speed [m/s] and yaw rate [rad/s]."""

    radius: float
    speed: float
    yaw_rate: float


def steady_turn(vessel: SteeredVessel, rudder: float, duration: float, dt: float) -> SteadyTurn:
    """What is left after `duration` s of a held rudder angle in rad: at the rudder's limit, the smallest turn that the vessel makes."""
    x, w = vessel.start(torch.ones(1, dtype=torch.float64))
    w[:, 0] = rudder
    variation = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    steps = math.ceil(duration / dt)
    with torch.no_grad():
        states, _, _ = Rollout(vessel.model(dt))(x, w.unsqueeze(1).expand(-1, steps, -1), variation)
    psi = states[0, :, vessel.column("psi")]
    track = states[0, :, [vessel.column("x"), vessel.column("y")]]
    # over the last tenth
    begin = steps - max(steps // 10, 1)
    moved = float((track[begin + 1 :] - track[begin:-1]).norm(dim=-1).sum())
    turned = float((psi[-1] - psi[begin]).abs())
    passed = (steps - begin) * dt
    return SteadyTurn(moved / turned, moved / passed, turned / passed)
