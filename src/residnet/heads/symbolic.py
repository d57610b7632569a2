"""The symbolic head: the residual, or the whole acceleration, as an equation of few terms
(documents 000 and 001).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, FeatureConfig, Features
from residnet.heads.delay_line import DelayConfig, DelayLine, Past, best_delay
from residnet.physics.candidates import Candidate, CandidatesConfig, rated
from residnet.physics.symmetry import wrong_parity
from residnet.physics.terms import TermLibrary, parse_term
from residnet.regression.equation_rows import (
    EstimatorConfig,
    LeastSquares,
    Rows,
    step_of,
    stretches,
)
from residnet.regression.expressions.equations import (
    Factor,
    Written,
    c_function,
    latex,
    plain,
    sympy_text,
)
from residnet.regression.solutions import Coefficient, Solution
from residnet.regression.sparse import NOTHING, Equation, Reduced, SearchConfig, find, reduce

_GAMMAS = (0.0, 0.5, 1.0)
_MOST_DELAYS = 6


class SymbolicConfig(FeatureConfig):
    """An equation for each axis, in SI units, by sparse regression.

    Attributes:
        candidates: which terms the equations may have, by type.
        terms: the candidates by name instead.
        search: how far the search goes.
        estimator: what a row of the regression is: a sample, a window of the weak form, or either
            behind instruments; terms that name no motion count as free of measuring noise.
        symmetric: leave out of each axis the terms that a vessel with port/starboard symmetry
            cannot have there, as far as the mirror images of its channels are known.
        delay: inputs that act late.
        choose: what the length of the equations is chosen by: `one_step`, extended BIC of the
            accelerations; or `free_run`, error of free runs on validation data, between shorter and
            longer equations and none.
    """

    kind: Literal["symbolic"] = "symbolic"
    candidates: CandidatesConfig = Field(default_factory=CandidatesConfig)
    terms: tuple[str, ...] = ()
    search: SearchConfig = Field(default_factory=SearchConfig)
    estimator: EstimatorConfig = Field(default_factory=LeastSquares)
    symmetric: bool = False
    delay: DelayConfig | None = None
    choose: Literal["one_step", "free_run"] = "one_step"

    def build(self, names: Sequence[str]) -> SymbolicHead:
        """The module for channels `names`."""
        return SymbolicHead(self, names)


@final
class SymbolicHead(EquationHead):
    """rho [..., 3] = phi(features) coefficients, most of them zero; over the baseline `still` it is
    the equation of the acceleration itself.
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
        """All candidate terms [..., J] of chosen features [..., F], held at the edge of the
        training range.
        """
        return self.library(self.features.held(chosen))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Residual [B, 3] at channels z [B, nz], and the past of late inputs one step on."""
        chosen, s = self.line(z.index_select(-1, self.features.index), s)
        return self.basis(chosen) @ self.coefficients.to(z.dtype), s

    def sequence(self, z: Tensor) -> Tensor:
        """Residuals [..., T, 3] along measured channels [..., T, nz], from an empty memory."""
        chosen = self.line.sequence(z.index_select(-1, self.features.index))
        return self.basis(chosen) @ self.coefficients.to(z.dtype)

    def warmup(self, z: Tensor) -> Tensor:
        """Memory [B, n_state] that past channels [B, T, nz] leave, oldest first."""
        return self.line.warmup(z.index_select(-1, self.features.index))

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
        """The equations that the extended BIC chooses; where free runs choose, then those of weaker
        and stronger penalties, and none.

        Raises:
            FitError: where the samples do not tell the candidates apart, or hold no stretch as long
                as the estimator or the delay needs.
        """
        past = self._past(samples)
        steps, told = self._delay(past)
        reduced = self._reduced(past.delayed(steps, self.line.index.numpy()))
        found = [self._solution(reduced, self.config.search, steps, told)]
        if self.config.choose == "free_run":
            others = [
                self.config.search.model_copy(update={"gamma": gamma})
                for gamma in _GAMMAS
                if gamma != self.config.search.gamma
            ]
            tried = [self._solution(reduced, search, steps, told) for search in others]
            found += [
                other
                for other in tried
                if not torch.equal(other.state["coefficients"], found[0].state["coefficients"])
            ]
            none = {
                name: self._written(name, NOTHING, own, steps)
                for name, own in zip(ACCELERATION, reduced, strict=True)
            }
            notes = found[0].notes | {"parameters": 0, "coefficients": [], "equations": none}
            found.append(
                Solution(
                    {"kept": [0, 0, 0]},
                    {"coefficients": torch.zeros_like(self.coefficients)},
                    notes=notes,
                )
            )
        return found

    def _past(self, samples: Samples) -> Past:
        """Features, targets and stretches of the samples; without times where nothing looks along
        them.
        """
        chosen, target = (
            samples.z.index_select(1, self.features.index).numpy(),
            samples.target.numpy(),
        )
        if not self.config.estimator.sequential and self.line.count == 0:
            return Past(chosen, target, samples.group.numpy(), 0.0)
        group, t = samples.group.numpy(), samples.t.numpy()
        step = step_of(group, t)
        return Past(chosen, target, stretches(group, t, step), step)

    def _reduced(self, past: Past) -> list[Reduced]:
        """The candidates' regression of each axis, reduced to its QR factor: one for all axes
        unless symmetry gives them candidates of their own.
        """
        with torch.no_grad():
            terms = self.basis(torch.from_numpy(past.chosen)).numpy()
        motions = self.config.candidates.motions
        exact = np.array(
            [
                all(f.name not in motions for f in parse_term(c.term, self.features.names))
                for c in self.candidates
            ]
        )
        rows = self.config.estimator.rows(Rows(terms, past.target, past.stretch), past.step, exact)
        if not self.config.symmetric:
            return [reduce(rows.x, rows.y, *_columns(self.candidates))] * 3
        out = []
        for axis in range(3):
            own = [
                j
                for j, candidate in enumerate(self.candidates)
                if not wrong_parity(candidate.term, axis, self.features.names)
            ]
            out.append(reduce(rows.x[:, own], rows.y, *_columns([self.candidates[j] for j in own])))
        return out

    def _delay(self, past: Past) -> tuple[int, dict[str, Any]]:
        """The delay in steps: that which fits best with the terms of degree one, then with those
        that are found at it, until it stays.
        """
        if self.line.count == 0:
            return 0, {}
        simple = [c.term for c in self.candidates if c.degree <= 1]
        terms: list[list[str]] = [simple] * 3
        seen: list[int] = []
        profile = np.zeros(0)
        while len(seen) < 2 or (seen[-1] != seen[-2] and len(seen) < _MOST_DELAYS):
            steps, profile = best_delay(
                past, terms, self.features.names, self.line.channels, self.line.longest
            )
            seen.append(steps)
            reduced = self._reduced(past.delayed(steps, self.line.index.numpy()))
            terms = [
                list(
                    dict.fromkeys(
                        (*find(reduced[axis], axis, self.config.search)[0].terms, *simple)
                    )
                )
                for axis in range(3)
            ]
        return seen[-1], {
            "delay": {
                "steps": seen[-1],
                "seconds": seen[-1] * past.step,
                "profile": profile.tolist(),
            }
        }

    def _solution(
        self, reduced: list[Reduced], search: SearchConfig, steps: int, told: dict[str, Any]
    ) -> Solution:
        found = [find(own, axis, search) for axis, own in enumerate(reduced)]
        equations = [equation for equation, _ in found]
        coefficients = torch.zeros_like(self.coefficients)
        for axis, equation in enumerate(equations):
            for term, value in zip(equation.terms, equation.values.tolist(), strict=True):
                coefficients[self.library.terms.index(term), axis] = value
        table = tuple(
            Coefficient(name, term, value, error)
            for name, equation in zip(ACCELERATION, equations, strict=True)
            for term, value, error in zip(
                equation.terms, equation.values.tolist(), equation.errors.tolist(), strict=True
            )
        )
        notes = {
            "terms": self.library.count,
            "parameters": len(table),
            "coefficients": [
                {"axis": c.axis, "term": c.term, "value": c.value, "standard_error": c.error}
                for c in table
            ],
            "unexcited": list(dict.fromkeys(term for own in reduced for term in own.unexcited)),
            "equations": {
                name: self._written(name, *pair, steps)
                for name, pair in zip(ACCELERATION, found, strict=True)
            },
            **told,
        }
        state = {
            "coefficients": coefficients,
            "line.steps": torch.full((1,), float(steps), dtype=torch.float64),
        }
        return Solution(
            {"kept": [len(equation.terms) for equation in equations], "gamma": search.gamma},
            state,
            table,
            notes,
        )

    def _written(
        self, name: str, equation: Equation, within: Reduced, steps: int
    ) -> dict[str, Any]:
        """One equation in writing, with what the data say about it."""
        channels = self.features.names
        factors = [
            [
                Factor("abs" if factor.magnitude else factor.function, factor.name, factor.power)
                for factor in parse_term(term, channels)
            ]
            for term in equation.terms
        ]
        written = Written(name, equation.terms, factors, equation.values.tolist(), channels)
        late = (
            f"; {', '.join(self.line.channels)}: {steps} steps earlier" if self.line.count else ""
        )
        return {
            "text": plain(written),
            "latex": latex(written),
            "sympy": sympy_text(written),
            "c": c_function(
                written, f"{name} in SI units, valid within the range of the training data{late}"
            ),
            **equation.summary(within),
        }


def _columns(candidates: Sequence[Candidate]) -> tuple[list[str], list[int], list[float]]:
    """Terms, degrees and efforts."""
    return (
        [c.term for c in candidates],
        [c.degree for c in candidates],
        [c.effort for c in candidates],
    )
