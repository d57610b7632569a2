"""The run folder: whose it is, what it records, and that nothing half written stands in it."""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
import time
from pathlib import Path

import pytest

import residnet.runs.folder as folder_module
from residnet import __version__
from residnet.core.errors import UsageError
from residnet.runs.folder import RunFolder, git_revision, sha256


def one_line(wanted: str, path: Path, resolved: str = "a: 1\n", *, resume: bool = False) -> None:
    with pytest.raises(UsageError, match=wanted) as caught:
        RunFolder.create(path, resolved, resume=resume)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_new_folder_holds_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "run"
    folder = RunFolder.create(path, "a: 1\n", resume=False)
    assert folder.path == path
    assert folder.resolved.read_text() == "a: 1\n"
    # an empty folder may be used too
    (tmp_path / "empty").mkdir()
    assert (
        RunFolder.create(tmp_path / "empty", "b: 2\n", resume=True).resolved.read_text() == "b: 2\n"
    )


def test_a_folder_is_taken_up_only_by_its_own_configuration(tmp_path: Path) -> None:
    path = tmp_path / "run"
    RunFolder.create(path, "a: 1\n", resume=False)
    (path / "kept.txt").write_text("mine")
    one_line("exists already; give another --out", path)
    one_line("was made with another configuration", path, "a: 2\n", resume=True)
    assert RunFolder.create(path, "a: 1\n", resume=True).path == path
    assert (path / "kept.txt").read_text() == "mine"
    assert (path / "resolved.yaml").read_text() == "a: 1\n"


def test_what_is_no_run_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("precious")
    other = tmp_path / "other"
    other.mkdir()
    (other / "notes.txt").write_text("precious")
    for resume in (False, True):
        one_line("exists already", file, resume=resume)
        one_line("exists already", other, resume=resume)
    assert file.read_text() == "precious"
    assert [path.name for path in other.iterdir()] == ["notes.txt"]


def test_open_wants_a_finished_run(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"not a run folder \(no resolved.yaml\)"):
        RunFolder.open(tmp_path / "none")
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    with pytest.raises(UsageError, match=r"is not finished .* --resume"):
        RunFolder.open(tmp_path / "run")
    folder.write_json(folder.metrics, {"rows": [1]})
    assert RunFolder.open(tmp_path / "run").read_metrics() == {"rows": [1]}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_json_holds_no_nan_and_the_old_file_stays(tmp_path: Path, value: float) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    file = folder.path / "deep" / "values.json"
    folder.write_json(file, {"a": [1.5, None]})
    before = file.read_text()
    with pytest.raises(ValueError, match="not JSON compliant"):
        folder.write_json(file, {"a": [value]})
    assert file.read_text() == before
    assert json.loads(before) == {"a": [1.5, None]}
    assert [path.name for path in file.parent.iterdir()] == ["values.json"], (
        "nothing partial is left"
    )


def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    folder.write(folder.report, "old")

    def full(self: Path, text: str) -> int:
        with self.open("w") as stream:
            stream.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OSError, match="No space"):
        folder.write(folder.report, "new and longer")
    assert folder.report.read_text() == "old"


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
    folder.write_provenance(
        config=tmp_path / "x.yaml", overrides=["seed=3"], seed=3, files=files, started=started
    )
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
    here = Path(folder_module.__file__).parent
    told = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=here, capture_output=True, text=True, check=False
    )
    expected = told.stdout.strip() if told.returncode == 0 else None
    found = git_revision()
    assert (found.removesuffix("+changes") if found else None) == expected
    # outside a checkout, or without git, nobody can say
    monkeypatch.setenv("PATH", "")
    assert git_revision() is None
