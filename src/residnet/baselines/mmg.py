"""MMG standard model of a ship with one propeller and one rudder, identified from trials.

The model has separate forces of hull, propeller and rudder with their interactions.

Source: Yasukawa and Yoshimura, Introduction of MMG standard method for ship maneuvering
predictions, J Mar Sci Technol 20 (2015) 37-52. The prior means of the linear hull derivatives are
from Kijima et al., On the manoeuvring performance of a ship with the parameter of loading
condition, J SNAJ 168 (1990).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline, ParametricBaseline, select_manoeuvres
from residnet.baselines.mmg_parameters import (
    PARAMETER_NAMES,
    MMGHull,
    MMGPropeller,
    MMGRudder,
    ParameterPrior,
)
from residnet.core.errors import FitError
from residnet.core.names import VELOCITY_NAMES
from residnet.core.samples import Samples
from residnet.regression.estimator import Coefficient, Solution
from residnet.regression.least_squares import minimize_levenberg_marquardt

if TYPE_CHECKING:
    from residnet.baselines.mmg_config import MMGConfig

_WAKE_SLOPE = 2.0
"""C_1, the slope of the wake fraction over the drift angle; the value of the KVLCC2 in the source.
"""
# lower bound of U^2, so that v / U is defined at rest; (m/s)^2
_MIN_SPEED_SQUARED = 1e-6
_CROSS_FLOW_DRAG = 1.0
"""C_Q in `soeding_normal_coefficient`, about 1 for rudders with sharp edges at tip and root."""
_KINEMATIC_VISCOSITY = 1.139e-6
"""Of fresh water at 15 degrees Celsius in m^2/s; ITTC Recommended Procedure 7.5-02-01-03."""
_MIN_REYNOLDS_NUMBER = 1e4
"""Lower bound in the friction line, which has a pole at 100."""


def soeding_normal_coefficient(
    attack_angle: Tensor, reynolds_number: Tensor, *, lift_slope: float, aspect: float
) -> Tensor:
    """Compute the coefficient C_N of the normal force of a rudder by Söding (1982).

    C_L = lift_slope sin(alpha) + C_Q sin(alpha) |sin(alpha)| cos(alpha)
    C_D = C_L^2 / (pi Lambda) + C_Q |sin(alpha)|^3 + C_D0
    C_N = C_L cos(alpha) + C_D sin(alpha)
    with C_D0 = 2.5 * 0.075 / (log10(R_n) - 2)^2. The formulas are valid below the angle of stall.

    Source: Söding, Prediction of ship steering capabilities, Schiffstechnik 29 (1982) 3-29;
    reprinted in Brix, Manoeuvring Technical Manual, Seehafen Verlag, Hamburg (1993), and in
    Bertram, Practical Ship Hydrodynamics, 2nd ed., Butterworth-Heinemann (2012), section 6.4.

    Args:
        attack_angle: angles of attack [...] in rad.
        reynolds_number: Reynolds numbers [...] by chord and inflow.
        lift_slope: slope of the lift coefficient at zero angle of attack.
        aspect: aspect ratio Lambda.
    """
    sine = torch.sin(attack_angle)
    cosine = torch.cos(attack_angle)
    lift = lift_slope * sine + _CROSS_FLOW_DRAG * sine * sine.abs() * cosine
    bounded = torch.clamp(reynolds_number, min=_MIN_REYNOLDS_NUMBER)
    friction_drag = 2.5 * 0.075 / (torch.log10(bounded) - 2.0) ** 2
    drag = lift * lift / (math.pi * aspect) + _CROSS_FLOW_DRAG * sine.abs() ** 3 + friction_drag
    return lift * cosine + drag * sine


@final
class MMGForces(nn.Module):
    """Accelerations of the ship, valid for forward motion with ahead revolutions.

    Hull forces are divided by rho/2 L d U^2, moments by rho/2 L^2 d U^2, with v' = v/U and
    r' = r L/U.

    Args:
        hull: particulars of the hull.
        propeller: particulars of the propeller.
        rudder: particulars of the rudder.
        columns: columns of u, v, r, propeller revolutions and rudder angle in the channels z.
    """

    def __init__(
        self, hull: MMGHull, propeller: MMGPropeller, rudder: MMGRudder, columns: Sequence[int]
    ) -> None:
        super().__init__()
        self.columns = list(columns)
        self.wake_slope = _WAKE_SLOPE
        self.min_speed_squared = _MIN_SPEED_SQUARED
        self.length = float(hull.length)
        self.pressure_factor = 0.5 * hull.density * hull.length * hull.draught
        self.mass = float(hull.mass)
        self.x_G = float(hull.x_G)
        # about midship, by the parallel axis theorem
        self.inertia = hull.mass * ((hull.gyration * hull.length) ** 2 + hull.x_G**2)
        self.density = float(hull.density)
        self.diameter = float(propeller.diameter)
        self.k0, self.k1, self.k2 = propeller.thrust
        self.rudder_factor = 0.5 * hull.density * rudder.area
        self.lift_factor = self.rudder_factor * rudder.lift_slope
        self.lift_slope = rudder.lift_slope
        self.rudder_curve = rudder.curve
        self.aspect = float(rudder.aspect)
        self.chord = rudder.chord
        self.x_P = propeller.x
        self.x_R = rudder.x
        self.race_share = rudder.race

    def mass_matrix(self, theta: Tensor) -> Tensor:
        """Return the mass matrix [3, 3] about midship, in SI, for parameters theta [34].

        Added mass has no coupling of sway and yaw in this model.
        """
        m_x, m_y, J_z = theta[:3]
        mass_scale = self.pressure_factor * self.length
        coupling = theta.new_tensor(self.x_G * self.mass)
        zero = torch.zeros_like(coupling)
        return torch.stack(
            (
                torch.stack((self.mass + m_x * mass_scale, zero, zero)),
                torch.stack((zero, self.mass + m_y * mass_scale, coupling)),
                torch.stack((zero, coupling, self.inertia + J_z * mass_scale * self.length**2)),
            )
        )

    def forward(self, z: Tensor, theta: Tensor) -> Tensor:
        """Compute nu_dot [..., 3] at channels z [..., nz] with parameters theta [..., 34].

        The parameters have the order of `PARAMETER_NAMES`.
        """
        (
            m_x, m_y, J_z, R_0, X_vv, X_vr, X_rr, X_vvvv,
            Y_0, Y_v, Y_r, Y_vvv, Y_vvr, Y_vrr, Y_rrr, N_0, N_v, N_r, N_vvv, N_vvr, N_vrr, N_rrr,
            t_P, w_P0, C_2p, C_2n, t_R, a_H, x_H, gamma_p, gamma_n, l_R, epsilon, kappa,
        ) = theta.unbind(-1)  # fmt: skip
        selected_channels = [z[..., column] for column in self.columns]
        u = selected_channels[0]
        v = selected_channels[1]
        r = selected_channels[2]
        n = selected_channels[3]
        delta = selected_channels[4]
        speed = torch.sqrt(u * u + v * v + self.min_speed_squared)
        v_nondim = v / speed
        r_nondim = r * self.length / speed
        # hull forces are polynomials of the non-dimensional velocities (eqs. (7) to (9))
        pressure = self.pressure_factor * speed * speed
        x_hull = (
            -R_0 * (u / speed) ** 2
            + X_vv * v_nondim * v_nondim
            + X_vr * v_nondim * r_nondim
            + X_rr * r_nondim * r_nondim
            + X_vvvv * v_nondim**4
        )
        y_hull = (
            Y_0
            + Y_v * v_nondim
            + Y_r * r_nondim
            + Y_vvv * v_nondim**3
            + Y_vvr * v_nondim * v_nondim * r_nondim
            + Y_vrr * v_nondim * r_nondim * r_nondim
            + Y_rrr * r_nondim**3
        )
        n_hull = (
            N_0
            + N_v * v_nondim
            + N_r * r_nondim
            + N_vvv * v_nondim**3
            + N_vvr * v_nondim * v_nondim * r_nondim
            + N_vrr * v_nondim * r_nondim * r_nondim
            + N_rrr * r_nondim**3
        )
        # propeller: the wake fraction depends on the drift angle, and differently to port and
        # starboard because of the rotation of the propeller
        propeller_drift = -v_nondim - self.x_P * r_nondim
        wake_ratio = torch.where(propeller_drift > 0, C_2p, C_2n)
        inflow = (
            u
            * (1 - w_P0)
            * (1 + (1 - torch.exp(-self.wake_slope * propeller_drift.abs())) * (wake_ratio - 1))
        )
        # K_T n^2 D^2 with J = u_P / (n D), written without a division by n, which may be zero
        revolutions_diameter = n * self.diameter
        thrust_loading = (
            self.k0 * revolutions_diameter * revolutions_diameter
            + self.k1 * revolutions_diameter * inflow
            + self.k2 * inflow * inflow
        )
        thrust = (1 - t_P) * self.density * self.diameter**2 * thrust_loading
        # rudder: part of the span is in the slipstream of the propeller
        race_velocity = torch.sqrt(
            torch.clamp(
                inflow * inflow + 8.0 / math.pi * thrust_loading, min=self.min_speed_squared
            )
        )
        # inflow from both parts of the span, weighted by area; kappa is the share of the
        # acceleration that the slipstream has reached at the rudder
        rudder_inflow_squared = (
            self.race_share * (inflow + kappa * (race_velocity - inflow)) ** 2
            + (1 - self.race_share) * inflow * inflow
        )
        rudder_inflow_x = epsilon * torch.sqrt(rudder_inflow_squared + self.min_speed_squared)
        rudder_drift = -v_nondim - l_R * r_nondim
        rudder_inflow_y = speed * torch.where(rudder_drift > 0, gamma_p, gamma_n) * rudder_drift
        attack_angle = delta - torch.atan2(rudder_inflow_y, rudder_inflow_x)
        inflow_squared = rudder_inflow_x * rudder_inflow_x + rudder_inflow_y * rudder_inflow_y
        if self.rudder_curve == "soeding":
            normal_coefficient = soeding_normal_coefficient(
                attack_angle,
                torch.sqrt(inflow_squared) * self.chord / _KINEMATIC_VISCOSITY,
                lift_slope=self.lift_slope,
                aspect=self.aspect,
            )
            normal_force = self.rudder_factor * inflow_squared * normal_coefficient
        else:
            normal_force = self.lift_factor * inflow_squared * torch.sin(attack_angle)
        x_rudder = -(1 - t_R) * normal_force * torch.sin(delta)
        side_force = -normal_force * torch.cos(delta)
        # equations of motion about midship, solved for the accelerations
        mass_scale = self.pressure_factor * self.length
        mass_x = self.mass + m_x * mass_scale
        mass_y = self.mass + m_y * mass_scale
        inertia = self.inertia + J_z * mass_scale * self.length**2
        mass_moment = self.x_G * self.mass
        surge = pressure * x_hull + thrust + x_rudder + mass_y * v * r + mass_moment * r * r
        sway = pressure * y_hull + (1 + a_H) * side_force - mass_x * u * r
        rudder_moment = (self.x_R + a_H * x_H) * self.length * side_force
        yaw = pressure * self.length * n_hull + rudder_moment - mass_moment * u * r
        # sway and yaw are coupled by x_G: Cramer's rule for two equations
        determinant = mass_y * inertia - mass_moment * mass_moment
        return torch.stack(
            (
                surge / mass_x,
                (inertia * sway - mass_moment * yaw) / determinant,
                (mass_y * yaw - mass_moment * sway) / determinant,
            ),
            dim=-1,
        )


_MAX_SAMPLES = 4000
"""Maximum number of samples in the fit; more samples are thinned evenly."""
_MAX_STEPS = 20
"""Maximum number of Gauss-Newton steps."""
_MIN_RELATIVE_GAIN = 1e-9
"""Relative decrease of the negative log-posterior below which the iteration ends."""
# axis of parameters that affect one acceleration only, by the first part of their name
_AXIS_OF_PREFIX = {"X": "u_dot", "R": "u_dot", "t": "u_dot", "Y": "v_dot", "N": "r_dot"}


@final
class MMGBaseline(ParametricBaseline):
    """MMG model of nu_dot [..., 3] with parameters theta [34] in the order of `PARAMETER_NAMES`."""

    def __init__(self, force_model: MMGForces, priors: Iterable[ParameterPrior]) -> None:
        prior_mean, prior_std, _ = zip(*priors, strict=True)
        super().__init__(torch.tensor(prior_mean, dtype=torch.float64))
        self.force_model = force_model
        self.prior_mean = list(prior_mean)
        self.prior_std = list(prior_std)

    def forward(self, z: Tensor) -> Tensor:
        nu_dot: Tensor = self.force_model(z, self.theta.to(z.dtype))
        return nu_dot

    def parameter_counts(self) -> list[float]:
        """Return the number of free parameters of each axis.

        Parameters of propeller and rudder affect several axes and are counted for each.
        """
        free_parameters = [PARAMETER_NAMES[i] for i in self.free_indices().tolist()]
        return [
            float(sum(axis_of_parameter(name) in (f"{axis}_dot", "") for name in free_parameters))
            for axis in VELOCITY_NAMES
        ]

    def free_indices(self) -> Tensor:
        """Return the indices [P] of the parameters with a nonzero prior standard deviation."""
        return torch.nonzero(torch.tensor(self.prior_std) > 0).squeeze(1)

    def free_parameter_names(self) -> list[tuple[str, str]]:
        """Return the P pairs (axis, name) of the free parameters."""
        return [
            (axis_of_parameter(PARAMETER_NAMES[i]), PARAMETER_NAMES[i])
            for i in self.free_indices().tolist()
        ]

    def mean_information(self, samples: Samples) -> Tensor:
        """Return the Fisher information [P, P] per sample.

        The variance of each axis is that of the residuals with the current parameters.
        """
        subsample = _subsample(samples)
        with torch.no_grad():
            jacobian = self.parameter_jacobian(subsample.z)
            variance = (subsample.target - self(subsample.z)).square().mean(0)
        return torch.einsum("bip,biq,i->pq", jacobian, jacobian, 1.0 / variance) / len(subsample)

    def prior(self) -> tuple[Tensor, Tensor]:
        free_index = self.free_indices()
        return (
            torch.tensor(self.prior_mean, dtype=torch.float64)[free_index],
            torch.tensor(self.prior_std, dtype=torch.float64)[free_index] ** -2,
        )

    def symmetry_precision(self, samples: Samples) -> Tensor:
        """Return zeros [P, P], since the asymmetric parameters have individual priors."""
        n_free = self.free_indices().numel()
        return torch.zeros(n_free, n_free, dtype=torch.float64)

    def refresh_table(
        self, table: Sequence[Coefficient], standard_errors: Tensor
    ) -> list[Coefficient]:
        standard_error_of = dict(
            zip(self.free_indices().tolist(), standard_errors.tolist(), strict=True)
        )
        return [
            Coefficient(
                axis_of_parameter(name), name, float(self.theta[i]), standard_error_of.get(i, 0.0)
            )
            for i, name in enumerate(PARAMETER_NAMES)
        ]


@final
class SemiEmpiricalBaseline(Baseline):
    """MMG model of nu_dot [..., 3] whose parameters theta [34] are regressions, not fitted."""

    def __init__(self, force_model: MMGForces, theta: Sequence[float]) -> None:
        super().__init__()
        self.force_model = force_model
        self.theta = nn.Buffer(torch.tensor(theta, dtype=torch.float64))

    def forward(self, z: Tensor) -> Tensor:
        nu_dot: Tensor = self.force_model(z, self.theta.to(z.dtype))
        return nu_dot

    def parameter_counts(self) -> list[float]:
        """Return zeros, since no parameter is fitted."""
        return [0.0] * self.n_dof


def axis_of_parameter(name: str) -> str:
    """Return the acceleration that a parameter affects; empty if it affects several."""
    return _AXIS_OF_PREFIX.get(name.split("_")[0], "") if name != "t_R" else "u_dot"


def _subsample(samples: Samples) -> Samples:
    """Return at most about `_MAX_SAMPLES` samples at equal distances."""
    mask = torch.zeros(len(samples), dtype=torch.bool)
    mask[:: max(len(samples) // _MAX_SAMPLES, 1)] = True
    return samples.select(mask)


_PRIOR_FACTORS = (1.0, 2.0, 4.0)
"""Factors on the standard deviations of the priors, of which the evidence chooses one.

None is below 1: means near the truth by chance do not make stated deviations smaller. With factors
of 0.25 and 0.5, 56 % of the 95 % intervals of derivatives contained those of a published tanker,
and 76 % without (`scripts/bench/kvlcc2_derivatives.py --refit-prior 1`, 20 and 12 draws)."""


def fit_mmg(config: MMGConfig, baseline: MMGBaseline, samples: Samples) -> Solution:
    """Compute the maximum a posteriori estimate by the Gauss-Newton method.

    With `prior_weight: evidence` the priors are widened by the factor with the largest marginal
    likelihood in Laplace's approximation (MacKay 1992, Bayesian Interpolation, Neural
    Computation 4(3), section 4). A refit takes the priors with this factor.

    Raises:
        FitError: if the accelerations at the prior means are not finite.
    """
    selected = select_manoeuvres(samples, config.manoeuvres)
    subsample = _subsample(selected)
    # the likelihood of correlated samples must not outweigh the prior
    independent_samples = len(selected) / config.correlation
    free_index = baseline.free_indices()
    mean, stated_precision = baseline.prior()

    def acceleration_residual(theta: Tensor) -> Tensor:
        baseline.theta[free_index] = theta
        predicted: Tensor = baseline(subsample.z)
        return subsample.target - predicted

    if not torch.isfinite(acceleration_residual(mean)).all():
        raise FitError(
            "the MMG model's accelerations are not finite along the training logs; check"
            " hull, propeller and rudder, and units"
        )

    def estimate(prior_factor: float) -> tuple[float, Tensor, Tensor]:
        """Return the log evidence, the estimate and its Hessian with priors of this width."""
        precision = stated_precision / prior_factor**2

        def negative_log_posterior(theta: Tensor) -> float:
            # Gaussian likelihood, concentrated with respect to the variance of each axis
            mean_squares = acceleration_residual(theta).square().mean(0)
            negative_log_likelihood = 0.5 * independent_samples * mean_squares.log().sum()
            return float(
                negative_log_likelihood + 0.5 * (precision * (theta - mean).square()).sum()
            )

        def normal_equations(theta: Tensor) -> tuple[Tensor, Tensor]:
            residual = acceleration_residual(theta)
            axis_weight = independent_samples / len(subsample) / residual.square().mean(0)
            jacobian = baseline.parameter_jacobian(subsample.z)
            hessian = torch.einsum("bip,biq,i->pq", jacobian, jacobian, axis_weight) + torch.diag(
                precision
            )
            gradient = torch.einsum("bip,bi,i->p", jacobian, residual, axis_weight)
            return hessian, gradient + precision * (mean - theta)

        def linearize(theta: Tensor) -> tuple[float, Callable[[float], tuple[float, Tensor]]]:
            hessian, gradient = normal_equations(theta)

            def try_step(damping: float) -> tuple[float, Tensor]:
                damped_hessian = hessian + damping * torch.diag(hessian.diagonal())
                next_theta = theta + torch.linalg.solve(damped_hessian, gradient)
                return negative_log_posterior(next_theta), next_theta

            return negative_log_posterior(theta), try_step

        theta_map = minimize_levenberg_marquardt(
            # no initial damping: the prior makes the problem well-conditioned
            mean,
            linearize,
            _MAX_STEPS,
            min_relative_decrease=_MIN_RELATIVE_GAIN,
            damping=0.0,
        ).minimizer
        hessian = normal_equations(theta_map)[0]
        log_evidence = (
            -negative_log_posterior(theta_map)
            + 0.5 * float(precision.log().sum())
            - 0.5 * float(torch.linalg.slogdet(hessian).logabsdet)
        )
        return log_evidence, theta_map, hessian

    factors = _PRIOR_FACTORS if config.prior_weight == "evidence" else (1.0,)
    estimates = {factor: estimate(factor) for factor in factors}
    best_factor = max(estimates, key=lambda factor: estimates[factor][0])
    _, theta_map, hessian = estimates[best_factor]
    baseline.theta[free_index] = theta_map
    baseline.prior_std = [best_factor * deviation for deviation in baseline.prior_std]
    standard_errors = torch.linalg.inv(hessian).diagonal().sqrt()
    notes: dict[str, Any] = {}
    if config.prior_weight == "evidence":
        notes["prior_factor"] = best_factor
        notes["log_evidence"] = {
            f"{factor:g}": round(entry[0], 3) for factor, entry in estimates.items()
        }
    theta = baseline.theta.detach().clone()
    return Solution({}, {"theta": theta}, tuple(baseline.refresh_table((), standard_errors)), notes)
