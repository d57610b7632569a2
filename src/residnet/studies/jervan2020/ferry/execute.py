"""Task `ferry_study`: residual models of a ferry in closed loop (Jervan 2020, chapter 4).

The plant follows a course under a controller with a believed model. Residual models are identified
from this run, and the course is repeated with them as feed-forward.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from residnet.autopilot.evaluation import TrackingMetrics, mean_squares_by_axis
from residnet.autopilot.guidance import CrossingConfig
from residnet.autopilot.motion_config import ReferenceFilterConfig
from residnet.baselines.given_config import BelievedConfig, HullEquations
from residnet.core.errors import ConfigError, FitError, UsageError
from residnet.core.files import read_json
from residnet.core.format import DEGREES_PER_RADIAN, format_number
from residnet.core.frames import wrap_angle
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, POSITION, VELOCITIES
from residnet.core.names import FORCE_CHANNELS, STATE_NAMES, suggest_name
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.rollout import Rollout
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.heads.base import ZeroHead
from residnet.manoeuvres.closed_loop import ZigzagFamily
from residnet.manoeuvres.trials import simulate_trials
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.force_model import ForceCorrection, ForceModel
from residnet.physics.signals_config import SignalsConfig
from residnet.report.blocks import Block, Cell, Section, Table, build_table
from residnet.report.figure import DASHED_STYLE, SOLID_STYLE, Case, Figure, Panel, style_family
from residnet.runs.folder import RunFolder
from residnet.runs.task import ExportRequest, ExportWriters, SummaryMetric
from residnet.studies.jervan2020.ferry.config import (
    BELIEVED_NAME,
    FerryModelConfig,
    FerryStudyConfig,
)
from residnet.studies.jervan2020.ferry.judging import ExportedFeedForward, draw_judging_courses
from residnet.studies.jervan2020.ferry_loop import (
    FeedForwardModel,
    FerryRun,
    FerrySimulation,
    MotionNoise,
    load_force_vessel,
)
from residnet.studies.jervan2020.residual import (
    AXES,
    ForceRecord,
    ResidualForceModel,
    derive_forward_equations,
    exact_residual_coefficients,
    fit_model,
    fit_to_json,
    model_figures,
    model_sections,
    refit_with_settings,
    to_baseline_yaml,
)
from residnet.studies.study import (
    StudyExecutor,
    StudyResults,
    comparison_columns,
    find_figures,
    format_notes,
    join_numbers,
)

# a model is invalid on an axis if it exceeds the first two limits in this share of the segments
_MAX_RESIDUAL_GROWTH = 4.0
"""Largest ratio of the mean square residual to that of the log of the identification."""
_MIN_VARIANCE_SHARE = 0.02
"""Mean square residual, as a share of the variance of the force, below which it is negligible."""
_MIN_SEGMENT_SHARE = 0.5
"""Share of segments, so that a single event such as a gust or a wake does not count."""
_DIVERGENCE_FACTOR = 3.0
"""A free run has diverged above this multiple of the largest velocities of the true ferry."""


_FREE_RUN_TRIALS: Mapping[str, Any] = {
    "trials": (
        ZigzagFamily(count=6, drive=(0.03, 0.07), steer=(0.01, 0.03), heading=(0.17, 0.35)),
    ),
    "duration": 60.0,
    "step": 0.1,
    "seed": 0,
    "identification": {},
    "validation": {},
}
"""Manoeuvres of the plant for the free runs of the models."""


@final
class FerryExecutor(StudyExecutor[FerryStudyConfig]):
    """Identify residual models of a ferry and repeat its course with them as feed-forward."""

    def compute_results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        return write_results(self.config, run_ferry_study(self.config), folder)

    def export_writers(self, folder: RunFolder) -> ExportWriters:
        return {
            name: partial(self.config.export_model, ExportRequest(folder, name))
            for name in self.config.models
        }

    def summarize(self, results: StudyResults) -> list[str]:
        models = results["models"]
        best_name = find_best_model(results)
        remaining_text = join_numbers([100 * share for share in models[best_name]["share_left"]])
        sentences = [
            f"Of {len(models)} residual models, {best_name} has the smallest residual force on the"
            f" unseen half of the course: {remaining_text} % of the mean square of the believed"
            f" model's residual in surge, sway and yaw."
        ]
        judging = results["judging"]
        best_flown = find_best_flown_model(results)
        sentences.append(
            f"On {len(judging[BELIEVED_NAME]['courses'])} validation courses the exported"
            f" feed-forward of {best_flown} has the smallest mean position error:"
            f" {_error_text(judging[best_flown])}; the believed model's is"
            f" {_error_text(judging[BELIEVED_NAME])}."
        )
        for run_kind in ("course", "crossing"):
            position_errors = {name: run["position_mae"] for name, run in results[run_kind].items()}
            believed_error = position_errors.pop(BELIEVED_NAME, None)
            if position_errors:
                closest_model = min(position_errors, key=position_errors.__getitem__)
                change_text = (
                    "decreases"
                    if position_errors[closest_model] < believed_error
                    else "does NOT decrease: it changes"
                )
                sentences.append(
                    f"With {closest_model} as feed-forward, the mean position error in the"
                    f" {run_kind} {change_text}"
                    f" from {format_number(believed_error)} m to"
                    f" {format_number(position_errors[closest_model])} m."
                )
        return sentences + [
            f"On the changed vessel, {name} {update['text']}."
            for name, update in results["later"].items()
        ]

    def main_figures(self, results: StudyResults) -> dict[str, SummaryMetric]:
        best_name = find_best_model(results)
        shares = zip(AXES, results["models"][best_name]["share_left"], strict=True)
        return (
            {
                f"residual left by {best_name}, {axis}": SummaryMetric(share)
                for axis, share in shares
            }
            | {
                f"mean position error on the validation courses with {name}": SummaryMetric(
                    run["position_mae"], "m"
                )
                for name, run in results["judging"].items()
                if run["position_mae"] is not None
            }
            | {
                f"mean position error on the course with {name}": SummaryMetric(
                    run["position_mae"], "m"
                )
                for name, run in results["course"].items()
            }
        )

    def build_sections(self, results: StudyResults, run: Path) -> list[Section]:
        residual_table = _residual_table(self.config, results)
        run_pictures = [
            picture.preview() for picture in find_figures(run, "errors_course", "errors_crossing")
        ]
        sections_written = [
            Section("", [*run_pictures[:1], residual_table.select_columns(3, 6)]),
            Section("Residual force on the unseen half", [residual_table]),
            Section("Validation courses", [_judging_table(results)]),
        ]
        for run_kind, title in (
            ("course", "Course in closed loop"),
            ("crossing", "Operational crossing"),
            ("feed_forward_alone", "Feed-forward without feedback"),
        ):
            if results[run_kind]:
                run_pictures = find_figures(run, f"errors_{run_kind}", f"forces_{run_kind}")
                sections_written.append(
                    Section(
                        title,
                        [
                            *_tracking_tables(self.config, results[run_kind], run_kind),
                            *run_pictures,
                        ],
                    )
                )
        if results["later"]:
            sections_written.append(
                Section("The changed vessel", [_update_table(results["later"])])
            )
        sections_written.append(Section("Forward in time", [_free_run_table(results["forward"])]))
        # Table 4.11
        comparisons = {
            name: {
                "true": {} if model.on else results["true_coefficients"],
                "published": model.published.coefficients,
            }
            for name, model in self.config.models.items()
        }
        return sections_written + model_sections(
            "Coefficients", results["models"], run, "notes", comparisons
        )


def export_model(config: FerryStudyConfig, request: ExportRequest) -> Path:
    """Write the feed-forward of a model; `selected` has the smallest error in judging runs.

    Raises:
        UsageError: if the run has no such model or no judging flights.
    """
    run = request.run
    results = read_json(request.run.path / config.results_file)
    if "judging" not in results:
        raise UsageError(
            f"{run.path}: {config.results_file} has no simulations of validation courses (key"
            " 'judging'); it is from an earlier version, so run the study again"
        )
    name = find_best_flown_model(results) if request.model == "selected" else request.model
    if name not in config.models:
        raise UsageError(f"{run.path}: no model '{name}'{suggest_name(name, config.models)}")
    chain = [name]
    while base_name := config.models[chain[0]].on:
        chain.insert(0, base_name)
    chain_rows = [results["models"][name_in_chain]["exported"] for name_in_chain in chain]
    force = ForceModel(load_force_vessel(config.believed)[0].hull)
    for row in chain_rows:
        tensors = (torch.tensor(row[key]).double() for key in ("coefficients", "intercept"))
        force = force.with_correction(ForceCorrection(row["terms"], *tensors))
    ranges = [(lower, upper) for lower, upper in chain_rows[-1]["range"]]
    required_force = RequiredForce(*force.split_corrections(), is_mirrored=True)
    exported = ExportedForce(name, required_force, ranges, chain_rows[-1]["notes"].get("lag"))
    return request.write(
        exported, list_feed_forward_objections(name, results), f"{name}_feed_forward"
    )


def compare_residuals(
    accepted_residual: Tensor, new_residual: Tensor, force: Tensor, fold: Tensor
) -> dict[str, Any]:
    """Return whether a model is still valid, by comparing residuals.

    Args:
        accepted_residual: residual on the data of the model's acceptance [N, 3].
        new_residual: residual on new data [M, 3].
        force: force of the new data [M, 3].
        fold: segment of each new sample [M].

    Returns:
        Whether the model `fits`; by axis `growth` (ratio of mean square residuals), `worse_share`
        of the force's variance, and `segments`, the share of segments with a worse fit.
    """
    variance = force.var(0)
    accepted_mse = accepted_residual.square().mean(0)
    segments = [new_residual[fold == segment].square().mean(0) for segment in torch.unique(fold)]
    # the segments, and the whole log as the last row
    squares = torch.stack([*segments, new_residual.square().mean(0)])
    is_worse = (
        (squares > _MAX_RESIDUAL_GROWTH * accepted_mse) & (squares > _MIN_VARIANCE_SHARE * variance)
    ).to(torch.float64)
    worse_share = is_worse[:-1].mean(0)
    return {
        "fits": not bool((is_worse[-1].bool() & (worse_share >= _MIN_SEGMENT_SHARE)).any()),
        "growth": (squares[-1] / accepted_mse.clamp(min=1e-300)).tolist(),
        "share": (squares[-1] / variance).tolist(),
        "segments": worse_share.tolist(),
    }


def _verdict_text(comparison: StudyResults) -> str:
    growth, share = (
        "/".join(f"{value:.3g}" for value in values)
        for values in (comparison["growth"], [100 * value for value in comparison["share"]])
    )
    sentence = (
        "is still valid"
        if comparison["fits"]
        else "is no longer valid: identify it again from this log"
    )
    return (
        f"{sentence} (residual {growth} times the previous one, {share} % of the force's variance;"
        " surge/sway/yaw)"
    )


def identify_model(
    config: FerryModelConfig, record: ForceRecord, base: ForceModel
) -> ResidualForceModel:
    """Fit one model on the training samples.

    Raises:
        FitError: if the data do not determine the model.
    """
    return fit_model(config, smooth_for_fit(config, record), base)


def smooth_for_fit(config: FerryModelConfig, record: ForceRecord) -> ForceRecord:
    """Return the record for the identification of a model, smoothed if its config says so."""
    should_smooth = config.searches_settings if config.smooth is None else config.smooth
    return record.smooth() if should_smooth and any(record.noise) else record


@dataclass(frozen=True)
class FerryStudy:
    """Results of all simulations and fits.

    Attributes:
        believed_run: the course with the believed model, from which the models are identified.
        record: log of this course; one half identifies the models, the other half tests them.
        unmodelled_mse: mean square residual of the believed model on the test half, by axis in N^2,
            N^2, (N m)^2.
        models: fitted models by name, each from one half of the course.
        whole_course_models: models with a hyperparameter search, fitted to the whole course for
            export.
        runs: simulations by model, `believed` first, of the `course`, the `crossing`, and the
            course without feedback (`feed_forward_alone`); empty if not simulated.
        judging: tracking metrics of every exported feed-forward, `believed` first, by judging
            course; None for an unstable closed loop.
        updates: for each feed-forward model on the changed vessel: whether it is still valid, and
            the tracking errors before and after a new identification.
    """

    believed_run: FerryRun
    record: ForceRecord
    unmodelled_mse: list[float]
    models: dict[str, ResidualForceModel]
    whole_course_models: dict[str, ResidualForceModel]
    runs: dict[str, dict[str, FerryRun]]
    judging: dict[str, dict[str, TrackingMetrics | None]]
    updates: dict[str, dict[str, Any]]


def build_record(run: FerryRun, interval: float, noise: MotionNoise | None) -> ForceRecord:
    """Return the log of a course with a fold for each segment; its first half is for training.

    Args:
        run: the simulated course.
        interval: time between waypoints in s.
        noise: known sensor noise; None for none.
    """
    return ForceRecord(
        run.t,
        run.measured[:, POSE],
        run.measured[:, VELOCITIES],
        run.measured[:, ACCELERATIONS],
        run.command,
        run.averaged_command,
        torch.div(run.t + 1e-9, interval, rounding_mode="floor").long(),
        torch.arange(len(run.t)) < len(run.t) // 2,
        (noise or MotionNoise()).standard_deviations(),
    )


def run_ferry_study(config: FerryStudyConfig) -> FerryStudy:
    """Simulate with the believed model, identify residual models, and simulate with these.

    Raises:
        ResidnetError: if a model cannot be identified or simulated.
    """
    ferry = config.build_loop(config.true)
    believed = ForceModel(ferry.believed_hull)
    believed_run = ferry.simulate(config.course, [(believed, None)])[0]
    record = build_record(believed_run, config.course.interval, config.noise)
    residual = believed.force_residual(
        record.command, record.nu_dot, record.nu, record.pose[:, HEADING]
    )
    models: dict[str, ResidualForceModel] = {}
    for name, model in config.models.items():
        models[name] = identify_model(
            model, record, models[model.on].force if model.on else believed
        )
    whole_record = replace(record, is_training=torch.ones_like(record.is_training))
    # exported models keep the hyperparameters selected on one half and tested on the other; their
    # coefficients are fitted to the whole course
    whole_course_models = {
        name: refit_with_settings(
            model, models[name], smooth_for_fit(model, whole_record), believed
        )
        for name, model in config.models.items()
        if model.searches_settings and not model.on and models[name].fit.notes["order"] > 0
    }
    judging = _simulate_judging_courses(config, ferry, record, models, whole_course_models)
    feed_forward_models = {name: models[name] for name, model in config.models.items() if model.fly}
    feeds_by_name: dict[str, FeedForwardModel] = {BELIEVED_NAME: (believed, None)}
    feeds_by_name |= {name: (model.force, model.lag) for name, model in feed_forward_models.items()}

    def simulate_runs(
        loop: FerrySimulation,
        path: ReferenceFilterConfig | CrossingConfig,
        names: Iterable[str],
        **options: bool,
    ) -> dict[str, FerryRun]:
        feeds = {name: feeds_by_name[name] for name in names}
        if not feeds:
            return {}
        return dict(zip(feeds, loop.simulate(path, list(feeds.values()), **options), strict=True))

    updates: dict[str, dict[str, Any]] = {}
    if config.later is not None:
        changed_loop = config.build_loop(config.later)
        for name, run in simulate_runs(changed_loop, config.course, feed_forward_models).items():
            log = build_record(run, config.course.interval, config.noise)
            previous_residual, new_residual = (
                feed_forward_models[name].residual_along(compared_record)
                for compared_record in (record, log)
            )
            verdict = compare_residuals(
                previous_residual[~record.is_training], new_residual, log.command, log.fold
            )
            updated_run = run
            if not verdict["fits"]:
                updated_model = identify_model(config.models[name], log, believed)
                updated_run = changed_loop.simulate(
                    config.course, [(updated_model.force, updated_model.lag)]
                )[0]
            updates[name] = {
                "verdict": verdict,
                "text": _verdict_text(verdict),
                "before": run.tracking_metrics.to_json(),
                "after": updated_run.tracking_metrics.to_json(),
            }
    return FerryStudy(
        believed_run,
        record,
        mean_squares_by_axis(residual[~record.is_training]),
        models,
        whole_course_models,
        {
            "course": {
                BELIEVED_NAME: believed_run,
                **simulate_runs(ferry, config.course, feed_forward_models),
            },
            "crossing": simulate_runs(ferry, config.crossing, feeds_by_name)
            if config.crossing
            else {},
            "feed_forward_alone": simulate_runs(
                ferry,
                config.course,
                feeds_by_name if config.feed_forward_alone else (),
                feedback=False,
            ),
        },
        judging,
        updates,
    )


def _simulate_judging_courses(
    config: FerryStudyConfig,
    ferry: FerrySimulation,
    record: ForceRecord,
    models: Mapping[str, ResidualForceModel],
    whole_course_models: Mapping[str, ResidualForceModel],
) -> dict[str, dict[str, TrackingMetrics | None]]:
    """Simulate the judging courses with the believed model and every exported feed-forward."""
    if config.judging_courses is None:
        courses = draw_judging_courses(config.course, config.seed)
    else:
        courses = {
            f"course {number}": course
            for number, course in enumerate(config.judging_courses, start=1)
        }
    feeds: dict[str, FeedForwardModel] = {BELIEVED_NAME: (ForceModel(ferry.believed_hull), None)}
    for name, model in {**models, **whole_course_models}.items():
        ranges = exported_ranges(record, model, is_whole_course=name in whole_course_models)
        feeds[name] = (ExportedFeedForward(model.force, ranges), model.lag)
    runs_by_model = ferry.simulate_courses(list(courses.values()), list(feeds.values()))
    return {
        name: {
            course: None if run is None else run.tracking_metrics
            for course, run in zip(courses, runs, strict=True)
        }
        for name, runs in zip(feeds, runs_by_model, strict=True)
    }


def forward_runs(
    config: FerryStudyConfig, models: Mapping[str, HullEquations]
) -> dict[str, dict[str, Any]]:
    """Free-run models from the commanded forces of the plant's manoeuvres.

    Args:
        config: the study, with its manoeuvres.
        models: equations of motion by name; the known hull is added.

    Returns:
        By model, `believed` first: `rmse` of u, v, r in m/s, m/s, rad/s over the runs without
        divergence (None without any), `runs`, and `diverged`, the number of diverged runs.
    """
    trials = SimulatedTrials(vessel=config.true, **_FREE_RUN_TRIALS)
    logs = [flight.true_log for flight in simulate_trials(trials.draw_manoeuvres(), trials)]
    # logs that ended early have another length and cannot be part of the batch
    logs = [log for log in logs if len(log) == max(map(len, logs))]
    thrusters = load_force_vessel(config.true)[1]
    x, commands = (
        torch.from_numpy(
            np.stack([np.stack([log.channels[name] for name in names], 1) for log in logs])
        )
        for names in (STATE_NAMES, thrusters.command_names)
    )
    w = thrusters.requested_force(commands)[:, :-1]
    velocity_limit = _DIVERGENCE_FACTOR * x[..., VELOCITIES].abs().amax(dim=(0, 1))
    believed_equations = BelievedConfig(vessel=config.believed).hull_equations()
    signals = SignalsConfig(inputs=FORCE_CHANNELS).build()
    rows = {}
    for name, equations in {BELIEVED_NAME: believed_equations, **models}.items():
        baseline = BelievedConfig(vessel=equations).build(signals.names)
        model = HybridDynamics(signals, baseline, ZeroHead(), trials.step).double()
        with torch.no_grad():
            trajectories = Rollout(model)(x[:, 0], w, x[:, 0, :0])[0]
        is_outside = (trajectories[..., VELOCITIES].abs() > velocity_limit).any(dim=-1)
        has_diverged = (~torch.isfinite(trajectories).all(dim=-1) | is_outside).any(dim=-1)
        errors = (trajectories - x)[~has_diverged][..., VELOCITIES]
        rows[name] = {
            "rmse": errors.square().mean(dim=(0, 1)).sqrt().tolist() if len(errors) else None,
            "runs": len(x),
            "diverged": int(has_diverged.sum()),
        }
    return rows


def write_results(
    config: FerryStudyConfig, study_result: FerryStudy, folder: RunFolder
) -> tuple[dict[str, Any], list[Figure]]:
    """Return the contents of ferry.json and the figures of a study.

    The models' equations are written into the folder.
    """
    figures: list[Figure] = []
    equations: dict[str, HullEquations] = {}
    refusals = dict.fromkeys(study_result.models, "")
    for name, model in study_result.models.items():
        figures += model_figures(name, config.models[name], model.fit, study_result.unmodelled_mse)
        try:
            equations[name] = derive_forward_equations(
                config.believed, model.force, f"model {name}"
            )
        except (ConfigError, FitError) as error:
            refusals[name] = str(error)
    forward = forward_runs(config, equations)
    for name, model_equations in equations.items():
        if forward[name]["diverged"]:
            refusals[name] = (
                f"model {name}: it diverges in {forward[name]['diverged']} of"
                f" {forward[name]['runs']} free runs in which the true ferry is bounded, so"
                " that its equations are not written; use a model with fewer terms or with lag"
            )
        else:
            text = to_baseline_yaml(model_equations, f"run {config.name}, model {name}")
            folder.write(folder.path / "models" / f"{name}_forward.yaml", text)
    models = {}
    for name, model in study_result.models.items():
        test_mse = model.test_mse(study_result.record)
        models[name] = {
            "test_mse": test_mse,
            "share_left": [
                a / b for a, b in zip(test_mse, study_result.unmodelled_mse, strict=True)
            ],
            "notes": model.fit.notes,
            "not_forward": refusals[name],
            **fit_to_json(config.models[name].terms, model.fit),
            "exported": _exported_model(config.models[name].terms, study_result, name),
        }
    for run_kind, runs in study_result.runs.items():
        figures += _run_figures(runs, run_kind) if runs else []
    content = {
        "schema": "residnet.ferry/1",
        "run": config.name,
        "unmodelled_test_mse": study_result.unmodelled_mse,
        "true_coefficients": exact_residual_coefficients(config.true, config.believed),
        "models": models,
        **{
            run_kind: {name: run.tracking_metrics.to_json() for name, run in runs.items()}
            for run_kind, runs in study_result.runs.items()
        },
        "judging": {name: _summarize_judging(runs) for name, runs in study_result.judging.items()},
        "later": study_result.updates,
        "forward": forward,
    }
    return content, figures


def exported_ranges(
    record: ForceRecord, model: ResidualForceModel, *, is_whole_course: bool
) -> list[tuple[float, float]]:
    """Return the training ranges of nu_dot and nu (six rows) of an exported model.

    Args:
        record: log of the course.
        model: the exported model.
        is_whole_course: whether the model is fitted to the whole course instead of its first half.
    """
    if is_whole_course:
        record = replace(record, is_training=torch.ones_like(record.is_training))
    return record.motion_ranges(mirror=bool(model.fit.notes.get("mirror")))


def _exported_model(terms: Sequence[str], study_result: FerryStudy, name: str) -> dict[str, Any]:
    """Return the model for export, with its training range."""
    is_whole_course = name in study_result.whole_course_models
    model = study_result.whole_course_models.get(name, study_result.models[name])
    ranges = exported_ranges(study_result.record, model, is_whole_course=is_whole_course)
    return {**fit_to_json(terms, model.fit), "notes": model.fit.notes, "range": ranges}


def _run_figures(runs: Mapping[str, FerryRun], run_kind: str) -> list[Figure]:
    t = next(iter(runs.values())).t.numpy()
    pose_errors = {name: run.desired_pose - run.pose for name, run in runs.items()}
    # the scales are logarithmic, since models differ by orders of magnitude
    position = {
        name: (t, pose_error[:, POSITION].norm(dim=-1).clamp(min=1e-5).numpy())
        for name, pose_error in pose_errors.items()
    }
    heading = {
        name: (
            t,
            (DEGREES_PER_RADIAN * wrap_angle(pose_error[:, HEADING]).abs()).clamp(min=1e-4).numpy(),
        )
        for name, pose_error in pose_errors.items()
    }
    panel_settings: Any = {"x_label": "time [s]", "height": 210, "group": "t", "y_log": True}
    errors = Figure(
        f"errors_{run_kind}",
        "Errors in closed loop",
        "Distance to the desired position and magnitude of the heading error over time, by"
        " model of the feed-forward.",
        style_family(runs, width=1.1),
        [
            Panel("position error [m]", **panel_settings),
            Panel("heading error [deg]", **panel_settings),
        ],
        [Case("", [position, heading])],
    )
    if not any(bool(run.feedback.any()) for run in runs.values()):
        return [errors]
    shown_runs = dict(list(runs.items())[:3])
    units = ("surge [N]", "sway [N]", "yaw [N m]")
    forces = Figure(
        f"forces_{run_kind}",
        "Forces in closed loop",
        "Commanded force and the part of it that is feedback, by model of the feed-forward.",
        {
            "command": replace(SOLID_STYLE, label="commanded force", width=1.0),
            "feedback": replace(DASHED_STYLE, label="feedback part", width=1.0),
        },
        [
            Panel(unit, "time [s]", name if not axis else "", height=165, group=name)
            for axis, unit in enumerate(units)
            for name in shown_runs
        ],
        [
            Case(
                "",
                [
                    {
                        part: (t, getattr(run, part)[:, axis].numpy())
                        for part in ("command", "feedback")
                    }
                    for axis in range(3)
                    for run in shown_runs.values()
                ],
            )
        ],
        columns=len(shown_runs),
    )
    return [errors, forces]


def _summarize_judging(metrics: Mapping[str, TrackingMetrics | None]) -> dict[str, Any]:
    """Return the mean errors over the judging courses; None if a simulation is unstable."""
    stable_runs = [run for run in metrics.values() if run is not None]
    is_stable = len(stable_runs) == len(metrics)
    position_errors = [run.position_mae for run in stable_runs]
    heading_errors = [run.heading_mae for run in stable_runs]
    return {
        "position_mae": sum(position_errors) / len(metrics) if is_stable else None,
        "heading_mae": sum(heading_errors) / len(metrics) if is_stable else None,
        "courses": {name: None if run is None else run.to_json() for name, run in metrics.items()},
    }


def _error_text(judging: StudyResults) -> str:
    """Return the mean position error of the judging simulations with its unit."""
    error = judging["position_mae"]
    return "unstable" if error is None else f"{format_number(error)} m"


def list_feed_forward_objections(name: str, results: StudyResults) -> list[str]:
    """Return objections to a feed-forward instead of the believed one.

    The criterion is the mean position error of simulations: on the judging courses, and in
    the operational crossing if there is one. The residual force is no criterion, because a model
    with a larger residual may track courses better.
    """
    model_error, believed_error = (
        results["judging"][model_name]["position_mae"] for model_name in (name, BELIEVED_NAME)
    )
    if model_error is None:
        return ["the closed loop with it is unstable on a validation course"]
    compared_errors = {"validation courses": (model_error, believed_error)}
    if name in (crossing := results["crossing"]):
        compared_errors["crossing"] = (
            crossing[name]["position_mae"],
            crossing[BELIEVED_NAME]["position_mae"],
        )
    return [
        f"its mean position error in the {flights} is {format_number(errors[0])} m, the believed"
        f" model's {format_number(errors[1])} m"
        for flights, errors in compared_errors.items()
        if errors[1] is not None and errors[0] > errors[1]
    ]


def find_best_model(results: StudyResults) -> str:
    """Return the model with the smallest remaining residual."""
    models: StudyResults = results["models"]
    return min(models, key=lambda name: float(sum(models[name]["share_left"])))


def find_best_flown_model(results: StudyResults) -> str:
    """Return the model with the smallest mean position error on the judging courses."""

    def position_error(name: str) -> float:
        error = results["judging"][name]["position_mae"]
        return math.inf if error is None else float(error)

    names: list[str] = list(results["models"])
    return min(names, key=position_error)


def _judging_table(results: StudyResults) -> Table:
    """Return the table of position errors on the judging courses."""
    judging = results["judging"]
    rows = [
        {
            "name": name,
            **judging[name],
            "decision": "reference"
            if name == BELIEVED_NAME
            else "; ".join(list_feed_forward_objections(name, results)) or "exported",
        }
        for name in judging
    ]
    course_names = list(judging[BELIEVED_NAME]["courses"])

    def course_cell(course: str) -> Callable[[Mapping[str, Any]], Cell]:
        def format_cell(row: Mapping[str, Any]) -> Cell:
            run = row["courses"][course]
            return Cell("unstable" if run is None else format_number(run["position_mae"]))

        return format_cell

    return build_table(
        rows,
        [
            ("feed-forward", "name"),
            *((f"{course} m", course_cell(course)) for course in course_names),
            ("mean m", lambda row: Cell(_error_text(row).removesuffix(" m"))),
            ("export", "decision"),
        ],
        caption="Mean position errors on courses that were not used for identification, with the"
        " feed-forwards as exported. A feed-forward is exported if its mean error is smaller than"
        " that of the believed model.",
        is_selected=lambda row: row["name"] == find_best_flown_model(results),
    )


def _residual_table(config: FerryStudyConfig, results: StudyResults) -> Table:
    """Build the table of test errors and published errors (Tables 4.2, 4.5, 4.7, 4.15)."""
    unmodelled = results["unmodelled_test_mse"]
    published_base = config.published.mse
    rows = []
    believed_row = {"test_mse": unmodelled, "notes": {}}
    for name, model in {BELIEVED_NAME: believed_row, **results["models"]}.items():
        published_figures = (
            config.published if name == BELIEVED_NAME else config.models[name].published
        )
        compared_values = {
            "ours": (model["test_mse"], unmodelled),
            "published": (published_figures.mse, published_base),
        }
        remaining_percent = {
            origin: [100 * a / b for a, b in zip(model_mse, base_mse, strict=True)]
            if model_mse and base_mse
            else None
            for origin, (model_mse, base_mse) in compared_values.items()
        }
        rows.append(
            {
                "name": name,
                "mse": model["test_mse"],
                "left": remaining_percent["ours"],
                "published": {"mse": published_figures.mse, "left": remaining_percent["published"]},
                "notes": format_notes(model["notes"]),
            }
        )
    return build_table(
        rows,
        [
            ("model", "name"),
            *comparison_columns("mse", ("surge N^2", "sway N^2", "yaw (N m)^2")),
            *comparison_columns("left", AXES, 3),
            ("chosen by the estimator", "notes"),
        ],
        caption="Mean square of the residual force, absolute and as a share of that of the believed"
        " model.",
        groups=[("mean square", 3), ("% of the believed model's residual", 3)],
        is_selected=lambda row: row["name"] == find_best_model(results),
    )


def _tracking_tables(
    config: FerryStudyConfig, runs: Mapping[str, StudyResults], run_kind: str
) -> list[Block]:
    """Return tables of tracking errors and forces on a course.

    They correspond to Tables 4.3, 4.4, 4.8, 4.9, 4.10, 4.12 and 4.13 of Jervan 2020.
    """
    rows = []
    for name, metrics in runs.items():
        published_figures = (
            config.published if name == BELIEVED_NAME else config.models[name].published
        )
        published_values = published_figures.model_dump()
        if run_kind == "crossing":
            crossing = {
                key.partition("crossing_")[2]: value for key, value in published_values.items()
            }
            published_values = {key: value for key, value in crossing.items() if key}
        elif run_kind == "feed_forward_alone":
            published_values = {"motion_mse": published_figures.alone}
        rows.append({"name": name, **metrics, "published": published_values})
    name_column = ("feed-forward", "name")
    open_loop_table = build_table(
        rows,
        [
            name_column,
            *comparison_columns("motion_mse", ("u", "v", "r", "u_dot", "v_dot", "r_dot")),
        ],
        caption="Mean square error against the desired motion without feedback, in (m/s)^2,"
        " (m/s)^2, (rad/s)^2, and the same per second squared.",
    )
    errors = build_table(
        rows,
        [
            name_column,
            *comparison_columns("position_mae", "mean position error m"),
            *comparison_columns("position_mse", "mean square m^2"),
            *comparison_columns("heading_mae", "mean heading error deg", factor=DEGREES_PER_RADIAN),
            *comparison_columns("power", ("power, position W", "power, heading W")),
            *comparison_columns("iaew", ("IAEW, position m s J", "IAEW, heading rad s J")),
        ],
        caption="IAEW is the integral of the error times the work (3.18).",
    )
    units = ("surge N", "sway N", "yaw N m")
    forces = build_table(
        rows,
        [name_column, *comparison_columns("tau", units), *comparison_columns("feedback", units)],
        groups=[("mean absolute force", 3), ("mean absolute feedback", 3)],
    )
    return [*([open_loop_table] if run_kind == "feed_forward_alone" else []), errors, forces]


def _free_run_table(rows: Mapping[str, StudyResults]) -> Table:
    """Return the table of free runs of the plant's manoeuvres (3.22)."""
    free_run_rows = [
        {
            "name": name,
            **row,
            "rmse": row["rmse"] and [*row["rmse"][:2], DEGREES_PER_RADIAN * row["rmse"][2]],
            "published": {},
        }
        for name, row in rows.items()
    ]
    return build_table(
        free_run_rows,
        [
            ("model", "name"),
            *comparison_columns("rmse", ("u m/s", "v m/s", "r deg/s"), 3),
            ("diverged", lambda row: Cell(f"{row['diverged']} of {row['runs']}")),
        ],
        caption="Root mean square errors of free runs from the commanded forces, over the runs that"
        " did not diverge. A model that explains the force does not necessarily predict the"
        " motion.",
    )


def _update_table(updates: Mapping[str, StudyResults]) -> Table:
    """Return the table of models on the changed vessel (section 3.7)."""

    def format_short(value: float) -> str:
        return format_number(value, 4)

    return build_table(
        [{"name": name, **row} for name, row in updates.items()],
        [
            ("model", "name"),
            ("mean position error m", "before.position_mae", format_short),
            ("after the update m", "after.position_mae", format_short),
            ("on the new log", "text"),
        ],
        caption="A model that is no longer valid is identified again from the log of one course.",
    )
