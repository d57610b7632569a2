"""A recursive refit of a model in service, as a run of its own beside the old one."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import dump_config
from residnet.core.errors import DataError, UsageError
from residnet.core.progress import say
from residnet.data.prepare import Prepared
from residnet.identification.identified import candidates, evaluate
from residnet.identification.models import FittedModel
from residnet.identification.prepared import require_window, velocity_limit
from residnet.identification.recursive_refit import Moved, Refit, recursive_refit, refitted
from residnet.judge.metrics import find
from residnet.judge.rollout_files import write_rollouts
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.provenance import Provenance
from residnet.runs.task import Outcome
from residnet.tasks.fit.config import FitTaskSettings
from residnet.tasks.fit.external import SPLIT
from residnet.tasks.fit.files import fit_outcome, write_data_quality, write_limits, write_metrics
from residnet.tasks.fit.watching import Service

_HELD = 3
"""One log of so many, the last ones, is kept to judge by."""


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
        return [
            *out,
            f"refit: on the logs held out: {errors}",
            f"refit: it IS worth taking; {self.folder}"
            if self.worth
            else f"refit: it is NOT worth taking; it stands in {self.folder}, with the old model"
            " selected",
        ]

    def content(self) -> dict[str, Any]:
        """Return what was found as JSON takes it."""
        judged = self.folder is not None
        return {
            "changes": [_row(one) for one in self.found.moved],
            "ended": self.found.ended,
            "run": str(self.folder) if judged else None,
            "nrmse_old": self.old if judged else None,
            "nrmse_new": self.new if judged else None,
            "worth_taking": self.worth,
        }


def _row(moved: Moved) -> dict[str, Any]:
    return {
        "cause": moved.change.name,
        "size": moved.size,
        "standard_error": moved.error,
        "unit": moved.change.unit,
        "after_each_log": list(moved.after),
    }


def require_refit(run: RunFolder, out: Path, config: FitTaskSettings) -> None:
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


def refit_run(config: FitTaskSettings, run: RunFolder, service: Service, out: Path) -> RefitRun:
    """Refit a model on the first two thirds of the new logs, and judge it on the others.

    The new run holds `zero`, the old model under its name, and the new one as `<name>_refit`.

    Args:
        config: of the finished fit.
        run: its folder, which stays as it is.
        service: the model, the watch over it and the new logs.
        out: folder of the new run.

    Raises:
        UsageError: where the folder may not be used, or the model has no parameters to move.
        DataError: where there are fewer than two logs, or one is too short.
    """
    if len(service.logs) < 2:
        raise DataError(
            "a refit needs at least two new logs, the last of which are held out to judge it; give"
            " more --logs, or cut the log into several"
        )
    for log in service.logs:
        require_window(log, config)
    held = max(len(service.logs) // _HELD, 1)
    used, kept = service.logs[:-held], service.logs[-held:]
    say(f"recursive refit of {service.fitted.name} on {len(used)} logs, {held} held out")
    found = recursive_refit(service.watch, [service.windows(log) for log in used])
    if not found.moved:
        return RefitRun(found)
    new = refitted(service.fitted, found)
    folder = RunFolder.create(out, dump_config(config))
    made_from = Provenance(run.resolved, (), config.seed, service.files, time.time())
    finished = config.conduct(
        folder, made_from, lambda place: _judged(config, run, service.fitted, new, kept, place)
    )
    rows = finished.folder.read_metrics()["rows"]
    asked = {"split": SPLIT, "protocol": config.evaluation.selection, "manoeuvre": "all"}
    old_row = find(rows, model=service.fitted.name, **asked)
    new_row = find(rows, model=new.name, **asked)
    chosen = finished.folder.read_metrics()["selected"]
    return RefitRun(
        found, out, old_row["nrmse"]["mean"], new_row["nrmse"]["mean"], chosen == new.name
    )


def _judged(
    config: FitTaskSettings,
    run: RunFolder,
    old: FittedModel,
    new: FittedModel,
    logs: Sequence[Prepared],
    folder: RunFolder,
) -> Outcome:
    """Keep the models, free-run them on the logs held out, and write what was found."""
    beside = [name for name in ("zero", old.name) if (run.models / name).is_dir()]
    for name in dict.fromkeys(beside):
        shutil.copytree(run.models / name, folder.models / name)
    store = FolderStore(folder)
    store.keep(new)
    fitted = [store.load(name) for name in dict.fromkeys([*beside, new.name])]
    models = [
        replace(one, reference=old.name) if one.name == new.name else one
        for one in candidates(fitted)
    ]
    limit = velocity_limit(
        np.array(old.spec.low), np.array(old.spec.high), config.evaluation.divergence
    )
    judged = evaluate(models, logs, config.evaluation, config.prepare.grid.step, limit)
    write_rollouts(folder.rollouts / SPLIT, judged.runs, logs, config.signals.columns, judged.bands)
    write_data_quality(folder, {SPLIT: logs})
    chosen = new.name if _worth(judged.rows, config, new.name) else old.name
    write_metrics(folder, config, judged.rows, chosen, None)
    write_limits(folder, config, {SPLIT: judged.limits}, logs)
    outcome = fit_outcome(folder, SPLIT)
    return replace(outcome, verdict=[*outcome.verdict, *_words(new, chosen)])


def _worth(rows: Sequence[Mapping[str, Any]], config: FitTaskSettings, new: str) -> bool:
    """Return whether the new model errs less by more than chance leaves open."""
    row = find(rows, model=new, split=SPLIT, protocol=config.evaluation.selection, manoeuvre="all")
    found = row["difference"]
    upper = found["ci95"][1] if found["ci95"] is not None else found["nrmse_mean"]
    return bool(row["diverged"] == 0 and upper < 0.0)


def _words(new: FittedModel, chosen: str) -> list[str]:
    changes = ", ".join(f"{one['cause']} {one['size']:+.3g}" for one in new.notes["refit_changes"])
    worth = "is worth taking" if chosen == new.name else "is not worth taking"
    return [f"The recursive refit ({changes}) {worth} by the logs that were held out."]
