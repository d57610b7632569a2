"""What the draft of a table reads, and says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from residnet.core.config import validate
from residnet.core.log import Log
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.tables import draft_tables
from residnet.data.readers import ReaderConfig


def drafted(path: Path, **settings: Any) -> tuple[Log, dict[str, Any], Marks]:
    """The log that the drafted reader reads, its settings, and what is marked."""
    marks = Marks()
    content = {**draft_tables([path], marks)[0], **settings}
    return validate(content, ReaderConfig, "here").build().read(path), content, marks
