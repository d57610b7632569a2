"""A Gymnasium environment over any vessel or learned model, single and vectorised.

Needs the extra `gymnasium`. An action in [-1, 1] covers each command's range; an observation holds
the velocities, what the task shows of its goal, and the last action. Observations and rewards of
the reference tasks are in units of the vehicle's cruise speed and of its look-ahead, the way that
it goes in ten seconds at that speed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Literal, final

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from residnet.core.columns import heading, pose, surge, sway, velocities
from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.simulators.vehicle import Vehicle

Task = Literal["heading", "course", "docking"]
_AWAY = 1e4
"""Speeds in cruise speeds beyond which a motion has diverged."""


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


def _uniform(rows: int, random: torch.Generator, like: Tensor) -> Tensor:
    return torch.rand(rows, 1, generator=random, dtype=torch.float64).to(like.dtype)


class Episodes:
    """Episodes of one task side by side, in tensors.

    Args:
        vehicle: what moves.
        task: name of the task.
        rows: number of episodes side by side.
        steps: length of an episode.

    Raises:
        UsageError: where there is no such task.
    """

    def __init__(self, vehicle: Vehicle, task: str, rows: int, steps: int) -> None:
        if task not in TASKS:
            raise UsageError(f"no task '{task}'{nearest(task, TASKS)}")
        self.vehicle, self.task, self.rows, self.steps = vehicle, TASKS[task], rows, steps
        self.random = torch.Generator()
        self.random.seed()
        self.size = 3 + self.task.seen + vehicle.commands
        dtype = vehicle.start.dtype
        self.middle = 0.5 * (vehicle.low + vehicle.high).to(dtype)
        self.half = 0.5 * (vehicle.high - vehicle.low).to(dtype)
        self.x = vehicle.start.expand(rows, -1).clone()
        self.s = vehicle.dynamics.initial_state(rows).to(dtype)
        self.goal = torch.zeros(rows, self.task.goal, dtype=dtype)
        self.last = torch.zeros(rows, vehicle.commands, dtype=dtype)
        self.count = torch.zeros(rows, dtype=torch.long)

    def begin(self, which: Tensor) -> None:
        """Begin the episodes `which` [B] anew: at the start, at a speed drawn up to the cruise."""
        n = int(which.sum())
        if n == 0:
            return
        start = self.vehicle.start.expand(n, -1).clone()
        share = torch.rand(n, generator=self.random, dtype=torch.float64).to(start.dtype)
        start[:, 3] = start[:, 3] + (self.vehicle.cruise - start[:, 3]) * share
        self.x[which] = start
        self.s[which] = self.vehicle.dynamics.initial_state(n).to(start.dtype)
        self.goal[which] = self.task.draw(start, self.random, self.vehicle.cruise)
        self.last[which] = 0.0
        self.count[which] = 0

    def observation(self) -> np.ndarray:
        """Return what is seen, [B, size] float32."""
        cruise, (u, v, r) = self.vehicle.cruise, velocities(self.x).unbind(-1)
        # yaw in turns of a look-ahead
        motion = torch.stack((u / cruise, v / cruise, r * AHEAD), dim=-1)
        parts = (motion, self.task.observe(self.x, self.goal, cruise), self.last)
        seen: np.ndarray = torch.cat(parts, dim=-1).float().numpy()
        return seen

    def advance(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step all episodes; return reward, diverged and finished, each [B]."""
        given = torch.as_tensor(np.asarray(actions), dtype=self.x.dtype)
        action = torch.nan_to_num(given).clamp(-1.0, 1.0)
        w = self.vehicle.inputs_at(self.middle + self.half * action)
        with torch.no_grad():
            after, memory = self.vehicle.dynamics.step(self.x, w, self.s)
        limit = _AWAY * self.vehicle.cruise
        # one look at the whole batch, which is nearly always sound; what is no number fails it
        sound = float(after.abs().sum()) < torch.inf and float(after[:, 3:5].abs().max()) <= limit
        lost = torch.zeros(self.rows, dtype=torch.bool)
        if not sound:
            far = (after[:, 3:5].abs() > limit).any(dim=-1)
            lost = far | ~torch.isfinite(after).all(dim=-1)
        if bool(lost.any()):
            after = torch.where(lost.unsqueeze(-1), self.x, after)
            memory = torch.where(lost.unsqueeze(-1), self.s, memory)
        reward = self.task.reward(after, self.goal, self.vehicle.cruise)
        # quick changes of a command wear the actuators
        reward = reward - 0.05 * (action - self.last).square().mean(dim=-1) - 10.0 * lost
        self.x, self.s, self.last = after, memory, action
        self.count += 1
        return (reward.double().numpy(), lost.numpy(), (self.count >= self.steps).numpy())

    def spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces of one observation and of one action."""
        return (
            spaces.Box(-np.inf, np.inf, (self.size,), np.float32),
            spaces.Box(-1.0, 1.0, (self.vehicle.commands,), np.float32),
        )


@final
class VesselEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vessel that learns one task.

    Args:
        vehicle: see `residnet.simulators.vehicle.vehicle`.
        task: heading, course or docking.
        seconds: length of an episode.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as in the base class)

    def __init__(self, vehicle: Vehicle, task: Task = "heading", seconds: float = 60.0) -> None:
        steps = max(1, round(seconds / vehicle.dynamics.dt))
        self.episodes = Episodes(vehicle, task, 1, steps)
        self.observation_space, self.action_space = self.episodes.spaces()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed draws the same goals."""
        super().reset(seed=seed)
        if seed is not None:
            self.episodes.random.manual_seed(seed)
        self.episodes.begin(torch.ones(1, dtype=torch.bool))
        return self.episodes.observation()[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step once; an episode is terminated where its motion diverges."""
        reward, lost, finished = self.episodes.advance(np.asarray(action)[None])
        return (
            self.episodes.observation()[0],
            float(reward[0]),
            bool(lost[0]),
            bool(finished[0] and not lost[0]),
            {},
        )


@final
class VesselVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many vessels that learn one task, stepped as one batch.

    An episode that has ended begins anew with the next step, whose action is left out.

    Args:
        vehicle: see `residnet.simulators.vehicle.vehicle`.
        num_envs: number of vessels.
        task: heading, course or docking.
        seconds: length of an episode.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as in the base class)
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self, vehicle: Vehicle, num_envs: int, task: Task = "heading", seconds: float = 60.0
    ) -> None:
        steps = max(1, round(seconds / vehicle.dynamics.dt))
        self.num_envs = num_envs
        self.episodes = Episodes(vehicle, task, num_envs, steps)
        self.single_observation_space, self.single_action_space = self.episodes.spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.ended = torch.zeros(num_envs, dtype=torch.bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin all episodes; the same seed draws the same goals."""
        first = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first)
        if first is not None:
            self.episodes.random.manual_seed(first)
        self.episodes.begin(torch.ones(self.num_envs, dtype=torch.bool))
        self.ended[:] = False
        return self.episodes.observation(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all; those that had ended stand at their new start, with no reward."""
        reward, lost, finished = self.episodes.advance(actions)
        anew = self.ended
        if bool(anew.any()):
            self.episodes.begin(anew)
            still = ~anew.numpy()
            reward, lost, finished = reward * still, lost & still, finished & still
        truncated = finished & ~lost
        self.ended = torch.from_numpy(lost | truncated)
        return self.episodes.observation(), reward, lost, truncated, {}
