"""The task `autopilot` under stated conditions: rows, verdict, report, export and wrong configs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch
from read_page import plain
from tiny import call, read_json, write_yaml

from residnet.autopilot.evaluation import describe_limit_cycles, list_policy_objections
from residnet.autopilot.records import HeadingRow
from residnet.autopilot.report.heading import cost_sentences
from residnet.autopilot.tasks.autopilot.config import AutopilotConfig
from residnet.autopilot.tasks.autopilot.execute import load_trained_policy
from residnet.core.config import load_config

pytestmark = pytest.mark.long

STATED = {"dt": "0.1 s", "duration": "6 s", "hold": "0 s", "delay": ["0 s", "0.3 s"]}
TRAINING = {
    "epochs": 1, "steps": 1, "batch": 8, "dt": "0.1 s", "hold": "0 s", "validation": 8,
    "compiled": False, "steady": {"flights": 2},
}  # fmt: skip
SMALL: dict[str, Any] = {
    "task": "autopilot",
    "name": "small",
    "vessel": "nomoto_oceanos",
    "rudder": "5 deg",
    "turning_time": "40 s",
    "pace": 1.25,
    "test": {"dt": "0.1 s", "duration": "8 s", "plants": 2, "bias_time": "10 s"},
    "conditions": {
        "stated": STATED,
        "flights": 12,
        "beyond": {"late": {**STATED, "delay": ["0.6 s", "0.6 s"]}},
        "evolution": {"flights": 4, "population": 2, "generations": 1},
    },
    "policies": {
        "learned": {"start": "ptos", "units": 3, "training": TRAINING},
        "constants": {"start": "ptos", "units": 0, "training": TRAINING},
        "network": {"start": None, "units": 3, "training": TRAINING},
    },
    "peers": {
        "pd": {"kind": "pd", "kp": 1.5, "damping_time": "1.3 s"},
        "ptos": {"kind": "ptos", "lag": "0.3 s"},
    },
}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("conditions")
    config = write_yaml(folder / "small.yaml", SMALL)
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", config, "--out", folder / "run") == 0
        for name in ("learned", "network"):
            # an epoch makes no policy that is better than its peers
            assert call(patch, "export", folder / "run", "--model", name, "--anyway") == 0
    return folder / "run"


def rows(run: Path) -> dict[tuple[str, str], dict[str, Any]]:
    found = read_json(run / "metrics.json")["rows"]
    return {(row["model"], row["protocol"]): row for row in found}


def test_every_controller_and_every_companion_is_judged_on_the_same_flights(run: Path) -> None:
    found = rows(run)
    kinds = {model: row["kind"] for (model, test), row in found.items() if test == "conditions"}
    assert kinds == {
        "learned": "policy",
        "learned untrained": "untrained",
        "learned network off": "network_off",
        "constants": "constants",
        "network": "network",
        "network untrained": "untrained",
        "pd": "classical",
        "ptos": "classical",
    }
    for model in kinds:
        assert found[(model, "conditions")]["n"] == found[(model, "beyond_late")]["n"] == 12
        assert found[(model, "quiet")]["rudder_swing"]["max"] >= 0
    # before training the policy is the law as tuned
    law, untrained = (found[(name, "conditions")] for name in ("ptos", "learned untrained"))
    assert untrained["cost"]["mean"] == pytest.approx(law["cost"]["mean"], rel=1e-6)
    assert found[("learned", "nominal")]["kind"] == "policy"


def test_rows_and_page_sum_up_the_flights(run: Path) -> None:
    flights = pd.read_parquet(run / "conditions.parquet")
    for (model, test), row in rows(run).items():
        if "cost" in row:
            own = flights[(flights["controller"] == model) & (flights["protocol"] == test)]
            for name in ("cost", "overshoot", "travel"):
                assert own[name].mean() == pytest.approx(row[name]["mean"])
    text = plain(run / "report.html")
    for words in ("Under the stated conditions", "policy, network switched off", "epoch 0 is"):
        assert words in text
    # the times that were flown, and not those before they were multiplied by the pace
    assert "over 7.5 s from the change on" in text
    fit = read_json(run / "models" / "learned" / "fit.json")
    assert fit["best_validation"] <= fit["start_validation"]
    assert read_json(run / "summary.json")["finished"]


def exported(run: Path, name: str) -> tuple[Any, dict[str, Any]]:
    extra = {"card.json": ""}
    module = torch.jit.load(str(run / "exports" / f"{name}.pt"), _extra_files=extra)
    return module, json.loads(extra["card.json"])


def test_policies_are_exported_with_their_cards_and_read_back(run: Path) -> None:
    module, card = exported(run, "learned")
    assert (card["kind"], card["units"]) == ("observed", 3)
    assert card["conditions"]["delay"] == [0.0, 0.3]
    measured = torch.tensor([[0.1, 3.2, 0.02]])
    assert module.initial_state(measured).shape == (1, len(card["memory"]))
    # a network without a law
    module, card = exported(run, "network")
    assert card["kind"] == "network"
    assert "constants" not in card
    config = load_config(run / "resolved.yaml", [], AutopilotConfig)
    policy = load_trained_policy(config, run / "models", "network", 0.1)
    policy.set_state_columns(("psi", "u", "r"))
    memory = policy.initial_state(measured.double())
    s = module.initial_state(measured)
    for _ in range(5):
        command, s, _ = module.step(measured, torch.tensor([[0.5]]), s)
        wish, memory = policy(measured.double(), torch.tensor([[0.5]]).double(), memory)
        assert float(command) == pytest.approx(float(wish), abs=1e-6)


def heading_row(
    protocol: str, model: str, kind: str, *, cycling: int | None = None, **metrics: float
) -> HeadingRow:
    """Return a row whose distributions have one value."""
    statistics = ("mean", "median", "p95", "max")
    return HeadingRow.model_validate(
        {"model": model, "kind": kind, "split": "simulated", "protocol": protocol, "n": 100}
        | {name: dict.fromkeys(statistics, value) for name, value in metrics.items()}
        | {"cycling": cycling}
    )


def test_the_verdict_begins_with_the_cheapest_policy() -> None:
    costs = {"a": ("network", 6.3), "b": ("policy", 6.1), "law": ("classical", 6.4)}
    rows = [
        heading_row("conditions", name, kind, cost=cost) for name, (kind, cost) in costs.items()
    ]
    first, second = cost_sentences(rows)
    cost = "'b' has a mean cost of 6.100 s, 4.7 % below"
    assert first.startswith(f"Under the stated conditions {cost}")
    assert "'a' has a mean cost of 6.300 s" in second
    assert list_policy_objections("b", rows) == []
    rows += [heading_row("beyond_waves", "b", "policy", cost=9.0)]
    rows += [heading_row("beyond_waves", "law", "classical", cost=8.0)]
    costly = "Do not use 'b' there: under 'waves' the mean cost is 9 s, with law 8 s."
    assert cost_sentences(rows)[1] == costly
    rows[2] = heading_row("conditions", "law", "classical", cost=6.0)
    assert list_policy_objections("b", rows) == [
        "under its conditions the mean cost is 6.1 s, with law 6 s"
    ]


def test_the_verdict_tells_a_policy_that_keeps_swinging() -> None:
    def quiet(name: str, kind: str, number: int) -> HeadingRow:
        return heading_row("quiet", name, kind, rudder_swing=0.698, cycling=number)

    rows = [quiet("a", "policy", 1), quiet("lqr", "classical", 2), quiet("pd", "classical", 0)]
    rows += [heading_row("conditions", row.model, row.kind, cost=6.0) for row in rows]
    said = (
        "'a' has a limit cycle in 1 of 100 simulations without noise, with a peak-to-peak command"
        " of up to 40 deg; "
    )
    assert cost_sentences(rows)[1] == said + "none with pd."
    assert describe_limit_cycles("lqr", rows)[0].endswith("none with pd.")
    assert describe_limit_cycles("pd", rows) == []
    rows[2] = quiet("pd", "classical", 1)
    assert describe_limit_cycles("a", rows) == [said + "so has each tuned law."]
