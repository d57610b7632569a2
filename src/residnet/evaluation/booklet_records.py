"""Typed contents of booklet.json and indices.json: indices of manoeuvres."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from residnet.core.records import FileRecord, Record
from residnet.evaluation.records import Interval


class BookletIndex(Record):
    """A manoeuvring index.

    Attributes:
        value: index for the fitted parameters, in the scale of the logs.
        ship: index for the fitted parameters, in the scale of the ship.
        draws: number of parameter draws for which the index exists.
        interval: prediction interval over the draws and the model error of repeated trials.
        repeated_trials: number of repeated trials in the model error; absent if it is unknown.
        lengths: index in lengths of the hull.
        measured: index of the measured manoeuvre.
        difference: simulated minus measured index.
        limit: limit of IMO in the scale of the ship.
        kept: whether the limit is met.
        kept_share: share of the predictive distribution that meets the limit.
    """

    value: float
    ship: float
    draws: int
    interval: Interval | None = None
    repeated_trials: int | None = None
    lengths: float | None = None
    measured: float | None = None
    difference: float | None = None
    limit: float | None = None
    kept: bool | None = None
    kept_share: float | None = None


class BookletRow(Record):
    """Indices of one manoeuvre.

    Attributes:
        name: name of the manoeuvre or of the repeated log.
        manoeuvre: kind of manoeuvre.
        demand: settings of the manoeuvre.
        split: split of the repeated log; empty for a standard manoeuvre.
        faults: number of parameter draws that did not end the manoeuvre.
        indices: indices by name.
    """

    name: str
    manoeuvre: str
    demand: dict[str, JsonValue]
    split: str
    faults: int
    indices: dict[str, BookletIndex]


class BookletFile(FileRecord):
    """booklet.json: manoeuvring indices with intervals.

    Attributes:
        model: name of the model.
        length: length of the hull in m in the scale of the logs.
        scale: scale of the ship over the scale of the logs.
        draws: number of parameter draws.
        level: level of the intervals.
        units: unit of each index.
        pages: indices by manoeuvre.
        remarks: manoeuvres that the model could not complete, with their reasons.
    """

    schema_name: Literal["residnet.booklet/1"] = Field(alias="schema")
    model: str
    length: float
    scale: float
    draws: int
    level: float
    units: dict[str, str]
    pages: tuple[BookletRow, ...]
    remarks: tuple[str, ...] = ()


class IndexLimit(Record):
    """The limit of IMO of an index.

    Attributes:
        limit: the limit.
        kept: whether it is met.
    """

    limit: float
    kept: bool


class FlightIndices(Record):
    """Manoeuvring indices of one simulated manoeuvre.

    Attributes:
        log: name of the log.
        manoeuvre: kind of manoeuvre.
        craft: name of the vessel or model.
        fault: why the manoeuvre did not end as intended; None if it did.
        timed_out: whether it ended by its longest duration.
        indices: values by name in SI units and rad; a list for a spiral. `<name>_lengths` is an
            index in lengths of the hull.
        limits: limits of IMO by name of the index.
    """

    log: str
    manoeuvre: str
    craft: str
    fault: str | None
    timed_out: bool
    indices: dict[str, float | tuple[float, ...]]
    limits: dict[str, IndexLimit]

    @property
    def scalar_indices(self) -> dict[str, BookletIndex]:
        """The indices that are numbers, with their lengths and limits."""
        entries = {}
        for name, value in self.indices.items():
            if isinstance(value, tuple) or name.endswith("_lengths"):
                continue
            lengths = self.indices.get(f"{name}_lengths")
            limit = self.limits.get(name)
            entries[name] = BookletIndex(
                value=value,
                ship=value,
                draws=0,
                lengths=None if isinstance(lengths, tuple) else lengths,
                limit=None if limit is None else limit.limit,
                kept=None if limit is None else limit.kept,
            )
        return entries


class IndicesFile(FileRecord):
    """indices.json: manoeuvring indices of simulated manoeuvres.

    Attributes:
        run: name of the run.
        length: length of the hull in m; None if it is unknown.
        units: unit of each index.
        rows: indices by manoeuvre and vessel.
    """

    schema_name: Literal["residnet.indices/1"] = Field(alias="schema")
    run: str
    length: float | None
    units: dict[str, str]
    rows: tuple[FlightIndices, ...]
