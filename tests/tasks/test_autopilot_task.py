"""The task `autopilot` from config to report: what is written, what the rows say, and a policy that
learned on a learned model.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
import yaml
from read_page import plain
from tiny import call

TRAINING = {
    "epochs": 1,
    "steps": 2,
    "batch": 32,
    "dt": "0.1 s",
    "horizon": "6 s",
    "learning_rate": 1e-3,
}
SMALL: dict[str, Any] = {
    "task": "autopilot",
    "name": "small",
    "vessel": "nomoto_oceanos",
    "rudder": "5 deg",
    "turning_time": "40 s",
    "test": {"dt": "0.05 s", "duration": "12 s", "plants": 6, "bias_time": "60 s"},
    "policies": {"policy": {"hidden": [6], "training": TRAINING}},
    "predictive": {
        "mlp": {
            "horizon": "2 s",
            "hidden": [8],
            "linear": True,
            "training": {"states": 300, "epochs": 20, "batch": 20},
        }
    },
    "peers": {"pd": {"kind": "pd"}, "bang_bang": {"kind": "bang_bang"}},
    "floor": "bang_bang",
    "tuning_points": 16,
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("autopilot")
    config = folder / "small.yaml"
    config.write_text(yaml.safe_dump(SMALL))
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", config, "--out", folder / "run") == 0
    return folder / "run"


def rows(run: Path) -> dict[tuple[str, str], dict[str, Any]]:
    return {
        (row["model"], row["protocol"]): row
        for row in json.loads((run / "metrics.json").read_text())["rows"]
    }


def test_every_controller_flies_every_test(run: Path) -> None:
    found = rows(run)
    assert set(found) == {
        (name, test)
        for name in ("policy", "mlp", "pd", "bang_bang")
        for test in ("nominal", "corners", "random", "bias")
    }
    assert {found[(name, "nominal")]["kind"] for name in ("policy", "pd", "bang_bang")} == {
        "policy",
        "classical",
        "floor",
    }
    assert found[("mlp", "nominal")]["kind"] == "predictive"
    assert found[("policy", "random")]["n"] == 6


def test_the_document_s_autopilot_says_how_well_it_predicts(run: Path) -> None:
    notes = json.loads((run / "controllers.json").read_text())["controllers"]["mlp"]
    assert 0 < notes["rms_heading"] < math.radians(2)
    assert notes["config"]["hidden"] == [8]
    assert (run / "models" / "mlp" / "model.safetensors").is_file()


def test_a_pupil_is_chosen_by_how_like_its_teacher_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The score of an imitation is the root mean square of the commands' difference: recomputed
    from the flights it is what the notes say.
    """
    config = tmp_path / "pupil.yaml"
    # a teacher that is slower than the policy's start: a choice by settling time would leave the
    # start
    peers = {"slow": {"kind": "pd", "kp": 3.0, "damping_time": "1.6 s"}}
    training = {
        **TRAINING,
        "epochs": 3,
        "steps": 10,
        "dt": "0.05 s",
        "horizon": "4 s",
        "learning_rate": 0.05,
    }
    policies = {"pupil": {"hidden": [12], "imitate": "slow", "training": training}}
    config.write_text(
        yaml.safe_dump(
            {**SMALL, "policies": policies, "peers": peers, "predictive": {}, "floor": None}
        )
    )
    assert call(monkeypatch, "run", config, "--out", tmp_path / "run") == 0
    fit = json.loads((tmp_path / "run" / "models" / "pupil" / "fit.json").read_text())
    assert fit["best_validation"] == min(entry["validation"] for entry in fit["curve"])
    series = pd.read_parquet(tmp_path / "run" / "flights.parquet")
    pupil, teacher = (
        series[series["controller"] == name].set_index(["effect", "time", "t"])["rudder"]
        for name in ("pupil", "slow")
    )
    # the teacher beside the pupil sees the pupil's flight, in flights.parquet its own: the same up
    # to what the two do differently
    apart = float((pupil - teacher).pow(2).mean() ** 0.5)
    assert apart == pytest.approx(fit["best_validation"], rel=0.6)
    assert fit["best_validation"] < 0.8 * fit["curve"][0]["validation"]


def test_the_floor_is_the_time_optimal_change(run: Path) -> None:
    """Entry of the time-optimal manoeuvre into +-1 deg from its closed form: full rudder until t1,
    then full counter-rudder.
    """
    gain, time, limit, change, band = 3.47, 3.94, math.radians(5), math.radians(30), math.radians(1)
    steady = gain * limit
    grid = torch.arange(0.0, 12.0, 1e-4, dtype=torch.float64)
    rate = steady * (1 - torch.exp(-grid / time))
    turned = steady * grid - time * rate
    stopping = time * (rate - steady * torch.log1p(rate / steady))
    switch = int(torch.argmin((turned + stopping - change).abs()))
    after = grid[: 20 * 10_000]
    coast = (
        turned[switch]
        - steady * after
        + time * (rate[switch] + steady) * (1 - torch.exp(-after / time))
    )
    entry = float(grid[switch] + after[int(torch.argmax((coast >= change - band).to(torch.int64)))])
    # a switch that comes up to a step late enters earlier, by as much at most
    assert entry - 0.08 < rows(run)[("bang_bang", "nominal")]["settling"]["max"] < entry + 0.02


def test_a_row_agrees_with_the_random_vessels_it_sums_up(run: Path) -> None:
    plants = pd.read_parquet(run / "plants.parquet")
    for name in ("policy", "pd"):
        own, row = plants[plants["controller"] == name], rows(run)[(name, "random")]
        for quantity in ("settling", "overshoot", "iae", "travel", "energy"):
            assert own[quantity].mean() == pytest.approx(row[quantity]["mean"])
            assert own[quantity].max() == pytest.approx(row[quantity]["max"])


def test_the_flights_say_what_the_rows_say(run: Path) -> None:
    series = pd.read_parquet(run / "flights.parquet")
    nominal = series[
        (series["controller"] == "policy") & (series["effect"] == 1) & (series["time"] == 1)
    ]
    error = (math.radians(30) - nominal["psi"]).abs()
    late = nominal["t"][error > math.radians(1)].max()
    settling = rows(run)[("policy", "nominal")]["settling"]["max"]
    assert late <= settling <= late + 0.05
    # the error falls from 30 deg without overshoot to speak of: its integral by the trapezoid of
    # the series
    area = float((0.5 * (error[1:].to_numpy() + error[:-1].to_numpy()) * 0.05).sum())
    assert rows(run)[("policy", "nominal")]["iae"]["max"] == pytest.approx(area, rel=0.02)


def test_the_report_holds_tables_and_figures(run: Path) -> None:
    text = plain(run / "report.html")
    assert text.count("<img") == 2
    for words in ("bang_bang", "absolute error", "energy", "Linear controllers are tuned"):
        assert words in text
    assert (run / "exports" / "policy.pt").is_file()


def test_reporting_again_draws_the_same_report(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = (run / "report.html").read_text()
    (run / "report.html").unlink()
    assert call(monkeypatch, "report", run) == 0
    assert (run / "report.html").read_text() == before


def test_a_policy_is_exported_by_its_name(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "there" / "pilot.pt"
    assert call(monkeypatch, "export", run, "--model", "policy", "--out", out) == 0
    assert torch.jit.load(str(out)).initial_state(torch.tensor([[0.0, 3.2, 0.0]])).shape == (1, 10)
    assert call(monkeypatch, "export", run, "--model", "polcy") == 2
    assert "did you mean 'policy'" in capsys.readouterr().err
    assert call(monkeypatch, "evaluate", run, "--logs", tmp_path) == 2
    assert "of task 'autopilot'; it has: report, export" in capsys.readouterr().err


def check(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, config: dict[str, Any]) -> int:
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump(config))
    return call(monkeypatch, "check", path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"test": {**SMALL["test"], "wind": "10 m/s"}}, "no input 'wind_speed'"),
        ({"spread": {"current": 0.5}}, "no input 'current_north'"),
        ({"vessel": "nomoto_oceanus"}, "nomoto_oceanos"),
        ({"floor": "pd"}, "kind bang_bang"),
        ({"rudder": "60 deg"}, "0.6109 rad at most"),
        ({"policies": {"policy": {"hidden": [0]}}}, "hidden"),
        ({"predictive": {"pd": {"horizon": "2 s"}}}, "'pd' names two controllers"),
        ({"policies": {"policy": {"imitate": "pdd"}}}, "no peer 'pdd'"),
        ({"policies": {"policy": {"learned": {"run": "nowhere"}}}}, "no such folder"),
    ],
)
def test_wrong_configs_are_said_in_a_line(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, Any],
    words: str,
) -> None:
    assert check(tmp_path, monkeypatch, {**SMALL, **change}) == 2
    assert words in capsys.readouterr().err


IDENTIFIED: dict[str, Any] = {
    "task": "fit",
    "name": "identified",
    "data": {
        "kind": "simulated",
        "vessel": "nomoto_oceanos",
        "duration": 40,
        "substeps": 1,
        "step": 0.1,
        "trials": [
            {
                "kind": "zigzag",
                "count": 12,
                "heading": ["10 deg", "20 deg"],
                "steer": [0.05, 0.14],
                "start": 2,
            }
        ],
        "noise": {"u": 0.01, "v": 0.01, "r": "0.1 deg/s"},
        "identification": {"zigzag": 10},
        "validation": {"zigzag": 2},
    },
    "prepare": {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
    },
    "signals": {"inputs": ["cmd_delta"]},
    "baseline": {"kind": "regressors", "terms": {"u": ["u"], "v": ["v"], "r": ["r", "cmd_delta"]}},
    "heads": {"ridge": {"kind": "ridge", "terms": ["r", "cmd_delta", "r|r|"]}},
    "evaluation": {
        "protocols": {"manoeuvre": {"kind": "manoeuvre"}},
        "selection": "manoeuvre",
        "scales": {"u": 0.3, "v": 0.3, "r": 0.2},
    },
}


@pytest.mark.long
def test_a_policy_that_learned_on_an_identified_model_steers_the_vessel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noisy logs, a fit, a policy trained on the fitted model: on the vessel it settles as the one
    that was trained there.
    """
    (tmp_path / "fit.yaml").write_text(yaml.safe_dump(IDENTIFIED))
    assert call(monkeypatch, "run", tmp_path / "fit.yaml", "--out", tmp_path / "fitted") == 0
    training = {**TRAINING, "steps": 1}
    learned = {"run": str(tmp_path / "fitted"), "model": "baseline"}
    policies = {
        "on_vessel": {"hidden": [6], "training": training},
        "on_model": {"hidden": [6], "training": training, "learned": learned},
    }
    config = tmp_path / "learned.yaml"
    peers = {"bang_bang": {"kind": "bang_bang"}}
    config.write_text(
        yaml.safe_dump(
            {**SMALL, "policies": policies, "peers": peers, "test": {**SMALL["test"], "plants": 2}}
        )
    )
    assert call(monkeypatch, "run", config, "--out", tmp_path / "run") == 0
    found = rows(tmp_path / "run")
    for protocol in ("nominal", "corners", "random"):
        mine, theirs = (
            found[(name, protocol)]["settling"]["mean"] for name in ("on_model", "on_vessel")
        )
        assert mine == pytest.approx(theirs, rel=0.05)
        assert mine != theirs
    card = {"card.json": ""}
    torch.jit.load(str(tmp_path / "run" / "exports" / "on_model.pt"), _extra_files=card)
    about = json.loads(card["card.json"])
    assert about["learned"] == {"run": str(tmp_path / "fitted"), "model": "baseline"}
    assert about["turning"]["K"] == pytest.approx(3.47, rel=0.05)
    assert about["turning"]["K"] != pytest.approx(3.47, rel=1e-6)


@pytest.mark.long
def test_wind_and_sea_are_flown_by_vessels_that_feel_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "patrol.yaml"
    sea = {
        "significant_height": 1.0,
        "peak_period": "7 s",
        "direction": "165 deg",
        "hull": {"length": 51.5, "breadth": 7.7, "draught": 2.3},
    }
    config.write_text(
        yaml.safe_dump(
            {
                **SMALL,
                "vessel": "patrol_p06_wind",
                "turning_time": "60 s",
                "spread": {"wind": [0, 10], "current": 0.5},
                "test": {
                    "dt": "0.25 s",
                    "duration": "30 s",
                    "plants": 2,
                    "overshoot": "2 deg",
                    "wind": 10,
                    "sea": sea,
                    "sea_time": "30 s",
                },
                "policies": {
                    "policy": {
                        "hidden": [6],
                        "training": {**TRAINING, "dt": "0.25 s", "steps": 1, "horizon": "5 s"},
                    }
                },
                "peers": {"pd": {"kind": "pd", "kp": 0.6, "damping_time": "8 s"}},
                "floor": None,
            }
        )
    )
    assert call(monkeypatch, "run", config, "--out", tmp_path / "run") == 0
    found = rows(tmp_path / "run")
    # PD stands where its rudder balances the wind; the policy takes the push away
    assert (
        found[("policy", "wind")]["error_end"]
        < math.radians(0.2)
        < found[("pd", "wind")]["error_end"]
    )
    for name in ("policy", "pd"):
        assert 0 < found[(name, "sea")]["heel_rms"]["mean"] < math.radians(20)
        assert 0 < found[(name, "sea")]["rudder_rms"]["max"] <= math.radians(5)
    text = plain(tmp_path / "run" / "report.html")
    assert "(jonswap) and travel towards 165 deg" in text
    assert "10 m/s from eight directions" in text
