"""Equations of motion from a model in force space (document 002, (3.22))."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

from residnet.baselines.believed import BelievedConfig, HullEquations
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.physics.force_model import FERRY_TERMS, MOTION, Correction, ForceModel, augmented
from residnet.physics.signals import FORCE_CHANNELS
from residnet.physics.terms import parse_term


def forward_equations(believed: str, model: ForceModel, label: str) -> HullEquations:
    """Return the accelerations of a force-space model as sums of terms.

    They are nu_dot = (M + A)^-1 (tau - C nu - D nu - b), in the form that the baseline `believed`
    takes.

    Args:
        believed: vessel of the known hull, by name or file.
        model: the known hull and its residual eps = A nu_dot + b(nu).
        label: name of the model in error messages.

    Raises:
        ConfigError: where a basis function is not affine in nu_dot.
        FitError: where the augmented mass cannot be inverted safely.
    """
    hull_rows = BelievedConfig(vessel=believed).equations().rows()
    known = list(dict.fromkeys(term for row in hull_rows for term in row))
    hull = torch.tensor(
        [[row.get(term, 0.0) for term in known] for row in hull_rows], dtype=torch.float64
    )
    mass, constant = model.hull.mass.clone(), torch.zeros(3, dtype=torch.float64)
    total, extra = mass, dict[str, Tensor]()
    for correction in model.corrections:
        assert isinstance(correction, Correction)
        terms, coefficients = correction.library.terms, correction.coefficients
        total, rest = augmented(total, terms, coefficients, label)
        constant = constant + correction.intercept
        for j in rest:
            extra[terms[j]] = (
                extra.get(terms[j], torch.zeros(3, dtype=torch.float64)) + coefficients[j]
            )
    inverse = torch.linalg.inv(total)
    rows = inverse @ mass @ hull
    table = {term: rows[:, j] for j, term in enumerate(known)}
    for term, force in {"1": constant, **extra}.items():
        table[term] = table.get(term, torch.zeros(3, dtype=torch.float64)) - inverse @ force
    by_axis = [
        {term: float(value[axis]) for term, value in table.items() if float(value[axis]) != 0.0}
        for axis in range(3)
    ]
    return HullEquations(u=by_axis[0], v=by_axis[1], r=by_axis[2])


def missing_coefficients(true: str, believed: str) -> dict[str, list[float]]:
    """Return the true coefficients of a residual by basis function: surge, sway, yaw.

    They are those of the true hull less those of the believed one, where document 002 misprints the
    cross terms (correction J19).
    """
    of_true, of_believed = (_force_coefficients(name) for name in (true, believed))
    zero = torch.zeros(3, dtype=torch.float64)
    out: dict[str, list[float]] = {}
    for key in dict.fromkeys((*of_believed, *of_true)):
        difference = of_true.get(key, zero) - of_believed.get(key, zero)
        # equal coefficients differ by rounding alone
        difference = torch.where(
            difference.abs() > 1e-9 * (1 + of_true.get(key, zero).abs()), difference, zero
        )
        if bool(difference.any()):
            out[key] = difference.tolist()
    return out


def _force_coefficients(vessel: str) -> dict[str, Tensor]:
    """Return the coefficients [3] of F(nu_dot, nu) by basis function of document 002."""
    names = {_factors(term): term for term in FERRY_TERMS}
    rows = BelievedConfig(vessel=vessel).equations().rows()
    columns = {
        term: torch.tensor([row.get(term, 0.0) for row in rows], dtype=torch.float64)
        for term in dict.fromkeys(t for row in rows for t in row)
    }
    mass = torch.linalg.inv(torch.stack([columns[name] for name in FORCE_CHANNELS], dim=1))
    out = {name: mass[:, axis] for axis, name in enumerate(ACCELERATION)}
    return out | {
        names.get(_factors(term), term): -mass @ column
        for term, column in columns.items()
        if term not in FORCE_CHANNELS
    }


def _factors(term: str) -> tuple[Any, ...]:
    return tuple(sorted(parse_term(term, MOTION)))


def as_baseline_yaml(equations: HullEquations, label: str) -> str:
    """Return the model as YAML lines for the `baseline` or `baselines` of a fit."""
    lines = [
        f"# {label}: accelerations from velocities and forces; needs the channels"
        f" {', '.join((*VELOCITY, *FORCE_CHANNELS))}"
    ]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY, equations.rows(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"
