"""A small recurrent cell that treats port and starboard alike."""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor, nn


@final
class OddCell(nn.Module):
    """A gated recurrent unit whose memory changes sign with its features.

    Gates see the sizes of features and memory, so that they are even; the candidate has no bias, so
    that it is odd (K. Cho and others, 2014, for the gates). A step of another length than that of
    training moves the memory by as much per second.

    Args:
        features: number of features.
        units: number of units.
        dt: step of training in s.
        hidden: units of an odd layer between memory and output; 0 for none.
    """

    def __init__(self, features: int, units: int, dt: float, hidden: int = 0) -> None:
        super().__init__()
        both = features + units
        self.gates = nn.Linear(both, 2 * units)
        self.candidate = nn.Linear(both, units, bias=False)
        self.hidden = nn.Linear(both, hidden, bias=False) if hidden > 0 else None
        self.out = nn.Linear(both + hidden, 1, bias=False)
        nn.init.normal_(self.gates.weight, std=1.0 / math.sqrt(both))
        nn.init.zeros_(self.gates.bias)
        nn.init.normal_(self.candidate.weight, std=1.0 / math.sqrt(both))
        nn.init.zeros_(self.out.weight)
        self.units, self.trained_at = units, dt

    def forward(self, features: Tensor, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Return the output [B, 1] and the memory [B, units] after a step of dt seconds."""
        sizes = torch.cat((features, memory), dim=1).abs()
        update, reset = torch.sigmoid(self.gates(sizes)).chunk(2, dim=1)
        kept = (1.0 - update).clamp(min=1e-6)
        if dt != self.trained_at:
            kept = kept.pow(dt / self.trained_at)
        candidate = torch.tanh(self.candidate(torch.cat((features, reset * memory), dim=1)))
        memory = candidate + kept * (memory - candidate)
        known = torch.cat((features, memory), dim=1)
        if self.hidden is not None:
            known = torch.cat((known, torch.tanh(self.hidden(known))), dim=1)
        output: Tensor = self.out(known)
        return output, memory
