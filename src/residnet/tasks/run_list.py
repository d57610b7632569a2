"""What `residnet runs` shows: the runs below a folder with task, state, best figure and age."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from residnet.core.config import load_mapping
from residnet.core.errors import ConfigError, UsageError
from residnet.report.blocks import Cell, Table

_UNITS = (("d", 86_400.0), ("h", 3_600.0), ("min", 60.0), ("s", 1.0))


def runs_below(folder: Path) -> list[dict[str, Any]]:
    """Return what lies below a folder of runs, the newest first.

    Each entry has run, task, state (`finished`, `unfinished` or `damaged`), best (name, value and
    unit of its first main figure, or None) and age in s.

    Raises:
        UsageError: where the folder does not exist.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; runs lie in runs/ unless --out says otherwise")
    found = [_entry(file.parent) for file in folder.rglob("resolved.yaml")]
    return sorted(found, key=lambda entry: float(entry["age"]))


def runs_text(folder: Path, entries: list[dict[str, Any]]) -> str:
    """Return the runs as a table for the terminal."""
    if not entries:
        return f"{folder}: no runs"
    table = Table(["run", "task", "state", "best", "age"])
    for entry in entries:
        best = entry["best"]
        figure = "" if best is None else f"{best['name']} {_figure(best)}"
        cells = (entry["task"], entry["state"], figure, _age(entry["age"]))
        table.add(str(entry["run"]), [Cell(str(text), mark="text") for text in cells])
    return table.text()


def _figure(best: Mapping[str, Any]) -> str:
    unit = "" if best["unit"] == "-" else f" {best['unit']}"
    return f"{best['value']:.4g}{unit}" if best["value"] is not None else "not finite"


def _entry(folder: Path) -> dict[str, Any]:
    """Return what is known of one run."""
    entry: dict[str, Any] = {"run": str(folder), "task": "unknown", "state": "unfinished"}
    entry |= {"best": None, "age": time.time() - (folder / "resolved.yaml").stat().st_mtime}
    try:
        entry["task"] = str(load_mapping(folder / "resolved.yaml").get("task", "unknown"))
    except ConfigError:
        return {**entry, "state": "damaged"}
    summary = folder / "summary.json"
    if not summary.is_file():
        return entry
    try:
        content = json.loads(summary.read_text(encoding="utf-8"))
        figures = dict(content.get("figures") or {})
        entry["state"] = "finished" if content.get("finished") else "unfinished"
        if figures:
            name, figure = next(iter(figures.items()))
            entry["best"] = {"name": name, "value": figure["value"], "unit": figure["unit"]}
    except (ValueError, AttributeError, KeyError, TypeError, OSError):
        return {**entry, "state": "damaged"}
    return entry


def _age(seconds: float) -> str:
    unit, size = next(((u, s) for u, s in _UNITS if seconds >= s), ("s", 1.0))
    return f"{seconds / size:.0f} {unit}"
