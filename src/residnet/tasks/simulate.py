"""Task `simulate`: sea trials of a vessel, a learned model or both: canonical logs, manoeuvring
indices and figures.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, model_validator

from residnet.core.config import Config, dump_config
from residnet.core.errors import DataError
from residnet.data.simulated.flying import Craft, Flight
from residnet.data.simulated.trials import SimulatedTrials, fly_trials, trials_craft
from residnet.manoeuvres import Replay
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.tasks.programme import Programme

_PRINTED = 24


class SimulateConfig(Config):
    """Simulated trials with their indices and figures; give `programme` or `data`.

    Attributes:
        name: of the run.
        programme: a list of manoeuvres on a vessel, a learned model, or both: logs/<log>.parquet,
            those of a model beside a vessel in model_logs.
        data: trials as the task `fit` draws and splits them: logs/<split>/<log>.parquet.
    """

    task: Literal["simulate"]
    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
    programme: Programme | None = None
    data: SimulatedTrials | None = None

    @model_validator(mode="after")
    def _one(self) -> SimulateConfig:
        if (self.programme is None) == (self.data is None):
            raise ValueError(
                "give programme (manoeuvres on a vessel or a model) or data (trials with splits),"
                " one of the two"
            )
        return self

    def check(self) -> None:
        """What reading the config does not show: that models and logs are there and fit the
        manoeuvres.

        Raises:
            ResidnetError: where they do not.
        """
        if self.programme is not None:
            self.programme.check()

    def run(
        self, *, source: Path, overrides: Sequence[str], out: Path | None, resume: bool
    ) -> RunFolder:
        """Fly, write logs, indices and figures, print the indices.

        Raises:
            UsageError: where the folder exists or something cannot fly the manoeuvres.
            DataError: where a manoeuvre of the list did not reach its stop condition; everything
                has been written by then.
        """
        from residnet.judge.index_table import contents, index_rows, table
        from residnet.report.figures.flights import draw_flights

        started = time.time()
        self.check()
        folder = RunFolder.create(out or Path("runs") / self.name, dump_config(self), resume=resume)
        flown, places, length, seed = (
            self._drawn() if self.programme is None else self._listed(self.programme)
        )
        count = 0
        for place, flights in places.items():
            (folder.path / place).mkdir(parents=True, exist_ok=True)
            for flight in flights:
                flight.log.save(folder.path / place / f"{flight.log.name}.parquet")
                count += 1
        rows = [row for craft, flights in flown for row in index_rows(craft, flights, length)]
        folder.write_json(folder.path / "indices.json", contents(self.name, length, rows))
        text = table(rows)
        folder.write(folder.path / "indices.txt", text + "\n")
        figures = draw_flights(folder.figures, {craft.name: flights for craft, flights in flown})
        folder.write_provenance(
            config=source, overrides=overrides, seed=seed, files=self._files(), started=started
        )
        print(
            text
            if len(rows) <= _PRINTED
            else f"indices of {len(rows)} manoeuvres: {folder.path / 'indices.txt'}"
        )
        print(
            f"{count} logs in {folder.path / 'logs'}, indices in {folder.path / 'indices.json'},"
            f" {len(figures)} figures in {folder.figures}"
        )
        self._report_faults(flown)
        return folder

    def _drawn(
        self,
    ) -> tuple[list[tuple[Craft, list[Flight]]], dict[str, list[Flight]], float, int]:
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
            self.data.seed,
        )

    def _listed(
        self, programme: Programme
    ) -> tuple[list[tuple[Craft, list[Flight]]], dict[str, list[Flight]], float | None, int]:
        flown = [(craft, programme.fly(craft, sea)) for craft, sea in programme.crafts()]
        places = dict(zip(("logs", "model_logs"), (flights for _, flights in flown), strict=False))
        return flown, places, programme.hull_length, programme.seed

    def _files(self) -> list[Path]:
        if self.programme is None:
            return []
        files = [
            manoeuvre.log
            for manoeuvre in self.programme.manoeuvres
            if isinstance(manoeuvre, Replay)
        ]
        model = self.programme.model
        return (
            files
            if model is None
            else [*files, *sorted((model.run / "models" / model.chosen).glob("model.*"))]
        )

    def _report_faults(self, flown: Sequence[tuple[Craft, Sequence[Flight]]]) -> None:
        """Name the flights that did not end as they should; only those that the config lists are an
        error.
        """
        listed = len(self.programme.manoeuvres) if self.programme is not None else 0
        faults = [
            (i < listed, f"{craft.name}, {f.log.name}: {f.fault}")
            for craft, flights in flown
            for i, f in enumerate(flights)
            if f.fault
        ]
        wrong = [fault for own, fault in faults if own]
        for fault in [fault for own, fault in faults if not own] + wrong[:-1]:
            print(f"residnet: {fault}", file=sys.stderr)
        if wrong:
            flights_count = sum(len(flights) for _, flights in flown)
            raise DataError(
                f"{wrong[-1]} ({len(wrong)} of {flights_count} flights did not end as they should;"
                " give more duration, drive or steer)"
            )
