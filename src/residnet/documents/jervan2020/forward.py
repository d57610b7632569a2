"""Force-space models that run forward in time (document 002 eq. (3.22))."""

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


def forward_equations(believed: str, model: ForceModel, who: str) -> HullEquations:
    """nu_dot = (M + A)^-1 (tau - C nu - D nu - b) written out by terms, as the baseline `believed`
    takes it.

    Args:
        believed: vessel of the hull that the model stands on.
        model: eps = A nu_dot + b(nu) on that hull.
        who: name in errors.

    Raises:
        ConfigError: where a basis function is not affine in nu_dot.
        FitError: where the augmented mass cannot be inverted safely.
    """
    given = BelievedConfig(vessel=believed).equations().rows()
    known = list(dict.fromkeys(term for row in given for term in row))
    hull = torch.tensor(
        [[row.get(term, 0.0) for term in known] for row in given], dtype=torch.float64
    )
    mass, constant = model.hull.mass.clone(), torch.zeros(3, dtype=torch.float64)
    total, extra = mass, dict[str, Tensor]()
    for correction in model.corrections:
        assert isinstance(correction, Correction)
        terms, coefficients = correction.library.terms, correction.coefficients
        total, rest = augmented(total, terms, coefficients, who)
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
    """What a believed hull lacks to the true one, by basis function: the residual's own
    coefficients (surge, sway, yaw) (ERRATA J19).
    """
    parts = [_force_coefficients(name) for name in (true, believed)]
    nothing = torch.zeros(3, dtype=torch.float64)
    out: dict[str, list[float]] = {}
    for key in dict.fromkeys((*parts[1], *parts[0])):
        apart = parts[0].get(key, nothing) - parts[1].get(key, nothing)
        # what is equal in both differs by rounding
        apart = torch.where(
            apart.abs() > 1e-9 * (1 + parts[0].get(key, nothing).abs()), apart, nothing
        )
        if bool(apart.any()):
            out[key] = apart.tolist()
    return out


def _force_coefficients(vessel: str) -> dict[str, Tensor]:
    """F(nu_dot, nu) of a vessel's hull by basis function, [3] each, those of document 002 under its
    names.
    """
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


def as_vessel_lines(equations: HullEquations, who: str) -> str:
    """The model as lines for a fit's `baseline` or `baselines`, so that it runs forward beside
    others.
    """
    lines = [
        f"# {who}: accelerations from velocities and forces; needs the channels"
        f" {', '.join((*VELOCITY, *FORCE_CHANNELS))}"
    ]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY, equations.rows(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"
