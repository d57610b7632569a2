"""A closed loop and its gradient as compiled C: many flights at once, and training through them.

One step of the loop becomes a CasADi function of single numbers. It and the product of its Jacobian
with a gradient are written for blocks of rows by the vector types that gcc and clang know, compiled
for this machine and called for whole flights.
"""

from __future__ import annotations

import copy
import ctypes
import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, final

import casadi as ca
import numpy as np
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.dynamics.rollout import Rollout
from residnet.export.c_code import FUNCTIONS, Body, Tables, compiled_library, literal
from residnet.export.lowering import in_numbers, lowered

_VISITED, _ROWS, _STEPS = 40, 16, 3
"""The compiled loop is checked over so many steps from every state that some flights visit in their
first steps: long enough that a step hands all on, too short for rounding to grow in a steep law.
"""
_SAME, _ROUNDED = 1e-6, 5e-3
"""How far it may be off: in double precision, and the median row in the precision of flights."""
_HANDED_ON = ("x", "s", "q")
"""State, memory of the vessel and memory of the controller, which a step hands on."""
_WHAT = "closed loop"
_TWO = ("atan2", "hypot", "pow", "fmod", "copysign")


_PRELUDE = (
    "#include <math.h>\n#include <string.h>\n"
    "#define ZERO ((REAL)0)\n#define ONE ((REAL)1)\n"
    "typedef REAL V __attribute__((vector_size(sizeof(REAL) * LANES)));\n"
    "typedef REAL U __attribute__((vector_size(sizeof(REAL) * LANES), aligned(4), may_alias));\n"
    "typedef INT I __attribute__((vector_size(sizeof(REAL) * LANES)));\n"
    "#define ALL(number) ((V){0} + (REAL)(number))\n"
    "#define EACH for (int l = 0; l < LANES; l++)\n"
    "static inline V pick(I c, V a, V b) { return (V)((c & (I)a) | (~c & (I)b)); }\n"
    + "".join(
        f"static __attribute__((noinline)) V v_{name}"
        + ("(V a, V b)" if name in _TWO else "(V a)")
        + f" {{ V o; EACH o[l] = R({name})(a[l]{', b[l]' if name in _TWO else ''}); return o; }}\n"
        for name in sorted(set(FUNCTIONS.values()))
    )
)


def prelude(dtype: torch.dtype) -> str:
    """Return what stands at the top of a file in this precision."""
    single = dtype == torch.float32
    words = {
        "LANES": lanes(dtype),
        "REAL": "float" if single else "double",
        "INT": "int" if single else "long long",
        "R(name)": "name##f" if single else "name",
        "BIG": "3e38f" if single else "1e308",
    }
    return "".join(f"#define {name} {text}\n" for name, text in words.items()) + _PRELUDE


def lanes(dtype: torch.dtype) -> int:
    """Return the number of rows of a block, which one vector of 64 bytes holds."""
    return 64 // dtype.itemsize


class _Lanes(Body):
    """Writes a function of single numbers for a block of `LANES` rows.

    An entry of an argument or result stands `stride` numbers behind the one before it, and the rows
    of an entry stand side by side. Numbers `theta` are shared by all rows, and results `total` are
    added up over all calls, for each lane by itself.
    """

    REAL, FLAG = "V", "I"
    unrolled = math.inf
    joined: Mapping[int, str] = {
        ca.OP_NOT: "~{0}", ca.OP_AND: "{0} & {1}", ca.OP_OR: "{0} | {1}"
    }  # fmt: skip

    def literal(self, value: float) -> str:
        return f"ALL({literal(value)})"

    def argument(self, name: str, place: int) -> str:
        if name == "theta":
            return f"ALL({name}[{place}])"
        return f"(*(const U *)({name} + {place} * stride))"

    def real(self, cell: str, flag: bool) -> str:
        return f"pick({cell}, ALL(ONE), ALL(ZERO))" if flag else cell

    def truth(self, cell: str, flag: bool) -> str:
        return cell if flag else f"({cell} != ZERO)"

    def pick(self, condition: str, value: str, alternative: str) -> str:
        return f"pick({condition}, {value}, {alternative})"

    def call(self, name: str, row: Sequence[str]) -> str:
        return f"v_{name}({', '.join(row)})"


def _function(name: str, function: ca.Function) -> str:
    """Return the C function of a step for a block of rows."""
    body = _Lanes(function, Tables(""), _WHAT)
    ends = [
        f"*(U *)({result} + {i} * LANES) += {cell};"
        if result == "total"
        else f"*(U *)({result} + {i} * stride) = {cell};"
        for result, cells in zip(function.name_out(), body.results, strict=True)
        for i, cell in enumerate(cells)
        if result != "total" or cell != body.zero
    ]
    given = [f"const REAL *restrict {argument}" for argument in body.names]
    taken = [f"REAL *restrict {result}" for result in function.name_out()]
    head = f"static void {name}({', '.join((*given, *taken))}, const long stride)"
    return head + " {\n" + "\n".join(body.read(ends)) + "\n}\n"


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

    arguments = [(name, sizes[name]) for name in _GIVEN]
    after = [f"{name}_after" for name in (*_HANDED_ON, "a")]
    function = in_numbers(lowered(step, arguments, after, _WHAT, examples, detached=gradient))
    functions = [_function("step", _flowing(function) if gradient else function)]
    if gradient:
        functions.append(_function("slope", _slope(function, sizes)))
    numbers = "".join(f"#define N_{name.upper()} {value}L\n" for name, value in sizes.items())
    return "".join((prelude(dtype), numbers, _AT, *functions, FLY, *([BACK] if gradient else [])))


_GIVEN = ("x", "w", "s", "q", "theta", "own")


def _known(step: ca.Function, found: ca.SX, given: Sequence[ca.SX]) -> ca.SX:
    """Return an expression of a step's arguments with what the step detaches put in."""
    apart, values = list(given[len(_GIVEN) :]), step.call(given)[len(_HANDED_ON) + 1 :]
    # what is detached may hang on what was detached before it
    for symbol, value in zip(reversed(apart), reversed(values), strict=True):
        found = ca.substitute(found, symbol, value)
    return found


def _flowing(step: ca.Function) -> ca.Function:
    """Return a step that computes what it detaches."""
    given = [ca.SX.sym(name, step.numel_in(name)) for name in step.name_in()]
    names = step.name_out()[: len(_HANDED_ON) + 1]
    found = [_known(step, part, given) for part in step.call(given)[: len(names)]]
    return ca.Function("step", given[: len(_GIVEN)], ca.cse(found), list(_GIVEN), names)


def _slope(step: ca.Function, sizes: Mapping[str, int]) -> ca.Function:
    """Return the product of a step's Jacobian with the slopes of what it gives."""
    given = [ca.SX.sym(name, step.numel_in(name)) for name in step.name_in()]
    slopes = [ca.SX.sym(f"{name}_slope", sizes[name]) for name in (*_HANDED_ON, "a")]
    x, _, s, q, theta, *_ = given
    known = ca.vertcat(x, s, q, theta)
    results = ca.vertcat(*step.call(given)[: len(slopes)])
    pulled = _known(step, ca.jtimes(results, known, ca.vertcat(*slopes), True), given)
    places = np.cumsum([0, *(sizes[name] for name in (*_HANDED_ON, "theta"))]).tolist()
    parts = [pulled[a:b] for a, b in pairwise(places)]
    names = [*_GIVEN, *(f"{name}_slope" for name in (*_HANDED_ON, "a"))]
    found = [*(f"{name}_before" for name in _HANDED_ON), "total"]
    return ca.Function("slope", [*given[: len(_GIVEN)], *slopes], ca.cse(parts), names, found)


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
        one = (alone, given, shared, rows, self.sizes)
        self.library = compiled_library(loop_source(*one, x.dtype, self.gradient))
        self.pool = ThreadPoolExecutor(max(torch.get_num_threads(), 1))
        exact = copy.copy(self)
        exact.dtype = torch.float64
        exact.library = compiled_library(loop_source(*one, exact.dtype, self.gradient), quick=True)
        self._check(exact, alone, x[:_ROWS], w[:_ROWS], s[:_ROWS])
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

    def _check(self, exact: CompiledLoop, alone: Rollout, x: Tensor, w: Tensor, s: Tensor) -> None:
        """Compare a few steps from all that flights visit, and their gradient, with the loop's own.

        Rounding doubles from step to step where a law is steep, and tells nothing then: the text of
        the library is compared in double precision, from equal states.

        Args:
            exact: the same flights in double precision.
            alone: the closed loop in double precision.
            x, w, s: of some flights.

        Raises:
            ExportError: where they differ by more than the precision explains.
        """
        step = _Step(alone)
        held = {f"rollout.{name}": part.detach() for name, part in _numbers(alone).items()}
        for name in self.own:
            held[f"rollout.{name}"] = held[f"rollout.{name}"][: len(x)]

        def flown(*start: Tensor, taken: Tensor, numbers: dict[str, Tensor]) -> list[Any]:
            """Return x, s and q at every step, and what acted."""
            states, acted = [tuple(start)], []
            for k in range(taken.shape[1]):
                x, s, q = states[-1]
                *after, acting = torch.func.functional_call(step, numbers, (x, taken[:, k], s, q))
                states.append(tuple(after))
                acted.append(acting)
            return [*zip(*states, strict=True), acted]

        count = min(_VISITED, w.shape[1])
        w, x, s = w[:, :count].double(), x.double(), s.double()
        with torch.no_grad():
            seen = flown(x, s, alone.source.initial(x), taken=w, numbers=held)
        # the rows of a visited step are one flight each, under the inputs that came next
        last = max(count - _STEPS, 0) + 1
        starts = [torch.cat(parts[:last]) for parts in seen[:3]]
        taken = torch.cat([w[:, k : k + _STEPS] for k in range(last)])
        many = {
            name: held[f"rollout.{name}"].repeat(last, *[1] * (held[f"rollout.{name}"].dim() - 1))
            for name in self.own
        }
        weights = {name: held[f"rollout.{name}"].requires_grad_() for name in self.shared}
        numbers = held | {f"rollout.{name}": part for name, part in {**many, **weights}.items()}
        states, _, _, acted = flown(*starts, taken=taken, numbers=numbers)
        slow = (torch.stack(states, 1), torch.stack(acted, 1))
        rows = torch.cat(
            [torch.zeros(len(taken), 0), *(part.reshape(len(taken), -1) for part in many.values())],
            dim=1,
        )
        theta = _flat(weights)
        given = (starts[0], taken, starts[1], starts[2])

        def fly(loop: CompiledLoop) -> tuple[Tensor, Tensor]:
            parts = [part.to(loop.dtype) for part in (theta, rows, *given)]
            if not self.gradient:
                return loop.flown(*parts)[0]
            apply: Any = _Flight.apply
            found: tuple[Tensor, Tensor] = apply(*parts, loop)
            return found

        fast, quick = fly(exact), fly(self)
        pairs = list(zip(fast, slow, strict=True))
        if self.gradient:
            slopes = (
                torch.autograd.grad(states.square().mean() + acted.sum(), list(weights.values()))
                for states, acted in (fast, slow)
            )
            flat = [torch.cat([part.reshape(-1) for part in parts]) for parts in slopes]
            pairs.append((flat[0], flat[1]))
        offs = [(found - wanted).detach().abs().max() for found, wanted in pairs]
        # rounding moves single rows far, a fault most of them
        offs += [
            (found - wanted).detach().abs().flatten(1).amax(1).median() * (_SAME / _ROUNDED)
            for found, wanted in zip(quick, fast, strict=True)
        ]
        sizes = [wanted.detach().abs().max().clamp(min=1e-9) for _, wanted in (*pairs, *pairs[:2])]
        off = max(float(one / size) for one, size in zip(offs, sizes, strict=True))
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
