"""Data from logs alone, as `fit` takes them where nobody said what drives the vessel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from residnet.api.data import Data, prepare
from residnet.api.logs import read_logs
from residnet.api.values import described
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.data.division import divided
from residnet.data.drafting.questions import Marks
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.split import SPLITS
from residnet.tasks.drafting import recipe
from residnet.tasks.drafting.inputs import driving


def prepared_alone(logs: Any) -> Data:
    """Return logs prepared by what they hold: inputs, split, step, protocols and scales.

    Args:
        logs: that were read or where to read them; or a mapping from splits to these.

    Raises:
        UsageError: where they are no logs, or nothing in them drives the vessel.
        DataError: where they are too short.
    """
    if isinstance(logs, Mapping):
        splits = {str(name): read_logs(members) for name, members in logs.items()}
    elif isinstance(logs, str | Log) or not isinstance(logs, int | float | None):
        splits = divided(read_logs(logs))
    else:
        raise UsageError(
            f"fit: expected logs, or data from residnet.prepare, given {described(logs)}"
        )
    whole = [complete_motion(log, MotionConfig()) for log in _all(splits)]
    inputs = driving(whole, Marks())
    if not inputs:
        raise UsageError(
            "fit: no channel of the logs is a rudder, a propeller or another command; call"
            " residnet.prepare with the inputs"
        )
    time = recipe.timing(whole)
    held = recipe.held(whole, inputs)
    judged = [splits.get(name, []) for name in ("validation", "test")]
    return prepare(
        splits,
        inputs,
        step=time.step,
        exogenous=recipe.exogenous(whole),
        derivative={"kind": "savitzky_golay", "window": time.window, "order": 2},
        held=held,
        hold="start" if len(held) == len(inputs) else "mean",
        protocols=recipe.protocols(recipe.window_length(judged, time.memory)),
    )


def _all(splits: Mapping[str, list[Log]]) -> list[Log]:
    return [log for name in SPLITS for log in splits.get(name, ())]
