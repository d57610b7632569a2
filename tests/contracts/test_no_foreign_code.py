"""No module of residnet can run code that stands in a file: no pickle, `eval`, shell and so on."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import residnet

ROOT = Path(residnet.__file__).parent
FORBIDDEN_MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "marshal", "shelve"} | {
    "joblib", "code", "runpy", "skops"
}  # fmt: skip
FORBIDDEN_CALLS = {"eval", "exec", "compile", "__import__"}
FORBIDDEN_METHODS = {
    "os.system", "os.popen", "pickle.load", "pickle.loads", "joblib.load", "np.load",
    "numpy.load", "pd.read_pickle", "pandas.read_pickle", "yaml.load", "yaml.load_all",
    "yaml.unsafe_load", "yaml.full_load", "sympy.sympify", "sympy.parse_expr", "sympy.lambdify",
    "torch.hub.load", "torch.package.PackageImporter", "torch.jit.load", "subprocess.getoutput",
    "importlib.import_module",
}  # fmt: skip

EXCEPTIONS = {
    ("engine/structure.py", "import pickle"): "writes a structure to hash it; nothing is read",
    ("core/processes.py", "from joblib"): "`cpu_count` alone, which counts cores",
    ("tasks/sweep/config.py", "from joblib"): "`cpu_count` alone, which counts cores",
    ("export/torchscript.py", "torch.jit.load"): "the file that the same call has just written",
    ("__init__.py", "importlib.import_module"): "names of residnet's own modules",
    ("core/registry.py", "importlib.import_module"): "paths in residnet's own tables of parts",
    ("autopilot/__init__.py", "importlib.import_module"): "names of residnet's own modules",
    ("cli.py", "importlib.import_module"): "entry points in files of residnet's own wings",
    ("runs/task.py", "importlib.import_module"): "page and executor of the task's class",
    ("export/onnx_file.py", "importlib.import_module"): "names of packages in the source",
    ("heads/scikit_estimators.py", "importlib.import_module"): "on the allow-list, or with --trust",
}
"""Justified uses, each with its reason."""


def findings(source: str) -> list[str]:
    """Return the forbidden imports and calls of a module."""
    found: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            roots = {alias.name.split(".")[0] for alias in node.names}
            found += [f"import {name}" for name in sorted(roots & FORBIDDEN_MODULES)]
        elif isinstance(node, ast.ImportFrom):
            module = (node.module or "").split(".")[0]
            found += [f"from {module}"] if module in FORBIDDEN_MODULES else []
            called = {f"{node.module}.{alias.name}" for alias in node.names}
            found += sorted(called & FORBIDDEN_METHODS)
        elif isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            keywords = {word.arg: ast.unparse(word.value) for word in node.keywords}
            if name in FORBIDDEN_CALLS or name in FORBIDDEN_METHODS:
                found.append(name)
            if name == "torch.load" and keywords.get("weights_only") != "True":
                found.append(name)
            if keywords.get("shell", "False") != "False":
                found.append(f"{name}(shell)")
            if keywords.get("allow_pickle", "False") != "False":
                found.append(f"{name}(allow_pickle)")
    return found


def test_no_module_can_run_what_stands_in_a_file() -> None:
    unused = set(EXCEPTIONS)
    faults = []
    for file in sorted(ROOT.rglob("*.py")):
        name = file.relative_to(ROOT).as_posix()
        for fault in findings(file.read_text(encoding="utf-8")):
            if (name, fault) in EXCEPTIONS:
                unused.discard((name, fault))
            else:
                faults.append(f"{name}: {fault}")
    assert not faults
    assert not unused, "these exceptions are used no more"


@pytest.mark.parametrize(
    ("source", "fault"),
    [
        ("import pickle", "import pickle"),
        ("from joblib import Memory", "from joblib"),
        ("import torch\ntorch.load(f)", "torch.load"),
        ("import torch\ntorch.load(f, weights_only=False)", "torch.load"),
        ("eval('1')", "eval"),
        ("import os\nos.system('ls')", "os.system"),
        ("subprocess.run('ls', shell=True)", "subprocess.run(shell)"),
        ("np.load(f, allow_pickle=True)", "np.load(allow_pickle)"),
        ("yaml.load(f)", "yaml.load"),
        ("from sympy import sympify", "sympy.sympify"),
    ],
)
def test_the_scan_sees_each_kind(source: str, fault: str) -> None:
    assert fault in findings(source)


def test_the_scan_lets_safe_calls_pass() -> None:
    assert findings("torch.load(f, weights_only=True)\nmodel.eval()\nre.compile('a')") == []
