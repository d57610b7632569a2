"""Learned models whose truth is known."""

from __future__ import annotations

import torch
from kinds import of_kind

from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.physics.signals_config import SignalsConfig


def nomoto_model(gain: float, time: float, dt: float) -> tuple[ModelSpec, HybridDynamics]:
    """Nomoto's first-order model as a fit would leave it: a baseline of regressors driven by
    `delta`.
    """
    spec = ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "nomoto",
            "role": "baseline",
            "signals": SignalsConfig(inputs=("delta",)).model_dump(),
            "baseline": RegressorsConfig(terms=("r", "delta")).model_dump(),
            "head": None,
            "dt": dt,
            "integrator": "rk4",
            "low": [0.0, 0.0, -0.4, -0.1],
            "high": [4.0, 0.0, 0.4, 0.1],
        }
    )
    model = spec.build()
    with torch.no_grad():
        theta = of_kind(model.baseline, RegressorBaseline).theta
        theta[2] = torch.tensor([-1.0 / time, gain / time])
    return spec, model
