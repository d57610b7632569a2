"""Task `sea_trial`: models of Odin by phase, on a simulated sea trial (document 000, section 7.5).

The log is interpolated to a uniform grid, filtered forward and backward by a Butterworth low-pass,
and differentiated by differences (7.1). The standard model is compared with equations found from
the data alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator

from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError
from residnet.core.format import DASH, DEG, interval, listed, number
from residnet.core.layout import RANGE_INPUTS, RANGE_VELOCITIES
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, VELOCITY, nearest
from residnet.core.samples import Samples
from residnet.core.stretches import stretches
from residnet.data.simulated import Craft, Disturbance, Sea, SensorNoise, fly
from residnet.documents import published
from residnet.documents.halvorsen2019.standard_model import (
    NAMES,
    SCALE,
    SUMS,
    StandardFitConfig,
    accelerations,
    fit,
    sums,
    truth,
)
from residnet.documents.study import Results, Study, compared, histories, pictures
from residnet.dynamics.simulated import RecordedPlantDynamics
from residnet.heads.base import ClosedFormHead
from residnet.heads.genetic import GeneticConfig
from residnet.heads.symbolic import SymbolicConfig
from residnet.judge.goodness import OneStep
from residnet.judge.goodness import table as goodness_table
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.open_loop import AccelerationDeceleration
from residnet.physics.hull import PHASES, OdinConfig, froude_number, phase_of
from residnet.physics.vessel import load_vessel
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text, table_of
from residnet.report.figure import (
    BLUE,
    COLORS,
    DASHED,
    MEASURED,
    SOLID,
    ZERO,
    Case,
    Curve,
    Figure,
    Look,
    Panel,
    names_of,
    whiskers,
)
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure

CONTROLS, FORCES = ("cmd_n", "cmd_nozzle"), ("tau_x", "tau_y", "tau_n")
CHANNELS = (*VELOCITY, *CONTROLS, *FORCES)
ALL = "all"
STANDARD, SEPARATE, PLANT = "standard", "separate", "plant"
SETS = (*PHASES, ALL)
"""Sets of samples that a model is fitted to and judged on."""
Published = dict[str, tuple[float, float, float, float, float, float]]
"""Numbers of the document by acceleration."""
SET_NAMES = {
    PHASES[0]: "displacement phase",
    PHASES[1]: "semi-displacement phase",
    PHASES[2]: "planing phase",
    ALL: "all phases",
}
_LEAST_SAMPLES = 500
"""Number of samples below which a phase is neither fitted nor judged."""
_STANDARD_PARAMETERS = (4.0, 8.0, 8.0)
"""Number of parameters of the standard model in surge, sway and yaw."""
_EXCERPT = 60.0
"""Length in s of the stretch of accelerations that is shown."""
_CUTOFFS = (0.025, 0.05, 0.1, 0.2)
"""Cut-offs of the filter that are drawn side by side."""
_ACCELERATION_ROWS = (("u' [m/s²]", 1.0), ("v' [m/s²]", 1.0), ("r' [deg/s²]", DEG))
_UNITS = dict(zip(ACCELERATION, ("m/s^2", "m/s^2", "rad/s^2"), strict=True))
_STEP = 0.04
"""Time step of the simulation in s, finer than the grid; its motion is sampled unevenly."""
_SAME_COST = 1e-6
"""Costs that differ by a smaller share count as the same minimum."""


class ProgrammeConfig(Config):
    """Zigzags at several speeds and a straight run in steps of speed, once on each course.

    Attributes:
        drives: motor speeds as shares of the largest one.
        steers: nozzle angles as shares of the largest one; there is a zigzag for each speed and
            angle.
        heading: heading change in rad at which a zigzag is reversed.
        zigzag: duration of a zigzag in s.
        hold: time in s for which a speed of the straight run is held.
        courses: courses in rad on which the programme is sailed; two opposite ones cancel a steady
            drift, as in the document.
    """

    drives: tuple[float, ...] = Field(default=(0.35, 0.45, 0.55, 0.7, 0.85, 1.0), min_length=2)
    steers: tuple[float, ...] = Field(default=(0.15, 0.35), min_length=1)
    heading: Radians = Field(default=float(np.radians(20)), gt=0)
    zigzag: Seconds = Field(default=80.0, gt=0)
    hold: Seconds = Field(default=25.0, gt=0)
    courses: tuple[Radians, ...] = Field(default=(0.0, float(np.pi)), min_length=1)

    def manoeuvres(self) -> list[Manoeuvre]:
        """Return the manoeuvres of one course in the order in which they are sailed."""
        levels = (*self.drives, *reversed(self.drives[:-1]))
        times = tuple(self.hold * i for i in range(len(levels)))
        straight = AccelerationDeceleration(
            times=times, levels=levels, duration=self.hold * len(levels)
        )
        zigzags = [
            Zigzag(
                heading=self.heading,
                start=self.zigzag / 4,
                duration=self.zigzag,
                drive=drive,
                steer=steer,
                first="starboard" if place % 2 == 0 else "port",
            )
            for drive in self.drives
            for place, steer in enumerate(self.steers)
        ]
        return [straight, *zigzags]


class PreparationConfig(Config):
    """How a log with uneven time steps becomes velocities and accelerations (section 7.3.1).

    Attributes:
        interval: shortest and longest time between two samples of the log, in s.
        step: time step of the uniform grid in s.
        cutoff: cut-off frequency of the Butterworth filter as a share of the Nyquist frequency
            (correction H27).
        order: order of the filter, which is run forward and backward.
        filter_inputs: filter commands and forces as the velocities. The document filters the
            velocities alone; its equations then learn the filter, too, and leave less of the
            measured acceleration than the vessel's own equations.
        margin: time in s that is cut off at both ends of a log, where the filter has one side only.
        stretch: length in s of the stretches that train or validate as a whole.
        validate_every: number of stretches of which the last one validates.
    """

    interval: tuple[Seconds, Seconds] = (0.03, 0.08)
    step: Seconds = Field(default=0.05, gt=0)
    cutoff: float = Field(default=0.1, gt=0, lt=1)
    order: int = Field(default=2, ge=1, le=8)
    filter_inputs: bool = True
    margin: Seconds = Field(default=2.0, ge=0)
    stretch: Seconds = Field(default=20.0, gt=0)
    validate_every: int = Field(default=4, ge=2)

    @model_validator(mode="after")
    def _ordered(self) -> PreparationConfig:
        if not 0 < self.interval[0] <= self.interval[1]:
            raise ValueError(
                "interval: expected shortest and longest, both positive, given"
                f" {list(self.interval)} s"
            )
        return self


class SeaTrialConfig(Config):
    """A simulated sea trial with one vessel.

    Attributes:
        vessel: vessel of kind `odin` with water jets, by name or file.
        programme: manoeuvres that are sailed.
        disturbance: waves and other forces.
        noise: noise of the measured velocities.
        preparation: how the logs become samples.
        seed: seed of the sea, the noise and the times of the samples.
    """

    vessel: str

    programme: ProgrammeConfig = ProgrammeConfig()
    disturbance: Disturbance = Disturbance()
    noise: SensorNoise = SensorNoise(u=0.02, v=0.02, r=float(np.radians(0.1)))
    preparation: PreparationConfig = PreparationConfig()
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _fits(self) -> SeaTrialConfig:
        try:
            self.disturbance.check(odin(self.vessel).build(), self.vessel)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self


def odin(name: str) -> OdinConfig:
    """Return a vessel whose accelerations are known as terms and which has water jets.

    Raises:
        ConfigError: where the vessel is of another kind.
    """
    vessel = load_vessel(name)
    if not isinstance(vessel, OdinConfig) or vessel.build().actuators.commands != CONTROLS:
        raise ConfigError(
            f"vessel '{name}': the sea trial needs a vessel of kind 'odin' with water jets, such as"
            " odin_jets"
        )
    return vessel


class EquationConfig(Config):
    """An equation of the accelerations that is found from the data alone.

    Attributes:
        inputs: inputs of the equation: `forces` of the water jets by their known thrust, or
            `controls`, which are motor speed and nozzle angle.
        head: how the equation is found.
    """

    inputs: Literal["forces", "controls"]
    head: Annotated[SymbolicConfig | GeneticConfig, Field(discriminator="kind")]

    @model_validator(mode="after")
    def _inputs_only(self) -> EquationConfig:
        if self.head.features:
            raise ValueError("head.features: give `inputs` instead")
        return self

    def build(self) -> ClosedFormHead:
        """Build the head for the channels of a trial.

        Raises:
            ConfigError: where its terms name a channel that is not among its inputs.
        """
        features = (*VELOCITY, *(FORCES if self.inputs == "forces" else CONTROLS))
        return self.head.model_copy(update={"features": features}).build(CHANNELS)


@final
class SeaTrialTaskConfig(Study, ComputingTask):
    """Models of Odin fitted and judged by phase, on one simulated trial or several.

    Attributes:
        task: `sea_trial`.
        trials: trials by name; published figures stand beside the first one.
        standard: how the standard model is fitted.
        equations: equations by name.
        published: what the document prints by set of samples, model and acceleration: root mean
            square error (m/s^2, m/s^2, rad/s^2), C_p and adjusted R^2 (Tables 7.3, 7.4), mean
            absolute residual and the ends of its 95 % interval (Table 7.5).
    """

    task: Literal["sea_trial"]
    trials: dict[str, SeaTrialConfig] = Field(min_length=1)
    standard: StandardFitConfig = StandardFitConfig()
    equations: dict[str, EquationConfig] = Field(default_factory=dict)
    published: dict[str, dict[str, Published]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _names(self) -> SeaTrialTaskConfig:
        for name, equation in self.equations.items():
            if name in (STANDARD, SEPARATE, PLANT):
                raise ValueError(f"equations: the name '{name}' is taken")
            try:
                equation.build()
            except ConfigError as error:
                raise ValueError(f"equations.{name}: {error}") from None
        known = (STANDARD, *self.equations)
        for where, models in self.published.items():
            for what, names, one in (("set", SETS, where), *(("model", known, m) for m in models)):
                if one not in names:
                    raise ValueError(f"published: no {what} '{one}'{nearest(one, names)}")
        return self

    def recorded_seed(self) -> int:
        return next(iter(self.trials.values())).seed

    def results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        trials, figures = {}, []
        for name in self.trials:
            trials[name], drawn = study(self, name)
            figures += drawn
        return {"schema": "residnet.sea_trial/1", "run": self.name, "trials": trials}, figures

    def verdict(self, results: Results) -> list[str]:
        sentences = []
        for name, trial in results["trials"].items():
            where = next(iter(trial["rows"]))
            each = [
                f"{row['model']} for {axis} ({number(row['rmse'])} {_UNITS[axis]})"
                for axis, row in _best(trial["rows"][where]).items()
            ]
            sentences.append(
                f"Trial {name}: on the validation stretches of the {SET_NAMES[where]}, the models"
                f" with the least root mean square error are {listed(each)}."
            )
            open_names = trial["standard"][where]["undetermined"]
            if open_names:
                sentences.append(
                    f"Of the standard model, the data of trial {name} determine only combinations"
                    f" of {listed(open_names)}."
                )
        return sentences

    def main_figures(self, results: Results) -> dict[str, MainFigure]:
        out: dict[str, MainFigure] = {}
        for name, trial in results["trials"].items():
            where, rows = next(iter(trial["rows"].items()))
            of_standard = [row for row in rows if row["model"] == STANDARD and row["on"] == where]
            for row in (*_best(rows).values(), *of_standard):
                key = f"{name}: rmse of {row['axis']}, {row['model']}"
                out[key] = MainFigure(row["rmse"], _UNITS[row["axis"]])
        return out

    def sections(self, results: Results, run: Path) -> list[Section]:
        name, trial = next(iter(results["trials"].items()))
        where, rows = next(iter(trial["rows"].items()))
        best = _best(rows)
        first = table_of(
            (
                row
                for row in rows
                if row is best[row["axis"]] or (row["model"] == STANDARD and row["on"] == where)
            ),
            [
                ("acceleration", "axis"),
                ("model", "model"),
                ("RMSE", lambda row: f"{number(row['rmse'])} {_UNITS[row['axis']]}", str),
            ],
            caption=f"Trial {name}, {SET_NAMES[where]}",
            selected=lambda row: row is best[row["axis"]],
            rule=lambda row: row["axis"],
        )
        drawn = [one.part() for one in pictures(run, f"{where}_{name}")]
        out = [Section("", [*drawn, first])]
        for place, (name, trial) in enumerate(results["trials"].items()):
            blocks: list[Text | Section] = [Text(_about(trial))]
            for where, rows in trial["rows"].items():
                table = _goodness(where, rows, {} if place else self.published.get(where, {}))
                title = f"Validation, {SET_NAMES[where]}"
                blocks.append(Section(title, [table, *pictures(run, f"{where}_{name}")]))
            parameters: list[Block] = [_parameters(trial), Bullets(_notes(trial))]
            parameters += pictures(run, f"parameters_{name}")
            blocks.append(Section("Parameters of the standard model", parameters))
            equations = [
                (model.replace("_", "-"), text)
                for model, texts in trial["equations"].items()
                for text in texts.values()
            ]
            if equations:
                columns = [("model", lambda row: row[0]), ("equation", lambda row: row[1])]
                blocks.append(Section("Equations", [table_of(equations, columns)]))
            blocks.append(Section("The trial", pictures(run, f"trial_{name}"), folded=True))
            out.append(Section(f"Trial {name}: vessel {self.trials[name].vessel}", blocks))
        return out


@dataclass(frozen=True)
class Trial:
    """The prepared samples of a trial, N in all.

    Attributes:
        samples: channels `CHANNELS` and measured accelerations; `group` numbers the stretches.
        log: number of the log that a sample belongs to [N].
        validates: samples that no model is fitted to [N] bool.
        phase: number of the phase in `physics.froude.PHASES` [N].
        step: time step in s.
    """

    samples: Samples
    log: np.ndarray
    validates: np.ndarray
    phase: np.ndarray
    step: float

    def pieces(self, keep: np.ndarray) -> list[np.ndarray]:
        """Return the indices of the kept samples, piece by piece without gaps.

        Args:
            keep: samples to keep [N] bool.
        """
        starts, stops = stretches(np.where(keep, self.samples.group.numpy(), -1))
        return [
            np.arange(start, stop)
            for start, stop in zip(starts, stops, strict=True)
            if stop - start > 1
        ]


def sailed(config: SeaTrialConfig) -> list[Log]:
    """Return the logs of the programme, sailed by the vessel.

    Raises:
        ConfigError: where the vessel cannot feel the disturbance or is of another kind.
        DataError: where the motion does not stay finite.
    """
    name, given = config.vessel, config.disturbance
    vessel, logs = odin(name), []
    for place, course in enumerate(config.programme.courses):
        plant = vessel.build()
        given.check(plant, name)
        dynamics = RecordedPlantDynamics(plant, _STEP)
        craft = Craft(name, dynamics, Helm.from_plant(plant), plant.commands, plant.approach(1))
        turned = given
        if given.waves is not None:
            direction = given.waves.direction - course
            waves = given.waves.model_copy(update={"direction": direction})
            turned = given.model_copy(update={"waves": waves})
        sea = Sea(plant, turned, config.noise, config.seed + place)
        programme = config.programme.manoeuvres()
        flights = fly(craft, programme, sea, config.programme.zigzag, _STEP)
        logs += [flight.log for flight in flights]
    return logs


def prepared(
    logs: Sequence[Log], vessel: OdinConfig, config: PreparationConfig, seed: int
) -> Trial:
    """Interpolate, filter and differentiate logs.

    Args:
        logs: logs with the channels u, v, r, cmd_n and cmd_nozzle.
        vessel: vessel that sailed them, whose jets turn commands into forces.
        config: how the logs are prepared.
        seed: seed of the times of the samples.
    """
    from scipy.signal import butter, filtfilt

    random, actuators = np.random.default_rng([seed, 11]), vessel.build().actuators
    low_pass = butter(config.order, config.cutoff)
    parts: list[tuple[np.ndarray, ...]] = []
    for place, given in enumerate(logs):
        # from samples at uneven times to the uniform grid
        end = float(given.t[-1])
        at = np.cumsum(random.uniform(*config.interval, size=round(end / config.interval[0]) + 1))
        taken = np.unique(np.searchsorted(given.t, at[at < end]))
        t = np.arange(float(given.t[taken[0]]), float(given.t[taken[-1]]), config.step)
        names = (*VELOCITY, *CONTROLS)
        z = np.stack([np.interp(t, given.t[taken], given.channels[n][taken]) for n in names], 1)
        nu, command = torch.from_numpy(z[:, RANGE_VELOCITIES]), torch.from_numpy(z[:, RANGE_INPUTS])
        force = actuators.force(torch.zeros(len(t), 0, dtype=torch.float64), command, nu).numpy()
        inputs = np.concatenate((z[:, RANGE_INPUTS], force), axis=1)
        if config.filter_inputs:
            inputs = filtfilt(*low_pass, inputs, axis=0)
        velocity = filtfilt(*low_pass, z[:, RANGE_VELOCITIES], axis=0)
        cut = round(config.margin / config.step)
        kept = slice(cut, len(t) - 1 - cut)
        parts.append(
            (
                np.concatenate((velocity, inputs), axis=1)[kept],
                (np.diff(velocity, axis=0) / config.step)[kept],
                t[kept],
                np.full(len(t[kept]), place),
                (t[kept] // config.stretch).astype(int),
            )
        )
    z, rates, t, log, stretch = (np.concatenate(part) for part in zip(*parts, strict=True))
    group = np.concatenate(([0], np.cumsum((np.diff(log) != 0) | (np.diff(stretch) != 0))))
    samples = Samples(
        torch.from_numpy(z),
        torch.from_numpy(rates),
        torch.from_numpy(group),
        torch.from_numpy(t),
        ("made",) * (group[-1] + 1),
        CHANNELS,
    )
    froude = froude_number(samples.z[:, 0], samples.z[:, 1], float(vessel.length.value))
    validates = (stretch + log) % config.validate_every == config.validate_every - 1
    return Trial(samples, log, validates, phase_of(froude).numpy(), config.step)


class Fitted(NamedTuple):
    """A model that was fitted to one set of samples.

    Attributes:
        predicted: predicted accelerations at all samples [N, 3].
        parameter_count: number of parameters in surge, sway and yaw.
        equations: the equation of each axis as text; empty for other models.
    """

    predicted: np.ndarray
    parameter_count: tuple[float, ...]
    equations: Mapping[str, str]


def study(settings: SeaTrialTaskConfig, name: str) -> tuple[dict[str, Any], list[Figure]]:
    """Simulate one trial, and fit and judge every model on every set of samples.

    Returns what was found and its figures: 7.1, 7.2 (one), 7.4 to 7.6 (one) and 7.8 to 7.14.

    Beside the models that are fitted to one set stands for each one that consists of those of the
    single phases.

    Raises:
        ResidnetError: where the trial cannot be sailed or a model is not determined.
    """
    config, mass = settings.trials[name], settings.standard.mass
    vessel, logs = odin(config.vessel), sailed(config)
    trials = {
        cutoff: prepared(
            logs, vessel, config.preparation.model_copy(update={"cutoff": cutoff}), config.seed
        )
        for cutoff in sorted({*_CUTOFFS, config.preparation.cutoff})
    }
    trial = trials[config.preparation.cutoff]
    sets: dict[str, np.ndarray] = {
        phase: trial.phase == place for place, phase in enumerate(PHASES)
    }
    sets[ALL] = np.ones(len(trial.phase), dtype=bool)
    sets = {
        where: keep
        for where, keep in sets.items()
        if min((keep & ~trial.validates).sum(), (keep & trial.validates).sum()) >= _LEAST_SAMPLES
    }
    z, a = trial.samples.z.numpy(), trial.samples.target.numpy()
    nu, tau = z[:, RANGE_VELOCITIES], z[:, 5:]
    standard: dict[str, Results] = {}
    models: dict[tuple[str, str], Fitted] = {}
    for where, keep in sets.items():
        train = keep & ~trial.validates
        standard[where] = found = fit(nu[train], tau[train], a[train], settings.standard)
        predicted = accelerations(np.array([*found["values"].values()]), mass, nu, tau)
        models[STANDARD, where] = Fitted(predicted, _STANDARD_PARAMETERS, {})
        samples = trial.samples.where(torch.from_numpy(train))
        for equation, equation_config in settings.equations.items():
            head = equation_config.build()
            head.calibrate(samples)
            texts = {axis: of["text"] for axis, of in head.solve(samples)["equations"].items()}
            with torch.no_grad():
                predicted = head(trial.samples.z, trial.samples.z[:, :0])[0].numpy()
            models[equation, where] = Fitted(predicted, tuple(head.parameter_count()), texts)
    for model in (STANDARD, *settings.equations):
        # where a phase has no model, the one of all phases takes its place
        predicted, count = models[model, ALL].predicted.copy(), np.zeros(3)
        for phase in PHASES:
            if phase in sets:
                predicted[sets[phase]] = models[model, phase].predicted[sets[phase]]
                count += models[model, phase].parameter_count
        models[model, SEPARATE] = Fitted(predicted, tuple(count), {})
    known, spread = truth(vessel, mass), a.std(axis=0)
    content = {
        "samples": len(trial.phase),
        "seconds": len(trial.phase) * trial.step,
        "step": trial.step,
        "logs": int(trial.log.max()) + 1,
        "validation_share": float(trial.validates.mean()),
        "acceleration_std": dict(zip(ACCELERATION, spread.tolist(), strict=True)),
        "acceleration_std_by_cutoff": {
            f"{cutoff:g}": dict(
                zip(ACCELERATION, each.samples.target.std(0, correction=0).tolist(), strict=True)
            )
            for cutoff, each in trials.items()
        },
        "phases": {
            phase: float((trial.phase == place).mean()) for place, phase in enumerate(PHASES)
        },
        "truth": known,
        "true_sums": sums(known, mass),
        "standard": standard,
        "equations": {
            f"{model} on {on}": fitted.equations
            for (model, on), fitted in models.items()
            if fitted.equations
        },
        "rows": _judged(vessel, trial, sets, models),
    }
    figures = [
        _sailed(name, trial),
        _cutoffs(name, trials),
        _parameters_figure(name, standard, known),
    ]
    return content, figures + [_excerpt(name, trial, models, where) for where in standard]


def _judged(
    vessel: OdinConfig,
    trial: Trial,
    sets: Mapping[str, np.ndarray],
    models: Mapping[tuple[str, str], Fitted],
) -> dict[str, list[dict[str, Any]]]:
    """Return the goodness of fit on the validation stretches of each set.

    The plant's own equations stand beside the models: they show what the sea and the preparation
    leave unexplained.
    """
    z, a = trial.samples.z, trial.samples.target.numpy()
    known = Fitted(vessel.hull()(z[:, RANGE_VELOCITIES], z[:, 5:]).numpy(), (0.0, 0.0, 0.0), {})
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


def _sailed(name: str, trial: Trial) -> Figure:
    z = trial.samples.z.numpy()
    t = np.arange(len(z)) * trial.step / 60
    rows = {
        "u": ("u [m/s]", 1.0),
        "v": ("v [m/s]", 1.0),
        "r": ("r [deg/s]", DEG),
        "cmd_n": ("motor [rpm]", 60.0),
        "cmd_nozzle": ("nozzle [deg]", DEG),
    }
    starts, stops = stretches(trial.validates)
    words = "Zigzags and steps of speed; stretches that validate are grey."
    return histories(
        f"trial_{name}",
        ("Simulated sea trial", words),
        {
            "validation": Look("validation", "#D9D9D9", kind="strip", order=0),
            "line": Look("", BLUE, width=0.6),
        },
        t,
        {"line": z[:, [CHANNELS.index(channel) for channel in rows]]},
        list(rows.values()),
        height=150,
        x_label="time, logs end to end [min]",
        shared={"validation": (t[starts], t[stops - 1])},
    )


def _cutoffs(name: str, trials: Mapping[float, Trial]) -> Figure:
    looks, paths = {}, {}
    shown = _turning(next(iter(trials.values())), np.ones(1, dtype=bool))
    for (cutoff, trial), color in zip(trials.items(), COLORS, strict=False):
        label = f"cut-off {cutoff:g}"
        looks[label] = Look(label, color, width=1)
        nozzle = trial.samples.z[:, CHANNELS.index("cmd_nozzle"), None]
        paths[label] = torch.cat((trial.samples.target, nozzle), dim=1).numpy()[shown]
    units = (*_ACCELERATION_ROWS, ("nozzle [deg]", DEG))
    words = (
        "Shares of the Nyquist frequency. A low one reacts before the inputs do and is too small."
    )
    t = np.arange(len(shown)) * next(iter(trials.values())).step
    title = ("Accelerations by the filter's cut-off", words)
    return histories(f"cutoffs_{name}", title, looks, t, paths, units, height=150)


def _turning(trial: Trial, keep: np.ndarray) -> np.ndarray:
    """Return the indices of the minute that turns most: straight runs show little."""
    nozzle = trial.samples.z.numpy()[:, CHANNELS.index("cmd_nozzle")]
    pieces = trial.pieces(np.broadcast_to(keep, nozzle.shape))
    piece = max(pieces, key=lambda indices: float(np.abs(nozzle[indices]).sum()))
    return piece[: round(_EXCERPT / trial.step)]


def _parameters_figure(
    name: str, fits: Mapping[str, Results], truth: Mapping[str, float]
) -> Figure:
    undetermined = next(iter(fits.values()))["undetermined"]
    shown = [i for i, name in enumerate(NAMES) if name not in undetermined]
    looks = {"zero": ZERO}
    curves: dict[str, Curve] = {"zero": (np.zeros(1), np.zeros(1))}
    for place, (where, found) in enumerate(fits.items()):
        values, errors, known = (
            np.array([of[NAMES[i]] for i in shown], dtype=float)
            for of in (found["values"], found["standard_errors"], truth)
        )
        error, spread = (values - known) / SCALE[shown], 2 * errors / SCALE[shown]
        at = np.arange(len(shown)) + 0.16 * (place - (len(fits) - 1) / 2)
        looks[where] = Look(SET_NAMES[where], COLORS[place], kind="points", size=3)
        looks[f"{where} errors"] = Look("", COLORS[place], width=1)
        curves[where] = (at, error)
        curves[f"{where} errors"] = whiskers(at, error - spread, error + spread)
    return Figure(
        f"parameters_{name}",
        "Parameters of the standard model",
        "Estimates less the true values, with two standard errors.",
        looks,
        [
            Panel(
                "estimate less truth, of a typical size",
                height=350,
                x_names=names_of(NAMES[i] for i in shown),
            )
        ],
        [Case("", [curves])],
    )


def _excerpt(
    name: str, trial: Trial, models: Mapping[tuple[str, str], Fitted], where: str
) -> Figure:
    keep = (
        trial.validates if where == ALL else trial.validates & (trial.phase == PHASES.index(where))
    )
    piece = _turning(trial, keep)
    t, paths = np.arange(len(piece)) * trial.step, {"measured": trial.samples.target.numpy()[piece]}
    looks = {"measured": MEASURED}
    other = next((key for key in models if key[0] != STANDARD and key[1] == where), None)
    for key, look in (((STANDARD, where), DASHED), (other, SOLID)):
        if key is not None:
            label = f"{key[0]}, fitted on {SET_NAMES[where]}"
            looks[label] = replace(look, label=label)
            paths[label] = models[key].predicted[piece]
    words = "Accelerations measured and predicted from measured velocities and inputs."
    title = f"Validation, {SET_NAMES[where]}"
    return histories(
        f"{where}_{name}", (title, words), looks, t, paths, _ACCELERATION_ROWS, height=180
    )


def _best(rows: Sequence[Results]) -> dict[str, Results]:
    axes = dict.fromkeys(row["axis"] for row in rows)
    return {
        axis: min(
            (row for row in rows if row["axis"] == axis and row["model"] != PLANT),
            key=lambda row: float(row["rmse"]),
        )
        for axis in axes
    }


def _about(trial: Results) -> str:
    shares = [
        f"{100 * share:.0f} % in the {SET_NAMES[phase]}" for phase, share in trial["phases"].items()
    ]
    spread = [
        f"{axis} {number(value)} {_UNITS[axis]}"
        for axis, value in trial["acceleration_std"].items()
    ]
    return (
        f"The trial lasts {trial['seconds'] / 60:.0f} minutes in {trial['logs']} logs, sampled at"
        f" {1 / trial['step']:.0f} Hz: {listed(shares)}. The standard deviations of the"
        f" accelerations are {listed(spread)}. {100 * trial['validation_share']:.0f} % of the"
        " stretches validate."
    )


def _goodness(where: str, rows: Sequence[Results], printed: Mapping[str, Published]) -> Table:
    """Return the goodness of fit of all models on one set (Tables 7.3 to 7.5)."""
    names, shown = ("rmse", "cp", "r2_adjusted", "mae", "low", "high"), []
    for row in rows:
        # the document fits its standard model to the phase, and its equations to all samples
        own = row["on"] == (where if row["model"] == STANDARD else ALL)
        beside = printed.get(row["model"], {}).get(row["axis"], ()) if own else ()
        shown.append({**row, "published": dict(zip(names, beside, strict=False))})

    def as_printed(row: Results) -> Cell:
        of = row["published"]
        note = f"published {interval([of['low'], of['high']])}" if "low" in of else ""
        return Cell(interval(row["mae_ci95_independent"]), note)

    def fitted_to(row: Results) -> str:
        return DASH if row["model"] == PLANT else row["on"].replace("_", "-")

    return table_of(
        shown,
        [
            ("model", "model"),
            ("acceleration", "axis"),
            ("fitted to", fitted_to),
            ("parameters", "parameters", 0),
            *compared("rmse", "RMSE", 3),
            *compared("cp", "C_p", 3),
            *compared("r2_adjusted", "adjusted R^2", 3),
            *compared("mae", "mean abs. residual", 3),
            ("95 %, blocks", "mae_ci95", interval),
            ("95 %, as printed", as_printed),
        ],
        caption="Published figures are those of the real vessel. Intervals are of the mean absolute"
        " residual; those by moving blocks account for its correlation in time (correction E8).",
    )


def _parameters(trial: Results) -> Table:
    fits, printed = trial["standard"], published("halvorsen2019")
    columns = ["parameter", "true", *map(SET_NAMES.__getitem__, fits)]
    table = Table(
        [*columns, "published before", "published after"], caption="SI units, with standard errors."
    )

    def with_error(value: float, error: float | None) -> Cell:
        if error == 0.0:
            return Cell(number(value, 5), "at its bound", mark="weak")
        return Cell(number(value, 5), f"± {number(error, 2)}")

    def estimate(fit: Results, name: str) -> Cell:
        value = fit["values"][name]
        if name in fit["undetermined"]:
            return Cell(number(value, 4), "not determined", mark="weak")
        if name in fit["at_bound"]:
            return Cell(number(value), "at its bound", mark="weak")
        return with_error(value, fit["standard_errors"][name])

    for name in NAMES:
        ours = [estimate(fit, name) for fit in fits.values()]
        theirs = number(printed["start"][name], 5), number(printed["fitted"].get(name), 4)
        table.add(name, [number(trial["truth"][name], 5), *ours, *theirs])
    for name in SUMS:
        inertias = [with_error(*fit["sums"][name]) for fit in fits.values()]
        table.add(name, [number(trial["true_sums"][name], 5), *inertias, "", ""])
    return table


def _notes(trial: Results) -> list[str]:
    notes = []
    for where, found in trial["standard"].items():
        costs = found["cost"]
        same = sum(cost <= costs[0] * (1 + _SAME_COST) for cost in costs)
        determined = (
            f"only combinations of {listed(found['undetermined'])} are determined"
            if found["undetermined"]
            else "every parameter is determined"
        )
        notes.append(
            f"In the {SET_NAMES[where]}, {determined}; the condition number of the rest is"
            f" {number(found['condition'], 2)}. {same} of {len(costs)} starting points end at the"
            " least error."
        )
    return [
        *notes,
        "The standard errors account for scatter and correlation of the residuals. They do not"
        " account for what the filter, the waves or a wrong structure of the model shift.",
    ]
