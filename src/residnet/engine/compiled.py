"""Rollouts and their gradients as compiled C, for a batch of rows at once.

The C code of a step and of its vector-Jacobian product (see `rollout_source`) is compiled for this
machine and called for all steps of a run. The gradient of a matrix follows from the stored factors
and cotangents of all steps, in one product. A cotangent is the derivative of the loss with respect
to a quantity.
"""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import groupby, pairwise
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.core.processes import available_cores
from residnet.engine.c_code import load_library
from residnet.engine.rollout import Rollout
from residnet.engine.rollout_source import (
    MODEL_NAME,
    STATE_NAMES,
    count_stored_values,
    write_rollout_source,
)
from residnet.engine.step_parts import split_step


class _RolloutStep(nn.Module):
    """One step of the source of the inputs and of the model of a rollout."""

    def __init__(self, rollout: Rollout) -> None:
        super().__init__()
        self.rollout = rollout

    def forward(self, x: Tensor, w: Tensor, s: Tensor, q: Tensor) -> tuple[Tensor, ...]:
        """Return state x, memory s of the model, memory q of the source, and applied inputs.

        The source of the inputs is open loop or a controller; it computes the inputs that the model
        receives (applied inputs) from state x and inputs w. They are omitted if they are w itself.
        """
        applied, q = self.rollout.source(x, w, 0, q)
        x, s = self.rollout.model.step(x, applied, s)
        return x, s, q, applied[:, :0] if self.rollout.source.is_playback else applied


@final
class CompiledRollout:
    """A rollout as compiled C, with gradients of parameters, initial states and initial memory.

    It has no gradient if gradients were disabled in torch when it was compiled, or if no parameter
    requires one.

    Args:
        rollout: rollout whose source does not depend on the number of the step. Parameters and
            buffers may change between runs.
        x: example of the initial states [B, nx], in the precision of the runs.
        w: example of the inputs [B, T, m].
        s: example of the memory [B, n].
        row_tensors: names of parameters and buffers [B, ...] that differ from row to row; they have
            no gradient.
        max_gradient_ratio: largest ratio of a row's gradient to its cotangent, as a multiple of the
            median over rows; larger gradients are scaled down. Rows of a marginally stable loop
            can have gradients 10^6 times larger than the other rows.

    Raises:
        ExportError: if the step cannot be traced or written in C, or compilation fails.
    """

    def __init__(
        self,
        rollout: Rollout,
        x: Tensor,
        w: Tensor,
        s: Tensor,
        *,
        row_tensors: Sequence[str] = (),
        max_gradient_ratio: float = math.inf,
    ) -> None:
        self.rollout = rollout
        self.row_tensor_names = tuple(row_tensors)
        self.max_gradient_ratio = max_gradient_ratio
        # traced in float64; the C code has the precision of the runs
        reference = copy.deepcopy(rollout).double()
        tensors = named_tensors(reference)
        self.shared_names = [
            name
            for name, part in tensors.items()
            if name not in self.row_tensor_names and part.is_floating_point()
        ]
        is_trained = torch.is_grad_enabled() and any(
            tensors[name].requires_grad for name in self.shared_names
        )
        self.has_row_gradients = is_trained and not math.isinf(max_gradient_ratio)
        step_module = _RolloutStep(reference)
        row_shapes = [tensors[name][:1].shape for name in self.row_tensor_names]

        def step(
            x: Tensor, w: Tensor, s: Tensor, q: Tensor, row_values: Tensor, *shared: Tensor
        ) -> Any:
            weights = dict(zip(self.shared_names, shared, strict=True))
            row_parts = row_values[0].split([shape.numel() for shape in row_shapes])
            for name, shape, row_part in zip(
                self.row_tensor_names, row_shapes, row_parts, strict=True
            ):
                weights[name] = row_part.reshape(shape)
            return _call_with_tensors(step_module, weights, (x, w, s, q))

        rows = [("x", x[:1].double()), ("w", w[:1, 0].double()), ("s", s[:1].double())]
        with torch.no_grad():
            # a source with tensors for each row accepts this number of rows only
            q = reference.source.initial(x.double())
            applied = reference.source(x.double(), w[:, 0].double(), 0, q)[0]
        rows += [("q", q[:1]), ("row_values", self._row_tensors(tensors, 1).double())]
        shared = [tensors[name].detach() for name in self.shared_names]
        names = [f"{name}_after" for name in STATE_NAMES]
        self.parts = split_step(step, rows, shared, [*names, "a"], MODEL_NAME)
        self.sizes = {name: example.shape[1] for name, example in rows}
        self.sizes["a"] = 0 if rollout.source.is_playback else applied.shape[1]
        self.trained_indices: list[int] | None = None
        if is_trained:
            # entries of theta that depend on no trained parameter have no gradient
            self.trained_indices = []
            offset = 0
            with torch.enable_grad():
                prepared = self.parts.prepare(*(tensors[name] for name in self.shared_names))
            for part in (prepared[k] for k in self.parts.theta_indices):
                self.trained_indices += (
                    range(offset, offset + part.numel()) if part.requires_grad else ()
                )
                offset += part.numel()

        self.dtype = x.dtype
        source, self.forward_storage, self.backward_storage = write_rollout_source(
            self.parts,
            self.sizes,
            self.trained_indices,
            self.dtype,
            has_row_gradients=self.has_row_gradients,
        )
        self.library = load_library(source)
        self.n_lanes = ctypes.c_long.in_dll(self.library, "lanes").value

    def with_rollout(self, rollout: Rollout) -> CompiledRollout:
        """Return the compiled rollout for a rollout of equal structure with other parameters."""
        compiled = copy.copy(self)
        compiled.rollout = rollout
        return compiled

    def _row_tensors(self, tensors: Mapping[str, Tensor], n_rows: int) -> Tensor:
        """Return the tensors that differ from row to row, flattened [n_rows, n]."""
        parts = [
            tensors[name].detach()[:n_rows].reshape(n_rows, -1) for name in self.row_tensor_names
        ]
        return torch.cat([torch.zeros(n_rows, 0), *parts], dim=1)

    def prepare_tables(self, tensors: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Compute `theta` and the matrices of products, concatenated, from named tensors."""
        prepared = self.parts.prepare(*(tensors[name].double() for name in self.shared_names))
        return _concatenate([prepared[k] for k in self.parts.theta_indices]).to(
            self.dtype
        ), _concatenate(
            [
                prepared[product.matrix_index].reshape(-1, product.n_inputs, product.n_outputs)[
                    product.matrix_member
                ]
                for product in self.parts.products
                if not product.activation
            ]
        ).to(self.dtype)

    def __call__(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, applied inputs and the final memory, as `Rollout.forward`."""
        return self.run_with_tensors(named_tensors(self.rollout), x, w, s)

    def run_with_tensors(
        self, tensors: Mapping[str, Tensor], x: Tensor, w: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the result of `__call__` with the parameters and buffers `tensors` by name."""
        rows = self._row_tensors(tensors, len(x) if self.row_tensor_names else 1).expand(len(x), -1)
        q = self.rollout.source.initial(x)
        with torch.set_grad_enabled(self.trained_indices is not None and torch.is_grad_enabled()):
            theta, tables = self.prepare_tables(tensors)
            states, applied_inputs, memory = self.simulate(theta, tables, x, s, rows, w, q)
        return states, w if self.rollout.source.is_playback else applied_inputs, memory

    def simulate(self, *arguments: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return states, inputs and the final memory; arguments as in `run_forward`."""
        if not torch.is_grad_enabled():
            return self.run_forward(*arguments, keep_history=False)[0]
        apply: Any = _CompiledRun.apply
        result: tuple[Tensor, Tensor, Tensor] = apply(*arguments, self)
        return result

    def run_forward(
        self,
        theta: Tensor,
        tables: Tensor,
        x: Tensor,
        s: Tensor,
        row_values: Tensor,
        w: Tensor,
        q: Tensor,
        *,
        keep_history: bool,
    ) -> tuple[tuple[Tensor, Tensor, Tensor], list[Tensor]]:
        """Run all rows in C.

        Args:
            theta: entries of shared tensors that the scalar function reads.
            tables: matrices of products, one after the other.
            x: initial states [B, nx].
            s: initial memory of the model [B, n_state].
            row_values: tensors that differ from row to row, flattened [B, n].
            w: inputs [B, T, m].
            q: initial memory of the source [B, k].
            keep_history: whether to store the values that the gradient needs.

        Returns:
            States, inputs and final memory; and the arguments of the gradient: `theta`, tables,
            row tensors, states, inputs and both memories with the rows as last dimension, padded to
            complete blocks, and the stored values of all steps, block by block.
        """
        n_rows, n_steps = w.shape[:2]
        n_blocks = -(-n_rows // self.n_lanes)
        n_padded = n_blocks * self.n_lanes
        # the last block is padded with copies of the last row
        row_indices = torch.arange(n_padded).clamp(max=n_rows - 1)

        def pad_rows(part: Tensor) -> Tensor:
            part = part.detach().to(self.dtype)
            return part if n_padded == n_rows else part[row_indices]

        def empty(*sizes: int) -> Tensor:
            return torch.empty(*sizes, n_padded, dtype=self.dtype)

        states = empty(n_steps + 1, self.sizes["x"])
        memories = [
            empty(n_steps + 1 if keep_history else 2, self.sizes[name]) for name in ("s", "q")
        ]
        for history, initial in zip((states, *memories), (x, s, q), strict=True):
            history[0] = pad_rows(initial).T
        inputs = pad_rows(w).permute(1, 2, 0).contiguous()
        applied = empty(n_steps, self.sizes["a"])
        stored = self.allocate(n_blocks, n_steps if keep_history else 0, self.forward_storage)
        rows = pad_rows(row_values).T.contiguous()
        tensors = [theta.detach(), tables.detach(), rows, states, inputs, *memories]
        self.call_library(
            "run_forward", n_blocks, *tensors, applied, stored, int(keep_history), n_steps, n_padded
        )
        # without history two buffers alternate
        final_memory = memories[0][n_steps if keep_history else n_steps & 1]
        result = (
            states.permute(2, 0, 1)[:n_rows],
            applied.permute(2, 0, 1)[:n_rows],
            final_memory.T[:n_rows],
        )
        return result, [*tensors, stored]

    def allocate(self, n_blocks: int, n_steps: int, layout: Mapping[str, slice]) -> Tensor:
        """Return uninitialised storage of a layout for each block and step."""
        return torch.empty(
            n_blocks * n_steps, count_stored_values(layout), self.n_lanes, dtype=self.dtype
        )

    def call_library(self, name: str, n_blocks: int, *arguments: Tensor | int) -> None:
        """Call a function of the library for all blocks of rows, in parallel on idle cores."""
        function = getattr(self.library, name)
        values = [
            ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_long(a)
            for a in arguments
        ]
        n_threads = min(max(torch.get_num_threads(), available_cores()), n_blocks)
        boundaries = [ctypes.c_long(n_blocks * k // n_threads) for k in range(n_threads + 1)]
        if n_threads == 1:
            function(*values, *boundaries)
            return
        with ThreadPoolExecutor(n_threads) as pool:
            list(
                pool.map(lambda block_range: function(*values, *block_range), pairwise(boundaries))
            )


class _CompiledRun(torch.autograd.Function):
    """The compiled rollout as an operation of torch with a gradient."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return states [B, T+1, nx], inputs [B, T, m] and the last memory [B, n].

        The arguments are theta, tables, x, s, row tensors, w, q, and the compiled rollout.
        """
        *tensors, compiled = arguments
        result: tuple[Tensor, Tensor, Tensor]
        result, history = compiled.run_forward(*tensors, keep_history=True)
        ctx.compiled = compiled
        ctx.n_rows = len(result[0])
        ctx.save_for_backward(*history)
        return result

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of theta, tables, x and s."""
        history = ctx.saved_tensors
        compiled = ctx.compiled
        n_rows = ctx.n_rows
        n_steps, _, n_padded = history[4].shape
        cotangents = []
        for grad in (grads[0], grads[1], grads[2][:, None]):
            padded = torch.zeros(*grad.shape[1:], n_padded, dtype=compiled.dtype)
            padded[:, :, :n_rows] = grad.permute(1, 2, 0)
            cotangents.append(padded)
        # the gradient is accumulated for each row, so that the sum over rows does not depend on the
        # number of threads
        n_blocks = n_padded // compiled.n_lanes
        n_theta = len(compiled.trained_indices)
        backward_storage = compiled.allocate(n_blocks, n_steps, compiled.backward_storage)
        products = [
            (k, product)
            for k, product in enumerate(compiled.parts.products)
            if not product.activation
        ]
        n_matrix_entries = (
            sum(product.matrix_size for _, product in products) if compiled.has_row_gradients else 0
        )
        row_gradients = torch.zeros(
            n_blocks, n_theta + n_matrix_entries, compiled.n_lanes, dtype=compiled.dtype
        )
        compiled.call_library(
            "run_backward",
            n_blocks,
            *history,
            *cotangents,
            backward_storage,
            row_gradients,
            n_steps,
            n_padded,
        )
        rows = row_gradients.transpose(1, 2).reshape(n_padded, -1)[:n_rows]
        if not math.isinf(compiled.max_gradient_ratio):
            cotangent_square = sum(grad.flatten(1).square().sum(1) for grad in grads)
            rows = _clip_row_gradients(
                rows, torch.as_tensor(cotangent_square).sqrt(), compiled.max_gradient_ratio
            )
        theta_gradient, tables = rows.sum(0).split([n_theta, n_matrix_entries])
        if not compiled.has_row_gradients:
            gradient_of_product: dict[int, Tensor] = {}
            layout = compiled.backward_storage
            # products with one cotangent have adjacent factors: their matrices get their gradients
            # in one batched product of stored factors and cotangents
            ordered_products = sorted(
                products, key=lambda p: compiled.forward_storage[f"factor_{p[0]}"].start
            )
            for _, group in groupby(
                ordered_products, lambda p: layout[f"product_{p[0]}_cotangent"].start
            ):
                group_products = [*group]
                (k, product) = group_products[0]
                last_factor = compiled.forward_storage[f"factor_{group_products[-1][0]}"]
                factor_range = slice(
                    compiled.forward_storage[f"factor_{k}"].start, last_factor.stop
                )
                factor = history[-1][:, factor_range].unflatten(1, (product.n_repeats, -1))
                cotangent = backward_storage[:, layout[f"product_{k}_cotangent"]].unflatten(
                    1, (product.n_repeats, -1)
                )
                gradient = torch.zeros(factor.shape[2], product.n_outputs, dtype=compiled.dtype)
                for a, b in zip(factor.unbind(1), cotangent.unbind(1), strict=True):
                    gradient.addbmm_(a, b.transpose(1, 2))
                parts = gradient.split([member.n_inputs for _, member in group_products])
                gradient_of_product |= {
                    k: part for (k, _), part in zip(group_products, parts, strict=True)
                }
            tables = _concatenate([gradient_of_product[k] for k, _ in products])
        theta = torch.zeros(len(history[0]), dtype=compiled.dtype)
        theta[compiled.trained_indices] = theta_gradient
        x, s = cotangents[0][0].T[:n_rows], cotangents[2][0].T[:n_rows]
        return theta, tables, x, s, *[None] * 4


def _clip_row_gradients(gradients: Tensor, cotangent_norm: Tensor, max_ratio: float) -> Tensor:
    """Scale down the gradients of rows whose ratio to their cotangents is exceptionally large.

    Args:
        gradients: gradient of each row [B, n].
        cotangent_norm: norm of each row's cotangent [B].
        max_ratio: largest ratio of gradient and cotangent as a multiple of the median ratio.
    """
    gradient_norm = gradients.norm(dim=1)
    ratio = gradient_norm / cotangent_norm.clamp(min=1e-30)
    median_ratio = (
        ratio[cotangent_norm > 0].nanmedian()
        if bool((cotangent_norm > 0).any())
        else ratio.new_zeros(())
    )
    factor = (max_ratio * median_ratio * cotangent_norm / gradient_norm.clamp(min=1e-30)).clamp(
        max=1.0
    )
    # gradients that are not finite carry no information
    return torch.where(torch.isfinite(gradient_norm)[:, None], gradients * factor[:, None], 0.0)


def named_tensors(rollout: Rollout) -> dict[str, Tensor]:
    """Return the parameters and buffers of a rollout by name."""
    # `named_parameters` and `named_buffers` would take half the time of a short run
    return {
        f"{module_name}.{name}" if module_name else name: tensor
        for module_name, module in rollout.named_modules()
        for tensors in (module._parameters, module._buffers)
        for name, tensor in tensors.items()
        if tensor is not None
    }


def _call_with_tensors(
    step: nn.Module, tensors: Mapping[str, Tensor], arguments: tuple[Tensor, ...]
) -> Any:
    """Call the step of a rollout with other parameters and buffers."""
    tensors = {f"rollout.{name}": tensor for name, tensor in tensors.items()}
    # a tensor shared by two modules would be replaced twice and restored once
    return torch.func.functional_call(step, tensors, arguments, tie_weights=False)


def _concatenate(parts: Sequence[Tensor]) -> Tensor:
    """Return all entries of tensors in one vector, empty for no tensors."""
    return torch.cat([torch.zeros(0), *(part.flatten() for part in parts)])
