"""The equations of symbolic heads, how sure they are, and what the data cannot tell."""

from __future__ import annotations

from residnet.report.blocks import Cell, Code, Section, Table, Text
from residnet.report.format import number
from residnet.report.run_reader import Content, RunFiles
from residnet.report.sections.fit.coefficients import term_unit

_NAMED = 8
"""Most names given of a list."""


def sections(run: RunFiles) -> list[Section]:
    """Return a section for every model with equations: equations, coefficients, remarks."""
    return [
        _equations(model, run.fit(model)) for model in run.heads if run.fit(model).get("equations")
    ]


def _equations(model: str, notes: Content) -> Section:
    about = (
        f"SI units. The head adds these accelerations to its baseline.{_delay(notes.get('delay'))}"
    )
    lines = "\n".join(equation["text"] for equation in notes["equations"].values())
    return Section(
        f"Equations of {model}",
        [
            Text(about, quiet=True),
            Code(lines, wrap=True),
            _coefficients(notes),
            Text(remarks(notes), quiet=True),
        ],
    )


def remarks(notes: Content) -> list[str]:
    """Return sentences on what the data do not determine."""
    out = []
    for name, equation in notes["equations"].items():
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
            f"These terms are zero in all samples, so nothing is known of them:"
            f" {_some(notes['unexcited'])}."
        )
    same: dict[str, Content] = {}
    for equation in notes["equations"].values():
        same |= equation["same_as_simpler"]
    if same:
        texts = [
            f"{term} = " + " + ".join(f"{value:.4g} ({other})" for other, value in parts.items())
            for term, parts in same.items()
        ]
        out.append(
            f"These terms equal simpler ones on these data, which stand in their place:"
            f" {_some(texts)}."
        )
    return out


def _coefficients(notes: Content) -> Table:
    table = Table(["term", "value", "standard error", "value / error", "unit"])
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
        table.add(f"{entry['axis'].replace('_dot', '')}′: {entry['term']}", cells)
    return table


def _delay(found: Content | None) -> str:
    return f" Delayed inputs act {found['seconds']:g} s after they are given." if found else ""


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (
        f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    )
