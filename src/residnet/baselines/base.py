"""Interfaces of baselines, the part of the dynamics that is fixed or identified first."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Self, final

import torch
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError, FitError
from residnet.core.samples import Samples
from residnet.physics.symmetry import get_dof
from residnet.regression.estimator import Coefficient, Solution


class Baseline(nn.Module, ABC):
    """Memoryless model of the accelerations [..., n] at channels z [..., nz].

    Accelerations are in m/s^2 and rad/s^2. A subclass needs `forward` only.
    """

    @abstractmethod
    def forward(self, z: Tensor) -> Tensor:
        """Compute nu_dot [..., n] at channels z [..., nz] (see `residnet.physics.signals`)."""

    @abstractmethod
    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters per axis."""

    def inertia_matrix(self) -> Tensor | None:
        """Return the inertia matrix [3, 3], float64; None if the baseline models no forces."""
        return None


class ParametricBaseline(Baseline, ABC):
    """Baseline whose fitted values are all elements of the parameter `theta`.

    The parameters can be refitted on free runs and sampled from their distribution.

    Args:
        theta: initial values of any shape. The P free parameters are given by `free_indices`.
    """

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        self.theta = nn.Parameter(theta, requires_grad=False)

    @abstractmethod
    def free_indices(self) -> Tensor:
        """Return the indices [P] of the free parameters in the flattened theta."""

    @final
    def get_free(self) -> Tensor:
        """Return the current values of the free parameters [P]."""
        return self.theta.detach().flatten()[self.free_indices()].clone()

    @final
    def set_free(self, values: Tensor) -> None:
        """Set the values of the free parameters [P]."""
        with torch.no_grad():
            flat_theta = self.theta.detach().clone().flatten()
            flat_theta[self.free_indices()] = values.to(flat_theta.dtype)
            self.theta.copy_(flat_theta.reshape(self.theta.shape))

    @abstractmethod
    def free_parameter_names(self) -> list[tuple[str, str]]:
        """Return the P pairs (axis, term) of the free parameters as in the coefficient table."""

    @final
    def parameter_jacobian(self, z: Tensor) -> Tensor:
        """Return the derivatives [B, n, P] of nu_dot by the free parameters at channels z [B, nz].

        They are exact: each row is differentiated in reverse mode, all rows at once.
        """

        def nu_dot(theta: Tensor, channels: Tensor) -> Tensor:
            out: Tensor = torch.func.functional_call(self, {"theta": theta}, (channels,))
            return out

        by_theta = torch.func.vmap(torch.func.jacrev(nu_dot), in_dims=(None, 0))
        jacobian: Tensor = by_theta(self.theta.detach().to(z.dtype), z)
        return jacobian.flatten(2)[..., self.free_indices()]

    @abstractmethod
    def mean_information(self, samples: Samples) -> Tensor:
        """Return the Fisher information [P, P] of the accelerations per sample.

        The information concerns the free parameters and is the mean over the samples.
        """

    @abstractmethod
    def prior(self) -> tuple[Tensor, Tensor]:
        """Return the prior mean [P] and precision [P] of the free parameters.

        The precision of a parameter without prior is zero.
        """

    @abstractmethod
    def symmetry_precision(self, samples: Samples) -> Tensor:
        """Return the precision matrix [P, P] of a prior for port/starboard symmetry.

        It penalises terms of the wrong parity and differences between the coefficients of a term
        and its mirror image. It is zero for terms with an unknown mirror image.
        """

    def destabilising_terms(self) -> list[int]:
        """Return indices of free parameters whose current sign is that of negative damping.

        The list is empty for a baseline that excludes negative damping or does not check for it.
        """
        return []

    def undamped_terms(self, samples: Samples) -> list[int]:
        """Return indices of free parameters that cause negative damping at most samples.

        There is at most one per axis. The list is empty as for `destabilising_terms`.
        """
        return []

    @abstractmethod
    def refresh_table(
        self, table: Sequence[Coefficient], standard_errors: Tensor
    ) -> list[Coefficient]:
        """Return the coefficient table with the current values of theta.

        Args:
            table: coefficient table of the fit.
            standard_errors: standard errors of the free parameters [P]. The standard errors of
                ratios are not changed.
        """


class IdentifiedConfig(Config, ABC):
    """Configuration of a baseline and of its identification."""

    kind: str

    def without_file_references(self) -> Self:
        """Return the config without references to files, for storage with a model."""
        return self

    @abstractmethod
    def build(self, names: Sequence[str]) -> Baseline:
        """Build the baseline, not yet fitted, for channels `names`.

        Raises:
            ConfigError: if a required channel is missing.
        """

    def validate_samples(self, samples: Samples) -> None:
        """Check that the samples contain the manoeuvres required for the identification.

        Raises:
            FitError: if they do not.
        """

    @abstractmethod
    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Identify the baseline from samples whose target is the measured acceleration.

        Returns:
            The solution; or several candidates for a selection by free runs, the preferred one
            first.

        Raises:
            FitError: if the data do not determine a coefficient.
        """

    @final
    def fit_preferred(self, baseline: Baseline, samples: Samples) -> list[Coefficient]:
        """Load the first solution of `fit_solutions` and return its coefficient table."""
        preferred = self.fit_solutions(baseline, samples)[0]
        baseline.load_state_dict(preferred.state, strict=False)
        return list(preferred.table)


def require_channels(names: Sequence[str], required: Sequence[str], subject: str) -> None:
    """Check that channels exist, required velocities are modelled and roll is not.

    Raises:
        ConfigError: with the first missing channel.
        UsageError: if the model includes roll.
    """
    dof = get_dof(names)
    dof.require_no_roll(subject)
    for name in required:
        if name in dof.fixed_states:
            raise ConfigError(
                f"{subject} needs the velocity {name}, but signals.velocities are"
                f" {', '.join(dof.velocities)}; a baseline of kind 'regressors' or 'nomoto' needs"
                " no other"
            )
        if name not in names:
            raise ConfigError(
                f"{subject} needs the channel '{name}', but the model has {', '.join(names)};"
                " add it to signals"
            )


def select_manoeuvres(samples: Samples, kinds: Sequence[str]) -> Samples:
    """Return the samples of some kinds of manoeuvre; all samples if `kinds` is empty.

    Raises:
        FitError: if there are no such samples.
    """
    selected = samples.select_manoeuvres(kinds)
    if len(selected) == 0:
        raise FitError(
            f"no sample is of the manoeuvres {list(kinds)} on which the baseline is fitted; kinds in"
            f" the data: {sorted(set(samples.kinds))}"
        )
    return selected
