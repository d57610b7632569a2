"""The card of an exported model: all that a user needs to drive it, and how good it is."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from residnet.core.names import STATE
from residnet.core.version import __version__
from residnet.dynamics.band import BandTable
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.export.guard import GuardedDynamics

_BAND = (
    "half widths of the errors of a free run so many steps after a measured state, whatever the run"
    " is like; between the steps they are interpolated, and beyond the last they grow in proportion"
    " to time, without any promise; the position's is the radius about the predicted one"
)


def _band(band: BandTable, dt: float) -> dict[str, Any]:
    """Return the table of half widths for formats that have no methods."""
    return {"about": _BAND, "horizon": band.steps[-1] * dt, **band.model_dump(mode="json")}


def make_card(
    spec: ModelSpec,
    model: HybridDynamics,
    metrics: Sequence[Mapping[str, Any]],
    parity: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the model card: all that a user needs to drive the module, and how good it is."""
    units = spec.signals.units()
    guard = GuardedDynamics(model, spec)
    accepted = torch.stack((guard.least, guard.most), dim=1).tolist()
    return {
        "schema": "residnet.card/1",
        "model": spec.name,
        "states": [{"name": name, "unit": units[name]} for name in STATE],
        "inputs": [
            {
                "name": name,
                "unit": units[name],
                "role": "command" if name in spec.signals.inputs else "exogenous",
            }
            for name in spec.signals.columns
        ],
        "inputs_held": {
            "start": "the sample at the step's start",
            "mean": "the mean of the samples at the step's start and end",
        }[spec.hold],
        "memory": model.n_state,
        "dt": spec.dt,
        "integrator": spec.integrator,
        "dtype": "float32",
        "frame": (
            "NED; body axes x forward, y starboard, z down; psi unwrapped, clockwise from north;"
            " wind_dir is where the wind comes from"
        ),
        "training_range": {name: list(limits) for name, limits in spec.ranges.items()},
        "bad_inputs": {
            "rules": (
                "an entry that is no number becomes the one under `substitute`, any other beyond"
                " `accepted` the nearest value of its training range; a memory that is not finite"
                " or beyond what the head can have begins anew; a step that would leave `accepted`"
                " is held at its edge; `outside` is then true"
            ),
            "accepted": dict(zip(units, accepted, strict=True)),
            "substitute": dict(zip(units, guard.middle.tolist(), strict=True)),
        },
        "baseline": spec.baseline.model_dump(mode="json"),
        "head": None if spec.head is None else spec.head.model_dump(mode="json"),
        "members": [
            member.model_dump(mode="json", include={"name", "baseline", "head"})
            for member in spec.members
        ],
        "gated": spec.gated,
        "band": None if spec.band is None else _band(spec.band, spec.dt),
        "metrics": [dict(row) for row in metrics],
        "parity": dict(parity),
        "versions": {"residnet": __version__, "torch": torch.__version__},
        "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
