"""Several files of one trip, each from a recorder of its own, as one log."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, final

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Seconds
from residnet.core.errors import DataError, ResidnetError
from residnet.core.log import Log
from residnet.core.names import STATE
from residnet.data.align import GridConfig, onto
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.readers.base import ConfiguredReader, digest, require_file
from residnet.data.readers.recording import Level, Remark, remark
from residnet.data.readers.tables import (
    TABLES,
    CsvConfig,
    ExcelConfig,
    JsonLinesConfig,
    ParquetConfig,
)
from residnet.data.readers.written import unix_unit
from residnet.data.statistics import Blocks

_LEAST = 0.5
"""Share of the shorter log that two clocks must have in common while their shift is looked for."""
_COARSE, _FINE = 0.5, 0.05
"""Steps in s by which the shift is looked for, and then around the best."""
_SURE = 1.5
"""How much more of the accelerations any shift far from the best one must leave unexplained."""
_FAR = 3.0
"""Time in s from which on a shift is another one."""
_BLOCK = 2.5
"""Time in s over which the velocities that are gained are explained: derivatives would be noise."""
_SAMPLES = 3000
"""Samples of the motion from which a shift is found."""

TableKind = CsvConfig | ParquetConfig | ExcelConfig | JsonLinesConfig


class Shift(NamedTuple):
    """The time in s to add to a clock, and what it explains of what the motion alone leaves.

    Attributes:
        seconds: to add.
        explained: share of the variance, from 0 to 1.
        other: the same with the best shift that is far from it.
    """

    seconds: float
    explained: float
    other: float


@final
class JoinedConfig(ConfiguredReader):
    """Files of one trip whose names differ in one word, such as gnss_1.csv beside motors_1.csv.

    The first part is that of the motion: a log is named by its file and has its clock. What the
    others hold is brought to this clock, averaged where it comes more often and held where it comes
    more rarely.

    Attributes:
        parts: word in the file's name -> reader of such files, that of the motion first.
        shift: word -> time in s that is added to the clock of that part; parts without one are
            joined by their dates (Unix time among them), and where they have none by the shift with
            which their channels explain most of the accelerations.
    """

    kind: Literal["joined"] = "joined"
    parts: dict[str, TableKind] = Field(min_length=2)
    shift: dict[str, Seconds] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _known(self) -> JoinedConfig:
        others = list(self.parts)[1:]
        if wrong := set(self.shift) - set(others):
            raise ValueError(
                f"shift: '{min(wrong)}' is no part whose clock can be moved ({', '.join(others)})"
            )
        return self

    def logs_among(self, paths: Sequence[Path]) -> list[Path]:
        """Return the files of the motion."""
        first, *others = self.parts
        kind = self.parts[first].kind
        return [
            path
            for path in paths
            if first in path.name
            and not any(word in path.name for word in others)
            and TABLES.get(path.suffix.lower(), "csv") == kind
        ]

    def files(self, path: Path) -> list[Path]:
        """Return the files of the trip that a file of the motion is of."""
        return [*self.trip(path).values()]

    def trip(self, path: Path) -> dict[str, Path]:
        """Return word -> file of the trip that a file of the motion is of."""
        require_file(path)
        first, *others = self.parts
        before, found, after = path.name.rpartition(first)
        if not found:
            raise DataError(
                f"{path}: its name holds no '{first}'; give the files of the motion, to which"
                f" those of {', '.join(others)} belong"
            )
        out = {first: path}
        for word in others:
            beside = path.with_name(f"{before}{word}{after}")
            if not beside.is_file():
                raise DataError(f"{path}: {beside.name} is not beside it; leave the trip out")
            out[word] = beside
        return out

    def read(self, path: Path) -> Log:
        """Return the log of one trip; see `LogReader.read`."""
        files = self.trip(path)
        logs = {word: self.parts[word].build().read(file) for word, file in files.items()}
        first, *others = logs
        log = logs[first]
        # what dates join may be what the shift of the others is found by
        for word in sorted(others, key=lambda word: _by_dates(log, logs[word]) is None):
            log = self._beside(log, logs[word], word)
        sums = {word: digest([file]) for word, file in files.items()}
        meta = {**log.meta, "sha256": digest(list(files.values())), "parts": sums}
        return log.replace(meta=meta)

    def _beside(self, log: Log, other: Log, word: str) -> Log:
        """Return a log with the channels of another one, on its own clock."""
        new = {n: values for n, values in other.channels.items() if n not in log.channels}
        if not new:
            raise DataError(
                f"log {log.name}: {word} holds {', '.join(other.channels)}, which are there"
                " already; leave this part out"
            )
        shift, told = self._shift(log, other.replace(channels=new), word)
        t = other.t + shift
        step = float(np.median(np.diff(log.t)))
        both = (log.t >= t[0]) & (log.t <= t[-1])
        if both.sum() < 2:
            raise DataError(
                f"log {log.name}: its clock goes from {log.t[0]:.1f} to {log.t[-1]:.1f} s, that of"
                f" {word} from {t[0]:.1f} to {t[-1]:.1f} s; give `shift: {{{word}: ...}}`"
            )
        held = tuple(new) if float(np.median(np.diff(t))) > step else ()
        moved = onto(other.replace(t=t, channels=new), GridConfig(step=step, held=held), log.t)
        findings = [*log.meta.get("findings", ()), *other.meta.get("findings", ()), told]
        return log.replace(
            channels={**log.channels, **{name: moved[name] for name in new}},
            units={**log.units, **{name: other.units[name] for name in new}},
            meta={**log.meta, "findings": findings},
        )

    def _shift(self, log: Log, other: Log, word: str) -> tuple[float, Remark]:
        """Return what is added to the other clock, and how sure that is.

        Dates of both join them, unless what the channels explain is sure to say otherwise.
        """
        given = self.shift.get(word)
        if given is not None:
            return given, remark("note", "joined", f"{word}: its clock is moved by {given:g} s")
        dated, give = _by_dates(log, other), f"give `shift: {{{word}: ...}}`"
        try:
            found = clock_shift(log, other)
        except ResidnetError as error:
            if dated is not None:
                return dated, remark("note", "joined", f"{word}: joined by the dates of both")
            text = f"{word}: its clock cannot be brought to that of the motion ({error}); both are"
            text += f" taken to begin together: {give}"
            return float(log.t[0] - other.t[0]), remark("will mislead", "joined", text)
        figures = found._asdict()
        sure = 1.0 - found.other >= _SURE * (1.0 - found.explained)
        by = f"with which its channels explain {100 * found.explained:.0f} % of what the motion"
        by += " alone leaves of the accelerations"
        if dated is not None and (not sure or abs(found.seconds - dated) < _COARSE):
            text = f"{word}: joined by the dates of both"
            return dated, remark("note", "joined", text, **figures)
        if dated is not None:
            text = f"{word}: joined by the dates of both, which are {dated - found.seconds:+.2f} s"
            text += f" from the shift {by}: one of the clocks is wrong, {give}"
            return dated, remark("will mislead", "joined", text, **figures)
        text = f"{word}: its clock is moved by {found.seconds:+.2f} s, {by}"
        text += f" ({100 * found.other:.0f} % with any shift {_FAR:g} s from it)"
        text += "" if sure else f"; that is not sure, {give}"
        level: Level = "note" if sure else "will mislead"
        return found.seconds, remark(level, "joined", text, **figures)


def _by_dates(log: Log, other: Log) -> float | None:
    """Return what brings another clock to that of a log by dates or Unix time that overlap."""
    first, second = (
        one.meta.get("epoch", one.t[0] if unix_unit(one.t) == "s" else None) for one in (log, other)
    )
    if first is None or second is None:
        return None
    apart = float(second) - float(first)
    if not other.t[0] - other.t[-1] < apart < log.t[-1] - log.t[0]:
        return None
    return apart + float(log.t[0] - other.t[0])


def clock_shift(log: Log, other: Log) -> Shift:
    """Return the shift of another log's clock with which its channels explain most accelerations.

    For each shift that leaves half of the shorter log, what u and r gain over blocks of time is
    fitted by integrals of the velocities, and of each channel, its square and its product with the
    speed. What counts is the share of what the velocities alone leave of all blocks.

    Args:
        log: of the motion, measured or by position and heading.
    """
    whole = complete_motion(log, MotionConfig())
    every = max(1, len(whole) // _SAMPLES)
    t = whole.t[::every]
    size = max(4, round(_BLOCK / float(np.median(np.diff(t)))))
    blocks = Blocks(t, np.arange(0, len(t) - size, max(1, size // 4)), size)
    if not blocks.first.size:
        raise DataError(f"log {log.name}: {t[-1] - t[0]:.1f} s are too short to tell")

    def over(*columns: np.ndarray) -> np.ndarray:
        """Return the integrals of columns [T] over the blocks [B, k]."""
        return blocks.integrals(np.stack(columns, axis=1))(0)

    known = {name: np.isfinite(whole[name]) for name in ("u", "r")}
    u, r = (np.interp(t, whole.t[k], whole[n][k]) for n, k in known.items())
    gained = blocks.change(np.stack((u, r), axis=1))
    gained /= np.maximum(gained.std(axis=0), 1e-12)
    own = over(np.ones_like(u), u, u * np.abs(u), r, r * np.abs(r), u * r)
    # what the motion explains by itself, which says nothing of the commands
    rest = gained - own @ np.linalg.lstsq(own, gained, rcond=1e-9)[0]
    left_alone = (rest**2).sum(axis=1)
    total = float(left_alone.sum())
    driving = [values for name, values in other.channels.items() if name not in STATE]
    # a velocity that the other one measured too gains what this one gains
    gains = [values for name, values in other.channels.items() if name in ("u", "v", "r")]
    least = _LEAST * min(t[-1] - t[0], other.t[-1] - other.t[0])

    def explained(shift: float) -> float:
        at = t - shift
        begin, end = at[blocks.first], at[blocks.first + size]
        inside = (begin >= other.t[0]) & (end <= other.t[-1])
        if inside.sum() < 3 * (own.shape[1] + 3 * len(driving) + len(gains)) or not total:
            return 0.0

        def seen(values: np.ndarray) -> np.ndarray:
            there = np.isfinite(values)
            return np.asarray(np.interp(at, other.t[there], values[there]))

        columns = [own[inside]]
        columns += [blocks.change(w)[inside, None] for w in map(seen, gains)]
        columns += [over(w, w * np.abs(w), w * u)[inside] for w in map(seen, driving)]
        x, y = np.concatenate(columns, axis=1), gained[inside]
        x = x / np.maximum(np.abs(x).max(axis=0), 1e-12)
        left = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
        # blocks that the other log does not reach stay as the motion alone leaves them
        return float((left_alone[inside].sum() - (left**2).sum()) / total)

    low, high = t[0] - other.t[-1] + least, t[-1] - other.t[0] - least
    coarse = np.arange(low, max(high, low + _COARSE), _COARSE)
    scores = np.array([explained(shift) for shift in coarse.tolist()])
    best = float(coarse[scores.argmax()])
    fine = best + np.arange(-_COARSE, _COARSE + _FINE, _FINE)
    found = np.array([explained(shift) for shift in fine.tolist()])
    seconds = float(fine[found.argmax()])
    far = scores[np.abs(coarse - seconds) > _FAR]
    return Shift(seconds, float(found.max()), float(far.max(initial=0.0)))


def partners(paths: Mapping[Path, tuple[str, ...]]) -> dict[str, list[Path]]:
    """Return word -> files, where files come in groups whose names differ in that word alone.

    Empty where they do not: files of one group have the same columns, and some trips one of each.
    Files of trips that lack a part are left out.

    Args:
        paths: file -> its columns.
    """
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, columns in paths.items():
        groups.setdefault(columns, []).append(path)
    members = list(groups.values())
    if not 2 <= len(members) <= 6:
        return {}
    named = [[set(re.findall(r"[^\W\d_]+", path.stem)) for path in group] for group in members]
    # the longest words that the names of all files of a group hold go first
    held = [sorted(set.intersection(*one), key=lambda w: (-len(w), w)) for one in named]
    shared = Counter(word for words in held for word in words)
    words = [[word for word in own if shared[word] == 1] for own in held]
    if not all(words):
        return {}
    trips = {
        own[0]: {path.with_name(path.name.replace(own[0], "\0")): path for path in group}
        for own, group in zip(words, members, strict=True)
    }
    first, *rest = trips.values()
    whole = [trip for trip in first if all(trip in other for other in rest)]
    return {word: [of[trip] for trip in whole] for word, of in trips.items()} if whole else {}
