"""Force-space models that run forward in time, and as TorchScript for a controller's feed-forward (document 002 eqs. (3.22), (3.24))."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from residnet.baselines.believed import BelievedConfig, HullEquations
from residnet.core.errors import ExportError
from residnet.core.names import VELOCITY
from residnet.physics.force_model import MOTION, Correction, ForceModel, augmented
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


class ExportedFeedForward(nn.Module):
    """tau [B, 3] = F(nu_dot [B, 3], nu [B, 3]), float64, SI."""

    def __init__(self, model: ForceModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, nu_dot: Tensor, nu: Tensor) -> Tensor:
        """What the motion needs."""
        force: Tensor = self.model(nu_dot, nu)
        return force


def export_feed_forward(model: ForceModel, lag: dict[str, float] | None, ranges: Sequence[tuple[float, float]], file: Path) -> None:
    """Write F(nu_dot, nu) as TorchScript with its card.

    Args:
        model: of the vessel.
        lag: of the thrusters, for the card; None where it was not fitted.
        ranges: of nu_dot and nu in the training data, six.
        file: where to write.

    Raises:
        ExportError: where the exported module differs from the model.
    """
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scripted: Any = torch.jit.freeze(torch.jit.script(ExportedFeedForward(model).eval()))
        low, high = torch.tensor(ranges, dtype=torch.float64).T
        motion = low + torch.rand(200, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * (high - low)
        with torch.no_grad():
            mine, theirs = model(motion[:, :3], motion[:, 3:]), scripted(motion[:, :3], motion[:, 3:])
        share = float(((mine - theirs).abs().amax(0) / (mine.amax(0) - mine.amin(0))).max())
        if not share < 1e-9:
            raise ExportError(f"{file.name}: the exported feed-forward differs from the model by {share:.1e} of its range; allowed 1e-9")
        card = {
            "schema": "residnet.feed_forward/1",
            "arguments": {"nu_dot": ["u_dot m/s^2", "v_dot m/s^2", "r_dot rad/s^2"], "nu": ["u m/s", "v m/s", "r rad/s"]},
            "returns": ["tau_x N", "tau_y N", "tau_n N m"],
            "training_range": {name: list(limits) for name, limits in zip(MOTION, ranges, strict=True)},
            "thruster_lag": lag,
            "parity_share_of_range": share,
            "safety": "TorchScript is code that runs when loaded: load only files that you trust.",
        }
        file.parent.mkdir(parents=True, exist_ok=True)
        torch.jit.save(scripted, str(file), _extra_files={"card.json": json.dumps(card, indent=1)})


def as_vessel_lines(equations: HullEquations, who: str) -> str:
    """The model as lines for a fit's `baseline` or `baselines`, so that it runs forward beside others."""
    lines = [f"# {who}: accelerations from velocities and forces; needs the channels {', '.join((*VELOCITY, *FORCE_CHANNELS))}"]
    lines += ["kind: believed", "vessel:"]
    for axis, row in zip(VELOCITY, equations.rows(), strict=True):
        lines.append(f"  {axis}: {json.dumps(row)}")
    return "\n".join(lines) + "\n"
