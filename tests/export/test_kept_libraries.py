"""Compiled loops are kept, so that the same source is compiled once on a machine."""

from __future__ import annotations

import ctypes
from pathlib import Path

import pytest
import torch

from residnet.core.errors import ExportError
from residnet.export.c import kept
from residnet.export.c.closed_loop import _held

SOURCE = "double twice(double x) { return 2.0 * x; }\n"


def called(library: ctypes.CDLL) -> float:
    library.twice.restype = ctypes.c_double
    found: float = library.twice(ctypes.c_double(1.5))
    return found


def test_the_same_source_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RESIDNET_CACHE", str(tmp_path / "kept"))
    calls: list[Path] = []
    compile_one = kept._compile

    def counted(tool: str, source: str, out: Path) -> None:
        calls.append(out)
        compile_one(tool, source, out)

    monkeypatch.setattr(kept, "_compile", counted)
    assert [called(kept.compiled_library(SOURCE)) for _ in range(2)] == [3.0, 3.0]
    assert len(calls) == 1
    kept.compiled_library(SOURCE.replace("2.0", "4.0"))
    assert len(calls) == 2
    assert len(list((tmp_path / "kept").iterdir())) == 2
    # where nothing can be written, it is compiled each time
    monkeypatch.setenv("RESIDNET_CACHE", str(next((tmp_path / "kept").iterdir()) / "below"))
    assert called(kept.compiled_library(SOURCE)) == 3.0
    assert len(calls) == 3


def test_source_that_does_not_compile_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_CACHE", str(tmp_path))
    with pytest.raises(ExportError, match="does not compile"):
        kept.compiled_library("int f(")
    assert not list(tmp_path.iterdir())


def test_a_flight_whose_gradient_explodes_does_not_drown_the_others() -> None:
    gradients = torch.tensor([[1.0, 0.0], [0.0, 2.0], [3e9, 4e9], [torch.inf, 0.0], [6.0, 8.0]])
    asked = torch.tensor([1.0, 1.0, 1.0, 1.0, 4.0])
    held = _held(gradients, asked, 2.0)
    # the median row has 2.5 times what was asked of it
    assert torch.allclose(held[2], torch.tensor([3.0, 4.0]))
    assert torch.equal(held[3], torch.zeros(2))
    for row in (0, 1, 4):
        assert torch.equal(held[row], gradients[row])
    assert _held(gradients, asked, float("inf")) is gradients
