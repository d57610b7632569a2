"""No command replaces, edits or deletes a file that residnet did not write."""

from __future__ import annotations

import functools
import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest
from pictures import omit_drawings
from tiny import Command, call, write_yaml

from residnet.core.log import Log
from residnet.export import vessel
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.runs import folder as folders
from residnet.runs.folder import RunFolder
from residnet.tasks import demo
from residnet.training import trainer

TURN = {"kind": "constant", "name": "turn", "drive": 0.5, "steer": 0.3}
PROGRAMME = {"vessel": "wam_v_cal", "duration": "20 s", "manoeuvres": [TURN]}
FLY = {"task": "simulate", "name": "fly", "programme": PROGRAMME}

COLLISIONS = (
    "resolved.yaml", "report.html", "summary.json", "checksums.json", "log.txt", "metrics.json",
    "figures/track.png", "figures/01_motion.png", "csv/mine.csv", "two_files/mine.csv",
    "exports/baseline.pt", "models/baseline/model.json", "monitor.json", "next_trials.yaml",
    "steer.c", "steer.h", "steer.card.json", "steer.pt", "boat.yaml", "found.json",
    "boat_vessel.yaml", "logs/turn.parquet", "rollouts/external/turn.parquet",
)  # fmt: skip
"""Names of files that some command writes."""


@pytest.fixture(autouse=True)
def _no_drawings(monkeypatch: pytest.MonkeyPatch) -> None:
    omit_drawings(monkeypatch)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a finished run of the task `simulate`, whose logs others read."""
    folder = tmp_path_factory.mktemp("flown")
    config = write_yaml(folder / "fly.yaml", FLY)
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", config, "--out", folder / "run") == 0
    return folder / "run"


def contents(folder: Path) -> dict[Path, bytes]:
    """Return the contents of each regular file below a folder."""
    files = (path for path in folder.rglob("*") if not path.is_symlink() and path.is_file())
    return {path: path.read_bytes() for path in files}


def scatter(root: Path, target: Path, *, collide: bool) -> dict[Path, bytes]:
    """Write files of a user above and next to a target; return their contents.

    Args:
        root: of all files.
        target: folder that a command writes to, or into.
        collide: whether there are files below the target, too, of the names that commands write.
    """
    draw = random.Random(63)
    for folder in (root, target.parent, *([target] if collide else ())):
        names = [f"{draw.randrange(10**6)}/{draw.randrange(10**6)}.txt" for _ in range(3)]
        for name in (*names, *draw.sample(COLLISIONS, len(COLLISIONS) if collide else 8)):
            path = folder / name
            if path != target and not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(draw.randbytes(50))
    return contents(root)


FOLDER_COMMANDS: tuple[tuple[str, ...], ...] = (
    ("run", "FLY", "--out", "TARGET", "-v"),
    ("run", "FLY", "--out", "TARGET", "--overwrite"),
    ("run", "FLY", "--out", "TARGET", "--resume"),
    ("evaluate", "FIT", "LOGS", "--out", "TARGET"),
    ("evaluate", "FIT", "LOGS", "--out", "TARGET", "--overwrite"),
    ("monitor", "FIT", "LOGS", "--model", "baseline", "--out", "TARGET"),
    ("monitor", "FIT", "LOGS", "--model", "baseline", "--refit", "TARGET"),
    ("compare", "FIT", "FIT2", "--out", "TARGET"),
    ("demo", "TARGET", "--overwrite"),
)
FILE_COMMANDS: tuple[tuple[str, ...], ...] = (
    ("export", "FIT", "--model", "baseline", "--anyway", "--out", "TARGET/steer.pt"),
    ("export", "FIT", "--model", "baseline", "--anyway", "--format", "c", "--out", "TARGET/steer"),
    ("new", "LOGS", "--out", "TARGET/boat.yaml", "--overwrite", "--defaults"),
    ("inspect", "LOGS", "--out", "TARGET/found.json"),
    ("autopilot", "0.31,7.4", "--rate", "6 deg/s", "--out", "TARGET/boat.yaml", "--draft",
     "--overwrite"),
)  # fmt: skip


@pytest.mark.parametrize("collide", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.parametrize("words", [*FOLDER_COMMANDS, *FILE_COMMANDS], ids=" ".join)
def test_files_of_the_user_stay_as_they_are(
    words: tuple[str, ...],
    collide: bool,
    flown: Path,
    tiny_run: Path,
    tmp_path: Path,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 20)
    shutil.copytree(tiny_run, tmp_path / "fit" / "a")
    shutil.copytree(tiny_run, tmp_path / "fit" / "b")
    target = tmp_path / "user" / "deep" / "target"
    before = scatter(tmp_path / "user", target, collide=collide)
    inputs = contents(tmp_path / "fit") | contents(flown)
    places = {
        "FLY": str(write_yaml(tmp_path / "fly.yaml", FLY)),
        "FIT": str(tmp_path / "fit" / "a"),
        "FIT2": str(tmp_path / "fit" / "b"),
        "LOGS": str(flown / "logs"),
    }
    monkeypatch.chdir(tmp_path / "user")
    said = command(
        *(places.get(word, word.replace("TARGET", str(target))) for word in words), "--quiet"
    )
    assert "defect" not in said.err
    if collide:
        assert said.code == 2, said.err
        assert len(said.err.strip().splitlines()) == 1
    else:
        # a monitor ends with 1 where there is an alarm
        assert said.code in (0, 1), said.err
        # a refit to logs that need none writes no run
        assert "--refit" in words or any(target.iterdir())
    after = contents(tmp_path / "user")
    assert {path: after.get(path) for path in before} == before
    assert {path: path.read_bytes() for path in inputs} == inputs


def test_overwrite_names_the_file_of_the_user_before_any_work(
    flown: Path, tmp_path: Path, command: Command
) -> None:
    run = tmp_path / "run"
    shutil.copytree(flown, run)
    config = write_yaml(run / "fly.yaml", FLY)
    (run / "mine").mkdir()
    (run / "mine" / "log.csv").write_text("mine")
    before = contents(run)
    said = command("run", config, "--out", run, "--overwrite", "--quiet")
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert "fly.yaml: exists" in said.err
    assert contents(run) == before
    config.rename(tmp_path / "fly.yaml")
    said = command("run", tmp_path / "fly.yaml", "--out", run, "--overwrite", "--quiet")
    assert said.code == 2
    assert "mine/log.csv: exists" in said.err
    shutil.rmtree(run / "mine")
    (run / "report.html").write_text("edited")
    said = command("run", tmp_path / "fly.yaml", "--out", run, "--overwrite", "--quiet")
    assert said.code == 2
    assert "report.html: was edited" in said.err
    (run / "report.html").unlink()
    assert command("run", tmp_path / "fly.yaml", "--out", run, "--overwrite", "-v").code == 0
    assert command("run", tmp_path / "fly.yaml", "--out", run, "--overwrite").code == 0
    RunFolder(run).manifest.require_all_owned()


def test_report_deletes_only_figures_that_it_recorded(
    flown: Path, tmp_path: Path, command: Command
) -> None:
    run = tmp_path / "run"
    shutil.copytree(flown, run)
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    figure = next((run / "figures").glob("*.json"))
    content = json.loads(figure.read_text())
    for number, still in enumerate((str(victim), "../../victim.txt", "/../victim.txt")):
        made = {**content, "stills": [still]}
        (run / "figures" / f"stranger_{number}.json").write_text(json.dumps(made))
    strangers = sorted((run / "figures").glob("stranger*"))
    command("report", run, "--quiet")
    assert victim.read_text() == "mine"
    assert sorted((run / "figures").glob("stranger*")) == strangers


@pytest.mark.parametrize("name", ["figures", "exports", "report.html"])
def test_links_lead_no_command_out_of_the_run(
    name: str, tiny_run: Path, tmp_path: Path, command: Command
) -> None:
    run = tmp_path / "run"
    outside = tmp_path / "outside"
    shutil.copytree(tiny_run, run)
    if (run / name).is_dir():
        shutil.move(run / name, outside)
    else:
        outside.mkdir(exist_ok=True)
        (outside / "page.html").write_text("mine")
        (run / name).unlink(missing_ok=True)
    (run / name).symlink_to(outside / "page.html" if "." in name else outside)
    before = contents(outside)
    words = ("export", run, "--model", "baseline", "--anyway") if name == "exports" else (
        "report", run)  # fmt: skip
    said = command(*words, "--quiet")
    assert said.code == 2
    assert "symbolic link" in said.err
    assert said.err.count("\n") == 1
    assert contents(outside) == before


def test_json_of_inspect_is_a_flag(flown: Path, tmp_path: Path, command: Command) -> None:
    logs = sorted((flown / "logs").glob("*.parquet"))
    before = contents(flown)
    said = command("inspect", "--json", *logs)
    assert json.loads(said.out)["schema"] == "residnet.inspection/1"
    assert contents(flown) == before
    out = tmp_path / "found.json"
    for _ in range(2):
        command("inspect", *logs, "--out", out)
    assert json.loads(out.read_text()) == json.loads(said.out)
    out.write_text("mine")
    assert command("inspect", *logs, "--out", out).code == 2
    assert out.read_text() == "mine"


def test_demo_is_replaced_only_if_it_is_unchanged(
    tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    # short logs and one workbook, in all layouts
    monkeypatch.setitem(demo.DEMO_TRIALS, "duration", "35 s")
    workbooks = dict([next(iter(demo._BASIN_MANOEUVRES.items()))])
    monkeypatch.setattr(demo, "_BASIN_MANOEUVRES", workbooks)
    # each command writes logs of the same simulations
    trials: list[Log] = []
    simulate_trial_logs = demo.simulate_trial_logs

    def simulate_once(manoeuvres: Any, config: SimulatedTrials) -> list[Log]:
        if not trials:
            trials.extend(simulate_trial_logs(manoeuvres, config))
        return trials

    monkeypatch.setattr(demo, "simulate_trial_logs", simulate_once)
    monkeypatch.setattr(demo, "simulate_basin_tests", functools.cache(demo.simulate_basin_tests))
    folder = tmp_path / "demo"
    assert command("demo", folder, "--quiet").code == 0
    said = command("demo", folder, "--quiet")
    assert said.code == 2
    assert "--overwrite" in said.err
    assert command("demo", folder, "--overwrite", "--quiet").code == 0
    (folder / "two_files" / "mine.csv").write_text("mine")
    before = contents(folder)
    said = command("demo", folder, "--overwrite", "--quiet")
    assert said.code == 2
    assert "two_files/mine.csv: exists" in said.err
    assert contents(folder) == before


def test_evaluate_locks_its_folder(
    tiny_run: Path,
    flown: Path,
    tmp_path: Path,
    command: Command,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(folders, "_LOCK_RETRIES", 1)
    out = tmp_path / "out"
    with RunFolder(out).lock():
        said = command("evaluate", tiny_run, flown / "logs", "--out", out, "--quiet")
    assert said.code == 2
    assert said.err.count("\n") == 1
    assert "another run is being written here" in said.err
    assert list(out.iterdir()) == []


@pytest.mark.long
def test_evaluate_has_the_options_that_it_recommends(
    tiny_run: Path, flown: Path, tmp_path: Path, command: Command
) -> None:
    out, run = tmp_path / "out", tmp_path / "fit"
    shutil.copytree(tiny_run, run)
    words = ("evaluate", run, flown / "logs", "--out", out, "--quiet")
    assert command(*words).code == 0
    said = command(*words)
    assert said.code == 2
    assert "--resume" in said.err
    assert "--overwrite" in said.err
    assert command(*words, "--resume").code == 0
    assert command(*words, "--overwrite").code == 0
    assert RunFolder.open(out).report.is_file()
    other = tmp_path / "other.parquet"
    shutil.copy(next((flown / "logs").glob("*.parquet")), other)
    said = command("evaluate", run, other, "--out", out, "--resume", "--quiet")
    assert said.code == 2
    assert "has changed since" in said.err
    for option in ([], ["--resume"], ["--overwrite"]):
        for place in (run, run.parent):
            said = command("evaluate", run, other, "--out", place, *option, "--quiet")
            assert (said.code, said.err.count("\n")) == (2, 1)
            assert (
                f"{place}: contains the run {run} that is evaluated; choose another --out"
                in said.err
            )
            # an option that was not given is no way out
            assert "--overwrite" not in said.err
    RunFolder.open(run)


def test_files_of_an_interrupted_training_are_recorded(
    tiny_config: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(trainer, "_log_result", interrupt)
    out = tmp_path / "run"
    assert command("run", tiny_config, "--out", out, "--quiet").code != 0
    assert list(out.rglob("last.ckpt"))
    assert list(out.rglob("events.out.tfevents*"))
    assert not (out / "checksums.json").exists()
    manifest = RunFolder(out).manifest
    manifest.require_all_owned()
    manifest.remove_owned()
    assert list(out.iterdir()) == []
