"""The run folder: whose it is, and that nothing half written stands in it."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from residnet.core.errors import UsageError
from residnet.runs.folder import RunFolder


def one_line(wanted: str, path: Path, resolved: str = "a: 1\n", *, resume: bool = False) -> None:
    with pytest.raises(UsageError, match=wanted) as caught:
        RunFolder.create(path, resolved, resume=resume)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_new_folder_holds_the_configuration(tmp_path: Path) -> None:
    # an empty folder may be used too
    (tmp_path / "empty").mkdir()
    for path, resume in ((tmp_path / "deep" / "run", False), (tmp_path / "empty", True)):
        folder = RunFolder.create(path, "a: 1\n", resume=resume)
        assert (folder.path, folder.resolved.read_text()) == (path, "a: 1\n")


def test_a_folder_is_taken_up_only_by_its_own_configuration(tmp_path: Path) -> None:
    path = tmp_path / "run"
    folder = RunFolder.create(path, "a: 1\n", resume=False)
    (path / "kept.txt").write_text("mine")
    folder.write_summary("fit", [], {}, finished=True)
    one_line("exists already; give another --out", path)
    one_line("was made with another configuration", path, "a: 2\n", resume=True)
    assert RunFolder(path).finished
    assert RunFolder.create(path, "a: 1\n", resume=True).path == path
    assert (path / "kept.txt").read_text() == "mine"
    assert (path / "resolved.yaml").read_text() == "a: 1\n"
    assert not RunFolder(path).finished, "a run that is taken up does not look finished"


def test_a_folder_without_results_is_used_again(tmp_path: Path) -> None:
    path = tmp_path / "run"
    folder = RunFolder.create(path, "a: 1\n")
    folder.write_json(folder.provenance, {})
    assert RunFolder.create(path, "a: 2\n").resolved.read_text() == "a: 2\n"
    folder.write_json(folder.models / "zero" / "fit.json", {})
    one_line("exists already", path, "a: 2\n")


def test_a_run_is_replaced_where_that_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "run"
    (RunFolder.create(path, "a: 1\n").path / "old.txt").write_text("old")
    folder = RunFolder.create(path, "a: 2\n", overwrite=True)
    assert [entry.name for entry in path.iterdir()] == ["resolved.yaml"]
    assert folder.resolved.read_text() == "a: 2\n"
    with pytest.raises(UsageError, match="not both"):
        RunFolder.create(path, "a: 2\n", overwrite=True, resume=True)


def test_what_is_no_run_is_left_alone(tmp_path: Path) -> None:
    file, other = tmp_path / "file", tmp_path / "other"
    other.mkdir()
    for precious in (file, other / "notes.txt"):
        precious.write_text("precious")
    for path in (file, other):
        for resume in (False, True):
            one_line("exists already", path, resume=resume)
    with pytest.raises(UsageError, match="not the folder of a run"):
        RunFolder.create(other, "a: 2\n", overwrite=True)
    assert file.read_text() == (other / "notes.txt").read_text() == "precious"
    assert [path.name for path in other.iterdir()] == ["notes.txt"]


def test_open_wants_a_finished_run(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"not a run folder \(no resolved.yaml\)"):
        RunFolder.open(tmp_path / "none")
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    with pytest.raises(UsageError, match=r"is not finished .* --resume"):
        RunFolder.open(tmp_path / "run")
    given = ("fit", ["Good."], {"error": {"value": 1.0, "unit": "m"}})
    folder.write_summary(*given, finished=False)
    with pytest.raises(UsageError, match="is not finished"):
        RunFolder.open(tmp_path / "run")
    folder.write_summary(*given, finished=True)
    folder.write_json(folder.metrics, {"rows": [1]})
    run = RunFolder.open(tmp_path / "run")
    assert run.read_metrics() == {"rows": [1]}
    about = dict(zip(("task", "verdict", "figures"), given, strict=True))
    assert run.read_summary() == {"schema": "residnet.summary/1", "finished": True, **about}


def test_a_damaged_file_is_one_line(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n")
    folder.summary.write_text('{"finished": tr')
    with pytest.raises(UsageError, match=r"summary.json: not readable as JSON"):
        RunFolder.open(tmp_path / "run")
    folder.summary.write_text("[]")
    with pytest.raises(UsageError, match="expected a JSON object, found list"):
        RunFolder.open(tmp_path / "run")
    with pytest.raises(UsageError, match="no such file"):
        folder.read_metrics()


def test_json_holds_no_nan_and_the_old_file_stays(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    file = folder.path / "deep" / "values.json"
    folder.write_json(file, {"a": [1.5, None]})
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="not JSON compliant"):
            folder.write_json(file, {"a": [value]})
    assert json.loads(file.read_text()) == {"a": [1.5, None]}
    assert [path.name for path in file.parent.iterdir()] == ["values.json"], "nothing is left"


def test_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    folder.write(folder.report, "old")

    def full(self: Path, text: str, encoding: str) -> int:
        with self.open("w") as stream:
            stream.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UsageError, match=r"report.html: cannot be written \(No space"):
        folder.write(folder.report, "new and longer")
    assert folder.report.read_text() == "old"
    assert not list(folder.path.rglob("*.partial"))


def test_two_processes_do_not_write_into_one_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("residnet.runs.folder._PATIENCE", 1)
    with RunFolder(tmp_path / "run").held():
        RunFolder.create(tmp_path / "run", "a: 1\n")
        with (
            pytest.raises(UsageError, match="another run is being written here"),
            RunFolder(tmp_path / "run").held(),
        ):
            pass
        (tmp_path / "run" / "metrics.json").write_text("{}")
        RunFolder.create(tmp_path / "run", "a: 1\n", overwrite=True)
        with pytest.raises(UsageError, match="another run"), RunFolder(tmp_path / "run").held():
            pass
    with RunFolder(tmp_path / "run").held():
        assert (tmp_path / "run" / "resolved.yaml").read_text() == "a: 1\n"
