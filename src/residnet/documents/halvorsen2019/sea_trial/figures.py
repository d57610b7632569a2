"""Figures of the sea trial's models (Figures 7.1, 7.2 and 7.8 to 7.14 of document 000)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from residnet.documents.halvorsen2019.sea_trial.config import ALL, CHANNELS, STANDARD
from residnet.documents.halvorsen2019.sea_trial.standard_model import NAMES, PARAMETERS
from residnet.documents.halvorsen2019.sea_trial.study import PhaseStudy
from residnet.physics.froude import PHASES
from residnet.report.figures.style import (
    DASHED,
    MEASURED,
    RC,
    SOLID,
    collect,
    legend_above,
    new_figure,
    save,
)
from residnet.report.format import DEG

_EXCERPT = 60.0
"""Length in s of the stretch that is shown."""
SET_NAMES = {
    PHASES[0]: "displacement phase",
    PHASES[1]: "semi-displacement phase",
    PHASES[2]: "planing phase",
    ALL: "all phases",
}


def draw_trial(study: PhaseStudy, file: Path) -> None:
    """Draw velocities and commands of all logs, one after another (Figures 7.1 and 7.2)."""
    from matplotlib import rc_context

    trial, z = study.trial, study.trial.samples.z.numpy()
    t = np.arange(len(z)) * trial.step / 60
    rows = [
        ("u", "u [m/s]", 1.0),
        ("v", "v [m/s]", 1.0),
        ("r", "r [deg/s]", DEG),
        ("cmd_n", "motor [rpm]", 60.0),
        ("cmd_nozzle", "nozzle [deg]", DEG),
    ]
    with rc_context(RC):
        figure = new_figure(7.0)
        panels = figure.subplots(len(rows), 1, sharex=True)
        for axes, (name, label, factor) in zip(panels, rows, strict=True):
            axes.plot(
                t, factor * z[:, CHANNELS.index(name)], color="C0", linewidth=0.6, rasterized=True
            )
            low, high = axes.get_ylim()
            axes.fill_between(
                t,
                low,
                high,
                where=trial.validates,
                color="0.85",
                linewidth=0,
                label="validation",
                zorder=0,
            )
            axes.set_ylim(low, high)
            axes.set_ylabel(label)
        panels[-1].set_xlabel("time, logs end to end [min]")
        legend_above(
            figure, dict(zip(*reversed(panels[0].get_legend_handles_labels()), strict=True))
        )
        save(
            figure,
            file,
            "Simulated sea trial",
            "Zigzags and steps of speed; stretches that validate are grey.",
        )


def draw_parameters(study: PhaseStudy, file: Path) -> None:
    """Draw estimates less true values in units of a typical size, with two standard errors."""
    from matplotlib import rc_context

    shown = [
        number
        for number, name in enumerate(NAMES)
        if name not in next(iter(study.standard.values())).undetermined
    ]
    with rc_context(RC):
        figure = new_figure(3.6)
        axes = figure.subplots()
        for place, (where, fit) in enumerate(study.standard.items()):
            scale = np.array([PARAMETERS[NAMES[i]].scale for i in shown])
            error = (fit.values[shown] - np.array([study.truth[NAMES[i]] for i in shown])) / scale
            at = np.arange(len(shown)) + 0.16 * (place - (len(study.standard) - 1) / 2)
            axes.errorbar(
                at,
                error,
                2 * fit.errors[shown] / scale,
                fmt="o",
                markersize=3,
                linewidth=1,
                color=f"C{place}",
                label=SET_NAMES[where],
            )
        axes.axhline(0.0, color="black", linewidth=0.7)
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_xticks(range(len(shown)), [NAMES[i] for i in shown], rotation=60, ha="right")
        axes.set_ylabel("estimate less truth, of a typical size")
        handles: dict[str, Any] = {}
        collect(handles, axes)
        legend_above(figure, handles)
        save(
            figure,
            file,
            "Parameters of the standard model",
            "Estimates less the true values, with two standard errors; the scale is logarithmic"
            " beyond 0.1.",
        )


def draw_excerpt(study: PhaseStudy, where: str, file: Path) -> None:
    """Draw accelerations of a validation stretch, measured and predicted (Figures 7.8 to 7.14)."""
    from matplotlib import rc_context

    trial = study.trial
    keep = (
        np.ones(len(trial.phase), dtype=bool)
        if where == ALL
        else trial.phase == PHASES.index(where)
    )
    pieces = trial.pieces(keep & trial.validates)
    nozzle = trial.samples.z.numpy()[:, CHANNELS.index("cmd_nozzle")]
    # the stretch with the largest nozzle angles: straight runs show nothing of sway and yaw
    piece = max(pieces, key=lambda indices: float(np.abs(nozzle[indices]).sum()))[
        : round(_EXCERPT / trial.step)
    ]
    measured, t = trial.samples.target.numpy()[piece], np.arange(len(piece)) * trial.step
    other = next((key for key in study.models if key[0] != STANDARD and key[1] == where), None)
    curves = {
        f"standard, fitted on {SET_NAMES[where]}": (study.models[STANDARD, where].predicted, DASHED)
    }
    if other is not None:
        curves[f"{other[0]}, fitted on {SET_NAMES[where]}"] = (study.models[other].predicted, SOLID)
    with rc_context(RC):
        figure = new_figure(5.0)
        panels = figure.subplots(3, 1, sharex=True)
        handles: dict[str, Any] = {}
        for axis, axes in enumerate(panels):
            factor = DEG if axis == 2 else 1.0
            axes.plot(t, factor * measured[:, axis], **MEASURED)
            for label, (predicted, style) in curves.items():
                axes.plot(t, factor * predicted[piece, axis], **style, label=label)
            axes.set_ylabel(("u' [m/s²]", "v' [m/s²]", "r' [deg/s²]")[axis])
            collect(handles, axes)
        panels[-1].set_xlabel("time [s]")
        legend_above(figure, handles)
        save(
            figure,
            file,
            f"Validation, {SET_NAMES[where]}",
            "Accelerations measured and predicted from measured velocities and inputs.",
        )
