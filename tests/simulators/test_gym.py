"""The Gymnasium environment: the checker of the package itself, batches, seeds and ends."""

from __future__ import annotations

import warnings
from typing import cast

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from residnet.core.errors import UsageError
from residnet.simulators.gym import REFERENCE_TASKS, Task, VesselEnv, VesselVectorEnv
from residnet.simulators.vehicle import Vehicle, load_vehicle


@pytest.fixture(scope="module")
def boat() -> Vehicle:
    return load_vehicle("wam_v_cal", dt=0.5)


@pytest.mark.parametrize("task", REFERENCE_TASKS)
def test_the_packages_own_checker_passes(boat: Vehicle, task: str) -> None:
    with warnings.catch_warnings():
        # it warns of bounds that are infinite, which those of velocities are
        warnings.simplefilter("ignore")
        check_env(VesselEnv(boat, cast(Task, task), seconds=5.0), skip_render_check=True)


def test_a_batch_is_its_single_vessels(boat: Vehicle) -> None:
    many = VesselVectorEnv(boat, 3, "course", seconds=4.0)
    first, _ = many.reset(seed=4)
    again, _ = VesselVectorEnv(boat, 3, "course", seconds=4.0).reset(seed=4)
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[0], first[1])
    single = VesselEnv(boat, "course", seconds=4.0)
    single.reset(seed=0)
    single.episodes.x[:] = many.episodes.x[1]
    single.episodes.goal[:] = many.episodes.goal[1]
    actions = np.random.default_rng(0).uniform(-1, 1, (9, 3, boat.n_commands))
    for k, action in enumerate(actions[:8]):
        seen, reward, lost, truncated, _ = many.step(action)
        alone, gain, *_ = single.step(action[1])
        np.testing.assert_allclose(seen[1], alone, rtol=1e-5, atol=1e-6)
        assert reward[1] == pytest.approx(gain)
        assert (truncated == (k == 7)).all()
        assert not lost.any()
    seen, reward, _, truncated, _ = many.step(actions[8])
    assert (reward == 0).all()
    assert not truncated.any()
    assert (many.episodes.step_count == 0).all()
    assert (seen[:, -boat.n_commands :] == 0).all()


def test_an_action_that_is_no_number_or_too_large_is_held(boat: Vehicle) -> None:
    env = VesselEnv(boat, "heading")
    env.reset(seed=1)
    for value in (np.nan, np.inf, -1e30):
        seen, reward, *_ = env.step(np.full(boat.n_commands, value))
        assert np.isfinite(seen).all()
        assert np.isfinite(reward)


def test_turning_to_the_goal_is_rewarded(boat: Vehicle) -> None:
    env = VesselVectorEnv(boat, 8, "heading", seconds=60.0)
    seen, _ = env.reset(seed=0)
    first = None
    for _ in range(100):
        turn = np.clip(2.0 * seen[:, 3] - 4.0 * seen[:, 2] / 10.0, -0.5, 0.5)
        seen, reward, *_ = env.step(np.stack((0.4 + turn, 0.4 - turn), axis=1))
        first = reward if first is None else first
    assert first is not None
    assert reward.mean() > 0.3 * first.mean()


def test_faults_are_said_in_one_line(boat: Vehicle) -> None:
    with pytest.raises(UsageError, match="no task 'coarse'; did you mean 'course'"):
        VesselEnv(boat, cast(Task, "coarse"))
    with pytest.raises(UsageError, match="no vessel 'wam_w'"):
        load_vehicle("wam_w")
