"""Task `ferry_study`: residual models of a ferry in closed loop (document 002, chapter 4).

A plant that stands for the true ferry flies a course under a controller that believes in a model;
residual models are identified from the course, and the course is flown again with them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal, final

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.baselines.given import BelievedConfig, HullEquations
from residnet.control.guidance import CrossingConfig
from residnet.control.motion import ReferenceFilterConfig
from residnet.core.config import Config
from residnet.core.errors import ConfigError, FitError, UsageError
from residnet.core.files import read_json
from residnet.core.format import DEG, number
from residnet.core.frames import wrap
from residnet.core.layout import ACCELERATIONS, HEADING, POSE, POSITION, VELOCITIES
from residnet.core.names import STATE, nearest
from residnet.data.simulated import SimulatedTrials, fly_trials
from residnet.documents.jervan2020.ferry_loop import (
    Disturbance,
    Feed,
    Ferry,
    Flight,
    LoopConfig,
    MotionNoise,
    force_hull,
)
from residnet.documents.jervan2020.residual import (
    AXES,
    FittedModel,
    Record,
    ResidualModelConfig,
    as_baseline_yaml,
    fit_as_json,
    fit_model,
    forward_equations,
    missing_coefficients,
    model_figures,
    model_sections,
    refitted,
)
from residnet.documents.study import Results, Study, compared, joined, notes_text, pictures
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.heads.base import ZeroHead
from residnet.judge.autopilots import mse
from residnet.manoeuvres.closed_loop import ZigzagFamily
from residnet.physics.force_model import Correction, ForceModel
from residnet.physics.signals import FORCE_CHANNELS, SignalsConfig
from residnet.report.blocks import Block, Cell, Section, Table, table_of
from residnet.report.figure import DASHED, SOLID, Case, Figure, Panel, family
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, ExportRequest, Exports, MainFigure, PartName

_WORSE, _MATTERS, _MOST = 4.0, 0.02, 0.5
"""A model no longer fits an axis where the mean square residual of a share of the segments, so that
one gust or one wake is no reason, and of the whole log is so many times what it was, and more than
a trifle of the force's variance. Chosen by hand.
"""


def still_fits(then: Tensor, now: Tensor, force: Tensor, fold: Tensor) -> dict[str, Any]:
    """Return whether a model still fits, by comparing residuals.

    Args:
        then: residual on data that the model was accepted on [N, 3].
        now: residual on new data [M, 3].
        force: of the new data [M, 3].
        fold: segment of each new sample [M].

    Returns:
        Whether the model `fits`; by axis `growth` (mean square residual now over then), `share` of
        the force's variance, and `segments`, the share of those that show a worse fit.
    """
    variance, before = force.var(0), then.square().mean(0)
    segments = [now[fold == one].square().mean(0) for one in torch.unique(fold)]
    # the segments, and the whole log as the last row
    squares = torch.stack([*segments, now.square().mean(0)])
    worse = ((squares > _WORSE * before) & (squares > _MATTERS * variance)).to(torch.float64)
    share = worse[:-1].mean(0)
    return {
        "fits": not bool((worse[-1].bool() & (share >= _MOST)).any()),
        "growth": (squares[-1] / before.clamp(min=1e-300)).tolist(),
        "share": (squares[-1] / variance).tolist(),
        "segments": share.tolist(),
    }


def _verdict_text(found: Results) -> str:
    growth, share = (
        "/".join(f"{value:.3g}" for value in part)
        for part in (found["growth"], [100 * value for value in found["share"]])
    )
    sentence = "still fits" if found["fits"] else "no longer fits: identify it again from this log"
    return (
        f"{sentence} (residual {growth} times what it was, {share} % of the force's variance;"
        " surge/sway/yaw)"
    )


_BELIEVED = "believed"
_FARTHEST = 3.0
"""Velocities of a free run in largest velocities of the true ferry from which it has diverged."""


class Published(Config):
    """Figures that document 002 prints for one model, to stand beside the figures of a run.

    The numbers stand as printed, except where a correction of the document says otherwise. A figure
    that the document does not print is left out (null).

    Attributes:
        mse: mean square of the residual on the unseen half in N^2, N^2, (N m)^2 (Tables 4.2, 4.5,
            4.7, 4.15); surge, sway and yaw.
        position_mae: mean position error on the course in m (Tables 4.4, 4.10).
        position_mse: mean square position error on the course in m^2 (Tables 4.4, 4.10).
        heading_mae: mean heading error on the course in deg (Tables 4.4, 4.10).
        tau: mean absolute commanded force in N, N, N m (Tables 4.3, 4.9).
        feedback: mean absolute force of the feedback alone in N, N, N m (Tables 4.3, 4.9).
        crossing_position_mae: mean position error in the operational crossing in m (Table 4.12).
        crossing_position_mse: mean square position error in the crossing in m^2 (Table 4.12).
        crossing_heading_mae: mean heading error in the crossing in deg (Table 4.12).
        alone: mean square error of u, v, r and of their derivatives against the desired motion
            without feedback, in (m/s)^2, (m/s)^2, (rad/s)^2 and the same per second squared
            (Table 4.8, correction J21).
        crossing_power: mean power in W that position and heading take in the crossing (Table 4.13).
        coefficients: coefficients of the basis functions in surge, sway and yaw in SI units
            (Table 4.11), by basis function.
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


_FORWARD: Mapping[str, Any] = {
    "trials": (
        ZigzagFamily(count=6, drive=(0.03, 0.07), steer=(0.01, 0.03), heading=(0.17, 0.35)),
    ),
    "duration": 60.0,
    "step": 0.1,
    "seed": 0,
    "identification": {},
    "validation": {},
}
"""Manoeuvres of the true ferry beside which the models run forward in time."""


class FerryModelConfig(ResidualModelConfig):
    """One model of the ferry's residual force; with `lag`, its feed-forward is led by the lag.

    Attributes:
        smooth: estimate the motion from all noisy measurements together before the fit
            (`residnet.data.motion`). Null does so where the noise is known and the model searches
            its settings.
        on: name of the model whose remaining residual this one explains (3.26); empty for the
            believed hull.
        fly: fly the course, and the crossing where there is one, with this model as feed-forward.
        published: figures that the document prints for this model.
    """

    smooth: bool | None = None
    on: str = ""
    fly: bool = False
    published: Published = Published()


@final
class FerryStudyConfig(Study, ComputingTask):
    """A course with the believed model, residual models identified from it, and the course again.

    Attributes:
        task: `ferry_study`.
        believed: vessel whose hull the controller believes in, by name or file.
        true: vessel that is simulated, by name or file.
        course: waypoints and reference filter; its first half identifies, the second tests.
        loop: controller and sampling.
        crossing: an operational crossing that is flown too; null for none.
        noise: noise on what is measured; null for none.
        disturbance: force that is constant in earth axes.
        feed_forward_alone: fly the course without feedback too (Table 4.8).
        models: residual models by name; a model stands after the one that it builds on.
        published: figures that the document prints for the believed model.
        later: vessel that the true one has become later, by name or file; the models that fly are
            judged on its log and identified again where they no longer fit. Null for none.
        seed: seed of the noise.
    """

    results_file: ClassVar[str] = "ferry.json"

    task: Literal["ferry_study"]
    believed: str = "milliampere"
    true: str = "milliampere_half"
    course: ReferenceFilterConfig
    loop: LoopConfig
    crossing: CrossingConfig | None = None
    noise: MotionNoise | None = None
    disturbance: Disturbance = Disturbance()
    feed_forward_alone: bool = False
    models: dict[PartName, FerryModelConfig] = Field(min_length=1)
    published: Published = Published()
    later: str | None = None
    seed: int = Field(default=0, ge=0)

    verbs: ClassVar[tuple[str, ...]] = ("report", "export")

    @model_validator(mode="after")
    def _combination(self) -> FerryStudyConfig:
        known: list[str] = []
        for name, model in self.models.items():
            if name == _BELIEVED:
                raise ValueError("'believed' cannot name a model: it is the controller's own")
            if model.on and model.on not in known:
                raise ValueError(
                    f"models.{name}.on: no model before it is named"
                    f" '{model.on}'{nearest(model.on, known)}"
                )
            below = self.models.get(model.on)
            if below and (below.searched or bool(below.lag) != bool(model.lag)):
                raise ValueError(
                    f"models.{name}.on: '{model.on}' and it must both be with lag or without; say"
                    " which of both by 'lag'"
                )
            known.append(name)
        if len(self.course.waypoints) < 4:
            raise ValueError(
                "course: at least four waypoints; half of them identify, segment by segment, and"
                " half test"
            )
        try:
            for true in (self.true, self.later or self.true):
                self.ferry(true)
            self.course.build(self.loop.step)
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def recorded_seed(self) -> int:
        return self.seed

    def ferry(self, true: str) -> Ferry:
        """Return the loop with one vessel as the true one."""
        return Ferry(true, self.believed, self.loop, self.noise, self.disturbance, self.seed)

    def results(self, folder: RunFolder) -> tuple[dict[str, Any], Iterable[Figure]]:
        return written(self, study(self), folder)

    def exports(self, folder: RunFolder) -> Exports:
        return {
            name: partial(self.export_model, ExportRequest(folder, name)) for name in self.models
        }

    def export_model(self, asked: ExportRequest) -> Path:
        """Write the feed-forward of a model; `selected` leaves the least of the residual force."""
        run, results = asked.run, read_json(asked.run.path / self.results_file)
        name = best_model(results) if asked.model == "selected" else asked.model
        if name not in self.models:
            raise UsageError(f"{run.path}: no model '{name}'{nearest(name, self.models)}")
        chain = [name]
        while below := self.models[chain[0]].on:
            chain.insert(0, below)
        rows = [results["models"][one]["exported"] for one in chain]
        force = ForceModel(force_hull(self.believed)[0].hull)
        for row in rows:
            numbers = (torch.tensor(row[key]).double() for key in ("coefficients", "intercept"))
            force = force.extended(Correction(row["terms"], *numbers))
        ranges = [(low, high) for low, high in rows[-1]["range"]]
        made = RequiredForce(*force.parts(), mirrored=True)
        exported = ExportedForce(name, made, ranges, rows[-1]["notes"].get("lag"))
        return asked.write(exported, objections(name, results), f"{name}_feed_forward")

    def verdict(self, results: Results) -> list[str]:
        models, best = results["models"], best_model(results)
        left = joined([100 * share for share in models[best]["share_left"]])
        sentences = [
            f"Of {len(models)} residual models, {best} leaves the least of the residual force on"
            f" the unseen half of the course: {left} % of its mean square in surge, sway and yaw."
        ]
        for kind in ("course", "crossing"):
            missed = {name: flight["position_mae"] for name, flight in results[kind].items()}
            before = missed.pop(_BELIEVED, None)
            if missed:
                closest = min(missed, key=missed.__getitem__)
                moves = "falls" if missed[closest] < before else "does NOT fall: it goes"
                sentences.append(
                    f"With {closest} as feed-forward, the mean position error in the {kind} {moves}"
                    f" from {number(before)} m to {number(missed[closest])} m."
                )
        return sentences + [
            f"On the vessel as it is later, {name} {update['text']}."
            for name, update in results["later"].items()
        ]

    def main_figures(self, results: Results) -> dict[str, MainFigure]:
        best = best_model(results)
        shares = zip(AXES, results["models"][best]["share_left"], strict=True)
        return {f"residual left by {best}, {axis}": MainFigure(share) for axis, share in shares} | {
            f"mean position error on the course with {name}": MainFigure(
                flight["position_mae"], "m"
            )
            for name, flight in results["course"].items()
        }

    def sections(self, results: Results, run: Path) -> list[Section]:
        left = _residuals(self, results)
        drawn = [one.part() for one in pictures(run, "errors_course", "errors_crossing")]
        out = [
            Section("", [*drawn[:1], left.part(3, 6)]),
            Section("Residual force on the unseen half", [left]),
        ]
        for kind, title in (
            ("course", "Course in closed loop"),
            ("crossing", "Operational crossing"),
            ("feed_forward_alone", "Feed-forward without feedback"),
        ):
            if results[kind]:
                drawn = pictures(run, f"errors_{kind}", f"forces_{kind}")
                out.append(Section(title, [*_flown(self, results[kind], kind), *drawn]))
        if results["later"]:
            out.append(Section("The vessel as it is later", [_later(results["later"])]))
        out.append(Section("Forward in time", [_forward(results["forward"])]))
        # Table 4.11
        others = {
            name: {
                "true": {} if model.on else results["true_coefficients"],
                "published": model.published.coefficients,
            }
            for name, model in self.models.items()
        }
        return out + model_sections("Coefficients", results["models"], run, "notes", others)


def identify(config: FerryModelConfig, record: Record, base: ForceModel) -> FittedModel:
    """Fit one model on the training samples.

    Raises:
        FitError: where the data do not determine the model.
    """
    return fit_model(config, smoothed(config, record), base)


def smoothed(config: FerryModelConfig, record: Record) -> Record:
    """Return the record as a model is identified from it."""
    wanted = config.searched if config.smooth is None else config.smooth
    return record.smoothed() if wanted and any(record.noise) else record


@dataclass(frozen=True)
class Flown:
    """Everything that was flown and fitted.

    Attributes:
        first: the course with the believed model, from which the models are identified.
        record: its log, of which one half identifies the models and the other tests them.
        unmodelled: mean square of the believed model's residual on the test half, by axis in N^2,
            N^2, (N m)^2.
        models: fitted models by name, each from one half of the course.
        whole: those that search their settings, fitted to the whole course as they are exported.
        flights: by model, `believed` first, of the `course`, the `crossing`, and the course without
            feedback (`feed_forward_alone`); empty where they were not flown.
        later: each model that flies, on the vessel as it is later: whether it still fits, and how
            the course is followed before and after it was identified again where it does not.
    """

    first: Flight
    record: Record
    unmodelled: list[float]
    models: dict[str, FittedModel]
    whole: dict[str, FittedModel]
    flights: dict[str, dict[str, Flight]]
    later: dict[str, dict[str, Any]]


def record_of(flight: Flight, interval: float, noise: MotionNoise | None) -> Record:
    """Return the log of a course with a fold for each segment; its first half identifies.

    Args:
        flight: the course as it was flown.
        interval: time from one waypoint to the next in s.
        noise: what is known of the sensors; None for none.
    """
    return Record(
        flight.t,
        flight.measured[:, POSE],
        flight.measured[:, VELOCITIES],
        flight.measured[:, ACCELERATIONS],
        flight.command,
        flight.averaged,
        torch.div(flight.t + 1e-9, interval, rounding_mode="floor").long(),
        torch.arange(len(flight.t)) < len(flight.t) // 2,
        (noise or MotionNoise()).spread(),
    )


def study(config: FerryStudyConfig) -> Flown:
    """Fly with the believed model, identify residual models, and fly with these.

    Raises:
        ResidnetError: where a model cannot be identified or flown.
    """
    ferry = config.ferry(config.true)
    believed = ForceModel(ferry.believed)
    first = ferry.fly(config.course, [(believed, None)])[0]
    record = record_of(first, config.course.interval, config.noise)
    residual = believed.residual(record.command, record.nu_dot, record.nu, record.pose[:, HEADING])
    models: dict[str, FittedModel] = {}
    for name, model in config.models.items():
        models[name] = identify(model, record, models[model.on].force if model.on else believed)
    every_sample = replace(record, train=torch.ones_like(record.train))
    # what a half chose and the other judged leaves with the coefficients of both
    whole = {
        name: refitted(model, models[name], smoothed(model, every_sample), believed)
        for name, model in config.models.items()
        if model.searched and not model.on and models[name].fit.notes["order"] > 0
    }
    flying = {name: models[name] for name, model in config.models.items() if model.fly}
    every: dict[str, Feed] = {_BELIEVED: (believed, None)}
    every |= {name: (model.force, model.lag) for name, model in flying.items()}

    def flown(
        craft: Ferry,
        path: ReferenceFilterConfig | CrossingConfig,
        names: Iterable[str],
        **how: bool,
    ) -> dict[str, Flight]:
        feeds = {name: every[name] for name in names}
        if not feeds:
            return {}
        return dict(zip(feeds, craft.fly(path, list(feeds.values()), **how), strict=True))

    later: dict[str, dict[str, Any]] = {}
    if config.later is not None:
        changed = config.ferry(config.later)
        for name, flight in flown(changed, config.course, flying).items():
            log = record_of(flight, config.course.interval, config.noise)
            before, now = (flying[name].remaining(of) for of in (record, log))
            verdict = still_fits(before[~record.train], now, log.command, log.fold)
            after = flight
            if not verdict["fits"]:
                again = identify(config.models[name], log, believed)
                after = changed.fly(config.course, [(again.force, again.lag)])[0]
            later[name] = {
                "verdict": verdict,
                "text": _verdict_text(verdict),
                "before": flight.tracking.row(),
                "after": after.tracking.row(),
            }
    return Flown(
        first,
        record,
        mse(residual[~record.train]),
        models,
        whole,
        {
            "course": {_BELIEVED: first, **flown(ferry, config.course, flying)},
            "crossing": flown(ferry, config.crossing, every) if config.crossing else {},
            "feed_forward_alone": flown(
                ferry, config.course, every if config.feed_forward_alone else (), feedback=False
            ),
        },
        later,
    )


def forward_runs(
    config: FerryStudyConfig, models: Mapping[str, HullEquations]
) -> dict[str, dict[str, Any]]:
    """Run models forward in time from the commanded forces of the true ferry's manoeuvres.

    Args:
        config: the study, with its manoeuvres.
        models: equations of motion by name, beside which stand those of the known hull.

    Returns:
        By model, `believed` first: `rmse` of u, v, r in m/s, m/s, rad/s over the runs that did not
        diverge (None without any), `runs`, and `diverged`, how many of them did.
    """
    trials = SimulatedTrials(vessel=config.true, **_FORWARD)
    logs = [flight.motion for flight in fly_trials(trials.draw(), trials)]
    # one that ended early shows no free run
    logs = [log for log in logs if len(log) == max(map(len, logs))]
    thrusters = force_hull(config.true)[1]
    x, commands = (
        torch.from_numpy(
            np.stack([np.stack([log.channels[name] for name in names], 1) for log in logs])
        )
        for names in (STATE, thrusters.commands)
    )
    w = thrusters.asked(commands)[:, :-1]
    limit = _FARTHEST * x[..., VELOCITIES].abs().amax(dim=(0, 1))
    known = BelievedConfig(vessel=config.believed).equations()
    signals, out = SignalsConfig(inputs=FORCE_CHANNELS).build(), {}
    for name, equations in {_BELIEVED: known, **models}.items():
        baseline = BelievedConfig(vessel=equations).build(signals.names)
        model = HybridDynamics(signals, baseline, ZeroHead(), trials.step).double()
        with torch.no_grad():
            ran = Rollout(model)(x[:, 0], w, x[:, 0, :0])[0]
        beyond = (ran[..., VELOCITIES].abs() > limit).any(dim=-1)
        away = (~torch.isfinite(ran).all(dim=-1) | beyond).any(dim=-1)
        kept = (ran - x)[~away][..., VELOCITIES]
        out[name] = {
            "rmse": kept.square().mean(dim=(0, 1)).sqrt().tolist() if len(kept) else None,
            "runs": len(x),
            "diverged": int(away.sum()),
        }
    return out


def written(
    config: FerryStudyConfig, found: Flown, folder: RunFolder
) -> tuple[dict[str, Any], list[Figure]]:
    """Return the contents of ferry.json and the figures of a study.

    The models' equations are written into the folder.
    """
    figures: list[Figure] = []
    equations: dict[str, HullEquations] = {}
    refused = dict.fromkeys(found.models, "")
    for name, model in found.models.items():
        figures += model_figures(name, config.models[name], model.fit, found.unmodelled)
        try:
            equations[name] = forward_equations(config.believed, model.force, f"model {name}")
        except (ConfigError, FitError) as error:
            refused[name] = str(error)
    forward = forward_runs(config, equations)
    for name, of_model in equations.items():
        if forward[name]["diverged"]:
            refused[name] = (
                f"model {name}: it diverges in {forward[name]['diverged']} of"
                f" {forward[name]['runs']} free runs beside the true ferry, so its equations are"
                " not written; take a model with fewer terms or with lag"
            )
        else:
            text = as_baseline_yaml(of_model, f"run {config.name}, model {name}")
            folder.write(folder.path / "models" / f"{name}_forward.yaml", text)
    models = {}
    for name, model in found.models.items():
        left = model.test_mse(found.record)
        models[name] = {
            "test_mse": left,
            "share_left": [a / b for a, b in zip(left, found.unmodelled, strict=True)],
            "notes": model.fit.notes,
            "not_forward": refused[name],
            **fit_as_json(config.models[name].terms, model.fit),
            "exported": _exported(config.models[name].terms, found, name),
        }
    for kind, flown in found.flights.items():
        figures += _flights(flown, kind) if flown else []
    content = {
        "schema": "residnet.ferry/1",
        "run": config.name,
        "unmodelled_test_mse": found.unmodelled,
        "true_coefficients": missing_coefficients(config.true, config.believed),
        "models": models,
        **{
            kind: {name: flight.tracking.row() for name, flight in flown.items()}
            for kind, flown in found.flights.items()
        },
        "later": found.later,
        "forward": forward,
    }
    return content, figures


def _exported(terms: Sequence[str], found: Flown, name: str) -> dict[str, Any]:
    """Return a model as it is exported, with the range of what it was fitted to."""
    record, model = found.record, found.models[name]
    if name in found.whole:
        record, model = replace(record, train=torch.ones_like(record.train)), found.whole[name]
    ranges = record.ranges(mirror=bool(model.fit.notes.get("mirror")))
    return {**fit_as_json(terms, model.fit), "notes": model.fit.notes, "range": ranges}


def _flights(flights: Mapping[str, Flight], kind: str) -> list[Figure]:
    t = next(iter(flights.values())).t.numpy()
    apart = {name: flight.desired - flight.pose for name, flight in flights.items()}
    # the scales are logarithmic, since models differ by orders of magnitude
    position = {
        name: (t, off[:, POSITION].norm(dim=-1).clamp(min=1e-5).numpy())
        for name, off in apart.items()
    }
    heading = {
        name: (t, (DEG * wrap(off[:, HEADING]).abs()).clamp(min=1e-4).numpy())
        for name, off in apart.items()
    }
    shared: Any = {"x_label": "time [s]", "height": 210, "group": "t", "y_log": True}
    errors = Figure(
        f"errors_{kind}",
        "Errors in closed loop",
        "Distance to the desired position and magnitude of the heading error over time, by"
        " model of the feed-forward.",
        family(flights, width=1.1),
        [Panel("position error [m]", **shared), Panel("heading error [deg]", **shared)],
        [Case("", [position, heading])],
    )
    if not any(bool(flight.feedback.any()) for flight in flights.values()):
        return [errors]
    shown = dict(list(flights.items())[:3])
    units = ("surge [N]", "sway [N]", "yaw [N m]")
    forces = Figure(
        f"forces_{kind}",
        "Forces in closed loop",
        "Commanded force and the part of it that is feedback, by model of the feed-forward.",
        {
            "command": replace(SOLID, label="commanded force", width=1.0),
            "feedback": replace(DASHED, label="feedback part", width=1.0),
        },
        [
            Panel(unit, "time [s]", name if not axis else "", height=165, group=name)
            for axis, unit in enumerate(units)
            for name in shown
        ],
        [
            Case(
                "",
                [
                    {
                        part: (t, getattr(flight, part)[:, axis].numpy())
                        for part in ("command", "feedback")
                    }
                    for axis in range(3)
                    for flight in shown.values()
                ],
            )
        ],
        columns=len(shown),
    )
    return [errors, forces]


def objections(name: str, results: Results) -> list[str]:
    """Return what speaks against a feed-forward rather than the believed one.

    That is what it leaves of the residual force on the unseen half, mean over the axes, and the
    position error of every flight with it.
    """
    shares = results["models"][name]["share_left"]
    out = []
    if sum(shares) > len(shares):
        left = joined([100 * share for share in shares])
        out.append(
            f"on the unseen half it leaves {left} % of the residual force in surge, sway and yaw"
        )
    for kind in ("course", "crossing", "feed_forward_alone"):
        if name in (flights := results[kind]):
            own, known = (flights[one]["position_mae"] for one in (name, _BELIEVED))
            if own > known:
                out.append(
                    f"its mean position error in the {kind.replace('_', ' ')} is {number(own)} m,"
                    f" the believed model's {number(known)} m"
                )
    return out


def best_model(results: Results) -> str:
    """Return the model that leaves the least of the residual."""
    models: Results = results["models"]
    return min(models, key=lambda name: float(sum(models[name]["share_left"])))


def _residuals(config: FerryStudyConfig, results: Results) -> Table:
    """Return the table of the remaining residual (Tables 4.2, 4.5, 4.7 and 4.15)."""
    unmodelled, base = results["unmodelled_test_mse"], config.published.mse
    rows = []
    first = {"test_mse": unmodelled, "notes": {}}
    for name, model in {_BELIEVED: first, **results["models"]}.items():
        given = config.published if name == _BELIEVED else config.models[name].published
        both = {"ours": (model["test_mse"], unmodelled), "published": (given.mse, base)}
        left = {
            who: [100 * a / b for a, b in zip(mine, of, strict=True)] if mine and of else None
            for who, (mine, of) in both.items()
        }
        rows.append(
            {
                "name": name,
                "mse": model["test_mse"],
                "left": left["ours"],
                "published": {"mse": given.mse, "left": left["published"]},
                "notes": notes_text(model["notes"]),
            }
        )
    return table_of(
        rows,
        [
            ("model", "name"),
            *compared("mse", ("surge N^2", "sway N^2", "yaw (N m)^2")),
            *compared("left", AXES, 3),
            ("chosen by the estimator", "notes"),
        ],
        caption="Mean square of the residual, and what is left of the believed model's.",
        groups=[("mean square", 3), ("% left of the residual force", 3)],
        selected=lambda row: row["name"] == best_model(results),
    )


def _flown(config: FerryStudyConfig, flights: Mapping[str, Results], kind: str) -> list[Block]:
    """Return how well a course is followed and with which forces.

    Tables 4.4, 4.8, 4.10, 4.12 and 4.13 of the document; Tables 4.3 and 4.9.
    """
    rows = []
    for name, metrics in flights.items():
        given = config.published if name == _BELIEVED else config.models[name].published
        printed = given.model_dump()
        if kind == "crossing":
            crossing = {key.partition("crossing_")[2]: value for key, value in printed.items()}
            printed = {key: value for key, value in crossing.items() if key}
        elif kind == "feed_forward_alone":
            printed = {"motion_mse": given.alone}
        rows.append({"name": name, **metrics, "published": printed})
    first = ("feed-forward", "name")
    alone = table_of(
        rows,
        [first, *compared("motion_mse", ("u", "v", "r", "u_dot", "v_dot", "r_dot"))],
        caption="Mean square error against the desired motion without feedback, in (m/s)^2,"
        " (m/s)^2, (rad/s)^2, and the same per second squared.",
    )
    errors = table_of(
        rows,
        [
            first,
            *compared("position_mae", "mean position error m"),
            *compared("position_mse", "mean square m^2"),
            *compared("heading_mae", "mean heading error deg", factor=DEG),
            *compared("power", ("power, position W", "power, heading W")),
            *compared("iaew", ("IAEW, position m s J", "IAEW, heading rad s J")),
        ],
        caption="IAEW is the integral of the error times the work (3.18).",
    )
    units = ("surge N", "sway N", "yaw N m")
    forces = table_of(
        rows,
        [first, *compared("tau", units), *compared("feedback", units)],
        groups=[("mean absolute force", 3), ("mean absolute feedback", 3)],
    )
    return [*([alone] if kind == "feed_forward_alone" else []), errors, forces]


def _forward(rows: Mapping[str, Results]) -> Table:
    """Return the table of free runs beside manoeuvres of the true ferry (3.22)."""
    shown = [
        {
            "name": name,
            **row,
            "rmse": row["rmse"] and [*row["rmse"][:2], DEG * row["rmse"][2]],
            "published": {},
        }
        for name, row in rows.items()
    ]
    return table_of(
        shown,
        [
            ("model", "name"),
            *compared("rmse", ("u m/s", "v m/s", "r deg/s"), 3),
            ("diverged", lambda row: Cell(f"{row['diverged']} of {row['runs']}")),
        ],
        caption="Root mean square errors of free runs from the commanded forces, over the runs that"
        " did not diverge. A model that explains the force may still be no model of motion.",
    )


def _later(later: Mapping[str, Results]) -> Table:
    """Return the table of models on the changed vessel (section 3.7)."""

    def short(value: float) -> str:
        return number(value, 4)

    return table_of(
        [{"name": name, **row} for name, row in later.items()],
        [
            ("model", "name"),
            ("mean position error m", "before.position_mae", short),
            ("after the update m", "after.position_mae", short),
            ("on the new log", "text"),
        ],
        caption="A model that no longer fits is identified again from the log of one course.",
    )
