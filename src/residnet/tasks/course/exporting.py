"""The exports of a course run: a policy with the guidance of each of its courses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from residnet.control.courses.config import PlannedCourse
from residnet.control.courses.course_check import Protocol
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.heading.keeper import HeadingKeeper
from residnet.core.errors import ExportError
from residnet.runs.folder import RunFolder
from residnet.tasks.autopilot.config import AutopilotSettings
from residnet.tasks.course.autopilot_run import load_policy, ready
from residnet.tasks.course.config import CourseSettings
from residnet.tasks.course.guided import plan_for

_SAME = 1e-6
"""Largest difference of a course planned again from the one that was flown, as a share."""


class CourseExport(NamedTuple):
    """A policy with the guidance along one plan, to be exported when the run ends.

    Attributes:
        folder: where files go.
        config: of the course.
        planned: the plan of one protocol.
        guidance: along it.
        policy: at the step of the course.
        autopilot: config of the policy's own run.
    """

    folder: Path
    config: CourseSettings
    planned: PlannedCourse
    guidance: CourseGuidance
    policy: HeadingKeeper
    autopilot: AutopilotSettings

    @property
    def name(self) -> str:
        """Name of the file without its ending."""
        return f"{self.config.policy}_{self.planned.protocol}"

    def write(self, rows: Sequence[dict[str, Any]]) -> Path:
        """Export, with the policy's rows of metrics.json in the card; returns the file."""
        from residnet.export.policy import ExportedCoursePolicy
        from residnet.export.torchscript import TorchScriptExporter

        config, protocol = self.config, self.planned.protocol
        file = self.folder / f"{self.name}.pt"
        about = {
            "vessel": self.autopilot.vessel,
            "course": config.course.model_dump(mode="json"),
            "protocol": protocol,
        }
        metrics = [
            row for row in rows if row["protocol"] == protocol and row["model"] == config.policy
        ]
        exported = ExportedCoursePolicy(
            config.policy,
            self.policy,
            self.guidance,
            self.planned.course,
            safe=config.safe,
            about=about,
            metrics=metrics,
        )
        TorchScriptExporter().export(exported, file)
        return file


def export_as(
    file_format: str,
    config: CourseSettings,
    run: RunFolder,
    protocol: Protocol,
    scripted: Path,
    out: Path | None,
) -> Path:
    """Write a policy with the guidance of a course, planned again; returns the file.

    Args:
        file_format: one of `residnet list formats`.
        config: of the course.
        run: its folder.
        protocol: that the course was planned by.
        scripted: the TorchScript file, whose card the new file takes.
        out: where to write; None for beside the TorchScript file.

    Raises:
        ExportError: where the plan is not the one that was flown, or the file does not reproduce
            policy and guidance.
    """
    import torch

    from residnet.export import exporter
    from residnet.export.policy import ExportedCoursePolicy

    chosen, extra = exporter(file_format), {"card.json": ""}
    torch.jit.load(str(scripted), _extra_files=extra)
    card = json.loads(extra["card.json"])
    known = ready(config, run)
    planned, guidance = plan_for(config, known, protocol)
    length = planned.course.length
    if not abs(length - card["length"]) <= _SAME * length:
        raise ExportError(
            f"{scripted}: its course has {card['length']:.3f} m, planned again {length:.3f} m;"
            " carry the run out again with this version"
        )
    file = out or scripted.with_name(f"{scripted.stem}{chosen.suffix}")
    exported = ExportedCoursePolicy(
        scripted.stem,
        load_policy(known, config.policy),
        guidance,
        planned.course,
        safe=config.safe,
        about=card,
        metrics=card["metrics"],
    )
    chosen.export(exported, file)
    return file
