"""Interfaces of baselines, the part of the dynamics that is fixed or identified first."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.core.layout import PLANAR_LAYOUT
from residnet.core.samples import Samples
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.least_squares import minimize_levenberg_marquardt


class Baseline(nn.Module, ABC):
    """Memoryless model of the accelerations [..., n] at channels z [..., nz].

    Accelerations are in m/s^2 and rad/s^2. A subclass needs `forward` only.

    Attributes:
        n_dof: number of accelerations n; surge, sway and yaw by default.
    """

    n_dof: int = PLANAR_LAYOUT.n_dof

    @abstractmethod
    def forward(self, z: Tensor) -> Tensor:
        """Compute nu_dot [..., n] at channels z [..., nz] (see `residnet.physics.signals`)."""

    def parameter_counts(self) -> list[float]:
        """Return the number of fitted parameters per axis.

        By default every parameter counts for every axis.
        """
        return [float(sum(parameter.numel() for parameter in self.parameters()))] * self.n_dof

    def inertia_matrix(self) -> Tensor | None:
        """Return the inertia matrix [3, 3], float64; None if the baseline models no forces."""
        return None


class ParametricBaseline(Baseline, ABC):
    """Baseline whose fitted values are all elements of the parameter `theta`.

    The parameters can be refitted on free runs and sampled from their distribution.

    Args:
        theta: initial values of any shape; `free_indices` selects the P free parameters.
    """

    def __init__(self, theta: Tensor) -> None:
        super().__init__()
        # least squares and refits set theta; gradient descent on a head must not change it
        self.theta = nn.Parameter(theta, requires_grad=False)

    @abstractmethod
    def free_indices(self) -> Tensor:
        """Return the indices [P] of the free parameters in the flattened theta."""

    @final
    def get_free(self) -> Tensor:
        """Return the current values of the free parameters [P]."""
        return self.theta.detach().flatten()[self.free_indices()].clone()

    @final
    def set_free(self, values: Tensor) -> None:
        """Set the values of the free parameters [P]."""
        with torch.no_grad():
            flat_theta = self.theta.detach().clone().flatten()
            flat_theta[self.free_indices()] = values.to(flat_theta.dtype)
            self.theta.copy_(flat_theta.reshape(self.theta.shape))

    @abstractmethod
    def free_parameter_names(self) -> list[tuple[str, str]]:
        """Return the P pairs (axis, term) of the free parameters as in the coefficient table."""

    @final
    def parameter_jacobian(self, z: Tensor) -> Tensor:
        """Return the Jacobian [B, n, P] of nu_dot with respect to the free parameters.

        The derivatives are exact: reverse-mode differentiation of each row, vectorised over rows.

        Args:
            z: channels [B, nz].
        """

        def nu_dot(theta: Tensor, channels: Tensor) -> Tensor:
            acceleration: Tensor = torch.func.functional_call(self, {"theta": theta}, (channels,))
            return acceleration

        # reverse mode: a row has few accelerations and many parameters
        jacobian_of_row = torch.func.vmap(torch.func.jacrev(nu_dot), in_dims=(None, 0))
        jacobian: Tensor = jacobian_of_row(self.theta.detach().to(z.dtype), z)
        return jacobian.flatten(2)[..., self.free_indices()]

    @abstractmethod
    def mean_information(self, samples: Samples) -> Tensor:
        """Return the Fisher information [P, P] of the accelerations per sample.

        The information concerns the free parameters and is the mean over the samples.
        """

    @abstractmethod
    def prior(self) -> tuple[Tensor, Tensor]:
        """Return the prior mean [P] and precision [P] of the free parameters.

        The precision of a parameter without prior is zero.
        """

    @abstractmethod
    def symmetry_precision(self, samples: Samples) -> Tensor:
        """Return the precision matrix [P, P] of a prior for port/starboard symmetry.

        It penalises terms of the wrong parity and differences between the coefficients of a term
        and its mirror image. It is zero for terms with an unknown mirror image.
        """

    def destabilising_terms(self) -> list[int]:
        """Return the indices of free parameters that cause negative damping by their sign.

        The list is empty for a baseline that excludes negative damping or does not check for it.
        """
        return []

    def undamped_terms(self, samples: Samples) -> list[int]:
        """Return indices of free parameters that cause negative damping at most samples.

        There is at most one per axis. The list is empty as for `destabilising_terms`.
        """
        return []

    @abstractmethod
    def refresh_table(
        self, table: Sequence[Coefficient], standard_errors: Tensor
    ) -> list[Coefficient]:
        """Return the coefficient table with the current values of theta.

        Args:
            table: coefficient table of the fit.
            standard_errors: standard errors of the free parameters [P]. The standard errors of
                ratios, such as time constants, are not changed.
        """


def select_manoeuvres(samples: Samples, kinds: Sequence[str]) -> Samples:
    """Return the samples of some kinds of manoeuvre; all samples if `kinds` is empty.

    Raises:
        FitError: if there are no such samples.
    """
    samples.origins.require_manoeuvres(kinds)
    return samples.select_manoeuvres(kinds)


_MAX_FIT_SAMPLES = 4000
"""Maximum number of samples of `fit_parameters`; more samples are decimated evenly."""
_MAX_FIT_STEPS = 100
"""Maximum number of Levenberg-Marquardt steps of `fit_parameters`."""
_MIN_FIT_DECREASE = 1e-10
"""Relative decrease of the cost below which `fit_parameters` ends."""
_MIN_TARGET_STD = 1e-9
"""Lower bound of the standard deviation of an acceleration in a denominator."""


def fit_parameters(baseline: Baseline, samples: Samples) -> Solution:
    """Fit all parameters of a baseline by nonlinear least squares, from their current values.

    The residuals are errors of the accelerations, divided by the standard deviation of each axis.
    Standard errors are cluster-robust over manoeuvres.

    Args:
        baseline: baseline whose `forward` is differentiable.
        samples: samples whose target is the measured acceleration [N, n].

    Raises:
        FitError: if a parameter has no effect on the accelerations, or parameters are collinear.
    """
    parameters = {name: value.detach().double() for name, value in baseline.named_parameters()}
    if not parameters:
        return Solution({}, {})
    shapes = [value.shape for value in parameters.values()]
    sizes = [value.numel() for value in parameters.values()]
    labels = [
        name if size == 1 else f"{name}[{i}]"
        for name, size in zip(parameters, sizes, strict=True)
        for i in range(size)
    ]
    rows = torch.linspace(0, len(samples) - 1, min(len(samples), _MAX_FIT_SAMPLES)).long()
    z = samples.z[rows]
    target = samples.target[rows]
    # accelerations in m/s^2 and rad/s^2 become comparable
    target_std = target.std(0).clamp(min=_MIN_TARGET_STD)

    def to_state(theta: Tensor) -> dict[str, Tensor]:
        parts = theta.split(sizes)
        return {
            name: part.reshape(shape)
            for name, part, shape in zip(parameters, parts, shapes, strict=True)
        }

    def compute_residuals(theta: Tensor) -> Tensor:
        acceleration: Tensor = torch.func.functional_call(baseline, to_state(theta), (z,))
        return ((acceleration - target) / target_std).flatten()

    def compute_jacobian(theta: Tensor) -> Tensor:
        # forward mode: there are few parameters and thousands of residuals
        jacobian: Tensor = torch.func.jacfwd(compute_residuals)(theta)
        return jacobian

    def linearize(theta: Tensor) -> tuple[float, Callable[[float], tuple[float, Tensor]]]:
        with torch.no_grad():
            residuals = compute_residuals(theta)
            jacobian = compute_jacobian(theta)
        gram = jacobian.T @ jacobian
        gradient = jacobian.T @ residuals
        _require_effect(gram.diagonal(), labels)

        def try_step(damping: float) -> tuple[float, Tensor]:
            # Marquardt scaling: damping in proportion to the curvature of each parameter,
            # independent of units
            damped = gram + damping * torch.diag(gram.diagonal())
            factor, info = torch.linalg.cholesky_ex(damped)
            if int(info) != 0:
                # not positive definite: the optimiser increases the damping after an infinite cost
                return math.inf, theta
            step = torch.cholesky_solve(gradient[:, None], factor)[:, 0]
            with torch.no_grad():
                trial_residuals = compute_residuals(theta - step)
            return float(trial_residuals.square().sum()), theta - step

        return float(residuals.square().sum()), try_step

    initial_theta = torch.cat([value.flatten() for value in parameters.values()])
    theta = minimize_levenberg_marquardt(
        initial_theta, linearize, _MAX_FIT_STEPS, min_relative_decrease=_MIN_FIT_DECREASE
    ).minimizer
    # sandwich estimator of the covariance, with the residuals of a manoeuvre as a cluster
    with torch.no_grad():
        residuals = compute_residuals(theta)
        jacobian = compute_jacobian(theta)
    gram = jacobian.T @ jacobian
    factor, info = torch.linalg.cholesky_ex(gram)
    if int(info) != 0:
        raise FitError(
            f"the parameters {', '.join(labels)} are collinear on these data; fix one of them or"
            " give data that excite them separately"
        )
    inverse = torch.cholesky_inverse(factor)
    groups, group_index = torch.unique(samples.group[rows], return_inverse=True)
    scores = jacobian * residuals[:, None]
    # errors within a manoeuvre are correlated: the scores of its samples are added before squaring
    if len(groups) > 1:
        cluster_index = group_index.repeat_interleave(target.shape[1])
        cluster_scores = scores.new_zeros(len(groups), len(theta))
        scores = cluster_scores.index_add_(0, cluster_index, scores)
    standard_errors = (inverse @ scores.T @ scores @ inverse).diagonal().clamp(min=0).sqrt()
    table = tuple(
        Coefficient("", label, value, standard_error)
        for label, value, standard_error in zip(
            labels, theta.tolist(), standard_errors.tolist(), strict=True
        )
    )
    return Solution({}, to_state(theta), table)


def _require_effect(squared_norms: Tensor, labels: Sequence[str]) -> None:
    """Refuse parameters whose column of the Jacobian is zero.

    Raises:
        FitError: if there is such a parameter; the message names the first one.
    """
    if bool((squared_norms == 0).any()):
        label = labels[int((squared_norms == 0).nonzero()[0, 0])]
        raise FitError(
            f"parameter '{label}' of the baseline has no effect on the accelerations of these data;"
            " remove it, start it at another value, or give data that excite it"
        )
