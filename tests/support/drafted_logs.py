"""What the draft of a table reads, and says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import validate_config
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers import ReaderConfig


def drafted(path: Path, **settings: Any) -> tuple[Log, dict[str, Any], DraftNotes]:
    """The log that the drafted reader reads, its settings, and what is marked."""
    marks = DraftNotes()
    content = {**draft_tables([path], marks)[0], **settings}
    return validate_config(content, ReaderConfig, "here").build().read(path), content, marks


def assert_read(log: Log, truth: Mapping[str, Any], atol: float = 1e-9) -> None:
    """Check channels against what was written; a heading may differ by whole turns."""
    for name, values in truth.items():
        apart = log[name] - np.asarray(values)
        apart = np.angle(np.exp(1j * apart)) if name in ("psi", "wind_dir") else apart
        np.testing.assert_allclose(apart, 0.0, atol=atol, err_msg=name)
