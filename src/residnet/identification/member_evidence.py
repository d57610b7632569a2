"""Which members of an ensemble predict which velocities, from their errors on validation windows.

Members run independently, so that the error of the mean of any subset is the mean of its errors.
Two one-sided paired t-tests at the usual level of 5 % decide for each velocity. The pairs are
blocks of windows, since windows of one log are correlated.

1. A member whose error is significantly larger than that of constant velocity is not used.
2. A member without which the error of the mean is significantly smaller is removed, the most
   significant first, and the test is repeated (backward elimination, as in the model confidence
   set of Hansen, Lunde and Nason, Econometrica 79, 2011, but with t-tests).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from residnet.evaluation.intervals import MIN_LOGS_AS_BLOCKS
from residnet.evaluation.protocol import Window

SIGNIFICANCE_LEVEL = 0.05
"""Level of the paired tests that exclude a member: the convention of such tests."""


@dataclass(frozen=True)
class Exclusion:
    """A member that is not used for a velocity.

    Attributes:
        member: index of the member.
        velocity: index of the velocity.
        p_value: of the paired one-sided t-test.
        reference: what has a significantly smaller error.
    """

    member: int
    velocity: int
    p_value: float
    reference: Literal["constant velocity", "the mean of the others"]


@dataclass(frozen=True)
class MemberSelection:
    """The members that are used for each velocity.

    Attributes:
        is_used: whether a member is used for a velocity [M, n].
        exclusions: the other combinations with their evidence.
    """

    is_used: np.ndarray
    exclusions: tuple[Exclusion, ...] = ()

    @property
    def weights(self) -> np.ndarray:
        """Equal weights of the members that are used for each velocity [M, n]."""
        return np.asarray(self.is_used / self.is_used.sum(axis=0))


def select_members(
    errors: Sequence[np.ndarray],
    constant_velocity_errors: np.ndarray,
    compute_rmse: Callable[[np.ndarray], np.ndarray],
    blocks: np.ndarray,
    active_velocities: Sequence[int],
    *,
    compares_members: bool = True,
) -> MemberSelection:
    """Return which members are used for which velocities.

    Args:
        errors: errors of the velocities at each sample of the windows, by member [N, n].
        constant_velocity_errors: those of the model of constant velocity [N, n].
        compute_rmse: returns the root mean square of each window [W, n] of errors [N, n].
        blocks: block of each window [W], see `group_windows`; with a single block there is no
            evidence, and all members are used.
        active_velocities: indices of the velocities that the models predict.
        compares_members: whether the windows are evidence for a comparison of members. They are
            none if some members were trained on them, whereas a member that is worse than constant
            velocity on its own training windows is worse on others too.
    """
    n_members = len(errors)
    is_used = np.ones((n_members, errors[0].shape[1]), dtype=bool)
    if n_members < 2 or len(np.unique(blocks)) < 2:
        return MemberSelection(is_used)
    exclusions: list[Exclusion] = []
    rmse_by_member = [compute_rmse(member_errors) for member_errors in errors]
    constant_velocity_rmse = compute_rmse(constant_velocity_errors)
    for velocity in active_velocities:
        differences = [rmse - constant_velocity_rmse for rmse in rmse_by_member]
        p_values = [compute_p_value(rows[:, velocity], blocks) for rows in differences]
        # the member with the smallest error remains in any case
        order = sorted(range(n_members), key=lambda m: -rmse_by_member[m][:, velocity].mean())
        for member in order[:-1]:
            if p_values[member] < SIGNIFICANCE_LEVEL:
                is_used[member, velocity] = False
                exclusions.append(
                    Exclusion(member, velocity, p_values[member], "constant velocity")
                )
        while compares_members and is_used[:, velocity].sum() > 1:
            used: list[int] = np.flatnonzero(is_used[:, velocity]).tolist()
            mean_rmse = compute_rmse(np.asarray(np.mean([errors[m] for m in used], axis=0)))
            candidates = []
            for member in used:
                other_members = [m for m in used if m != member]
                rmse_without = compute_rmse(
                    np.asarray(np.mean([errors[m] for m in other_members], axis=0))
                )
                difference = (mean_rmse - rmse_without)[:, velocity]
                candidates.append((compute_p_value(difference, blocks), member))
            p_value, worst = min(candidates)
            if p_value >= SIGNIFICANCE_LEVEL:
                break
            is_used[worst, velocity] = False
            exclusions.append(Exclusion(worst, velocity, p_value, "the mean of the others"))
    return MemberSelection(is_used, tuple(exclusions))


def group_windows(windows: Sequence[Window]) -> np.ndarray:
    """Return the block of each window [W]; windows of different blocks hardly depend on each other.

    A block is a log if there are at least five, otherwise all windows of a log that start within
    one window length.
    """
    log_indices = np.array([window.log_index for window in windows])
    if len(np.unique(log_indices)) >= MIN_LOGS_AS_BLOCKS:
        return np.unique(log_indices, return_inverse=True)[1]
    first_starts: dict[int, int] = {}
    for window in windows:
        first_starts.setdefault(window.log_index, window.start)
    lengths = [window.stop - window.start for window in windows]
    keys = [
        (window.log_index, (window.start - first_starts[window.log_index]) // max(lengths))
        for window in windows
    ]
    number_of_key = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    return np.array([number_of_key[key] for key in keys])


def compute_p_value(differences: np.ndarray, blocks: np.ndarray) -> float:
    """Return the p-value of the hypothesis that the mean difference [W] is at most zero.

    One-sided t-test on the means of blocks of windows [W].
    """
    block_means = np.bincount(blocks, differences) / np.bincount(blocks)
    n_blocks = len(block_means)
    standard_error = float(block_means.std(ddof=1)) / math.sqrt(n_blocks)
    mean = float(block_means.mean())
    if standard_error == 0.0:
        return 0.0 if mean > 0.0 else 1.0
    return float(scipy.stats.t.sf(mean / standard_error, n_blocks - 1))
