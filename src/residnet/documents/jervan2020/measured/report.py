"""The report page of a study of measured forces, from its results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.documents.cells import beside_published, listed, notes_text, pictures
from residnet.documents.jervan2020.measured.config import ForceSettings
from residnet.documents.jervan2020.measured.study import better
from residnet.documents.jervan2020.residual_model import AXES
from residnet.documents.jervan2020.residual_pages import (
    ABOUT_COEFFICIENTS,
    MODEL_PICTURES,
    coefficients_section,
)
from residnet.report.blocks import Bullets, Cell, Section, Table, Text
from residnet.report.format import fixed, interval, number, plural, signed

Results = Mapping[str, Any]
_BASE = ("zero", "believed")
_ABOUT = Text(ABOUT_COEFFICIENTS)


def verdict(results: Results) -> list[str]:
    """Return the sentences that say for each force whether a regression gained anything."""
    sentences: list[str] = []
    for force, rows in _groups(results).items():
        fits = [row for row in rows if row["model"] not in _BASE]
        if results["intervals"] is None:
            sentences.append(
                f"{force.capitalize()} force: there are too few segments to say whether one model"
                " is better than another."
            )
            continue
        believed = next(row for row in rows if row["model"] == "believed")
        sentences.append(
            f"{force.capitalize()} force: the believed model is better than no force"
            f" {_where(better(believed, 'zero'))}{_worse_than_nothing(believed)}."
        )
        sentences += [*_gains(fits), _advice(fits)]
    return sentences + _lags(results)


def _worse_than_nothing(believed: Results) -> str:
    """Return where the believed model is reliably worse than no force, for the same sentence."""
    bounds = believed["minus_zero"]["ci95"][:3]
    names = [axis for axis, limits in zip(AXES, bounds, strict=True) if limits[0] > 0]
    return f", and worse than no force in {listed(names)}" if names else ""


def _gains(fits: Sequence[Results]) -> list[str]:
    """Return sentences on which regressions are better than what needs none."""
    best = "the better of no force and the believed model on each axis"
    winners = [row for row in fits if better(row, "reference")[3]]
    if not winners:
        sentences = [
            f"None of the {len(fits)} regressions is better than {best}: every interval of the mean"
            " over the axes reaches zero."
        ]
    else:
        gain = -100 * min(row["minus_reference"]["mean"][3] for row in winners)
        sentences = [
            f"Of {len(fits)} regressions, these are better than {best} in the mean over the axes:"
            f" {listed([row['model'] for row in winners])}. The largest gain is {fixed(gain, 1)} %"
            " of the force's mean square."
        ]
    single = [
        f"{row['model']} ({_where(flags)})"
        for row in fits
        if any(flags := better(row, "reference")[:3])
    ]
    if single:
        sentences.append(
            f"Better on single axes: {listed(single)}; of {3 * len(fits)} such comparisons, one in"
            " forty comes out so by chance."
        )
    worse = [row["model"] for row in fits if row["minus_reference"]["ci95"][3][0] > 0]
    if worse:
        sentences.append(f"Worse than that: {listed(worse)}.")
    return sentences


def _advice(fits: Sequence[Results]) -> str:
    """Return the sentence that says what to use on each axis.

    A regression is named where it is reliably better on that axis; of several, the one with the
    least error. Otherwise it is the better of no force and the believed model.
    """
    names = {"zero": "no force at all", "believed": "the believed model alone"}
    chosen: dict[str, list[str]] = {}
    for axis, name in enumerate(AXES):
        sure = [row for row in fits if better(row, "reference")[axis]]
        best = min(sure, key=lambda row: float(row["mse"][axis]), default=None)
        use = names[fits[0]["reference"][axis]] if best is None else str(best["model"])
        chosen.setdefault(use, []).append(name)
    parts = [f"{use} in {listed(axes)}" for use, axes in chosen.items()]
    return f"Recommended: {', '.join(parts)}."


def _where(flags: Sequence[bool]) -> str:
    names = [name for name, yes in zip((*AXES, "the mean over axes"), flags, strict=False) if yes]
    return f"in {listed(names)}" if names else "on no axis"


def _lags(results: Results) -> list[str]:
    """Return a sentence that compares fitted lags with that of the actual forces."""
    thrusters = results["forces"]["lag"]
    fitted = {
        name: model["all"]["lag"]
        for name, model in results["models"].items()
        if "lag" in model["all"]
    }
    if isinstance(thrusters, str) or not fitted:
        return []
    each = [
        f"{number(lag['frequency'])} rad/s and {number(lag['delay'], 2)} s for {name}"
        for name, lag in fitted.items()
    ]
    return [
        f"The lag fitted together with the residual is {listed(each)}; the actual forces follow the"
        f" commands with {number(thrusters['frequency'])} rad/s and"
        f" {number(thrusters['delay'], 2)} s."
    ]


def main_figures(results: Results) -> dict[str, tuple[float, str]]:
    """Return the numbers that sum the study up, with their units."""
    out: dict[str, tuple[float, str]] = {}
    for force, rows in _groups(results).items():
        believed = next(row for row in rows if row["model"] == "believed")
        best = min(rows, key=lambda row: sum(row["of_zero"]))
        for row in {id(believed): believed, id(best): best}.values():
            share = sum(row["of_zero"]) / 3
            out[f"share of the {force} force left by {row['model']}"] = (share, "-")
    return out


def _groups(results: Results) -> dict[str, list[Results]]:
    """Return the rows of the results by the force that judges them."""
    out: dict[str, list[Results]] = {}
    for row in results["rows"]:
        out.setdefault(row["force"], []).append(row)
    return out


def sections(config: ForceSettings, results: Results, run: Path) -> list[Section]:
    """Return the sections of the report.

    Args:
        config: the study.
        results: contents of force_residual.json.
        run: run folder, which holds the figures.
    """
    out = [_data(config, results), _forces(results, run)]
    if results["acceleration"]:
        out.append(_accelerations(config, results, run))
    for force, rows in _groups(results).items():
        out.append(Section(f"Residual of the {force} force", [_models(config, results, rows)]))
    out.append(Section("Errors and residuals", pictures(run, "scores", "residual_")))
    if results["failed"]:
        causes = list(results["failed"].values())
        out.append(Section("Not determined by these logs", [Bullets(causes)]))
    causes = [model["not_forward"] for model in results["models"].values() if model["not_forward"]]
    if causes:
        out.append(Section("Models that cannot run forward in time", [Bullets(causes)]))
    coefficients = [
        coefficients_section(name, model, model["all"], {})
        for name, model in results["models"].items()
    ]
    out.append(Section("Coefficients of models fitted to all samples", [_ABOUT, *coefficients]))
    return [*out, Section("Orders, weights and surfaces", pictures(run, *MODEL_PICTURES), True)]


def _data(config: ForceSettings, results: Results) -> Section:
    """Return what was read, and how models are judged."""
    lengths = [f"{log['name']} ({log['seconds']:.0f} s)" for log in results["logs"]]
    masks = [
        f"{100 * share:.1f} % of {log} by {reason}"
        for log, reasons in results["masked"].items()
        for reason, share in reasons.items()
    ]
    folds, validation, blocks = results["folds"], config.validation, results["intervals"]
    each = (
        "each consists of whole logs"
        if folds["of"] == "logs"
        else "each is a stretch of time of every log"
    )
    paragraphs = [
        f"Logs: {', '.join(lengths)}. Masked: {', '.join(masks) or 'nothing'}; {results['used']} of"
        f" {results['samples']} samples are used.",
        f"There are {folds['count']} folds; {each}. No model is fitted to data within"
        f" {validation.gap:g} s of what it predicts. Orders and penalties are chosen inside the"
        f" training part, on left-out segments of {validation.segment:g} s. Errors are means over"
        " segments.",
        "There are no intervals, because there are fewer than five segments."
        if blocks is None
        else f"Intervals (95 %) come from resampling {plural(blocks['count'], blocks['of'][:-1])}."
        + (
            ""
            if blocks["of"] == "logs"
            else " With so few logs they speak for these logs and not for another day."
        ),
        "The model zero predicts no force at all; believed predicts the force of the believed hull,"
        " which is a residual of zero.",
    ]
    return Section("Data and cross-validation", [Text(paragraphs)])


def _forces(results: Results, run: Path) -> Section:
    """Return the comparison of commanded and actual force."""
    lag = results["forces"]["lag"]
    text = (
        f"The thrusters' lag is not determined: {lag}."
        if isinstance(lag, str)
        else f"The actual force follows the command with a lag of {number(lag['frequency'])} rad/s,"
        f" a damping ratio of {number(lag['damping'])} and a delay of {number(lag['delay'])} s."
    )
    table = Table(
        [
            "axis",
            "rms commanded",
            "rms actual",
            "explained by the command %",
            "explained through the lag %",
            "gain through the lag",
        ],
        caption="Forces in N, N and N m; a share is of the variance of the actual force.",
    )
    for axis in AXES:
        force = results["forces"][axis]
        shares = [fixed(100 * force[key], 1) for key in ("explained", "explained_with_lag")]
        rms = [number(force[key], 4) for key in ("rms_commanded", "rms_actual")]
        table.add(axis, [*rms, *shares, fixed(force["gain_with_lag"], 3)])
    return Section("Commanded and actual force", [Text(text), table, *pictures(run, "forces_")])


def _accelerations(config: ForceSettings, results: Results, run: Path) -> Section:
    """Return the comparison of measured accelerations and derivatives of velocity."""
    used = (
        "the derivative of the velocity"
        if config.acceleration == "velocity"
        else "the measured acceleration less its offset"
    )
    table = Table(
        [
            "axis",
            "offset",
            "95 % interval",
            "rms difference",
            "rms of the derivative",
            "correlation",
        ],
        caption=f"In m/s^2, m/s^2 and rad/s^2; the models use {used}.",
    )
    for axis in AXES:
        row = results["acceleration"][axis]
        table.add(
            axis,
            [
                number(row["offset"], 2),
                interval(row["offset_ci95"], digits=2),
                number(row["rms_without_offset"]),
                number(row["rms"]),
                fixed(row["correlation"], 4),
            ],
        )
    return Section(
        "Measured accelerations and derivatives of velocity",
        [table, *pictures(run, "accelerations_")],
    )


def _models(config: ForceSettings, results: Results, rows: Sequence[Results]) -> Table:
    """Return the table of the models that are judged on one force (Tables 5.1, 5.2, 5.4, 5.5)."""
    table = Table(
        [
            "model",
            *("surge N^2", "sway N^2", "yaw (N m)^2"),
            *("surge", "sway", "yaw") * 2,
            *("mean", "95 % interval", "segments better %") * 2,
            "chosen by the estimator",
        ],
        caption="Published: the share that the document's model of that kind left of its believed"
        " model's residual, in other trials.",
        groups=[
            ("mean square error", 3),
            ("% of zero", 3),
            ("% of the believed model's", 3),
            ("mean over axes less believed, % of zero", 3),
            ("the same less the better of zero and believed on each axis", 3),
            ("", 1),
        ],
    )
    base = next(row for row in rows if row["model"] == "believed")["mse"]
    for row in rows:
        model_config = config.models.get(row["model"])
        published = None if model_config is None else model_config.published
        cells = [Cell(number(value, 4)) for value in row["mse"]]
        cells += [Cell(fixed(100 * value, 0)) for value in row["of_zero"]]
        for axis in range(3):
            left = 100 * published[1][axis] / published[0][axis] if published else None
            cells.append(beside_published(100 * row["mse"][axis] / base[axis], left, 3))
        difference = row.get("minus_believed")
        cells += [Cell("")] * 3 if difference is None else _difference(difference)
        cells += _difference(row["minus_reference"])
        notes = "" if model_config is None else notes_text(results["models"][row["model"]]["all"])
        table.add(row["model"], [*cells, Cell(notes, mark="text")])
    return table


def _difference(difference: Results) -> list[Cell]:
    """Return mean, interval and share of better segments of the mean over the axes."""
    bounds = difference["ci95"][3]
    shown = "" if bounds is None else " to ".join(signed(100 * bound, 1) for bound in bounds)
    return [
        Cell(signed(100 * difference["mean"][3], 1)),
        Cell(shown),
        Cell(fixed(100 * difference["segments_below"][3], 0)),
    ]
