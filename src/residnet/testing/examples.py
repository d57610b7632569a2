"""Data and models that contracts are checked on: short trials of a catamaran, ready for a fit."""

from __future__ import annotations

import functools

import torch

from residnet.baselines.regressors import RegressorsConfig
from residnet.core.layout import PLANAR, ROLL, SIX
from residnet.core.samples import Samples
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.simulated import SimulatedTrials, fly_trials
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.heads.base import ClosedFormHead, FeatureConfig
from residnet.heads.linear import RidgeConfig
from residnet.heads.lstm import LstmConfig
from residnet.physics.signals import SignalsConfig

SIGNALS = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").resolved()
"""Inputs of the example models: the revolutions of two propellers, and the forces they make."""

ROLLING = SignalsConfig(inputs=("delta", "cmd_thrust"), velocities=("u", "v", "r", "p"))
"""Inputs of example models of a patrol vessel that rolls."""

SUBMERGED = SignalsConfig(
    inputs=("delta", "delta_s", "n"), velocities=("u", "v", "r", "w", "p", "q")
)
"""Inputs of example models of a torpedo in six degrees of freedom."""

_VESSELS = {PLANAR: "wam_v_cal", ROLL: "patrol_p06_linear", SIX: "remus_100"}

STEP = 0.1
"""Step of the example models in s."""


_DERIVATIVE = {"kind": "savitzky_golay", "window": 1.1, "order": 2}


@functools.cache
def example_samples(
    vessel: str = "", signals: SignalsConfig = SIGNALS, duration: float = 20.0
) -> Samples:
    """Return samples of simulated trials: channels z [N, nz], accelerations [N, n], float64, SI.

    Without arguments these are trials of a catamaran with the channels u, v, r, n_port, n_stbd,
    tau_x, tau_y, tau_n.

    Args:
        vessel: name of the vessel; that catamaran, a patrol vessel for signals with roll, or a
            torpedo for six degrees of freedom.
        signals: what drives the model; channels of the vessel's logs.
        duration: of each manoeuvre in s.
    """
    trials = SimulatedTrials.model_validate(
        {
            "vessel": vessel or _VESSELS[signals.live.layout],
            "step": STEP,
            "substeps": 1,
            "duration": duration,
            "trials": [
                {"kind": "constant", "drive": [0.5, 0.9], "steer": [-0.4, 0.0, 0.4]},
                {"kind": "zigzag", "count": 4, "heading": ["15 deg"], "start": 2.0},
                {
                    "kind": "random_steps",
                    "count": 4,
                    "dive_amplitude": [0.0, 0.4 if signals.live.spatial else 0.0],
                },
            ],
            "identification": {"zigzag": 3},
            "validation": {"zigzag": 1},
            "seed": 4,
        }
    )
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": _DERIVATIVE})
    logs = [flight.log for flight in fly_trials(trials.draw(), trials)]
    prepared = [prepare(log, "train", signals.columns, config, signals.live) for log in logs]
    return samples(prepared, signals.build())


def residual_samples() -> Samples:
    """Return the example samples with a target that heads are fitted on: what a line leaves."""
    known = example_samples()
    design = torch.cat((known.z, torch.ones(len(known), 1, dtype=torch.float64)), dim=1)
    line = torch.linalg.lstsq(design, known.target, driver="gelsd").solution
    return known.with_target(known.target - design @ line)


def example_spec(head: FeatureConfig | None, signals: SignalsConfig = SIGNALS) -> ModelSpec:
    """Return the description of a model with an equation as baseline and a head, or none.

    Args:
        head: config of any head.
        signals: inputs, forces and velocities of the model.
    """
    seen = example_samples(signals=signals).z[:, : signals.live.size + len(signals.inputs)]
    forces = ("u", "v", "r", "tau_x", "tau_n")
    return ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "example",
            "role": "baseline" if head is None else "head",
            "signals": signals.model_dump(),
            "baseline": RegressorsConfig(terms=forces if signals.forces else ()).model_dump(),
            "head": None if head is None else head.model_dump(),
            "dt": STEP,
            "integrator": "rk4",
            "low": seen.amin(0).tolist(),
            "high": seen.amax(0).tolist(),
        }
    )


def example_models() -> list[tuple[ModelSpec, HybridDynamics]]:
    """Return fitted models: a baseline alone, one with a memoryless head, one with a memory."""
    heads = (None, RidgeConfig(), LstmConfig(hidden_size=4))
    return [(spec, example_model(spec)) for spec in map(example_spec, heads)]


def example_model(spec: ModelSpec) -> HybridDynamics:
    """Return the model of a description from `example_spec`, its baseline identified.

    A head takes its scales from the example samples; a closed form is fitted on them too.
    """
    torch.manual_seed(0)
    model, known = spec.build(), example_samples(signals=spec.signals)
    spec.baseline.fit(model.baseline, known)
    with torch.no_grad():
        residual = model.head.residual_target(known, model.baseline(known.z))
    model.head.calibrate(residual)
    if isinstance(model.head, ClosedFormHead):
        model.head.solve(residual)
    return model.eval()
