"""Files stand in their place whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from residnet.core.errors import UsageError
from residnet.core.files import atomic_write, make_file_stem


def test_atomic_write_replaces_a_complete_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "values.json"
    with atomic_write(path) as file:
        file.write_text("new")
        assert not path.exists()
    assert path.read_text() == "new"
    assert [entry.name for entry in path.parent.iterdir()] == ["values.json"]


@pytest.mark.parametrize("error", [ValueError("wrong"), KeyboardInterrupt(), SystemExit(1)])
def test_atomic_write_keeps_the_old_file_after_an_error(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "values.json"
    path.write_text("old")

    def broken_off() -> None:
        with atomic_write(path) as file:
            file.write_text("half")
            raise error

    with pytest.raises(type(error)):
        broken_off()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["values.json"]


@pytest.mark.parametrize("name", ["x" * 300, "file/values.json"])
def test_unwritable_places_raise_usage_errors(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("no folder")
    path = tmp_path / name
    with pytest.raises(UsageError, match="cannot be written") as caught, atomic_write(path) as file:
        file.write_text("new")
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "x/../../../NAME",
        "zigzag 10/10",
        "..",
        "",
        "a\x00b",
        "C:\\boat",
        "\udce4",
        "n" * 400,
        "船" * 90,
    ],
)
def test_make_file_stem_gives_safe_unique_names(name: str, tmp_path: Path) -> None:
    stem = make_file_stem(name)
    (tmp_path / f"{stem}.txt").write_text("here")
    assert [path.name for path in tmp_path.iterdir()] == [f"{stem}.txt"]
    assert stem != make_file_stem(f"{name}/") != make_file_stem(f"{name}:")
    assert make_file_stem("Zigzag 10, 20°_ä (2)") == "Zigzag 10, 20°_ä (2)"
