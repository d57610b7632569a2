"""Exporting a model of a finished fit."""

from __future__ import annotations

from pathlib import Path

from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.dynamics.store import load_model, model_names
from residnet.export import exporter
from residnet.export.vessel import ExportedVessel
from residnet.runs.folder import RunFolder


def export_model(run: RunFolder, name: str, out: Path | None, file_format: str) -> Path:
    """Export one model of a fit in the format of that name, and return the file.

    Args:
        run: of the fit.
        name: of the model; `selected` for the one chosen on validation data.
        out: file to write; exports/<model> with the format's suffix where not given.
        file_format: one of `residnet list formats`.

    Raises:
        ConfigError: where there is no such format.
        UsageError: where there is no such model.
        ExportError: where the exported model does not agree with the one that it came from.
    """
    chosen_format = exporter(file_format)
    metrics = run.read_metrics()
    chosen = str(metrics["selected"]) if name == "selected" else name
    known = model_names(run.models)
    if chosen not in known:
        raise UsageError(f"{run.path}: no model '{name}'{nearest(name, ['selected', *known])}")
    spec, model = load_model(run.models / chosen)
    rows = [row for row in metrics["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"]
    file = out or run.exports / f"{chosen}{chosen_format.suffix}"
    chosen_format.export(ExportedVessel(spec, model, rows), file)
    return file
