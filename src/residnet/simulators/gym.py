"""Gymnasium environments (single and vectorised) for vessels and learned models.

It needs the extra `gymnasium`. An action in [-1, 1] covers each command's range; an observation
holds the velocities, the goal observation of the task and the last action. Observations and rewards
of the reference tasks are scaled by the cruise speed of the vehicle and by its look-ahead distance,
the distance travelled in ten seconds at cruise speed.
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

from residnet.core.columns import dynamic_states, heading, pose, surge, sway
from residnet.core.errors import UsageError
from residnet.core.names import suggest_name
from residnet.simulators.vehicle import Vehicle

Task = Literal["heading", "course", "docking"]
_DIVERGENCE_SPEED = 1e4
"""A motion has diverged above this multiple of the cruise speed."""


LOOK_AHEAD_TIME = 10.0
"""Look-ahead in s at cruise speed."""


class ReferenceTask(ABC):
    """A task of an agent: a random goal for each episode, its observation and the reward.

    Attributes:
        name: name of the task.
        goal_size: number of entries of a goal.
        observation_size: number of entries of an observation in addition to motion and commands.
    """

    name: ClassVar[str]
    goal_size: ClassVar[int]
    observation_size: ClassVar[int]

    @abstractmethod
    def sample_goal(self, x: Tensor, generator: torch.Generator, cruise: float) -> Tensor:
        """Return goals [B, goal] of episodes that start at states x [B, nx]."""

    @abstractmethod
    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the observation of the goal [B, observation_size]."""

    @abstractmethod
    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the reward [B] of a state: 0 at its best, about -1 far from the goal."""


@final
class HeadingTask(ReferenceTask):
    """Turn to a heading and keep it; a goal is a heading in rad."""

    name = "heading"
    goal_size = 1
    observation_size = 2

    def sample_goal(self, x: Tensor, generator: torch.Generator, cruise: float) -> Tensor:
        """Return headings up to 60 degrees to port or starboard of the initial one."""
        heading_change = (2.0 * _sample_uniform(len(x), generator, x) - 1.0) * math.pi / 3
        return heading(x).unsqueeze(-1) + heading_change

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

    name = "course"
    goal_size = 3
    observation_size = 3

    def sample_goal(self, x: Tensor, generator: torch.Generator, cruise: float) -> Tensor:
        """Return lines within 45 degrees of the heading that pass the vehicle at some distance."""
        direction = heading(x).unsqueeze(-1)
        direction = direction + (2.0 * _sample_uniform(len(x), generator, x) - 1.0) * math.pi / 4
        cross_track_offset = (
            (2.0 * _sample_uniform(len(x), generator, x) - 1.0) * cruise * LOOK_AHEAD_TIME
        )
        normal_direction = torch.cat((-torch.sin(direction), torch.cos(direction)), dim=-1)
        return torch.cat(
            (pose(x)[:, :2] + cross_track_offset * normal_direction, direction), dim=-1
        )

    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the distance from the line, and sine and cosine of the error of the heading."""
        error = goal[:, 2] - heading(x)
        relative_offset = self._cross_track_error(x, goal) / (cruise * LOOK_AHEAD_TIME)
        return torch.stack(
            (relative_offset.clamp(-10.0, 10.0), torch.sin(error), torch.cos(error)), dim=-1
        )

    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return minus the saturated squared distance, minus a penalty of the heading error."""
        relative_offset = self._cross_track_error(x, goal) / (cruise * LOOK_AHEAD_TIME)
        return -torch.tanh(relative_offset.square()) + 0.5 * (
            torch.cos(goal[:, 2] - heading(x)) - 1.0
        )

    def _cross_track_error(self, x: Tensor, goal: Tensor) -> Tensor:
        """Return the distance [B] from the line in m, positive to starboard of it."""
        offset = pose(x)[:, :2] - goal[:, :2]
        return offset[:, 1] * torch.cos(goal[:, 2]) - offset[:, 0] * torch.sin(goal[:, 2])


@final
class DockingTask(ReferenceTask):
    """Slow down to a docking speed and keep the heading; a goal is speed in m/s and heading."""

    name = "docking"
    goal_size = 2
    observation_size = 3

    def sample_goal(self, x: Tensor, generator: torch.Generator, cruise: float) -> Tensor:
        """Return a tenth to a third of the cruise speed, at the heading of the start."""
        speed = cruise * (0.1 + 0.23 * _sample_uniform(len(x), generator, x))
        return torch.cat((speed, heading(x).unsqueeze(-1)), dim=-1)

    def observe(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return the speed error and the sine and cosine of the heading error."""
        error = goal[:, 1] - heading(x)
        speed_error = (goal[:, 0] - surge(x)) / cruise
        return torch.stack((speed_error, torch.sin(error), torch.cos(error)), dim=-1)

    def reward(self, x: Tensor, goal: Tensor, cruise: float) -> Tensor:
        """Return minus the saturated error of speed and sway, minus a heading penalty."""
        speed_penalty = torch.tanh(((goal[:, 0] - surge(x)).abs() + sway(x).abs()) / cruise)
        return -speed_penalty + 0.5 * (torch.cos(goal[:, 1] - heading(x)) - 1.0)


REFERENCE_TASKS: dict[str, ReferenceTask] = {
    task.name: task for task in (HeadingTask(), CourseTask(), DockingTask())
}


def _sample_uniform(n_rows: int, generator: torch.Generator, dtype_source: Tensor) -> Tensor:
    return torch.rand(n_rows, 1, generator=generator, dtype=torch.float64).to(dtype_source.dtype)


class EpisodeBatch:
    """Batched simulation of the episodes of one task.

    Args:
        vehicle: simulated vehicle.
        task: name of the task.
        n_episodes: number of parallel episodes.
        episode_length: length of an episode.

    Raises:
        UsageError: if the task does not exist.
    """

    def __init__(self, vehicle: Vehicle, task: str, n_episodes: int, episode_length: int) -> None:
        if task not in REFERENCE_TASKS:
            raise UsageError(f"no task '{task}'{suggest_name(task, REFERENCE_TASKS)}")
        self.vehicle = vehicle
        self.task = REFERENCE_TASKS[task]
        self.n_episodes = n_episodes
        self.episode_length = episode_length
        self.generator = torch.Generator()
        self.generator.seed()
        self.observation_size = 3 + self.task.observation_size + vehicle.n_commands
        dtype = vehicle.initial_state.dtype
        self.command_centre = 0.5 * (vehicle.lower_commands + vehicle.upper_commands).to(dtype)
        self.command_half_range = 0.5 * (vehicle.upper_commands - vehicle.lower_commands).to(dtype)
        self.x = vehicle.initial_state.expand(n_episodes, -1).clone()
        self.s = vehicle.dynamics.initial_state(n_episodes).to(dtype)
        self.goal = torch.zeros(n_episodes, self.task.goal_size, dtype=dtype)
        self.last_action = torch.zeros(n_episodes, vehicle.n_commands, dtype=dtype)
        self.step_count = torch.zeros(n_episodes, dtype=torch.long)

    def reset(self, mask: Tensor) -> None:
        """Restart the episodes `mask` [B] at the start with a random speed up to cruise."""
        n = int(mask.sum())
        if n == 0:
            return
        start = self.vehicle.initial_state.expand(n, -1).clone()
        share = torch.rand(n, generator=self.generator, dtype=torch.float64).to(start.dtype)
        start[:, 3] = start[:, 3] + (self.vehicle.cruise - start[:, 3]) * share
        self.x[mask] = start
        self.s[mask] = self.vehicle.dynamics.initial_state(n).to(start.dtype)
        self.goal[mask] = self.task.sample_goal(start, self.generator, self.vehicle.cruise)
        self.last_action[mask] = 0.0
        self.step_count[mask] = 0

    def observe(self) -> np.ndarray:
        """Return the observation [B, size] in float32."""
        cruise = self.vehicle.cruise
        (u, v, r) = dynamic_states(self.x).unbind(-1)
        # dimensionless: yaw rate as the heading change during the look-ahead time
        motion = torch.stack((u / cruise, v / cruise, r * LOOK_AHEAD_TIME), dim=-1)
        observation_parts = (motion, self.task.observe(self.x, self.goal, cruise), self.last_action)
        observation: np.ndarray = torch.cat(observation_parts, dim=-1).float().numpy()
        return observation

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Step all episodes; return reward, diverged and finished, each [B]."""
        raw_action = torch.as_tensor(np.asarray(actions), dtype=self.x.dtype)
        action = torch.nan_to_num(raw_action).clamp(-1.0, 1.0)
        w = self.vehicle.inputs_at(self.command_centre + self.command_half_range * action)
        with torch.no_grad():
            next_state, memory = self.vehicle.dynamics.step(self.x, w, self.s)
        limit = _DIVERGENCE_SPEED * self.vehicle.cruise
        # one cheap test of the whole batch, since divergence is rare; NaN fails the comparisons
        is_finite = (
            float(next_state.abs().sum()) < torch.inf
            and float(next_state[:, 3:5].abs().max()) <= limit
        )
        has_diverged = torch.zeros(self.n_episodes, dtype=torch.bool)
        if not is_finite:
            is_too_fast = (next_state[:, 3:5].abs() > limit).any(dim=-1)
            has_diverged = is_too_fast | ~torch.isfinite(next_state).all(dim=-1)
        if bool(has_diverged.any()):
            next_state = torch.where(has_diverged.unsqueeze(-1), self.x, next_state)
            memory = torch.where(has_diverged.unsqueeze(-1), self.s, memory)
        reward = self.task.reward(next_state, self.goal, self.vehicle.cruise)
        # a penalty on fast command changes, which wear actuators
        reward = (
            reward - 0.05 * (action - self.last_action).square().mean(dim=-1) - 10.0 * has_diverged
        )
        self.x = next_state
        self.s = memory
        self.last_action = action
        self.step_count += 1
        return (
            reward.double().numpy(),
            has_diverged.numpy(),
            (self.step_count >= self.episode_length).numpy(),
        )

    def build_spaces(self) -> tuple[spaces.Box, spaces.Box]:
        """Return the spaces of one observation and of one action."""
        return (
            spaces.Box(-np.inf, np.inf, (self.observation_size,), np.float32),
            spaces.Box(-1.0, 1.0, (self.vehicle.n_commands,), np.float32),
        )


@final
class VesselEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """One vessel that learns one task.

    Args:
        vehicle: vehicle, see `residnet.simulators.vehicle.load_vehicle`.
        task: heading, course or docking.
        seconds: length of an episode.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (as in the base class)

    def __init__(self, vehicle: Vehicle, task: Task = "heading", seconds: float = 60.0) -> None:
        steps = max(1, round(seconds / vehicle.dynamics.dt))
        self.episodes = EpisodeBatch(vehicle, task, 1, steps)
        self.observation_space, self.action_space = self.episodes.build_spaces()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the same seed draws the same goals."""
        super().reset(seed=seed)
        if seed is not None:
            self.episodes.generator.manual_seed(seed)
        self.episodes.reset(torch.ones(1, dtype=torch.bool))
        return self.episodes.observe()[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step once; an episode is terminated if its motion diverges."""
        reward, diverged, finished = self.episodes.step(np.asarray(action)[None])
        return (
            self.episodes.observe()[0],
            float(reward[0]),
            bool(diverged[0]),
            bool(finished[0] and not diverged[0]),
            {},
        )


@final
class VesselVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many vessels that learn one task, stepped as one batch.

    An episode that has ended restarts in the next step, whose action is ignored.

    Args:
        vehicle: vehicle, see `residnet.simulators.vehicle.load_vehicle`.
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
        self.episodes = EpisodeBatch(vehicle, task, num_envs, steps)
        self.single_observation_space, self.single_action_space = self.episodes.build_spaces()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.needs_reset = torch.zeros(num_envs, dtype=torch.bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin all episodes; the same seed draws the same goals."""
        first_seed = seed[0] if isinstance(seed, list) else seed
        super().reset(seed=first_seed)
        if first_seed is not None:
            self.episodes.generator.manual_seed(first_seed)
        self.episodes.reset(torch.ones(self.num_envs, dtype=torch.bool))
        self.needs_reset[:] = False
        return self.episodes.observe(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step all environments; episodes that ended before are reset, with zero reward."""
        reward, diverged, finished = self.episodes.step(actions)
        restarted_mask = self.needs_reset
        if bool(restarted_mask.any()):
            self.episodes.reset(restarted_mask)
            is_continuing = ~restarted_mask.numpy()
            reward = reward * is_continuing
            diverged = diverged & is_continuing
            finished = finished & is_continuing
        truncated = finished & ~diverged
        self.needs_reset = torch.from_numpy(diverged | truncated)
        return self.episodes.observe(), reward, diverged, truncated, {}
