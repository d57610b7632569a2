"""Recordings whose fields are named as the columns of a table are: MATLAB structs, HDF5 groups."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.data.drafting.channels import CHANNELS, READER, Channels
from residnet.data.drafting.fixes import from_fixes
from residnet.data.drafting.physics import Raw
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.sources import Sources, step_of
from residnet.data.drafting.tables import named
from residnet.data.drafting.words import state_channel, words_of
from residnet.data.readers.recording import Recording, Series

_FEWEST = 50


def named_fields(recordings: Sequence[Recording], marks: Marks) -> Sources | None:
    """Return position, heading, velocities and inputs of a series that holds them by name.

    Units, signs and frames are settled as those of a table are. None where no series without a
    message type holds position and heading.

    Args:
        recordings: some of those that are alike, with their clocks settled.
        marks: is told what is not sure.
    """
    series = _table_like(recordings[0])
    if series is None:
        return None
    same = [r.series[series.name] for r in recordings if series.name in r.series]
    fields = [
        name
        for name in series.fields
        if all(one.has(name) and np.isfinite(one[name]).any() for one in same)
        and not (words_of(name).has("time") and bool((np.diff(series[name]) > 0.0).all()))
    ]
    names = named(fields, marks)
    logs = [Raw(one.clock, {name: one[field] for name, field in names.items()}) for one in same]
    names, logs, fixes = from_fixes(names, logs, marks)
    entries = Channels(names, logs, marks, fixes).drafted()
    content = _content(series.name, entries, marks)
    idle = [name for name in fields if name not in names.values()]
    if idle:
        marks.note(CHANNELS, f"fields that no channel takes: {', '.join(idle[:20])}")
    return Sources(content, {(series.name, name) for name in series.fields}, step_of(series))


def _table_like(recording: Recording) -> Series | None:
    """Return the only series that holds position and heading under names that say so."""
    found = []
    for series in recording.series.values():
        if series.kind or len(series) < _FEWEST:
            continue
        held = {state_channel(words_of(name)) for name in series.fields}
        if "psi" in held and ({"x", "y"} <= held or {"latitude", "longitude"} <= held):
            found.append(series)
    return found[0] if len(found) == 1 else None


def _content(topic: str, entries: Mapping[str, dict[str, Any]], marks: Marks) -> dict[str, Any]:
    """Return the settings of a reader of recordings from a channel map."""
    rest = dict(entries)
    content: dict[str, Any] = {"standard_messages": False}
    for kind, first, second, keys in (
        ("local", "x", "y", ("north", "east")),
        ("geodetic", "latitude", "longitude", ("latitude", "longitude")),
    ):
        if first in rest and second in rest:
            pair = rest.pop(first), rest.pop(second)
            content["position"] = {"kind": kind, "topic": topic}
            content["position"] |= {key: one["column"] for key, one in zip(keys, pair, strict=True)}
            content["position"]["unit"] = pair[0]["unit"]
    heading = rest.pop("psi")
    content["heading"] = {"kind": "angle", "topic": topic, "field": heading["column"]}
    content["heading"] |= {"unit": heading["unit"], "frame": heading.get("frame", "ned")}
    for name, place in (("x", "position"), ("y", "position"), ("psi", "heading")):
        marks.move((*CHANNELS, name), (*READER, place))
    content["channels"] = {
        name: {"topic": topic, "field": entry.pop("column"), **entry}
        for name, entry in ((name, dict(entry)) for name, entry in rest.items())
    }
    return content
