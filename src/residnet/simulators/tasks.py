"""Reference tasks of the Gymnasium environment: heading, course and docking speed.

All observations and rewards are in units of the vehicle's cruise speed and of its look-ahead, the
way that it goes in ten seconds at that speed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import ClassVar, final

import torch
from torch import Tensor

from residnet.core.errors import UsageError
from residnet.core.layout import heading, pose, surge, sway, velocities, yaw_rate
from residnet.core.names import nearest

AHEAD = 10.0
"""Look-ahead in s at cruise speed."""


class ReferenceTask(ABC):
    """What an agent shall do: a goal drawn for each episode, what is seen of it, and a reward.

    Attributes:
        name: of the task.
        goal: number of entries of a goal.
        seen: number of entries of an observation that the task adds to the motion's five.
    """

    name: ClassVar[str]
    goal: ClassVar[int]
    seen: ClassVar[int]

    @abstractmethod
    def draw(self, x: Tensor, random: torch.Generator, cruise: float) -> Tensor:
        """Return goals [B, goal] of episodes that start at states x [B, nx]."""

    @abstractmethod
    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return what is seen of the goal, [B, seen]."""

    @abstractmethod
    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the reward [B] of a state: 0 at its best, about -1 far from the goal."""


@final
class HeadingTask(ReferenceTask):
    """Turn to a heading and keep it; a goal is a heading in rad."""

    name, goal, seen = "heading", 1, 2

    def draw(self, x: Tensor, random: torch.Generator, cruise: float) -> Tensor:
        """Return headings up to 60 degrees to either side."""
        turn = (2.0 * _uniform(len(x), random, x) - 1.0) * math.pi / 3
        return heading(x).unsqueeze(-1) + turn

    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return sine and cosine of the error."""
        error = goal[:, 0] - heading(x)
        return torch.stack((torch.sin(error), torch.cos(error)), dim=-1)

    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return minus half of one minus the cosine of the error, which is 0 to -1."""
        return 0.5 * (torch.cos(goal[:, 0] - heading(x)) - 1.0)


@final
class CourseTask(ReferenceTask):
    """Follow a straight line; a goal is a point of it (north, east) in m and its direction."""

    name, goal, seen = "course", 3, 3

    def draw(self, x: Tensor, random: torch.Generator, cruise: float) -> Tensor:
        """Return lines within 45 degrees of the heading that pass the vehicle at some distance."""
        direction = heading(x).unsqueeze(-1)
        direction = direction + (2.0 * _uniform(len(x), random, x) - 1.0) * math.pi / 4
        aside = (2.0 * _uniform(len(x), random, x) - 1.0) * cruise * AHEAD
        across = torch.cat((-torch.sin(direction), torch.cos(direction)), dim=-1)
        return torch.cat((pose(x)[:, :2] + aside * across, direction), dim=-1)

    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the distance from the line, and sine and cosine of the error of the heading."""
        error = goal[:, 2] - heading(x)
        off = self._off(x, goal) / (cruise * AHEAD)
        return torch.stack((off.clamp(-10.0, 10.0), torch.sin(error), torch.cos(error)), dim=-1)

    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return minus the square of the distance, which saturates, less what goes backwards."""
        off = self._off(x, goal) / (cruise * AHEAD)
        return -torch.tanh(off.square()) + 0.5 * (torch.cos(goal[:, 2] - heading(x)) - 1.0)

    def _off(self, x: Tensor, goal: Tensor) -> Tensor:
        """Return the distance [B] from the line in m, positive to starboard of it."""
        away = pose(x)[:, :2] - goal[:, :2]
        return away[:, 1] * torch.cos(goal[:, 2]) - away[:, 0] * torch.sin(goal[:, 2])


@final
class DockingTask(ReferenceTask):
    """Slow down to a docking speed and keep the heading; a goal is speed in m/s and heading."""

    name, goal, seen = "docking", 2, 3

    def draw(self, x: Tensor, random: torch.Generator, cruise: float) -> Tensor:
        """Return a tenth to a third of the cruise speed, at the heading of the start."""
        speed = cruise * (0.1 + 0.23 * _uniform(len(x), random, x))
        return torch.cat((speed, heading(x).unsqueeze(-1)), dim=-1)

    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the error of the speed, and sine and cosine of that of the heading."""
        error = goal[:, 1] - heading(x)
        slow = (goal[:, 0] - surge(x)) / cruise
        return torch.stack((slow, torch.sin(error), torch.cos(error)), dim=-1)

    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return minus the error of the speed, less sway and the error of the heading."""
        slow = torch.tanh(((goal[:, 0] - surge(x)).abs() + sway(x).abs()) / cruise)
        return -slow + 0.5 * (torch.cos(goal[:, 1] - heading(x)) - 1.0)


TASKS: dict[str, ReferenceTask] = {
    task.name: task for task in (HeadingTask(), CourseTask(), DockingTask())
}


def task_named(name: str) -> ReferenceTask:
    """Return a task by its name.

    Raises:
        UsageError: where there is none.
    """
    if name not in TASKS:
        raise UsageError(f"no task '{name}'{nearest(name, TASKS)}")
    return TASKS[name]


def motion_seen(x: Tensor, cruise: float) -> Tensor:
    """Return the velocities in units of the cruise speed, [B, 3]; yaw in turns of a look-ahead."""
    u, v, _ = velocities(x).unbind(-1)
    return torch.stack((u / cruise, v / cruise, yaw_rate(x) * AHEAD), dim=-1)


def _uniform(rows: int, random: torch.Generator, like: Tensor) -> Tensor:
    return torch.rand(rows, 1, generator=random, dtype=torch.float64).to(like.dtype)
