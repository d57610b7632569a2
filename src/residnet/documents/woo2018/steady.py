"""The steady map of document 003 (Woo et al. 2018): Figure 9 and Table 1, from a finished run."""

from __future__ import annotations

from typing import Any

import numpy as np

from residnet.documents.cells import beside_published
from residnet.documents.woo2018.published import STEADY
from residnet.report.blocks import Cell, Figure, Table
from residnet.report.figures.style import RC, new_figure, save
from residnet.report.format import DEG, interval
from residnet.report.run_reader import RunFiles

_SHOWN = {"u": ("u", "m/s", 1.0), "v": ("v", "m/s", 1.0), "r": ("r", "deg/s", DEG)}
_INPUTS = {"u": ("tau_x", "N"), "v": ("tau_n", "N m"), "r": ("tau_n", "N m")}
_WITHIN = 1.96
"""Standard errors on either side of a 95 % interval."""


def steady_table(files: RunFiles) -> Table:
    """Return the constraints (32) of the linear model with intervals, beside Table 1."""
    found = files.fit("baseline")["steady_constraints"]
    table = Table(
        ["steady state", "Phi", "95 % interval", "bias", "95 % interval", "unit"],
        caption="Steady states of the constant manoeuvres as x = Phi tau + bias (32), beside those"
        " of Table 1 as corrected (W12, W13). The vessels differ: sizes alone compare.",
    )
    for state, (name, unit, factor) in _SHOWN.items():
        own, printed = found[state], STEADY[state]
        cells: list[Cell | str] = []
        for key, published in zip(("phi", "bias"), printed, strict=True):
            value, error = own[key], _WITHIN * own[f"{key}_error"]
            cells.append(beside_published(factor * value, published, 3))
            cells.append(interval([value - error, value + error], factor, 3))
        force, measure = _INPUTS[state]
        table.add(f"{name} over {force}", [*cells, f"{unit} per {measure}; {unit}"])
    return table


def steady_figure(files: RunFiles) -> Figure:
    """Draw the steady states over force and moment with the lines of the linear model."""
    from matplotlib import rc_context

    notes = files.fit("baseline")
    states, found = notes["steady_states"], notes["steady_constraints"]
    path = files.path / "figures" / "woo2018" / "9.png"
    title = "Figure 9 of document 003: steady states of the constant manoeuvres"
    caption = "Points: means of the settled part of each manoeuvre. Lines: Phi tau + bias (32)."
    with rc_context(RC):
        figure = new_figure(2.6)
        for axes, (state, shown) in zip(figure.subplots(1, 3), _SHOWN.items(), strict=True):
            _panel(axes, states, found[state], shown, _INPUTS[state])
        save(figure, path, title, caption)
    return Figure(path, title, caption)


def _panel(
    axes: Any,
    states: dict[str, list[float]],
    found: dict[str, Any],
    shown: tuple[str, str, float],
    driven: tuple[str, str],
) -> None:
    """Draw one steady state over the input that drives it."""
    (name, unit, factor), (force, measure) = shown, driven
    tau, value = np.array(states[force]), factor * np.array(states[name])
    axes.plot(tau, value, "o", markersize=2.5, color="#0072B2")
    ends = np.array([tau.min(), tau.max()])
    axes.plot(ends, factor * (found["phi"] * ends + found["bias"]), color="#E69F00")
    axes.set_xlabel(f"{force} [{measure}]")
    axes.set_ylabel(f"steady {name} [{unit}]")
