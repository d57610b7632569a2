"""The run folder: whose it is, what it records and seals, and that nothing half written stands in
it.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from made_models import nomoto_model

from residnet.core.errors import UsageError
from residnet.core.files import sha256
from residnet.core.run_loader import accept_run
from residnet.core.run_records import MainFigure
from residnet.core.version import __version__
from residnet.runs import folder as folders
from residnet.runs.folder import (
    Provenance,
    RunFolder,
    read_git_revision,
    verify_checksums,
    write_checksums,
)
from residnet.runs.model_store import RunModelStore


def refused(wanted: str, path: Path, resolved: str = "a: 1\n", *, resume: bool = False) -> None:
    with pytest.raises(UsageError, match=wanted) as caught:
        RunFolder.create(path, resolved, resume=resume)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_folder_is_taken_up_only_by_its_own_configuration(tmp_path: Path) -> None:
    # an empty folder may be used too
    (tmp_path / "empty").mkdir()
    for path, resume in ((tmp_path / "deep" / "run", False), (tmp_path / "empty", True)):
        folder = RunFolder.create(path, "a: 1\n", resume=resume)
        assert (folder.path, folder.resolved_config.read_text()) == (path, "a: 1\n")
    (path / "kept.txt").write_text("mine")
    folder.write_summary("fit", [], {}, is_finished=True)
    refused("exists already; choose another --out", path)
    refused("has another configuration", path, "a: 2\n", resume=True)
    assert RunFolder(path).is_finished
    assert RunFolder.create(path, "a: 1\n", resume=True).path == path
    assert (path / "kept.txt").read_text() == "mine"
    assert (path / "resolved.yaml").read_text() == "a: 1\n"
    assert not RunFolder(path).is_finished, "a run that is taken up does not look finished"


def test_a_folder_is_used_again_without_results_or_where_that_is_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "run"
    folder = RunFolder.create(path, "a: 1\n")
    folder.write_json(folder.provenance, {})
    assert RunFolder.create(path, "a: 2\n").resolved_config.read_text() == "a: 2\n"
    folder.write_json(folder.models / "constant_velocity" / "fit.json", {})
    refused("exists already", path, "a: 2\n")
    folder = RunFolder.create(path, "a: 3\n", overwrite=True)
    assert {entry.name for entry in path.iterdir()} == {"resolved.yaml", "checksums.jsonl"}
    assert folder.resolved_config.read_text() == "a: 3\n"
    with pytest.raises(UsageError, match="not both"):
        RunFolder.create(path, "a: 2\n", overwrite=True, resume=True)


def test_what_is_no_run_is_left_alone(tmp_path: Path) -> None:
    file = tmp_path / "file"
    other = tmp_path / "other"
    other.mkdir()
    for precious in (file, other / "notes.txt"):
        precious.write_text("precious")
    for path in (file, other):
        for resume in (False, True):
            refused("exists", path, resume=resume)
    with pytest.raises(UsageError, match="not a run folder"):
        RunFolder.create(other, "a: 2\n", overwrite=True)
    assert file.read_text() == (other / "notes.txt").read_text() == "precious"
    assert [path.name for path in other.iterdir()] == ["notes.txt"]


def test_only_a_finished_run_whose_files_are_whole_is_opened(tmp_path: Path) -> None:
    path = tmp_path / "run"

    def closed(wanted: str) -> None:
        with pytest.raises(UsageError, match=wanted):
            RunFolder.open(path)

    closed("no such folder")
    folder = RunFolder.create(path, "a: 1\n", resume=False)
    closed(r"is not finished .* --resume")
    given = ("fit", ["Good."], {"error": MainFigure(value=1.0, unit="m")})
    folder.write_summary(*given, is_finished=False)
    closed("is not finished")
    folder.write_summary(*given, is_finished=True)
    with pytest.raises(UsageError, match="no such file"):
        folder.read_metrics()
    folder.write_json(folder.metrics, {"rows": [{"a": 1}]})
    run = RunFolder.open(path)
    with pytest.raises(UsageError, match=r"metrics\.json: key 'schema': field required"):
        run.read_metrics()
    summary = run.read_summary()
    assert (summary.task, list(summary.verdict), summary.figures) == given
    assert summary.finished
    folder.summary.write_text('{"finished": tr')
    closed(r"summary.json: not readable as JSON")
    folder.summary.write_text("[]")
    closed("expected a JSON object, found list")


def test_json_holds_no_nan_and_a_write_that_fails_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    file = folder.path / "deep" / "values.json"
    folder.write_json(file, {"a": [1.5, None]})
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="not JSON compliant"):
            folder.write_json(file, {"a": [value]})
    assert json.loads(file.read_text()) == {"a": [1.5, None]}

    def full(self: Path, text: str, encoding: str) -> int:
        with self.open("w") as stream:
            stream.write(text[: len(text) // 2])
        raise OSError(28, "No space left on device")

    folder.write(folder.report, "old")
    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(UsageError, match=r"report.html: cannot be written \(No space"):
        folder.write(folder.report, "new and longer")
    assert folder.report.read_text() == "old"
    assert not list(folder.path.rglob("*.partial")), "nothing is left"
    assert [path.name for path in file.parent.iterdir()] == ["values.json"]


def test_two_processes_do_not_write_into_one_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folders, "_LOCK_RETRIES", 1)
    run = tmp_path / "run"
    with RunFolder(run).lock():
        for overwrite in (False, True):
            folder = RunFolder.create(run, "a: 1\n", overwrite=overwrite)
            with (
                pytest.raises(UsageError, match="another run is being written here"),
                RunFolder(run).lock(),
            ):
                pass
            folder.write_json(folder.metrics, {})
    with RunFolder(run).lock():
        assert (run / "resolved.yaml").read_text() == "a: 1\n"


def test_provenance_names_every_input_by_its_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder.create(tmp_path / "run", "a: 1\n", resume=False)
    contents = {"a.csv": b"t,u\n0,1\n", "b.csv": bytes(range(256)) * 5000, "empty.csv": b""}
    files = [tmp_path / name for name in contents]
    for file in files:
        file.write_bytes(contents[file.name])
    monkeypatch.setattr("sys.argv", ["residnet", "run", "x.yaml"])
    started = time.time() - 12.0
    Provenance(tmp_path / "x.yaml", ["seed=3"], 3, files, started).write(
        folder, {"made-parts": "1.0"}
    )
    content = json.loads((folder.path / "provenance.json").read_text())
    hashes = [hashlib.sha256(data).hexdigest() for data in contents.values()]
    assert content["inputs"] == dict(zip(map(str, files), hashes, strict=True))
    assert sha256(files[1]) == hashes[1]
    told = {"seed": 3, "overrides": ["seed=3"], "config": str(tmp_path / "x.yaml")}
    told |= {"command": ["residnet", "run", "x.yaml"], "residnet": __version__}
    told |= {"python": platform.python_version()}
    told |= {"started": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(started))}
    assert {key: content[key] for key in told} == told
    assert 12.0 <= content["seconds"] < 60.0
    assert content["part_packages"] == {"made-parts": "1.0"}
    assert content["packages"]["torch"].split("+")[0] == torch.__version__.split("+")[0]


def test_the_revision_is_that_of_git(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["git", "rev-parse", "HEAD"]
    here = Path(folders.__file__).parent
    told = subprocess.run(words, cwd=here, capture_output=True, text=True, check=False)
    found = read_git_revision()
    expected = told.stdout.strip() if told.returncode == 0 else None
    assert (found.removesuffix("+changes") if found else None) == expected
    # outside a checkout, or without git, nobody can say
    monkeypatch.setenv("PATH", "")
    assert read_git_revision() is None


SEALED = ("resolved.yaml", "metrics.json", "models/mlp/model.safetensors")


def sealed(run: Path) -> Path:
    others = ("figures/a.png", "external-1/summary.json", "external-1/metrics.json")
    for name in (*SEALED, *others):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text(f"contents of {name}")
    write_checksums(run)
    return run


def test_results_alone_are_sealed(tmp_path: Path) -> None:
    run = sealed(tmp_path)
    assert set(json.loads((run / "checksums.json").read_text())["files"]) == set(SEALED)
    for name in ("figures/a.png", "external-1/metrics.json"):
        (run / name).write_text("made anew")
    verify_checksums(run)
    (run / "checksums.json").unlink()
    with pytest.raises(UsageError, match=r"has no checksums.json; .*: residnet trust"):
        verify_checksums(run)
    accept_run(run)
    verify_checksums(run)


def as_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


MODEL = SEALED[-1]
SUMS = "checksums.json"
DAMAGES: list[tuple[str, Callable[[Path], object], str]] = [
    (MODEL, Path.unlink, f"{MODEL}.*run it again"),
    (MODEL, as_folder, f"{MODEL}.*run it again"),
    (MODEL, lambda f: f.write_text(f.read_text().replace("of", "0f")), f"{MODEL}.*run it again"),
    (SUMS, lambda file: file.write_text(""), "restore"),
    (SUMS, lambda file: file.write_text("[]"), "restore"),
    (SUMS, lambda file: file.write_text("{}"), "restore"),
    (SUMS, lambda file: file.write_text('{"files": {"a\\u0000": "1"}}'), "restore"),
    (SUMS, lambda file: file.write_text('{"files": []}'), "restore"),
]


@pytest.mark.parametrize(("name", "damage", "said"), DAMAGES)
def test_damaged_results_and_checksums_are_one_line(
    name: str, damage: Callable[[Path], object], said: str, tmp_path: Path
) -> None:
    damage(sealed(tmp_path) / name)
    with pytest.raises(UsageError, match=said) as caught:
        verify_checksums(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("file", ["fit.json", "model.json"])
def test_a_resumed_run_takes_no_model_that_was_edited(file: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    store = RunModelStore(folder)
    spec, model = nomoto_model(0.2, 5.0, 0.1)
    store.save_module("ridge", spec, model, {"validation": 0.2})
    assert store.load("ridge").notes == {"validation": 0.2}
    (folder.models / "ridge" / file).write_text("{}")
    with pytest.raises(UsageError, match=f"{file}: its SHA-256 is not the one"):
        store.load("ridge")
