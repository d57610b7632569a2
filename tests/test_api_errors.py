"""What a stranger does wrong from Python is answered in one plain line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from written_trials import CHANNELS, write_trials

import residnet
from residnet.core.errors import ResidnetError


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strange")
    write_trials(folder / "trials", duration=30.0)
    (folder / "empty").mkdir()
    return folder


@pytest.fixture(scope="module")
def made(folder: Path) -> dict[str, Any]:
    logs = residnet.read_logs(folder / "trials", channels=CHANNELS, time="time")
    data = residnet.prepare(logs, ["n_port", "n_stbd"])
    models = residnet.fit(data, heads="ridge")
    return {"logs": logs, "data": data, "models": models, "folder": folder}


def wrong(value: object) -> Any:
    """An argument that no type checker would let pass."""
    return value


def coasting(log: residnet.Log) -> residnet.Log:
    return log.replace(channels={k: v for k, v in log.channels.items() if not k.startswith("n_")})


X, W = np.zeros(6), np.zeros(2)
CALLS: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "no logs": (lambda m: residnet.read_logs([]), "no log is given"),
    "a table": (
        lambda m: residnet.read_logs(wrong(pd.DataFrame())),
        "expected a path, given a DataFrame",
    ),
    "nothing": (lambda m: residnet.read_logs(wrong(None)), "expected a path, given None"),
    "no such file": (lambda m: residnet.read_logs("nowhere.csv"), "no such file"),
    "no match": (lambda m: residnet.read_logs("no*where.csv"), "matches no file"),
    "an empty folder": (lambda m: residnet.read_logs(m["folder"] / "empty"), "holds no log"),
    "no unit": (
        lambda m: residnet.read_logs(m["folder"] / "trials", channels={"u": "surge"}),
        r"channels: u: give the column and its unit, for example \('surge', 'm/s'\)",
    ),
    "a wrong unit": (
        lambda m: residnet.read_logs(m["folder"] / "trials", channels={"u": ("surge", "deg")}),
        "does not measure",
    ),
    "an unknown column": (
        lambda m: residnet.read_logs(
            m["folder"] / "trials", channels={"u": ("surg", "m/s")}, time="time"
        ),
        "no column 'surg'; did you mean 'surge'",
    ),
    "an unknown reader": (
        lambda m: residnet.read_logs(m["folder"] / "trials", reader="cvs"),
        "unknown value 'cvs'; did you mean 'csv'",
    ),
    "no inputs": (lambda m: residnet.prepare([coasting(log) for log in m["logs"]]), "inputs: no"),
    "inputs as text": (lambda m: residnet.prepare(m["logs"], "n_port"), "expected a list"),
    "an unknown input": (
        lambda m: residnet.prepare(m["logs"], ["n_prt", "n_stbd"]),
        "no channel 'n_prt'; did you mean 'n_port'",
    ),
    "a step with a wrong unit": (
        lambda m: residnet.prepare(m["logs"], ["n_port"], step="0.1 m"),
        "step: unit 'm' does not measure",
    ),
    "an unknown head": (
        lambda m: residnet.fit(m["data"], heads=["lsmt"]),
        "unknown value 'lsmt'; did you mean 'lstm'",
    ),
    "an unknown baseline": (
        lambda m: residnet.fit(m["data"], "regresors"),
        "unknown value 'regresors'; did you mean 'regressors'",
    ),
    "an unknown key": (
        lambda m: residnet.head("lstm", hiden_size=3),
        "hiden_size: unknown key; did you mean 'hidden_size'",
    ),
    "a text for a number": (lambda m: residnet.head("lstm", hidden_size="3"), "a whole number"),
    "logs instead of data": (lambda m: residnet.fit(wrong(3)), "expected logs, or data from"),
    "an unknown model": (lambda m: m["models"]["rigde"], "no model 'rigde'; did you mean 'ridge'"),
    "a wide w": (
        lambda m: m["models"]["ridge"].step(X, np.zeros(3)),
        r"w has the shape \[3\], expected \[B, 2\] or \[2\] \(inputs n_port, n_stbd\)",
    ),
    "a wide w in a free run": (
        lambda m: m["models"]["ridge"].rollout(X, np.zeros((10, 5))),
        r"w has the shape \[10, 5\], expected \[B, T, 2\]",
    ),
    "a narrow x": (lambda m: m["models"]["ridge"].step(np.zeros(3), W), r"x has the shape \[3\]"),
    "not a number": (
        lambda m: m["models"]["ridge"].step(X, [np.nan, 1.0]),
        "w holds a value that is not finite",
    ),
    "no numbers": (lambda m: m["models"]["ridge"].step("here", W), "x: expected numbers"),
    "unequal batches": (
        lambda m: m["models"]["ridge"].step(np.zeros((2, 6)), np.zeros((3, 2))),
        "2 states, but inputs for 3",
    ),
    "other inputs": (
        lambda m: residnet.free_run(m["models"], residnet.prepare(m["logs"], ["n_port"])),
        "has the inputs n_port, n_stbd, the data have n_port",
    ),
    "an unknown split": (
        lambda m: residnet.free_run(m["models"], m["data"], "tset"),
        "no split 'tset'; did you mean 'test'",
    ),
    "an unknown log": (
        lambda m: residnet.free_run(m["models"], m["data"]).plot_track("zigzag"),
        "no log 'zigzag'; ",
    ),
    "an unknown format": (
        lambda m: residnet.export_model(m["models"]["ridge"], "x", "torchscrip"),
        "did you mean 'torchscript'",
    ),
    "no model": (lambda m: residnet.save(m["data"], "x"), "expected a model, given a Data"),
    "nothing to load": (lambda m: residnet.load(m["folder"]), "no model here"),
    "an unknown vessel": (lambda m: residnet.vessel("wam_v_call"), "did you mean 'wam_v_cal'"),
    "an unknown manoeuvre": (
        lambda m: residnet.simulate("wam_v_cal", "zigzagg"),
        "unknown value 'zigzagg'; did you mean 'zigzag'",
    ),
    "nothing flown": (lambda m: residnet.simulate("wam_v_cal"), "nothing is flown"),
    "an unknown list": (lambda m: residnet.available(wrong("head")), "did you mean 'heads'"),
    "an unknown task": (lambda m: residnet.run({"task": "fitt"}), "did you mean 'fit'"),
    "no config": (lambda m: residnet.run(wrong(3)), "expected the path of a YAML file"),
    "overrides of a mapping": (
        lambda m: residnet.run({"task": "fit"}, overrides=["seed=1"]),
        "overrides are for a file",
    ),
    "no callback": (
        lambda m: residnet.fit(m["data"], progress=wrong(3)),
        "progress: expected a function",
    ),
}


@pytest.mark.parametrize("case", CALLS)
def test_one_line(case: str, made: dict[str, Any]) -> None:
    wrong, message = CALLS[case]
    with pytest.raises(ResidnetError, match=message) as caught:
        wrong(made)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
