"""What a sweep seeks: a free-run error on validation data, or a main figure of any task."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field

from residnet.core.config import Config, load_mapping
from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest
from residnet.runs.folder import RunFolder
from residnet.runs.task import Task
from residnet.tasks.fit import FitConfig


class FreeRunObjective(Config):
    """The least mean NRMSE in free run over the validation data of a fit.

    The protocol is the one that the fit itself selects by. Test data have no say.

    Attributes:
        kind: of the objective.
        model: whose error counts; `selected` for the one that each fit selects.
    """

    kind: Literal["free_run"] = "free_run"
    model: str = "selected"

    @property
    def minimized(self) -> bool:
        """Return that a lesser error is better."""
        return True

    @property
    def watched(self) -> str | None:
        """Return the model whose training may be ended early; None where it is not named."""
        return None if self.model == "selected" else self.model

    @property
    def words(self) -> str:
        """Return what is sought, for tables and axes."""
        return f"validation NRMSE of {self.model} [-]"

    def check(self, task: Task) -> None:
        """Check that runs of a task have this objective.

        Raises:
            UsageError: where the task is no fit, or has no such model.
        """
        if not isinstance(task, FitConfig):
            raise UsageError(
                f"objective: task {task.task} has no free-run error; give objective: {{kind:"
                " figure, name: ..., direction: ...} with a main figure of its summary.json"
            )
        models = ("selected", *task.model_names)
        if self.model not in models:
            raise UsageError(
                f"objective.model: no model is named '{self.model}'{nearest(self.model, models)}"
            )

    def value(self, run: RunFolder) -> float:
        """Return the objective of a finished run.

        Raises:
            DataError: where the run has no such error.
        """
        metrics = run.read_metrics()
        model = metrics["selected"] if self.model == "selected" else self.model
        wanted: dict[str, Any] = {
            "model": model,
            "split": "validation",
            "protocol": load_mapping(run.resolved)["evaluation"]["selection"],
            "manoeuvre": "all",
        }
        for row in metrics["rows"]:
            if all(row[key] == value for key, value in wanted.items()):
                return _finite(row["nrmse"]["mean"], run)
        raise DataError(f"{run.metrics}: has no validation error of model '{model}'")


class FigureObjective(Config):
    """A main figure of summary.json.

    Attributes:
        kind: of the objective.
        name: of the figure, for example `cost`.
        direction: `minimize` or `maximize`.
    """

    kind: Literal["figure"]
    name: str
    direction: Literal["minimize", "maximize"] = "minimize"

    @property
    def minimized(self) -> bool:
        """Return whether a lesser figure is better."""
        return self.direction == "minimize"

    @property
    def watched(self) -> str | None:
        """Return None: no training shows the figure before a run ends."""
        return None

    @property
    def words(self) -> str:
        """Return what is sought, for tables and axes."""
        return self.name

    def check(self, task: Task) -> None:
        """Check that the figure may be sought.

        Raises:
            UsageError: where the task is a fit, whose main figures are errors on test data.
        """
        if isinstance(task, FitConfig):
            raise UsageError(
                "objective: the main figures of a fit are errors on test data, which must not"
                " choose anything; take objective: {kind: free_run}"
            )

    def value(self, run: RunFolder) -> float:
        """Return the objective of a finished run.

        Raises:
            DataError: where the run has no such figure.
        """
        figures = run.read_summary()["figures"]
        if self.name not in figures:
            raise DataError(
                f"{run.summary}: has no main figure '{self.name}'{nearest(self.name, figures)}"
            )
        return _finite(figures[self.name]["value"], run)


ObjectiveConfig = Annotated[FreeRunObjective | FigureObjective, Field(discriminator="kind")]


def _finite(value: float | None, run: RunFolder) -> float:
    if value is None or not math.isfinite(value):
        raise DataError(f"{run.path}: what is sought is not finite")
    return float(value)
