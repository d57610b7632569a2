"""A configuration that runs in seconds, and how tests call commands."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from residnet.cli import main

TINY: dict[str, Any] = {
    "task": "fit",
    "name": "tiny",
    "data": {
        "kind": "simulated",
        "vessel": "wam_v_cal",
        "duration": 30,
        "substeps": 1,
        "step": 0.1,
        "trials": [
            {"kind": "constant", "drive": [0.4, 0.9], "steer": [-0.4, 0.0, 0.4]},
            {"kind": "zigzag", "count": 5, "heading": ["20 deg"], "start": 3},
            {"kind": "acceleration_deceleration", "count": 3},
            {"kind": "three_two_one_one", "count": 3, "start": 3},
        ],
        "identification": {"zigzag": 4, "acceleration_deceleration": 2, "three_two_one_one": 2},
        "validation": {"zigzag": 1, "acceleration_deceleration": 0, "three_two_one_one": 0},
    },
    "prepare": {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
    },
    "signals": {"inputs": ["n_port", "n_stbd"], "forces": "wam_v_cal"},
    "baseline": {"kind": "linear_steady", "settled": 20},
    "heads": {
        "ridge": {"kind": "ridge"},
        "lstm": {"kind": "lstm", "hidden_size": 6, "dropout": 0.1},
    },
    "ensembles": {"ensemble": ["ridge", "lstm"]},
    "training": {
        "lstm": {
            "steps": 3,
            "one_step": {"epochs": 2, "window": 2.0, "batch": 16},
            "multi_step": [
                {"horizon": 1.0, "epochs": 2, "batch": 16},
                {"horizon": 2.0, "epochs": 3, "batch": 16},
            ],
            "start_noise": 0.1,
        }
    },
    "evaluation": {
        "protocols": {
            "manoeuvre": {"kind": "manoeuvre"},
            "T10": {"kind": "windows", "length": 10, "first": 2, "history": 1},
        },
        "selection": "manoeuvre",
        "scales": {"u": 0.35, "v": 0.16, "r": 0.24},
    },
    "export": {"models": ["lstm"]},
}


def call(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """Exit code of a command, in this process."""
    monkeypatch.setattr("sys.argv", ["residnet", *map(str, words)])
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


class Said(NamedTuple):
    """How a command ended, and what it printed."""

    code: int
    out: str
    err: str


Command = Callable[..., Said]
"""The fixture that carries out a command line."""


def write_yaml(path: Path, content: Any) -> Path:
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def read_json(path: Path) -> Any:
    return json.loads(path.read_text())


SWEEP: dict[str, Any] = {
    "task": "sweep",
    "name": "tiny_sweep",
    "base": "tiny.yaml",
    "common": [
        "data.duration=15",
        "data.trials=[{kind: zigzag, count: 5, heading: [20 deg], start: 1},"
        " {kind: three_two_one_one, count: 2, start: 1}]",
        "data.identification={zigzag: 4, three_two_one_one: 1}",
        "data.validation={zigzag: 1, three_two_one_one: 0}",
        "baseline={kind: regressors, terms: [u, v, r, tau_x, tau_n]}",
        "heads={ridge: {kind: ridge}}",
        "training={}",
        "ensembles={}",
        "bands=null",
        "export.models=[]",
        "evaluation.splits=[validation]",
        "~evaluation.protocols.T10",
    ],
    "space": {
        "heads.ridge.degree": {"choices": [1, 2]},
        "prepare.derivative.window": {"low": 0.7, "high": 1.9, "points": 2},
    },
    "search": {"kind": "grid"},
    "objective": {"kind": "free_run", "model": "ridge"},
    "runner": {"kind": "processes", "workers": 1},
}
"""A sweep over `TINY`, which lies beside it as tiny.yaml."""
VARIANTS: dict[str, Any] = {
    "task": "sweep",
    "name": "tiny_variants",
    "base": "tiny.yaml",
    "common": ["heads={ridge: {kind: ridge}}", "training={}", "ensembles={}", "export.models=[]"],
    "search": {
        "kind": "variants",
        "variants": {"recipe": [], "short": ["heads.ridge.degree=1"]},
        "reference": "recipe",
        "model": "ridge",
        "seeds": [0, 1],
    },
    "runner": {"kind": "processes", "workers": 1},
}
"""Another recipe and another seed of `TINY`, which lies beside it as tiny.yaml."""
