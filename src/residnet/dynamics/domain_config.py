"""Configuration of the operating domain of a model; `residnet.dynamics.domain` applies it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Final, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.format import display_unit, format_number

MAX_TABLE_BYTES: Final = 16_384
"""Largest size of the tables of a domain in exported C code, in double precision."""


class InputRelation(Config):
    """Relation of an input to channels of the logs: offset + sum of gains times channels.

    Attributes:
        input: name of the input.
        kind: held at one value; proportional to another input; or set by a controller.
        offset: constant term, SI.
        channels: velocities and inputs that it follows.
        gains: gain of each channel, SI.
        heading: reference of the heading in rad; None if the input does not follow the heading.
        heading_gain: gain of the sine of the heading relative to the reference.
        max_heading: largest deviation of the heading from the reference in rad.
        tolerance: largest deviation of the input from the relation, SI.
    """

    input: str
    kind: Literal["held", "proportional", "feedback"]
    offset: float
    channels: tuple[str, ...] = ()
    gains: tuple[float, ...] = ()
    heading: float | None = None
    heading_gain: float = 0.0
    max_heading: float = Field(default=math.pi, gt=0)
    tolerance: float = Field(gt=0)

    @model_validator(mode="after")
    def _validate_lengths(self) -> InputRelation:
        if len(self.channels) != len(self.gains):
            raise ValueError("gains: expected one for each of channels")
        return self


class OperatingDomain(Config):
    """Relations and density of the training logs, with which `outside` is computed.

    Attributes:
        channels: velocities and inputs of the density.
        centre: mean of each channel, SI.
        scale: standard deviation of each channel, SI.
        factor: square matrix F by rows with q = |F v|^2.
        limit: largest q of the domain.
        false_flags: share of samples of held-out training logs outside the domain.
        n_logs: number of training logs.
        range_margins: margin of the training range on both sides by velocity and input, SI; no
            margin for other channels.
        relations: relations of inputs.
        is_closed_loop_only: whether a controller without a reference that the model can see set an
            input, so that no sample can be said to lie in the domain.
    """

    channels: tuple[str, ...] = ()
    centre: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()
    factor: tuple[float, ...] = ()
    limit: float = Field(default=1.0, gt=0)
    false_flags: float = Field(default=0.0, ge=0, le=1)
    n_logs: int = Field(ge=1)
    range_margins: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    relations: tuple[InputRelation, ...] = ()
    is_closed_loop_only: bool = False

    @model_validator(mode="after")
    def _validate_sizes(self) -> OperatingDomain:
        n_channels = len(self.channels)
        if len(self.centre) != n_channels or len(self.scale) != n_channels:
            raise ValueError("centre, scale: expected one number for each of channels")
        n_features = math.isqrt(len(self.factor))
        if n_features**2 != len(self.factor) or n_features not in {
            0,
            count_features(n_channels, 1),
            count_features(n_channels, 2),
        }:
            raise ValueError("factor: expected a square matrix of the monomials of channels")
        return self

    @property
    def degree(self) -> int:
        """Degree of the monomials; 0 without a density."""
        n_features = math.isqrt(len(self.factor))
        if n_features == 0:
            return 0
        return 1 if n_features == count_features(len(self.channels), 1) else 2


def describe_domain(domain: OperatingDomain, units: Mapping[str, str]) -> list[str]:
    """Return sentences on the relations of a domain.

    Args:
        domain: the domain.
        units: SI unit of each state and input.
    """

    def quantity(value: float, name: str) -> str:
        unit, factor = display_unit(units.get(name, "-"))
        return f"{format_number(factor * value, 3)} {unit}".removesuffix(" -")

    sentences = []
    for relation in domain.relations:
        name = relation.input
        tolerance = quantity(relation.tolerance, name)
        if relation.kind == "held":
            sentences.append(
                f"{name} was held at {quantity(relation.offset, name)} (tolerance {tolerance}): its"
                " effect is unknown."
            )
        elif relation.kind == "proportional":
            terms = " + ".join(
                f"{format_number(gain, 3)} {channel}"
                for channel, gain in zip(relation.channels, relation.gains, strict=True)
            )
            # rounding errors are no offset
            is_negligible = abs(relation.offset) < 1e-6 * relation.tolerance
            sign = "+" if relation.offset >= 0 else "-"
            offset_text = "" if is_negligible else f" {sign} {quantity(abs(relation.offset), name)}"
            sentences.append(
                f"{name} was {terms}{offset_text} (tolerance {tolerance}): the effect of a"
                f" difference between {name} and {', '.join(relation.channels)} is unknown."
            )
        else:
            sentences.append(
                f"{name} was set by a controller: {format_number(relation.heading_gain, 3)} times"
                f" the sine of the heading relative to"
                f" {math.degrees(relation.heading or 0.0):.1f} deg (tolerance {tolerance}); the"
                " model holds for operation under the same controller only."
            )
    if domain.is_closed_loop_only:
        sentences.append(
            "An input was set by a controller whose reference the model cannot see: every step is"
            " flagged as outside."
        )
    return sentences


def count_features(n_channels: int, degree: int) -> int:
    """Return the number of monomials of some channels up to degree 1 or 2."""
    return 1 + n_channels + (n_channels * (n_channels + 1) // 2 if degree == 2 else 0)
