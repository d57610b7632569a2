"""Every task from Python gives the numbers of the command line, with no folder of its own."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import written_logs
import yaml
from tiny import SWEEP, TINY, call

import residnet
from residnet.core.config import load_mapping

STUDIES = Path(__file__).parents[2] / "configs" / "studies"
# what depends on the clock of the machine and on where the run stands
_PASSING = ("seconds", "exported", "run", "folder", "source", "started", "file", "versions")
_AUTOPILOT: dict[str, Any] = {
    "task": "autopilot",
    "name": "small",
    "vessel": "nomoto_oceanos",
    "rudder": "5 deg",
    "turning_time": "40 s",
    "test": {"dt": "0.1 s", "duration": "8 s", "plants": 1, "bias_time": "10 s"},
    "policies": {
        "policy": {
            "hidden": [6],
            "training": {
                "epochs": 1,
                "steps": 1,
                "batch": 16,
                "dt": "0.1 s",
                "horizon": "4 s",
                "learning_rate": 1e-3,
            },
        }
    },
    "peers": {"pd": {"kind": "pd"}, "bang_bang": {"kind": "bang_bang"}},
    "floor": "bang_bang",
    "tuning_points": 16,
}


def autopilot(folder: Path) -> dict[str, Any]:
    return _AUTOPILOT


def course(folder: Path) -> dict[str, Any]:
    (folder / "autopilot.yaml").write_text(yaml.safe_dump(_AUTOPILOT))
    return {
        "task": "course",
        "name": "bend",
        "autopilot": "autopilot.yaml",
        "course": {
            "buoys": [
                {"north": 50.0, "east": 30.0, "leave_to": "port", "radius": 10.0},
                {"north": 100.0, "east": 20.0, "leave_to": "starboard", "radius": 12.0},
            ],
            "acceptance": 4.0,
            "lookahead": 10.0,
            "planning_dt": "0.2 s",
        },
        "peers": [],
        "line_of_sight": [{"kind": "lookahead", "distance": 10.0}],
        "spread": {"flights": 2, "effect": [1.0, 1.0], "time": [1.0, 1.0]},
        "dt": "0.2 s",
        "duration": "42 s",
    }


def imported(folder: Path) -> dict[str, Any]:
    written_logs.topics(written_logs.trial(10.0), folder).rename(folder / "rec_a")
    return {
        "task": "import",
        "name": "trials",
        "root": str(folder),
        "logs": ["rec_*"],
        "reader": {"kind": "auto"},
    }


def actuators(folder: Path) -> dict[str, Any]:
    throttle = np.arange(-100, 101, 5)
    rpm = np.clip(28 * throttle, -2380, 2380) + 3 * np.sin(throttle)
    pd.DataFrame({"throttle": throttle, "rpm": rpm}).to_csv(folder / "throttle.csv", index=False)
    return {
        "task": "actuators",
        "name": "thrusters",
        "throttle": {
            "files": ["throttle.csv"],
            "throttle": {"column": "throttle", "unit": "%"},
            "n": {"column": "rpm", "unit": "rpm"},
        },
    }


def ferry(folder: Path) -> dict[str, Any]:
    content = load_mapping(STUDIES / "jervan2020" / "noise.yaml")
    content["course"] |= {"interval": "12 s", "waypoints": content["course"]["waypoints"][:6]}
    content["models"] = dict(list(content["models"].items())[:1])
    return content


def study(folder: Path) -> dict[str, Any]:
    trials = [
        {"kind": "constant", "drive": [0.4, 0.9], "steer": [-0.4, 0.0, 0.4]},
        {"kind": "zigzag", "count": 4, "heading": ["20 deg"], "start": 3},
        {"kind": "acceleration_deceleration", "count": 2},
    ]
    counts = {"zigzag": 3, "acceleration_deceleration": 1}
    kept = {"zigzag": 1, "acceleration_deceleration": 0}
    data = {**TINY["data"], "trials": trials, "identification": counts, "validation": kept}
    (folder / "tiny.yaml").write_text(yaml.safe_dump({**TINY, "data": data}, sort_keys=False))
    return {
        "task": "study",
        "name": "tiny_study",
        "base": "tiny.yaml",
        "common": [
            "heads={ridge: {kind: ridge, folds: 2}}",
            "training={}",
            "ensembles={}",
            "export.models=[]",
        ],
        "variants": {"recipe": [], "short": ["heads.ridge.degree=1"]},
        "reference": "recipe",
        "model": "ridge",
        "seeds": [0],
    }


def breeding(folder: Path) -> dict[str, Any]:
    pytest.importorskip("deap", reason="genetic programming needs the extra gp")
    return {
        "task": "breeding",
        "name": "small",
        "head": {
            "kind": "genetic",
            "final": None,
            "evolution": {"operators": ["+", "*", "abs"], "split": "sum", "generations": 3},
        },
        "rows": {"key": "head.evolution.population", "values": [10, 30]},
        "columns": {"key": "noise.factor", "values": [0.0, 0.5]},
        "repeats": 1,
    }


def sea_trial(folder: Path) -> dict[str, Any]:
    content = load_mapping(STUDIES / "halvorsen2019" / "standard_model.yaml")
    calm = content["trials"]["calm"]
    calm["programme"] = {
        "drives": [0.35, 0.5],
        "steers": [0.3],
        "zigzag": 60,
        "hold": 20,
        "courses": [0],
    }
    calm["preparation"]["validate_every"] = 2
    content["trials"] = {"calm": calm}
    content["standard"]["starts"] = 1
    content.pop("published")
    return content


def sweep(folder: Path) -> dict[str, Any]:
    (folder / "tiny.yaml").write_text(yaml.safe_dump(TINY, sort_keys=False))
    return SWEEP


TASKS: dict[str, Callable[[Path], dict[str, Any]]] = {
    "sweep": sweep,
    "autopilot": autopilot,
    "course": course,
    "import": imported,
    "actuators": actuators,
    "ferry_study": ferry,
    "study": study,
    "breeding": breeding,
    "sea_trial": sea_trial,
}


def numbers(value: Any, at: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a JSON document with the keys that lead to it."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not any(key.startswith(word) for word in _PASSING):
                yield from numbers(item, f"{at}.{key}")
    elif isinstance(value, list):
        for place, item in enumerate(value):
            yield from numbers(item, f"{at}.{place}")
    else:
        yield at, value


def contents(folder: Path) -> dict[str, dict[str, Any]]:
    """Results of a run by file: what its JSON documents and tables hold."""
    out: dict[str, dict[str, Any]] = {}
    for file in sorted(folder.rglob("*.json")):
        if file.name != "provenance.json":
            out[str(file.relative_to(folder))] = dict(numbers(json.loads(file.read_text())))
    for file in sorted(folder.rglob("*.parquet")):
        table = pd.read_parquet(file)
        out[str(file.relative_to(folder))] = {
            f"{name}.{i}": value for name in table for i, value in enumerate(table[name])
        }
    return out


def assert_equal(found: dict[str, Any], expected: dict[str, Any], where: str) -> None:
    assert found.keys() == expected.keys(), where
    for key, value in expected.items():
        if isinstance(value, float) and not math.isnan(value):
            assert math.isclose(found[key], value, rel_tol=1e-9, abs_tol=1e-12), f"{where} {key}"
        elif not isinstance(value, float):
            assert found[key] == value, f"{where} {key}"


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
def test_python_and_command_line_are_one(
    task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if task == "import":
        pytest.importorskip("rosbags")
    if task == "sweep":
        pytest.importorskip("optuna")
    config = TASKS[task](tmp_path)
    assert config["task"] == task
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    assert call(monkeypatch, "run", "config.yaml", "--out", "by_command") == 0
    heard: list[residnet.Progress] = []
    if task == "autopilot":
        settings = {key: value for key, value in config.items() if key != "task"}
        result = residnet.autopilot(**settings, progress=heard.append)
        assert {"policy", "pd", "bang_bang"} <= set(result.metrics["model"])
    else:
        result = residnet.run(config, progress=heard.append)
    assert result.summary["task"] == task
    assert result.summary["finished"]
    assert "report.html" in result.files
    expected, found = contents(tmp_path / "by_command"), contents(result.folder)
    assert found.keys() == expected.keys()
    assert len(expected) > 1
    for file, values in expected.items():
        assert_equal(found[file], values, file)


def test_a_run_without_a_folder_leaves_nothing_behind() -> None:
    """Its files last as long as the result."""
    flown = {"vessel": "wam_v_cal", "manoeuvres": [{"kind": "constant", "drive": 0.5, "steer": 0}]}
    config = {"task": "simulate", "name": "gone", "programme": {**flown, "duration": 5}}
    result = residnet.run(config)
    folder = result.folder
    assert (folder / "summary.json").is_file()
    del result
    assert not folder.exists()


def test_every_task_is_compared() -> None:
    """`fit` and `simulate` are compared with the functions of `api` too, in test_api.py."""
    names = set(residnet.available("tasks")["name"])
    # the measured ferry needs data that are not part of a checkout
    assert names - set(TASKS) == {"fit", "simulate", "force_residual"}
