"""Where a run comes from: versions, revision and the hash of every input file."""

from __future__ import annotations

import hashlib
import json
import platform
import subprocess
import time
from pathlib import Path

import pytest

import residnet.runs.folder as provenance_module
from residnet.core.files import sha256
from residnet.core.version import __version__
from residnet.runs.folder import Provenance, RunFolder, git_revision


def test_provenance_names_every_input_by_its_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    files = [tmp_path / name for name in ("a.csv", "b.csv", "empty.csv")]
    contents = [b"t,u\n0,1\n", bytes(range(256)) * 5000, b""]
    for file, content in zip(files, contents, strict=True):
        file.write_bytes(content)
    monkeypatch.setattr("sys.argv", ["residnet", "run", "x.yaml"])
    started = time.time() - 12.0
    Provenance(tmp_path / "x.yaml", ["seed=3"], 3, files, started).write(folder)
    content = json.loads((folder.path / "provenance.json").read_text())
    assert content["inputs"] == {
        str(file): hashlib.sha256(data).hexdigest()
        for file, data in zip(files, contents, strict=True)
    }
    assert (content["seed"], content["overrides"], content["config"]) == (
        3,
        ["seed=3"],
        str(tmp_path / "x.yaml"),
    )
    assert content["command"] == ["residnet", "run", "x.yaml"]
    assert (content["residnet"], content["python"]) == (__version__, platform.python_version())
    assert content["started"] == time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(started))
    assert 12.0 <= content["seconds"] < 60.0
    import torch

    assert (
        content["packages"]["torch"] == torch.__version__.split("+")[0]
        or content["packages"]["torch"] == torch.__version__
    )
    assert sha256(files[1]) == content["inputs"][str(files[1])]


def test_revision_is_that_of_git(monkeypatch: pytest.MonkeyPatch) -> None:
    here = Path(provenance_module.__file__).parent
    told = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False
    )
    expected = told.stdout.strip() if told.returncode == 0 else None
    found = git_revision()
    assert (found.removesuffix("+changes") if found else None) == expected
    # outside a checkout, or without git, nobody can say
    monkeypatch.setenv("PATH", "")
    assert git_revision() is None
