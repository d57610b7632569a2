"""Scores that the epochs of a heading policy are chosen by; less is better."""

from __future__ import annotations

import math

import torch

from residnet.control.base import ClosedLoop, Policy
from residnet.control.heading.controllers import Steering
from residnet.control.heading.imitation import SideBySide
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import fly
from residnet.dynamics.rollout import Source
from residnet.judge.autopilots import step_flights
from residnet.tasks.autopilot.config import AutopilotSettings


class SettlingScore:
    """The score of a policy: mean and worst settling time in s, and a penalty on overshoot.

    Both are taken over the corners of the spread.
    """

    def __init__(self, steering: Steering, config: AutopilotSettings) -> None:
        self.steering, self.test, self.corners = steering, config.test, config.spread.corners()

    def __call__(self, policy: HeadingPolicy) -> float:
        test = self.test
        policy.dt = test.dt
        flights = step_flights(
            self.steering.vessel, policy, self.corners, test.heading, test.dt, test.duration
        )
        settled = flights.settled(test.band)
        beyond = (flights.overshoot() - 0.9 * test.overshoot).clamp(min=0.0) / test.overshoot
        return float(settled.mean() + 2.0 * settled.max() + 0.5 * test.duration * beyond.amax())


class CommandDifference:
    """The root mean square in rad of how the commands of a policy differ from its teacher's.

    The teacher sees what the policy flies.
    """

    def __init__(self, steering: Steering, config: AutopilotSettings, teacher: Policy) -> None:
        self.steering, self.test, self.corners, self.teacher = (
            steering,
            config.test,
            config.spread.corners(),
            teacher.double(),
        )

    def __call__(self, policy: HeadingPolicy) -> float:
        test, rows = self.test, len(self.corners)
        policy.dt = test.dt
        beside: list[SideBySide] = []

        def watched(source: Source) -> Source:
            assert isinstance(source, ClosedLoop)
            beside.append(SideBySide(source.policy, self.teacher, source.reference))
            return beside[0]

        heading = torch.full((rows,), test.heading)
        flights = fly(
            self.steering.vessel,
            policy,
            heading,
            self.corners,
            dt=test.dt,
            duration=test.duration,
            surround=watched,
        )
        return math.sqrt(float(beside[0].total) / flights.inputs.shape[1])
