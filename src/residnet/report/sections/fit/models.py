"""Residual heads and further models: what they are and what chose their complexity."""

from __future__ import annotations

from residnet.judge.verdict.sentences import diverged_note
from residnet.report.blocks import Cell, Section, Table, Text
from residnet.report.format import DASH, number, whole
from residnet.report.run_reader import Content, RunFiles


def section(run: RunFiles) -> Section | None:
    """Return the table of heads and further models, None where there are none."""
    table = heads(run)
    if table is None:
        return None
    about = (
        "A head adds to the accelerations of a baseline what that leaves. Further baselines and"
        " ensembles stand alone. The simplest sound model is selected that validation does not tell"
        " from the best one."
    )
    return Section("Residual heads and further models", [Text(about, quiet=True), table])


def heads(run: RunFiles) -> Table | None:
    """Return what was learned: kind, complexity, parameters, time, and the error that selects.

    None where the folder holds no notes on any fit.
    """
    if not any(run.fit(model) for model in run.heads):
        return None
    protocol = run.protocols[0]
    table = Table(
        [
            "head",
            "kind",
            "complexity",
            "parameters",
            "inputs; baseline below",
            "fit [s]",
            "epochs",
            "validation NRMSE [-]",
        ]
    )
    for model in run.heads:
        notes, card = run.fit(model), run.card(model)
        head = card.get("head") or {}
        row = run.row(model, "validation", protocol)
        error = row["nrmse"]["mean"] if row else notes.get("validation")
        count = notes.get("parameters") or (
            3 * (int(notes["terms"]) + 1) if "terms" in notes else None
        )
        cells = [
            Cell(str(head.get("kind") or card.get("role", DASH))),
            Cell(_complexity(notes, head), mark="text"),
            Cell(whole(count) if count else DASH),
            Cell(_foundation(notes, head), mark="text"),
            Cell(number(notes.get("seconds"), 2)),
            Cell(str(notes.get("epochs", DASH))),
            Cell(
                number(error),
                diverged_note(row) if row else "",
                "best" if model == run.selected else "bad" if row and row["diverged"] else "",
            ),
        ]
        table.add(run.label(model), cells, selected=model == run.selected)
    return table


def _foundation(notes: Content, head: Content) -> str:
    """Return the inputs of a head and the baseline below it, or the members of an ensemble."""
    if notes.get("members"):
        return "mean of " + ", ".join(notes["members"])
    if not head:
        return "refitted through rollouts" if notes.get("refit") else "least squares"
    inputs = ", ".join(head.get("features") or []) or "all channels"
    return (
        f"{inputs}; {notes['baseline']}"
        if notes.get("baseline", "baseline") != "baseline"
        else inputs
    )


def _complexity(notes: Content, head: Content) -> str:
    parts = []
    if "terms" in notes:
        parts.append(f"{notes['terms']} basis functions")
    if "order" in notes:
        parts.append(f"order {notes['order']} (latent variables)")
    if "penalty" in notes:
        penalties = notes["penalty"] if isinstance(notes["penalty"], list) else [notes["penalty"]]
        parts.append("penalty " + ", ".join(f"{value:g}" for value in penalties))
    if "hidden" in head:
        parts.append("layers of " + ", ".join(str(units) for units in head["hidden"]))
    if "hidden_size" in head:
        parts.append(
            f"{head['hidden_size']} hidden units"
            + (" for each axis" if head.get("per_axis") else "")
        )
    return "; ".join(parts) or DASH
