"""Errors of a fit when one velocity alone runs free and the others are as measured: the first
approach of document 001, section 4.

Tuned so, each model looks good for itself; together they may still drift apart, which is why the
document gives the approach up.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.regression.equation_rows import step_of, stretches

_FAR = 10.0
"""Spreads of a velocity beyond which its error is not counted on: it has run away."""


class Recursion:
    """Unbroken stretches of samples side by side, padded by samples that do not count."""

    def __init__(self, samples: Samples) -> None:
        """From samples with times; their target is what the fit explains.

        Raises:
            FitError: where no manoeuvre has two samples at different times.
        """
        group, t = samples.group.numpy(), samples.t.numpy()
        self.step = step_of(group, t)
        _, counts = torch.unique_consecutive(
            torch.from_numpy(stretches(group, t, self.step)), return_counts=True
        )
        lengths = counts.tolist()
        if max(lengths) < 2:
            raise FitError(
                "choosing by recursion needs samples that follow each other; the masks leave none"
            )
        self.inside = torch.nn.utils.rnn.pad_sequence(
            [torch.ones(n, dtype=torch.bool) for n in lengths], batch_first=True
        )
        self.z = torch.nn.utils.rnn.pad_sequence(list(samples.z.split(lengths)), batch_first=True)
        self.target = torch.nn.utils.rnn.pad_sequence(
            list(samples.target.split(lengths)), batch_first=True
        )
        self.columns = [samples.names.index(name) for name in VELOCITY]

    def errors(self, axis: int, predicted: Callable[[Tensor], Tensor], count: int) -> Tensor:
        """Mean square error [C] of one velocity along all stretches, for C fits at once.

        What the measured accelerations hold beside the target, a baseline's part, is taken as it
        was.

        Args:
            axis: of the velocity.
            predicted: from channels [C, G, nz] to each fit's answer on that axis [C, G].
            count: C.
        """
        column = self.columns[axis]
        own = self.z[..., column]
        known = (own[:, 1:] - own[:, :-1]) / self.step - self.target[:, :-1, axis]
        middle, far = (
            float(own[self.inside].mean()),
            _FAR * float(own[self.inside].std(correction=0)),
        )
        x, total = own[:, 0].expand(count, -1).clone(), torch.zeros(count, dtype=own.dtype)
        for k in range(own.shape[1] - 1):
            z = self.z[:, k].expand(count, -1, -1).clone()
            z[..., column] = x
            x = x + self.step * (known[:, k] + predicted(z))
            x = middle + (x - middle).nan_to_num(far, far, -far).clamp(-far, far)
            total += torch.where(
                self.inside[:, k + 1], (x - own[:, k + 1]).square(), torch.zeros_like(x)
            ).sum(-1)
        return total / int(self.inside[:, 1:].sum())
