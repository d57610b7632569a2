"""What there is to choose from, and configs of heads and baselines by name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from residnet.api.values import PartGiven, part
from residnet.baselines import BaselineConfig
from residnet.baselines.base import IdentifiedConfig
from residnet.core.config import validate
from residnet.core.errors import UsageError
from residnet.core.names import nearest
from residnet.heads import HeadConfig
from residnet.heads.base import FeatureConfig
from residnet.tasks.registry import catalogue

if TYPE_CHECKING:
    import pandas as pd

What = Literal["vessels", "heads", "baselines", "manoeuvres", "readers", "tasks", "formats"]
_WHAT = ("vessels", "heads", "baselines", "manoeuvres", "readers", "tasks", "formats")


def available(what: What) -> pd.DataFrame:
    """Return what there is to choose from, parts of other packages included: name and about.

    Args:
        what: vessels, heads, baselines, manoeuvres, readers, tasks or formats (of exports).

    Raises:
        UsageError: where it is none of these.

    Example:
        residnet.available("heads")
    """
    import pandas as pd

    if what not in _WHAT:
        raise UsageError(f"available: there are no '{what}'{nearest(str(what), _WHAT)}")
    return pd.DataFrame(catalogue(what), columns=["name", "about"])


def head(kind: PartGiven, **settings: Any) -> FeatureConfig:
    """Return the config of a residual head, for `fit`.

    Args:
        kind: one of `available("heads")`.
        settings: of the head, as YAML has them.

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.head("lstm", hidden_size=16)
    """
    config: FeatureConfig = validate(part(kind, "head", **settings), HeadConfig, "head")
    return config


def baseline(kind: PartGiven, **settings: Any) -> IdentifiedConfig:
    """Return the config of a baseline, for `fit`.

    Args:
        kind: one of `available("baselines")`.
        settings: of the baseline, as YAML has them.

    Raises:
        ConfigError: where there is no such kind, or a setting is wrong.

    Example:
        residnet.baseline("regressors", sets=["fossen"])
    """
    config: IdentifiedConfig = validate(
        part(kind, "baseline", **settings), BaselineConfig, "baseline"
    )
    return config
