"""Commands beside `run` and `check`: what they print, write, and leave alone."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import written_logs
import yaml
from pictures import omit_drawings
from tiny import Command, read_json, write_yaml
from tiny_tasks import measured

from residnet.core.errors import DataError, UsageError
from residnet.core.files import find_shipped_configs
from residnet.core.progress import log_message
from residnet.core.version import __version__
from residnet.export import vessel
from residnet.io.drafting.log_files import find_log_files
from residnet.runs.folder import RunFolder
from residnet.runs.task import TaskOutcome
from residnet.tasks.simulate.config import SimulateConfig

CONSTANT = {"kind": "constant", "name": "turn", "drive": 0.5, "steer": 0.3}
PROGRAMME = {"vessel": "wam_v_cal", "duration": "5 s", "manoeuvres": [CONSTANT]}
FLY = {"task": "simulate", "name": "fly", "programme": PROGRAMME}


@pytest.fixture(autouse=True)
def _no_drawings(monkeypatch: pytest.MonkeyPatch) -> None:
    omit_drawings(monkeypatch)


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    """The config of a fit to csv logs."""
    return write_yaml(tmp_path / "measured.yaml", measured(tmp_path))


def test_configs_are_found_by_file_or_name_and_folders_of_others_left_alone(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("precious")
    monkeypatch.chdir(tmp_path)
    # a folder of the same name does not hide a shipped config
    (tmp_path / "quickstart").mkdir()
    for words, told in (
        (("run", tmp_path / "none.yaml"), "none.yaml"),
        (("run", "quikstart"), "did you mean 'quickstart'"),
        (("run", csv, "--out", tmp_path / "mine"), "exists already"),
    ):
        said = command(*words)
        assert said.code == 2
        assert told in said.err
        assert len(said.err.strip().splitlines()) == 1
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["notes.txt"]
    valid = "quickstart: the config is valid (task fit, run quickstart)"
    assert valid in command("check", "quickstart").out
    assert all(
        yaml.safe_load(f.read_text())["description"] for f in find_shipped_configs().values()
    )


def test_a_finished_run_is_exported(
    tiny_run: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    out = tmp_path / "model.pt"
    assert command("export", tiny_run, "--model", "baseline", "--out", out, "--anyway").code == 0
    assert out.is_file()
    said = command("export", tiny_run, "--model", "basline", "--out", out)
    assert said.code == 2
    assert "did you mean 'baseline'" in said.err


@pytest.mark.long
def test_a_fit_to_csv_is_evaluated_and_exported(
    csv: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "run"
    external = tmp_path / "external"
    assert command("run", csv, "--out", out, "-s", "export.models=[selected]").code == 0
    content = read_json(out / "metrics.json")
    assert {row["split"] for row in content["rows"]} == {"train", "validation", "test"}
    assert "plant" not in {row["model"] for row in content["rows"]}
    assert len(read_json(out / "provenance.json")["inputs"]) == 6
    for split, logs in (("train", range(4)), ("test", (5,))):
        shutil.rmtree(external, ignore_errors=True)
        first, *others = [tmp_path / "logs" / f"log_{i}.csv" for i in logs]
        words = [first, *(word for log in others for word in ("--logs", log))]
        assert command("evaluate", out, *words, "--out", external).code == 0
        rows = read_json(external / "metrics.json")["rows"]
        own = [row for row in content["rows"] if row["split"] == split]
        assert [row["model"] for row in rows] == [row["model"] for row in own]
        for mine, row in zip(own, rows, strict=True):
            # free runs of several splits are one batch, in which sums may round otherwise
            assert row["rmse"] == pytest.approx(mine["rmse"], rel=1e-12)
    assert command("export", out, "--model", "ridge", "--format", "torchscript").code == 0
    assert (out / "exports" / "ridge.pt").is_file()
    assert command("export", out, "--out", tmp_path / "chosen").code == 0
    card = {"card.json": ""}
    torch.jit.load(str(tmp_path / "chosen.pt"), _extra_files=card)
    assert json.loads(card["card.json"])["model"] == content["selected"]
    refused: tuple[tuple[list[Any], str], ...] = (
        (["export", out, "--model", "rigde"], "did you mean 'ridge'"),
        (["evaluate", out, "--logs", tmp_path / "nothing"], "nothing"),
        (["evaluate", out], "no logs given; name files or folders"),
        (["report", tmp_path], ""),
    )
    for words, told in refused:
        said = command(*words)
        assert said.code == 2
        assert told in said.err


def test_inspect_tells_what_misleads_and_drafts_a_channel_map(
    csv: Path, tmp_path: Path, command: Command
) -> None:
    said = command("inspect", tmp_path / "logs", "--config", csv)
    assert said.code == 0
    assert "log_5" in said.out
    assert "regressors of baseline over these logs: 5 move, condition number" in said.out
    path = tmp_path / "logs" / "log_0.csv"
    found = tmp_path / "found.json"
    table = pd.read_csv(path)
    table.assign(psi=-table["psi"]).to_csv(path, index=False)
    said = command("inspect", path, "--config", csv, "--out", found)
    assert said.code == 1
    assert "will mislead: x, y rates against R(psi) [u, v]" in said.out
    content = read_json(found)
    assert (content["schema"], content["misled"]) == ("residnet.inspection/1", True)
    assert content["logs"][0]["source"] == str(path)
    loud = [f["code"] for f in content["logs"][0]["findings"] if f["level"] == "will mislead"]
    assert "frames" in loud
    said = command("inspect", path, "--config", "simulate_wam_v")
    assert said.code == 2
    assert "has no channel map" in said.err
    # a table that nobody described
    table = table.rename(columns={"psi": "Heading [deg]"})
    table["Heading [deg]"] = np.degrees(table["Heading [deg]"])
    table.assign(mode="auto", spare=np.nan).to_csv(path, index=False)
    said = command("inspect", path)
    assert said.code in (0, 1)
    assert "# empty columns: spare" in said.out
    assert "# columns of text: mode" in said.out
    draft = yaml.safe_load(said.out[said.out.index("reader:") :])["reader"]
    assert draft["time"] == {"column": "t", "unit": "s"}
    assert draft["channels"]["psi"] == {"column": "Heading [deg]", "unit": "deg"}
    assert list(draft["channels"])[:6] == ["x", "y", "psi", "u", "v", "r"]


def test_folders_hold_tables_recordings_or_other_logs(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    log = written_logs.trial(3.0)
    tables, tabs, bags, boxes = (tmp_path / name for name in ("tables", "tabs", "bags", "boxes"))
    for folder in (tables, tabs, bags / "one", bags / "two", boxes, tmp_path / "empty"):
        folder.mkdir(parents=True)
    table = written_logs.csv(log, tables)
    # what lies beside tables is no log
    (tables / "README.txt").write_text("Trials of a boat.\n")
    assert find_log_files([tables]) == [table]
    # what Dataverse hands out
    tab = tabs / "trial.tab"
    tab.write_text(table.read_text().replace(",", "\t"))
    assert find_log_files([tabs]) == [tab]
    # a file that is named twice is one log
    assert find_log_files([table, tables, tables / ".." / "tables" / table.name]) == [table]
    bag_files = [written_logs.bag2(log, bags / name) for name in ("one", "two")]
    assert find_log_files([bags]) == bag_files
    assert find_log_files([bag_files[0]]) == bag_files[:1]
    box = written_logs.mcap(log, boxes)
    shutil.rmtree(boxes / "whole")
    assert find_log_files([boxes]) == [box]
    with pytest.raises(UsageError, match="has no log of a known format"):
        find_log_files([tmp_path / "empty"])


@pytest.mark.long
@pytest.mark.parametrize("error", [DataError("no such wind"), KeyboardInterrupt(), ValueError("x")])
def test_the_log_of_a_run_that_ends_badly_goes_on(
    error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """Its lines and the traceback stay, and the next one goes on behind them."""

    def broken(self: SimulateConfig, folder: RunFolder) -> TaskOutcome:
        log_message("the wind rises")
        raise error

    monkeypatch.chdir(tmp_path)
    write_yaml(tmp_path / "fly.yaml", FLY)
    again: list[Any] = ["run", "fly.yaml", "--out", "run", "-v", "--quiet"]
    with monkeypatch.context() as patch:
        patch.setattr(SimulateConfig, "execute", broken)
        assert command(*again).code != 0
    text = (tmp_path / "run/log.txt").read_text()
    for words in ("the wind rises\n", "in broken", type(error).__name__):
        assert words in text
    if isinstance(error, DataError):
        assert command(*again, "--resume").code == 0
        assert (tmp_path / "run/log.txt").read_text().startswith(text)


def test_the_log_of_a_run_without_a_folder_stands_beside_it(
    tmp_path: Path, command: Command
) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run/mine.txt").write_text("not a run")
    file = write_yaml(tmp_path / "fly.yaml", FLY)
    assert command("run", file, "--out", tmp_path / "run", "-v").code == 2
    assert "UsageError" in (tmp_path / "run.log.txt").read_text()
    assert [entry.name for entry in (tmp_path / "run").iterdir()] == ["mine.txt"]


def test_a_quiet_run_for_machines_and_the_list_of_runs(tmp_path: Path, command: Command) -> None:
    out = tmp_path / "run"
    file = write_yaml(tmp_path / "fly.yaml", FLY)
    said = command("run", file, "--out", out, "--json", "-v")
    assert (said.code, said.err) == (0, "")
    assert json.loads(said.out)["folder"] == str(out)
    assert (out / "log.txt").is_file()
    assert json.loads(command("runs", tmp_path, "--json").out)[0]["best"]["value"] == 1
    assert command("--version").out.strip() == f"residnet {__version__}"


@pytest.mark.parametrize(
    ("place", "told"),
    [
        ("file/run", "cannot be written|is not a folder"),
        ("x" * 300, "name too long|too long"),
        ("/".join(["deep" * 20] * 60), "too long"),
        ("full/run", "No space left on device"),
    ],
)
def test_a_place_that_cannot_hold_a_run_is_refused_before_the_work(
    place: str, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    config = write_yaml(tmp_path / "fly.yaml", FLY)
    (tmp_path / "file").write_text("no folder")

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    if place.startswith("full"):
        monkeypatch.setattr(os, "fsync", full)
    said = command("run", config, "--out", tmp_path / place)
    assert said.code == 2
    assert said.err.count("\n") == 1, "nothing was done before"
    assert any(words in said.err for words in told.split("|")), said.err
