"""Commands beside `run` and `check`: what they print, write, and leave alone."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import written_logs
import yaml
from tiny import call
from tiny_tasks import measured

from residnet.core.errors import DataError, UsageError
from residnet.core.files import shipped_configs
from residnet.core.progress import say
from residnet.core.version import __version__
from residnet.data.drafting.reading import log_files
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.simulate import SimulateConfig

FLY = (
    "task: simulate\nname: fly\nprogramme:\n  vessel: wam_v_cal\n  duration: 5 s\n"
    "  manoeuvres: [{kind: constant, name: turn, drive: 0.5, steer: 0.3}]\n"
)


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    text = capsys.readouterr().err.strip()
    assert len(text.splitlines()) == 1
    return text


@pytest.fixture
def csv(tmp_path: Path) -> Path:
    """The config of a fit to csv logs."""
    path = tmp_path / "measured.yaml"
    path.write_text(yaml.safe_dump(measured(tmp_path)))
    return path


def test_a_missing_config_and_an_existing_folder(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "run", tmp_path / "none.yaml") == 2
    assert "none.yaml" in one_line(capsys)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("precious")
    assert call(monkeypatch, "run", csv, "--out", tmp_path / "mine") == 2
    assert "exists already" in one_line(capsys)
    assert [file.name for file in (tmp_path / "mine").iterdir()] == ["notes.txt"]


def test_a_shipped_config_is_found_by_its_name(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    # a folder of the same name does not hide it
    (tmp_path / "quickstart").mkdir()
    assert call(monkeypatch, "check", "quickstart") == 0
    assert "quickstart: the config is valid (task fit, run quickstart)" in capsys.readouterr().out
    assert call(monkeypatch, "run", "quikstart") == 2
    assert "did you mean 'quickstart'" in one_line(capsys)
    assert all(
        yaml.safe_load(file.read_text())["description"] for file in shipped_configs().values()
    )


@pytest.mark.long
def test_measured_csv_end_to_end(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, external = tmp_path / "run", tmp_path / "external"
    assert call(monkeypatch, "run", csv, "--out", out, "-s", "export.models=[selected]") == 0
    content = json.loads((out / "metrics.json").read_text())
    assert {row["split"] for row in content["rows"]} == {"train", "validation", "test"}
    assert "truth" not in {row["model"] for row in content["rows"]}
    assert len(json.loads((out / "provenance.json").read_text())["inputs"]) == 6
    for split, logs in (("train", range(4)), ("test", (5,))):
        shutil.rmtree(external, ignore_errors=True)
        first, *others = [tmp_path / "logs" / f"log_{i}.csv" for i in logs]
        words = [first, *(word for log in others for word in ("--logs", log))]
        assert call(monkeypatch, "evaluate", out, *words, "--out", external) == 0
        rows = json.loads((external / "metrics.json").read_text())["rows"]
        own = [row for row in content["rows"] if row["split"] == split]
        assert [row["model"] for row in rows] == [row["model"] for row in own]
        for mine, row in zip(own, rows, strict=True):
            # free runs of several splits are one batch, in which sums may round otherwise
            assert row["rmse"] == pytest.approx(mine["rmse"], rel=1e-12)
    assert call(monkeypatch, "export", out, "--model", "ridge", "--format", "torchscript") == 0
    assert (out / "exports" / "ridge.pt").is_file()
    assert call(monkeypatch, "export", out, "--out", tmp_path / "chosen") == 0
    card = {"card.json": ""}
    torch.jit.load(str(tmp_path / "chosen.pt"), _extra_files=card)
    assert json.loads(card["card.json"])["model"] == content["selected"]
    capsys.readouterr()
    assert call(monkeypatch, "export", out, "--model", "rigde") == 2
    assert "did you mean 'ridge'" in one_line(capsys)
    assert call(monkeypatch, "evaluate", out, "--logs", tmp_path / "nothing") == 2
    capsys.readouterr()
    assert call(monkeypatch, "evaluate", out) == 2
    assert "Name files or folders of logs behind the run" in one_line(capsys)
    assert call(monkeypatch, "report", tmp_path) == 2


def test_inspect(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = tmp_path / "logs"
    assert call(monkeypatch, "inspect", logs, "--config", csv) == 0
    text = capsys.readouterr().out
    assert "log_5" in text
    assert "regressors of baseline over these logs: 5 move, condition number" in text
    path, found = logs / "log_0.csv", tmp_path / "found.json"
    table = pd.read_csv(path)
    table.assign(psi=-table["psi"]).to_csv(path, index=False)
    assert call(monkeypatch, "inspect", path, "--config", csv, "--json", found) == 1
    assert "will mislead: x, y rates against R(psi) [u, v]" in capsys.readouterr().out
    content = json.loads(found.read_text())
    assert (content["schema"], content["misled"]) == ("residnet.inspection/1", True)
    assert content["logs"][0]["source"] == str(path)
    loud = [f["code"] for f in content["logs"][0]["findings"] if f["level"] == "will mislead"]
    assert "frames" in loud
    assert call(monkeypatch, "inspect", path, "--config", "simulate_wam_v") == 2
    assert "has no channel map" in one_line(capsys)


def test_inspect_drafts_a_channel_map_for_a_table_that_nobody_described(
    csv: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "logs" / "log_0.csv"
    table = pd.read_csv(path).rename(columns={"psi": "Heading [deg]"})
    table["Heading [deg]"] = np.degrees(table["Heading [deg]"])
    table.assign(mode="auto", spare=np.nan).to_csv(path, index=False)
    assert call(monkeypatch, "inspect", path) in (0, 1)
    text = capsys.readouterr().out
    assert "# empty columns: spare" in text
    assert "# columns of text: mode" in text
    draft = yaml.safe_load(text[text.index("reader:") :])["reader"]
    assert draft["time"] == {"column": "t", "unit": "s"}
    assert draft["channels"]["psi"] == {"column": "Heading [deg]", "unit": "deg"}
    assert list(draft["channels"])[:6] == ["x", "y", "psi", "u", "v", "r"]


def test_folders_hold_tables_recordings_or_other_logs(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    log = written_logs.trial(3.0)
    tables, bags, boxes = tmp_path / "tables", tmp_path / "bags", tmp_path / "boxes"
    for folder in (tables, bags / "one", bags / "two", boxes):
        folder.mkdir(parents=True)
    table = written_logs.csv(log, tables)
    # what lies beside tables is no log
    (tables / "README.txt").write_text("Trials of a boat.\n")
    assert log_files([tables]) == [table]
    # what Dataverse hands out
    tabs = tmp_path / "tabs" / "trial.tab"
    tabs.parent.mkdir()
    tabs.write_text(table.read_text().replace(",", "\t"))
    assert log_files([tabs.parent]) == [tabs]
    # a file that is named twice is one log
    assert log_files([table, tables, tables / ".." / "tables" / table.name]) == [table]
    bag_files = [written_logs.bag2(log, bags / name) for name in ("one", "two")]
    assert log_files([bags]) == bag_files
    assert log_files([bag_files[0]]) == bag_files[:1]
    box = written_logs.mcap(log, boxes)
    shutil.rmtree(boxes / "whole")
    assert log_files([boxes]) == [box]
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="holds no log of a format"):
        log_files([tmp_path / "empty"])


@pytest.mark.long
@pytest.mark.parametrize("error", [DataError("no such wind"), KeyboardInterrupt(), ValueError("x")])
def test_the_log_of_a_run_that_ends_badly(
    error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lines and the traceback stay, and the next one goes on behind them."""

    def broken(self: SimulateConfig, folder: RunFolder) -> Outcome:
        say("the wind rises")
        raise error

    monkeypatch.chdir(tmp_path)
    (tmp_path / "fly.yaml").write_text(FLY)
    again: list[Any] = ["run", "fly.yaml", "--out", "run", "-v", "--quiet"]
    with monkeypatch.context() as patch:
        patch.setattr(SimulateConfig, "carry_out", broken)
        assert call(monkeypatch, *again) != 0
    text = (tmp_path / "run/log.txt").read_text()
    for words in ("the wind rises\n", "in broken", type(error).__name__):
        assert words in text
    if isinstance(error, DataError):
        assert call(monkeypatch, *again, "--resume") == 0
        assert (tmp_path / "run/log.txt").read_text().startswith(text)


def test_the_log_of_a_run_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fly.yaml").write_text(FLY)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/mine.txt").write_text("not a run")
    assert call(monkeypatch, "run", tmp_path / "fly.yaml", "--out", tmp_path / "run", "-v") == 2
    assert "UsageError" in (tmp_path / "run.log.txt").read_text()
    assert [entry.name for entry in (tmp_path / "run").iterdir()] == ["mine.txt"]


def test_a_quiet_run_for_machines_and_the_list_of_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config, out = tmp_path / "fly.yaml", tmp_path / "run"
    config.write_text(FLY)
    assert call(monkeypatch, "run", config, "--out", out, "--json", "-v") == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["folder"] == str(out)
    assert told.err == ""
    assert (out / "log.txt").is_file()
    assert call(monkeypatch, "runs", tmp_path, "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["best"]["value"] == 1
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip() == f"residnet {__version__}"
