"""The symbolic head: an equation of few terms (documents 000 and 001).

It is that of the residual, or of the whole acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, FeatureConfig, Features
from residnet.heads.delay_line import DelayConfig, DelayLine, Past, best_delay
from residnet.physics.symmetry import wrong_parity
from residnet.physics.terms import CandidatesConfig, TermLibrary, parse_term, rated
from residnet.regression.equation_rows import (
    Rows,
    RowsConfig,
    SampleRows,
    step_of,
    unbroken_stretches,
)
from residnet.regression.solutions import Coefficient, Solution
from residnet.regression.sparse import SearchConfig, SparseRegression
from residnet.regression.writing import equation, symbolic, total

_GAMMAS = (0.0, 0.5, 1.0)
"""Weights of the number of candidates that are offered where free runs choose: from BIC up."""
_MOST_DELAYS = 6
"""Most rounds of the search for a delay."""


class SymbolicConfig(FeatureConfig):
    """An equation for each axis, in SI units, by sparse regression.

    Attributes:
        candidates: which terms the equations may have, by type.
        terms: names of the candidates, instead of types.
        search: how far the search goes.
        estimator: what a row of the regression is: a sample, a window of the weak form, or either
            behind instruments; terms that name no motion count as free of measuring noise.
        symmetric: leave out of each axis the terms that a vessel with port/starboard symmetry
            cannot have there, as far as the mirror images of its channels are known.
        delay: inputs that act late; none where left out.
        choose: what the length of the equations is chosen by: `one_step`, extended BIC of the
            accelerations; or `free_run`, error of free runs on validation data, between shorter and
            longer equations and none.
    """

    kind: Literal["symbolic"] = "symbolic"
    candidates: CandidatesConfig = Field(default_factory=CandidatesConfig)
    terms: tuple[str, ...] = ()
    search: SearchConfig = Field(default_factory=SearchConfig)
    estimator: RowsConfig = Field(default_factory=SampleRows)
    symmetric: bool = False
    delay: DelayConfig | None = None
    choose: Literal["one_step", "free_run"] = "one_step"

    def build(self, names: Sequence[str]) -> SymbolicHead:
        """Return the module for channels `names`."""
        return SymbolicHead(self, names)


@final
class SymbolicHead(EquationHead):
    """A head rho [..., 3] = phi(features) coefficients, most of them zero.

    Over the baseline `still` it is the equation of the acceleration itself.
    """

    def __init__(self, config: SymbolicConfig, names: Sequence[str]) -> None:
        super().__init__()
        chosen = config.chosen(names)
        self.features = Features(chosen, names, config.margin)
        self.line = DelayLine(config.delay, chosen)
        self.n_state = self.line.n_state
        self.config = config
        self.candidates = (
            rated(dict.fromkeys(config.terms), chosen)
            if config.terms
            else config.candidates.candidates(chosen)
        )
        self.library = TermLibrary([candidate.term for candidate in self.candidates], chosen)
        self.register_buffer(
            "coefficients", torch.zeros(self.library.count, 3, dtype=torch.float64)
        )
        self.coefficients: Tensor

    def calibrate(self, samples: Samples) -> None:
        """Take the ranges of the features from the samples."""
        self.features.calibrate(samples)

    def basis(self, chosen: Tensor) -> Tensor:
        """Return all candidate terms [..., J] of chosen features [..., F].

        The features are held at the edge of the training range.
        """
        values: Tensor = self.library(self.features.held(chosen))
        return values

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, 3] at channels z [B, nz], and the late inputs as memory."""
        chosen, s = self.line(self.features.guarded(z), s)
        return self.basis(chosen) @ self.coefficients.to(z.dtype), s

    def sequence(self, z: Tensor) -> Tensor:
        """Return residuals [..., T, 3] along channels [..., T, nz], from an empty memory."""
        chosen = self.line.sequence(self.features.guarded(z))
        return self.basis(chosen) @ self.coefficients.to(z.dtype)

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] that past channels [B, T, nz], oldest first, leave."""
        return self.line.warmup(self.features.guarded(z))

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest late inputs: those that the features are held between."""
        return self.line.memory_range(self.features.low, self.features.high)

    def contributions(self, z: Tensor, axis: int) -> dict[str, np.ndarray]:
        """Return each term of an axis times its coefficient [T], along channels z [T, nz]."""
        with torch.no_grad():
            values = (
                self.basis(self.line.sequence(z.index_select(-1, self.features.index)))
                * self.coefficients[:, axis].to(z.dtype)
            ).numpy()
        return {
            term: values[:, j]
            for j, term in enumerate(self.library.terms)
            if float(self.coefficients[j, axis]) != 0.0
        }

    def solutions(self, samples: Samples) -> list[Solution]:
        """Return the equations of the extended BIC, then what free runs may prefer.

        Those are the equations of weaker and stronger penalties, and none.

        Raises:
            FitError: where the samples do not tell the candidates apart, or hold no stretch as long
                as the estimator or the delay needs.
        """
        past = self._past(samples)
        steps, delay = self._delay(past)
        gammas = _GAMMAS if self.config.choose == "free_run" else ()
        found = self._fit(past.delayed(steps, self.line.index.numpy()), gammas)
        return [self._complete(solution, steps, delay) for solution in found]

    def _past(self, samples: Samples) -> Past:
        """Return features, targets and stretches of the samples.

        They are without times where nothing looks along them.
        """
        chosen = samples.z.index_select(1, self.features.index).numpy()
        target, group = samples.target.numpy(), samples.group.numpy()
        if not self.config.estimator.sequential and self.line.count == 0:
            return Past(chosen, target, group, 0.0)
        t = samples.t.numpy()
        step = step_of(group, t)
        return Past(chosen, target, unbroken_stretches(group, t, step), step)

    def _fit(self, past: Past, gammas: Sequence[float] = ()) -> list[Solution]:
        """Return the solutions of a sparse regression of all axes."""
        with torch.no_grad():
            terms = self.basis(torch.from_numpy(past.chosen)).numpy()
        motions, channels = self.config.candidates.motions, self.features.names
        exact = np.array(
            [
                all(factor.name not in motions for factor in parse_term(term, channels))
                for term in self.library.terms
            ]
        )
        rows = self.config.estimator.rows(Rows(terms, past.target, past.stretch), past.step, exact)
        odd = [
            [wrong_parity(term, axis, channels) for axis in range(3)] for term in self.library.terms
        ]
        estimator = SparseRegression(
            self.config.search,
            degrees=[candidate.degree for candidate in self.candidates],
            efforts=[candidate.effort for candidate in self.candidates],
            allowed=~torch.tensor(odd) if self.config.symmetric else None,
            gammas=gammas,
        )
        x, y = torch.from_numpy(rows.x), torch.from_numpy(rows.y)
        return estimator.fit(x, y, names=self.library.terms, outputs=ACCELERATION)

    def _delay(self, past: Past) -> tuple[int, dict[str, Any]]:
        """Return the delay in steps, and the notes about it.

        It is the one that fits best with the terms of degree one, then with those that are found at
        it, until it stays.
        """
        if self.line.count == 0:
            return 0, {}
        simple = [c.term for c in self.candidates if c.degree <= 1]
        terms: list[list[str]] = [simple] * 3
        tried: list[int] = []
        profile = np.zeros(0)
        while len(tried) < 2 or (tried[-1] != tried[-2] and len(tried) < _MOST_DELAYS):
            steps, profile = best_delay(
                past, terms, self.features.names, self.line.channels, self.line.longest
            )
            tried.append(steps)
            table = self._fit(past.delayed(steps, self.line.index.numpy()))[0].table
            found = [[c.term for c in table if c.axis == name] for name in ACCELERATION]
            terms = [list(dict.fromkeys((*row, *simple))) for row in found]
        notes = {
            "steps": tried[-1],
            "seconds": tried[-1] * past.step,
            "profile": profile.tolist(),
        }
        return tried[-1], {"delay": notes}

    def _complete(self, solution: Solution, steps: int, delay: dict[str, Any]) -> Solution:
        """Return the solution with its delay, and with its equations in writing."""
        equations = {
            name: self._written(name, [c for c in solution.table if c.axis == name], steps) | about
            for name, about in solution.notes["equations"].items()
        }
        line = {"line.steps": torch.full((1,), float(steps), dtype=torch.float64)}
        return replace(
            solution,
            state=solution.state | line,
            notes=solution.notes | {"equations": equations} | delay,
        )

    def _written(self, name: str, terms: Sequence[Coefficient], steps: int) -> dict[str, str]:
        """Return one equation in writing."""
        channels = self.features.names
        weights = [entry.value for entry in terms]
        factors = [
            [
                ("abs" if factor.magnitude else factor.function, factor.name, factor.power)
                for factor in parse_term(entry.term, channels)
            ]
            for entry in terms
        ]
        late = ""
        if self.line.count:
            late = f"; {', '.join(self.line.channels)}: {steps} steps earlier"
        comment = f"{name} in SI units, valid within the range of the training data{late}"
        text = total([entry.term for entry in terms], weights)
        return equation(name, text, symbolic(factors, weights), channels, comment)
