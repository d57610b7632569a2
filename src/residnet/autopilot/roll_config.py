"""Settings of roll reduction: seas, hull, cost, tuning and training; PyTorch is not imported."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from pydantic import Field

from residnet.core.config import Config, Metres
from residnet.physics.environment_config import HullBoxConfig, WavesConfig
from residnet.training.config import OneStage

SEA_STATES: Final[Mapping[int, tuple[float, float]]] = {
    3: (0.88, 7.5),
    4: (1.88, 8.8),
    5: (3.25, 9.7),
}
"""Significant wave height in m and most probable peak period in s (open North Atlantic; NATO STANAG
4194, S. L. Bales, 1983).
"""
HEADINGS_DEG: Final = (0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0)
"""Directions of propagation relative to the course: 0 deg following, 180 deg head seas."""
GAIN_NAMES: Final = (
    "heading_gain",
    "yaw_rate_gain",
    "filter_share",
    "rudder_roll_rate_gain",
    "rudder_roll_gain",
    "fin_roll_rate_gain",
    "fin_roll_gain",
)
"""Constants of the classical law: heading PD with a low-pass filter, rudder and fin PD in roll."""
HEADING_ONLY: Final = "heading"
"""Heading control alone with fins amidships, to which all reductions refer."""
COMBINATIONS: Final[Mapping[str, tuple[str, ...]]] = {
    HEADING_ONLY: GAIN_NAMES[:3],
    "rudder": GAIN_NAMES[:5],
    "fins": (*GAIN_NAMES[:3], *GAIN_NAMES[5:]),
    "both": GAIN_NAMES,
}
"""Tuned constants of each classical combination."""
TRAINED_LAW: Final = "both_trained"
"""The last combination with constants that are trained by gradients."""
LEARNED: Final = "learned"
"""The trained law with a recurrent network."""


class RollWeights(Config):
    """Weights of the cost relative to the mean square roll angle.

    Attributes:
        heading: weight of the mean square heading error.
        effort: weight of the mean square angles of rudder and fins.
    """

    heading: float = Field(default=4.0, ge=0)
    effort: float = Field(default=0.01, ge=0)


class EquivalentBoxConfig(Config):
    """Hull particulars from which a box for the wave loads follows.

    In waves much longer than the hull, the Froude-Krylov loads depend only on volume, metacentric
    radius and depth of the centre of buoyancy. A box with breadth B and draught T has the
    metacentric radius L B^3 / (12 volume), so that L follows, and T from the volume.

    Attributes:
        volume: displaced volume in m^3.
        breadth: breadth of the waterline in m.
        metacentric_radius: distance BM of the transverse metacentre from the centre of buoyancy
            in m.
    """

    volume: float = Field(gt=0)
    breadth: Metres = Field(gt=0)
    metacentric_radius: Metres = Field(gt=0)

    def build_box(self) -> HullBoxConfig:
        """Return the box with this volume and metacentric radius."""
        length = 12.0 * self.volume * self.metacentric_radius / self.breadth**3
        draught = self.volume / (length * self.breadth)
        return HullBoxConfig(length=length, breadth=self.breadth, draught=draught)


@dataclass(frozen=True)
class Sea:
    """One condition of the evaluation.

    Attributes:
        state: sea state.
        heading_deg: direction of propagation relative to the course.
    """

    state: int
    heading_deg: float

    def waves(self, hull: HullBoxConfig) -> WavesConfig:
        """Return the waves of this condition on a northerly course."""
        height, period = SEA_STATES[self.state]
        return WavesConfig(
            significant_height=height,
            peak_period=period,
            direction=math.radians(self.heading_deg),
            hull=hull,
        )


def list_seas(
    states: Sequence[int] = tuple(SEA_STATES), headings_deg: Sequence[float] = HEADINGS_DEG
) -> list[Sea]:
    """Return all conditions: each sea state with each direction of the waves."""
    return [Sea(state, heading) for state in states for heading in headings_deg]


class RollTuning(Config):
    """Settings of the differential evolution of the constants of a classical law.

    Attributes:
        generations: largest number of generations.
        population: candidates per generation and constant.
    """

    generations: int = Field(default=14, ge=1, le=10_000)
    population: int = Field(default=4, ge=1, le=1_000)


class RollTraining(OneStage):
    """Settings of the training of a roll policy by gradients through the closed loop.

    After an epoch whose validation loss is 3 % above the best, the training continues from the best
    policy with half of the learning rate.

    Attributes:
        heading_excess: penalty in deg^2/m^2 of a relative increase of 1 of the RMS heading error
            above the error of the law from which a network starts, in the same waves; the sum over
            sea states. It is zero without an increase, so that the network reduces the roll at the
            heading error of the law. It does not apply to the constants of the law.
        steps: number of batches per epoch.
        rows_per_sea: number of realisations of each sea in a batch.
        validation_rows: number of realisations of each sea for the selection of the epoch.
    """

    epochs: int = Field(default=20, ge=1, le=100_000)
    learning_rate: float = Field(default=1e-2, gt=0)
    gradient_clip: float = Field(default=0.3, gt=0)
    steps: int = Field(default=12, ge=1, le=100_000)
    heading_excess: float = Field(default=0.5, ge=0)
    rows_per_sea: int = Field(default=3, ge=1, le=10_000)
    validation_rows: int = Field(default=6, ge=1, le=10_000)
