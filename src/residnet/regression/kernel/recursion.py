"""Errors of a fit whose output integrates into one of its inputs, the others as measured.

This is the first approach of document 001, section 4. Tuned so, each model looks good for itself;
together they may still drift apart, which is why the document gives the approach up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from residnet.core.errors import FitError

_FAR = 10.0
"""Standard deviations of a state beyond which it has run away, and its error stays what it is."""


class Recursion:
    """Unbroken stretches of samples side by side, padded by samples that do not count.

    Args:
        z: inputs of the fit [N, nz].
        target: outputs of the fit [N, n].
        stretch: number of the unbroken stretch of each sample, ascending [N].
        step: time between neighbouring samples, s.
        states: column of z that each output is the derivative of, [n].

    Raises:
        FitError: where no two samples follow each other.
    """

    def __init__(
        self, z: Tensor, target: Tensor, stretch: Tensor, step: float, states: Sequence[int]
    ) -> None:
        lengths = torch.unique_consecutive(stretch, return_counts=True)[1].tolist()
        if max(lengths, default=0) < 2:
            raise FitError(
                "choosing by recursion needs samples that follow each other; the masks leave none"
            )
        pad = torch.nn.utils.rnn.pad_sequence
        inside = [torch.ones(length, dtype=torch.bool) for length in lengths]
        self.inside = pad(inside, batch_first=True)
        self.z = pad(list(z.split(lengths)), batch_first=True)
        self.target = pad(list(target.split(lengths)), batch_first=True)
        self.step = step
        self.states = tuple(states)

    def errors(self, output: int, predicted: Callable[[Tensor], Tensor], count: int) -> Tensor:
        """Return mean square errors [C] of one state along all stretches, for C fits at once.

        What the state's measured derivative holds beside the output, such as the part of a
        baseline, is taken as it was.

        Args:
            output: number of the output.
            predicted: from inputs [C, G, nz] to each fit's output [C, G].
            count: number of fits C.
        """
        column = self.states[output]
        measured = self.z[..., column]
        known = (measured[:, 1:] - measured[:, :-1]) / self.step - self.target[:, :-1, output]
        middle = float(measured[self.inside].mean())
        far = _FAR * float(measured[self.inside].std(correction=0))
        x = measured[:, 0].expand(count, -1).clone()
        total = torch.zeros(count, dtype=measured.dtype)
        for k in range(measured.shape[1] - 1):
            z = self.z[:, k].expand(count, -1, -1).clone()
            z[..., column] = x
            x = x + self.step * (known[:, k] + predicted(z))
            x = middle + (x - middle).nan_to_num(far, far, -far).clamp(-far, far)
            error = (x - measured[:, k + 1]).square()
            total += torch.where(self.inside[:, k + 1], error, torch.zeros_like(x)).sum(-1)
        return total / int(self.inside[:, 1:].sum())
