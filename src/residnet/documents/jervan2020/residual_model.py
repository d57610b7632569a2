"""Identification of the ferry's force residual from one flown course (document 002 chapter 4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from pydantic import Field
from torch import Tensor

from residnet.control.motion.anticipation import Lag
from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.core.frames import to_body
from residnet.documents.jervan2020.regressions import Fit, Regression, RegressionConfig
from residnet.judge.tracking import mse
from residnet.physics.force_model import FERRY_TERMS, MOTION, Correction, ForceModel, column_scale
from residnet.physics.terms import TermLibrary, parse_term
from residnet.training.lag import LagFit, fit_lag, followed


class Published(Config):
    """Figures of the document for one model, as printed where ERRATA does not say otherwise; they
    stand beside the run's own.

    Attributes:
        mse: of the residual on the test half in N^2, N^2, (N m)^2.
        position_mae: m.
        position_mse: m^2.
        heading_mae: deg.
        tau: mean |tau| in N, N, N m.
        feedback: mean |tau_FB|.
        alone: MSE of u, v, r and their derivatives against the desired ones without feedback, in
            (m/s)^2, (rad/s)^2 and per second squared.
        crossing_position_mae, crossing_position_mse, crossing_heading_mae: the same of the
        operational crossing.
        crossing_power: mean power of keeping position and heading in the crossing in W.
        coefficients: Theta by basis function, surge, sway and yaw.
    """

    mse: tuple[float, float, float] | None = None
    position_mae: float | None = None
    position_mse: float | None = None
    heading_mae: float | None = None
    tau: tuple[float, float, float] | None = None
    feedback: tuple[float, float, float] | None = None
    crossing_position_mae: float | None = None
    crossing_position_mse: float | None = None
    crossing_heading_mae: float | None = None
    alone: tuple[float, float, float, float, float, float] | None = None
    crossing_power: tuple[float, float] | None = None
    coefficients: dict[str, tuple[float, float, float]] = Field(default_factory=dict)


class ResidualModelConfig(Config):
    """One model of a residual force.

    Attributes:
        fit: how its coefficients are found.
        terms: its basis functions; the 30 of (4.12) unless given.
        lag: fit the thrusters' lag with it and explain the force that followed the command.
        earth: include forces that are constant in earth axes.
    """

    fit: RegressionConfig
    terms: tuple[str, ...] = FERRY_TERMS
    lag: bool = False
    earth: bool = False

    def model_post_init(self, context: Any) -> None:
        """Read the terms, so that a wrong one is found at once."""
        for term in self.terms:
            parse_term(term, MOTION)


class FerryModelConfig(ResidualModelConfig):
    """One model of the ferry's residual; with `lag` its feed-forward is led by the lag.

    Attributes:
        smooth: bring the noisy measurements into one motion first (see
            `residnet.data.motion_smoother`).
        on: the model whose remaining residual this one explains (3.26); empty for the believed
            hull.
        fly: fly the course, and the crossing where there is one, with it as feed-forward.
        published: the document's figures.
    """

    smooth: bool = False
    on: str = ""
    fly: bool = False
    published: Published = Published()


@dataclass(frozen=True)
class FerryModel:
    """A fitted model.

    Attributes:
        model: F = F_0 + corrections.
        lag: of the thrusters, where it was fitted.
        fit: coefficients.
        test_mse: of the remaining residual on the test half, by axis; against the command, or for a
            lag-aware model against the followed command.
        notes: what was chosen.
    """

    model: ForceModel
    lag: Lag | None
    fit: Fit
    test_mse: list[float]
    notes: dict[str, Any]


@dataclass(frozen=True)
class Record:
    """What a controller logs, uniform in time.

    Attributes:
        t: [N] s.
        pose, nu, nu_dot: as measured [N, 3].
        command: tau_c as sampled [N, 3].
        averaged: tau_c averaged over the steps around a sample [N, 3].
        fold: segment of each sample [N].
        train: samples that identify [N] bool; the others test.
        noise: standard deviations of pose, nu and nu_dot, nine.
        runs: lengths of the runs that stand one after another; empty for one.
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
        """Sampling interval."""
        return float(self.t[1] - self.t[0])

    def smoothed(self) -> Record:
        """With the motion that all measurements together make likeliest, under the noise that the
        sensors are known to have.
        """
        from residnet.data.motion_smoother import smooth_motion

        seen = torch.cat((self.pose, self.nu, self.nu_dot), dim=-1)
        motion = torch.from_numpy(smooth_motion(seen.numpy(), self.noise, self.dt))
        return replace(self, pose=motion[:, :3], nu=motion[:, 3:6], nu_dot=motion[:, 6:])


def identify(config: FerryModelConfig, record: Record, base: ForceModel) -> FerryModel:
    """Fit one model on the record's training samples and judge it on the others, as they were
    logged.

    Raises:
        FitError: where the data do not determine it.
    """
    model, lag, fit, notes = fit_model(config, record.smoothed() if config.smooth else record, base)
    return FerryModel(model, lag, fit, judged(model, lag, record), notes)


def fit_model(
    config: ResidualModelConfig, used: Record, base: ForceModel
) -> tuple[ForceModel, Lag | None, Fit, dict[str, Any]]:
    """One model from a record's training samples: F = F_base + correction, the lag, the
    coefficients, and what was chosen.

    Raises:
        FitError: where the data do not determine it.
    """
    train = used.train
    x = TermLibrary(config.terms, MOTION)(torch.cat((used.nu_dot, used.nu), dim=-1))
    needed = base.at_heading(used.nu_dot, used.nu, used.pose[:, 2])
    along, across = (
        to_body(torch.ones(()), torch.zeros(()), used.pose[:, 2]),
        to_body(torch.zeros(()), torch.ones(()), used.pose[:, 2]),
    )
    nothing = torch.zeros_like(along[0])
    earthly = torch.stack(
        (torch.stack((*along, nothing), dim=-1), torch.stack((*across, nothing), dim=-1)), dim=-1
    )
    found: LagFit | None = None
    force = used.command
    if config.lag:
        regressors = torch.cat((x, earthly[:, 0]), dim=-1) if config.earth else x
        found = fit_lag(used.averaged, needed, regressors, used.dt, train, used.runs)
        force = followed(used.averaged, found.lag, used.dt, used.runs)
    y = force - needed
    push = torch.zeros(2, dtype=torch.float64)
    if config.earth:
        push = constant_force(x[train], y[train], -earthly[train])
        y = y + torch.einsum("nad,d->na", earthly, push)
    data = Regression(
        config.terms,
        x[train],
        y[train],
        _scale(config, x[train]),
        _ranked(used.fold[train]),
        (x[~train], y[~train]),
    )
    fit = config.fit.fit(data)
    model = base.extended(Correction(config.terms, fit.coefficients, fit.intercept), push)
    notes = dict(fit.notes)
    if found is not None:
        notes["lag"] = {
            "frequency": found.lag.frequency,
            "damping": found.lag.damping,
            "delay": found.lag.delay,
        }
    if config.earth:
        notes["earth"] = {"north": float(push[0]), "east": float(push[1])}
    return model, found.lag if found is not None else None, fit, notes


def judged(model: ForceModel, lag: Lag | None, record: Record) -> list[float]:
    """MSE of the residual that a model leaves on a record's test samples as they were logged, by
    axis; through its lag where it has one.
    """
    return mse(remaining(model, lag, record)[~record.train])


def remaining(model: ForceModel, lag: Lag | None, record: Record) -> Tensor:
    """The residual [N, 3] that a model leaves along a record as it was logged; through its lag
    where it has one.
    """
    force = (
        record.command if lag is None else followed(record.averaged, lag, record.dt, record.runs)
    )
    return model.residual(force, record.nu_dot, record.nu, record.pose[:, 2])


def _scale(config: ResidualModelConfig, x: Tensor) -> Tensor:
    finite = torch.nan_to_num(x)
    return column_scale(config.terms, finite)


def _ranked(fold: Tensor) -> Tensor:
    return torch.unique(fold, return_inverse=True)[1]


def constant_force(x: Tensor, y: Tensor, earthly: Tensor) -> Tensor:
    """A force (north, east) [2] shared by the axes, beside regressors that each axis weighs by
    itself (partialled out).

    Args:
        x: regressors [N, J].
        y: residual [N, 3].
        earthly: what a unit of each force adds to the residual [N, 3, 2].

    Raises:
        FitError: where the vessel hardly turned, so that a constant of the body axes explains the
            same.
    """
    centred = torch.cat(
        (torch.ones_like(x[:, :1]), (x - x.mean(0)) / x.std(0).clamp(min=1e-300)), dim=-1
    )
    left, singular, _ = torch.linalg.svd(centred, full_matrices=False)
    left = left[:, singular > 1e-7 * singular[0]]

    def rest(part: Tensor) -> Tensor:
        return part - left @ (left.T @ part)

    weight = rest(y).std(0).clamp(min=1e-9)
    design = torch.cat(
        [
            torch.stack([rest(earthly[:, a, d]) for d in range(2)], dim=-1) / weight[a]
            for a in range(2)
        ]
    )
    target = torch.cat([rest(y[:, a]) / weight[a] for a in range(2)])
    own = float(torch.linalg.svdvals(design * weight[:2].mean())[-1]) / len(y) ** 0.5
    if own < 0.02:
        raise FitError(
            "a force constant in earth axes does not show: the vessel kept its heading; give a run"
            " that turns, or leave earth out"
        )
    return torch.linalg.lstsq(design, target[:, None]).solution[:, 0]
