"""Samples of identification, their tallies, and derivatives along directions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd import forward_ad

from residnet.core.arrays.paged import iterate_row_chunks, release_pages, take_rows


@dataclass(frozen=True)
class Samples:
    """The usable samples of all manoeuvres, one below the other.

    Attributes:
        z: channels [N, nz], float64 (columns named by `names`).
        target: what a fit explains, [N, n]: accelerations in m/s^2, m/s^2, rad/s^2, or what a
            baseline leaves of them.
        group: number of the manoeuvre of each sample, [N], ascending.
        t: time since the manoeuvre's start [N] in s.
        kinds: kind of each manoeuvre, by number.
        names: names of the columns of z.
    """

    z: Tensor
    target: Tensor
    group: Tensor
    t: Tensor
    kinds: tuple[str, ...]
    names: tuple[str, ...]

    def __len__(self) -> int:
        return int(self.z.shape[0])

    def select_manoeuvres(self, kinds: Collection[str]) -> Samples:
        """Return the samples of manoeuvres of some kinds; all where `kinds` is empty."""
        if not kinds:
            return self
        is_selected = torch.tensor(
            [manoeuvre_kind in kinds for manoeuvre_kind in self.kinds], dtype=torch.bool
        )
        return self.select(is_selected[self.group])

    def select(self, mask: Tensor) -> Samples:
        """Return the samples at which `mask` [N] is True."""
        return replace(
            self,
            z=take_rows(self.z, mask),
            target=take_rows(self.target, mask),
            group=take_rows(self.group, mask),
            t=take_rows(self.t, mask),
        )

    def with_target(self, target: Tensor) -> Samples:
        """Return the same samples with another target [N, n]."""
        return replace(self, target=target)

    def running_moments(self) -> tuple[RunningMoments, RunningMoments]:
        """Return what the channels are like, and the target."""
        channel_moments, target_moments = (
            RunningMoments(self.z.shape[1]),
            RunningMoments(self.target.shape[1]),
        )
        for rows in iterate_row_chunks(len(self)):
            channel_moments.add_rows(self.z[rows])
            target_moments.add_rows(self.target[rows])
            release_pages()
        return channel_moments, target_moments

    def channel(self, name: str) -> Tensor:
        """Return one channel [N] by its name."""
        return self.z[:, self.names.index(name)]


class RunningMoments:
    """What columns [N, J] are like, from pieces of their rows.

    Attributes:
        n_rows: rows so far.
        mean: of each column [J].
        sum_of_squares: sum of squares about the mean [J].
        minimum: least value [J].
        maximum: largest value [J].
    """

    def __init__(self, n_columns: int) -> None:
        self.n_rows = 0
        self.mean = torch.zeros(n_columns, dtype=torch.float64)
        self.sum_of_squares = torch.zeros(n_columns, dtype=torch.float64)
        self.minimum = torch.full((n_columns,), torch.inf, dtype=torch.float64)
        self.maximum = torch.full((n_columns,), -torch.inf, dtype=torch.float64)

    def add_rows(self, rows: Tensor) -> None:
        """Count rows [M, J] in, M at least 1."""
        n_new, new_mean = len(rows), rows.mean(0)
        new_sum_of_squares = rows.var(0, correction=0) * n_new
        if self.n_rows == 0:
            self.mean, self.sum_of_squares = new_mean, new_sum_of_squares
        else:
            # the rule for joining two variances keeps their digits
            n_total, mean_difference = self.n_rows + n_new, new_mean - self.mean
            self.sum_of_squares = (
                self.sum_of_squares
                + new_sum_of_squares
                + mean_difference.square() * self.n_rows * n_new / n_total
            )
            self.mean = self.mean + mean_difference * n_new / n_total
        self.n_rows += n_new
        self.minimum = torch.minimum(self.minimum, rows.amin(0))
        self.maximum = torch.maximum(self.maximum, rows.amax(0))

    def std(self, correction: int = 0) -> Tensor:
        """Return the standard deviation of each column [J]."""
        return (self.sum_of_squares / max(self.n_rows - correction, 1)).sqrt()


def directional_derivatives(
    function: Callable[[Tensor], Tensor], z: Tensor, directions: Tensor
) -> Tensor:
    """Return the derivatives [D, B, ...] of a function along directions, by forward mode.

    It takes half the time of torch.func.jvp, and agrees with it to the last digits.

    Args:
        function: of rows z [B, n], each row for itself.
        z: where the derivatives are taken [B, n].
        directions: the directions [D, B, n].
    """
    n_directions, n_rows = directions.shape[:2]
    with forward_ad.dual_level():
        dual_state = forward_ad.make_dual(
            z.repeat(n_directions, 1), directions.reshape(n_directions * n_rows, -1)
        )
        value, derivative = forward_ad.unpack_dual(function(dual_state))
    # None where nothing depends on the rows
    derivatives: Tensor = torch.zeros_like(value) if derivative is None else derivative
    derivatives_by_direction: Tensor = derivatives.unflatten(0, (n_directions, n_rows))
    return derivatives_by_direction
