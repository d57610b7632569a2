"""The interface of residual heads, and the scaling and guard that all of them share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.arrays import paged
from residnet.core.columns import zero_acceleration
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.layout import PLANAR_LAYOUT
from residnet.core.names import ACCELERATION_NAMES, suggest_name
from residnet.core.samples import Samples
from residnet.physics.signals import RestoringAcceleration
from residnet.physics.symmetry import active_channels, get_dof
from residnet.regression.estimator import Solution
from residnet.regression.shrinkage import CONSTANT_TOLERANCE

_MIN_STD = 1e-9
"""Least standard deviation of a residual that a network's output is scaled by, SI."""


class ResidualHead(nn.Module, ABC):
    """A head: the residual rho [B, n] from channels z [B, nz] and memory s [B, n_state].

    It is in m/s^2, m/s^2 and rad/s^2, on top of the baseline.

    A memoryless head has n_state = 0. Every head is scriptable, however its parameters were found,
    but those with a `export_error`.

    Attributes:
        output_names: names of what it gives.
        batch_ensemble_size: number of networks that it holds; rows are then those of one after the other.
        innovation_time_constant: time in s over which it wants to know how wrong accelerations were predicted: n
            channels more, behind the others; 0 for none.
        export_error: why no format of export can hold it; empty where they can.

    Args:
        names: channels of the model, which say what moves; u, v and r where they say nothing.
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        super().__init__()
        self.n_dof = get_dof(names).n_dynamic
        self.output_names = get_dof(names).derivative_names
        self.n_state = 0
        self.batch_ensemble_size = 1
        self.innovation_time_constant = 0.0
        self.export_error = ""

    def set_step(self, dt: float) -> None:
        """Take the step of the model in s; most heads need none."""

    @abstractmethod
    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, n] at channels z [B, nz], and the memory for the next step.

        Called once per step; the memory is [B, n_state].
        """

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, n] along measured channels [B, T, nz], from an empty memory.

        In other words, teacher forcing.
        """
        return self.forward(z, z[..., :0])[0]

    def combine_accelerations(self, baseline_acceleration: Tensor, rho: Tensor) -> Tensor:
        """Return nu_dot [..., n] from the baseline's `baseline_acceleration` and this head's residual, [..., n]."""
        return baseline_acceleration + rho

    def residual_samples(self, samples: Samples, baseline_acceleration: Tensor) -> Samples:
        """Return the samples with what the baseline leaves as target, in this head's space.

        The baseline's accelerations are `baseline_acceleration` [N, n].
        """
        residuals = paged.allocate_rows(len(samples), samples.target.shape[1])
        for rows in paged.iterate_row_chunks(len(samples)):
            torch.sub(samples.target[rows], baseline_acceleration[rows], out=residuals[rows])
        return samples.with_target(residuals)

    def set_inertia(self, mass: Tensor | None) -> None:
        """Take the inertia [3, 3] of the baseline, None where it knows no forces.

        Most heads need none.

        Raises:
            ConfigError: where a head needs one and there is none.
        """

    def effective_baseline(self, baseline: nn.Module) -> nn.Module:
        """Return the baseline as this head changes it.

        Its acceleration plus the residual is nu_dot.
        """
        return baseline

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] that past channels [B, T, nz], oldest first, leave."""
        return torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the least and the largest value [n_state] that each entry of the memory can have.

        An exported model refuses a memory beyond it. Heads that do not say it take any number.
        """
        limit = torch.full((self.n_state,), torch.inf, dtype=torch.float64)
        return -limit, limit

    def calibrate(self, samples: Samples) -> None:
        """Take scales and ranges from the training samples; called once, before the fit.

        The features, the scale and the bound that a head is made of take theirs by themselves.
        """
        for module in self.modules():
            if isinstance(module, Features | ResidualScale | RestoringAcceleration):
                module.calibrate(samples)

    def residual_scale(self) -> Tensor:
        """Return the standard deviation of the residual on the training samples, [n], float64.

        A one-step loss is measured in it; ones where a head keeps none.
        """
        return torch.ones(self.n_dof, dtype=torch.float64)

    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters of each axis, all trained ones for each."""
        return [float(sum(parameter.numel() for parameter in self.parameters()))] * self.n_dof


class ClosedFormHead(ResidualHead):
    """A head whose parameters come from a closed-form solution."""

    def validate_samples(self, samples: Samples) -> None:
        """Check that samples are of as many manoeuvres as the fit divides them into.

        Raises:
            FitError: where they are not.
        """

    @abstractmethod
    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Fit samples whose target is the residual [N, n].

        The solution that one-step errors choose stands first, then those that free runs may prefer.

        Raises:
            FitError: where the data do not determine the parameters.
        """

    def fit_preferred(self, samples: Samples) -> dict[str, Any]:
        """Fill the buffers with the first of `fit_solutions` and return the notes of the fit."""
        preferred = self.fit_solutions(samples)[0]
        self.load_state_dict(preferred.state, strict=False)
        return preferred.hyperparameters | preferred.notes

    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters of each axis.

        Coefficients [J, n] and intercepts [n] that are not zero, where a head does not count
        otherwise.
        """
        coefficients = [
            values.reshape(-1, self.n_dof)
            for name, values in self.named_buffers()
            if name in ("coefficients", "intercept")
        ]
        return [float((torch.cat(coefficients)[:, axis] != 0).sum()) for axis in range(self.n_dof)]


class EquationHead(ClosedFormHead):
    """A closed-form head that is a sum of few terms."""

    @abstractmethod
    def format_terms(self) -> list[str]:
        """Return the terms in writing, [J]."""

    @abstractmethod
    def evaluate_terms(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the terms [T, J] along channels z [T, nz], and their coefficients [J, n]."""

    def term_contributions(self, z: Tensor, axis: int) -> dict[str, np.ndarray]:
        """Return each term of an axis times its coefficient [T], along channels z [T, nz]."""
        with torch.no_grad():
            terms, weights = self.evaluate_terms(z)
            term_contributions = (terms * weights[:, axis].to(z.dtype)).numpy()
        axis_weights = weights[:, axis].tolist()
        return {
            name: term_contributions[:, j]
            for j, name in enumerate(self.format_terms())
            if axis_weights[j] != 0.0
        }


class FeatureConfig(Config):
    """The channels that a head sees, and how far beyond the training range it follows them.

    Attributes:
        features: names of channels; empty for all.
        margin: share of the training range that it is widened by. Features are held at the edges of
            the wider range; outside, the residual stays what it was at the edge instead of running
            away.
    """

    features: tuple[str, ...] = ()
    margin: float = Field(default=0.1, ge=0)

    def select_features(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the features among the channels `format_terms`.

        Raises:
            ConfigError: where a feature is no channel.
        """
        for name in self.features:
            if name in ACCELERATION_NAMES and name not in names:
                raise ConfigError(
                    f"head feature '{name}' is an acceleration: only a residual in force space"
                    " knows it (plsr or ridge, space: force)"
                )
            if name not in names:
                raise ConfigError(
                    f"head feature '{name}' is not a channel of the model{suggest_name(name, names)}"
                )
        return self.features or active_channels(names)


class BaseHeadConfig(FeatureConfig, ABC):
    """The config of a head that another package offers: its `kind` and how the head is built.

    Attributes:
        kind: a `Literal` with the name of the entry point in the group `residnet.heads`.
    """

    kind: str

    @abstractmethod
    def build(self, names: Sequence[str]) -> ResidualHead:
        """Return the head, its numbers not yet found, for channels `format_terms`.

        Raises:
            ConfigError: where a channel that it needs is missing.
        """


class Features(nn.Module):
    """The selected, guarded and standardised channels: z [..., nz] -> [..., F].

    They are near zero mean and unit variance on the training data.
    """

    def __init__(self, feature_names: Sequence[str], names: Sequence[str], margin: float) -> None:
        super().__init__()
        self.names = tuple(feature_names)
        self.n_dof = get_dof(names).n_dynamic
        self.n_features = len(self.names)
        self.margin = margin
        self.index = _index_buffer([list(names).index(name) for name in feature_names])
        self.mean = nn.Buffer(torch.zeros(self.n_features, dtype=torch.float64))
        self.std = nn.Buffer(torch.ones(self.n_features, dtype=torch.float64))
        self.low = nn.Buffer(torch.full((self.n_features,), -torch.inf, dtype=torch.float64))
        self.high = nn.Buffer(torch.full((self.n_features,), torch.inf, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Take mean, standard deviation and range of each feature from the samples.

        A constant feature is left unscaled.
        """
        channel_moments, _ = samples.running_moments()
        lower, upper, std = (
            moments[self.index]
            for moments in (channel_moments.minimum, channel_moments.maximum, channel_moments.std())
        )
        range_margin = self.margin * (upper - lower)
        self.mean.copy_(channel_moments.mean[self.index])
        self.std.copy_(
            torch.where(std > CONSTANT_TOLERANCE * (1 + self.mean.abs()), std, torch.ones_like(std))
        )
        self.low.copy_(lower - range_margin)
        self.high.copy_(upper + range_margin)

    def select_clamped(self, z: Tensor) -> Tensor:
        """Return the selected channels [..., F], held at the edge of the training range."""
        return self.clamp(z.index_select(-1, self.index))

    def clamp(self, features: Tensor) -> Tensor:
        """Return channels that are selected already [..., F], held at the edge of the range."""
        return torch.minimum(
            torch.maximum(features, self.low.to(features.dtype)), self.high.to(features.dtype)
        )

    def forward(self, z: Tensor) -> Tensor:
        """Return the standardised features [..., F]."""
        return (self.select_clamped(z) - self.mean.to(z.dtype)) / self.std.to(z.dtype)


def _index_buffer(indices: Sequence[int]) -> nn.Buffer:
    return nn.Buffer(torch.tensor(indices, dtype=torch.long), persistent=False)


class ResidualScale(nn.Module):
    """The scale between a network's output near one and accelerations.

    It is the standard deviation of the residual on the training samples.
    """

    def __init__(self, dof: int = PLANAR_LAYOUT.n_dof) -> None:
        super().__init__()
        self.std = nn.Buffer(torch.ones(dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Take the standard deviation of each axis from the samples' target."""
        self.std.copy_(samples.running_moments()[1].std().clamp(min=_MIN_STD))

    def forward(self, network_output: Tensor) -> Tensor:
        """Return residual accelerations [..., n] for outputs [..., n] near one."""
        return network_output * self.std.to(network_output.dtype)


@final
class ZeroHead(ResidualHead):
    """A head without a residual, rho = 0: the baseline alone."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return zero_acceleration(z, self.n_dof), s
