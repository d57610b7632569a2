"""Published experiments whose figures a fit's report can show, found by name.

A study is registered like a head or a reader: residnet's own ones in a table, those of other
packages by the entry points `residnet.fit_studies`. It is imported when a config names it.
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
    {
        "moreno2019": "residnet.studies.moreno2019:Moreno2019Study",
        "woo2018": "residnet.studies.woo2018:Woo2018Study",
    },
    key="name",
)


def find_fit_study(name: str) -> FitStudy:
    """Return the study of a name.

    Raises:
        ValueError: if there is none, or the package that offers it is broken.
    """
    if name not in (study_names := FIT_STUDIES.kind_names()):
        raise ValueError(f"unknown value '{name}'{suggest_name(name, study_names)}")
    study_class = FIT_STUDIES.find_kind(name)
    if isinstance(study_class, EntryPointPart):
        raise ValueError(f"study {study_class.error_message}")
    study: FitStudy = study_class()
    return study
