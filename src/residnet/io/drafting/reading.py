"""Drafting of readers for logs without a config, and reading of these logs.

The commands `inspect`, `fit`, `new` and `draft` and `residnet.read_logs` use the same drafts.
Recordings map their standard messages; the result is checked and completed by names of fields.
"""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import validate_config
from residnet.core.errors import DataError, ResidnetError, UsageError
from residnet.core.layout import DegreesOfFreedom
from residnet.core.log import Log
from residnet.core.progress import report_progress
from residnet.core.units import to_si
from residnet.io.drafting.motion_regression import (
    MIN_STANDARD_ERRORS,
    RawTable,
    ScaleFit,
    estimate_rudder_gain,
    fit_rate_to_angle,
)
from residnet.io.drafting.problems import (
    UnreadableLogsError,
    name_files_in_errors,
    raise_unreadable,
)
from residnet.io.drafting.questions import (
    CHANNELS_KEY,
    INPUTS_KEY,
    READER_KEY,
    DraftNotes,
    Key,
)
from residnet.io.drafting.recordings import draft_recordings
from residnet.io.drafting.tables import draft_tables
from residnet.io.drafting.trips import draft_trip_parts, group_by_trip, refuse_topics
from residnet.io.header_vocabulary import PLANE_PATTERN, parse_header_unit
from residnet.io.readers import ReaderConfig
from residnet.io.readers.detect import detect_log_kind, is_channel_reader
from residnet.io.readers.manoeuvre_kinds import UNKNOWN
from residnet.io.readers.recording import Recording
from residnet.io.readers.tables import read_column_names
from residnet.io.split import assign_log_names
from residnet.preprocessing.motion import MotionConfig, complete_motion


@dataclass
class DraftResult:
    """Drafted reader and its logs.

    Attributes:
        reader: settings of the reader, `data.reader` of a config.
        draft_notes: guesses and notes on these settings.
        logs: path -> log in SI.
        errors: path -> error of a log that cannot be read.
    """

    reader: dict[str, Any]
    draft_notes: DraftNotes
    logs: dict[Path, Log] = dataclasses.field(default_factory=dict)
    errors: dict[Path, ResidnetError] = dataclasses.field(default_factory=dict)


def read_drafted(
    paths: Sequence[Path], draft_notes: DraftNotes, *, is_gridded: bool = True
) -> DraftResult:
    """Draft a reader for files of one format and read them.

    Args:
        paths: files.
        draft_notes: receives guesses and notes.
        is_gridded: whether recordings get a uniform clock; otherwise the clock of their positions.

    Raises:
        UsageError: if the files have several formats.
        DataError: if no file can be read.
    """
    log_kind = _detect_common_kind(paths)
    result = DraftResult({"kind": "canonical"}, draft_notes)
    recordings: dict[Path, Recording] = {}
    if log_kind == "table" and (trip_files := group_by_trip(paths)):
        result.reader, result.errors = draft_trip_parts(trip_files, draft_notes)
        result.errors |= {
            path: DataError(f"{path}: another file of its trip is missing; leave it out")
            for path in sorted(set(paths).difference(*trip_files.values()))
        }
        # a trip has the name of its file with the most channels of the motion
        paths = [*trip_files[next(iter(result.reader["parts"]))]]
    elif log_kind == "table":
        refuse_topics(paths)
        with name_files_in_errors(paths):
            result.reader, result.errors = draft_tables(paths, draft_notes)
    elif is_channel_reader(log_kind):
        # a registered reader that returns channels in SI units needs no channel map
        result.reader = {"kind": log_kind}
    elif log_kind != "canonical":
        result.reader, recordings = draft_recordings(paths, draft_notes)
    settings = {key: value for key, value in result.reader.items() if is_gridded or key != "clock"}
    reader = validate_config(settings, ReaderConfig, "draft").build()
    names = assign_log_names(paths)
    for number, path in enumerate(paths):
        report_progress("reading logs", number, len(paths))
        try:
            if path not in result.errors:
                # recordings from which the reader was drafted are loaded already
                recording = recordings.pop(path, None)
                log = reader.read(path) if recording is None else reader.to_log(recording)
                result.logs[path] = log.replace(name=names[path])
        except ResidnetError as error:
            result.errors[path] = error
    report_progress("reading logs", len(paths), len(paths))
    if not result.logs:
        raise_unreadable(result.errors)
    _correct_joined_rates(result)
    _correct_rudder_signs(result)
    _note_manoeuvres(result)
    return result


def _detect_common_kind(paths: Sequence[Path]) -> str:
    """Return the format of logs.

    Raises:
        UsageError: if they have several formats.
    """
    kinds = {path: detect_log_kind(path) for path in paths}
    if len({*kinds.values()}) > 1:
        names = {
            kind: ", ".join(path.name for path in paths if kinds[path] == kind)
            for kind in sorted({*kinds.values()})
        }
        text = "; ".join(f"{kind}: {file_names[:120]}" for kind, file_names in names.items())
        raise UsageError(
            f"the logs have several formats, one was expected ({text}); give logs of one format"
        )
    return kinds[paths[0]]


def _note_manoeuvres(result: DraftResult) -> None:
    """Note the kinds of manoeuvres that the reader infers."""
    counts = Counter(log.manoeuvre for log in result.logs.values() if log.manoeuvre != UNKNOWN)
    if counts and result.reader.get("manoeuvre") == "auto":
        kinds = ", ".join(f"{count} {kind}" for kind, count in counts.items())
        text = f"{kinds} of {len(result.logs)} logs, by names of files or by rudder and heading"
        result.draft_notes.add_guess((*READER_KEY, "manoeuvre"), text)


def read_mixed_formats(
    paths: Sequence[Path], answers: Mapping[Key, str] | None = None
) -> list[DraftResult]:
    """Read logs of any formats with one drafted reader per format and set of columns.

    A group of logs without a readable one has the error in its result.

    Args:
        paths: files.
        answers: answers that the user has given in advance, by key.
    """
    kinds = {path: detect_log_kind(path) for path in paths}
    tables = [path for path, kind in kinds.items() if kind == "table"]
    has_trips = bool(group_by_trip(tables))
    if not has_trips:
        refuse_topics(tables)
    groups: dict[tuple[str, ...], list[Path]] = {}
    for path, kind in kinds.items():
        names = read_column_names(path) if kind == "table" and not has_trips else ()
        groups.setdefault((kind, *names), []).append(path)
    results = []
    for group in groups.values():
        draft_notes = DraftNotes(answers=answers)
        try:
            results.append(read_drafted(group, draft_notes, is_gridded=False))
        except UnreadableLogsError as error:
            results.append(DraftResult({}, draft_notes, errors=error.errors))
        except ResidnetError as error:
            results.append(DraftResult({}, draft_notes, errors=dict.fromkeys(group, error)))
    return results


def _scale_channel(result: DraftResult, name: str, entry: dict[str, Any], factor: float) -> None:
    """Multiply a channel of all logs by a factor, whose sign is that of its entry."""
    if factor < 0.0:
        entry["sign"] = -1 * int(entry.get("sign", 1))
    for path, log in result.logs.items():
        if name in log.channels:
            channels = {**log.channels, name: factor * log[name]}
            result.logs[path] = log.replace(channels=channels)


def _correct_joined_rates(result: DraftResult) -> None:
    """Correct sign and unit of a yaw rate whose heading is in another file of its trip.

    The settings of the drafted reader and the logs are changed in place.

    Args:
        result: drafted reader and its logs.
    """
    for part_name, part in result.reader.get("parts", {}).items():
        entry = part["channels"].get("r")
        logs = [log for log in result.logs.values() if {"psi", "r"} <= log.channels.keys()]
        if entry is None or "psi" in part["channels"]:
            continue
        tables = [RawTable(log.t, {"psi": log["psi"], "r": log["r"]}) for log in logs]
        fit = fit_rate_to_angle(tables, "psi", "rad", "r")
        if not fit.is_significant:
            continue
        factor = float(np.sign(fit.factor))
        text = "positive to port by headings" if factor < 0.0 else ""
        # the logs are in SI by the unit that was guessed
        old_factor = to_si(entry["unit"])
        unit = ScaleFit(fit.factor * old_factor, fit.correlation).matching_unit("rad/s")
        if unit not in (None, entry["unit"]) and not parse_header_unit(entry["column"], "rad/s"):
            factor *= to_si(unit) / old_factor
            entry["unit"] = unit
            text = f"the header has no unit; headings give {unit} {text}".strip()
        _scale_channel(result, "r", entry, factor)
        if text:
            key = (*READER_KEY, "parts", part_name, "channels", "r")
            result.draft_notes.add_guess(key, f"{text} (correlation {fit.correlation:.2f})")


def _correct_rudder_signs(result: DraftResult) -> None:
    """Reverse the sign of rudders that turn the vessel to port, and of planes that pitch it up.

    The signs of the drafted reader and of the logs are changed in place.

    Args:
        result: drafted reader and its logs.
    """
    channel_maps: dict[Key, dict[str, Any]] = {
        (*READER_KEY, "parts", part_name, "channels"): part["channels"]
        for part_name, part in result.reader.get("parts", {}).items()
    }
    channel_maps = channel_maps or {CHANNELS_KEY: result.reader.get("channels", {})}
    channel_names = dict.fromkeys(name for log in result.logs.values() for name in log.channels)
    names = [name for name in channel_names if re.match(r"(cmd_)?delta(?!_rate)", name)]
    logs_with_rates = [
        completed_log
        for log in result.logs.values()
        if names and (completed_log := _complete_turn_rates(log))
    ]
    for name in names:
        is_plane = PLANE_PATTERN.match(name) is not None
        rate, rate_sign, direction = ("q", -1.0, "up") if is_plane else ("r", 1.0, "to port")
        columns = [name, "theta"] if is_plane else [name]
        usable_logs = [log for log in logs_with_rates if {rate, *columns} <= log.channels.keys()]
        logs = [RawTable(log.t, {column: log[column] for column in columns}) for log in usable_logs]
        rates = {number: rate_sign * log[rate] for number, log in enumerate(usable_logs)}
        gain, standard_error = estimate_rudder_gain(
            logs, name, rates, "theta" if is_plane else None
        )
        key, entry = next(
            (((*key, name), part[name]) for key, part in channel_maps.items() if name in part),
            (INPUTS_KEY, {}),
        )
        text = f"positive values of {name} turned the vessel {direction} in the logs"
        if abs(gain) < MIN_STANDARD_ERRORS * standard_error:
            text = f"the logs do not determine in which direction {name} turns the vessel"
        elif gain >= 0.0:
            continue
        elif entry:
            _scale_channel(result, name, entry, -1.0)
            text += f" ({-gain / standard_error:.0f} standard errors): the sign is reversed"
        result.draft_notes.add_guess(key, text)


def _complete_turn_rates(log: Log) -> Log | None:
    """Return a log with yaw rate, and pitch rate for underwater vessels; None if impossible."""
    try:
        dof = DegreesOfFreedom.from_channels(log.channels)
        rates = {"r", "q"} if dof.is_six_dof else {"r"}
        return log if rates <= log.channels.keys() else complete_motion(log, MotionConfig(), dof)
    except ResidnetError:
        return None
