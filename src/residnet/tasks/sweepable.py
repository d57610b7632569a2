"""All kinds of run that a sweep can vary: every one but a sweep itself."""

from __future__ import annotations

from typing import Annotated

from residnet.core.config import Config
from residnet.core.registry import Kinds
from residnet.documents.halvorsen2019.breeding.task import BreedingTaskConfig
from residnet.documents.halvorsen2019.sea_trial.task import SeaTrialTaskConfig
from residnet.documents.jervan2020.ferry.task import FerryStudyConfig
from residnet.documents.jervan2020.measured.task import ForceResidualConfig
from residnet.tasks.actuators import ActuatorsTaskConfig
from residnet.tasks.autopilot.task import AutopilotConfig
from residnet.tasks.course.task import CourseTaskConfig
from residnet.tasks.fit import FitConfig
from residnet.tasks.import_logs import ImportConfig
from residnet.tasks.simulate import SimulateConfig
from residnet.tasks.study import StudyConfig

SingleTask = (
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
    | SeaTrialTaskConfig
)

SweepableConfig = Annotated[SingleTask, Kinds("residnet.tasks", Config, key="task")]
