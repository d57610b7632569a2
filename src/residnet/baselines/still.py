"""The baseline that knows nothing: velocities held.

It makes the model `zero`, and a black box where a head is set on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig
from residnet.core.layout import zero_acceleration
from residnet.core.samples import Samples
from residnet.regression.solutions import Solution


@final
class StillBaseline(Baseline):
    """A baseline without any acceleration, nu_dot = 0."""

    def forward(self, z: Tensor) -> Tensor:
        """Return zeros [..., 3] for channels z [..., nz]."""
        return zero_acceleration(z)

    def parameter_count(self) -> list[float]:
        """Return zero parameters for each axis."""
        return [0.0, 0.0, 0.0]


class StillConfig(IdentifiedConfig):
    """No known part: the head learns the whole acceleration."""

    kind: Literal["still"] = "still"

    def build(self, names: Sequence[str]) -> StillBaseline:
        """Return the module; it has no parameters."""
        return StillBaseline()

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return one solution without numbers: there is nothing to fit."""
        return [Solution({}, {})]
