"""Identification of a force residual from a record of motion and force (document 002, chapter 4).

The residual is the force that a known hull does not explain: tau - F(nu_dot, nu) (3.19), (3.20).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from residnet.control.motion.anticipation import Lag
from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.core.frames import to_body
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, VELOCITIES
from residnet.documents.jervan2020.regressions import Fit, Regression, RegressionConfig
from residnet.judge.tracking import mse
from residnet.physics.force_model import FERRY_TERMS, MOTION, Correction, ForceModel, column_scale
from residnet.physics.terms import TermLibrary, parse_term
from residnet.training.lag import LagFit, fit_lag, followed

AXES = ("surge", "sway", "yaw")
_RANK_TOLERANCE = 1e-7
"""Regressors with singular values below this share of the largest count as dependent."""
_LEAST_EARTH_FORCE_SPREAD = 0.02
"""Least root mean square that turning must leave of a unit force fixed in earth axes."""


class ResidualModelConfig(Config):
    """A regression of a force residual on basis functions of nu_dot and nu.

    Attributes:
        fit: estimator of the coefficients, with its settings.
        terms: basis functions, written as products of u_dot, v_dot, r_dot, u, v, r and their
            absolute values; the 30 of (4.12) unless given.
        lag: identify the thrusters' lag together with the coefficients, and explain the force that
            follows the command through it.
        earth: also identify a force that is constant in earth axes, such as that of wind.
    """

    fit: RegressionConfig
    terms: tuple[str, ...] = FERRY_TERMS
    lag: bool = False
    earth: bool = False

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

    def smoothed(self) -> Record:
        """Return the record with the most likely motion under the known noise of the sensors."""
        from residnet.data.motion_smoother import smooth_motion

        measured = torch.cat((self.pose, self.nu, self.nu_dot), dim=-1)
        motion = torch.from_numpy(smooth_motion(measured.numpy(), self.noise, self.dt))
        return replace(
            self,
            pose=motion[:, POSE],
            nu=motion[:, VELOCITIES],
            nu_dot=motion[:, ACCELERATIONS],
        )


def fit_model(
    config: ResidualModelConfig, record: Record, base: ForceModel
) -> tuple[ForceModel, Lag | None, Fit, dict[str, Any]]:
    """Fit one model of the residual force of `base` on the training samples of a record.

    Args:
        config: basis functions and estimator.
        record: motion and commanded force.
        base: the known model, F_base(nu_dot, nu).

    Returns:
        The model F = F_base + correction, the thrusters' lag where it was fitted, the coefficients,
        and what the estimator chose.

    Raises:
        FitError: where the data do not determine the model.
    """
    train = record.train
    x = TermLibrary(config.terms, MOTION)(torch.cat((record.nu_dot, record.nu), dim=-1))
    needed = base.at_heading(record.nu_dot, record.nu, record.pose[:, HEADING])
    earth_axes = _earth_axes(record.pose[:, HEADING])
    lag_fit: LagFit | None = None
    force = record.command
    if config.lag:
        regressors = torch.cat((x, earth_axes[:, 0]), dim=-1) if config.earth else x
        lag_fit = fit_lag(record.averaged, needed, regressors, record.dt, train, record.runs)
        force = followed(record.averaged, lag_fit.lag, record.dt, record.runs)
    y = force - needed
    earth_force = torch.zeros(2, dtype=torch.float64)
    if config.earth:
        earth_force = constant_force(x[train], y[train], -earth_axes[train])
        y = y + torch.einsum("nad,d->na", earth_axes, earth_force)
    data = Regression(
        config.terms,
        x[train],
        y[train],
        column_scale(config.terms, torch.nan_to_num(x[train])),
        torch.unique(record.fold[train], return_inverse=True)[1],
        (x[~train], y[~train]),
    )
    fit = config.fit.fit(data)
    model = base.extended(Correction(config.terms, fit.coefficients, fit.intercept), earth_force)
    notes = dict(fit.notes)
    if lag_fit is not None:
        lag = lag_fit.lag
        notes["lag"] = {
            "frequency": lag.frequency,
            "damping": lag.damping,
            "delay": lag.delay,
        }
    if config.earth:
        notes["earth"] = {"north": float(earth_force[0]), "east": float(earth_force[1])}
    return model, lag_fit.lag if lag_fit is not None else None, fit, notes


def _earth_axes(psi: Tensor) -> Tensor:
    """Unit forces to north and to east in body axes [N, 3, 2], without a moment."""
    one, zero = torch.ones(()), torch.zeros(())
    nothing = torch.zeros_like(psi)
    columns = [
        torch.stack((*to_body(north, east, psi), nothing), dim=-1)
        for north, east in ((one, zero), (zero, one))
    ]
    return torch.stack(columns, dim=-1)


def unseen_mse(model: ForceModel, lag: Lag | None, record: Record) -> list[float]:
    """Return the mean square of a model's remaining residual on the test samples, by axis.

    The residual is that of the measurements as logged, through the model's lag where it has one.
    """
    return mse(remaining(model, lag, record)[~record.train])


def remaining(model: ForceModel, lag: Lag | None, record: Record) -> Tensor:
    """Return the residual [N, 3] that a model leaves along a record, in N, N, N m.

    The model is compared with the command, or through its lag with the force that follows it.
    """
    force = (
        record.command if lag is None else followed(record.averaged, lag, record.dt, record.runs)
    )
    residual: Tensor = model.residual(force, record.nu_dot, record.nu, record.pose[:, HEADING])
    return residual


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
    centred = torch.cat(
        (torch.ones_like(x[:, :1]), (x - x.mean(0)) / x.std(0).clamp(min=1e-300)), dim=-1
    )
    left, singular, _ = torch.linalg.svd(centred, full_matrices=False)
    left = left[:, singular > _RANK_TOLERANCE * singular[0]]

    def unexplained(part: Tensor) -> Tensor:
        rest: Tensor = part - left @ (left.T @ part)
        return rest

    weight = unexplained(y).std(0).clamp(min=1e-9)
    design = torch.cat(
        [
            torch.stack([unexplained(unit_forces[:, a, d]) for d in range(2)], dim=-1) / weight[a]
            for a in range(2)
        ]
    )
    target = torch.cat([unexplained(y[:, a]) / weight[a] for a in range(2)])
    spread = float(torch.linalg.svdvals(design * weight[:2].mean())[-1]) / len(y) ** 0.5
    if spread < _LEAST_EARTH_FORCE_SPREAD:
        raise FitError(
            "a force constant in earth axes does not show: the vessel kept its heading; give a run"
            " that turns, or leave earth out"
        )
    solution: Tensor = torch.linalg.lstsq(design, target[:, None]).solution
    return solution[:, 0]
