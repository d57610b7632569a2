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
    items = (
        value.items()
        if isinstance(value, Mapping)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, item in items:
        yield (*at, key)
        yield from places(item, (*at, key))


def at(root: Any, keys: Keys) -> Any:
    for key in keys:
        root = root[key]
    return root


def put(root: Any, keys: Keys, value: Any) -> None:
    at(root, keys[:-1])[keys[-1]] = value


def junk(root: Any, rng: random.Random) -> str:
    keys, value = rng.choice(list(places(root))), rng.choice(JUNK)
    put(root, keys, copy.deepcopy(value))
    return f"{_dotted(keys)} = {str(value)[:30]!r}"


def scaled(root: Any, rng: random.Random) -> str:
    numbers = [keys for keys in places(root) if type(at(root, keys)) in (int, float)]
    if not numbers:
        return junk(root, rng)
    keys, factor = rng.choice(numbers), rng.choice(SCALES)
    value = at(root, keys) * factor
    if type(at(root, keys)) is int and abs(value) < 1e30:
        value = int(value)
    put(root, keys, value)
    return f"{_dotted(keys)} = {value:g}"


def removed(root: Any, rng: random.Random) -> str:
    keys = rng.choice(list(places(root)))
    del at(root, keys[:-1])[keys[-1]]
    return f"without {_dotted(keys)}"


def misspelt(root: Any, rng: random.Random) -> str:
    named = [keys for keys in places(root) if isinstance(keys[-1], str) and keys[-1]]
    keys = rng.choice(named)
    parent, key = at(root, keys[:-1]), str(keys[-1])
    letter = rng.randrange(len(key))
    parent[rng.choice([key[:letter] + key[letter + 1 :], key + "s", key.upper(), ""])] = parent.pop(
        key
    )
    return f"{_dotted(keys)} misspelt"


def exchanged(root: Any, rng: random.Random) -> str:
    leaves = [keys for keys in places(root) if not isinstance(at(root, keys), dict | list)]
    one, other = rng.choice(leaves), rng.choice(leaves)
    first, second = at(root, one), at(root, other)
    put(root, one, second)
    put(root, other, first)
    return f"{_dotted(one)} and {_dotted(other)} exchanged"


def transplanted(root: Any, rng: random.Random) -> str:
    every = list(places(root))
    one, other = rng.choice(every), rng.choice(every)
    put(root, other, copy.deepcopy(at(root, one)))
    return f"{_dotted(one)} copied to {_dotted(other)}"


def relisted(root: Any, rng: random.Random) -> str:
    lists = [keys for keys in places(root) if isinstance(at(root, keys), list) and at(root, keys)]
    if not lists:
        return junk(root, rng)
    keys = rng.choice(lists)
    items: list[Any] = at(root, keys)
    put(root, keys, rng.choice([items[1:], items[::-1], items * 2, items * 50, [items]]))
    return f"{_dotted(keys)} relisted"


def renamed_word(root: Any, rng: random.Random) -> str:
    words = [keys for keys in places(root) if isinstance(at(root, keys), str)]
    if len(words) < 2:
        return junk(root, rng)
    keys = rng.choice(words)
    value = at(root, rng.choice(words))
    put(root, keys, value)
    return f"{_dotted(keys)} = {value[:30]!r}"


EDITS = (
    *(junk, junk, junk, scaled, scaled, scaled, removed, removed, misspelt),
    *(exchanged, transplanted, relisted, renamed_word),
)


def _dotted(keys: Keys) -> str:
    return ".".join(str(key)[:40] for key in keys)


def edited(root: Any, rng: random.Random) -> str:
    """Change a tree of plain values in place; returns what was done."""
    if not list(places(root)):
        return "nothing to edit"
    try:
        return rng.choice(EDITS)(root, rng)
    except (IndexError, KeyError, TypeError, OverflowError):
        # a value has gone into itself or is no number any more
        return junk(root, rng)


def cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def peppered(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.randint(1, 4)):
        place = rng.randrange(len(data) + 1)
        data = data[:place] + rng.choice(BYTES) * rng.choice([1, 1, 40]) + data[place:]
    return data


def flipped(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.randint(1, 5)):
        if out:
            out[rng.randrange(len(out))] ^= 1 << rng.randrange(8)
    return bytes(out)


def zeroed(data: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(data) + 1)
    return data[:place] + bytes(rng.randint(1, 500)) + data[place + rng.randint(0, 500) :]


def replaced(data: bytes, rng: random.Random) -> bytes:
    return rng.choice([b"", b"\n", b"{}", b"[]", b"null", b"1", b'"x"', b"PK\x03\x04", bytes(64)])


BYTE_DAMAGES: tuple[Callable[[bytes, random.Random], bytes], ...] = (
    *(cut, peppered, flipped, zeroed, replaced),
)


def alias_bomb(text: str, rng: random.Random) -> str:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    return "\n".join([*lines, text])


def nested(text: str, rng: random.Random) -> str:
    sign = rng.choice(["[", "{a: ", "- "])
    return f"{text}\nextra: {sign * rng.choice([500, 20_000])}"


def repeated_key(text: str, rng: random.Random) -> str:
    lines = text.splitlines()
    line = rng.choice(lines)
    return "\n".join([*lines, line])


def shifted(text: str, rng: random.Random) -> str:
    lines = text.splitlines()
    place = rng.randrange(len(lines))
    lines[place] = rng.choice(["  ", "\t", " "]) + lines[place]
    return "\n".join(lines)


TEXT_DAMAGES: tuple[Callable[[str, random.Random], str], ...] = (
    *(alias_bomb, nested, repeated_key, shifted, shifted),
)


def mutated_config(config: Mapping[str, Any], rng: random.Random) -> tuple[bytes, str]:
    """A config as a file's bytes, with one to three changes, and what was changed."""
    root: dict[str, Any] = json.loads(json.dumps(config))
    if rng.random() < 0.8:
        told = [edited(root, rng) for _ in range(rng.choice([1, 1, 1, 2, 3]))]
        text = yaml.safe_dump(root, sort_keys=False, allow_unicode=True)
        return text.encode("utf-8", "surrogatepass"), ", ".join(told)
    text = yaml.safe_dump(root, sort_keys=False)
    if rng.random() < 0.4:
        damage = rng.choice(TEXT_DAMAGES)
        return damage(text, rng).encode(), damage.__name__
    spoil = rng.choice(BYTE_DAMAGES)
    return spoil(text.encode(), rng), spoil.__name__


def mutated_folder(run: Path, foreign: Sequence[Path], rng: random.Random) -> str:
    """Damage one file of a run folder, or take it away; returns what was done.

    Args:
        run: folder of a finished run, which is changed.
        foreign: other run folders, whose files may take the place of its own.
        rng: draws.
    """
    files = sorted(path for path in run.rglob("*") if path.is_file())
    # few large families of files must not hide the rest
    families = sorted({_family(path, run) for path in files})
    family = rng.choice(families)
    path = rng.choice([path for path in files if _family(path, run) == family])
    name = path.relative_to(run)
    how = rng.choice(["bytes", "bytes", "edit", "edit", "edit", "gone", "swap", "other"])
    if how == "edit" and path.suffix in (".json", ".yaml"):
        text = path.read_text()
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
        told = edited(content, rng)
        if path.suffix == ".json":
            path.write_text(json.dumps(content))
        else:
            path.write_text(yaml.safe_dump(content, sort_keys=False), errors="surrogatepass")
        return f"{name}: {told}"
    if how == "edit" and path.suffix == ".parquet":
        return f"{name}: {_edited_table(path, rng)}"
    if how == "gone":
        path.unlink()
        if rng.random() < 0.3:
            path.mkdir()
        return f"{name} is gone"
    if how == "swap":
        other = rng.choice([p for p in files if p.suffix == path.suffix])
        shutil.copy(other, path) if other != path else path.write_bytes(b"")
        return f"{name} is {other.relative_to(run)}"
    if how == "other" and foreign:
        other = rng.choice(foreign) / name
        if other.is_file():
            shutil.copy(other, path)
            return f"{name} is that of {other.parent}"
    spoil = rng.choice(BYTE_DAMAGES)
    path.write_bytes(spoil(path.read_bytes(), rng))
    return f"{name}: {spoil.__name__}"


def _family(path: Path, run: Path) -> str:
    return (
        path.name
        if path.suffix in (".json", ".yaml")
        else "/".join(path.parts[-2:-1]) + (path.suffix)
    )


def _edited_table(path: Path, rng: random.Random) -> str:
    import pandas as pd

    table = pd.read_parquet(path)
    column = rng.choice(list(table))
    how = rng.choice(["dropped", "empty", "text", "null", "huge", "rows", "none"])
    if how == "dropped":
        table = table.drop(columns=[column])
    elif how == "empty":
        table = table.iloc[:0]
    elif how == "text":
        table[column] = table[column].astype(str) + "x"
    elif how == "null":
        table[column] = None
    elif how == "huge" and pd.api.types.is_float_dtype(table[column]):
        table.loc[table.index[0], column] = 1e300
    elif how == "rows":
        table = table.sample(frac=0.7, random_state=rng.randrange(1000))
    else:
        table = pd.DataFrame({"a": [1]})
    table.to_parquet(path)
    return f"{column} {how}"
