"""Draw faults of the source at random and count how many the tests find.

A mutant changes one operator, comparison, number or condition of src/residnet. It is run against
the tests that reach its line, quickest first, up to the first failure. Needs pytest-cov, and a
coverage map with contexts of the whole suite:

    pytest -n 2 -m "not long and not exporters" --cov=src/residnet --cov-context=test --cov-report=
    python scripts/bench/mutants.py --count 120 --seed 1 [--seconds 120] [--out FILE]

`--map` is the coverage map, `--seconds` the processor time that a mutant has, `--junit` a file with
the durations of the tests as pytest writes them, and `--out` takes a line of JSON for each mutant.
"""

from __future__ import annotations

import ast
import json
import os
import random
import resource
import shutil
import sys
import tempfile
import time
import xml.etree.ElementTree as tree
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import bench
import lightning  # noqa: F401 (loaded once, in the parent)
import pandas  # noqa: F401
import pytest
import scipy.stats  # noqa: F401
from coverage import CoverageData

ROOT = bench.ROOT
SWAPS: dict[type[ast.AST], type[ast.AST]] = {
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult},
    **{ast.Lt: ast.GtE, ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt},
    **{ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is},
    **{ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And},
}


@dataclass(frozen=True)
class Mutant:
    """One fault: the lines `first` to `last` of a file are replaced by `text`."""

    file: str
    first: int
    last: int
    text: str
    what: str


def changed(node: ast.AST) -> str | None:
    """Change a node in place; returns what was done, or nothing where there is nothing to do."""
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
        before = node.op
        node.op = SWAPS[type(before)]()  # type: ignore[assignment]
        return f"{type(before).__name__} to {type(node.op).__name__}"
    if isinstance(node, ast.BoolOp):
        node.op = SWAPS[type(node.op)]()  # type: ignore[assignment]
        return f"to {type(node.op).__name__}"
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        node.ops[0] = SWAPS[type(node.ops[0])]()  # type: ignore[assignment]
        return f"to {type(node.ops[0]).__name__}"
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        before_value = node.value
        node.value = node.value + 1
        return f"{before_value} to {node.value}"
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        node.op = ast.UAdd()
        return "sign dropped"
    return None


def places(file: Path) -> Iterator[int]:
    """Yield the numbers, in the order of `ast.walk`, of the expressions that can be changed."""
    tree = ast.parse(file.read_text())
    formatted = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in ast.walk(node)
    }
    for number, node in enumerate(ast.walk(tree)):
        if id(node) not in formatted and changed(node) is not None:
            yield number


def mutant(file: Path, place: int) -> Mutant:
    """Return the fault at a place of a file."""
    source = file.read_text()
    node = list(ast.walk(ast.parse(source)))[place]
    assert isinstance(node, ast.expr)
    what = changed(node) or ""
    first = node.lineno
    last = node.end_lineno or node.lineno
    lines = [line.encode() for line in source.splitlines()[first - 1 : last]]
    before = lines[0][: node.col_offset]
    after = lines[-1][node.end_col_offset :]
    text = (before + f"({ast.unparse(node)})".encode() + after).decode()
    return Mutant(file.relative_to(ROOT).as_posix(), first, last, text, what)


def draw(count: int, seed: int) -> list[Mutant]:
    """Draw faults over all places of the source alike."""
    files = sorted((ROOT / "src" / "residnet").rglob("*.py"))
    everywhere = [(file, place) for file in files for place in places(file)]
    return [mutant(*found) for found in random.Random(seed).sample(everywhere, count)]


def reaching(drawn: list[Mutant], map_file: str, durations: dict[str, float]) -> list[list[str]]:
    """Return the tests that reach each fault, quickest first.

    Of a line that only an import reaches, they are those that reach any line of its file.
    """
    data = CoverageData(map_file)
    data.read()
    measured = {name.split("/src/residnet/")[-1]: name for name in data.measured_files()}
    found = []
    for one in drawn:
        name = measured.get(one.file.removeprefix("src/residnet/"))
        lines = data.contexts_by_lineno(name) if name else {}
        own = [lines.get(number, []) for number in range(one.first, one.last + 1)]
        tests = {context for contexts in own for context in contexts if context}
        tests = tests or {context for contexts in lines.values() for context in contexts if context}
        ids = {test.rsplit("|", 1)[0] for test in tests}
        found.append(sorted(ids, key=lambda test: (durations.get(test, 1.0), test)))
    return found


def judged(one: Mutant, tests: list[str], scratch: Path, seconds: int) -> str:
    """Return `killed`, `survived`, `time` or `unreached`; a fork runs the tests on a copy."""
    if not tests:
        return "unreached"
    file = scratch / one.file
    whole = file.read_text()
    lines = whole.splitlines()
    lines[one.first - 1 : one.last] = one.text.splitlines()
    file.write_text("\n".join(lines) + "\n")
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        os.chdir(scratch)
        sys.path[:0] = [str(scratch / "src")]
        os.environ["PYTHONPATH"] = str(scratch / "src")
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1)
        os.dup2(silent, 2)
        os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests[:400]])))
    _, status = os.waitpid(child, 0)
    file.write_text(whole)
    if os.WIFSIGNALED(status):
        return "time"
    return "survived" if os.WEXITSTATUS(status) == 0 else "killed"


def main() -> None:
    """Draw, run and count."""
    given = bench.options(
        __doc__, count=120, seed=1, seconds=120, map=str(ROOT / ".coverage"), junit=None, out=None
    )
    durations = {}
    if given.junit:
        for case in tree.parse(given.junit).iter("testcase"):
            module = case.get("classname", "").replace(".", "/") + ".py"
            durations[f"{module}::{case.get('name')}"] = float(case.get("time", 1.0))
    mutants = draw(given.count, given.seed)
    tests = reaching(mutants, given.map, durations)
    counts: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "copy"
        # `src/residnet/runs` is no folder of runs
        left_out = {str(ROOT): [".venv", ".git", "runs", "build", "dist"]}
        shutil.copytree(ROOT, scratch, ignore=lambda folder, _: left_out.get(folder, []))
        for number, (one, reached) in enumerate(zip(mutants, tests, strict=True)):
            started = time.monotonic()
            state = judged(one, reached, scratch, given.seconds)
            counts[state] = counts.get(state, 0) + 1
            row = {"file": one.file, "line": one.first, "what": one.what, "state": state}
            row |= {"tests": len(reached), "seconds": round(time.monotonic() - started, 1)}
            print(number, json.dumps(row), flush=True)
            if given.out:
                with Path(given.out).open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
    print(", ".join(f"{state} {count}" for state, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
