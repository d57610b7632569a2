"""Tables that are parts of the same trips."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.core.errors import ResidnetError, UsageError
from residnet.core.names import STATE_NAMES, truncate
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.questions import READER_KEY, DraftNotes
from residnet.io.drafting.table_preview import preview_table
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers.joined_files import group_trip_files
from residnet.io.readers.quantities import QUATERNION
from residnet.io.readers.tables import read_column_names


def draft_trip_parts(
    trip_files: Mapping[str, Sequence[Path]], draft_notes: DraftNotes
) -> tuple[dict[str, Any], dict[Path, ResidnetError]]:
    """Draft a reader that joins several tables of each trip.

    Args:
        trip_files: files of each part in the order of the trips, see `group_by_trip`.
        draft_notes: receives guesses and notes.

    Returns:
        Settings of the reader, the part with most channels of the motion first, and the error of
        each table that cannot be read.
    """
    part_settings: dict[str, dict[str, Any]] = {}
    errors: dict[Path, ResidnetError] = {}
    for part_name, files in trip_files.items():
        part_notes = DraftNotes()
        part_settings[part_name], part_errors = draft_tables(files, part_notes, has_heading=True)
        errors |= part_errors
        part_notes.move_key(READER_KEY, (*READER_KEY, "parts", part_name))
        draft_notes.extend(part_notes)
    part_order = sorted(
        part_settings, key=lambda name: -len(_motion_channels(part_settings[name]["channels"]))
    )
    text = (
        f"files whose names differ only in {' and '.join(part_order)} are joined as one trip;"
        " the clock offset follows from a yaw rate against a heading, from dates, or from the"
        " motion that the commands explain"
    )
    draft_notes.add_guess((*READER_KEY, "parts"), text)
    parts = {part_name: part_settings[part_name] for part_name in part_order}
    return {"kind": "joined", "parts": parts}, errors


def group_by_trip(paths: Sequence[Path]) -> dict[str, list[Path]]:
    """Group tables that are parts of trips by the word in which their names differ.

    Two files that both have a position or a speed are separate logs, of two vessels or of two
    recorders. A heading may be in both.

    Returns:
        Word -> tables in the order of the trips; empty if the tables are separate logs.
    """
    columns = {path: read_column_names(path) for path in paths}
    # tables without channels next to logs are notes
    paths_by_columns: dict[tuple[str, ...], list[Path]] = {}
    for path, names in columns.items():
        paths_by_columns.setdefault(names, []).append(path)
    log_groups = {
        n: files
        for n, files in paths_by_columns.items()
        if len(paths_by_columns) > 1 and _channels_from_headers(files)
    }
    trip_files = group_trip_files(
        {path: names for path, names in columns.items() if names in log_groups}
    )
    motion_sets = [
        _motion_channels(_channels_from_headers(files)) & {*"xyuv"} for files in trip_files.values()
    ]
    is_ambiguous = any(
        first_set & second_set for first_set, second_set in itertools.combinations(motion_sets, 2)
    )
    return {} if is_ambiguous else trip_files


def refuse_topics(paths: Sequence[Path]) -> None:
    """Stop if tables are the topics of several recordings in one folder, as `ulog2csv` writes them.

    The name of such a table is that of its recording and that of its topic. Topics have different
    columns, and at most one of them has the complete motion.

    Args:
        paths: tables that are not parts of trips.

    Raises:
        UsageError: if they are topics.
    """
    longest_name = max((path.stem.count("_") for path in paths), default=0)
    for n_words in range(longest_name, 0, -1):
        topics: dict[str, dict[str, Path]] = {}
        for path in paths:
            words = path.stem.split("_")
            recording = "_".join(words[:n_words])
            topics.setdefault(recording, {})["_".join(words[n_words:])] = path
        first, *others = topics.values()
        if not others or len(first) < 2 or any(other.keys() != first.keys() for other in others):
            continue
        headers, *other_headers = [
            {topic: read_column_names(path) for topic, path in files.items()}
            for files in topics.values()
        ]
        if len({*headers.values()}) < 2 or any(other != headers for other in other_headers):
            continue
        channels = [_motion_channels(_channels_from_headers([path])) for path in first.values()]
        if sum({"x", "y", "psi"} <= names for names in channels) < 2:
            raise UsageError(
                f"{paths[0].parent}: the tables are {len(first)} topics"
                f" ({truncate(', '.join(first), 100)}) of {len(topics)} recordings"
                f" ({truncate(', '.join(topics), 60)}); move the files of each recording to a"
                " folder of its own"
            )


def _channels_from_headers(files: Sequence[Path]) -> Iterable[str]:
    """Return the channels of the column names of the first readable table; may be empty."""
    for path in files:
        with contextlib.suppress(ResidnetError):
            if channels := match_channels([*preview_table(path, 50).numeric_columns], DraftNotes()):
                return channels
    return ()


def _motion_channels(channels: Iterable[str]) -> set[str]:
    """Return the channels of position, heading, velocities and roll under canonical names."""
    equivalent_channels = {"latitude": "x", "longitude": "y", **dict.fromkeys(QUATERNION, "psi")}
    return {equivalent_channels.get(name, name) for name in channels} & {*STATE_NAMES, "phi", "p"}
