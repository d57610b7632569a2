"""Draw random faults of the source and count how many the tests detect.

A mutant changes one operator, comparison, number or condition of src/residnet. It is run against
the tests that reach its line, the fastest first, until the first failure. Needs pytest-cov, and a
coverage map with contexts of all tests:

    pytest -n 2 -m "not long and not exporters" --cov=src/residnet --cov-context=test --cov-report=
    python scripts/bench/mutants.py --count 120 --seed 1 [--seconds 120] [--out FILE]

`--map` is the coverage map, `--seconds` the limit of the processor time of a mutant, `--junit` a
file of pytest with the durations of the tests, and `--out` a file for a line of JSON per mutant.
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


def change_node(node: ast.AST) -> str | None:
    """Change a node in place; return a description of the change, or None if it has no change."""
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
        operator = node.op
        node.op = SWAPS[type(operator)]()  # type: ignore[assignment]
        return f"{type(operator).__name__} to {type(node.op).__name__}"
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


def iterate_places(file: Path) -> Iterator[int]:
    """Yield the indices, in the order of `ast.walk`, of the expressions that can be changed."""
    tree = ast.parse(file.read_text())
    formatted = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in ast.walk(node)
    }
    for number, node in enumerate(ast.walk(tree)):
        if id(node) not in formatted and change_node(node) is not None:
            yield number


def make_mutant(file: Path, index: int) -> Mutant:
    """Return the fault at a place of a file."""
    source = file.read_text()
    node = list(ast.walk(ast.parse(source)))[index]
    assert isinstance(node, ast.expr)
    description = change_node(node) or ""
    first = node.lineno
    last = node.end_lineno or node.lineno
    lines = [line.encode() for line in source.splitlines()[first - 1 : last]]
    prefix = lines[0][: node.col_offset]
    suffix = lines[-1][node.end_col_offset :]
    text = (prefix + f"({ast.unparse(node)})".encode() + suffix).decode()
    return Mutant(file.relative_to(ROOT).as_posix(), first, last, text, description)


def draw_mutants(count: int, seed: int) -> list[Mutant]:
    """Draw faults uniformly from all places of the source."""
    files = sorted((ROOT / "src" / "residnet").rglob("*.py"))
    all_places = [(file, place) for file in files for place in iterate_places(file)]
    return [
        make_mutant(*file_and_place)
        for file_and_place in random.Random(seed).sample(all_places, count)
    ]


def find_reaching_tests(
    mutants: list[Mutant], map_file: str, durations: dict[str, float]
) -> list[list[str]]:
    """Return the tests that reach each fault, the fastest first.

    For a line that only an import reaches they are the tests that reach any line of its file.
    """
    data = CoverageData(map_file)
    data.read()
    measured_files = {name.split("/src/residnet/")[-1]: name for name in data.measured_files()}
    tests_of_mutants = []
    for mutant in mutants:
        name = measured_files.get(mutant.file.removeprefix("src/residnet/"))
        lines = data.contexts_by_lineno(name) if name else {}
        contexts_of_lines = [
            lines.get(number, []) for number in range(mutant.first, mutant.last + 1)
        ]
        tests = {context for contexts in contexts_of_lines for context in contexts if context}
        tests = tests or {context for contexts in lines.values() for context in contexts if context}
        ids = {test.rsplit("|", 1)[0] for test in tests}
        tests_of_mutants.append(sorted(ids, key=lambda test: (durations.get(test, 1.0), test)))
    return tests_of_mutants


def evaluate_mutant(mutant: Mutant, tests: list[str], scratch: Path, seconds: int) -> str:
    """Return `killed`, `survived`, `time` or `unreached`; a fork runs the tests on a copy."""
    if not tests:
        return "unreached"
    file = scratch / mutant.file
    source = file.read_text()
    lines = source.splitlines()
    lines[mutant.first - 1 : mutant.last] = mutant.text.splitlines()
    file.write_text("\n".join(lines) + "\n")
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
        os.chdir(scratch)
        sys.path[:0] = [str(scratch / "src")]
        os.environ["PYTHONPATH"] = str(scratch / "src")
        null_device = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null_device, 1)
        os.dup2(null_device, 2)
        os._exit(int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *tests[:400]])))
    _, status = os.waitpid(child, 0)
    file.write_text(source)
    if os.WIFSIGNALED(status):
        return "time"
    return "survived" if os.WEXITSTATUS(status) == 0 else "killed"


def main() -> None:
    """Draw, run and count."""
    options = bench.options(
        __doc__, count=120, seed=1, seconds=120, map=str(ROOT / ".coverage"), junit=None, out=None
    )
    durations = {}
    if options.junit:
        for case in tree.parse(options.junit).iter("testcase"):
            module = case.get("classname", "").replace(".", "/") + ".py"
            durations[f"{module}::{case.get('name')}"] = float(case.get("time", 1.0))
    mutants = draw_mutants(options.count, options.seed)
    tests = find_reaching_tests(mutants, options.map, durations)
    counts: dict[str, int] = {}
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder) / "copy"
        # `src/residnet/runs` is no folder of runs
        ignored_names = {str(ROOT): [".venv", ".git", "runs", "build", "dist"]}
        shutil.copytree(ROOT, scratch, ignore=lambda folder, _: ignored_names.get(folder, []))
        for number, (mutant, reaching_tests) in enumerate(zip(mutants, tests, strict=True)):
            start_time = time.monotonic()
            state = evaluate_mutant(mutant, reaching_tests, scratch, options.seconds)
            counts[state] = counts.get(state, 0) + 1
            row = {
                "file": mutant.file,
                "line": mutant.first,
                "what": mutant.what,
                "state": state,
            }
            row |= {
                "tests": len(reaching_tests),
                "seconds": round(time.monotonic() - start_time, 1),
            }
            print(number, json.dumps(row), flush=True)
            if options.out:
                with Path(options.out).open("a") as stream:
                    stream.write(json.dumps(row) + "\n")
    print(", ".join(f"{state} {count}" for state, count in sorted(counts.items())))


if __name__ == "__main__":
    main()
