"""Tables and figures of the standard model's study: goodness of fit beside the published figures,
parameters beside the true ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.names import ACCELERATION
from residnet.documents.halvorsen2019.sea_trial.standard_model import NAMES, PARAMETERS, StandardFit
from residnet.documents.halvorsen2019.sea_trial.study import (
    ALL,
    PLANT,
    STANDARD,
    PhasesSettings,
    PhaseStudy,
)
from residnet.documents.halvorsen2019.sea_trial.trial import CHANNELS
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
from residnet.runs.folder import RunFolder

_SECONDS = 60.0
_WORDS = {
    PHASES[0]: "displacement phase",
    PHASES[1]: "semi-displacement phase",
    PHASES[2]: "planing phase",
    ALL: "all phases",
}


def write(settings: PhasesSettings, found: Mapping[str, PhaseStudy], folder: RunFolder) -> str:
    """Write study.json, study.md and figures; returns the text of study.md."""
    parts, first = [settings.description or settings.name], next(iter(found))
    folder.figures.mkdir(exist_ok=True)
    for name, study in found.items():
        parts.append(f"# Trial {name}: vessel {settings.trials[name].vessel}\n\n{_about(study)}")
        published = settings.published if name == first else {}
        parts += [
            _goodness(where, rows, published.get(where, {})) for where, rows in study.rows.items()
        ]
        parts += [_parameters(study), _notes(study.standard), _equations(study)]
        draw_trial(study, folder.figures / f"trial_{name}.png")
        draw_parameters(study, folder.figures / f"parameters_{name}.png")
        for where in study.standard:
            draw_excerpt(study, where, folder.figures / f"{where}_{name}.png")
    text = "\n\n".join(parts) + "\n"
    folder.write(folder.path / "study.md", text)
    folder.write_json(
        folder.path / "study.json",
        {"schema": "residnet.sea_trial/1", "run": settings.name, "trials": _content(found)},
    )
    return text


def _about(study: PhaseStudy) -> str:
    trial, a = study.trial, study.trial.samples.target.numpy()
    shares = ", ".join(
        f"{name.replace('_', '-')} {(trial.phase == number).mean():.0%}"
        for number, name in enumerate(PHASES)
    )
    spread = ", ".join(
        f"{name} {value:.3g}" for name, value in zip(ACCELERATION, a.std(axis=0), strict=True)
    )
    return (
        f"{len(a) * trial.step / 60:.0f} minutes at {1 / trial.step:.0f} Hz in"
        f" {trial.log.max() + 1} logs: {shares}. Standard deviations of the accelerations: {spread}"
        f" (m/s^2, m/s^2, rad/s^2). {trial.validates.mean():.0%} of the stretches validate."
    )


def _goodness(
    where: str,
    rows: list[dict[str, Any]],
    published: Mapping[str, Mapping[str, tuple[float, float, float]]],
) -> str:
    """Tables 7.3 to 7.5 of the document with ours."""
    lines = [f"## Validation, {_WORDS[where]}", ""]
    lines += [
        (
            "RMSE, C_p and adjusted R^2, in brackets as published for the vessel itself; intervals"
            " of the mean absolute residual by moving blocks"
        ),
        "",
    ]
    lines += [
        "| acceleration | model | fitted on | parameters | RMSE | C_p | adjusted R^2 | mean abs."
        " residual [95 %, blocks] | 95 %, printed way |"
    ]
    lines += ["|---|---|---|---|---|---|---|---|---|"]
    for row in rows:
        printed = (
            published.get(row["model"], {}).get(row["axis"])
            if row["on"] == (where if row["model"] == STANDARD else ALL)
            else None
        )
        cells = [
            _beside(row[key], None if printed is None else printed[i])
            for i, key in enumerate(("rmse", "cp", "r2_adjusted"))
        ]
        blocks, narrow = (_range(row[key]) for key in ("mae_ci95", "mae_ci95_independent"))
        fitted = "-" if row["model"] == PLANT else row["on"].replace("_", "-")
        lines.append(
            f"| {row['axis']} | {row['model']} | {fitted} | {row['parameters']:.0f} |"
            f" {' | '.join(cells)} | {row['mae']:.3g} {blocks} | {narrow} |"
        )
    return "\n".join(lines)


def _beside(value: float | None, printed: float | None) -> str:
    return ("-" if value is None else f"{value:.3g}") + (
        "" if printed is None else f" ({printed:g})"
    )


def _range(bounds: list[float] | None) -> str:
    return "-" if bounds is None else f"[{bounds[0]:.3g}, {bounds[1]:.3g}]"


def _parameters(study: PhaseStudy) -> str:
    """What is found of each parameter on each set, beside the truth and what the document found."""
    lines = ["## Parameters of the standard model, SI, with standard errors", ""]
    lines += [
        "| parameter | vessel | "
        + " | ".join(where.replace("_", "-") for where in study.standard)
        + " | published before, after |"
    ]
    lines += ["|---" * (len(study.standard) + 3) + "|"]
    for number, name in enumerate(NAMES):
        cells = [_estimate(fit, number) for fit in study.standard.values()]
        entry = PARAMETERS[name]
        after = "-" if entry.published is None else f"{entry.published:.4g}"
        written = name.replace("|", "\\|")
        lines.append(
            f"| {written} | {study.truth[name]:.5g} | {' | '.join(cells)} | {entry.start:.5g},"
            f" {after} |"
        )
    known = study.truth
    whole = {
        "m - X_udot": -known["X_udot"],
        "m - Y_vdot": -known["Y_vdot"],
        "I_z - N_rdot": known["I_z"] - known["N_rdot"],
    }
    for name, value in whole.items():
        mass = next(iter(study.standard.values())).mass if name.startswith("m") else 0.0
        cells = [_sum(fit, name) for fit in study.standard.values()]
        lines.append(f"| {name} | {mass + value:.5g} | {' | '.join(cells)} | |")
    return "\n".join(lines)


def _estimate(fit: StandardFit, number: int) -> str:
    name = NAMES[number]
    if name in fit.undetermined:
        return f"({fit.values[number]:.4g}) open"
    if name in fit.bound:
        return f"{fit.values[number] + 0.0:.3g} at its bound"
    return f"{fit.values[number]:.4g} ± {fit.errors[number]:.2g}"


def _sum(fit: StandardFit, name: str) -> str:
    value, error = fit.sums[name]
    return f"{value:.5g} at its bound" if error == 0.0 else f"{value:.5g} ± {error:.2g}"


def _notes(standard: Mapping[str, StandardFit]) -> str:
    """What the data leave open, and whether every start leads to the same place."""
    lines = []
    for where, fit in standard.items():
        same = sum(cost <= fit.cost[0] * (1 + 1e-6) for cost in fit.cost)
        left = (
            f"only combinations of {', '.join(fit.undetermined)} are determined"
            if fit.undetermined
            else "every parameter is determined"
        )
        lines.append(
            f"- {_WORDS[where]}: {left}; condition of the rest {fit.condition:.2g}; {same} of"
            f" {len(fit.cost)} starts end at the least error"
        )
    lines.append(
        "- standard errors know the scatter and memory of the residuals, not what the filter, the"
        " waves or a wrong structure shift"
    )
    return "\n".join(lines)


def _equations(study: PhaseStudy) -> str:
    lines = ["## Equations found", ""]
    for (name, on), model in study.models.items():
        lines += [
            f"- {name} on {on.replace('_', '-')}: `{text}`"
            for text in model.notes.get("equations", {}).values()
        ]
    return "\n".join(lines) if len(lines) > 2 else ""


def _content(found: Mapping[str, PhaseStudy]) -> dict[str, Any]:
    return {
        name: {
            "samples": len(study.trial.phase),
            "phases": {
                phase: float((study.trial.phase == number).mean())
                for number, phase in enumerate(PHASES)
            },
            "truth": dict(study.truth),
            "standard": {where: _fit(fit) for where, fit in study.standard.items()},
            "equations": {
                f"{model} on {on}": own.notes["equations"]
                for (model, on), own in study.models.items()
                if own.notes
            },
            "rows": dict(study.rows),
        }
        for name, study in found.items()
    }


def _fit(fit: StandardFit) -> dict[str, Any]:
    errors = {
        name: float(error) if np.isfinite(error) else None
        for name, error in zip(NAMES, fit.errors, strict=True)
    }
    return {
        "values": dict(zip(NAMES, fit.values.tolist(), strict=True)),
        "standard_errors": errors,
        "sums": {name: list(pair) for name, pair in fit.sums.items()},
        "undetermined": fit.undetermined,
        "at_bound": fit.bound,
        "condition": fit.condition,
        "cost": fit.cost,
    }


def draw_trial(study: PhaseStudy, file: Path) -> None:
    """Velocities and commands of all logs one after another, phases shaded (Figures 7.1, 7.2)."""
    from matplotlib import rc_context

    trial, z = study.trial, study.trial.samples.z.numpy()
    t = np.arange(len(z)) * trial.step / 60
    degrees = 180 / np.pi
    rows = [
        ("u", "u [m/s]", 1.0),
        ("v", "v [m/s]", 1.0),
        ("r", "r [deg/s]", degrees),
        ("cmd_n", "motor [rpm]", 60.0),
    ]
    rows += [("cmd_nozzle", "nozzle [deg]", degrees)]
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
            "Zigzags and speed steps; grey: stretches that validate.",
        )


def draw_parameters(study: PhaseStudy, file: Path) -> None:
    """Estimates less truth in units of a typical size, with two standard errors."""
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
            apart = (fit.values[shown] - np.array([study.truth[NAMES[i]] for i in shown])) / scale
            at = np.arange(len(shown)) + 0.16 * (place - (len(study.standard) - 1) / 2)
            axes.errorbar(
                at,
                apart,
                2 * fit.errors[shown] / scale,
                fmt="o",
                markersize=3,
                linewidth=1,
                color=f"C{place}",
                label=_WORDS[where],
            )
        axes.axhline(0.0, color="black", linewidth=0.7)
        axes.set_yscale("symlog", linthresh=0.1)
        axes.set_xticks(range(len(shown)), [NAMES[i] for i in shown], rotation=60, ha="right")
        axes.set_ylabel("estimate - truth, of a typical size")
        handles: dict[str, Any] = {}
        collect(handles, axes)
        legend_above(figure, handles)
        save(
            figure,
            file,
            "Parameters of the standard model",
            "Estimates less the vessel's own, bars: two standard errors; logarithmic beyond 0.1.",
        )


def draw_excerpt(study: PhaseStudy, where: str, file: Path) -> None:
    """A validation stretch: accelerations as measured, of the standard model and of the first
    equation (Figures 7.8 to 7.14).
    """
    from matplotlib import rc_context

    trial = study.trial
    keep = (
        np.ones(len(trial.phase), dtype=bool)
        if where == ALL
        else trial.phase == PHASES.index(where)
    )
    pieces = trial.pieces(keep & trial.validates)
    nozzle = trial.samples.z.numpy()[:, CHANNELS.index("cmd_nozzle")]
    # the liveliest: straight runs show nothing of sway and yaw
    piece = max(pieces, key=lambda one: float(np.abs(nozzle[one]).sum()))[
        : round(_SECONDS / trial.step)
    ]
    measured, t = trial.samples.target.numpy()[piece], np.arange(len(piece)) * trial.step
    other = next((key for key in study.models if key[0] != STANDARD and key[1] == where), None)
    curves = {
        f"standard, fitted on {_WORDS[where]}": (study.models[STANDARD, where].predicted, DASHED)
    }
    if other is not None:
        curves[f"{other[0]}, fitted on {_WORDS[where]}"] = (study.models[other].predicted, SOLID)
    with rc_context(RC):
        figure = new_figure(5.0)
        panels = figure.subplots(3, 1, sharex=True)
        handles: dict[str, Any] = {}
        for axis, axes in enumerate(panels):
            factor = 180 / np.pi if axis == 2 else 1.0
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
            f"Validation, {_WORDS[where]}",
            "Accelerations measured and predicted from measured velocities and inputs.",
        )
