"""Residual forces of a known hull: how both studies of document 002 (Jervan 2020) identify them.

The residual is the force that the hull does not explain: tau - F(nu_dot, nu) (3.19), (3.20). It is
regressed on basis functions of the motion (chapters 3 and 4); a model runs forward in time by
(3.22).
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

from residnet.baselines.given import BelievedConfig, HullEquations
from residnet.control.motion import Lag
from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.core.format import number
from residnet.core.frames import to_body
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, VELOCITIES
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.documents.study import Results, notes_text, pictures
from residnet.judge.autopilots import mse
from residnet.physics.force_model import (
    FERRY_TERMS,
    MOTION,
    Correction,
    ForceModel,
    augmented,
    column_scale,
)
from residnet.physics.signals import FORCE_CHANNELS
from residnet.physics.symmetry import term_parity
from residnet.physics.terms import TermLibrary, parse_term
from residnet.regression.estimator import Estimator, require_data
from residnet.regression.least_squares import CentredLeastSquares, ElasticNet
from residnet.regression.shrinkage import PLSR, Ridge, pls_path
from residnet.regression.surface import Surface, SurfacePLSR
from residnet.report.blocks import Bullets, Section, Table, Text
from residnet.report.figure import (
    BLUE,
    GREY,
    ORANGE,
    PURPLE,
    VERMILLION,
    Case,
    Figure,
    Look,
    Panel,
    bars,
    joined,
    names_of,
)
from residnet.training.lag import fit_lag, followed

AXES = ("surge", "sway", "yaw")
_FORCES = ("surge force", "sway force", "yaw moment")
_PENALTIES = tuple(10.0**k for k in range(-10, 1))
"""Ridge penalties tried where none is given, in units of a standardised column's energy."""
_RANK_TOLERANCE = 1e-7
"""Regressors with singular values below this share of the largest count as dependent."""
_LEAST_EARTH_FORCE_SPREAD = 0.02
"""Least root mean square that turning must leave of a unit force fixed in earth axes."""
_SIDES = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
"""Signs of surge, sway and yaw in the mirror."""
_SURFACE_SPAN = (6.3, 316.0)
"""Shares in % that the axis of a surface analysis shows; single models lie orders above."""


@dataclass(frozen=True)
class Regression:
    """The data of a regression.

    Attributes:
        terms: names of the basis functions.
        x: basis functions [N, J], float64.
        y: residual forces [N, 3] in N, N, N m.
        scale: what the columns are divided by [J].
        fold: of each sample [N], from 0; samples that belong together (a segment, a run) share a
            fold.
        test: samples of the document's own choice of a model, which judges on them; None where a
            model must not see them.
    """

    terms: tuple[str, ...]
    x: Tensor
    y: Tensor
    scale: Tensor
    fold: Tensor
    test: tuple[Tensor, Tensor] | None = None

    def __post_init__(self) -> None:
        require_data(self.x, self.y, self.terms, _FORCES)
        if len(self.x) <= len(self.terms):
            raise FitError(
                f"{len(self.x)} samples do not determine {len(self.terms)} basis functions; give"
                " more data or fewer terms"
            )

    @property
    def standardised(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """E [N, J], F [N, 3], mean of x, mean of y, std of y (3.3), (3.4), (4.8)."""
        mean_x, mean_y, std_y = self.x.mean(0), self.y.mean(0), self.y.std(0)
        return (self.x - mean_x) / self.scale, (self.y - mean_y) / std_y, mean_x, mean_y, std_y


@dataclass(frozen=True)
class Fit:
    """Coefficients of y = intercept + x coefficients.

    Attributes:
        coefficients: Theta_post [J, 3], zero for basis functions that were removed.
        intercept: of each axis [3].
        pre: Theta_pre [J, 3], coefficients of the scaled variables (3.11).
        notes: what was chosen.
        surface: errors of all models that the choice was made from, where a surface analysis made
            it.
        orders: mean square errors [A, 3] over the order of a PLSR in N^2, N^2, (N m)^2, by the
            samples that they are of; NaN where there are none.
    """

    coefficients: Tensor
    intercept: Tensor
    pre: Tensor
    notes: dict[str, Any] = field(default_factory=dict)
    surface: Surface | None = None
    orders: dict[str, Tensor] = field(default_factory=dict)

    def predict(self, x: Tensor) -> Tensor:
        """Return the outputs [N, 3] at basis functions [N, J]."""
        return x @ self.coefficients + self.intercept


_ESTIMATORS: Mapping[str, Estimator] = {
    "ols": CentredLeastSquares(),
    "ridge": Ridge(_PENALTIES, folds=None, scale=False, shared=True),
    "lasso": ElasticNet(),
    "elastic_net": ElasticNet(0.5),
}
"""Estimators without settings, by kind; what they choose they choose over left-out folds."""


@final
class RegressionConfig(Config):
    """A way to find the coefficients of a residual force.

    Attributes:
        kind: `plsr`, of the three axes together; `surface`, PLSR of each axis by itself, chosen by
            surface analysis (document 002 section 4.5.1); `ols`, ordinary least squares; `ridge`,
            `lasso` or `elastic_net`, with the penalty of the least error over left-out folds.
        order: number of latent variables of `plsr`; null takes the least error over left-out folds.
        choose: how `surface` chooses. `test`, the document's own: the least error on the test half,
            which then also judges it; `simplest`: cross-validation over the folds of the first half
            and the one-standard-error rule; `least`: cross-validation and its bare minimum.
    """

    kind: Literal["plsr", "surface", "ols", "ridge", "lasso", "elastic_net"]
    order: int | None = Field(default=None, ge=1)
    choose: Literal["test", "simplest", "least"] = "simplest"

    @model_validator(mode="after")
    def _own(self) -> RegressionConfig:
        for key, kind in (("order", "plsr"), ("choose", "surface")):
            if self.kind != kind and getattr(self, key) != type(self).model_fields[key].default:
                raise ValueError(f"{key}: belongs to kind {kind}; leave it out of {self.kind}")
        return self

    @property
    def searches(self) -> bool:
        """Whether it searches its order."""
        return self.kind == "plsr" and self.order is None

    def fit(self, data: Regression) -> Fit:
        """Return the coefficients that fit the regression's samples.

        A PLSR tells its errors over all orders, too (Figures 4.4, 4.22, 4.42, 5.7).

        Raises:
            FitError: where the data do not determine them.
        """
        if self.kind == "surface":
            return _by_surface(data, self.choose)
        chooses = self.kind != "ols" and self.order is None
        estimator = _ESTIMATORS.get(self.kind) or PLSR(
            self.order, max_order=None, folds=None, scale=False
        )
        e, f, mean_x, mean_y, std_y = data.standardised
        groups = data.fold if chooses else None
        first = estimator.fit(e, f, groups, names=data.terms, outputs=_FORCES)[0]
        # Theta_post = diag(scale)^-1 Theta_pre diag(std y) (3.12), correction J15
        post = first.coefficients / data.scale[:, None] * std_y
        notes = first.choice or first.notes
        if self.kind == "ridge":
            notes = {"penalty": notes["penalty"][0]}
        if notes.get("order") == 0:
            raise FitError("PLSR: nothing in the residual varies with the basis functions")
        orders = _errors_by_order(data) if self.kind == "plsr" else {}
        return Fit(post, mean_y - mean_x @ post, first.coefficients, notes, orders=orders)


def _errors_by_order(data: Regression) -> dict[str, Tensor]:
    """Return the mean square errors [A, 3] of a PLSR over its order, on folds left out and test."""
    e, f, mean_x, mean_y, std_y = data.standardised
    folds, nothing = data.fold.unique(), torch.full_like(f, torch.nan).repeat(e.shape[1], 1, 1)
    left_out, test = nothing.clone(), nothing[:, :1]
    for fold in folds if len(folds) > 1 else ():
        out = data.fold == fold
        left_out[:, out] = _error_by_order(e[~out], f[~out], e[out], f[out])
    if data.test is not None and len(data.test[0]):
        x, y = data.test
        test = _error_by_order(e, f, (x - mean_x) / data.scale, (y - mean_y) / std_y)
    errors = {"left-out segments": left_out, "test half": test}
    return {what: error.square().mean(1) * std_y.square() for what, error in errors.items()}


def _error_by_order(e: Tensor, f: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the errors [J, N, 3] at x of a PLSR of f on e, for each order."""
    mean_e, mean_f = e.mean(0), f.mean(0)
    centred, orders = e - mean_e, e.shape[1]
    path = pls_path(centred.T @ centred, centred.T @ (f - mean_f), orders)
    if len(path) < orders:
        # what is left explains nothing: higher orders change no more
        last = path[-1:] if len(path) else torch.zeros(1, orders, f.shape[1], dtype=e.dtype)
        path = torch.cat((path, last.expand(orders - len(path), -1, -1)))
    return y - mean_f - (x - mean_e) @ path


def _by_surface(data: Regression, choose: str) -> Fit:
    x, y, groups = data.x, data.y, data.fold
    estimator = SurfacePLSR("simplest" if choose == "simplest" else "least")
    if choose == "test":
        if data.test is None:
            raise FitError("surface: choose 'test' needs the test half")
        x, y = torch.cat((x, data.test[0])), torch.cat((y, data.test[1]))
        groups = (torch.arange(len(x)) >= len(data.x)).long()
        estimator = SurfacePLSR("least", test=[1])
    found = estimator.surface(x, y, groups)
    best = estimator.chosen(found, x, y, groups)
    pre = best.coefficients * data.x.std(0)[:, None] / data.y.std(0)
    return Fit(best.coefficients, best.intercept, pre, best.choice, found)


class ResidualModelConfig(Config):
    """A regression of a force residual on basis functions of nu_dot and nu.

    Attributes:
        fit: estimator of the coefficients, with its settings.
        terms: basis functions, written as products of u_dot, v_dot, r_dot, u, v, r and their
            absolute values; the 30 of (4.12) unless given.
        lag: identify the thrusters' lag together with the coefficients, and explain the force that
            follows the command through it. Null where an estimator searches its order: with lag,
            without, and no residual at all are then tried too, over the same left-out folds; for
            other estimators null is without.
        mirror: what a motion to port shows is taken to hold to starboard too, as for a hull that is
            alike on both sides. Null tries both ways where `lag` does.
        earth: also identify a force that is constant in earth axes, such as that of wind.
    """

    fit: RegressionConfig
    terms: tuple[str, ...] = FERRY_TERMS
    lag: bool | None = None
    mirror: bool | None = None
    earth: bool = False

    @property
    def searched(self) -> bool:
        """Whether lag, mirror and no residual at all are candidates beside the orders."""
        return self.lag is None and self.fit.searches

    def model_post_init(self, context: Any) -> None:
        """Parse the terms, so that a wrong one is found when the config is read."""
        for term in self.terms:
            parse_term(term, MOTION)


@dataclass(frozen=True)
class Record:
    """Motion and commanded force of one or several runs, on a uniform time grid of N samples.

    Attributes:
        t: time [N] in s.
        pose: measured x, y, psi [N, 3] in m, m, rad.
        nu: measured u, v, r [N, 3] in m/s, m/s, rad/s.
        nu_dot: measured accelerations [N, 3] in m/s^2, m/s^2, rad/s^2.
        command: commanded force at the samples [N, 3] in N, N, N m.
        averaged: commanded force averaged over the controller's steps around a sample [N, 3].
        fold: number of the segment that a sample belongs to [N].
        train: samples to identify from [N] bool; the others test the model.
        noise: standard deviations of the measured pose, nu and nu_dot, nine numbers.
        runs: numbers of samples of the runs that stand one after another; empty for one run.
    """

    t: Tensor
    pose: Tensor
    nu: Tensor
    nu_dot: Tensor
    command: Tensor
    averaged: Tensor
    fold: Tensor
    train: Tensor
    noise: tuple[float, ...]
    runs: tuple[int, ...] = ()

    @property
    def dt(self) -> float:
        """Sampling interval in s."""
        return float(self.t[1] - self.t[0])

    def ranges(self, *, mirror: bool) -> list[tuple[float, float]]:
        """Return the least and most of nu_dot and nu of the training samples, six.

        With `mirror` the mirror images of the samples count too.
        """
        motion = torch.cat((self.nu_dot, self.nu), dim=-1)[self.train]
        if mirror:
            motion = torch.cat((motion, motion * torch.cat((_SIDES, _SIDES))))
        return list(zip(motion.amin(0).tolist(), motion.amax(0).tolist(), strict=True))

    def smoothed(self) -> Record:
        """Return the record with the most likely motion under the known noise of the sensors."""
        from residnet.data.motion import smooth_motion

        measured = torch.cat((self.pose, self.nu, self.nu_dot), dim=-1)
        motion = torch.from_numpy(smooth_motion(measured.numpy(), self.noise, self.dt))
        pose, nu, nu_dot = (motion[:, part] for part in (POSE, VELOCITIES, ACCELERATIONS))
        return replace(self, pose=pose, nu=nu, nu_dot=nu_dot)


class FittedModel(NamedTuple):
    """A fitted model of a residual force.

    Attributes:
        force: F = F_base + correction.
        lag: of the thrusters; None where it was not fitted.
        fit: coefficients, and in its notes what was chosen.
    """

    force: ForceModel
    lag: Lag | None
    fit: Fit

    def remaining(self, record: Record) -> Tensor:
        """Return the residual [N, 3] that the model leaves along a record, in N, N, N m.

        The model is compared with the command, or through its lag with the force that follows it.
        """
        force = record.command
        if self.lag is not None:
            force = followed(record.averaged, self.lag, record.dt, record.runs)
        return self.force.residual(force, record.nu_dot, record.nu, record.pose[:, HEADING])

    def test_mse(self, record: Record) -> list[float]:
        """Return the mean square of what remains of the measurements as logged, by axis.

        It is over the test samples, in N^2, N^2, (N m)^2.
        """
        return mse(self.remaining(record)[~record.train])


def fit_model(
    config: ResidualModelConfig, record: Record, base: ForceModel, lag: Lag | None = None
) -> FittedModel:
    """Fit one model of the residual force of `base` on the training samples of a record.

    Args:
        base: the known model, F_base(nu_dot, nu).
        lag: where the config asks for one and it is known; None to find it.

    Raises:
        FitError: where the data do not determine the model.
    """
    if config.searched:
        return _searched(config, record, base)
    train, psi = record.train, record.pose[:, HEADING]
    x = TermLibrary(config.terms, MOTION)(torch.cat((record.nu_dot, record.nu), dim=-1))
    needed = base.at_heading(record.nu_dot, record.nu, psi)
    # unit forces to north and to east in body axes, without a moment
    unit = torch.eye(2, dtype=psi.dtype)
    earth_axes = torch.stack(
        [
            torch.stack((*to_body(north, east, psi), torch.zeros_like(psi)), dim=-1)
            for north, east in unit
        ],
        dim=-1,
    )
    force = record.command
    notes: dict[str, Any] = {}
    if config.lag:
        regressors = torch.cat((x, earth_axes[:, 0]), dim=-1) if config.earth else x
        if lag is None:
            lag = fit_lag(record.averaged, needed, regressors, record.dt, train, record.runs)
        force = followed(record.averaged, lag, record.dt, record.runs)
        notes["lag"] = lag.model_dump()
    y, earth_force = force - needed, None
    if config.earth:
        earth_force = constant_force(x[train], y[train], -earth_axes[train])
        y = y + torch.einsum("nad,d->na", earth_axes, earth_force)
        notes["earth"] = dict(zip(("north", "east"), earth_force.tolist(), strict=True))
    seen, shown, fold = x[train], y[train], record.fold[train]
    if config.mirror:
        signs = mirror_signs(config.terms)
        if signs is None:
            raise FitError("mirror: not all basis functions are known to mirror; leave it out")
        seen, shown = (
            torch.cat((part, part * by)) for part, by in ((seen, signs), (shown, _SIDES))
        )
        fold, notes["mirror"] = fold.repeat(2), True
    data = Regression(
        config.terms,
        seen,
        shown,
        column_scale(config.terms, torch.nan_to_num(seen)),
        torch.unique(fold, return_inverse=True)[1],
        (x[~train], y[~train]),
    )
    fit = config.fit.fit(data)
    correction = Correction(config.terms, fit.coefficients, fit.intercept)
    model = base.extended(correction, earth_force)
    return FittedModel(model, lag, replace(fit, notes=fit.notes | notes))


def _searched(config: ResidualModelConfig, record: Record, base: ForceModel) -> FittedModel:
    """Return the model of least error over left-out folds.

    Tried are lag and mirror, each with and without, and no residual. Errors are in units of what
    the base leaves, so that no residual has an error of one.
    """
    none = FittedModel(base, None, Fit(torch.zeros(0), torch.zeros(0), torch.zeros(0)))
    nothing = torch.tensor(mse(none.remaining(record)[record.train]))
    tried, faults = [], []
    known: Lag | None = None
    mirrors = [False, True] if config.mirror is None else [config.mirror]
    if mirror_signs(config.terms) is None and config.mirror is None:
        mirrors = [False]
    for lag, mirror in itertools.product((False, True), mirrors):
        try:
            one = config.model_copy(update={"lag": lag, "mirror": mirror})
            found = fit_model(one, record, base, known if lag else None)
        except FitError as error:
            faults.append(error)
            continue
        known = found.lag
        left = found.fit.orders["left-out segments"][found.fit.notes["order"] - 1] / nothing
        tried.append((float(left.nan_to_num(torch.inf).mean()), found))
    if not tried:
        raise faults[0]
    least, best = min(tried, key=lambda pair: pair[0])
    if least < 1.0:
        notes = {**best.fit.notes, "left_out": least}
        return best._replace(fit=replace(best.fit, notes=notes))
    zero = torch.zeros_like(best.fit.coefficients)
    fit = Fit(zero, zero[0], zero, {"order": 0, "left_out": 1.0})
    return FittedModel(base.extended(Correction(config.terms, zero, zero[0])), None, fit)


def refitted(
    config: ResidualModelConfig, model: FittedModel, record: Record, base: ForceModel
) -> FittedModel:
    """Return a searched model fitted to other samples, with the settings and the lag that it has.

    Raises:
        FitError: where the samples do not determine it.
    """
    notes = model.fit.notes
    chosen = {
        "fit": config.fit.model_copy(update={"order": notes["order"]}),
        "lag": model.lag is not None,
        "mirror": bool(notes.get("mirror")),
    }
    return fit_model(config.model_copy(update=chosen), record, base, model.lag)


def mirror_signs(terms: Sequence[str]) -> Tensor | None:
    """Return the sign [J] that each basis function changes by in the mirror; None if unknown."""
    signs = [parity for term in terms if (parity := term_parity(term, MOTION)) is not None]
    return torch.tensor(signs, dtype=torch.float64) if len(signs) == len(terms) else None


def constant_force(x: Tensor, y: Tensor, unit_forces: Tensor) -> Tensor:
    """Return the force (north, east) [2] in N that is constant in earth axes.

    The basis functions, whose coefficients differ from axis to axis, are projected out first.

    Args:
        x: basis functions [N, J].
        y: residual [N, 3] in N, N, N m.
        unit_forces: what a unit force to north and to east adds to the residual [N, 3, 2].

    Raises:
        FitError: where the vessel hardly turned, so that a constant in body axes explains as much.
    """
    scaled = (x - x.mean(0)) / x.std(0).clamp(min=1e-300)
    centred = torch.cat((torch.ones_like(x[:, :1]), scaled), dim=-1)
    left, singular, _ = torch.linalg.svd(centred, full_matrices=False)
    left = left[:, singular > _RANK_TOLERANCE * singular[0]]

    def unexplained(part: Tensor) -> Tensor:
        rest: Tensor = part - left @ (left.T @ part)
        return rest

    weight = unexplained(y).std(0).clamp(min=1e-9)
    # a moment is none of its doing
    design = torch.cat([unexplained(unit_forces[:, a]) / weight[a] for a in range(2)])
    target = torch.cat([unexplained(y[:, a]) / weight[a] for a in range(2)])
    spread = float(torch.linalg.svdvals(design * weight[:2].mean())[-1]) / len(y) ** 0.5
    if spread < _LEAST_EARTH_FORCE_SPREAD:
        raise FitError(
            "a force constant in earth axes does not show: the vessel kept its heading; give a run"
            " that turns, or leave earth out"
        )
    solution: Tensor = torch.linalg.lstsq(design, target[:, None]).solution
    return solution[:, 0]


def _columns(rows: Sequence[Mapping[str, float]]) -> dict[str, Tensor]:
    """Return the coefficients [3] of each term of three rows."""
    return {
        term: torch.tensor([row.get(term, 0.0) for row in rows], dtype=torch.float64)
        for term in dict.fromkeys(term for row in rows for term in row)
    }


def forward_equations(believed: str, model: ForceModel, label: str) -> HullEquations:
    """Return the accelerations of a force-space model as sums of terms.

    They are nu_dot = (M + A)^-1 (tau - C nu - D nu - b), in the form that the baseline `believed`
    takes.

    Args:
        believed: vessel of the known hull, by name or file.
        model: the known hull and its residual eps = A nu_dot + b(nu).
        label: name of the model in error messages.

    Raises:
        ConfigError: where a basis function is not affine in nu_dot.
        FitError: where the augmented mass cannot be inverted safely.
    """
    total = model.hull.mass
    nothing = torch.zeros(3, dtype=torch.float64)
    extra = {"1": nothing}
    for correction in model.corrections:
        assert isinstance(correction, Correction)
        terms, coefficients = correction.library.terms, correction.coefficients
        total, rest = augmented(total, terms, coefficients, label)
        added = {"1": correction.intercept} | {terms[j]: coefficients[j] for j in rest}
        for term, force in added.items():
            extra[term] = extra.get(term, nothing) + force
    inverse = torch.linalg.inv(total)
    known = _columns(BelievedConfig(vessel=believed).equations().rows())
    table = {term: inverse @ model.hull.mass @ column for term, column in known.items()}
    for term, force in extra.items():
        table[term] = table.get(term, nothing) - inverse @ force
    u, v, r = (
        {term: float(value[axis]) for term, value in table.items() if float(value[axis]) != 0.0}
        for axis in range(3)
    )
    return HullEquations(u=u, v=v, r=r)


def missing_coefficients(true: str, believed: str) -> dict[str, list[float]]:
    """Return the true coefficients of a residual by basis function: surge, sway, yaw.

    They are those of the true hull less those of the believed one, where document 002 misprints the
    cross terms (correction J19).
    """

    def factors(term: str) -> tuple[Any, ...]:
        return tuple(sorted(parse_term(term, MOTION)))

    names = {factors(term): term for term in FERRY_TERMS}

    def of_force(vessel: str) -> dict[str, Tensor]:
        """Return the coefficients [3] of F(nu_dot, nu) by basis function of document 002."""
        columns = _columns(BelievedConfig(vessel=vessel).equations().rows())
        mass = torch.linalg.inv(torch.stack([columns.pop(name) for name in FORCE_CHANNELS], dim=1))
        out = {name: mass[:, axis] for axis, name in enumerate(ACCELERATION)}
        return out | {
            names.get(factors(term), term): -mass @ column for term, column in columns.items()
        }

    of_true, of_believed = of_force(true), of_force(believed)
    zero, out = torch.zeros(3, dtype=torch.float64), {}
    for key in dict.fromkeys((*of_believed, *of_true)):
        whole = of_true.get(key, zero)
        difference = whole - of_believed.get(key, zero)
        # equal coefficients differ by rounding alone
        known = difference.abs() > 1e-9 * (1 + whole.abs())
        if bool(known.any()):
            out[key] = torch.where(known, difference, zero).tolist()
    return out


def as_baseline_yaml(equations: HullEquations, label: str) -> str:
    """Return the model as YAML lines for the `baseline` or `baselines` of a fit."""
    lines = [
        f"# {label}: accelerations from velocities and forces; needs the channels"
        f" {', '.join((*VELOCITY, *FORCE_CHANNELS))}"
    ]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY, equations.rows(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"


def fit_as_json(terms: Sequence[str], fit: Fit) -> dict[str, Any]:
    """Return a fitted model as it stands in the results: terms, coefficients and weights."""
    return {
        "terms": list(terms),
        "coefficients": fit.coefficients.tolist(),
        "intercept": fit.intercept.tolist(),
        "weights": fit.pre.abs().tolist(),
    }


def model_sections(
    title: str,
    models: Mapping[str, Results],
    run: Path,
    notes: str,
    others: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]],
) -> list[Section]:
    """Return what both studies tell of fitted models: refusals, coefficients, and their figures.

    Args:
        models: entries of the results (`fit_as_json`) by name.
        run: folder that holds `model_figures`.
        others: coefficients [3] by basis function to stand beside those of a model, by its name and
            by what they are, such as `true` and `published`.
    """
    causes = [model["not_forward"] for model in models.values() if model["not_forward"]]
    refused = Section("Models that cannot run forward in time", [Bullets(causes)])
    about = Text(
        "The force of a model is that of the believed hull plus the sum of coefficient times basis"
        " function, in SI units. A weight is the magnitude of the coefficient of scaled variables:"
        " it says how much a basis function matters."
    )
    parts = []
    for name, model in models.items():
        terms = model["terms"]
        kept = {t: row for t, row in zip(terms, model["coefficients"], strict=True) if any(row)}
        beside = {what: values for what, values in others.get(name, {}).items() if values}
        forces = {"coefficient": {"1": model["intercept"], **kept}, **beside}
        weights = dict(zip(terms, model["weights"], strict=True))
        groups = [(what, 3) for what in ("coefficient", "weight", *beside)]
        table = Table(["basis function", *AXES * len(groups)], groups=groups)
        for term in dict.fromkeys(term for of in forces.values() for term in of):
            ours, *theirs = (
                [number(value, 4) for value in of.get(term, (0.0, 0.0, 0.0))]
                for of in forces.values()
            )
            weight = [number(value, 3) for value in weights[term]] if term in weights else [""] * 3
            table.add(term, [*ours, *weight, *(text for texts in theirs for text in texts)])
        chosen = notes_text(model[notes])
        words = Text(f"Chosen by the estimator: {chosen}." if chosen else "")
        parts.append(Section(name, [words, table], folded=True))
    figures = pictures(run, "orders_", "surface_", "weights_")
    return [
        *([refused] if causes else []),
        Section(title, [about, *parts]),
        Section("Orders, weights and surfaces", figures, True),
    ]


def model_figures(
    name: str, config: ResidualModelConfig, fit: Fit, unmodelled: Sequence[float]
) -> list[Figure]:
    """Return the weights of a model, and the errors that its order or surface was chosen from.

    Figures 4.6, 4.20, 4.22 and 4.25 of the document.

    Args:
        unmodelled: mean square of the believed model's residual by axis.
    """
    at, weights, names = np.arange(len(config.terms)), fit.pre.abs().numpy(), names_of(config.terms)
    out = [
        Figure(
            f"weights_{name}",
            f"Weights of the basis functions in {name}",
            "Magnitude of the coefficients of scaled basis functions. It shows how much each one"
            " weighs in the model.",
            {"weights": Look("", BLUE, kind="fill")},
            [Panel(f"{axis}, scaled [-]", height=165, group="w", x_names=names) for axis in AXES],
            [Case("", [{"weights": bars(at, weights[:, axis])} for axis in range(3)])],
        )
    ]
    if fit.orders:
        out.append(_orders(name, fit.orders, unmodelled, int(fit.notes["order"])))
    if fit.surface is not None:
        choices = {
            "chosen": list(zip(fit.notes["order"], fit.notes["terms"], strict=True)),
            "least": [fit.surface.least(axis) for axis in range(3)],
        }
        out.append(_surface(name, fit.surface.error, unmodelled, choices))
    return out


def _orders(
    name: str, curves: Mapping[str, Tensor], unmodelled: Sequence[float], chosen: int
) -> Figure:
    """Return the error that is left over the order of a PLSR.

    Args:
        curves: mean square error by order and axis [A, 3], by the samples that it is of.
        unmodelled: mean square of the residual of each axis.
        chosen: order of the model.
    """
    colors = dict(zip(curves, (BLUE, VERMILLION), strict=True))
    looks = {label: Look(label, color) for label, color in colors.items()}
    looks["chosen"] = Look("this model", GREY, "dashed", 1.0, kind="upright")
    shown = []
    for axis in range(3):
        panel = {"chosen": (np.array([float(chosen)]), np.zeros(1))}
        for label, error in curves.items():
            share = error[:, axis].numpy() / unmodelled[axis]
            if np.isfinite(share).any():
                panel[label] = (np.arange(len(share)) + 1.0, share)
        shown.append(panel)
    return Figure(
        f"orders_{name}",
        "Error over the order of the PLSR",
        "Share of the unmodelled residual's mean square that is left, by model order: on"
        " segments that were left out of the fit one by one, and on the test half.",
        looks,
        [
            Panel(f"{axis}, share of the MSE left", "model order", height=285, y_log=True)
            for axis in AXES
        ],
        [Case("", shown)],
        columns=3,
    )


def _surface(
    name: str,
    error: Tensor,
    unmodelled: Sequence[float],
    chosen: Mapping[str, Sequence[tuple[int, int]]],
) -> Figure:
    marks = (("x", VERMILLION), ("o", PURPLE), ("s", ORANGE))
    looks = {
        "orders": Look("each model order", GREY, width=0.8),
        "order": Look("order of this model", BLUE, width=1.6),
    }
    for label, (marker, color) in zip(chosen, marks, strict=False):
        looks[label] = Look(
            label, color, kind="points", marker=marker, size=7, hollow=True, order=5
        )
    curves = []
    for axis in range(3):
        # [A, J] by model order, from 1 on, and number of basis functions
        share = 100.0 * error[axis].numpy() / unmodelled[axis]
        counts = np.arange(share.shape[1], dtype=float)
        best, _ = chosen["chosen"][axis]
        panel = {
            "orders": joined((counts, row) for row in share),
            "order": (counts, share[best - 1]),
        }
        for label, picks in chosen.items():
            order, count = picks[axis]
            panel[label] = (np.array([float(count)]), share[order - 1, [count]])
        curves.append(panel)
    return Figure(
        f"surface_{name}",
        "Surface analysis",
        "Share of the unmodelled residual's mean square that is left, by number of basis functions,"
        " a line for each model order. Marks show what each rule chose.",
        looks,
        [
            Panel(
                f"{axis}, share of the MSE left [%]",
                "basis functions",
                height=285,
                y_log=True,
                y_limits=_SURFACE_SPAN,
            )
            for axis in AXES
        ],
        [Case("", curves)],
        columns=3,
    )
