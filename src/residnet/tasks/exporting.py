"""`residnet export`, and the exports at the end of a fit."""

from __future__ import annotations

from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.dynamics.store import load_model, model_names
from residnet.export.torchscript import export_torchscript
from residnet.run_folder import RunFolder


def export_model(path: Path, name: str, out: Path | None) -> Path:
    """Export one model of a finished run as TorchScript; returns the file.

    Raises:
        UsageError: where the run or the model does not exist.
        ExportError: where the exported module differs from the model.
    """
    folder = RunFolder.open(path)
    content = folder.read_metrics()
    chosen = str(content["selected"]) if name == "selected" else name
    if chosen not in model_names(folder.models):
        raise UsageError(f"{path}: no model '{name}'{nearest(name, ['selected', *model_names(folder.models)])}")
    spec, model = load_model(folder.models / chosen)
    rows = [row for row in content["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"]
    file = out or folder.exports / f"{chosen}.pt"
    export_torchscript(spec, model, file, rows)
    return file
