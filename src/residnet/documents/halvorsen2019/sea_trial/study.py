"""Models of Odin by phase: the standard model against equations (document 000, section 7.5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from residnet.core.layout import RANGE_VELOCITIES
from residnet.documents.halvorsen2019.sea_trial.config import (
    ALL,
    PLANT,
    SEPARATE,
    STANDARD,
    EquationConfig,
    SeaTrialConfig,
    SeaTrialSettings,
    odin,
)
from residnet.documents.halvorsen2019.sea_trial.standard_model import StandardFit, fit, truth
from residnet.documents.halvorsen2019.sea_trial.trial import Trial, sail
from residnet.judge.goodness import OneStep
from residnet.judge.goodness import table as goodness_table
from residnet.physics.froude import PHASES
from residnet.physics.odin import AccelerationHull

_LEAST_SAMPLES = 500
"""Number of samples below which a phase is neither fitted nor judged."""
_STANDARD_PARAMETERS = (4.0, 8.0, 8.0)
"""Number of parameters of the standard model in surge, sway and yaw."""


@dataclass(frozen=True)
class Fitted:
    """A model that was fitted to one set of samples.

    Attributes:
        predicted: predicted accelerations at all samples [N, 3].
        parameter_count: number of parameters in surge, sway and yaw.
        equations: the equation of each axis as text; empty for other models.
    """

    predicted: np.ndarray
    parameter_count: tuple[float, ...]
    equations: Mapping[str, str]


@dataclass(frozen=True)
class PhaseStudy:
    """What was found on one trial.

    Attributes:
        trial: the samples.
        standard: fits of the standard model by set of samples.
        truth: true parameters of the vessel, as far as the standard model has them.
        models: models by name and by the set that they were fitted to.
        rows: goodness of fit on the validation stretches, by set.
    """

    trial: Trial
    standard: Mapping[str, StandardFit]
    truth: Mapping[str, float]
    models: Mapping[tuple[str, str], Fitted]
    rows: Mapping[str, list[dict[str, Any]]]


def study(settings: SeaTrialSettings) -> dict[str, PhaseStudy]:
    """Simulate every trial, and fit and judge every model on every set of samples.

    Raises:
        ResidnetError: where a trial cannot be sailed or a model is not determined.
    """
    return {name: one_trial(settings, trial) for name, trial in settings.trials.items()}


def one_trial(settings: SeaTrialSettings, config: SeaTrialConfig) -> PhaseStudy:
    """Simulate one trial, and fit and judge every model on every set of samples."""
    trial = sail(config)
    sets = {
        name: keep
        for name, keep in _sets(trial).items()
        if min((keep & ~trial.validates).sum(), (keep & trial.validates).sum()) >= _LEAST_SAMPLES
    }
    z, a = trial.samples.z.numpy(), trial.samples.target.numpy()
    standard, models = {}, {}
    for name, keep in sets.items():
        train = keep & ~trial.validates
        standard[name] = found = fit(
            z[train, RANGE_VELOCITIES], z[train, 5:], a[train], settings.standard
        )
        predicted = found.accelerations(z[:, RANGE_VELOCITIES], z[:, 5:])
        models[STANDARD, name] = Fitted(predicted, _STANDARD_PARAMETERS, {})
        for equation, equation_config in settings.equations.items():
            models[equation, name] = _fit_equation(equation_config, trial, train)
    if settings.separate:
        models |= _separate(models, sets, trial)
    return PhaseStudy(
        trial,
        standard,
        truth(odin(config.vessel), settings.standard.mass),
        models,
        _judged(config, trial, sets, models),
    )


def _sets(trial: Trial) -> dict[str, np.ndarray]:
    """Return the samples [N] bool of each phase and of all phases."""
    return {phase: trial.phase == number for number, phase in enumerate(PHASES)} | {
        ALL: np.ones(len(trial.phase), dtype=bool)
    }


def _fit_equation(config: EquationConfig, trial: Trial, train: np.ndarray) -> Fitted:
    """Find an equation from the training samples [N] bool, and evaluate it at all samples."""
    head, samples = config.build(), trial.samples.where(torch.from_numpy(train))
    head.calibrate(samples)
    notes = head.solve(samples)
    with torch.no_grad():
        predicted = head(trial.samples.z, trial.samples.z[:, :0])[0].numpy()
    return Fitted(
        predicted,
        tuple(head.parameter_count()),
        {axis: equation["text"] for axis, equation in notes["equations"].items()},
    )


def _separate(
    models: Mapping[tuple[str, str], Fitted], sets: Mapping[str, np.ndarray], trial: Trial
) -> dict[tuple[str, str], Fitted]:
    """Return for each model one that consists of the models fitted to the single phases.

    Where a phase has no model, the one of all phases takes its place.
    """
    out = {}
    for name in dict.fromkeys(model for model, _ in models):
        predicted, parameter_count = models[name, ALL].predicted.copy(), np.zeros(3)
        for number, phase in enumerate(PHASES):
            if phase in sets:
                predicted[trial.phase == number] = models[name, phase].predicted[
                    trial.phase == number
                ]
                parameter_count += models[name, phase].parameter_count
        out[name, SEPARATE] = Fitted(predicted, tuple(parameter_count), {})
    return out


def _judged(
    config: SeaTrialConfig,
    trial: Trial,
    sets: Mapping[str, np.ndarray],
    models: Mapping[tuple[str, str], Fitted],
) -> dict[str, list[dict[str, Any]]]:
    """Return the goodness of fit on the validation stretches of each set.

    The plant's own equations stand beside the models: they show what the sea and the preparation
    leave unexplained.
    """
    vessel = odin(config.vessel)
    z, a = trial.samples.z, trial.samples.target.numpy()
    known = Fitted(
        AccelerationHull(vessel.gains, vessel.terms)(z[:, RANGE_VELOCITIES], z[:, 5:]).numpy(),
        (0.0, 0.0, 0.0),
        {},
    )
    out = {}
    for name, keep in sets.items():
        pieces = trial.pieces(keep & trial.validates)
        judged = {
            key: model for key, model in models.items() if key[1] in (name, ALL, SEPARATE)
        } | {(PLANT, PLANT): known}
        steps = [
            OneStep(
                f"{model} on {on}",
                "head",
                fitted.parameter_count,
                [(a - fitted.predicted)[piece] for piece in pieces],
                f"{STANDARD} on {name}",
            )
            for (model, on), fitted in judged.items()
        ]
        keys = {f"{model} on {on}": (model, on) for model, on in judged}
        out[name] = [
            row | dict(zip(("model", "on"), keys[row["model"]], strict=True))
            for row in goodness_table(steps, [a[p] for p in pieces], trial.step)
        ]
    return out
