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
    from residnet.api.data import Data, prepare
    from residnet.api.drafting import draft
    from residnet.api.fitting import Models, fit, metrics, select
    from residnet.api.logs import inspect, read_logs
    from residnet.api.models import Model, export_model, load, save
    from residnet.api.monitoring import Monitor
    from residnet.api.parts import available, baseline, head
    from residnet.api.runs import FreeRuns, free_run
    from residnet.api.simulation import Trials, manoeuvre, simulate, vessel
    from residnet.api.tasks import Result, autopilot, run
    from residnet.core.errors import ResidnetError
    from residnet.core.log import Log
    from residnet.core.progress import Progress
    from residnet.core.version import __version__

_HOME = {
    "__version__": "core.version",
    "Data": "api.data",
    "FreeRuns": "api.runs",
    "Log": "core.log",
    "Model": "api.models",
    "Models": "api.fitting",
    "Monitor": "api.monitoring",
    "Progress": "core.progress",
    "ResidnetError": "core.errors",
    "Result": "api.tasks",
    "Trials": "api.simulation",
    "autopilot": "api.tasks",
    "available": "api.parts",
    "baseline": "api.parts",
    "draft": "api.drafting",
    "export_model": "api.models",
    "fit": "api.fitting",
    "free_run": "api.runs",
    "head": "api.parts",
    "inspect": "api.logs",
    "load": "api.models",
    "manoeuvre": "api.simulation",
    "metrics": "api.fitting",
    "prepare": "api.data",
    "read_logs": "api.logs",
    "run": "api.tasks",
    "save": "api.models",
    "select": "api.fitting",
    "simulate": "api.simulation",
    "vessel": "api.simulation",
}

__all__ = [
    "Data",
    "FreeRuns",
    "Log",
    "Model",
    "Models",
    "Monitor",
    "Progress",
    "ResidnetError",
    "Result",
    "Trials",
    "__version__",
    "autopilot",
    "available",
    "baseline",
    "draft",
    "export_model",
    "fit",
    "free_run",
    "head",
    "inspect",
    "load",
    "manoeuvre",
    "metrics",
    "prepare",
    "read_logs",
    "run",
    "save",
    "select",
    "simulate",
    "vessel",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'residnet' has no attribute '{name}'")
    value = getattr(importlib.import_module(f"residnet.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
