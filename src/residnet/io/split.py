"""Assignment of logs, or intervals of logs, to training, validation and test.

The config selects files by patterns and intervals by times, or residnet divides the logs. Two
splits must not share measurements.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, model_validator

from residnet.core.arrays.paged import MAX_SAMPLES_IN_MEMORY, is_memory_mapped, release_pages
from residnet.core.config import Config, ConfigPath, Seconds, load_mapping, validate_config
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES, suggest_name
from residnet.io.readers.base import list_files, locate_file
from residnet.preprocessing.motion import remove_pauses

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SPLITS = ("train", "validation", "test")
_MIN_LOGS_FOR_WHOLE_SPLITS = 5
"""Smallest number of logs for splits of complete logs."""
_MIN_TEST_LOGS = 3
"""Number of test logs that a verdict needs."""
_MIN_LOGS_FOR_TEST_LOGS = 8
"""Smallest number of logs of which so many become test logs."""
_SPLIT_SHARES = (
    ("train", 0.0, 0.3),
    ("validation", 0.3, 0.5),
    ("train", 0.5, 0.8),
    ("test", 0.8, 1.0),
)
"""Split, start and end (share of the duration) of the intervals of each log if logs are few."""
_MAX_SHARED_ROWS = 100
"""Largest number of equal rows in two logs; with more, one is a partial copy of the other."""


class LogPart(Config):
    """Logs, or an interval of logs, for a split.

    Attributes:
        log: path or pattern of files, folders and bags, relative to `root`.
        from: start of the interval in s on the log's clock; null for the start of the log.
        to: end of the interval in s; null for the end of the log.
        manoeuvre: type of manoeuvre that logs must have; null accepts all.
    """

    log: str
    start: Seconds | None = Field(default=None, alias="from")
    stop: Seconds | None = Field(default=None, alias="to")
    manoeuvre: str | None = None

    @model_validator(mode="after")
    def check_order(self) -> LogPart:
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError(
                f"the interval from {self.start:.10g} s to {self.stop:.10g} s is empty; `to` must"
                " be later than `from`"
            )
        return self

    @property
    def path(self) -> Path:
        """Path of the file or folder, if `log` is no pattern."""
        return Path(self.log)

    @property
    def is_whole_log(self) -> bool:
        """Whether the part has neither a start nor a stop."""
        return self.start is None and self.stop is None

    @property
    def time_range(self) -> tuple[float, float]:
        """Start and end in s; infinite for the start and end of the log."""
        start = -np.inf if self.start is None else self.start
        stop = np.inf if self.stop is None else self.stop
        return start, stop

    def overlaps(self, other: LogPart) -> bool:
        """Return whether two parts of one log share a time interval and may share a manoeuvre."""
        is_other_manoeuvre = self.manoeuvre != other.manoeuvre and None not in (
            self.manoeuvre,
            other.manoeuvre,
        )
        return not is_other_manoeuvre and max(self.time_range[0], other.time_range[0]) < min(
            self.time_range[1], other.time_range[1]
        )

    def extract(self, log: Log) -> Log | None:
        """Extract this part from a log; None if the log has another manoeuvre.

        Raises:
            DataError: if the interval has fewer than two samples.
        """
        if self.manoeuvre not in (None, log.manoeuvre):
            return None
        return log if self.is_whole_log else extract_segment(log, *self.time_range)


def extract_segment(log: Log, start_time: float, stop_time: float) -> Log:
    """Return the samples of a log with start <= t < stop as a log with a new name.

    Args:
        log: the log.
        start_time: start in s; -inf for the start of the log.
        stop_time: end in s; inf for the end of the log.

    Raises:
        DataError: if the interval has fewer than two samples.
    """
    is_inside = (log.t >= start_time - 1e-9) & (log.t < stop_time - 1e-9)
    first_time = float(log.t[0])
    last_time = float(log.t[-1])
    time_range = [
        start_time if np.isfinite(start_time) else first_time,
        stop_time if np.isfinite(stop_time) else last_time,
    ]
    if is_inside.sum() < 2:
        raise DataError(
            f"log {log.name}: {int(is_inside.sum())} samples from {time_range[0]:.10g} s to"
            f" {time_range[1]:.10g} s, at least 2 are needed; the log runs from {first_time:.10g} s"
            f" to {last_time:.10g} s"
        )
    name = "_".join(
        [log.name, *(f"{time_limit:.13g}s".replace(".", "p") for time_limit in time_range)]
    )
    first_index = int(np.argmax(is_inside))
    # a slice is a view without a copy
    segment = log.select_rows(slice(first_index, first_index + int(is_inside.sum()))).replace(
        name=name, meta={**log.meta, "stretch": time_range}
    )
    return segment.move_to_disk() if is_memory_mapped(log.t) else segment


def resolve_log_parts(
    root: Path, entries: Sequence[str | LogPart], error_prefix: str
) -> list[LogPart]:
    """Resolve patterns of a split to parts of single logs without duplicates.

    Args:
        root: folder of relative patterns.
        entries: patterns, or parts with patterns.
        error_prefix: start of messages.

    Raises:
        ConfigError: if a pattern matches nothing.
    """
    log_parts: dict[LogPart, None] = {}
    for entry in entries:
        log_part = entry if isinstance(entry, LogPart) else LogPart(log=entry)
        for path in match_patterns(root, [log_part.log], error_prefix):
            log_parts[log_part.model_copy(update={"log": str(path)})] = None
    return list(log_parts)


class SplitFile(Config):
    """Separate YAML file with the logs of the three splits; see `SplitConfig`."""

    train: tuple[str | LogPart, ...] = Field(min_length=1)
    validation: tuple[str | LogPart, ...] = Field(min_length=1)
    test: tuple[str | LogPart, ...] = Field(min_length=1)


class SplitConfig(Config):
    """Logs of the three splits: from a YAML file, from patterns, or divided automatically.

    Attributes:
        file: YAML file with the keys train, validation and test, each a list of paths or patterns
            relative to `root`.
        root: folder of relative paths and patterns; by default the folder of `file`, otherwise the
            current folder.
        auto: patterns of logs that residnet divides. Of each five logs, sorted by manoeuvre, the
            third is for validation and the fifth for the test. Fewer than five logs are divided in
            time. Copies of logs are left out.
        train: training logs, if there is no `file`: files, folders, bags or patterns such as
            `turning/*.csv` (`**` for any depth), time intervals such as `{log: trip.mcap,
            from: 120 s, to: 300 s}`, or logs of a manoeuvre such as `{log: "*.csv", manoeuvre:
            zigzag}`.
        validation: validation logs, on which models are selected.
        test: test logs, which no selection uses.
    """

    file: ConfigPath | None = None
    root: ConfigPath | None = None
    auto: tuple[str, ...] = ()
    train: tuple[str | LogPart, ...] = Field(default=())
    validation: tuple[str | LogPart, ...] = Field(default=())
    test: tuple[str | LogPart, ...] = Field(default=())

    @model_validator(mode="after")
    def check_source(self) -> SplitConfig:
        named_splits = [name for name in SPLITS if getattr(self, name)]
        if self.auto and (named_splits or self.file is not None):
            given_text = ", ".join([*named_splits, *(["file"] if self.file is not None else [])])
            raise ValueError(
                f"give either `auto`, `file` or patterns (given: auto and {given_text})"
            )
        if self.auto:
            return self
        if self.file is not None and named_splits:
            raise ValueError(
                "give either `file` or patterns, not both (given: file and"
                f" {', '.join(named_splits)})"
            )
        if self.file is None and len(named_splits) < len(SPLITS):
            missing_splits = [name for name in SPLITS if name not in named_splits]
            raise ValueError(
                f"no files for {', '.join(missing_splits)}; give patterns for train, validation and"
                " test, one `file` with these lists, or `auto` with patterns of all logs"
            )
        return self

    def resolve_parts(self) -> dict[str, list[LogPart]]:
        """Return split -> parts of logs in the order of its patterns; empty for `auto`.

        The matches of a pattern are sorted.

        Raises:
            ConfigError: if a split is empty, a pattern matches nothing, or an interval belongs to
                two splits.
        """
        if self.auto:
            return {}
        root = self._find_root()
        error_prefix = "split" if self.file is None else str(self.file)
        split_settings = (
            self
            if self.file is None
            else validate_config(load_mapping(self.file), SplitFile, error_prefix)
        )
        parts_by_split = {
            name: resolve_log_parts(root, getattr(split_settings, name), f"{error_prefix}: {name}")
            for name in SPLITS
        }
        listed_parts = [
            (log_part.path.resolve(), split, log_part)
            for split, parts_of_split in parts_by_split.items()
            for log_part in parts_of_split
        ]
        for part_index, (resolved_path, split, log_part) in enumerate(listed_parts):
            for other_path, other_split, other_part in listed_parts[:part_index]:
                if (
                    other_path == resolved_path
                    and other_split != split
                    and log_part.overlaps(other_part)
                ):
                    subject = "" if log_part.is_whole_log else "an interval of "
                    raise ConfigError(
                        f"{error_prefix}: {subject}{log_part.path} belongs to {other_split} and to"
                        f" {split}; assign it to one split"
                    )
        return parts_by_split

    def list_files(self) -> list[Path]:
        """Return the paths of all logs without duplicates.

        Raises:
            ConfigError: see `resolve_parts`.
        """
        if self.auto:
            return match_patterns(self._find_root(), self.auto, "split: auto")
        return list(
            dict.fromkeys(part.path for parts in self.resolve_parts().values() for part in parts)
        )

    def resolve_paths(self) -> dict[str, list[Path]]:
        """Return split -> paths of its logs; empty for `auto`.

        Raises:
            ConfigError: see `resolve_parts`.
        """
        return {
            split: list(dict.fromkeys(part.path for part in parts))
            for split, parts in self.resolve_parts().items()
        }

    def _find_root(self) -> Path:
        root = self.root or (self.file.parent if self.file is not None else Path.cwd())
        if not root.is_dir():
            raise ConfigError(f"split: root {root} is not a folder; correct `root`")
        return root


def split_logs(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Divide logs into train, validation and test, without copies of logs.

    - If folders or files are called train and test (and validation), these are the splits.
    - Of each five logs, sorted by manoeuvre, the third is for validation and the fifth for the
      test. Of eight or more logs at least three are for the test, which a verdict needs.
    - Fewer than five logs are divided in time: 0 to 30 % and 50 to 80 % of the duration are for
      training, 30 to 50 % for validation, 80 to 100 % for the test.

    Raises:
        DataError: if a log is too short to be divided.
    """
    distinct_logs = remove_copies(logs)
    logs_by_split: dict[str, list[Log]] = {split: [] for split in SPLITS}
    split_names = splits_from_names(distinct_logs)
    n_logs = len(distinct_logs)
    if not split_names and n_logs >= _MIN_LOGS_FOR_WHOLE_SPLITS:
        logs_per_test_log = (
            n_logs / _MIN_TEST_LOGS
            if _MIN_LOGS_FOR_TEST_LOGS <= n_logs < _MIN_TEST_LOGS * _MIN_LOGS_FOR_WHOLE_SPLITS
            else _MIN_LOGS_FOR_WHOLE_SPLITS
        )
        test_indices = {int((k + 0.8) * logs_per_test_log) for k in range(n_logs)}
        distinct_logs = sorted(distinct_logs, key=lambda log: log.manoeuvre)
        split_names = [
            "test" if log_index in test_indices else "train" for log_index in range(n_logs)
        ]
    if split_names:
        for log, split_name in zip(distinct_logs, split_names, strict=True):
            logs_by_split[split_name].append(log)
        if not logs_by_split["validation"]:
            training_logs = logs_by_split["train"]
            validation_indices = range(2, len(training_logs), 4) or range(
                len(training_logs) - 1, 0, -len(training_logs)
            )
            logs_by_split["validation"] = [
                training_logs[log_index] for log_index in validation_indices
            ]
            logs_by_split["train"] = [
                log
                for log_index, log in enumerate(training_logs)
                if log_index not in validation_indices
            ]
        return logs_by_split
    for log in distinct_logs:
        elapsed = remove_pauses(log.t)
        duration = float(log.t[-1] - log.t[0])
        # round times to three significant digits of the duration
        n_digits = max(0, 2 - int(np.log10(max(duration, 1e-9))))
        for split, *share_limits in _SPLIT_SHARES:
            start_time, stop_time = (
                round(float(np.interp(share * elapsed[-1], elapsed, log.t)), n_digits)
                for share in share_limits
            )
            segment_start = start_time if share_limits[0] else -np.inf
            segment_stop = stop_time if share_limits[1] < 1.0 else np.inf
            logs_by_split[split].append(extract_segment(log, segment_start, segment_stop))
    return logs_by_split


def splits_from_names(logs: Sequence[Log]) -> list[str]:
    """Return the split of each log from the name of its file or folder.

    The list is empty unless all names contain a split, with at least two logs for training and
    validation and one log for the test.
    """
    from residnet.io.header_vocabulary import SPLIT_NAMES

    split_names = []
    for log in logs:
        path = Path(str(log.meta.get("source", "")).lower())
        name_parts = [re.split(r"[\W_\d]+", path.stem)[0], *reversed(path.parent.parts)]
        split_names.append(
            next((SPLIT_NAMES[word] for word in name_parts if word in SPLIT_NAMES), "")
        )
    has_several_training_logs = split_names.count("train") + split_names.count("validation") > 1
    return (
        split_names
        if has_several_training_logs
        and "" not in split_names
        and {"train", "test"} <= {*split_names}
        else []
    )


def remove_copies(logs: Sequence[Log]) -> list[Log]:
    """Return the logs without those that share more than 100 rows with a longer log."""
    common_channels = sorted(set.intersection(*(set(log.channels) for log in logs))) if logs else []
    if len(logs) < 2 or not common_channels:
        return [*logs]
    shared_rows = _count_shared_rows(
        [np.unique(hash_measured_rows(log, common_channels)) for log in logs]
    )
    is_retained = np.zeros(len(logs), dtype=bool)
    for i in sorted(range(len(logs)), key=lambda i: -len(logs[i])):
        row_slice = slice(shared_rows.indptr[i], shared_rows.indptr[i + 1])
        is_retained[i] = not (
            is_retained[shared_rows.indices[row_slice]]
            & (shared_rows.data[row_slice] > _MAX_SHARED_ROWS)
        ).any()
    return [log for log, is_retained_log in zip(logs, is_retained, strict=True) if is_retained_log]


def _count_shared_rows(hashes: Sequence[np.ndarray]) -> csr_array:
    """Return the numbers of distinct rows that pairs of logs share, sparse [L, L].

    Args:
        hashes: unique hashes of the rows of each log.
    """
    from scipy.sparse import coo_array, csr_array

    log_indices = np.repeat(np.arange(len(hashes)), [log_hashes.size for log_hashes in hashes])
    _, hash_indices, n_occurrences = np.unique(
        np.concatenate(hashes), return_inverse=True, return_counts=True
    )
    is_shared = n_occurrences[hash_indices] > 1
    row_and_column = log_indices[is_shared], hash_indices[is_shared]
    incidence = coo_array(
        (np.ones(is_shared.sum()), row_and_column), (len(hashes), n_occurrences.size)
    ).tocsr()
    shared_counts = csr_array(incidence @ incidence.T)
    shared_counts.sort_indices()
    return shared_counts


def check_leaks(
    logs_by_split: Mapping[str, Sequence[Log]], max_shared_rows: int = _MAX_SHARED_ROWS
) -> None:
    """Raise an error if two logs of different splits share measurements.

    Rows of the common channels are compared without time and with angles modulo a full circle, so
    that copies with another clock or another start of the heading are detected. Equal rows within
    one log (a vessel at rest) count once.

    Args:
        logs_by_split: split -> logs.
        max_shared_rows: largest number of distinct rows that two logs may share.

    Raises:
        DataError: if two logs share more rows; the message names the worst pair.
    """
    splits_and_logs = [
        (split, log) for split, logs_of_split in logs_by_split.items() for log in logs_of_split
    ]
    common_channels = (
        sorted(set.intersection(*(set(log.channels) for _, log in splits_and_logs)))
        if splits_and_logs
        else []
    )
    # of very many rows a sample is compared; equal rows have equal hashes and are sampled together
    interval = row_sampling_interval([log for _, log in splits_and_logs])
    hashes = [
        hash_measured_rows(log, common_channels) for _, log in splits_and_logs if common_channels
    ]
    hashes = [np.unique(log_hashes[log_hashes % np.uint64(interval) == 0]) for log_hashes in hashes]
    has_hashes = any(log_hashes.size for log_hashes in hashes)
    if len({split for split, _ in splits_and_logs}) < 2 or not has_hashes:
        return
    shared_counts = _count_shared_rows(hashes).tocoo()
    split_indices = np.unique([split for split, _ in splits_and_logs], return_inverse=True)[1]
    cross_split_counts = np.where(
        split_indices[shared_counts.row] != split_indices[shared_counts.col],
        shared_counts.data,
        0.0,
    )
    if not cross_split_counts.any():
        return
    largest_index = int(np.argmax(cross_split_counts))
    (first_split, first_log) = splits_and_logs[shared_counts.row[largest_index]]
    (second_split, second_log) = splits_and_logs[shared_counts.col[largest_index]]
    n_identical = np.intersect1d(
        hash_measured_rows(first_log, common_channels),
        hash_measured_rows(second_log, common_channels),
    ).size
    if n_identical > max_shared_rows:
        raise DataError(
            f"logs {first_log.name} ({first_split}) and {second_log.name} ({second_split}) share"
            f" {n_identical} identical rows, at most {max_shared_rows} are allowed; one is a"
            " partial copy of the other: leave one out, or assign both to one split"
        )


def row_sampling_interval(logs: Sequence[Log]) -> int:
    """Return k if one of k rows is compared between logs, to limit memory with many samples."""
    return -(-sum(len(log) for log in logs) // MAX_SAMPLES_IN_MEMORY)


_MOTION_CHANNELS = (*STATE_NAMES, "phi", "p")


def hash_measured_rows(log: Log, channels: Sequence[str]) -> np.ndarray:
    """Return hashes of the rows with at least half of the motion channels, uint64 [K].

    In logs with several sampling rates other rows have commands only, which may be equal by chance.
    """
    motion_channels = [name for name in channels if name in _MOTION_CHANNELS] or channels
    n_measured = np.isfinite(log.stack(tuple(motion_channels))).sum(axis=1)
    return np.asarray(hash_rows(log, channels)[2 * n_measured >= n_measured.max(initial=0)])


_ROWS_PER_HASH_CHUNK = 250_000
"""Number of rows that are hashed at once; bounds the memory for copies of the channels."""


def hash_rows(log: Log, channels: Sequence[str]) -> np.ndarray:
    """Return a hash of the given channels for each row, uint64 [T]."""
    import pandas as pd

    hashes = np.empty(len(log), dtype=np.uint64)
    # chunks, because the temporary arrays of millions of rows would double the memory of the log
    for start in range(0, len(log), _ROWS_PER_HASH_CHUNK):
        chunk = slice(start, start + _ROWS_PER_HASH_CHUNK)
        columns = {}
        for name in channels:
            values = log[name][chunk]
            # a copy that was unwrapped from another start differs by rounding errors in the heading
            columns[name] = (
                np.round(np.remainder(values, 2.0 * np.pi), 9)
                if log.units[name] == "rad"
                else values + 0.0
            )
        hashes[chunk] = pd.util.hash_pandas_object(pd.DataFrame(columns), index=False).to_numpy()
    release_pages()
    return hashes


def find_logs(folder: Path) -> list[Path]:
    """Return the logs below a folder in sorted order: recordings (folders) and files.

    Files with unknown extensions are tested by content if there are no others.
    """
    from residnet.io.readers.detect import (
        detect_recording_format,
        is_text_table,
        list_log_endings,
    )

    log_endings = list_log_endings()
    return _find_logs_recursively(
        folder, lambda path: path.suffix.lower() in log_endings
    ) or _find_logs_recursively(
        folder, lambda path: detect_recording_format(path) is not None or is_text_table(path)
    )


def _find_logs_recursively(folder: Path, is_log: Callable[[Path], bool]) -> list[Path]:
    from residnet.io.readers.detect import detect_recording_format

    if detect_recording_format(folder) is not None and not _contains_recordings(folder):
        return [folder]
    log_paths: list[Path] = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            log_paths += _find_logs_recursively(path, is_log)
        elif is_log(path):
            log_paths.append(path)
    return log_paths


def _contains_recordings(folder: Path) -> bool:
    """Return whether several subfolders contain files of the same names, as recordings do."""
    subfolders = [path for path in folder.iterdir() if path.is_dir()]
    file_name_sets = [
        frozenset(f.relative_to(path) for f in list_files(path)) for path in subfolders
    ]
    return any(
        file_name_sets.count(file_names) > 1 and len(file_names) > 1
        for file_names in file_name_sets
    )


def assign_log_names(paths: Iterable[Path]) -> dict[Path, str]:
    """Return a unique name for each log.

    It is the name of the file without extension, or of the folder. Equal names are preceded by the
    names of parent folders until they are unique. Files in one folder that differ in their
    extension include the extension in their names.

    Args:
        paths: files and recordings; duplicates are one log.
    """
    distinct_paths = list(dict.fromkeys(paths))
    resolved_paths = {path: path.resolve() for path in distinct_paths}
    n_parent_names = dict.fromkeys(distinct_paths, 0)
    n_by_stem = Counter(
        (resolved_path.parent, path.stem)
        for resolved_path, path in {
            resolved_paths[distinct_path]: distinct_path for distinct_path in distinct_paths
        }.items()
    )
    while True:
        names_by_path = {
            path: _make_log_name(path, resolved_paths[path], n_parent_names[path], n_by_stem)
            for path in distinct_paths
        }
        paths_by_name: dict[str, set[Path]] = {}
        for path, log_name in names_by_path.items():
            paths_by_name.setdefault(log_name, set()).add(resolved_paths[path])
        ambiguous_paths = [
            path
            for path, log_name in names_by_path.items()
            if len(paths_by_name[log_name]) > 1
            and n_parent_names[path] < len(resolved_paths[path].parents) - 1
        ]
        if not ambiguous_paths:
            return names_by_path
        for path in ambiguous_paths:
            n_parent_names[path] += 1


def _make_log_name(
    path: Path, resolved_path: Path, n_parent_names: int, n_by_stem: Mapping[tuple[Path, str], int]
) -> str:
    """Return the name of a log with a number of parent folders before it."""
    if path.is_dir():
        base_name = path.name
    elif n_by_stem[resolved_path.parent, path.stem] == 1:
        base_name = path.stem
    else:
        base_name = path.name.replace(".", "_")
    parents = list(reversed(resolved_path.parents[:n_parent_names]))
    parent_names = [parent.stem if parent.is_file() else parent.name for parent in parents]
    return "_".join([*parent_names, base_name])


def match_patterns(root: Path, patterns: Sequence[str], error_prefix: str) -> list[Path]:
    """Return the logs that match patterns, without duplicates, including all logs in folders.

    A file with several tests is a log for each test.

    Args:
        root: folder of relative patterns.
        patterns: paths or glob patterns.
        error_prefix: start of messages.

    Raises:
        ConfigError: if a pattern matches no log.
    """
    from residnet.io.readers.several_tests import expand_files

    log_paths: dict[Path, None] = {}
    for pattern in patterns:
        # an existing path may contain characters with a meaning in patterns
        path = root / pattern
        is_log = path.exists() or locate_file(path) != path
        matched_paths = [path] if is_log else _glob(root, pattern, error_prefix)
        matched_logs = expand_files(
            log
            for matched_path in matched_paths
            for log in (find_logs(matched_path) if matched_path.is_dir() else [matched_path])
        )
        if not matched_logs:
            parent = path.parent
            hint = (
                suggest_name(Path(pattern).name, (path.name for path in parent.iterdir()))
                if parent.is_dir()
                else f"; there is no folder {parent}"
            )
            raise ConfigError(f"{error_prefix}: '{pattern}' matches no file in {root}{hint}")
        log_paths.update(dict.fromkeys(matched_logs))
    return list(log_paths)


def _glob(root: Path, pattern: str, error_prefix: str) -> list[Path]:
    """Return the files, otherwise the recordings, that match a pattern, in sorted order."""
    from residnet.io.readers.detect import detect_recording_format

    reason_text = "it is an absolute path" if Path(pattern).is_absolute() else ""
    try:
        if not reason_text:
            matched_paths = sorted(root.glob(pattern))
            matched_files = [path for path in matched_paths if path.is_file()]
            return matched_files or [
                path for path in matched_paths if path.is_dir() and detect_recording_format(path)
            ]
    except ValueError as error:
        reason_text = str(error)
    raise ConfigError(
        f"{error_prefix}: '{pattern}' is not a pattern relative to {root} ({reason_text}); set"
        " `root` instead"
    )
