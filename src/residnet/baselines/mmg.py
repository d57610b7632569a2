"""The MMG standard model with parameters identified from trials, starting from a prior."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.baselines.base import (
    Baseline,
    IdentifiedConfig,
    ParametricBaseline,
    of_manoeuvres,
    require,
)
from residnet.core.errors import FitError
from residnet.core.names import VELOCITY, nearest
from residnet.core.samples import Samples
from residnet.physics.mmg import (
    PARAMETERS,
    MMGForces,
    MMGHull,
    MMGPropeller,
    MMGRudder,
    Prior,
    usual_priors,
)
from residnet.regression.least_squares import descend
from residnet.regression.solutions import Coefficient, Solution

_MOST_SAMPLES = 4000
"""Samples that accelerations are fitted to; more are thinned evenly."""
_STEP = 1e-4
"""Step of a difference quotient, in prior standard deviations."""
_MOST_STEPS = 20
"""Most steps of the search."""
_GAIN = 1e-9
"""Share of the logarithm of the likelihood that a step must gain for another one."""
# what can only be seen in the accelerations of one axis is listed under it
_AXIS = {"X": "u_dot", "R": "u_dot", "t": "u_dot", "Y": "v_dot", "N": "r_dot"}


@final
class MMGBaseline(ParametricBaseline):
    """The MMG model, nu_dot [..., 3], with parameters theta [34] as `PARAMETERS` names them."""

    def __init__(self, forces: MMGForces, priors: Sequence[Prior]) -> None:
        super().__init__(torch.tensor([prior.mean for prior in priors], dtype=torch.float64))
        self.forces = forces
        self.mean = [prior.mean for prior in priors]
        self.sd = [prior.sd for prior in priors]

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        nu_dot: Tensor = self.forces(z, self.theta.to(z.dtype))
        return nu_dot

    def parameter_count(self) -> list[float]:
        """Return the number of parameters that are not fixed, by the axis they are listed under.

        Those of propeller and rudder count in every axis.
        """
        free = [PARAMETERS[i] for i in self.free_indices().tolist()]
        return [
            float(sum(axis_of(name) in (f"{axis}_dot", "") for name in free)) for axis in VELOCITY
        ]

    def free_indices(self) -> Tensor:
        """Return the places [P] of the parameters whose prior is not fixed."""
        return torch.nonzero(torch.tensor(self.sd) > 0).squeeze(1)

    def free_names(self) -> list[tuple[str, str]]:
        """Return (axis, name) of each parameter whose prior is not fixed [P]."""
        return [(axis_of(PARAMETERS[i]), PARAMETERS[i]) for i in self.free_indices().tolist()]

    def sensitivity(self, z: Tensor) -> Tensor:
        """Return d nu_dot / d theta [B, 3, P], by central differences of all parameters at once.

        This is as exact as needed and 20 times as fast as torch.func.
        """
        free = self.free_indices()
        steps = _STEP * torch.tensor(self.sd, dtype=z.dtype)[free]
        moves = torch.zeros(free.numel(), self.theta.numel(), dtype=z.dtype)
        moves[torch.arange(free.numel()), free] = steps
        theta = self.theta.detach().to(z.dtype)
        ahead, behind = self.forces(z, (theta + torch.stack((moves, -moves)))[:, :, None])
        slopes: Tensor = (ahead - behind) / (2.0 * steps[:, None, None])
        return slopes.permute(1, 2, 0)

    def information(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P].

        Each axis weighs by the variance that the present parameters leave of it.
        """
        part = _thinned(samples)
        with torch.no_grad():
            slopes, variance = (
                self.sensitivity(part.z),
                (part.target - self(part.z)).square().mean(0),
            )
        return torch.einsum("bip,biq,i->pq", slopes, slopes, 1.0 / variance) / len(part)

    def prior(self) -> tuple[Tensor, Tensor]:
        """Return the mean and precision [P] that the config gives."""
        free = self.free_indices()
        return (
            torch.tensor(self.mean, dtype=torch.float64)[free],
            torch.tensor(self.sd, dtype=torch.float64)[free] ** -2,
        )

    def asymmetry(self, samples: Samples) -> Tensor:
        """Return zeros [P, P]: what is asymmetric here has a prior of its own."""
        count = self.free_indices().numel()
        return torch.zeros(count, count, dtype=torch.float64)

    def updated_table(self, table: Sequence[Coefficient], errors: Tensor) -> list[Coefficient]:
        """Return every parameter as it is now."""
        known = dict(zip(self.free_indices().tolist(), errors.tolist(), strict=True))
        return [
            Coefficient(axis_of(name), name, float(self.theta[i]), known.get(i, 0.0))
            for i, name in enumerate(PARAMETERS)
        ]


def axis_of(name: str) -> str:
    """Return the acceleration that a parameter is listed under, empty where it acts on several."""
    return _AXIS.get(name.split("_")[0], "") if name != "t_R" else "u_dot"


def _thinned(samples: Samples) -> Samples:
    keep = torch.zeros(len(samples), dtype=torch.bool)
    keep[:: max(len(samples) // _MOST_SAMPLES, 1)] = True
    return samples.where(keep)


class MMGConfig(IdentifiedConfig):
    """The MMG standard model of a ship with one propeller and one rudder.

    It is that of Yasukawa and Yoshimura (2015). Every parameter has a prior, a mean and a standard
    deviation; usual values stand in for those that are not given. The trials move the parameters as
    far as they tell, first through accelerations, then, with a `refit` of this baseline, through
    free runs, which also gives the standard errors that intervals of predictions come from.

    Attributes:
        hull: particulars of the hull.
        propeller: particulars of the propeller.
        rudder: particulars of the rudder.
        beliefs: prior mean and standard deviation by parameter (non-dimensional, as the model has
            them), where not the usual ones; a standard deviation of 0 fixes it.
        revolutions: channel of the propeller's revolutions, 1/s.
        angle: channel of the rudder's angle, rad, positive to starboard.
        correlation: number of successive samples of accelerations that tell as much as one alone.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    kind: Literal["mmg"] = "mmg"
    hull: MMGHull
    propeller: MMGPropeller
    rudder: MMGRudder
    beliefs: dict[str, tuple[float, Annotated[float, Field(ge=0)]]] = Field(default_factory=dict)
    revolutions: str = "n"
    angle: str = "delta"
    correlation: int = Field(default=100, ge=1, le=100_000)
    manoeuvres: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _known(self) -> MMGConfig:
        for name in self.beliefs:
            if name not in PARAMETERS:
                raise ValueError(f"beliefs: no parameter '{name}'{nearest(name, PARAMETERS)}")
        return self

    def build(self, names: Sequence[str]) -> MMGBaseline:
        """Return the module with every parameter at its prior mean, for channels `names`."""
        wanted = (*VELOCITY, self.revolutions, self.angle)
        require(names, wanted, "the baseline 'mmg'")
        u, v, r, n, delta = (list(names).index(name) for name in wanted)
        usual = usual_priors(self.hull)
        priors = [
            (
                Prior(*self.beliefs[name], usual[name].meaning)
                if name in self.beliefs
                else usual[name]
            )
            for name in PARAMETERS
        ]
        return MMGBaseline(
            MMGForces(self.hull, self.propeller, self.rudder, (u, v, r, n, delta)), priors
        )

    def require_samples(self, samples: Samples) -> None:
        """Check that there are manoeuvres to fit on.

        Raises:
            FitError: where there are none of the kinds that are asked for.
        """
        of_manoeuvres(samples, self.manoeuvres)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the most likely parameters given accelerations and priors, by Gauss-Newton.

        Raises:
            FitError: where the accelerations at the prior means are not finite.
        """
        assert isinstance(baseline, MMGBaseline)
        picked = of_manoeuvres(samples, self.manoeuvres)
        chosen, count = _thinned(picked), len(picked) / self.correlation
        free, (mean, precision) = baseline.free_indices(), baseline.prior()

        def error(theta: Tensor) -> Tensor:
            baseline.theta[free] = theta
            known: Tensor = baseline(chosen.z)
            return chosen.target - known

        def cost(theta: Tensor) -> float:
            likelihood = 0.5 * count * error(theta).square().mean(0).log().sum()
            return float(likelihood + 0.5 * (precision * (theta - mean).square()).sum())

        def equations(theta: Tensor) -> tuple[Tensor, Tensor]:
            left = error(theta)
            weight = count / len(chosen) / left.square().mean(0)
            slopes = baseline.sensitivity(chosen.z)
            hessian = torch.einsum("bip,biq,i->pq", slopes, slopes, weight) + torch.diag(precision)
            gradient = torch.einsum("bip,bi,i->p", slopes, left, weight)
            return hessian, gradient + precision * (mean - theta)

        def near(theta: Tensor) -> tuple[float, Callable[[float], tuple[float, Tensor]]]:
            hessian, gradient = equations(theta)

            def trial(damping: float) -> tuple[float, Tensor]:
                damped = hessian + damping * torch.diag(hessian.diagonal())
                moved = theta + torch.linalg.solve(damped, gradient)
                return cost(moved), moved

            return cost(theta), trial

        if not torch.isfinite(error(mean)).all():
            raise FitError(
                "the MMG model's accelerations are not finite along the training logs; check"
                " hull, propeller and rudder, and units"
            )
        found = descend(mean, near, _MOST_STEPS, gain=_GAIN, damping=0.0).point
        errors = torch.linalg.inv(equations(found)[0]).diagonal().sqrt()
        theta = baseline.theta.detach().clone()
        return [Solution({}, {"theta": theta}, tuple(baseline.updated_table((), errors)))]
