"""Ownership: nothing is replaced or deleted that residnet did not write."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write, stage_files, write_owned
from residnet.core.ownership import (
    FILE_MANIFEST,
    Manifest,
    find_run_manifest,
    require_replaceable,
    resolve_name,
)


@pytest.fixture
def run(tmp_path: Path) -> Manifest:
    """Return the manifest of a folder with two files that were written by residnet."""
    manifest = Manifest(tmp_path / "run")
    for name in ("a.json", "figures/b.json"):
        with atomic_write(manifest.folder / name, manifest) as file:
            file.write_text(name)
    return manifest


def test_journal_and_manifest_recognise_written_files(run: Manifest) -> None:
    run.require_all_owned()
    run.compact()
    assert not run.journal.exists()
    assert set(run.read()) == {"a.json", "figures/b.json"}
    run.require_all_owned()
    run.verify()


def test_file_of_the_user_is_named_and_nothing_deleted(run: Manifest) -> None:
    (run.folder / "figures" / "NOTES.md").write_text("mine")
    with pytest.raises(UsageError, match=r"figures/NOTES\.md: exists"):
        run.remove_owned()
    assert (run.folder / "a.json").read_text() == "a.json"
    with (
        pytest.raises(UsageError, match=r"NOTES\.md: exists"),
        atomic_write(run.folder / "figures" / "NOTES.md"),
    ):
        raise AssertionError("the file was opened for writing")


def test_edited_file_is_named(run: Manifest) -> None:
    (run.folder / "a.json").write_text("edited")
    with pytest.raises(UsageError, match=r"a\.json: was edited"):
        run.remove_owned()
    with pytest.raises(UsageError, match=r"a\.json: its SHA-256"):
        run.verify()


def test_remove_owned_leaves_the_folder_alone(run: Manifest) -> None:
    neighbour = run.folder.with_name("neighbour.txt")
    neighbour.write_text("mine")
    run.compact()
    run.remove_owned()
    assert list(run.folder.iterdir()) == []
    assert neighbour.read_text() == "mine"


def test_both_versions_are_recognised_after_a_kill(run: Manifest) -> None:
    path = run.folder / "a.json"
    with pytest.raises(KeyboardInterrupt), atomic_write(path):
        raise KeyboardInterrupt
    run.require_all_owned()
    # killed between the entry and the replacement
    run.record(path, "0" * 64)
    run.require_all_owned()
    # killed within a line
    with run.journal.open("a") as journal:
        journal.write('{"name": "x')
    run.require_all_owned()


def test_links_lead_nowhere(run: Manifest, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    outside.mkdir()
    (run.folder / "exports").symlink_to(outside)
    with (
        pytest.raises(UsageError, match="exports: is a symbolic link"),
        atomic_write(run.folder / "exports" / "x.pt"),
    ):
        raise AssertionError("the file was opened for writing")
    assert list(outside.iterdir()) == []
    with pytest.raises(UsageError, match="exports: is a symbolic link"):
        run.remove_owned()


@pytest.mark.parametrize("name", ["/etc/passwd", "../x", "a/../../x", "", ".", "a//b", "a\\b", 3])
def test_names_cannot_leave_the_folder(name: object, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="not the name of a file inside"):
        resolve_name(tmp_path, name)


def test_manifest_that_is_no_regular_file_is_refused(run: Manifest) -> None:
    os.mkfifo(run.path)
    with pytest.raises(UsageError, match="no regular file"):
        run.read()


def test_damaged_manifest_is_refused(run: Manifest) -> None:
    run.compact()
    run.path.write_text(json.dumps({"schema": "other", "files": {}}))
    with pytest.raises(UsageError, match="holds no checksums"):
        run.read()


def test_nested_run_folder_has_its_own_manifest(run: Manifest) -> None:
    nested = Manifest(run.folder / "external")
    with atomic_write(nested.folder / "metrics.json", nested) as file:
        file.write_text("{}")
    above = find_run_manifest(nested.folder / "metrics.json")
    assert above is not None
    assert above.folder == nested.folder
    run.require_all_owned()
    (nested.folder / "metrics.json").write_text("edited")
    with pytest.raises(UsageError, match="was edited"):
        run.require_all_owned()


def test_single_files_are_recorded_beside_them(tmp_path: Path) -> None:
    file = tmp_path / "boat.yaml"
    for text in ("first", "second"):
        with write_owned(file) as partial:
            partial.write_text(text)
    assert sorted(path.name for path in tmp_path.iterdir()) == [FILE_MANIFEST, "boat.yaml"]
    require_replaceable(file)
    file.write_text("edited")
    with pytest.raises(UsageError, match=r"boat\.yaml: was edited"):
        require_replaceable(file)


def _write_source_and_header(out: Path, text: str) -> None:
    with stage_files(out) as file:
        file.write_text(text)
        file.with_suffix(".h").write_text("header")


def test_staged_files_are_written_all_or_none(tmp_path: Path) -> None:
    out = tmp_path / "new" / "steer.c"
    _write_source_and_header(out, "source")
    assert out.with_suffix(".h").read_text() == "header"
    header = out.with_suffix(".h")
    header.write_text("edited")
    with pytest.raises(UsageError, match=r"steer\.h: was edited"):
        _write_source_and_header(out, "new")
    assert out.read_text() == "source"
    assert header.read_text() == "edited"
