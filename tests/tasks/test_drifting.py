"""A run on logs with unknown currents."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from tiny import TINY, call

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.data.simulated import SimulatedTrials
from residnet.tasks.fit import FitConfig

CONFIG: dict[str, Any] = {
    **TINY,
    "data": {**TINY["data"], "disturbance": {"current_each": [0.1, 0.4]}},  # type: ignore[dict-item]
    "baseline": {"kind": "regressors", "sets": ["fossen"]},
    "current": {"baseline": "baseline"},
    "heads": {},
    "ensembles": {},
    "training": {},
    "export": {"models": []},
}


@pytest.mark.long
def test_currents_are_found_and_models_fitted_without_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    errors = {}
    for name, change in (("with", {}), ("without", {"current": None})):
        path = tmp_path / f"{name}.yaml"
        path.write_text(yaml.safe_dump(CONFIG | change, sort_keys=False))
        assert call(monkeypatch, "run", path, "--out", tmp_path / name) == 0
        notes = json.loads((tmp_path / name / "models" / "baseline" / "fit.json").read_text())
        errors[name] = notes["validation"]
    # 0.118 in calm water
    assert errors["with"] < 0.15 < 0.5 < errors["without"]
    assert not (tmp_path / "without" / "currents.json").exists()
    data = validate(CONFIG["data"], SimulatedTrials, "here")
    manoeuvres = data.draw()
    truth = data.disturbance.currents(len(manoeuvres), data.seed)
    names = [
        f"{m.kind}_{[other.kind for other in manoeuvres[: i + 1]].count(m.kind):02d}"
        for i, m in enumerate(manoeuvres)
    ]
    known = dict(zip(names, truth, strict=True))
    table = json.loads((tmp_path / "with" / "currents.json").read_text())
    assert {row["log"] for row in table} == {
        name for name, split in zip(names, data.splits(manoeuvres), strict=True) if split != "test"
    }
    for row in table:
        np.testing.assert_allclose(
            [row["current_north"], row["current_east"]], known[row["log"]], atol=0.06
        )


@pytest.mark.parametrize(
    ("current", "message"),
    [
        ({"baseline": "bseline"}, "did you mean 'baseline'"),
        ({"baseline": "held"}, "'held' has no regressors to tell a current by"),
        ({"spread": 0}, "greater than 0"),
        ({"spread": "3 deg"}, r"m/s"),
    ],
)
def test_wrong_configs(current: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate(
            CONFIG | {"baselines": {"held": {"kind": "still"}}, "current": current},
            FitConfig,
            "here",
        )
    assert "\n" not in str(caught.value)
