"""Runs without drawings, for tests that look at no picture."""

from __future__ import annotations

from pathlib import Path

import pytest

from residnet.core.files import atomic_write
from residnet.report import figure_files, page

PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010804000000b51c0c02"
    "0000000b4944415478da6364f80f00010501012718e3660000000049454e44ae426082"
)
"""The smallest PNG file."""


def omit_drawings(patch: pytest.MonkeyPatch) -> None:
    """Write a pixel for each static image, and pages without other figures.

    Drawings take half of the time of a small run. `tests/report` draws every figure.
    """
    patch.setattr(page, "render_figures", lambda sections: {})
    patch.setattr(page, "draw_svg", lambda figure: "")
    patch.setattr(figure_files, "render_matplotlib", lambda figure, case: None)
    patch.setattr(figure_files, "save_png", _save_pixel)


def _save_pixel(_: object, path: Path, *__: object) -> None:
    with atomic_write(path) as file:
        file.write_bytes(PIXEL)
