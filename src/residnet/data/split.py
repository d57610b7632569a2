"""Which logs, and which stretches of them, are for training, validation and test.

Files are named by patterns; a log may be cut in time. Where nobody said which is which they are
divided here, and no two splits may share measurements.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field, model_validator

from residnet.core.arrays.paged import LARGE, forget, lies_on_disk
from residnet.core.config import Config, ConfigPath, Seconds, load_mapping, validate
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import STATE, nearest
from residnet.data.motion import without_pauses
from residnet.data.readers.base import files_of
from residnet.data.readers.detect import LOG_ENDINGS, format_of, is_text_table

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SPLITS = ("train", "validation", "test")
_ENOUGH = 5
"""Logs from which whole ones are taken for each split."""
_JUDGED, _SPARED = 3, 8
"""Test logs without which no verdict is passed, and logs of which so many can be spared."""
_SHARES = (("train", 0.0, 0.3), ("validation", 0.3, 0.5), ("train", 0.5, 0.8), ("test", 0.8, 1.0))
"""Stretches of each log where there are fewer."""
_CALLED = {
    **dict.fromkeys(("train", "training"), "train"),
    **dict.fromkeys(("validation", "valid", "val", "dev"), "validation"),
    **dict.fromkeys(("test", "testing"), "test"),
}
"""What folders and files of a split are called."""
_COPIED = 100
"""Rows that two logs may share before one is a copy of part of the other."""


class LogPart(Config):
    """Logs, or a stretch of one, that belong to a split.

    Attributes:
        log: path or pattern of files, folders and bags, relative to `root`.
        from: time in s on the log's own clock at which the stretch begins; null for its start.
        to: time in s at which it ends; null for the log's end.
        manoeuvre: only logs of this kind of manoeuvre; null for all.
    """

    log: str
    start: Seconds | None = Field(default=None, alias="from")
    stop: Seconds | None = Field(default=None, alias="to")
    manoeuvre: str | None = None

    @model_validator(mode="after")
    def _order(self) -> LogPart:
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError(
                f"a stretch from {self.start:.10g} s to {self.stop:.10g} s holds nothing"
            )
        return self

    @property
    def path(self) -> Path:
        """The file or folder, where it names one (`parts_of`)."""
        return Path(self.log)

    @property
    def whole(self) -> bool:
        """Whether it is the log from end to end."""
        return self.start is None and self.stop is None

    @property
    def ends(self) -> tuple[float, float]:
        """Times at which it begins and ends, s; infinite for those of the log."""
        start, stop = self.start, self.stop
        return -np.inf if start is None else start, np.inf if stop is None else stop

    def overlaps(self, other: LogPart) -> bool:
        """Return whether two parts of one log share a stretch of time, whatever its kind."""
        apart = self.manoeuvre != other.manoeuvre and None not in (self.manoeuvre, other.manoeuvre)
        return not apart and max(self.ends[0], other.ends[0]) < min(self.ends[1], other.ends[1])

    def of(self, log: Log) -> Log | None:
        """Return this part of a log; None where the log is of another manoeuvre.

        Raises:
            DataError: where the stretch holds fewer than two samples.
        """
        if self.manoeuvre not in (None, log.manoeuvre):
            return None
        return log if self.whole else stretch_of(log, *self.ends)


def stretch_of(log: Log, start: float, stop: float) -> Log:
    """Return the samples of a log with start <= t < stop, under a name of their own."""
    inside = (log.t >= start - 1e-9) & (log.t < stop - 1e-9)
    first, last = float(log.t[0]), float(log.t[-1])
    ends = [start if np.isfinite(start) else first, stop if np.isfinite(stop) else last]
    if inside.sum() < 2:
        raise DataError(
            f"log {log.name}: {int(inside.sum())} samples from {ends[0]:.10g} s to"
            f" {ends[1]:.10g} s; the log runs from {first:.10g} s to {last:.10g} s"
        )
    name = "_".join([log.name, *(f"{end:.13g}s".replace(".", "p") for end in ends)])
    at = int(np.argmax(inside))
    # a slice, and no copy
    part = log.rows(slice(at, at + int(inside.sum()))).replace(
        name=name, meta={**log.meta, "stretch": ends}
    )
    return part.on_disk() if lies_on_disk(log.t) else part


def parts_of(root: Path, entries: Sequence[str | LogPart], where: str) -> list[LogPart]:
    """Return the parts of single logs that a split's entries name, each once."""
    out: dict[LogPart, None] = {}
    for entry in entries:
        wanted = entry if isinstance(entry, LogPart) else LogPart(log=entry)
        for path in matches(root, [wanted.log], where):
            out[wanted.model_copy(update={"log": str(path)})] = None
    return list(out)


class SplitFile(Config):
    """Logs of the three splits in a YAML file of their own, as in `SplitConfig`."""

    train: tuple[str | LogPart, ...] = Field(min_length=1)
    validation: tuple[str | LogPart, ...] = Field(min_length=1)
    test: tuple[str | LogPart, ...] = Field(min_length=1)


class SplitConfig(Config):
    """Logs of the three splits: from a YAML file, from patterns, or divided by residnet.

    Attributes:
        file: YAML file with the keys train, validation and test, each a list of paths or patterns
            relative to `root`.
        root: folder that paths and patterns start from; by default the folder of `file`, else the
            current folder.
        auto: patterns of logs that are divided by residnet: of each five logs, in the order of
            their manoeuvres, the third is for validation and the fifth for the test; fewer are cut
            in time. Copies are left out.
        train: files, folders, bags or patterns such as `turning/*.csv` (`**` for any depth), where
            there is no `file`; or stretches of time and logs of a manoeuvre, such as `{log:
            trip.mcap, from: 120 s, to: 300 s}` and `{log: "*.csv", manoeuvre: zigzag}`.
        validation: the same for the logs that models are chosen on.
        test: the same for the logs that nothing is chosen on.
    """

    file: ConfigPath | None = None
    root: ConfigPath | None = None
    auto: tuple[str, ...] = ()
    train: tuple[str | LogPart, ...] = Field(default=())
    validation: tuple[str | LogPart, ...] = Field(default=())
    test: tuple[str | LogPart, ...] = Field(default=())

    @model_validator(mode="after")
    def _one_source(self) -> SplitConfig:
        named = [name for name in SPLITS if getattr(self, name)]
        if self.auto and (named or self.file is not None):
            given = ", ".join([*named, *(["file"] if self.file is not None else [])])
            raise ValueError(f"give either `auto`, `file` or patterns (given: auto and {given})")
        if self.auto:
            return self
        if self.file is not None and named:
            raise ValueError(
                f"give either `file` or patterns, not both (given: file and {', '.join(named)})"
            )
        if self.file is None and len(named) < len(SPLITS):
            empty = [name for name in SPLITS if name not in named]
            raise ValueError(
                f"no files for {', '.join(empty)}; give patterns for train, validation and test,"
                " one `file` that names them, or `auto` with patterns of all logs"
            )
        return self

    def parts(self) -> dict[str, list[LogPart]]:
        """Return what each split consists of, in the order of its patterns; nothing of `auto`.

        The matches of a pattern are sorted.

        Raises:
            ConfigError: where a split is empty, a pattern matches nothing, or a stretch stands in
                two splits.
        """
        if self.auto:
            return {}
        root, where = self._root(), "split" if self.file is None else str(self.file)
        named = self if self.file is None else validate(load_mapping(self.file), SplitFile, where)
        parts = {name: parts_of(root, getattr(named, name), f"{where}: {name}") for name in SPLITS}
        seen = [
            (part.path.resolve(), split, part) for split, some in parts.items() for part in some
        ]
        for number, (real, split, part) in enumerate(seen):
            for other, owner, taken in seen[:number]:
                if other == real and owner != split and part.overlaps(taken):
                    what = "" if part.whole else "the same stretch of "
                    raise ConfigError(
                        f"{where}: {what}{part.path} stands in {owner} and in {split}; a"
                        f" {'file' if part.whole else 'stretch'} belongs to one split"
                    )
        return parts

    def files(self) -> list[Path]:
        """Return all logs, each once.

        Raises:
            ConfigError: as `parts`.
        """
        if self.auto:
            return matches(self._root(), self.auto, "split: auto")
        return list(dict.fromkeys(part.path for parts in self.parts().values() for part in parts))

    def resolve(self) -> dict[str, list[Path]]:
        """Return the logs of each split; nothing where `auto` divides them.

        Raises:
            ConfigError: as `parts`.
        """
        return {
            split: list(dict.fromkeys(part.path for part in parts))
            for split, parts in self.parts().items()
        }

    def _root(self) -> Path:
        root = self.root or (self.file.parent if self.file is not None else Path.cwd())
        if not root.is_dir():
            raise ConfigError(f"split: root {root} is not a folder; correct `root`")
        return root


def divided(logs: Sequence[Log]) -> dict[str, list[Log]]:
    """Return the logs by split (train, validation, test); copies are left out.

    Of each five logs, in the order of their manoeuvres, the third is for validation and the fifth
    for the test; of eight or more three at least, fewer cannot tell how good a model is. Where
    there are fewer than five, each is cut in time: its first three tenths and those from the middle
    on are for training, the rest for validation and test. Where folders or files are called train
    and test (and validation), that is the split.

    Raises:
        DataError: where a log is too short to be cut.
    """
    kept = without_copies(logs)
    out: dict[str, list[Log]] = {split: [] for split in SPLITS}
    owners, count = called_splits(kept), len(kept)
    if not owners and count >= _ENOUGH:
        each = count / _JUDGED if _SPARED <= count < _JUDGED * _ENOUGH else _ENOUGH
        test = {int((k + 0.8) * each) for k in range(count)}
        kept = sorted(kept, key=lambda log: log.manoeuvre)
        owners = ["test" if place in test else "train" for place in range(count)]
    if owners:
        for log, owner in zip(kept, owners, strict=True):
            out[owner].append(log)
        if not out["validation"]:
            known = out["train"]
            places = range(2, len(known), 4) or range(len(known) - 1, 0, -len(known))
            out["validation"] = [known[place] for place in places]
            out["train"] = [log for place, log in enumerate(known) if place not in places]
        return out
    for log in kept:
        gone, length = without_pauses(log.t), float(log.t[-1] - log.t[0])
        # whole numbers read better, where the log is long enough for them
        digits = max(0, 2 - int(np.log10(max(length, 1e-9))))
        for split, *shares in _SHARES:
            low, high = (
                round(float(np.interp(share * gone[-1], gone, log.t)), digits) for share in shares
            )
            start, stop = low if shares[0] else -np.inf, high if shares[1] < 1.0 else np.inf
            out[split].append(stretch_of(log, start, stop))
    return out


def called_splits(logs: Sequence[Log]) -> list[str]:
    """Return for each log the split that its folder or file is called after; empty for no split.

    All must be called so, two of them for training and one for the test at least.
    """
    owners = []
    for log in logs:
        path = Path(str(log.meta.get("source", "")).lower())
        words = [re.split(r"[\W_\d]+", path.stem)[0], *reversed(path.parent.parts)]
        owners.append(next((_CALLED[word] for word in words if word in _CALLED), ""))
    many = owners.count("train") + owners.count("validation") > 1
    return owners if many and "" not in owners and {"train", "test"} <= {*owners} else []


def without_copies(logs: Sequence[Log]) -> list[Log]:
    """Return the logs without those whose rows another one holds; the longest stay."""
    common = sorted(set.intersection(*(set(log.channels) for log in logs))) if logs else []
    if len(logs) < 2 or not common:
        return [*logs]
    shared = _shared_rows([np.unique(measured_hashes(log, common)) for log in logs])
    kept = np.zeros(len(logs), dtype=bool)
    for i in sorted(range(len(logs)), key=lambda i: -len(logs[i])):
        own = slice(shared.indptr[i], shared.indptr[i + 1])
        kept[i] = not (kept[shared.indices[own]] & (shared.data[own] > _COPIED)).any()
    return [log for log, stays in zip(logs, kept, strict=True) if stays]


def _shared_rows(hashes: Sequence[np.ndarray]) -> csr_array:
    """Return how many distinct rows logs have in common [L, L], by those that two of them hold."""
    from scipy.sparse import coo_array, csr_array

    owner = np.repeat(np.arange(len(hashes)), [part.size for part in hashes])
    _, row, count = np.unique(np.concatenate(hashes), return_inverse=True, return_counts=True)
    twice = count[row] > 1
    place = owner[twice], row[twice]
    holds = coo_array((np.ones(twice.sum()), place), (len(hashes), count.size)).tocsr()
    shared = csr_array(holds @ holds.T)
    shared.sort_indices()
    return shared


def check_leaks(logs: Mapping[str, Sequence[Log]], rows: int = _COPIED) -> None:
    """Stop where two logs of different splits hold the same measurements.

    Compared are rows of all channels that the logs have in common, without time and with angles
    modulo a full circle, so that a copied stretch is found wherever its clock and heading start.
    Equal rows within one log (a vessel at rest) count once.

    Args:
        logs: split -> its logs.
        rows: most distinct rows that two logs may share.

    Raises:
        DataError: naming the two logs that share most rows.
    """
    flat = [(split, log) for split, members in logs.items() for log in members]
    common = sorted(set.intersection(*(set(log.channels) for _, log in flat))) if flat else []
    one_of = sampling([log for _, log in flat])
    hashes = [measured_hashes(log, common) for _, log in flat if common]
    hashes = [np.unique(part[part % np.uint64(one_of) == 0]) for part in hashes]
    if len({split for split, _ in flat}) < 2 or not any(h.size for h in hashes):
        return
    shared = _shared_rows(hashes).tocoo()
    split_of = np.unique([split for split, _ in flat], return_inverse=True)[1]
    across = np.where(split_of[shared.row] != split_of[shared.col], shared.data, 0.0)
    if not across.any():
        return
    most = int(np.argmax(across))
    (split_a, a), (split_b, b) = flat[shared.row[most]], flat[shared.col[most]]
    same = np.intersect1d(measured_hashes(a, common), measured_hashes(b, common)).size
    if same > rows:
        raise DataError(
            f"logs {a.name} ({split_a}) and {b.name} ({split_b}) share {same} identical rows, at"
            f" most {rows} are allowed; one is a copy of part of the other: leave one out, or put"
            " both into one split"
        )


def sampling(logs: Sequence[Log]) -> int:
    """Return of how many rows one is compared between logs: more than one of very many."""
    return -(-sum(len(log) for log in logs) // LARGE)


_MOTION = (*STATE, "phi", "p")


def measured_hashes(log: Log, channels: Sequence[str]) -> np.ndarray:
    """Return the hashes of the rows that hold half of the motion at least, uint64 [K].

    Where channels come at several rates, a row between two fixes holds commands alone, and tells
    nothing of the run that it is from.
    """
    motion = [name for name in channels if name in _MOTION] or channels
    measured = np.isfinite(log.stack(tuple(motion))).sum(axis=1)
    return np.asarray(row_hashes(log, channels)[2 * measured >= measured.max(initial=0)])


def row_hashes(log: Log, channels: Sequence[str]) -> np.ndarray:
    """Return the hash of each row of some channels, uint64 [T]."""
    import pandas as pd

    columns = {}
    for name in channels:
        values = log[name]
        # unwrapping a copied stretch from another start leaves rounding in the heading
        columns[name] = (
            np.round(np.remainder(values, 2.0 * np.pi), 9)
            if log.units[name] == "rad"
            else values + 0.0
        )
    hashes = pd.util.hash_pandas_object(pd.DataFrame(columns), index=False).to_numpy()
    forget()
    return np.asarray(hashes)


def logs_below(folder: Path) -> list[Path]:
    """Return the recordings and files of logs in a folder, in order; a recording is one log."""
    # endings of one's own are looked into where there are no others
    return _below(folder, lambda path: path.suffix.lower() in LOG_ENDINGS) or _below(
        folder, lambda path: format_of(path) is not None or is_text_table(path)
    )


def _below(folder: Path, is_log: Callable[[Path], bool]) -> list[Path]:
    if format_of(folder) is not None and not _holds_recordings(folder):
        return [folder]
    found: list[Path] = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir():
            found += _below(path, is_log)
        elif is_log(path):
            found.append(path)
    return found


def _holds_recordings(folder: Path) -> bool:
    """Return whether the folders in a folder hold files of the same names, as recordings do."""
    below = [path for path in folder.iterdir() if path.is_dir()]
    names = [frozenset(f.relative_to(path) for f in files_of(path)) for path in below]
    return any(names.count(held) > 1 and len(held) > 1 for held in names)


def log_names(paths: Iterable[Path]) -> dict[Path, str]:
    """Return the name of each log: that of its file without the ending, or of its folder.

    Where several files or folders have one name, as with a folder for each trial, the folders above
    come before it as far as they are needed to tell the logs apart; of files in one folder the
    ending comes behind it.

    Args:
        paths: files and recordings; one that is given twice is one log.
    """
    given = list(dict.fromkeys(paths))
    real = {path: path.resolve() for path in given}
    above = dict.fromkeys(given, 0)
    beside = Counter((own.parent, path.stem) for own, path in {real[p]: p for p in given}.items())
    while True:
        names = {path: _name(path, real[path], above[path], beside) for path in given}
        owners: dict[str, set[Path]] = {}
        for path, name in names.items():
            owners.setdefault(name, set()).add(real[path])
        again = [
            path
            for path, name in names.items()
            if len(owners[name]) > 1 and above[path] < len(real[path].parents) - 1
        ]
        if not again:
            return names
        for path in again:
            above[path] += 1


def _name(path: Path, real: Path, above: int, beside: Mapping[tuple[Path, str], int]) -> str:
    alone = path.is_dir() or beside[real.parent, path.stem] == 1
    own = (path.name if path.is_dir() else path.stem) if alone else path.name.replace(".", "_")
    return "_".join([*(parent.name for parent in reversed(real.parents[:above])), own])


def matches(root: Path, patterns: Sequence[str], where: str) -> list[Path]:
    """Return logs of all patterns, each once: files, recordings, and what lies below folders."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        # a plain path may hold characters that a pattern would read otherwise
        path = root / pattern
        named = [path] if path.exists() else _globbed(root, pattern, where)
        logs = [log for one in named for log in (logs_below(one) if one.is_dir() else [one])]
        if not logs:
            parent = path.parent
            near = (
                nearest(Path(pattern).name, (path.name for path in parent.iterdir()))
                if parent.is_dir()
                else f"; there is no folder {parent}"
            )
            raise ConfigError(f"{where}: '{pattern}' matches no file in {root}{near}")
        found.update(dict.fromkeys(logs))
    return list(found)


def _globbed(root: Path, pattern: str, where: str) -> list[Path]:
    """Return files and recordings below `root` that a pattern matches, in order."""
    why = "it is an absolute path" if Path(pattern).is_absolute() else ""
    try:
        if not why:
            found = sorted(root.glob(pattern))
            files = [path for path in found if path.is_file()]
            return files or [path for path in found if path.is_dir() and format_of(path)]
    except ValueError as error:
        why = str(error)
    raise ConfigError(
        f"{where}: '{pattern}' is not a pattern relative to {root} ({why}); set `root` instead"
    )
