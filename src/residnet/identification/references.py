"""Which model each model of a run is compared with, window by window."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

_FIRST = "baseline"


def references(roles: Mapping[str, str], notes: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the name of each model's reference.

    A head is compared with the baseline that it was fitted on; an ensemble, which stands on none,
    with the baseline of the run that does best on the validation data; any other model with the
    run's first baseline, which itself has no reference.

    Args:
        roles: zero, baseline, head, ensemble or truth by model.
        notes: contents of models/<model>/fit.json by model; a head's `baseline` and the baselines'
            `validation` and `validation_diverged` are read.
    """
    # a baseline that diverged is the worse one, whatever its error
    validated = {
        name: (
            int(notes[name].get("validation_diverged", 0)),
            float(notes[name].get("validation", math.inf)),
        )
        for name, role in roles.items()
        if role == "baseline"
    }
    best = min(validated, key=lambda name: validated[name], default=_FIRST)
    out = {}
    for name, role in roles.items():
        named = {
            "head": str(notes[name].get("baseline", _FIRST)) if name in notes else _FIRST,
            "ensemble": best,
        }
        out[name] = named.get(role, _FIRST)
    return {
        name: reference
        for name, reference in out.items()
        if name != reference and reference in roles
    }
