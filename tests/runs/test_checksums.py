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

SEALED = ("resolved.yaml", "metrics.json", "models/mlp/model.safetensors")


def made(run: Path) -> Path:
    others = ("figures/a.png", "external-1/summary.json", "external-1/metrics.json")
    for name in (*SEALED, *others):
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).write_text(f"contents of {name}")
    seal(run)
    return run


def test_results_alone_are_sealed(tmp_path: Path) -> None:
    run = made(tmp_path)
    assert set(json.loads((run / "checksums.json").read_text())["files"]) == set(SEALED)
    for name in ("figures/a.png", "external-1/metrics.json", "summary.json"):
        (run / name).write_text("made anew")
    require_sealed(run)
    # a run of an earlier version is taken as it is
    (run / "checksums.json").unlink()
    (run / "metrics.json").write_text("other")
    require_sealed(run)


@pytest.mark.parametrize("file", ["fit.json", "model.json"])
def test_a_resumed_run_takes_no_model_that_was_edited(file: str, tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    store = FolderStore(folder)
    spec, model = nomoto_model(0.2, 5.0, 0.1)
    store.keep_module("ridge", spec, model, {"validation": 0.2})
    assert store.load("ridge").notes == {"validation": 0.2}
    (folder.models / "ridge" / file).write_text("{}")
    with pytest.raises(UsageError, match=f"{file}: its SHA-256 is not the one"):
        store.load("ridge")


def _as_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


DAMAGES: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "a folder": _as_folder,
    "edited": lambda file: file.write_text(file.read_text().replace("of", "0f")),
    "cut off": lambda file: file.write_text(file.read_text()[:-1]),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_one_line(tmp_path: Path, damage: str) -> None:
    name = SEALED[-1]
    DAMAGES[damage](made(tmp_path) / name)
    with pytest.raises(UsageError, match=f"{name}.*run it again") as caught:
        require_sealed(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"files": {"a\\u0000": "1"}}', '{"files": []}'])
def test_damaged_checksums_are_one_line(tmp_path: Path, text: str) -> None:
    (made(tmp_path) / "checksums.json").write_text(text)
    with pytest.raises(UsageError, match="restore"):
        require_sealed(tmp_path)
