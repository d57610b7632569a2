"""Task `breeding`: how often genetic programming finds an equation (document 000, chapter 5)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from residnet.core.config import load_config
from residnet.core.files import read_json
from residnet.documents.halvorsen2019.breeding.config import BreedingSettings
from residnet.report.blocks import Section
from residnet.runs.folder import RunFolder
from residnet.runs.task import MainFigure, Outcome

FILE = "study.json"


@final
class BreedingTaskConfig(BreedingSettings):
    """A search for the equation with every combination of two settings, several times each.

    Attributes:
        task: `breeding`.
    """

    task: Literal["breeding"]

    def check(self) -> None:
        """Check that DEAP is there.

        Raises:
            UsageError: where it is not installed.
        """
        from residnet.regression.genetic.evolution import require_deap

        require_deap()

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Search with every combination, and write study.json and figures/study.png.

        Raises:
            ResidnetError: where DEAP is not installed or the data do not determine an equation.
        """
        from residnet.documents.halvorsen2019.breeding.report import (
            draw,
            least,
            main_figures,
            verdict,
        )
        from residnet.documents.halvorsen2019.breeding.search import search_table

        rows = search_table(self)
        content = {
            "schema": "residnet.breeding/1",
            "run": self.name,
            "keys": (self.rows.key, self.columns.key),
            "rows": rows,
            "least": {str(row["row"]): row["column"] for row in least(self, rows)},
        }
        folder.write_json(folder.path / FILE, content)
        folder.figures.mkdir(exist_ok=True)
        draw(self, rows, folder.figures / "study.png")
        figures = {name: MainFigure(*value) for name, value in main_figures(self, rows).items()}
        return Outcome(verdict(self, rows), figures)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return the sections of the report, from the run folder alone."""
        from residnet.documents.halvorsen2019.breeding.report import sections

        config = load_config(run.resolved, [], cls)
        return sections(config, read_json(run.path / FILE)["rows"], run.path)
