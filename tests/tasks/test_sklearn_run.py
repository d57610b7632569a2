"""Runs with heads of scikit-learn: they reach their end, and what is not stored needs `--trust`."""

from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from forged_run import forge_sums
from pictures import omit_drawings
from tiny import TINY, Command, read_json, write_yaml

from residnet import load
from residnet.core.errors import UsageError
from residnet.evaluation import soundness


def _config(head: dict[str, Any]) -> dict[str, Any]:
    """Return a fit of a few seconds with one head of scikit-learn."""
    config = copy.deepcopy(TINY)
    config |= {"name": "boosted", "heads": {"boosting": head}, "bands": None}
    config |= {"ensembles": {}, "training": {}, "export": {"models": []}}
    # a step of these heads takes a millisecond: few, short free runs suffice
    config["data"] |= {
        "duration": 15,
        "trials": [
            {"kind": "zigzag", "count": 5, "heading": ["20 deg"], "start": 1},
            {"kind": "three_two_one_one", "count": 2, "start": 1},
        ],
        "identification": {"zigzag": 4, "three_two_one_one": 1},
        "validation": {"zigzag": 1, "three_two_one_one": 0},
    }
    config["baseline"] = {"kind": "regressors", "terms": ["u", "v", "r", "tau_x", "tau_n"]}
    del config["evaluation"]["protocols"]["T10"]
    return config


PLAIN = {"kind": "sklearn", "samples": 200}
BAGGING = {
    "kind": "sklearn",
    "samples": 100,
    "pipeline": [{"sklearn.ensemble.BaggingRegressor": {"n_estimators": 2}}],
}
MEMORY = {
    "kind": "sklearn",
    "pipeline": [
        {"sklearn.cluster.FeatureAgglomeration": {"memory": "cache", "n_clusters": 2}},
        "sklearn.linear_model.LinearRegression",
    ],
}


@pytest.fixture(autouse=True)
def _quick_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omit drawings, and check the boundedness over 30 s: each step takes four milliseconds."""
    omit_drawings(monkeypatch)
    monkeypatch.setattr(soundness, "_LONG_RUN_DURATION", 30.0)


def test_run_with_sklearn_head_completes(command: Command, tmp_path: Path) -> None:
    """TorchScript accepted it, and failed in the check of bounded free runs."""
    config = write_yaml(tmp_path / "plain.yaml", _config(PLAIN))
    run = tmp_path / "run"
    ended = command("run", config, "--out", run, "--quiet")
    assert ended.code == 0, ended.err
    assert read_json(run / "summary.json")["finished"]
    rows = read_json(run / "metrics.json")["rows"]
    assert "boosting" in {row["model"] for row in rows}
    assert load(run, "boosting").module.head.axis_pipelines
    ended = command("export", run, "--model", "boosting", "--anyway")
    assert (ended.code, ended.err.count("\n")) == (1, 1)
    assert "scikit-learn need Python" in ended.err


# 5 s; test_run_with_sklearn_head_completes carries out a run, too
@pytest.mark.long
def test_run_with_other_classes_needs_trust(command: Command, tmp_path: Path) -> None:
    config = write_yaml(tmp_path / "bagging.yaml", _config(BAGGING))
    run = tmp_path / "run"
    ended = command("run", config, "--out", run, "--quiet")
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert "BaggingRegressor' is not among the classes" in ended.err
    assert not run.exists()
    assert command("run", config, "--out", run, "--quiet", "--trust").code == 0
    with pytest.raises(UsageError, match="--trust"):
        load(run, "boosting")
    assert load(run, "boosting", trust=True).module.head.axis_pipelines
    # the permission ends with the command
    assert command("check", config).code == 2
    assert command("check", config, "--trust").code == 0


@pytest.mark.parametrize("trust", [(), ("--trust",)])
def test_run_and_export_refuse_a_store_of_pickles(
    trust: tuple[str, ...], command: Command, tiny_run: Path, tmp_path: Path
) -> None:
    """A model that names a joblib store in its description: `export` ran what lay there."""
    config = write_yaml(tmp_path / "memory.yaml", _config(MEMORY))
    ended = command("run", config, "--out", tmp_path / "run", *trust)
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert ("is a cache of pickles" if trust else "is not among") in ended.err
    stranger = tmp_path / "stranger"
    shutil.copytree(tiny_run, stranger)
    _plant(stranger, MEMORY)
    ended = command("export", stranger, "--model", "ridge", *trust)
    assert (ended.code, ended.err.count("\n")) == (2, 1)
    assert ("is a cache of pickles" if trust else "is not among") in ended.err


def _plant(run: Path, head: dict[str, Any]) -> None:
    """Put a head into a model's description, and correct all sums, as an attacker does."""
    card = run / "models" / "ridge" / "model.json"
    card.write_text(json.dumps({**read_json(card), "head": head}))
    forge_sums(run)
