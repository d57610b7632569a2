"""The report's part on equations: what was found, how sure it is, and what the data cannot tell."""

from __future__ import annotations

from typing import Any

from residnet.report.run_reader import Row, RunFiles
from residnet.report.tables import Cell, Table, number, term_unit

_NAMED = 8
"""Most names given of a list."""


def section(run: RunFiles) -> list[dict[str, Any]]:
    """For every model with equations: name, delay, lines, table of coefficients, remarks."""
    return [
        {
            "name": model,
            "delay": _delay(run.fit(model).get("delay")),
            "lines": [equation["text"] for equation in run.fit(model)["equations"].values()],
            "table": _coefficients(run.fit(model)),
            "remarks": list(remarks(run.fit(model))),
        }
        for model in run.heads
        if run.fit(model).get("equations")
    ]


def remarks(notes: Row) -> list[str]:
    """Sentences on what the data do not determine."""
    out = []
    for name, equation in notes["equations"].items():
        out.append(
            f"{name}: {equation['candidates']} candidates that differ, condition number"
            f" {equation['condition']:.1e}; {100 * equation['error_share']:.2g} % of the target"
            " (RMS) unexplained."
        )
        for term, others in equation["cannot_tell_apart"].items():
            out.append(f"{name}: the data do not tell {term} from {_some(others)}.")
        if equation["undecided"]:
            terms = [
                f"{term} ({100 * share:.0f} %)" for term, share in equation["undecided"].items()
            ]
            out.append(
                f"{name}: left out, but within two standard errors they could make up the stated"
                f" share of the target: {_some(terms)}."
            )
    if notes["unexcited"]:
        out.append(
            f"Zero in all samples, so nothing is known of them: {_some(notes['unexcited'])}."
        )
    same: dict[str, Row] = {}
    for equation in notes["equations"].values():
        same |= equation["same_as_simpler"]
    if same:
        texts = [
            f"{term} = " + " + ".join(f"{value:.4g} ({other})" for other, value in parts.items())
            for term, parts in same.items()
        ]
        out.append(
            f"On these data the same as simpler terms, which stand in their place: {_some(texts)}."
        )
    return out


def _coefficients(notes: Row) -> Table:
    table = Table(heads=["value", "standard error", "value / error", "unit"], corner="term")
    for entry in notes["coefficients"]:
        value, error = entry["value"], entry["standard_error"]
        exact = error <= 1e-9 * abs(value)
        ratio = "exact" if exact else number(abs(value) / error, 2)
        cells = [
            Cell(number(value, 4)),
            Cell(number(error, 2)),
            Cell(ratio),
            Cell(term_unit(entry["axis"], entry["term"])),
        ]
        table.rows.append((f"{entry['axis'].replace('_dot', '')}′: {entry['term']}", cells))
    return table


def _delay(found: Row | None) -> str:
    return f"Late inputs act {found['seconds']:g} s after they are given." if found else ""


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (
        f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    )
