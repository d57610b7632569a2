"""Configuration of the sparse equation of the residual."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import suggest_name
from residnet.heads.config import ClosedFormConfig
from residnet.physics.terms import CandidatesConfig, CandidateTerm, rank_candidates
from residnet.regression.equation_rows import (
    RowsConfig,
    SampleRows,
)
from residnet.regression.sparse_config import SparseSearchConfig

if TYPE_CHECKING:
    from residnet.heads.symbolic import SymbolicHead


class DelayConfig(Config):
    """Input delay that is identified by the fit, common to all delayed channels.

    Attributes:
        channels: delayed inputs.
        longest: maximum candidate delay in time steps; the memory of the head contains this number
            of samples and a flag.
    """

    channels: tuple[str, ...] = Field(min_length=1)
    longest: int = Field(default=20, ge=1, le=500)

    def require_features(self, names: Sequence[str]) -> None:
        """Check that all delayed channels are features `names` of the head.

        Raises:
            ConfigError: if one is not.
        """
        for name in self.channels:
            if name not in names:
                raise ConfigError(
                    f"delay: '{name}' is not a feature of the head{suggest_name(name, names)}"
                )


class SymbolicConfig(ClosedFormConfig):
    """Equation of each axis in SI units, identified by sparse regression.

    Attributes:
        candidates: candidate terms, given by types.
        terms: names of candidate terms; if given, they replace `candidates`.
        search: settings of the search.
        estimator: rows of the regression: samples, or windows of the weak form.
        symmetric: whether the candidates of each axis exclude terms that violate port/starboard
            symmetry, for channels with a known mirror image.
        delay: delayed inputs; null for no delay.
        choose: criterion of the number of terms. `one_step` is the extended BIC of the
            accelerations; `free_run` is the error of free runs on validation data, with shorter and
            longer equations and no residual as candidates.
    """

    kind: Literal["symbolic"] = "symbolic"
    candidates: CandidatesConfig = Field(default_factory=CandidatesConfig)
    terms: tuple[str, ...] = ()
    search: SparseSearchConfig = Field(default_factory=SparseSearchConfig)
    estimator: RowsConfig = Field(default_factory=SampleRows)
    symmetric: bool = False
    delay: DelayConfig | None = None
    choose: Literal["one_step", "free_run"] = "one_step"

    def rank_terms(self, feature_names: Sequence[str]) -> tuple[CandidateTerm, ...]:
        """Return the candidate terms of the features, by degree and complexity.

        Raises:
            ConfigError: if a term is invalid or contains an unknown feature.
        """
        if self.terms:
            return rank_candidates(dict.fromkeys(self.terms), feature_names)
        return self.candidates.generate_candidates(feature_names)

    def check_channels(self, names: Sequence[str]) -> None:
        feature_names = self.select_features(names)
        if self.delay is not None:
            self.delay.require_features(feature_names)
        self.rank_terms(feature_names)

    def build(self, names: Sequence[str]) -> SymbolicHead:
        """Build the head for channels `names`."""
        from residnet.heads.symbolic import SymbolicHead

        return SymbolicHead(self, names)
