"""Values of a known kind: a test that names its own vessel, head or baseline knows what it gets."""

from __future__ import annotations

from typing import Any, TypeVar

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


def of_kind(value: object, kind: type[T]) -> T:
    """Return the value, which must be of this kind."""
    assert isinstance(value, kind), f"expected a {kind.__name__}, given a {type(value).__name__}"
    return value
