"""`residnet export`, and the exports at the end of a fit."""

from __future__ import annotations

import shutil
from pathlib import Path

from residnet.core.config import load_mapping
from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.dynamics.store import load_model, model_names
from residnet.export import exporter
from residnet.runs.folder import RunFolder


def export_model(path: Path, name: str, out: Path | None, form: str = "torchscript") -> Path:
    """Export one model of a finished run in the format of that name, and return the file.

    Raises:
        ConfigError: where there is no such format.
        UsageError: where the run or the model does not exist.
        ExportError: where the exported module differs from the model.
    """
    format = exporter(form)
    folder = RunFolder.open(path)
    content = folder.read_metrics()
    policies = load_mapping(folder.resolved).get("policies")
    if policies is not None:
        return _exported_policy(folder, name, list(policies), out, form)
    chosen = str(content["selected"]) if name == "selected" else name
    if chosen not in model_names(folder.models):
        raise UsageError(
            f"{path}: no model '{name}'{nearest(name, ['selected', *model_names(folder.models)])}"
        )
    spec, model = load_model(folder.models / chosen)
    rows = [row for row in content["rows"] if row["model"] == chosen and row["manoeuvre"] == "all"]
    file = out or folder.exports / f"{chosen}{format.suffix}"
    format.export(spec, model, file, rows)
    return file


def _exported_policy(
    folder: RunFolder, name: str, policies: list[str], out: Path | None, form: str
) -> Path:
    """A policy of an autopilot run: exported and checked when the run ended, so that a copy is all
    there is to do.

    Raises:
        UsageError: where there is no such policy, or another form is asked for.
    """
    if name not in policies:
        raise UsageError(f"{folder.path}: no policy '{name}'{nearest(name, policies)}")
    if form != "torchscript":
        raise UsageError(f"{folder.path}: policies are exported as torchscript, not as {form}")
    file = folder.exports / f"{name}.pt"
    if not file.is_file():
        raise UsageError(f"{file}: no such file; the run writes it at its end")
    if out is None:
        return file
    out.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(file, out)
    return out
