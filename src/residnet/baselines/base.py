"""The interfaces of baselines: the part of the dynamics that is known or identified first."""

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
    """A baseline: accelerations [..., n] from channels z [..., nz], without memory.

    They are in m/s^2, m/s^2 and rad/s^2.
    """

    @abstractmethod
    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., n] at channels z [..., nz] (see `residnet.physics.signals`)."""

    @abstractmethod
    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters of each axis."""

    def inertia_matrix(self) -> Tensor | None:
        """Return the inertia [3, 3] between forces and accelerations, float64.

        None where a baseline knows no forces.
        """
        return None


class ParametricBaseline(Baseline, ABC):
    """A baseline of which all that was fitted stands in `theta`.

    Its parameters can be moved through free runs and drawn at random.

    Args:
        theta: numbers of any shape, kept as the parameter `theta`; the P of them that may move are
            named by `free_indices`.
    """

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        self.theta = nn.Parameter(theta, requires_grad=False)

    @abstractmethod
    def free_indices(self) -> Tensor:
        """Return the places [P] in theta, flattened, of the parameters that may move."""

    @final
    def get_free(self) -> Tensor:
        """Return the free parameters [P] as they are."""
        return self.theta.detach().flatten()[self.free_indices()].clone()

    @final
    def set_free(self, values: Tensor) -> None:
        """Set the free parameters to values [P]."""
        with torch.no_grad():
            flat_theta = self.theta.detach().clone().flatten()
            flat_theta[self.free_indices()] = values.to(flat_theta.dtype)
            self.theta.copy_(flat_theta.reshape(self.theta.shape))

    @abstractmethod
    def free_parameter_names(self) -> list[tuple[str, str]]:
        """Return (axis, term) of each free parameter, as the table of coefficients has them [P]."""

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
        """Return the information [P, P] that a sample's accelerations hold, mean over samples.

        It is about the free parameters.
        """

    @abstractmethod
    def prior(self) -> tuple[Tensor, Tensor]:
        """Return the prior mean [P] and precision [P] of the free parameters, before any trial.

        The precision is zero where nothing is known before.
        """

    @abstractmethod
    def symmetry_precision(self, samples: Samples) -> Tensor:
        """Return the information [P, P] about what a mirror-symmetric vessel cannot have.

        It is zero where nothing is known of the mirror. Terms of the wrong parity, and differences
        between a coefficient and that of the term's mirror image, cost by it.
        """

    def destabilising_terms(self) -> list[int]:
        """Return the free parameters, counted among these, whose sign feeds energy as they are.

        Empty for a baseline whose form does not allow it, or that is not asked to look.
        """
        return []

    def undamped_terms(self, samples: Samples) -> list[int]:
        """Return the free parameters that feed an axis where most of the samples are not damped.

        They are counted among the free ones, at most one of each axis; empty as for `destabilising_terms`.
        """
        return []

    @abstractmethod
    def refresh_table(
        self, table: Sequence[Coefficient], standard_errors: Tensor
    ) -> list[Coefficient]:
        """Return the table of coefficients as theta is now.

        Standard errors [P] are those of the free parameters; errors of ratios stay as they were.
        """


class IdentifiedConfig(Config, ABC):
    """A kind of baseline and how it is identified."""

    kind: str

    def without_file_references(self) -> Self:
        """Return the config without references to files, as it is kept with a model."""
        return self

    @abstractmethod
    def build(self, names: Sequence[str]) -> Baseline:
        """Return the module, its numbers not yet found, for channels `names`.

        Raises:
            ConfigError: where a channel that it needs is missing.
        """

    def validate_samples(self, samples: Samples) -> None:
        """Check that samples hold the manoeuvres that this baseline is identified from.

        Raises:
            FitError: where they do not.
        """

    @abstractmethod
    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Identify from samples whose target is the measured acceleration.

        There are several solutions where free runs are to choose between them.

        Raises:
            FitError: where the data do not determine a coefficient.
        """

    @final
    def fit_preferred(self, baseline: Baseline, samples: Samples) -> list[Coefficient]:
        """Fill the baseline with the first of `fit_solutions` and return its coefficients."""
        preferred = self.fit_solutions(baseline, samples)[0]
        baseline.load_state_dict(preferred.state, strict=False)
        return list(preferred.table)


def require_channels(names: Sequence[str], required: Sequence[str], subject: str) -> None:
    """Check that channels exist, velocities live, and nothing rolls.

    Raises:
        ConfigError: naming the first that does not.
        UsageError: where the model rolls.
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
                f"{subject} needs the channel '{name}', but the model has {', '.join(names)}; add it to"
                " signals"
            )


def select_manoeuvres(samples: Samples, kinds: Sequence[str]) -> Samples:
    """Return the samples of some kinds of manoeuvre, all where `kinds` is empty.

    Raises:
        FitError: where there are none.
    """
    selected = samples.select_manoeuvres(kinds)
    if len(selected) == 0:
        raise FitError(
            f"no sample is of the manoeuvres {list(kinds)} that the baseline is fitted on; kinds in"
            f" the data: {sorted(set(samples.kinds))}"
        )
    return selected
