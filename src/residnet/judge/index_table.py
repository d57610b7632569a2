"""Manoeuvring indices of flights as a table, vessel beside model, with limits of IMO."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from residnet.data.simulated.flying import Craft, Flight
from residnet.manoeuvres.indices import UNITS

SCHEMA = "residnet.indices/1"
_SHOWN = {"rad": ("deg", math.degrees(1.0)), "rad/s": ("deg/s", math.degrees(1.0))}


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


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the indices as text, flight by flight, one column for each craft.

    With two crafts also how far the second is off.
    """
    crafts = list(dict.fromkeys(row["craft"] for row in rows))
    lines: list[str] = []
    for log in dict.fromkeys(row["log"] for row in rows):
        of = {row["craft"]: row for row in rows if row["log"] == log}
        names = [
            n
            for n in dict.fromkeys(n for row in of.values() for n in row["indices"])
            if n in UNITS and _single(of, n)
        ]
        lines += [f"{log}: {row['craft']}: {row['fault']}" for row in of.values() if row["fault"]]
        if not names:
            continue
        titles = "".join(f"{craft[:14]:>15s}" for craft in crafts) + (
            f"{'difference':>12s}" if len(crafts) == 2 else ""
        )
        lines.append(f"{log:28s} {'':6s}{titles}{'  in lengths' if _lengths(of) else ''}")
        lines += [_line(of, crafts, name) for name in names]
    return "\n".join(lines)


def _line(of: Mapping[str, Mapping[str, Any]], crafts: Sequence[str], name: str) -> str:
    unit, factor = _SHOWN.get(UNITS[name], (UNITS[name], 1.0))
    values = [of[craft]["indices"].get(name) if craft in of else None for craft in crafts]
    text = f"  {name:26s} {unit:6s}" + "".join(
        f"{'-':>15s}" if value is None else f"{factor * value:15.4g}" for value in values
    )
    if len(crafts) == 2:
        one, other = values
        text += (
            f"{'-':>12s}" if one is None or other is None else f"{factor * (other - one):+12.3g}"
        )
    lengths = [of[craft]["indices"].get(f"{name}_lengths") for craft in crafts if craft in of]
    if any(value is not None for value in lengths):
        text += "  " + ", ".join("-" if value is None else f"{value:.2f} L" for value in lengths)
    limits = {
        craft: of[craft]["limits"][name]
        for craft in crafts
        if craft in of and name in of[craft]["limits"]
    }
    if limits:
        first = next(iter(limits.values()))
        kept = ", ".join("kept" if limit["kept"] else "EXCEEDED" for limit in limits.values())
        text += f"  IMO limit {factor * first['limit']:.4g} {unit}: {kept}"
    return text


def _single(of: Mapping[str, Mapping[str, Any]], name: str) -> bool:
    return not any(isinstance(row["indices"].get(name), list) for row in of.values())


def _lengths(of: Mapping[str, Mapping[str, Any]]) -> bool:
    return any(name.endswith("_lengths") for row in of.values() for name in row["indices"])
