"""Heads (residual models) that correct the force model of a hull.

The residual is eps = tau - F(nu_dot, nu).
The residual is affine in nu_dot, so that the model can be solved for nu_dot in a free run
(Jervan 2020, eqs. (3.19)-(3.24)).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.columns import zero_acceleration
from residnet.core.errors import FitError
from residnet.core.layout import RANGE_VELOCITIES
from residnet.core.names import ACCELERATION_NAMES, FORCE_CHANNELS
from residnet.core.renamed_state import RenamedStateModule
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisHead
from residnet.physics.force_model import augment_mass
from residnet.physics.force_terms import find_acceleration_terms, require_inertia_matrix
from residnet.regression.estimator import Solution

_CONSTANT_FORCE_STD = 1e-9
"""Standard deviation in N or N m below which a force counts as constant."""


@final
class ForceHead(RenamedStateModule, ClosedFormHead):
    """Force residual eps = A nu_dot + b(z), with basis functions of accelerations and channels.

    Every stage of the integrator solves (M + A) nu_dot = tau - C nu - D nu - b. With the
    acceleration nu_dot_0 of the baseline, nu_dot = (M + A)^-1 M nu_dot_0 - (M + A)^-1 b, where b is
    evaluated once per time step.
    """

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {
        "lowest": "lower_velocities",
        "highest": "upper_velocities",
    }

    def __init__(self, basis_head: BasisHead) -> None:
        super().__init__()
        self.inner = basis_head
        self.feature_names = basis_head.features.names
        self.acceleration_terms = find_acceleration_terms(
            basis_head.library.terms, self.feature_names
        )
        self.constant_forces: list[str] = []
        self.mass = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.inverse = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.gain = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.lower_velocities = nn.Buffer(torch.zeros(3, dtype=torch.float64))
        self.upper_velocities = nn.Buffer(torch.zeros(3, dtype=torch.float64))

    def set_inertia(self, mass: Tensor | None) -> None:
        require_inertia_matrix(has_inertia_matrix=mass is not None)
        assert mass is not None
        self.mass.copy_(mass)
        self.inverse.copy_(torch.linalg.inv(mass))

    def residual_samples(self, samples: Samples, baseline_acceleration: Tensor) -> Samples:
        """Return samples of accelerations and channels whose target is the force residual.

        The target is tau - F(nu_dot, nu) = M (nu_dot_0 - nu_dot) (Jervan 2020, eq. (3.20)).
        """
        force = (baseline_acceleration - samples.target) @ self.mass.T
        return Samples(
            torch.cat((samples.target, samples.z), dim=-1),
            force,
            samples.group,
            samples.t,
            samples.kinds,
            (*ACCELERATION_NAMES, *samples.names),
        )

    def calibrate(self, samples: Samples) -> None:
        """Calibrate the features; accelerations are not clamped, because they are solved for."""
        self.inner.calibrate(samples)
        channel_std = dict(zip(samples.names, samples.z.std(0).tolist(), strict=True))
        self.constant_forces = [
            name for name in FORCE_CHANNELS if channel_std.get(name, 0.0) <= _CONSTANT_FORCE_STD
        ]
        velocities = samples.z[:, RANGE_VELOCITIES]
        self.lower_velocities.copy_(velocities.amin(0))
        self.upper_velocities.copy_(velocities.amax(0))
        for feature_index, name in enumerate(self.feature_names):
            if name in ACCELERATION_NAMES:
                # a clamped acceleration would no longer be affine in nu_dot
                self.inner.features.low[feature_index] = -torch.inf
                self.inner.features.high[feature_index] = torch.inf

    def fit_solutions(self, samples: Samples) -> list[Solution]:
        """Return the solutions of the basis functions with a positive definite mass M + A.

        Raises:
            FitError: if no solution has one, or the data determine no solution.
        """
        runnable = []
        errors = list[FitError]()
        for solution in self.inner.fit_solutions(samples):
            try:
                runnable.append(self._add_augmented_mass(solution))
            except FitError as error:
                errors.append(error)
        # an empty equation always has a positive definite mass; it must not hide the error of the
        # others
        if errors and not any(
            bool(solution.state["inner.coefficients"].any()) for solution in runnable
        ):
            raise errors[0]
        return runnable

    def _add_augmented_mass(self, solution: Solution) -> Solution:
        """Return a solution with its mass M + A, with the names of the state of this head."""
        coefficients = solution.state["coefficients"].clone()
        for j, axis in self.acceleration_terms.items():
            # the coefficients belong to accelerations scaled by their standard deviation
            coefficients[j] /= self.inner.features.std[
                self.feature_names.index(ACCELERATION_NAMES[axis])
            ]
        augmented_mass, _ = augment_mass(
            self.mass,
            self.inner.library.terms,
            coefficients,
            "residual in force space",
            self.feature_names,
        )
        augmented_mass_inverse = torch.linalg.inv(augmented_mass)
        state = {f"inner.{name}": value for name, value in solution.state.items()} | {
            "inverse": augmented_mass_inverse,
            "gain": augmented_mass_inverse @ self.mass,
        }
        notes = solution.notes | {"space": "force", "augmented_mass": augmented_mass.tolist()}
        if self.constant_forces:
            # without varying forces the equation of motion is identifiable only up to a factor; the
            # penalty and the selection by free runs keep the factor near one
            notes["forces_that_never_vary"] = self.constant_forces
        return Solution(solution.hyperparameters, state, notes=notes)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the acceleration -(M + A)^-1 b [..., 3] at channels z [..., nz]."""
        # b(z) is the residual at zero acceleration; A is part of the augmented mass
        residual_load, s = self.inner(torch.cat((zero_acceleration(z), z), dim=-1), s)
        return -(residual_load @ self.inverse.to(z.dtype).T), s

    def combine_accelerations(self, baseline_acceleration: Tensor, rho: Tensor) -> Tensor:
        """Return nu_dot [..., 3] from nu_dot_0 of the baseline and the residual of `forward`."""
        return baseline_acceleration @ self.gain.to(baseline_acceleration.dtype).T + rho

    def residual_force(self, nu_dot: Tensor, z: Tensor) -> Tensor:
        """Return eps [..., 3] in N, N, N m at accelerations [..., 3] and channels z [..., nz]."""
        residual: Tensor = self.inner(torch.cat((nu_dot, z), dim=-1), z[..., :0])[0]
        return residual

    def effective_baseline(self, baseline: nn.Module) -> nn.Module:
        return AugmentedMassBaseline(baseline, self.gain)

    def parameter_counts(self) -> list[float]:
        return self.inner.parameter_counts()


@final
class AugmentedMassBaseline(RenamedStateModule):
    """Baseline with the mass M + A: its acceleration [..., 3] is (M + A)^-1 M nu_dot_0."""

    legacy_parameter_names: ClassVar[Mapping[str, str]] = {"gain": "inertia_ratio"}

    def __init__(self, baseline: nn.Module, inertia_ratio: Tensor) -> None:
        super().__init__()
        self.baseline = baseline
        self.inertia_ratio = nn.Buffer(inertia_ratio.clone())

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        baseline_acceleration: Tensor = self.baseline(z)
        return baseline_acceleration @ self.inertia_ratio.to(z.dtype).T

    def parameter_counts(self) -> list[float]:
        """Return the number of parameters of the baseline for each axis."""
        counts: list[float] = self.baseline.parameter_counts()  # type: ignore[operator]
        return counts
