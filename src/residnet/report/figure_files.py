"""The figures of a run as files: a picture for each case, and beside it all that a page draws."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.files import file_stem, read_json, whole
from residnet.core.ownership import require_inside, resolve_name, run_manifest_above
from residnet.core.progress import begin
from residnet.report.blocks import Section
from residnet.report.figure import Case, Curve, Figure, Look, Panel, joined, parts, thinned
from residnet.report.still import save, still


def packed(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return columns as 16-bit numbers with offset and step; equal columns are stored once."""
    out: dict[str, Any] = {}
    stored: dict[bytes, str] = {}
    for name, values in columns.items():
        before = stored.setdefault(values.tobytes(), name)
        if before != name:
            out[name] = before
            continue
        finite = np.isfinite(values)
        known = values[finite]
        low, span = (float(known.min()), float(np.ptp(known))) if known.size else (0.0, 0.0)
        # finer than any screen; the largest number is a gap
        step = span / 65_000 if span > 0 else 1.0
        levels = np.full(len(values), 65_535, dtype="<u2")
        levels[finite] = np.round((known - low) / step)
        out[name] = [low, step, base64.b64encode(levels.tobytes()).decode("ascii")]
    return out


def unpacked(columns: Mapping[str, Any], name: str) -> np.ndarray:
    """Return one of the columns that `packed` gave, as numbers [T]."""
    stored = columns[name]
    low, step, text = columns[stored] if isinstance(stored, str) else stored
    levels = np.frombuffer(base64.b64decode(text), dtype="<u2")
    values: np.ndarray = np.where(levels == 65_535, np.nan, low + step * levels)
    return values


def write_figure(folder: Path, figure: Figure, name: str = "") -> Figure:
    """Write a figure of a run: a PNG for each case that has one, and the figure itself beside them.

    Args:
        name: of the files, that of the figure where empty.
    """
    name = file_stem(name or figure.name)
    stills, several = [], len(figure.pictured) > 1
    for number, case in enumerate(figure.pictured, start=1):
        path = folder / (f"{name}_{number}.png" if several else f"{name}.png")
        title = figure.title + (f": {case.title}" if several else "")
        save(still(figure, case), path, title, figure.caption)
        stills.append(path)
    content = {name: getattr(figure, name) for name in _PLAIN} | {
        "looks": {name: asdict(look) for name, look in figure.looks.items()},
        "panels": [asdict(panel) for panel in figure.panels],
        "stills": [path.name for path in stills],
        "cases": [
            {"title": case.title, "note": case.note, "still": case.still}
            | {"curves": [_stored(curves) for curves in case.curves]}
            for case in figure.cases
        ],
    }
    with whole(folder / f"{name}.json") as file:
        file.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
    return replace(figure, stills=stills)


_PLAIN = ("name", "title", "caption", "chooser", "columns")


def _stored(curves: Mapping[str, Curve]) -> dict[str, Any]:
    """Return the curves of a panel with no more samples than a screen shows, packed."""
    columns: dict[str, np.ndarray] = {}
    for name, (x, y) in curves.items():
        pieces = parts(x, y)
        most = max(20, min(600, 6_000 // max(len(pieces), 1)))
        light = joined(tuple(axis[thinned(len(axis), most)] for axis in piece) for piece in pieces)
        columns |= {f"x{name}": light[0], f"y{name}": light[1]}
    return packed(columns)


def write_figures(folder: Path, figures: Iterable[Figure]) -> list[Figure]:
    """Write figures in the order in which a page shows them; those of an earlier call are replaced.

    Other pictures of the folder stay, and so do figures that somebody edited.
    """
    manifest = run_manifest_above(folder / "figure.json")
    if manifest is not None:
        require_inside(manifest.folder, folder)
        for path in folder.glob("*.json"):
            before = _read(path)
            for file in (path, *before.stills) if before else ():
                manifest.remove_if_owned(file)
    begin("drawing figures")
    # the number keeps the order for whoever lists the folder
    return [
        write_figure(folder, one, f"{i:02d}_{one.name}") for i, one in enumerate(figures, start=1)
    ]


def read_figures(folder: Path, names: str = ".*") -> list[Figure]:
    """Return the figures of a folder in the order of their files; damaged ones are left out.

    Args:
        folder: as `write_figures` left it.
        names: regular expression of the names of those that are wanted.
    """
    found = (_read(path) for path in sorted(folder.glob("*.json")))
    return [figure for figure in found if figure and re.fullmatch(names, figure.name)]


def figures_section(folder: Path) -> list[Section]:
    """Return a section with the figures of a folder, none where there are none."""
    figures = read_figures(folder)
    return [Section("Figures", figures)] if figures else []


def _read(path: Path) -> Figure | None:
    try:
        content = read_json(path)
        for case in content["cases"]:
            case["curves"] = [
                {
                    name[1:]: (unpacked(of, name), unpacked(of, f"y{name[1:]}"))
                    for name in of
                    if name[0] == "x"
                }
                for of in case["curves"]
            ]
        return Figure(
            **{name: content[name] for name in _PLAIN},
            looks={name: Look(**look) for name, look in content["looks"].items()},
            panels=[Panel(**panel) for panel in content["panels"]],
            cases=[Case(**case) for case in content["cases"]],
            stills=[_still_path(path, name) for name in content["stills"]],
        )
    except (UsageError, OSError, ValueError, TypeError, KeyError, AttributeError):
        # damaged: it is drawn again, or is not one of residnet
        return None


def _still_path(figure: Path, name: object) -> Path:
    """Return the picture of a figure: a PNG in the folder of the figure.

    Raises:
        UsageError: if the name leads elsewhere, or is that of another file.
    """
    still = resolve_name(figure.parent, name, figure)
    if still.parent != figure.parent or still.suffix != ".png":
        raise UsageError(f"{figure}: {name!r} is not the name of a picture beside it")
    return still
