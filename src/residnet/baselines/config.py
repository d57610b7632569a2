"""Configuration that all baselines share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Self, final

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.sample_origins import SampleOrigins
from residnet.physics.symmetry import get_dof

if TYPE_CHECKING:
    from residnet.baselines.base import Baseline
    from residnet.core.samples import Samples
    from residnet.regression.estimator import Coefficient, Solution


class IdentifiedConfig(Config, ABC):
    """Base of the configs of all baselines: what to build, and how it is fitted to samples."""

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

    def check_channels(self, names: Sequence[str]) -> None:
        """Check that the baseline can be built for channels `names`, by default by building it.

        A built-in baseline is checked without PyTorch.

        Raises:
            ConfigError: if a required channel is missing.
        """
        self.build(names)

    def is_parametric(self, names: Sequence[str]) -> bool:
        """Return whether the baseline can be refitted through rollouts (`ParametricBaseline`)."""
        from residnet.baselines.base import ParametricBaseline

        return isinstance(self.build(names), ParametricBaseline)

    def has_regressors(self, names: Sequence[str]) -> bool:
        """Return whether the baseline is linear in named regressors (`RegressorBaseline`)."""
        from residnet.baselines.regressors import RegressorBaseline

        return isinstance(self.build(names), RegressorBaseline)

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        """Return whether the baseline models forces, so that it has an inertia matrix."""
        return self.build(names).inertia_matrix() is not None

    def validate_samples(self, samples: SampleOrigins) -> None:
        """Check that the samples contain the manoeuvres required for the identification.

        Raises:
            FitError: if they do not.
        """

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Identify the baseline from samples whose target is the measured acceleration.

        By default all parameters (`torch.nn.Parameter`) of the baseline are fitted by
        `fit_parameters`.

        Returns:
            The solution; or several candidates for a selection by free runs, the preferred one
            first.

        Raises:
            FitError: if the data do not determine a coefficient.
        """
        from residnet.baselines.base import fit_parameters

        return [fit_parameters(baseline, samples)]

    @final
    def fit_preferred(self, baseline: Baseline, samples: Samples) -> list[Coefficient]:
        """Load the first solution of `fit_solutions` and return its coefficient table."""
        preferred = self.fit_solutions(baseline, samples)[0]
        baseline.load_state_dict(preferred.state, strict=False)
        return list(preferred.table)


def require_channels(names: Sequence[str], required: Sequence[str], subject: str) -> None:
    """Check that channels exist, that required velocities are modelled and that roll is not.

    Raises:
        ConfigError: if a channel is missing; the message names the first one.
        UsageError: if the model includes roll.
    """
    dof = get_dof(names)
    dof.require_no_roll(subject)
    for name in required:
        if name in dof.fixed_states:
            raise ConfigError(
                f"{subject} needs the velocity {name}, but signals.velocities are"
                f" {', '.join(dof.velocities)}; use a baseline of kind 'regressors' or"
                " 'nomoto', which needs no further velocities"
            )
        if name not in names:
            raise ConfigError(
                f"{subject} needs the channel '{name}', but the model has {', '.join(names)};"
                " add it to signals"
            )
