"""Interactive figures of logs in a run folder: track, motion and commands of each manoeuvre."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from residnet.core.log import Log
from residnet.core.names import STATE
from residnet.report.format import shown_unit
from residnet.report.interactive.explorer import (
    INK,
    Case,
    Curve,
    Explorer,
    Look,
    Panel,
    thinned,
)

_MOST_CASES = 30
_MOST_SAMPLES = 500
_MOST_PANELS = 12
_MOTION = ("u", "v", "r", "psi", "p", "phi")
_COLORS = (INK, "#0072B2", "#D55E00", "#009E73")
_DASHES = ("solid", "dashed", "dashdot", "dotted")


def flight_explorer(folders: Mapping[str, Path]) -> Explorer | None:
    """Return the interactive figure of canonical logs; None where there are none.

    Logs of one name in several folders are shown over each other.

    Args:
        folders: with logs (`**/*.parquet`) by what flew them.
    """
    files = {
        flown: {file.stem: file for file in sorted(folder.rglob("*.parquet"))}
        for flown, folder in folders.items()
    }
    files = {flown: found for flown, found in files.items() if found}
    names = list(dict.fromkeys(name for found in files.values() for name in found))[:_MOST_CASES]
    if not names:
        return None
    groups = {
        name: {flown: Log.load(found[name]) for flown, found in files.items() if name in found}
        for name in names
    }
    channels = _channels([log for group in groups.values() for log in group.values()])
    panels = [Panel("track, north [m] against east [m]", "", "map", 380)]
    panels += [Panel(title, height=150) for title in channels.values()]
    panels[-1] = Panel(panels[-1].title, "time [s]", height=180)
    return Explorer(
        "manoeuvres",
        "Manoeuvres",
        "North is up, and scales of the track are equal. The time axes move together.",
        "Manoeuvre",
        {
            flown: Look(flown, _COLORS[i % len(_COLORS)], _DASHES[i % len(_DASHES)])
            for i, flown in enumerate(files)
        },
        panels,
        [_case(name, group, list(channels)) for name, group in groups.items()],
    )


def _channels(logs: Sequence[Log]) -> dict[str, str]:
    """Return titles of the channels that have a panel: the motion, then all others."""
    units = {name: unit for log in logs for name, unit in log.units.items()}
    present = list(dict.fromkeys(name for log in logs for name in log.channels))
    motion = [name for name in _MOTION if name in present]
    others = [name for name in present if name not in (*_MOTION, *STATE)]
    return {
        name: f"{name} [{shown_unit(units.get(name, '-'))[0]}]"
        for name in (*motion, *others)[:_MOST_PANELS]
    }


def _case(name: str, group: Mapping[str, Log], channels: Sequence[str]) -> Case:
    panels: list[dict[str, Curve]] = [{} for _ in range(1 + len(channels))]
    for flown, log in group.items():
        rows = thinned(len(log), _MOST_SAMPLES)
        time = log.t[rows] - log.t[0]
        if "x" in log.channels and "y" in log.channels:
            panels[0][flown] = (log["y"][rows], log["x"][rows])
        for panel, channel in zip(panels[1:], channels, strict=True):
            if channel in log.channels:
                factor = shown_unit(log.units.get(channel, "-"))[1]
                panel[flown] = (time, factor * np.asarray(log[channel][rows], dtype=float))
    kind = next(iter(group.values())).manoeuvre.replace("_", " ")
    longest = max(float(log.t[-1] - log.t[0]) for log in group.values())
    return Case(name.replace("_", " "), panels, f"{kind}, {longest:.0f} s")
