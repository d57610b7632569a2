"""Values of a known kind: a test that names its own vessel, head or baseline knows what it gets."""

from __future__ import annotations

from typing import Any, TypeVar

import pytest

from residnet.baselines import BaselineConfig
from residnet.core.config import validate
from residnet.core.errors import ResidnetError
from residnet.physics.signals import SignalsConfig
from residnet.testing import check_baseline, example_samples

T = TypeVar("T")
# what makes a kind quick enough for a contract
HEADS: dict[str, dict[str, Any]] = {
    "genetic": {"evolution": {"population": 60, "generations": 3}},
    "kernel": {"folds": 2, "penalties": [0.1]},
    "mlp": {"hidden": [8]},
    "lstm": {"hidden_size": 6},
    "recurrent": {"hidden_size": 6},
    "sklearn": {"pipeline": [{"sklearn.ensemble.HistGradientBoostingRegressor": {"max_iter": 9}}]},
}
# what a kind cannot do without
BASELINES: dict[str, dict[str, Any]] = {
    "believed": {"vessel": "wam_v_cal"},
    "equations": {"r": {"r": -1.0}},
    "linear_steady": {"settled": 10, "speed": ["zigzag"], "steering": ["zigzag"]},
    "mmg": {
        "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
        "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
        "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
    },
}


def check_or_refused(kind: str, signals: SignalsConfig, refusal: str) -> None:
    """A baseline that knows a layout beyond the planar keeps its contract, others say why not."""
    config = validate({"kind": kind, **BASELINES.get(kind, {})}, BaselineConfig, "here")
    if kind in ("regressors", "still"):
        check_baseline(config, example_samples(signals=signals))
        return
    with pytest.raises(ResidnetError, match=refusal):
        config.build(signals.build().names)


def of_kind(value: object, kind: type[T]) -> T:
    """Return the value, which must be of this kind."""
    assert isinstance(value, kind), f"expected a {kind.__name__}, given a {type(value).__name__}"
    return value
