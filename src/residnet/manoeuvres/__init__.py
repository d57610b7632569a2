"""Manoeuvres, one file each: the manoeuvre, its source of inputs, and the family that draws it at random."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from residnet.manoeuvres.acceleration_deceleration import AccelerationDeceleration, AccelerationDecelerationFamily
from residnet.manoeuvres.base import Helm, Manoeuvre, StackedSource
from residnet.manoeuvres.constant import ConstantFamily, ConstantInput
from residnet.manoeuvres.three_two_one_one import ThreeTwoOneOne, ThreeTwoOneOneFamily
from residnet.manoeuvres.zigzag import Zigzag, ZigzagFamily

ManoeuvreConfig = Annotated[ConstantInput | Zigzag | AccelerationDeceleration | ThreeTwoOneOne, Field(discriminator="kind")]
FamilyConfig = Annotated[ConstantFamily | ZigzagFamily | AccelerationDecelerationFamily | ThreeTwoOneOneFamily, Field(discriminator="kind")]

__all__ = [
    "AccelerationDeceleration",
    "ConstantInput",
    "FamilyConfig",
    "Helm",
    "Manoeuvre",
    "ManoeuvreConfig",
    "StackedSource",
    "ThreeTwoOneOne",
    "Zigzag",
]
