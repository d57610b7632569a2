"""The report's manoeuvring booklet: standard manoeuvres with intervals and limits, and measured
zigzags repeated by the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from residnet.report.figures.booklet import page_title
from residnet.report.run_reader import RunFiles
from residnet.report.tables import Cell, Table, number

_SHOWN = {"rad": ("deg", math.degrees(1.0)), "rad/s": ("deg/s", math.degrees(1.0))}
_WORDS = {
    "approach_speed": "approach speed", "advance": "advance", "transfer": "transfer",
    "tactical_diameter": "tactical diameter",
    "time_90": "time to 90 deg", "time_180": "time to 180 deg",
    "steady_diameter": "steady diameter", "steady_speed": "steady speed",
    "steady_speed_ratio": "steady speed over approach speed",
    "steady_drift_angle": "steady drift angle", "steady_yaw_rate": "steady yaw rate",
    "initial_turning_time": "initial turning time",
    "initial_turning_distance": "initial turning distance", "first_overshoot": "first overshoot",
    "second_overshoot": "second overshoot", "time_to_check_yaw": "time to check yaw",
    "overshoot_width": "overshoot width", "reach": "reach",
    "period": "period", "largest_yaw_rate": "largest yaw rate", "track_reach": "track reach",
    "head_reach": "head reach",
    "lateral_deviation": "lateral deviation", "stopping_time": "stopping time",
    "pull_out_yaw_rate": "yaw rate after pull-out",
}  # fmt: skip
_COMPARED = (
    "first_overshoot",
    "second_overshoot",
    "initial_turning_time",
    "reach",
    "period",
    "largest_yaw_rate",
)


def section(run: RunFiles) -> dict[str, Any] | None:
    """Introduction, a table for each standard manoeuvre, and one that compares zigzags; None where
    the run has no booklet.
    """
    booklet = run.booklet
    if not booklet:
        return None
    own = [page for page in booklet["pages"] if not page["split"]]
    repeated = [page for page in booklet["pages"] if page["split"]]
    return {
        "model": booklet["model"],
        "about": _about(booklet),
        "pages": [
            {"title": page_title(page), "table": _table(booklet, page), "faults": page["faults"]}
            for page in own
        ],
        "repeated": _repeated(booklet, repeated) if repeated else None,
        "worst": _worst(repeated),
    }


def _about(booklet: Mapping[str, Any]) -> str:
    scale, length = float(booklet["scale"]), float(booklet["length"])
    of = (
        f"a hull of {number(length)} m"
        if scale == 1
        else f"a hull of {number(length)} m, a model at 1:{number(scale)}; ship: by Froude's law"
    )
    return (
        f"Flown by model {booklet['model']} for {of}. Intervals ({100 * booklet['level']:.0f} %)"
        f" come from {booklet['draws']} draws of the parameters as the trials leave them open; they"
        " take the model's form for true."
    )


def _table(booklet: Mapping[str, Any], page: Mapping[str, Any]) -> Table:
    ship = float(booklet["scale"]) != 1
    heads = [
        "value",
        f"{100 * booklet['level']:.0f} % interval",
        "unit",
        "lengths",
        *(["ship"] if ship else []),
        "IMO limit",
        "kept by",
    ]
    table = Table(heads=heads, corner="index")
    for name, found in page["indices"].items():
        unit, factor = _SHOWN.get(booklet["units"][name], (booklet["units"][name], 1.0))
        cells = [
            Cell(number(factor * found["value"])),
            Cell(_range(found.get("interval"), factor)),
            Cell(unit),
            Cell(number(found["lengths"]) if "lengths" in found else ""),
        ]
        cells += [Cell(number(factor * found["ship"]))] if ship else []
        share = found.get("kept_share")
        kept = "" if share is None else f"{100 * share:.0f} % of draws"
        cells += [
            Cell(number(factor * found["limit"]) if "limit" in found else ""),
            Cell(kept, mark="" if found.get("kept", True) else "bad"),
        ]
        table.rows.append((_WORDS.get(name, name.replace("_", " ")), cells))
    return table


def _repeated(booklet: Mapping[str, Any], pages: list[Mapping[str, Any]]) -> Table:
    """Measured and predicted indices of the repeated zigzags, a line for each."""
    used = [
        name
        for name in _COMPARED
        if any("measured" in page["indices"].get(name, {}) for page in pages)
    ]
    table = Table(heads=["measured", "model", "difference"] * len(used), corner="log")
    table.groups = [
        (f"{_WORDS[name]} [{_SHOWN.get(booklet['units'][name], (booklet['units'][name],))[0]}]", 3)
        for name in used
    ]
    for page in pages:
        cells: list[Cell] = []
        for name in used:
            found = page["indices"].get(name, {})
            factor = _SHOWN.get(booklet["units"][name], ("", 1.0))[1]
            if "measured" not in found:
                cells += [Cell("–"), Cell("–"), Cell("–")]
                continue
            cells += [
                Cell(number(factor * found["measured"])),
                Cell(number(factor * found["value"]), note=_range(found.get("interval"), factor)),
                Cell(number(factor * found["difference"], 2)),
            ]
        table.rows.append((page_title(page), cells))
    return table


def _worst(pages: list[Mapping[str, Any]]) -> str:
    """The largest difference of the first overshoot, in words."""
    apart = [
        abs(page["indices"]["first_overshoot"]["difference"])
        for page in pages
        if "difference" in page["indices"].get("first_overshoot", {})
    ]
    return (
        f"First overshoots differ by at most {number(math.degrees(max(apart)), 2)} deg."
        if apart
        else ""
    )


def _range(interval: list[float] | None, factor: float) -> str:
    return (
        "–"
        if interval is None
        else f"{number(factor * interval[0])} to {number(factor * interval[1])}"
    )
