"""Models that earlier runs learned, by the folder of the run and the name of the model."""

from __future__ import annotations

from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.files import read_json
from residnet.core.names import nearest
from residnet.dynamics.store import model_names


def chosen_model(run: Path, name: str) -> str:
    """Return the name of a model in its run; `selected` is the one that validation chose.

    Raises:
        UsageError: where there is no such folder or no such model in it.
    """
    if not run.is_dir():
        raise UsageError(
            f"{run}: no such folder; run the fit first that identifies the model (residnet run"
            f" CONFIG --out {run})"
        )
    names = model_names(run / "models")
    if name != "selected" and name in names:
        return name
    metrics = run / "metrics.json"
    selected = (
        str(read_json(metrics).get("selected")) if name == "selected" and metrics.is_file() else ""
    )
    if selected not in names:
        raise UsageError(
            f"{run}: no model"
            f" '{name}'{nearest(name, names) if names else '; not the folder of a finished fit'}"
        )
    return selected
