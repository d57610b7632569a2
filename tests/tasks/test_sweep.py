"""Task `sweep`: every run of many is kept, and a kill changes nothing."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import pytest
import yaml
from read_page import plain
from tiny import SWEEP, TINY, VARIANTS, Command, read_json, write_yaml

from residnet.core.config import load_config
from residnet.core.processes import IsolatedProcessPool
from residnet.core.progress import Progress
from residnet.tasks.sweep import execute as running
from residnet.tasks.sweep.config import SweepConfig
from residnet.tasks.sweep.execute import TrialQueue, make_pruning_callback, open_optuna_study

optuna = pytest.importorskip("optuna")

WINDOW = "prepare.derivative.window"
FALLING = "space={heads.ridge.penalty: {low: 1e-6, high: 1.0, log: true}}"


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    write_yaml(tmp_path / "tiny.yaml", TINY)
    return write_yaml(tmp_path / "sweep.yaml", SWEEP)


def _values(out: Path) -> list[tuple[Any, Any]]:
    return [(row["values"], row["value"]) for row in read_json(out / "sweep.json")["trials"]]


def _error(run: Path, split: str, protocol: str) -> float:
    """The error of `ridge` over all manoeuvres."""
    wanted = ("ridge", split, protocol, "all")
    (found,) = (
        row["nrmse"]["mean"]
        for row in read_json(run / "metrics.json")["rows"]
        if (row["model"], row["split"], row["protocol"], row["manoeuvre"]) == wanted
    )
    return float(found)


# 7 s; .ci/run carries out a sweep
@pytest.mark.long
def test_a_grid_is_searched_whole_and_resumed(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    out = tmp_path / "out"
    real = running.run_sweep_trial
    begun = []

    def killed(*words: Any) -> Any:
        begun.append(words[3])
        if len(begun) == 2:
            raise KeyboardInterrupt
        return real(*words)

    monkeypatch.setattr(running, "run_sweep_trial", killed)
    space = {**SWEEP["space"], WINDOW: {"choices": [0.9]}}
    words = ["run", sweep, "--out", out, "-s", f"space={json.dumps(space)}"]
    assert command(*words).code == 130
    assert command(*words, "--resume").code == 0
    assert begun == [0, 1, 1], "the trial without an end goes on, the finished one is kept"

    content = read_json(out / "sweep.json")
    assert [row["state"] for row in content["trials"]] == ["finished"] * 2
    drawn = [tuple(row["values"].values()) for row in content["trials"]]
    assert drawn == [(1, 0.9), (2, 0.9)]
    for row in content["trials"]:
        run = out / "trials" / f"{row['number']:05d}"
        assert row["value"] == _error(run, "validation", "manoeuvre")
        resolved = yaml.safe_load((run / "resolved.yaml").read_text())
        assert resolved["heads"]["ridge"]["degree"] == row["values"]["heads.ridge.degree"]
    best = min(content["trials"], key=lambda row: row["value"])
    assert content["best"] == best["number"]
    written = yaml.safe_load((out / "best.yaml").read_text())
    assert written["heads"]["ridge"]["degree"] == best["values"]["heads.ridge.degree"]
    assert command("check", out / "best.yaml").code == 0
    names = {path.name for path in (out / "figures").glob("*.png")}
    assert {"01_slices.png", "02_course.png"} <= names
    assert "heads.ridge.degree" in (out / "report.html").read_text()


def test_values_of_a_random_search_hang_on_its_seed_alone(sweep: Path, tmp_path: Path) -> None:
    found = []
    for number, seed in enumerate((3, 3, 4)):
        search = f"search={{kind: random, trials: 30, seed: {seed}}}"
        config = load_config(sweep, [FALLING, search], SweepConfig)
        (folder := tmp_path / str(number)).mkdir()
        drawn: list[Any] = []
        # what a resumed sweep draws goes on as the undisturbed one does
        for stop in (7, 20, 30):
            trials = TrialQueue(config, open_optuna_study(config, folder))
            while len(drawn) < stop and (trial := trials.start_next()):
                drawn.append(trial.params["heads.ridge.penalty"])
                trials.study.tell(trial.number, 1.0)
        assert trials.start_next() is None
        assert len(drawn) == 30
        assert all(1e-6 <= value <= 1.0 for value in drawn)
        # evenly in the logarithm
        assert 8 <= sum(value < 1e-3 for value in drawn) <= 22
        found.append(drawn)
    assert found[0] == found[1] != found[2]


def test_a_poor_trial_is_ended_early(sweep: Path, tmp_path: Path) -> None:
    words = ["pruning={startup: 3}", "search={kind: random, trials: 5}"]
    config = load_config(sweep, words, SweepConfig)
    trials = TrialQueue(config, open_optuna_study(config, tmp_path))

    def heard(number: int) -> Any:
        trial: Any = trials.start_next()
        assert trial.number == number
        return make_pruning_callback(config, tmp_path, trial._trial_id)

    for number, level in enumerate((1.0, 2.0, 3.0)):
        told = heard(number)
        for epoch in (1, 2):
            told(Progress("training ridge", epoch, 2, score=level / epoch))
        trials.study.tell(number, level)
    good = heard(3)
    poor = heard(4)
    good(Progress("training ridge", 1, 2, score=1.5))
    good(Progress("training other", 1, 2, score=9.0))
    with pytest.raises(optuna.TrialPruned):
        poor(Progress("training ridge", 1, 2, score=2.5))


def _children(parent: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def _alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.long
def test_processes_end_with_a_killed_sweep_and_the_rest_follows(
    sweep: Path, tmp_path: Path
) -> None:
    words = [sys.executable, "-m", "residnet.cli", "run", str(sweep), "--out", "out"]
    words += ["-s", "runner.workers=2"]
    begun = subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 300
    while not list(tmp_path.glob("out/trials/*/resolved.yaml")) and time.monotonic() < until:
        time.sleep(0.1)
    workers = _children(begun.pid)
    assert workers
    os.kill(begun.pid, signal.SIGKILL)
    begun.wait()
    until = time.monotonic() + 20
    while (alive := [one for one in workers if _alive(one)]) and time.monotonic() < until:
        time.sleep(0.1)
    assert not alive
    subprocess.run([*words, "--resume"], cwd=tmp_path, check=True, capture_output=True)
    undisturbed = [*words[:6], "calm", *words[7:]]
    subprocess.run(undisturbed, cwd=tmp_path, check=True, capture_output=True)
    assert _values(tmp_path / "out") == _values(tmp_path / "calm")


def test_a_lost_process_costs_its_own_trial_alone(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    begun: list[int] = []

    def lost(*words: Any) -> Any:
        begun.append(words[3])
        if words[3] == 1 or begun == [0]:
            raise BrokenProcessPool("a process ended")
        return running.TrialResult(float(words[3]), False, "", 0.0)

    monkeypatch.setattr(running, "run_sweep_trial", lost)
    space = {**SWEEP["space"], WINDOW: {"choices": [0.9, 1.1, 1.3]}}
    words = ["run", sweep, "--out", tmp_path / "out", "-s", f"space={json.dumps(space)}"]
    assert command(*words, "-s", "runner.workers=1").code == 0
    rows = read_json(tmp_path / "out" / "sweep.json")["trials"]
    assert [begun.count(row["number"]) for row in rows] == [2, 3, *[1] * (len(rows) - 2)]
    assert [row["number"] for row in rows if row["state"] == "failed"] == [1]
    assert "lost 3 times" in rows[1]["fault"]


def test_a_process_that_is_killed_is_replaced() -> None:
    with IsolatedProcessPool(1) as pool:
        with pytest.raises(BrokenProcessPool):
            pool.submit(os._exit, 1).result()
        assert pool.submit(abs, -2).result() == 2


@pytest.mark.long
def test_the_same_sweep_runs_through_ray(sweep: Path, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("ray")
    runner = "runner={kind: ray, workers: 2}"
    assert command("run", sweep, "--out", tmp_path / "ray", "-s", runner).code == 0
    assert command("run", sweep, "--out", tmp_path / "own").code == 0
    assert _values(tmp_path / "ray") == _values(tmp_path / "own")


@pytest.mark.long
def test_all_variants_and_seeds_stand_in_one_table(
    sweep: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "out"
    file = write_yaml(tmp_path / "variants.yaml", VARIANTS)
    assert command("run", file, "--out", out).code == 0
    rows = read_json(out / "variants.json")["rows"]
    assert {(row["variant"], row["protocol"]) for row in rows} == {
        (v, p) for v in VARIANTS["search"]["variants"] for p in ("manoeuvre", "T10")
    }
    for row in rows:
        runs = [out / "variants" / f"{row['variant']}.{seed}" for seed in (0, 1)]
        found = [_error(run, "test", row["protocol"]) for run in runs]
        assert row["nrmse_mean"] == pytest.approx(sum(found) / 2, rel=1e-6)
    assert "short" in plain(out / "report.html")
    assert (out / "figures" / "01_variants.png").stat().st_size > 1000
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("variants/*/metrics.json")}
    assert len(stamps) == 4
    (out / "variants" / "short.1" / "summary.json").unlink()
    assert command("run", file, "--out", out, "--resume").code == 0
    again = {path: path.stat().st_mtime_ns for path in stamps}
    changed = {path.parent.name for path in again if again[path] != stamps[path]}
    assert changed == {"short.1"}, "finished runs are kept"
