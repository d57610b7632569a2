"""Free runs of force-space models beside the true ferry's zigzags (document 002, (3.22))."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from residnet.baselines.believed import BelievedConfig, HullEquations
from residnet.core.config import Config, Seconds
from residnet.core.layout import VELOCITIES
from residnet.core.log import Log
from residnet.core.names import STATE
from residnet.data.simulated.trials import SimulatedTrials, fly_trials
from residnet.documents.jervan2020.ferry.flights import force_hull
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.heads.zero import ZeroHead
from residnet.manoeuvres import FamilyConfig
from residnet.manoeuvres.zigzag import ZigzagFamily
from residnet.physics.actuators import ForceActuators
from residnet.physics.signals import FORCE_CHANNELS, SignalsConfig

_FARTHEST = 3.0
"""Velocities of a free run in largest velocities of the true ferry from which it has diverged."""


def _zigzags() -> tuple[FamilyConfig, ...]:
    """Return gentle zigzags: their speeds are those of the course that identifies the models."""
    family = ZigzagFamily(count=6, drive=(0.03, 0.07), steer=(0.01, 0.03), heading=(0.17, 0.35))
    return (family,)


class ForwardRunsConfig(Config):
    """What the models are run forward in time beside.

    Attributes:
        trials: families of manoeuvres of the true ferry.
        duration: of each manoeuvre.
        step: of the free runs.
        seed: of everything random in them.
    """

    trials: tuple[FamilyConfig, ...] = Field(default_factory=_zigzags, min_length=1)
    duration: Seconds = Field(default=60.0, gt=0)
    step: Seconds = Field(default=0.1, gt=0)
    seed: int = Field(default=0, ge=0)


def forward_runs(
    config: ForwardRunsConfig, true: str, believed: str, models: Mapping[str, HullEquations]
) -> dict[str, dict[str, Any]]:
    """Run models forward in time from the commanded forces of the true ferry's manoeuvres.

    Args:
        config: the manoeuvres.
        true: vessel that flies them.
        believed: vessel of the known hull, which stands beside the models.
        models: equations of motion by name.

    Returns:
        By model, `believed` first: `rmse` of u, v, r in m/s, m/s, rad/s over the runs that did not
        diverge (None without any), `runs`, and `diverged`, how many of them did.
    """
    trials = SimulatedTrials(
        vessel=true,
        trials=config.trials,
        duration=config.duration,
        step=config.step,
        identification={},
        validation={},
        seed=config.seed,
    )
    flown = [flight.motion for flight in fly_trials(trials.draw(), trials)]
    thrusters = force_hull(true)[1]
    x, w = (
        torch.stack(part)
        for part in zip(*(_columns(log, thrusters) for log in _equal(flown)), strict=True)
    )
    limit = _FARTHEST * x[..., VELOCITIES].abs().amax(dim=(0, 1))
    known = BelievedConfig(vessel=believed).equations()
    out = {}
    for name, equations in {"believed": known, **models}.items():
        ran = _run(equations, x[:, 0], w[:, :-1], config.step)
        error = (ran - x)[..., VELOCITIES]
        finite = torch.isfinite(ran).all(dim=-1)
        away = (~finite | (ran[..., VELOCITIES].abs() > limit).any(dim=-1)).any(dim=-1)
        kept = error[~away]
        out[name] = {
            "rmse": kept.square().mean(dim=(0, 1)).sqrt().tolist() if len(kept) else None,
            "runs": len(x),
            "diverged": int(away.sum()),
        }
    return out


def why_refused(name: str, row: Mapping[str, Any]) -> str:
    """Return why a model is refused to run forward; empty where it is not."""
    if not row["diverged"]:
        return ""
    return (
        f"model {name}: it diverges in {row['diverged']} of {row['runs']} free runs beside the true"
        " ferry, so its equations are not written; take a model with fewer terms or with lag"
    )


def _equal(logs: list[Log]) -> list[Log]:
    """Return the logs that last as long as the longest: one that ended early shows no free run."""
    longest = max(len(log) for log in logs)
    return [log for log in logs if len(log) == longest]


def _columns(log: Log, thrusters: ForceActuators) -> tuple[Tensor, Tensor]:
    """Return states [T, 6] and the forces [T, 3] that the commands ask for."""
    states, commands = (
        torch.from_numpy(np.stack([log.channels[name] for name in names], axis=1))
        for names in (STATE, thrusters.commands)
    )
    return states, thrusters.asked(commands)


def _run(equations: HullEquations, x0: Tensor, w: Tensor, step: float) -> Tensor:
    """Return the states [B, T, 6] of a free run from x0 [B, 6] under forces w [B, T - 1, 3]."""
    signals = SignalsConfig(inputs=FORCE_CHANNELS).build()
    baseline = BelievedConfig(vessel=equations).build(signals.names)
    model = HybridDynamics(signals, baseline, ZeroHead(), step).double()
    with torch.no_grad():
        states: Tensor = Rollout(model)(x0, w, x0[:, :0])[0]
    return states
