"""A fit in service: watched on new logs, refitted to a changed vessel, its next trials planned."""

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

from residnet.core.config import dump_config, validate
from residnet.core.errors import DataError, UsageError
from residnet.core.files import whole
from residnet.core.format import fixed, number, plural
from residnet.core.layout import SIX
from residnet.core.names import nearest
from residnet.core.ownership import recorded_folder
from residnet.core.progress import say
from residnet.data.prepare import samples
from residnet.data.windows import WindowStore
from residnet.identification.identified import candidates, evaluate
from residnet.identification.monitoring import MonitorConfig, Verdict, Watch, Watcher
from residnet.identification.planning import Aim, Plan, TrialLimits, plan, shares_of
from residnet.identification.prepared import prepare_logs, require_window, through_currents
from residnet.identification.recursive_refit import Refit, recursive_refit, refitted
from residnet.judge.metrics import find
from residnet.report.blocks import Section, Table, bad_where, table_of
from residnet.report.figure import DASHED, GLANCE, SOLID, ZERO, Case, Figure, Panel, family
from residnet.report.figure_files import write_figure
from residnet.report.page import write_page
from residnet.runs.folder import Provenance, RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.task import Outcome
from residnet.tasks.fit_outcome import (
    SPLIT,
    external_logs,
    fit_outcome,
    limit_of,
    write_judged,
)
from residnet.training.left_out import left_open

if TYPE_CHECKING:
    from residnet.tasks.fit import FitConfig

_NAMED = 3
"""Causes that are named."""
_HELD = 3
"""One log of so many, the last ones, is kept to judge a refit by."""
_SHOWN = 12
"""Candidates for trials in the table."""


@dataclass(frozen=True)
class WatchedLog:
    """What a monitor found in one log.

    Attributes:
        name: of the log.
        since: time in s from its start to the first alarm; None where there was none.
        last: the verdict at its end.
        window: length of its windows in s.
        scores: the largest score of any cause after each of them.
    """

    name: str
    since: float | None
    last: Verdict
    window: float
    scores: Sequence[float]

    @property
    def windows(self) -> int:
        """How many windows it held."""
        return len(self.scores)

    def content(self) -> dict[str, Any]:
        """Return what was found as JSON takes it."""
        return {
            "log": self.name,
            "windows": self.windows,
            "alarm_after": self.since,
            "threshold": self.last.threshold,
            "innovation": self.last.innovation,
            "suspects": [
                {
                    "cause": suspect.change.name,
                    "score": suspect.score,
                    "size": suspect.size,
                    "standard_error": suspect.error,
                    "unit": suspect.change.unit,
                    "explains": suspect.explains,
                }
                for suspect in self.last.suspects
            ],
        }

    def text(self) -> list[str]:
        """Return what was found in words."""
        state = "no alarm" if self.since is None else f"ALARM after {self.since:.0f} s"
        named = self.last.suspects[: _NAMED if self.since is not None else 1]
        return [f"{self.name}: {state} ({self.windows} windows)"] + [
            f"  {suspect.change.name}: score {suspect.score:.1f} of {self.last.threshold:.1f},"
            f" size {suspect.size:+.3g} +- {suspect.error:.2g} {suspect.change.unit}"
            f" (the logs look as if {suspect.change.words})"
            for suspect in named
        ]


class Service:
    """A model in service, the watch over it, and the logs that are new.

    Args:
        paths: logs, in the order of time.
        model: name of the model; `selected` for the one chosen on validation data.
        settings: of `MonitorConfig`.

    Raises:
        UsageError: where there is no such model or path.
        DataError: where a log cannot be used, or clean logs are too few.
    """

    def __init__(
        self,
        config: FitConfig,
        run: RunFolder,
        paths: Sequence[Path],
        model: str,
        settings: Mapping[str, Any],
    ) -> None:
        chosen = validate(dict(settings), MonitorConfig, "monitor")
        store = FolderStore(run)
        name = str(run.read_metrics()["selected"]) if model == "selected" else model
        if name not in store.names():
            valid = ["selected", *store.names()]
            raise UsageError(f"{run.path}: no model '{name}'{nearest(name, valid)}")
        self.config, self.run, self.fitted = config, run, store.load(name)
        self.files, _, self.logs = external_logs(config, paths)
        # clean logs over ground, as new ones are: a current is taken out of either alike
        clean = prepare_logs(config.logs(), config)
        known = [*clean["train"], *clean["validation"]]
        self.watch = Watch.of(self.fitted.spec, self.fitted.model, known, chosen)

    def watched(self) -> list[WatchedLog]:
        """Watch the logs one after the other; what is looked back over goes on between them.

        Raises:
            DataError: where a log holds no window.
        """
        watcher, out = Watcher(self.watch), []
        for log in self.logs:
            found = self.watch.windows(log)
            watcher.restart()
            verdicts = [watcher.take(sums) for sums in self.watch.sums(found)]
            alarms = np.flatnonzero([verdict.alarm for verdict in verdicts])
            first = (int(alarms[0]) + 1) * self.watch.config.window if alarms.size else None
            scores = [verdict.largest for verdict in verdicts]
            window = self.watch.config.window
            out.append(WatchedLog(log.log.name, first, verdicts[-1], window, scores))
        return out


def write_watched(folder: Path, logs: Sequence[WatchedLog]) -> Path:
    """Write the page of what a monitor found: which logs raise an alarm, and the scores over time.

    Args:
        logs: in the order of time.
    """
    step = logs[0].window / 60.0
    alarmed = [log for log in logs if log.since is not None]
    told = [f"No alarm in {plural(len(logs), 'log')}: the model fits them as it fitted its own."]
    if alarmed:
        first = alarmed[-1].last.suspects[0].change
        told = [
            f"ALARM in {len(alarmed)} of {plural(len(logs), 'log')}: as if {first.words}.",
            "Another cause may look alike: see the scores of all causes.",
        ]
    ends = step * np.cumsum([log.windows for log in logs])
    scores = np.concatenate([log.scores for log in logs])
    threshold = logs[0].last.threshold
    curves = {
        "score": (step * (1.0 + np.arange(len(scores))), scores),
        "threshold": (np.zeros(1), np.array([threshold])),
        "logs": (ends, ends),
    }
    figure = Figure(
        "scores",
        "Largest score over time",
        "The largest score of any cause after each window; above the threshold it is an alarm.",
        {
            "score": replace(SOLID, label="largest score"),
            "threshold": replace(DASHED, label="threshold", kind="across"),
            "logs": replace(ZERO, label="end of a log", kind="upright", dash="dotted"),
        },
        [Panel("score [-]", "time of the logs [min]", height=GLANCE)],
        [Case("", [curves])],
    )
    glance = table_of(
        logs,
        [
            ("log", lambda log: log.name),
            (
                "alarm",
                lambda log: bad_where(
                    "no" if log.since is None else f"after {log.since:.0f} s", log.since
                ),
            ),
            ("likeliest cause", lambda log: log.last.suspects[0].change.name),
            ("score", lambda log: number(log.last.suspects[0].score), str),
        ],
        selected=lambda log: log.since is not None,
    )
    suspects = table_of(
        [(log, suspect) for log in logs for suspect in log.last.suspects],
        [
            ("log", lambda row: row[0].name),
            ("cause", lambda row: row[1].change.name),
            ("score", lambda row: number(row[1].score), str),
            ("size", lambda row: f"{number(row[1].size)} {row[1].change.unit}", str),
            ("standard error", lambda row: number(row[1].error, 2), str),
            ("the logs look as if", lambda row: row[1].change.words),
        ],
        rule=lambda row: row[0].name,
    )
    return write_page(
        folder,
        "New logs watched",
        f"{plural(len(scores), 'window')} of {logs[0].window:g} s, threshold {number(threshold)}",
        told,
        [
            Section("", [write_figure(folder / "figures", figure), glance]),
            Section("Every cause, at the end of each log", [suspects], folded=True),
        ],
    )


@dataclass(frozen=True)
class RefitRun:
    """What a recursive refit has found, and whether it is worth taking.

    Attributes:
        found: the changes that were put into the model.
        folder: of the new run; None where the monitor named no change to refit.
        old: mean free-run error (NRMSE) of the old model on the logs that were held out.
        new: that of the new one.
        worth: whether the new one is better by more than a paired interval leaves open.
    """

    found: Refit
    folder: Path | None = None
    old: float = float("nan")
    new: float = float("nan")
    worth: bool = False

    def text(self) -> list[str]:
        """Return what was found in words."""
        out = [
            f"refit: {one.change.name} {one.size:+.3g} +- {one.error:.2g} {one.change.unit}, after"
            f" each log {', '.join(f'{size:+.3g}' for size in one.after)}"
            for one in self.found.moved
        ]
        out.append(f"refit: ended since {self.found.ended}")
        if self.folder is None:
            return [*out, "refit: no model was written; the old one stays"]
        errors = f"old {self.old:.4f}, new {self.new:.4f} (mean NRMSE of free runs)"
        worth = (
            f"it IS worth taking; {self.folder}"
            if self.worth
            else f"it is NOT worth taking; it stands in {self.folder}, with the old model selected"
        )
        return [*out, f"refit: on the logs held out: {errors}", f"refit: {worth}"]

    def content(self) -> dict[str, Any]:
        """Return what was found as JSON takes it."""
        judged = self.folder is not None
        return {
            "changes": [
                {
                    "cause": one.change.name,
                    "size": one.size,
                    "standard_error": one.error,
                    "unit": one.change.unit,
                    "after_each_log": list(one.after),
                }
                for one in self.found.moved
            ],
            "ended": self.found.ended,
            "run": str(self.folder) if judged else None,
            "nrmse_old": self.old if judged else None,
            "nrmse_new": self.new if judged else None,
            "worth_taking": self.worth,
        }


def require_refit(run: RunFolder, out: Path, config: FitConfig) -> None:
    """Check that a refit may write its run, before any work.

    Raises:
        UsageError: where the folder exists, or lies within that of the old run.
    """
    if out.resolve().is_relative_to(run.path.resolve()):
        raise UsageError(
            f"{out}: lies within the run {run.path}, which a refit leaves as it is; give another"
            " folder for --refit"
        )
    RunFolder(out).require(dump_config(config))


def refit_run(service: Service, out: Path) -> RefitRun:
    """Refit a model on the first two thirds of the new logs, and judge it on the others.

    The new run holds `zero`, the old model under its name, and the new one as `<name>_refit`.

    Args:
        service: the model, the watch over it and the new logs.

    Raises:
        UsageError: where the folder may not be used, or the model has no parameters to move.
        DataError: where there are fewer than two logs, or one is too short.
    """
    config, old = service.config, service.fitted
    if len(service.logs) < 2:
        raise DataError(
            "a refit needs at least two new logs, the last of which are held out to judge it; give"
            " more --logs, or cut the log into several"
        )
    for log in service.logs:
        require_window(log, config)
    held = max(len(service.logs) // _HELD, 1)
    used, kept = service.logs[:-held], service.logs[-held:]
    say(f"recursive refit of {old.name} on {len(used)} logs, {held} held out")
    found = recursive_refit(service.watch, [service.watch.windows(log) for log in used])
    if not found.moved:
        return RefitRun(found)
    new = refitted(old, found)
    asked = {"split": SPLIT, "protocol": config.evaluation.selection, "manoeuvre": "all"}
    made_from = Provenance(service.run.resolved, (), config.seed, service.files, time.time())
    errors: dict[str, Any] = {}

    def judge(folder: RunFolder) -> Outcome:
        store, models = FolderStore(folder), service.run.models
        beside = [name for name in dict.fromkeys(("zero", old.name)) if (models / name).is_dir()]
        for name in beside:
            shutil.copytree(models / name, folder.models / name)
        store.keep(new)
        judged = evaluate(
            [
                replace(one, reference=old.name) if one.name == new.name else one
                for one in candidates([store.load(name) for name in (*beside, new.name)])
            ],
            {SPLIT: kept},
            config.evaluation,
            config.prepare.grid.step,
            limit_of(old.spec, config),
        )
        row = find(judged[SPLIT].rows, model=new.name, **asked)
        gain = row["difference"]
        upper = gain["nrmse_mean"] if gain["ci95"] is None else gain["ci95"][1]
        worth = bool(row["diverged"] == 0 and upper < 0.0)
        before = find(judged[SPLIT].rows, model=old.name, **asked)
        errors.update(old=before["nrmse"]["mean"], new=row["nrmse"]["mean"], worth=worth)
        chosen = new.name if worth else old.name
        write_judged(folder, config, judged, (chosen, None, chosen), {SPLIT: kept})
        changes = [f"{one['cause']} {one['size']:+.3g}" for one in new.notes["refit_changes"]]
        sentence = (
            f"The recursive refit ({', '.join(changes)}) is {'' if worth else 'not '}worth taking"
            " by the logs that were held out."
        )
        outcome = fit_outcome(folder, SPLIT)
        return replace(outcome, verdict=[*outcome.verdict, sentence])

    with RunFolder(out).held():
        config.conduct(RunFolder.create(out, dump_config(config)), made_from, judge)
    return RefitRun(found, out, **errors)


@dataclass(frozen=True)
class PlannedTrials:
    """The next trials of a run.

    Attributes:
        model: the refitted baseline that they are for.
        plan: candidates and choice.
    """

    model: str
    plan: Plan

    @property
    def table(self) -> Table:
        """The candidates, the most telling per minute first; those to run are marked."""
        return table_of(
            self.plan.trials[:_SHOWN],
            [
                ("manoeuvre", lambda trial: trial.flight.motion.name),
                ("time [min]", lambda trial: fixed(trial.minutes, 1), str),
                ("reach [m]", lambda trial: fixed(trial.reach, 0), str),
                ("narrower by [%]", lambda trial: fixed(100 * trial.shrinks, 1), str),
                ("volume per minute", lambda trial: fixed(trial.volume, 2), str),
            ],
            caption=f"Candidates for {self.model}, by what they narrow per minute.",
            selected=lambda trial: any(trial is one for one in self.plan.chosen),
        )

    @property
    def choice(self) -> str:
        """What to run, and by how much that narrows predictions, in a sentence."""
        names = ", ".join(trial.flight.motion.name for trial in self.plan.chosen)
        return (
            f"Run {names}: together they narrow the intervals of predictions by"
            f" {100 * self.plan.shrinks:.0f} %, as the model expects it."
        )

    def text(self) -> str:
        """Return the table and the choice in words."""
        return f"{self.table.text()}\n{self.choice}"

    def write(self, folder: Path) -> list[Path]:
        """Write the chosen manoeuvres as YAML, tracks as CSV, and a page; returns the files."""
        with recorded_folder(folder):
            return self._write(folder)

    def _write(self, folder: Path) -> list[Path]:
        trials, tracks = folder / "next_trials.yaml", folder / "next_tracks.csv"
        flights = [trial.flight for trial in self.plan.chosen]
        chosen = [flight.manoeuvre.model_dump(mode="json") for flight in flights]
        states = [name for name in SIX.names if name in flights[0].motion.channels]
        lines = [",".join(("manoeuvre", "t", *states))]
        for motion in (flight.motion for flight in flights):
            every = max(round(1.0 / float(motion.t[1] - motion.t[0])), 1)
            rows = np.column_stack((motion.t, motion.stack(states)))
            lines += [
                ",".join([motion.name, *(f"{value:.6g}" for value in row)]) for row in rows[::every]
            ]
        with whole(trials) as file:
            file.write_text(yaml.safe_dump({"manoeuvres": chosen}, sort_keys=False))
        with whole(tracks) as file:
            file.write_text("\n".join(lines) + "\n")
        curves = {
            motion.name: (motion["y"] - motion["y"][0], motion["x"] - motion["x"][0])
            for motion in (flight.motion for flight in flights)
        }
        panel = Panel("north [m]", "east [m]", kind="map", height=300)
        figure = Figure(
            "tracks", "Tracks", "As the model flies them.", family(curves), [panel],
            [Case("", [curves])],
        )  # fmt: skip
        shown = Section("", [write_figure(folder / "figures", figure), self.table.part(0, 3)])
        table = Section("Candidates", [self.table], folded=True)
        about = f"For {self.model}."
        page = write_page(folder, "Next trials", about, [self.choice], [shown, table])
        return [trials, tracks, page]


def plan_trials(
    config: FitConfig, run: RunFolder, model: str, limits: Mapping[str, Any]
) -> PlannedTrials:
    """Return the trials that would tell most about a refitted baseline, see `FitConfig`."""
    allowed = validate(dict(limits), TrialLimits, "plan-trial")
    known = [name for name in config.refit if "refit" in run.fit_notes(name)]
    if not known:
        raise UsageError(
            f"{run.path}: no baseline of this run was refitted through rollouts, so nothing says"
            " how sure its parameters are; add `refit` to the config"
        )
    booklet = config.booklet
    name = model or (booklet.model if booklet is not None else known[0])
    if name not in known:
        raise UsageError(f"{run.path}: no refitted baseline '{name}'{nearest(name, known)}")
    logs, _ = through_currents(prepare_logs(config.logs(), config), config)
    fitted, train, refit = FolderStore(run).load(name), logs["train"], config.refit[name]
    refit = refit.with_prior(float(fitted.notes.get("prior", refit.prior)))
    scales = config.evaluation.scales.array()
    open_ = left_open(
        fitted.model.double(),
        samples(train, config.signals.build()),
        WindowStore.gather(train, torch.float64),
        refit,
        torch.from_numpy(scales),
        fitted.notes["refit"].get("at_rest", ()),
    )
    limit, aim = limit_of(fitted.spec, config), None
    if booklet is None:
        shares = shares_of(fitted.spec)
    else:
        initial = {key: float(value) for key, value in booklet.initial.items()}
        # zigzags and turns of one kind fly together
        manoeuvres = sorted(booklet.manoeuvres, key=lambda manoeuvre: manoeuvre.kind)
        aim, shares = Aim(manoeuvres, booklet.duration, initial), booklet.inputs
    return PlannedTrials(name, plan(fitted, open_, refit, scales, shares, limit, allowed, aim))
