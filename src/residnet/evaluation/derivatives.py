"""Hydrodynamic derivatives of an identified baseline, with standard errors, in the prime systems.

The accelerations of the baseline are expanded in a Taylor series about straight-ahead motion at a
service speed, with the propellers at the revolutions that balance the resistance. The coefficients
multiply the monomials (Abkowitz 1964), so that Y_vvr stands for Y_vvr v^2 r without a factorial.
Automatic differentiation computes them for every baseline with free parameters, and the delta
method carries the covariance of the parameters over to their standard errors.

With a mass matrix M and the rigid body's centripetal terms C_RB, the derivatives are those of the
hydrodynamic force M nu_dot + C_RB(nu) nu (Fossen 2011, section 6.5). Without masses, logs of motion
determine only the accelerations, that is combinations such as (Y_r - m U) / (m - Y_vdot).
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.base import Baseline, ParametricBaseline
from residnet.baselines.mmg import MMGBaseline
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import UsageError
from residnet.core.names import FORCE_CHANNELS
from residnet.core.records import FileRecord, OpenRecord, Record
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.evaluation.records import Interval
from residnet.physics.similarity import (
    DIMENSIONLESS,
    Dimension,
    Particulars,
    SystemName,
    dimension_of_unit,
    estimate_added_mass,
    estimate_linear_derivatives,
    froude_factor,
    is_drive,
)

_AXES = ("X", "Y", "N")
_VELOCITY = Dimension(0, 1, -1)
_YAW_RATE = Dimension(0, 0, -1)
_FORCE_DIMENSIONS = (Dimension(1, 1, -2), Dimension(1, 1, -2), Dimension(1, 2, -2))
"""Dimensions of X and Y (N) and of N (N m)."""
_ACCELERATION_DIMENSIONS = (Dimension(0, 1, -2), Dimension(0, 1, -2), Dimension(0, 0, -2))
"""Dimensions of the accelerations in surge, sway (m/s^2) and yaw (rad/s^2)."""
_SYSTEMS: tuple[SystemName, ...] = ("prime_i", "prime_ii", "bis")
_NORMAL_95 = 1.959964
"""Quantile of the standard normal distribution for 95 % intervals."""
_NEGLIGIBLE = 1e-12
"""Coefficients below this share of the axis's largest are rounding errors of an exact zero."""
_NEGLIGIBLE_CONSTANT = 1e-9
"""The same for the force at the expansion point, an equilibrium up to the tolerance of its root."""

MassSource = Literal["identified", "estimated", "unknown"]


class DerivativeRow(Record):
    """A hydrodynamic derivative.

    Attributes:
        name: symbol such as Y_v, N_delta or Y_v|v|, and Y_0 for the force at the expansion point;
            with the suffix "/m" for an acceleration.
        axis: X, Y or N.
        variables: variables of the monomial that the coefficient multiplies; `u` is the difference
            to the service speed, a propeller's revolutions that to their equilibrium, and `|v|` a
            magnitude.
        value: value in SI units.
        unit: SI unit.
        standard_error: standard error in SI units; None if the covariance of the parameters is
            unknown.
        ci95: 95 % confidence interval in SI units; None without standard error.
        is_significant: whether the interval excludes zero; None without standard error.
        prime_i: value in the prime I system; None where a particular that it needs is unknown.
        prime_i_error: standard error in the prime I system.
        prime_ii: value in the prime II system.
        bis: value in the bis system.
    """

    name: str
    axis: Literal["X", "Y", "N"]
    variables: tuple[str, ...]
    value: float
    unit: str
    standard_error: float | None
    ci95: Interval | None
    is_significant: bool | None
    prime_i: float | None
    prime_i_error: float | None
    prime_ii: float | None
    bis: float | None


class DerivativesFile(FileRecord):
    """derivatives.json: hydrodynamic derivatives of a model.

    Attributes:
        model: name of the model.
        quantity: `force`, or `acceleration` where the masses are unknown.
        masses: source of the masses: `identified` from forces in the logs, `estimated` from
            main particulars, or `unknown`.
        mass_matrix: rows of the mass matrix M in SI; None if unknown.
        particulars: main particulars in SI.
        froude_number: U / sqrt(g L).
        scale: length of the target vessel divided by the length of the vessel in the logs.
        operating_point: values of the inputs at the expansion point.
        surge_imbalance: surge acceleration at the expansion point in m/s^2; zero at an equilibrium.
        ranges: training ranges of u, v, r and the inputs in SI, the limits of validity.
        rows: derivatives by order, axis and variables; last the terms with |v| or |r|.
        correlation: correlation matrix of the first-order derivatives; None if unknown.
        published: Y_v, Y_r, N_v, N_r in the prime I system by Clarke et al. (1983); None if the
            particulars do not suffice.
        remarks: sentences about limits of the figures.
    """

    schema_name: Literal["residnet.derivatives/1"] = Field(alias="schema")
    model: str
    quantity: Literal["force", "acceleration"]
    masses: MassSource
    mass_matrix: list[list[float]] | None
    particulars: dict[str, float | None]
    froude_number: float
    scale: float
    operating_point: dict[str, float]
    surge_imbalance: float
    ranges: dict[str, Interval] = Field(default_factory=dict)
    rows: list[DerivativeRow]
    correlation: dict[str, list[float]] | None
    published: dict[str, float] | None
    remarks: list[str]

    def to_text(self) -> str:
        """Return a table for the terminal."""
        particulars = self.particulars
        header = (
            f"{self.model}: derivatives of the"
            f" {'hydrodynamic forces' if self.quantity == 'force' else 'accelerations'} about"
            f" U = {particulars['speed']:.4g} m/s (Froude number {self.froude_number:.3g}),"
            f" L = {particulars['length']:.4g} m"
        )
        lines = [
            header,
            f"{'':14}{'SI':>13} {'unit':16}{'95 % interval (SI)':>27}{'prime I x 1e5':>15}"
            f"{'+-':>9}{'prime II x 1e5':>15}{'bis':>12}",
        ]
        for row in self.rows:
            interval = "" if row.ci95 is None else f"{row.ci95[0]:.4g} to {row.ci95[1]:.4g}"
            lines.append(
                f"{row.name:14}{row.value:>13.5g} {row.unit:16}{interval:>27}"
                f"{_format_scaled(row.prime_i, 1e5):>15}"
                f"{_format_scaled(row.prime_i_error, 1e5):>9}"
                f"{_format_scaled(row.prime_ii, 1e5):>15}{_format_scaled(row.bis, 1.0):>12}"
            )
        if self.published:
            estimates = ", ".join(f"{k}' {1e5 * v:.1f}" for k, v in self.published.items())
            lines.append(f"Clarke et al. (1983), prime I x 1e5: {estimates}")
        return "\n".join([*lines, *self.remarks])

    def to_csv(self) -> str:
        """Return the rows as comma-separated values."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        names = [name for name in DerivativeRow.model_fields if name != "ci95"]
        writer.writerow([*names, "ci95_low", "ci95_high"])
        for row in self.rows:
            values = [getattr(row, name) for name in names]
            values[names.index("variables")] = " ".join(row.variables)
            writer.writerow([*values, *(row.ci95 or ("", ""))])
        return stream.getvalue()

    def to_matlab(self) -> str:
        """Return a MATLAB script that assigns structures with SI and prime I values."""
        particulars = self.particulars
        lines = [
            f"% {self.model}: hydrodynamic derivatives, {self.quantity}",
            f"% about U = {particulars['speed']:.6g} m/s, L = {particulars['length']:.6g} m",
            f"U = {particulars['speed']!r}; L = {particulars['length']!r};",
            f"rho = {particulars['density']!r};",
        ]
        for row in self.rows:
            field = re.sub(r"\|(\w)\|", r"abs\1", row.name).replace("/m", "_acc")
            lines.append(f"si.{field} = {row.value!r}; % {row.unit}")
            if row.prime_i is not None:
                lines.append(f"prime.{field} = {row.prime_i!r};")
        return "\n".join(lines) + "\n"


def _format_scaled(value: float | None, factor: float) -> str:
    return "" if value is None else f"{value * factor:.4g}"


@dataclass(frozen=True)
class _OperatingPoint:
    """Straight-ahead motion at the service speed.

    Attributes:
        speed: u in m/s.
        inputs: inputs of the model, wind included [m].
        surge_imbalance: surge acceleration in m/s^2.
    """

    speed: float
    inputs: Tensor
    surge_imbalance: float


class _Variable(NamedTuple):
    """A variable of the expansion.

    Attributes:
        name: name of the variable.
        column: column in the vector (u, v, r, inputs).
        dimension: dimension of the variable.
    """

    name: str
    column: int
    dimension: Dimension


def compute_derivatives(
    spec: ModelSpec,
    model: HybridDynamics,
    particulars: Particulars,
    *,
    covariance: Sequence[Sequence[float]] | None = None,
    has_correlations: bool = True,
    order: int = 1,
    scale: float = 1.0,
    density_ratio: float = 1.0,
) -> DerivativesFile:
    """Compute the hydrodynamic derivatives of a model's baseline.

    Args:
        spec: description of the model.
        model: the model with its parameter values; its head is not used.
        particulars: main particulars and service speed of the vessel in the logs.
        covariance: covariance of the baseline's free parameters [P][P]; None if unknown.
        has_correlations: whether the covariance has the correlations of the parameters.
        order: highest order of the expansion, 1 to 3.
        scale: length of the target vessel divided by the length of the vessel in the logs
            (Froude's law of similarity).
        density_ratio: density of the water at the target scale divided by the density in the logs.

    Raises:
        UsageError: if the model has no baseline with free parameters in u, v and r.
    """
    _validate_settings(order, scale, density_ratio)
    baseline = _require_planar_baseline(spec, model)
    input_names = list(spec.signals.input_columns)
    particulars = _complete_particulars(baseline, particulars)
    # operating point, mass matrix and monomials of the Taylor series of the force
    point = _find_operating_point(spec, model, baseline, input_names, particulars.speed)
    mass_of, source = _choose_mass_matrix(baseline, particulars)
    variables = _expansion_variables(spec, input_names)
    smooth_monomials: list[tuple[_Variable, ...]] = [
        combination
        for k in range(order + 1)
        for combination in itertools.combinations_with_replacement(variables, k)
    ]
    modulus_columns = _modulus_terms(baseline) if order > 1 else {}
    monomials = [*smooth_monomials, *modulus_columns.values()]
    rigid_mass = 0.0 if source == "unknown" else particulars.mass or 0.0
    force = _build_force_function(
        model, baseline, point, mass_of, rigid_mass, particulars.centre_of_gravity
    )

    def coefficients(theta: Tensor) -> Tensor:
        """Return the coefficients of all monomials [M, 3] for parameters theta."""
        taylor = _taylor_coefficients(lambda q: force(theta, q), variables, smooth_monomials, order)
        if not modulus_columns:
            return taylor
        assert isinstance(baseline, RegressorBaseline), "only regressors have terms"
        modulus = mass_of(theta) @ (theta * baseline.term_mask)[:, list(modulus_columns)]
        return torch.cat((taylor, modulus.T))

    # values, and their standard errors by propagation of the covariance of the parameters
    theta = baseline.theta.detach().double()
    values = coefficients(theta)
    parameter_covariance = _to_covariance(baseline, covariance)
    errors = None
    first_order_covariance = None
    if parameter_covariance is not None:
        errors, first_order_covariance = _propagate_covariance(
            coefficients, theta, baseline.free_indices(), parameter_covariance, 1 + len(variables)
        )
    # rows at the target scale, without terms that are negligible on their axis
    full_scale = particulars.scaled(scale, density_ratio)
    is_force = source != "unknown"
    rows: list[DerivativeRow] = []
    row_indices: list[int] = []
    largest = values.abs().amax(dim=0)
    for k, monomial in enumerate(monomials):
        for axis in range(3):
            share = _NEGLIGIBLE_CONSTANT if not monomial else _NEGLIGIBLE
            if abs(float(values[k, axis])) <= share * float(largest[axis]):
                continue
            if k <= len(variables):
                row_indices.append(3 * k + axis)
            rows.append(
                _make_row(
                    axis,
                    monomial,
                    float(values[k, axis]),
                    None if errors is None else float(errors[k, axis]),
                    full_scale,
                    is_force=is_force,
                    scale=scale,
                    density_ratio=density_ratio,
                )
            )
    n_first_order = len(row_indices)
    mass_matrix = None
    if is_force:
        scaled_mass = mass_of(theta) * _mass_factors(scale, density_ratio)
        mass_matrix = scaled_mass.tolist()
    return DerivativesFile(
        schema="residnet.derivatives/1",
        model=spec.name,
        quantity="force" if is_force else "acceleration",
        masses=source,
        mass_matrix=mass_matrix,
        particulars=full_scale.model_dump(),
        froude_number=particulars.froude_number,
        scale=scale,
        operating_point=_scaled_inputs(spec, point, scale, density_ratio),
        surge_imbalance=point.surge_imbalance,
        ranges=_scaled_ranges(spec, scale, density_ratio),
        rows=rows,
        correlation=_correlation_table(
            rows[:n_first_order], first_order_covariance if has_correlations else None, row_indices
        ),
        published=estimate_linear_derivatives(particulars),
        remarks=[
            *_build_remarks(spec, particulars, point, source, baseline, order),
            *_describe_errors(covariance is not None, has_correlations),
        ],
    )


def _validate_settings(order: int, scale: float, density_ratio: float) -> None:
    if not 1 <= order <= 3:
        raise UsageError(f"order: expected 1, 2 or 3, got {order}")
    if not 0.0 < scale < math.inf:
        raise UsageError(f"scale: expected a positive number such as 50, got {scale:g}")
    if not 0.0 < density_ratio < math.inf:
        raise UsageError(
            f"density_ratio: expected a positive number such as 1.025, got {density_ratio:g}"
        )


def _require_planar_baseline(spec: ModelSpec, model: HybridDynamics) -> ParametricBaseline:
    baseline: Baseline = model.baseline
    if not isinstance(baseline, ParametricBaseline):
        raise UsageError(
            f"model {spec.name}: its baseline '{spec.baseline.kind}' has no free parameters; choose"
            " a model with a baseline of kind regressors, hull or mmg (--model)"
        )
    velocities = tuple(spec.signals.velocities)
    if velocities != ("u", "v", "r"):
        raise UsageError(
            f"model {spec.name}: derivatives are computed for the velocities u, v, r, not"
            f" {', '.join(velocities)}"
        )
    return baseline


def _complete_particulars(baseline: ParametricBaseline, particulars: Particulars) -> Particulars:
    """Return the particulars with the rigid body of an MMG model, which its config states."""
    if not isinstance(baseline, MMGBaseline):
        return particulars
    force_model = baseline.force_model
    return particulars.model_copy(
        update={
            "mass": force_model.mass,
            "centre_of_gravity": force_model.x_G,
            "density": force_model.density,
        }
    )


def _find_operating_point(
    spec: ModelSpec,
    model: HybridDynamics,
    baseline: Baseline,
    input_names: Sequence[str],
    speed: float,
) -> _OperatingPoint:
    """Find the common share of the propulsion inputs' training ranges with surge in equilibrium."""
    lower = torch.tensor(spec.low[3 : 3 + len(input_names)], dtype=torch.float64)
    upper = torch.tensor(spec.high[3 : 3 + len(input_names)], dtype=torch.float64)
    drive_mask = torch.tensor([is_drive(name) for name in input_names], dtype=torch.float64)
    state = torch.tensor([0.0, 0.0, 0.0, speed, 0.0, 0.0], dtype=torch.float64)

    def inputs_at(share: float) -> Tensor:
        return drive_mask * (lower + share * (upper - lower))

    def surge(share: float) -> float:
        with torch.no_grad():
            channels = model.signals(state[None], model.signals.prepare(inputs_at(share)[None]))
            return float(baseline(channels.to(baseline.theta.dtype))[0, 0])

    shares = np.linspace(0.0, 1.0, 101)
    surge_accelerations = np.array([surge(share) for share in shares])
    # the equilibrium at the largest thrust; slower ones are those of astern revolutions
    crossings = np.flatnonzero(np.diff(np.sign(surge_accelerations)))
    if not drive_mask.any() or crossings.size == 0:
        share = float(shares[int(np.argmin(np.abs(surge_accelerations)))])
    else:
        from scipy.optimize import brentq

        left_index = int(crossings[-1])
        share = float(brentq(surge, shares[left_index], shares[left_index + 1]))
    return _OperatingPoint(speed, inputs_at(share), surge(share))


def _expansion_variables(spec: ModelSpec, input_names: Sequence[str]) -> list[_Variable]:
    units = spec.signals.channel_units()
    variables = [
        _Variable("u", 0, _VELOCITY),
        _Variable("v", 1, _VELOCITY),
        _Variable("r", 2, _YAW_RATE),
    ]
    for i, name in enumerate(input_names):
        if name in spec.signals.exogenous:
            continue
        dimension = dimension_of_unit(units.get(name, "-"))
        if dimension is not None:
            variables.append(_Variable(name, 3 + i, dimension))
    return variables


def _modulus_terms(baseline: ParametricBaseline) -> dict[int, tuple[_Variable, ...]]:
    """Return the monomials of terms such as v|r|, which have no Taylor series, by their column.

    These are the products of two velocities v or r with one magnitude (second-order modulus terms).
    """
    if not isinstance(baseline, RegressorBaseline):
        return {}
    linear_variables = {"v": _Variable("v", 1, _VELOCITY), "r": _Variable("r", 2, _YAW_RATE)}
    magnitudes = {"v": _Variable("|v|", 1, _VELOCITY), "r": _Variable("|r|", 2, _YAW_RATE)}
    columns: dict[int, tuple[_Variable, ...]] = {}
    for column, term in enumerate(baseline.library.terms):
        match = re.fullmatch(r"(?P<plain>[vr]) ?\|(?P<magnitude>[vr])\|", term)
        if match:
            columns[column] = (linear_variables[match["plain"]], magnitudes[match["magnitude"]])
    return columns


MassFunction = Callable[[Tensor], Tensor]


def _choose_mass_matrix(
    baseline: ParametricBaseline, particulars: Particulars
) -> tuple[MassFunction, MassSource]:
    """Return a function from theta to the mass matrix [3, 3], and where it comes from.

    Unknown masses are replaced by the identity.
    """
    if isinstance(baseline, MMGBaseline):
        return baseline.force_model.mass_matrix, "identified"
    if isinstance(baseline, RegressorBaseline):
        terms = list(baseline.library.terms)
        if all(name in terms for name in FORCE_CHANNELS):
            columns = [terms.index(name) for name in FORCE_CHANNELS]
            inverse_mass = (baseline.theta * baseline.term_mask).detach()[:, columns]
            if torch.linalg.matrix_rank(inverse_mass) == 3:
                # the coefficients of the forces are the inverse of the mass matrix
                return lambda theta: torch.linalg.inv(theta[:, columns]), "identified"
    added = estimate_added_mass(particulars)
    if added is None or particulars.mass is None:
        return lambda _: torch.eye(3, dtype=torch.float64), "unknown"
    mass = particulars.mass
    static_moment = mass * particulars.centre_of_gravity
    inertia = mass * (
        (particulars.gyradius * particulars.length) ** 2 + particulars.centre_of_gravity**2
    )
    matrix = torch.tensor(
        [
            [mass + added.surge, 0.0, 0.0],
            [0.0, mass + added.sway, static_moment + added.sway_yaw],
            [0.0, static_moment + added.yaw_sway, inertia + added.yaw],
        ],
        dtype=torch.float64,
    )
    return lambda _: matrix, "estimated"


def _build_force_function(
    model: HybridDynamics,
    baseline: ParametricBaseline,
    point: _OperatingPoint,
    mass_of: MassFunction,
    mass: float,
    centre: float,
) -> Callable[[Tensor, Tensor], Tensor]:
    """Return the force [3] as a function of theta and (u - U, v, r, inputs - equilibrium).

    It is the hydrodynamic force if the mass of the rigid body is known, else M nu_dot.

    Args:
        model: the model, which computes the channels of its baseline.
        baseline: the baseline.
        point: expansion point.
        mass_of: mass matrix as a function of theta.
        mass: mass of the rigid body in kg; 0 if it is unknown.
        centre: centre of gravity ahead of the origin in m.
    """
    pose = torch.zeros(3, dtype=torch.float64)

    def force(theta: Tensor, q: Tensor) -> Tensor:
        nu = torch.cat((q[:1] + point.speed, q[1:3]))
        state = torch.cat((pose, nu))[None]
        channels = model.signals(state, model.signals.prepare((q[3:] + point.inputs)[None]))
        acceleration: Tensor = torch.func.functional_call(baseline, {"theta": theta}, (channels,))
        inertial = mass_of(theta) @ acceleration[0]
        u, v, r = nu
        centripetal = torch.stack(
            (-mass * (v * r + centre * r * r), mass * u * r, mass * centre * u * r)
        )
        return inertial + centripetal

    return force


def _taylor_coefficients(
    function: Callable[[Tensor], Tensor],
    variables: Sequence[_Variable],
    monomials: Sequence[tuple[_Variable, ...]],
    order: int,
) -> Tensor:
    """Return the coefficients [K, 3] of monomials in the Taylor series about zero.

    A monomial with powers k_i has the derivative divided by the product of k_i!; the monomial
    without variables has the value at zero.
    """
    n_variables = max(variable.column for variable in variables) + 1
    origin = torch.zeros(n_variables, dtype=torch.float64)
    derivative = function
    derivatives = [function(origin)]
    for _ in range(order):
        derivative = torch.func.jacfwd(derivative)
        derivatives.append(derivative(origin))
    rows = []
    for monomial in monomials:
        indices = tuple(variable.column for variable in monomial)
        factorial = math.prod(math.factorial(indices.count(index)) for index in set(indices))
        index: Any = (slice(None), *indices)
        rows.append(derivatives[len(indices)][index] / factorial)
    return torch.stack(rows)


def _propagate_covariance(
    coefficients: Callable[[Tensor], Tensor],
    theta: Tensor,
    free_indices: Tensor,
    covariance: Tensor,
    n_first_order: int,
) -> tuple[Tensor, np.ndarray]:
    """Carry the covariance of the parameters over to the coefficients (delta method).

    Args:
        coefficients: coefficients [K, 3] of the monomials as a function of theta.
        theta: parameters of the baseline.
        free_indices: indices of the free parameters in the flattened theta [P].
        covariance: covariance of the free parameters [P, P].
        n_first_order: number of monomials of order 0 and 1, which come first.

    Returns:
        Standard errors [K, 3], and the covariance of the first-order coefficients, monomial by
        monomial with its three axes.
    """
    jacobian = torch.func.jacfwd(coefficients)(theta).flatten(2)[..., free_indices]
    variance = torch.einsum("kap,pq,kaq->ka", jacobian, covariance, jacobian)
    first_order = jacobian[:n_first_order].reshape(-1, jacobian.shape[-1])
    first_order_covariance: np.ndarray = (first_order @ covariance @ first_order.T).numpy()
    return variance.clamp(min=0.0).sqrt(), first_order_covariance


def _to_covariance(
    baseline: ParametricBaseline, covariance: Sequence[Sequence[float]] | None
) -> Tensor | None:
    if covariance is None:
        return None
    matrix = torch.tensor(covariance, dtype=torch.float64)
    n_free = len(baseline.free_indices())
    if matrix.shape != (n_free, n_free):
        raise UsageError(
            f"fit.json: the covariance is {list(matrix.shape)}, expected [{n_free}, {n_free}] for"
            " the free parameters of the baseline; run the fit again"
        )
    return matrix


def _make_row(
    axis: int,
    monomial: tuple[_Variable, ...],
    value: float,
    error: float | None,
    particulars: Particulars,
    *,
    is_force: bool,
    scale: float,
    density_ratio: float,
) -> DerivativeRow:
    """Return a derivative at the target scale, in SI units and in the non-dimensional systems.

    Args:
        axis: index of the force or acceleration: surge, sway or yaw.
        monomial: variables of the derivative; a power repeats its variable.
        value: derivative at the scale of the logs in SI units.
        error: standard error of `value`; None if it is unknown.
        particulars: particulars of the target vessel.
        is_force: whether the derivative is one of a force, otherwise of an acceleration.
        scale: length of the target vessel divided by the length of the vessel in the logs.
        density_ratio: water density at the target scale divided by the density in the logs.
    """
    dimension = (_FORCE_DIMENSIONS if is_force else _ACCELERATION_DIMENSIONS)[axis]
    for variable in monomial:
        dimension = dimension.times(variable.dimension, -1.0)
    factor = froude_factor(dimension, scale, density_ratio)
    value *= factor
    error = None if error is None else error * factor
    units: dict[str, float] = {}
    for system in _SYSTEMS:
        scales = particulars.reference_scales(system)
        if scales is not None:
            units[system] = scales.factor(dimension)
    names = [variable.name for variable in monomial]
    # single letters are written together as usual, Y_vvr; longer names need a separator
    is_short = all(len(name.strip("|")) == 1 for name in names)
    subscript = ("".join(names) if is_short else "_".join(names)) or "0"
    interval = None if error is None else (value - _NORMAL_95 * error, value + _NORMAL_95 * error)
    prime_i = units.get("prime_i")
    return DerivativeRow(
        name=f"{_AXES[axis]}_{subscript}" + ("" if is_force else "/m"),
        axis=("X", "Y", "N")[axis],
        variables=tuple(names),
        value=value,
        unit=dimension.unit,
        standard_error=error,
        ci95=interval,
        is_significant=None if interval is None else interval[0] * interval[1] > 0.0,
        prime_i=None if prime_i is None else value / prime_i,
        prime_i_error=None if prime_i is None or error is None else error / prime_i,
        prime_ii=value / units["prime_ii"] if "prime_ii" in units else None,
        bis=value / units["bis"] if "bis" in units else None,
    )


def _mass_factors(scale: float, density_ratio: float) -> Tensor:
    """Return the Froude factors [3, 3] of the entries of a mass matrix."""
    lengths = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    exponents = 3.0 + lengths[:, None] + lengths[None, :]
    return density_ratio * scale**exponents


def _scaled_inputs(
    spec: ModelSpec, point: _OperatingPoint, scale: float, density_ratio: float
) -> dict[str, float]:
    units = spec.signals.channel_units()
    scaled = {}
    for name, value in zip(spec.signals.input_columns, point.inputs.tolist(), strict=True):
        dimension = dimension_of_unit(units.get(name, "-")) or DIMENSIONLESS
        scaled[name] = value * froude_factor(dimension, scale, density_ratio)
    return scaled


def _scaled_ranges(spec: ModelSpec, scale: float, density_ratio: float) -> dict[str, Interval]:
    """Return the training ranges of u, v, r and the inputs at the target scale."""
    units = {"u": "m/s", "v": "m/s", "r": "rad/s", **spec.signals.channel_units()}
    names = ("u", "v", "r", *spec.signals.input_columns)
    ranges = {}
    for name, low, high in zip(names, spec.low, spec.high, strict=False):
        dimension = dimension_of_unit(units.get(name, "-")) or DIMENSIONLESS
        factor = froude_factor(dimension, scale, density_ratio)
        ranges[name] = (float(low) * factor, float(high) * factor)
    return ranges


def _correlation_table(
    rows: Sequence[DerivativeRow], covariance: np.ndarray | None, indices: Sequence[int]
) -> dict[str, list[float]] | None:
    """Return the correlation of the first-order derivatives, by name in the order of the rows."""
    if covariance is None:
        return None
    selected = covariance[np.ix_(indices, indices)]
    deviation = np.sqrt(np.clip(np.diag(selected), 1e-300, None))
    correlation = np.clip(selected / np.outer(deviation, deviation), -1.0, 1.0)
    return {row.name: correlation[i].round(4).tolist() for i, row in enumerate(rows)}


def _build_remarks(
    spec: ModelSpec,
    particulars: Particulars,
    point: _OperatingPoint,
    source: MassSource,
    baseline: ParametricBaseline,
    order: int,
) -> list[str]:
    """Return sentences on the validity of the derivatives."""
    remarks = []
    if not spec.low[0] <= particulars.speed <= spec.high[0]:
        remarks.append(
            f"The service speed {particulars.speed:.3g} m/s is outside the training range"
            f" {spec.low[0]:.3g} to {spec.high[0]:.3g} m/s: the derivatives are extrapolated."
        )
    if abs(point.surge_imbalance) > 1e-6:
        remarks.append(
            "No revolutions within the training range balance the resistance at this speed: the"
            f" surge acceleration there is {point.surge_imbalance:.2g} m/s^2."
        )
    if source == "unknown":
        remarks.append(
            "The logs determine accelerations only: names with /m are forces divided by the mass"
            " including added mass (Y_v/m is Y_v / (m - Y_vdot) without sway-yaw coupling). Give"
            " mass, beam and draught for derivatives of forces."
        )
    elif source == "identified" and particulars.mass is None:
        remarks.append(
            "The logs determine the mass matrix but not the rigid body's share of it: coefficients"
            " of r contain its centripetal terms (Y_r is Y_r - m U). Give mass to separate them."
        )
    elif source == "estimated":
        remarks.append(
            "Masses are those of the rigid body with added masses by Clarke et al. (1983) and"
            " Soeding (1982); their error is not part of the intervals."
        )
    if isinstance(baseline, RegressorBaseline):
        listed_columns = _modulus_terms(baseline) if order > 1 else {}
        missing_terms = [
            term
            for column, term in enumerate(baseline.library.terms)
            if ("|v|" in term or "|r|" in term) and column not in listed_columns
        ]
        if missing_terms:
            hint = "see fit.json" if order > 1 else "--order 2 lists them"
            remarks.append(
                f"Terms with |v| or |r| ({', '.join(missing_terms)}) have no Taylor series and are"
                f" not part of the table; {hint}."
            )
    return remarks


def _describe_errors(has_errors: bool, has_correlations: bool) -> list[str]:
    """Return what is missing in the standard errors."""
    if not has_errors:
        return [
            "The fit has stored no covariance of its parameters, so that there are no standard"
            " errors; run the fit again with this version."
        ]
    if not has_correlations:
        return [
            "The fit has stored standard errors without correlations: those of sums of several"
            " coefficients are approximate."
        ]
    return []


class StandardErrorRow(OpenRecord):
    """The standard error of a parameter in fit.json.

    Attributes:
        axis: name of the acceleration.
        term: the regressor.
        standard_error: standard error of the parameter.
    """

    axis: str
    term: str
    standard_error: float | None


class CovarianceNotes(OpenRecord):
    """The uncertainty of the parameters of a baseline in fit.json.

    Attributes:
        covariance: covariance [P][P] of the free parameters; None if it was not estimated.
        coefficients: standard errors of the parameters.
    """

    covariance: tuple[tuple[float, ...], ...] | None = None
    coefficients: tuple[StandardErrorRow, ...] = ()


def read_covariance(
    notes: CovarianceNotes, baseline: Baseline
) -> tuple[Sequence[Sequence[float]] | None, bool]:
    """Return the covariance of the baseline's free parameters from the notes of a fit.

    Args:
        notes: notes on the fit of the baseline.
        baseline: the fitted baseline.

    Returns:
        The covariance [P][P], None if unknown; and whether correlations are known. Baselines whose
        parameters are ratios of coefficients store standard errors only.
    """
    if notes.covariance is not None:
        return notes.covariance, True
    if not isinstance(baseline, ParametricBaseline):
        return None, False
    errors = {
        (row.axis, row.term): row.standard_error
        for row in notes.coefficients
        if row.standard_error is not None
    }
    names = baseline.free_parameter_names()
    if not names or not errors.keys() >= {*names}:
        return None, False
    return np.diag([errors[name] ** 2 for name in names]).tolist(), False
