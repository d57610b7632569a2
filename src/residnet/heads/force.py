"""Residuals in force space of a believed hull, eps = tau - F(nu_dot, nu).

They are affine in nu_dot to run forward (document 002 (3.19)-(3.24)).
"""

from __future__ import annotations

from typing import final

import torch
from torch import Tensor, nn

from residnet.core.columns import zero_acceleration
from residnet.core.errors import ConfigError, FitError
from residnet.core.layout import RANGE_VELOCITIES
from residnet.core.names import ACCELERATION
from residnet.core.samples import Samples
from residnet.heads.base import ClosedFormHead
from residnet.heads.basis import BasisHead
from residnet.physics.force_model import accelerating, augmented
from residnet.physics.signals import FORCE_CHANNELS
from residnet.regression.estimator import Solution

_STEADY = 1e-9
"""Standard deviation of a force in N or N m up to which it never varies."""


@final
class ForceHead(ClosedFormHead):
    """A force eps = A nu_dot + b(z) by a head of basis functions over accelerations and channels.

    Every stage of the integrator solves (M + A) nu_dot = tau - C nu - D nu - b: with the believed
    baseline's acceleration nu_dot_0 this is nu_dot = (M + A)^-1 M nu_dot_0 - (M + A)^-1 b, of which
    b is evaluated once per step.
    """

    def __init__(self, inner: BasisHead) -> None:
        super().__init__()
        self.inner = inner
        self.seen = inner.features.names
        self.moving = accelerating(inner.library.terms, self.seen)
        self.still: list[str] = []
        self.mass = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.inverse = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.gain = nn.Buffer(torch.eye(3, dtype=torch.float64))
        self.lowest = nn.Buffer(torch.zeros(3, dtype=torch.float64))
        self.highest = nn.Buffer(torch.zeros(3, dtype=torch.float64))

    def set_mass(self, mass: Tensor | None) -> None:
        if mass is None:
            raise ConfigError(
                "space: force needs a baseline that knows its mass and the forces on it; set its"
                " kind to 'believed'"
            )
        self.mass.copy_(mass)
        self.inverse.copy_(torch.linalg.inv(mass))

    def residual_target(self, samples: Samples, known: Tensor) -> Samples:
        """Return samples over accelerations and channels with the lack-of-fit as target.

        It is tau - F(nu_dot, nu) = M (nu_dot_0 - nu_dot) (3.20).
        """
        force = (known - samples.target) @ self.mass.T
        return Samples(
            torch.cat((samples.target, samples.z), dim=-1),
            force,
            samples.group,
            samples.t,
            samples.kinds,
            (*ACCELERATION, *samples.names),
        )

    def calibrate(self, samples: Samples) -> None:
        """Take scales and ranges of the features from the samples.

        Accelerations are solved for and never held.
        """
        self.inner.calibrate(samples)
        varying = dict(zip(samples.names, samples.z.std(0).tolist(), strict=True))
        self.still = [name for name in FORCE_CHANNELS if varying.get(name, 0.0) <= _STEADY]
        moved = samples.z[:, RANGE_VELOCITIES]
        self.lowest.copy_(moved.amin(0))
        self.highest.copy_(moved.amax(0))
        for place, name in enumerate(self.seen):
            if name in ACCELERATION:
                self.inner.features.low[place], self.inner.features.high[place] = (
                    -torch.inf,
                    torch.inf,
                )

    def require_samples(self, samples: Samples) -> None:
        self.inner.require_samples(samples)

    def solutions(self, samples: Samples) -> list[Solution]:
        """Return those solutions of the basis functions that can run forward.

        Raises:
            FitError: where none can, or the data do not determine any.
        """
        found, refused = [], list[FitError]()
        for solution in self.inner.solutions(samples):
            try:
                found.append(self._with_mass(solution))
            except FitError as error:
                refused.append(error)
        if refused and not any(
            bool(solution.state["inner.coefficients"].any()) for solution in found
        ):
            raise refused[0]
        return found

    def _with_mass(self, solution: Solution) -> Solution:
        """Return a solution with the mass that it makes, in the names of this head's state."""
        coefficients = solution.state["coefficients"].clone()
        for j, axis in self.moving.items():
            coefficients[j] /= self.inner.features.std[self.seen.index(ACCELERATION[axis])]
        total, _ = augmented(
            self.mass, self.inner.library.terms, coefficients, "residual in force space", self.seen
        )
        inverse = torch.linalg.inv(total)
        state = {f"inner.{name}": value for name, value in solution.state.items()} | {
            "inverse": inverse,
            "gain": inverse @ self.mass,
        }
        notes = solution.notes | {"space": "force", "augmented_mass": total.tolist()}
        if self.still:
            # its equation of motion then holds up to a factor, and only the penalty and free runs
            # keep that near one
            notes["forces_that_never_vary"] = self.still
        return Solution(solution.choice, state, notes=notes)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return -(M + A)^-1 b [..., 3], what the part without accelerations does to nu_dot.

        It is taken at channels z [..., nz]; the memory is empty.
        """
        b, s = self.inner(torch.cat((zero_acceleration(z), z), dim=-1), s)
        return -(b @ self.inverse.to(z.dtype).T), s

    def accelerations(self, known: Tensor, rho: Tensor) -> Tensor:
        """Return nu_dot [..., 3] from the believed one and the part without accelerations."""
        return known @ self.gain.to(known.dtype).T + rho

    def force(self, nu_dot: Tensor, z: Tensor) -> Tensor:
        """Return eps [..., 3] in N, N, N m at accelerations [..., 3] and channels z [..., nz]."""
        out: Tensor = self.inner(torch.cat((nu_dot, z), dim=-1), z[..., :0])[0]
        return out

    def effective_baseline(self, baseline: nn.Module) -> nn.Module:
        return AugmentedMassBaseline(baseline, self.gain)

    def parameter_count(self) -> list[float]:
        return self.inner.parameter_count()


@final
class AugmentedMassBaseline(nn.Module):
    """A baseline's acceleration [..., 3] under another mass: (M + A)^-1 M nu_dot_0."""

    def __init__(self, baseline: nn.Module, gain: Tensor) -> None:
        super().__init__()
        self.baseline = baseline
        self.gain = nn.Buffer(gain.clone())

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        known: Tensor = self.baseline(z)
        return known @ self.gain.to(z.dtype).T

    def parameter_count(self) -> list[float]:
        """Return the number of parameters of the baseline."""
        counts: list[float] = self.baseline.parameter_count()  # type: ignore[operator]
        return counts
