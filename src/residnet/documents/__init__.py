"""The experiments of the source documents: one package for each document.

Where an experiment is a fit, `study` in its config adds the document's figures and tables to the
report.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from residnet.documents.moreno2019.published import MODELS as MORENO2019
from residnet.documents.woo2018.published import MODELS as WOO2018
from residnet.report.blocks import Section

StudyName = Literal["moreno2019", "woo2018"]

STUDY_MODELS: dict[StudyName, tuple[str, ...]] = {"moreno2019": MORENO2019, "woo2018": WOO2018}
"""Models that a fit must have for a document's study."""


def study_sections(name: StudyName, run: Path) -> list[Section]:
    """Draw a document's figures into a finished run and return its sections of the report.

    Args:
        name: name of the document's study.
        run: folder of a finished fit.

    Raises:
        UsageError: where the run lacks a model or a manoeuvre of the study.
    """
    from residnet.documents.moreno2019 import report as moreno2019
    from residnet.documents.woo2018 import report as woo2018

    studies: dict[StudyName, Callable[[Path], list[Section]]] = {
        "moreno2019": moreno2019.sections,
        "woo2018": woo2018.sections,
    }
    return studies[name](run)
