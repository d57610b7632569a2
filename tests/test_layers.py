"""The order of the house, read from the imports of every file: nothing imports upwards, nothing
imports in circles.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

from tiny import TINY, write_yaml

import residnet
from residnet.core.registry import import_object

ROOT = Path(residnet.__file__).parent
# lowest first; packages of one row may not import each other, except where ALLOWED says so
LAYERS = [
    {"core"},
    {"regression"},
    {"physics"},
    {"baselines", "heads"},
    {"dynamics"},
    {"engine"},
    {"manoeuvres"},
    {"preprocessing"},
    {"io"},
    {"quality"},
    {"training"},
    {"evaluation"},
    {"identification"},
    {"export"},
    {"simulators", "report"},
    {"runs"},
    {"tasks"},
    {"exits", "terminal"},
    {"cli", "__main__", "api", "testing"},
]
# optional packages: the core imports none of them, they may import all of the core
WINGS = {file.parent.name for file in ROOT.glob("*/entry_points.toml")}
# the studies compare controllers of the autopilot wing
ALLOWED = {("__main__", "cli"), ("studies", "autopilot")}
RANK = {package: rank for rank, packages in enumerate(LAYERS) for package in packages}
RANK |= dict.fromkeys(WINGS, len(LAYERS))
FILES = sorted(ROOT.rglob("*.py"))
SUPPORT = str(Path(__file__).parent / "support")


RUN_COMMANDS = """
import json, sys
import residnet
from residnet.__main__ import main
from residnet.export import vessel
commands, wings, support = json.loads(sys.argv[1])
sys.path.append(support)
import pytest
from pictures import omit_drawings
omit_drawings(pytest.MonkeyPatch())
vessel.PARITY_STEPS = 60
for command in commands:
    sys.argv = ["residnet", *command]
    try:
        main()
    except SystemExit as end:
        assert not end.code, (command, end.code)
print("loaded:", sorted(m for m in sys.modules if m.split(".")[:1] == ["residnet"]
                        and m.split(".")[1:2] and m.split(".")[1] in wings))
"""
"""Runs commands in one process and prints the modules of wings that they have imported."""


def module_of(path: Path) -> str:
    parts = ("residnet", *path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path): path for path in FILES}


@cache
def imports(path: Path, *, at_load: bool = False, at_work: bool = False) -> set[str]:
    """Modules that a file imports, anywhere, only when it is itself imported, or when its functions
    run, too; `from residnet import x` names the module x where there is one.
    """
    found: set[str] = set()
    nodes = statements(path, executed=at_load or at_work, inside=at_work or not at_load)
    for node in nodes:
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            assert node.module is not None
            deeper = [f"{node.module}.{alias.name}" for alias in node.names]
            found.update(name if name in MODULES else node.module for name in deeper)
    return found


@cache
def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def statements(path: Path, *, executed: bool, inside: bool) -> Iterator[ast.AST]:
    """Yield the statements of a file; expressions contain no imports.

    Args:
        path: the file.
        executed: whether to leave out those below `if TYPE_CHECKING`.
        inside: whether to include those of functions.
    """
    pending: list[ast.AST] = [parse(path)]
    while pending:
        node = pending.pop()
        yield node
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.expr):
                continue
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not inside:
                continue
            if (
                executed
                and isinstance(child, ast.If)
                and "TYPE_CHECKING" in ast.unparse(child.test)
            ):
                continue
            pending.append(child)


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


def test_every_entry_point_of_a_wing_leads_to_its_own_package() -> None:
    assert {"autopilot", "studies"} <= WINGS
    for wing in WINGS:
        text = (ROOT / wing / "entry_points.toml").read_text()
        for parts in tomllib.loads(text)["entry-points"].values():
            for object_path in parts.values():
                assert object_path.startswith(f"residnet.{wing}."), object_path
                assert import_object(object_path) is not None


def test_core_commands_load_no_wing(tmp_path: Path) -> None:
    """Lists, a fit with an export, and another export import no module of a wing."""
    # few short trials; no bands and no selection of the penalty, whose free runs take most time
    ridge = {"kind": "ridge", "degree": 1, "choose": "one_step"}
    config = {**TINY, "heads": {"ridge": ridge}, "export": {"models": ["ridge"]}}
    del config["training"], config["ensembles"]
    data = {"duration": 12, "trials": [{"kind": "zigzag", "count": 4, "heading": ["20 deg"]}]}
    data |= {"identification": {"zigzag": 3}, "validation": {"zigzag": 1}}
    terms = ["u", "v", "r", "tau_x", "tau_n"]
    config |= {"data": {**TINY["data"], **data}, "bands": None}
    config["baseline"] = {"kind": "regressors", "terms": terms}
    config["evaluation"] = {
        **TINY["evaluation"],
        "protocols": {"manoeuvre": {"kind": "manoeuvre"}},
    }
    write_yaml(tmp_path / "fit.yaml", config)
    catalogues = ("tasks", "heads", "baselines", "manoeuvres", "readers", "vessels", "formats")
    commands = [
        *(["list", catalogue] for catalogue in catalogues),
        ["run", "fit.yaml", "--out", "run"],
        ["export", "run", "--model", "ridge", "--format", "c", "--anyway"],
    ]
    finished = subprocess.run(
        [sys.executable, "-c", RUN_COMMANDS, json.dumps([commands, sorted(WINGS), SUPPORT])],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert finished.returncode == 0, finished.stderr
    assert (tmp_path / "run" / "report.html").is_file(), finished.stderr
    assert list((tmp_path / "run" / "exports").glob("*.c")), finished.stderr
    assert finished.stdout.splitlines()[-1] == "loaded: []"


def test_no_circles() -> None:
    """Between modules, in functions too; a package's own face counts as its __init__."""
    graph = {
        module: (imports(path, at_work=True) & MODULES.keys()) - {module}
        for module, path in MODULES.items()
    }
    # says the circle, where there is one
    order = list(TopologicalSorter(graph).static_order())
    assert len(order) == len(MODULES)


def test_a_task_package_has_a_config_that_imports_no_executor() -> None:
    """A config names its executor by its place; only `PackageTask.executor` imports it."""
    executors = {module for module in MODULES if module.endswith(".execute")}
    assert {"residnet.tasks.fit.execute", "residnet.autopilot.tasks.course.execute"} <= executors
    for executor in executors:
        config = f"{executor.removesuffix('.execute')}.config"
        assert config in MODULES, f"{executor} has no config beside it"
        assert not imports(MODULES[config], at_work=True) & executors, config


def test_lightning_is_imported_by_trainings_and_their_data_only() -> None:
    names = {"lightning", "pytorch_lightning"}
    heavy = {
        module
        for module, path in MODULES.items()
        if names & {name.split(".")[0] for name in imports(path)}
    }
    assert heavy
    assert {one for one in heavy if package(one) != "training"} <= {
        "residnet.preprocessing.data_module"
    }
