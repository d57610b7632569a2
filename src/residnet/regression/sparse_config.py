"""Configuration of sparse regression."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config


class SparseSearchConfig(Config):
    """Settings of a sparse search.

    Attributes:
        max_terms: maximum number of terms during the search; the result usually has fewer.
        gamma: weight of the number of candidates in the extended BIC (Chen and Chen 2008),
            n ln(RSS) + k ln(n) + 2 gamma ln(J choose k); 0 for the BIC.
        precision: error relative to the target below which a fit counts as exact.
        resolution: relative norm by which a term must differ from simpler ones on noisy data. The
            relative error of the best equation is used instead if it is lower. A term that differs
            by less is selected only on strong evidence: u|u| differs from u^2 by noise only if the
            vessel never moves astern.
    """

    max_terms: int = Field(default=30, ge=1, le=80)
    gamma: float = Field(default=1.0, ge=0.0, le=1.0)
    precision: float = Field(default=1e-13, ge=1e-15, lt=1.0)
    resolution: float = Field(default=1e-2, ge=0.0, lt=1.0)
