"""Typed contents of excitation.json and data_quality.json: the logs of a fit."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from residnet.core.records import FileRecord, FileRows, Record
from residnet.evaluation.records import ByChannel


class InputExcitationRow(Record):
    """Excitation in the training logs of one input that is a regressor of the model.

    Attributes:
        name: name of the input.
        low: smallest value, SI.
        high: largest value, SI.
        std: standard deviation, SI.
        bandwidth: frequency in Hz below which 95 % of its power lies; None for a constant input.
        variance_inflation: ratio by which velocities and other inputs increase the variance of the
            estimated effect, by leave-one-log-out regression.
        feedback_source: quantity that a controller may have fed back; None if it cannot be
            assessed.
        feedback_share: share of the input that feedback explains beyond its effects.
        effect_share: share of the input that the velocities before and after it explain.
        state: excited; held at one value; set by feedback without excitation; or collinear with
            velocities and other inputs.
        text: the state in words.
    """

    name: str
    low: float
    high: float
    std: float
    bandwidth: float | None
    variance_inflation: float
    feedback_source: str | None
    feedback_share: float | None
    effect_share: float | None
    state: Literal["excited", "held", "feedback", "collinear"]
    text: str


class DirectionRow(Record):
    """Excitation of the sum or the difference of two inputs of the same kind.

    Attributes:
        name: the direction in words.
        inputs: names of the inputs.
        ratio: standard deviation relative to the larger one of sum and difference.
        is_excited: whether the logs excite the direction.
        text: the result in words.
    """

    name: str
    inputs: tuple[str, str]
    ratio: float
    is_excited: bool
    text: str


class ExcitationFile(FileRecord):
    """excitation.json: what the training logs excite, and feedback in training and test logs.

    Attributes:
        run: name of the run.
        inputs: inputs that are regressors of the model.
        directions: sums and differences of inputs of the same kind.
        closed_loop_test_inputs: inputs of the test logs that feedback sets.
        relay_inputs: inputs that the training logs switch between the ends of their ranges.
        domain: sentences on the relations of the operating domain.
    """

    schema_name: Literal["residnet.excitation/1"] = Field(alias="schema")
    run: str
    inputs: tuple[InputExcitationRow, ...]
    directions: tuple[DirectionRow, ...]
    closed_loop_test_inputs: tuple[str, ...]
    domain: tuple[str, ...]
    relay_inputs: tuple[str, ...] = ()


class LogQuality(Record):
    """The samples of one prepared log.

    Attributes:
        log: name of the log.
        split: train, validation, test or external.
        manoeuvre: kind of manoeuvre.
        seconds: duration in s.
        samples: number of samples.
        usable: share of the samples at which velocities and position are scored.
        learned_from: fraction of the samples that have smoothed states and accelerations, from
            which models learn.
        masked: share of the samples that each mask excludes.
        largest: largest magnitude of each state over the usable samples.
        integrated: pose channels that were integrated from the velocities.
    """

    log: str
    split: str
    manoeuvre: str
    seconds: float
    samples: int
    usable: float
    learned_from: float
    masked: ByChannel
    largest: ByChannel
    integrated: tuple[str, ...] = ()


class DataQualityFile(FileRows[LogQuality]):
    """data_quality.json: the samples of each log."""
