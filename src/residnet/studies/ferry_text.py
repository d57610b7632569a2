"""Force-space models as text: coefficients, weights, and what was chosen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.heads.regressions import Fit, table


def coefficients_text(about: str, terms: Sequence[str], fit: Fit, notes: Mapping[str, Any]) -> str:
    """A model for reading: coefficients in SI, and |Theta_pre|, which says how much each weighs."""
    lines = [f"{about}: tau = F_believed(nu_dot, nu) + sum of coefficient x basis function", ""]
    lines += [f"chosen: {notes_text(notes) or 'nothing'}", "", "| basis function | surge | sway | yaw | weight |", "|---|---|---|---|---|"]
    weights = dict(zip(terms, fit.pre.abs().tolist(), strict=True))
    for term, row in table(terms, fit):
        weight = " / ".join(f"{value:.3f}" for value in weights[term]) if term in weights else ""
        lines.append(f"| {term.replace('|', '&#124;')} | {row[0]:.4g} | {row[1]:.4g} | {row[2]:.4g} | {weight} |")
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
