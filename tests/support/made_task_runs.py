"""Tiny run folders of every task but the fit, with hand-made numbers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from made_run import write_json

from residnet.core.log import Log


def _resolved(run: Path, content: dict[str, Any]) -> None:
    run.mkdir(parents=True, exist_ok=True)
    (run / "resolved.yaml").write_text(yaml.safe_dump({"name": "made", **content}))


def _spread(mean: float) -> dict[str, float]:
    return {"mean": mean, "median": mean, "p95": 1.2 * mean, "max": 1.5 * mean}


def made_autopilot(run: Path) -> Path:
    """Two controllers of one vessel; the second does not settle in four flights."""
    _resolved(
        run,
        {
            "task": "autopilot",
            "rudder": math.radians(20),
            "test": {
                "heading": math.radians(30),
                "band": math.radians(1),
                "plants": 5,
                "bias": math.radians(1),
                "bias_time": 60.0,
                "overshoot": math.radians(0.1),
                "wind": 10.0,
                "sea": {
                    "significant_height": 1.5,
                    "peak_period": 8.0,
                    "direction": math.radians(45),
                    "spectrum": {"kind": "jonswap"},
                },
                "sea_time": 300.0,
            },
        },
    )
    rows = []
    for place, (model, kind) in enumerate({"net": "policy", "pd": "classical"}.items()):
        base = {"model": model, "kind": kind, "split": "simulated", "n": 5, "diverged": 0}
        for protocol in ("nominal", "corners", "random"):
            found = {
                "settling": _spread(10.0 + place),
                "overshoot": _spread(math.radians(0.2)),
                "iae": _spread(1.0),
                "travel": _spread(0.5),
                "energy": _spread(0.1),
                "unsettled": 4 * place if protocol == "random" else 0,
            }
            rows.append({**base, "protocol": protocol, **found})
        for protocol in ("bias", "wind"):
            rows.append({**base, "protocol": protocol, "error_end": math.radians(0.25)})
        sea = {f"{name}_rms": _spread(math.radians(2.0)) for name in ("heading", "rudder", "heel")}
        rows.append({**base, "protocol": "sea", **sea})
    write_json(run / "metrics.json", {"run": "made", "floor": "net", "rows": rows})
    write_json(run / "controllers.json", {"controllers": {"pd": {"kp": 1.0}}})
    t = np.arange(0.0, 20.0, 0.5)
    parts = [
        pd.DataFrame(
            {
                "controller": controller,
                "effect": effect,
                "time": time,
                "t": t,
                "psi": math.radians(30) * (1 - np.exp(-effect * t / time / 4)),
                "r": 0.1 * np.exp(-t / 4),
                "rudder": 0.2 * np.exp(-t / 4),
            }
        )
        for controller in ("net", "pd")
        for effect, time in ((1.0, 1.0), (0.8, 1.2))
    ]
    pd.concat(parts).to_parquet(run / "flights.parquet")
    random = np.random.default_rng(0)
    names = ("settling", "overshoot", "iae", "travel", "energy")
    plants = [
        pd.DataFrame({"controller": name, **{key: random.uniform(1, 2, 5) for key in names}})
        for name in ("net", "pd")
    ]
    pd.concat(plants).to_parquet(run / "plants.parquet")
    return run


def made_course(run: Path) -> Path:
    """One controller past two buoys under both protocols, with a spread of four flights."""
    buoys = [
        {"north": 100.0, "east": 0.0, "radius": 20.0, "leave_to": "port"},
        {"north": 100.0, "east": 100.0, "radius": 30.0, "leave_to": "starboard"},
    ]
    _resolved(
        run,
        {
            "task": "course",
            "protocols": ["enter", "sides"],
            "course": {"acceptance": 15.0, "buoys": buoys, "start": [0.0, 0.0]},
            "spread": {
                "flights": 4,
                "effect": [0.8, 1.2],
                "time": [0.8, 1.2],
                "bias": math.radians(1),
                "current": 0.5,
            },
        },
    )
    rows, flown, plans, spread = [], [], [], []
    t = np.arange(0.0, 60.0)
    for protocol in ("enter", "sides"):
        base = {"model": "net", "kind": "policy", "guidance": "course", "protocol": protocol}
        passed = {"entered": 2} if protocol == "enter" else {"right_side": 2, "clear": 1}
        rows.append(
            {
                **base,
                **passed,
                "split": "simulated",
                "finished": True,
                "course_time": 61.5,
                "reference_time": 60.0,
                "ratio": 1.025,
                "ratio_turning": 0.95,
                "margin": -0.5,
                "tightest_turn": 18.0,
                "cross_track_rms": 0.75,
                "cross_track_max": 2.0,
                "travel": math.radians(90),
                "n": 2,
            }
        )
        rows.append(
            {
                **base,
                "split": "spread",
                "n": 4,
                "passed": 0.75,
                "finished": 1.0,
                "ratio": 1.04,
                "ratio_worst": 1.2,
                "margin": 1.0,
                "margin_worst": -2.0,
                "cross_track_rms": 0.9,
                "reference_time": 60.0,
            }
        )
        place = {"north": 2 * t, "east": t, "protocol": protocol}
        plans.append(pd.DataFrame(place))
        motion = {"psi": 0.4 + 0 * t, "rudder": 0.1 * np.sin(t), "speed": 2 + 0 * t}
        flight = {"controller": "net", "guidance": "course", "t": t, "cross_track": np.sin(t)}
        flown.append(pd.DataFrame({**place, **flight, **motion}))
        found = {"ratio": [1.0, 1.1, 1.2, 1.3], "passed": [True, True, True, False]}
        spread.append(pd.DataFrame({**base, **found, "finished": True}))
    smallest = {"radius": 25.0, "speed": 1.5}
    feasibility = [
        {"buoy": 1, "radius": 20.0, "smallest": 25.0, "possible": False},
        {"buoy": 2, "radius": 30.0, "smallest": 25.0, "possible": True},
    ]
    write_json(
        run / "metrics.json",
        {
            "run": "made",
            "speed": 2.0,
            "rudder": math.radians(35),
            "smallest": smallest,
            "feasibility": feasibility,
            "rows": rows,
        },
    )
    for name, tables in (("tracks", flown), ("courses", plans), ("spread", spread)):
        pd.concat(tables).to_parquet(run / f"{name}.parquet")
    return run


def made_simulate(run: Path, logs: int = 2) -> Path:
    """Zigzags of a vessel and a model, and a flight that has no indices."""
    _resolved(run, {"task": "simulate"})
    rows = []
    for number in range(logs):
        for craft, overshoot in (("ship", 9.0), ("model", 11.0)):
            indices = {
                "first_overshoot": math.radians(overshoot),
                "initial_turning_distance": 8.0,
                "initial_turning_distance_lengths": 2.0,
            }
            limit = {"limit": math.radians(10), "kept": overshoot < 10}
            rows.append(
                {
                    "log": f"zigzag_{number + 1:02d}",
                    "manoeuvre": "zigzag",
                    "craft": craft,
                    "fault": "",
                    "timed_out": False,
                    "indices": indices,
                    "limits": {"first_overshoot": limit},
                }
            )
    steady = {"log": "constant_01", "manoeuvre": "constant", "indices": {}, "limits": {}}
    rows.append({**steady, "craft": "ship", "fault": "timed out after 60 s", "timed_out": True})
    units = {
        "first_overshoot": "rad",
        "initial_turning_distance": "m",
        "initial_turning_distance_lengths": "-",
    }
    write_json(run / "indices.json", {"run": "made", "length": 4.0, "units": units, "rows": rows})
    return run


def made_import(run: Path) -> Path:
    """Two recordings, one with a finding that needs a look."""
    _resolved(run, {"task": "import"})
    t = np.arange(0.0, 10.0, 0.1)
    (run / "logs").mkdir(parents=True)
    for name in ("first", "second"):
        u = np.where(t < 5, 1.0, math.nan)
        log = Log(name, t, {"u": u, "psi": 0.1 * t}, masks={"hard:gap": t > 9})
        log.save(run / "logs" / f"{name}.parquet")
    severe = {"level": "will mislead", "code": "gaps", "text": "a gap of -5 s"}
    note = {"level": "note", "code": "rate", "text": "the topic has 10 Hz"}
    write_json(run / "findings.json", {"first": [severe, note], "second": [note]})
    return run


def made_actuators(run: Path) -> Path:
    """A throttle map, a step response and thrust curves."""
    _resolved(run, {"task": "actuators"})

    def estimate(value: float, unit: str) -> dict[str, Any]:
        return {"value": value, "low": 0.9 * value, "high": 1.1 * value, "unit": unit}

    throttle = {name: estimate(40.0, "1/s") for name in ("slope", "offset", "n_max")}
    step = {"rate": estimate(20.0, "1/s^2"), "dead_time": estimate(0.25, "s")}
    curve = {"c0": estimate(0.02, "N s^2"), "low": 0.0, "high": 40.0, "rms": 1.5}
    found = {"throttle": {**throttle, "saturated": False}, "step": step}
    write_json(run / "actuators.json", found | {"forward": curve, "reverse": curve})
    (run / "actuators.yaml").write_text("n_max: 2400 rpm\n")
    return run


def made_study(run: Path) -> Path:
    """A recipe and a variant that is worse, under two protocols."""
    _resolved(run, {"task": "study"})
    rows = [
        {
            "variant": variant,
            "overrides": overrides,
            "protocol": protocol,
            "seeds": 3,
            "windows": 12,
            "nrmse_mean": 0.2 + shift,
            "nrmse_sd": 0.01,
            "nrmse_range": [0.19 + shift, 0.21 + shift],
            "difference": shift,
            "difference_ci95": [0.5 * shift, 1.5 * shift] if shift else None,
            "seconds": 12.0,
        }
        for variant, overrides, shift in (("recipe", [], 0.0), ("no_head", ["~heads"], 0.05))
        for protocol in ("T30", "manoeuvre")
    ]
    content = {"run": "made", "model": "plsr", "split": "test", "reference": "recipe"}
    write_json(run / "study.json", content | {"rows": rows})
    return run
