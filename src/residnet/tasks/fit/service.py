"""Operations on a finished fit: monitoring of new logs, recursive refit, planning of trials."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import yaml

from residnet.core.config import dump_config, validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import atomic_write
from residnet.core.format import format_count, format_fixed, format_number
from residnet.core.layout import SIX_DOF_LAYOUT
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import suggest_name
from residnet.core.ownership import record_folder
from residnet.core.progress import log_message
from residnet.evaluation.data_records import ExcitationFile
from residnet.evaluation.metrics_file import find_row
from residnet.evaluation.verdict import advise_intermediate_steps
from residnet.identification.identified import evaluate_splits, make_candidates
from residnet.identification.monitoring import (
    ChangeDetector,
    MonitorConfig,
    MonitorVerdict,
    OnlineChangeDetector,
)
from residnet.identification.planning import (
    PredictionGoal,
    TrialLimits,
    TrialPlan,
    infer_input_shares,
    plan_trials,
)
from residnet.identification.prepared import (
    check_window_fits,
    convert_to_motion_through_water,
    prepare_splits,
)
from residnet.identification.recursive_refit import (
    RecursiveRefit,
    make_refitted_model,
    refit_recursively,
)
from residnet.preprocessing.samples import make_samples
from residnet.preprocessing.windows import WindowStore
from residnet.report.blocks import Section, Table, build_table, flag_cell
from residnet.report.figure import (
    DASHED_STYLE,
    MAX_PREVIEW_HEIGHT,
    SOLID_STYLE,
    ZERO_LINE_STYLE,
    Case,
    Figure,
    Panel,
    style_family,
)
from residnet.report.figure_files import write_figure
from residnet.report.page import write_page
from residnet.report.records import (
    MonitoredLogRow,
    ParameterChangeRow,
    RefitRow,
    RefitSummary,
    SuspectRow,
)
from residnet.runs.folder import Provenance, RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import TaskOutcome
from residnet.tasks.fit.outcome import (
    EXTERNAL_SPLIT,
    build_fit_outcome,
    divergence_limit,
    read_external_logs,
    write_evaluation,
)
from residnet.training.left_out import estimate_refit_covariance

if TYPE_CHECKING:
    from residnet.tasks.fit.config import FitConfig

_MAX_NAMED_CAUSES = 3
"""Maximum number of hypotheses in the text output."""
_HOLD_OUT_RATIO = 3
"""One log in this many is held out to evaluate a refit; the last logs are taken."""
_MAX_SHOWN_TRIALS = 12
"""Maximum number of candidate trials in the table."""


@dataclass(frozen=True)
class MonitoredLog:
    """Result of monitoring one log.

    Attributes:
        name: name of the log.
        alarm_time: time in s from the start of the log to the first alarm; None without alarm.
        final_verdict: verdict at the end of the log.
        window_seconds: length of the windows in s.
        scores: largest score of all hypotheses after each window.
    """

    name: str
    alarm_time: float | None
    final_verdict: MonitorVerdict
    window_seconds: float
    scores: Sequence[float]

    @property
    def n_windows(self) -> int:
        """Number of windows of the log that the monitor has tested."""
        return len(self.scores)

    def to_record(self) -> MonitoredLogRow:
        """Return the entry of monitor.json."""
        return MonitoredLogRow(
            log=self.name,
            windows=self.n_windows,
            alarm_after=self.alarm_time,
            threshold=self.final_verdict.threshold,
            innovation=self.final_verdict.innovation_rms,
            suspects=tuple(
                SuspectRow(
                    cause=suspect.change.name,
                    score=suspect.test_statistic,
                    size=suspect.estimated_size,
                    standard_error=suspect.standard_error,
                    unit=suspect.change.unit,
                    explains=suspect.score_reduction,
                )
                for suspect in self.final_verdict.hypotheses
            ),
        )

    def to_lines(self) -> list[str]:
        """Return alarm and most likely causes as lines for the terminal."""
        alarm_text = (
            "no alarm" if self.alarm_time is None else f"ALARM after {self.alarm_time:.0f} s"
        )
        suspects = self.final_verdict.hypotheses[
            : _MAX_NAMED_CAUSES if self.alarm_time is not None else 1
        ]
        return [f"{self.name}: {alarm_text} ({self.n_windows} windows)"] + [
            f"  {suspect.change.name}: score {suspect.test_statistic:.1f} of"
            f" {self.final_verdict.threshold:.1f},"
            f" size {suspect.estimated_size:+.3g} +- {suspect.standard_error:.2g}"
            f" {suspect.change.unit}"
            f" (the logs look as if {suspect.change.description})"
            for suspect in suspects
        ]


class FittedModelMonitor:
    """A fitted model with its change detector and the new logs to be monitored.

    Args:
        config: config of the fit.
        run: folder of the fit.
        log_paths: new logs, in chronological order.
        model: name of the model; `selected` for the model chosen on validation data.
        settings: keys of `MonitorConfig`.

    Raises:
        UsageError: if there is no such model or path.
        DataError: if a log cannot be used, or there are too few reference logs.
    """

    def __init__(
        self,
        config: FitConfig,
        run: RunFolder,
        log_paths: Sequence[Path],
        model: str,
        settings: Mapping[str, Any],
    ) -> None:
        monitor_config = validate_config(dict(settings), MonitorConfig, "monitor")
        store = RunModelStore(run)
        name = run.read_metrics().selected if model == "selected" else model
        if name not in store.names():
            valid_names = ["selected", *store.names()]
            raise UsageError(f"{run.path}: no model '{name}'{suggest_name(name, valid_names)}")
        self.config = config
        self.run = run
        self.fitted_model = store.load(name)
        self.input_paths, _, self.logs = read_external_logs(config, log_paths)
        # the reference logs contain velocities over ground, as do the new logs; the detector
        # removes the current from both
        reference_splits = prepare_splits(config.load_logs(), config)
        reference_logs = [*reference_splits["train"], *reference_splits["validation"]]
        self.detector = ChangeDetector.from_logs(
            self.fitted_model.spec, self.fitted_model.model, reference_logs, monitor_config
        )

    def monitor_logs(self) -> list[MonitoredLog]:
        """Monitor the logs one after the other; the score statistics continue between logs.

        Raises:
            DataError: if a log contains no window.
        """
        online_detector = OnlineChangeDetector(self.detector)
        monitored = []
        for log in self.logs:
            windows = self.detector.make_windows(log)
            online_detector.start_new_log()
            verdicts = [
                online_detector.update_with_sums(score_sums)
                for score_sums in self.detector.compute_sums(windows)
            ]
            alarm_windows = np.flatnonzero([verdict.is_alarm for verdict in verdicts])
            alarm_time = (
                (int(alarm_windows[0]) + 1) * self.detector.config.window
                if alarm_windows.size
                else None
            )
            scores = [verdict.max_score for verdict in verdicts]
            window_seconds = self.detector.config.window
            monitored.append(
                MonitoredLog(log.log.name, alarm_time, verdicts[-1], window_seconds, scores)
            )
        return monitored


def write_monitoring_page(folder: Path, logs: Sequence[MonitoredLog]) -> Path:
    """Write the monitoring page with the alarms and the scores over time; returns the page.

    Args:
        folder: folder of the page.
        logs: results in chronological order.
    """
    window_minutes = logs[0].window_seconds / 60.0
    logs_with_alarm = [log for log in logs if log.alarm_time is not None]
    summary = [
        f"No alarm in {format_count(len(logs), 'log')}: the innovations are like those of the"
        f" reference logs."
    ]
    if logs_with_alarm:
        likeliest_change = logs_with_alarm[-1].final_verdict.hypotheses[0].change
        summary = [
            f"ALARM in {len(logs_with_alarm)} of {format_count(len(logs), 'log')}: as if"
            f" {likeliest_change.description}.",
            "Other causes may have similar effects: see the scores of all causes.",
        ]
    log_end_times = window_minutes * np.cumsum([log.n_windows for log in logs])
    scores = np.concatenate([log.scores for log in logs])
    threshold = logs[0].final_verdict.threshold
    score_curves = {
        "score": (window_minutes * (1.0 + np.arange(len(scores))), scores),
        "threshold": (np.zeros(1), np.array([threshold])),
        "logs": (log_end_times, log_end_times),
    }
    figure = Figure(
        "scores",
        "Largest score over time",
        "Largest score of all causes after each window; a score above the threshold is an alarm.",
        {
            "score": replace(SOLID_STYLE, label="largest score"),
            "threshold": replace(DASHED_STYLE, label="threshold", kind="hline"),
            "logs": replace(ZERO_LINE_STYLE, label="end of a log", kind="vline", dash="dotted"),
        },
        [Panel("score [-]", "time of the logs [min]", height=MAX_PREVIEW_HEIGHT)],
        [Case("", [score_curves])],
    )
    overview = build_table(
        logs,
        [
            ("log", lambda log: log.name),
            (
                "alarm",
                lambda log: flag_cell(
                    "no" if log.alarm_time is None else f"after {log.alarm_time:.0f} s",
                    log.alarm_time,
                ),
            ),
            ("likeliest cause", lambda log: log.final_verdict.hypotheses[0].change.name),
            (
                "score",
                lambda log: format_number(log.final_verdict.hypotheses[0].test_statistic),
                str,
            ),
        ],
        is_selected=lambda log: log.alarm_time is not None,
    )
    suspects = build_table(
        [(log, suspect) for log in logs for suspect in log.final_verdict.hypotheses],
        [
            ("log", lambda row: row[0].name),
            ("cause", lambda row: row[1].change.name),
            ("score", lambda row: format_number(row[1].test_statistic), str),
            (
                "size",
                lambda row: f"{format_number(row[1].estimated_size)} {row[1].change.unit}",
                str,
            ),
            ("standard error", lambda row: format_number(row[1].standard_error, 2), str),
            ("the logs look as if", lambda row: row[1].change.description),
        ],
        group_key=lambda row: row[0].name,
    )
    return write_page(
        folder,
        "Monitoring of new logs",
        f"{format_count(len(scores), 'window')} of {logs[0].window_seconds:g} s, threshold"
        f" {format_number(threshold)}",
        summary,
        [
            # the first picture of a page needs no JavaScript
            Section("", [figure.preview(), overview]),
            Section("Scores over time", [write_figure(folder / "figures", figure)]),
            Section("Every cause, at the end of each log", [suspects], is_folded=True),
        ],
    )


@dataclass(frozen=True)
class RefitResult:
    """Result of a recursive refit, evaluated on held-out logs.

    Attributes:
        recursive_refit: identified changes of the model.
        folder: folder of the new run; None if no change was identified.
        old_error: mean free-run error (NRMSE) of the old model on the held-out logs.
        new_error: mean free-run error (NRMSE) of the new model on the held-out logs.
        is_better: whether the new model is significantly better, by the 95 % confidence interval of
            the paired differences.
    """

    recursive_refit: RecursiveRefit
    folder: Path | None = None
    old_error: float = float("nan")
    new_error: float = float("nan")
    is_better: bool = False

    def to_lines(self) -> list[str]:
        """Return changes, reason of the end and errors before and after, one line each."""
        lines = [
            f"refit: {changed_parameter.change.name} {changed_parameter.estimated_size:+.3g} +-"
            f" {changed_parameter.standard_error:.2g} {changed_parameter.change.unit}, after"
            f" each log {', '.join(f'{size:+.3g}' for size in changed_parameter.size_by_log)}"
            for changed_parameter in self.recursive_refit.identified_changes
        ]
        lines.append(f"refit: ended because {self.recursive_refit.stopping_reason}")
        if self.folder is None:
            return [*lines, "refit: no change was identified; no model was written"]
        error_text = f"old {self.old_error:.4f}, new {self.new_error:.4f} (mean NRMSE of free runs)"
        conclusion = (
            f"the new model is significantly better and selected in {self.folder}"
            if self.is_better
            else "the new model is NOT significantly better; the old model is selected in"
            f" {self.folder}"
        )
        return [*lines, f"refit: held-out logs: {error_text}", f"refit: {conclusion}"]

    def to_record(self) -> RefitRow:
        """Return the entry of monitor.json."""
        has_run = self.folder is not None
        summary = RefitSummary(
            changes=tuple(
                ParameterChangeRow(
                    cause=changed_parameter.change.name,
                    size=changed_parameter.estimated_size,
                    standard_error=changed_parameter.standard_error,
                    unit=changed_parameter.change.unit,
                    after_each_log=tuple(changed_parameter.size_by_log),
                )
                for changed_parameter in self.recursive_refit.identified_changes
            ),
            ended=self.recursive_refit.stopping_reason,
            run=str(self.folder) if has_run else None,
            nrmse_old=self.old_error if has_run else None,
            nrmse_new=self.new_error if has_run else None,
            worth_taking=self.is_better,
        )
        return RefitRow(refit=summary)


def require_refit_folder(run: RunFolder, output_folder: Path, config: FitConfig) -> None:
    """Check that the folder of a refit can be written, before any work.

    Raises:
        UsageError: if the folder exists, or lies in the folder of the fit.
    """
    if output_folder.resolve().is_relative_to(run.path.resolve()):
        raise UsageError(
            f"{output_folder}: lies in the run {run.path}, which a refit does not change; choose"
            f" another"
            " folder for --refit"
        )
    RunFolder(output_folder).require_usable(dump_config(config))


def run_refit(monitor: FittedModelMonitor, output_folder: Path) -> RefitResult:
    """Refit a model on the first two thirds of the new logs, and evaluate it on the others.

    The new run contains `constant_velocity`, the old model under its name, and the new model as
    `<name>_refit`.

    Args:
        monitor: the model, its change detector and the new logs.
        output_folder: folder of the new run.

    Raises:
        UsageError: if the folder may not be used, or the model has no parameters to change.
        DataError: if there are fewer than two logs, or a log is too short.
    """
    config = monitor.config
    original_model = monitor.fitted_model
    if len(monitor.logs) < 2:
        raise DataError(
            "a refit needs at least two new logs, because the last ones are held out to evaluate"
            " it; give more --logs, or cut the log into several"
        )
    for log in monitor.logs:
        check_window_fits(log, config)
    # the last logs are held out: a refit must predict later logs than it was fitted to
    n_held_out = max(len(monitor.logs) // _HOLD_OUT_RATIO, 1)
    training_logs = monitor.logs[:-n_held_out]
    held_out_logs = monitor.logs[-n_held_out:]
    log_message(
        f"recursive refit of {original_model.name} on {len(training_logs)} logs, {n_held_out}"
        f" held out"
    )
    recursive_result = refit_recursively(
        monitor.detector, [monitor.detector.make_windows(log) for log in training_logs]
    )
    if not recursive_result.identified_changes:
        return RefitResult(recursive_result)
    refitted_model = make_refitted_model(original_model, recursive_result)
    provenance = Provenance(
        monitor.run.resolved_config, (), config.seed, monitor.input_paths, time.time()
    )
    result = RefitResult(recursive_result, output_folder)

    def evaluate_refit(folder: RunFolder) -> TaskOutcome:
        """Store old and new models, evaluate both on the held-out logs and select the better."""
        nonlocal result
        store = RunModelStore(folder)
        models = monitor.run.models
        reference_names = [
            name
            for name in dict.fromkeys((CONSTANT_VELOCITY, original_model.name))
            if (models / name).is_dir()
        ]
        for name in reference_names:
            shutil.copytree(models / name, folder.models / name)
        store.save(refitted_model)
        # the new model is compared with the old one window by window
        evaluations = evaluate_splits(
            [
                replace(candidate_model, reference=original_model.name)
                if candidate_model.name == refitted_model.name
                else candidate_model
                for candidate_model in make_candidates(
                    [store.load(name) for name in (*reference_names, refitted_model.name)]
                )
            ],
            {EXTERNAL_SPLIT: held_out_logs},
            config.evaluation,
            config.prepare.grid.step,
            divergence_limit(original_model.spec, config),
        )
        rows = [
            row
            for row in evaluations[EXTERNAL_SPLIT].rows
            if row.protocol == config.evaluation.selection
        ]
        refitted_row = find_row(rows, model=refitted_model.name)
        difference = refitted_row.difference
        assert difference is not None, "the original model is the reference of the refitted one"
        # too few logs give no confidence interval: then the mean difference decides
        upper_bound = difference.nrmse_mean if difference.ci95 is None else difference.ci95[1]
        is_better = refitted_row.diverged == 0 and upper_bound < 0.0
        result = replace(
            result,
            old_error=find_row(rows, model=original_model.name).mean_nrmse,
            new_error=refitted_row.mean_nrmse,
            is_better=is_better,
        )
        selected_name = refitted_model.name if is_better else original_model.name
        write_evaluation(
            folder,
            config,
            evaluations,
            (selected_name, None, selected_name),
            {EXTERNAL_SPLIT: held_out_logs},
        )
        changes = [
            f"{change['cause']} {change['size']:+.3g}"
            for change in refitted_model.notes["refit_changes"]
        ]
        effect = "significantly reduces" if is_better else "does not significantly reduce"
        sentence = (
            f"The recursive refit ({', '.join(changes)}) {effect} the free-run error on the"
            " held-out logs."
        )
        outcome = build_fit_outcome(folder, EXTERNAL_SPLIT)
        return replace(outcome, verdict=[*outcome.verdict, sentence])

    with RunFolder(output_folder).lock():
        config.run_in_folder(
            RunFolder.create(output_folder, dump_config(config)), provenance, evaluate_refit
        )
    return result


@dataclass(frozen=True)
class NextTrials:
    """Planned trials for a refitted baseline.

    Attributes:
        model: name of the refitted baseline.
        plan: candidate and selected trials.
        missing_excitation: for each input or combination of two inputs that the training logs do
            not excite, a sentence on the trial that would excite it.
    """

    model: str
    plan: TrialPlan
    missing_excitation: tuple[str, ...] = ()

    @property
    def table(self) -> Table:
        """Candidates in the order of information per minute; selected trials are marked."""
        return build_table(
            self.plan.candidates[:_MAX_SHOWN_TRIALS],
            [
                ("manoeuvre", lambda trial: trial.simulated_run.true_log.name),
                ("time [min]", lambda trial: format_fixed(trial.duration_minutes, 1), str),
                ("reach [m]", lambda trial: format_fixed(trial.max_distance, 0), str),
                (
                    "narrower by [%]",
                    lambda trial: format_fixed(100 * trial.uncertainty_reduction, 1),
                    str,
                ),
                (
                    "volume per minute",
                    lambda trial: format_fixed(trial.volume_gain_per_minute, 2),
                    str,
                ),
            ],
            caption=f"Candidate trials for {self.model}, in the order of information per minute.",
            is_selected=lambda trial: any(
                trial is selected_trial for selected_trial in self.plan.selected_trials
            ),
        )

    @property
    def recommendation(self) -> str:
        """Sentence with the selected trials and the expected reduction of the prediction
        intervals.
        """
        names = ", ".join(trial.simulated_run.true_log.name for trial in self.plan.selected_trials)
        return (
            f"Run {names}: the model expects that together they narrow the prediction intervals by"
            f" {100 * self.plan.uncertainty_reduction:.0f} %."
        )

    def to_text(self) -> str:
        """Return the table, the recommendation and the missing excitation as text."""
        return "\n".join((self.table.to_text(), self.recommendation, *self.missing_excitation))

    def write_files(self, folder: Path) -> list[Path]:
        """Write the selected manoeuvres as YAML, tracks as CSV, and a page; returns the files."""
        with record_folder(folder):
            return self._write(folder)

    def _write(self, folder: Path) -> list[Path]:
        """Write the trials as YAML, their tracks as CSV, and a page; return the three files."""
        trials = folder / "next_trials.yaml"
        tracks = folder / "next_tracks.csv"
        simulated_runs = [trial.simulated_run for trial in self.plan.selected_trials]
        chosen = [run.manoeuvre.model_dump(mode="json") for run in simulated_runs]
        states = [
            name
            for name in SIX_DOF_LAYOUT.state_names
            if name in simulated_runs[0].true_log.channels
        ]
        lines = [",".join(("manoeuvre", "t", *states))]
        for motion in (run.true_log for run in simulated_runs):
            # one row of the file per second
            stride = max(round(1.0 / float(motion.t[1] - motion.t[0])), 1)
            rows = np.column_stack((motion.t, motion.stack(states)))
            lines += [
                ",".join([motion.name, *(f"{value:.6g}" for value in row)])
                for row in rows[::stride]
            ]
        with atomic_write(trials) as file:
            file.write_text(yaml.safe_dump({"manoeuvres": chosen}, sort_keys=False))
        with atomic_write(tracks) as file:
            file.write_text("\n".join(lines) + "\n")
        curves = {
            motion.name: (motion["y"] - motion["y"][0], motion["x"] - motion["x"][0])
            for motion in (run.true_log for run in simulated_runs)
        }
        panel = Panel("north [m]", "east [m]", kind="map", height=300)
        figure = Figure(
            "tracks",
            "Tracks of the next trials",
            "Simulated by the model.",
            style_family(curves),
            [panel],
            [Case("", [curves])],
        )
        # the first picture of a page needs no JavaScript
        shown = Section("", [figure.preview(), self.table.select_columns(0, 3)])
        track_section = Section("Tracks", [write_figure(folder / "figures", figure)])
        table = Section("Candidates", [self.table], is_folded=True)
        about = f"Trials that best reduce the uncertainty of the model {self.model}"
        summary = [self.recommendation, *self.missing_excitation]
        page = write_page(folder, "Next trials", about, summary, [shown, track_section, table])
        return [trials, tracks, page]


def plan_next_trials(
    config: FitConfig, run: RunFolder, model: str, limits: Mapping[str, Any]
) -> NextTrials:
    """Plan the most informative trials for a refitted baseline; see `FitConfig.plan_trial`."""
    trial_limits = validate_config(dict(limits), TrialLimits, "plan-trial")
    refitted_names = [name for name in config.refit if "refit" in run.read_fit_notes(name)]
    if not refitted_names:
        raise UsageError(
            f"{run.path}: no baseline of this run was refitted through rollouts, so nothing says"
            " how sure its parameters are; add `refit` to the config"
        )
    manoeuvring_booklet = config.booklet
    name = model or (
        manoeuvring_booklet.model if manoeuvring_booklet is not None else refitted_names[0]
    )
    if name not in refitted_names:
        raise UsageError(
            f"{run.path}: no refitted baseline '{name}'{suggest_name(name, refitted_names)}"
        )
    logs, _ = convert_to_motion_through_water(prepare_splits(config.load_logs(), config), config)
    fitted_model = RunModelStore(run).load(name)
    training_logs = logs["train"]
    refit = config.refit[name]
    # the notes of the fit contain the weight of the prior that the refit used
    refit = refit.with_prior(float(fitted_model.notes.get("prior", refit.prior)))
    scales = config.evaluation.scales.to_array()
    refit_uncertainty = estimate_refit_covariance(
        fitted_model.model.double(),
        make_samples(training_logs, config.signals.build()),
        WindowStore.from_logs(training_logs, torch.float64),
        refit,
        torch.from_numpy(scales),
        fitted_model.notes["refit"].get("at_rest", ()),
    )
    divergence_bounds = divergence_limit(fitted_model.spec, config)
    goal = None
    # the mapping from propulsion and steering command of a manoeuvre to the inputs of the model
    if manoeuvring_booklet is None:
        input_shares = infer_input_shares(fitted_model.spec)
    else:
        initial = {key: float(value) for key, value in manoeuvring_booklet.initial.items()}
        # manoeuvres of one kind are simulated in one batch
        manoeuvres = sorted(manoeuvring_booklet.manoeuvres, key=lambda manoeuvre: manoeuvre.kind)
        goal = PredictionGoal(manoeuvres, manoeuvring_booklet.duration, initial)
        input_shares = manoeuvring_booklet.inputs
    return NextTrials(
        name,
        plan_trials(
            fitted_model,
            refit_uncertainty,
            refit,
            scales,
            input_shares,
            divergence_bounds,
            trial_limits,
            goal,
        ),
        advise_excitation(
            run.read_excitation(),
            [name for name in input_shares if input_shares[name].steer],
        ),
    )


def advise_excitation(
    excitation: ExcitationFile | None, steering_inputs: Sequence[str]
) -> tuple[str, ...]:
    """Return a sentence for each input or pair of inputs that the logs do not excite enough.

    Args:
        excitation: contents of excitation.json; None if the run has no such file.
        steering_inputs: names of the inputs that steer.
    """
    if excitation is None:
        return ()
    sentences = []
    for row in excitation.inputs:
        if row.state == "excited":
            continue
        manoeuvre = (
            "a zigzag, a 3-2-1-1 or random steps in open loop"
            if row.name in steering_inputs
            else "steps between at least three levels"
        )
        sentences.append(f"Not excited: {row.text}; run {manoeuvre} of {row.name}.")
    sentences += [
        f"{name} only switches between the ends of its range;"
        f" run {advise_intermediate_steps(name)}."
        for name in excitation.relay_inputs
    ]
    for direction in excitation.directions:
        if not direction.is_excited:
            first, second = direction.inputs
            sentences.append(
                f"Not excited: {direction.name}; run steps of {first} and {second} independent of"
                " each other."
            )
    return tuple(sentences)
