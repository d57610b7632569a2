"""Figures of a run as files: a PNG for each case and a JSON file with the data of the figure."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write, make_file_stem, read_json
from residnet.core.ownership import find_run_manifest, require_inside, resolve_name
from residnet.core.progress import begin_stage
from residnet.report.blocks import Section
from residnet.report.figure import (
    Case,
    Curve,
    Figure,
    GlyphStyle,
    Panel,
    join_with_gaps,
    split_at_gaps,
    subsample_indices,
)
from residnet.report.still import render_matplotlib, save_png


class PackedColumn(NamedTuple):
    """Numbers as 16-bit levels.

    Attributes:
        minimum: value of level 0.
        step: difference between two levels.
        levels: levels [T] as unsigned little-endian integers in base 64; 65,535 marks a gap.
    """

    minimum: float
    step: float
    levels: str


PackedColumns = dict[str, PackedColumn | str]
"""Columns by name; a column that is equal to an earlier one is the name of that one."""


def pack_columns(columns: Mapping[str, np.ndarray]) -> PackedColumns:
    """Encode columns as 16-bit numbers; equal columns are stored once."""
    packed_columns: PackedColumns = {}
    stored: dict[bytes, str] = {}
    for name, values in columns.items():
        first_name = stored.setdefault(values.tobytes(), name)
        if first_name != name:
            packed_columns[name] = first_name
            continue
        finite = np.isfinite(values)
        finite_values = values[finite]
        minimum, span = (
            (float(finite_values.min()), float(np.ptp(finite_values)))
            if finite_values.size
            else (0.0, 0.0)
        )
        # finer than any screen; the largest number marks a gap
        step = span / 65_000 if span > 0 else 1.0
        levels = np.full(len(values), 65_535, dtype="<u2")
        levels[finite] = np.round((finite_values - minimum) / step)
        text = base64.b64encode(levels.tobytes()).decode("ascii")
        packed_columns[name] = PackedColumn(minimum, step, text)
    return packed_columns


def unpack_column(columns: Mapping[str, PackedColumn | str], name: str) -> np.ndarray:
    """Decode one of the columns of `pack_columns`, as numbers [T].

    Raises:
        ValueError: if an equal column is itself the name of another one.
    """
    packed_column = columns[name]
    if isinstance(packed_column, str):
        packed_column = columns[packed_column]
    if isinstance(packed_column, str):
        raise ValueError(f"column {name} has no numbers")
    minimum, step, text = packed_column
    levels = np.frombuffer(base64.b64decode(text), dtype="<u2")
    values: np.ndarray = np.where(levels == 65_535, np.nan, minimum + step * levels)
    return values


def write_figure(folder: Path, figure: Figure, name: str = "") -> Figure:
    """Write a figure: a PNG for each case with a static image, and a JSON file with its data.

    Args:
        name: stem of the files; the name of the figure if empty.
    """
    name = make_file_stem(name or figure.name)
    image_paths = []
    has_several = len(figure.static_cases) > 1
    for number, case in enumerate(figure.static_cases, start=1):
        path = folder / (f"{name}_{number}.png" if has_several else f"{name}.png")
        title = figure.title + (f": {case.title}" if has_several else "")
        save_png(render_matplotlib(figure, case), path, title, figure.caption)
        image_paths.append(path)
    content = {name: getattr(figure, name) for name in _STORED_FIELDS} | {
        "looks": {name: asdict(style) for name, style in figure.styles.items()},
        "panels": [asdict(panel) for panel in figure.panels],
        "stills": [path.name for path in image_paths],
        "cases": [
            {"title": case.title, "note": case.note, "still": case.has_static_image}
            | {"curves": [_pack_curves(panel_curves) for panel_curves in case.curves]}
            for case in figure.cases
        ],
    }
    with atomic_write(folder / f"{name}.json") as file:
        file.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
    return replace(figure, static_images=image_paths)


_STORED_FIELDS = ("name", "title", "caption", "chooser", "columns", "is_drawing")
_FORMER_KINDS = {"across": "hline", "upright": "vline", "strip": "vspan"}
"""Kind of a curve by its name in files of earlier versions."""


def _pack_curves(panel_curves: Mapping[str, Curve]) -> PackedColumns:
    """Encode the curves of a panel, subsampled to the resolution of a screen."""
    columns: dict[str, np.ndarray] = {}
    for name, (x, y) in panel_curves.items():
        curve_parts = split_at_gaps(x, y)
        max_points = max(20, min(300, 4_000 // max(len(curve_parts), 1)))
        subsampled = join_with_gaps(
            tuple(axis[subsample_indices(len(axis), max_points)] for axis in curve_part)
            for curve_part in curve_parts
        )
        columns |= {f"x{name}": subsampled[0], f"y{name}": subsampled[1]}
    return pack_columns(columns)


def write_figures(folder: Path, figures: Iterable[Figure]) -> list[Figure]:
    """Write figures in page order and replace the figures of an earlier call.

    Files that residnet did not write, and files edited since, are not touched.
    """
    manifest = find_run_manifest(folder / "figure.json")
    if manifest is not None:
        require_inside(manifest.folder, folder)
        for path in folder.glob("*.json"):
            previous_figure = _read_figure(path)
            for file in (path, *previous_figure.static_images) if previous_figure else ():
                manifest.remove_if_owned(file)
    begin_stage("drawing figures")
    # the number keeps the order in a listing of the folder
    return [
        write_figure(folder, figure, f"{i:02d}_{figure.name}")
        for i, figure in enumerate(figures, start=1)
    ]


def read_figures(folder: Path, names: str = ".*") -> list[Figure]:
    """Read the figures of a folder in file order; unreadable files are skipped.

    Args:
        folder: folder that `write_figures` wrote.
        names: regular expression that the figure name must match.
    """
    read = (_read_figure(path) for path in sorted(folder.glob("*.json")))
    return [figure for figure in read if figure and re.fullmatch(names, figure.name)]


def figures_section(folder: Path, names: str = ".*") -> list[Section]:
    """Return a section with the figures of a folder; an empty list without figures.

    Args:
        folder: folder that `write_figures` wrote.
        names: regular expression that the figure name must match.
    """
    figures = read_figures(folder, names)
    return [Section("Figures", figures)] if figures else []


def _read_figure(path: Path) -> Figure | None:
    """Read a stored figure; None if the file is not readable."""
    try:
        content = read_json(path)
        for style in content["looks"].values():
            style["kind"] = _FORMER_KINDS.get(style["kind"], style["kind"])
        for case in content["cases"]:
            case["has_static_image"] = case.pop("still")
            case["curves"] = [
                {
                    name[1:]: (
                        unpack_column(packed_panel, name),
                        unpack_column(packed_panel, f"y{name[1:]}"),
                    )
                    for name in packed_panel
                    if name[0] == "x"
                }
                for packed_panel in case["curves"]
            ]
        return Figure(
            # files of earlier versions have no drawings
            **{name: content[name] for name in _STORED_FIELDS if name in content},
            styles={name: GlyphStyle(**style) for name, style in content["looks"].items()},
            panels=[Panel(**panel) for panel in content["panels"]],
            cases=[Case(**case) for case in content["cases"]],
            static_images=[_still_path(path, name) for name in content["stills"]],
        )
    except (UsageError, OSError, ValueError, TypeError, KeyError, AttributeError):
        # a damaged figure is drawn again; other JSON files are no figures of residnet
        return None


def _still_path(figure: Path, name: object) -> Path:
    """Return the path of a static image: a PNG in the folder of the figure.

    Raises:
        UsageError: if the name leaves the folder or names another kind of file.
    """
    still = resolve_name(figure.parent, name, figure)
    if still.parent != figure.parent or still.suffix != ".png":
        raise UsageError(f"{figure}: {name!r} is not the name of a picture in the same folder")
    return still
