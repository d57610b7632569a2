"""The manoeuvring booklet and the table of indices, with intervals and IMO limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from pydantic import Field, field_validator

from residnet.core.config import Config, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.evaluation.records import (
    BookletFile,
    BookletIndex,
    BookletRow,
    FlightIndices,
    IndexLimit,
    IndicesFile,
)
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Manoeuvre
from residnet.manoeuvres.indices import INDEX_UNITS, LENGTH_INDICES
from residnet.manoeuvres.input_shares import InputShare

if TYPE_CHECKING:
    from residnet.manoeuvres.trials import ManoeuvreRun, SimulatedVessel

SCHEMA: Final = "residnet.booklet/1"
# exponent of the length scale that converts a unit from model to ship by Froude's law
_FROUDE_EXPONENTS = {"m": 1.0, "s": 0.5, "m/s": 0.5, "rad/s": -0.5, "rad": 0.0, "-": 0.0}


class BookletConfig(Config):
    """Settings of a manoeuvring booklet, simulated with one refitted baseline.

    Parameters are drawn from their posterior distribution. Every draw performs every manoeuvre,
    which gives prediction intervals of the indices. The intervals assume a correct model structure;
    they are too narrow if it is wrong.

    Attributes:
        model: name of the baseline.
        length: length of the hull in the scale of the logs, m.
        scale: scale ratio of ship and logs (Froude's law); 1 for full-scale logs.
        inputs: inputs of the model with their shares of propulsion command and steering command,
            limits and rates.
        initial: initial states by name.
        manoeuvres: standard manoeuvres.
        duration: duration of manoeuvres that define none, and time limit of the others.
        repeat: splits whose measured zigzags and turning circles are repeated in closed loop with
            the measured rudder angles and reversals.
        skip_failed: whether a manoeuvre that the model cannot complete is left out with a remark;
            otherwise it is an error.
        draws: number of parameter draws.
        level: level of the prediction intervals.
        seed: seed of the draws.
    """

    model: str
    length: Metres = Field(gt=0)
    scale: float = Field(default=1.0, gt=0)
    inputs: dict[str, InputShare]
    initial: dict[str, float | str] = Field(default_factory=dict)
    manoeuvres: tuple[ManoeuvreConfig, ...] = Field(min_length=1)
    duration: Seconds = Field(default=600.0, gt=0, le=86_400)
    repeat: tuple[str, ...] = ("validation", "test")
    skip_failed: bool = False
    draws: int = Field(default=100, ge=20, le=100_000)
    level: float = Field(default=0.95, gt=0, lt=1)
    seed: int = Field(default=0, ge=0)

    @field_validator("initial")
    @classmethod
    def convert_initial_units(cls, initial: dict[str, float | str]) -> dict[str, float | str]:
        return {
            name: Quantity(CHANNEL_UNITS.get(name, "-")).convert(value)
            for name, value in initial.items()
        }

    def steering_input(self) -> str:
        """Return the input that steers.

        Raises:
            ConfigError: if none or several inputs steer.
        """
        steering_inputs = [
            name for name, share in self.inputs.items() if share.steer not in (0, 0.0)
        ]
        if len(steering_inputs) != 1:
            raise ConfigError(
                f"booklet.inputs: one input must have a share in steer, given"
                f" {steering_inputs or 'none'}"
            )
        return steering_inputs[0]


@dataclass(frozen=True)
class BookletPage:
    """Results of one manoeuvre.

    Attributes:
        name: name of the page.
        manoeuvre: the simulated manoeuvre.
        runs: simulation with the estimated parameters, then with drawn ones.
        indices: indices of each run; empty for a failed or diverged run.
        limits: limits of IMO for the ship.
        measured_log: measured log that was repeated; None for a standard manoeuvre.
        split: split of that log.
        measured_indices: indices of that log.
    """

    name: str
    manoeuvre: Manoeuvre
    runs: Sequence[ManoeuvreRun]
    indices: Sequence[Mapping[str, Any]]
    limits: Mapping[str, float]
    measured_log: Log | None
    split: str
    measured_indices: Mapping[str, Any]


def build_booklet(
    model: str,
    length: float,
    scale: float,
    draws: int,
    level: float,
    pages: Sequence[BookletPage],
    remarks: Sequence[str] = (),
) -> BookletFile:
    """Return the contents of booklet.json in SI units and rad, in the scale of the logs.

    The `ship` value of an index is in the scale of the ship.

    Args:
        length: length of the hull in the scale of the logs, m.
        remarks: manoeuvres that are left out, with their reasons.
    """

    rows = [_page_row(page, length, scale, level) for page in pages]
    index_names = sorted({name for row in rows for name in row.indices})
    return BookletFile(
        schema=SCHEMA,
        model=model,
        length=length,
        scale=scale,
        draws=draws,
        level=level,
        units={name: INDEX_UNITS[name] for name in index_names},
        pages=tuple(rows),
        remarks=tuple(remarks),
    )


def _page_row(page: BookletPage, length: float, scale: float, level: float) -> BookletRow:
    names = [
        name
        for name, value in page.indices[0].items()
        if name in INDEX_UNITS and not isinstance(value, list)
    ]
    indices = {name: _index_summary(page, name, length, scale, level) for name in names}
    return BookletRow(
        name=page.name,
        manoeuvre=page.manoeuvre.kind,
        demand=page.manoeuvre.model_dump(mode="json"),
        split=page.split,
        # runs without indices diverged or did not reach their end; they are no part of the
        # intervals
        faults=sum(not run_indices for run_indices in page.indices[1:]),
        indices=indices,
    )


def _index_summary(
    page: BookletPage, name: str, length: float, scale: float, level: float
) -> BookletIndex:
    """Return one index with its interval over draws and, where they are known, its references."""
    value = float(page.indices[0][name])
    draws = np.array(
        [float(run_indices[name]) for run_indices in page.indices[1:] if name in run_indices]
    )
    froude_factor = scale ** _FROUDE_EXPONENTS[INDEX_UNITS[name]]
    summary: dict[str, Any] = {
        "value": value,
        "ship": froude_factor * value,
        "draws": int(draws.size),
    }
    if draws.size:
        summary["interval"] = np.quantile(draws, (0.5 - level / 2, 0.5 + level / 2)).tolist()
    if name in LENGTH_INDICES:
        summary["lengths"] = value / length
    if name in page.measured_indices:
        summary |= {
            "measured": float(page.measured_indices[name]),
            "difference": value - float(page.measured_indices[name]),
        }
    if name in page.limits:
        limit = page.limits[name]
        summary |= {
            "limit": limit,
            "kept": froude_factor * value <= limit,
            "kept_share": float(np.mean(froude_factor * draws <= limit)) if draws.size else None,
        }
    return BookletIndex.model_validate(summary)


INDICES_SCHEMA: Final = "residnet.indices/1"


def build_index_rows(
    vessel: SimulatedVessel, runs: Sequence[ManoeuvreRun], length: float | None
) -> list[FlightIndices]:
    """Return log, manoeuvre, vessel, fault, indices and limits of each simulated manoeuvre.

    Indices are in SI units and rad; each limit has a flag whether it is kept.

    Args:
        vessel: the simulated vessel.
        runs: simulated manoeuvres.
        length: length of the hull in m; None if unknown, then without lengths and limits.
    """
    rows = []
    for run in runs:
        indices = (
            {}
            if run.measured_log.meta.get("diverged")
            else run.manoeuvre.compute_indices(run.true_log, length)
        )
        speed = indices.get("approach_speed", 0.0)
        limits = (
            run.manoeuvre.imo_limits(vessel.helm, length, speed)
            if length is not None and speed > 0
            else {}
        )
        rows.append(
            FlightIndices(
                log=run.true_log.name,
                manoeuvre=run.manoeuvre.kind,
                craft=vessel.name,
                fault=run.fault_text,
                timed_out=bool(run.measured_log.meta.get("timed_out", False)),
                indices=indices,
                limits={
                    name: IndexLimit(limit=limit, kept=bool(indices[name] <= limit))
                    for name, limit in limits.items()
                    if name in indices
                },
            )
        )
    return rows


def build_indices_file(
    run: str, length: float | None, rows: Sequence[FlightIndices]
) -> IndicesFile:
    """Return the contents of indices.json."""
    index_names = {name for row in rows for name in row.indices}
    return IndicesFile(
        schema=INDICES_SCHEMA,
        run=run,
        length=length,
        units={name: INDEX_UNITS.get(name, "-") for name in sorted(index_names)},
        rows=tuple(rows),
    )
