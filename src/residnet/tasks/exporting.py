"""`residnet export`, and the exports at the end of a fit."""

from __future__ import annotations

from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.dynamics.store import load_model, model_names
from residnet.export.feed_forward import export_feed_forward, required_force
from residnet.export.torchscript import export_torchscript
from residnet.run_folder import RunFolder


def export_model(path: Path, name: str, out: Path | None, form: str = "torchscript") -> Path:
    """Export one model of a finished run, `torchscript` to run it or `feed_forward` for the force that a motion needs; returns the file.

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
    if form == "feed_forward":
        force, ranges = required_force(spec, model)
        file = out or folder.exports / f"{chosen}_feed_forward.pt"
        export_feed_forward(force, None, ranges, file)
        return file
    rows = [row for row in content["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"]
    file = out or folder.exports / f"{chosen}.pt"
    export_torchscript(spec, model, file, rows)
    return file
