"""A finished run whose results are not as they were written is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from made_models import nomoto_model

from residnet.core.errors import UsageError
from residnet.runs.folder import RunFolder, require_sealed, seal
from residnet.runs.model_store import FolderStore


def made(run: Path) -> Path:
    for name in ("resolved.yaml", "metrics.json", "models/mlp/model.safetensors", "figures/a.png"):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text(f"contents of {name}")
    other = run / "external-1"
    other.mkdir()
    for name in ("summary.json", "metrics.json"):
        (other / name).write_text("{}")
    seal(run)
    return run


def test_results_alone_are_sealed(tmp_path: Path) -> None:
    run = made(tmp_path)
    assert set(json.loads((run / "checksums.json").read_text())["files"]) == {
        "resolved.yaml",
        "metrics.json",
        "models/mlp/model.safetensors",
    }
    (run / "figures" / "a.png").write_text("drawn anew")
    (run / "external-1" / "metrics.json").write_text("judged anew")
    (run / "summary.json").write_text("{}")
    require_sealed(run)
    seal(run)
    require_sealed(run)


def _missing(file: Path) -> None:
    file.unlink()


def _folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _edited(file: Path) -> None:
    file.write_text(file.read_text().replace("of", "0f"))


def _cut(file: Path) -> None:
    file.write_text(file.read_text()[:-1])


@pytest.mark.parametrize("file", ["fit.json", "model.json"])
def test_a_resumed_run_takes_no_model_that_was_edited(file: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    store = FolderStore(folder)
    spec, model = nomoto_model(0.2, 5.0, 0.1)
    store.keep_module("ridge", spec, model, {"validation": 0.2})
    assert store.load("ridge").notes == {"validation": 0.2}
    place = folder.models / "ridge" / file
    place.write_text("{}")
    with pytest.raises(UsageError, match=f"{file}: its SHA-256 is not the one"):
        store.load("ridge")


@pytest.mark.parametrize("damage", [_missing, _folder, _edited, _cut])
@pytest.mark.parametrize("name", ["metrics.json", "models/mlp/model.safetensors"])
def test_damage_is_one_line(tmp_path: Path, name: str, damage: Callable[[Path], None]) -> None:
    run = made(tmp_path)
    damage(run / name)
    with pytest.raises(UsageError, match=f"{name}.*run it again") as caught:
        require_sealed(run)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": {"a\\u0000": "1"}}', '{"files": []}'])
def test_damaged_checksums_are_one_line(tmp_path: Path, text: str) -> None:
    run = made(tmp_path)
    (run / "checksums.json").write_text(text)
    with pytest.raises(UsageError, match="restore"):
        require_sealed(run)


def test_a_run_of_an_earlier_version_is_taken_as_it_is(tmp_path: Path) -> None:
    run = made(tmp_path)
    (run / "checksums.json").unlink()
    (run / "metrics.json").write_text("other")
    require_sealed(run)
