"""Flights under stated conditions: sensors with noise, commands with delay, and what they cost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import torch
from torch import Tensor

from residnet.control.base import Policy
from residnet.control.conditions.config import ConditionsConfig, HeadingChanges
from residnet.control.heading.steering import SteeredVessel
from residnet.core.errors import ExportError
from residnet.core.frames import wrap
from residnet.dynamics.rollout import Rollout, Source
from residnet.dynamics.steering_variation import PushedSteering

QUANTITIES = {
    "cost": "s",
    "time_outside": "s",
    "overshoot": "rad",
    "travel": "rad",
    "iae": "rad s",
}
"""Of a flight, with units: the cost, its three parts, and the integral of the absolute error."""

Flying = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""Flights from states [B, nx], inputs [B, T, m] and memory [B, n]: states and what acted."""
Compiler = Callable[[Rollout, Tensor, Tensor, Tensor], Flying]
"""Makes the flights of a closed loop quick, given examples of what they are flown with; it raises
ExportError where it cannot."""


@final
class ConditionedLoop(Source):
    """A controller that sees through noisy sensors and whose commands arrive late.

    Given inputs [B, m + 5]: those of the vessel, then push, reference, noise on heading and yaw
    rate, and the delay in steps. It returns [B, m + 2]: the inputs that act, the push, and the
    command as it was issued. Its memory holds the last commands, then that of the controller.

    Args:
        policy: the controller.
        columns: of heading and yaw rate in the state.
        inputs: number m of the vessel's inputs.
        longest: delay in steps that the memory holds.
    """

    def __init__(self, policy: Policy, columns: tuple[int, int], inputs: int, longest: int) -> None:
        super().__init__()
        self.policy = policy
        self.psi, self.r = columns
        self.inputs, self.longest = inputs, longest

    def initial(self, x: Tensor) -> Tensor:
        """Return the memory at the start: rudder amidships for as long as commands may take."""
        late = torch.zeros(x.shape[0], self.longest, dtype=x.dtype)
        return torch.cat((late, self.policy.initial_state(x)), dim=-1)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return what acts [B, m + 2] and the memory."""
        m = self.inputs
        push, reference, noise_psi, noise_r, delay = w[:, m:].split(1, dim=1)
        seen = torch.zeros_like(x)
        seen[:, self.psi : self.psi + 1] = noise_psi
        seen[:, self.r : self.r + 1] = noise_r
        command, s = self.policy(x + seen, reference, memory[:, self.longest :])
        late = torch.cat((command, memory[:, : self.longest]), dim=1)
        arriving = late.gather(1, delay.to(torch.int64))
        acting = torch.cat((arriving, w[:, 1:m], push, command), dim=1)
        return acting, torch.cat((late[:, : self.longest], s), dim=1)


@dataclass(frozen=True)
class ConditionedFlights:
    """B heading changes of T steps as they were flown.

    Attributes:
        changes: as they were drawn.
        psi: heading [B, T] in rad at the start of each step.
        r: yaw rate [B, T] in rad/s.
        command: rudder command [B, T] in rad, as it was issued.
    """

    changes: HeadingChanges
    psi: Tensor
    r: Tensor
    command: Tensor

    @property
    def error(self) -> Tensor:
        """New heading less heading [B, T] in rad, wrapped."""
        return wrap(self.changes.heading[:, None] - self.psi)

    def swing(self, after: float) -> tuple[Tensor, Tensor]:
        """Return how far heading and rudder command [B] in rad move, peak to peak.

        Args:
            after: time in s from the change of heading on, up to the flight's end.
        """
        steps = torch.arange(self.psi.shape[1])
        late = steps >= self.changes.start[:, None] + round(after / self.changes.dt)

        def between(values: Tensor) -> Tensor:
            highest = torch.where(late, values, -torch.inf).amax(1)
            return highest - torch.where(late, values, torch.inf).amin(1)

        return between(self.psi), between(self.command)

    def late_swing(self, share: float) -> Tensor:
        """Return the variance of the rudder command [B] in rad^2 in the last share of what counts.

        What counts is the time from the change on that the cost is of.
        """
        first = self.changes.start[:, None] + round((1.0 - share) * self.changes.count)
        late = self.changes.counted() & (torch.arange(self.psi.shape[1]) >= first)
        number = late.sum(1, keepdim=True).clamp(min=1)
        mean = (self.command * late).sum(1, keepdim=True) / number
        return ((self.command - mean).square() * late).sum(1) / number[:, 0]

    def measured(self, conditions: ConditionsConfig) -> dict[str, Tensor]:
        """Return each of `QUANTITIES` by flight, [B]; what is no number is left so."""
        dt, degrees = self.changes.dt, 180.0 / torch.pi
        counted = self.changes.counted().to(self.psi.dtype)
        error = self.error
        size = error.abs()
        outside = (counted * size / (size + conditions.band)).sum(1) * dt
        beyond = -error * self.changes.heading.sign()[:, None]
        # plus zero: no negative zero is shown
        overshoot = (beyond * counted).amax(1).clamp(min=0.0) + 0.0
        moved = torch.diff(self.command, dim=1, prepend=torch.zeros_like(self.command[:, :1]))
        travel = (moved.abs() * counted).sum(1)
        cost = (
            outside
            + degrees * conditions.overshoot_weight * overshoot
            + degrees * conditions.travel_weight * travel
        )
        values = (cost, outside, overshoot, travel, (size * counted).sum(1) * dt)
        return dict(zip(QUANTITIES, values, strict=True))


@final
class ConditionedRun:
    """A vessel and a controller ready to fly heading changes at one step.

    Args:
        vessel: see there.
        policy: the controller, at this step.
        dt: step in s.
        integrator: of the vessel.
        dtype: of the flights.
        compiler: of flights without gradients; None to fly them as they are, as are those that it
            cannot compile.
        longest: delay in steps that there is room for; None for that of each call's changes.
    """

    def __init__(
        self,
        vessel: SteeredVessel,
        policy: Policy,
        dt: float,
        integrator: str = "rk4",
        dtype: torch.dtype = torch.float64,
        compiler: Compiler | None = None,
        longest: int | None = None,
    ) -> None:
        self.vessel, self.dtype, self.dt = vessel, dtype, dt
        self.columns = vessel.column("psi"), vessel.column("r")
        self.policy, self.compiler, self.longest = policy, compiler, longest
        self._flying: dict[int, Flying] = {}
        self.model = PushedSteering(vessel.model(dt, integrator), len(vessel.inputs))
        self.model.to(dtype).requires_grad_(False)

    def rollout(self, longest: int) -> Rollout:
        """Return the closed loop, with room for delays of so many steps."""
        loop = ConditionedLoop(self.policy, self.columns, len(self.vessel.inputs), longest)
        return Rollout(self.model, loop)

    def given(self, changes: HeadingChanges) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, nx], inputs [B, T, m + 5] and the vessel's memory for a rollout."""
        rows, steps = changes.push.shape
        x, w = self.vessel.start(torch.ones(rows, dtype=self.dtype))
        for name, value in changes.weather.items():
            w[:, self.vessel.inputs.index(name)] = value.to(self.dtype)
        extra = torch.stack(
            (
                changes.push,
                changes.reference(),
                changes.noise[:, :, 0],
                changes.noise[:, :, 1],
                changes.delay[:, None].expand(-1, steps),
            ),
            dim=2,
        )
        inputs = torch.cat((w.unsqueeze(1).expand(-1, steps, -1), extra.to(self.dtype)), dim=2)
        return x, inputs, self.vessel.memory(changes.variation.to(self.dtype))

    def flights(
        self, changes: HeadingChanges, states: Tensor, inputs: Tensor
    ) -> ConditionedFlights:
        """Return what a rollout gave: states [B, T+1, nx] and inputs [B, T, m + 2]."""
        psi, r = (states[:, :-1, column] for column in self.columns)
        return ConditionedFlights(changes, psi, r, inputs[:, :, -1])

    def fly(self, changes: HeadingChanges) -> ConditionedFlights:
        """Fly heading changes without gradients."""
        longest = self.longest or max(int(changes.delay.max()), 1)
        given = self.given(changes)
        with torch.no_grad():
            if longest not in self._flying:
                self._flying[longest] = self._quick(self.rollout(longest), *given)
            return self.flights(changes, *self._flying[longest](*given))

    def _quick(self, rollout: Rollout, x: Tensor, w: Tensor, s: Tensor) -> Flying:
        """Return the flights of a closed loop, compiled where that can be."""
        if self.compiler is not None:
            try:
                return self.compiler(rollout, x[:2], w[:2], s[:2])
            except ExportError:
                pass  # what cannot be compiled is flown as it is

        def fly(x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
            states, inputs, _ = rollout(x, w, s)
            return states, inputs

        return fly


def fly_under(
    vessel: SteeredVessel,
    policy: Policy,
    changes: HeadingChanges,
    *,
    integrator: str = "rk4",
    dtype: torch.dtype = torch.float64,
) -> ConditionedFlights:
    """Return the flights of a controller, at the step of the changes, without gradients."""
    run = ConditionedRun(vessel, policy.to(dtype), changes.dt, integrator, dtype)
    return run.fly(changes)
