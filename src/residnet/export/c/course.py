"""A heading policy with the guidance of a course as a C99 source file and header."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from residnet.control.courses.course_plan import Course
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.heading.keeper import HeadingKeeper
from residnet.export.c.policy import export_policy
from residnet.export.course import MEASURED, ExportedCourse, check_parity


def export_course_as_c(
    name: str,
    policy: HeadingKeeper,
    guidance: CourseGuidance,
    course: Course,
    file: Path,
    *,
    safe: Literal["hold", "amidships"],
    card: Mapping[str, Any],
) -> None:
    """Write a policy with the guidance of a course as C, in double precision.

    Args:
        name: of the policy and its course.
        policy: at the step that it shall run with.
        guidance: of the course.
        course: that parity is checked along.
        file: the .c file.
        safe: command while inputs are wrong: the last one, or rudder amidships.
        card: of the course's TorchScript file.

    Raises:
        ExportError: where the C file does not reproduce policy and guidance.
    """
    module = ExportedCourse(policy, guidance, safe).eval()
    export_policy(
        name,
        module,
        [("y", len(MEASURED)), ("s", module.memory_low.numel())],
        ["command", "s_after", "fault", "arrived"],
        card,
        file,
        lambda exported: check_parity(name, module, exported, course),
        double=True,
    )
