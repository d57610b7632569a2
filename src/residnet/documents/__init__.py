"""The source documents' experiments: what a config under `configs/studies` draws beside the
ordinary report.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

StudyName = Literal["moreno2019", "woo2018"]


def draw_study(name: StudyName, run: Path) -> list[Path]:
    """Write a study's tables and figures into the folder of a finished run; returns their paths."""
    from residnet.documents.moreno2019 import report as moreno2019
    from residnet.documents.woo2018 import report as woo2018

    studies = {"moreno2019": moreno2019.draw, "woo2018": woo2018.draw}
    return studies[name](run)
