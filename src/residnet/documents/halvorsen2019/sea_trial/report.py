"""The report page of a sea trial's study (Tables 7.3 to 7.5 and appendix C.2 of document 000)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.documents.cells import beside_published, listed, pictures
from residnet.documents.halvorsen2019.sea_trial.config import (
    ALL,
    PLANT,
    STANDARD,
    SeaTrialSettings,
)
from residnet.documents.halvorsen2019.sea_trial.figures import SET_NAMES
from residnet.documents.halvorsen2019.sea_trial.published import (
    FITTED_PARAMETERS,
    START_PARAMETERS,
)
from residnet.documents.halvorsen2019.sea_trial.standard_model import NAMES, SUMS
from residnet.report.blocks import Bullets, Cell, Section, Table, Text
from residnet.report.format import DASH, interval, number

Results = Mapping[str, Any]
_SAME_COST = 1e-6
"""Costs that differ by a smaller share count as the same minimum."""


def verdict(results: Results) -> list[str]:
    """Return for each trial which model fits the validation stretches best, axis by axis."""
    sentences = []
    for name, trial in results["trials"].items():
        where = next(iter(trial["rows"]))
        best = _best(trial["rows"][where])
        each = [f"{row['model']} for {axis} ({number(row['rmse'])})" for axis, row in best.items()]
        sentences.append(
            f"Trial {name}: on the validation stretches of the {SET_NAMES[where]}, the models with"
            f" the least root mean square error are {listed(each)}."
        )
        open_names = trial["standard"][where]["undetermined"]
        if open_names:
            sentences.append(
                f"Of the standard model, the data of trial {name} determine only combinations of"
                f" {listed(open_names)}."
            )
    return sentences


def main_figures(results: Results) -> dict[str, tuple[float, str]]:
    """Return the errors of the standard model and of the best model on the first set."""
    units = {"u_dot": "m/s^2", "v_dot": "m/s^2", "r_dot": "rad/s^2"}
    out: dict[str, tuple[float, str]] = {}
    for name, trial in results["trials"].items():
        where = next(iter(trial["rows"]))
        for axis, row in _best(trial["rows"][where]).items():
            out[f"{name}: rmse of {axis}, {row['model']}"] = (row["rmse"], units[axis])
        for row in trial["rows"][where]:
            if row["model"] == STANDARD and row["on"] == where:
                out[f"{name}: rmse of {row['axis']}, {STANDARD}"] = (
                    row["rmse"],
                    units[row["axis"]],
                )
    return out


def _best(rows: Sequence[Results]) -> dict[str, Results]:
    """Return by acceleration the row with the least error, the plant's own equations aside."""
    axes = dict.fromkeys(row["axis"] for row in rows)
    return {
        axis: min(
            (row for row in rows if row["axis"] == axis and row["model"] != PLANT),
            key=lambda row: float(row["rmse"]),
        )
        for axis in axes
    }


def sections(settings: SeaTrialSettings, results: Results, run: Path) -> list[Section]:
    """Return the sections of the report, one for each trial.

    Args:
        settings: the study.
        results: contents of study.json.
        run: run folder, which holds the figures.
    """
    first = next(iter(results["trials"]))
    printed = (settings.published, settings.published_absolute)
    return [
        _trial(settings, name, trial, run, printed if name == first else ({}, {}))
        for name, trial in results["trials"].items()
    ]


def _trial(
    settings: SeaTrialSettings,
    name: str,
    trial: Results,
    run: Path,
    published: Sequence[Mapping[str, Mapping[str, Any]]],
) -> Section:
    blocks: list[Text | Section] = [Text(_about(trial))]
    for where, rows in trial["rows"].items():
        table = _goodness(where, rows, *(of.get(where, {}) for of in published))
        blocks.append(
            Section(f"Validation, {SET_NAMES[where]}", [table, *pictures(run, f"{where}_{name}.")])
        )
    blocks.append(
        Section(
            "Parameters of the standard model",
            [_parameters(trial), Bullets(_notes(trial)), *pictures(run, f"parameters_{name}.")],
        )
    )
    if trial["equations"]:
        blocks.append(Section("Equations", [_equations(trial)]))
    blocks.append(Section("The trial", pictures(run, f"trial_{name}."), folded=True))
    return Section(f"Trial {name}: vessel {settings.trials[name].vessel}", blocks)


def _about(trial: Results) -> str:
    shares = listed(
        [
            f"{100 * share:.0f} % in the {SET_NAMES[phase]}"
            for phase, share in trial["phases"].items()
        ]
    )
    units = ("m/s^2", "m/s^2", "rad/s^2")
    spread = listed(
        [
            f"{axis} {number(value)} {unit}"
            for (axis, value), unit in zip(trial["acceleration_std"].items(), units, strict=True)
        ]
    )
    return (
        f"The trial lasts {trial['seconds'] / 60:.0f} minutes in {trial['logs']} logs, sampled at"
        f" {1 / trial['step']:.0f} Hz: {shares}. The standard deviations of the accelerations are"
        f" {spread}. {100 * trial['validation_share']:.0f} % of the stretches validate."
    )


def _goodness(
    where: str,
    rows: Sequence[Results],
    published: Mapping[str, Any],
    absolute: Mapping[str, Any],
) -> Table:
    """Return the goodness of fit of all models on one set (Tables 7.3 to 7.5).

    Args:
        where: set of samples.
        rows: goodness of each model on each acceleration.
        published: RMSE, C_p and adjusted R^2 that the document prints, by model and acceleration.
        absolute: mean absolute residual and its interval, likewise.
    """
    table = Table(
        [
            "model",
            "acceleration",
            "fitted to",
            "parameters",
            "RMSE",
            "C_p",
            "adjusted R^2",
            "mean abs. residual",
            "95 %, blocks",
            "95 %, as printed",
        ],
        caption="Published figures are those of the real vessel. Intervals are of the mean absolute"
        " residual; those by moving blocks account for its correlation in time (correction E8).",
    )
    for row in rows:
        fitted_to = where if row["model"] == STANDARD else ALL
        printed, mean = (
            of.get(row["model"], {}).get(row["axis"]) if row["on"] == fitted_to else None
            for of in (published, absolute)
        )
        goodness = [
            beside_published(row[key], None if printed is None else printed[i], 3)
            for i, key in enumerate(("rmse", "cp", "r2_adjusted"))
        ]
        fitted_on = DASH if row["model"] == PLANT else row["on"].replace("_", "-")
        table.add(
            row["model"],
            [
                Cell(row["axis"], mark="text"),
                Cell(fitted_on, mark="text"),
                f"{row['parameters']:.0f}",
                *goodness,
                beside_published(row["mae"], mean[0] if mean else None, 3),
                interval(row["mae_ci95"]),
                Cell(
                    interval(row["mae_ci95_independent"]),
                    f"published {interval(list(mean[1:]))}" if mean else "",
                ),
            ],
        )
    return table


def _parameters(trial: Results) -> Table:
    """Return the parameters by set, beside the true ones and those of appendix C.2."""
    fits = trial["standard"]
    table = Table(
        [
            "parameter",
            "true",
            *(SET_NAMES[where] for where in fits),
            "published before",
            "published after",
        ],
        caption="SI units, with standard errors.",
    )
    for name in NAMES:
        table.add(
            name,
            [
                number(trial["truth"][name], 5),
                *(_estimate(fit, name) for fit in fits.values()),
                number(START_PARAMETERS[name], 5),
                number(FITTED_PARAMETERS.get(name), 4),
            ],
        )
    for name in SUMS:
        sums = [_with_error(*fit["sums"][name]) for fit in fits.values()]
        table.add(name, [number(trial["true_sums"][name], 5), *sums, "", ""])
    return table


def _estimate(fit: Results, name: str) -> Cell:
    value = fit["values"][name]
    if name in fit["undetermined"]:
        return Cell(number(value, 4), "not determined", mark="weak")
    if name in fit["at_bound"]:
        return Cell(number(value), "at its bound", mark="weak")
    return _with_error(value, fit["standard_errors"][name])


def _with_error(value: float, error: float | None) -> Cell:
    if error == 0.0:
        return Cell(number(value, 5), "at its bound", mark="weak")
    return Cell(number(value, 5), f"± {number(error, 2)}")


def _notes(trial: Results) -> list[str]:
    """Return what the data leave open, and whether every start leads to the same minimum."""
    notes = []
    for where, fit in trial["standard"].items():
        costs = fit["cost"]
        same = sum(cost <= costs[0] * (1 + _SAME_COST) for cost in costs)
        determined = (
            f"only combinations of {listed(fit['undetermined'])} are determined"
            if fit["undetermined"]
            else "every parameter is determined"
        )
        notes.append(
            f"In the {SET_NAMES[where]}, {determined}; the condition number of the rest is"
            f" {number(fit['condition'], 2)}. {same} of {len(costs)} starting points end at the"
            " least error."
        )
    return [
        *notes,
        "The standard errors account for scatter and correlation of the residuals. They do not"
        " account for what the filter, the waves or a wrong structure of the model shift.",
    ]


def _equations(trial: Results) -> Table:
    table = Table(["model", "equation"])
    for model, texts in trial["equations"].items():
        for text in texts.values():
            table.add(model.replace("_", "-"), [Cell(text, mark="text")])
    return table
