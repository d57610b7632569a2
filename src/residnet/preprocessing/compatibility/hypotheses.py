"""Decide between interpretations of measured channels, such as their sign, unit or frame.

The motion is reconstructed with each interpretation, and the BIC ranks the reconstructions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from residnet.preprocessing.compatibility.estimates import Prior, Reconstruction
from residnet.preprocessing.compatibility.reconstruction import reconstruct
from residnet.preprocessing.compatibility.sensors import Sensor

MIN_MARGIN = 20.0
"""Difference of the BIC below which two hypotheses are not distinguished."""
_MIN_EFFECTIVE_SHARE = 0.02
"""Smallest fraction of the samples that counts as independent when residuals are autocorrelated."""


@dataclass(frozen=True)
class Hypothesis:
    """An interpretation of the channels of a log.

    Attributes:
        sensors: measurements as interpreted; all hypotheses of a comparison have the same
            values in the same order.
        errors: instrument errors -> prior.
    """

    sensors: Sequence[Sensor]
    errors: Mapping[str, Prior] = field(default_factory=dict)


class RankedHypothesis(NamedTuple):
    """A hypothesis and its distance from the best one.

    Attributes:
        name: name of the hypothesis.
        margin: difference of the BIC from the best one, reduced by the autocorrelation of the
            residuals; 0 for the best one.
        reconstruction: motion of the log under this hypothesis.
    """

    name: str
    margin: float
    reconstruction: Reconstruction


def compare(hypotheses: Mapping[str, Hypothesis], step: float) -> list[RankedHypothesis]:
    """Rank hypotheses about the channels of a log by their evidence, the best first.

    Successive residuals of filtered channels are not independent. The differences of the BIC are
    therefore multiplied by the share of independent samples, (1 - a) / (1 + a) for the largest
    autocorrelation a of the residuals of the best hypothesis (autoregression of first order).

    Args:
        hypotheses: name -> hypothesis.
        step: time between the nodes of the reconstructions in s.

    Raises:
        DataError: see `reconstruct`.
    """
    reconstructions = {
        name: reconstruct(hypothesis.sensors, hypothesis.errors, step)
        for name, hypothesis in hypotheses.items()
    }
    ranking = sorted(reconstructions, key=lambda name: reconstructions[name].bic)
    best = reconstructions[ranking[0]]
    share = min(
        (1.0 - sensor.autocorrelation) / (1.0 + max(sensor.autocorrelation, 0.0))
        for sensor in best.sensors.values()
    )
    share = float(np.clip(share, _MIN_EFFECTIVE_SHARE, 1.0))
    return [
        RankedHypothesis(
            name, share * (reconstructions[name].bic - best.bic), reconstructions[name]
        )
        for name in ranking
    ]


def choose_stretch(
    t: np.ndarray, activity: np.ndarray, step: float, max_nodes: int = 400
) -> tuple[float, float]:
    """Return start and stop of the stretch of a log in which the motion varies most.

    Args:
        t: times [T] in s, increasing.
        activity: measure of the motion [T], for example the squared deviation of the yaw rate; NaN
            counts as zero.
        step: time between nodes in s.
        max_nodes: largest number of nodes of the stretch.
    """
    duration = step * max_nodes
    if t[-1] - t[0] <= duration:
        return float(t[0]), float(t[-1])
    cumulative = np.append(0.0, np.cumsum(np.nan_to_num(activity)))
    starts = np.arange(t[0], t[-1] - duration, 0.25 * duration)
    first = np.searchsorted(t, starts)
    last = np.searchsorted(t, starts + duration)
    best = int(np.argmax(cumulative[last] - cumulative[first]))
    return float(starts[best]), float(starts[best] + duration)
