"""A closed loop and its gradient as compiled C: many flights at once, and training through them.

Torch records one step of the loop, and the product of a step's Jacobian with a gradient; both are
written as C for blocks of rows, compiled for this machine and called for whole flights.
"""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, final

import torch
from torch import Tensor

from residnet.core.errors import ExportError
from residnet.dynamics.rollout import Rollout
from residnet.export.c.kept import compiled_library
from residnet.export.c.lanes import lanes
from residnet.export.c.loop_source import loop_source

_CHECKED, _SAME = 40, 5e-3
"""Steps of the flight that the compiled loop is checked by, and how far it may be off."""


@final
class CompiledLoop:
    """The flights of a closed loop, with a gradient for the numbers that are trained.

    There is none where torch's gradients are switched off while this is made.

    Args:
        rollout: the closed loop, whose source does not count steps. Its parameters that require a
            gradient may change between flights.
        x, w, s: examples of its arguments, [B, nx], [B, T, m] and [B, n], in the precision that
            flights are flown in.
        own: names of parameters and buffers [B, ...] that every row has for itself; there is no
            gradient for them.
        most: how much of what is asked of a row reaches its gradient, as a multiple of the median
            over rows. A loop that is at the edge of swinging has flights whose gradients are
            millions of times as large as those of others.

    Raises:
        ExportError: where a step cannot be recorded or written, or no C compiler does its work.
    """

    def __init__(
        self,
        rollout: Rollout,
        x: Tensor,
        w: Tensor,
        s: Tensor,
        *,
        own: Sequence[str] = (),
        most: float = math.inf,
    ) -> None:
        self.rollout, self.dtype, self.own = rollout, x.dtype, tuple(own)
        self.most = math.inf
        weights = {name: p for name, p in rollout.named_parameters() if name not in self.own}
        trained = [name for name, p in weights.items() if p.requires_grad]
        self.gradient = torch.is_grad_enabled() and bool(trained)
        # loops that differ in their weights alone are one library, which is compiled once
        self.shared = trained if self.gradient else list(weights)
        alone = copy.deepcopy(rollout).double()
        held = _numbers(alone)
        shared = {name: held[name].detach() for name in self.shared}
        rows = {name: held[name].detach()[:1] for name in self.own}
        given = [x[:1].double(), w[:1, 0].double(), s[:1].double()]
        with torch.no_grad():
            given.append(alone.source.initial(given[0]))
            # a source whose rows have numbers of their own flies as many rows
            many = (x.double(), w[:, 0].double(), 0, alone.source.initial(x.double()))
            acting = alone.source(*many)[0]
        given += [_flat(shared)[None], _flat(rows)[None]]
        sizes = {
            name: part.shape[1]
            for name, part in zip(("x", "w", "s", "q", "theta", "own"), given, strict=True)
        }
        self.sizes = sizes | {"a": acting.shape[1]}
        self.library = compiled_library(
            loop_source(alone, given, shared, rows, self.sizes, x.dtype, self.gradient)
        )
        self.pool = ThreadPoolExecutor(max(torch.get_num_threads(), 1))
        self._check(x, w[:, :_CHECKED], s)
        self.most = most

    def of(self, rollout: Rollout) -> CompiledLoop:
        """Return the flights of a closed loop that differs in its numbers alone."""
        other = copy.copy(self)
        other.rollout = rollout
        return other

    def __call__(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return states [B, T+1, nx] and inputs that acted [B, T, m]."""
        held = _numbers(self.rollout)
        theta = _flat({name: held[name] for name in self.shared}).to(self.dtype)
        own = [held[name].detach().reshape(len(x), -1) for name in self.own]
        rows = torch.cat([torch.zeros(len(x), 0), *own], dim=1).to(self.dtype)
        q = self.rollout.source.initial(x)
        if not self.gradient:
            return self.flown(theta.detach(), rows, x, w, s, q)[0]
        apply: Any = _Flight.apply
        found: tuple[Tensor, Tensor] = apply(theta, rows, x, w, s, q, self)
        return found

    def flown(
        self, theta: Tensor, own: Tensor, x: Tensor, w: Tensor, s: Tensor, q: Tensor
    ) -> tuple[tuple[Tensor, Tensor], list[Tensor]]:
        """Return states and inputs of flights, and all that is known of each step.

        The latter stand with the rows last, padded to whole blocks: shared and own numbers, states,
        inputs, and both memories.
        """
        count, steps = w.shape[:2]
        block = lanes(self.dtype)
        blocks = -(-count // block)
        width = blocks * block
        # rows that fill up the last block repeat the last one
        places = torch.arange(width).clamp(max=count - 1)
        kept = [
            torch.empty(steps + 1, part.shape[1], width, dtype=self.dtype) for part in (x, s, q)
        ]
        for whole, start in zip(kept, (x, s, q), strict=True):
            whole[0] = start.detach().to(self.dtype)[places].T
        inputs = w.to(self.dtype)[places].permute(1, 2, 0).contiguous()
        rows = own[places].T.contiguous()
        acting = torch.empty(steps, self.sizes["a"], width, dtype=self.dtype)
        theta = theta.detach().contiguous()
        known = [theta, rows, kept[0], inputs, kept[1], kept[2]]
        self.run("fly", blocks, *known, acting, steps, width)
        return (kept[0].permute(2, 0, 1)[:count], acting.permute(2, 0, 1)[:count]), known

    def _check(self, x: Tensor, w: Tensor, s: Tensor) -> None:
        """Compare a short flight and its gradient with those of the closed loop itself.

        Raises:
            ExportError: where they differ by more than the precision explains.
        """
        weights = [_numbers(self.rollout)[name] for name in self.shared if self.gradient]
        found = []
        for flown in (self(x, w, s), self.rollout(x, w, s)[:2]):
            parts = [part.detach() for part in flown]
            if weights:
                slopes = torch.autograd.grad(flown[0].square().mean() + flown[1].sum(), weights)
                parts.append(torch.cat([part.reshape(-1) for part in slopes]))
            found.append(parts)
        for fast, slow in zip(*found, strict=True):
            off = float((fast - slow).abs().max() / slow.abs().max().clamp(min=1e-9))
            if not off <= _SAME:
                raise ExportError(f"the compiled closed loop is off by {off:.2g} of its size")

    def run(self, name: str, blocks: int, *arguments: Tensor | int) -> None:
        """Call a function of the library for all blocks of rows, in as many threads as torch."""
        function = getattr(self.library, name)
        given = [
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_long(a)
            for a in arguments
        ]
        list(self.pool.map(lambda block: function(*given, ctypes.c_long(block)), range(blocks)))


class _Flight(torch.autograd.Function):
    """Flights in C, and their gradient for the trained numbers."""

    @staticmethod
    def forward(ctx: Any, theta: Tensor, *given: Any) -> tuple[Tensor, Tensor]:
        """Return states [B, T+1, nx] and inputs [B, T, m]."""
        *parts, loop = given
        found, known = loop.flown(theta, *parts)
        ctx.loop, ctx.rows = loop, len(found[0])
        ctx.save_for_backward(*known)
        return found[0], found[1]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of the trained numbers; nothing else has one."""
        known, loop = ctx.saved_tensors, ctx.loop
        steps, _, width = known[3].shape
        given = []
        for grad in grads:
            whole = torch.zeros(grad.shape[1], grad.shape[2], width, dtype=loop.dtype)
            whole[:, :, : ctx.rows] = grad.permute(1, 2, 0)
            given.append(whole)
        block = lanes(loop.dtype)
        # each row adds up for itself, so that the sum does not depend on the number of threads
        total = torch.zeros(width // block, loop.sizes["theta"], block, dtype=loop.dtype)
        loop.run("back", width // block, *known, *given, total, steps, width)
        by_row = total.transpose(1, 2).reshape(width, -1)[: ctx.rows]
        asked = sum(grad.flatten(1).square().sum(1) for grad in grads)
        return (_held(by_row, torch.as_tensor(asked).sqrt(), loop.most).sum(0), *[None] * 6)


def _held(gradients: Tensor, asked: Tensor, most: float) -> Tensor:
    """Return gradients [B, n] of rows, none larger than a multiple of what the median row has.

    Args:
        gradients: of each row.
        asked: size [B] of the gradient that each row was given.
        most: the multiple; infinity leaves all as they are.
    """
    if math.isinf(most):
        return gradients
    size = gradients.norm(dim=1)
    share = size / asked.clamp(min=1e-30)
    usual = share[asked > 0].nanmedian() if bool((asked > 0).any()) else share.new_zeros(())
    kept = (most * usual * asked / size.clamp(min=1e-30)).clamp(max=1.0)
    # what is no number says nothing
    return torch.where(torch.isfinite(size)[:, None], gradients * kept[:, None], 0.0)


def _numbers(rollout: Rollout) -> dict[str, Tensor]:
    """Return the parameters and buffers of a closed loop by name."""
    return {**dict(rollout.named_parameters()), **dict(rollout.named_buffers())}


def _flat(parts: dict[str, Tensor]) -> Tensor:
    return torch.cat([torch.zeros(0), *(part.reshape(-1) for part in parts.values())])
