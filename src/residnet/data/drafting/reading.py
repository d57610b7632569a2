"""Logs of any format read without a config: their reader is drafted, and read them.

`inspect`, `read_logs`, `fit`, `new` and `draft` come through here, so that each has the same map.
What recordings say of themselves is taken, checked, and completed by names.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.layout import Live
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS, STATE
from residnet.core.progress import report
from residnet.data.drafting.channels import (
    CERTAIN,
    CHANNELS,
    FRAMES,
    READER,
    Fit,
    Motion,
    Raw,
    along,
    drafted_channels,
    follows,
    motion_of,
    turns_to,
)
from residnet.data.drafting.questions import Key, Marks
from residnet.data.drafting.tables import draft_tables, mark_folders, named, peek
from residnet.data.drafting.words import (
    MOTION,
    PLANES,
    input_channel,
    state_channel,
    thrown,
    unit_of,
    words_of,
)
from residnet.data.motion import MotionConfig, complete_motion
from residnet.data.readers import ReaderConfig
from residnet.data.readers.compose import heading_part, position_part
from residnet.data.readers.detect import AutoConfig, kind_of, to_table
from residnet.data.readers.joined import partners
from residnet.data.readers.messages import in_ned, standard_plan
from residnet.data.readers.quantities import (
    QUATERNION,
    Angle,
    FieldMap,
    Geodetic,
    HeadingConfig,
    Local,
    Plan,
    PositionConfig,
    Quaternion,
)
from residnet.data.readers.recording import EVERYTHING, Recording, Series
from residnet.data.readers.tables import column_names
from residnet.data.readers.topics import align_clocks
from residnet.data.split import log_names, logs_below

# how well position, heading and velocities of a recording that is taken as it is fit together, of 1
_COHERENT = 0.7
# interval in s from which a pose is looked for that comes more often
_SLOW = 0.6
# rows of a topic of the motion, and of one of inputs
_FEWEST, _FEW = 50, 20
_MOST = 12
"""Positions, and headings, that are tried with each other; chosen by hand: 144 poses take long."""
_PAIRS = (("x", "y"), ("north", "east"), ("east", "north"))


@dataclass(frozen=True)
class _Sources:
    """Where the motion comes from.

    Attributes:
        content: position, heading, channels and what else goes with them in a reader's settings.
        taken: topics and fields that it takes.
        step: the shorter of the usual steps of position and heading, s.
    """

    content: dict[str, Any]
    taken: set[tuple[str, str]]
    step: float


def draft_recordings(
    paths: Sequence[Path], marks: Marks
) -> tuple[dict[str, Any], dict[Path, Recording]]:
    """Return the settings of a reader of recordings of one format, and those that were loaded.

    Standard messages map themselves. Where position, heading and velocities do not fit together by
    them, or the pose comes rarely, other topics and frames are tried, unless the format fixes its
    frames. Inputs are found by names.

    Raises:
        UsageError: where the first one cannot be read.
        DataError: where it holds nothing that can be used.
    """
    # what stands still in one recording may move in another: three are looked at
    stride = max(1, (len(paths) - 1) // 2)
    auto = AutoConfig()
    loaded = {path: auto.load(path, EVERYTHING) for path in (paths[0], *paths[::stride])}
    some = [align_clocks(recording, {}, None) for recording in loaded.values()]
    content: dict[str, Any] = {"kind": "auto", **mark_folders(paths, marks)}
    try:
        log = auto.build().log_of(loaded[paths[0]])
    except ResidnetError:
        log = None
    plan = standard_plan(some[0], Plan())
    whole = log is not None and {"x", "y", "psi"} <= set(log.channels)
    poses = [source for source in (plan.position, plan.heading) if source is not None]
    taken = {(entry.topic or "", entry.field) for entry in plan.channels.values()}
    taken |= {(source.topic or "", field) for source in poses for field in source.fields}
    steps = [_step_of(some[0].series[s.topic]) for s in poses if s.topic in some[0].series]
    step = max(min(steps), 0.02) if steps else 1.0
    if not steps and log is not None:
        step = float(np.median(np.diff(log.t)))
    sources = _Sources({}, taken, step)
    settled = any(in_ned(some[0][source.topic]) for source in poses)
    if by_name := _named_fields(some, marks):
        sources = by_name
    elif log is None or not whole or not _sound(log, marks):
        found = None
        if not (whole and settled):
            found = _fitting(some[0], marks, _COHERENT if whole else 0.0)
        if found is None and whole:
            text = "position, heading and velocities fit together badly: check the frames"
            marks.guess(READER, text)
        sources = found or sources
    elif sources.step > _SLOW and not settled:
        others = Marks()
        found = _fitting(some[0], others, _COHERENT)
        # the same pose again would lose the velocities that stand beside it
        if found is not None and found.step < 0.9 * sources.step:
            marks.extend(others)
            sources = found
    content |= sources.content
    content["clock"] = {"kind": "uniform", "step": f"{float(f'{sources.step:.2g}'):g} s"}
    marks.note((*READER, "clock"), "as often as the heading or the position comes")
    standard = "standard_messages" not in content
    known = set(log.channels) if log is not None and standard else set()
    channels = dict(content.pop("channels", {}))
    plain = _renamed(some[0], plan.channels) if standard else ()
    for name, (topic, field) in (*plain, *_inputs(some, sources.taken)):
        if name in known or name in channels:
            continue
        values = _values(some, topic, field)
        told = thrown(name, field, values) or unit_of(name, field, values)
        reason = f"taken by its name; {told.reason}" if told.reason else "taken by its name"
        marks.guess((*CHANNELS, name), reason)
        channels[name] = {"topic": topic, "field": field, **told.settings, "hold": True}
    return content | ({"channels": channels} if channels else {}), loaded


def _step_of(series: Series) -> float:
    return float(np.median(np.diff(series.clock))) if len(series) > 1 else float("inf")


def _sound(log: Log, marks: Marks) -> bool:
    """Return whether position, heading and velocities fit together as they are."""
    raw = Raw(log.t, log.channels)
    motions = [motion_of(raw, "rad", frame) for frame in FRAMES]
    if None in motions:
        return True
    scores = []
    for motion in motions:
        fits = [follows([raw], [motion], name) for name in ("u", "v") if name in log.channels]
        both = sum(f.correlation * np.sign(f.factor) for f in fits) / 2
        scores.append(both if len(fits) == 2 else along([motion]))
    if scores[0] < _COHERENT and max(scores) > scores[0] + 0.1:
        return False
    if scores[0] < 0.3:
        if along(motions[:1]) > _COHERENT:
            # the pose is right, and the velocities are not those of the body
            return False
        text = f"position, heading and velocities fit together badly ({scores[0]:.2f} of 1)"
        marks.guess(READER, f"{text}: check the frames")
    return True


def _named_fields(recordings: Sequence[Recording], marks: Marks) -> _Sources | None:
    """Return the motion and inputs of the only table whose fields are named as columns are.

    MATLAB structs and HDF5 groups are such; units, signs and frames are settled as those of a
    table. None where no series without a message type holds position and heading.
    """
    found = []
    for series in recordings[0].series.values():
        held = {state_channel(words_of(name)) for name in series.fields}
        placed = {"x", "y"} <= held or {"latitude", "longitude"} <= held
        if not series.kind and len(series) >= _FEWEST and "psi" in held and placed:
            found.append(series)
    if len({frozenset(series.fields) for series in found}) < len(found):
        alike = ", ".join(series.name for series in found)
        raise DataError(
            f"{recordings[0].path}: holds {len(found)} tables of the same columns ({alike[:120]}),"
            " each a log of its own; write each to a file, in Python"
            " pandas.DataFrame({name: column for name, column in table.items()}).to_csv(...)"
        )
    if len(found) != 1:
        return None
    series = found[0]
    topic, same = (
        series.name,
        [r.series[series.name] for r in recordings if series.name in r.series],
    )
    fields = [
        name
        for name in series.fields
        if all(one.has(name) and np.isfinite(one[name]).any() for one in same)
        and not (words_of(name).has("time") and bool((np.diff(series[name]) > 0.0).all()))
    ]
    names = named(fields, marks)
    logs = [Raw(one.clock, {name: one[field] for name, field in names.items()}) for one in same]
    rest = drafted_channels(names, logs, marks)
    idle = [name for name in fields if name not in names.values()]
    if idle:
        marks.note(CHANNELS, f"fields that no channel takes: {', '.join(idle[:20])}")
    content: dict[str, Any] = {"standard_messages": False}
    for kind, pair, keys in (
        ("local", ("x", "y"), ("north", "east")),
        ("geodetic", ("latitude", "longitude"), ("latitude", "longitude")),
    ):
        if set(pair) <= set(rest):
            first, second = (rest.pop(name) for name in pair)
            place = {"kind": kind, "topic": topic, keys[0]: first["column"]}
            content["position"] = place | {keys[1]: second["column"], "unit": first["unit"]}
    heading = rest.pop("psi")
    content["heading"] = {"kind": "angle", "topic": topic, "field": heading["column"]}
    content["heading"] |= {"unit": heading["unit"], "frame": heading.get("frame", "ned")}
    for name, place_of in (("x", "position"), ("y", "position"), ("psi", "heading")):
        marks.move((*CHANNELS, name), (*READER, place_of))
    content["channels"] = {
        name: {"topic": topic, "field": entry.pop("column"), **entry}
        for name, entry in rest.items()
    }
    return _Sources(content, {(topic, name) for name in series.fields}, _step_of(series))


def _fitting(recording: Recording, marks: Marks, least: float) -> _Sources | None:
    """Return the position and heading that fit together best and come most often.

    None where there is no pair of both that fits at least as well as asked, of 1.
    """
    positions, headings = list(_positions(recording)), list(_headings(recording))
    velocities = list(_velocities(recording))
    best: tuple[float, Any] = (-np.inf, None)
    for position in positions[:_MOST]:
        for heading in headings[:_MOST]:
            pose = _pose(recording, position, heading)
            if pose is None:
                continue
            score, velocity = _score(pose, velocities)
            rates = [_step_of(recording[source.topic]) for source in (position, heading)]
            # a pose that comes once a second is worth less than one that comes ten times
            value = score - 0.3 * float(np.log10(max(max(rates), 0.05) / 0.05))
            if value > best[0]:
                best = value, (position, heading, score, velocity, min(rates))
    if best[1] is None or best[1][2] < least:
        return None
    position, heading, score, velocity, step = best[1]
    text = f"of {len(positions)} positions and {len(headings)} headings these fit together and come"
    marks.guess((*READER, "position"), f"{text} most often (fit {score:.2f} of 1)")
    marks.guess((*READER, "heading"), f"frame {heading.frame}: with it the motion fits")
    if velocity is not None:
        marks.note(READER, f"velocities in {velocity} served to check the frames only")
    content: dict[str, Any] = {"standard_messages": False}
    for name, source in (("position", position), ("heading", heading)):
        told = source.model_dump(mode="json", exclude_defaults=True)
        content[name] = {"kind": source.kind, **told}
    taken = {(source.topic, field) for source in (position, heading) for field in source.fields}
    return _Sources(content, taken, max(step, 0.02))


def _measured(recording: Recording) -> Iterator[Series]:
    """Yield the topics with enough rows that are no references that somebody asks for."""
    for series in recording.series.values():
        words = words_of(series.name)
        if len(series) >= _FEWEST and not words.has("command") and "guidance" not in words.text:
            yield series


def _positions(recording: Recording) -> Iterator[PositionConfig]:
    """Yield the positions that a recording may hold, in both orders of their axes."""
    for series in _measured(recording):
        if series.has("latitude") and series.has("longitude"):
            yield Geodetic(topic=series.name)
            continue
        called = {state_channel(words_of(field)): field for field in reversed(series.fields)}
        if {"latitude", "longitude"} <= set(called):
            fixes = called["latitude"], called["longitude"]
            largest = [float(np.nanmax(np.abs(series[name]), initial=0.0)) for name in fixes]
            if min(largest) > 0.0 and max(largest) <= 180.0:
                yield Geodetic(topic=series.name, latitude=fixes[0], longitude=fixes[1])
                continue
        prefixes = ("pose.pose.position.", "pose.position.", "position.", "")
        pairs = ((f"{p}{a}", f"{p}{b}") for p in prefixes for a, b in _PAIRS)
        pair = next((pair for pair in pairs if all(map(series.has, pair))), None)
        if pair is None or ("." not in pair[0] and "orientation" in series.name):
            continue
        if all(float(np.nanstd(series[name])) > 0.05 for name in pair):
            yield Local(topic=series.name, north=pair[0], east=pair[1])
            if not in_ned(series):
                yield Local(topic=series.name, north=pair[1], east=pair[0])


def _headings(recording: Recording) -> Iterator[HeadingConfig]:
    for series in _measured(recording):
        frames: tuple[Literal["ned", "enu"], ...] = ("ned",) if in_ned(series) else ("ned", "enu")
        for whole in [field[:-2] for field in series.fields if field.endswith((".w", "_w"))]:
            if all(series.has(f"{whole}.{axis}") for axis in "xyz") and series[f"{whole}.w"].any():
                for frame in frames:
                    yield Quaternion(topic=series.name, field=whole, frame=frame)
        for field in series.fields:
            if state_channel(words_of(field)) == "psi" and np.isfinite(series[field]).any():
                largest = float(np.nanmax(np.abs(series[field])))
                unit = "deg" if largest > 7.0 else "rad"
                if 0.0 < largest <= 400.0:
                    for frame in frames:
                        yield Angle(topic=series.name, field=field, unit=unit, frame=frame)


def _velocities(recording: Recording) -> Iterator[tuple[Series, str, str]]:
    """Yield pairs of fields that may be the velocities forward and sideways."""
    for series in _measured(recording):
        prefixes = ("twist.twist.linear.", "twist.linear.", "linear.")
        at = next((p for p in prefixes if series.has(f"{p}x") and series.has(f"{p}y")), None)
        if at is not None:
            yield series, f"{at}x", f"{at}y"


def _pose(recording: Recording, position: PositionConfig, heading: HeadingConfig) -> Raw | None:
    """Return north, east and heading at the times of the positions; None where they cannot be."""
    try:
        place = position_part(recording, position).log
        angle = heading_part(recording, heading).log
    except ResidnetError:
        return None
    known = np.isfinite(angle["psi"])
    # a heading that stands still fits a velocity over ground as well as one through the water
    if known.sum() < _FEWEST or float(np.ptp(angle["psi"][known])) < 0.3:
        return None
    if angle.t[-1] < place.t[0] or angle.t[0] > place.t[-1]:
        return None
    at = np.interp(place.t, angle.t[known], angle["psi"][known], left=np.nan, right=np.nan)
    return Raw(place.t, {"x": place["x"], "y": place["y"], "psi": at})


def _score(pose: Raw, velocities: list[tuple[Series, str, str]]) -> tuple[float, str | None]:
    """Return how well a pose fits the velocities, and the topic of these; itself without any."""
    motion = motion_of(pose, "rad", FRAMES[0])
    if motion is None:
        return -1.0, None
    still = Raw(pose.t, {**pose.columns, "psi": np.zeros(pose.t.size)})
    ground = motion_of(still, "rad", FRAMES[0])
    fits = [(-1.0, "")]
    for series, first, second in velocities:
        turned = [(first, second), (second, first)]
        over = [_agreement(still, ground, series, *pair) for pair in turned] if ground else [0.0]
        # along north and east it says nothing of the heading
        if max(over) <= 0.85:
            fits.append((_agreement(pose, motion, series, first, second), series.name))
    best = max(fits)
    return best if best[0] > 0.3 else (along([motion]), None)


def _agreement(pose: Raw, motion: Motion, series: Series, first: str, second: str) -> float:
    """Return the mean correlation of forward and sideways velocity with a pair of fields."""
    fits: list[Fit] = []
    for name, field in (("u", first), ("v", second)):
        known = np.isfinite(series[field])
        if known.sum() < _FEWEST:
            return -1.0
        at = np.interp(pose.t, series.clock[known], series[field][known])
        fits.append(follows([Raw(pose.t, {**pose.columns, name: at})], [motion], name))
    forward, sideways = fits
    # the speed itself must agree: a heading that is turned by a right angle swaps the two
    return float(0.5 * (forward.correlation * np.sign(forward.factor) + sideways.correlation))


def _renamed(
    recording: Recording, standard: Mapping[str, FieldMap]
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield channel, topic and field of plain numbers whose topic or joint names an actuator.

    A message that holds a bare number says neither what it measures nor its unit.
    """
    for name, entry in standard.items():
        topic, field = entry.topic or "", entry.field
        if name in CHANNEL_UNITS or entry.unit not in ("-", "rad") or topic not in recording.series:
            continue
        # the last part of a topic says more than the folders that it lies in
        names = (topic.rsplit("/", 1)[-1], name) if field == "data" else (name,)
        channels = (input_channel(words_of(one.removesuffix("_position"))) for one in names)
        if channel := next(filter(None, channels), None):
            yield channel, (topic, field)


def _values(recordings: Sequence[Recording], topic: str, field: str) -> np.ndarray:
    """Return the values of a field in all recordings that hold it."""
    held = [r.series[topic] for r in recordings if topic in r.series]
    return np.concatenate([series[field] for series in held if series.has(field)])


def _inputs(
    recordings: Sequence[Recording], taken: set[tuple[str, str]]
) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield channel, topic and field of those that are named as actuators are.

    Several actuators of one topic are told apart by a number alone, `control[0]` and `control[1]`:
    each is taken. Of other fields that stand for one channel the first one is.
    """
    found: dict[str, list[tuple[str, str]]] = {}
    for topic, series in recordings[0].series.items():
        for field in series.fields:
            channel = input_channel(words_of(f"{topic} {field}"))
            if channel is None or channel in MOTION or (topic, field) in taken:
                continue
            values = _values(recordings, topic, field)
            known = values[np.isfinite(values)]
            if known.size >= _FEW and float(np.ptp(known)) > 0.0:
                found.setdefault(channel, []).append((topic, field))
    for channel, same in found.items():
        kinds = [(topic, re.sub(r"\d+", "#", field)) for topic, field in same]
        alike = [one for one, kind in zip(same, kinds, strict=True) if kind == kinds[0]]
        for number, one in enumerate(alike, 1):
            yield f"{channel}_{number}" if len(alike) > 1 else channel, one


INPUTS = ("signals", "inputs")
"""Key of a config's inputs."""
_TABLES = (".csv", ".parquet")


def log_files(paths: Sequence[Path]) -> list[Path]:
    """Return the files, and the logs below folders, in order; each once.

    A folder may itself be a log, as a ROS 2 bag is, and where a folder holds neither such nor
    tables, logs of any other format are taken.

    Raises:
        UsageError: where a path does not exist or a folder holds no log.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            below = logs_below(path)
            # notes and settings often lie beside tables
            found = [p for p in below if p.is_dir() or p.suffix in _TABLES] or below
            if not found:
                raise UsageError(f"{path}: holds no log of a format that is known{others_in(path)}")
            files += found
        elif path.is_file():
            files.append(path)
        else:
            raise UsageError(f"{path}: no such file or folder")
    once: dict[Path, Path] = {}
    for file in files:
        once.setdefault(file.resolve(), file)
    return list(once.values())


def others_in(folder: Path) -> str:
    """Return what a folder without logs holds, and how it can become logs; empty for nothing."""
    endings = Counter(path.suffix.lower() for path in folder.rglob("*") if path.is_file())
    held = ", ".join(
        f"{n} file{'s' * (n > 1)} {end or 'without ending'}" for end, n in endings.items()
    )
    usual = max(endings, key=lambda ending: endings[ending], default="")
    return f", but {held[:120]}; {to_table(usual)}" if held else ""


@dataclass
class DraftedLogs:
    """Logs that one drafted reader reads.

    Attributes:
        reader: `data.reader` of a config.
        logs: path -> log, in SI, as the reader gives it.
        left_out: path -> why it cannot be read.
        marks: what of the reader is not sure.
    """

    reader: dict[str, Any]
    marks: Marks
    logs: dict[Path, Log] = dataclasses.field(default_factory=dict)
    left_out: dict[Path, ResidnetError] = dataclasses.field(default_factory=dict)


def read_drafted(paths: Sequence[Path], marks: Marks, *, gridded: bool = True) -> DraftedLogs:
    """Return the logs in files of one format, by a reader that is drafted from them.

    Args:
        gridded: recordings come on a uniform clock, and else on that of their positions.

    Raises:
        UsageError: where the files are of several formats.
        DataError: where none can be used.
    """
    kinds = {path: kind_of(path) for path in paths}
    if len(set(kinds.values())) > 1:
        named = "; ".join(
            f"{kind}: {', '.join(path.name for path in paths if kinds[path] == kind)[:120]}"
            for kind in sorted(set(kinds.values()))
        )
        raise UsageError(
            f"the logs are of several formats, and a fit reads one ({named}); give those of one"
        )
    kind, read = kinds[paths[0]], DraftedLogs({"kind": "canonical"}, marks)
    loaded: dict[Path, Recording] = {}
    if kind == "table" and (trips := trips_of(paths)):
        alone = set(paths).difference(*trips.values())
        parts: dict[str, dict[str, Any]] = {}
        left_out: dict[Path, ResidnetError] = {}
        for word, files in trips.items():
            own = Marks()
            parts[word], lost = draft_tables(files, own, headed=True)
            left_out |= lost
            own.move(READER, (*READER, "parts", word))
            marks.extend(own)
        order = sorted(parts, key=lambda word: -len(_of_motion(parts[word]["channels"])))
        text = (
            f"files whose names differ in {' and '.join(order)} alone are taken as one trip; where"
            " both have no dates, their clocks are brought together by what the commands explain"
        )
        marks.guess((*READER, "parts"), text)
        reader = {"kind": "joined", "parts": {word: parts[word] for word in order}}
        read.reader, paths, read.left_out = reader, [*trips[order[0]]], left_out
        read.left_out |= {
            path: DataError(f"{path}: no other file of its trip is beside it; leave it out")
            for path in sorted(alone)
        }
    elif kind == "table":
        read.reader, read.left_out = draft_tables(paths, marks)
    elif kind != "canonical":
        read.reader, loaded = draft_recordings(paths, marks)
    settings = {key: value for key, value in read.reader.items() if gridded or key != "clock"}
    reader, names = validate(settings, ReaderConfig, "draft").build(), log_names(paths)
    for number, path in enumerate(paths):
        report("reading logs", number, len(paths))
        try:
            if path not in read.left_out:
                # a recording that was drafted from is not loaded again
                there = loaded.pop(path, None)
                log = reader.read(path) if there is None else reader.log_of(there)
                read.logs[path] = log.replace(name=names[path])
        except ResidnetError as error:
            read.left_out[path] = error
    report("reading logs", len(paths), len(paths))
    if not read.logs:
        raise next(iter(read.left_out.values()))
    _turn_rudders(read)
    return read


def trips_of(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Return word -> tables, where those that differ in one word of their names are parts of trips.

    Empty where they are not. Two files with a position or a speed each are of two vessels, or of
    two recorders that each are a log; a compass may be in both.
    """
    columns = {path: column_names(path) for path in paths}
    # lists of names and notes lie beside logs
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, names in columns.items():
        groups.setdefault(names, []).append(path)
    logs = {n: files for n, files in groups.items() if len(groups) > 1 and _channels_of(files)}
    found = partners({path: names for path, names in columns.items() if names in logs})
    held = [_of_motion(_channels_of(files)) & {*"xyuv"} for files in found.values()]
    alike = any(one & other for one, other in itertools.combinations(held, 2))
    return {} if alike else found


def _channels_of(files: Sequence[Path]) -> Iterable[str]:
    """Return the channels that the names of columns tell, of the first table that can be read."""
    for path in files:
        with contextlib.suppress(ResidnetError):
            if found := named([*peek(path, 50).numbers], Marks()):
                return found
    return ()


def _of_motion(channels: Iterable[str]) -> set[str]:
    """Return what channels tell of the motion: position, heading, velocities and roll by name."""
    same = {"latitude": "x", "longitude": "y", **dict.fromkeys(QUATERNION, "psi")}
    return {same.get(name, name) for name in channels} & {*STATE, "phi", "p"}


def read_each(paths: Sequence[Path]) -> list[DraftedLogs]:
    """Return logs of any formats, those with the same columns together.

    Where none of those alike can be read, all of them are left out.
    """
    alike: dict[tuple[str, ...], list[Path]] = {}
    tables = {path: column_names(path) for path in paths if kind_of(path) == "table"}
    joined = bool(trips_of([*tables]))
    for path in paths:
        kind = kind_of(path)
        names = tables[path] if kind == "table" and not joined else ()
        alike.setdefault((kind, *names), []).append(path)
    out = []
    for group in alike.values():
        marks = Marks()
        try:
            out.append(read_drafted(group, marks, gridded=False))
        except ResidnetError as error:
            out.append(DraftedLogs({}, marks, left_out=dict.fromkeys(group, error)))
    return out


def _turn_rudders(read: DraftedLogs) -> None:
    """Turn the sign of rudders whose positive angles turn the vessel to port, of planes those that
    turn it up.
    """
    parts: dict[Key, Mapping[str, Any]] = {
        (*READER, "parts", word): part for word, part in read.reader.get("parts", {}).items()
    }
    parts = parts or {READER: read.reader}
    channels: dict[str, dict[str, Any]] = {}
    places: dict[str, Key] = {}
    for place, part in parts.items():
        for name, entry in part.get("channels", {}).items():
            channels.setdefault(name, entry)
            places.setdefault(name, (*place, "channels", name))
    held = dict.fromkeys(name for log in read.logs.values() for name in log.channels)
    names = [name for name in held if re.match(r"(cmd_)?delta(?!_rate)", name)]
    moving = [moved for log in read.logs.values() if names and (moved := _turning(log))]
    for name in names:
        dives = PLANES.match(name) is not None
        rate, way, wrong = ("q", -1.0, "up") if dives else ("r", 1.0, "to port")
        columns = [name, "theta"] if dives else [name]
        there = [log for log in moving if {rate, *columns} <= log.channels.keys()]
        logs = [Raw(log.t, {column: log[column] for column in columns}) for log in there]
        rates = {number: way * log[rate] for number, log in enumerate(there)}
        slope, error = turns_to(logs, name, rates, "theta" if dives else None)
        key = places.get(name, INPUTS)
        if abs(slope) < CERTAIN * error:
            read.marks.guess(key, f"the logs do not tell which way {name} turns the vessel")
        elif slope < 0.0 and name in channels:
            channels[name]["sign"] = -1 * int(channels[name].get("sign", 1))
            text = f"positive values turned the vessel {wrong} in the logs ({-slope / error:.0f}"
            read.marks.guess(key, f"{text} standard errors): the sign is turned")
            for path, log in read.logs.items():
                if name in log.channels:
                    turned = {**log.channels, name: -log[name]}
                    read.logs[path] = log.replace(channels=turned)
        elif slope < 0.0:
            text = f"positive values of {name} turned the vessel {wrong} in the logs"
            read.marks.guess(key, text)


def _turning(log: Log) -> Log | None:
    """Return a log with its yaw rate and, where it dives, its pitch rate; None without."""
    try:
        told = Live.told(log.channels)
        rates = {"r", "q"} if told.spatial else {"r"}
        return log if rates <= log.channels.keys() else complete_motion(log, MotionConfig(), told)
    except ResidnetError:
        return None
