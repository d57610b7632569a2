"""The channel map of tables that nobody described, with what is not sure about it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from residnet.core.errors import DataError, UsageError
from residnet.core.names import CHANNEL_UNITS
from residnet.core.units import to_si
from residnet.data.drafting.fixes import as_fixes, from_fixes
from residnet.data.drafting.physics import (
    FRAMES,
    Fit,
    Frame,
    Motion,
    Raw,
    along,
    explained_turn,
    follows,
    heading_of,
    motion_of,
)
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.sheets import Clock, Sheet, clock_of, peek
from residnet.data.drafting.units import is_pulse, other_dimension, unit_by_size, written_unit
from residnet.data.drafting.words import input_channel, state_channel, words_of

_LOOKED_AT = 24
"""Tables whose values are looked at; of the others only the header is."""
READER = ("data", "reader")
CHANNELS = (*READER, "channels")
_STATE = ("x", "y", "psi", "u", "v", "r", "phi", "p", "wind_speed", "wind_dir")
_SURE = 0.9
"""Correlation from which a measured factor overrules a header."""


@dataclass(frozen=True)
class TableDraft:
    """The reader of tables that are alike.

    Attributes:
        content: settings of the reader.
        files: that it reads.
        left_out: file -> why it is not read.
    """

    content: dict[str, Any]
    files: tuple[Path, ...]
    left_out: dict[Path, str]


def draft_tables(files: Sequence[Path], marks: Marks) -> TableDraft:
    """Return the reader of tables, by names, units in the headers, values and physics.

    Args:
        files: at least one table.
        marks: is told what is not sure.

    Raises:
        UsageError: where the tables have nothing in common.
        DataError: where none can be read, or none has a time.
    """
    sheets, left_out = _sheets(files)
    first = sheets[0]
    shared = [name for name in first.header if all(name in sheet.header for sheet in sheets)]
    lost = sorted({name for sheet in sheets for name in sheet.header} - set(shared))
    if lost:
        marks.note(CHANNELS, f"not in every file, left out: {', '.join(lost[:12])}")
    clock = clock_of(first)
    if not set(clock.columns) <= set(shared):
        raise UsageError(f"{first.path}: its time '{clock.columns[0]}' is not in every file")
    if clock.guess:
        marks.guess((*READER, "time"), clock.guess)
    numeric = [name for name in shared if name in first.numbers and name not in clock.columns]
    names = named(numeric, marks)
    logs = _raw(sheets, names, left_out)
    names, logs, fixes = from_fixes(names, logs, marks)
    channels = Channels(names, logs, marks, fixes).drafted()
    about = {key: value for key, value in first.about.items() if key != "kind"}
    content = {"kind": first.about["kind"], **about, "time": clock.settings}
    if len({path.resolve().parent for path in files}) > 1:
        content["manoeuvre"] = "folder"
        marks.guess((*READER, "manoeuvre"), "the kind of manoeuvre is taken from the folder's name")
    _unused(first, names, clock, marks)
    kept = tuple(path for path in files if path not in left_out)
    return TableDraft({**content, "channels": channels}, kept, left_out)


def _sheets(files: Sequence[Path]) -> tuple[list[Sheet], dict[Path, str]]:
    """Return the first rows of the tables, those of some with all that is looked at."""
    stride = max(1, len(files) // _LOOKED_AT)
    sheets: list[Sheet] = []
    left_out: dict[Path, str] = {}
    for number, path in enumerate(files):
        try:
            sheets.append(peek(path) if number % stride == 0 else peek(path, 50))
        except DataError as error:
            left_out[path] = str(error)
    if not sheets:
        raise DataError(next(iter(left_out.values())))
    kinds = {tuple(sorted(sheet.about.items())) for sheet in sheets if len(sheet.numbers) > 1}
    if len({dict(kind)["kind"] for kind in kinds}) > 1:
        raise UsageError("the tables are of several formats; give those of one format at a time")
    # the form that most of them have: a table of whole numbers shows no decimal sign
    usual = max(kinds, key=lambda kind: (len(kind), sum(s.about == dict(kind) for s in sheets)))
    best = next(i for i, s in enumerate(sheets) if tuple(sorted(s.about.items())) == usual)
    return [sheets[best], *sheets[:best], *sheets[best + 1 :]], left_out


def named(columns: Sequence[str], marks: Marks) -> dict[str, str]:
    """Return channel -> column, by what the columns are called."""
    names: dict[str, str] = {}
    speeds: list[str] = []
    about = {column: words_of(column) for column in columns}
    # shorter names first: `heading` before `heading of the second compass`
    for column in sorted(columns, key=lambda name: len(about[name].about)):
        channel = state_channel(about[column]) or input_channel(about[column])
        other = _other_unit(column, channel)
        if channel == "n" and other == "m":
            channel = "x"
        elif channel in _STATE and other:
            marks.note(CHANNELS, f"'{column}' is called as {channel} is, but holds {other}")
            continue
        if channel == "speed":
            speeds.append(column)
        elif channel is not None and channel not in names:
            names[channel] = column
        elif channel is not None:
            marks.note(CHANNELS, f"'{column}' may be {channel} as well as '{names[channel]}' is")
    if "u" not in names and "v" in names and speeds:
        names["u"] = speeds[0]
        marks.guess((*CHANNELS, "u"), f"'{speeds[0]}' is taken as the speed forward, not its size")
    order = [*_STATE, *(name for name in names if name not in _STATE)]
    return {name: names[name] for name in order if name in names}


def _other_unit(column: str, channel: str | None) -> str | None:
    """Return the unit in the brackets of a name where it cannot be that of a channel."""
    si = CHANNEL_UNITS.get(channel or "")
    return None if si is None else other_dimension(column, si)


def _raw(sheets: Sequence[Sheet], names: Mapping[str, str], left_out: dict[Path, str]) -> list[Raw]:
    """Return the columns of the tables that were looked at."""
    logs = []
    for sheet in sheets:
        try:
            clock = clock_of(sheet)
        except DataError as error:
            left_out[sheet.path] = str(error)
            continue
        columns = {
            channel: sheet.numbers[column]
            for channel, column in names.items()
            if column in sheet.numbers
        }
        logs.append(Raw(clock.seconds, columns))
    return logs


def _unused(sheet: Sheet, names: Mapping[str, str], clock: Clock, marks: Marks) -> None:
    """Note the columns that no channel takes."""
    used = {*names.values(), *clock.columns}
    idle = [name for name in sheet.numbers if name not in used]
    if idle:
        marks.note(CHANNELS, f"columns that no channel takes: {', '.join(idle[:20])}")
    if sheet.texts.keys() - used:
        marks.note(CHANNELS, f"columns of text: {', '.join(list(sheet.texts.keys() - used)[:12])}")
    if sheet.empty:
        marks.note(CHANNELS, f"empty columns: {', '.join(sheet.empty[:12])}")


@final
class Channels:
    """The entries of a channel map, from names, headers, values and physics."""

    def __init__(
        self, names: Mapping[str, str], logs: Sequence[Raw], marks: Marks, fixes: bool
    ) -> None:
        self._fixes = fixes
        self._names, self._logs, self._marks = dict(names), list(logs), marks
        self._frame = FRAMES[0]
        self._motions: list[Motion | None] = [None] * len(logs)
        self._psi_unit = "rad"

    def drafted(self) -> dict[str, dict[str, Any]]:
        """Return channel -> entry."""
        if {"x", "y", "psi"} <= set(self._names):
            self._settle_frame()
        self._settle_wind()
        entries = {name: self._entry(name) for name in self._names}
        return as_fixes(entries) if self._fixes else entries

    def _values(self, name: str) -> np.ndarray:
        parts = [raw.columns[name] for raw in self._logs if name in raw.columns]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _settle_frame(self) -> None:
        """Find the unit and frame of the heading under which the vessel moves where it points."""
        written = written_unit(self._names["psi"], "rad")
        sized, _ = unit_by_size("psi", self._values("psi"))
        # a heading that is not wrapped is large in radians too: its size decides only where the
        # motion does not
        other = "rad" if sized == "deg" else "deg"
        tried = [written] if written else [sized, other]
        best = (-np.inf, "rad", FRAMES[0])
        for unit in tried:
            for frame in (f for f in FRAMES if not (self._fixes and f.swapped)):
                motions = [motion_of(raw, unit, frame) for raw in self._logs]
                score = self._score(motions)
                if score > best[0] + 0.02:
                    best = (score, unit, frame)
                    self._motions = motions
        score, self._psi_unit, self._frame = best
        if written is None:
            reason = f"position and heading fit together best in {self._psi_unit}"
            self._marks.guess((*CHANNELS, "psi"), f"the header has no unit; {reason}")
        self._name_axes(score)

    def _score(self, motions: Sequence[Motion | None]) -> float:
        """Return how well position, heading and velocities fit together, at most 1."""
        fits = [follows(self._logs, motions, name) for name in ("u", "v") if name in self._names]
        if len(fits) == 2:
            # only the forward component tells how the heading lies; both count
            return sum(fit.correlation * (fit.factor > 0 or i) for i, fit in enumerate(fits)) / 2
        return along(motions)

    def _name_axes(self, score: float) -> None:
        """Say which column is north, and mark what names and motion leave open."""
        x, y = words_of(self._names["x"]), words_of(self._names["y"])
        told = x.has("north") and y.has("east") and not (x.text == "x" or y.text == "y")
        told = told or self._fixes
        if self._frame.swapped and not told:
            self._names["x"], self._names["y"] = self._names["y"], self._names["x"]
            text = "the vessel moves where it points only if the column called y is the north"
            self._marks.guess((*CHANNELS, "x"), text)
        elif self._frame.swapped:
            # named north and east, yet turned about: the heading counts from east
            self._frame = Frame(False, True)
            self._motions = [motion_of(raw, self._psi_unit, self._frame) for raw in self._logs]
        elif not told and not self._frame.from_east:
            text = f"x is taken as north and y as east: with them the heading fits ({score:.2f})"
            self._marks.guess((*CHANNELS, "x"), text)
        if self._frame.from_east:
            text = "the vessel moves where it points only if the heading counts from east"
            self._marks.guess((*CHANNELS, "psi"), text)
        if score < 0.5:
            text = f"position, heading and velocities fit together badly ({score:.2f} of 1)"
            self._marks.guess((*CHANNELS, "psi"), f"{text}: check units and axes")
        self._frame = Frame(False, self._frame.from_east)

    def _settle_wind(self) -> None:
        """Leave out a wind that turns with the vessel, and a wind without its other half."""
        pair = {"wind_speed", "wind_dir"} & set(self._names)
        if not pair:
            return
        if len(pair) == 1:
            column = self._names.pop(pair.pop())
            self._marks.note(CHANNELS, f"'{column}' alone is no wind; left out")
            return
        words = words_of(self._names["wind_dir"])
        if not words.has("true") and self._turns_with_vessel():
            columns = [self._names.pop(name) for name in ("wind_speed", "wind_dir")]
            text = "turns against the heading, as a relative wind does; a model needs the true wind"
            self._marks.note(CHANNELS, f"'{columns[1]}' {text}: {', '.join(columns)} left out")
            return
        text = "the direction is taken as that which the true wind comes from, clockwise from north"
        self._marks.guess((*CHANNELS, "wind_dir"), text)

    def _turns_with_vessel(self) -> bool:
        if "psi" not in self._names:
            return False
        unit = self._unit("wind_dir", mark=False)
        shares = [
            explained_turn(
                raw,
                raw.columns["wind_dir"] * to_si(unit, "rad"),
                heading_of(raw, self._psi_unit, self._frame),
            )
            for raw in self._logs
            if {"wind_dir", "psi"} <= set(raw.columns)
        ]
        return bool(shares) and float(np.mean(shares)) > 0.1

    def _unit(self, name: str, *, mark: bool = True) -> str:
        """Return the unit of a channel from its header or its size."""
        column = self._names[name]
        written = written_unit(column, CHANNEL_UNITS.get(name))
        if written is not None:
            return written
        unit, reason = unit_by_size(name, self._values(name))
        if mark:
            self._marks.guess((*CHANNELS, name), reason)
        return unit

    def _entry(self, name: str) -> dict[str, Any]:
        column = self._names[name]
        entry: dict[str, Any] = {"column": column}
        if self._fixes and name in ("x", "y"):
            return entry | {"unit": "deg"}
        if name == "psi":
            entry["unit"] = self._psi_unit
            return entry | ({"frame": "enu"} if self._frame.from_east else {})
        if name in ("u", "v", "r") and {"x", "y", "psi"} <= set(self._names):
            return entry | self._rate(name)
        pulses = name not in _STATE and is_pulse(name, self._values(name))
        if pulses and written_unit(column, "rad") is None:
            text = "pulses of a servo; 1500 us are taken as neutral, 500 us as all the way"
            self._marks.guess((*CHANNELS, name), text)
            return entry | {"unit": "-", "offset": 1500, "scale": 0.002}
        return entry | {"unit": self._unit(name)}

    def _rate(self, name: str) -> dict[str, Any]:
        """Return unit and sign of a velocity, checked against position and heading."""
        key, column = (*CHANNELS, name), self._names[name]
        si = CHANNEL_UNITS[name]
        fit = follows(self._logs, self._motions, name)
        written = written_unit(column, si)
        unit = self._measured_unit(name, written, fit)
        entry: dict[str, Any] = {"unit": unit}
        if fit.telling and fit.factor < 0.0:
            entry["sign"] = -1
            what = {"u": "astern", "v": "port", "r": "port"}[name]
            text = f"position and heading say that it is positive to {what} (correlation"
            self._marks.guess(key, f"{text} {fit.correlation:.2f})")
        if not fit.telling and written is None:
            self._marks.guess(key, f"position and heading do not tell whether {unit} is right")
        return entry

    def _measured_unit(self, name: str, written: str | None, fit: Fit) -> str:
        key, si = (*CHANNELS, name), CHANNEL_UNITS[name]
        found = fit.unit(si) if fit.telling else None
        if written is None and found is not None:
            text = f"the header has no unit; position and heading say {found}"
            self._marks.guess(key, f"{text} (correlation {fit.correlation:.2f})")
            return found
        if written is None:
            return self._unit(name)
        if found is None or to_si(found) == to_si(written, si) or fit.correlation < _SURE:
            return written
        ratio = abs(fit.factor) / to_si(written, si)
        if 0.6 < ratio < 1.6:
            return written
        text = f"the header says {written}, position and heading say {found} (factor {ratio:.3g})"
        return self._marks.ask(key, f"unit of '{self._names[name]}'", found, text, (found, written))
