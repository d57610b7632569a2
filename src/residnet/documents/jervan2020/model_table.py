"""Force-space models as text: coefficients, weights, and what was chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.documents.jervan2020.regressions import Fit, table


def coefficients_text(
    about: str,
    terms: Sequence[str],
    fit: Fit,
    notes: Mapping[str, Any],
    truth: Mapping[str, Sequence[float]] | None = None,
    published: Mapping[str, Sequence[float]] | None = None,
) -> str:
    """A model for reading: coefficients in SI, and |Theta_pre|, which says how much each weighs.

    Args:
        about: what it is.
        terms: basis functions.
        fit: coefficients.
        notes: what was chosen.
        truth: what the believed hull really lacks, by basis function; empty or None where nobody
            knows.
        published: coefficients that a document found, by basis function.
    """
    lines = [f"{about}: tau = F_believed(nu_dot, nu) + sum of coefficient x basis function", ""]
    lines += [f"chosen: {notes_text(notes) or 'nothing'}", ""]
    beside = {
        name: values for name, values in (("true", truth), ("published", published)) if values
    }
    titles = [
        "basis function",
        "surge",
        "sway",
        "yaw",
        "weight",
        *(f"{name} surge / sway / yaw" for name in beside),
    ]
    lines += [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    weights = dict(zip(terms, fit.pre.abs().tolist(), strict=True))
    rows = dict(table(terms, fit))
    for term in dict.fromkeys((*rows, *(name for values in beside.values() for name in values))):
        own = [f"{value:.4g}" for value in rows.get(term, (0.0, 0.0, 0.0))]
        weight = " / ".join(f"{value:.3f}" for value in weights[term]) if term in weights else ""
        others = [
            " / ".join(f"{value:.4g}" for value in values.get(term, (0.0, 0.0, 0.0)))
            for values in beside.values()
        ]
        lines.append(f"| {' | '.join([term.replace('|', '&#124;'), *own, weight, *others])} |")
    return "\n".join(lines) + "\n"


def notes_text(notes: Mapping[str, Any]) -> str:
    """What a fit chose, in one line."""

    def said(value: Any) -> str:
        if isinstance(value, dict):
            return ", ".join(f"{key} {said(part)}" for key, part in value.items())
        if isinstance(value, list):
            return "/".join(said(part) for part in value)
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    return "; ".join(f"{key} {said(value)}" for key, value in notes.items())
