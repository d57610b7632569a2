"""Commands and their exit codes: one clear line for every mistake, and nothing lost."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from tiny import TINY, call

import residnet
from residnet.core.log import Log

CONFIGS = Path(residnet.__file__).parents[2] / "configs"


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    text = capsys.readouterr().err.strip()
    assert len(text.splitlines()) == 1
    assert "Traceback" not in text
    return text


@pytest.mark.parametrize(
    "path",
    sorted(p for p in CONFIGS.rglob("*.yaml") if p.parent.name != "vessels"),
    ids=lambda p: p.name,
)
def test_every_config_is_valid(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from residnet.tasks.registry import load_task

    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    task = load_task(path, [])
    assert task.name
    assert task.description


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("heads.lstm.hiden_size=3", "did you mean 'hidden_size'"),
        ("heads.lstm.kind=lstn", "did you mean 'lstm'"),
        ("prepare.grid.step=3 deg", "does not measure [s]"),
        ("evaluation.selection=manuvre", "did you mean 'manoeuvre'"),
        ("heads.ridge.features=[u, w]", "'w' is not a channel"),
        ("data.vessel=wam_w_cal", "did you mean 'wam_v_cal'"),
        ("data.identification={zigzag: 9}", "leaves a split empty"),
        ("training.mlp.steps=3", "no head is named 'mlp'"),
        ("export.models=[lstmm]", "did you mean 'lstm'"),
        ("baseline.steer=tau_z", "tau_z"),
    ],
)
def test_config_errors(
    tiny_config: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    override: str,
    said: str,
) -> None:
    assert call(monkeypatch, "check", tiny_config, "-s", override) == 2
    assert said in one_line(capsys)


def test_check_passes(
    tiny_config: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "check", tiny_config) == 0
    assert "valid" in capsys.readouterr().out


def test_missing_config(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert call(monkeypatch, "run", tmp_path / "none.yaml") == 2
    assert "none.yaml" in one_line(capsys)


def test_existing_folder_is_left_alone(
    tiny_config: Path,
    tiny_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = (tiny_run / "metrics.json").read_text()
    assert call(monkeypatch, "run", tiny_config, "--out", tiny_run) == 2
    assert "exists already" in one_line(capsys)
    assert (tiny_run / "metrics.json").read_text() == before


@pytest.mark.parametrize(
    "what",
    ["vessels", "heads", "manoeuvres", "readers", "tasks", "baselines", "formats", "configs"],
)
def test_list(
    what: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "list", what) == 0
    assert len(capsys.readouterr().out.splitlines()) >= 2


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


def test_help_does_not_import_torch() -> None:
    code = (
        "import sys; import residnet.cli; sys.exit(any(name in sys.modules for name in ('torch',"
        " 'lightning', 'pandas', 'matplotlib', 'pydantic')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_check_does_not_import_lightning(tiny_config: Path) -> None:
    load = f"import residnet.tasks.registry as l; l.load_task(Path({str(tiny_config)!r}), [])"
    code = f"import sys; from pathlib import Path; {load}; sys.exit('lightning' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def csv_config(folder: Path, **reader: object) -> Path:
    """A configuration that reads csv logs from `folder`/logs."""
    columns = {
        "x": "m",
        "y": "m",
        "psi": "rad",
        "u": "m/s",
        "v": "m/s",
        "r": "rad/s",
        "n_port": "1/s",
        "n_stbd": "1/s",
    }
    channels = {name: {"column": f"col_{name}", "unit": unit} for name, unit in columns.items()}
    config = TINY | {
        "data": {
            "kind": "measured",
            "reader": (
                {
                    "kind": "csv",
                    "time": {"column": "time"},
                    "channels": channels,
                    "manoeuvre": "folder",
                }
                | reader
            ),
            "split": {
                "root": str(folder / "logs"),
                "train": ["*/train*.csv"],
                "validation": ["*/val*.csv"],
                "test": ["*/test*.csv"],
            },
        },
        "baseline": {"kind": "regressors", "terms": ["1", "u", "v", "r", "tau_x", "tau_n"]},
        "heads": {"ridge": {"kind": "ridge", "folds": 2}},
        "ensembles": {},
        "training": {},
        "export": {"models": ["selected"]},
    }
    path = folder / "measured.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


@pytest.fixture
def csv_logs(tmp_path: Path, trial_logs: list[Log]) -> Path:
    folder = tmp_path / "logs" / "zigzag"
    folder.mkdir(parents=True)
    for name, log in zip(["train1", "train2", "val1", "test1"], trial_logs, strict=True):
        pd.DataFrame({"time": log.t} | {f"col_{k}": v for k, v in log.channels.items()}).to_csv(
            folder / f"{name}.csv", index=False
        )
    return tmp_path


@pytest.fixture(scope="session")
def trial_logs() -> list[Log]:
    from residnet.data.simulated import SimulatedTrials, simulate
    from residnet.manoeuvres.three_two_one_one import ThreeTwoOneOne

    flown = [
        ThreeTwoOneOne(drive=d, steer=s, unit=u, start=2)
        for d, s, u in ((0.3, 0.5, 2), (0.8, 0.8, 3), (0.5, 0.6, 2.5), (0.6, 0.7, 2))
    ]
    data = SimulatedTrials.model_validate(TINY["data"])
    return simulate(flown, data)


@pytest.mark.long
def test_measured_csv_end_to_end(
    csv_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = csv_logs / "run"
    assert call(monkeypatch, "run", csv_config(csv_logs), "--out", out) == 0
    content = json.loads((out / "metrics.json").read_text())
    assert {row["split"] for row in content["rows"]} == {"train", "validation", "test"}
    assert "truth" not in {row["model"] for row in content["rows"]}
    provenance = json.loads((out / "provenance.json").read_text())
    assert len(provenance["inputs"]) == 4
    assert (
        call(
            monkeypatch,
            "evaluate",
            out,
            "--logs",
            csv_logs / "logs" / "zigzag" / "test1.csv",
            "--out",
            csv_logs / "external",
        )
        == 0
    )
    external = json.loads((csv_logs / "external" / "metrics.json").read_text())
    assert {row["split"] for row in external["rows"]} == {"external"}
    mine = {
        (r["model"], r["protocol"]): r["rmse"]
        for r in content["rows"]
        if r["split"] == "test" and r["manoeuvre"] == "all"
    }
    theirs = {
        (r["model"], r["protocol"]): r["rmse"] for r in external["rows"] if r["manoeuvre"] == "all"
    }
    assert theirs.keys() == mine.keys()
    for key, rmse in mine.items():
        # free runs of several splits are one batch, in which sums may round otherwise
        assert theirs[key] == pytest.approx(rmse, rel=1e-12)
    assert call(monkeypatch, "export", out, "--model", "ridge", "--format", "torchscript") == 0
    assert (out / "exports" / "ridge.pt").is_file()
    capsys.readouterr()
    assert call(monkeypatch, "export", out, "--model", "rigde") == 2
    assert "did you mean 'ridge'" in one_line(capsys)
    assert call(monkeypatch, "evaluate", out, "--logs", csv_logs / "nothing") == 2
    assert call(monkeypatch, "report", csv_logs) == 2


def spoil(path: Path, change: str) -> None:
    table = pd.read_csv(path)
    if change == "time goes back":
        table["time"] = table["time"].where(table.index != 50, table["time"].iloc[40])
    elif change == "duplicated time":
        table["time"] = table["time"].where(table.index != 50, table["time"].iloc[49])
    elif change == "all NaN":
        table["col_r"] = np.nan
    elif change == "short":
        table = table.iloc[:30]
    elif change == "no column":
        table = table.drop(columns="col_v")
    table.to_csv(path, index=False)


@pytest.mark.parametrize(
    ("change", "code", "said"),
    [
        ("time goes back", 1, "train1"),
        ("duplicated time", 1, "train1"),
        ("all NaN", 1, "col_r"),
        ("no column", 2, "col_v"),
    ],
)
def test_bad_logs(
    csv_logs: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: str,
    code: int,
    said: str,
) -> None:
    spoil(csv_logs / "logs" / "zigzag" / "train1.csv", change)
    assert call(monkeypatch, "run", csv_config(csv_logs), "--out", csv_logs / "run") == code
    assert said in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("name", ["val1", "test1"])
def test_log_shorter_than_a_window(
    csv_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    spoil(csv_logs / "logs" / "zigzag" / f"{name}.csv", "short")
    assert call(monkeypatch, "run", csv_config(csv_logs), "--out", csv_logs / "run") == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert name in last
    assert "shorter than a window" in last


def test_wrong_unit_and_missing_file(
    csv_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = csv_config(csv_logs)
    assert call(monkeypatch, "check", config, "-s", "data.reader.channels.u.unit=deg") == 2
    assert "m/s" in one_line(capsys)
    assert call(monkeypatch, "check", config, "-s", "data.split.test=[none*.csv]") == 2
    assert "none*.csv" in one_line(capsys)


def test_inspect(
    csv_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = csv_config(csv_logs)
    assert call(monkeypatch, "inspect", csv_logs / "logs" / "zigzag", "--config", config) == 0
    assert "test1" in capsys.readouterr().out
    path = csv_logs / "logs" / "zigzag" / "train1.csv"
    table = pd.read_csv(path)
    table["col_psi"] = -table["col_psi"]
    table.to_csv(path, index=False)
    found = csv_logs / "found.json"
    assert call(monkeypatch, "inspect", path, "--config", config, "--json", found) == 1
    assert "will mislead: x, y rates against R(psi) [u, v]" in capsys.readouterr().out
    content = json.loads(found.read_text())
    assert (content["schema"], content["misled"], content["logs"][0]["source"]) == (
        "residnet.inspection/1",
        True,
        str(path),
    )
    assert "frames" in {
        finding["code"]
        for finding in content["logs"][0]["findings"]
        if finding["level"] == "will mislead"
    }


def test_inspect_drafts_a_channel_map_for_a_table_that_nobody_described(
    csv_logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = csv_logs / "logs" / "zigzag" / "train1.csv"
    table = pd.read_csv(path)
    table.columns = [
        name.removeprefix("col_").replace("psi", "Heading [deg]") for name in table.columns
    ]
    table["Heading [deg]"] = np.degrees(table["Heading [deg]"])
    table.assign(mode="auto", spare=np.nan).to_csv(path, index=False)
    assert call(monkeypatch, "inspect", path) == 0
    text = capsys.readouterr().out
    assert "# empty columns: spare" in text
    assert "# columns of text: mode" in text
    assert "coherence 1.000" in text
    draft = yaml.safe_load(text[text.index("reader:") :])["reader"]
    assert draft["time"] == {"column": "time", "unit": "s"}
    assert draft["channels"]["psi"] == {"column": "Heading [deg]", "unit": "deg"}
    assert list(draft["channels"])[:6] == ["x", "y", "psi", "u", "v", "r"]
