"""Inputs as they were some steps ago: the memory of a model whose actuators answer late."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import nearest
from residnet.physics.terms import TermLibrary, parse_term
from residnet.regression.equation_rows import delay_profile

_PRECISION = 1e-14
"""Share of the energy of a target that rounding leaves."""
_TINY = 1e-300
"""Keeps the logarithm of the error of a target of zeros finite."""


class DelayConfig(Config):
    """A delay that the fit finds, one for all of its channels.

    Attributes:
        channels: inputs that act late.
        longest: longest delay that is tried, in steps of the grid; the memory holds as many
            samples, and whether there was one.
    """

    channels: tuple[str, ...] = Field(min_length=1)
    longest: int = Field(default=20, ge=1, le=500)


class DelayLine(nn.Module):
    """The channels with some of them as they were `steps` ago.

    The memory holds the last `longest` values of these, oldest first, and behind them 1 once there
    was a sample, 0 before. What lies before the first sample is taken to be like it: zeros would
    be no state of the vessel, and a term that divides by one of them would be no number.
    """

    def __init__(self, config: DelayConfig | None, names: Sequence[str]) -> None:
        super().__init__()
        late = config.channels if config is not None else ()
        for name in late:
            if name not in names:
                raise ConfigError(
                    f"delay: '{name}' is not a feature of the head{nearest(name, names)}"
                )
        self.longest = config.longest if config is not None else 0
        self.channels = late
        self.count = len(late)
        self.n_state = self.longest * self.count + 1 if self.count > 0 else 0
        self.register_buffer(
            "index",
            torch.tensor([list(names).index(name) for name in late], dtype=torch.long),
            persistent=False,
        )
        # a float, as all stored numbers are
        self.register_buffer("steps", torch.zeros(1, dtype=torch.float64))
        self.index: Tensor
        self.steps: Tensor

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return channels [B, nz] with the late ones delayed, and the next memory [B, n_state]."""
        if self.count == 0:
            return z, s
        now = z.index_select(-1, self.index)
        past = torch.where(s[..., -1:] > 0, s[..., :-1], self._repeated(now))
        line = torch.cat((past, now), dim=-1)
        first = (self.longest - self.steps.round().to(torch.long)) * self.count
        late = line.index_select(-1, first + torch.arange(self.count, device=z.device))
        after = torch.cat((line[..., self.count :], torch.ones_like(s[..., -1:])), dim=-1)
        return z.index_copy(-1, self.index, late), after

    def _repeated(self, late: Tensor) -> Tensor:
        """Return the line [..., longest * count] that late channels [..., count] fill alone."""
        return late.unsqueeze(-2).repeat_interleave(self.longest, dim=-2).flatten(-2)

    def sequence(self, z: Tensor) -> Tensor:
        """Return channels [..., T, nz] with the late ones delayed, from an empty memory."""
        if self.count == 0:
            return z
        late = z.index_select(-1, self.index)
        line = torch.cat((late[..., :1, :].repeat_interleave(self.longest, dim=-2), late), dim=-2)
        first = self.longest - self.steps.round().to(torch.long)
        return z.index_copy(
            -1,
            self.index,
            line.index_select(-2, first + torch.arange(z.shape[-2], device=z.device)),
        )

    def warmup(self, z: Tensor) -> Tensor:
        """Return the memory [B, n_state] after channels [B, T, nz]; zeros without any."""
        if self.count == 0 or z.shape[1] == 0:
            return z.new_zeros((z.shape[0], self.n_state))
        late = z.index_select(-1, self.index)
        line = torch.cat((late[:, :1].repeat_interleave(self.longest, dim=1), late), dim=1)
        past = line[:, line.shape[1] - self.longest :].flatten(1)
        return torch.cat((past, torch.ones_like(past[:, :1])), dim=-1)

    def memory_range(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], from those of all channels [nz]."""
        if self.count == 0:
            return low[:0], high[:0]
        first, last = (edge[self.index].repeat(self.longest) for edge in (low, high))
        # the memory without a past is zeros
        return torch.cat((first.clamp(max=0.0), first.new_zeros(1))), (
            torch.cat((last.clamp(min=0.0), last.new_ones(1)))
        )


class Past(NamedTuple):
    """The samples of a fit with what lies before them.

    Attributes:
        chosen: features [N, F].
        target: outputs [N, n].
        stretch: number of the unbroken stretch of each sample, ascending [N].
        step: time between neighbouring samples, s.
    """

    chosen: np.ndarray
    target: np.ndarray
    stretch: np.ndarray
    step: float

    def delayed(self, steps: int, index: np.ndarray) -> Past:
        """Return the samples that have a past of `steps`, with the features `index` from then."""
        if steps == 0:
            return self
        now = np.arange(steps, len(self.stretch))
        now = now[self.stretch[now] == self.stretch[now - steps]]
        chosen = self.chosen[now].copy()
        chosen[:, index] = self.chosen[now - steps][:, index]
        return Past(chosen, self.target[now], self.stretch[now], self.step)


def best_delay(
    past: Past,
    terms: Sequence[Sequence[str]],
    names: Sequence[str],
    late: Sequence[str],
    longest: int,
) -> tuple[int, np.ndarray]:
    """Return the delay at which terms explain their targets best, and the profile of errors.

    The delay is in steps; the profile is the mean over targets of ln(RSS) for each delay [longest +
    1].

    Args:
        past: samples.
        terms: of each target.
        names: of the features.
        late: features that are delayed.
        longest: longest delay, in steps.

    Raises:
        FitError: with too few samples that have such a past.
    """
    z = torch.from_numpy(past.chosen)
    total = np.zeros(longest + 1)
    for names_of_terms, y in zip(terms, past.target.T, strict=True):
        held, moved = (
            TermLibrary([_part(term, names, late, take) for term in names_of_terms], names)(
                z
            ).numpy()
            for take in (False, True)
        )
        rss = delay_profile(held, moved, y, past.stretch, longest).rss
        # what rounding leaves of a perfect fit is no evidence
        total += np.log(rss + _PRECISION * float(y @ y) + _TINY) / len(terms)
    return int(total.argmin()), total


def _part(term: str, names: Sequence[str], late: Sequence[str], take: bool) -> str:
    """Return the factors of a term that are delayed, or those that are not."""
    factors = [factor for factor in parse_term(term, names) if (factor.name in late) == take]
    return (
        " ".join(f"{f'|{f.name}|' if f.magnitude else f.symbol}^{f.power}" for f in factors) or "1"
    )
