"""`check` refuses what `run` refuses, with the same line, and nothing is written before it."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from tiny import TINY, call

MEASURED: dict[str, Any] = {
    key: value for key, value in TINY.items() if key not in ("ensembles", "training", "export")
} | {
    "data": {
        "kind": "measured",
        "reader": {
            "kind": "csv",
            "time": {"column": "t", "unit": "s"},
            "channels": {
                "x": {"column": "x", "unit": "m"},
                "y": {"column": "y", "unit": "m"},
                "psi": {"column": "psi", "unit": "rad"},
                "u": {"column": "u", "unit": "m/s"},
                "v": {"column": "v", "unit": "m/s"},
                "r": {"column": "r", "unit": "rad/s"},
                "n_port": {"column": "port", "unit": "1/s"},
                "n_stbd": {"column": "stbd", "unit": "1/s"},
            },
        },
        "split": {"root": ".", "train": ["a*.csv"], "validation": ["b.csv"], "test": ["c.csv"]},
    },
    "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]},
    "heads": {"ridge": {"kind": "ridge"}},
}


@pytest.fixture
def logs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Four small tables in the current folder."""
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(0)
    for name in ("a1", "a2", "b", "c"):
        t = np.arange(0.0, 25.0, 0.1)
        columns = {key: random.normal(size=t.size).cumsum() * 0.01 for key in ("psi", "v", "r")}
        pd.DataFrame(
            {"t": t, "x": 1.3 * t + random.normal(size=t.size), "y": 0.3 * t, "u": 1.3 + 0.1 * t}
            | columns
            | {"port": 10 + np.sin(t), "stbd": 10 + np.cos(0.7 * t) + random.random(t.size)}
        ).to_csv(tmp_path / f"{name}.csv", index=False)
    return tmp_path


def refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], config: dict[str, Any]
) -> tuple[int, str]:
    """Exit code and line of both commands, which must be the same."""
    Path("made.yaml").write_text(yaml.safe_dump(config, sort_keys=False))
    capsys.readouterr()
    answers = []
    for words in (("check", "made.yaml"), ("run", "made.yaml", "--out", "out")):
        code = call(monkeypatch, *words)
        answers.append((code, capsys.readouterr().err.strip().splitlines()[-1:]))
    assert answers[0] == answers[1]
    assert not Path("out").exists(), "nothing is begun"
    code, line = answers[0]
    return code, line[0] if line else ""


def changed(base: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """The config with one value changed; keys stand apart by dots."""
    out = copy.deepcopy(base)
    *path, last = key.split(".")
    place = out
    for part in path:
        place = place[part]
    place[last] = value
    return out


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "a column is missing": (
        changed(MEASURED, "data.reader.channels.u.column", "speed"),
        "no column 'speed'",
    ),
    "the model's input is no channel": (
        changed(MEASURED, "signals", {"inputs": ["n_port", "delta"]})
        | {"baseline": {"kind": "regressors", "terms": ["u", "v", "r", "delta"]}},
        "delta",
    ),
    "too few manoeuvres for the folds": (
        changed(MEASURED, "heads.ridge", {"kind": "ridge", "folds": 3}),
        "head ridge: 3 folds need as many manoeuvres, the training data have 2",
    ),
    "kinds that are not there": (
        changed(MEASURED, "baseline.manoeuvres", ["zigzag"]),
        "no sample is of the manoeuvres",
    ),
    "a training longer than any log": (
        changed(MEASURED, "heads", {"net": {"kind": "mlp", "hidden": [4]}})
        | {"training": {"net": {"one_step": {"epochs": 1, "window": 99.0}}}},
        "no training log holds a window of 990 samples",
    ),
    "a refit longer than any log": (
        MEASURED | {"refit": {"baseline": {"horizon": 200.0}}},
        "no training log holds a window of 2001 samples",
    ),
    "windows longer than any log": (
        changed(MEASURED, "evaluation.protocols", {"T900": {"kind": "windows", "length": 900}})
        | {
            "evaluation": MEASURED["evaluation"]
            | {"protocols": {"T900": {"kind": "windows", "length": 900}}, "selection": "T900"}
        },
        "shorter than a window of every protocol",
    ),
    "simulated: a channel that the vessel lacks": (
        changed(TINY, "signals", {"inputs": ["n_port", "delta"]})
        | {
            "baseline": {"kind": "regressors", "terms": ["u", "v", "r", "delta"]},
            "ensembles": {},
        },
        "delta",
    ),
    "simulated: too few manoeuvres for the folds": (
        changed(TINY, "heads.ridge", {"kind": "ridge", "folds": 40}),
        "head ridge: 40 folds need as many manoeuvres",
    ),
    "simulated: kinds that are not flown": (
        changed(TINY, "baseline", {"kind": "linear_steady", "speed": ["spiral"]}),
        "linear_steady",
    ),
    "simulated trials without a test set": (
        {
            "task": "simulate",
            "name": "trials",
            "data": changed(TINY, "data.identification", {"zigzag": 5})["data"],
        },
        "leaves a split empty",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_run_refuses_before_its_work(
    fault: str, logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, line = FAULTS[fault]
    code, found = refused(monkeypatch, capsys, config)
    assert code in (1, 2)
    assert line in found


def test_files_that_cannot_be_read(
    logs: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = (logs / "a2.csv").read_bytes()
    for contents in (b"", b"\x00\xff" * 50, b"t,x\n1,2\n", whole[:40]):
        (logs / "a2.csv").write_bytes(contents)
        code, found = refused(monkeypatch, capsys, MEASURED)
        assert code in (1, 2)
        assert "a2.csv" in found
    (logs / "a2.csv").write_bytes(whole)
    assert call(monkeypatch, "check", "made.yaml") == 0
