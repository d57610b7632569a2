"""Small models of every head kind, found from the union itself, for the tests of export formats."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.registry import load_kinds
from residnet.core.samples import Samples
from residnet.dynamics.domain_config import InputRelation, OperatingDomain
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.base import LoadedExport
from residnet.export.vessel import ExportedVessel
from residnet.heads import HeadConfig
from residnet.heads.base import ClosedFormHead
from residnet.physics.signals_config import SignalsConfig

SIGNALS = SignalsConfig(
    inputs=("n_port", "n_stbd"), exogenous=("wind_speed", "wind_dir"), forces="wam_v_cal"
).with_thrusters()
NAMES = SIGNALS.build().names
FEATURES = ("u", "v", "r", "tau_x", "tau_n", "wind_u", "wind_v", "wind_mag")
LOW = (-0.5, -0.6, -0.4, -10.0, -12.0, 0.0, -3.0)
HIGH = (3.0, 0.6, 0.4, 30.0, 32.0, 9.0, 3.0)
KINDS: dict[str, type[Any]] = load_kinds(HeadConfig)
# smaller than the defaults, for the sake of time
SIZES: dict[str, dict[str, Any]] = {
    "mlp": {"hidden": (8,)},
    "lstm": {"hidden_size": 6, "readout_activation": "silu"},
    "recurrent": {"hidden_size": 6},
}
VARIANTS: dict[str, dict[str, Any]] = {
    **{
        kind: {"kind": kind, "features": FEATURES, **SIZES.get(kind, {})}
        for kind in KINDS
        if kind != "sklearn"
    },
    "mlp_mirror": {"kind": "mlp", "hidden": (8,), "mirror": True, "skip": "none"},
    "lstm_mirror": {
        "kind": "lstm",
        "hidden_size": 5,
        "readout": 4,
        "memory": ("tau_x", "tau_n"),
        "mirror": True,
    },
    "recurrent_members": {"kind": "recurrent", "members": 3, "hidden_size": 4, "step": 0.4},
    "gru_encoder": {
        "kind": "recurrent",
        "members": 2,
        "hidden_size": 4,
        "step": 0.4,
        "encoder": "measurements",
    },
    "lstm_encoder": {
        "kind": "recurrent",
        "cell": "lstm",
        "members": 2,
        "hidden_size": 4,
        "step": 0.4,
        "encoder": "measurements",
    },
    "mean": {},
    "lstm_per_axis": {
        "kind": "lstm",
        "hidden_size": 4,
        "per_axis": True,
        "activation": "softsign",
        "skip": "none",
    },
}


def spec_of(head: dict[str, Any] | None, **changes: Any) -> ModelSpec:
    baseline = RegressorsConfig(terms=("1", "u", "v", "r", "tau_x", "tau_n", "wind_v wind_mag"))
    content: dict[str, Any] = {
        "schema": "residnet.model/1",
        "name": "mine",
        "role": "head",
        "signals": SIGNALS.model_dump(),
        "baseline": baseline.model_dump(),
    }
    content |= {"head": head, "dt": 0.1, "integrator": "rk4", "low": LOW, "high": HIGH}
    return ModelSpec.model_validate(content | changes)


def fill(model: HybridDynamics, seed: int = 0) -> None:
    """A stable baseline, and a residual that is small beside it but matters."""
    random = np.random.default_rng(seed)
    assert isinstance(model.baseline, RegressorBaseline)
    with torch.no_grad():
        rows = [
            [0, -0.5, 0, 0, 2e-3, 0, 0],
            [0, 0, -0.8, -0.1, 0, 1e-4, 1e-3],
            [0, 0, 0.1, -0.9, 0, 1e-3, 1e-4],
        ]
        model.baseline.theta.copy_(torch.tensor(rows, dtype=torch.float64))
    z = torch.from_numpy(
        random.normal(size=(400, len(NAMES))) * [1, 0.2, 0.2, 10, 10, 200, 1, 100, 4, 4, 2]
        + [1.2, 0, 0, 10, 10, 200, 0, 0, 0, 0, 5]
    )
    target = torch.stack(
        (0.05 * torch.tanh(z[:, 0]), 0.05 * torch.sin(z[:, 9]), 0.05 * torch.tanh(3 * z[:, 2])),
        dim=1,
    )
    target = target + 0.01 * torch.from_numpy(random.normal(size=(400, 3)))
    samples = Samples(z, target, torch.arange(400) // 40, torch.zeros(400), ("zigzag",) * 10, NAMES)
    model.head.calibrate(samples)
    if isinstance(model.head, ClosedFormHead):
        model.head.fit_preferred(samples)
    with torch.no_grad():
        for parameter in model.head.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))


def built(variant: str) -> tuple[ModelSpec, HybridDynamics]:
    torch.manual_seed(0)
    if variant == "mean":
        parts = [built(member) for member in ("plsr", "lstm", "recurrent_members", "gru_encoder")]
        members = tuple(
            spec.model_copy(update={"name": f"member_{i}"}) for i, (spec, _) in enumerate(parts)
        )
        spec = spec_of(None, role="ensemble", baseline={"kind": "still"})
        spec = spec.model_copy(update={"members": members, "of": "trajectories"})
        single = [m.members[0] if isinstance(m, MeanOfTrajectories) else m for _, m in parts]
        return spec, spec.average_trajectories(single)
    spec = spec_of(VARIANTS[variant])
    model = spec.build_single_model()
    fill(model)
    return spec, spec.average_networks(model)


class AsTensors:
    """A loaded file of a vessel in any format as a module of batches, row by row."""

    def __init__(self, loaded: LoadedExport, exported: ExportedVessel) -> None:
        self.loaded = loaded
        self.exported = exported
        self.size = exported.model.n_state
        self.guard = exported.guard_model(torch.float32)

    def initial_state(self, batch: int) -> Tensor:
        return torch.zeros(batch, self.size)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows = [
            self.loaded.step(*(part.numpy() for part in row)) for row in zip(x, w, s, strict=True)
        ]
        found = (torch.from_numpy(np.stack(part)) for part in zip(*rows, strict=True))
        after, memory, outside = found
        return after.float(), memory.float(), outside.bool().reshape(-1)

    def warmup(self, y: Tensor, w: Tensor) -> Tensor:
        rows = zip(y.numpy(), w.numpy(), strict=True)
        return torch.from_numpy(
            np.stack([self.exported.warm_up_memory(self.loaded, *row) for row in rows])
        ).float()

    def rollout(self, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        states = [self.guard.state_ranges.replace_unaccepted(x0)]
        flags = []
        x = x0
        for k in range(w.shape[1]):
            x, s, outside = self.step(x, w[:, k], s)
            states.append(x)
            flags.append(outside)
        return torch.stack(states, dim=1), s, torch.stack(flags, dim=1)


DOMAIN_CHANNELS = ("u", "v", "r", "n_port", "n_stbd")


def exported_with_domain() -> ExportedVessel:
    """A model whose domain is a ball of ranges, with alike propellers on one course."""
    spec, model = built("mlp")
    centre = [0.5 * (low + high) for low, high in zip(LOW[:5], HIGH[:5], strict=True)]
    scale = [0.5 * (high - low) for low, high in zip(LOW[:5], HIGH[:5], strict=True)]
    random = np.random.default_rng(0)
    z = random.uniform(-1, 1, (400, 5))
    features = np.column_stack(
        (np.ones(400), z, *(z[:, i] * z[:, j] for i in range(5) for j in range(i, 5)))
    )
    factor = np.linalg.inv(np.linalg.cholesky(features.T @ features / 400))
    domain = OperatingDomain(
        channels=DOMAIN_CHANNELS,
        centre=tuple(centre),
        scale=tuple(scale),
        factor=tuple(factor.reshape(-1).tolist()),
        limit=25.0,
        n_logs=4,
        range_margins={"u": 0.2 * (HIGH[0] - LOW[0]), "n_port": 0.1 * (HIGH[3] - LOW[3])},
        relations=(
            InputRelation(
                input="n_stbd",
                kind="proportional",
                offset=0.0,
                channels=("n_port",),
                gains=(1.0,),
                tolerance=12.0,
            ),
            InputRelation(
                input="n_port",
                kind="feedback",
                offset=10.0,
                channels=("r",),
                gains=(5.0,),
                heading=0.5,
                heading_gain=8.0,
                max_heading=1.5,
                tolerance=14.0,
            ),
        ),
    )
    return ExportedVessel(spec.model_copy(update={"domain": domain}), model)


def draw_samples_around_ranges(n_samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw states [K, 6] and inputs [K, m] in float32, a few beyond the training range."""
    random = np.random.default_rng(1)
    low = np.array(LOW)
    high = np.array(HIGH)
    share = random.random((n_samples, len(LOW)))
    # within the margin of u and beyond it
    share[: n_samples // 5, 0] = random.uniform(1.02, 1.4, n_samples // 5)
    values = (low + (high - low) * share).astype(np.float32)
    x = np.zeros((n_samples, 6), np.float32)
    x[:, 2] = random.uniform(-3, 3, n_samples)
    x[:, 3:] = values[:, :3]
    return x, values[:, 3:]


def expected_flags(vessel: ExportedVessel, x: np.ndarray, w: np.ndarray) -> list[bool]:
    """Return the flags of single steps by the guarded model."""
    guarded = vessel.guard_model(torch.float32)
    memory = torch.zeros(len(x), guarded.n_state)
    with torch.no_grad():
        flags = guarded.flagged_step(torch.from_numpy(x), torch.from_numpy(w), memory)[2]
    return [bool(flag) for flag in flags]
