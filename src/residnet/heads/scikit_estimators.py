"""Construction of estimators of scikit-learn from configs."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from residnet.core.names import suggest_name
from residnet.core.trust import is_trusted
from residnet.heads.scikit_state import FITTED, KERNELS

_STORES_PICKLES = ("memory",)
"""Parameters that configure a joblib cache, which unpickles its files."""


def parse_step(step: Any) -> tuple[str, Mapping[str, Any]] | None:
    """Return the class name and parameters of a step; None for a plain value."""
    if isinstance(step, str) and step.startswith("sklearn."):
        return step, {}
    if isinstance(step, Mapping) and len(step) == 1:
        name, parameters = next(iter(step.items()))
        if isinstance(name, str) and name.startswith("sklearn."):
            return name, parameters or {}
    return None


def _is_listed(step: Any, names: Any) -> bool:
    """Return whether a class and the classes in its parameters are on the allow-lists."""
    parsed_step = parse_step(step)
    if parsed_step is None:
        return False
    class_name, parameters = parsed_step
    if class_name not in names:
        return False
    return all(_is_listed(value, KERNELS) for value in parameters.values() if parse_step(value))


def make_estimator(step: Any, *, listed: Any = FITTED) -> Any:
    """Construct the estimator of a step, not yet fitted, with a fixed random seed.

    Args:
        step: class name, or a mapping from the class name to the parameters.
        listed: class names that are allowed without `--trust`.

    Raises:
        ValueError: if the class or a parameter does not exist or is not allowed.
    """
    parsed_step = parse_step(step)
    if parsed_step is None:
        raise ValueError(
            f"{step!r} is not a class below `sklearn`; give a name such as sklearn.svm.SVR"
        )
    name, parameters = parsed_step
    if name not in listed and not is_trusted():
        raise ValueError(
            f"'{name}' is not among the classes of scikit-learn whose fitted state is stored as"
            f" data{suggest_name(name, listed)}; docs/howto/head.md lists them. Give --trust (in"
            " Python trust=True) only for configs and runs whose source you trust"
        )
    module_name, _, class_name = name.rpartition(".")
    try:
        estimator_class = getattr(importlib.import_module(module_name), class_name)
    except (ImportError, AttributeError):
        raise ValueError(f"scikit-learn has no '{name}'") from None
    if not inspect.isclass(estimator_class):
        raise ValueError(f"'{name}' is not a class of scikit-learn")
    settings = {key: _parameter(name, key, value) for key, value in parameters.items()}
    if "random_state" in inspect.signature(estimator_class).parameters:
        settings.setdefault("random_state", 0)
    if name == "sklearn.neighbors.KNeighborsRegressor":
        # the search tree is an object of compiled code, which cannot be stored as arrays
        algorithm = settings.setdefault("algorithm", "brute")
        if algorithm != "brute":
            raise ValueError(f"{name}: algorithm: expected 'brute', got {algorithm}")
    try:
        estimator = estimator_class(**settings)
        # scikit-learn validates parameters at the fit; an error here shows the key of the config
        if hasattr(estimator, "_validate_params"):
            estimator._validate_params()
    except (TypeError, ValueError) as error:
        first_line = next(iter(str(error).splitlines()), "")
        raise ValueError(f"{name}: {first_line}") from None
    return estimator


def _parameter(owner: str, key: str, value: Any) -> Any:
    """Convert a parameter: a plain value, a list of plain values, or an allowed kernel.

    Raises:
        ValueError: if the value is of another type, or configures a cache of pickles.
    """
    if key in _STORES_PICKLES and value is not None:
        raise ValueError(
            f"{owner}: {key}: is a cache of pickles, which residnet does not open; remove it"
        )
    if parse_step(value):
        return make_estimator(value, listed=KERNELS)
    if isinstance(value, list | tuple):
        return [_parameter(owner, key, part) for part in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise ValueError(
        f"{owner}: {key}: expected a number, a string or a list of these, got"
        f" {type(value).__name__}"
    )
