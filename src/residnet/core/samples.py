"""Samples for identification, running moments, and directional derivatives."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.autograd import forward_ad

from residnet.core.arrays.paged import iterate_row_chunks, release_pages, take_rows
from residnet.core.sample_origins import SampleOrigins


@dataclass(frozen=True)
class Samples:
    """Concatenated usable samples of all manoeuvres.

    Attributes:
        z: channels [N, nz], float64.
        target: response of a fit [N, n]: accelerations in SI units, or residuals of a baseline.
        group: index of the manoeuvre of each sample [N], ascending.
        t: time since the start of the manoeuvre [N] in s.
        kinds: kind of each manoeuvre.
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

    @property
    def origins(self) -> SampleOrigins:
        """Manoeuvre and time of the samples."""
        return SampleOrigins(self.group.numpy(), self.t.numpy(), self.kinds)

    def select_manoeuvres(self, kinds: Collection[str]) -> Samples:
        """Return the samples of manoeuvres of some kinds; all samples if `kinds` is empty."""
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
        """Accumulate the moments of z [N, nz] and of the target [N, n], chunk by chunk."""
        channel_moments = RunningMoments(self.z.shape[1])
        target_moments = RunningMoments(self.target.shape[1])
        for rows in iterate_row_chunks(len(self)):
            channel_moments.add_rows(self.z[rows])
            target_moments.add_rows(self.target[rows])
            release_pages()
        return channel_moments, target_moments

    def channel(self, name: str) -> Tensor:
        """Return the column [N] of z with the name of a channel."""
        return self.z[:, self.names.index(name)]


class RunningMoments:
    """Moments and ranges of columns [N, J], accumulated over chunks of rows.

    Attributes:
        n_rows: number of accumulated rows.
        mean: mean of each column [J].
        sum_of_squares: sum of squares about the mean [J].
        minimum: smallest value of each column [J].
        maximum: largest value of each column [J].
    """

    def __init__(self, n_columns: int) -> None:
        self.n_rows = 0
        self.mean = torch.zeros(n_columns, dtype=torch.float64)
        self.sum_of_squares = torch.zeros(n_columns, dtype=torch.float64)
        self.minimum = torch.full((n_columns,), torch.inf, dtype=torch.float64)
        self.maximum = torch.full((n_columns,), -torch.inf, dtype=torch.float64)

    def add_rows(self, rows: Tensor) -> None:
        """Add rows [M, J], M at least 1."""
        n_new = len(rows)
        new_mean = rows.mean(0)
        new_sum_of_squares = rows.var(0, correction=0) * n_new
        if self.n_rows == 0:
            self.mean = new_mean
            self.sum_of_squares = new_sum_of_squares
        else:
            # pairwise update of mean and sum of squares, which is numerically stable (Chan et al.
            # 1983)
            n_total = self.n_rows + n_new
            mean_difference = new_mean - self.mean
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
    """Return directional derivatives [D, B, ...] of a function by forward-mode differentiation.

    It takes half the time of torch.func.jvp with the same result.

    Args:
        function: maps rows [B, n] to [B, ...], each row independently.
        z: points at which the derivatives are computed [B, n].
        directions: directions [D, B, n].
    """
    n_directions, n_rows = directions.shape[:2]
    with forward_ad.dual_level():
        dual_state = forward_ad.make_dual(
            z.repeat(n_directions, 1), directions.reshape(n_directions * n_rows, -1)
        )
        value, derivative = forward_ad.unpack_dual(function(dual_state))
    # None if the value does not depend on the rows
    derivatives: Tensor = torch.zeros_like(value) if derivative is None else derivative
    derivatives_by_direction: Tensor = derivatives.unflatten(0, (n_directions, n_rows))
    return derivatives_by_direction
