"""Task `sea_trial`: models of Odin by phase, on simulated trials (Halvorsen 2019, section 7.5).

The log is interpolated to a uniform grid, filtered forward and backward by a Butterworth low-pass,
and differentiated by differences (7.1). The standard model is compared with equations found from
the data alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
import torch

from residnet.core.format import DASH, DEGREES_PER_RADIAN, format_interval, format_number, join_list
from residnet.core.layout import RANGE_INPUTS, RANGE_VELOCITIES
from residnet.core.log import Log
from residnet.core.names import ACCELERATION_NAMES, VELOCITY_NAMES
from residnet.core.samples import Samples
from residnet.core.stretches import find_runs
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.evaluation.goodness import OneStepResiduals
from residnet.evaluation.goodness import build_goodness_table as goodness_table
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.trials import SimulatedVessel, TrialEnvironment, simulate_manoeuvres
from residnet.physics.froude import SPEED_REGIMES, classify_speed_regime, compute_froude_number
from residnet.physics.hull import AccelerationHullConfig
from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text, build_table
from residnet.report.figure import (
    BLUE,
    COLORS,
    DASHED_STYLE,
    MEASURED_STYLE,
    SOLID_STYLE,
    ZERO_LINE_STYLE,
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    error_bars,
    tick_labels,
)
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric
from residnet.studies import load_published
from residnet.studies.halvorsen2019.sea_trial.config import (
    ALL,
    CHANNELS,
    CONTROLS,
    PLANT,
    SEPARATE,
    STANDARD,
    PreparationConfig,
    Published,
    SeaTrialConfig,
    SeaTrialTaskConfig,
    load_odin,
)
from residnet.studies.halvorsen2019.standard_model import (
    INERTIA_SUMS,
    SCALE,
    STANDARD_PARAMETER_NAMES,
    fit_standard_model,
    inertia_sums,
    standard_accelerations,
    true_parameters,
)
from residnet.studies.study import (
    StudyExecutor,
    StudyResults,
    comparison_columns,
    find_figures,
    plot_time_series,
)

SET_NAMES = {
    SPEED_REGIMES[0]: "displacement phase",
    SPEED_REGIMES[1]: "semi-displacement phase",
    SPEED_REGIMES[2]: "planing phase",
    ALL: "all phases",
}
"""Names of the sets of samples in sentences."""
_LEAST_SAMPLES = 500
"""Smallest number of samples of a phase for a fit and an evaluation."""
_STANDARD_PARAMETERS = (4.0, 8.0, 8.0)
"""Number of parameters of the standard model in surge, sway and yaw."""
_EXCERPT_SECONDS = 60.0
"""Length in s of the plotted part of the accelerations."""
_PLOTTED_CUTOFFS = (0.025, 0.05, 0.1, 0.2)
"""Cut-off frequencies of the plotted filters."""
_ACCELERATION_ROWS = (("u' [m/s²]", 1.0), ("v' [m/s²]", 1.0), ("r' [deg/s²]", DEGREES_PER_RADIAN))
_UNITS = dict(zip(ACCELERATION_NAMES, ("m/s^2", "m/s^2", "rad/s^2"), strict=True))
_SIMULATION_STEP = 0.04
"""Time step of the simulation in s, finer than the grid; its motion is sampled unevenly."""
_SAME_COST = 1e-6
"""Relative difference below which two costs belong to the same minimum."""


@final
class SeaTrialExecutor(StudyExecutor[SeaTrialTaskConfig]):
    """Fit and evaluate models of Odin by phase on simulated trials."""

    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        trials = {}
        figures = []
        for name in self.config.trials:
            trials[name], trial_figures = run_trial(self.config, name)
            figures += trial_figures
        return {
            "schema": "residnet.sea_trial/1",
            "run": self.config.name,
            "trials": trials,
        }, figures

    def summarize(self, results: StudyResults) -> list[str]:
        sentences = []
        for name, trial in results["trials"].items():
            set_name = next(iter(trial["rows"]))
            best_texts = [
                f"{row['model']} for {axis} ({format_number(row['rmse'])} {_UNITS[axis]})"
                for axis, row in _best_rows(trial["rows"][set_name]).items()
            ]
            sentences.append(
                f"Trial {name}: on the validation stretches of the {SET_NAMES[set_name]}, the"
                f" models"
                f" with the least root mean square error are {join_list(best_texts)}."
            )
            undetermined = trial["standard"][set_name]["undetermined"]
            if undetermined:
                sentences.append(
                    f"Of the standard model, the data of trial {name} determine only combinations"
                    f" of {join_list(undetermined)}."
                )
        return sentences

    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        figures: dict[str, SummaryMetric] = {}
        for name, trial in results["trials"].items():
            set_name, rows = next(iter(trial["rows"].items()))
            standard_rows = [
                row for row in rows if row["model"] == STANDARD and row["on"] == set_name
            ]
            for row in (*_best_rows(rows).values(), *standard_rows):
                key = f"{name}: rmse of {row['axis']}, {row['model']}"
                figures[key] = SummaryMetric(row["rmse"], _UNITS[row["axis"]])
        return figures

    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        name, trial = next(iter(results["trials"].items()))
        set_name, rows = next(iter(trial["rows"].items()))
        best_rows = _best_rows(rows)
        summary_table = build_table(
            (
                row
                for row in rows
                if row is best_rows[row["axis"]]
                or (row["model"] == STANDARD and row["on"] == set_name)
            ),
            [
                ("acceleration", "axis"),
                ("model", "model"),
                ("RMSE", lambda row: f"{format_number(row['rmse'])} {_UNITS[row['axis']]}", str),
            ],
            caption=f"Trial {name}, {SET_NAMES[set_name]}",
            is_selected=lambda row: row is best_rows[row["axis"]],
            group_key=lambda row: row["axis"],
        )
        previews = [picture.preview() for picture in find_figures(run, f"{set_name}_{name}")]
        sections_written = [Section("", [*previews, summary_table])]
        for trial_index, (name, trial) in enumerate(results["trials"].items()):
            blocks: list[Text | Section] = [Text(_trial_text(trial))]
            for set_name, rows in trial["rows"].items():
                table = _goodness_table(
                    set_name, rows, {} if trial_index else self.config.published.get(set_name, {})
                )
                title = f"Validation, {SET_NAMES[set_name]}"
                blocks.append(Section(title, [table, *find_figures(run, f"{set_name}_{name}")]))
            parameters: list[Block] = [
                _parameter_table(trial),
                Bullets(_identifiability_notes(trial)),
            ]
            parameters += find_figures(run, f"parameters_{name}")
            blocks.append(Section("Parameters of the standard model", parameters))
            equations = [
                (model.replace("_", "-"), text)
                for model, texts in trial["equations"].items()
                for text in texts.values()
            ]
            if equations:
                columns = [("model", lambda row: row[0]), ("equation", lambda row: row[1])]
                blocks.append(Section("Equations", [build_table(equations, columns)]))
            blocks.append(Section("The trial", find_figures(run, f"trial_{name}"), is_folded=True))
            sections_written.append(
                Section(f"Trial {name}: vessel {self.config.trials[name].vessel}", blocks)
            )
        return sections_written


@dataclass(frozen=True)
class TrialSamples:
    """The prepared samples of a trial, N in all.

    Attributes:
        samples: channels `CHANNELS` and measured accelerations; `group` numbers the stretches.
        log: index of the log of each sample [N].
        is_validation: mask of the samples that no model is fitted to [N].
        phase: index of the phase of each sample in `physics.froude.PHASES` [N].
        step: time step in s.
    """

    samples: Samples
    log: np.ndarray
    is_validation: np.ndarray
    phase: np.ndarray
    step: float

    def contiguous_indices(self, mask: np.ndarray) -> list[np.ndarray]:
        """Return the indices of the selected samples, one array for each part without gaps.

        Args:
            mask: selected samples [N] bool.
        """
        starts, stops = find_runs(np.where(mask, self.samples.group.numpy(), -1))
        return [
            np.arange(start, stop)
            for start, stop in zip(starts, stops, strict=True)
            if stop - start > 1
        ]


def simulate_sea_trial_logs(config: SeaTrialConfig) -> list[Log]:
    """Return simulated logs of the trial programme.

    Raises:
        ConfigError: if the vessel cannot be disturbed or is of another kind.
        DataError: if the motion does not remain finite.
    """
    name = config.vessel
    disturbance = config.disturbance
    vessel = load_odin(name)
    logs = []
    for course_index, course_angle in enumerate(config.programme.courses):
        plant = vessel.build()
        disturbance.check_plant(plant, name)
        dynamics = RecordedPlantDynamics(plant, _SIMULATION_STEP)
        craft = SimulatedVessel(
            name, dynamics, Helm.from_plant(plant), plant.n_commands, plant.make_initial_state(1)
        )
        rotated_disturbance = disturbance
        if disturbance.waves is not None:
            direction = disturbance.waves.direction - course_angle
            waves = disturbance.waves.model_copy(update={"direction": direction})
            rotated_disturbance = disturbance.model_copy(update={"waves": waves})
        sea = TrialEnvironment(plant, rotated_disturbance, config.noise, config.seed + course_index)
        programme = config.programme.build_manoeuvres()
        trials = simulate_manoeuvres(
            craft, programme, sea, config.programme.zigzag, _SIMULATION_STEP
        )
        logs += [flight.measured_log for flight in trials]
    return logs


def prepare_logs(
    logs: Sequence[Log], vessel: AccelerationHullConfig, config: PreparationConfig, seed: int
) -> TrialSamples:
    """Interpolate, filter and differentiate logs.

    Args:
        logs: logs with the channels u, v, r, cmd_n and cmd_nozzle.
        vessel: vessel of the logs, whose water jets convert commands to forces.
        config: settings of the preparation.
        seed: seed of the times of the samples.
    """
    from scipy.signal import butter, filtfilt

    generator = np.random.default_rng([seed, 11])
    actuators = vessel.build().actuators
    low_pass = butter(config.order, config.cutoff)
    log_parts: list[tuple[np.ndarray, ...]] = []
    for log_index, raw_log in enumerate(logs):
        # from samples at uneven times to the uniform grid
        end = float(raw_log.t[-1])
        sample_times = np.cumsum(
            generator.uniform(*config.interval, size=round(end / config.interval[0]) + 1)
        )
        sample_indices = np.unique(np.searchsorted(raw_log.t, sample_times[sample_times < end]))
        t = np.arange(
            float(raw_log.t[sample_indices[0]]), float(raw_log.t[sample_indices[-1]]), config.step
        )
        names = (*VELOCITY_NAMES, *CONTROLS)
        z = np.stack(
            [
                np.interp(t, raw_log.t[sample_indices], raw_log.channels[n][sample_indices])
                for n in names
            ],
            1,
        )
        nu = torch.from_numpy(z[:, RANGE_VELOCITIES])
        command = torch.from_numpy(z[:, RANGE_INPUTS])
        force = actuators.force(torch.zeros(len(t), 0, dtype=torch.float64), command, nu).numpy()
        inputs = np.concatenate((z[:, RANGE_INPUTS], force), axis=1)
        if config.filter_inputs:
            inputs = filtfilt(*low_pass, inputs, axis=0)
        velocity = filtfilt(*low_pass, z[:, RANGE_VELOCITIES], axis=0)
        n_cut = round(config.margin / config.step)
        inner_samples = slice(n_cut, len(t) - 1 - n_cut)
        log_parts.append(
            (
                np.concatenate((velocity, inputs), axis=1)[inner_samples],
                (np.diff(velocity, axis=0) / config.step)[inner_samples],
                t[inner_samples],
                np.full(len(t[inner_samples]), log_index),
                (t[inner_samples] // config.stretch).astype(int),
            )
        )
    z, rates, t, log, stretch = (np.concatenate(arrays) for arrays in zip(*log_parts, strict=True))
    group = np.concatenate(([0], np.cumsum((np.diff(log) != 0) | (np.diff(stretch) != 0))))
    samples = Samples(
        torch.from_numpy(z),
        torch.from_numpy(rates),
        torch.from_numpy(group),
        torch.from_numpy(t),
        ("made",) * (group[-1] + 1),
        CHANNELS,
    )
    froude = compute_froude_number(samples.z[:, 0], samples.z[:, 1], float(vessel.length.value))
    validates = (stretch + log) % config.validate_every == config.validate_every - 1
    return TrialSamples(samples, log, validates, classify_speed_regime(froude).numpy(), config.step)


class FittedAccelerations(NamedTuple):
    """A model that was fitted to one set of samples.

    Attributes:
        predicted: predicted accelerations at all samples [N, 3].
        parameter_count: number of parameters in surge, sway and yaw.
        equations: the equation of each axis as text; empty for other models.
    """

    predicted: np.ndarray
    parameter_count: tuple[float, ...]
    equations: Mapping[str, str]


def run_trial(settings: SeaTrialTaskConfig, name: str) -> tuple[dict[str, Any], list[Figure]]:
    """Simulate one trial, and fit and evaluate every model on every set of samples.

    Returns the results and the figures 7.1, 7.2 (one), 7.4 to 7.6 (one) and 7.8 to 7.14.

    In addition to the models of one set, each model is also evaluated as a combination of the
    models of the single phases.

    Raises:
        ResidnetError: if the trial cannot be simulated or a model is not determined.
    """
    config = settings.trials[name]
    mass = settings.standard.mass
    vessel = load_odin(config.vessel)
    logs = simulate_sea_trial_logs(config)
    trials = {
        cutoff: prepare_logs(
            logs, vessel, config.preparation.model_copy(update={"cutoff": cutoff}), config.seed
        )
        for cutoff in sorted({*_PLOTTED_CUTOFFS, config.preparation.cutoff})
    }
    trial = trials[config.preparation.cutoff]
    sets: dict[str, np.ndarray] = {
        phase: trial.phase == phase_index for phase_index, phase in enumerate(SPEED_REGIMES)
    }
    sets[ALL] = np.ones(len(trial.phase), dtype=bool)
    sets = {
        set_name: mask
        for set_name, mask in sets.items()
        if min((mask & ~trial.is_validation).sum(), (mask & trial.is_validation).sum())
        >= _LEAST_SAMPLES
    }
    z, a = trial.samples.z.numpy(), trial.samples.target.numpy()
    nu, tau = z[:, RANGE_VELOCITIES], z[:, 5:]
    standard: dict[str, StudyResults] = {}
    models: dict[tuple[str, str], FittedAccelerations] = {}
    for set_name, mask in sets.items():
        train = mask & ~trial.is_validation
        standard[set_name] = standard_fit = fit_standard_model(
            nu[train], tau[train], a[train], settings.standard
        )
        predicted = standard_accelerations(
            np.array([*standard_fit["values"].values()]), mass, nu, tau
        )
        models[STANDARD, set_name] = FittedAccelerations(predicted, _STANDARD_PARAMETERS, {})
        samples = trial.samples.select(torch.from_numpy(train))
        for equation, equation_config in settings.equations.items():
            head = equation_config.build()
            head.calibrate(samples)
            texts = {
                axis: axis_equation["text"]
                for axis, axis_equation in head.fit_preferred(samples)["equations"].items()
            }
            with torch.no_grad():
                predicted = head(trial.samples.z, trial.samples.z[:, :0])[0].numpy()
            models[equation, set_name] = FittedAccelerations(
                predicted, tuple(head.parameter_counts()), texts
            )
    for model in (STANDARD, *settings.equations):
        # where a phase has no model, the one of all phases takes its place
        predicted = models[model, ALL].predicted.copy()
        count = np.zeros(3)
        for phase in SPEED_REGIMES:
            if phase in sets:
                predicted[sets[phase]] = models[model, phase].predicted[sets[phase]]
                count += models[model, phase].parameter_count
        models[model, SEPARATE] = FittedAccelerations(predicted, tuple(count), {})
    parameter_values = true_parameters(vessel, mass)
    acceleration_std = a.std(axis=0)
    content = {
        "samples": len(trial.phase),
        "seconds": len(trial.phase) * trial.step,
        "step": trial.step,
        "logs": int(trial.log.max()) + 1,
        "validation_share": float(trial.is_validation.mean()),
        "acceleration_std": dict(zip(ACCELERATION_NAMES, acceleration_std.tolist(), strict=True)),
        "acceleration_std_by_cutoff": {
            f"{cutoff:g}": dict(
                zip(
                    ACCELERATION_NAMES,
                    trial_at_cutoff.samples.target.std(0, correction=0).tolist(),
                    strict=True,
                )
            )
            for cutoff, trial_at_cutoff in trials.items()
        },
        "phases": {
            phase: float((trial.phase == phase_index).mean())
            for phase_index, phase in enumerate(SPEED_REGIMES)
        },
        "truth": parameter_values,
        "true_sums": inertia_sums(parameter_values, mass),
        "standard": standard,
        "equations": {
            f"{model} on {fitted_set}": model_fit.equations
            for (model, fitted_set), model_fit in models.items()
            if model_fit.equations
        },
        "rows": _evaluate_models(vessel, trial, sets, models),
    }
    figures = [
        _trial_figure(name, trial),
        _cutoff_figure(name, trials),
        _parameters_figure(name, standard, parameter_values),
    ]
    return content, figures + [
        _excerpt_figure(name, trial, models, set_name) for set_name in standard
    ]


def _evaluate_models(
    vessel: AccelerationHullConfig,
    trial: TrialSamples,
    sets: Mapping[str, np.ndarray],
    models: Mapping[tuple[str, str], FittedAccelerations],
) -> dict[str, list[dict[str, Any]]]:
    """Return the goodness of fit on the validation segments of each set.

    The plant's own equations are included as a reference for the effect of sea and preparation.
    """
    z, a = trial.samples.z, trial.samples.target.numpy()
    plant_model = FittedAccelerations(
        vessel.build_hull()(z[:, RANGE_VELOCITIES], z[:, 5:]).numpy(), (0.0, 0.0, 0.0), {}
    )
    rows_by_set = {}
    for name, mask in sets.items():
        segments = trial.contiguous_indices(mask & trial.is_validation)
        evaluated_models = {
            key: model for key, model in models.items() if key[1] in (name, ALL, SEPARATE)
        } | {(PLANT, PLANT): plant_model}
        steps = [
            OneStepResiduals(
                f"{model} on {fitted_set}",
                "head",
                model_fit.parameter_count,
                [(a - model_fit.predicted)[segment] for segment in segments],
                f"{STANDARD} on {name}",
            )
            for (model, fitted_set), model_fit in evaluated_models.items()
        ]
        keys = {
            f"{model} on {fitted_set}": (model, fitted_set)
            for model, fitted_set in evaluated_models
        }
        rows_by_set[name] = [
            row.model_dump(mode="json", exclude_unset=True)
            | dict(zip(("model", "on"), keys[row.model], strict=True))
            for row in goodness_table(steps, [a[p] for p in segments], trial.step)
        ]
    return rows_by_set


def _trial_figure(name: str, trial: TrialSamples) -> Figure:
    z = trial.samples.z.numpy()
    t = np.arange(len(z)) * trial.step / 60
    channel_labels = {
        "u": ("u [m/s]", 1.0),
        "v": ("v [m/s]", 1.0),
        "r": ("r [deg/s]", DEGREES_PER_RADIAN),
        "cmd_n": ("motor [rpm]", 60.0),
        "cmd_nozzle": ("nozzle [deg]", DEGREES_PER_RADIAN),
    }
    starts, stops = find_runs(trial.is_validation)
    caption = "Zigzags and steps of speed; stretches that validate are grey."
    return plot_time_series(
        f"trial_{name}",
        ("Simulated sea trial", caption),
        {
            "validation": GlyphStyle("validation", "#D9D9D9", kind="vspan", z_order=0),
            "line": GlyphStyle("", BLUE, width=0.6),
        },
        t,
        {"line": z[:, [CHANNELS.index(channel) for channel in channel_labels]]},
        list(channel_labels.values()),
        height=150,
        x_label="time, logs end to end [min]",
        shared_traces={"validation": (t[starts], t[stops - 1])},
    )


def _cutoff_figure(name: str, trials: Mapping[float, TrialSamples]) -> Figure:
    styles = {}
    paths = {}
    shown_samples = _most_turning_samples(next(iter(trials.values())), np.ones(1, dtype=bool))
    for (cutoff, trial), color in zip(trials.items(), COLORS, strict=False):
        label = f"cut-off {cutoff:g}"
        styles[label] = GlyphStyle(label, color, width=1)
        nozzle = trial.samples.z[:, CHANNELS.index("cmd_nozzle"), None]
        paths[label] = torch.cat((trial.samples.target, nozzle), dim=1).numpy()[shown_samples]
    units = (*_ACCELERATION_ROWS, ("nozzle [deg]", DEGREES_PER_RADIAN))
    caption = (
        "Shares of the Nyquist frequency. A low one reacts before the inputs do and is too small."
    )
    t = np.arange(len(shown_samples)) * next(iter(trials.values())).step
    title = ("Accelerations by the filter's cut-off", caption)
    return plot_time_series(f"cutoffs_{name}", title, styles, t, paths, units, height=150)


def _most_turning_samples(trial: TrialSamples, mask: np.ndarray) -> np.ndarray:
    """Return the indices of the minute with the most turning, which shows most of the dynamics."""
    nozzle = trial.samples.z.numpy()[:, CHANNELS.index("cmd_nozzle")]
    segments = trial.contiguous_indices(np.broadcast_to(mask, nozzle.shape))
    segment = max(segments, key=lambda indices: float(np.abs(nozzle[indices]).sum()))
    return segment[: round(_EXCERPT_SECONDS / trial.step)]


def _parameters_figure(
    name: str, fits_by_set: Mapping[str, StudyResults], truth: Mapping[str, float]
) -> Figure:
    undetermined = next(iter(fits_by_set.values()))["undetermined"]
    shown_parameters = [
        i for i, name in enumerate(STANDARD_PARAMETER_NAMES) if name not in undetermined
    ]
    styles = {"zero": ZERO_LINE_STYLE}
    traces: dict[str, Curve] = {"zero": (np.zeros(1), np.zeros(1))}
    for set_index, (set_name, standard_fit) in enumerate(fits_by_set.items()):
        values, errors, true_values = (
            np.array(
                [parameter_values[STANDARD_PARAMETER_NAMES[i]] for i in shown_parameters],
                dtype=float,
            )
            for parameter_values in (standard_fit["values"], standard_fit["standard_errors"], truth)
        )
        error = (values - true_values) / SCALE[shown_parameters]
        double_error = 2 * errors / SCALE[shown_parameters]
        positions = np.arange(len(shown_parameters)) + 0.16 * (
            set_index - (len(fits_by_set) - 1) / 2
        )
        styles[set_name] = GlyphStyle(SET_NAMES[set_name], COLORS[set_index], kind="points", size=3)
        styles[f"{set_name} errors"] = GlyphStyle("", COLORS[set_index], width=1)
        traces[set_name] = (positions, error)
        traces[f"{set_name} errors"] = error_bars(
            positions, error - double_error, error + double_error
        )
    return Figure(
        f"parameters_{name}",
        "Parameters of the standard model",
        "Estimates less the true values, with two standard errors.",
        styles,
        [
            Panel(
                "estimate less truth, of a typical size",
                height=350,
                x_names=tick_labels(STANDARD_PARAMETER_NAMES[i] for i in shown_parameters),
            )
        ],
        [Case("", [traces])],
    )


def _excerpt_figure(
    name: str,
    trial: TrialSamples,
    models: Mapping[tuple[str, str], FittedAccelerations],
    set_name: str,
) -> Figure:
    mask = (
        trial.is_validation
        if set_name == ALL
        else trial.is_validation & (trial.phase == SPEED_REGIMES.index(set_name))
    )
    segment = _most_turning_samples(trial, mask)
    t = np.arange(len(segment)) * trial.step
    paths = {"measured": trial.samples.target.numpy()[segment]}
    styles = {"measured": MEASURED_STYLE}
    other_key = next((key for key in models if key[0] != STANDARD and key[1] == set_name), None)
    for key, style in (((STANDARD, set_name), DASHED_STYLE), (other_key, SOLID_STYLE)):
        if key is not None:
            label = f"{key[0]}, fitted on {SET_NAMES[set_name]}"
            styles[label] = replace(style, label=label)
            paths[label] = models[key].predicted[segment]
    caption = "Accelerations measured and predicted from measured velocities and inputs."
    title = f"Validation, {SET_NAMES[set_name]}"
    return plot_time_series(
        f"{set_name}_{name}", (title, caption), styles, t, paths, _ACCELERATION_ROWS, height=180
    )


def _best_rows(rows: Sequence[StudyResults]) -> dict[str, StudyResults]:
    axes = dict.fromkeys(row["axis"] for row in rows)
    return {
        axis: min(
            (row for row in rows if row["axis"] == axis and row["model"] != PLANT),
            key=lambda row: float(row["rmse"]),
        )
        for axis in axes
    }


def _trial_text(trial: StudyResults) -> str:
    phase_texts = [
        f"{100 * share:.0f} % in the {SET_NAMES[phase]}" for phase, share in trial["phases"].items()
    ]
    spread_texts = [
        f"{axis} {format_number(value)} {_UNITS[axis]}"
        for axis, value in trial["acceleration_std"].items()
    ]
    return (
        f"The trial lasts {trial['seconds'] / 60:.0f} minutes in {trial['logs']} logs, sampled at"
        f" {1 / trial['step']:.0f} Hz: {join_list(phase_texts)}. The standard deviations of the"
        f" accelerations are {join_list(spread_texts)}. {100 * trial['validation_share']:.0f} %"
        f" of the"
        " stretches validate."
    )


def _goodness_table(
    set_name: str, rows: Sequence[StudyResults], published_values: Mapping[str, Published]
) -> Table:
    """Return the goodness of fit of all models on one set (Tables 7.3 to 7.5)."""
    names = ("rmse", "cp", "r2_adjusted", "mae", "low", "high")
    shown_rows = []
    for row in rows:
        # the document fits its standard model to the phase, and its equations to all samples
        is_published_set = row["on"] == (set_name if row["model"] == STANDARD else ALL)
        published_row = (
            published_values.get(row["model"], {}).get(row["axis"], ()) if is_published_set else ()
        )
        shown_rows.append({**row, "published": dict(zip(names, published_row, strict=False))})

    def interval_as_printed(row: StudyResults) -> Cell:
        published_row = row["published"]
        note = (
            f"published {format_interval([published_row['low'], published_row['high']])}"
            if "low" in published_row
            else ""
        )
        return Cell(format_interval(row["mae_ci95_independent"]), note)

    def fitted_to(row: StudyResults) -> str:
        return DASH if row["model"] == PLANT else row["on"].replace("_", "-")

    return build_table(
        shown_rows,
        [
            ("model", "model"),
            ("acceleration", "axis"),
            ("fitted to", fitted_to),
            ("parameters", "parameters", 0),
            *comparison_columns("rmse", "RMSE", 3),
            *comparison_columns("cp", "C_p", 3),
            *comparison_columns("r2_adjusted", "adjusted R^2", 3),
            *comparison_columns("mae", "mean abs. residual", 3),
            ("95 %, blocks", "mae_ci95", format_interval),
            ("95 %, as printed", interval_as_printed),
        ],
        caption="Published figures are those of the real vessel. Intervals are of the mean absolute"
        " residual; those by moving blocks account for its correlation in time (correction E8).",
    )


def _parameter_table(trial: StudyResults) -> Table:
    fits_by_set = trial["standard"]
    published_parameters = load_published("halvorsen2019")
    columns = ["parameter", "true", *map(SET_NAMES.__getitem__, fits_by_set)]
    table = Table(
        [*columns, "published before", "published after"], caption="SI units, with standard errors."
    )

    def with_error(value: float, error: float | None) -> Cell:
        if error == 0.0:
            return Cell(format_number(value, 5), "at its bound", mark="weak")
        return Cell(format_number(value, 5), f"± {format_number(error, 2)}")

    def estimate(fit: StudyResults, name: str) -> Cell:
        value = fit["values"][name]
        if name in fit["undetermined"]:
            return Cell(format_number(value, 4), "not determined", mark="weak")
        if name in fit["at_bound"]:
            return Cell(format_number(value), "at its bound", mark="weak")
        return with_error(value, fit["standard_errors"][name])

    for name in STANDARD_PARAMETER_NAMES:
        estimates = [estimate(fit, name) for fit in fits_by_set.values()]
        published_cells = (
            format_number(published_parameters["start"][name], 5),
            format_number(published_parameters["fitted"].get(name), 4),
        )
        table.add_row(name, [format_number(trial["truth"][name], 5), *estimates, *published_cells])
    for name in INERTIA_SUMS:
        inertias = [with_error(*fit["sums"][name]) for fit in fits_by_set.values()]
        table.add_row(name, [format_number(trial["true_sums"][name], 5), *inertias, "", ""])
    return table


def _identifiability_notes(trial: StudyResults) -> list[str]:
    notes = []
    for set_name, standard_fit in trial["standard"].items():
        costs = standard_fit["cost"]
        n_same_cost = sum(cost <= costs[0] * (1 + _SAME_COST) for cost in costs)
        determined_text = (
            f"only combinations of {join_list(standard_fit['undetermined'])} are determined"
            if standard_fit["undetermined"]
            else "every parameter is determined"
        )
        notes.append(
            f"In the {SET_NAMES[set_name]}, {determined_text}; the condition number of the rest is"
            f" {format_number(standard_fit['condition'], 2)}. {n_same_cost} of {len(costs)}"
            f" starting points end at the"
            " least error."
        )
    return [
        *notes,
        "The standard errors account for variance and correlation of the residuals. They do not"
        " account for bias due to the filter, the waves or a wrong model structure.",
    ]
