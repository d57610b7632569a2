"""The part of scripts/bench/bands.py that leaves models out of a config."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from residnet.core.files import shipped_configs
from residnet.tasks.fit import FitConfig
from residnet.tasks.registry import load_task

BENCH = Path(__file__).parents[2] / "scripts" / "bench" / "bands.py"


@pytest.mark.parametrize(
    ("model", "left"),
    [("baseline", ["baseline"]), ("both", ["baseline", "both"]), ("mlp", ["baseline", "mlp"])],
)
def test_what_a_model_does_not_stand_on_is_left_out(model: str, left: list[str]) -> None:
    alone = runpy.run_path(str(BENCH))["alone"]
    file = shipped_configs()["quickstart"]
    changes = [
        "baselines.both.kind=regressors",
        "baselines.both.sets=[linear]",
        "heads.mlp.kind=mlp",
    ]
    config = load_task(file, changes)
    assert isinstance(config, FitConfig)
    found = load_task(file, [*changes, *alone(config, model)])
    assert isinstance(found, FitConfig)
    assert list(found.model_names) == left
    with pytest.raises(ValueError, match="is no baseline or head"):
        alone(config, "nobody")
