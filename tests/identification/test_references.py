"""Who is compared with whom."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

from residnet.identification.fitter import FittedModel
from residnet.identification.fitter import references as compared

ROLES = {
    "zero": "zero",
    "baseline": "baseline",
    "physics": "baseline",
    "hull": "baseline",
    "mlp": "head",
    "ridge": "head",
    "mean": "ensemble",
}
NOTES: dict[str, dict[str, Any]] = {
    "zero": {},
    "baseline": {"validation": 0.5},
    "physics": {"validation": 0.16},
    "hull": {"validation": 0.18},
    "mlp": {"baseline": "hull", "validation": 0.1},
    "ridge": {"validation": 0.2},
    "mean": {"validation": 0.1},
}


def references(roles: Mapping[str, str], notes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    found = [
        SimpleNamespace(name=name, spec=SimpleNamespace(role=role), notes=notes.get(name, {}))
        for name, role in roles.items()
    ]
    return compared(cast(list[FittedModel], found))


def test_each_model_has_its_reference() -> None:
    found = references(ROLES | {"truth": "truth"}, NOTES)
    assert found == {
        "zero": "baseline",
        "physics": "baseline",
        "hull": "baseline",
        "mlp": "hull",
        "ridge": "baseline",
        "mean": "physics",
        "truth": "baseline",
    }


def test_what_is_not_there_is_no_reference() -> None:
    assert (
        references({"mlp": "head", "mean": "ensemble"}, {"mlp": {"baseline": "hull"}, "mean": {}})
        == {}
    )
    # baselines without a recorded validation error: the first
    assert (
        references(
            {"baseline": "baseline", "b": "baseline", "mean": "ensemble"},
            {"baseline": {}, "b": {}, "mean": {}},
        )["mean"]
        == "baseline"
    )


def test_a_baseline_that_diverged_is_no_reference_while_a_steady_one_is_there() -> None:
    lost = {**NOTES, "physics": {"validation": 0.16, "validation_diverged": 2}}
    assert references(ROLES, lost)["mean"] == "hull"
