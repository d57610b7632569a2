"""What a sweep leaves: sweep.json, the best config, and the verdict."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.core.config import dump_config
from residnet.report.sections.sweep import trials_table
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome
from residnet.tasks.sweep.config import SweepConfig
from residnet.tasks.sweep.trial import trial_folder, trial_task

if TYPE_CHECKING:
    import optuna

BEST = "best.yaml"
_WORDS = {"COMPLETE": "finished", "PRUNED": "ended early", "FAIL": "failed"}


def write_results(config: SweepConfig, study: optuna.Study, folder: RunFolder) -> Outcome:
    """Write sweep.json and best.yaml; returns what the sweep found."""
    rows = [_row(config, trial) for trial in study.get_trials(deepcopy=False)]
    finished = [row for row in rows if row["state"] == "finished"]
    sign = 1.0 if config.objective.minimized else -1.0
    best = min(finished, key=lambda row: (sign * row["value"], row["number"]), default=None)
    content = {
        "schema": "residnet.sweep/1",
        "run": config.name,
        "objective": config.objective.words,
        "minimized": config.objective.minimized,
        "search": config.search.kind,
        "keys": list(config.space),
        "log": [key for key, values in config.space.items() if values.log],
        "best": None if best is None else best["number"],
        "importance": _importance(study, len(finished)),
        "trials": rows,
    }
    folder.write_json(folder.path / "sweep.json", content)
    figures = {
        "finished": MainFigure(len(finished)),
        "ended_early": MainFigure(sum(row["state"] == "ended early" for row in rows)),
        "failed": MainFigure(sum(row["state"] == "failed" for row in rows)),
    }
    if best is None:
        first = next((row["fault"] for row in rows if row["fault"]), "none came to its end")
        return Outcome(
            ["No trial of the sweep has a value."],
            figures,
            failure=f"{config.name}: no trial has a value; the first fault: {first}",
        )
    task = trial_task(config, _distributed(best["values"]), f"{config.name}.best")
    folder.write(folder.path / BEST, dump_config(task))
    return Outcome(
        _verdict(config, rows, best),
        {"best": MainFigure(best["value"]), **figures},
        trials_table(content).text(),
    )


def _row(config: SweepConfig, trial: Any) -> dict[str, Any]:
    values = {
        key: json.loads(value) if isinstance(value, str) else value
        for key, value in ((key, trial.params[key]) for key in config.space)
    }
    return {
        "number": trial.number,
        "state": _WORDS[trial.state.name],
        "value": trial.value if trial.state.name == "COMPLETE" else None,
        "seconds": trial.user_attrs.get("seconds", 0.0),
        "fault": trial.user_attrs.get("fault", ""),
        "values": values,
    }


def _distributed(values: dict[str, Any]) -> dict[str, Any]:
    """Return values of a row as overrides take them."""
    return {key: json.dumps(value) for key, value in values.items()}


def _importance(study: optuna.Study, finished: int) -> dict[str, float]:
    """Return the share of each key in the variance of the objective; empty for too few trials."""
    if finished < 4:
        return {}
    from optuna.importance import FanovaImportanceEvaluator, get_param_importances

    try:
        found = get_param_importances(study, evaluator=FanovaImportanceEvaluator(seed=0))
    except (RuntimeError, ValueError):
        # all values are alike: there is no variance to share
        return {}
    return {key: float(share) for key, share in found.items()}


def _verdict(config: SweepConfig, rows: list[dict[str, Any]], best: dict[str, Any]) -> list[str]:
    drawn = ", ".join(f"{key} = {json.dumps(value)}" for key, value in best["values"].items())
    sought = config.objective.words.removesuffix(" [-]")
    early = sum(row["state"] == "ended early" for row in rows)
    failed = [row for row in rows if row["state"] == "failed"]
    sentences = [
        f"Trial {best['number']} of {len(rows)} is the best: {sought}"
        f" {best['value']:.5g}, with {drawn}.",
        f"Its run is {trial_folder(Path(), best['number'])} in the sweep's folder, and the config"
        f" {BEST} there repeats it.",
    ]
    if early:
        sentences.append(f"{early} trials were ended early.")
    if failed:
        sentences.append(f"{len(failed)} trials failed; the first: {failed[0]['fault']}.")
    finished = [row["value"] for row in rows if row["value"] is not None]
    if len(finished) > 1:
        sentences.append(
            f"The best of {len(finished)} values is lucky as well as good: judge it on data that"
            " chose nothing, such as the test split of its run."
        )
    return sentences
