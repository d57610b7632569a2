"""Task `sweep`: every trial is kept, a kill changes nothing, wrong spaces are one line."""

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
from tiny import SWEEP, TINY, call

from residnet.core.processes import ApartProcesses

pytest.importorskip("optuna")

WINDOW = "prepare.derivative.window"


@pytest.fixture
def sweep(tmp_path: Path) -> Path:
    (tmp_path / "tiny.yaml").write_text(yaml.safe_dump(TINY, sort_keys=False))
    path = tmp_path / "sweep.yaml"
    path.write_text(yaml.safe_dump(SWEEP, sort_keys=False))
    return path


def _read(out: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((out / "sweep.json").read_text())
    return content


def _values(out: Path) -> list[tuple[Any, Any]]:
    return [(row["values"], row["value"]) for row in _read(out)["trials"]]


def test_a_grid_is_searched_whole_and_resumed(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from residnet.tasks import sweep as running

    out = tmp_path / "out"
    real, begun = running.carry_out_trial, []

    def killed(*words: Any) -> Any:
        begun.append(words[3])
        if len(begun) == 2:
            raise KeyboardInterrupt
        return real(*words)

    monkeypatch.setattr(running, "carry_out_trial", killed)
    words = ["run", sweep, "--out", out]
    space = {**SWEEP["space"], WINDOW: {"choices": [0.9]}}
    words += ["-s", f"space={json.dumps(space)}"]
    assert call(monkeypatch, *words) == 130
    assert call(monkeypatch, *words, "--resume") == 0
    assert begun == [0, 1, 1], "the trial without an end goes on, the finished one is kept"

    content = _read(out)
    assert [row["state"] for row in content["trials"]] == ["finished"] * 2
    drawn = [tuple(row["values"].values()) for row in content["trials"]]
    assert drawn == [(1, 0.9), (2, 0.9)]
    for row in content["trials"]:
        run = out / "trials" / f"{row['number']:05d}"
        rows = json.loads((run / "metrics.json").read_text())["rows"]
        (error,) = (
            one["nrmse"]["mean"]
            for one in rows
            if (one["model"], one["split"], one["protocol"], one["manoeuvre"])
            == ("ridge", "validation", "manoeuvre", "all")
        )
        assert row["value"] == error
        resolved = yaml.safe_load((run / "resolved.yaml").read_text())
        assert resolved["heads"]["ridge"]["degree"] == row["values"]["heads.ridge.degree"]
    best = min(content["trials"], key=lambda row: row["value"])
    assert content["best"] == best["number"]
    written = yaml.safe_load((out / "best.yaml").read_text())
    assert written["heads"]["ridge"]["degree"] == best["values"]["heads.ridge.degree"]
    assert call(monkeypatch, "check", out / "best.yaml") == 0
    names = {path.name for path in (out / "figures").glob("*.png")}
    assert {"01_parallel_coordinates.png", "02_course.png"} <= names
    assert "heads.ridge.degree" in (out / "report.html").read_text()


def test_values_of_a_random_search_hang_on_its_seed_alone(sweep: Path, tmp_path: Path) -> None:
    from residnet.core.config import load_config
    from residnet.tasks.sweep import SweepConfig, Trials, open_study

    space = "space={heads.ridge.penalty: {low: 1e-6, high: 1.0, log: true}}"
    found = []
    for number, seed in enumerate((3, 3, 4)):
        search = f"search={{kind: random, trials: 30, seed: {seed}}}"
        config = load_config(sweep, [space, search], SweepConfig)
        (folder := tmp_path / str(number)).mkdir()
        drawn: list[Any] = []
        # what a resumed sweep draws goes on as the undisturbed one does
        for _ in range(3):
            trials = Trials(config, open_study(config, folder))
            while len(drawn) < 30 and (trial := trials.next()):
                drawn.append(trial.params["heads.ridge.penalty"])
                trials.study.tell(trial.number, 1.0)
                if len(drawn) in (7, 20):
                    break
        assert trials.next() is None
        assert len(drawn) == 30
        assert all(1e-6 <= value <= 1.0 for value in drawn)
        # evenly in the logarithm
        assert 8 <= sum(value < 1e-3 for value in drawn) <= 22
        found.append(drawn)
    assert found[0] == found[1] != found[2]


def test_a_poor_trial_is_ended_early(sweep: Path, tmp_path: Path) -> None:
    import optuna

    from residnet.core.config import load_config
    from residnet.core.progress import Progress
    from residnet.tasks.sweep import SweepConfig, Trials, open_study, watch

    words = ["pruning={startup: 3}", "search={kind: random, trials: 5}"]
    config = load_config(sweep, words, SweepConfig)
    study = open_study(config, tmp_path)
    trials = Trials(config, study)
    for level in (1.0, 2.0, 3.0):
        trial = trials.next()
        assert trial is not None
        heard: Any = watch(config, tmp_path, trial._trial_id)
        for epoch in (1, 2):
            heard(Progress("training ridge", epoch, 2, score=level / epoch))
        study.tell(trial.number, level)
    good, poor = trials.next(), trials.next()
    assert good is not None
    assert poor is not None
    heard = watch(config, tmp_path, good._trial_id)
    heard(Progress("training ridge", 1, 2, score=1.5))
    heard(Progress("training other", 1, 2, score=9.0))
    heard = watch(config, tmp_path, poor._trial_id)
    with pytest.raises(optuna.TrialPruned):
        heard(Progress("training ridge", 1, 2, score=2.5))


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


def _children(parent: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]


def _alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_a_lost_process_costs_its_own_trial_alone(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from residnet.tasks import sweep as running

    begun: list[int] = []

    def lost(*words: Any) -> Any:
        begun.append(words[3])
        if words[3] == 1 or begun == [0]:
            raise BrokenProcessPool("a process ended")
        return running.Ended(float(words[3]), False, "", 0.0)

    monkeypatch.setattr(running, "carry_out_trial", lost)
    space = {**SWEEP["space"], WINDOW: {"choices": [0.9, 1.1, 1.3]}}
    words = ["run", sweep, "--out", tmp_path / "out", "-s", f"space={json.dumps(space)}"]
    assert call(monkeypatch, *words, "-s", "runner.workers=1") == 0
    rows = _read(tmp_path / "out")["trials"]
    assert [begun.count(row["number"]) for row in rows] == [2, 3, *[1] * (len(rows) - 2)]
    failed = [row["number"] for row in rows if row["state"] == "failed"]
    assert failed == [1]
    assert "lost 3 times" in rows[1]["fault"]


def test_a_process_that_is_killed_is_replaced() -> None:
    with ApartProcesses(1) as pool:
        with pytest.raises(BrokenProcessPool):
            pool.submit(os._exit, 1).result()
        assert pool.submit(abs, -2).result() == 2


@pytest.mark.long
def test_the_same_sweep_runs_through_ray(
    sweep: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("ray")
    runner = "runner={kind: ray, workers: 2}"
    assert call(monkeypatch, "run", sweep, "--out", tmp_path / "ray", "-s", runner) == 0
    assert call(monkeypatch, "run", sweep, "--out", tmp_path / "own") == 0
    assert _values(tmp_path / "ray") == _values(tmp_path / "own")
