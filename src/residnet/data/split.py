"""The split of log files into training, validation and test, and the check that none share data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from residnet.core.arrays.paged import LARGE, forget
from residnet.core.config import Config, ConfigPath, load_mapping, validate
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import nearest
from residnet.data.parts import LogPart, Part, matches, parts_of

SPLITS = ("train", "validation", "test")


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

    def parts(self) -> dict[str, list[Part]]:
        """Return what each split consists of, in the order of its patterns; nothing of `auto`.

        The matches of a pattern are sorted.

        Raises:
            ConfigError: where a split is empty, a pattern matches nothing, or a stretch stands in
                two splits.
        """
        if self.auto:
            return {}
        entries = (
            {name: getattr(self, name) for name in SPLITS}
            if self.file is None
            else _from_file(self.file)
        )
        root, where = self._root(), "split" if self.file is None else str(self.file)
        parts = {
            name: parts_of(root, wanted, f"{where}: {name}") for name, wanted in entries.items()
        }
        _require_distinct(parts, where)
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


def _from_file(file: Path) -> dict[str, tuple[str | LogPart, ...]]:
    content: dict[str, Any] = load_mapping(file)
    for key in content:
        if key not in SPLITS:
            raise ConfigError(f"{file}: unknown split '{key}'{nearest(key, SPLITS)}")
    for name in SPLITS:
        entries = content.get(name)
        if (
            not isinstance(entries, list)
            or not entries
            or not all(isinstance(entry, str | dict) for entry in entries)
        ):
            raise ConfigError(
                f"{file}: {name}: expected a list of at least one path or pattern, found"
                f" {entries!r}"
            )
    return {
        name: tuple(
            entry if isinstance(entry, str) else validate(entry, LogPart, f"{file}: {name}")
            for entry in content[name]
        )
        for name in SPLITS
    }


def _require_distinct(parts: Mapping[str, Sequence[Part]], where: str) -> None:
    """Stop where two splits name the same stretch."""
    seen: list[tuple[Path, str, Part]] = []
    for split, members in parts.items():
        for part in members:
            real = part.path.resolve()
            for other, owner, taken in seen:
                if other == real and owner != split and part.overlaps(taken):
                    what = "" if part.whole else "the same stretch of "
                    raise ConfigError(
                        f"{where}: {what}{part.path} stands in {owner} and in {split}; a"
                        f" {'file' if part.whole else 'stretch'} belongs to one split"
                    )
            seen.append((real, split, part))


def check_leaks(logs: Mapping[str, Sequence[Log]], rows: int = 100) -> None:
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
    from scipy.sparse import coo_array

    flat = [(split, log) for split, members in logs.items() for log in members]
    if len({split for split, _ in flat}) < 2:
        return
    common = sorted(set.intersection(*(set(log.channels) for _, log in flat)))
    if not common:
        return
    one_of = sampling([log for _, log in flat])
    hashes = [np.unique(sampled_hashes(log, common, one_of)) for _, log in flat]
    owner = np.repeat(np.arange(len(flat)), [h.size for h in hashes])
    _, row = np.unique(np.concatenate(hashes), return_inverse=True)
    holds = coo_array((np.ones(row.size), (row, owner))).tocsr()
    split_of = np.unique([split for split, _ in flat], return_inverse=True)[1]
    shared = np.where(split_of[:, None] != split_of[None, :], (holds.T @ holds).toarray(), 0.0)
    first, second = np.unravel_index(int(np.argmax(shared)), shared.shape)
    (split_a, a), (split_b, b) = flat[first], flat[second]
    if shared[first, second] == 0.0:
        return
    same = np.intersect1d(row_hashes(a, common), row_hashes(b, common)).size
    if same > rows:
        raise DataError(
            f"logs {a.name} ({split_a}) and {b.name} ({split_b}) share {same} identical rows, at"
            f" most {rows} are allowed; one is a copy of part of the other: leave one out, or put"
            " both into one split"
        )


def sampling(logs: Sequence[Log]) -> int:
    """Return of how many rows one is compared between logs: more than one of very many."""
    return -(-sum(len(log) for log in logs) // LARGE)


def sampled_hashes(log: Log, channels: Sequence[str], one_of: int) -> np.ndarray:
    """Return the hashes of a log's rows that are compared: of equal rows all are, or none.

    Args:
        log: whose rows.
        channels: that count.
        one_of: of how many hashes one is kept, by its own number.
    """
    hashes = row_hashes(log, channels)
    forget()
    return np.asarray(hashes[hashes % np.uint64(one_of) == 0])


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
    return np.asarray(pd.util.hash_pandas_object(pd.DataFrame(columns), index=False).to_numpy())
