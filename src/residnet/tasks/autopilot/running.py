"""Carrying out an autopilot run, into a run folder."""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path
from typing import Any

import torch

from residnet.control.base import Policy
from residnet.control.heading.controllers import Steering, TunedConfig
from residnet.control.heading.keeper import HeadingKeeper
from residnet.control.heading.policy import HeadingPolicy
from residnet.control.heading.steering import SteeredPlant
from residnet.control.heading.stored import HeadingPolicySpec
from residnet.control.heading.tuning import TuningTask, tune
from residnet.control.observed.config import AnyController, ObservedConfig
from residnet.core.progress import say
from residnet.documents.gouletas2020.autopilot import predictive
from residnet.dynamics.store import rebuilt
from residnet.export.policy import ExportedHeading
from residnet.export.torchscript import TorchScriptExporter
from residnet.judge.autopilots import QUANTITIES
from residnet.judge.metrics import SCHEMA
from residnet.physics.vessel import load_vessel
from residnet.report.sections.autopilot import (
    CONDITIONS,
    FLIGHTS,
    PLANTS,
    cost_table,
    cost_verdict,
    effort_table,
    settling_table,
)
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.task import MainFigure, Outcome
from residnet.tasks.autopilot.comparison import compare
from residnet.tasks.autopilot.config import AutopilotSettings, PolicyConfig
from residnet.tasks.autopilot.pace import paced
from residnet.tasks.autopilot.requirements import learned_vessel
from residnet.tasks.autopilot.scores import CommandDifference, SettlingScore
from residnet.tasks.autopilot.under_conditions import (
    companions,
    completed,
    judge_all,
    trained_policy,
)
from residnet.training.policies.autopilot import train_autopilot


def run_autopilot(config: AutopilotSettings, folder: RunFolder) -> Outcome:
    """Tune, train and compare."""
    config = paced(config)
    vessel = SteeredPlant(load_vessel(config.vessel).build())
    turning = vessel.turning(config.rudder, config.turning_time)
    say(
        f"{config.name}: {config.vessel} answers {config.rudder:.3g} rad of rudder with K ="
        f" {turning.gain:.4g} 1/s, T = {turning.time:.4g} s"
    )
    steering = Steering(vessel, turning, config.rudder, config.test.dt)
    controllers: dict[str, tuple[str, Policy]] = {}
    notes: dict[str, Any] = {}
    complete: dict[str, AnyController] = {}
    for name, peer in config.peers.items():
        complete[name], notes[name] = _peer(name, peer, steering, config)
        controllers[name] = (
            "floor" if name == config.floor else "classical",
            complete[name].build(steering),
        )
    for name, settings in config.predictive.items():
        built, notes[name] = predictive(name, settings, steering, config.seed, folder)
        controllers[name] = ("predictive", built)
    for name, wanted in config.policies.items():
        school = _school(name, wanted, steering, config)
        teacher = None if wanted.imitate is None else complete[wanted.imitate]
        policy, notes[name] = _policy(name, wanted, school, config, folder, teacher)
        policy.read_from(vessel.state)
        controllers = {name: ("policy", policy), **controllers}
    judged = dict(controllers)
    if config.conditions is not None:
        for name, learner in config.recurrent.items():
            start = None if learner.start is None else complete[learner.start]
            assert start is None or isinstance(start, ObservedConfig)
            spec, observed, found = trained_policy(
                name, learner, start, steering, config, config.conditions, folder
            )
            notes[name] = {key: value for key, value in found.items() if key != "curve"}
            learned = {name: (learner.kind, observed)}
            controllers = {**learned, **controllers}
            judged = {**learned, **companions(name, learner, spec, observed), **judged}
    folder.write_json(
        folder.path / "controllers.json",
        {"schema": "residnet.controllers/1", "turning": vars(turning), "controllers": notes},
    )
    rows, series, plants = compare(controllers, vessel, config)
    if config.conditions is not None:
        more, flown = judge_all(judged, config, config.conditions)
        rows += more
        folder.write_table(folder.path / CONDITIONS, flown)
    folder.write_json(
        folder.metrics,
        {
            "schema": SCHEMA,
            "run": config.name,
            "channels": {
                **QUANTITIES,
                "cost": "s",
                "time_outside": "s",
                "heading_swing": "rad",
                "rudder_swing": "rad",
                "error_end": "rad",
                "heading_rms": "rad",
                "rudder_rms": "rad",
                "heel_rms": "rad",
            },
            "floor": config.floor,
            "rows": rows,
        },
    )
    folder.write_table(folder.path / FLIGHTS, series)
    folder.write_table(folder.path / PLANTS, plants)
    policies = {name: controllers[name][1] for name in (*config.policies, *config.recurrent)}
    tables = [settling_table(rows, config.floor), effort_table(rows)]
    if config.conditions is not None:
        tables.insert(0, cost_table(rows))
    return Outcome(
        _verdict(config, rows),
        _main_figures(config, rows),
        "\n\n".join(table.text() for table in tables),
        exports={
            name: partial(_export, config, folder, name, policies[name], rows) for name in policies
        },
    )


def _settling(
    config: AutopilotSettings, rows: list[dict[str, Any]]
) -> dict[str, tuple[float, float]]:
    """Return the settling times of each policy in s: nominal vessel, and worst corner."""
    found = {(row["model"], row["protocol"]): row["settling"] for row in rows if "settling" in row}
    return {
        name: (found[name, "nominal"]["max"], found[name, "corners"]["max"])
        for name in (*config.policies, *config.recurrent)
    }


def _verdict(config: AutopilotSettings, rows: list[dict[str, Any]]) -> list[str]:
    step = math.degrees(config.test.heading)
    sentences = [
        f"'{name}' settles on a new heading {step:.3g} deg away in {nominal:.2f} s on the nominal"
        f" vessel, and in {worst:.2f} s on the slowest vessel at the corners of the spread."
        for name, (nominal, worst) in _settling(config, rows).items()
    ]
    if config.floor is not None:
        floor = next(
            row["settling"]["max"]
            for row in rows
            if (row["model"], row["protocol"]) == (config.floor, "nominal")
        )
        sentences.append(
            f"The fastest possible change of the nominal vessel, by '{config.floor}' that knows it"
            f" exactly, takes {floor:.2f} s."
        )
    return [*cost_verdict(rows), *sentences]


def _main_figures(config: AutopilotSettings, rows: list[dict[str, Any]]) -> dict[str, MainFigure]:
    figures = {}
    for name, (nominal, worst) in _settling(config, rows).items():
        figures[f"{name}_settling_nominal"] = MainFigure(nominal, "s")
        figures[f"{name}_settling_worst"] = MainFigure(worst, "s")
    for row in rows:
        if row["protocol"] == "conditions" and row["model"] in config.recurrent:
            figures[f"{row['model']}_cost"] = MainFigure(row["cost"]["mean"], "s")
    return figures


def _export(
    config: AutopilotSettings,
    folder: RunFolder,
    name: str,
    policy: Policy,
    rows: list[dict[str, Any]],
) -> Path:
    """Export a policy, with its rows of metrics.json in the card; returns the file."""
    assert isinstance(policy, HeadingKeeper)
    about: dict[str, Any] = {"vessel": config.vessel}
    if name in config.policies:
        learned = config.policies[name].learned
        about |= {"spread": config.spread.model_dump(mode="json")}
        about |= {} if learned is None else {"learned": learned.model_dump(mode="json")}
    elif config.conditions is not None:
        about |= {"conditions": config.conditions.stated.model_dump(mode="json")}
    metrics = [row for row in rows if row["model"] == name]
    file = folder.exports / f"{name}.pt"
    exported = ExportedHeading(name, policy, safe=config.safe, about=about, metrics=metrics)
    TorchScriptExporter().export(exported, file)
    return file


def _peer(
    name: str, peer: AnyController, steering: Steering, config: AutopilotSettings
) -> tuple[AnyController, dict[str, Any]]:
    """Return a peer with all its gains, and notes on its tuning."""
    if config.conditions is not None:
        return completed(name, peer, steering, config, config.conditions)
    if not isinstance(peer, TunedConfig):
        return peer, {"config": peer.model_dump(mode="json")}
    test = config.test
    task = TuningTask(
        test.heading,
        config.spread.corners(),
        test.overshoot,
        test.band,
        test.duration,
        test.bias,
        test.bias_error,
        test.bias_time,
    )
    started = time.time()
    tuned = tune(peer, steering, task, config.tuning_points)
    say(
        f"  tuned {name}: "
        + ", ".join(f"{k} {v:.4g}" for k, v in (tuned.parameters | tuned.gains).items())
        + f", worst {tuned.settling:.2f} s"
    )
    complete = peer.model_copy(update=tuned.parameters)
    return complete, {
        "config": complete.model_dump(mode="json"),
        "gains": tuned.gains,
        "worst_settling": tuned.settling,
        "worst_overshoot": tuned.overshoot,
        "tried": tuned.tried,
        "seconds": round(time.time() - started, 1),
    }


def _school(
    name: str, wanted: PolicyConfig, steering: Steering, config: AutopilotSettings
) -> Steering:
    """Return what a policy is trained on: the vessel, or a learned model of it.

    The vessel is in wind and current where the spread has them.

    Raises:
        FitError: where the learned model does not turn steadily.
        ConfigError: where its inputs are not those of the vessel.
    """
    if wanted.learned is None:
        return (
            steering._replace(vessel=SteeredPlant(load_vessel(config.vessel).build(), calm=False))
            if config.spread.weather
            else steering
        )
    assert isinstance(steering.vessel, SteeredPlant)
    vessel = learned_vessel(name, wanted, steering.vessel, config)
    turning = vessel.turning(config.rudder, config.turning_time, wanted.training.dt)
    say(
        f"  {name} learns on {wanted.learned.model} of {wanted.learned.run}: K ="
        f" {turning.gain:.4g} 1/s, T = {turning.time:.4g} s"
    )
    return steering._replace(vessel=vessel, turning=turning)


def _policy(
    name: str,
    wanted: PolicyConfig,
    steering: Steering,
    config: AutopilotSettings,
    folder: RunFolder,
    teacher: AnyController | None,
) -> tuple[HeadingPolicy, dict[str, Any]]:
    torch.manual_seed(config.seed)
    spec = HeadingPolicySpec(
        state=tuple(steering.vessel.state),
        gain=steering.turning.gain,
        time=steering.turning.time,
        speed=steering.turning.speed,
        limit=steering.limit,
        rate=steering.vessel.rate,
        dt=wanted.training.dt,
        hidden=tuple(wanted.hidden),
        observer=wanted.observer,
    )
    policy, store = spec.build(), FolderStore(folder)
    started = time.time()
    notes = store.finished_module(name, policy)
    if notes is None:
        say(f"  training {name}")
        # a controller with a memory knows its step: one teaches at the step of training, its like
        # is compared at that of flights
        shown = None if teacher is None else teacher.build(steering._replace(dt=wanted.training.dt))
        score = (
            SettlingScore(steering, config)
            if teacher is None
            else CommandDifference(steering, config, teacher.build(steering))
        )
        notes = train_autopilot(
            name,
            policy,
            steering.vessel,
            wanted.training,
            config.spread,
            score,
            config.seed,
            folder.path,
            shown,
        )
        notes |= {"seconds": round(time.time() - started, 1), "imitates": wanted.imitate}
        store.keep_module(name, spec, policy, notes)
        # as a resumed run reads it
        policy = rebuilt(spec, policy)
    policy.dt = steering.dt
    say(f"  {name}: score {notes['best_validation']:.3f} after {notes['seconds']:.0f} s")
    return policy.double(), {key: value for key, value in notes.items() if key != "curve"}
