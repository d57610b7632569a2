"""The part of an autopilot run that stated conditions ask for: tuning, training and judging."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import pandas as pd
import torch

from residnet.control.base import Policy
from residnet.control.conditions.evolution import evolve
from residnet.control.conditions.flights import ConditionedRun
from residnet.control.conditions.quiet import quiet, quiet_after
from residnet.control.heading.controllers import Steering, TunableConfig
from residnet.control.heading.steering import SteeredPlant
from residnet.control.observed.config import AnyController, ObservedConfig
from residnet.control.observed.policy import ObservedPolicy
from residnet.control.observed.stored import RecurrentPolicy, RecurrentSpec
from residnet.core.progress import report, say
from residnet.dynamics.store import rebuilt
from residnet.export.closed_loop import CompiledLoop
from residnet.judge.conditions import QUIET_FLIGHTS, drawn, judged, swinging
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import FolderStore
from residnet.tasks.autopilot.config import AutopilotSettings, JudgedConditions, RecurrentConfig
from residnet.tasks.autopilot.tuned import tuned_before
from residnet.training.policies.conditions_fit import train_under_conditions

Controllers = dict[str, tuple[str, Policy]]


def in_weather(config: AutopilotSettings, stated: JudgedConditions) -> SteeredPlant:
    """Return the vessel as the conditions need it: in calm water, or in wind and current."""
    flown = (stated.stated, *stated.beyond.values())
    calm = not any(conditions.weather for conditions in flown)
    return SteeredPlant(load_vessel(config.vessel).build(), calm=calm)


def tuned_peer(
    name: str,
    peer: TunableConfig,
    steering: Steering,
    config: AutopilotSettings,
    stated: JudgedConditions,
) -> tuple[TunableConfig, dict[str, Any]]:
    """Return a peer with all its constants, tuned by the cost, and notes on its tuning."""
    started = time.time()
    steering = steering._replace(vessel=in_weather(config, stated))
    seed = config.seed + 11
    found = evolve(peer, steering, stated.stated, stated.evolution, seed, CompiledLoop)
    constants = ", ".join(f"{key} {value:.4g}" for key, value in found.parameters.items())
    say(f"  tuned {name}: {constants}, cost {found.cost:.3f} s")
    complete = peer.model_copy(update=found.parameters)
    return complete, {
        "config": complete.model_dump(mode="json"),
        "cost": found.cost,
        "tried": found.tried,
        "seconds": round(time.time() - started, 1),
    }


def trained_policy(
    name: str,
    wanted: RecurrentConfig,
    start: ObservedConfig | None,
    steering: Steering,
    config: AutopilotSettings,
    stated: JudgedConditions,
    folder: RunFolder,
) -> tuple[RecurrentSpec, RecurrentPolicy, dict[str, Any]]:
    """Return a policy trained under the conditions, with its description and notes.

    `start` is the law that its network stands beside; None for none.
    """
    torch.manual_seed(config.seed)
    vessel = in_weather(config, stated)
    spec = wanted.spec.model_validate(
        {
            "state": steering.vessel.state,
            "gain": steering.turning.gain,
            "time": steering.turning.time,
            "speed": steering.turning.speed,
            "limit": steering.limit,
            "rate": steering.vessel.rate,
            "dt": steering.dt,
            "trained_at": wanted.training.dt,
            "units": wanted.units,
            **({} if start is None else {"law": start.model_dump()}),
        }
    )
    policy, store = spec.build(), FolderStore(folder)
    notes, started = store.finished_module(name, policy), time.time()
    if notes is None:
        say(f"  training {name}")
        notes = train_under_conditions(
            name,
            policy,
            vessel,
            wanted.training,
            stated.stated,
            config.seed,
            folder.path,
            partial(CompiledLoop, most=wanted.training.outlying)
            if wanted.training.compiled
            else None,
        )
        notes |= {"seconds": round(time.time() - started, 1), "constants": policy.values()}
        store.keep_module(name, spec, policy, notes)
        # as a resumed run reads it
        policy = rebuilt(spec, policy)
    policy.at(steering.dt)
    say(
        f"  {name}: cost {notes['best_validation']:.3f} s, {notes['start_validation']:.3f} s at the"
        f" start, after {notes['seconds']:.0f} s of training"
    )
    return spec, policy.double(), notes


def companions(
    name: str, wanted: RecurrentConfig, spec: RecurrentSpec, policy: RecurrentPolicy
) -> Controllers:
    """Return what a trained policy is compared with: itself untrained, and without its network.

    A network alone gives nothing in both cases, and stands there once.
    """
    if wanted.units == 0:
        return {}
    untrained = spec.build().eval().requires_grad_(False).double()
    found: Controllers = {f"{name} untrained": ("untrained", untrained)}
    if isinstance(policy, ObservedPolicy):
        found[f"{name} network off"] = ("network_off", policy.without_network())
    return found


def judge_all(
    controllers: Controllers, config: AutopilotSettings, stated: JudgedConditions
) -> tuple[list[dict[str, Any]], pd.DataFrame]:
    """Return the rows of metrics.json and the table of flights of all controllers."""
    vessel = in_weather(config, stated)
    tests = {"conditions": stated.stated}
    tests |= {f"beyond_{name}": conditions for name, conditions in stated.beyond.items()}
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
            vessel, policy.double(), stated.stated.dt, compiler=CompiledLoop, longest=longest
        )
        for protocol, (conditions, changes) in flown.items():
            row, table = judged(name, kind, protocol, run, conditions, changes)
            rows.append(row)
            tables.append(table)
        rows.append(swinging(name, kind, run, still, quiet_after(stated.stated.duration)))
    return rows, pd.concat(tables, ignore_index=True)


def completed(
    name: str,
    peer: AnyController,
    steering: Steering,
    config: AutopilotSettings,
    stated: JudgedConditions,
) -> tuple[AnyController, dict[str, Any]]:
    """Return a peer ready to fly, tuned where it lacks constants, and notes on it."""
    if not isinstance(peer, TunableConfig) or None not in peer.parameters().values():
        return peer, {"config": peer.model_dump(mode="json")}
    before = tuned_before(name, peer, config)
    found, notes = before or tuned_peer(name, peer, steering, config, stated)
    return type(peer).model_validate(found.model_dump()), notes
