"""What the standard recipe looks at: channels, their excitation, sampling, length, protocol."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.core.stretches import stretches
from residnet.data.prepare import Prepared
from residnet.judge.config import EvaluationConfig
from residnet.judge.protocol import Windows
from residnet.physics.signals import FORCE_CHANNELS, WIND_CHANNELS

_STILL = 1e-3
"""Spread of a channel, as a share of its size, below which it tells nothing."""
_ASTERN = 0.01
"""Share of the samples from which a propeller that turns astern counts."""
_ROOM = 0.6
"""Share of a usual stretch that a free run may take, so that it can start at several places."""
_USUAL = 60.0
"""Length of a free run in s where no log says how long it is."""


@dataclass(frozen=True)
class Facts:
    """What the portfolio of a fit depends on.

    Attributes:
        names: channels that models see.
        moving: inputs, forces and wind channels that vary in the training logs.
        astern: inputs that take both signs there.
        step: of the grid, s.
        length: of the free runs that choose between models, s.
        history: measured past that a free run may look back on, s.
        stretch: half of the training samples lie in uninterrupted stretches at least so long, s.
        samples: of the training logs.
    """

    names: tuple[str, ...]
    moving: tuple[str, ...]
    astern: tuple[str, ...]
    step: float
    length: float
    history: float
    stretch: float
    samples: int

    @classmethod
    def supposed(cls, names: tuple[str, ...], step: float = 0.1) -> Facts:
        """Return facts before any log is read: every channel moves, ahead only."""
        return cls(names, _acting(names), (), step, _USUAL, 0.1 * _USUAL, math.inf, 10_000)

    @classmethod
    def of(
        cls,
        samples: Samples,
        logs: Sequence[Prepared],
        evaluation: EvaluationConfig,
        step: float,
    ) -> Facts:
        """Return what training logs and the protocol that chooses say.

        Args:
            samples: of the training logs.
            logs: for training.
            evaluation: protocols.
            step: of the grid, s.
        """
        z, names = samples.z, samples.names
        spread, size = z.std(0, correction=0), z.abs().amax(0)
        moving = [
            name
            for name in _acting(names)
            if spread[names.index(name)] > _STILL * size[names.index(name)]
        ]
        astern = [name for name in moving if _both_signs(z[:, names.index(name)])]
        length, history = _free_run(logs, evaluation, step)
        stretch = _stretch(logs) * step
        return cls(
            names, tuple(moving), tuple(astern), step, length, history, stretch, len(samples)
        )

    @property
    def longest(self) -> float:
        """Length of the longest free runs that there is a use and enough room for, s."""
        return min(self.length, _ROOM * self.stretch)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Channels that drive the vessel and vary; forces where the model makes them."""
        return tuple(name for name in self.moving if name not in WIND_CHANNELS)

    @property
    def wind(self) -> bool:
        """Whether the true wind is known."""
        return any(name in WIND_CHANNELS for name in self.moving)


def _acting(names: Sequence[str]) -> tuple[str, ...]:
    forces = "tau_x" in names
    return tuple(
        name
        for name in names
        if name not in VELOCITY and (not forces or name in FORCE_CHANNELS or name in WIND_CHANNELS)
    )


def _stretch(logs: Sequence[Prepared]) -> float:
    """Return the number of samples of stretches in which half of all samples lie, or longer."""
    lengths = np.concatenate(
        [np.diff(np.stack(stretches(log.piece)), axis=0).flatten() for log in logs]
    )
    falling = np.sort(lengths)[::-1]
    return float(falling[np.searchsorted(np.cumsum(falling), 0.5 * falling.sum())])


def _both_signs(values: torch.Tensor) -> bool:
    ahead = float((values > 0).double().mean())
    return min(ahead, float((values < 0).double().mean())) > _ASTERN


def _free_run(
    logs: Sequence[Prepared], evaluation: EvaluationConfig, step: float
) -> tuple[float, float]:
    """Return how long the free runs are that choose between models, and their measured past, s."""
    protocol = evaluation.protocols[evaluation.selection]
    if isinstance(protocol, Windows):
        return protocol.length, protocol.history
    found = [
        window.stop - window.start
        for number, log in enumerate(logs)
        for window in protocol.windows(log, number, step)
    ]
    return (float(np.median(found)) * step if found else _USUAL), protocol.initial
