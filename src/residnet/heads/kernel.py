"""Kernel ridge regression of the residual (document 001 section 3.2, corrections M4, M5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, Features
from residnet.physics.symmetry import get_dof
from residnet.physics.term_library import TermLibrary
from residnet.regression.equation_rows import median_time_step, number_regular_segments
from residnet.regression.estimator import Solution, default_fold_count
from residnet.regression.kernel import KernelRidge, RecursiveErrors, RegularizationPath
from residnet.regression.shrinkage import CONSTANT_TOLERANCE

if TYPE_CHECKING:
    from residnet.heads.kernel_config import KernelConfig


@final
class TermFeatures(nn.Module):
    """Computes standardised terms [..., J] of clamped channels [..., F]."""

    def __init__(self, terms: Sequence[str], channels: Sequence[str]) -> None:
        super().__init__()
        self.library = TermLibrary(terms, channels)
        self.n_terms = self.library.n_terms
        self.mean = nn.Buffer(torch.zeros(self.n_terms, dtype=torch.float64))
        self.std = nn.Buffer(torch.ones(self.n_terms, dtype=torch.float64))

    def calibrate(self, channels: Tensor) -> None:
        """Compute mean and standard deviation from training samples of the channels [N, F].

        Raises:
            FitError: if a term is constant.
        """
        values = self.library(channels)
        std = values.std(0, correction=0)
        for term, is_constant in zip(
            self.library.terms,
            (std <= CONSTANT_TOLERANCE * (1 + values.mean(0).abs())).tolist(),
            strict=True,
        ):
            if is_constant:
                raise FitError(
                    f"feature '{term}' is constant over the training samples; remove it from"
                    " `terms`"
                )
        self.mean.copy_(values.mean(0))
        self.std.copy_(std)

    def forward(self, channels: Tensor) -> Tensor:
        """Return the standardised terms [..., J]."""
        values: Tensor = self.library(channels)
        return (values - self.mean.to(values.dtype)) / self.std.to(values.dtype)


@final
class KernelHead(ClosedFormHead):
    """Head with the residual rho [..., n] = f(standardised features), f a kernel function."""

    def __init__(self, config: KernelConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        feature_names = config.select_features(names)
        self.features = Features(feature_names, names, config.margin)
        self.terms = TermFeatures(config.terms, feature_names)
        self.kernel = config.kernel.build(len(feature_names) + self.terms.n_terms, self.n_dof)
        self.config = config
        self.effective = nn.Buffer(torch.zeros(self.n_dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        super().calibrate(samples)
        if self.terms.n_terms:
            self.terms.calibrate(self.features.select_clamped(samples.z))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.kernel(self.kernel_inputs(z)), s

    def kernel_inputs(self, z: Tensor) -> Tensor:
        """Return the standardised features and terms [..., F + J]."""
        x = self.features(z)
        return (
            x
            if self.terms.n_terms == 0
            else torch.cat((x, self.terms(self.features.select_clamped(z))), dim=-1)
        )

    def parameter_counts(self) -> list[float]:
        """Return the effective number of parameters per axis, the trace of the smoother."""
        return [float(n_effective) for n_effective in self.effective]

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        score_paths = None
        if self.config.choose == "recursion":
            group = samples.group.numpy()
            t = samples.t.numpy()
            # recursion runs one velocity freely, which needs segments without gaps
            time_step = median_time_step(group, t)
            segment = torch.from_numpy(number_regular_segments(group, t, time_step))
            columns = [samples.names.index(name) for name in get_dof(samples.names).dynamic_states]
            recursive_errors = RecursiveErrors(
                samples.z, samples.target, segment, time_step, columns
            )
            score_paths = partial(self._recursion_errors, recursive_errors)
        estimator = KernelRidge(
            self.kernel,
            self.config.penalties,
            folds=self.config.folds or default_fold_count(samples.group),
            scoring=score_paths,
            has_alternatives=self.config.choose == "free_run",
        )
        with torch.no_grad():
            inputs = self.kernel_inputs(samples.z)
        solutions = estimator.fit(inputs, samples.target, samples.group, outputs=self.output_names)
        return [self._to_state(solution) for solution in solutions]

    def _to_state(self, solution: Solution) -> Solution:
        """Return a solution of the kernel with the names of the state of this head."""
        state_names = {"effective": "effective"}
        state = {
            state_names.get(name, f"kernel.{name}"): value for name, value in solution.state.items()
        }
        make_neighbours = solution.neighbours
        neighbours = (
            None
            if make_neighbours is None
            else lambda: [self._to_state(neighbour) for neighbour in make_neighbours()]
        )
        return replace(solution, state=state, neighbours=neighbours)

    def _recursion_errors(
        self, recursive_errors: RecursiveErrors, paths: Sequence[RegularizationPath]
    ) -> Tensor:
        """Return mean squared errors of single-velocity free runs, [settings, penalties, n]."""
        n_penalties = len(self.config.penalties)
        errors = torch.zeros(len(paths), n_penalties, self.n_dof, dtype=torch.float64)
        for i, path in enumerate(paths):
            for axis in range(self.n_dof):
                weights = path.coefficients[:, :, axis]

                def predict(
                    z: Tensor, path: RegularizationPath = path, weights: Tensor = weights
                ) -> Tensor:
                    features = self.kernel.evaluate_features(path, self.kernel_inputs(z))
                    return torch.einsum("cgp,cp->cg", features, weights)

                with torch.no_grad():
                    errors[i, :, axis] = recursive_errors.state_errors(axis, predict, n_penalties)
        return errors
