"""Carrying out an autopilot run, into a run folder."""

from __future__ import annotations

import json
import time
from typing import Any

import pandas as pd
import torch

from residnet.control.base import Policy
from residnet.control.controllers import AnyController, Steering, TunedConfig
from residnet.control.policy import HeadingPolicy
from residnet.control.steering import SteeredPlant, fly
from residnet.control.tuning import TuningTask, tune
from residnet.evaluation.autopilots import random_variations, row, step_flights, table
from residnet.evaluation.metrics import SCHEMA
from residnet.evaluation.report_autopilot import FLIGHTS, write_autopilot_report
from residnet.export.autopilot import export_autopilot
from residnet.physics.vessel import load_vessel
from residnet.run_folder import RunFolder
from residnet.tasks.autopilot import AutopilotConfig, PolicyConfig
from residnet.tasks.pipeline import say
from residnet.training.autopilot import train_autopilot


def run_autopilot(config: AutopilotConfig, folder: RunFolder) -> None:
    """Tune, train, compare, draw, report, export."""
    torch.set_num_threads(config.threads)
    vessel = SteeredPlant(load_vessel(config.vessel).build())
    turning = vessel.turning(config.rudder, config.turning_time)
    say(f"{config.name}: {config.vessel} answers {config.rudder:.3g} rad of rudder with K = {turning.gain:.4g} 1/s, T = {turning.time:.4g} s")
    steering = Steering(vessel, turning, config.rudder, config.test.dt)
    controllers: dict[str, tuple[str, Policy]] = {}
    notes: dict[str, Any] = {}
    for name, peer in config.peers.items():
        built, notes[name] = _peer(name, peer, steering, config)
        controllers[name] = ("floor" if name == config.floor else "classical", built)
    for name, wanted in config.policies.items():
        teacher = None if wanted.imitate is None else controllers[wanted.imitate][1]
        policy, notes[name] = _policy(name, wanted, steering, config, folder, teacher)
        controllers = {name: ("policy", policy), **controllers}
    folder.write_json(folder.path / "controllers.json", {"schema": "residnet.controllers/1", "turning": vars(turning), "controllers": notes})
    rows, series = _compare(controllers, vessel, config)
    folder.write_json(
        folder.metrics,
        {
            "schema": SCHEMA,
            "run": config.name,
            "channels": {"settling": "s", "overshoot": "rad", "iae": "rad s", "travel": "rad"},
            "floor": config.floor,
            "rows": rows,
        },
    )
    series.to_parquet(folder.path / FLIGHTS)
    for name in config.policies:
        trained = controllers[name][1]
        assert isinstance(trained, HeadingPolicy)
        about = {"vessel": config.vessel, "spread": config.spread.model_dump(mode="json")}
        own = [entry for entry in rows if entry["model"] == name]
        export_autopilot(name, trained, folder.exports / f"{name}.pt", safe=config.safe, about=about, metrics=own)
        print(f"exported: {folder.exports / f'{name}.pt'}")
    write_autopilot_report(folder.path)
    print(table(rows, config.floor))


def _peer(name: str, peer: AnyController, steering: Steering, config: AutopilotConfig) -> tuple[Policy, dict[str, Any]]:
    if not isinstance(peer, TunedConfig):
        return peer.build(steering), {"config": peer.model_dump(mode="json")}
    test = config.test
    task = TuningTask(test.heading, config.spread.corners(), test.overshoot, test.band, test.duration, test.bias, test.bias_error, test.bias_time)
    started = time.time()
    tuned = tune(peer, steering, task, config.tuning_points)
    say(f"  tuned {name}: " + ", ".join(f"{k} {v:.4g}" for k, v in (tuned.parameters | tuned.gains).items()) + f", worst {tuned.settling:.2f} s")
    complete = peer.model_copy(update=tuned.parameters)
    return complete.build(steering), {
        "config": complete.model_dump(mode="json"),
        "gains": tuned.gains,
        "worst_settling": tuned.settling,
        "worst_overshoot": tuned.overshoot,
        "tried": tuned.tried,
        "seconds": round(time.time() - started, 1),
    }


def _policy(
    name: str,
    wanted: PolicyConfig,
    steering: Steering,
    config: AutopilotConfig,
    folder: RunFolder,
    teacher: Policy | None,
) -> tuple[HeadingPolicy, dict[str, Any]]:
    torch.manual_seed(config.seed)
    policy = HeadingPolicy(
        steering.vessel.state,
        turning=steering.turning,
        limit=steering.limit,
        dt=wanted.training.dt,
        rate=steering.vessel.rate,
        hidden=wanted.hidden,
        observer=wanted.observer,
    )
    started = time.time()
    notes = _stored(policy, name, folder)
    if notes is None:
        say(f"  training {name}")
        notes = train_autopilot(
            name, policy, steering.vessel, wanted.training, config.spread, _Score(steering, config), config.seed, folder.path, teacher
        )
        notes |= {"seconds": round(time.time() - started, 1), "imitates": wanted.imitate}
        _store(policy, name, folder, notes)
    policy.dt = steering.dt
    say(f"  {name}: score {notes['best_validation']:.3f} after {notes['seconds']:.0f} s")
    return policy.double(), {key: value for key, value in notes.items() if key != "curve"}


class _Score:
    """Mean and worst settling time over the corners of the spread, and what overshoot beyond the limit costs; seconds."""

    def __init__(self, steering: Steering, config: AutopilotConfig) -> None:
        self.steering, self.test, self.corners = steering, config.test, config.spread.corners()

    def __call__(self, policy: HeadingPolicy) -> float:
        test = self.test
        policy.dt = test.dt
        flights = step_flights(self.steering.vessel, policy, self.corners, test.heading, test.dt, test.duration)
        settled = flights.settled(test.band)
        beyond = (flights.overshoot() - 0.7 * test.overshoot).clamp(min=0.0) / test.overshoot
        return float(settled.mean() + 2.0 * settled.max() + 0.5 * test.duration * beyond.amax())


def _store(policy: HeadingPolicy, name: str, folder: RunFolder, notes: dict[str, Any]) -> None:
    from safetensors.torch import save_file

    place = folder.models / name
    place.mkdir(parents=True, exist_ok=True)
    save_file({key: value.contiguous() for key, value in policy.state_dict().items()}, place / "weights.safetensors")
    folder.write_json(place / "fit.json", notes)


def _stored(policy: HeadingPolicy, name: str, folder: RunFolder) -> dict[str, Any] | None:
    """Weights and notes of a policy that an interrupted run had finished."""
    from safetensors.torch import load_file

    place = folder.models / name
    if not (place / "fit.json").is_file():
        return None
    policy.load_state_dict(load_file(place / "weights.safetensors"))
    policy.eval().requires_grad_(False)
    notes: dict[str, Any] = json.loads((place / "fit.json").read_text())
    return notes


def _compare(controllers: dict[str, tuple[str, Policy]], vessel: SteeredPlant, config: AutopilotConfig) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    """Rows of metrics.json, and the corners' flights as a table."""
    test, corners = config.test, config.spread.corners()
    drawn = random_variations(config.spread.effect, config.spread.time, test.plants, config.seed + 1)
    pushed = torch.tensor([[1.0, 1.0, side * test.bias] for side in (1.0, -1.0)], dtype=torch.float64)
    rows: list[dict[str, Any]] = []
    parts = []
    for name, (kind, policy) in controllers.items():
        for protocol, variations in (("nominal", corners[:1]), ("corners", corners), ("random", drawn)):
            flights = step_flights(vessel, policy, variations, test.heading, test.dt, test.duration)
            rows.append(row(name, kind, protocol, flights, test.band))
            if protocol == "corners":
                every = max(round(0.05 / test.dt), 1)
                for i, variation in enumerate(corners):
                    side = 1.0 if i % 2 == 0 else -1.0
                    parts.append(
                        pd.DataFrame(
                            {
                                "controller": name,
                                "effect": float(variation[0]),
                                "time": float(variation[1]),
                                "t": torch.arange(0, flights.inputs.shape[1], every).numpy() * test.dt,
                                "psi": side * flights.states[i, :-1:every, flights.psi].numpy(),
                                "r": side * flights.states[i, :-1:every, flights.r].numpy(),
                                "rudder": side * flights.inputs[i, ::every, 0].numpy(),
                            }
                        )
                    )
        flights = fly(vessel, policy, torch.full((2,), test.heading), pushed, dt=test.dt, duration=test.bias_time)
        rows.append(row(name, kind, "bias", flights, test.band) | {"error_end": float(flights.error[:, -1].abs().max())})
    return rows, pd.concat(parts, ignore_index=True)
