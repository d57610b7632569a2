"""All kinds of run, those of other packages included."""

from __future__ import annotations

from typing import Annotated

from residnet.core.config import Config
from residnet.core.registry import Kinds
from residnet.tasks.sweep.task import SweepTaskConfig
from residnet.tasks.sweepable import SingleTask

TaskConfig = Annotated[
    SingleTask | SweepTaskConfig,
    Kinds("residnet.tasks", Config, key="task"),
]
