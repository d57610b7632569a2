"""Symbolic head: a sparse equation of the residual or of the acceleration (documents 000, 001)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import EquationHead, Features
from residnet.physics.symmetry import compute_term_parity, get_axis_parities
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import parse_term
from residnet.regression.equation_rows import (
    RegressionRows,
    label_regular_segments,
    median_time_step,
)
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.expressions import format_equation, format_sum, terms_to_sympy
from residnet.regression.lack_of_fit import (
    estimate_lack_of_fit,
    probe_families,
    select_test_rows,
)
from residnet.regression.sparse import SparseRegression

if TYPE_CHECKING:
    from residnet.heads.symbolic_config import DelayConfig, SymbolicConfig

_ROUNDING_SHARE = 1e-14
"""Relative residual energy below which a fit is at the level of rounding errors."""
_RANK_TOLERANCE = 1e-10
"""Ratio to the largest eigenvalue below which an eigenvalue counts as zero."""
_MIN_NORM = 1e-300
"""Lower bound of the norm of a term and of the argument of the logarithm of an error."""


class DelayLine(nn.Module):
    """Delay line that delays some of the channels by `delay_steps` time steps.

    The memory contains the last `max_delay` values of the delayed channels, oldest first, and a
    flag that is 1 after the first sample. Before the first sample the channels are assumed equal to
    it, because zeros are not a plausible state and a term that divides by them is undefined.
    """

    def __init__(self, config: DelayConfig | None, names: Sequence[str]) -> None:
        super().__init__()
        delayed_names = config.channels if config is not None else ()
        if config is not None:
            config.require_features(names)
        self.max_delay = config.longest if config is not None else 0
        self.delayed_names = delayed_names
        self.n_delayed = len(delayed_names)
        self.n_state = self.max_delay * self.n_delayed + 1 if self.n_delayed > 0 else 0
        self.delayed_index = nn.Buffer(
            torch.tensor([list(names).index(name) for name in delayed_names], dtype=torch.long),
            persistent=False,
        )
        # stored as a float like all buffers, because models are cast to a dtype as a whole
        self.steps = nn.Buffer(torch.zeros(1, dtype=torch.float64))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Delay channels [B, nz] by the memory; return them and the next memory [B, n_state]."""
        if self.n_delayed == 0:
            return z, s
        current = z.index_select(-1, self.delayed_index)
        # an empty memory (flag 0) is filled with the first sample
        buffered = torch.where(s[..., -1:] > 0, s[..., :-1], self._repeat_to_line(current))
        delay_line = torch.cat((buffered, current), dim=-1)
        # the line is ordered from old to new: a delay of d steps begins d blocks before the end
        first_column = (self.max_delay - self.steps.round().to(torch.long)) * self.n_delayed
        delayed = delay_line.index_select(
            -1, first_column + torch.arange(self.n_delayed, device=z.device)
        )
        next_memory = torch.cat(
            (delay_line[..., self.n_delayed :], torch.ones_like(s[..., -1:])), dim=-1
        )
        return z.index_copy(-1, self.delayed_index, delayed), next_memory

    def _repeat_to_line(self, current: Tensor) -> Tensor:
        """Return the delay line [..., max_delay * C] filled with the delayed channels [..., C]."""
        return current.unsqueeze(-2).repeat_interleave(self.max_delay, dim=-2).flatten(-2)

    def delay_sequence(self, z: Tensor) -> Tensor:
        """Delay channels [..., T, nz], from an empty memory."""
        if self.n_delayed == 0:
            return z
        undelayed = z.index_select(-1, self.delayed_index)
        delay_line = torch.cat(
            (undelayed[..., :1, :].repeat_interleave(self.max_delay, dim=-2), undelayed), dim=-2
        )
        first_row = self.max_delay - self.steps.round().to(torch.long)
        return z.index_copy(
            -1,
            self.delayed_index,
            delay_line.index_select(-2, first_row + torch.arange(z.shape[-2], device=z.device)),
        )

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] after channels [B, T, nz]; zeros for T = 0."""
        if self.n_delayed == 0 or z.shape[1] == 0:
            return z.new_zeros((z.shape[0], self.n_state))
        undelayed = z.index_select(-1, self.delayed_index)
        delay_line = torch.cat(
            (undelayed[:, :1].repeat_interleave(self.max_delay, dim=1), undelayed), dim=1
        )
        buffered = delay_line[:, delay_line.shape[1] - self.max_delay :].flatten(1)
        return torch.cat((buffered, torch.ones_like(buffered[:, :1])), dim=-1)

    def memory_bounds(self, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bounds of the memory [n_state] from the bounds of the channels [nz]."""
        if self.n_delayed == 0:
            return lower[:0], upper[:0]
        lower_memory, upper_memory = (
            limit[self.delayed_index].repeat(self.max_delay) for limit in (lower, upper)
        )
        # the memory without a past is zero, which need not be in the range of a channel
        return torch.cat((lower_memory.clamp(max=0.0), lower_memory.new_zeros(1))), (
            torch.cat((upper_memory.clamp(min=0.0), upper_memory.new_ones(1)))
        )


class SegmentedSamples(NamedTuple):
    """Samples of a fit in uninterrupted segments, which allows delays.

    Attributes:
        features: features [N, F].
        target: targets [N, n].
        segment: number of the uninterrupted segment of each sample, ascending [N].
        time_step: sampling interval, s.
    """

    features: np.ndarray
    target: np.ndarray
    segment: np.ndarray
    time_step: float

    def with_delay(
        self, delay_steps: int, delayed_index: np.ndarray, min_past: int = 0
    ) -> SegmentedSamples:
        """Return the samples with some features delayed.

        Args:
            delayed_index: indices of the delayed features.
            delay_steps: delay in samples.
            min_past: samples with fewer preceding samples in their segment are removed.
        """
        n_past = max(delay_steps, min_past)
        current = np.arange(n_past, len(self.segment))
        current = current[self.segment[current] == self.segment[current - n_past]]
        features = self.features[current].copy()
        features[:, delayed_index] = self.features[current - delay_steps][:, delayed_index]
        return SegmentedSamples(
            features, self.target[current], self.segment[current], self.time_step
        )


def find_best_delay(
    samples: SegmentedSamples,
    terms: Sequence[Sequence[str]],
    names: Sequence[str],
    delayed_index: np.ndarray,
    max_delay: int,
) -> tuple[int, np.ndarray]:
    """Select the delay of minimum least-squares error; return it and the error profile.

    The profile [max_delay + 1] is the mean over the targets of ln(RSS) for each delay, evaluated on
    the same samples for all delays (Halvorsen 2019, section 5.3.4).

    Args:
        samples: samples in segments.
        terms: terms of each target.
        names: names of the features.
        delayed_index: indices of the delayed features.
        max_delay: maximum delay in time steps.

    Raises:
        FitError: if there are fewer samples with a sufficient past than terms.
    """
    profile = np.zeros(max_delay + 1)
    libraries = [TermLibrary(target_terms, names) for target_terms in terms]
    for delay_steps in range(max_delay + 1):
        delayed = samples.with_delay(delay_steps, delayed_index, max_delay)
        z = torch.from_numpy(delayed.features)
        max_terms = max(map(len, terms))
        if len(z) <= max_terms:
            raise FitError(
                f"delay: {len(z)} samples have {max_delay} preceding samples, which is too few for"
                f" {max_terms} terms; give longer logs or a shorter delay"
            )
        for library, target in zip(libraries, delayed.target.T, strict=True):
            columns = library(z).numpy()
            columns = columns / np.maximum(np.linalg.norm(columns, axis=0), _MIN_NORM)
            # candidates may be collinear, so use the pseudoinverse
            gram_inverse = np.linalg.pinv(
                columns.T @ columns, rcond=_RANK_TOLERANCE, hermitian=True
            )
            target_energy = float(target @ target)
            projection = columns.T @ target
            # RSS of the projection: y'y - (X'y)' (X'X)^+ X'y
            rss = max(target_energy - float(projection @ gram_inverse @ projection), 0.0)
            # differences at the level of rounding errors must not decide between delays
            profile[delay_steps] += np.log(rss + _ROUNDING_SHARE * target_energy + _MIN_NORM) / len(
                terms
            )
    return int(profile.argmin()), profile


_GAMMAS = (0.0, 0.5, 1.0)
"""Weights gamma of the extended BIC of the alternatives if free runs select."""
_MAX_DELAY_ROUNDS = 6
"""Maximum number of iterations of the search for a delay."""


@final
class SymbolicHead(EquationHead):
    """Head with the residual rho [..., n] = phi(features) coefficients, with sparse coefficients.

    With the baseline `still` it is an equation of the acceleration.
    """

    def __init__(self, config: SymbolicConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        self.axis_signs = get_axis_parities(names)
        feature_names = config.select_features(names)
        self.features = Features(feature_names, names, config.margin)
        self.line = DelayLine(config.delay, feature_names)
        self.n_state = self.line.n_state
        self.config = config
        self.candidates = config.rank_terms(feature_names)
        self.library = TermLibrary([candidate.term for candidate in self.candidates], feature_names)
        self.coefficients = nn.Buffer(
            torch.zeros(self.library.n_terms, self.n_dof, dtype=torch.float64)
        )

    def candidate_values(self, features: Tensor) -> Tensor:
        """Return all candidate terms [..., J] of features [..., F], which are clamped."""
        term_values: Tensor = self.library(self.features.clamp(features))
        return term_values

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, n] at channels z [B, nz], and the next delay line."""
        features, s = self.line(self.features.select_clamped(z), s)
        return self.candidate_values(features) @ self.coefficients.to(z.dtype), s

    def teacher_forced_residuals(self, z: Tensor) -> Tensor:
        features = self.line.delay_sequence(self.features.select_clamped(z))
        return self.candidate_values(features) @ self.coefficients.to(z.dtype)

    def warmup(self, z: Tensor) -> Tensor:
        return self.line.warmup(self.features.select_clamped(z))

    def memory_bounds(self) -> tuple[Tensor, Tensor]:
        """Return the bounds of the delay line, which are the bounds of the clamped features."""
        return self.line.memory_bounds(self.features.low, self.features.high)

    def format_terms(self) -> list[str]:
        return list(self.library.terms)

    def evaluate_terms(self, z: Tensor) -> tuple[Tensor, Tensor]:
        features = self.line.delay_sequence(z.index_select(-1, self.features.index))
        return self.candidate_values(features), self.coefficients

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Fit the equations of the extended BIC, then alternatives for free runs.

        The alternatives are the equations with other weights gamma, and no equation.

        Raises:
            FitError: if the candidates are linearly dependent on the samples, or no segment is as
                long as the rows or the delay require.
        """
        samples_with_past = self._segment_samples(samples)
        delay_steps, delay_notes = self._fit_delay(samples_with_past)
        gammas = _GAMMAS if self.config.choose == "free_run" else ()
        delayed_samples = samples_with_past.with_delay(delay_steps, self.line.delayed_index.numpy())
        solutions = self._fit_equations(delayed_samples, gammas)
        lack_of_fit = self._estimate_lack_of_fit(delayed_samples)
        return [
            self._add_delay_and_text(solution, delay_steps, delay_notes, lack_of_fit)
            for solution in solutions
        ]

    def _segment_samples(self, samples: Samples) -> SegmentedSamples:
        """Return features, targets and segments of the samples.

        Sample times are needed only for rows of the weak form and delays.
        """
        features = samples.z.index_select(1, self.features.index).numpy()
        target = samples.target.numpy()
        group = samples.group.numpy()
        if not self.config.estimator.sequential and self.line.n_delayed == 0:
            return SegmentedSamples(features, target, group, 0.0)
        t = samples.t.numpy()
        time_step = median_time_step(group, t)
        return SegmentedSamples(
            features, target, label_regular_segments(group, t, time_step), time_step
        )

    def _fit_equations(
        self, samples: SegmentedSamples, gammas: Sequence[float] = ()
    ) -> list[Solution]:
        """Fit sparse equations to delayed samples; first that of the search, then one per gamma."""
        with torch.no_grad():
            term_values = self.candidate_values(torch.from_numpy(samples.features)).numpy()
        regression_rows = self.config.estimator.build_rows(
            RegressionRows(term_values, samples.target, samples.segment), samples.time_step
        )
        estimator = SparseRegression(
            self.config.search,
            degrees=[candidate.degree for candidate in self.candidates],
            complexities=[candidate.complexity for candidate in self.candidates],
            allowed_terms=self._allowed_terms(samples),
            gammas=gammas,
        )
        design_matrix = torch.from_numpy(regression_rows.x)
        targets = torch.from_numpy(regression_rows.y)
        return estimator.fit(
            design_matrix, targets, names=self.library.terms, outputs=self.output_names
        )

    def _estimate_lack_of_fit(self, samples: SegmentedSamples) -> dict[str, dict[str, float]]:
        """Return the lack of fit of all candidates of each axis by family of functions."""
        is_allowed = self._allowed_terms(samples).numpy()
        if not self.config.estimator.sequential:
            # probes of all samples would take several times the memory of the fit
            rows = select_test_rows(len(samples.target))
            samples = SegmentedSamples(
                samples.features[rows],
                samples.target[rows],
                samples.segment[rows],
                samples.time_step,
            )
        with torch.no_grad():
            term_values = self.candidate_values(torch.from_numpy(samples.features)).numpy()
        families, probes = probe_families(samples.features, self.features.names)
        # rows of the weak form are linear in the columns, so probes are integrated like terms
        regression_rows = self.config.estimator.build_rows(
            RegressionRows(
                np.concatenate((term_values, *probes), axis=1), samples.target, samples.segment
            ),
            samples.time_step,
        )
        n_terms = term_values.shape[1]
        probe_ends = n_terms + np.cumsum([columns.shape[1] for columns in probes])
        probe_columns = np.split(regression_rows.x, [n_terms, *probe_ends[:-1]], axis=1)[1:]
        return {
            output: estimate_lack_of_fit(
                regression_rows.x[:, :n_terms][:, is_allowed[:, k]],
                regression_rows.y[:, k],
                families,
                probe_columns,
            )
            for k, output in enumerate(self.output_names)
        }

    def _allowed_terms(self, samples: SegmentedSamples) -> Tensor:
        """Return the mask of the candidates of each axis, [J, n]."""
        channels = self.features.names
        is_allowed = torch.ones(self.library.n_terms, self.n_dof, dtype=torch.bool)
        if not self.config.terms:
            z = torch.from_numpy(samples.features)
            is_allowed &= self.config.candidates.find_nonsingular_terms(
                self.library.terms, channels, z
            )[:, None]
        if self.config.symmetric:
            term_parities = [compute_term_parity(term, channels) for term in self.library.terms]
            matches_symmetry = [
                [term_sign in (None, axis_sign) for axis_sign in self.axis_signs]
                for term_sign in term_parities
            ]
            is_allowed &= torch.tensor(matches_symmetry)
        return is_allowed

    def _fit_delay(self, samples: SegmentedSamples) -> tuple[int, dict[str, Any]]:
        """Identify the delay; return it in time steps, and the notes of the fit.

        The iteration starts with the delay of minimum error for the terms of degree one. It
        alternates between the terms at a delay and the best delay for these terms, until the delay
        does not change.
        """
        if self.line.n_delayed == 0:
            return 0, {}
        is_possible = self._allowed_terms(samples).any(1).tolist()
        delayed_index = self.line.delayed_index.numpy()
        linear_terms = [
            candidate.term
            for candidate, is_term_possible in zip(self.candidates, is_possible, strict=True)
            if is_term_possible and candidate.degree <= 1
        ]
        terms: list[list[str]] = [linear_terms] * self.n_dof
        tried_delays: list[int] = []
        profile = np.zeros(0)
        # delay and terms depend on each other: a fixed-point iteration with a limit of rounds
        while len(tried_delays) < 2 or (
            tried_delays[-1] != tried_delays[-2] and len(tried_delays) < _MAX_DELAY_ROUNDS
        ):
            delay_steps, profile = find_best_delay(
                samples, terms, self.features.names, delayed_index, self.line.max_delay
            )
            tried_delays.append(delay_steps)
            coefficients = self._fit_equations(samples.with_delay(delay_steps, delayed_index))[
                0
            ].table
            found_terms = [
                [coefficient.term for coefficient in coefficients if coefficient.axis == name]
                for name in self.output_names
            ]
            terms = [
                list(dict.fromkeys((*axis_terms, *linear_terms))) for axis_terms in found_terms
            ]
        notes = {
            "steps": tried_delays[-1],
            "seconds": tried_delays[-1] * samples.time_step,
            "profile": profile.tolist(),
        }
        return tried_delays[-1], {"delay": notes}

    def _add_delay_and_text(
        self,
        solution: Solution,
        delay_steps: int,
        delay_notes: dict[str, Any],
        lack_of_fit: dict[str, dict[str, float]],
    ) -> Solution:
        """Add the delay to the state of a solution; equations and lack of fit to its notes."""
        equations = {
            name: self._format_solution(
                name,
                [coefficient for coefficient in solution.table if coefficient.axis == name],
                delay_steps,
            )
            | notes
            | {"lack_of_fit": lack_of_fit[name]}
            for name, notes in solution.notes["equations"].items()
        }
        delay_state = {"line.steps": torch.full((1,), float(delay_steps), dtype=torch.float64)}
        return replace(
            solution,
            state=solution.state | delay_state,
            notes=solution.notes | {"equations": equations} | delay_notes,
        )

    def _format_solution(
        self, name: str, terms: Sequence[Coefficient], delay_steps: int
    ) -> dict[str, str]:
        """Return the equation of one acceleration in several notations."""
        channels = self.features.names
        weights = [coefficient.value for coefficient in terms]
        factors = [
            [
                ("abs" if factor.magnitude else factor.function, factor.name, factor.power)
                for factor in parse_term(coefficient.term, channels)
            ]
            for coefficient in terms
        ]
        delay_text = ""
        if self.line.n_delayed:
            delay_text = f"; {', '.join(self.line.delayed_names)}: {delay_steps} steps earlier"
        comment = f"{name} in SI units, valid within the range of the training data{delay_text}"
        right_hand_side = format_sum([coefficient.term for coefficient in terms], weights)
        return format_equation(
            name, right_hand_side, terms_to_sympy(factors, weights), channels, comment
        )
