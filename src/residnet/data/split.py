"""The split of log files into training, validation and test, and the check that none share data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import Config, ConfigPath, load_mapping
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.core.names import nearest

SPLITS = ("train", "validation", "test")


class SplitConfig(Config):
    """Files of the three splits: from a YAML file, or from patterns.

    Attributes:
        file: YAML file with the keys train, validation and test, each a list of paths or patterns
            relative to `root`.
        root: folder that paths and patterns start from; by default the folder of `file`, else the
            current folder.
        train: patterns such as `turning/*.csv` (`**` for any depth), where there is no `file`.
        validation: the same for the logs that models are chosen on.
        test: the same for the logs that nothing is chosen on.
    """

    file: ConfigPath | None = None
    root: ConfigPath | None = None
    train: tuple[str, ...] = Field(default=())
    validation: tuple[str, ...] = Field(default=())
    test: tuple[str, ...] = Field(default=())

    @model_validator(mode="after")
    def _one_source(self) -> SplitConfig:
        named = [name for name in SPLITS if getattr(self, name)]
        if self.file is not None and named:
            raise ValueError(
                f"give either `file` or patterns, not both (given: file and {', '.join(named)})"
            )
        if self.file is None and len(named) < len(SPLITS):
            empty = [name for name in SPLITS if name not in named]
            raise ValueError(
                f"no files for {', '.join(empty)}; give patterns for train, validation and test, or"
                " one `file` that names them"
            )
        return self

    def resolve(self) -> dict[str, list[Path]]:
        """Return the files of each split, in the order of its patterns.

        The matches of a pattern are sorted.

        Raises:
            ConfigError: where a split is empty, a pattern matches nothing, or a file or the name of
                a log occurs in two places.
        """
        patterns = (
            {name: getattr(self, name) for name in SPLITS}
            if self.file is None
            else _from_file(self.file)
        )
        root = self.root or (self.file.parent if self.file is not None else Path.cwd())
        if not root.is_dir():
            raise ConfigError(f"split: root {root} is not a folder; correct `root`")
        where = "split" if self.file is None else str(self.file)
        files = {
            name: matches(root, wanted, f"{where}: {name}") for name, wanted in patterns.items()
        }
        _require_distinct(files, where)
        return files


def _from_file(file: Path) -> dict[str, tuple[str, ...]]:
    content: dict[str, Any] = load_mapping(file)
    for key in content:
        if key not in SPLITS:
            raise ConfigError(f"{file}: unknown split '{key}'{nearest(key, SPLITS)}")
    for name in SPLITS:
        entries = content.get(name)
        if (
            not isinstance(entries, list)
            or not entries
            or not all(isinstance(entry, str) for entry in entries)
        ):
            raise ConfigError(
                f"{file}: {name}: expected a list of at least one path or pattern, found"
                f" {entries!r}"
            )
    return {name: tuple(content[name]) for name in SPLITS}


def matches(root: Path, patterns: Sequence[str], where: str) -> list[Path]:
    """Return files of all patterns, each once."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        # a plain path may hold characters that a pattern would read otherwise
        files = [root / pattern] if (root / pattern).is_file() else _globbed(root, pattern, where)
        if not files:
            parent = (root / pattern).parent
            near = (
                nearest(Path(pattern).name, (path.name for path in parent.iterdir()))
                if parent.is_dir()
                else f"; there is no folder {parent}"
            )
            raise ConfigError(f"{where}: '{pattern}' matches no file in {root}{near}")
        found.update(dict.fromkeys(files))
    return list(found)


def _globbed(root: Path, pattern: str, where: str) -> list[Path]:
    """Return files below `root` that a pattern matches, in order."""
    why = "it is an absolute path" if Path(pattern).is_absolute() else ""
    try:
        if not why:
            return sorted(path for path in root.glob(pattern) if path.is_file())
    except ValueError as error:
        why = str(error)
    raise ConfigError(
        f"{where}: '{pattern}' is not a pattern relative to {root} ({why}); set `root` instead"
    )


def _require_distinct(files: Mapping[str, Sequence[Path]], where: str) -> None:
    seen: dict[Path, str] = {}
    names: dict[str, Path] = {}
    for split, paths in files.items():
        for path in paths:
            real = path.resolve()
            if real in seen:
                raise ConfigError(
                    f"{where}: {path} stands in {seen[real]} and in {split}; a file belongs to one"
                    " split"
                )
            if path.stem in names:
                raise ConfigError(
                    f"{where}: {names[path.stem]} and {path} would both be the log '{path.stem}';"
                    " rename one of the files"
                )
            seen[real], names[path.stem] = split, path


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
    hashes = [np.unique(row_hashes(log, common)) for _, log in flat]
    owner = np.repeat(np.arange(len(flat)), [h.size for h in hashes])
    _, row = np.unique(np.concatenate(hashes), return_inverse=True)
    holds = coo_array((np.ones(row.size), (row, owner))).tocsr()
    split_of = np.unique([split for split, _ in flat], return_inverse=True)[1]
    shared = np.where(split_of[:, None] != split_of[None, :], (holds.T @ holds).toarray(), 0.0)
    first, second = np.unravel_index(int(np.argmax(shared)), shared.shape)
    if shared[first, second] > rows:
        (split_a, a), (split_b, b) = flat[first], flat[second]
        raise DataError(
            f"logs {a.name} ({split_a}) and {b.name} ({split_b}) share {int(shared[first, second])}"
            f" identical rows, at most {rows} are allowed; one is a copy of part of the other:"
            " leave one out, or put both into one split"
        )


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
