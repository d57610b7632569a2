"""The standard model of Odin against equations found from the data, in the displacement phase and
in all phases (document 000, section 7.5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY, nearest
from residnet.documents.halvorsen2019.sea_trial.standard_model import (
    StandardFit,
    StandardFitConfig,
    fit,
    truth,
)
from residnet.documents.halvorsen2019.sea_trial.trial import (
    CHANNELS,
    CONTROLS,
    FORCES,
    Trial,
    TrialConfig,
    odin,
    sail,
)
from residnet.heads.base import ClosedFormHead
from residnet.heads.genetic import GeneticConfig
from residnet.heads.symbolic import SymbolicConfig
from residnet.judge.goodness import OneStep
from residnet.judge.goodness import table as goodness_table
from residnet.physics.froude import PHASES
from residnet.physics.odin import AccelerationHull

ALL = "all"
STANDARD, SEPARATE, PLANT = "standard", "separate", "plant"
SETS = (*PHASES, ALL)
"""What a model is fitted on, and what it is judged on."""
_FEWEST = 500
"""Samples below which a phase is not fitted or judged."""
Published = dict[str, tuple[float, float, float]]


class BlackConfig(Config):
    """An equation of the accelerations from the data alone.

    Attributes:
        inputs: `forces` of the jets by their known thrust, or `controls`, motor speed and nozzle
            angle.
        head: how the equation is found.
    """

    inputs: Literal["forces", "controls"]
    head: Annotated[SymbolicConfig | GeneticConfig, Field(discriminator="kind")]

    @model_validator(mode="after")
    def _inputs_only(self) -> BlackConfig:
        if self.head.features:
            raise ValueError("head.features: give `inputs` instead")
        return self

    def build(self) -> ClosedFormHead:
        """The head for the channels of a trial.

        Raises:
            ConfigError: where its terms name what it does not see.
        """
        seen = (*VELOCITY, *(FORCES if self.inputs == "forces" else CONTROLS))
        return self.head.model_copy(update={"features": seen}).build(CHANNELS)


class SeaTrialConfig(TrialConfig):
    """A trial with a vessel.

    Attributes:
        vessel: of kind odin with water jets.
    """

    vessel: str

    @model_validator(mode="after")
    def _fits(self) -> SeaTrialConfig:
        try:
            self.disturbance.check(odin(self.vessel).build(), self.vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self


class PhasesSettings(Config):
    """Models fitted and judged by phase, on one trial or several.

    Attributes:
        name: of the run.
        trials: by name; the first is the one that published figures stand beside.
        standard: fit of the standard model.
        equations: by name.
        separate: also put models together of one for each phase.
        published: root mean square error, C_p and adjusted R^2 by set, model and acceleration.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    trials: dict[str, SeaTrialConfig] = Field(min_length=1)
    standard: StandardFitConfig = StandardFitConfig()
    equations: dict[str, BlackConfig] = Field(default_factory=dict)
    separate: bool = True
    published: dict[str, dict[str, Published]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names(self) -> PhasesSettings:
        for name in self.equations:
            if name in (STANDARD, SEPARATE, PLANT):
                raise ValueError(f"equations: the name '{name}' is taken")
        for where, models in self.published.items():
            if where not in SETS:
                raise ValueError(f"published: no set '{where}'{nearest(where, SETS)}")
            for model in models:
                if model not in (STANDARD, *self.equations):
                    raise ValueError(
                        f"published.{where}: no model"
                        f" '{model}'{nearest(model, (STANDARD, *self.equations))}"
                    )
        for name, equation in self.equations.items():
            try:
                equation.build()
            except ConfigError as error:
                raise ValueError(f"equations.{name}: {error}") from None
        return self


@dataclass(frozen=True)
class Fitted:
    """A model fitted on one set: its prediction at all samples [N, 3], the number of parameters of
    each axis, and what there is to say.
    """

    predicted: np.ndarray
    freedom: tuple[float, ...]
    notes: dict[str, Any]


@dataclass(frozen=True)
class PhaseStudy:
    """One trial.

    Attributes:
        trial: the data.
        standard: fits of the standard model by set.
        truth: its parameters on the vessel that sailed, as far as the model has them.
        models: by name and set.
        rows: goodness of fit on validation stretches by set.
    """

    trial: Trial
    standard: Mapping[str, StandardFit]
    truth: Mapping[str, float]
    models: Mapping[tuple[str, str], Fitted]
    rows: Mapping[str, list[dict[str, Any]]]


def study(settings: PhasesSettings) -> dict[str, PhaseStudy]:
    """Sail every trial, fit every model on every set, and judge.

    Raises:
        ResidnetError: where a trial cannot be sailed or a model is not determined.
    """
    return {name: one_trial(settings, trial) for name, trial in settings.trials.items()}


def one_trial(settings: PhasesSettings, config: SeaTrialConfig) -> PhaseStudy:
    """Sail a trial, fit and judge; see `study`."""
    trial = sail(config.vessel, config)
    sets = {
        name: keep
        for name, keep in _sets(trial).items()
        if min((keep & ~trial.validates).sum(), (keep & trial.validates).sum()) >= _FEWEST
    }
    z, a = trial.samples.z.numpy(), trial.samples.target.numpy()
    standard, models = {}, {}
    for name, keep in sets.items():
        own = keep & ~trial.validates
        standard[name] = found = fit(z[own, :3], z[own, 5:], a[own], settings.standard)
        freedom = (4.0, 8.0, 8.0)
        models[STANDARD, name] = Fitted(found.accelerations(z[:, :3], z[:, 5:]), freedom, {})
        for equation, black in settings.equations.items():
            models[equation, name] = _found(black, trial, own)
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
    return {phase: trial.phase == number for number, phase in enumerate(PHASES)} | {
        ALL: np.ones(len(trial.phase), dtype=bool)
    }


def _found(config: BlackConfig, trial: Trial, own: np.ndarray) -> Fitted:
    """The equation of the samples chosen, at all samples."""
    head, seen = config.build(), trial.samples.where(torch.from_numpy(own))
    head.calibrate(seen)
    notes = head.solve(seen)
    with torch.no_grad():
        predicted = head(trial.samples.z, trial.samples.z[:, :0])[0].numpy()
    return Fitted(
        predicted,
        tuple(head.parameter_count()),
        {"equations": {axis: own["text"] for axis, own in notes["equations"].items()}},
    )


def _separate(
    models: Mapping[tuple[str, str], Fitted], sets: Mapping[str, np.ndarray], trial: Trial
) -> dict[tuple[str, str], Fitted]:
    """Of each kind of model one that takes, at each sample, the one fitted on its phase (where a
    phase has none, the one of all phases).
    """
    out = {}
    for name in dict.fromkeys(model for model, _ in models):
        predicted, freedom = models[name, ALL].predicted.copy(), np.zeros(3)
        for number, phase in enumerate(PHASES):
            if phase in sets:
                predicted[trial.phase == number] = models[name, phase].predicted[
                    trial.phase == number
                ]
                freedom += models[name, phase].freedom
        out[name, SEPARATE] = Fitted(predicted, tuple(freedom), {})
    return out


def _judged(
    config: SeaTrialConfig,
    trial: Trial,
    sets: Mapping[str, np.ndarray],
    models: Mapping[tuple[str, str], Fitted],
) -> dict[str, list[dict[str, Any]]]:
    """Goodness of fit on the validation stretches of each set; the plant's own equations show what
    the sea and the preparation leave.
    """
    vessel = odin(config.vessel)
    z, a = trial.samples.z, trial.samples.target.numpy()
    known = Fitted(
        AccelerationHull(vessel.gains, vessel.terms)(z[:, :3], z[:, 5:]).numpy(),
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
                own.freedom,
                [(a - own.predicted)[piece] for piece in pieces],
                f"{STANDARD} on {name}",
            )
            for (model, on), own in judged.items()
        ]
        keys = {f"{model} on {on}": (model, on) for model, on in judged}
        out[name] = [
            row | dict(zip(("model", "on"), keys[row["model"]], strict=True))
            for row in goodness_table(steps, [a[p] for p in pieces], trial.step)
        ]
    return out
