"""Task `simulate`: sea trials as canonical logs, with manoeuvring indices and figures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import model_validator

from residnet.core.progress import say
from residnet.data.simulated.flying import Craft, Flight
from residnet.data.simulated.trials import SimulatedTrials, fly_trials, stand_ins, trials_craft
from residnet.manoeuvres.replay import Replay
from residnet.physics.vessel import load_vessel
from residnet.report.blocks import Section
from residnet.report.figure import write_figures
from residnet.report.run_reader import RunFiles
from residnet.report.sections.manoeuvres import indices_text, sections
from residnet.runs.folder import RunFolder
from residnet.runs.task import ComputingTask, MainFigure, Outcome
from residnet.tasks.programme import Programme

_SHOWN = 24
"""Manoeuvres whose indices are shown on the terminal; more stand in a file."""


class SimulateConfig(ComputingTask):
    """Simulated trials with their indices and figures; give `programme` or `data`.

    Attributes:
        programme: a list of manoeuvres on a vessel, a learned model, or both: logs/<log>.parquet,
            those of a model beside a vessel in model_logs.
        data: trials as the task `fit` draws and splits them: logs/<split>/<log>.parquet.
    """

    task: Literal["simulate"]
    programme: Programme | None = None
    data: SimulatedTrials | None = None

    @model_validator(mode="after")
    def _one(self) -> SimulateConfig:
        if (self.programme is None) == (self.data is None):
            raise ValueError(
                "give programme (manoeuvres on a vessel or a model) or data (trials with splits),"
                " one of the two"
            )
        if self.data is not None:
            self.data.splits(self.data.draw())
        return self

    def check(self) -> None:
        """Check that models and logs are there and fit the manoeuvres.

        Raises:
            ResidnetError: where they do not.
        """
        if self.programme is not None:
            self.programme.check()
        if self.data is not None:
            stand_ins(self.data)

    def input_files(self) -> list[Path]:
        """Return the logs that are replayed, and the files of the learned model."""
        if self.programme is None:
            return []
        files = [
            manoeuvre.log
            for manoeuvre in self.programme.manoeuvres
            if isinstance(manoeuvre, Replay)
        ]
        model = self.programme.model
        if model is None:
            return files
        return [*files, *sorted((model.run / "models" / model.chosen).glob("model.*"))]

    def recorded_seed(self) -> int:
        """Return the seed of everything random in the trials."""
        given = self.programme or self.data
        assert given is not None
        return given.seed

    def carry_out(self, folder: RunFolder) -> Outcome:
        """Fly the manoeuvres, and write logs, indices and figures.

        Raises:
            UsageError: where something cannot fly the manoeuvres.
        """
        from residnet.judge.booklet import index_contents, index_rows
        from residnet.report.sections.manoeuvres import flight_figures

        flown, places, length = (
            self._drawn() if self.programme is None else self._listed(self.programme)
        )
        count = 0
        for place, flights in places.items():
            for flight in flights:
                flight.log.save(folder.path / place / f"{flight.log.name}.parquet")
                count += 1
        rows = [row for craft, flights in flown for row in index_rows(craft, flights, length)]
        content = index_contents(self.name, length, rows)
        folder.write_json(folder.path / "indices.json", content)
        figures = flight_figures({craft.name: flights for craft, flights in flown})
        write_figures(folder.figures, figures)
        faults = [row for row in rows if row["fault"]]
        ended = (
            f"{len(faults)} of {count} manoeuvres did NOT end as they should"
            if faults
            else f"All {count} manoeuvres ended as they should"
        )
        verdict = [
            f"{ended}; they were flown by {' and '.join(craft.name for craft, _ in flown)}, and"
            " their logs are in the folder logs."
        ]
        verdict += [f"{row['craft']}, {row['log']}: {row['fault']}." for row in faults[:5]]
        return Outcome(
            verdict,
            {"logs": MainFigure(count), "flights_with_a_fault": MainFigure(len(faults))},
            indices_text(content) if len(rows) <= _SHOWN else "",
            self._failure(flown),
        )

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        """Return the tables of manoeuvring indices; the figures are those of the run."""
        return sections(RunFiles(run.path))

    def _drawn(
        self,
    ) -> tuple[list[tuple[Craft, list[Flight]]], dict[str, list[Flight]], float]:
        assert self.data is not None
        manoeuvres = self.data.draw()
        flights = fly_trials(manoeuvres, self.data)
        places: dict[str, list[Flight]] = {"logs/train": [], "logs/validation": [], "logs/test": []}
        for flight, split in zip(flights, self.data.splits(manoeuvres), strict=True):
            places[f"logs/{split}"].append(flight)
        return (
            [(trials_craft(self.data), flights)],
            places,
            load_vessel(self.data.vessel).length.value,
        )

    def _listed(
        self, programme: Programme
    ) -> tuple[list[tuple[Craft, list[Flight]]], dict[str, list[Flight]], float | None]:
        flown = [(craft, programme.fly(craft, sea)) for craft, sea in programme.crafts()]
        places = dict(zip(("logs", "model_logs"), (flights for _, flights in flown), strict=False))
        return flown, places, programme.hull_length

    def _failure(self, flown: Sequence[tuple[Craft, Sequence[Flight]]]) -> str:
        """Return a line where flights did not end as they should.

        Flights that were drawn at random may do so; only those that the config lists are a failure.
        """
        listed = len(self.programme.manoeuvres) if self.programme is not None else 0
        failures: list[str] = []
        for craft, flights in flown:
            for number, flight in enumerate(flights):
                if not flight.fault:
                    continue
                line = f"{craft.name}, {flight.log.name}: {flight.fault}"
                if number < listed:
                    failures.append(line)
                else:
                    say(line)
        if not failures:
            return ""
        # the last one is the error itself
        for line in failures[:-1]:
            say(line)
        count = sum(len(flights) for _, flights in flown)
        return (
            f"{failures[-1]} ({len(failures)} of {count} flights did not end as they should; give"
            " more duration, drive or steer)"
        )
