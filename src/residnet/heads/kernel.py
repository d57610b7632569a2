"""Kernel ridge regression of the residual (document 001 section 3.2, corrections M4, M5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated, Literal, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead, FeatureConfig, Features
from residnet.physics.symmetry import live_of
from residnet.physics.terms import TermLibrary
from residnet.regression.equation_rows import step_of, unbroken_stretches
from residnet.regression.estimator import Solution, fold_numbers, usual_folds
from residnet.regression.kernel import KernelRidge, Path, Polynomial, Rbf, Recursion
from residnet.regression.shrinkage import CONSTANT


class KernelConfig(FeatureConfig):
    """A kernel ridge regression of each residual on standardised features, without intercept.

    Attributes:
        kernel: radial basis functions (`rbf`) or a polynomial (`polynomial`).
        terms: further features, made of the others, such as `n|n|`: the kernel of degree p has
            products of these too. A polynomial of low degree in the revolutions is a poor thrust.
        penalties: candidates, for each sample: the document's lambda (scikit-learn's alpha) is
            penalty * samples.
        choose: what chooses. `free_run`, jointly: the setting of the kernel and one penalty for all
            axes by the error of free runs on validation data, then the penalty of each axis in turn
            for as long as free runs gain, or no residual at all (document 001 section 4, second
            approach); `one_step`: setting and penalty of each axis for itself by cross-validated
            errors of accelerations; `recursion`: of each axis for itself by the error of its own
            velocity in free run along the training records, the other velocities as measured (first
            approach).
        folds: number of folds of the cross-validation; a manoeuvre is never split between folds.
            null for five, or one for each manoeuvre where there are fewer.
    """

    kind: Literal["kernel"] = "kernel"
    kernel: Annotated[Rbf | Polynomial, Field(discriminator="kind")] = Field(default_factory=Rbf)
    terms: tuple[str, ...] = ()
    penalties: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(1e-7, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1), min_length=1
    )
    choose: Literal["one_step", "recursion", "free_run"] = "free_run"
    folds: int | None = Field(default=None, ge=2, le=1_000)

    def build(self, names: Sequence[str]) -> KernelHead:
        """Return the module for channels `names`."""
        return KernelHead(self, names)


@final
class TermFeatures(nn.Module):
    """The standardised terms [..., J] of guarded channels [..., F]."""

    def __init__(self, terms: Sequence[str], channels: Sequence[str]) -> None:
        super().__init__()
        self.library = TermLibrary(terms, channels)
        self.count = self.library.count
        self.mean = nn.Buffer(torch.zeros(self.count, dtype=torch.float64))
        self.std = nn.Buffer(torch.ones(self.count, dtype=torch.float64))

    def calibrate(self, channels: Tensor) -> None:
        """Take mean and standard deviation from the training samples of the channels [N, F].

        Raises:
            FitError: where a term is constant.
        """
        values = self.library(channels)
        std = values.std(0, correction=0)
        for term, still in zip(
            self.library.terms, (std <= CONSTANT * (1 + values.mean(0).abs())).tolist(), strict=True
        ):
            if still:
                raise FitError(
                    f"feature '{term}' is constant over the training samples; leave it out of"
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
    """A head rho [..., n] = f(standardised features), f in the space of a kernel."""

    def __init__(self, config: KernelConfig, names: Sequence[str]) -> None:
        super().__init__(names)
        chosen = config.chosen(names)
        self.features = Features(chosen, names, config.margin)
        self.terms = TermFeatures(config.terms, chosen)
        self.kernel = config.kernel.build(len(chosen) + self.terms.count, self.dof)
        self.config = config
        self.effective = nn.Buffer(torch.zeros(self.dof, dtype=torch.float64))

    def calibrate(self, samples: Samples) -> None:
        super().calibrate(samples)
        if self.terms.count:
            self.terms.calibrate(self.features.guarded(samples.z))

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.kernel(self.columns(z)), s

    def columns(self, z: Tensor) -> Tensor:
        """Return the standardised features and terms [..., F + J]."""
        x = self.features(z)
        return (
            x
            if self.terms.count == 0
            else torch.cat((x, self.terms(self.features.guarded(z))), dim=-1)
        )

    def parameter_count(self) -> list[float]:
        """Return the effective number of parameters of each axis, the trace of the smoother."""
        return [float(count) for count in self.effective]

    def require_samples(self, samples: Samples) -> None:
        fold_numbers(samples.group, self.config.folds or usual_folds(samples.group))

    def solutions(self, samples: Samples) -> list[Solution]:
        scoring = None
        if self.config.choose == "recursion":
            group, t = samples.group.numpy(), samples.t.numpy()
            step = step_of(group, t)
            stretch = torch.from_numpy(unbroken_stretches(group, t, step))
            columns = [samples.names.index(name) for name in live_of(samples.names).moving]
            recursion = Recursion(samples.z, samples.target, stretch, step, columns)
            scoring = partial(self._recursion_errors, recursion)
        estimator = KernelRidge(
            self.kernel,
            self.config.penalties,
            folds=self.config.folds or usual_folds(samples.group),
            scoring=scoring,
            alternatives=self.config.choose == "free_run",
        )
        with torch.no_grad():
            x = self.columns(samples.z)
        found = estimator.fit(x, samples.target, samples.group, outputs=self.outputs)
        return [self._named(solution) for solution in found]

    def _named(self, solution: Solution) -> Solution:
        own = {"effective": "effective"}
        state = {own.get(name, f"kernel.{name}"): value for name, value in solution.state.items()}
        make = solution.neighbours
        neighbours = None if make is None else lambda: [self._named(near) for near in make()]
        return replace(solution, state=state, neighbours=neighbours)

    def _recursion_errors(self, recursion: Recursion, paths: Sequence[Path]) -> Tensor:
        """Return mean square errors of velocities that run alone, [settings, penalties, n]."""
        count = len(self.config.penalties)
        out = torch.zeros(len(paths), count, self.dof, dtype=torch.float64)
        for i, path in enumerate(paths):
            for axis in range(self.dof):
                weights = path.coefficients[:, :, axis]

                def predicted(z: Tensor, path: Path = path, weights: Tensor = weights) -> Tensor:
                    features = self.kernel.features(path, self.columns(z))
                    return torch.einsum("cgp,cp->cg", features, weights)

                with torch.no_grad():
                    out[i, :, axis] = recursion.errors(axis, predicted, count)
        return out
