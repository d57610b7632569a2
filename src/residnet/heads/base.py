"""Interface of heads (residual models), and the scaling and clamping that they share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.arrays import paged
from residnet.core.columns import zero_acceleration
from residnet.core.layout import PLANAR_LAYOUT
from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.physics.signals import SoftVelocityLimit
from residnet.physics.symmetry import get_dof
from residnet.regression.estimator import Solution
from residnet.regression.shrinkage import CONSTANT_TOLERANCE

_MIN_STD = 1e-9
"""Lower bound of the standard deviation of the residual that scales the output of a network, SI."""


class ResidualHead(nn.Module, ABC):
    """Residual head: computes the residual rho [B, n] from channels z [B, nz] and memory s.

    The residual is added to the acceleration of the baseline, in m/s^2 and rad/s^2. The memory s
    [B, n_state] is the hidden state of a recurrent head; a memoryless head has n_state = 0. A head
    must be scriptable by TorchScript unless it has an `export_error`.

    A head needs `forward` only. The other methods have defaults: `calibrate` calibrates the
    `Features` and `ResidualScale` modules of the head, and `warmup` and `teacher_forced_residuals`
    call `forward` step by step.

    Attributes:
        output_names: names of the accelerations that the residual corrects.
        n_dof: number of these accelerations n.
        n_state: number of memory values per row.
        batch_ensemble_size: number K of networks evaluated as one batch; rows are K consecutive
            blocks, one per network.
        innovation_time_constant: time constant in s of the low-pass filter of the one-step
            prediction errors of the accelerations (innovations), which are appended to the
            channels as n further columns; 0 for a head without innovations.
        has_encoder: whether the memory of the measured past comes from an encoder; a further column
            of the channels is 1 at measured states and 0 at predicted ones.
        export_error: reason why no export format supports the head; empty if it can be exported.

    Args:
        names: channels of the model, which determine the degrees of freedom; surge, sway and yaw if
            empty.
    """

    def __init__(self, names: Sequence[str] = ()) -> None:
        super().__init__()
        self.n_dof = get_dof(names).n_dynamic
        self.output_names = get_dof(names).derivative_names
        self.n_state = 0
        self.batch_ensemble_size = 1
        self.innovation_time_constant = 0.0
        self.has_encoder = False
        self.export_error = ""

    def set_step(self, dt: float) -> None:
        """Set the time step of the model in s; the default ignores it."""

    @abstractmethod
    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the residual of one time step.

        Args:
            z: channels [B, nz].
            s: memory [B, n_state].

        Returns:
            The residual [B, n] and the memory for the next step [B, n_state].
        """

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        """Return the residuals [B, T, n] of measured channels [B, T, nz], from a zero memory."""
        if self.n_state == 0:
            return self.forward(z, z[..., :0])[0]
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        residuals: list[Tensor] = []
        for k in range(z.shape[1]):
            rho, s = self.forward(z[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1)

    def combine_accelerations(self, baseline_acceleration: Tensor, rho: Tensor) -> Tensor:
        """Return nu_dot [..., n] from the acceleration of the baseline and the residual."""
        return baseline_acceleration + rho

    def residual_samples(self, samples: Samples, baseline_acceleration: Tensor) -> Samples:
        """Return the samples with the residual of the baseline as target.

        Args:
            samples: samples whose target is the measured acceleration [N, n].
            baseline_acceleration: acceleration of the baseline [N, n].
        """
        # long training data are stored on disk: computed in chunks of rows
        residuals = paged.allocate_rows(len(samples), samples.target.shape[1])
        for rows in paged.iterate_row_chunks(len(samples)):
            torch.sub(samples.target[rows], baseline_acceleration[rows], out=residuals[rows])
        return samples.with_target(residuals)

    def set_inertia(self, mass: Tensor | None) -> None:
        """Set the inertia matrix of the baseline [3, 3]; the default ignores it.

        Args:
            mass: inertia matrix; None if the baseline does not model forces.

        Raises:
            ConfigError: if the head needs the matrix and it is None.
        """

    def effective_baseline(self, baseline: nn.Module) -> nn.Module:
        """Return the baseline to which the residual is added, by default the baseline itself."""
        return baseline

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] after past channels [B, T, nz], oldest first."""
        s = torch.zeros(z.shape[0], self.n_state, dtype=z.dtype, device=z.device)
        if self.n_state > 0:
            for k in range(z.shape[1]):
                _, s = self.forward(z[:, k], s)
        return s

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the lower and upper bounds [n_state] of the memory, by default infinite.

        An exported model rejects a memory outside these bounds.
        """
        limit = torch.full((self.n_state,), torch.inf, dtype=torch.float64)
        return -limit, limit

    def calibrate(self, samples: Samples) -> None:
        """Calibrate the scales and ranges on the training samples, once before the fit.

        The default calibrates all submodules of the types `Features`, `ResidualScale` and
        `SoftVelocityLimit`.
        """
        for module in self.modules():
            if isinstance(module, Features | ResidualScale | SoftVelocityLimit):
                module.calibrate(samples)

    def residual_scale(self) -> Tensor:
        """Return the standard deviation of the residual on the training samples, [n], float64.

        The one-step loss is normalised by it. The default is that of the `ResidualScale` of the
        head, or ones if it has none.
        """
        for module in self.modules():
            if isinstance(module, ResidualScale):
                return module.std
        return torch.ones(self.n_dof, dtype=torch.float64)

    def zero_residual(self) -> None:
        """Set the residual to zero for all channels, so that the model is its baseline.

        The default sets the scales of all `ResidualScale` submodules to zero.
        """
        for module in self.modules():
            if isinstance(module, ResidualScale):
                module.std.zero_()

    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters per axis.

        By default every parameter counts for every axis.
        """
        return [float(sum(parameter.numel() for parameter in self.parameters()))] * self.n_dof


class ClosedFormHead(ResidualHead):
    """Residual head whose parameters are fitted in closed form instead of by gradient descent."""

    @abstractmethod
    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Fit samples whose target is the residual [N, n].

        Returns:
            The solution with the lowest one-step error, then the candidates for a selection by free
            runs.

        Raises:
            FitError: if the data do not determine the parameters.
        """

    def fit_preferred(self, samples: Samples) -> dict[str, Any]:
        """Load the first solution of `fit_solutions` and return the notes of the fit."""
        preferred = self.fit_solutions(samples)[0]
        self.load_state_dict(preferred.state, strict=False)
        return preferred.hyperparameters | preferred.notes

    def parameter_counts(self) -> list[float]:
        """Return the number of nonzero coefficients and intercepts per axis."""
        coefficients = [
            values.reshape(-1, self.n_dof)
            for name, values in self.named_buffers()
            if name in ("coefficients", "intercept")
        ]
        return [float((torch.cat(coefficients)[:, axis] != 0).sum()) for axis in range(self.n_dof)]


class EquationHead(ClosedFormHead):
    """Closed-form head whose residual is a sum of terms, written as an equation."""

    @abstractmethod
    def format_terms(self) -> list[str]:
        """Return the J terms as plain text."""

    @abstractmethod
    def evaluate_terms(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the terms [T, J] at channels z [T, nz], and their coefficients [J, n]."""

    def term_contributions(self, z: Tensor, axis: int) -> dict[str, np.ndarray]:
        """Return each term of an axis times its coefficient [T], at channels z [T, nz]."""
        with torch.no_grad():
            terms, weights = self.evaluate_terms(z)
            term_contributions = (terms * weights[:, axis].to(z.dtype)).numpy()
        axis_weights = weights[:, axis].tolist()
        return {
            name: term_contributions[:, j]
            for j, name in enumerate(self.format_terms())
            if axis_weights[j] != 0.0
        }


class Features(nn.Module):
    """Selects, clamps and standardises channels, z [..., nz] -> [..., F].

    Features have zero mean and unit variance on the training data.
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
        """Compute the mean, standard deviation and range of each feature.

        A constant feature is not scaled.
        """
        channel_moments, _ = samples.running_moments()
        lower, upper, std = (
            moments[self.index]
            for moments in (channel_moments.minimum, channel_moments.maximum, channel_moments.std())
        )
        # outside the margin the residual is constant instead of extrapolated
        range_margin = self.margin * (upper - lower)
        self.mean.copy_(channel_moments.mean[self.index])
        self.std.copy_(
            torch.where(std > CONSTANT_TOLERANCE * (1 + self.mean.abs()), std, torch.ones_like(std))
        )
        self.low.copy_(lower - range_margin)
        self.high.copy_(upper + range_margin)

    def select_clamped(self, z: Tensor) -> Tensor:
        """Return the selected channels [..., F], clamped to the training range."""
        return self.clamp(z.index_select(-1, self.index))

    def clamp(self, features: Tensor) -> Tensor:
        """Clamp selected channels [..., F] to the training range."""
        return torch.minimum(
            torch.maximum(features, self.low.to(features.dtype)), self.high.to(features.dtype)
        )

    def forward(self, z: Tensor) -> Tensor:
        """Return the standardised features [..., F]."""
        return (self.select_clamped(z) - self.mean.to(z.dtype)) / self.std.to(z.dtype)


def _index_buffer(indices: Sequence[int]) -> nn.Buffer:
    """Return column indices as a buffer, which moves with the module but is not stored."""
    return nn.Buffer(torch.tensor(indices, dtype=torch.long), persistent=False)


class ResidualScale(RenamedStateModule):
    """Scales network outputs by the standard deviation of the residual on the training samples."""

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"spread": "std"}

    def __init__(self, dof: int = PLANAR_LAYOUT.n_dof) -> None:
        super().__init__()
        self.std = nn.Buffer(torch.ones(dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        """Compute the standard deviation of the target of each axis."""
        self.std.copy_(samples.running_moments()[1].std().clamp(min=_MIN_STD))

    def forward(self, network_output: Tensor) -> Tensor:
        """Return residual accelerations [..., n] of normalised outputs [..., n]."""
        return network_output * self.std.to(network_output.dtype)


@final
class ZeroHead(ResidualHead):
    """Head with the residual rho = 0, so that the model is the baseline."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return zero_acceleration(z, self.n_dof), s
