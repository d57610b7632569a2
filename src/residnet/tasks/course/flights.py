"""Flights of a course run: many vessels at once, each in a current of its own."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.control.base import ClosedLoop, Policy, Reference
from residnet.control.courses.config import PlannedCourse
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.heading.controllers import Steering
from residnet.core.config import Config, MetresPerSecond, Radians
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import InAmbientCurrent
from residnet.judge.courses import CourseFlight


class Vessels(NamedTuple):
    """The variation of B vessels and the current that each runs in.

    Attributes:
        variation: of the steering, [B, 3] (`dynamics.steering_variation.VARIATION`).
        current: to the north and to the east, [B, 2] in m/s.
    """

    variation: Tensor
    current: Tensor


NOMINAL = Vessels(
    torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64), torch.zeros(1, 2, dtype=torch.float64)
)
"""The vessel that the course is planned with, in water at rest."""


class CourseSpreadConfig(Config):
    """Random vessels, each in a steady current from a random direction.

    Every controller and guidance flies the same ones.

    Attributes:
        flights: number of vessels.
        seed: of the random numbers.
        effect: least and largest effect of the rudder, as a multiple of the nominal one (K of
            Nomoto's model).
        time: least and largest time constants of sway and yaw, as a multiple of the nominal ones (T
            of Nomoto's model).
        bias: largest constant angle that is added to the rudder's, in rad.
        current: speed of the current in m/s.
    """

    flights: int = Field(default=50, ge=2, le=1_000_000)
    seed: int = Field(default=0, ge=0)
    effect: tuple[float, float] = (0.9, 1.1)
    time: tuple[float, float] = (0.9, 1.1)
    bias: Radians = Field(default=0.0, ge=0)
    current: MetresPerSecond = Field(default=0.0, ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name, (low, high) in {"effect": self.effect, "time": self.time}.items():
            if not 0 < low <= high:
                raise ValueError(
                    f"{name}: low and high must be positive and in order, given {low:g}, {high:g}"
                )
        return self

    def draw(self) -> Vessels:
        """Draw the vessels, evenly spread over their ranges."""
        generator = np.random.default_rng(self.seed)
        effect, time, bias = (
            generator.uniform(*limits, self.flights)
            for limits in (self.effect, self.time, (-self.bias, self.bias))
        )
        towards = generator.uniform(-math.pi, math.pi, self.flights)
        variation, current = (
            np.stack((effect, time, bias), axis=-1),
            self.current * np.stack((np.cos(towards), np.sin(towards)), axis=-1),
        )
        return Vessels(torch.from_numpy(variation), torch.from_numpy(current))


def fly(
    steering: Steering,
    policy: Policy,
    reference: Reference,
    planned: PlannedCourse,
    lookahead: float,
    duration: float,
    vessels: Vessels,
) -> list[CourseFlight]:
    """Fly each vessel once, from the plan's first point and heading.

    Args:
        steering: vessel and step.
        policy: that steers.
        reference: what it follows.
        planned: course that cross-track errors are measured from.
        lookahead: of the plan's guidance in m.
        duration: in s, after which a flight that has not ended is given up.
        vessels: that fly.
    """
    vessel, count, steps = steering.vessel, len(vessels.variation), round(duration / steering.dt)
    place = [vessel.column("x"), vessel.column("y")]
    x, w = vessel.start(torch.ones(count, dtype=torch.float64))
    x[:, place] = torch.from_numpy(planned.course.track[0])
    x[:, vessel.column("psi")] = float(planned.course.heading[0])
    model = InAmbientCurrent(vessel.model(steering.dt), vessel.state)
    loop = Rollout(model, ClosedLoop(policy, reference))
    memory = torch.cat((vessels.current, vessel.memory(vessels.variation)), dim=-1)
    with torch.no_grad():
        states, inputs, _ = loop(x, w.unsqueeze(1).expand(-1, steps, -1), memory)
        moves = (states.diff(dim=1)[:, :, place].abs().sum(dim=-1) > 0).numpy()
        ends = [int(np.flatnonzero(row)[-1]) + 1 for row in moves]
        aside = _aside(
            CourseGuidance(planned.course, lookahead, vessel.state), states[:, : max(ends) + 1]
        )
    speed = torch.hypot(states[:, :, vessel.column("u")], states[:, :, vessel.column("v")])
    psi = states[:, :, vessel.column("psi")]
    return [
        CourseFlight(
            states[row, : end + 1, place].numpy(),
            psi[row, : end + 1].numpy(),
            inputs[row, : end + 1, 0].numpy(),
            speed[row, : end + 1].numpy(),
            aside[row, : end + 1].numpy(),
            steering.dt,
            end < steps,
        )
        for row, end in enumerate(ends)
    ]


def _aside(plan: CourseGuidance, states: Tensor) -> Tensor:
    """Return the cross-track errors [B, T] in m of states [B, T, nx]."""
    place, errors = plan.initial_state(states[:, 0]), []
    for k in range(states.shape[1]):
        _, place = plan(states[:, k], k, place)
        errors.append(plan.error(states[:, k], place[:, 0])[1])
    return torch.stack(errors, dim=1)
