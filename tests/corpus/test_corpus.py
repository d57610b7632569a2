"""Layouts as recorders write them, a folder each, and what residnet makes of them.

A case is a folder with two trips of the truth in some layout and a `case.yaml`: `channels` with the
largest error (SI) of nine samples in ten, null where the truth lacks it; `told`, patterns that
`inspect` must say, `never`, which nobody may; `misled`, whether it warns, null where either will
do; `drafted`, patterns that `new` must say, or `refused`, how it ends; `answers`, what the user
says to `new`, key of the reader -> answer, after which it does not refuse; `truth`, log -> trip and
its first second. Where only the channels stand, only they are looked at. `make.py` makes the truth,
and what the sensors of a new case say.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml

import residnet
from residnet.api import data as api_data
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.io.drafting.questions import READER_KEY, Key
from residnet.io.drafting.reading import DraftResult, read_mixed_formats
from residnet.tasks import inspection
from residnet.tasks.drafting import write_new_config
from residnet.tasks.inspection import inspect_logs
from residnet.tasks.registry import load_task, open_finished_task

HERE = Path(__file__).parent
FOLDERS = sorted(path.parent.name for path in HERE.glob("*/case.yaml"))
TRUTH = {trip: pd.read_csv(HERE / f"truth_{trip}.csv") for trip in (1, 2)}


def case_in(name: str, folder: Path) -> tuple[dict[str, Any], Path]:
    """Return a case, and its logs alone in a folder of their own."""
    case = yaml.safe_load((HERE / name / "case.yaml").read_text())
    return case, shutil.copytree(HERE / name, folder / name, ignore=lambda *_: ["case.yaml"])


def error_of(log: Log, channel: str, trip: int, start: float) -> float:
    """Return how far nine in ten samples of a channel are from the truth, at most."""
    true = TRUTH[trip]
    known = np.isfinite(log[channel])
    at = log.t[known] - log.t[0] + start
    apart = log[channel][known] - np.interp(at, true.t, true[channel])
    if channel == "psi":
        apart -= 2.0 * np.pi * np.round(np.median(apart) / (2.0 * np.pi))
    # positions may count from the first fix
    apart -= np.median(apart) * (channel in "xy")
    return float(np.quantile(np.abs(apart), 0.9))


def drafted(case: dict[str, Any], folder: Path, config: Path) -> str:
    """Return what `new` says, after the words that it must end with."""
    if "refused" in case:
        with pytest.raises(ResidnetError, match=case["refused"]) as refused:
            write_new_config([folder], config, None, overwrite=False)
        assert "\n" not in str(refused.value)
        if "answers" not in case:
            return ""
    told = write_new_config([folder], config, None, overwrite=False, answers=answers_of(case))
    load_task(config, []).check()
    return "\n".join([*told, config.read_text()])


def answers_of(case: dict[str, Any]) -> dict[Key, str]:
    """Return the answers of a user, by keys of the config."""
    return {(*READER_KEY, *key.split(".")): text for key, text in case.get("answers", {}).items()}


@pytest.fixture
def read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read files for the second reader, `residnet.read_logs`, as `inspect` has read them.

    Both make the same call of the same function, which takes a third of the time of a layout.
    """
    results = dict[tuple[Path, ...], list[DraftResult]]()

    def read(paths: Sequence[Path], answers: Mapping[Key, str] | None = None) -> list[DraftResult]:
        assert not answers
        key = tuple(paths)
        if key not in results:
            results[key] = read_mixed_formats(paths)
        return results[key]

    for module in (inspection, api_data):
        monkeypatch.setattr(module, "read_mixed_formats", read)


@pytest.mark.usefixtures("omit_currents", "read_once")
@pytest.mark.parametrize("name", FOLDERS)
def test_read_logs_of_a_layout_equals_its_truth(name: str, tmp_path: Path) -> None:
    case, folder = case_in(name, tmp_path)
    said = {"told": "", "drafted": ""}
    if {"drafted", "refused"} & {*case}:
        said["drafted"] = drafted(case, folder, tmp_path / "boat.yaml")
    if not case["channels"]:
        return
    if {"told", "never", "misled"} & {*case}:
        found = inspect_logs([folder], None)
        assert case.get("misled", False) in (None, found.has_problems), found.text
        said["told"] = found.text
    text = {door: re.sub(r"\s*\n\s*#?\s*", " ", words) for door, words in said.items()}
    for door in text:
        assert [
            pattern for pattern in case.get(door, ()) if not re.search(pattern, text[door])
        ] == []
    assert [
        word for word in case.get("never", ()) if re.search(word, " ".join(text.values()))
    ] == []
    if "answers" in case:
        reader: Any = load_task(tmp_path / "boat.yaml", [])
        logs = [reader.data.reader.build().read(path) for path in sorted(folder.iterdir())]
    else:
        logs = residnet.read_logs(folder)
    assert logs
    for log in logs:
        assert set(log.channels) == set(case["channels"])
        trip, start = case.get("truth", {}).get(log.name) or (int(log.name[-1]), 0.0)
        for channel, most in case["channels"].items():
            assert most is None or error_of(log, channel, trip, start) <= most, (log.name, channel)


@pytest.mark.long
@pytest.mark.parametrize("name", FOLDERS)
def test_fit_and_evaluation_of_a_layout_are_finite(name: str, tmp_path: Path) -> None:
    case, folder = case_in(name, tmp_path)
    if "refused" in case and "answers" not in case:
        pytest.skip("cannot be fitted, as the test of its doors says")
    config = tmp_path / "boat.yaml"
    write_new_config([folder], config, None, overwrite=False, answers=answers_of(case))
    run = tmp_path / "run"
    load_task(config, ["effort=0.02"]).run(output_folder=run)
    ended, task = open_finished_task(run, "evaluate")
    task.evaluate_on_logs(ended, [folder], tmp_path / "other")
    for place in (run, tmp_path / "other"):
        rows = json.loads((place / "metrics.json").read_text())["rows"]
        assert rows
        assert all(np.isfinite(row["nrmse"]["mean"]) for row in rows)
