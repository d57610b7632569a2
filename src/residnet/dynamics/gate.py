"""A gate between network and physics: outside the training range a residual fades to its baseline.

The distance d of the channels from their training range is measured in half widths of that range;
inside it is zero. Each axis keeps the share 1 / (1 + (d / w)^2) of its residual. Where the variance
of an ensemble's members exceeds what it is on the training data by e, the share of a residual rho
falls by rho^2 / (rho^2 + e): members that agree in its sign keep most of it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import final

import numpy as np
import torch
from torch import Tensor

from residnet.core.samples import Samples
from residnet.heads.base import ResidualHead

_BOXES = (0.05, 0.15, 0.25)
"""Quantiles at whose inner boxes the fade is learned: what lies outside stands for the unseen."""
_AGREED = 0.99
"""Share of the training samples on which the members are said to agree."""
_WORTH = 0.8
"""Share of the best candidate's gain at which a residual that reaches farther is taken."""
_LEAST = 1e-9


@final
class GatedHead(ResidualHead):
    """A head whose residual fades where its training data say nothing.

    Args:
        inner: the head, fitted.
        channels: number of channels nz.
        holds: whether the inner head sees channels beyond the range at its edge.
    """

    def __init__(self, inner: ResidualHead, channels: int, *, holds: bool = False) -> None:
        super().__init__()
        self.inner, self.holds = inner, holds
        self.n_state = inner.n_state
        self.tiny = 1e-18
        for name, count, value in (
            ("low", channels, -torch.inf),
            ("high", channels, torch.inf),
            ("reach", channels, 1.0),
            ("fade", 3, 1.0),
            ("agreed", 3, 1.0),
        ):
            self.register_buffer(name, torch.full((count,), value, dtype=torch.float64))
        self.low: Tensor
        self.high: Tensor
        self.reach: Tensor
        self.fade: Tensor
        self.agreed: Tensor

    def held(self, z: Tensor) -> Tensor:
        """Return channels z [..., nz], at the edges of their range where they left it."""
        return torch.minimum(torch.maximum(z, self.low.to(z.dtype)), self.high.to(z.dtype))

    def seen(self, z: Tensor) -> Tensor:
        """Return the channels [..., nz] that the inner head sees."""
        return self.held(z) if self.holds else z

    def distance(self, z: Tensor) -> Tensor:
        """Return the squared distance [..., 1] of channels z [..., nz] from their range."""
        beyond = (z - self.held(z)) / self.reach.to(z.dtype)
        return beyond.square().sum(dim=-1, keepdim=True)

    def kept(self, z: Tensor, rho: Tensor, spread: Tensor) -> Tensor:
        """Return what is kept [..., 3] of a residual.

        Args:
            z: channels [..., nz].
            rho: residual [..., 3].
            spread: standard deviation [..., 3] of the members' residuals; zero for a single head.
        """
        near = 1.0 / (1.0 + self.distance(z) / self.fade.to(z.dtype).square())
        beyond = torch.relu(spread.square() - self.agreed.to(z.dtype).square())
        known = rho.square() + self.tiny
        return rho * near * known / (known + beyond)

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the residual [B, 3] at channels z [B, nz] and the memory for the next step."""
        rho, spread, s = self.inner.with_spread(self.seen(z), s)
        return self.kept(z, rho, spread), s

    def sequence(self, z: Tensor) -> Tensor:
        """Return residuals [B, T, 3] along channels [B, T, nz], from an empty memory."""
        rho, spread = self.inner.sequence_with_spread(self.seen(z))
        return self.kept(z, rho, spread)

    def warms_by_steps(self) -> bool:
        """Return what the inner head says."""
        return self.inner.warms_by_steps()

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] that past channels [B, T, nz] leave."""
        return self.inner.warmup(self.seen(z))

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], the inner head's."""
        return self.inner.memory_range()

    def residual_std(self) -> Tensor:
        """Return the standard deviation of the residual on the training samples, [3]."""
        return self.inner.residual_std()

    def parameter_count(self) -> list[float]:
        """Return the inner head's, with one more for each axis: its fade."""
        return [count + 1.0 for count in self.inner.parameter_count()]

    def calibrate(self, samples: Samples) -> None:
        """Take the range of the channels, and how far members disagree there."""
        low, high = samples.z.amin(0), samples.z.amax(0)
        self.low.copy_(low)
        self.high.copy_(high)
        half = 0.5 * (high - low)
        # what never varied has no width of its own: its size stands for it
        alone = torch.maximum(torch.maximum(low.abs(), high.abs()), torch.full_like(low, 1e-3))
        self.reach.copy_(torch.where(half > _LEAST * alone, half, alone))
        with torch.no_grad():
            spread = torch.cat(
                [
                    self.inner.sequence_with_spread(z)[1][0]
                    for z in _by_manoeuvre(samples.z, samples.group)
                ]
            )
        (agreed,) = _quantiles(spread, (_AGREED,))
        self.agreed.copy_(torch.where(agreed > _LEAST, agreed, torch.ones_like(agreed)))

    def inner_box(self, z: Tensor, quantile: float) -> tuple[Tensor, Tensor]:
        """Return the low and high quantile [nz] of channels z [N, nz]."""
        low, high = _quantiles(z, (quantile, 1.0 - quantile))
        return low, high

    def within(self, low: Tensor, high: Tensor, fade: Tensor) -> GatedHead:
        """Return this gate as if the residual were known within a box only.

        Beyond it the residual is held at the edge, as heads hold theirs, and faded.

        Args:
            low: lower edges of the box [nz].
            high: upper edges [nz].
            fade: distance at which half is left of each axis [3], in half widths of the box.
        """
        out = GatedHead(copy.deepcopy(self.inner), len(low), holds=True)
        for name, value in (
            ("low", low),
            ("high", high),
            ("reach", self._reach(low, high)),
            ("fade", fade),
            ("agreed", self.agreed),
        ):
            out.get_buffer(name).copy_(value)
        return out

    def _reach(self, low: Tensor, high: Tensor) -> Tensor:
        """Return the half widths of a box [nz], in which distances from it are measured."""
        half = (0.5 * (high - low)).clamp(min=_LEAST)
        # a channel that hardly varies within the box would make all distances large
        return torch.maximum(half, 0.1 * self.reach)

    def learn_fade(self, samples: Samples, candidates: Sequence[float]) -> dict[str, list[float]]:
        """Choose each axis' fade from what holding the residual would have told of accelerations.

        Inner boxes of the training range play its part: beyond one, the residual is held at its
        edge, and faded by each candidate. That which reaches farthest is taken, of those that gain
        nearly as much on the baseline as the best one does: outside all data the distances are
        larger than inner boxes can show.

        Args:
            samples: with the accelerations that the baseline leaves as target; best of logs that
                no head was fitted on.
            candidates: distances, in half widths of the range, at which half of it is left.

        Returns:
            For each candidate the share [3] that it leaves of what the baseline leaves.
        """
        lost = torch.zeros(len(candidates), 3, dtype=torch.float64)
        whole = torch.zeros(3, dtype=torch.float64)
        fades = torch.tensor(candidates, dtype=torch.float64)[:, None, None]
        for quantile in _BOXES:
            low, high = self.inner_box(samples.z, quantile)
            held = torch.minimum(torch.maximum(samples.z, low), high)
            far = ((samples.z - held) / self._reach(low, high)).square().sum(dim=1)
            out = far > 0
            with torch.no_grad():
                rho = torch.cat(
                    [self.inner.sequence(z)[0] for z in _by_manoeuvre(held, samples.group)]
                )
            share = 1.0 / (1.0 + far[None, out, None] / fades.square())
            lost += (samples.target[out] - share * rho[out]).square().sum(dim=1)
            whole += samples.target[out].square().sum(dim=0)
        left = lost / whole.clamp(min=_LEAST**2)
        farther = torch.argsort(fades.flatten())
        gained = 1.0 - left[farther]
        worth = gained >= torch.clamp(_WORTH * gained.amax(dim=0), min=0.0)
        # where none gains, the first one, which fades at once
        last = torch.where(worth, torch.arange(len(candidates))[:, None], 0).amax(dim=0)
        self.fade.copy_(fades.flatten()[farther][last])
        return {f"{fade:g}": left[i].tolist() for i, fade in enumerate(candidates)}


def _quantiles(values: Tensor, shares: Sequence[float]) -> Tensor:
    """Return quantiles [Q, n] of columns [N, n]; torch's own take 16 million numbers at most."""
    return torch.from_numpy(np.quantile(values.double().numpy(), shares, axis=0))


def _by_manoeuvre(z: Tensor, group: Tensor) -> list[Tensor]:
    """Return channels [N, nz] of each manoeuvre [1, T, nz], in their order."""
    _, counts = torch.unique_consecutive(group, return_counts=True)
    return [part.unsqueeze(0) for part in z.split(counts.tolist())]
