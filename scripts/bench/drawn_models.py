"""Models drawn at random, fitted on simulated trials, for benches of exported files."""

from __future__ import annotations

import functools
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent))
from bad_inputs import BASELINES
from playback import Recording

from residnet.core.log import Log
from residnet.core.samples import Samples
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.simulated.trials import SimulatedTrials, fly_trials
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.heads import ClosedFormHead
from residnet.physics.signals import SignalsConfig

STEP = 0.1
FRAMES: dict[str, tuple[str, tuple[str, ...], str | None]] = {
    "rudder": ("example_rudder_boat", ("n", "delta"), None),
    "twin": ("wam_v_cal", ("n_port", "n_stbd"), None),
    "twin, forces": ("wam_v_cal", ("n_port", "n_stbd"), "wam_v_cal"),
    "azimuth": (
        "milliampere_azimuth",
        ("cmd_n_bow", "cmd_n_stern", "cmd_alpha_bow", "cmd_alpha_stern"),
        None,
    ),
    "jets": ("odin_jets", ("cmd_n", "cmd_nozzle"), None),
    "forces": ("milliampere", ("tau_x", "tau_y", "tau_n"), None),
}
"""Vessel, inputs of the model, and whose thrusters make forces of them."""
Model = tuple[ModelSpec, HybridDynamics]


@functools.cache
def flown(vessel: str) -> tuple[Log, ...]:
    """Return logs of simulated trials, with a wind that varies slowly and does nothing."""
    trials = SimulatedTrials.model_validate(
        {
            "vessel": vessel,
            "step": STEP,
            "substeps": 2,
            "duration": 40.0,
            "trials": [{"kind": "random_steps", "count": 12}],
            "identification": {"random_steps": 11},
            "validation": {"random_steps": 1},
            "seed": 4,
        }
    )
    logs = []
    for flight in fly_trials(trials.draw(), trials):
        log, phase = flight.log, len(logs)
        wind = {
            "wind_speed": 5.0 + 3.0 * np.sin(0.1 * log.t + phase),
            "wind_dir": 0.5 * phase + np.sin(0.05 * log.t),
        }
        units = log.units | {"wind_speed": "m/s", "wind_dir": "rad"}
        logs.append(replace(log, channels={**log.channels, **wind}, units=units))
    return tuple(logs)


@functools.cache
def known(frame: str, wind: bool) -> tuple[SignalsConfig, Samples, tuple[Any, ...]]:
    """Return signals, samples and prepared logs of a frame."""
    vessel, inputs, forces = FRAMES[frame]
    exogenous = ("wind_speed", "wind_dir") if wind else ()
    signals = SignalsConfig(inputs=inputs, exogenous=exogenous, forces=forces).resolved()
    config = PrepareConfig.model_validate(
        {
            "grid": {"step": STEP},
            "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
        }
    )
    prepared = tuple(prepare(log, "train", signals.columns, config) for log in flown(vessel))
    return signals, samples(list(prepared), signals.build()), prepared


class Draw:
    """One model after another from a generator."""

    def __init__(self, seed: list[int]) -> None:
        self.random = np.random.default_rng(seed)

    def one_of(self, options: Any) -> Any:
        """Return one of several, each as likely."""
        options = list(options)
        return options[int(self.random.integers(len(options)))]

    def often(self, share: float) -> bool:
        """Return True in that share of all calls."""
        return bool(self.random.random() < share)

    def baseline(self, frame: str, names: tuple[str, ...]) -> dict[str, Any]:
        """Return the config of a baseline that suits a frame."""
        forced = {"tau_x", "tau_y", "tau_n"} <= set(names)
        kinds = ["regressors", "regressors", "still", "equations"]
        kinds += ["believed", "linear_steady"] if forced else []
        kinds += ["nomoto", "nomoto_sideslip", "mmg"] if frame == "rudder" else []
        kind = self.one_of(kinds)
        if kind == "regressors":
            moved = self.one_of(("u|u|", "u^2", "|u|u^2", "sqrt(u)", "u^3"))
            inputs = [self.one_of((f"{n}", f"{n}|{n}|", f"{n}^2", f"sin({n})")) for n in names[3:]]
            terms = ["1", "u", "v", "r", moved, "u v", "u r", "v|r|", *inputs]
            flags = {name: self.often(0.4) for name in ("dissipative", "bounded")}
            return {"kind": kind, "terms": terms, "ridge": 1e-4, **flags}
        if kind == "believed":
            return {"kind": kind, "vessel": FRAMES[frame][0], "scale": self.random.uniform(0.8, 2)}
        if kind == "equations":
            u, v, r = self.random.uniform(-0.9, -0.3, 3).tolist()
            drive, steer = names[3], names[-1]
            return {
                "kind": kind,
                "u": {"u": u, f"{drive}|{drive}|": 1e-5},
                "v": {"v": v, "u r": -0.1},
                "r": {"r": r, f"sin({steer})" if frame == "rudder" else steer: 1e-4},
            }
        if kind == "linear_steady":
            return {
                "kind": kind,
                "steady": ["random_steps"],
                "speed": ["random_steps"],
                "steering": ["random_steps"],
                "settled": 10,
            }
        return {"kind": kind, **BASELINES.get(kind, ({},))[0]}

    def head(self, frame: str, names: tuple[str, ...], believed: bool) -> dict[str, Any] | None:
        """Return the config of a head, or none."""
        kind = self.one_of(
            [
                "mlp",
                "mlp",
                "lstm",
                "lstm",
                "lstm",
                "plsr",
                "ridge",
                "kernel",
                "symbolic",
                "genetic",
                "none",
            ]
        )
        if kind == "none":
            return None
        size, some = int(self.random.integers(3, 20)), self.some(names)
        margin = self.one_of((0.0, 0.1, 0.5))
        base: dict[str, Any] = {"kind": kind, "features": some, "margin": margin}
        if kind == "mlp":
            layers = tuple(int(n) for n in self.random.integers(1, 40, self.random.integers(1, 4)))
            return base | {
                "hidden": layers,
                "activation": self.one_of(("tanh", "silu", "relu", "softsign")),
                "mirror": self.often(0.4),
                "dropout": self.one_of((0.0, 0.2)),
            }
        if kind == "lstm":
            readout = self.one_of((0, 4, 9))
            commands = tuple(name for name in some if name not in ("u", "v", "r"))
            return base | {
                "hidden_size": size,
                "readout": readout,
                "memory": commands if readout and commands and self.often(0.5) else (),
                "activation": self.one_of(("tanh", "softsign")),
                "per_axis": self.often(0.3),
                "mirror": self.often(0.3),
                "encoder": self.often(0.3),
                "restoring": self.often(0.3),
            }
        if kind in ("plsr", "ridge"):
            if believed and self.often(0.7):
                return {"kind": kind, "space": "force", "terms": ["u_dot", "r_dot", "u", "v", "r"]}
            return base | {"choose": "one_step", "degree": self.one_of((1, 2, 3)), "folds": 3}
        if kind == "kernel":
            shape = self.one_of(({"kind": "rbf"}, {"kind": "polynomial"}))
            return base | {"kernel": shape, "folds": 3, "penalties": [1e-2], "choose": "one_step"}
        if kind == "genetic":
            return base | {"evolution": {"population": 60, "generations": 3}}
        late = [name for name in some if name in FRAMES[frame][1]]
        delay = {"channels": late[:1], "longest": 6} if late and self.often(0.6) else None
        if late and self.often(0.5):
            return base | {"terms": (f"u {late[0]}^-1", "v", "r|r|"), "delay": delay}
        return base | {"symmetric": self.often(0.5), "delay": delay}

    def some(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return at least the velocities, and some of the other channels."""
        others = [name for name in names[3:] if self.often(0.7)]
        return (*names[:3], *others) or names

    def member(self, frame: str, wind: bool, integrator: str) -> Model:
        """Return one fitted model.

        Raises:
            ResidnetError: where the parts do not go together.
        """
        signals, seen, _ = known(frame, wind)
        names = signals.build().names
        baseline = self.baseline(frame, names)
        head = self.head(frame, names, baseline["kind"] == "believed")
        range_of = torch.cat((seen.z[:, :3], seen.z[:, 3 : 3 + len(signals.inputs)]), dim=1)
        low, high = range_of.amin(0).tolist(), range_of.amax(0).tolist()
        spec = ModelSpec.model_validate(
            {
                "schema": "residnet.model/1",
                "name": "drawn",
                "role": "baseline" if head is None else "head",
                "signals": signals.model_dump(),
                "baseline": baseline,
                "head": head,
                "dt": STEP,
                "integrator": integrator,
                "hold": self.one_of(("start", "mean")),
                "low": low + ([0.0, -3.0] if wind else []),
                "high": high + ([9.0, 9.0] if wind else []),
                "disturbance": {"settle": 5.0, "decay": self.one_of((None, 60.0))}
                if self.often(0.2)
                else None,
            }
        )
        return spec, fitted(spec, seen, int(self.random.integers(1 << 30)))

    def model(self) -> tuple[str, bool, Model]:
        """Return frame, whether there is wind, and a model or the mean of several."""
        frame, wind = self.one_of(FRAMES), self.often(0.3)
        integrator = self.one_of(("rk4", "heun", "euler", "semi_implicit_euler"))
        if not self.often(0.15):
            return frame, wind, self.member(frame, wind, integrator)
        pairs = []
        while len(pairs) < 2:
            spec, model = self.member(frame, wind, integrator)
            if spec.disturbance is None and (spec.head is None or "force" not in str(spec.head)):
                pairs.append((spec, model))
        parts = tuple(spec for spec, _ in pairs)
        spec = pairs[0][0].model_copy(update={"role": "ensemble", "head": None, "members": parts})
        return frame, wind, (spec, mean_of([model for _, model in pairs]))


def fitted(spec: ModelSpec, seen: Samples, seed: int) -> HybridDynamics:
    """Return a model with its baseline identified, closed forms solved, weights at random."""
    torch.manual_seed(seed)
    model = spec.build()
    spec.baseline.fit(model.baseline, seen)
    thin = seen.where(torch.arange(len(seen)) % max(len(seen) // 400, 1) == 0)
    with torch.no_grad():
        residual = model.head.residual_target(thin, model.baseline(thin.z))
    model.head.calibrate(residual)
    if isinstance(model.head, ClosedFormHead):
        model.head.solve(residual)
    with torch.no_grad():
        for weights in model.head.parameters():
            weights.add_(0.2 * torch.randn_like(weights))
    return model.eval()


def recording(frame: str, wind: bool, spec: ModelSpec, steps: int, random: Any) -> Recording:
    """Return a measured past of a log, and inputs that jump and at times leave the range."""
    _, _, prepared = known(frame, wind)
    log = prepared[int(random.integers(len(prepared)))]
    begin = int(random.integers(0, 200))
    past = slice(begin, begin + 60)
    low, high = np.array(spec.low[3:]), np.array(spec.high[3:])
    jumps = random.uniform(low, high, (steps // 20 + 1, len(low)))
    w = np.repeat(jumps, 20, axis=0)[:steps]
    # a sample in fifty is a little outside of what was seen
    w[random.random(steps) < 0.02] = high + 0.1 * (high - low)
    y = log.y[past].copy()
    y[:, :2] -= y[-1, :2]
    return Recording(f"{frame}, wind" if wind else frame, y[-1], w, y, log.w[past])
