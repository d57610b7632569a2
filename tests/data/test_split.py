"""Splits: files by pattern, and no measurement in two of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.config import validate
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.data.doctor import inspect_together
from residnet.data.split import SplitConfig, check_leaks, log_names


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in (
        "turning/a.csv",
        "turning/b.csv",
        "zigzag/c.csv",
        "zigzag/d.csv",
        "zigzag/deep/e.csv",
        "odd [1].csv",
    ):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("t\n")
    return tmp_path


def resolve(**config: Any) -> dict[str, list[Path]]:
    return validate(
        {key: str(value) if isinstance(value, Path) else value for key, value in config.items()},
        SplitConfig,
        "test",
    ).resolve()


def test_patterns(root: Path) -> None:
    files = resolve(
        root=root,
        train=["zigzag/**/*.csv", "zigzag/c.csv"],
        validation=["turning/b.*"],
        test=["turning/a.csv", "odd [1].csv"],
    )
    assert {
        split: [str(path.relative_to(root)) for path in paths] for split, paths in files.items()
    } == {
        "train": ["zigzag/c.csv", "zigzag/d.csv", "zigzag/deep/e.csv"],
        "validation": ["turning/b.csv"],
        "test": ["turning/a.csv", "odd [1].csv"],
    }


def test_a_file_of_splits_is_relative_to_its_own_folder_unless_a_root_is_given(
    root: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text = "train: [zigzag/c.csv]\nvalidation: [zigzag/d.csv]\ntest: [turning/*.csv]\n"
    (root / "split.yaml").write_text(text)
    elsewhere = tmp_path_factory.mktemp("configs") / "split.yaml"
    elsewhere.write_text(text)
    inside = resolve(file=root / "split.yaml")
    assert inside == resolve(file=elsewhere, root=root)
    assert inside["test"] == [root / "turning/a.csv", root / "turning/b.csv"]


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"train": ["zigzag/c.csv"], "validation": ["zigzag/d.csv"]}, "no files for test"),
        (
            {"train": ["zigzag/c.csv"], "validation": ["zigzag/*.csv"], "test": ["turning/*.csv"]},
            "stands in train and in validation",
        ),
        (
            {"train": ["zigzag/c.csv"], "validation": ["zigzag/x.csv"], "test": ["turning/*.csv"]},
            "'zigzag/x.csv' matches no file",
        ),
        (
            {"train": ["zig/c.csv"], "validation": ["zigzag/d.csv"], "test": ["turning/*.csv"]},
            "there is no folder",
        ),
        (
            {"train": ["turning/c.csv"], "validation": ["zigzag/d.csv"], "test": ["turning/*.csv"]},
            "'turning/c.csv' matches no file",
        ),
        (
            {"train": ["/zigzag/*.csv"], "validation": ["zigzag/d.csv"], "test": ["turning/*.csv"]},
            "not a pattern relative to",
        ),
        ({"trian": ["zigzag/c.csv"]}, "did you mean 'train'?"),
    ],
)
def test_faulty_patterns(root: Path, config: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        resolve(root=root, **config)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "train: [zigzag/c.csv]\nvalidation: [zigzag/d.csv]\n",
            "test: expected a list of at least one",
        ),
        (
            "train: [zigzag/c.csv]\nvalidation: []\ntest: [turning/a.csv]\n",
            "validation: expected a list",
        ),
        (
            "train: zigzag/c.csv\nvalidation: [zigzag/d.csv]\ntest: [turning/a.csv]\n",
            "train: expected a list",
        ),
        (
            "train: [zigzag/c.csv]\nvalid: [zigzag/d.csv]\ntest: [turning/a.csv]\n",
            "unknown split 'valid'",
        ),
        (
            "train: [zigzag/c.csv]\nvalidation: [zigzag/d.csv]\ntest: [zigzag/c.csv]\n",
            "stands in train and in test",
        ),
    ],
)
def test_faulty_files_of_splits(root: Path, text: str, words: str) -> None:
    (root / "split.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"split\.yaml") as caught:
        resolve(file=root / "split.yaml")
    assert words in str(caught.value)


def test_other_faults(root: Path) -> None:
    with pytest.raises(ConfigError, match="either `file` or patterns"):
        resolve(file=root / "split.yaml", train=["a"])
    with pytest.raises(ConfigError, match="no such file"):
        resolve(file=root / "none.yaml")
    with pytest.raises(ConfigError, match="is not a folder"):
        resolve(root=root / "none", train=["a"], validation=["b"], test=["c"])


def test_logs_of_one_name_are_told_apart_by_their_folders(root: Path) -> None:
    for name in ("zigzag/a.csv", "day_1/run_1/log.csv", "day_2/run_1/log.csv", "day_2/log.csv"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("t\n")
    (root / "day_2/log.txt").write_text("t\n")
    paths = [path for path in sorted(root.rglob("*.*")) if path.suffix != ".yaml"]
    names = log_names([*paths, paths[0]])
    assert len(set(names.values())) == len(names) == len(paths)
    told = {path.relative_to(root).as_posix(): name for path, name in names.items()}
    assert told["zigzag/a.csv"] == "zigzag_a"
    assert told["turning/a.csv"] == "turning_a"
    assert told["day_1/run_1/log.csv"] == "day_1_run_1_log"
    assert told["day_2/run_1/log.csv"] == "day_2_run_1_log"
    assert (told["day_2/log.csv"], told["day_2/log.txt"]) == ("log_csv", "log_txt")
    # a name that only one log has stays as it is
    assert told["zigzag/d.csv"] == "d"
    found = resolve(
        root=root, train=["zigzag/a.csv"], validation=["zigzag/d.csv"], test=["turning/a.csv"]
    )
    assert [len(paths) for paths in found.values()] == [1, 1, 1]


def copied(log: Log, start: int, stop: int, turns: int = 0) -> Log:
    channels = {name: values[start:stop].copy() for name, values in log.channels.items()}
    channels["psi"] = channels["psi"] + 2.0 * np.pi * turns
    return Log("copy", log.t[start:stop] - log.t[start], channels)


def other(seed: int = 0, size: int = 2000) -> Log:
    rng = np.random.default_rng(seed)
    return Log(
        f"other{seed}",
        0.1 * np.arange(size),
        {name: rng.normal(size=size) for name in ("x", "y", "psi", "u", "v", "r", "delta", "n")},
    )


def test_a_copied_stretch_is_found_wherever_its_clock_and_heading_start() -> None:
    log = wavy()
    logs = {
        "train": [other(0), log, other(1)],
        "validation": [other(2)],
        "test": [copied(log, 700, 1200, turns=-2)],
    }
    with pytest.raises(
        DataError,
        match=(
            r"logs wavy \(train\) and copy \(test\) share 500 identical rows, at most 100 are"
            r" allowed"
        ),
    ):
        check_leaks(logs)
    check_leaks(logs, rows=500)
    check_leaks({"train": [log, copied(log, 700, 1200)], "test": [other(0)]})


def test_a_vessel_at_rest_shares_no_more_than_one_row() -> None:
    rest = {name: np.zeros(3000) for name in ("x", "y", "psi", "u")}
    check_leaks(
        {
            "train": [Log("a", np.arange(3000.0), rest)],
            "test": [Log("b", np.arange(3000.0), {**rest, "u": -rest["u"]})],
        }
    )


def test_missing_values_compare_equal_and_one_split_cannot_leak() -> None:
    log = wavy()
    log["u"][100:900] = np.nan
    with pytest.raises(DataError, match="share 800 identical rows"):
        check_leaks({"train": [log], "test": [copied(log, 100, 900)]})
    check_leaks({"train": [log, log]})
    check_leaks({})


def test_copies_are_found_by_a_sample_of_very_many_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    log = wavy()
    logs = {"train": [log], "test": [copied(log, 700, 1200)]}
    with pytest.raises(DataError) as exact:
        check_leaks(logs)
    monkeypatch.setattr("residnet.data.split.LARGE", 600)
    with pytest.raises(DataError) as sampled:
        check_leaks(logs)
    assert str(sampled.value) == str(exact.value)
    assert inspect_together([log, copied(log, 700, 1200)]).find("copied_part")
