"""The C source of a closed loop: a step, its gradient, and whole flights of a block of rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from residnet.dynamics.rollout import Rollout
from residnet.export.c.lanes import LanesBody, prelude
from residnet.export.lowering.build import lowered
from residnet.export.lowering.program import Program

_HANDED_ON = ("x", "s", "q")
"""State, memory of the vessel and memory of the controller, which a step hands on."""
_WHAT = "closed loop"


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


def loop_source(
    rollout: Rollout,
    examples: Sequence[Tensor],
    shared: Mapping[str, Tensor],
    own: Mapping[str, Tensor],
    sizes: Mapping[str, int],
    dtype: torch.dtype,
    gradient: bool,
) -> str:
    """Return the source file with the functions `fly` and, where it is wanted, `back`.

    Args:
        rollout: the closed loop in float64.
        examples: x, w, s, q, shared and own numbers of a row, each [1, n].
        shared: numbers of the loop that all rows share, as one row has them.
        own: numbers that every row has for itself.
        sizes: number of entries of each example, and `a` of what acts.
        dtype: precision of the file.
        gradient: whether the gradient for the shared numbers is written.
    """
    one, groups = _Step(rollout), (shared, own)

    def step(x: Tensor, w: Tensor, s: Tensor, q: Tensor, *numbers: Tensor) -> Any:
        weights = {}
        for group, given in zip(groups, numbers, strict=True):
            pieces = given[0].split([part.numel() for part in group.values()])
            for (name, part), piece in zip(group.items(), pieces, strict=True):
                weights[f"rollout.{name}"] = piece.reshape(part.shape)
        return torch.func.functional_call(one, weights, (x, w, s, q))

    def back(
        x: Tensor, w: Tensor, s: Tensor, q: Tensor, theta: Tensor, own: Tensor, *given: Tensor
    ) -> Any:
        pull = torch.func.vjp(lambda x, s, q, theta: step(x, w, s, q, theta, own), x, s, q, theta)[
            1
        ]
        return pull(given)

    arguments = [(name, sizes[name]) for name in ("x", "w", "s", "q", "theta", "own")]
    after = [f"{name}_after" for name in (*_HANDED_ON, "a")]
    functions = [_function("step", lowered(step, arguments, after, _WHAT, examples))]
    if gradient:
        slopes = [(f"{name}_slope", sizes[name]) for name in (*_HANDED_ON, "a")]
        ones = [torch.ones(1, length, dtype=torch.float64) for _, length in slopes]
        found = [*(f"{name}_before" for name in _HANDED_ON), "total"]
        program = lowered(back, [*arguments, *slopes], found, _WHAT, [*examples, *ones])
        functions.append(_function("slope", program))
    numbers = "".join(f"#define N_{name.upper()} {value}L\n" for name, value in sizes.items())
    return "".join((prelude(dtype), numbers, _AT, *functions, FLY, *([BACK] if gradient else [])))


def _function(name: str, program: Program) -> str:
    """Return the C function of a step for a block of rows."""
    body = LanesBody(program, {"theta"}, {"total"}, _WHAT).write()
    given = [f"const REAL *restrict {block.name}" for block in program.arguments]
    taken = [f"REAL *restrict {result}" for result, _, _ in program.results]
    head = f"static void {name}({', '.join((*given, *taken))}, const long stride)"
    return head + " {\n" + "\n".join(body) + "\n}\n"


_AT = """
#define AT(array, n, k) (array + (n) * (k) * width + block * LANES)
#define ROOM(n) (((n) ? (n) : 1) * LANES)
#define TAKE(to, n, from) for (long i = 0; i < n; i++) EACH to[i * LANES + l] = from[i * width + l];
"""
FLY = """
void fly(const REAL *theta, const REAL *own, REAL *x, const REAL *w, REAL *s, REAL *q, REAL *a,
         long steps, long width, long block) {
    for (long k = 0; k < steps; k++)
        step(AT(x, N_X, k), AT(w, N_W, k), AT(s, N_S, k), AT(q, N_Q, k), theta, AT(own, N_OWN, 0),
             AT(x, N_X, k + 1), AT(s, N_S, k + 1), AT(q, N_Q, k + 1), AT(a, N_A, k), width);
}
"""
BACK = """
void back(const REAL *theta, const REAL *own, const REAL *x, const REAL *w, const REAL *s,
          const REAL *q, REAL *gx, const REAL *ga, REAL *total,
          long steps, long width, long block) {
    REAL slope_s[2][ROOM(N_S)], slope_q[2][ROOM(N_Q)], at_own[ROOM(N_OWN)];
    memset(slope_s, 0, sizeof slope_s);
    memset(slope_q, 0, sizeof slope_q);
    TAKE(at_own, N_OWN, AT(own, N_OWN, 0))
    for (long k = steps - 1; k >= 0; k--) {
        REAL slope_x[ROOM(N_X)], slope_a[ROOM(N_A)], before_x[ROOM(N_X)];
        REAL at_x[ROOM(N_X)], at_w[ROOM(N_W)], at_s[ROOM(N_S)], at_q[ROOM(N_Q)];
        TAKE(slope_x, N_X, AT(gx, N_X, k + 1))
        TAKE(slope_a, N_A, AT(ga, N_A, k))
        TAKE(at_x, N_X, AT(x, N_X, k))
        TAKE(at_w, N_W, AT(w, N_W, k))
        TAKE(at_s, N_S, AT(s, N_S, k))
        TAKE(at_q, N_Q, AT(q, N_Q, k))
        slope(at_x, at_w, at_s, at_q, theta, at_own, slope_x, slope_s[k & 1], slope_q[k & 1],
              slope_a, before_x, slope_s[~k & 1], slope_q[~k & 1],
              total + block * N_THETA * LANES, LANES);
        for (long i = 0; i < N_X; i++) EACH
            AT(gx, N_X, k)[i * width + l] += before_x[i * LANES + l];
    }
}
"""
"""The slope of the state at a step's end is what came from outside and from the steps after it."""
