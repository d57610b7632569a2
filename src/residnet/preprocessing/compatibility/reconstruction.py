"""Flight path reconstruction: states and instrument errors from the kinematics alone.

Position, heading and velocities are reconciled without a model of the vessel's forces (Klein and
Morelli, Aircraft System Identification, 2006, ch. 10; Jategaonkar, Flight Vehicle System
Identification, 2006, ch. 10). The derivatives of u, v, r are driven by white noise (jerk). States
and errors are estimated jointly by Gauss-Newton on a banded system bordered by the errors; noise
levels by restricted maximum likelihood with stochastic traces (Hutchinson 1990); the evidence by
Laplace's approximation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from residnet.core.errors import DataError
from residnet.core.frames import unwrap_angle
from residnet.core.result_cache import cache_results
from residnet.preprocessing.compatibility.estimates import (
    ErrorEstimate,
    Prior,
    Reconstruction,
    SensorFit,
)
from residnet.preprocessing.compatibility.residuals import (
    ResidualGroup,
    compute_position_residuals,
    compute_student_constant,
    linearize_score,
    sum_by_node,
)
from residnet.preprocessing.compatibility.sensors import (
    COMPLEX_STEP,
    CURRENT_NAMES,
    N_STATES,
    PSI,
    R_DOT,
    U_DOT,
    V_DOT,
    NodeStates,
    R,
    Sensor,
    U,
    V,
    X,
    Y,
    compute_hermite_weights,
    differentiate_interpolation,
    interpolate_states,
)

_MAX_ITERATIONS = 25
"""Largest number of Gauss-Newton iterations."""
_CURVATURE_ITERATIONS = (4, 8)
"""Iterations in which the gradient of the curvature is updated."""
_CURVATURE_STEP = 1e-3
"""Step of the difference quotient of this gradient."""
_N_PROBES = 3
"""Number of random vectors per noise level in the stochastic estimate of a trace."""
_N_SECTIONS = 20
"""Number of sections of a log for the jackknife covariance, because residuals of filtered channels
are correlated.
"""
_WEAKENED_SMOOTHNESS = 100.0
"""Factor on the jerk intensities in the test whether sensors determine an error: without a smooth
motion the standard error of other errors grows.
"""
_PROBED_SMOOTHNESS = 10.0
"""Factor on the jerk intensities for the test whether smoothness changes the errors."""
_N_REESTIMATIONS = 3
"""Number of Gauss-Newton steps with this factor."""
_CLOCK_STEP_SHARE = 0.01
"""Standard deviation that the grid adds to a clock, as a share of the step between nodes: actuators
change accelerations between nodes, and this shifts the interpolated velocities.
"""
_MAX_NODES = 20_000
"""Largest number of nodes."""
_CACHE_BYTES = 50_000_000
"""Largest total size of the stored results of `reconstruct`."""
_MIN_SAMPLES = 20
"""Smallest number of samples of a sensor."""
_HEADING_WINDOW = 1.0
"""Window in s of the polynomials for the initial heading and yaw rate."""
_VELOCITY_WINDOW = 2.0
"""Window in s of the polynomials for the initial velocities."""
_POSE_TOLERANCES = (1e-7, 2e-6)
"""Standard deviations in rad and m of the equations that integrate the pose over a step.

They are not zero, so that the covariance of these equations is invertible.
"""


@cache_results(_CACHE_BYTES)
def reconstruct(
    sensors: Sequence[Sensor], errors: Mapping[str, Prior], step: float
) -> Reconstruction:
    """Reconstruct the motion of a vessel and the errors of its instruments.

    Args:
        sensors: measurements, among them a position and a heading.
        errors: name of an instrument error -> prior, for the errors named by the sensors and the
            components of a current.
        step: time between nodes in s.

    Raises:
        DataError: if the sensors have too few values or the log is too long for the step.
    """
    problem = _Problem(sensors, errors, step)
    return problem.estimate()


@dataclass
class _Solver:
    """Factors of a linearised problem.

    Attributes:
        banded_factor: Cholesky factor of the states.
        gradient: gradient of the cost by the states [K * 9].
        border: second derivatives by errors and states [P, K * 9].
        schur: second derivatives by the errors with the states eliminated [P, P].
        error_gradient: gradient of the cost by the errors [P].
        state_solution: solution for the gradient [K * 9].
        border_solution: solution for the border [K * 9, P].
    """

    banded_factor: np.ndarray
    gradient: np.ndarray
    border: np.ndarray
    schur: np.ndarray
    error_gradient: np.ndarray
    state_solution: np.ndarray
    border_solution: np.ndarray


class _Problem:
    """Joint estimation of states and errors on a grid of nodes."""

    def __init__(self, sensors: Sequence[Sensor], errors: Mapping[str, Prior], step: float) -> None:
        self.sensors = [sensor.select_finite() for sensor in sensors]
        self.sensors = [sensor for sensor in self.sensors if len(sensor.t) >= _MIN_SAMPLES]
        if not {"position", "heading"} <= {sensor.kind for sensor in self.sensors}:
            raise DataError(
                f"position and heading need at least {_MIN_SAMPLES} values each for a data"
                " compatibility analysis; record a longer log"
            )
        reference_sensors = [sensor for sensor in self.sensors if not sensor.clock] or self.sensors
        start = min(float(sensor.t[0]) for sensor in reference_sensors)
        stop = max(float(sensor.t[-1]) for sensor in reference_sensors)
        n_nodes = int(np.ceil((stop - start) / step - 1e-6)) + 1
        if n_nodes > _MAX_NODES:
            raise DataError(
                f"{n_nodes} nodes are too many for a data compatibility analysis (at most"
                f" {_MAX_NODES}); increase the step"
            )
        self.step = step
        self.n_nodes = max(n_nodes, 8)
        self.t = start + step * np.arange(self.n_nodes)
        used_names = {name for s in self.sensors for name in (s.clock, *s.error_names)}
        self.names = [name for name in errors if name in used_names or name in CURRENT_NAMES]
        self.prior_means = np.array([errors[name].mean for name in self.names], dtype=np.float64)
        self.prior_stds = np.array([errors[name].std for name in self.names], dtype=np.float64)
        self.jerk_intensity = np.ones(3)
        self.curvature_gradient = np.zeros(len(self.names))

    def estimate(self) -> Reconstruction:
        """Iterate states, errors and noise levels until they are stationary."""
        states = self._guess_states()
        errors = self.prior_means.copy()
        residuals = self._linearize(states, errors)
        n_stationary = 0
        for iteration in range(_MAX_ITERATIONS):
            solver = self._factorize(residuals, errors)
            if iteration in _CURVATURE_ITERATIONS or n_stationary == 1:
                self.curvature_gradient = self._differentiate_curvature(
                    states, errors, residuals, solver
                )
                solver = self._factorize(residuals, errors)
            error_step = np.zeros(errors.size)
            if errors.size:
                reduced_gradient = solver.error_gradient - solver.border @ solver.state_solution
                error_step = -np.linalg.solve(solver.schur, reduced_gradient)
            state_step = -(solver.state_solution + solver.border_solution @ error_step)
            state_step = state_step.reshape(self.n_nodes, N_STATES)
            cost = self._compute_cost(residuals, errors)
            step_length = 1.0
            # backtracking line search
            for _ in range(6):
                candidate = self._linearize(
                    states + step_length * state_step, errors + step_length * error_step
                )
                new_cost = self._compute_cost(candidate, errors + step_length * error_step)
                is_accepted = new_cost < cost + 1e-6 * abs(cost) + 1e-3
                if is_accepted:
                    break
                step_length *= 0.4
            states = states + step_length * state_step
            errors = errors + step_length * error_step
            residuals = candidate
            noise_change = 0.0
            if iteration:
                inverse_noise = self._compute_inverse_noise()
                noise_change = self._update_noise(residuals, solver)
                if is_accepted:
                    residuals = self._whiten_again(residuals, inverse_noise)
                else:
                    residuals = self._linearize(states, errors)
            is_stationary = abs(cost - new_cost) < 0.3 + 1e-5 * abs(cost) and noise_change < 0.03
            n_stationary = n_stationary + 1 if is_stationary and step_length == 1.0 else 0
            if n_stationary >= 2:
                break
        return self._summarize(states, errors, residuals)

    # --- first guess -------------------------------------------------------------------------

    def _guess_states(self) -> np.ndarray:
        """Return a first guess of the states [K, 9], and set the first noise levels."""
        sensors = {sensor.kind: sensor for sensor in reversed(self.sensors)}
        position = sensors["position"]
        heading = sensors["heading"]
        states = np.zeros((self.n_nodes, N_STATES))
        width = max(_VELOCITY_WINDOW, 5.0 * float(np.median(np.diff(position.t))))
        for state in (X, Y):
            resampled = np.interp(self.t, position.t, position.values[:, state])
            states[:, state] = self._smooth(resampled, width)
        resampled = np.interp(self.t, heading.t, unwrap_angle(heading.values[:, 0]))
        states[:, PSI] = self._smooth(resampled, _HEADING_WINDOW)
        states[:, R] = self._smooth(states[:, PSI], _HEADING_WINDOW, 1)
        north, east = (
            self._smooth(states[:, state], width, 1)
            - (self.prior_means[self.names.index(name)] if name in self.names else 0.0)
            for state, name in zip((X, Y), CURRENT_NAMES, strict=True)
        )
        cosine = np.cos(states[:, PSI])
        sine = np.sin(states[:, PSI])
        states[:, U] = north * cosine + east * sine
        states[:, V] = east * cosine - north * sine
        for state, rate, seconds in ((U, U_DOT, width), (V, V_DOT, width), (R, R_DOT, 1.0)):
            states[:, rate] = self._smooth(states[:, state], seconds, 1)
        self.jerk_intensity = np.array(
            [
                3.0 * self.step * np.mean(np.gradient(states[:, rate], self.step) ** 2) + 1e-10
                for rate in (U_DOT, V_DOT, R_DOT)
            ]
        )
        self.sensors = [_guess_noise(sensor) for sensor in self.sensors]
        return states

    def _smooth(self, values: np.ndarray, seconds: float, derivative: int = 0) -> np.ndarray:
        """Smooth values at the nodes [K], or differentiate them, by local parabolas."""
        # this import takes half a second, and most drafts compare no hypotheses
        from scipy.signal import savgol_filter

        window = max(5, int(seconds / self.step) // 2 * 2 + 1)
        window = max(min(window, (self.n_nodes - 1) // 2 * 2 - 1), 3)
        return np.asarray(savgol_filter(values, window, 2, deriv=derivative, delta=self.step))

    # --- linearisation -----------------------------------------------------------------------

    def _linearize(self, states: np.ndarray, errors: np.ndarray) -> list[ResidualGroup]:
        """Return the whitened residuals of all equations and their derivatives."""
        parameters = dict(zip(self.names, errors.tolist(), strict=True))
        groups = self._linearize_dynamics(states, parameters)
        for index, sensor in enumerate(self.sensors):
            groups += self._linearize_sensor(index, sensor, states, parameters)
        return groups

    def _linearize_dynamics(
        self, states: np.ndarray, parameters: Mapping[str, float]
    ) -> list[ResidualGroup]:
        """Return the residuals of white jerk and of the kinematics over each step."""
        h = self.step
        nodes = np.arange(self.n_nodes - 1)
        unit_column = np.ones(nodes.size)
        groups = []
        for axis, (state, rate) in enumerate(((U, U_DOT), (V, V_DOT), (R, R_DOT))):
            # covariance of velocity and acceleration under white jerk, decorrelated
            velocity_error = states[1:, state] - states[:-1, state] - h * states[:-1, rate]
            rate_error = states[1:, rate] - states[:-1, rate]
            velocity_weight = 1.0 / np.sqrt(self.jerk_intensity[axis] * h**3 / 3.0)
            rate_weight = 1.0 / np.sqrt(self.jerk_intensity[axis] * h / 4.0)
            slope = 1.5 / h
            name = f"jerk {axis}"
            next_state = N_STATES + state
            next_rate = N_STATES + rate
            derivatives = {
                state: -velocity_weight,
                rate: -h * velocity_weight,
                next_state: velocity_weight,
            }
            groups.append(
                ResidualGroup(
                    name,
                    nodes,
                    velocity_error * velocity_weight,
                    {key: factor * unit_column for key, factor in derivatives.items()},
                )
            )
            derivatives = {
                state: slope * rate_weight,
                rate: (slope * h - 1.0) * rate_weight,
                next_state: -slope * rate_weight,
                next_rate: rate_weight,
            }
            groups.append(
                ResidualGroup(
                    name,
                    nodes,
                    (rate_error - slope * velocity_error) * rate_weight,
                    {key: factor * unit_column for key, factor in derivatives.items()},
                )
            )
        heading_weight, position_weight = self._pose_weights
        heading_error = (
            states[1:, PSI] - states[:-1, PSI] - h / 2.0 * (states[1:, R] + states[:-1, R])
        )
        heading_error = heading_error - h**2 / 12.0 * (states[:-1, R_DOT] - states[1:, R_DOT])
        heading_derivatives = (
            {PSI: -1.0, R: -h / 2.0, R_DOT: -(h**2) / 12.0},
            {PSI: 1.0, R: -h / 2.0, R_DOT: h**2 / 12.0},
        )
        groups.append(
            ResidualGroup(
                "heading",
                nodes,
                heading_error * heading_weight,
                {
                    side * N_STATES + key: factor * heading_weight * unit_column
                    for side, part in enumerate(heading_derivatives)
                    for key, factor in part.items()
                },
            )
        )
        states_by_end = [
            {key: states[rows, key] for key in range(N_STATES)}
            for rows in (slice(-1), slice(1, None))
        ]
        current = [parameters.get(name, 0.0) for name in CURRENT_NAMES]
        position_errors, derivatives_by_axis = compute_position_residuals(
            states_by_end[0], states_by_end[1], h, *current
        )
        for axis, name in enumerate(CURRENT_NAMES):
            by_error = (
                {self.names.index(name): -h * position_weight * unit_column}
                if name in self.names
                else {}
            )
            groups.append(
                ResidualGroup(
                    "position",
                    nodes,
                    position_errors[axis] * position_weight,
                    {
                        key: factor * position_weight * unit_column
                        for key, factor in derivatives_by_axis[axis].items()
                    },
                    by_error,
                )
            )
        return groups

    def _compute_inverse_noise(self) -> dict[str, float]:
        """Return the factor of each group of residuals that is inverse to its noise level."""
        factors = {f"jerk {k}": q**-0.5 for k, q in enumerate(self.jerk_intensity.tolist())}
        factors["heading"], factors["position"] = self._pose_weights
        factors |= {f"sensor {k}": 1.0 / s.noise_std for k, s in enumerate(self.sensors)}
        return factors

    def _whiten_again(
        self, residuals: Sequence[ResidualGroup], inverse_noise: Mapping[str, float]
    ) -> list[ResidualGroup]:
        """Return residuals at the present noise levels.

        Args:
            residuals: residuals at earlier noise levels.
            inverse_noise: group -> factor at these levels.
        """
        factors = self._compute_inverse_noise()
        sensors = {f"sensor {k}": sensor for k, sensor in enumerate(self.sensors)}
        return [
            group.scale(
                factors[group.noise_name] / inverse_noise[group.noise_name],
                sensors.get(group.noise_name),
            )
            for group in residuals
        ]

    @property
    def _pose_weights(self) -> tuple[float, float]:
        """Inverse standard deviations of the integration of heading and position over a step."""
        q = self.jerk_intensity
        share = self.step**5 / 720.0
        return (
            1.0 / float(np.sqrt(q[2] * share + _POSE_TOLERANCES[0] ** 2)),
            1.0 / float(np.sqrt(max(q[0], q[1]) * share + _POSE_TOLERANCES[1] ** 2)),
        )

    def _locate(
        self, sensor: Sensor, parameters: Mapping[str, float]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Return which samples are between nodes, their first nodes, and fractions of the step.

        The fractions are None if all samples are on nodes.
        """
        times = sensor.t + parameters.get(sensor.clock, 0.0)
        location = (times - self.t[0]) / self.step
        is_inside = (location > -1e-6) & (location < self.n_nodes - 1 + 1e-6)
        location = np.clip(location[is_inside], 0.0, self.n_nodes - 1 - 1e-9)
        is_on_nodes = not sensor.clock and bool(np.abs(location - np.round(location)).max() < 1e-4)
        nodes = (np.round(location) if is_on_nodes else np.floor(location)).astype(int)
        nodes = np.clip(nodes, 0, self.n_nodes - (1 if is_on_nodes else 2))
        fraction = None if is_on_nodes else location - nodes
        return is_inside, nodes, fraction

    def _linearize_sensor(
        self, index: int, sensor: Sensor, states: np.ndarray, parameters: dict[str, float]
    ) -> list[ResidualGroup]:
        """Return the residuals of a sensor by complex-step differentiation."""
        is_inside, nodes, fraction = self._locate(sensor, parameters)
        values = sensor.values[is_inside]
        weights = None if fraction is None else compute_hermite_weights(self.step, fraction)
        node_states = sensor.select_states(is_on_nodes=fraction is None)
        node_values = {key: states[nodes, key] for key in node_states}
        next_nodes = np.minimum(nodes + 1, self.n_nodes - 1)
        next_node_values = {key: states[next_nodes, key] for key in node_states}
        sampled = interpolate_states(
            sensor.measured_states, node_values, next_node_values, weights, parameters
        )
        predicted = sensor.measure(parameters, sampled)
        by_state: list[dict[int, np.ndarray]] = [{} for _ in predicted]
        # chain rule: by the states at the samples, which depend on those of the nodes
        for state in sensor.measured_states:
            perturbed_states = {**sampled, state: sampled[state] + 1j * COMPLEX_STEP}
            interpolation = differentiate_interpolation(
                state, node_values, next_node_values, weights
            )
            for target, column in zip(
                by_state, sensor.measure(parameters, perturbed_states), strict=True
            ):
                slope = np.imag(column) / (sensor.noise_std * COMPLEX_STEP)
                if slope.any():
                    for key, factor in interpolation.items():
                        target[key] = target.get(key, 0.0) + slope * factor
        by_error = self._differentiate_by_errors(
            sensor, parameters, node_values, next_node_values, fraction
        )
        differences = [
            sensor.subtract(column, values[:, k]) / sensor.noise_std
            for k, column in enumerate(predicted)
        ]
        squares = np.sum(np.square(differences), axis=0)
        return [
            ResidualGroup(
                f"sensor {index}",
                nodes,
                differences[k],
                by_state[k],
                by_error[k],
                sensor,
                squares,
                len(differences),
            )
            for k in range(len(differences))
        ]

    def _differentiate_by_errors(
        self,
        sensor: Sensor,
        parameters: Mapping[str, float],
        before: NodeStates,
        after: NodeStates,
        fraction: np.ndarray | None,
    ) -> list[dict[int, np.ndarray]]:
        """Return the derivatives of whitened predictions by errors, for each column of a sensor."""
        weights = None if fraction is None else compute_hermite_weights(self.step, fraction)
        perturbed_predictions: dict[str, list[np.ndarray]] = {}
        for name in {*sensor.error_names, *CURRENT_NAMES} & {*self.names}:
            perturbed_parameters = {**parameters, name: parameters[name] + 1j * COMPLEX_STEP}
            perturbed_predictions[name] = sensor.predict(
                perturbed_parameters, before, after, weights
            )
        if sensor.clock in self.names and fraction is not None:
            perturbed_fraction = fraction + 1j * COMPLEX_STEP / self.step
            perturbed_weights = compute_hermite_weights(self.step, perturbed_fraction)
            perturbed_predictions[sensor.clock] = sensor.predict(
                parameters, before, after, perturbed_weights
            )
        derivatives: list[dict[int, np.ndarray]] = [{} for _ in range(sensor.values.shape[1])]
        for name, columns in perturbed_predictions.items():
            for target, column in zip(derivatives, columns, strict=True):
                # a sensor through the water does not depend on the current
                if np.iscomplexobj(column):
                    slope = np.imag(column) / (sensor.noise_std * COMPLEX_STEP)
                    target[self.names.index(name)] = slope
        return derivatives

    def _compute_cost(self, residuals: Sequence[ResidualGroup], errors: np.ndarray) -> float:
        """Return minus twice the log-density, with the linearised curvature of the states."""
        prior = float((((errors - self.prior_means) / self.prior_stds) ** 2).sum())
        curvature = 2.0 * float(self.curvature_gradient @ errors)
        return prior + curvature + sum(group.cost for group in residuals)

    def _differentiate_curvature(
        self,
        states: np.ndarray,
        errors: np.ndarray,
        residuals: Sequence[ResidualGroup],
        solver: _Solver,
    ) -> np.ndarray:
        """Return the gradient [P] of half the log-determinant of the states' Hessian.

        Joint estimates of states and a scale are biased: a smaller state needs less jerk. The
        marginal likelihood of the errors contains this determinant.
        """
        gradient = np.zeros(errors.size)
        log_determinant = float(np.log(solver.banded_factor[0]).sum())
        for index, name in enumerate(self.names):
            index_by_group = {
                f"sensor {k}": k for k, sensor in enumerate(self.sensors) if sensor.scale == name
            }
            if not index_by_group:
                continue
            perturbed_errors = errors.copy()
            perturbed_errors[index] += _CURVATURE_STEP
            parameters = dict(zip(self.names, perturbed_errors.tolist(), strict=True))
            # other sensors and the dynamic equations do not depend on the scale
            groups = [group for group in residuals if group.noise_name not in index_by_group]
            for k in index_by_group.values():
                groups += self._linearize_sensor(k, self.sensors[k], states, parameters)
            factor = self._factorize(groups, perturbed_errors).banded_factor
            gradient[index] = (float(np.log(factor[0]).sum()) - log_determinant) / _CURVATURE_STEP
        return gradient

    # --- normal equations --------------------------------------------------------------------

    def _factorize(self, residuals: Sequence[ResidualGroup], errors: np.ndarray) -> _Solver:
        """Factorise the normal equations, banded in the states and dense in the errors."""
        n_nodes = self.n_nodes
        n_errors = errors.size
        band = np.zeros((2 * N_STATES, n_nodes, N_STATES))
        gradient = np.zeros((n_nodes + 1, N_STATES))
        border = np.zeros((n_errors, n_nodes + 1, N_STATES))
        corner = np.diag(1.0 / self.prior_stds**2)
        error_gradient = (errors - self.prior_means) / self.prior_stds**2
        for group in residuals:
            weights = group.weights
            weighted_values = weights * group.values
            # a dynamic equation belongs to each node but the last; a node may have several samples
            n_targets = n_nodes if group.sensor is not None else n_nodes - 1
            keys = np.array(sorted(group.by_state))
            derivatives = np.array([group.by_state[key] for key in keys.tolist()])
            for position, first in enumerate(keys.tolist()):
                side, state = divmod(first, N_STATES)
                target = slice(side, n_targets + side)
                first_derivative = derivatives[position]
                gradient[target, state] += sum_by_node(
                    group, first_derivative * weighted_values, n_nodes
                )
                weighted_derivative = first_derivative * weights
                products = sum_by_node(group, weighted_derivative * derivatives[position:], n_nodes)
                # a product of two states of the next node belongs to that node
                n_products = min(n_targets, n_nodes - side)
                offsets = keys[position:] - first
                band[offsets, side : side + n_products, state] += products[:, :n_products]
                for index, derivative in group.by_error.items():
                    border[index, target, state] += sum_by_node(
                        group, weighted_derivative * derivative, n_nodes
                    )
            for index, derivative in group.by_error.items():
                error_gradient[index] += float((derivative * weighted_values).sum())
                for other_index, other_derivative in group.by_error.items():
                    corner[index, other_index] += float(
                        (derivative * weights * other_derivative).sum()
                    )
        flat_band = band.reshape(2 * N_STATES, n_nodes * N_STATES)
        flat_band[0] += 1e-9
        flat_gradient = gradient[:n_nodes].reshape(-1)
        flat_border = border[:, :n_nodes].reshape(n_errors, n_nodes * N_STATES)
        factor = cholesky_banded(flat_band, lower=True, overwrite_ab=True, check_finite=False)
        right_hand_sides = np.vstack([flat_gradient[None], flat_border]).T
        solution = cho_solve_banded((factor, True), right_hand_sides, check_finite=False)
        border_solution = solution[:, 1:]
        return _Solver(
            factor,
            flat_gradient,
            flat_border,
            corner - flat_border @ border_solution,
            error_gradient + self.curvature_gradient,
            solution[:, 0],
            border_solution,
        )

    # --- noise levels ------------------------------------------------------------------------

    def _update_noise(self, residuals: Sequence[ResidualGroup], solver: _Solver) -> float:
        """Update noise levels to the restricted maximum likelihood; return the largest change.

        A noise level is the sum of squares over the residual degrees of freedom. Those that the
        estimates use are a trace, estimated with random signs.
        """
        rng = np.random.default_rng(0)
        names = ["jerk 0", "jerk 1", "jerk 2"]
        names += [f"sensor {k}" for k in range(len(self.sensors))]
        groups_by_name = {name: [g for g in residuals if g.noise_name == name] for name in names}
        right_hand_sides = []
        by_errors = []
        for name in names:
            for _ in range(_N_PROBES):
                by_states, by_error = self._multiply_signs(groups_by_name[name], rng)
                right_hand_sides.append(by_states)
                by_errors.append(by_error)
        solutions = cho_solve_banded(
            (solver.banded_factor, True), np.array(right_hand_sides).T, check_finite=False
        )
        schur_inverse = np.linalg.inv(solver.schur) if self.names else solver.schur
        largest_change = 0.0
        for k, name in enumerate(names):
            used_dof = []
            for probe in range(k * _N_PROBES, (k + 1) * _N_PROBES):
                trace = float(right_hand_sides[probe] @ solutions[:, probe])
                reduced_product = by_errors[probe] - solver.border @ solutions[:, probe]
                used_dof.append(trace + float(reduced_product @ schur_inverse @ reduced_product))
            n_residuals = sum(group.values.size for group in groups_by_name[name])
            squares = sum(
                float((group.weights * group.values**2).sum()) for group in groups_by_name[name]
            )
            residual_dof = max(n_residuals - float(np.mean(used_dof)), 0.003 * n_residuals, 2.0)
            ratio = squares / residual_dof
            kind, _, number = name.partition(" ")
            if kind == "jerk":
                ratio = float(np.clip(ratio, 0.1, 10.0))
                self.jerk_intensity[int(number)] = max(
                    self.jerk_intensity[int(number)] * ratio, 1e-12
                )
                largest_change = max(largest_change, abs(float(np.log(ratio))) / 3.0)
            else:
                sensor = self.sensors[int(number)]
                factor = float(np.sqrt(np.clip(ratio, 0.05, 20.0)))
                noise_std = max(sensor.noise_std * factor, sensor.min_noise_std)
                largest_change = max(
                    largest_change, abs(float(np.log(noise_std / sensor.noise_std)))
                )
                self.sensors[int(number)] = replace(sensor, noise_std=noise_std)
        return largest_change

    def _multiply_signs(
        self, groups: Sequence[ResidualGroup], rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the transposed derivatives of a group times random signs, by states and errors."""
        by_states = np.zeros((self.n_nodes + 1, N_STATES))
        by_errors = np.zeros(len(self.names))
        for group in groups:
            signs = rng.choice((-1.0, 1.0), group.values.size) * np.sqrt(group.weights)
            for key, derivative in group.by_state.items():
                side, state = divmod(key, N_STATES)
                by_states[side : self.n_nodes + side, state] += np.bincount(
                    group.nodes, derivative * signs, self.n_nodes
                )
            for index, derivative in group.by_error.items():
                by_errors[index] += float((derivative * signs).sum())
        return by_states[: self.n_nodes].reshape(-1), by_errors

    # --- results -----------------------------------------------------------------------------

    def _summarize(
        self, states: np.ndarray, errors: np.ndarray, residuals: list[ResidualGroup]
    ) -> Reconstruction:
        """Return estimates with standard errors, growth and evidence."""
        solver = self._factorize(residuals, errors)
        standard_errors = self._compute_standard_errors(residuals, errors)
        clocks = {sensor.clock for sensor in self.sensors}
        for k, name in enumerate(self.names):
            if name in clocks:
                standard_errors[k] = np.hypot(standard_errors[k], _CLOCK_STEP_SHARE * self.step)
        deviance = self._compute_deviance(residuals, errors, solver)
        intensity = self.jerk_intensity.copy()
        growth = np.ones(errors.size)
        change = np.zeros(errors.size)
        if errors.size:
            # A rudder accelerates sway and yaw together. Smoothness alone prefers errors under
            # which the jerk is small: a lever arm to the point of the hull that the rudder does
            # not accelerate, and too small velocities. This is no noise, and no standard error
            # contains it.
            self.jerk_intensity = _PROBED_SMOOTHNESS * intensity
            change = self._reestimate_errors(states, errors) - errors
            self.jerk_intensity = _WEAKENED_SMOOTHNESS * intensity
            weakened = self._factorize(self._linearize(states, errors), errors)
            self.jerk_intensity = intensity
            growth = np.sqrt(
                np.diag(np.linalg.inv(weakened.schur)) / np.diag(np.linalg.inv(solver.schur))
            )
        return Reconstruction(
            self.t,
            states,
            {
                name: ErrorEstimate(
                    float(errors[k]),
                    float(standard_errors[k]),
                    float(change[k]),
                    float(growth[k]),
                    float(self.prior_stds[k]),
                )
                for k, name in enumerate(self.names)
            },
            self._summarize_sensors(residuals),
            intensity,
            deviance,
            sum(group.values.size for group in residuals if group.sensor is not None),
        )

    def _reestimate_errors(self, states: np.ndarray, errors: np.ndarray) -> np.ndarray:
        """Return the errors [P] after some iterations at the present noise levels."""
        for _ in range(_N_REESTIMATIONS):
            residuals = self._linearize(states, errors)
            solver = self._factorize(residuals, errors)
            self.curvature_gradient = self._differentiate_curvature(
                states, errors, residuals, solver
            )
            solver = self._factorize(residuals, errors)
            reduced_gradient = solver.error_gradient - solver.border @ solver.state_solution
            error_step = -np.linalg.solve(solver.schur, reduced_gradient)
            state_step = -(solver.state_solution + solver.border_solution @ error_step)
            states = states + state_step.reshape(self.n_nodes, N_STATES)
            errors = errors + error_step
        return errors

    def _compute_standard_errors(
        self, residuals: Sequence[ResidualGroup], errors: np.ndarray
    ) -> np.ndarray:
        """Return standard errors [P]: the larger of curvature and jackknife over sections.

        The estimates without one section follow from its score and its information. Their spread is
        the cluster-robust covariance CR3 (Cameron and Miller 2015, J. Human Resources 50, sec. VI).
        A sandwich would be too small: the estimates fit the scores of few sections.

        Scores and information are corrected for the weights of the M-estimator (Huber 1981, Robust
        Statistics, sec. 7.6), which overstate the information of noise without outliers.
        """
        if not errors.size:
            return np.zeros(0)
        groups = [linearize_score(group) for group in residuals]
        solver = self._factorize(groups, errors)
        covariance = np.linalg.inv(solver.schur)
        prior_gradient = (errors - self.prior_means) / self.prior_stds**2
        scores = np.tile(prior_gradient / _N_SECTIONS, (_N_SECTIONS, 1))
        information = np.tile(np.diag(1.0 / self.prior_stds**2) / _N_SECTIONS, (_N_SECTIONS, 1, 1))
        for group in groups:
            # derivative by the errors with the states eliminated
            profile = np.zeros((group.values.size, errors.size))
            for index, derivative in group.by_error.items():
                profile[:, index] += derivative
            for key, derivative in group.by_state.items():
                rows = np.minimum(group.nodes * N_STATES + key, self.n_nodes * N_STATES - 1)
                profile -= derivative[:, None] * solver.border_solution[rows]
            sections = group.nodes * _N_SECTIONS // self.n_nodes
            for section in range(_N_SECTIONS):
                rows = sections == section
                scores[section] += group.values[rows] @ profile[rows]
                information[section] += profile[rows].T @ profile[rows]
        changes = np.stack(
            [
                np.linalg.lstsq(solver.schur - removed, score)[0]
                for removed, score in zip(information, scores, strict=True)
            ]
        )
        variances = (_N_SECTIONS - 1) / _N_SECTIONS * (changes**2).sum(axis=0)
        return np.asarray(np.sqrt(np.maximum(np.diag(covariance), variances)))

    def _summarize_sensors(self, residuals: Sequence[ResidualGroup]) -> dict[str, SensorFit]:
        fit_by_sensor = {}
        for group in residuals:
            if group.sensor is None:
                continue
            weighted_values = np.sqrt(group.weights) * (group.values - group.values.mean())
            energy = max(float(weighted_values @ weighted_values), 1e-300)
            fit_by_sensor[group.sensor.name] = SensorFit(
                group.sensor.noise_std,
                float(weighted_values[1:] @ weighted_values[:-1]) / energy,
                float((np.abs(group.values) > 5.0).mean()),
            )
        return fit_by_sensor

    def _compute_deviance(
        self, residuals: Sequence[ResidualGroup], errors: np.ndarray, solver: _Solver
    ) -> float:
        """Return minus twice the log-evidence by Laplace's approximation.

        Powers of the step are left out: they are equal for all hypotheses with one grid.
        """
        deviance = 2.0 * float(np.log(solver.banded_factor[0]).sum())
        deviance -= self.n_nodes * N_STATES * float(np.log(2.0 * np.pi))
        deviance += self._compute_cost(residuals, errors)
        deviance -= 2.0 * float(self.curvature_gradient @ errors)
        for group in residuals:
            n = group.values.size
            if group.sensor is not None:
                constant = compute_student_constant(group.dimension)
                deviance += n * (2.0 * float(np.log(group.sensor.noise_std)) + constant)
                continue
            deviance += n * float(np.log(2.0 * np.pi))
            if group.noise_name.startswith("jerk"):
                deviance += n * float(np.log(self.jerk_intensity[int(group.noise_name[-1])]))
        heading_weight, position_weight = self._pose_weights
        return deviance - 2.0 * (self.n_nodes - 1) * float(
            np.log(heading_weight) + 2.0 * np.log(position_weight)
        )


def _guess_noise(sensor: Sensor) -> Sensor:
    """Return a sensor with a first guess of its noise from third differences."""
    if sensor.noise_std:
        return sensor
    values = sensor.values
    if sensor.kind == "heading":
        values = unwrap_angle(values[:, 0])[:, None]
    differences = np.abs(np.diff(values, n=3, axis=0))
    noise_std = float(np.median(differences)) / 0.6745 / np.sqrt(20.0)
    smallest = max(1e-6 * (1.0 + float(np.abs(values).max())), sensor.min_noise_std)
    return replace(sensor, noise_std=max(noise_std, smallest))
