"""The Python interface: lazy, the numbers of the command line, and its errors in one line."""

from __future__ import annotations

import copy
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from tiny import TINY

import residnet
from residnet.core.config import validate_config
from residnet.core.errors import ResidnetError, UsageError
from residnet.evaluation.metrics_file import build_metrics_table
from residnet.evaluation.protocol import EvaluationConfig
from residnet.evaluation.records import MetricsFile
from residnet.export import vessel
from residnet.io.split import split_logs
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig
from residnet.training.current_config import CurrentConfig

EXAMPLE = Path(__file__).parents[1] / "examples" / "fifteen_lines.py"
CHANNELS = {
    "x": ("north", "m"),
    "y": ("east", "m"),
    "psi": ("heading", "deg"),
    "u": ("surge", "m/s"),
    "v": ("sway", "m/s"),
    "r": ("yaw rate", "deg/s"),
    "n_port": ("port", "rpm"),
    "n_stbd": ("starboard", "rpm"),
}
FACTORS = {"deg": 180.0 / math.pi, "deg/s": 180.0 / math.pi, "rpm": 60.0}


@pytest.fixture(scope="module")
def trials(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sea trials as a stranger would hand them over: csv, odd names, degrees and rpm."""
    (folder := tmp_path_factory.mktemp("api") / "trials").mkdir()
    zigzag = {"kind": "zigzag", "heading": "20 deg", "start": 3}
    circle = {"kind": "turning_circle", "start": 3}
    pairs = [(drive, steer) for drive in (0.4, 0.6, 0.8) for steer in (0.3, 0.5)]
    flown = [zigzag | {"drive": drive, "steer": steer} for drive, steer in pairs]
    flown += [circle | {"drive": d, "steer": s} for d in (0.4, 0.8) for s in (0.3, -0.5)]
    noise = {"u": 0.01, "v": 0.01, "r": 0.002}
    made = residnet.simulate("wam_v_cal", flown, duration=40.0, step=0.1, noise=noise, seed=1)
    for log in made.logs:
        columns = {"time": log.t}
        for name, (column, unit) in CHANNELS.items():
            columns[column] = log[name] * FACTORS.get(unit, 1.0)
        pd.DataFrame(columns).to_csv(folder / f"{log.name}.csv", index=False)
    return folder


@pytest.fixture(scope="module")
def logs(trials: Path) -> list[residnet.Log]:
    return residnet.read_logs(trials, channels=CHANNELS, time="time")


@pytest.fixture(scope="module")
def data(logs: list[residnet.Log]) -> residnet.Dataset:
    return residnet.prepare(logs, ["n_port", "n_stbd"])


@pytest.fixture(scope="module")
def models(data: residnet.Dataset) -> residnet.Models:
    heads = {"ridge": "ridge", "net": {"kind": "mlp", "hidden": (8,)}}
    return residnet.fit(data, heads=heads, effort=0.2)


def test_the_face_loads_nothing_and_every_name_is_there_and_documented() -> None:
    code = (
        "import sys, residnet;"
        "heavy = {'torch', 'pandas', 'numpy', 'pydantic', 'matplotlib'} & set(sys.modules);"
        "print(sorted(heavy), len(dir(residnet)))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["[]", str(len(residnet.__all__))]
    for name in residnet.__all__:
        assert getattr(residnet, name).__doc__
    with pytest.raises(AttributeError, match="no attribute 'fitt'"):
        _ = residnet.fitt  # type: ignore[attr-defined]


def test_logs_have_one_recipe_whoever_asks(trials: Path, data: residnet.Dataset) -> None:
    assert data.prepare.grid.step == 0.1
    assert dict(data.table["split"].value_counts()) == {"train": 5, "validation": 2, "test": 3}
    assert data.prepare.hold == "mean"
    assert data.evaluation.selection == next(iter(data.evaluation.protocols))
    draft = residnet.draft_config(trials, folder=trials.parent)
    logs = residnet.read_logs(trials, reader=draft.config["data"]["reader"])
    heard: list[residnet.Progress] = []
    fitted = residnet.fit(logs, "regressors", bands=None, progress=heard.append).settings
    assert any("fitting baseline" in entry.message for entry in heard)
    prepared = residnet.prepare(logs)
    for key, kind in (
        ("prepare", PrepareConfig),
        ("signals", SignalsConfig),
        ("evaluation", EvaluationConfig),
    ):
        drafted = validate_config(draft.config[key], kind, key)
        assert getattr(prepared, key) == drafted, key
        assert getattr(fitted, key) == drafted, key
    residnet.read_logs(trials, channels=CHANNELS, time="time", progress=heard.append)
    assert heard[-1].done == heard[-1].total == 10


def test_tables_without_names_or_time_are_read(trials: Path, tmp_path: Path) -> None:
    table = pd.read_csv(min(trials.glob("*.csv")))
    table.drop(columns="time").to_csv(tmp_path / "no_time.csv", index=False)
    table.to_csv(tmp_path / "no_names.csv", index=False, header=False)
    with pytest.raises(ResidnetError, match=r"in Python read_logs\(files, time="):
        residnet.read_logs(tmp_path / "no_time.csv")
    with pytest.raises(ResidnetError, match=r"in Python read_logs\(files, names="):
        residnet.read_logs(tmp_path / "no_names.csv")
    (stepped,) = residnet.read_logs(tmp_path / "no_time.csv", time={"step": "0.1 s"})
    (named,) = residnet.read_logs(tmp_path / "no_names.csv", names=list(table.columns))
    (mapped,) = residnet.read_logs(
        tmp_path / "no_names.csv",
        names=list(table.columns),
        channels={"u": CHANNELS["u"]},
        time={"step": "0.1 s"},
    )
    for log in (stepped, named, mapped):
        np.testing.assert_allclose(log["u"], table["surge"], atol=1e-9)
        np.testing.assert_allclose(np.diff(log.t), 0.1, atol=1e-6)


def test_inputs_that_move_as_others_are_unexcited(logs: list[residnet.Log]) -> None:
    alike = [
        log.replace(
            channels={
                **log.channels,
                "n_stbd": log["n_port"],
                "delta": 0.02 * (log["n_port"] - log["n_stbd"]),
            }
        )
        for log in logs
    ]
    signals = residnet.prepare(alike).signals
    assert signals.inputs == ("n_port", "delta")
    assert signals.unexcited == ("n_stbd",)


def test_inputs_that_only_other_logs_vary_are_held(logs: list[residnet.Log]) -> None:
    splits = {split: [log.name for log in members] for split, members in split_logs(logs).items()}
    varying = splits["test"][0]
    with_trim = [
        log.replace(
            channels={
                **log.channels,
                "n": np.where((log.name == varying) & (log.t > log.t.mean()), 20.0, 12.0),
            }
        )
        for log in logs
    ]
    heard: list[residnet.Progress] = []
    data = residnet.prepare(with_trim, progress=heard.append)
    assert "n" not in data.signals.inputs
    assert data.signals.unexcited == ("n",)
    text = f"n is constant at 12 in the training logs.*train on {varying} to identify"
    assert any(re.search(text, report.message) for report in heard)
    models = residnet.fit(data, "regressors", bands=None)
    assert any("n was held at" in sentence for sentence in models.excitation.domain)
    explicit = residnet.prepare(with_trim, [*data.signals.inputs, "n"])
    with pytest.raises(ResidnetError, match=r"regressor 'n' is constant.*`unexcited`"):
        residnet.fit(explicit, "regressors", bands=None)
    held = residnet.prepare(with_trim, data.signals.inputs, unexcited=["n"])
    assert held.signals == data.signals


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


def test_tables_and_figures(models: residnet.Models, data: residnet.Dataset) -> None:
    table = residnet.metrics(models, split="test")
    assert set(table["model"]) == {"constant_velocity", "baseline", "ridge", "net"}
    error = table[table["protocol"] == "T30"].set_index("model")["nrmse_mean"]
    assert error["ridge"] < error["baseline"] < error["constant_velocity"]
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
    assert runs.plot_track(width=3.4).get_figwidth() == pytest.approx(3.4)
    assert residnet.select_model(models).name == models.selected_name
    lead = f" free run the position error of {models.selected_name} is "
    assert lead in models.verdict[0]
    told = f"On test data the velocity errors of {models.selected_name} "
    assert any(sentence.startswith(told) for sentence in models.verdict)
    assert models.selection.reason in models.verdict
    assert list(models["baseline"].coefficients["axis"].unique()) == ["u_dot", "v_dot", "r_dot"]


def test_figures_are_drawn_on_axes_of_the_caller(
    models: residnet.Models, data: residnet.Dataset, tmp_path: Path
) -> None:
    runs = residnet.free_run(models, data)
    with plt.rc_context({"font.size": 6.0}):
        figure, axes = plt.subplots(2, 3, figsize=(3.4, 2.0))
        track, *histories, spare = axes.ravel()
        assert runs.plot_track(models=["ridge"], ax=track) is figure
        assert runs.plot_history(models=["ridge"], ax=histories) is figure
    assert {line.get_label() for line in track.lines} >= {"measured", "ridge"}
    assert all(len(part.lines) >= 2 for part in histories)
    assert not spare.lines
    # the caller's size of letters and figure
    assert track.xaxis.label.get_size() == 6.0
    assert figure.get_figwidth() == pytest.approx(3.4)
    for name, start in (("track.pdf", b"%PDF"), ("track.svg", b"<?xml")):
        figure.savefig(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    with pytest.raises(UsageError, match=r"expected 4 axes, one each for .*; got 1"):
        runs.plot_history(ax=[track])
    plt.close(figure)


def test_other_logs_are_judged_as_those_of_the_fit(
    models: residnet.Models, data: residnet.Dataset, logs: list[residnet.Log]
) -> None:
    names = {log.log.name for log in data.logs("test")}
    other = residnet.prepare([log for log in logs if log.name in names], settings_from=data)
    again = residnet.metrics(models, other, manoeuvre=None)
    table = residnet.metrics(models, split="test", manoeuvre=None)
    columns = ["nrmse_mean", "position_error_end"]
    np.testing.assert_allclose(again[columns], table[columns], rtol=1e-12)
    assert set(again["split"]) == {"external"}


def test_stepping_with_arrays(models: residnet.Models, data: residnet.Dataset) -> None:
    model = models["ridge"]
    log = data.logs("test")[0]
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
    models: residnet.Models, data: residnet.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    with pytest.raises(ResidnetError, match="already contains a model"):
        residnet.save(models["net"], tmp_path / "net")


def prepare_by_config(config: dict[str, Any], **evaluation: Any) -> residnet.Dataset:
    """Prepare the data of a config with the settings of its sections in Python."""
    preparation = config["prepare"]
    return residnet.prepare(
        config["data"],
        config["signals"]["inputs"],
        forces=config["signals"]["forces"],
        step=preparation["grid"]["step"],
        derivative=preparation["derivative"],
        hold="start",
        held_channels=(),
        **evaluation,
    )


@pytest.mark.long
def test_a_fit_by_function_mapping_and_command_line_is_one(tiny_run: Path) -> None:
    config = copy.deepcopy(TINY)
    metrics = MetricsFile.read(tiny_run / "metrics.json")
    table = build_metrics_table(metrics.rows)
    result = residnet.run(config, report=False)
    pd.testing.assert_frame_equal(result.metrics, table, rtol=1e-12)
    evaluation = {key: config["evaluation"][key] for key in ("protocols", "selection", "scales")}
    data = prepare_by_config(config, **evaluation)
    models = residnet.fit(
        data,
        config["baseline"],
        {name: residnet.head(head) for name, head in config["heads"].items()},
        ensembles=config["ensembles"],
        training=config["training"],
    )
    pd.testing.assert_frame_equal(models.metrics, table, rtol=1e-9)
    assert models.selected_name == metrics.selected
    loaded = residnet.load(tiny_run, "ridge")
    assert loaded.coefficients.empty
    assert loaded.notes["validation"] == pytest.approx(models["ridge"].notes["validation"])


def test_currents_are_estimated_as_by_the_key_of_a_config() -> None:
    config = copy.deepcopy(TINY)
    # zigzags and steps alone, which excite most
    config["data"] |= {
        "disturbance": {"current_each": [0.2, 0.4]},
        "trials": [config["data"]["trials"][k] for k in (1, 3)],
        "identification": {"zigzag": 4, "three_two_one_one": 2},
        "validation": {"zigzag": 1},
    }
    config |= {"heads": {}, "ensembles": {}, "training": {}, "current": {}, "bands": None}
    config["baseline"] = {"kind": "regressors", "sets": ["linear"]}
    simulated = validate_config(config["data"], SimulatedTrials, "data")
    names = [log.name for log in simulate_trial_logs(simulated.draw_manoeuvres(), simulated)]
    truth = simulated.disturbance.draw_currents(len(names), simulated.seed)
    data = prepare_by_config(config)
    models = residnet.fit(data, config["baseline"], current={}, bands=None)
    currents = models.currents.set_index("log")
    assert set(currents.index) == {log.log.name for logs in data.splits.values() for log in logs}
    components = ["current_north", "current_east"]
    error = currents[components] - pd.DataFrame(truth, names, components)
    assert error.abs().median().max() < 0.1
    still = residnet.fit(data, config["baseline"], bands=None)
    assert still.currents.empty
    assert list(still.currents.columns) == ["log", *currents.columns]
    # the baseline is that of the motion through the water
    assert not models["baseline"].coefficients.equals(still["baseline"].coefficients)
    again = residnet.fit(data, config["baseline"], current=CurrentConfig(), bands=None)
    pd.testing.assert_frame_equal(again.currents, models.currents)
    with pytest.raises(ResidnetError, match=r"current\.spread"):
        residnet.fit(data, config["baseline"], current={"spread": -1.0})


# 3 s; tasks/test_simulate.py simulates by config
@pytest.mark.long
def test_a_simulation_by_function_and_mapping_is_one() -> None:
    zigzag = {"kind": "zigzag", "drive": 0.6, "steer": 0.4, "heading": "20 deg", "start": 3}
    way = {"kind": "waypoints", "drive": 0.7, "points": [[20, 0], [20, 20]], "acceptance": 3}
    programme: dict[str, Any] = {
        "vessel": "wam_v_cal",
        "manoeuvres": [zigzag, way | {"lookahead": 6}],
        "duration": "60 s",
        "step": 0.1,
        "noise": {"u": 0.02},
        "seed": 3,
    }
    config = {"task": "simulate", "name": "gone", "programme": programme}
    result = residnet.run(config, report=False)
    trials = residnet.simulate(**programme)
    for log in trials.logs:
        stored = residnet.Log.load(result.folder / "logs" / f"{log.name}.parquet")
        for name, values in log.channels.items():
            np.testing.assert_array_equal(stored[name], values)
    overshoot = trials.indices["first_overshoot"].iloc[0]
    found = result.read_file("indices.json")["rows"][0]["indices"]
    assert found["first_overshoot"] == pytest.approx(overshoot, rel=1e-12)
    assert result.read_file("summary.json")["figures"]["logs"]["value"] == 2
    assert result.verdict[0].startswith("All 2 manoeuvres were completed")
    assert "logs/zigzag_01.parquet" in result.file_names
    folder = result.folder
    assert folder.exists()
    del result
    assert not folder.exists(), "without a folder of one's own nothing is left behind"


@pytest.mark.long
def test_logs_alone_are_fitted_by_the_recipe(logs: list[residnet.Log]) -> None:
    coarse = [log.select_rows(slice(None, None, 8)).replace(masks={}) for log in logs[:6]]
    models = residnet.fit(coarse, effort=0.01)
    assert models.settings.recipe == "standard"
    assert models.settings.signals.inputs == ("n_port", "n_stbd")
    assert {"constant_velocity", "baseline", "hull", "hull_network", "ensemble"} <= set(models)
    assert models.selected_name in models


WRONG = [
    ("read_logs([])", "no log is given"),
    ("read_logs(pd.DataFrame())", "expected a path, given a DataFrame"),
    ("read_logs('nowhere.csv')", "no such file"),
    ("read_logs('no*where.csv')", "matches no file"),
    ("read_logs(folder / 'empty')", "has no log"),
    (
        "read_logs(folder, channels={'u': 'surge'})",
        r"channels: u: give the column and its unit, for example \('surge', 'm/s'\)",
    ),
    (
        "read_logs(folder, channels={'u': ('surg', 'm/s')}, time='time')",
        "no column 'surg'; did you mean 'surge'",
    ),
    ("read_logs(folder, reader='cvs')", "unknown value 'cvs'; did you mean 'csv'"),
    ("prepare([coasting(log) for log in logs])", "inputs: no"),
    ("prepare(logs, 'n_port')", "expected a list"),
    ("prepare(logs, ['n_prt', 'n_stbd'])", "no channel 'n_prt'; did you mean 'n_port'"),
    ("prepare(logs, ['n_port'], step='0.1 m')", "step: unit 'm' does not measure"),
    ("fit(data, heads='lsmt')", "unknown value 'lsmt'; did you mean 'lstm'"),
    ("fit(data, 'regresors')", "unknown value 'regresors'; did you mean 'regressors'"),
    ("head('lstm', hiden_size=3)", "hiden_size: unknown key; did you mean 'hidden_size'"),
    ("head('lstm', hidden_size='3')", "a whole number"),
    ("fit(3)", "expected logs, or data from"),
    ("models['rigde']", "no model 'rigde'; did you mean 'ridge'"),
    (
        "ridge.step(x, np.zeros(3))",
        r"w has the shape \[3\], expected \[B, 2\] or \[2\] \(inputs n_port, n_stbd\)",
    ),
    ("ridge.rollout(x, np.zeros((10, 5)))", r"w has the shape \[10, 5\], expected \[B, T, 2\]"),
    ("ridge.step(np.zeros(3), w)", r"x has the shape \[3\]"),
    ("ridge.step(x, [np.nan, 1.0])", "w contains a value that is not finite"),
    ("ridge.step('here', w)", "x: expected numbers"),
    ("ridge.step(np.zeros((2, 6)), np.zeros((3, 2)))", "2 states, but inputs for 3"),
    (
        "free_run(models, prepare(logs, ['n_port']))",
        "has the inputs n_port, n_stbd, the data have n_port",
    ),
    ("free_run(models, data, 'tset')", "no split 'tset'; did you mean 'test'"),
    ("free_run(models, data).plot_track('zigzag')", "no log 'zigzag'; "),
    ("export_model(ridge, 'x', 'torchscrip')", "did you mean 'torchscript'"),
    ("save(data, 'x')", "expected a model, given a Dataset"),
    ("load(folder)", "checksums.json"),
    ("vessel('wam_v_call')", "did you mean 'wam_v_cal'"),
    ("simulate('wam_v_cal', 'zigzagg')", "unknown value 'zigzagg'; did you mean 'zigzag'"),
    ("simulate('wam_v_cal')", "no manoeuvre"),
    ("list_available('head')", "did you mean 'heads'"),
    ("run({'task': 'fitt'})", "did you mean 'fit'"),
    ("run(3)", "expected the path of a YAML file"),
    ("run({'task': 'fit'}, overrides=['seed=1'])", "overrides are for a file"),
    ("fit(data, progress=3)", "progress: expected a function"),
    ("fit([throttled(log) for log in logs])", "turns by up to .* and no input steers it; map"),
]


def coasting(log: residnet.Log) -> residnet.Log:
    return log.replace(channels={k: v for k, v in log.channels.items() if not k.startswith("n_")})


def throttled(log: residnet.Log) -> residnet.Log:
    throttle = 0.01 * (log["n_port"] + log["n_stbd"])
    return log.replace(channels={**coasting(log).channels, "throttle": throttle})


@pytest.mark.parametrize(("call", "message"), WRONG)
def test_what_a_stranger_does_wrong_is_answered_in_one_plain_line(
    call: str,
    message: str,
    trials: Path,
    logs: list[residnet.Log],
    data: residnet.Dataset,
    models: residnet.Models,
) -> None:
    (trials / "empty").mkdir(exist_ok=True)
    names = {name: getattr(residnet, name) for name in residnet.__all__}
    names |= {"np": np, "pd": pd, "coasting": coasting, "x": np.zeros(6), "w": np.zeros(2)}
    names |= {"throttled": throttled}
    names |= {"folder": trials, "logs": logs, "data": data, "models": models}
    with pytest.raises(ResidnetError, match=message) as caught:
        eval(call, {**names, "ridge": models["ridge"]})
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
