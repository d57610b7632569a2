"""Kernel ridge regression of the residual.

Source: Moreno-Salinas et al. 2019, section 3.2. The article misprints the inverse matrix of the
solution and the exponent of the radial kernel (`docs/documents/corrections.md`, M4 and M5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, Features
from residnet.physics.symmetry import get_dof
from residnet.physics.term_library import TermLibrary
from residnet.regression.equation_rows import label_regular_segments, median_time_step
from residnet.regression.estimator import Solution, default_fold_count
from residnet.regression.kernel import KernelRidge, RegularizationPath, SingleStateFreeRun
from residnet.regression.shrinkage import CONSTANT_TOLERANCE

if TYPE_CHECKING:
    from residnet.heads.kernel_config import KernelConfig


@final
class TermFeatures(nn.Module):
    """Computes standardised terms [..., J], such as n|n|, of clamped channels [..., F]."""

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
class KernelHead(RenamedStateModule, ClosedFormHead):
    """Head with the residual f(x) = sum over p of a_p k(x, x_p), a kernel expansion [..., n].

    x are standardised features and terms, x_p the support points of the kernel k, and a_p the
    fitted coefficients [n].

    Args:
        config: settings of the head.
        names: names of the channels z of the model.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"effective": "effective_parameters"}

    def __init__(self, config: KernelConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        feature_names = config.select_features(names)
        self.features = Features(feature_names, names, config.margin)
        self.terms = TermFeatures(config.terms, feature_names)
        self.kernel = config.kernel.build(len(feature_names) + self.terms.n_terms, self.n_dof)
        self.config = config
        self.effective_parameters = nn.Buffer(torch.zeros(self.n_dof, dtype=torch.float64))

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
        """Return the effective number of parameters per axis: the trace of the smoother matrix."""
        return [float(n_effective) for n_effective in self.effective_parameters]

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        # criterion of kernel setting and penalty; None for the cross-validated one-step error
        score_paths = None
        if self.config.choose == "recursion":
            group = samples.group.numpy()
            t = samples.t.numpy()
            # the free run of a single velocity needs segments without gaps
            time_step = median_time_step(group, t)
            segment = torch.from_numpy(label_regular_segments(group, t, time_step))
            columns = [samples.names.index(name) for name in get_dof(samples.names).dynamic_states]
            free_run = SingleStateFreeRun(samples.z, samples.target, segment, time_step, columns)
            score_paths = partial(self._free_run_errors, free_run)
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
        return [self._with_head_state(solution) for solution in solutions]

    def _with_head_state(self, solution: Solution) -> Solution:
        """Rename the state of a kernel solution to the entries of this head's state_dict."""
        state = {
            name if name == "effective_parameters" else f"kernel.{name}": value
            for name, value in solution.state.items()
        }
        # solutions of neighbouring penalties are computed only when a selection asks for them
        make_neighbours = solution.neighbours
        neighbours = (
            None
            if make_neighbours is None
            else lambda: [self._with_head_state(neighbour) for neighbour in make_neighbours()]
        )
        return replace(solution, state=state, neighbours=neighbours)

    def _free_run_errors(
        self, free_run: SingleStateFreeRun, paths: Sequence[RegularizationPath]
    ) -> Tensor:
        """Return mean squared errors of single-velocity free runs, [settings, penalties, n].

        Args:
            free_run: free runs of one velocity with the other velocities as measured.
            paths: solutions of all penalties, one path per kernel setting.
        """
        n_penalties = len(self.config.penalties)
        errors = torch.zeros(len(paths), n_penalties, self.n_dof, dtype=torch.float64)
        for i, path in enumerate(paths):
            for axis in range(self.n_dof):
                weights = path.coefficients[:, :, axis]

                def predict(
                    z: Tensor, path: RegularizationPath = path, weights: Tensor = weights
                ) -> Tensor:
                    features = self.kernel.evaluate_features(path, self.kernel_inputs(z))
                    # penalty c, segment g, support point p: the expansion of each penalty
                    return torch.einsum("cgp,cp->cg", features, weights)

                with torch.no_grad():
                    errors[i, :, axis] = free_run.state_errors(axis, predict, n_penalties)
        return errors
