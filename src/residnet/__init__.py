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
    from residnet.core.errors import ResidnetError
    from residnet.core.log import Log
    from residnet.core.progress import Progress
    from residnet.core.version import __version__
    from residnet.face.data import Data, prepare
    from residnet.face.drafting import draft
    from residnet.face.fitting import Models, fit, metrics, select
    from residnet.face.logs import inspect, read_logs
    from residnet.face.models import Model, export_model, load, save
    from residnet.face.monitoring import Monitor
    from residnet.face.parts import available, baseline, head
    from residnet.face.runs import FreeRuns, free_run
    from residnet.face.simulation import Trials, manoeuvre, simulate, vessel
    from residnet.face.tasks import Result, autopilot, run

_HOME = {
    "__version__": "core.version",
    "Data": "face.data",
    "FreeRuns": "face.runs",
    "Log": "core.log",
    "Model": "face.models",
    "Models": "face.fitting",
    "Monitor": "face.monitoring",
    "Progress": "core.progress",
    "ResidnetError": "core.errors",
    "Result": "face.tasks",
    "Trials": "face.simulation",
    "autopilot": "face.tasks",
    "available": "face.parts",
    "baseline": "face.parts",
    "draft": "face.drafting",
    "export_model": "face.models",
    "fit": "face.fitting",
    "free_run": "face.runs",
    "head": "face.parts",
    "inspect": "face.logs",
    "load": "face.models",
    "manoeuvre": "face.simulation",
    "metrics": "face.fitting",
    "prepare": "face.data",
    "read_logs": "face.logs",
    "run": "face.tasks",
    "save": "face.models",
    "select": "face.fitting",
    "simulate": "face.simulation",
    "vessel": "face.simulation",
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
