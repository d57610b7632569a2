"""Task `simulate`: its logs are canonical, read by `inspect`, and fitted like measured ones."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tiny import TINY, call

from residnet.core.log import Log
from residnet.data.readers.canonical import CanonicalConfig
from residnet.data.simulated import SimulatedTrials, simulate
from residnet.tasks.registry import load_task

DATA: dict[str, Any] = copy.deepcopy(TINY["data"])
CONFIG = {"task": "simulate", "name": "trials", "data": DATA}


def written(folder: Path, content: dict[str, Any], name: str) -> Path:
    path = folder / name
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of the task."""
    folder = tmp_path_factory.mktemp("simulate")
    with pytest.MonkeyPatch.context() as patch:
        assert (
            call(patch, "run", written(folder, CONFIG, "trials.yaml"), "--out", folder / "run") == 0
        )
    return folder / "run"


def test_the_logs_are_those_of_the_programme(trials: Path) -> None:
    data = SimulatedTrials.model_validate(DATA)
    manoeuvres = data.draw()
    expected = {
        log.name: (split, log)
        for log, split in zip(simulate(manoeuvres, data), data.splits(manoeuvres), strict=True)
    }
    files = sorted((trials / "logs").rglob("*.parquet"))
    assert {path.stem for path in files} == set(expected)
    assert {path.parent.name for path in files} == {"train", "validation", "test"}
    for path in files:
        split, log = expected[path.stem]
        read = CanonicalConfig().build().read(path)
        assert (path.parent.name, read.manoeuvre, read.units) == (split, log.manoeuvre, log.units)
        np.testing.assert_array_equal(read.t, log.t)
        assert read.channels.keys() == log.channels.keys()
        for name in log.channels:
            np.testing.assert_array_equal(read[name], log[name])
        assert Log.recognises(path)


def test_the_folder_says_what_made_it(trials: Path) -> None:
    assert load_task(trials / "resolved.yaml", []).name == "trials"
    provenance = json.loads((trials / "provenance.json").read_text())
    assert (provenance["seed"], provenance["inputs"]) == (0, {})
    assert provenance["config"].endswith("trials.yaml")


def test_inspect_reads_them(
    trials: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = sorted((trials / "logs").rglob("three_two_one_one_*.parquet"))
    assert len(logs) == 3
    assert call(monkeypatch, "inspect", *logs) == 0
    text = capsys.readouterr().out
    assert all(
        f"{path.stem}: note: 10 channels, 300 samples, manoeuvre three_two_one_one" in text
        for path in logs
    )
    assert "coherence 1.000" in text


@pytest.mark.long
def test_a_fit_of_the_files_equals_a_fit_of_the_simulation(
    trials: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Baseline and ridge see the same numbers whether they are simulated or read back."""
    data = SimulatedTrials.model_validate(DATA)
    manoeuvres = data.draw()
    split: dict[str, Any] = {
        "root": str(trials / "logs"),
        "train": [],
        "validation": [],
        "test": [],
    }
    # in the order of the programme: the folds of a cross-validation follow the order of the logs
    for log, name in zip(simulate(manoeuvres, data), data.splits(manoeuvres), strict=True):
        split[name].append(f"{name}/{log.name}.parquet")
    measured = {"kind": "measured", "reader": {"kind": "canonical"}, "split": split}
    light = {
        "heads": {"ridge": {"kind": "ridge"}},
        "ensembles": {},
        "training": {},
        "export": {"models": []},
    }
    config = written(tmp_path, TINY | light | {"name": "files", "data": measured}, "files.yaml")
    assert call(monkeypatch, "run", config, "--out", tmp_path / "files") == 0
    found = []
    for run in (tiny_run, tmp_path / "files"):
        fit = json.loads((run / "models" / "baseline" / "fit.json").read_text())
        values: dict[tuple[str, ...], float] = {
            (entry["axis"], entry["term"]): entry["value"] for entry in fit["coefficients"]
        }
        for row in json.loads((run / "metrics.json").read_text())["rows"]:
            if row["model"] in ("zero", "baseline", "ridge"):
                values[row["model"], row["split"], row["protocol"], row["manoeuvre"]] = row[
                    "nrmse"
                ]["mean"]
        found.append(values)
    assert found[1] == pytest.approx(found[0], rel=1e-9)
    assert len(found[0]) > 40
    inputs = json.loads((tmp_path / "files" / "provenance.json").read_text())["inputs"]
    assert len(inputs) == len(manoeuvres)


def test_an_existing_folder_is_left_alone(
    trials: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(path.stat().st_mtime_ns for path in trials.rglob("*.parquet"))
    assert call(monkeypatch, "run", trials.parent / "trials.yaml", "--out", trials) == 2
    assert "exists already" in capsys.readouterr().err
    assert sorted(path.stat().st_mtime_ns for path in trials.rglob("*.parquet")) == before


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("data.duration=20 m", "does not measure [s]"),
        ("data.vessel=wam_w_cal", "did you mean 'wam_v_cal'"),
        ("data.trials.1.kind=zigzack", "did you mean 'zigzag'"),
        ("heads={}", "unknown key"),
    ],
)
def test_wrong_configs(
    trials: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    override: str,
    said: str,
) -> None:
    assert call(monkeypatch, "check", trials.parent / "trials.yaml", "-s", override) == 2
    text = capsys.readouterr().err.strip()
    assert said in text
    assert "\n" not in text
