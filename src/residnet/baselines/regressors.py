"""Baselines that are linear in their coefficients: nu_dot = Theta phi(z), with regressors by name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.config import Config
from residnet.core.errors import ConfigError, FitError
from residnet.core.least_squares import solve
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.physics.terms import TermLibrary

RowTerms = dict[Literal["u", "v", "r"], tuple[str, ...]]


@dataclass(frozen=True)
class Coefficient:
    """One identified number: nu_dot of `axis` has the term `term` with `value` +- `error` (standard error)."""

    axis: str
    term: str
    value: float
    error: float


@final
class RegressorBaseline(Baseline):
    """nu_dot [..., 3] = theta [3, J] phi(z) [..., J]; a term that an axis does not have keeps a zero."""

    def __init__(self, rows: Sequence[Sequence[str]], names: Sequence[str]) -> None:
        super().__init__()
        terms = list(dict.fromkeys(term for row in rows for term in row))
        self.library = TermLibrary(terms, names)
        allowed = torch.tensor([[term in row for term in terms] for row in rows], dtype=torch.float64)
        self.register_buffer("allowed", allowed, persistent=False)
        self.allowed: Tensor
        self.theta = nn.Parameter(torch.zeros(3, len(terms), dtype=torch.float64), requires_grad=False)

    def forward(self, z: Tensor) -> Tensor:
        """nu_dot [..., 3] at channels z [..., nz]."""
        weights = self.theta * self.allowed
        return self.library(z) @ weights.to(z.dtype).T

    def columns(self, axis: int) -> list[int]:
        """Numbers of the terms that an axis has."""
        return [j for j in range(self.library.count) if bool(self.allowed[axis, j] > 0)]


class RegressorsConfig(Config):
    """Least squares (or ridge) of accelerations on named regressors.

    Attributes:
        terms: regressors of every axis, or of each axis `u`, `v`, `r`; empty: the constant and every channel (a linear model).
        ridge: penalty as a share of each regressor's energy; 0 for ordinary least squares.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    kind: Literal["regressors"] = "regressors"
    terms: tuple[str, ...] | RowTerms = ()
    ridge: float = Field(default=0.0, ge=0)
    manoeuvres: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _rows(self) -> RegressorsConfig:
        if isinstance(self.terms, dict) and set(self.terms) != set(VELOCITY):
            raise ValueError(f"terms per axis need all of u, v, r; given {sorted(self.terms)}")
        return self

    def rows(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Regressors of each axis for channels `names`."""
        if isinstance(self.terms, dict):
            return [tuple(self.terms[axis]) for axis in ("u", "v", "r")]
        return [self.terms or ("1", *names)] * 3

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        """The module, coefficients zero, for channels `names`."""
        return RegressorBaseline(self.rows(names), names)

    def fit(self, baseline: Baseline, samples: Samples) -> list[Coefficient]:
        """Fill the baseline's coefficients from samples whose target is the measured acceleration.

        Raises:
            FitError: where the data do not determine a coefficient.
        """
        assert isinstance(baseline, RegressorBaseline)
        chosen = samples.of_kinds(self.manoeuvres)
        if len(chosen) == 0:
            kinds = sorted(set(samples.kinds))
            raise FitError(f"no sample is of the manoeuvres {list(self.manoeuvres)} that the baseline is fitted on; kinds in the data: {kinds}")
        phi = baseline.library(chosen.z)
        table: list[Coefficient] = []
        for axis, name in enumerate(VELOCITY):
            columns = baseline.columns(axis)
            terms = tuple(baseline.library.terms[j] for j in columns)
            fit = solve(phi[:, columns], chosen.target[:, axis : axis + 1], chosen.group, names=terms, ridge=self.ridge)
            with torch.no_grad():
                baseline.theta[axis, columns] = fit.coefficients[:, 0]
            pairs = zip(terms, fit.coefficients[:, 0].tolist(), fit.errors[:, 0].tolist(), strict=True)
            table += [Coefficient(f"{name}_dot", term, value, error) for term, value, error in pairs]
        return table


def require(names: Sequence[str], wanted: Sequence[str], who: str) -> None:
    """Check that channels exist.

    Raises:
        ConfigError: naming the first that does not.
    """
    for name in wanted:
        if name not in names:
            raise ConfigError(f"{who} needs the channel '{name}', but the model has {', '.join(names)}; add it to model.signals")
