"""Task `simulate`: a vessel, a learned model, or both; trials for a fit to read back."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from read_page import plain
from tiny import TINY, Command, call, read_json, write_yaml

from residnet.core.log import Log
from residnet.core.progress import on_progress
from residnet.io.readers.base import CanonicalConfig
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.tasks.registry import load_task

STEP = 0.1
PATTERN = {"kind": "three_two_one_one", "drive": 0.5, "steer": 0.6, "unit": 2, "duration": 25}
ZIGZAG = {"kind": "zigzag", "drive": 0.6, "steer": 0.4, "heading": "15 deg", "start": 10}
CIRCLE = {"kind": "turning_circle", "name": "circle", "drive": 0.6, "steer": 1.0, "start": 10}
VESSEL: dict[str, Any] = {
    "vessel": "wam_v_cal",
    "duration": 60,
    "step": STEP,
    "substeps": 1,
    "noise": {"u": 0, "v": 0, "r": 0},
    "manoeuvres": [ZIGZAG | {"reversals": 4}, CIRCLE, PATTERN],
    "families": [{"kind": "random_steps", "count": 1}],
}


def of(folder: Path, **content: Any) -> Path:
    """Write the config beside the folder of its run."""
    return write_yaml(folder.with_suffix(".yaml"), {"task": "simulate", "name": "ship", **content})


def logs_of(run: Path) -> dict[str, Log]:
    """Logs by their folder and name."""
    files = sorted(run.rglob("*.parquet"))
    return {
        f"{file.parent.name}/{file.stem}": CanonicalConfig().build().read(file) for file in files
    }


def flown(folder: Path, **content: Any) -> dict[str, Log]:
    """The logs of a run without a report."""
    file = of(folder, **content)
    load_task(file).run(source=file, output_folder=folder, report=False)
    return logs_of(folder)


def indices(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    rows = read_json(folder / "indices.json")["rows"]
    return {(row["craft"], row["log"]): row for row in rows}


@pytest.fixture(scope="module")
def ship(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("programme") / "run"
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", of(folder, programme=VESSEL), "--out", folder) == 0
    return folder


def test_a_vessel_leaves_logs_indices_and_figures(ship: Path) -> None:
    logs = {path.stem: Log.load(path) for path in (ship / "logs").glob("*.parquet")}
    assert set(logs) == {"zigzag_01", "circle", "three_two_one_one_01", "random_steps_01"}
    assert logs["three_two_one_one_01"].t[-1] == pytest.approx(25 - STEP)
    assert logs["random_steps_01"].t[-1] == pytest.approx(60 - STEP)
    # the circle ends at the first sample at which the heading has changed by 540 deg
    psi = logs["circle"]["psi"]
    assert psi[-1] >= 3 * math.pi > psi[-2]
    zigzag = logs["zigzag_01"]
    steer = np.sign(zigzag["cmd_port"] - zigzag["cmd_stbd"])
    assert (np.diff(steer[zigzag.t > 10]) != 0).sum() == 4
    assert zigzag["psi"][-1] >= 0 > zigzag["psi"][-2]
    content = read_json(ship / "indices.json")
    assert (content["schema"], content["length"]) == ("residnet.indices/1", 4.88)
    assert content["units"]["first_overshoot"] == "rad"
    # the peak lies between samples
    peak = float(zigzag["psi"][zigzag.t < 16].max())
    found = indices(ship)["wam_v_cal", "zigzag_01"]["indices"]
    assert found["first_overshoot"] == pytest.approx(peak - math.radians(15), abs=1e-3)
    circle = indices(ship)["wam_v_cal", "circle"]
    assert circle["limits"]["advance"]["limit"] == pytest.approx(4.5 * 4.88)
    assert circle["limits"]["advance"]["kept"]
    advance = circle["indices"]["advance"]
    assert circle["indices"]["advance_lengths"] == pytest.approx(advance / 4.88)
    assert not any(row["timed_out"] for row in content["rows"])
    figures = list((ship / "figures").glob("*.png"))
    assert len(figures) == len(logs)
    for path in figures:
        with Image.open(path) as picture:
            assert min(picture.size) > 600
            assert picture.info["Title"]
    assert "first overshoot" in plain(ship / "report.html")


@pytest.mark.long
def test_a_model_flies_beside_its_vessel_and_alone(tiny_run: Path, tmp_path: Path) -> None:
    """The model of the tiny fit is no good one; here it only has to fly by itself, and both ways
    the same; with given inputs, without a vessel, they follow within their rate.
    """
    model: dict[str, Any] = {"run": str(tiny_run), "name": "ridge"}
    programme = VESSEL | {"manoeuvres": [PATTERN], "step": None, "duration": 20, "model": model}
    both = flown(tmp_path / "both", programme=programme)
    programme |= {"vessel": None, "model": {**model, "actuators": "wam_v_cal"}}
    alone = flown(tmp_path / "alone", programme=programme)
    names = {name.removeprefix("logs/") for name in alone}
    assert names == {"three_two_one_one_01", "random_steps_01"}
    assert set(both) == {f"{place}/{name}" for place in ("logs", "model_logs") for name in names}
    for name in names:
        log = both[f"model_logs/{name}"]
        other = alone[f"logs/{name}"]
        true = both[f"logs/{name}"]
        for channel in log.channels:
            np.testing.assert_array_equal(log[channel], other[channel])
        np.testing.assert_array_equal(log["cmd_port"], true["cmd_port"])
        np.testing.assert_allclose(log["n_port"], true["n_port"], atol=1e-9)
        assert 0 < np.abs(log["u"] - true["u"]).max() < 0.5
    # the model has no input for wave loads: its motion is the same, and a message says so
    hull = {"length": 4.9, "breadth": 1.0, "draught": 0.2}
    waves = {"significant_height": 0.3, "peak_period": 3.0, "direction": "90 deg", "hull": hull}
    messages: list[str] = []
    with on_progress(lambda progress: messages.append(progress.message)):
        rough = flown(tmp_path / "rough", programme=programme | {"disturbance": {"waves": waves}})
    for name, log in rough.items():
        np.testing.assert_array_equal(log["r"], alone[name]["r"])
    assert any("'ridge' has no input for wave loads" in message for message in messages)
    inputs = read_json(tmp_path / "both" / "provenance.json")["inputs"]
    assert {Path(path).name for path in inputs} == {"model.json", "model.safetensors"}
    share = {"drive": "2380 rpm", "limit": "2380 rpm", "rate": "600 rpm/s"}
    sides = {"n_port": share | {"steer": "2380 rpm"}, "n_stbd": share | {"steer": "-2380 rpm"}}
    given = {"model": {"run": str(tiny_run), "inputs": sides}, "duration": 20, "length": 4.88}
    given |= {"noise": VESSEL["noise"], "manoeuvres": [ZIGZAG | {"drive": 0.5, "steer": 0.3}]}
    log = flown(tmp_path / "given", programme=given)["logs/zigzag_01"]
    assert np.abs(np.diff(log["n_port"])).max() == pytest.approx(10 * STEP, rel=1e-9)
    assert log["cmd_n_port"].max() == pytest.approx(0.8 * 2380 / 60)


@pytest.mark.long
def test_a_manoeuvre_that_never_ends_is_an_error_where_it_is_listed(
    tmp_path: Path, command: Command
) -> None:
    """Its log says it too; of those that are drawn it is a line."""
    lazy = ZIGZAG | {"steer": 0.0, "heading": "20 deg", "reversals": 2, "duration": 8}
    run = tmp_path / "run"
    programme = VESSEL | {"manoeuvres": [lazy, PATTERN]}
    said = command("run", of(run, programme=programme), "--out", run)
    assert said.code == 1
    [error] = [line for line in said.err.splitlines() if line.startswith("residnet:")]
    assert "zigzag_01: timed out after 7.9 s before 2 reversals at 20 deg" in error
    assert "(1 of 3 runs were not completed" in error
    logs = logs_of(run)
    assert logs["logs/zigzag_01"].meta["timed_out"] is True
    assert "timed_out" not in logs["logs/three_two_one_one_01"].meta
    assert indices(run)["wam_v_cal", "zigzag_01"]["timed_out"]
    family = [{"kind": "turning_circle", "count": 1, "steer": [0.01, 0.02]}]
    drawn = VESSEL | {"manoeuvres": [], "families": family, "duration": 10}
    said = command("run", of(run, programme=drawn), "--out", tmp_path / "drawn")
    assert said.code == 0
    assert "turning_circle_01: timed out" in said.err


def test_a_replay_gives_the_log_again(ship: Path, tmp_path: Path) -> None:
    """The same vessel from the recorded start with the recorded commands: the recorded motion."""
    names = ("random_steps_01", "circle")
    replay = [{"kind": "replay", "log": str(ship / "logs" / f"{name}.parquet")} for name in names]
    logs = flown(tmp_path / "run", programme=VESSEL | {"manoeuvres": replay, "families": []})
    for name, source in zip(("replay_01", "replay_02"), names, strict=True):
        mine = logs[f"logs/{name}"]
        log = Log.load(ship / "logs" / f"{source}.parquet")
        assert len(log) - len(mine) in (0, 1)
        for channel in log.channels:
            np.testing.assert_allclose(mine[channel], log[channel][: len(mine)], atol=1e-9)
        assert indices(tmp_path / "run")["wam_v_cal", name]["indices"]["rmse_u"] < 1e-9


# 4 s; test_a_vessel_leaves_logs_indices_and_figures simulates, too
@pytest.mark.long
def test_trials_are_drawn_split_and_read_by_inspect(tmp_path: Path, command: Command) -> None:
    trials = [{**TINY["data"]["trials"][0], "drive": [0.4]}, TINY["data"]["trials"][3]]
    counts = {"identification": {"three_two_one_one": 2}, "validation": {"constant": 2}}
    settings = {**TINY["data"], "duration": 6, "trials": trials, **counts}
    logs = flown(tmp_path / "run", data=settings)
    data = SimulatedTrials.model_validate(settings)
    found = zip(
        simulate_trial_logs(data.draw_manoeuvres(), data),
        data.assign_splits(data.draw_manoeuvres()),
        strict=True,
    )
    expected = {f"{split}/{log.name}": log for log, split in found}
    assert logs.keys() == expected.keys()
    for name, log in expected.items():
        assert (logs[name].manoeuvre, logs[name].units) == (log.manoeuvre, log.units)
        np.testing.assert_array_equal(logs[name].t, log.t)
        assert logs[name].channels.keys() == log.channels.keys()
        for channel in log.channels:
            np.testing.assert_array_equal(logs[name][channel], log[channel])
    provenance = read_json(tmp_path / "run" / "provenance.json")
    assert (provenance["seed"], provenance["inputs"]) == (0, {})
    assert provenance["config"].endswith("run.yaml")
    files = sorted((tmp_path / "run" / "logs").rglob("three_two_one_one_*.parquet"))
    assert len(files) == 3
    said = command("inspect", *files)
    assert said.code in (0, 1)
    told = "note: 10 channels, 60 samples, manoeuvre three_two_one_one"
    assert all(f"{path.stem}: {told}" in said.out for path in files)
