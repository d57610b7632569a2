"""Residual forces of a known hull and their identification, for both studies of Jervan 2020.

The residual is the force that the hull model does not explain: tau - F(nu_dot, nu) (3.19), (3.20).
It is regressed on basis functions of the motion (chapters 3 and 4); a model runs forward in time by
eq. (3.22) of Jervan 2020.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.autopilot.actuator_lag import fit_lag, simulate_lagged_force
from residnet.autopilot.evaluation import mean_squares_by_axis
from residnet.autopilot.motion_config import ActuatorLag
from residnet.baselines.given_config import BelievedConfig, HullEquations
from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.core.format import format_number
from residnet.core.frames import to_body
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, VELOCITIES
from residnet.core.names import ACCELERATION_NAMES, FORCE_CHANNELS, VELOCITY_NAMES
from residnet.physics.force_model import (
    ForceCorrection,
    ForceModel,
    augment_mass,
    weighted_column_std,
)
from residnet.physics.force_terms import FERRY_TERMS, MOTION_CHANNELS
from residnet.physics.symmetry import compute_term_parity
from residnet.physics.term_library import TermLibrary
from residnet.physics.terms import parse_term
from residnet.regression.estimator import Estimator, validate_data
from residnet.regression.least_squares import CentredLeastSquares, ElasticNet
from residnet.regression.shrinkage import PLSR, Ridge, pls_path
from residnet.regression.surface import ErrorSurface, SurfacePLSR
from residnet.report.blocks import Bullets, Section, Table, Text
from residnet.report.figure import (
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    VERMILLION,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    bar_outlines,
    join_with_gaps,
    tick_labels,
)
from residnet.studies.study import StudyResults, find_figures, format_notes

AXES = ("surge", "sway", "yaw")
_FORCE_NAMES = ("surge force", "sway force", "yaw moment")
_PENALTIES = tuple(10.0**k for k in range(-10, 1))
"""Ridge penalties of the search, relative to the squared norm of a standardised column."""
_RANK_TOLERANCE = 1e-7
"""Singular values of regressors below this share of the largest count as zero."""
_MIN_EARTH_FORCE_RMS = 0.02
"""Smallest root mean square of a unit force in earth axes that the basis functions do not explain.

It is small if the heading hardly changes, because the force is then constant in body axes too.
"""
_MIRROR_SIGNS = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
"""Signs of surge, sway and yaw under reflection of port and starboard."""
_SURFACE_LIMITS = (6.3, 316.0)
"""Limits of the error axis of a surface analysis in %. Some models have errors that are larger by
orders of magnitude, which would hide the differences between the others.
"""


@dataclass(frozen=True)
class ForceRegressionData:
    """The data of a regression.

    Attributes:
        terms: names of the basis functions.
        x: basis functions [N, J], float64.
        y: residual forces [N, 3] in N, N, N m.
        scale: divisors of the columns [J].
        fold: fold of each sample [N], from 0; samples of one segment or run share a fold.
        test: basis functions and residual forces of the test half, for the model selection of the
            document and for the errors by order; None without them.
    """

    terms: tuple[str, ...]
    x: Tensor
    y: Tensor
    scale: Tensor
    fold: Tensor
    test: tuple[Tensor, Tensor] | None = None

    def __post_init__(self) -> None:
        validate_data(self.x, self.y, self.terms, _FORCE_NAMES)
        if len(self.x) <= len(self.terms):
            raise FitError(
                f"{len(self.x)} samples do not determine {len(self.terms)} basis functions; give"
                " more data or fewer terms"
            )

    @property
    def standardised(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Scaled columns E [N, J] and outputs F [N, 3], mean of x, mean of y, std of y.

        Source: Jervan 2020, eqs. (3.3), (3.4), (4.8).
        """
        mean_x = self.x.mean(0)
        mean_y = self.y.mean(0)
        std_y = self.y.std(0)
        return (self.x - mean_x) / self.scale, (self.y - mean_y) / std_y, mean_x, mean_y, std_y


@dataclass(frozen=True)
class RegressionFit:
    """Coefficients of y = intercept + x coefficients.

    Attributes:
        coefficients: Theta_post [J, 3], zero for removed basis functions.
        intercept: intercept of each axis [3].
        scaled_coefficients: Theta_pre [J, 3], coefficients of the scaled variables (3.11).
        notes: selected hyperparameters.
        surface: errors of all models of a surface analysis; None for other estimators.
        errors_by_order: mean square errors [A, 3] by PLSR order in N^2, N^2, (N m)^2, by set of
            samples; NaN if unavailable.
    """

    coefficients: Tensor
    intercept: Tensor
    scaled_coefficients: Tensor
    notes: dict[str, Any] = field(default_factory=dict)
    surface: ErrorSurface | None = None
    errors_by_order: dict[str, Tensor] = field(default_factory=dict)

    def predict(self, x: Tensor) -> Tensor:
        """Return the outputs [N, 3] at basis functions [N, J]."""
        return x @ self.coefficients + self.intercept


_ESTIMATORS: Mapping[str, Estimator] = {
    "ols": CentredLeastSquares(),
    "ridge": Ridge(_PENALTIES, folds=None, is_scaled=False, is_shared=True),
    "lasso": ElasticNet(),
    "elastic_net": ElasticNet(0.5),
}
"""Estimators without settings, by kind; they select hyperparameters by cross-validation."""


@final
class RegressionConfig(Config):
    """Estimator of the coefficients of a residual force.

    Attributes:
        kind: `plsr`, PLSR of the three axes together; `surface`, PLSR of each axis separately with
            surface analysis (Jervan 2020, section 4.5.1); `ols`, ordinary least squares; `ridge`,
            `lasso` or `elastic_net` with the penalty of the smallest cross-validation error.
        order: number of latent variables of `plsr`; null for the smallest cross-validation error.
        choose: selection rule of `surface`. `test`, as in the document: smallest error on the test
            half, whose error is then no independent evidence; `simplest`: cross-validation over the
            folds of the first half with the one-standard-error rule; `least`: minimum of the
            cross-validation error.
    """

    kind: Literal["plsr", "surface", "ols", "ridge", "lasso", "elastic_net"]
    order: int | None = Field(default=None, ge=1)
    choose: Literal["test", "simplest", "least"] = "simplest"

    @model_validator(mode="after")
    def _check_options(self) -> RegressionConfig:
        for key, required_kind in (("order", "plsr"), ("choose", "surface")):
            if (
                self.kind != required_kind
                and getattr(self, key) != type(self).model_fields[key].default
            ):
                raise ValueError(
                    f"{key}: an option of kind {required_kind}; remove it for {self.kind}"
                )
        return self

    @property
    def searches_order(self) -> bool:
        """Whether the order is selected by cross-validation."""
        return self.kind == "plsr" and self.order is None

    def fit(self, data: ForceRegressionData) -> RegressionFit:
        """Return the coefficients fitted to the regression's samples.

        A PLSR also returns its errors by order (Figures 4.4, 4.22, 4.42, 5.7).

        Raises:
            FitError: if the data do not determine the coefficients.
        """
        if self.kind == "surface":
            return _fit_by_surface_analysis(data, self.choose)
        needs_folds = self.kind != "ols" and self.order is None
        estimator = _ESTIMATORS.get(self.kind) or PLSR(
            self.order, max_order=None, folds=None, is_scaled=False
        )
        e, f, mean_x, mean_y, std_y = data.standardised
        groups = data.fold if needs_folds else None
        first_fit = estimator.fit(e, f, groups, names=data.terms, outputs=_FORCE_NAMES)[0]
        # Theta_post = diag(scale)^-1 Theta_pre diag(std y), which eq. (3.12) misprints (J15 in
        # docs/documents/corrections.md)
        coefficients = first_fit.coefficients / data.scale[:, None] * std_y
        notes = first_fit.hyperparameters or first_fit.notes
        if self.kind == "ridge":
            notes = {"penalty": notes["penalty"][0]}
        if notes.get("order") == 0:
            raise FitError("PLSR: the residual does not depend on the basis functions")
        orders = _errors_by_order(data) if self.kind == "plsr" else {}
        return RegressionFit(
            coefficients,
            mean_y - mean_x @ coefficients,
            first_fit.coefficients,
            notes,
            errors_by_order=orders,
        )


def _errors_by_order(data: ForceRegressionData) -> dict[str, Tensor]:
    """Return the mean square errors [A, 3] of a PLSR by order, for each set of samples.

    The sets are the left-out segments of a cross-validation, and the test half.
    """
    e, f, mean_x, mean_y, std_y = data.standardised
    folds = data.fold.unique()
    nan_errors = torch.full_like(f, torch.nan).repeat(e.shape[1], 1, 1)
    left_out_errors = nan_errors.clone()
    test_errors = nan_errors[:, :1]
    for fold in folds if len(folds) > 1 else ():
        is_left_out = data.fold == fold
        left_out_errors[:, is_left_out] = _pls_errors(
            e[~is_left_out], f[~is_left_out], e[is_left_out], f[is_left_out]
        )
    if data.test is not None and len(data.test[0]):
        x, y = data.test
        test_errors = _pls_errors(e, f, (x - mean_x) / data.scale, (y - mean_y) / std_y)
    errors = {"left-out segments": left_out_errors, "test half": test_errors}
    return {
        sample_kind: error.square().mean(1) * std_y.square()
        for sample_kind, error in errors.items()
    }


def _pls_errors(e: Tensor, f: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the errors [J, N, 3] at x of a PLSR of f on e, for each order."""
    mean_e = e.mean(0)
    mean_f = f.mean(0)
    centred = e - mean_e
    orders = e.shape[1]
    path = pls_path(centred.T @ centred, centred.T @ (f - mean_f), orders)
    if len(path) < orders:
        # the path ends when the remaining covariance is zero: higher orders are equal to the last
        last = path[-1:] if len(path) else torch.zeros(1, orders, f.shape[1], dtype=e.dtype)
        path = torch.cat((path, last.expand(orders - len(path), -1, -1)))
    return y - mean_f - (x - mean_e) @ path


def _fit_by_surface_analysis(data: ForceRegressionData, rule: str) -> RegressionFit:
    x = data.x
    y = data.y
    groups = data.fold
    estimator = SurfacePLSR("simplest" if rule == "simplest" else "least")
    if rule == "test":
        if data.test is None:
            raise FitError("surface: choose 'test' needs the test half")
        x, y = torch.cat((x, data.test[0])), torch.cat((y, data.test[1]))
        # fitted on the first half (group 0), errors on the test half (group 1), as in the document
        groups = (torch.arange(len(x)) >= len(data.x)).long()
        estimator = SurfacePLSR("least", test_groups=[1])
    surface = estimator.error_surface(x, y, groups)
    best_fit = estimator.solution_at_selection(surface, x, y, groups)
    scaled_coefficients = best_fit.coefficients * data.x.std(0)[:, None] / data.y.std(0)
    return RegressionFit(
        best_fit.coefficients,
        best_fit.intercept,
        scaled_coefficients,
        best_fit.hyperparameters,
        surface,
    )


class ResidualModelConfig(Config):
    """A regression of a force residual on basis functions of nu_dot and nu.

    Attributes:
        fit: estimator of the coefficients, with its settings.
        terms: basis functions: products of u_dot, v_dot, r_dot, u, v, r and their absolute values;
            by default the 30 of (4.12).
        lag: whether the lag of the thrusters is identified together with the coefficients, so that
            the force is the lagged command. Null: a PLSR without a given order selects lag, no lag
            or zero residual by cross-validation; other estimators assume no lag.
        mirror: whether port-starboard symmetry is assumed. Null: selected by cross-validation where
            the lag is; otherwise not assumed.
        earth: also identify a constant force in earth axes, such as wind.
    """

    fit: RegressionConfig
    terms: tuple[str, ...] = FERRY_TERMS
    lag: bool | None = None
    mirror: bool | None = None
    earth: bool = False

    @property
    def searches_settings(self) -> bool:
        """Whether lag, symmetry and zero residual are candidates in addition to the orders."""
        return self.lag is None and self.fit.searches_order

    def model_post_init(self, context: Any) -> None:
        """Parse the terms, so that a wrong one is found when the config is read."""
        for term in self.terms:
            parse_term(term, MOTION_CHANNELS)


@dataclass(frozen=True)
class ForceRecord:
    """Motion and commanded force of one or several runs, on a uniform time grid of N samples.

    Attributes:
        t: time [N] in s.
        pose: measured x, y, psi [N, 3] in m, m, rad.
        nu: measured u, v, r [N, 3] in m/s, m/s, rad/s.
        nu_dot: measured accelerations [N, 3] in m/s^2, m/s^2, rad/s^2.
        command: commanded force at the samples [N, 3] in N, N, N m.
        averaged_command: commanded force averaged over the controller's steps around a sample [N,
            3].
        fold: segment of each sample [N].
        is_training: training samples [N] bool; the others test the model.
        noise: standard deviations of the measured pose, nu and nu_dot, nine numbers.
        run_lengths: number of samples of each concatenated run; empty for one run.
    """

    t: Tensor
    pose: Tensor
    nu: Tensor
    nu_dot: Tensor
    command: Tensor
    averaged_command: Tensor
    fold: Tensor
    is_training: Tensor
    noise: tuple[float, ...]
    run_lengths: tuple[int, ...] = ()

    @property
    def dt(self) -> float:
        """Sampling interval in s."""
        return float(self.t[1] - self.t[0])

    def motion_ranges(self, *, mirror: bool) -> list[tuple[float, float]]:
        """Return the ranges of nu_dot and nu over the training samples, six pairs.

        With `mirror` the mirror images of the samples are included.
        """
        motion = torch.cat((self.nu_dot, self.nu), dim=-1)[self.is_training]
        if mirror:
            motion = torch.cat((motion, motion * torch.cat((_MIRROR_SIGNS, _MIRROR_SIGNS))))
        return list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))

    def smooth(self) -> ForceRecord:
        """Return the record with the most likely motion under the known noise of the sensors."""
        from residnet.preprocessing.motion import smooth_measured_motion

        measured = torch.cat((self.pose, self.nu, self.nu_dot), dim=-1)
        motion = torch.from_numpy(smooth_measured_motion(measured.numpy(), self.noise, self.dt))
        pose, nu, nu_dot = (motion[:, columns] for columns in (POSE, VELOCITIES, ACCELERATIONS))
        return replace(self, pose=pose, nu=nu, nu_dot=nu_dot)


class ResidualForceModel(NamedTuple):
    """A fitted model of a residual force.

    Attributes:
        force: F = F_base + correction.
        lag: lag of the thrusters; None if not identified.
        fit: coefficients, and the selected hyperparameters in its notes.
    """

    force: ForceModel
    lag: ActuatorLag | None
    fit: RegressionFit

    def residual_along(self, record: ForceRecord) -> Tensor:
        """Return the remaining residual [N, 3] of the model along a record, in N, N, N m.

        It is the force of the thrusters minus that of the model. The force of the thrusters is the
        command, delayed by the lag if the model has one.
        """
        force = record.command
        if self.lag is not None:
            force = simulate_lagged_force(
                record.averaged_command, self.lag, record.dt, record.run_lengths
            )
        return self.force.force_residual(force, record.nu_dot, record.nu, record.pose[:, HEADING])

    def test_mse(self, record: ForceRecord) -> list[float]:
        """Return the mean square of the remaining residual of the unsmoothed measurements, by axis.

        The mean is over the test samples, in N^2, N^2, (N m)^2.
        """
        return mean_squares_by_axis(self.residual_along(record)[~record.is_training])


def fit_model(
    config: ResidualModelConfig,
    record: ForceRecord,
    base: ForceModel,
    lag: ActuatorLag | None = None,
) -> ResidualForceModel:
    """Fit one model of the residual force of `base` on the training samples of a record.

    Args:
        base: the known model, F_base(nu_dot, nu).
        lag: known lag of the thrusters, if the config asks for a lag; None to identify it.

    Raises:
        FitError: if the data do not determine the model.
    """
    if config.searches_settings:
        return _search_settings(config, record, base)
    # basis functions and the force of the known model along the record
    train = record.is_training
    psi = record.pose[:, HEADING]
    x = TermLibrary(config.terms, MOTION_CHANNELS)(torch.cat((record.nu_dot, record.nu), dim=-1))
    base_force = base.thruster_force(record.nu_dot, record.nu, psi)
    # unit forces to north and to east in body axes, without a moment
    unit_vectors = torch.eye(2, dtype=psi.dtype)
    unit_earth_forces = torch.stack(
        [
            torch.stack((*to_body(north, east, psi), torch.zeros_like(psi)), dim=-1)
            for north, east in unit_vectors
        ],
        dim=-1,
    )
    # the force of the thrusters: the command, or the command after the identified lag
    force = record.command
    notes: dict[str, Any] = {}
    if config.lag:
        regressors = torch.cat((x, unit_earth_forces[:, 0]), dim=-1) if config.earth else x
        if lag is None:
            lag = fit_lag(
                record.averaged_command,
                base_force,
                regressors,
                record.dt,
                train,
                record.run_lengths,
            )
        force = simulate_lagged_force(record.averaged_command, lag, record.dt, record.run_lengths)
        notes["lag"] = lag.model_dump()
    # the residual, without the part that is constant in earth axes
    y = force - base_force
    earth_force = None
    if config.earth:
        earth_force = estimate_earth_force(x[train], y[train], -unit_earth_forces[train])
        y = y + torch.einsum("nad,d->na", unit_earth_forces, earth_force)
        notes["earth"] = dict(zip(("north", "east"), earth_force.tolist(), strict=True))
    train_terms = x[train]
    train_target = y[train]
    fold = record.fold[train]
    # with symmetry the mirror images of the samples are samples too
    if config.mirror:
        term_signs = mirror_signs(config.terms)
        if term_signs is None:
            raise FitError("mirror: not all basis functions are known to mirror; leave it out")
        train_terms = torch.cat((train_terms, train_terms * term_signs))
        train_target = torch.cat((train_target, train_target * _MIRROR_SIGNS))
        fold = fold.repeat(2)
        notes["mirror"] = True
    data = ForceRegressionData(
        config.terms,
        train_terms,
        train_target,
        weighted_column_std(config.terms, torch.nan_to_num(train_terms)),
        torch.unique(fold, return_inverse=True)[1],
        (x[~train], y[~train]),
    )
    fit = config.fit.fit(data)
    correction = ForceCorrection(config.terms, fit.coefficients, fit.intercept)
    model = base.with_correction(correction, earth_force)
    return ResidualForceModel(model, lag, replace(fit, notes=fit.notes | notes))


def _search_settings(
    config: ResidualModelConfig, record: ForceRecord, base: ForceModel
) -> ResidualForceModel:
    """Return the model with the smallest cross-validated error.

    Candidates are models with and without lag and mirror symmetry, and a zero residual. Errors are
    relative to the residual of the base, so that a zero residual has an error of one.
    """
    no_residual_model = ResidualForceModel(
        base, None, RegressionFit(torch.zeros(0), torch.zeros(0), torch.zeros(0))
    )
    base_mse = torch.tensor(
        mean_squares_by_axis(no_residual_model.residual_along(record)[record.is_training])
    )
    candidates = []
    errors = []
    known_lag: ActuatorLag | None = None
    mirrors = [False, True] if config.mirror is None else [config.mirror]
    if mirror_signs(config.terms) is None and config.mirror is None:
        mirrors = [False]
    for lag, mirror in itertools.product((False, True), mirrors):
        try:
            candidate_config = config.model_copy(update={"lag": lag, "mirror": mirror})
            candidate = fit_model(candidate_config, record, base, known_lag if lag else None)
        except FitError as error:
            errors.append(error)
            continue
        known_lag = candidate.lag
        left_out_error = (
            candidate.fit.errors_by_order["left-out segments"][candidate.fit.notes["order"] - 1]
            / base_mse
        )
        candidates.append((float(left_out_error.nan_to_num(torch.inf).mean()), candidate))
    if not candidates:
        raise errors[0]
    lowest_error, best_model = min(candidates, key=lambda pair: pair[0])
    if lowest_error < 1.0:
        notes = {**best_model.fit.notes, "left_out": lowest_error}
        return best_model._replace(fit=replace(best_model.fit, notes=notes))
    zero = torch.zeros_like(best_model.fit.coefficients)
    fit = RegressionFit(zero, zero[0], zero, {"order": 0, "left_out": 1.0})
    return ResidualForceModel(
        base.with_correction(ForceCorrection(config.terms, zero, zero[0])), None, fit
    )


def refit_with_settings(
    config: ResidualModelConfig, model: ResidualForceModel, record: ForceRecord, base: ForceModel
) -> ResidualForceModel:
    """Fit a model to other samples with its selected settings and its lag.

    Raises:
        FitError: if the samples do not determine the model.
    """
    notes = model.fit.notes
    settings = {
        "fit": config.fit.model_copy(update={"order": notes["order"]}),
        "lag": model.lag is not None,
        "mirror": bool(notes.get("mirror")),
    }
    return fit_model(config.model_copy(update=settings), record, base, model.lag)


def mirror_signs(terms: Sequence[str]) -> Tensor | None:
    """Return the sign [J] of the mirror image of each basis function; None if unknown."""
    signs = [
        parity
        for term in terms
        if (parity := compute_term_parity(term, MOTION_CHANNELS)) is not None
    ]
    return torch.tensor(signs, dtype=torch.float64) if len(signs) == len(terms) else None


def estimate_earth_force(x: Tensor, y: Tensor, unit_forces: Tensor) -> Tensor:
    """Return the force (north, east) [2] in N that is constant in earth axes.

    The basis functions, whose coefficients differ from axis to axis, are projected out first.

    Args:
        x: basis functions [N, J].
        y: residual [N, 3] in N, N, N m.
        unit_forces: residual of a unit force to the north and to the east [N, 3, 2].

    Raises:
        FitError: if the vessel turned too little to separate it from a constant in body axes.
    """
    scaled = (x - x.mean(0)) / x.std(0).clamp(min=1e-300)
    with_intercept = torch.cat((torch.ones_like(x[:, :1]), scaled), dim=-1)
    left_vectors, singular, _ = torch.linalg.svd(with_intercept, full_matrices=False)
    left_vectors = left_vectors[:, singular > _RANK_TOLERANCE * singular[0]]

    def project_out(values: Tensor) -> Tensor:
        projected: Tensor = values - left_vectors @ (left_vectors.T @ values)
        return projected

    weight = project_out(y).std(0).clamp(min=1e-9)
    # surge and sway only: a constant force has no moment about the origin of the model
    design = torch.cat([project_out(unit_forces[:, a]) / weight[a] for a in range(2)])
    target = torch.cat([project_out(y[:, a]) / weight[a] for a in range(2)])
    sensitivity = float(torch.linalg.svdvals(design * weight[:2].mean())[-1]) / len(y) ** 0.5
    if sensitivity < _MIN_EARTH_FORCE_RMS:
        raise FitError(
            "a constant force in earth axes is not identifiable, because the heading hardly"
            " changed; use a run with turns, or remove `earth`"
        )
    solution: Tensor = torch.linalg.lstsq(design, target[:, None]).solution
    return solution[:, 0]


def _coefficients_by_term(rows: Sequence[Mapping[str, float]]) -> dict[str, Tensor]:
    """Return the coefficients in surge, sway and yaw [3] by term, from one row for each axis."""
    return {
        term: torch.tensor([row.get(term, 0.0) for row in rows], dtype=torch.float64)
        for term in dict.fromkeys(term for row in rows for term in row)
    }


def derive_forward_equations(believed: str, model: ForceModel, label: str) -> HullEquations:
    """Return the accelerations of a force-space model as sums of terms.

    They are nu_dot = (M + A)^-1 (tau - C nu - D nu - b), in the form of the baseline `believed`.

    Args:
        believed: vessel of the known hull, by name or file.
        model: the known hull and its residual eps = A nu_dot + b(nu).
        label: name of the model in error messages.

    Raises:
        ConfigError: if a basis function is not affine in nu_dot.
        FitError: if the augmented mass matrix is ill-conditioned.
    """
    augmented_mass = model.hull.mass
    zero_force = torch.zeros(3, dtype=torch.float64)
    residual_terms = {"1": zero_force}
    for correction in model.corrections:
        assert isinstance(correction, ForceCorrection)
        terms = correction.library.terms
        coefficients = correction.coefficients
        augmented_mass, remaining_terms = augment_mass(augmented_mass, terms, coefficients, label)
        correction_terms = {"1": correction.intercept} | {
            terms[j]: coefficients[j] for j in remaining_terms
        }
        for term, force in correction_terms.items():
            residual_terms[term] = residual_terms.get(term, zero_force) + force
    inverse = torch.linalg.inv(augmented_mass)
    believed_terms = _coefficients_by_term(
        BelievedConfig(vessel=believed).hull_equations().axis_coefficients()
    )
    acceleration_terms = {
        term: inverse @ model.hull.mass @ column for term, column in believed_terms.items()
    }
    for term, force in residual_terms.items():
        acceleration_terms[term] = acceleration_terms.get(term, zero_force) - inverse @ force
    u, v, r = (
        {
            term: float(value[axis])
            for term, value in acceleration_terms.items()
            if float(value[axis]) != 0.0
        }
        for axis in range(3)
    )
    return HullEquations(u=u, v=v, r=r)


def exact_residual_coefficients(plant_name: str, believed: str) -> dict[str, list[float]]:
    """Return the exact coefficients of a residual by basis function: surge, sway, yaw.

    They are the coefficients of the simulated vessel minus those of the believed hull. Jervan 2020
    misprints the cross terms (J19 in docs/documents/corrections.md).

    Args:
        plant_name: name of the simulated vessel.
        believed: name of the vessel of the known hull.
    """

    def factors(term: str) -> tuple[Any, ...]:
        return tuple(sorted(parse_term(term, MOTION_CHANNELS)))

    names = {factors(term): term for term in FERRY_TERMS}

    def force_coefficients(vessel: str) -> dict[str, Tensor]:
        """Return the coefficients [3] of F(nu_dot, nu) by basis function of Jervan 2020."""
        columns = _coefficients_by_term(
            BelievedConfig(vessel=vessel).hull_equations().axis_coefficients()
        )
        mass = torch.linalg.inv(torch.stack([columns.pop(name) for name in FORCE_CHANNELS], dim=1))
        coefficients = {name: mass[:, axis] for axis, name in enumerate(ACCELERATION_NAMES)}
        return coefficients | {
            names.get(factors(term), term): -mass @ column for term, column in columns.items()
        }

    plant_coefficients = force_coefficients(plant_name)
    believed_coefficients = force_coefficients(believed)
    zero = torch.zeros(3, dtype=torch.float64)
    missing = {}
    for key in dict.fromkeys((*believed_coefficients, *plant_coefficients)):
        plant_value = plant_coefficients.get(key, zero)
        difference = plant_value - believed_coefficients.get(key, zero)
        # the tolerance removes differences due to rounding
        is_different = difference.abs() > 1e-9 * (1 + plant_value.abs())
        if bool(is_different.any()):
            missing[key] = torch.where(is_different, difference, zero).tolist()
    return missing


def to_baseline_yaml(equations: HullEquations, label: str) -> str:
    """Return the model as YAML lines for the `baseline` or `baselines` of a fit."""
    lines = [
        f"# {label}: accelerations from velocities and forces; needs the channels"
        f" {', '.join((*VELOCITY_NAMES, *FORCE_CHANNELS))}"
    ]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY_NAMES, equations.axis_coefficients(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"


def fit_to_json(terms: Sequence[str], fit: RegressionFit) -> dict[str, Any]:
    """Return the JSON entry of a fitted model: terms, coefficients and weights."""
    return {
        "terms": list(terms),
        "coefficients": fit.coefficients.tolist(),
        "intercept": fit.intercept.tolist(),
        "weights": fit.scaled_coefficients.abs().tolist(),
    }


def model_sections(
    title: str,
    models: Mapping[str, StudyResults],
    run: Path,
    notes_key: str,
    comparisons: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]],
) -> list[Section]:
    """Return the report sections on fitted models: rejected models, coefficients, figures.

    Args:
        models: entries of the results (`fit_to_json`) by name.
        run: folder of the `model_figures`.
        comparisons: reference coefficients [3] by basis function, by model and by source, such as
            `plant_name` and `published`.
    """
    refusal_reasons = [model["not_forward"] for model in models.values() if model["not_forward"]]
    refusal_section = Section("Models that cannot run forward in time", [Bullets(refusal_reasons)])
    explanation = Text(
        "The force of a model is that of the believed hull plus the sum of coefficient times basis"
        " function, in SI units. A weight is the magnitude of the coefficient of scaled variables,"
        " by which basis functions with different units can be compared."
    )
    model_blocks = []
    for name, model in models.items():
        terms = model["terms"]
        nonzero_coefficients = {
            t: row for t, row in zip(terms, model["coefficients"], strict=True) if any(row)
        }
        comparison_values = {
            comparison: values for comparison, values in comparisons.get(name, {}).items() if values
        }
        forces = {
            "coefficient": {"1": model["intercept"], **nonzero_coefficients},
            **comparison_values,
        }
        weights = dict(zip(terms, model["weights"], strict=True))
        groups = [(comparison, 3) for comparison in ("coefficient", "weight", *comparison_values)]
        table = Table(["basis function", *AXES * len(groups)], groups=groups)
        for term in dict.fromkeys(
            term for values_by_term in forces.values() for term in values_by_term
        ):
            model_cells, *comparison_cells = (
                [format_number(value, 4) for value in values_by_term.get(term, (0.0, 0.0, 0.0))]
                for values_by_term in forces.values()
            )
            weight = (
                [format_number(value, 3) for value in weights[term]]
                if term in weights
                else [""] * 3
            )
            table.add_row(
                term,
                [*model_cells, *weight, *(text for texts in comparison_cells for text in texts)],
            )
        choice_text = format_notes(model[notes_key])
        choice_block = Text(f"Chosen by the estimator: {choice_text}." if choice_text else "")
        model_blocks.append(Section(name, [choice_block, table], is_folded=True))
    figures = find_figures(run, "orders_", "surface_", "weights_")
    return [
        *([refusal_section] if refusal_reasons else []),
        Section(title, [explanation, *model_blocks]),
        Section("Orders, weights and surfaces", figures, True),
    ]


def model_figures(
    name: str, config: ResidualModelConfig, fit: RegressionFit, unmodelled: Sequence[float]
) -> list[Figure]:
    """Return figures of the weights of a model, and of the errors for the choice of its order.

    They correspond to Figures 4.6, 4.20, 4.22 and 4.25 of Jervan 2020.

    Args:
        unmodelled: mean square of the believed model's residual by axis.
    """
    positions = np.arange(len(config.terms))
    weights = fit.scaled_coefficients.abs().numpy()
    names = tick_labels(config.terms)
    figures = [
        Figure(
            f"weights_{name}",
            f"Weights of the basis functions in {name}",
            "Magnitude of the coefficients of scaled basis functions. It shows how much each one"
            " weighs in the model.",
            {"weights": GlyphStyle("", BLUE, kind="fill")},
            [Panel(f"{axis}, scaled [-]", height=165, group="w", x_names=names) for axis in AXES],
            [
                Case(
                    "",
                    [{"weights": bar_outlines(positions, weights[:, axis])} for axis in range(3)],
                )
            ],
        )
    ]
    if fit.errors_by_order:
        figures.append(
            _order_figure(name, fit.errors_by_order, unmodelled, int(fit.notes["order"]))
        )
    if fit.surface is not None:
        rule_choices = {
            "chosen": list(zip(fit.notes["order"], fit.notes["terms"], strict=True)),
            "least": [fit.surface.minimum_error_model(axis) for axis in range(3)],
        }
        figures.append(_surface_figure(name, fit.surface.error, unmodelled, rule_choices))
    return figures


def _order_figure(
    name: str,
    errors_by_samples: Mapping[str, Tensor],
    unmodelled: Sequence[float],
    chosen_order: int,
) -> Figure:
    """Return a figure of the remaining error of a PLSR by order.

    Args:
        name: name of the model.
        errors_by_samples: mean square error by order and axis [A, 3], by set of samples.
        unmodelled: mean square of the residual of each axis.
        chosen_order: order of the model.
    """
    colors = dict(zip(errors_by_samples, (BLUE, VERMILLION), strict=True))
    styles = {label: GlyphStyle(label, color) for label, color in colors.items()}
    styles["chosen"] = GlyphStyle("this model", GREY, "dashed", 1.0, kind="vline")
    panels_shown = []
    for axis in range(3):
        panel = {"chosen": (np.array([float(chosen_order)]), np.zeros(1))}
        for label, error in errors_by_samples.items():
            relative_error = error[:, axis].numpy() / unmodelled[axis]
            if np.isfinite(relative_error).any():
                panel[label] = (np.arange(len(relative_error)) + 1.0, relative_error)
        panels_shown.append(panel)
    return Figure(
        f"orders_{name}",
        "Error over the order of the PLSR",
        "Mean square of the remaining residual as a share of that of the unmodelled residual, by"
        " model order: on segments that were left out of the fit one by one, and on the test half.",
        styles,
        [
            Panel(f"{axis}, relative MSE [-]", "model order", height=285, y_log=True)
            for axis in AXES
        ],
        [Case("", panels_shown)],
        columns=3,
    )


def _surface_figure(
    name: str,
    error: Tensor,
    unmodelled: Sequence[float],
    choices: Mapping[str, Sequence[tuple[int, int]]],
) -> Figure:
    """Return the figure of the error over model orders, with marks at the selected orders."""
    marks = (("x", VERMILLION), ("o", PURPLE), ("s", ORANGE))
    styles = {
        "orders": GlyphStyle("each model order", GREY, width=0.8),
        "order": GlyphStyle("order of this model", BLUE, width=1.6),
    }
    for label, (marker, color) in zip(choices, marks, strict=False):
        styles[label] = GlyphStyle(
            label, color, kind="points", marker=marker, size=7, is_hollow=True, z_order=5
        )
    panel_traces = []
    for axis in range(3):
        # [A, J] by model order, from 1 on, and number of basis functions
        relative_error = 100.0 * error[axis].numpy() / unmodelled[axis]
        counts = np.arange(relative_error.shape[1], dtype=float)
        best_order, _ = choices["chosen"][axis]
        panel = {
            "orders": join_with_gaps((counts, row) for row in relative_error),
            "order": (counts, relative_error[best_order - 1]),
        }
        for label, picks_by_axis in choices.items():
            order, count = picks_by_axis[axis]
            panel[label] = (np.array([float(count)]), relative_error[order - 1, [count]])
        panel_traces.append(panel)
    return Figure(
        f"surface_{name}",
        "Surface analysis",
        "Mean square of the remaining residual as a share of that of the unmodelled residual, by"
        " number of basis functions, a line for each model order. Marks show the selection of each"
        " rule.",
        styles,
        [
            Panel(
                f"{axis}, relative MSE [%]",
                "basis functions",
                height=285,
                y_log=True,
                y_limits=_SURFACE_LIMITS,
            )
            for axis in AXES
        ],
        [Case("", panel_traces)],
        columns=3,
    )
