"""The experiments of the source documents, one or two files for each document.

Where an experiment is a fit, `study` in its config adds the document's figures and tables to the
report. What the documents print for their own vessels stands in published.yaml.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from residnet.report.blocks import Section

StudyName = Literal["moreno2019", "woo2018"]

STUDY_MODELS: dict[StudyName, tuple[str, ...]] = {
    "moreno2019": (
        *("baseline", "rbf_joint", "rbf_each", "p1_joint", "p1_each", "p2_joint", "p2_each"),
        "symbolic",
    ),
    "woo2018": ("baseline", "nomoto", "nomoto_side_slip", "lstm_printed", "lstm_rate", "lstm"),
}
"""Models that a fit must have for a document's study."""


def build_study_sections(name: StudyName, run: Path) -> Sequence[Section]:
    """Draw a document's figures into a finished run and return its sections of the report.

    Raises:
        UsageError: where the run lacks a protocol or a manoeuvre of the study.
    """
    from residnet.report.run_reader import RunFiles

    study: Sequence[Section] = importlib.import_module(f"{__name__}.{name}").sections(RunFiles(run))
    return study


def load_published(document: str) -> dict[str, Any]:
    """Return the figures that a document prints, from published.yaml."""
    from residnet.core.config import load_mapping

    figures: dict[str, Any] = load_mapping(Path(__file__).with_name("published.yaml"))[document]
    return figures
