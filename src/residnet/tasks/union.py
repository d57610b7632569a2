"""All kinds of run, those of other packages included; each is imported when a config names it."""

from __future__ import annotations

from typing import Annotated

from residnet.core.registry import Kinds
from residnet.runs.task import Task

_DOCUMENTS = "residnet.documents"
SINGLE = {
    "fit": "residnet.tasks.fit.task:FitConfig",
    "import": "residnet.tasks.import_logs:ImportConfig",
    "simulate": "residnet.tasks.simulate:SimulateConfig",
    "study": "residnet.tasks.study:StudyConfig",
    "actuators": "residnet.tasks.actuators:ActuatorsTaskConfig",
    "autopilot": "residnet.tasks.autopilot.task:AutopilotConfig",
    "course": "residnet.tasks.course.task:CourseTaskConfig",
    "ferry_study": f"{_DOCUMENTS}.jervan2020.ferry:FerryStudyConfig",
    "force_residual": f"{_DOCUMENTS}.jervan2020.measured:ForceResidualConfig",
    "breeding": f"{_DOCUMENTS}.halvorsen2019.breeding:BreedingTaskConfig",
    "sea_trial": f"{_DOCUMENTS}.halvorsen2019.sea_trial:SeaTrialTaskConfig",
}
"""All but the sweep, which varies any of these."""

TaskConfig = Annotated[
    Task,
    Kinds(
        "residnet.tasks",
        Task,
        {**SINGLE, "sweep": "residnet.tasks.sweep.task:SweepTaskConfig"},
        key="task",
    ),
]
SweepableConfig = Annotated[Task, Kinds("residnet.tasks", Task, SINGLE, key="task")]
