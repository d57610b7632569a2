"""A closed loop and its gradient as compiled C: many flights at once, trained through in no time.

Torch records one step of the loop, and the product of a step's Jacobian with a gradient; both are
written as C for blocks of rows, compiled for this machine and called for whole flights.
"""

from __future__ import annotations

import copy
import ctypes
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.dynamics.rollout import Rollout
from residnet.export.c.compiled import compiler
from residnet.export.c.lanes import PRELUDE, LanesBody
from residnet.export.lowering.build import lowered
from residnet.export.lowering.program import Program

LANES = 16
"""Rows of a block."""
_FLAGS = ("-O2", "-ftree-vectorize", "-ffast-math", "-march=native", "-fPIC", "-shared", "-w")
_CHECKED, _SAME = 40, 5e-3
"""Steps of the flight that the compiled loop is checked by, and how far it may be off."""
_MEMORY = ("x", "s", "q")
"""What a step hands on: state, memory of the vessel, memory of the controller."""


@dataclass(frozen=True)
class _Sizes:
    """Numbers of entries by name: x, w, s, q, a (what acts) and theta (trained numbers)."""

    x: int
    w: int
    s: int
    q: int
    a: int
    theta: int


class _Step(nn.Module):
    """One step of a closed loop."""

    def __init__(self, rollout: Rollout) -> None:
        super().__init__()
        self.rollout = rollout

    def forward(self, x: Tensor, w: Tensor, s: Tensor, q: Tensor) -> tuple[Tensor, ...]:
        """Return state, memory of the vessel, memory of the controller, and what acted."""
        acting, q = self.rollout.source(x, w, 0, q)
        x, s = self.rollout.model.step(x, acting, s)
        return x, s, q, acting


@final
class CompiledLoop:
    """The flights of a closed loop, with a gradient for the numbers that are trained.

    Args:
        rollout: the closed loop, whose source does not count steps.
        x, w, s: examples of its arguments, [B, nx], [B, T, m] and [B, n].

    Raises:
        ExportError: where a step cannot be recorded or written, or no C compiler does its work.
    """

    def __init__(self, rollout: Rollout, x: Tensor, w: Tensor, s: Tensor) -> None:
        self.rollout = rollout
        self.trained = [name for name, p in rollout.named_parameters() if p.requires_grad]
        alone = copy.deepcopy(rollout).double()
        given = (x[:1].double(), w[:1, 0].double(), s[:1].double())
        with torch.no_grad():
            q = alone.source.initial(given[0])
            acting = alone.source(given[0], given[1], 0, q)[0]
        own = dict(alone.named_parameters())
        parts = [own[name].detach() for name in self.trained]
        theta = torch.cat([part.reshape(-1) for part in parts])[None]
        self.sizes = _Sizes(*(part.shape[1] for part in (*given, q, acting, theta)))
        programs = _recorded(alone, self.trained, parts, [*given, q, theta], self.sizes)
        self.library = _library(_source(*programs))
        self.pool = ThreadPoolExecutor(max(torch.get_num_threads(), 1))
        self._check(x, w[:, :_CHECKED], s)

    def __call__(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return states [B, T+1, nx] and inputs that acted [B, T, m], float32."""
        own = dict(self.rollout.named_parameters())
        theta = torch.cat([own[name].reshape(-1) for name in self.trained])
        q = self.rollout.source.initial(x)
        apply: Any = _Flight.apply
        found: tuple[Tensor, Tensor] = apply(theta, x, w, s, q, self)
        return found

    def _check(self, x: Tensor, w: Tensor, s: Tensor) -> None:
        """Compare a short flight and its gradient with those of the closed loop itself.

        Raises:
            ExportError: where they differ by more than single precision explains.
        """
        own = dict(self.rollout.named_parameters())
        weights = [own[name] for name in self.trained]
        found = []
        for flown in (self(x, w, s), self.rollout(x, w, s)[:2]):
            slopes = torch.autograd.grad(flown[0].square().mean() + flown[1].sum(), weights)
            slope = torch.cat([part.reshape(-1) for part in slopes])
            found.append((flown[0].detach(), flown[1].detach(), slope))
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
    def forward(
        ctx: Any,
        theta: Tensor,
        x: Tensor,
        w: Tensor,
        s: Tensor,
        q: Tensor,
        loop: CompiledLoop,
    ) -> tuple[Tensor, Tensor]:
        """Return states [B, T+1, nx] and inputs [B, T, m]."""
        rows, steps = w.shape[:2]
        blocks = -(-rows // LANES)
        size, width = loop.sizes, blocks * LANES
        first = torch.arange(width).clamp(max=rows - 1)
        kept = [torch.empty(steps + 1, part.shape[1], width) for part in (x, s, q)]
        for whole, start in zip(kept, (x, s, q), strict=True):
            whole[0] = start.float()[first].T
        inputs = w.float()[first].permute(1, 2, 0).contiguous()
        acting = torch.empty(steps, size.a, width)
        theta = theta.float().contiguous()
        loop.run("fly", blocks, theta, kept[0], inputs, kept[1], kept[2], acting, steps, width)
        ctx.loop, ctx.rows = loop, rows
        ctx.save_for_backward(theta, *kept, inputs)
        return kept[0].permute(2, 0, 1)[:rows], acting.permute(2, 0, 1)[:rows]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradient of the trained numbers; nothing else has one."""
        theta, x, s, q, w = ctx.saved_tensors
        loop, steps, width = ctx.loop, w.shape[0], w.shape[2]
        given = []
        for grad in grads:
            whole = torch.zeros(grad.shape[1], grad.shape[2], width)
            whole[:, :, : ctx.rows] = grad.permute(1, 2, 0)
            given.append(whole)
        blocks = width // LANES
        total = torch.zeros(blocks, loop.sizes.theta, LANES)
        loop.run("back", blocks, theta, x, w, s, q, *given, total, steps, width)
        return total.sum((0, 2)), None, None, None, None, None


def _recorded(
    rollout: Rollout,
    trained: list[str],
    parts: list[Tensor],
    examples: list[Tensor],
    size: _Sizes,
) -> tuple[Program, Program]:
    """Return the program of a step, and that of its gradient."""
    one, lengths = _Step(rollout), [part.numel() for part in parts]

    def step(x: Tensor, w: Tensor, s: Tensor, q: Tensor, theta: Tensor) -> Any:
        pieces = zip(trained, theta[0].split(lengths), parts, strict=True)
        weights = {f"rollout.{name}": piece.reshape(part.shape) for name, piece, part in pieces}
        return torch.func.functional_call(one, weights, (x, w, s, q))

    def back(x: Tensor, w: Tensor, s: Tensor, q: Tensor, theta: Tensor, *given: Tensor) -> Any:
        pull = torch.func.vjp(lambda x, s, q, theta: step(x, w, s, q, theta), x, s, q, theta)[1]
        return pull(given)

    names = ["x", "w", "s", "q", "theta"]
    arguments = [(name, getattr(size, name)) for name in names]
    after = [(f"{name}_after", getattr(size, name)) for name in (*_MEMORY, "a")]
    slopes = [(f"{name}_slope", getattr(size, name)) for name in (*_MEMORY, "a")]
    what = "closed loop"
    forward = lowered(step, arguments, [name for name, _ in after], what, examples)
    ones = [torch.ones(1, length, dtype=torch.float64) for _, length in slopes]
    found = [f"{name}_before" for name in _MEMORY] + ["total"]
    backward = lowered(back, [*arguments, *slopes], found, what, [*examples, *ones])
    return forward, backward


def _function(name: str, program: Program) -> str:
    """Return the C function of a step for a block of rows."""
    body = LanesBody(program, {"theta"}, {"total"}, "closed loop").write()
    given = [f"const float *restrict {block.name}" for block in program.arguments]
    taken = [f"float *restrict {result}" for result, _, _ in program.results]
    head = f"static void {name}({', '.join((*given, *taken))}, const long stride)"
    return head + " {\n" + "\n".join(body) + "\n}\n"


def _source(forward: Program, backward: Program) -> str:
    """Return the source file: functions `fly` and `back` for the flights of a block of rows."""
    size = {block.name: block.size for block in forward.arguments}
    size["a"] = next(cells.size for name, _, cells in forward.results if name == "a_after")
    sizes = "".join(f"#define N_{name.upper()} {value}L\n" for name, value in size.items())
    return (
        f"#define LANES {LANES}\n"
        + PRELUDE
        + "#define AT(array, n, k) (array + (n) * (k) * width + block * LANES)\n"
        + sizes
        + _function("step", forward)
        + _function("slope", backward)
        + _DRIVERS
    )


_DRIVERS = """
void fly(const float *theta, float *x, const float *w, float *s, float *q, float *a,
         long steps, long width, long block) {
    for (long k = 0; k < steps; k++)
        step(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, k), AT(q, N_Q, k), theta,
             AT(x, N_X, k + 1), AT(s, N_S, k + 1), AT(q, N_Q, k + 1), AT(a, N_A, k), width);
}

/* the slopes of what a step hands on lie side by side, as wide as all rows */
void back(const float *theta, const float *x, const float *w, const float *s, const float *q,
          float *gx, const float *ga, float *total, long steps, long width, long block) {
    float slope_s[2][(N_S ? N_S : 1) * LANES], slope_q[2][(N_Q ? N_Q : 1) * LANES];
    memset(slope_s, 0, sizeof slope_s);
    memset(slope_q, 0, sizeof slope_q);
    for (long k = steps - 1; k >= 0; k--) {
        float slope_x[N_X * LANES], slope_a[N_A * LANES];
        float before_x[N_X * LANES];
        float at_x[N_X * LANES], at_w[N_W * LANES];
        float at_s[(N_S ? N_S : 1) * LANES], at_q[(N_Q ? N_Q : 1) * LANES];
        for (long i = 0; i < N_X; i++) EACH {
            slope_x[i * LANES + l] = AT(gx, N_X, k + 1)[i * width + l];
            at_x[i * LANES + l] = AT(x, N_X, k)[i * width + l];
        }
        for (long i = 0; i < N_A; i++) EACH
            slope_a[i * LANES + l] = AT(ga, N_A, k)[i * width + l];
        for (long i = 0; i < N_W; i++) EACH at_w[i * LANES + l] = AT(w, N_W, k)[i * width + l];
        for (long i = 0; i < N_S; i++) EACH at_s[i * LANES + l] = AT(s, N_S, k)[i * width + l];
        for (long i = 0; i < N_Q; i++) EACH at_q[i * LANES + l] = AT(q, N_Q, k)[i * width + l];
        slope(at_x, at_w, at_s, at_q, theta, slope_x, slope_s[k & 1], slope_q[k & 1], slope_a,
              before_x, slope_s[~k & 1], slope_q[~k & 1], total + block * N_THETA * LANES, LANES);
        for (long i = 0; i < N_X; i++) EACH
            AT(gx, N_X, k)[i * width + l] += before_x[i * LANES + l];
    }
}
"""


def _library(source: str) -> ctypes.CDLL:
    """Compile a source file for this machine and load it.

    Raises:
        ExportError: where there is no compiler, or it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        file, out = Path(folder) / "closed_loop.c", Path(folder) / "closed_loop.so"
        file.write_text(source)
        call = [compiler(), "-std=gnu99", *_FLAGS, str(file), "-o", str(out), "-lm"]
        done = subprocess.run(call, capture_output=True, text=True)
        if done.returncode:
            said = done.stderr.strip().splitlines() or ["no message"]
            raise ExportError(f"the closed loop does not compile ({said[0]})")
        return ctypes.CDLL(str(out))
