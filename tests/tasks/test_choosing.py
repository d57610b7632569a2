"""Free runs choose between solutions of a closed-form fit: alone, and in a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from tiny import TINY, call

from residnet.baselines import RegressorsConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import ZeroHead
from residnet.physics.signals import SignalsConfig
from residnet.regression.solutions import Solution
from residnet.tasks.choosing import choose


def model() -> HybridDynamics:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    return HybridDynamics(
        signals, RegressorsConfig(terms=("u",)).build(signals.names), ZeroHead(), 0.1
    )


def solutions(*values: float) -> list[Solution]:
    return [
        Solution({"value": value}, {"theta": torch.full((3, 1), value, dtype=torch.float64)})
        for value in values
    ]


def test_the_best_free_run_is_kept() -> None:
    own = model()

    def bench(candidate: HybridDynamics) -> float:
        return abs(float(candidate.baseline.theta[0, 0]) - 2.2)  # type: ignore[index, operator]

    best, notes = choose(own, own.baseline, solutions(5.0, 2.0, 1.0), bench)
    assert best.choice == {"value": 2.0}
    assert bench(own) == pytest.approx(0.2)
    assert [
        (entry["value"], pytest.approx(entry["validation"])) for entry in notes["free_run_choice"]
    ] == [(5.0, 2.8), (2.0, 0.2), (1.0, 1.2)]


def test_a_single_solution_is_taken_without_a_free_run() -> None:
    own = model()

    def never(candidate: HybridDynamics) -> float:
        raise AssertionError("nothing to choose")

    best, notes = choose(own, own.baseline, solutions(3.0), never)
    assert best.choice == {"value": 3.0}
    assert notes == {}
    assert own.baseline.theta.flatten().tolist() == [3.0] * 3  # type: ignore[union-attr, operator]


def test_in_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Baseline and heads carry the solution whose validation free run is best, and fit.json says
    what was tried.
    """
    config: dict[str, Any] = {
        **TINY,
        "baselines": {
            "poly": {"kind": "regressors", "sets": ["polynomial_2"], "ridge": [1.0e-5, 1.0e-1]},
            "nomoto": {"kind": "nomoto_sideslip", "drive": "tau_x", "steer": "tau_n"},
        },
        "heads": {
            "plsr": {
                "kind": "plsr",
                "choose": "free_run",
                "terms": ["u", "v", "r", "tau_n", "u|u|", "r|r|"],
                "features": ["u", "v", "r", "tau_n"],
            },
            "ridge": {"kind": "ridge", "choose": "free_run", "penalties": [1.0e-6, 1.0e-2]},
        },
        "ensembles": {},
        "training": {},
        "export": {"models": []},
    }
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    assert call(monkeypatch, "run", path, "--out", tmp_path / "run") == 0
    notes = {
        name: json.loads((tmp_path / "run" / "models" / name / "fit.json").read_text())
        for name in ("poly", "plsr", "ridge", "nomoto")
    }
    for name, key, count in (("poly", "ridge", 2), ("plsr", "order", 8), ("ridge", "penalty", 4)):
        tried = notes[name]["free_run_choice"]
        assert len(tried) == count
        best = min(tried, key=lambda entry: entry["validation"])
        assert notes[name][key] == best[key]
        assert notes[name]["validation"] == best["validation"]
    assert len(notes["plsr"]["cross_validated_share"]) == 6
    assert "free_run_choice" not in notes["nomoto"]
    assert {"T", "K", "T_beta", "K_beta"} <= {
        entry["term"] for entry in notes["nomoto"]["coefficients"]
    }


def test_what_lies_around_the_best_is_tried_while_it_gains() -> None:
    own = model()

    def at(value: float) -> Solution:
        theta = torch.full((3, 1), value, dtype=torch.float64)
        return Solution(
            {"value": value},
            {"theta": theta},
            neighbours=lambda: [at(value - 1.0), at(value + 1.0)],
        )

    def bench(candidate: HybridDynamics) -> float:
        return abs(float(candidate.baseline.theta[0, 0]) - 4.2)  # type: ignore[index, operator]

    best, notes = choose(own, own.baseline, [at(0.0), at(2.0)], bench)
    assert best.choice == {"value": 4.0}
    assert bench(own) == pytest.approx(0.2)
    # each once, up to the first neighbours that do not gain
    assert [entry["value"] for entry in notes["free_run_choice"]] == [0.0, 2.0, 1.0, 3.0, 4.0, 5.0]


def test_what_stands_alone_does_not_end_the_search() -> None:
    """No residual at all may beat every shared setting, and yet lose to what lies around the best
    of them.
    """
    own = model()

    def at(value: float) -> Solution:
        theta = torch.full((3, 1), value, dtype=torch.float64)
        return Solution(
            {"value": value},
            {"theta": theta},
            neighbours=lambda: [at(value - 1.0), at(value + 1.0)],
        )

    def bench(candidate: HybridDynamics) -> float:
        value = float(candidate.baseline.theta[0, 0])  # type: ignore[index, operator]
        return 2.5 if value == 0.0 else abs(value - 7.2)

    nothing = Solution({"value": None}, {"theta": torch.zeros(3, 1, dtype=torch.float64)})
    best, notes = choose(own, own.baseline, [at(4.0), at(3.0), nothing], bench)
    assert (
        notes["free_run_choice"][2]["validation"] == 2.5 < notes["free_run_choice"][0]["validation"]
    )
    assert best.choice == {"value": 7.0}
    assert float(own.baseline.theta[0, 0]) == 7.0  # type: ignore[index, operator]
