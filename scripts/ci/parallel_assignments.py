"""Find assignments of unrelated values in one statement, such as `path, count = file, 3`.

    python scripts/ci/parallel_assignments.py src tests          exit 1 if there are any
    python scripts/ci/parallel_assignments.py --fix src tests    one assignment per line instead

Ruff has no rule for this. A statement is accepted if the values belong together:

- one expression is unpacked (`x, y = position`),
- all names are mathematical symbols of at most three letters (`c, s = cos(psi), sin(psi)`),
- a later value uses an earlier target, as in a swap or a recursion (`a, b = b, a + b`).
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

SYMBOL_LENGTH = 3
"""Longest name that counts as a mathematical symbol."""


def target_name(node: ast.expr) -> str:
    """Return the name that an assignment binds, without leading underscores."""
    name = (
        node.id
        if isinstance(node, ast.Name)
        else node.attr
        if isinstance(node, ast.Attribute)
        else ""
    )
    return name.lstrip("_")


def uses_target(target: ast.expr, values: list[ast.expr]) -> bool:
    """Return whether evaluating the values after the assignment could differ."""
    text = ast.unparse(target)
    for value in values:
        for node in ast.walk(value):
            if isinstance(node, ast.Name | ast.Attribute) and ast.unparse(node) == text:
                return True
            # a method may read the attribute that was just assigned
            if isinstance(target, ast.Attribute) and isinstance(node, ast.Call):
                owner = ast.unparse(target.value)
                if any(
                    isinstance(part, ast.Name) and part.id == owner.split(".")[0]
                    for part in ast.walk(node)
                ):
                    return True
    return False


def parallel_assignments(tree: ast.AST) -> Iterator[ast.Assign]:
    """Yield the assignments that should be split, in the order of the file."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.Assign) or len(node.targets) != 1:
            continue
        target = node.targets[0]
        value = node.value
        if not isinstance(target, ast.Tuple) or not isinstance(value, ast.Tuple):
            continue
        if len(target.elts) != len(value.elts) or any(
            isinstance(part, ast.Starred) for part in (*target.elts, *value.elts)
        ):
            continue
        if all(len(target_name(part)) <= SYMBOL_LENGTH for part in target.elts):
            continue
        if any(uses_target(part, value.elts[i + 1 :]) for i, part in enumerate(target.elts)):
            continue
        yield node


def split_assignments(text: str) -> str:
    """Return the source with one assignment per line; formatting is left to `ruff format`."""
    lines = text.splitlines(keepends=True)
    nodes = sorted(parallel_assignments(ast.parse(text)), key=lambda node: -node.lineno)
    for node in nodes:
        assert isinstance(node.targets[0], ast.Tuple)
        assert isinstance(node.value, ast.Tuple)
        indent = " " * node.col_offset
        first_line = lines[node.lineno - 1]
        last_line = lines[node.end_lineno - 1].encode()
        # a comment within the statement has no place afterwards, so a person must split it
        statement = "".join(lines[node.lineno - 1 : node.end_lineno])
        trailing = last_line[node.end_col_offset :].decode().strip()
        if first_line[: node.col_offset].strip() or trailing.startswith(";") or "#" in statement:
            continue
        assignments = [
            f"{indent}{ast.get_source_segment(text, target)} ="
            f" ({ast.get_source_segment(text, value)})\n"
            for target, value in zip(node.targets[0].elts, node.value.elts, strict=True)
        ]
        lines[node.lineno - 1 : node.end_lineno] = assignments
    return "".join(lines)


def main(arguments: list[str]) -> int:
    """Check or rewrite the Python files below the given paths; return the exit status."""
    is_fixing = "--fix" in arguments
    paths = [Path(name) for name in arguments if name != "--fix"]
    files = [
        file for path in paths for file in (sorted(path.rglob("*.py")) if path.is_dir() else [path])
    ]
    n_matches = 0
    for file in files:
        text = file.read_text()
        if is_fixing:
            rewritten = split_assignments(text)
            if rewritten != text:
                file.write_text(rewritten)
            text = rewritten
        for node in parallel_assignments(ast.parse(text)):
            n_matches += 1
            print(f"{file}:{node.lineno}: assigns unrelated values in parallel; write one per line")
    return int(n_matches > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
