"""Configuration of the equation found by genetic programming."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

from residnet.heads.config import ClosedFormConfig
from residnet.regression.genetic_config import EquationSearchConfig

if TYPE_CHECKING:
    from residnet.heads.genetic import GeneticHead


class GeneticConfig(ClosedFormConfig, EquationSearchConfig):
    """Equation of the residual of each axis in SI units, found by genetic programming.

    Fitting needs the extra `gp`; using a fitted model does not.

    Attributes:
        kind: name of the head.
        optional: whether a fit skips the head with a warning if the extra is not installed, instead
            of ending with an error.
    """

    kind: Literal["genetic"] = "genetic"
    optional: bool = False

    def build(self, names: Sequence[str]) -> GeneticHead:
        """Build the head for channels `names`."""
        from residnet.heads.genetic import GeneticHead

        return GeneticHead(self, names)
