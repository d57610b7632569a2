"""Splits by file, folder, stretch and manoeuvre, the division where nobody says, and leaks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_logs import wavy

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError
from residnet.core.log import Log
from residnet.io.sources import MeasuredLogs, read_split_logs
from residnet.io.split import (
    SplitConfig,
    assign_log_names,
    check_leaks,
    remove_copies,
    split_logs,
)
from residnet.quality import inspect_log_set

FILES = ("turning/a", "turning/b", "zigzag/c", "zigzag/d", "zigzag/deep/e", "odd [1]")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name in FILES:
        path = tmp_path / f"{name}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("t\n")
    return tmp_path


def resolve(root: Path, **config: Any) -> dict[str, list[str]]:
    found = validate_config({"root": str(root), **config}, SplitConfig, "test").resolve_paths()
    return {
        split: [path.relative_to(root).as_posix() for path in paths]
        for split, paths in found.items()
    }


def split_of(train: Any, validation: Any = "zigzag/d.csv", test: Any = "turning/*.csv") -> Any:
    return {"train": [train], "validation": [validation], "test": [test]}


def written(train: str, rest: str = "") -> dict[str, str]:
    """A split that stands in a file."""
    return {"file": f"train: [{train}]\nvalidation: [zigzag/d.csv]\n{rest}\n"}


def test_patterns_and_files_of_them(root: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    found = resolve(
        root,
        train=["zigzag/**/*.csv", "zigzag/c.csv"],
        validation=["turning/b.*"],
        test=["turning/a.csv", "odd [1].csv"],
    )
    assert found == {
        "train": ["zigzag/c.csv", "zigzag/d.csv", "zigzag/deep/e.csv"],
        "validation": ["turning/b.csv"],
        "test": ["turning/a.csv", "odd [1].csv"],
    }
    text = "train: [zigzag/c.csv]\nvalidation: [zigzag/d.csv]\ntest: [turning/*.csv]\n"
    elsewhere = tmp_path_factory.mktemp("configs") / "split.yaml"
    for file, given in ((root / "split.yaml", {}), (elsewhere, {"root": str(root)})):
        file.write_text(text)
        parts = validate_config({"file": str(file), **given}, SplitConfig, "test").resolve_paths()
        assert parts["test"] == [root / "turning/a.csv", root / "turning/b.csv"]


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"train": ["zigzag/c.csv"], "validation": ["zigzag/d.csv"]}, "no files for test"),
        (split_of("zigzag/c.csv", "zigzag/*.csv"), "belongs to train and to validation"),
        (split_of("zigzag/c.csv", "zigzag/x.csv"), "'zigzag/x.csv' matches no file"),
        (split_of("zig/c.csv"), "there is no folder"),
        (split_of("turning/c.csv"), "'turning/c.csv' matches no file"),
        (split_of("/zigzag/*.csv"), "not a pattern relative to"),
        ({"trian": ["zigzag/c.csv"]}, "did you mean 'train'?"),
        ({"file": "split.yaml", "train": ["a"]}, "either `file` or patterns"),
        ({"auto": ["."], "train": ["a.parquet"]}, "either `auto`, `file` or patterns"),
        ({"auto": ["nowhere"]}, "'nowhere' matches no file"),
        ({"file": "none.yaml"}, "no such file"),
        (written("zigzag/c.csv"), "test: missing"),
        (written("", "test: [turning/a.csv]"), "train: .* at least 1 item"),
        (written("3", "test: [turning/a.csv]"), "train.0: expected text or a mapping"),
        (
            written("zigzag/c.csv", "tset: [turning/a.csv]"),
            "tset: unknown key; did you mean 'test'",
        ),
        (written("zigzag/c.csv", "test: [zigzag/c.csv]"), "belongs to train and to test"),
        ({**split_of("a"), "root": "none"}, "is not a folder"),
        (split_of({"log": "a", "from": "9 s", "to": "3 s"}), "from 9 s to 3 s is empty"),
        (
            split_of(
                {"log": "zigzag/c.csv", "to": "40 s"},
                {"log": "zigzag/c.csv", "from": "30 s", "to": "50 s"},
            ),
            "an interval of .*c.csv belongs to train and to validation",
        ),
    ],
)
def test_faulty_splits(root: Path, config: dict[str, Any], words: str) -> None:
    if "\n" in config.get("file", ""):
        (root / "split.yaml").write_text(config["file"])
        config = {"file": str(root / "split.yaml")}
    with pytest.raises(ConfigError, match=words) as caught:
        validate_config({"root": str(root), **config}, SplitConfig, "test").list_files()
    assert "\n" not in str(caught.value)


def test_logs_of_one_name_are_told_apart_by_their_folders(root: Path) -> None:
    more = ("zigzag/a.csv", "day_1/run_1/log.csv", "day_2/run_1/log.csv", "day_2/log.csv")
    for name in (*more, "day_2/log.txt"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text("t\n")
    paths = sorted(root.rglob("*.*"))
    names = assign_log_names([*paths, paths[0]])
    assert len(set(names.values())) == len(names) == len(paths)
    told = {path.relative_to(root).as_posix(): name for path, name in names.items()}
    expected = {
        **{"zigzag/a.csv": "zigzag_a", "turning/a.csv": "turning_a", "zigzag/d.csv": "d"},
        **{"day_1/run_1/log.csv": "day_1_run_1_log", "day_2/run_1/log.csv": "day_2_run_1_log"},
        **{"day_2/log.csv": "log_csv", "day_2/log.txt": "log_txt"},
    }
    assert {path: told[path] for path in expected} == expected


def saved(folder: Path, *names: str) -> None:
    """Canonical logs of 60 s that share no row; the first word of a name is the manoeuvre."""
    for number, name in enumerate(names):
        log = wavy(seconds=60.0, name=Path(name).name)
        x = log["x"] + 1000.0 * (number + 1)
        log = log.replace(channels={**log.channels, "x": x}, manoeuvre=log.name.split("_")[0])
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        log.save(folder / f"{name}.parquet")


def splits(root: Path, **split: Any) -> dict[str, list[tuple[str, float, float]]]:
    """Name, first and last time of every log by split."""
    settings = {"reader": {"kind": "canonical"}, "split": {"root": str(root), **split}}
    read = read_split_logs(validate_config(settings, MeasuredLogs, "here"))
    return {
        name: [(log.name, float(log.t[0]), round(float(log.t[-1]), 6)) for log in logs]
        for name, logs in read.items()
    }


def test_stretches_folders_and_manoeuvres(tmp_path: Path) -> None:
    saved(tmp_path, "trip", "a/zigzag_1", "a/turn_1", "b/zigzag_2", "b/turn_2", "c/deep/zigzag_3")
    trip = {"log": "trip.parquet"}
    found = splits(
        tmp_path,
        train=[trip | {"to": "30 s"}, "a", {"log": "b", "manoeuvre": "turn"}],
        validation=[trip | {"from": "30 s", "to": "0.75 min"}, {"log": "b", "manoeuvre": "zigzag"}],
        test=[trip | {"from": 45}, "c"],
    )
    assert {split: logs[0] for split, logs in found.items()} == {
        "train": ("trip_0s_30s", 0.0, 29.9),
        "validation": ("trip_30s_45s", 30.0, 44.9),
        "test": ("trip_45s_59p9s", 45.0, 59.9),
    }
    assert {split: [name for name, _, _ in logs[1:]] for split, logs in found.items()} == {
        "train": ["turn_1", "zigzag_1", "turn_2"],
        "validation": ["zigzag_2"],
        "test": ["zigzag_3"],
    }
    whole = {"train": ["a/zigzag_1.parquet"], "validation": ["a/turn_1.parquet"]}
    with pytest.raises(DataError, match=r"0 samples from 200 s to 59\.9 s, .*runs from 0 s"):
        splits(tmp_path, **whole, test=[trip | {"from": "200 s"}])
    with pytest.raises(DataError, match=r"test has no log of the requested .*have trip"):
        splits(tmp_path, **whole, test=[trip | {"manoeuvre": "spiral"}])


def test_residnet_divides_many_logs_and_cuts_few(tmp_path: Path) -> None:
    saved(tmp_path, *(f"{kind}_{i}" for kind in ("zigzag", "turn") for i in range(5)))
    found = splits(tmp_path, auto=["."])
    assert {split: [name for name, _, _ in logs] for split, logs in found.items()} == {
        "train": ["turn_0", "turn_1", "turn_4", "zigzag_0", "zigzag_2"],
        "validation": ["turn_3", "zigzag_3"],
        "test": ["turn_2", "zigzag_1", "zigzag_4"],
    }
    log = wavy(seconds=100.0)
    cut = split_logs([log.select_rows(slice(500)).replace(name="copy"), log])
    assert {split: [one.name for one in logs] for split, logs in cut.items()} == {
        "train": ["wavy_0s_30s", "wavy_50s_79p9s"],
        "validation": ["wavy_30s_50s"],
        "test": ["wavy_79p9s_99p9s"],
    }
    together = np.concatenate([one.t for logs in cut.values() for one in logs])
    assert np.array_equal(np.sort(together), log.t)


def copied(log: Log, start: int, stop: int, turns: int = 0) -> Log:
    part = log.select_rows(slice(start, stop))
    channels = {**part.channels, "psi": part["psi"] + 2.0 * np.pi * turns}
    return part.replace(name="copy", t=part.t - part.t[0], channels=channels)


def other(seed: int = 0) -> Log:
    rng = np.random.default_rng(seed)
    names = ("x", "y", "psi", "u", "v", "r", "delta", "n")
    channels = {name: rng.normal(size=2000) for name in names}
    return Log(f"other{seed}", 0.1 * np.arange(2000), channels)


def test_copies_across_splits_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    log = wavy()
    copy = copied(log, 700, 1200, turns=-2)
    logs = {"train": [other(0), log, other(1)], "validation": [other(2)], "test": [copy]}
    words = r"logs wavy \(train\) and copy \(test\) share 500 identical rows, at most 100 are"
    for most in (10**9, 600):
        # of very many rows a sample is compared
        monkeypatch.setattr("residnet.io.split.MAX_SAMPLES_IN_MEMORY", most)
        with pytest.raises(DataError, match=words):
            check_leaks(logs)
        assert inspect_log_set([log, copied(log, 700, 1200)]).find_by_code("copied_part")
    check_leaks(logs, max_shared_rows=500)
    check_leaks({"train": [log, copy, log], "test": [other(0)]})
    check_leaks({"train": [log, log]})
    check_leaks({})
    # a vessel at rest shares no more than one row, and missing values compare equal
    rest = {name: np.zeros(3000) for name in ("x", "y", "psi")}
    still = [Log("rest", np.arange(3000.0), {**rest, "u": rest["x"] * sign}) for sign in (1, -1)]
    check_leaks({"train": still[:1], "test": still[1:]})
    log["u"][100:900] = np.nan
    with pytest.raises(DataError, match="share 800 identical rows"):
        check_leaks({"train": [log], "test": [copied(log, 100, 900)]})


def test_rows_between_two_fixes_are_no_copies() -> None:
    """Commands at 10 Hz, positions at 1 Hz: rows of equal commands alone stand in every log."""
    t = 0.1 * np.arange(2000)
    fixed = np.arange(t.size) % 10 == 0

    def sailed(seed: int) -> Log:
        place = np.random.default_rng(seed).normal(size=t.size).cumsum()
        return Log(
            f"run{seed}", t, {"x": np.where(fixed, place, np.nan), "n": np.round(5 + t // 20)}
        )

    check_leaks({"train": [sailed(1)], "test": [sailed(2)]}, max_shared_rows=2)
    copied = sailed(1).replace(name="again")
    with pytest.raises(DataError, match="share 200 identical rows"):
        check_leaks({"train": [sailed(1)], "test": [copied]}, max_shared_rows=2)
    assert [log.name for log in remove_copies([sailed(1), sailed(2), copied])] == ["run1", "run2"]


def test_folders_called_after_the_splits_are_the_splits(tmp_path: Path) -> None:
    logs = []
    for number, folder in enumerate(("train", "train", "train", "test", "valid")):
        t = np.arange(0.0, 20.0, 0.1)
        source = str(tmp_path / folder / f"{number}.csv")
        channels = {"u": np.random.default_rng(number).normal(size=t.size)}
        logs.append(Log(f"log{number}", t, channels, {"u": "m/s"}, meta={"source": source}))
    found = {split: [log.name for log in part] for split, part in split_logs(logs).items()}
    assert found == {"train": ["log0", "log1", "log2"], "validation": ["log4"], "test": ["log3"]}
    # without a folder for validation some of training are
    found = {split: [log.name for log in part] for split, part in split_logs(logs[:4]).items()}
    assert found == {"train": ["log0", "log1"], "validation": ["log2"], "test": ["log3"]}
    # `trials/test_3.csv` alone says nothing
    named = [log.replace(meta={"source": f"trials/test_{i}.csv"}) for i, log in enumerate(logs)]
    assert [len(part) for part in split_logs(named).values()] == [3, 1, 1]


@pytest.mark.parametrize(
    ("count", "parts"), [(7, [5, 1, 1]), (8, [4, 1, 3]), (10, [5, 2, 3]), (14, [8, 3, 3])]
)
def test_a_verdict_has_its_test_logs_where_eight_can_be_divided(
    count: int, parts: list[int]
) -> None:
    logs = [Log(f"{k}", np.arange(3.0), {"u": np.arange(3.0) + k}) for k in range(count)]
    assert [len(part) for part in split_logs(logs).values()] == parts
