"""Registry of published experiments whose figures the report of a fit can show.

A study is registered by the entry point group `residnet.fit_studies` of a wing or of another
package. It is imported on first use.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

from residnet.core.names import suggest_name
from residnet.core.registry import EntryPointPart, PluginUnion

if TYPE_CHECKING:
    from residnet.report.blocks import Section
    from residnet.report.run_reader import RunFiles


class FitStudy(ABC):
    """A published experiment that a fit repeats.

    Attributes:
        name: value of the config key `study`.
        models: names of the models that the fit must have.
    """

    name: ClassVar[str]
    models: ClassVar[tuple[str, ...]]

    @abstractmethod
    def sections(self, run: RunFiles) -> Sequence[Section]:
        """Draw the figures of the study into a finished run and return its sections of the report.

        Raises:
            UsageError: if the run lacks a protocol or a manoeuvre of the study.
        """


FIT_STUDIES = PluginUnion(
    "residnet.fit_studies",
    "residnet.report.fit_studies:FitStudy",
    {},
    key="name",
)


def find_fit_study(name: str) -> FitStudy:
    """Return the study with the given name.

    Raises:
        ValueError: if no study has this name or its package cannot be imported.
    """
    if name not in (study_names := FIT_STUDIES.kind_names()):
        raise ValueError(f"unknown value '{name}'{suggest_name(name, study_names)}")
    study_class = FIT_STUDIES.find_kind(name)
    if isinstance(study_class, EntryPointPart):
        raise ValueError(f"study {study_class.error_message}")
    study: FitStudy = study_class()
    return study
