"""What both studies of document 002 show of a residual model: coefficients, weights and surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.documents.cells import notes_text
from residnet.documents.jervan2020.regressions import Fit, RegressionConfig, SurfaceRegression
from residnet.documents.jervan2020.residual_model import AXES
from residnet.report.blocks import Section, Table, Text
from residnet.report.figures.force import draw_orders, draw_surface, draw_weights
from residnet.report.format import number

ABOUT_COEFFICIENTS = (
    "The force of a model is that of the believed hull plus the sum of coefficient times basis"
    " function, in SI units. A weight is the magnitude of the coefficient of scaled variables: it"
    " says how much a basis function matters."
)

MODEL_PICTURES = ("orders_", "surface_", "weights_")
"""What the names of the pictures of `draw_model` begin with."""


def fit_as_json(terms: Sequence[str], fit: Fit) -> dict[str, Any]:
    """Return a fitted model as it stands in the results: terms, coefficients and weights."""
    return {
        "terms": list(terms),
        "coefficients": fit.coefficients.tolist(),
        "intercept": fit.intercept.tolist(),
        "weights": fit.pre.abs().tolist(),
    }


def coefficients_section(
    name: str,
    model: Mapping[str, Any],
    notes: Mapping[str, Any],
    others: Mapping[str, Mapping[str, Sequence[float]]],
) -> Section:
    """Return a folded section with the coefficients of one model.

    Args:
        name: name of the model.
        model: its entry in the results (`fit_as_json`).
        notes: what its estimator chose.
        others: coefficients [3] by basis function to stand beside it, by what they are, such as
            `true` and `published`.
    """
    others = {what: values for what, values in others.items() if values}
    kept = {
        term: row
        for term, row in zip(model["terms"], model["coefficients"], strict=True)
        if any(row)
    }
    rows = {"1": model["intercept"], **kept}
    weights = dict(zip(model["terms"], model["weights"], strict=True))
    groups = [(what, 3) for what in ("coefficient", "weight", *others)]
    table = Table(["basis function", *AXES * len(groups)], groups=groups)
    absent = (0.0, 0.0, 0.0)
    for term in dict.fromkeys((*rows, *(term for values in others.values() for term in values))):
        cells = [number(value, 4) for value in rows.get(term, absent)]
        cells += [number(value, 3) for value in weights[term]] if term in weights else [""] * 3
        for values in others.values():
            cells += [number(value, 4) for value in values.get(term, absent)]
        table.add(term, cells)
    chosen = notes_text(notes)
    return Section(
        name,
        [Text(f"Chosen by the estimator: {chosen}." if chosen else ""), table],
        folded=True,
    )


def draw_model(
    name: str,
    config: RegressionConfig,
    terms: Sequence[str],
    fit: Fit,
    unmodelled: Sequence[float],
    figures: Path,
) -> None:
    """Draw the weights of a model, and the errors that its order or surface was chosen from.

    Args:
        name: name of the model.
        config: its estimator.
        terms: its basis functions.
        fit: its coefficients.
        unmodelled: mean square of the believed model's residual by axis.
        figures: folder for the pictures.
    """
    title = f"Weights of the basis functions in {name}"
    draw_weights(terms, fit.pre, title, figures / f"weights_{name}.png")
    if fit.orders is not None:
        curves = {"left-out segments": fit.orders.left_out, "test half": fit.orders.test}
        order = int(fit.notes["order"])
        draw_orders(curves, unmodelled, order, figures / f"orders_{name}.png")
    if isinstance(config, SurfaceRegression) and fit.surface is not None:
        choices = {
            "chosen": list(zip(fit.notes["order"], fit.notes["terms"], strict=True)),
            "least": [fit.surface.least(axis) for axis in range(3)],
        }
        draw_surface(fit.surface.error, unmodelled, choices, figures / f"surface_{name}.png")
