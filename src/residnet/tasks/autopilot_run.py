"""Carrying out an autopilot run, into a run folder."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch

from residnet.control.base import Policy
from residnet.control.heading.conditions import (
    ConditionedRun,
    ConditionsConfig,
    fly,
    quiet,
    quiet_after,
    tune,
)
from residnet.control.heading.controllers import (
    DepthConfig,
    ObservedConfig,
    RecurrentPolicy,
    Steering,
    TunableConfig,
    load_recurrent,
    observed_of,
)
from residnet.control.heading.policies import SIGHT, DepthPolicy, ObservedPolicy
from residnet.control.heading.vessels import SteeredPlant
from residnet.core.progress import begin, report, say
from residnet.documents.gouletas2020.autopilot import predictive
from residnet.dynamics.compiled import CompiledRollout
from residnet.dynamics.store import rebuilt
from residnet.export.policy import ExportedHeading
from residnet.judge.autopilots import (
    QUANTITIES,
    QUIET_FLIGHTS,
    corners,
    cycling,
    drawn,
    judged,
    measure,
    not_for,
    objections,
    random_variations,
    sea_flights,
    sea_row,
    series,
    step_flights,
    step_row,
    swinging,
    wind_flights,
)
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
    words_of,
)
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.runs.task import ExportRequest, MainFigure, Outcome
from residnet.training.policies.fit import train_policy

if TYPE_CHECKING:
    from residnet.tasks.autopilot import AnyController, AutopilotConfig, JudgedConditions

Controllers = dict[str, tuple[str, Policy]]
"""Kind (policy, classical, floor and others) and controller by name."""


def run_autopilot(config: AutopilotConfig, folder: RunFolder) -> Outcome:
    """Tune, train and compare."""
    config = config.paced()
    vessel = config.steered
    turning = vessel.turning(config.rudder, config.turning_time)
    say(
        f"{config.name}: {config.vessel} answers {config.rudder:.3g} rad of rudder with K ="
        f" {turning.gain:.4g} 1/s, T = {turning.time:.4g} s"
    )
    steering = Steering(vessel, turning, config.rudder, config.test.dt)
    controllers: Controllers = {}
    notes: dict[str, Any] = {}
    complete: dict[str, AnyController] = {}
    for name, peer in config.peers.items():
        complete[name], notes[name] = _complete(name, peer, steering, config)
        kind = "floor" if name == config.floor else "classical"
        controllers[name] = (kind, complete[name].build(steering))
    for name, settings in config.predictive.items():
        built, notes[name] = predictive(name, settings, steering, config.seed, folder)
        controllers[name] = ("predictive", built)
    judged_too: Controllers = {}
    for name, wanted in config.policies.items():
        start = None if wanted.start is None else complete[wanted.start]
        policy, notes[name], untrained = _policy(name, start, steering, config, folder)
        controllers = {name: (wanted.kind, policy), **controllers}
        # what it is compared with: itself untrained, and without its network
        if wanted.units > 0:
            judged_too[f"{name} untrained"] = ("untrained", untrained)
            if isinstance(policy, ObservedPolicy | DepthPolicy):
                judged_too[f"{name} network off"] = ("network_off", policy.without_network())
    folder.write_json(
        folder.path / "controllers.json",
        {"schema": "residnet.controllers/1", "turning": vars(turning), "controllers": notes},
    )
    rows, flown, plants = _compare(controllers, vessel, config)
    if config.conditions is not None:
        more, conditioned = _judge(judged_too | controllers, config, config.conditions)
        rows += more
        folder.write_table(folder.path / CONDITIONS, conditioned)
    channels = {**QUANTITIES, "cost": "s", "time_outside": "s"} | dict.fromkeys(
        ("heading_swing", "rudder_swing", "error_end", "heading_rms", "rudder_rms", "heel_rms"),
        "rad",
    )
    # what is of the heading error in rad is of the depth's in m
    lengths = {"rad": "m", "rad s": "m s"} if config.test.depth else {}
    for name in ("overshoot", "iae", "heading_swing", "error_end"):
        channels[name] = lengths.get(channels[name], channels[name])
    folder.write_json(
        folder.metrics,
        {
            "schema": SCHEMA,
            "run": config.name,
            "channels": channels,
            "floor": config.floor,
            "flown": config.model_dump(mode="json", include={"test", "conditions"}),
            "rows": rows,
        },
    )
    folder.write_table(folder.path / FLIGHTS, flown)
    folder.write_table(folder.path / PLANTS, plants)
    words = words_of(config.test.model_dump())
    tables = [settling_table(rows, config.floor, words), effort_table(rows, words)]
    if config.conditions is not None:
        tables.insert(0, cost_table(rows, words))
    return Outcome(
        *_told(config, rows),
        "\n\n".join(table.text() for table in tables),
        exports={
            name: partial(export_policy, config, ExportRequest(folder, name))
            for name in config.policies
        },
    )


def _complete(
    name: str, peer: AnyController, steering: Steering, config: AutopilotConfig
) -> tuple[AnyController, dict[str, Any]]:
    """Return a peer ready to fly, tuned by the cost where it lacks constants, and notes on it."""
    stated = config.conditions
    if not isinstance(peer, TunableConfig) or None not in peer.parameters().values():
        return peer, {"config": peer.model_dump(mode="json")}
    assert stated is not None
    started = time.time()
    steering = steering._replace(vessel=_in_weather(config, stated))
    found = tune(peer, steering, stated.stated, stated.evolution, config.seed + 11, CompiledRollout)
    constants = ", ".join(f"{key} {value:.4g}" for key, value in found.parameters.items())
    say(f"  tuned {name}: {constants}, cost {found.cost:.3f} s")
    complete = peer.tuned(found.parameters)
    return complete, {
        "config": complete.model_dump(mode="json"),
        "cost": found.cost,
        "tried": found.tried,
        "seconds": round(time.time() - started, 1),
    }


def _in_weather(config: AutopilotConfig, stated: JudgedConditions) -> SteeredPlant:
    """Return the vessel as the conditions need it: in calm water, or in wind and current."""
    calm = not any(conditions.weather for conditions in stated.flown.values())
    return SteeredPlant(load_vessel(config.vessel).build(), calm=calm, axis=config.axis)


def _policy(
    name: str,
    start: AnyController | None,
    steering: Steering,
    config: AutopilotConfig,
    folder: RunFolder,
) -> tuple[RecurrentPolicy, dict[str, Any], RecurrentPolicy]:
    """Return a policy trained under the conditions, notes, and the policy as it began.

    `start` is the law that its network stands beside; None for none.
    """
    wanted, stated = config.policies[name], config.conditions
    assert stated is not None
    school, turning = config.school_of(name), steering.turning
    if wanted.learned is not None:
        turning = school.turning(config.rudder, config.turning_time, wanted.training.dt)
        say(
            f"  {name} learns on {wanted.learned.model} of {wanted.learned.run}: K ="
            f" {turning.gain:.4g} 1/s, T = {turning.time:.4g} s"
        )
    torch.manual_seed(config.seed)
    law = observed_of(start)
    described = {
        "state": school.state,
        **vars(turning),
        "limit": steering.limit,
        "rate": school.rate,
        "dt": steering.dt,
        "trained_at": wanted.training.dt,
        "units": wanted.units,
        **({"law": law.model_dump()} if isinstance(law, ObservedConfig) else {}),
    }
    if isinstance(start, DepthConfig):
        sight = {name: start.complete()[name] for name in SIGHT}
        described = {"law": described, "steepest": start.steepest, "sight": sight}
    spec = config.spec_of(name).model_validate(described)
    policy, store = spec.build(), FolderStore(folder)
    notes, started = store.finished_module(name, policy), (time.time(), time.process_time())
    if notes is None:
        begin(f"training {name}")
        compiler = partial(CompiledRollout, most=wanted.training.outlying)
        notes = train_policy(
            name,
            policy,
            school,
            wanted.training,
            stated.stated,
            config.seed,
            folder.path,
            compiler if wanted.training.compiled else None,
        )
        seconds, cpu = time.time() - started[0], time.process_time() - started[1]
        notes |= {"seconds": round(seconds, 1), "cpu_seconds": round(cpu, 1)}
        notes |= {"constants": policy.values()}
        store.keep_module(name, spec, policy, notes)
        # as a resumed run reads it
        policy = rebuilt(spec, policy)
    untrained = spec.build().eval().requires_grad_(False).double()
    policy.at(steering.dt)
    for built in (policy, untrained):
        built.read_from(steering.vessel.state)
    say(
        f"  {name}: cost {notes['best_validation']:.3f} s, {notes['start_validation']:.3f} s at the"
        f" start, after {notes['seconds']:.0f} s of training"
    )
    notes = {key: value for key, value in notes.items() if key != "curve"}
    return policy.double(), notes, untrained


def stored_policy(config: AutopilotConfig, models: Path, name: str, dt: float) -> RecurrentPolicy:
    """Return a trained policy of a finished run, at a step of dt seconds.

    Raises:
        UsageError: where the run lacks it, or it is not as it was written.
    """
    policy = load_recurrent(models / name, config.spec_of(name))
    policy.at(dt)
    return policy


def _compare(
    controllers: Controllers, vessel: SteeredPlant, config: AutopilotConfig
) -> tuple[list[dict[str, Any]], pd.DataFrame, pd.DataFrame]:
    """Return the rows of metrics.json, and two tables: flights of the corners, random vessels."""
    test, stated = config.test, _stated(config)
    change, band = test.step
    ends = corners(stated.effect, stated.time)
    spread = random_variations(stated.effect, stated.time, test.plants, config.seed + 1)
    pushed = torch.tensor([[1.0, 1.0, test.bias], [1.0, 1.0, -test.bias]], dtype=torch.float64)
    plant = load_vessel(config.vessel).build()
    rows: list[dict[str, Any]] = []
    flown, plants = [], []
    for name, (kind, policy) in controllers.items():
        step = partial(step_flights, vessel, policy, change, test.dt, test.duration)
        tests = {"nominal": step(ends[:1]), "corners": step(ends), "random": step(spread)}
        rows += [
            step_row(name, kind, protocol, flights, band) for protocol, flights in tests.items()
        ]
        flown.append(series(name, tests["corners"], ends))
        found = {key: value.numpy() for key, value in measure(tests["random"], band).items()}
        given = {"effect": spread[:, 0].numpy(), "time": spread[:, 1].numpy()}
        plants.append(pd.DataFrame({"controller": name, **given, **found}))
        times: dict[str, Any] = {"dt": test.dt, "duration": test.bias_time}
        disturbed = {"bias": fly(vessel, policy, torch.full((2,), change), pushed, **times)}
        if test.wind is not None:
            disturbed["wind"] = wind_flights(plant, policy, test.wind, test.heading, **times)
        rows += [
            step_row(name, kind, key, flights, band)
            | {"error_end": float(flights.error[:, -1].abs().max())}
            for key, flights in disturbed.items()
        ]
        if test.sea is not None:
            duration = test.duration + test.sea_time
            kept = sea_flights(
                plant, policy, test.sea, test.heading, test.dt, duration, config.seed + 2
            )
            rows.append(sea_row(name, kind, kept, test.duration))
    return rows, pd.concat(flown, ignore_index=True), pd.concat(plants, ignore_index=True)


def _stated(config: AutopilotConfig) -> ConditionsConfig:
    return ConditionsConfig() if config.conditions is None else config.conditions.stated


def _judge(
    controllers: Controllers, config: AutopilotConfig, stated: JudgedConditions
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    """Return the rows of metrics.json and the table of flights under the conditions."""
    vessel = _in_weather(config, stated)
    tests = {
        "conditions" if name == "stated" else f"beyond_{name}": conditions
        for name, conditions in stated.flown.items()
    }
    flown = {
        name: (conditions, drawn(conditions, stated.flights, config.seed))
        for name, conditions in tests.items()
    }
    still = drawn(quiet(stated.stated), min(QUIET_FLIGHTS, stated.flights), config.seed)
    longest = max(1, *(int(changes.delay.max()) for _, changes in flown.values()))
    rows, tables = [], []
    for place, (name, (kind, policy)) in enumerate(controllers.items()):
        report("judging", place, len(controllers))
        run = ConditionedRun(
            vessel, policy.double(), stated.stated.dt, compiler=CompiledRollout, longest=longest
        )
        for protocol, (conditions, changes) in flown.items():
            found, table = judged(name, kind, protocol, run, conditions, changes)
            rows.append(found)
            tables.append(table)
        rows.append(swinging(name, kind, run, still, quiet_after(stated.stated.duration)))
    return rows, pd.concat(tables, ignore_index=True)


def _told(
    config: AutopilotConfig, rows: list[dict[str, Any]]
) -> tuple[list[str], dict[str, MainFigure]]:
    """Return the verdict and the main figures: settling on the nominal vessel, and worst corner."""
    found = {(row["model"], row["protocol"]): row["settling"] for row in rows if "settling" in row}
    sentences, figures = cost_verdict(rows), dict[str, MainFigure]()
    change, _ = config.test.step
    words = words_of(config.test.model_dump())
    for name in config.policies or config.predictive:
        nominal, worst = found[name, "nominal"]["max"], found[name, "corners"]["max"]
        figures[f"{name}_settling_nominal"] = MainFigure(nominal, "s")
        figures[f"{name}_settling_worst"] = MainFigure(worst, "s")
        sentences.append(
            f"'{name}' settles on a new {words.value} {words.scale * change:.3g} {words.unit} away"
            f" in {nominal:.2f} s on the nominal vessel, and in {worst:.2f} s on the slowest vessel"
            " at the corners of the spread."
        )
    if config.floor is not None:
        sentences.append(
            f"The fastest possible change of the nominal vessel, by '{config.floor}' that knows it"
            f" exactly, takes {found[config.floor, 'nominal']['max']:.2f} s."
        )
    for row in rows:
        if row["protocol"] == "conditions" and row["model"] in config.policies:
            figures[f"{row['model']}_cost"] = MainFigure(row["cost"]["mean"], "s")
    return sentences, figures


def export_policy(config: AutopilotConfig, asked: ExportRequest) -> Path:
    """Write a policy of a run, with its rows of metrics.json in the card; returns the file.

    Raises:
        UsageError: where there is no such policy.
        WithheldError: where a classical controller costs less, but for `asked.anyway`.
        ExportError: where the file does not reproduce the policy.
    """
    name, rows = asked.named(config.policies), asked.run.read_metrics()["rows"]
    flown = config.paced()
    about = {"vessel": config.vessel, "conditions": _stated(flown).model_dump(mode="json")}
    learned = config.policies[name].learned
    about |= {} if learned is None else {"learned": learned.model_dump(mode="json")}
    about |= {"not_for": [*not_for(name, rows), *cycling(name, rows)]}
    exported = ExportedHeading(
        name,
        stored_policy(config, asked.run.models, name, flown.test.dt),
        safe=config.safe,
        about=about,
        metrics=[row for row in rows if row["model"] == name],
    )
    return asked.write(exported, objections(name, rows))
