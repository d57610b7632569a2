"""`residnet monitor --refit`: a new run beside the old one, judged on logs that were held out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from read_page import Page, plain
from tiny import TINY, Command, call, read_json, write_yaml

from residnet.core.config import validate_config
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.runs.folder import verify_checksums

pytestmark = pytest.mark.long

DATA: dict[str, Any] = {
    **TINY["data"],
    "duration": 20,
    "noise": {"u": 0.01, "v": 0.01, "r": 0.002},
    "trials": [
        {"kind": "zigzag", "count": 7, "heading": ["20 deg"], "start": 3},
        {"kind": "acceleration_deceleration", "count": 4},
        {"kind": "three_two_one_one", "count": 4, "start": 3},
    ],
    "identification": {"zigzag": 6, "acceleration_deceleration": 3, "three_two_one_one": 3},
}
MANOEUVRE = {"protocols": {"manoeuvre": {"kind": "manoeuvre"}}, "selection": "manoeuvre"}
CONFIG: dict[str, Any] = {
    **{key: TINY[key] for key in ("task", "prepare", "signals")},
    "name": "watched",
    "data": DATA,
    "baseline": {"kind": "regressors", "sets": ["fossen"], "ridge": 1e-6},
    "bands": None,
    "evaluation": {**MANOEUVRE, "scales": TINY["evaluation"]["scales"]},
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("watched")
    file = write_yaml(folder / "config.yaml", CONFIG)
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", file, "--out", folder / "run") == 0
    return folder / "run"


def new_logs(folder: Path, weaker: float) -> list[Any]:
    """Write logs of a vessel whose starboard propeller pushes by a share less."""
    data = validate_config({**DATA, "seed": 7}, SimulatedTrials, "test")
    folder.mkdir()
    words: list[Any] = []
    for number, log in enumerate(simulate_trial_logs(data.draw_manoeuvres(), data)[:4]):
        # the log tells more revolutions than those that push, as the thrust grows with the square
        told = log.channels["n_stbd"] / (1.0 - weaker) ** 0.5
        log.replace(channels={**log.channels, "n_stbd": told}).save(folder / f"{number}.parquet")
        words += ["--logs", folder / f"{number}.parquet"]
    return words


def test_a_refit_leaves_the_old_run_alone_and_can_be_exported(
    run: Path, tmp_path: Path, command: Command
) -> None:
    before = {file: file.read_bytes() for file in run.rglob("*") if file.is_file()}
    logs = new_logs(tmp_path / "logs", 0.2)
    out = tmp_path / "refit"
    given = ["monitor", run, *logs, "--model", "baseline", "--window", "5 s", "--refit", out]
    said = command(*given, "--out", tmp_path / "page")
    assert said.code == 1
    alarms, causes = Page(plain(tmp_path / "page" / "report.html")).tables
    assert [line[1][:5] for line in alarms[1:]].count("after") >= 1
    assert alarms[-1][2] == "gain n_stbd"
    assert [line[1] for line in causes].count("gain n_stbd") == 4
    assert {file: file.read_bytes() for file in run.rglob("*") if file.is_file()} == before
    verify_checksums(run)
    found = read_json(tmp_path / "page" / "monitor.json")[-1]["refit"]
    (change,) = found["changes"]
    assert change["cause"] == "gain n_stbd"
    assert found["worth_taking"]
    assert "significantly better and selected" in said.out
    metrics = read_json(out / "metrics.json")
    assert metrics["selected"] == "baseline_refit"
    assert {row["model"] for row in metrics["rows"]} == {
        "constant_velocity",
        "baseline",
        "baseline_refit",
    }
    errors = {
        row["model"]: row["nrmse"]["mean"]
        for row in metrics["rows"]
        if (row["protocol"], row["manoeuvre"]) == ("manoeuvre", "all")
    }
    assert errors["baseline_refit"] == found["nrmse_new"] < 0.8 * errors["baseline"]
    assert errors["baseline"] == found["nrmse_old"]
    assert (out / "report.html").is_file()
    assert command("export", out, "--model", "baseline_refit").code == 0
    # a folder that is there, or the run itself, is not written to
    assert command(*given).code == 2
    said = command("monitor", run, *logs, "--refit", run / "refit")
    assert said.code == 2
    assert "give another folder for --refit" in said.err


def test_clean_logs_are_not_refitted(run: Path, tmp_path: Path, command: Command) -> None:
    logs = new_logs(tmp_path / "logs", 0.0)
    out = tmp_path / "refit"
    given = [*logs, "--model", "baseline", "--window", "5 s", "--refit", out]
    said = command("monitor", run, *given)
    assert said.code == 0
    assert "no model was written" in said.out
    assert not out.exists()
