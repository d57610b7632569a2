"""Planning the next trial of a finished fit: a table, tracks and a YAML file of manoeuvres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.files import whole
from residnet.core.names import nearest
from residnet.data.prepare import samples
from residnet.data.windows import WindowStore
from residnet.identification.planning import Aim, Plan, Trial, TrialLimits, plan, shares_of
from residnet.identification.prepared import prepare_logs, through_currents, velocity_limit
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.inputs import take_logs
from residnet.training.free_runs.covariance import left_open

_SHOWN = 12
"""Candidates in the table."""


@dataclass(frozen=True)
class PlannedTrials:
    """The next trials of a run.

    Attributes:
        model: the refitted baseline that they are for.
        plan: candidates and choice.
    """

    model: str
    plan: Plan

    def text(self) -> str:
        """Return the table and the choice in words."""
        lines = [
            f"Next trials for {self.model}; candidates by what they narrow per minute:",
            f"{'manoeuvre':38s}{'min':>6s}{'reach m':>9s}{'narrower %':>12s}{'volume/min':>12s}",
        ]
        lines += [_line(trial) for trial in self.plan.trials[:_SHOWN]]
        names = ", ".join(trial.flight.motion.name for trial in self.plan.chosen)
        lines.append(
            f"Run {names}: together they narrow the intervals of predictions by"
            f" {100 * self.plan.shrinks:.0f} %, as the model expects it."
        )
        return "\n".join(lines)

    def write(self, folder: Path) -> list[Path]:
        """Write the chosen manoeuvres as YAML and their tracks as CSV; returns the files."""
        folder.mkdir(parents=True, exist_ok=True)
        trials, tracks = folder / "next_trials.yaml", folder / "next_tracks.csv"
        chosen = [
            trial.flight.manoeuvre.model_dump(mode="json", exclude_defaults=False)
            for trial in self.plan.chosen
        ]
        with whole(trials) as file:
            file.write_text(yaml.safe_dump({"manoeuvres": chosen}, sort_keys=False))
        with whole(tracks) as file:
            file.write_text("\n".join(["manoeuvre,t,x,y,psi,u,v,r", *self._tracks()]) + "\n")
        return [trials, tracks]

    def _tracks(self) -> list[str]:
        out = []
        for trial in self.plan.chosen:
            motion = trial.flight.motion
            every = max(round(1.0 / float(motion.t[1] - motion.t[0])), 1)
            rows = np.column_stack((motion.t, motion.stack(("x", "y", "psi", "u", "v", "r"))))
            out += [
                ",".join([motion.name, *(f"{value:.6g}" for value in row)]) for row in rows[::every]
            ]
        return out


def _line(trial: Trial) -> str:
    return (
        f"{trial.flight.motion.name:38s}{trial.minutes:6.1f}{trial.reach:9.0f}"
        f"{100 * trial.shrinks:12.1f}{trial.volume:12.2f}"
    )


def plan_trials(
    config: FitTaskSettings, run: RunFolder, model: str, limits: Mapping[str, Any]
) -> PlannedTrials:
    """Return the trials that would tell most about a refitted baseline.

    Args:
        config: of the finished fit.
        run: its folder.
        model: name of the baseline; empty for the booklet's, else the first that was refitted.
        limits: of `TrialLimits`.

    Raises:
        UsageError: where the run has no such refitted baseline, or no input steers.
        DataError: where no candidate stays within the limits.
    """
    allowed = validate(dict(limits), TrialLimits, "plan-trial")
    store = FolderStore(run)
    refitted = [name for name in config.refit if "refit" in run.fit_notes(name)]
    if not refitted:
        raise UsageError(
            f"{run.path}: no baseline of this run was refitted through rollouts, so nothing says"
            " how sure its parameters are; add `refit` to the config"
        )
    preferred = config.booklet.model if config.booklet is not None else refitted[0]
    name = model or preferred
    if name not in refitted:
        raise UsageError(f"{run.path}: no refitted baseline '{name}'{nearest(name, refitted)}")
    logs, _ = through_currents(prepare_logs(take_logs(config), config), config)
    fitted, train = store.load(name), logs["train"]
    refit = config.refit[name]
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
    booklet = config.booklet
    shares = booklet.inputs if booklet is not None else shares_of(fitted.spec)
    low, high = np.array(fitted.spec.low), np.array(fitted.spec.high)
    limit = velocity_limit(low, high, config.evaluation.divergence)
    aim = None
    if booklet is not None:
        initial = {key: float(value) for key, value in booklet.initial.items()}
        # zigzags and turns of one kind fly together
        manoeuvres = sorted(booklet.manoeuvres, key=lambda manoeuvre: manoeuvre.kind)
        aim = Aim(manoeuvres, booklet.duration, initial)
    return PlannedTrials(name, plan(fitted, open_, refit, scales, shares, limit, allowed, aim))
