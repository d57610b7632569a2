"""A small vessel of known equations: its trials, its models, and how far a free run of a model is
off.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.rollout import Rollout
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log

STEP = 0.1
SIGNALS = SignalsConfig(inputs=("tau_x", "tau_n"))
LINEAR = ("1", "u", "v", "r", "tau_x", "tau_n")
SCALES = torch.tensor([0.3, 0.1, 0.2], dtype=torch.float64)
# mirror-symmetric: rows u, v, r; columns as LINEAR, then u|u|, v|v|, u r, r|r|
QUADRATIC = (*LINEAR, "u|u|", "v|v|", "u r", "r|r|")
THETA = torch.tensor(
    [
        [0.0, -0.3, 0.0, 0.0, 1.0, 0.0, -0.4, 0.0, 0.0, 0.0],
        [0.0, 0.0, -0.9, -0.2, 0.0, 0.1, 0.0, -0.8, -0.3, 0.0],
        [0.0, 0.0, 0.1, -0.8, 0.0, 1.0, 0.0, 0.0, 0.0, -0.6],
    ],
    dtype=torch.float64,
)


def model_of(
    terms: Sequence[str], theta: Tensor | None = None, head: ResidualHead | None = None
) -> HybridDynamics:
    """A model whose axes all have the same terms."""
    signals = SIGNALS.build()
    baseline = RegressorBaseline([tuple(terms)] * 3, signals.names)
    if theta is not None:
        baseline.theta.data.copy_(theta)
    return HybridDynamics(signals, baseline, head or ZeroHead(), STEP, "rk4")


def truth() -> HybridDynamics:
    """The vessel itself."""
    return model_of(QUADRATIC, THETA)


def inputs(count: int, steps: int, seed: int) -> Tensor:
    """Steps of thrust and turning moment that hold for one to four seconds, [B, T, 2]."""
    random = np.random.default_rng(seed)
    out = np.zeros((count, steps, 2))
    for row in out:
        for column, (low, high) in enumerate(((0.1, 1.2), (-0.6, 0.6))):
            k = 0
            while k < steps:
                hold = int(random.integers(10, 40))
                row[k : k + hold, column] = random.uniform(low, high)
                k += hold
    return torch.from_numpy(out)


@cache
def trials(
    count: int = 4,
    seconds: float = 40.0,
    noise: float = 0.01,
    seed: int = 0,
    window: float = 0.9,
) -> tuple[PreparedLog, ...]:
    """Logs of the vessel from rest, velocities noisy, derivatives over `window` seconds (a long one
    biases them).
    """
    steps = round(seconds / STEP)
    w = inputs(count, steps, seed)
    with torch.no_grad():
        start = torch.zeros(count, 6, dtype=torch.float64)
        memory = torch.zeros(count, 0)
        states = Rollout(truth())(start, w, memory)[0][:, :-1].numpy()
    states[:, :, 3:] += noise * np.random.default_rng([seed, 1]).standard_normal((count, steps, 3))
    config = PrepareConfig.model_validate(
        {
            "grid": {"step": STEP},
            "derivative": {"kind": "savitzky_golay", "window": window, "order": 2},
        }
    )
    out = []
    for i in range(count):
        channels = {name: states[i, :, j].copy() for j, name in enumerate(STATE_NAMES)} | {
            "tau_x": w[i, :, 0].numpy(),
            "tau_n": w[i, :, 1].numpy(),
        }
        out.append(
            prepare_log(
                Log(f"trial_{i}", STEP * np.arange(steps), channels, manoeuvre="made"),
                "train",
                SIGNALS.input_columns,
                config,
            )
        )
    return tuple(out)


def free_run_error(model: HybridDynamics, seed: int = 99, seconds: float = 30.0) -> float:
    """Root mean square error of free-run velocities against the vessel's own on fresh inputs, in
    units of the scales.
    """
    w = inputs(6, round(seconds / STEP), seed)
    own = truth()
    theirs = model.double().eval()
    x0 = torch.zeros(6, 6, dtype=torch.float64)
    with torch.no_grad():
        a = Rollout(own)(x0, w, torch.zeros(6, 0))[0]
        b = Rollout(theirs)(x0, w, theirs.initial_state(6).double())[0]
    return float((((a - b)[:, :, 3:] / SCALES).square().mean()).sqrt())
