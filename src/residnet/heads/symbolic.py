"""The symbolic head: an equation of few terms (documents 000 and 001).

It is that of the residual, or of the whole acceleration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError, FitError
from residnet.core.names import nearest
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, FeatureConfig, Features
from residnet.physics.symmetry import axis_parities, term_parity
from residnet.physics.terms import CandidatesConfig, TermLibrary, parse_term, rated
from residnet.regression.equation_rows import (
    Rows,
    RowsConfig,
    SampleRows,
    step_of,
    unbroken_stretches,
)
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.expressions import equation, symbolic, total
from residnet.regression.sparse import SearchConfig, SparseRegression

_PRECISION = 1e-14
"""Share of the energy of a target that rounding leaves."""
_ROUNDED = 1e-10
"""Share of the largest eigenvalue up to which one is what rounding leaves."""
_TINY = 1e-300
"""Keeps the logarithm of the error of a target of zeros finite, and least length of a term."""


class DelayConfig(Config):
    """A delay that the fit finds, one for all of its channels.

    Attributes:
        channels: inputs that act late.
        longest: longest delay that is tried, in steps of the grid; the memory holds as many
            samples, and whether there was one.
    """

    channels: tuple[str, ...] = Field(min_length=1)
    longest: int = Field(default=20, ge=1, le=500)


class DelayLine(nn.Module):
    """The channels with some of them as they were `steps` ago.

    The memory holds the last `longest` values of these, oldest first, and behind them 1 once there
    was a sample, 0 before. What lies before the first sample is taken to be like it: zeros would
    be no state of the vessel, and a term that divides by one of them would be no number.
    """

    def __init__(self, config: DelayConfig | None, names: Sequence[str]) -> None:
        super().__init__()
        late = config.channels if config is not None else ()
        for name in late:
            if name not in names:
                raise ConfigError(
                    f"delay: '{name}' is not a feature of the head{nearest(name, names)}"
                )
        self.longest = config.longest if config is not None else 0
        self.channels = late
        self.count = len(late)
        self.n_state = self.longest * self.count + 1 if self.count > 0 else 0
        self.index = nn.Buffer(
            torch.tensor([list(names).index(name) for name in late], dtype=torch.long),
            persistent=False,
        )
        # a float, as all stored numbers are
        self.steps = nn.Buffer(torch.zeros(1, dtype=torch.float64))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return channels [B, nz] with the late ones delayed, and the next memory [B, n_state]."""
        if self.count == 0:
            return z, s
        now = z.index_select(-1, self.index)
        past = torch.where(s[..., -1:] > 0, s[..., :-1], self._repeated(now))
        line = torch.cat((past, now), dim=-1)
        first = (self.longest - self.steps.round().to(torch.long)) * self.count
        late = line.index_select(-1, first + torch.arange(self.count, device=z.device))
        after = torch.cat((line[..., self.count :], torch.ones_like(s[..., -1:])), dim=-1)
        return z.index_copy(-1, self.index, late), after

    def _repeated(self, late: Tensor) -> Tensor:
        """Return the line [..., longest * count] that late channels [..., count] fill alone."""
        return late.unsqueeze(-2).repeat_interleave(self.longest, dim=-2).flatten(-2)

    def sequence(self, z: Tensor) -> Tensor:
        """Return channels [..., T, nz] with the late ones delayed, from an empty memory."""
        if self.count == 0:
            return z
        late = z.index_select(-1, self.index)
        line = torch.cat((late[..., :1, :].repeat_interleave(self.longest, dim=-2), late), dim=-2)
        first = self.longest - self.steps.round().to(torch.long)
        return z.index_copy(
            -1,
            self.index,
            line.index_select(-2, first + torch.arange(z.shape[-2], device=z.device)),
        )

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] after channels [B, T, nz]; zeros without any."""
        if self.count == 0 or z.shape[1] == 0:
            return z.new_zeros((z.shape[0], self.n_state))
        late = z.index_select(-1, self.index)
        line = torch.cat((late[:, :1].repeat_interleave(self.longest, dim=1), late), dim=1)
        past = line[:, line.shape[1] - self.longest :].flatten(1)
        return torch.cat((past, torch.ones_like(past[:, :1])), dim=-1)

    def memory_range(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], from those of all channels [nz]."""
        if self.count == 0:
            return low[:0], high[:0]
        first, last = (edge[self.index].repeat(self.longest) for edge in (low, high))
        # the memory without a past is zeros
        return torch.cat((first.clamp(max=0.0), first.new_zeros(1))), (
            torch.cat((last.clamp(min=0.0), last.new_ones(1)))
        )


class Past(NamedTuple):
    """The samples of a fit with what lies before them.

    Attributes:
        chosen: features [N, F].
        target: outputs [N, n].
        stretch: number of the unbroken stretch of each sample, ascending [N].
        step: time between neighbouring samples, s.
    """

    chosen: np.ndarray
    target: np.ndarray
    stretch: np.ndarray
    step: float

    def delayed(self, steps: int, index: np.ndarray, least: int = 0) -> Past:
        """Return samples with the features `index` from `steps` before.

        Those are left out that have no past of so many samples, and of `least`.
        """
        reach = max(steps, least)
        now = np.arange(reach, len(self.stretch))
        now = now[self.stretch[now] == self.stretch[now - reach]]
        chosen = self.chosen[now].copy()
        chosen[:, index] = self.chosen[now - steps][:, index]
        return Past(chosen, self.target[now], self.stretch[now], self.step)


def best_delay(
    past: Past,
    terms: Sequence[Sequence[str]],
    names: Sequence[str],
    index: np.ndarray,
    longest: int,
) -> tuple[int, np.ndarray]:
    """Return the delay at which terms explain their targets best, and the profile of errors.

    The delay is in steps; the profile is the mean over targets of ln(RSS) for each delay [longest +
    1]. All delays are judged on the same samples (document 000 section 5.3.4).

    Args:
        past: samples.
        terms: of each target.
        names: of the features.
        index: places of those that act late.
        longest: longest delay, in steps.

    Raises:
        FitError: with fewer samples that have a past than terms.
    """
    profile, libraries = np.zeros(longest + 1), [TermLibrary(row, names) for row in terms]
    for steps in range(longest + 1):
        late = past.delayed(steps, index, longest)
        z, most = torch.from_numpy(late.chosen), max(map(len, terms))
        if len(z) <= most:
            raise FitError(
                f"delay: {len(z)} samples have a past of {longest} samples, {most} terms need more;"
                " give longer logs or a shorter delay"
            )
        for library, y in zip(libraries, late.target.T, strict=True):
            x = library(z).numpy()
            x = x / np.maximum(np.linalg.norm(x, axis=0), _TINY)
            # candidates may be collinear: what rounding cannot tell apart shares its part
            inverse = np.linalg.pinv(x.T @ x, rcond=_ROUNDED, hermitian=True)
            energy, along = float(y @ y), x.T @ y
            rss = max(energy - float(along @ inverse @ along), 0.0)
            # what rounding leaves of a perfect fit is no evidence
            profile[steps] += np.log(rss + _PRECISION * energy + _TINY) / len(terms)
    return int(profile.argmin()), profile


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
        estimator: what a row of the regression is: a sample, or a window of the weak form.
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
    """A head rho [..., n] = phi(features) coefficients, most of them zero.

    Over the baseline `still` it is the equation of the acceleration itself.
    """

    def __init__(self, config: SymbolicConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.parities = axis_parities(names)
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
        self.coefficients = nn.Buffer(
            torch.zeros(self.library.count, self.dof, dtype=torch.float64)
        )

    def basis(self, chosen: Tensor) -> Tensor:
        """Return all candidate terms [..., J] of chosen features [..., F].

        The features are held at the edge of the training range.
        """
        values: Tensor = self.library(self.features.held(chosen))
        return values

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, n] at channels z [B, nz], and the late inputs as memory."""
        chosen, s = self.line(self.features.guarded(z), s)
        return self.basis(chosen) @ self.coefficients.to(z.dtype), s

    def sequence(self, z: Tensor) -> Tensor:
        chosen = self.line.sequence(self.features.guarded(z))
        return self.basis(chosen) @ self.coefficients.to(z.dtype)

    def warmup(self, z: Tensor) -> Tensor:
        return self.line.warmup(self.features.guarded(z))

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest late inputs: those that the features are held between."""
        return self.line.memory_range(self.features.low, self.features.high)

    def names(self) -> list[str]:
        return list(self.library.terms)

    def along(self, z: Tensor) -> tuple[Tensor, Tensor]:
        chosen = self.line.sequence(z.index_select(-1, self.features.index))
        return self.basis(chosen), self.coefficients

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
        with torch.no_grad():
            terms = self.basis(torch.from_numpy(past.chosen)).numpy()
        rows = self.config.estimator.rows(Rows(terms, past.target, past.stretch), past.step)
        estimator = SparseRegression(
            self.config.search,
            degrees=[candidate.degree for candidate in self.candidates],
            efforts=[candidate.effort for candidate in self.candidates],
            allowed=self._allowed(past),
            gammas=gammas,
        )
        x, y = torch.from_numpy(rows.x), torch.from_numpy(rows.y)
        return estimator.fit(x, y, names=self.library.terms, outputs=self.outputs)

    def _allowed(self, past: Past) -> Tensor:
        """Return which candidates each axis may have, [J, n] bool."""
        channels = self.features.names
        allowed = torch.ones(self.library.count, self.dof, dtype=torch.bool)
        if not self.config.terms:
            z = torch.from_numpy(past.chosen)
            allowed &= self.config.candidates.clear(self.library.terms, channels, z)[:, None]
        if self.config.symmetric:
            parities = [term_parity(term, channels) for term in self.library.terms]
            even = [[parity in (None, own) for own in self.parities] for parity in parities]
            allowed &= torch.tensor(even)
        return allowed

    def _delay(self, past: Past) -> tuple[int, dict[str, Any]]:
        """Return the delay in steps, and the notes about it.

        It is the one that fits best with the terms of degree one, then with those that are found at
        it, until it stays.
        """
        if self.line.count == 0:
            return 0, {}
        possible, index = self._allowed(past).any(1).tolist(), self.line.index.numpy()
        simple = [
            c.term
            for c, some in zip(self.candidates, possible, strict=True)
            if some and c.degree <= 1
        ]
        terms: list[list[str]] = [simple] * self.dof
        tried: list[int] = []
        profile = np.zeros(0)
        while len(tried) < 2 or (tried[-1] != tried[-2] and len(tried) < _MOST_DELAYS):
            steps, profile = best_delay(past, terms, self.features.names, index, self.line.longest)
            tried.append(steps)
            table = self._fit(past.delayed(steps, index))[0].table
            found = [[c.term for c in table if c.axis == name] for name in self.outputs]
            terms = [list(dict.fromkeys((*row, *simple))) for row in found]
        notes = {"steps": tried[-1], "seconds": tried[-1] * past.step, "profile": profile.tolist()}
        return tried[-1], {"delay": notes}

    def _complete(self, solution: Solution, steps: int, delay: dict[str, Any]) -> Solution:
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
