"""Force-space models that run forward in time (document 002 eq. (3.22))."""

from __future__ import annotations

import json

import torch
from torch import Tensor

from residnet.baselines.believed import BelievedConfig, HullEquations
from residnet.core.names import VELOCITY
from residnet.physics.force_model import Correction, ForceModel, augmented
from residnet.physics.signals import FORCE_CHANNELS


def forward_equations(believed: str, model: ForceModel, who: str) -> HullEquations:
    """nu_dot = (M + A)^-1 (tau - C nu - D nu - b) written out by terms, as the baseline `believed` takes it.

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
    hull = torch.tensor([[row.get(term, 0.0) for term in known] for row in given], dtype=torch.float64)
    mass, constant = model.hull.mass.clone(), torch.zeros(3, dtype=torch.float64)
    total, extra = mass, dict[str, Tensor]()
    for correction in model.corrections:
        assert isinstance(correction, Correction)
        terms, coefficients = correction.library.terms, correction.coefficients
        total, rest = augmented(total, terms, coefficients, who)
        constant = constant + correction.intercept
        for j in rest:
            extra[terms[j]] = extra.get(terms[j], torch.zeros(3, dtype=torch.float64)) + coefficients[j]
    inverse = torch.linalg.inv(total)
    rows = inverse @ mass @ hull
    table = {term: rows[:, j] for j, term in enumerate(known)}
    for term, force in {"1": constant, **extra}.items():
        table[term] = table.get(term, torch.zeros(3, dtype=torch.float64)) - inverse @ force
    by_axis = [{term: float(value[axis]) for term, value in table.items() if float(value[axis]) != 0.0} for axis in range(3)]
    return HullEquations(u=by_axis[0], v=by_axis[1], r=by_axis[2])


def as_vessel_lines(equations: HullEquations, who: str) -> str:
    """The model as lines for a fit's `baseline` or `baselines`, so that it runs forward beside others."""
    lines = [f"# {who}: accelerations from velocities and forces; needs the channels {', '.join((*VELOCITY, *FORCE_CHANNELS))}"]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY, equations.rows(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"
