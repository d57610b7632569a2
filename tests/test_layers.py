"""The order of the house, read from the imports of every file: nothing imports upwards, nothing
imports in circles.
"""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import residnet

ROOT = Path(residnet.__file__).parent
# lowest first; packages of one row may not import each other, except where ALLOWED says so
LAYERS = [
    {"core"},
    {"regression"},
    {"physics"},
    {"baselines", "heads"},
    {"dynamics"},
    {"control"},
    {"manoeuvres"},
    {"data"},
    {"training"},
    {"judge"},
    {"identification"},
    {"export"},
    {"simulators", "report"},
    {"runs"},
    {"documents"},
    {"tasks"},
    {"exits", "terminal"},
    {"cli", "__main__", "api", "testing"},
]
ALLOWED = {("__main__", "cli")}
RANK = {package: rank for rank, packages in enumerate(LAYERS) for package in packages}
FILES = sorted(ROOT.rglob("*.py"))


def module_of(path: Path) -> str:
    parts = ("residnet", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


@cache
def imports(path: Path, *, at_load: bool = False) -> set[str]:
    """Modules that a file imports, anywhere or only when it is itself imported; `from residnet
    import x` names the module x where there is one.
    """
    found: set[str] = set()
    tree = ast.parse(path.read_text())
    nodes = loaded(tree) if at_load else list(ast.walk(tree))
    for node in nodes:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            deeper = [f"{node.module}.{alias.name}" for alias in node.names]
            found.update(name if name in MODULES else node.module for name in deeper)
    return found


def loaded(tree: ast.AST) -> list[ast.AST]:
    """Nodes outside functions and outside `if TYPE_CHECKING`."""
    out: list[ast.AST] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        out += [node, *loaded(node)]
    return out


def package(module: str) -> str | None:
    """First part below residnet; None for residnet itself and for other libraries."""
    parts = module.split(".")
    return parts[1] if parts[0] == "residnet" and len(parts) > 1 else None


def test_nothing_imports_upwards() -> None:
    face = imports(MODULES["residnet"], at_load=True)
    assert not [name for name in face if package(name)], "residnet itself is a lazy face"
    for module, path in MODULES.items():
        own = package(module)
        if own is None:
            continue
        assert own in RANK, f"{module} has no place in the order: {LAYERS}"
        for target in sorted(imports(path)):
            other = package(target)
            if other is None or other == own:
                continue
            assert other in RANK, f"{module} imports {target}, which has no place in the order"
            assert RANK[other] < RANK[own] or (own, other) in ALLOWED, (
                f"{module} imports {target}: {own} stands below {other} or beside it"
            )


def test_no_circles() -> None:
    """Between modules, as they import each other when loaded; a package's own face counts as its
    __init__.
    """
    graph = {
        module: {name for name in imports(path, at_load=True) if name in MODULES and name != module}
        for module, path in MODULES.items()
    }
    done: set[str] = set()

    def visit(module: str, trail: list[str]) -> None:
        assert module not in trail, "imports in a circle: " + " -> ".join(
            [*trail[trail.index(module) :], module]
        )
        if module not in done:
            for target in sorted(graph[module]):
                visit(target, [*trail, module])
            done.add(module)

    for module in sorted(graph):
        visit(module, [])


def test_packages_import_each_other_one_way_only() -> None:
    pairs = {
        (package(m), package(target)) for m, path in MODULES.items() for target in imports(path)
    }
    pairs = {(a, b) for a, b in pairs if a and b and a != b}
    assert not {(a, b) for a, b in pairs if (b, a) in pairs}


def test_lightning_is_imported_by_trainings_and_their_data_only() -> None:
    heavy = {
        module
        for module, path in MODULES.items()
        for name in imports(path)
        if name.split(".")[0] in ("lightning", "pytorch_lightning")
    }
    assert heavy
    others = {module for module in heavy if package(module) != "training"}
    assert others <= {"residnet.data.module"}


def test_core_needs_no_other_part_of_the_house() -> None:
    for module, path in MODULES.items():
        if package(module) == "core":
            assert {package(name) for name in imports(path)} <= {None, "core"}, module


def test_the_reader_of_imports_sees_what_is_there(tmp_path: Path) -> None:
    file = tmp_path / "made.py"
    file.write_text(
        "import numpy as np\nfrom residnet.core import names\nfrom residnet.core.errors import"
        " ConfigError\nfrom typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import torch\ndef"
        " f():\n    import lightning\n"
    )
    assert imports(file) == {
        "numpy",
        "residnet.core.names",
        "residnet.core.errors",
        "typing",
        "torch",
        "lightning",
    }
    assert imports(file, at_load=True) == {
        "numpy",
        "residnet.core.names",
        "residnet.core.errors",
        "typing",
    }
