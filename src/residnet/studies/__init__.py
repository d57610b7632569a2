"""The experiments of the source documents, one or two files for each document.

Where an experiment is a fit, `study` in its config adds the document's figures and tables to the
report (`residnet.report.fit_studies`). The file published.yaml holds the numbers that the documents
print for their own vessels.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any


def load_published(document: str) -> dict[str, Any]:
    """Return the figures that a document prints, from published.yaml."""
    from residnet.core.config import load_mapping

    figures: dict[str, Any] = load_mapping(Path(__file__).with_name("published.yaml"))[document]
    return figures
