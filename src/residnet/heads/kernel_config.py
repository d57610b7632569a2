"""Configuration of kernel ridge regression of the residual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from residnet.core.sample_origins import SampleOrigins
from residnet.heads.config import ClosedFormConfig
from residnet.physics.terms import parse_term
from residnet.regression.folds import count_default_folds, require_folds
from residnet.regression.kernel_config import PolynomialConfig, RbfConfig

if TYPE_CHECKING:
    from residnet.heads.kernel import KernelHead


class KernelConfig(ClosedFormConfig):
    """Kernel ridge regression of each residual on standardised features, without intercept.

    Attributes:
        kernel: radial basis functions (`rbf`) or a polynomial (`polynomial`).
        terms: additional features computed from the features, such as `n|n|`, which a polynomial of
            low degree in the revolutions approximates poorly.
        penalties: candidate penalties per sample; lambda of Moreno-Salinas et al. 2019 and `alpha`
            of scikit-learn are the penalty times the number of samples.
        choose: criterion of the kernel setting and the penalties. `free_run` minimises the error of
            free runs on validation data, first over the setting and a shared penalty, then over the
            penalty of each axis in turn, with no residual as a candidate (Moreno-Salinas et al.
            2019, section 4, second approach). `one_step` minimises the cross-validated error of the
            acceleration of each axis. `recursion` minimises, for each axis, the error of its
            velocity in a free run with the other velocities as measured (first approach).
        folds: number of folds of the cross-validation, which never splits a manoeuvre; null for
            five folds, or the number of manoeuvres if it is lower.
    """

    kind: Literal["kernel"] = "kernel"
    kernel: Annotated[RbfConfig | PolynomialConfig, Field(discriminator="kind")] = Field(
        default_factory=RbfConfig
    )
    terms: tuple[str, ...] = ()
    penalties: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1), min_length=1
    )
    choose: Literal["one_step", "recursion", "free_run"] = "free_run"
    folds: int | None = Field(default=None, ge=2, le=1_000)

    def validate_samples(self, samples: SampleOrigins) -> None:
        require_folds(samples.n_groups, self.folds or count_default_folds(samples.n_groups))

    def check_channels(self, names: Sequence[str]) -> None:
        features = self.select_features(names)
        for term in self.terms:
            parse_term(term, features)

    def build(self, names: Sequence[str]) -> KernelHead:
        """Build the head for channels `names`."""
        from residnet.heads.kernel import KernelHead

        return KernelHead(self, names)
