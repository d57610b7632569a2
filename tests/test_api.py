"""The Python interface: lazy, the numbers of the command line, and its errors in one line."""

from __future__ import annotations

import copy
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from tiny import TINY, call
from written_trials import CHANNELS, write_trials

import residnet
from residnet.core.config import validate
from residnet.core.errors import ResidnetError
from residnet.data.prepare import PrepareConfig
from residnet.export import vessel
from residnet.judge.metrics import metrics_table
from residnet.judge.protocol import EvaluationConfig
from residnet.physics.signals import SignalsConfig
from residnet.runs.folder import RunFolder

EXAMPLE = Path(__file__).parents[1] / "examples" / "fifteen_lines.py"


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("api") / "trials"
    write_trials(folder, duration=40.0)
    return folder


@pytest.fixture(scope="module")
def logs(trials: Path) -> list[residnet.Log]:
    return residnet.read_logs(trials, channels=CHANNELS, time="time")


@pytest.fixture(scope="module")
def data(logs: list[residnet.Log]) -> residnet.Data:
    return residnet.prepare(logs, ["n_port", "n_stbd"])


@pytest.fixture(scope="module")
def models(data: residnet.Data) -> residnet.Models:
    return residnet.fit(data, heads={"ridge": "ridge", "net": {"kind": "mlp", "hidden": (8,)}})


def test_the_import_is_quick_and_loads_nothing() -> None:
    code = (
        "import sys, time; start = time.perf_counter(); import residnet;"
        "heavy = {'torch', 'pandas', 'numpy', 'pydantic', 'matplotlib'} & set(sys.modules);"
        "print(time.perf_counter() - start, sorted(heavy), len(dir(residnet)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "[]" in out.stdout
    assert int(out.stdout.split()[-1]) == len(residnet.__all__)


def test_every_name_is_there_and_documented() -> None:
    for name in residnet.__all__:
        assert getattr(residnet, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        _ = residnet.fitt  # type: ignore[attr-defined]


def test_defaults_come_from_the_logs(data: residnet.Data) -> None:
    assert data.prepare.grid.step == 0.1
    table = data.table
    assert dict(table["split"].value_counts()) == {"train": 6, "validation": 2, "test": 2}
    assert data.prepare.hold == "mean"
    assert data.evaluation.selection == next(iter(data.evaluation.protocols))


def test_logs_have_one_recipe_whoever_asks(trials: Path) -> None:
    draft = residnet.draft(trials, folder=trials.parent)
    logs = residnet.read_logs(trials, reader=draft.config["data"]["reader"])
    data = residnet.prepare(logs)
    fitted = residnet.fit(logs, "regressors", bands=None).settings
    for key, kind in (
        ("prepare", PrepareConfig),
        ("signals", SignalsConfig),
        ("evaluation", EvaluationConfig),
    ):
        drafted = validate(draft.config[key], kind, key)
        assert getattr(data, key) == drafted, key
        assert getattr(fitted, key) == drafted, key


@pytest.mark.long
def test_fifteen_lines(trials: Path) -> None:
    """The example fits, runs freely and draws, as a stranger would start it."""
    lines = EXAMPLE.read_text().split('"""')[2].strip().splitlines()
    assert len([line for line in lines if line.strip()]) <= 15
    done = subprocess.run(
        [sys.executable, EXAMPLE], capture_output=True, text=True, check=False, cwd=trials.parent
    )
    assert done.returncode == 0, done.stderr
    assert "best on the validation logs: plsr" in done.stdout
    assert (trials.parent / "track.png").stat().st_size > 10_000


def test_tables_and_figures(models: residnet.Models, data: residnet.Data) -> None:
    table = residnet.metrics(models, split="test")
    assert set(table["model"]) == {"zero", "baseline", "ridge", "net"}
    error = table[table["protocol"] == "T30"].set_index("model")["nrmse_mean"]
    assert error["ridge"] < error["baseline"] < error["zero"]
    runs = residnet.free_run(models, data)
    rows = runs.table
    one = rows[(rows["model"] == "ridge") & (rows["protocol"] == "T30") & (rows["window"] == 0)]
    first = one[one["log"] == runs.logs[0]]
    assert first["u"].iloc[0] == pytest.approx(first["u_hat"].iloc[0])
    rmse = [
        float(np.sqrt(np.mean((part["u_hat"] - part["u"])[part["usable"]] ** 2)))
        for _, part in one.groupby("log")
    ]
    found = table[(table["model"] == "ridge") & (table["protocol"] == "T30")]["rmse_u"].iloc[0]
    assert found == pytest.approx(np.mean(rmse), rel=1e-12)
    for figure in (runs.plot_track(models=["ridge"]), runs.plot_history(protocol="T30")):
        assert len(figure.axes) in (1, 4)
    assert residnet.select(models).name == models.selected
    assert models.verdict[0].startswith("2 windows of 2 logs on test data cannot say how good")
    told = f"On test data model {models.selected} is "
    assert any(sentence.startswith(told) for sentence in models.verdict)
    assert models.selection.reason in models.verdict
    assert list(models["baseline"].coefficients["axis"].unique()) == ["u_dot", "v_dot", "r_dot"]


def test_other_logs_are_judged_as_those_of_the_fit(
    models: residnet.Models, data: residnet.Data, logs: list[residnet.Log]
) -> None:
    names = {log.log.name for log in data.logs("test")}
    other = residnet.prepare([log for log in logs if log.name in names], like=data)
    again = residnet.metrics(models, other, manoeuvre=None)
    table = residnet.metrics(models, split="test", manoeuvre=None)
    columns = ["nrmse_mean", "position_error_end"]
    np.testing.assert_allclose(again[columns], table[columns], rtol=1e-12)
    assert set(again["split"]) == {"external"}


def test_stepping_with_arrays(models: residnet.Models, data: residnet.Data) -> None:
    model, log = models["ridge"], data.logs("test")[0]
    x0, w = log.y[0], log.w[:20]
    states = model.rollout(x0, w)
    x, s = x0, None
    for k in range(20):
        x, s = model.step(x, w[k], s)
        np.testing.assert_allclose(x, states[k + 1], rtol=1e-12)
    both = model.rollout(np.stack([x0, x0]), np.stack([w, w]))
    np.testing.assert_allclose(both[1], states, rtol=1e-12)
    assert model.warmup(log.y[:20], w).shape == (model.module.n_state,)


def test_save_load_export(
    models: residnet.Models, data: residnet.Data, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    residnet.save(models["net"], tmp_path / "net")
    again = residnet.load(tmp_path / "net")
    log = data.logs("test")[0]
    np.testing.assert_array_equal(
        again.rollout(log.y[0], log.w[:30]), models["net"].rollout(log.y[0], log.w[:30])
    )
    one = residnet.free_run(again, data).metrics
    many = residnet.free_run(models, data).metrics
    many = many[many["model"] == "net"].reset_index(drop=True)
    np.testing.assert_allclose(one["nrmse_mean"], many["nrmse_mean"], rtol=1e-12)
    card = residnet.export_model(again, tmp_path / "net.pt")
    assert card["model"] == "net"
    with pytest.raises(ResidnetError, match="stands there already"):
        residnet.save(models["net"], tmp_path / "net")


def test_progress_is_told_to_one_callback(trials: Path, data: residnet.Data) -> None:
    heard: list[residnet.Progress] = []
    residnet.read_logs(trials, channels=CHANNELS, time="time", progress=heard.append)
    assert heard[-1].done == heard[-1].total == 10
    residnet.fit(data, heads="ridge", progress=heard.append)
    assert any("fitting ridge" in entry.message for entry in heard)


def cli_rows(config: dict[str, Any], folder: Path, patch: pytest.MonkeyPatch) -> RunFolder:
    """The same config by the command line."""
    file = folder / "config.yaml"
    file.write_text(yaml.safe_dump(config, sort_keys=False))
    assert call(patch, "run", file, "--out", folder / "run") == 0
    return RunFolder(folder / "run")


@pytest.mark.long
def test_a_fit_by_function_mapping_and_command_line_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = copy.deepcopy(TINY)
    run = cli_rows(config, tmp_path, monkeypatch)
    table = metrics_table(run.read_metrics()["rows"])
    result = residnet.run(config, report=False)
    pd.testing.assert_frame_equal(result.metrics, table, rtol=1e-12)
    prepared, evaluation = config["prepare"], config["evaluation"]
    data = residnet.prepare(
        config["data"],
        config["signals"]["inputs"],
        forces=config["signals"]["forces"],
        step=prepared["grid"]["step"],
        derivative=prepared["derivative"],
        hold="start",
        held=(),
        **{key: evaluation[key] for key in ("protocols", "selection", "scales")},
    )
    models = residnet.fit(
        data,
        config["baseline"],
        {name: residnet.head(head) for name, head in config["heads"].items()},
        ensembles=config["ensembles"],
        training=config["training"],
    )
    pd.testing.assert_frame_equal(models.metrics, table, rtol=1e-9)
    assert models.selected == run.read_metrics()["selected"]
    loaded = residnet.load(tmp_path / "run", "ridge")
    assert loaded.coefficients.empty
    assert loaded.notes["validation"] == pytest.approx(models["ridge"].notes["validation"])


@pytest.mark.long
def test_a_simulation_by_function_mapping_and_command_line_is_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programme: dict[str, Any] = {
        "vessel": "wam_v_cal",
        "manoeuvres": [
            {"kind": "zigzag", "drive": 0.6, "steer": 0.4, "heading": "20 deg", "start": 3},
            {"kind": "waypoints", "drive": 0.7, "points": [[20, 0], [20, 20]], "acceptance": 3,
             "lookahead": 6},
        ],
        "duration": "60 s",
        "step": 0.1,
        "noise": {"u": 0.02},
        "seed": 3,
    }  # fmt: skip
    config = {"task": "simulate", "name": "flown", "programme": programme}
    run = cli_rows(config, tmp_path, monkeypatch)
    result = residnet.run(config)
    assert result.read("indices.json") == json.loads((run.path / "indices.json").read_text())
    trials = residnet.simulate(**programme)
    for log in trials.logs:
        stored = residnet.Log.load(run.path / "logs" / f"{log.name}.parquet")
        for name, values in log.channels.items():
            np.testing.assert_array_equal(stored[name], values)
    rows = result.read("indices.json")["rows"]
    overshoot = trials.indices["first_overshoot"].iloc[0]
    assert rows[0]["indices"]["first_overshoot"] == pytest.approx(overshoot, rel=1e-12)


@pytest.mark.long
def test_logs_alone_are_fitted_by_the_recipe(logs: list[residnet.Log]) -> None:
    models = residnet.fit([_coarse(log) for log in logs[:6]], effort=0.01)
    assert models.settings.recipe == "standard"
    assert models.settings.signals.inputs == ("n_port", "n_stbd")
    assert {"zero", "baseline", "hull", "hull_network", "mean"} <= set(models)
    assert models.selected in models


def _coarse(log: residnet.Log) -> residnet.Log:
    """Every eighth sample of a log."""
    channels = {name: values[::8] for name, values in log.channels.items()}
    return log.replace(t=log.t[::8], channels=channels, masks={})


def test_a_run_without_a_folder_leaves_nothing_behind() -> None:
    """Its files last as long as the result."""
    flown = {"vessel": "wam_v_cal", "manoeuvres": [{"kind": "constant", "drive": 0.5, "steer": 0}]}
    config = {"task": "simulate", "name": "gone", "programme": {**flown, "duration": 5}}
    result = residnet.run(config)
    assert result.read("summary.json")["figures"]["logs"]["value"] == 1
    assert result.verdict[0].startswith("All 1 manoeuvres ended as they should")
    assert "logs/constant_01.parquet" in result.files
    folder = result.folder
    del result
    assert not folder.exists()
