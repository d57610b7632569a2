"""What can happen to configs and run folders on the way: cut, edited, swapped, miswritten."""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from damaged_text import BYTES

Keys = tuple[str | int, ...]

JUNK: list[Any] = [
    *[None, True, False, "", " ", "x", "nan", "1e400", "None", [], {}, [None], [[1]], {"a": 1}],
    *[-1, 0, 1, 2, 3, 7, -0.5, 3.5, 1e-300, 1e200, -1e200, 10**22, -(10**22), 2**63, 10**40],
    *[float("inf"), float("-inf"), float("nan"), [1, 2, 3], ["a", "a"], ["u", "u"], [0.5, -0.5]],
    *["a" * 5000, "\x00", "a\x00b", "../../..", "/", "/dev/null", "~", "ä€", "\ud7ff", "a\nb"],
    *["5 furlongs", "20 degC", "1 m", "10 s", "3 deg", "NaN s", "1e400 m", "-5 s", "0 s", "1e9 s"],
    *[{"kind": "x"}, {"kind": None}, [{"kind": "zigzag"}], "**/*", "*", "[", "~u", "u|", "u u u u"],
]
SCALES = (-1, 0, 1e-9, 1e-3, 0.1, 0.5, 2, 10, 1e3, 1e9, 1e200)


def places(value: Any, at: Keys = ()) -> Iterator[Keys]:
    """Every place below the root."""
    named = isinstance(value, Mapping)
    pairs = value.items() if named else enumerate(value if isinstance(value, list) else ())
    for key, item in pairs:
        yield (*at, key)
        yield from places(item, (*at, key))


def at(root: Any, keys: Keys) -> Any:
    for key in keys:
        root = root[key]
    return root


def put(root: Any, keys: Keys, value: Any) -> None:
    at(root, keys[:-1])[keys[-1]] = value


def _scaled(value: Any, rng: random.Random) -> Any:
    scaled = value * rng.choice(SCALES)
    return int(scaled) if type(value) is int and abs(scaled) < 1e30 else scaled


# what a value must be -> what becomes of it, given another value of the kind
CHANGES: list[tuple[type | tuple[type, ...], Callable[[Any, Any, random.Random], Any]]] = [
    (object, lambda old, other, rng: rng.choice(JUNK)),
    ((int, float), lambda old, other, rng: _scaled(old, rng)),
    (object, lambda old, other, rng: other),
    (str, lambda old, other, rng: other),
    (list, lambda old, other, rng: rng.choice([old[1:], old[::-1], old * 2, old * 50, [old]])),
]


def edited(root: Any, rng: random.Random) -> str:
    """Change a tree of plain values in place; returns what was done."""
    every = list(places(root))
    if not every:
        return "nothing to edit"
    try:
        keys = rng.choice(every)
        how = rng.randrange(10)
        parent = at(root, keys[:-1])
        key = keys[-1]
        if how < 2:
            del parent[key]
        elif how == 2 and isinstance(key, str) and key:
            letter = rng.randrange(len(key))
            wrong = [key[:letter] + key[letter + 1 :], key + "s", key.upper(), ""]
            parent[rng.choice(wrong)] = parent.pop(key)
        else:
            kind, change = rng.choice(CHANGES)
            fit = [k for k in every if isinstance(at(root, k), kind)] or every
            keys = rng.choice(fit)
            other = rng.choice(fit)
            put(root, keys, copy.deepcopy(change(at(root, keys), at(root, other), rng)))
    except (IndexError, KeyError, TypeError, OverflowError):
        # a value has gone into itself or is no number any more
        put(root, rng.choice(list(places(root))), None)
    return ".".join(str(key)[:40] for key in keys)


def _peppered(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(data) + 1)
        data = data[:place] + rng.choice(BYTES) * rng.choice([1, 1, 40]) + data[place:]
    return data


def _flipped(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 5) if out else 0):
        out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


WHOLES = [b"", b"\n", b"{}", b"[]", b"null", b"1", b'"x"', b"PK\x03\x04", bytes(64)]
BYTE_DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    _peppered,
    _flipped,
    lambda data, rng: data[: rng.randrange(len(data) + 1)],
    lambda data, rng: data[: rng.randrange(len(data) + 1)] + bytes(rng.randint(1, 500)),
    lambda data, rng: rng.choice(WHOLES),
)
BOMB = "\n".join(
    ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
)
TEXT_DAMAGES: tuple[Callable[[str, random.Random], str], ...] = (
    lambda text, rng: f"{BOMB}\n{text}",
    lambda text, rng: f"{text}\nextra: {rng.choice(['[', '{a: ']) * rng.choice([500, 20000])}",
    lambda text, rng: f"{text}\n{rng.choice(text.splitlines())}",
    lambda text, rng: text.replace("\n", "\n" + rng.choice(["  ", "\t", " "]), rng.randint(1, 3)),
)  # fmt: skip


def mutated_config(config: Mapping[str, Any], rng: random.Random) -> tuple[bytes, str]:
    """A config as a file's bytes, with one to three changes, and what was changed."""
    root: dict[str, Any] = json.loads(json.dumps(config))
    if rng.random() < 0.8:
        told = [edited(root, rng) for _ in range(rng.choice([1, 1, 1, 2, 3]))]
        text = yaml.safe_dump(root, sort_keys=False, allow_unicode=True)
        return text.encode("utf-8", "surrogatepass"), ", ".join(told)
    text = yaml.safe_dump(root, sort_keys=False)
    if rng.random() < 0.4:
        return rng.choice(TEXT_DAMAGES)(text, rng).encode(), "text"
    return rng.choice(BYTE_DAMAGES)(text.encode(), rng), "bytes"


def mutated_folder(run: Path, foreign: Sequence[Path], rng: random.Random) -> str:
    """Damage one file of a run folder, or take it away; returns what was done.

    Args:
        run: folder of a finished run, which is changed.
        foreign: other run folders, whose files may take the place of its own.
        rng: draws.
    """
    families: dict[str, list[Path]] = {}
    for file in sorted(path for path in run.rglob("*") if path.is_file()):
        # few large families of files must not hide the rest
        plain = file.suffix in (".json", ".yaml")
        families.setdefault(file.name if plain else file.parent.name + file.suffix, []).append(file)
    path = rng.choice(families[rng.choice(sorted(families))])
    name = path.relative_to(run)
    how = rng.choice(["bytes", "bytes", "edit", "edit", "edit", "gone", "swap", "other"])
    if how == "edit" and path.suffix in (".json", ".yaml"):
        # any JSON is YAML
        content = yaml.safe_load(path.read_text())
        told = edited(content, rng)
        as_json = path.suffix == ".json"
        text = json.dumps(content) if as_json else yaml.safe_dump(content, sort_keys=False)
        path.write_text(text, errors="surrogatepass")
        return f"{name}: {told}"
    if how == "edit" and path.suffix == ".parquet":
        return f"{name}: {_edited_table(path, rng)}"
    if how == "gone":
        path.unlink()
        if rng.random() < 0.3:
            path.mkdir()
        return f"{name} is gone"
    others = {
        "swap": [p for part in families.values() for p in part if p.suffix == path.suffix],
        "other": [folder / name for folder in foreign if (folder / name).is_file()],
    }.get(how)
    if others:
        other = rng.choice(others)
        shutil.copy(other, path) if other != path else path.write_bytes(b"")
        return f"{name} is {other}"
    path.write_bytes(rng.choice(BYTE_DAMAGES)(path.read_bytes(), rng))
    return f"{name}: bytes"


def _edited_table(path: Path, rng: random.Random) -> str:
    import pandas as pd

    table = pd.read_parquet(path)
    column = str(rng.choice(list(table)))
    how = rng.randrange(5)
    changes: list[Callable[[], pd.DataFrame]] = [
        lambda: table.drop(columns=[column]),
        lambda: table.iloc[:0],
        lambda: table.assign(**{column: table[column].astype(str) + "x"}),
        lambda: table.assign(**{column: None}),
        lambda: table.sample(frac=0.7, random_state=rng.randrange(1000)),
    ]
    changes[how]().to_parquet(path)
    return f"{column}, change {how}"
