"""All kinds of run."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.tasks.actuators import ActuatorsTaskConfig
from residnet.tasks.autopilot import AutopilotConfig
from residnet.tasks.breeding import BreedingTaskConfig
from residnet.tasks.course import CourseTaskConfig
from residnet.tasks.ferry_study import FerryStudyConfig
from residnet.tasks.fit import FitConfig
from residnet.tasks.force_residual import ForceResidualConfig
from residnet.tasks.import_logs import ImportConfig
from residnet.tasks.sea_trial import SeaTrialTaskConfig
from residnet.tasks.simulate import SimulateConfig
from residnet.tasks.study import StudyConfig

TaskConfig = Annotated[
    FitConfig
    | ImportConfig
    | SimulateConfig
    | StudyConfig
    | ActuatorsTaskConfig
    | AutopilotConfig
    | CourseTaskConfig
    | FerryStudyConfig
    | ForceResidualConfig
    | BreedingTaskConfig
    | SeaTrialTaskConfig,
    Field(discriminator="task"),
]
