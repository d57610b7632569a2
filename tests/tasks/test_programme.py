"""Task `simulate` with a programme: a vessel, a learned model, both side by side; time-outs,
replays, mistakes in one line.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image
from read_page import plain
from tiny import call

from residnet.core.log import Log
from residnet.data.readers.canonical import CanonicalConfig

STEP = 0.1
VESSEL: dict[str, Any] = {
    "task": "simulate",
    "name": "ship",
    "programme": {
        "vessel": "wam_v_cal",
        "duration": 60,
        "step": STEP,
        "substeps": 1,
        "noise": {"u": 0, "v": 0, "r": 0},
        "manoeuvres": [
            {
                "kind": "zigzag",
                "drive": 0.6,
                "steer": 0.4,
                "heading": "15 deg",
                "start": 10,
                "reversals": 4,
            },
            {"kind": "turning_circle", "name": "circle", "drive": 0.6, "steer": 1.0, "start": 10},
            {"kind": "three_two_one_one", "drive": 0.5, "steer": 0.6, "unit": 2, "duration": 25},
        ],
        "families": [{"kind": "random_steps", "count": 2}],
    },
}


def written(folder: Path, content: dict[str, Any], **changes: Any) -> Path:
    path = folder / "programme.yaml"
    path.write_text(
        yaml.safe_dump(content | {"programme": content["programme"] | changes}, sort_keys=False)
    )
    return path


def rows(folder: Path) -> dict[tuple[str, str], dict[str, Any]]:
    return {
        (row["craft"], row["log"]): row
        for row in json.loads((folder / "indices.json").read_text())["rows"]
    }


@pytest.fixture(scope="module")
def ship(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("programme")
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "check", written(folder, VESSEL)) == 0
        assert call(patch, "run", written(folder, VESSEL), "--out", folder / "run") == 0
    return folder / "run"


def test_a_vessel_leaves_logs_indices_and_figures(ship: Path) -> None:
    logs = {
        path.stem: CanonicalConfig().build().read(path)
        for path in (ship / "logs").glob("*.parquet")
    }
    assert set(logs) == {
        "zigzag_01",
        "circle",
        "three_two_one_one_01",
        "random_steps_01",
        "random_steps_02",
    }
    assert logs["three_two_one_one_01"].t[-1] == pytest.approx(25 - STEP)
    assert logs["random_steps_01"].t[-1] == pytest.approx(60 - STEP)
    # the circle ends at the first sample at which the heading has changed by 540 deg
    psi = logs["circle"]["psi"]
    assert psi[-1] >= 3 * math.pi > psi[-2]
    zigzag = logs["zigzag_01"]
    steer = np.sign(zigzag["cmd_port"] - zigzag["cmd_stbd"])
    assert (np.diff(steer[zigzag.t > 10]) != 0).sum() == 4
    assert zigzag["psi"][-1] >= 0 > zigzag["psi"][-2]
    content = json.loads((ship / "indices.json").read_text())
    assert (content["schema"], content["length"]) == ("residnet.indices/1", 4.88)
    assert content["units"]["first_overshoot"] == "rad"
    found = rows(ship)["wam_v_cal", "zigzag_01"]
    # the peak lies between samples
    peak = float(zigzag["psi"][zigzag.t < 16].max())
    assert found["indices"]["first_overshoot"] == pytest.approx(peak - math.radians(15), abs=1e-3)
    circle = rows(ship)["wam_v_cal", "circle"]
    assert circle["limits"]["advance"]["limit"] == pytest.approx(4.5 * 4.88)
    assert circle["limits"]["advance"]["kept"]
    assert circle["indices"]["advance_lengths"] == pytest.approx(
        circle["indices"]["advance"] / 4.88
    )
    assert not any(row["timed_out"] for row in content["rows"])
    figures = {path.stem[3:] for path in (ship / "figures").glob("*.png")}
    assert figures == {f"manoeuvres_{number + 1}" for number in range(len(logs))}
    for path in (ship / "figures").glob("*.png"):
        with Image.open(path) as picture:
            assert min(picture.size) > 600
            assert picture.info["Title"]
    assert "first overshoot" in plain(ship / "report.html")


def test_a_model_flies_beside_its_vessel_and_alone(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model of the tiny fit is no good one; here it only has to fly by itself, and both ways
    the same.
    """
    model = {"run": str(tiny_run), "name": "ridge"}
    programme = VESSEL["programme"] | {
        "manoeuvres": VESSEL["programme"]["manoeuvres"][2:],
        "step": None,
        "duration": 20,
    }
    both = written(tmp_path, VESSEL | {"programme": programme}, model=model)
    assert call(monkeypatch, "run", both, "--out", tmp_path / "both") == 0
    assert (
        call(
            monkeypatch,
            "run",
            both,
            "-s",
            "~programme.vessel",
            "-s",
            "programme.model.actuators=wam_v_cal",
            "--out",
            tmp_path / "alone",
        )
        == 0
    )
    beside = {
        path.stem: Log.load(path) for path in (tmp_path / "both" / "model_logs").glob("*.parquet")
    }
    alone = {path.stem: Log.load(path) for path in (tmp_path / "alone" / "logs").glob("*.parquet")}
    ships = {path.stem: Log.load(path) for path in (tmp_path / "both" / "logs").glob("*.parquet")}
    assert (
        set(beside)
        == set(alone)
        == set(ships)
        == {"three_two_one_one_01", "random_steps_01", "random_steps_02"}
    )
    for name, log in beside.items():
        for channel in log.channels:
            np.testing.assert_array_equal(log[channel], alone[name][channel])
        np.testing.assert_array_equal(log["cmd_port"], ships[name]["cmd_port"])
        np.testing.assert_allclose(log["n_port"], ships[name]["n_port"], atol=1e-9)
        assert 0 < np.abs(log["u"] - ships[name]["u"]).max() < 0.5
    assert not (tmp_path / "alone" / "model_logs").exists()
    inputs = json.loads((tmp_path / "both" / "provenance.json").read_text())["inputs"]
    assert {Path(path).name for path in inputs} == {"model.json", "model.safetensors"}


def test_a_model_with_given_inputs(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a vessel file: the inputs follow drive and steer within their rate."""
    share = {"drive": "2380 rpm", "limit": "2380 rpm", "rate": "600 rpm/s"}
    model = {
        "run": str(tiny_run),
        "inputs": {
            "n_port": {**share, "steer": "2380 rpm"},
            "n_stbd": {**share, "steer": "-2380 rpm"},
        },
    }
    content = VESSEL | {
        "programme": {
            "model": model, "duration": 20, "length": 4.88,
            "noise": {"u": 0, "v": 0, "r": 0},
            "manoeuvres": [{"kind": "zigzag", "drive": 0.5, "steer": 0.3, "heading": "20 deg"}],
        }
    }  # fmt: skip
    assert call(monkeypatch, "run", written(tmp_path, content), "--out", tmp_path / "run") == 0
    log = Log.load(tmp_path / "run" / "logs" / "zigzag_01.parquet")
    assert np.abs(np.diff(log["n_port"])).max() == pytest.approx(10 * STEP, rel=1e-9)
    assert log["cmd_port" if "cmd_port" in log.channels else "cmd_n_port"].max() == pytest.approx(
        0.8 * 2380 / 60
    )


def test_a_manoeuvre_that_never_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It times out: one line that says so, exit code 1, and the log is there and says it too."""
    lazy = [
        {
            "kind": "zigzag",
            "drive": 0.5,
            "steer": 0.0,
            "heading": "20 deg",
            "reversals": 2,
            "duration": 8,
        },
        VESSEL["programme"]["manoeuvres"][2],
    ]
    assert (
        call(
            monkeypatch,
            "run",
            written(tmp_path, VESSEL, manoeuvres=lazy),
            "--out",
            tmp_path / "run",
        )
        == 1
    )
    error = capsys.readouterr().err.strip()
    assert len(error.splitlines()) == 1
    assert "zigzag_01: timed out after 7.9 s before 2 reversals at 20 deg" in error
    log = Log.load(tmp_path / "run" / "logs" / "zigzag_01.parquet")
    assert log.meta["timed_out"] is True
    assert (
        "timed_out" not in Log.load(tmp_path / "run" / "logs" / "three_two_one_one_01.parquet").meta
    )
    assert rows(tmp_path / "run")["wam_v_cal", "zigzag_01"]["timed_out"]


def test_random_manoeuvres_may_run_out_of_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    family = [{"kind": "turning_circle", "count": 1, "steer": [0.01, 0.02]}]
    path = written(tmp_path, VESSEL, manoeuvres=[], families=family, duration=10)
    assert call(monkeypatch, "run", path, "--out", tmp_path / "run") == 0
    assert "turning_circle_01: timed out" in capsys.readouterr().err


def test_replay_gives_the_log_again(
    ship: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same vessel from the recorded start with the recorded commands: the recorded motion."""
    replay = [
        {"kind": "replay", "log": str(ship / "logs" / "random_steps_01.parquet")},
        {"kind": "replay", "log": str(ship / "logs" / "circle.parquet")},
    ]
    assert (
        call(
            monkeypatch,
            "run",
            written(tmp_path, VESSEL, manoeuvres=replay, families=[]),
            "--out",
            tmp_path / "run",
        )
        == 0
    )
    for name, source in (("replay_01", "random_steps_01"), ("replay_02", "circle")):
        mine, log = (
            Log.load(tmp_path / "run" / "logs" / f"{name}.parquet"),
            Log.load(ship / "logs" / f"{source}.parquet"),
        )
        assert len(log) - len(mine) in (0, 1)
        for channel in log.channels:
            np.testing.assert_allclose(mine[channel], log[channel][: len(mine)], atol=1e-9)
        assert rows(tmp_path / "run")["wam_v_cal", name]["indices"]["rmse_u"] < 1e-9


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"vessel": None}, "nothing flies"),
        ({"manoeuvres": [], "families": []}, "nothing is flown"),
        (
            {"manoeuvres": [{"kind": "zigzag", "drive": 0.5, "heading": "10 deg"}]},
            "give either steer",
        ),
        (
            {
                "manoeuvres": [
                    {"kind": "zigzag", "drive": 0.5, "rudder": "10 deg", "heading": "10 deg"}
                ]
            },
            "the vessel has no rudder",
        ),
        (
            {
                "vessel": "mariner",
                "manoeuvres": [{"kind": "turning_circle", "drive": 1, "rudder": "60 deg"}],
            },
            "the vessel's goes to 40 deg",
        ),
        ({"manoeuvres": [{"kind": "zigzog"}]}, "did you mean 'zigzag'"),
        ({"initial": {"uu": 1}}, "no state 'uu'"),
        ({"initial": {"u": "3 deg"}}, "does not measure [m/s]"),
        ({"model": {"run": "nowhere"}}, "no such file or folder"),
        ({"disturbance": {"wind": {"speed": 3, "direction": 0}}}, "has no input 'wind_speed'"),
        (
            {"manoeuvres": [{"kind": "random_steps", "drive": 0.5, "band": [0.2, 0.1]}]},
            "a band goes from a low",
        ),
        (
            {
                "manoeuvres": (
                    [
                        {
                            "kind": "three_two_one_one",
                            "name": "a",
                            "drive": 0.5,
                            "steer": 0.2,
                            "unit": 2,
                        }
                    ]
                    * 2
                )
            },
            "two manoeuvres are named 'a'",
        ),
    ],
)
def test_wrong_programmes(
    changes: dict[str, Any],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call(monkeypatch, "check", written(tmp_path, VESSEL, **changes)) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"model": {"name": "rigde"}}, "did you mean 'ridge'"),
        ({"model": {"name": "ridge"}, "step": 0.2}, "must be that of model 'ridge' (0.1 s)"),
        ({"model": {"name": "ridge"}, "vessel": None}, "a model flies with actuators"),
        ({"model": {"name": "ridge", "actuators": "mariner"}}, "the model is driven by 'n_port'"),
        (
            {
                "model": {
                    "name": "ridge",
                    "actuators": "wam_v_cal",
                    "inputs": {"n_port": {"drive": 1}},
                }
            },
            "not both",
        ),
        (
            {
                "model": {
                    "name": "ridge",
                    "inputs": {"n_port": {"drive": "3 m"}, "n_stbd": {"drive": 1}},
                }
            },
            "inputs.n_port",
        ),
    ],
)
def test_wrong_models(
    changes: dict[str, Any],
    said: str,
    tiny_run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    model = changes.pop("model") | {"run": str(tiny_run)}
    assert call(monkeypatch, "check", written(tmp_path, VESSEL, **changes, model=model)) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1
