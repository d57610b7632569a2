"""Operating domain of a model: relations between inputs, and the density of states and inputs.

A range for each channel is a box. Logs fill only a part of it: an input that was held, two
propellers that ran at equal speeds, a rudder that a controller set from the heading. The operating
domain adds to the ranges:

- **relations**: an unexcited input has its value in the logs, or its relation to other inputs; an
  input of a controller has its relation to the heading and the velocities;
- a **density**: the inverse Christoffel function q(z) = v(z)' M^-1 v(z) of velocities and inputs z,
  where v holds all monomials up to degree two and M is their mean outer product over the training
  logs. It is the Mahalanobis distance of v and large wherever the logs hold no samples. Source: J.
  B. Lasserre and E. Pauwels, The empirical Christoffel function with applications in data analysis,
  Advances in Computational Mathematics 45 (2019).

The limit of q is a quantile of the training logs, each scored with the moments of the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.dynamics.domain_config import OperatingDomain


def monomials(z: Tensor, degree: int) -> Tensor:
    """Return the monomials [..., p] of scaled channels z [..., d] up to degree 1 or 2."""
    columns = [torch.ones_like(z[..., :1]), z]
    if degree == 2:
        n_channels = z.shape[-1]
        columns += [z[..., i : i + 1] * z[..., i:] for i in range(n_channels)]
    return torch.cat(columns, dim=-1)


def log_domain_distance(
    domain: OperatingDomain,
    states: np.ndarray,
    inputs: np.ndarray,
    state_names: Sequence[str],
    input_names: Sequence[str],
) -> np.ndarray | None:
    """Return half the logarithm of q over the number of monomials at each sample [T].

    Over the training data, the mean of q is the number of monomials without the regularisation and
    slightly less with it. Far from these data the value grows as the logarithm of the distance
    times the degree of the monomials.

    Args:
        domain: the domain.
        states: states [T, nx].
        inputs: inputs [T, m].
        state_names: names of the states.
        input_names: names of the inputs.

    Returns:
        The values; None for a domain without a density.
    """
    if domain.degree == 0:
        return None
    names = [*state_names, *input_names]
    columns = [names.index(name) for name in domain.channels]
    values = np.concatenate((states, inputs), axis=1)[:, columns]
    z = torch.from_numpy((values - np.array(domain.centre)) / np.array(domain.scale))
    n_features = math.isqrt(len(domain.factor))
    factor = np.array(domain.factor).reshape(n_features, n_features)
    scores = (monomials(z, domain.degree).numpy() @ factor.T) ** 2
    return np.asarray(0.5 * np.log(np.maximum(scores.sum(axis=1), 1e-12) / n_features))


@final
class DomainCheck(nn.Module):
    """Decides which states and inputs lie in the operating domain.

    Args:
        domain: the domain.
        state_names: names of the columns of states, the heading third.
        input_names: names of the columns of inputs.
        dtype: precision of the tables and of the inputs.
    """

    def __init__(
        self,
        domain: OperatingDomain,
        state_names: Sequence[str],
        input_names: Sequence[str],
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        names = [*state_names, *input_names]
        self.degree = domain.degree
        self.is_closed_loop_only = domain.is_closed_loop_only
        self.density_columns = [names.index(name) for name in domain.channels]
        self.heading_column = names.index("psi") if "psi" in names else 0
        n_features = math.isqrt(len(domain.factor))
        self.centre = nn.Buffer(torch.tensor(domain.centre, dtype=dtype))
        self.inverse_scale = nn.Buffer(1.0 / torch.tensor(domain.scale, dtype=dtype))
        factor = torch.tensor(domain.factor, dtype=dtype).reshape(n_features, n_features)
        # scaled by the limit, so that `forward` compares q with 1
        self.factor = nn.Buffer(factor / math.sqrt(domain.limit))
        self.relations = domain.relations
        gains = torch.zeros(len(domain.relations), len(names), dtype=dtype)
        for row, relation in zip(gains, domain.relations, strict=True):
            row[names.index(relation.input)] = 1.0
            for channel, gain in zip(relation.channels, relation.gains, strict=True):
                row[names.index(channel)] -= gain
        self.gains = nn.Buffer(gains)
        self.offsets = nn.Buffer(_column(dtype, [relation.offset for relation in domain.relations]))
        self.tolerances = nn.Buffer(
            _column(dtype, [relation.tolerance for relation in domain.relations])
        )
        self.has_heading = any(relation.heading is not None for relation in domain.relations)
        self.headings = nn.Buffer(
            _column(dtype, [relation.heading or 0.0 for relation in domain.relations])
        )
        self.heading_gains = nn.Buffer(
            _column(dtype, [relation.heading_gain for relation in domain.relations])
        )
        self.min_cosines = nn.Buffer(
            _column(
                dtype,
                [
                    # no cosine is below -2, so that a relation without heading is always fulfilled
                    -2.0
                    if relation.heading is None
                    else math.cos(min(relation.max_heading, math.pi))
                    for relation in domain.relations
                ],
            )
        )

    def forward(self, x: Tensor, w: Tensor) -> Tensor:
        """Return which rows [B] of states [B, nx] and inputs [B, m] lie in the domain."""
        values = torch.cat((x, w), dim=-1)
        # true unless the first state is NaN
        is_inside = values[..., 0] == values[..., 0]
        if self.is_closed_loop_only:
            # false for every row, with the shape of the batch
            return ~is_inside & is_inside
        if self.degree > 0:
            columns = [values[..., k : k + 1] for k in self.density_columns]
            z = (torch.cat(columns, dim=-1) - self.centre) * self.inverse_scale
            scores = monomials(z, self.degree) @ self.factor.T
            is_inside = is_inside & ((scores * scores).sum(dim=-1) <= 1.0)
        if len(self.relations) > 0:
            deviation = values @ self.gains.T - self.offsets
            if self.has_heading:
                heading = values[..., self.heading_column : self.heading_column + 1]
                deviation = deviation - self.heading_gains * torch.sin(heading - self.headings)
                is_on_course = torch.cos(heading - self.headings) >= self.min_cosines
                is_inside = is_inside & is_on_course.all(dim=-1)
            is_inside = is_inside & (deviation.abs() <= self.tolerances).all(dim=-1)
        return is_inside


def _column(dtype: torch.dtype, values: Sequence[float]) -> Tensor:
    return torch.tensor(list(values), dtype=dtype)
