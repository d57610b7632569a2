"""Assess which inputs and directions the training logs excite, for verdict, model card and trials.

The parametric model of the motion is linear in an input that no other regressor replaces. Its
information about an input is the part of the input that velocities, their products and the other
inputs do not explain; the variance inflation factor is the ratio by which the others increase the
variance of its coefficient (Belsley, Kuh and Welsch 1980). With feedback, this part is set by
disturbances instead, and the estimate is biased (Ljung, System Identification, 1999, chapter 13).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from residnet.core.format import display_unit, format_number
from residnet.core.layout import SURGE
from residnet.dynamics.domain_config import (
    OperatingDomain,
    describe_domain,
)
from residnet.evaluation.data_records import DirectionRow, ExcitationFile, InputExcitationRow
from residnet.identification.domain import MAX_VARIANCE_INFLATION, detect_feedback_of_logs
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PreparedLog
from residnet.quality.feedback import InputFeedback, cross_validated_r2, find_relay_inputs

SCHEMA = "residnet.excitation/1"
_HELD_SHARE: Final = 0.02
"""Standard deviation of an input relative to its magnitude, below which it counts as held."""
_MIN_DIRECTION_RATIO: Final = 0.05
"""Smallest standard deviation of a difference of two inputs relative to that of their sum."""


def assess_excitation(
    logs: Mapping[str, Sequence[PreparedLog]],
    signals: SignalsConfig,
    step: float,
    domain: OperatingDomain | None,
    run: str,
) -> ExcitationFile:
    """Assess excitation and feedback in the training logs, and feedback in the test logs.

    Args:
        logs: prepared logs by split.
        signals: inputs of the model.
        step: step of the grid in s.
        domain: operating domain of the training logs; None if it is unknown.
        run: name of the run.
    """
    training_logs = [log for log in logs["train"] if log.usable.any()]
    feedback_by_input = {
        feedback.name: feedback
        for feedback in detect_feedback_of_logs(logs["train"], signals, step)
    }
    test_feedback = detect_feedback_of_logs(logs.get("test", ()), signals, step)
    units = signals.channel_units()
    rows = [
        _assess_input(name, training_logs, signals, step, units[name], feedback_by_input.get(name))
        for name in signals.inputs
    ]
    return ExcitationFile.model_validate(
        {
            "schema": SCHEMA,
            "run": run,
            "inputs": [row.model_dump() for row in rows],
            "directions": [
                direction.model_dump() for direction in _assess_directions(training_logs, signals)
            ],
            "closed_loop_test_inputs": [
                feedback.name for feedback in test_feedback if feedback.is_closed_loop
            ],
            "domain": [] if domain is None else describe_domain(domain, units),
            "relay_inputs": _find_relay_inputs(training_logs, signals),
        }
    )


def _find_relay_inputs(logs: Sequence[PreparedLog], signals: SignalsConfig) -> list[str]:
    """Return the inputs that prepared logs switch between the ends of their ranges."""
    tables = [
        {name: log.w[log.usable, k] for k, name in enumerate(signals.input_columns)} for log in logs
    ]
    return find_relay_inputs(tables, signals.inputs) if tables else []


def _assess_input(
    name: str,
    logs: Sequence[PreparedLog],
    signals: SignalsConfig,
    step: float,
    unit: str,
    feedback: InputFeedback | None,
) -> InputExcitationRow:
    """Assess amplitude, bandwidth, collinearity and feedback of an input."""
    column = signals.input_columns.index(name)
    values = [log.w[log.usable, column] for log in logs]
    joined = np.concatenate(values)
    std = float(joined.std())
    magnitude = float(np.abs(joined).max())
    is_held = std <= _HELD_SHARE * magnitude
    others = [
        _explaining_columns(log, [k for k in range(len(signals.inputs)) if k != column])
        for log in logs
    ]
    inflation = 1.0
    if len(logs) > 1 and std > 0.0:
        explained = max(cross_validated_r2(others, values), 0.0)
        inflation = 1.0 / max(1.0 - explained, 1e-9)
    is_closed_loop = feedback is not None and feedback.is_closed_loop
    is_collinear = inflation > MAX_VARIANCE_INFLATION
    shown_unit, factor = display_unit(unit)
    if is_held:
        level = format_number(factor * float(np.median(joined)), 3)
        text = f"{name} was held at {level} {shown_unit}".removesuffix(" -")
    elif is_closed_loop and feedback is not None:
        text = (
            f"{name} was set by feedback from {feedback.source}, which explains"
            f" {100 * feedback.share:.0f} % of its variance beyond the velocities"
        )
    elif is_collinear:
        text = (
            f"{name} follows the velocities and the other inputs (variance inflation"
            f" {format_number(inflation, 2)})"
        )
    else:
        text = f"{name} was excited (variance inflation {format_number(inflation, 2)})"
    return InputExcitationRow(
        name=name,
        low=float(joined.min()),
        high=float(joined.max()),
        std=std,
        bandwidth=_bandwidth(values, step),
        variance_inflation=inflation,
        feedback_source=None if feedback is None else feedback.source,
        feedback_share=None if feedback is None else feedback.share,
        effect_share=None if feedback is None else feedback.effect_share,
        state="held"
        if is_held
        else "feedback"
        if is_closed_loop
        else "collinear"
        if is_collinear
        else "excited",
        text=text,
    )


def _explaining_columns(log: PreparedLog, other_inputs: Sequence[int]) -> np.ndarray:
    """Return velocities, their products and other inputs at the usable samples [K, c]."""
    velocities = log.smoothed[log.usable, SURGE : SURGE + log.dof.n_dynamic]
    pairs = itertools.combinations_with_replacement(range(velocities.shape[1]), 2)
    products = [velocities[:, i] * velocities[:, j] for i, j in pairs]
    others = log.w[log.usable][:, list(other_inputs)]
    return np.column_stack((velocities, *products, others, others * np.abs(others)))


def _bandwidth(values: Sequence[np.ndarray], step: float) -> float | None:
    """Return the frequency in Hz below which 95 % of the power of an input lies."""
    longest = max(values, key=len)
    if len(longest) < 20 or longest.std() == 0.0:
        return None
    power = np.abs(np.fft.rfft(longest - longest.mean())[1:]) ** 2
    cumulative = np.cumsum(power)
    index = 1 + int(np.searchsorted(cumulative, 0.95 * cumulative[-1]))
    return float(index / (len(longest) * step))


_DIRECTION_WORDS: Final = {"n": "thrust", "thrust": "thrust", "delta": "rudder", "tau": "force"}


def _assess_directions(logs: Sequence[PreparedLog], signals: SignalsConfig) -> list[DirectionRow]:
    """Assess sums and differences of inputs of the same kind, and of unexcited ones."""
    names = (*signals.inputs, *signals.unexcited)
    joined = {
        name: np.concatenate([log.w[log.usable, signals.input_columns.index(name)] for log in logs])
        for name in names
    }
    rows = []
    for first, second in itertools.combinations(names, 2):
        stem = first.split("_")[0]
        if stem != second.split("_")[0] or first == second:
            continue
        kind = _DIRECTION_WORDS.get(stem, stem)
        common = float((joined[first] + joined[second]).std())
        difference = float((joined[first] - joined[second]).std())
        largest = max(common, difference, 1e-12)
        for word, std in (("common", common), ("differential", difference)):
            is_excited = std >= _MIN_DIRECTION_RATIO * largest
            rows.append(
                DirectionRow(
                    name=f"{word} {kind} of {first} and {second}",
                    inputs=(first, second),
                    ratio=std / largest,
                    is_excited=is_excited,
                    text=f"{word} {kind} of {first} and {second}:"
                    f" {'excited' if is_excited else 'not excited'}",
                )
            )
    return rows
