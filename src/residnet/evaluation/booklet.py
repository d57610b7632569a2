"""The manoeuvring booklet and the table of indices, with intervals and IMO limits."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import scipy
from pydantic import Field, field_validator

from residnet.core.config import Config, Metres, Quantity, Seconds
from residnet.core.errors import ConfigError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.evaluation.booklet_records import (
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
    which gives prediction intervals of the indices. Repeated trials show the error of the model's
    form, which widens the intervals (`add_model_error`); without two of them the intervals assume a
    correct form.

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
        indices: indices of each run that are numbers; empty for a failed or diverged run.
        limits: limits of IMO for the ship.
        measured_log: measured log that was repeated; None for a standard manoeuvre.
        split: split of that log.
        measured_indices: indices of that log.
    """

    name: str
    manoeuvre: Manoeuvre
    runs: Sequence[ManoeuvreRun]
    indices: Sequence[Mapping[str, float]]
    limits: Mapping[str, float]
    measured_log: Log | None
    split: str
    measured_indices: Mapping[str, float]


def select_scalar_indices(indices: Mapping[str, float | Sequence[float]]) -> dict[str, float]:
    """Return the indices that are numbers; those of a spiral are lists."""
    return {name: value for name, value in indices.items() if isinstance(value, int | float)}


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

    errors = [_model_errors(page) for page in pages]
    rows = [
        _page_row(
            page,
            # a repeated trial does not judge its own prediction
            [
                other_errors
                for other_page, other_errors in zip(pages, errors, strict=True)
                if other_page is not page and other_page.manoeuvre.kind == page.manoeuvre.kind
            ],
            length,
            scale,
            level,
        )
        for page in pages
    ]
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


class ModelError(NamedTuple):
    """Deviation of a repeated trial from the measured one in one index.

    Attributes:
        relative: logarithm of the predicted over the measured index; None unless both are positive.
        absolute: predicted minus measured index.
        relative_variance: variance of the logarithm over the parameter draws.
        absolute_variance: variance over the parameter draws.
    """

    relative: float | None
    absolute: float
    relative_variance: float
    absolute_variance: float


def _model_errors(page: BookletPage) -> dict[str, ModelError]:
    """Return the deviations of a repeated trial by index; empty for a standard manoeuvre."""
    errors = {}
    for name, measured in page.measured_indices.items():
        value = page.indices[0].get(name)
        # the approach speed is an initial condition
        if name not in INDEX_UNITS or name == "approach_speed" or value is None:
            continue
        draws = _index_draws(page, name)
        is_positive = measured > 0.0 and value > 0.0 and bool((draws > 0.0).all())
        errors[name] = ModelError(
            math.log(value / measured) if is_positive else None,
            float(value - measured),
            float(np.log(draws).var()) if is_positive and draws.size else 0.0,
            float(draws.var()) if draws.size else 0.0,
        )
    return errors


def _index_draws(page: BookletPage, name: str) -> np.ndarray:
    """Return an index of all parameter draws that have it."""
    return np.array([float(indices[name]) for indices in page.indices[1:] if name in indices])


_MIN_REPEATED = 2
"""Smallest number of repeated trials from which the model error of an index is estimated."""


def add_model_error(draws: np.ndarray, errors: Sequence[ModelError]) -> np.ndarray:
    """Return draws of an index that contain the model error as well as the parameters'.

    Repeated trials deviate from the measured ones by more than the parameters explain, if the form
    of the model is wrong. The standard deviation of this excess is a relative one for positive
    indices, and its uncertainty after n trials makes the error follow Student's t distribution with
    n degrees of freedom (a normal model with known mean zero and unknown variance).

    Args:
        draws: index by parameter draw [K].
        errors: deviations of repeated trials of the same kind of manoeuvre.

    Returns:
        Draws [K * Q], one for each draw and quantile of the model error; `draws` without errors.
    """
    if len(errors) < _MIN_REPEATED or not draws.size:
        return draws
    quantiles = scipy.stats.t.ppf((np.arange(_N_QUANTILES) + 0.5) / _N_QUANTILES, len(errors))
    relative = [error.relative for error in errors if error.relative is not None]
    if len(relative) == len(errors) and (draws > 0.0).all():
        variance = np.square(relative).mean() - np.mean([e.relative_variance for e in errors])
        widened: np.ndarray = draws[:, None] * np.exp(math.sqrt(max(variance, 0.0)) * quantiles)
        return widened.ravel()
    absolute = [error.absolute for error in errors]
    variance = np.square(absolute).mean() - np.mean([e.absolute_variance for e in errors])
    widened = draws[:, None] + math.sqrt(max(variance, 0.0)) * quantiles
    return widened.ravel()


_N_QUANTILES = 401
"""Number of quantiles that represent the model error; odd, so that one of them is zero."""


def _page_row(
    page: BookletPage,
    other_errors: Sequence[Mapping[str, ModelError]],
    length: float,
    scale: float,
    level: float,
) -> BookletRow:
    """Return the row of booklet.json of one manoeuvre: its indices with prediction intervals.

    Args:
        page: the manoeuvre and the indices of its nominal run and of the draws.
        other_errors: errors of the model in other repeated trials, by name of the index.
        length: length of the hull in m.
        scale: ratio of the lengths of the ship and the vessel.
        level: nominal coverage of the intervals.
    """
    names = [name for name in page.indices[0] if name in INDEX_UNITS]
    indices = {
        name: _index_summary(
            page, name, [by_name[name] for by_name in other_errors if name in by_name], length,
            scale, level,
        )
        for name in names
    }  # fmt: skip
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
    page: BookletPage,
    name: str,
    errors: Sequence[ModelError],
    length: float,
    scale: float,
    level: float,
) -> BookletIndex:
    """Return one index with its interval over draws and, where they are known, its references."""
    value = page.indices[0][name]
    draws = _index_draws(page, name)
    predictions = add_model_error(draws, errors)
    froude_factor = scale ** _FROUDE_EXPONENTS[INDEX_UNITS[name]]
    summary: dict[str, Any] = {
        "value": value,
        "ship": froude_factor * value,
        "draws": int(draws.size),
    }
    if draws.size:
        summary["interval"] = np.quantile(predictions, (0.5 - level / 2, 0.5 + level / 2)).tolist()
        if len(errors) >= _MIN_REPEATED:
            summary["repeated_trials"] = len(errors)
    if name in LENGTH_INDICES:
        summary["lengths"] = value / length
    if name in page.measured_indices:
        summary |= {
            "measured": page.measured_indices[name],
            "difference": value - page.measured_indices[name],
        }
    if name in page.limits:
        limit = page.limits[name]
        summary |= {
            "limit": limit,
            "kept": froude_factor * value <= limit,
            "kept_share": (
                float(np.mean(froude_factor * predictions <= limit)) if draws.size else None
            ),
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
