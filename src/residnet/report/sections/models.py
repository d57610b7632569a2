"""What was identified and learned: coefficients, heads, equations, learning, goodness of fit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from residnet.core.errors import ConfigError
from residnet.core.format import DASH, fixed, interval, number, powers
from residnet.core.format import whole as whole_number
from residnet.core.names import CHANNEL_UNITS
from residnet.judge.verdict import diverged_note
from residnet.physics.terms import parse_term
from residnet.report.blocks import Block, Cell, Code, Mark, Section, Table, Text, table_of
from residnet.report.figure import BLUE, Case, Curve, Figure, Look, Panel, family
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.runs import AXES, model_looks, short_label

_EXTRA_UNITS = {"wind_u": "m/s", "wind_v": "m/s", "wind_mag": "m/s"}
"""Units of factors of terms that are no channels of a log."""
_NAMED = 8
"""Most names given of a list."""
_TERMS = 6
"""Most terms drawn for themselves in a panel, the largest ones; of the others the sum is drawn."""
_PARTS = ("train", "validation")
_RING = Look("", kind="points", size=7, hollow=True, order=5)
_WHITE = 0.05
"""Least p-value at which residuals pass for white noise."""


def models(run: RunFiles) -> Section | None:
    """Return the section on what was identified and learned."""
    found = [_baselines(run), _heads(run)]
    found += [
        _equations(model, run.fit(model)) for model in run.heads if run.fit(model).get("equations")
    ]
    there = [part for part in found if part is not None]
    return Section("Models", there) if there else None


def _baselines(run: RunFiles) -> Section | None:
    """Return the tables of coefficients, the first baseline's open; None where there are none."""
    blocks: list[Block] = [
        Text(
            "u′, v′, r′ are the accelerations du/dt, dv/dt, dr/dt. Each is the sum of its terms. A"
            " value below twice its standard error (grey) cannot be told from 0.",
            quiet=True,
        )
    ]
    further = [model for model, kind in run.kinds.items() if kind == "further"]
    for model in (run.baseline or "baseline", *further):
        notes = run.fit(model)
        if not notes.get("coefficients"):
            continue
        parts: list[Block] = [_coefficients(notes)]
        title = f"Parameters of {model}"
        if notes.get("refit"):
            parts.insert(0, Text(_after_refit(model, notes), quiet=True))
            title += ", refitted through rollouts"
        blocks += parts if len(blocks) == 1 else [Section(title, parts, folded=True)]
    return Section("Baseline parameters", blocks) if len(blocks) > 1 else None


def _after_refit(model: str, notes: Content) -> str:
    at_rest, left_open = (
        ", ".join(f"{term} in {axis.replace('_dot', '')}′" for axis, term in notes.get(key) or [])
        for key in ("feeding", "open")
    )
    said = (
        f"{model}: values and standard errors are those after the refit through rollouts. The"
        " ratios of value to error keep the error of the least-squares fit before it."
    )
    if at_rest:
        said += f" Left out, for their sign would feed energy: {at_rest}."
    if left_open:
        said += f" The data leave open, and they stay near 0: {left_open}."
    return said


def _coefficients(notes: Content) -> Table:
    """Return coefficients with their standard errors, to two digits of these, and units."""

    def value(entry: Content) -> str:
        value, error = float(entry["value"]), float(entry["standard_error"])
        decimals = max(1 - math.floor(math.log10(error)), 0) if error > 0 else 7
        # an exact one has no error to tell its digits by
        return fixed(value, decimals) if decimals <= 6 else number(value, 4)

    def ratio(entry: Content) -> Cell:
        value, error = abs(float(entry["value"])), float(entry["standard_error"])
        if error <= 1e-9 * value:
            return Cell("exact")
        return Cell(number(value / error, 2), mark="weak" if value < 2 * error else "")

    return table_of(
        notes["coefficients"],
        [
            ("term", lambda entry: f"{entry['axis'].replace('_dot', '')}′: {entry['term']}"),
            ("value", value, str),
            ("standard error", lambda entry: number(float(entry["standard_error"]), 2), str),
            ("value / error", ratio),
            ("unit", lambda entry: term_unit(entry["axis"], entry["term"]), str),
        ],
    )


def term_unit(axis: str, term: str) -> str:
    """Return the unit of a coefficient: that of the acceleration over that of its term.

    It is empty where the unit of a factor is not known.
    """
    units = CHANNEL_UNITS | _EXTRA_UNITS
    try:
        factors = parse_term(term, [name for name in units if name != "t"], functions=False)
    except ConfigError:
        return ""
    found: dict[str, int] = {}
    for unit, sign in [
        (units.get(axis, "-"), 1),
        *((units[factor.name], -factor.power) for factor in factors),
    ]:
        for place, part in enumerate(unit.split("/")):
            for piece in part.split():
                name, _, exponent = piece.partition("^")
                if name not in ("1", "-"):
                    power = (sign if place == 0 else -sign) * int(exponent or 1)
                    found[name] = found.get(name, 0) + power
    up, down = (
        "·".join(powers(f"{n}^{s * p}".removesuffix("^1")) for n, p in found.items() if s * p > 0)
        for s in (1, -1)
    )
    if not down:
        return up or "-"
    return f"{up or '1'}/({down})" if "·" in down else f"{up or '1'}/{down}"


def _heads(run: RunFiles) -> Section | None:
    """Return what was learned: kind, complexity, parameters, time, and the error that selects.

    None where the folder holds no notes on any fit.
    """
    if not any(run.fit(model) for model in run.heads):
        return None

    def count(model: str) -> str:
        notes = run.fit(model)
        found = notes.get("parameters") or 3 * (int(notes.get("terms", -1)) + 1)
        return whole_number(found) if found else DASH

    def error(model: str) -> Cell:
        row = run.row(model, "validation", run.deciding)
        value = row["nrmse"]["mean"] if row else run.fit(model).get("validation")
        lost = row is not None and row["diverged"]
        note = diverged_note(row) if row else ""
        mark: Mark = "best" if model == run.selected else "bad" if lost else ""
        return Cell(number(value), note, mark)

    def kind(model: str) -> str:
        card = run.card(model)
        return str((card.get("head") or {}).get("kind") or card.get("role", DASH))

    table = table_of(
        run.heads,
        [
            ("head", run.label),
            ("kind", kind, str),
            ("complexity", lambda model: _complexity(run, model)),
            ("parameters", count, str),
            ("inputs; baseline below", lambda model: _foundation(run, model)),
            ("fit [s]", lambda model: number(run.fit(model).get("seconds"), 2), str),
            ("epochs", lambda model: str(run.fit(model).get("epochs", DASH)), str),
            ("validation NRMSE [-]", error),
        ],
        selected=lambda model: model == run.selected,
    )
    about = (
        "A head adds to the accelerations of a baseline what that leaves. Further baselines and"
        " ensembles stand alone."
    )
    return Section("Residual heads and further models", [Text(about, quiet=True), table])


def _foundation(run: RunFiles, model: str) -> str:
    """Return the inputs of a head and the baseline below it, or the members of an ensemble."""
    notes, head = run.fit(model), run.card(model).get("head") or {}
    if notes.get("members"):
        return "mean of " + ", ".join(notes["members"])
    if not head:
        return "refitted through rollouts" if notes.get("refit") else "least squares"
    below = notes.get("baseline", "baseline")
    inputs = ", ".join(head.get("features") or []) or "all channels"
    return inputs if below == "baseline" else f"{inputs}; {below}"


_COMPLEXITY = {
    "terms": "{} basis functions",
    "order": "order {} (latent variables)",
    "penalty": "penalty {}",
    "hidden": "layers of {}",
    "hidden_size": "{} hidden units",
}
"""What notes and cards of heads hold, and how it is told."""


def _complexity(run: RunFiles, model: str) -> str:
    head, parts = run.card(model).get("head") or {}, []
    # a card's `terms` are names
    known = dict(run.fit(model)) | {
        key: head[key] for key in ("hidden", "hidden_size") if key in head
    }
    for key, words in _COMPLEXITY.items():
        if key in known:
            values = known[key] if isinstance(known[key], list) else [known[key]]
            parts.append(words.format(", ".join(f"{value:g}" for value in values)))
    return ("; ".join(parts) or DASH) + (" for each axis" if head.get("per_axis") else "")


def _equations(model: str, notes: Content) -> Section:
    """Return the equations of a model, how sure they are, and what the data cannot tell."""
    delay = notes.get("delay")
    about = "SI units. The head adds these accelerations to its baseline." + (
        f" Delayed inputs act {delay['seconds']:g} s after they are given." if delay else ""
    )
    return Section(
        f"Equations of {model}",
        [
            Text(about, quiet=True),
            Code("\n".join(one["text"] for one in notes["equations"].values()), wrap=True),
            _coefficients(notes),
            Text(remarks(notes), quiet=True),
        ],
    )


def remarks(notes: Content) -> list[str]:
    """Return sentences on what the data do not determine."""
    out = []
    same: dict[str, Content] = {}
    for name, equation in notes["equations"].items():
        same |= equation["same_as_simpler"]
        out.append(
            f"{name}: {equation['candidates']} candidate terms differ on these data (condition"
            f" number {equation['condition']:.1e}). {100 * equation['error_share']:.2g} % of the"
            " target (RMS) stays unexplained."
        )
        for term, others in equation["cannot_tell_apart"].items():
            out.append(f"{name}: the data cannot tell {term} from {_some(others)}.")
        if equation["undecided"]:
            terms = [
                f"{term} ({100 * share:.0f} %)" for term, share in equation["undecided"].items()
            ]
            out.append(
                f"{name}: these terms were left out, but within two standard errors they could"
                f" make up the stated share of the target: {_some(terms)}."
            )
    if notes["unexcited"]:
        out.append(
            "These terms are 0 in all samples, so nothing is known of them:"
            f" {_some(notes['unexcited'])}."
        )
    if same:
        texts = [
            f"{term} = " + " + ".join(f"{value:.4g} ({other})" for other, value in parts.items())
            for term, parts in same.items()
        ]
        out.append(
            "These terms equal simpler ones on these data, which stand in their place:"
            f" {_some(texts)}."
        )
    return out


def _some(names: list[str]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def terms(run: RunFiles) -> Iterator[Figure]:
    """Draw the equation of every model along a log, term by term (document 000, 6.4.2)."""
    frame = run.frame("terms.parquet")
    for model, rows in [] if frame is None else frame.groupby("model", sort=False):
        curves: list[dict[str, Curve]] = []
        axes = [axis for axis in AXES if (rows["axis"] == axis).any()]
        for axis in axes:
            of_axis = rows[rows["axis"] == axis]
            wide = of_axis.pivot_table(index="t", columns="term", values="value", sort=False)
            wide *= AXES[axis][2]
            time, target = wide.index.to_numpy(), wide.pop("target")
            order = (wide**2).mean().sort_values(ascending=False, kind="stable").index
            shown = {"target": target} | {str(term): wide[term] for term in order[:_TERMS]}
            if len(order) > _TERMS:
                shown["smaller terms"] = wide[order[_TERMS:]].sum(axis=1)
            shown["sum"] = wide.sum(axis=1)
            curves.append({name: (time, line.to_numpy()) for name, line in shown.items()})
        names = {name for panel in curves for name in panel} - {"target", "smaller terms", "sum"}
        looks = {
            "target": Look("target", "#BFBFBF", width=2.2),
            **family(sorted(names), width=1.0),
            "smaller terms": Look("sum of smaller terms", "#7F7F7F", "dotted", 1.0),
            "sum": Look("sum", width=0.8, order=4),
        }
        looks = {name: replace(look, label=powers(look.label)) for name, look in looks.items()}
        yield Figure(
            f"terms_{model}",
            f"Equation of {model}, term by term",
            f"What each term adds to the acceleration along {rows['log'].iloc[0]}, and their sum"
            " (black) against the target (grey), which is what the baseline leaves. Two large terms"
            " that mirror each other mean that the data can hardly tell them apart. A flat term"
            " could be left out.",
            looks,
            [
                Panel(
                    "{} [{}]".format(*AXES[axis]),
                    "time [s]" if axis == axes[-1] else "",
                    height=230,
                )
                for axis in axes
            ],
            [Case("", curves)],
        )


def breeding(run: RunFiles) -> Iterator[Figure]:
    """Draw the best error of each generation of every model that was bred (Figures 6.2, 6.3)."""
    for model in run.heads:
        equations = run.fit(model).get("equations", {})
        curves: list[Any] = []
        panels: list[Panel] = []
        for axis, row in ((axis, row) for axis, row in equations.items() if "history" in row):
            errors = pd.DataFrame(row["history"])
            kept = errors.iloc[[row["generation"]]]
            curves.append(
                {part: (errors.index.to_numpy(), errors[part].to_numpy()) for part in _PARTS}
                | {"kept": (kept.index.to_numpy(), kept["validation"].to_numpy())}
            )
            label = "" if panels else "share of the mean square [-]"
            panels.append(
                Panel(label, "generation", AXES[axis][0], height=230, y_log=True, group=axis)
            )
        if panels:
            yield Figure(
                f"breeding_{model}",
                f"Search of {model}, generation by generation",
                "Mean square error of the best individual over the target's mean square, on the"
                " samples that breed and on those that validate. A ring marks the generation whose"
                " equation was kept, the least validation error. A curve that still falls at its"
                " end asks for more generations.",
                family(_PARTS) | {"kept": replace(_RING, label="kept")},
                panels,
                [Case("", curves)],
                columns=len(panels),
            )


def learning(run: RunFiles) -> Figure | None:
    """Draw loss and free-run error on validation data by epoch, a case for each trained head."""
    cases = []
    reference = run.row(run.baseline, "validation", run.deciding)
    for model in run.heads:
        points = pd.DataFrame(run.fit(model).get("curve") or [])
        if points.empty:
            continue
        points = points.reindex(columns=["epoch", "stage", "loss", "validation"])
        epoch, stage, loss, validation = points.fillna({"stage": 0}).to_numpy(float).T
        epoch += 1
        # each stage has a loss of its own
        gap = np.flatnonzero(np.diff(stage)) + 1
        upper: dict[str, Curve] = {
            "loss": (np.insert(epoch, gap, np.nan), np.insert(loss, gap, np.nan))
        }
        known = np.isfinite(validation)
        lower: dict[str, Curve] = {"validation": (epoch[known], validation[known])}
        if reference is not None:
            lower["baseline"] = (epoch[:1], np.array([reference["nrmse"]["mean"]]))
        if known.any():
            best = [int(np.nanargmin(validation))]
            lower["best"] = (epoch[best], validation[best])
        if len(gap):
            upper["stage"] = lower["stage"] = (epoch[gap] - 0.5, np.zeros(len(gap)))
        multi = ((run.resolved.get("training") or {}).get(model) or {}).get("multi_step") or []
        words = {k + 1: f"{one['horizon']:g} s" for k, one in enumerate(multi)} | {0: "one-step"}
        texts = [
            (0, float(epoch[stage == k].mean()), math.nan, words.get(int(k), f"stage {k:.0f}"))
            for k in np.unique(stage)
        ]
        cases.append(Case(short_label(run, model), [upper, lower], texts=texts))
    if not cases:
        return None
    baseline = model_looks(run)[run.baseline] if run.baseline else Look("")
    return Figure(
        "learning",
        "Learning curves",
        "Each stage (one-step, then free runs of the stated length) has a loss of its own,"
        " so only the slopes count. The lower panels decide: the weights of the circled"
        " epoch are kept. A curve that still falls at its end asks for more epochs.",
        {
            "loss": Look("training loss", BLUE),
            "validation": Look("validation", BLUE),
            "baseline": replace(baseline, kind="across"),
            "best": replace(_RING, label="best epoch"),
            "stage": Look("next stage", "#7F7F7F", width=0.8, kind="upright", order=1),
        },
        [
            Panel("training loss [-]", height=200, y_log=True),
            Panel("free-run error on\nvalidation, NRMSE [-]", "epoch", height=200),
        ],
        cases,
        "Head",
    )


def goodness(run: RunFiles) -> Section | None:
    """Return the section on goodness of fit, None where the run has no goodness.json.

    It speaks of the split that the report is on; another one stands in where that has no samples.
    """
    splits = run.json("goodness.json").get("splits") or {}
    split = next((name for name in (run.focus, *splits) if splits.get(name)), "")
    parts: list[Block] = []
    for axis, (title, *_) in AXES.items():
        of_axis = [row for row in splits.get(split, []) if row["axis"] == axis]
        if of_axis:
            name = axis.removesuffix("_dot")
            unit, factor = run.unit(name)
            unit = f"{unit}²" if unit.endswith("/s") else f"{unit}/s"
            parts.append(
                Section(
                    f"{title} {name}′ [{unit}], {split} data",
                    [*_fit_tables(of_axis, factor), Text(" ".join(_sentences(of_axis)))],
                    folded=bool(parts),
                )
            )
    if not parts:
        return None
    about = (
        "These are one-step residuals: what each model leaves of the measured acceleration"
        " along the measured states. A model that is good here may still be poor in free run,"
        " and the other way round."
    )
    words = [
        "C_p, AIC and BIC use the noise variance of the model with the least residual. The"
        " parameters of a kernel model are the trace of its smoother, those of a network"
        " all its weights.",
        "95 %, blocks: moving-block bootstrap with a block length chosen from the data. 95"
        " %, independent: Student's t for independent samples, far too narrow for"
        " correlated residuals. White: test of Ljung and Box, which counts every sample.",
        "Difference: of the mean |residual| from that of the named model at the same"
        " samples, with its interval by blocks. Negative is better; a bold one excludes"
        " zero.",
    ]
    return Section("Goodness of fit", [Text(about), *parts, Text(words, quiet=True)])


def _fit_tables(rows: list[Content], factor: float) -> list[Table]:
    """Return how close each model fits on one axis, and how sure its residuals are."""

    def white(row: Content) -> Cell:
        p = row["white_p"]
        return Cell("< 0.001" if p < 1e-3 else number(p, 2), mark="" if p > _WHITE else "weak")

    def difference(row: Content) -> Cell:
        pair = row.get("difference")
        if pair is None:
            return Cell(DASH)
        text = f"{number(factor * pair['mae'])} ({interval(pair['ci95'], factor)})"
        return Cell(text, f"to {pair['to']}", "best" if pair["excludes_zero"] else "")

    return [
        table_of(
            rows,
            [
                ("model", "model"),
                ("parameters", "parameters", number),
                ("RMSE", "rmse", number, factor),
                ("R²", "r2", number),
                ("adjusted R²", "r2_adjusted", number),
                ("C_p", "cp", number, factor**2),
                ("AIC", lambda row: number(row["aic"], 4), str),
                ("BIC", lambda row: number(row["bic"], 4), str),
            ],
        ),
        table_of(
            rows,
            [
                ("model", "model"),
                ("mean |residual|", "mae", number, factor),
                ("95 %, blocks", lambda row: interval(row["mae_ci95"], factor), str),
                (
                    "95 %, independent",
                    lambda row: Cell(interval(row["mae_ci95_independent"], factor), mark="weak"),
                ),
                ("block [s]", lambda row: number(row["block_seconds"], 2), str),
                (
                    "independent samples",
                    lambda row: f"{row['effective']:.0f} of {row['samples']}",
                    str,
                ),
                ("correlation at lag 1", lambda row: number(row["autocorrelation"][0]), str),
                ("white, p", white),
                ("difference", difference),
            ],
        ),
    ]


def _sentences(rows: list[Content]) -> list[str]:
    """Return by how much intervals of independent samples are too narrow, and what is white."""
    spans = [
        [np.ptp(row[key] or [0.0]) for key in ("mae_ci95", "mae_ci95_independent")] for row in rows
    ]
    wider = [blocks / independent for blocks, independent in spans if blocks and independent > 0]
    out = []
    if wider:
        out.append(
            "The interval that takes the samples for independent is"
            f" {min(wider):.1f} to {max(wider):.1f} times too narrow."
        )
    white = [row["model"] for row in rows if row["white_p"] > _WHITE]
    out.append(
        f"The residuals of {', '.join(white)} pass for white noise."
        if white
        else "No model leaves white residuals."
    )
    return out
