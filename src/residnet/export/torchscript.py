"""Export to TorchScript: one file that a controller loads with torch alone.

The exported module works in float32 at a fixed step and is frozen; its card is an extra file of the
archive. TorchScript is code: load only files that you trust.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.names import STATE
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec
from residnet.export import contract
from residnet.export.base import Exporter
from residnet.export.card import make_card
from residnet.export.contract import PAST, SINGLE, drive, require_numbers, require_sound
from residnet.export.guard import GuardedDynamics
from residnet.export.scripting import require_shape, size, write_scripted

_SETTINGS = {
    "format": "torchscript",
    "safety": (
        "TorchScript is code that runs when loaded: load only files that you trust. The files under"
        " models/ hold numbers only."
    ),
    "executor": {
        "threads": 1,
        "profiling_mode": False,
        "optimize": False,
        "why": (
            "torch's profiling executor compiles during the first calls, which then take hundreds"
            " of steps; so set, the first call is as quick as the others"
        ),
        "python": (
            "torch.set_num_threads(1); torch._C._jit_set_profiling_executor(False);"
            " torch._C._set_graph_executor_optimize(False)"
        ),
        "c++": (
            "at::set_num_threads(1); torch::jit::getProfilingMode() = false;"
            " torch::jit::setGraphExecutorOptimize(false)"
        ),
    },
}
"""What the card of this format says besides: the settings that make its first call quick."""
_METHODS = ["initial_state", "warmup", "step", "rollout", "band"]


class ExportedModel(nn.Module):
    """What a controller sees; all tensors are float32, SI and radians.

    Bad inputs and memories are treated as `residnet.export.guard` says: a flag and a finite answer.
    Tensors of a wrong shape are refused, never broadcast; other precisions are converted.
    """

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__()
        self.guarded = GuardedDynamics(model, spec)
        self.simulate = Rollout(self.guarded)
        self.inputs = len(spec.signals.columns)
        self.states = len(STATE)
        self.n_state = model.n_state
        known = spec.band
        self.register_buffer("band_steps", torch.tensor([1.0] if known is None else known.steps))
        self.register_buffer(
            "band_widths",
            torch.full((1, 5), torch.inf) if known is None else torch.tensor(known.columns).T,
        )
        self.band_steps: Tensor
        self.band_widths: Tensor

    @torch.jit.export
    def band(self, k: int) -> Tensor:
        """Return the half widths [5] of u, v, r, heading and position k steps after a measurement.

        They are zero at k = 0, grow in proportion to time beyond the calibrated horizon, and are
        infinite where the model has no band.
        """
        steps, widths = self.band_steps.to(torch.float32), self.band_widths.to(torch.float32)
        if k <= 0:
            return torch.zeros_like(widths[0])
        last = steps.shape[0] - 1
        if k >= int(steps[last]):
            return widths[last] * (float(k) / float(steps[last]))
        after = int((steps <= k).sum())
        share = (float(k) - float(steps[after - 1])) / float(steps[after] - steps[after - 1])
        return widths[after - 1] + share * (widths[after] - widths[after - 1])

    @torch.jit.export
    def initial_state(self, batch: int) -> Tensor:
        """Return the memory s [batch, n_state] without a past."""
        return self.guarded.initial_state(batch)

    @torch.jit.export
    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory s [B, n_state] that a measured past leaves.

        Samples that are no measurements are left out: the last one before them stands for them.

        Args:
            y_history: states [B, T, 6], oldest first.
            w_history: inputs [B, T, m], oldest first.
        """
        rows, steps = size(y_history, 3, 0), size(y_history, 3, 1)
        require_shape("y_history", y_history, [rows, steps, self.states])
        require_shape("w_history", w_history, [rows, steps, self.inputs])
        s: Tensor = self.guarded.warmup(y_history.to(torch.float32), w_history.to(torch.float32))
        return s

    @torch.jit.export
    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state [B, 6] and memory after one step under inputs w [B, m], and a flag.

        `outside` [B] is True where a velocity or an input is beyond the training range, an entry or
        the memory is not finite, or the step was held.
        """
        rows = size(x, 2, 0)
        require_shape("x", x, [rows, self.states])
        require_shape("w", w, [rows, self.inputs])
        require_shape("s", s, [rows, self.n_state])
        return self.guarded.flagged_step(
            x.to(torch.float32), w.to(torch.float32), s.to(torch.float32)
        )

    @torch.jit.export
    def rollout(self, x0: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the states [B, T+1, 6] from x0 [B, 6] on under inputs w [B, T, m].

        Behind them stand the memory [B, n_state] after the last step and `outside` [B, T], the flag
        of each step.
        """
        rows, steps = size(x0, 2, 0), size(w, 3, 1)
        require_shape("x0", x0, [rows, self.states])
        require_shape("w", w, [rows, steps, self.inputs])
        require_shape("s", s, [rows, self.n_state])
        x0 = x0.to(torch.float32)
        start = torch.cat((self.guarded.accept_state(x0), torch.zeros_like(x0[:, :1])), dim=-1)
        # the first step sees x0 as it was given, for its flag
        states, _, s = self.simulate(
            torch.cat((x0, torch.zeros_like(x0[:, :1])), dim=-1),
            w.to(torch.float32),
            s.to(torch.float32),
        )
        states = torch.cat((start.unsqueeze(1), states[:, 1:]), dim=1)
        return states[..., : self.states], s, states[:, 1:, self.states] > 0

    def forward(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return what `step` returns."""
        return self.step(x, w, s)


def export_torchscript(
    spec: ModelSpec, model: HybridDynamics, file: Path, metrics: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Write one model as TorchScript with its card, after a parity check.

    Args:
        spec: the model's description.
        model: the model; left in float32.
        file: where to write.
        metrics: rows of metrics.json of this model, for the card.

    Returns:
        The card.

    Raises:
        ExportError: where the exported module does not reproduce the model.
    """
    require_numbers(spec, model)
    model = model.to(torch.float32).eval().requires_grad_(False)
    return write_scripted(
        file,
        ExportedModel(model, spec).eval(),
        _METHODS,
        partial(check_parity, spec, model, driven=_driven(spec, model)),
        lambda parity: (
            make_card(
                spec, model, metrics, {"steps": contract.PARITY_STEPS, "share_of_range": parity}
            )
            | _SETTINGS
        ),
    )


def _driven(spec: ModelSpec, model: HybridDynamics) -> tuple[Tensor, Tensor, Tensor]:
    """Return past states [1, P, 6], inputs [1, P + T, m] and the model's own track [1, T + 1, 6].

    Raises:
        ExportError: where the model itself leaves what exports accept.
    """
    y, w = drive(spec, torch.float32)
    with torch.no_grad():
        s = model.warmup(y, w[:, :PAST])
        eager, _, _ = Rollout(model)(y[:, -1].clone(), w[:, PAST:], s)
        require_sound(spec, model, eager)
    return y, w, eager


def check_parity(
    spec: ModelSpec,
    model: HybridDynamics,
    exported: Any,
    driven: tuple[Tensor, Tensor, Tensor] | None = None,
) -> dict[str, float]:
    """Return the largest difference of each state between model and exported module.

    It is a share of the state's range, over 2,000 steps from a warmed-up memory.

    Raises:
        ExportError: where a share exceeds 1e-5, or the model itself leaves what exports accept.
    """
    y, w, eager = _driven(spec, model) if driven is None else driven
    x = y[:, -1].clone()
    with torch.no_grad():
        scripted = [x]
        memory = exported.warmup(y, w[:, :PAST])
        for k in range(PAST, w.shape[1]):
            x, memory, _ = exported.step(x, w[:, k], memory)
            scripted.append(x)
        together, _, _ = exported.rollout(scripted[0], w[:, PAST:], exported.warmup(y, w[:, :PAST]))
    single = torch.stack(scripted, dim=1)
    span = (eager.amax(1) - eager.amin(1)).clamp(min=1e-6)
    worst = torch.maximum((single - eager).abs(), (together - eager).abs()).amax(1) / span
    shares = {name: float(value) for name, value in zip(STATE, worst[0], strict=True)}
    if not bool((worst <= SINGLE).all()):
        raise ExportError(
            f"model {spec.name}: the exported module differs from the model by {shares} of each"
            f" channel's range over {w.shape[1] - PAST} steps; allowed {SINGLE:g}"
        )
    return shares


@final
class TorchScriptExporter(Exporter):
    """One file that a controller loads with torch alone."""

    name: ClassVar[str] = "torchscript"
    suffix: ClassVar[str] = ".pt"
    about: ClassVar[str] = "The model as TorchScript, which Python and C++ run with torch alone."

    def export(
        self,
        spec: ModelSpec,
        model: HybridDynamics,
        file: Path,
        rows: Sequence[Mapping[str, Any]],
    ) -> Mapping[str, Any]:
        """Write the model in float32 and return its card."""
        return export_torchscript(spec, model, file, rows)
