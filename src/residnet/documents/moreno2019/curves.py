"""Figures 5 and 6 of document 001: the error over the penalty lambda and the width sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.blocks import Figure
from residnet.report.figures.style import FAMILY, RC, collect, legend_above, new_figure, save
from residnet.report.run_reader import RunFiles

MODEL = "rbf_joint"
_TITLES = {
    5: "Figure 5 of document 001: error over the penalty lambda",
    6: "Figure 6 of document 001: error over the width sigma of the radial kernel",
}
_CAPTION = (
    "Left: free runs over the validation record, mean of the normalised errors of u, v, r. Right:"
    " cross-validated one-step error on the training records, each axis over its least, mean of"
    " the axes. All three outputs have the same penalty and width here."
)


def curves(files: RunFiles) -> list[Figure]:
    """Draw what each penalty and width of the radial kernel gave; nothing where it is not kept."""
    from matplotlib import rc_context

    notes = files.fit(MODEL)
    grid = _grid(notes.get("free_run_choice") or [])
    if not grid:
        return []
    one_step = _one_step(notes, grid)
    out = []
    for number, title in _TITLES.items():
        path = files.path / "figures" / "moreno2019" / f"{number}.png"
        with rc_context(RC):
            save(_drawn(grid, one_step, over=number - 5), path, title, _CAPTION)
        out.append(Figure(path, title, _CAPTION))
    return out


Errors = dict[tuple[float, float], float]
"""An error for each pair of penalty and width."""


def _grid(tried: Sequence[Mapping[str, Any]]) -> Errors:
    """Return the validation error by penalty and width where all outputs share both."""
    out: Errors = {}
    for entry in tried:
        values = [set(entry.get(key) or []) for key in ("penalty", "sigma")]
        if all(len(value) == 1 for value in values) and not entry["diverged"]:
            out[values[0].pop(), values[1].pop()] = float(entry["validation"])
    return out


def _one_step(notes: Mapping[str, Any], grid: Errors) -> Errors:
    """Return the cross-validated one-step errors of the same pairs."""
    errors = np.asarray(notes["cross_validated_error"])
    relative = (errors / errors.min(axis=(0, 1))).mean(axis=-1)
    penalties, widths = (sorted({pair[i] for pair in grid}) for i in (0, 1))
    if relative.shape != (len(widths), len(penalties)):
        return {}
    return {
        (penalty, width): float(relative[i, j])
        for i, width in enumerate(widths)
        for j, penalty in enumerate(penalties)
    }


def _drawn(grid: Errors, one_step: Errors, over: int) -> Any:
    """Draw both errors over the penalty (0) or the width (1), a line for each of the other."""
    figure = new_figure(3.0)
    panels = figure.subplots(1, 2)
    handles: dict[str, Any] = {}
    names = ("lambda", "sigma")
    for axes, errors, words in zip(
        panels, (grid, one_step), ("validation free run", "one-step, relative"), strict=True
    ):
        others = sorted({pair[1 - over] for pair in errors})
        for place, other in enumerate(others):
            points = sorted((p[over], e) for p, e in errors.items() if p[1 - over] == other)
            look = FAMILY[place % len(FAMILY)] | {"label": f"{names[1 - over]} = {other:g}"}
            axes.loglog(*zip(*points, strict=True), marker="o", markersize=2.5, **look)
        axes.set_xlabel(names[over])
        axes.set_ylabel(f"error, {words}")
        collect(handles, axes)
    legend_above(figure, handles)
    return figure
