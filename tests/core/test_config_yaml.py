"""YAML files of configs: scalars, merge keys, and what cannot be read."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from made_configs import Fit

from residnet.core.config import (
    load_config,
    load_mapping,
)
from residnet.core.config_yaml import parse
from residnet.core.errors import ConfigError


def test_scalars_follow_yaml_1_2(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(
        "a: 1e-3\nb: 1E6\nc: 010\nd: 0x10\ne: off\nf: yes\ng: 12:30\nh: 2024-01-01\ni: ~\nj:\nk:"
        " true\nl: .5\nm: '1e-3'\non: 0o17\n7: x\n"
    )
    mapping = load_mapping(path)
    assert mapping == {
        **{
            "a": 1e-3,
            "b": 1e6,
            "c": 10,
            "d": 16,
            "e": "off",
            "f": "yes",
            "g": "12:30",
            "h": "2024-01-01",
            "i": None,
            "j": None,
        },
        **{"k": True, "l": 0.5, "m": "1e-3", "on": 15, "7": "x"},
    }
    assert type(mapping["b"]) is float
    assert type(mapping["c"]) is int


def test_merge_keys_are_not_duplicates_and_are_not_shared(load: Callable[..., Fit]) -> None:
    text = "heads:\n  a: &a {kind: lstm, hidden_size: 3}\n  b: *a\n  c: {<<: *a, hidden_size: 5}\n"
    heads = load(text, "heads.a.hidden_size=4").heads
    assert {name: head.model_dump()["hidden_size"] for name, head in heads.items()} == {
        "a": 4,
        "b": 3,
        "c": 5,
    }


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", ": empty; expected a mapping"),
        (b"# nothing\n", ": empty; expected a mapping"),
        (b"- 1\n- 2\n", ": expected a mapping of keys to values, found a list"),
        (b"hello\n", ": expected a mapping of keys to values, found the value 'hello'"),
        (b"a: 1\nb: [1, 2\n", ":3:1: not YAML: "),
        (b"a: 1\n\tb: 2\n", ":2:1: not YAML: "),
        (b"a: b: c\n", ":1:5: not YAML: mapping values are not allowed here"),
        (b"a: 1\n---\nb: 2\n", ":2:1: not YAML: "),
        (b"a: !!python/object:os.system {}\n", ":1:4: not YAML: could not determine a constructor"),
        (b"a: !!timestamp 2024-01-01\n", ":1:4: not YAML: could not determine a constructor"),
        (b"? [a]\n: 1\n", ":1:3: not YAML: a key must be plain text"),
        (b"a: *nowhere\n", ":1:4: not YAML: found undefined alias"),
        (b"a: &a [*a]\n", ": stands for more than 200000 values, or refers to itself"),
        (b"[" * 5000, ":1:62: not YAML: nested more than 60 levels deep"),
        (b"a: \x01\n", ": not YAML: "),
        (b"a: \xff\n", ": not UTF-8 text (byte 3)"),
        (b"a: 1\nb:\n  c: 1\n  d: 2\n  c: 3\n", ":5: duplicate key 'c', first on line 3"),
        (b"a: 1\na: 1\n", ":2: duplicate key 'a', first on line 1"),
        (b"l:\n- {k: 1, k: 2}\n", ":2: duplicate key 'k', first on line 2"),
    ],
)
def test_unreadable_files(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(content)
    for read in (lambda: load_mapping(path), lambda: load_config(path, [], Fit)):
        with pytest.raises(ConfigError) as caught:
            read()
        assert str(caught.value).startswith(f"{path}{expected}")
        assert "\n" not in str(caught.value)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nope\.yaml: no such file$"):
        load_config(tmp_path / "nope.yaml", [], Fit)
    with pytest.raises(ConfigError, match="is a folder; give a YAML file"):
        load_mapping(tmp_path)


def test_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\n")
    assert load_mapping(path) == {"a": 1}


_BOMB = "\n".join(
    ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12))]
)
_MERGES = "\n".join(
    [
        "a0: &a0 {x: 1}",
        *(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}" for i in range(1, 12)),
    ]
)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (_BOMB, "stands for more than 200000 values"),
        (_MERGES, "stands for more than 200000 values"),
        ("a: &a [*a]", "refers to itself"),
        ("a: " + "[" * 100_000, "nested more than 60 levels"),
        ("a: " + "{b: " * 100_000, "nested more than 60 levels"),
        ("a:\n" + "- " * 10_000, "nested more than 60 levels"),
        ("a: " + "9" * 5000, "whole number of 5000 digits"),
        ("a: 0x" + "f" * 9000, "whole number of 9002 digits"),
    ],
    ids=["aliases", "merges", "itself", "brackets", "braces", "dashes", "digits", "hex"],
)
def test_what_would_take_minutes_is_one_line_at_once(text: str, told: str) -> None:
    started = time.process_time()
    with pytest.raises(ConfigError, match=told) as caught:
        parse(text, "x.yaml")
    assert str(caught.value).startswith("x.yaml")
    assert len(str(caught.value)) < 200
    assert time.process_time() - started < 2.0
