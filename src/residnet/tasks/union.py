"""All kinds of run."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.tasks.fit import FitConfig
from residnet.tasks.simulate import SimulateConfig

TaskConfig = Annotated[FitConfig | SimulateConfig, Field(discriminator="task")]
