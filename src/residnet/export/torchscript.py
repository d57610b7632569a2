"""Export to TorchScript: one file that a controller loads with torch alone.

The exported module works in float32 at a fixed step and is frozen; its card is an extra file of the
archive. TorchScript is code: load only files that you trust.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.layout import RANGE_INPUTS, motion
from residnet.core.names import STATE
from residnet.core.version import __version__
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.store import ModelSpec
from residnet.export.base import Exporter
from residnet.export.guard import GuardedDynamics
from residnet.export.scripting import require_shape, size, write_scripted

PARITY_STEPS = 1000
PARITY_TOLERANCE = 1e-5
_METHODS = ["initial_state", "warmup", "step", "rollout"]


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
    model = model.to(torch.float32).eval().requires_grad_(False)
    return write_scripted(
        file,
        ExportedModel(model, spec).eval(),
        _METHODS,
        lambda exported: check_parity(spec, model, exported),
        lambda parity: make_card(spec, model, metrics, parity),
    )


def check_parity(spec: ModelSpec, model: HybridDynamics, exported: Any) -> dict[str, float]:
    """Return the largest difference of each state between model and exported module.

    It is a share of the state's range.

    They run 1,000 steps from a warmed-up memory.

    Inputs sweep the training range as slow sines, so that the run passes through what the model
    knows.

    Raises:
        ExportError: where a share exceeds 1e-5, or the model itself leaves what exports accept.
    """
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    past = 50
    steps = torch.arange(PARITY_STEPS + past, dtype=torch.float32)
    phase = torch.arange(low.numel() - 3, dtype=torch.float32)
    sweep = 0.5 + 0.4 * torch.sin(0.02 * (1 + 0.37 * phase)[None] * steps[:, None] + phase[None])
    w = (low[RANGE_INPUTS] + sweep * (high - low)[RANGE_INPUTS]).unsqueeze(0)
    y = torch.zeros(1, past, len(STATE))
    y[:, :, 3] = 0.5 * (low[0] + high[0])
    x = y[:, -1].clone()
    with torch.no_grad():
        s = model.warmup(y, w[:, :past])
        eager, _, _ = Rollout(model)(x, w[:, past:], s)
        _require_sound(spec, model, eager)
        scripted = [x]
        memory = exported.warmup(y, w[:, :past])
        for k in range(PARITY_STEPS):
            x, memory, _ = exported.step(x, w[:, past + k], memory)
            scripted.append(x)
        together, _, _ = exported.rollout(scripted[0], w[:, past:], exported.warmup(y, w[:, :past]))
    single = torch.stack(scripted, dim=1)
    span = (eager.amax(1) - eager.amin(1)).clamp(min=1e-6)
    worst = torch.maximum((single - eager).abs(), (together - eager).abs()).amax(1) / span
    shares = {name: float(value) for name, value in zip(STATE, worst[0], strict=True)}
    if not bool((worst <= PARITY_TOLERANCE).all()):
        raise ExportError(
            f"model {spec.name}: the exported module differs from the model by {shares} of each"
            f" channel's range over {PARITY_STEPS} steps; allowed {PARITY_TOLERANCE:g}"
        )
    return shares


def _require_sound(spec: ModelSpec, model: HybridDynamics, states: Tensor) -> None:
    """Refuse a model that diverges in a free run whose inputs stay within the training range.

    Raises:
        ExportError: that names the first step and channel beyond what exports accept.
    """
    guard = GuardedDynamics(model, spec)
    least, most = motion(guard.least), motion(guard.most)
    wrong = ~((states[0] >= least) & (states[0] <= most))
    if not bool(wrong.any()):
        return
    k = int(wrong.any(dim=1).to(torch.int).argmax())
    i = int(wrong[k].to(torch.int).argmax())
    raise ExportError(
        f"model {spec.name}: diverges in the export's free run, though its inputs stay within the"
        f" training range: {STATE[i]} is {float(states[0, k, i]):.3g} after {k * spec.dt:g} s,"
        f" accepted {float(least[i]):.3g} to {float(most[i]):.3g}; not exported, choose another"
        " model"
    )


def make_card(
    spec: ModelSpec,
    model: HybridDynamics,
    metrics: Sequence[Mapping[str, Any]],
    parity: Mapping[str, float],
) -> dict[str, Any]:
    """Return the model card: all that a user needs to drive the module, and how good it is."""
    units = spec.signals.units()
    guard = GuardedDynamics(model, spec)
    accepted = torch.stack((guard.least, guard.most), dim=1).tolist()
    return {
        "schema": "residnet.card/1",
        "model": spec.name,
        "states": [{"name": name, "unit": units[name]} for name in STATE],
        "inputs": [
            {
                "name": name,
                "unit": units[name],
                "role": "command" if name in spec.signals.inputs else "exogenous",
            }
            for name in spec.signals.columns
        ],
        "inputs_held": {
            "start": "the sample at the step's start",
            "mean": "the mean of the samples at the step's start and end",
        }[spec.hold],
        "memory": model.n_state,
        "dt": spec.dt,
        "integrator": spec.integrator,
        "dtype": "float32",
        "frame": (
            "NED; body axes x forward, y starboard, z down; psi unwrapped, clockwise from north;"
            " wind_dir is where the wind comes from"
        ),
        "training_range": {name: list(limits) for name, limits in spec.ranges.items()},
        "bad_inputs": {
            "rules": (
                "an entry that is no number becomes the one under `substitute`, any other beyond"
                " `accepted` the nearest value of its training range; a memory that is not finite"
                " or beyond what the head can have begins anew; a step that would leave `accepted`"
                " is held at its edge; `outside` is then true"
            ),
            "accepted": dict(zip(units, accepted, strict=True)),
            "substitute": dict(zip(units, guard.middle.tolist(), strict=True)),
        },
        "baseline": spec.baseline.model_dump(mode="json"),
        "head": None if spec.head is None else spec.head.model_dump(mode="json"),
        "members": [
            member.model_dump(mode="json", include={"name", "baseline", "head"})
            for member in spec.members
        ],
        "metrics": [dict(row) for row in metrics],
        "parity": {"steps": PARITY_STEPS, "share_of_range": dict(parity)},
        "versions": {"residnet": __version__, "torch": torch.__version__},
        "exported": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "safety": (
            "TorchScript is code that runs when loaded: load only files that you trust. The files"
            " under models/ hold numbers only."
        ),
    }


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
