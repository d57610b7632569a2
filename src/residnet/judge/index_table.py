"""Manoeuvring indices of flights, with the limits of IMO where they apply."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from residnet.data.simulated.flying import Craft, Flight
from residnet.manoeuvres.indices import UNITS

SCHEMA = "residnet.indices/1"


def index_rows(
    craft: Craft, flights: Sequence[Flight], length: float | None
) -> list[dict[str, Any]]:
    """Return log, manoeuvre, craft, faults, indices and limits of each flight.

    Indices in SI and rad; each limit with whether it is kept.

    Args:
        craft: what flew.
        flights: of that craft.
        length: of the hull in m; None where unknown, then there are neither lengths nor limits.
    """
    out = []
    for flight in flights:
        indices = (
            {}
            if flight.log.meta.get("diverged")
            else flight.manoeuvre.indices(flight.motion, length)
        )
        speed = indices.get("approach_speed", 0.0)
        limits = (
            flight.manoeuvre.limits(craft.helm, length, speed)
            if length is not None and speed > 0
            else {}
        )
        out.append(
            {
                "log": flight.motion.name,
                "manoeuvre": flight.manoeuvre.kind,
                "craft": craft.name,
                "fault": flight.fault,
                "timed_out": bool(flight.log.meta.get("timed_out", False)),
                "indices": indices,
                "limits": {
                    name: {"limit": limit, "kept": indices[name] <= limit}
                    for name, limit in limits.items()
                    if name in indices
                },
            }
        )
    return out


def contents(run: str, length: float | None, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the contents of indices.json."""
    used = {name for row in rows for name in row["indices"]}
    units = {name: UNITS.get(name, "-") for name in sorted(used)}
    return {"schema": SCHEMA, "run": run, "length": length, "units": units, "rows": list(rows)}
