"""residnet: models of real vessels, physics first and learning for the rest.

    import residnet

    logs = residnet.read_logs("trials/*.csv")
    data = residnet.prepare(logs, inputs=["n_port", "n_stbd"])
    models = residnet.fit(data, baseline="regressors", heads=["plsr", "lstm"])
    residnet.free_run(models, data).plot_track()

Nothing heavy is imported before a name is used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from residnet.api.data import Dataset, draft_config, inspect, prepare, read_logs
    from residnet.api.fitting import FreeRuns, Models, fit, free_run, metrics, select_model
    from residnet.api.models import Model, Monitor, export_model, load, save, trust
    from residnet.api.tasks import (
        RunResult,
        SimulationResult,
        baseline,
        head,
        list_available,
        manoeuvre,
        run,
        simulate,
        vessel,
    )
    from residnet.api.training import HeadTrainingRun, head_training
    from residnet.autopilot.api import design_autopilot, train_autopilot
    from residnet.core.errors import ResidnetError
    from residnet.core.log import Log
    from residnet.core.progress import Progress
    from residnet.core.version import __version__

_HOME = {
    "core.version": "__version__",
    "core.errors": "ResidnetError",
    "core.log": "Log",
    "core.progress": "Progress",
    "api.data": "Dataset draft_config inspect prepare read_logs",
    "api.models": "Model Monitor export_model load save trust",
    "api.fitting": "FreeRuns Models fit free_run metrics select_model",
    "api.tasks": (
        "RunResult SimulationResult baseline head list_available manoeuvre run simulate vessel"
    ),
    "api.training": "HeadTrainingRun head_training",
    "autopilot.api": "design_autopilot train_autopilot",
}

__all__ = [
    "Dataset",
    "FreeRuns",
    "HeadTrainingRun",
    "Log",
    "Model",
    "Models",
    "Monitor",
    "Progress",
    "ResidnetError",
    "RunResult",
    "SimulationResult",
    "__version__",
    "baseline",
    "design_autopilot",
    "draft_config",
    "export_model",
    "fit",
    "free_run",
    "head",
    "head_training",
    "inspect",
    "list_available",
    "load",
    "manoeuvre",
    "metrics",
    "prepare",
    "read_logs",
    "run",
    "save",
    "select_model",
    "simulate",
    "train_autopilot",
    "trust",
    "vessel",
]


def __getattr__(name: str) -> Any:
    home = next((module for module, names in _HOME.items() if name in names.split()), None)
    if home is None:
        raise AttributeError(f"module 'residnet' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"residnet.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
