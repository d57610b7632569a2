"""Exact Jacobians of one model step, for many states at once.

The step is traced once into a CasADi expression and differentiated there, so that no baseline and
no integrator has derivatives of its own to keep right.
"""

from __future__ import annotations

import ctypes
from typing import Any, final
from weakref import WeakKeyDictionary

import casadi as ca
import torch
from torch import Tensor, nn

from residnet.baselines.base import ParametricBaseline
from residnet.core.layout import HEADING
from residnet.dynamics.hybrid import HybridDynamics
from residnet.engine.c_code import CompilerError, compiled_library
from residnet.engine.trace import in_numbers, lowered
from residnet.heads.base import ZeroHead

_LOOP = """
void jacobians(const double *x, const double *w, const double *theta, double *out, long rows) {{
    casadi_int iwork[{iw}];
    double work[{w}];
    for (long k = 0; k < rows; k++) {{
        const double *arg[{arg}] = {{x + k * {nx}, w + k * {nw}, theta}};
        double *res[{res}] = {{out + k * {size}}};
        jacobian(arg, res, iwork, work, 0);
    }}
}}
"""


class _Step(nn.Module):
    """One step without a residual, as a function of theta too."""

    def __init__(self, model: HybridDynamics, theta_shape: torch.Size) -> None:
        super().__init__()
        self.theta_shape = theta_shape
        head = ZeroHead(model.signals.names)
        self.model = HybridDynamics(model.signals, model.baseline, head, model.dt, model.integrator)

    def forward(self, x: Tensor, w: Tensor) -> Tensor:
        return self.model.step(x, w, x[:, :0])[0]

    def with_theta(self, x: Tensor, w: Tensor, theta: Tensor) -> tuple[Tensor]:
        weights = {"model.baseline.theta": theta.reshape(self.theta_shape)}
        # baselines share modules with signals, which must not be swapped twice
        out: Tensor = torch.func.functional_call(self, weights, (x, w), tie_weights=False)
        return (out,)


@final
class StepJacobian:
    """Derivatives of (heading, velocities) one step later, by themselves and the free parameters.

    The position is left out: nothing in body axes depends on it. float64.

    Attributes:
        free: places of the free parameters in the flattened theta.
    """

    def __init__(self, model: HybridDynamics, baseline: ParametricBaseline) -> None:
        self.theta, self.free = baseline.theta, baseline.free_indices().tolist()
        self.n = 1 + model.dof
        inputs = model.signals.n_inputs + 2 * model.signals.has_wind
        sizes = {"x": HEADING + self.n, "w": inputs, "theta": self.theta.numel()}
        traced = _Step(model, baseline.theta.shape).with_theta
        step = lowered(traced, [*sizes.items()], ["after"], "step")
        x, w, theta = (ca.SX.sym(name, size) for name, size in sizes.items())
        after = in_numbers(step)(x, w, theta)
        jacobian = ca.jacobian(after[HEADING:], ca.vertcat(x[HEADING:], theta[self.free]))
        # CasADi stores columns, torch rows
        transposed = ca.cse([ca.densify(jacobian.T)])
        self.function = f = ca.Function("jacobian", [x, w, theta], transposed)
        code = ca.CodeGenerator("jacobian.c")
        code.add(f)
        loop = _LOOP.format(
            iw=f.sz_iw() + 1, w=f.sz_w() + 1, arg=f.sz_arg(), res=f.sz_res(),
            nx=sizes["x"], nw=inputs, size=jacobian.numel(),
        )  # fmt: skip
        try:
            self._library: Any = compiled_library(code.dump() + loop)
        except CompilerError:
            self._library = None

    def __call__(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Return d/d state [B, 1 + n, 1 + n] and d/d theta [B, 1 + n, P] at x [B, nx], w [B, m]."""
        x, w, theta = x.contiguous(), w.contiguous(), self.theta.detach().flatten().contiguous()
        if self._library is None:
            # without a compiler CasADi's own interpreter takes twenty times as long
            columns = self.function(x.numpy().T, w.numpy().T, theta.numpy()).full()
            out = torch.from_numpy(columns).reshape(-1, len(x), self.n).permute(1, 2, 0)
        else:
            out = torch.empty(len(x), self.n, self.n + len(self.free), dtype=torch.float64)
            pointers = [ctypes.c_void_p(part.data_ptr()) for part in (x, w, theta, out)]
            self._library.jacobians(*pointers, ctypes.c_long(len(x)))
        by_state, by_theta = out.split([self.n, len(self.free)], dim=-1)
        return by_state, by_theta

    @classmethod
    def of(cls, model: HybridDynamics) -> StepJacobian:
        """Return the Jacobian of a model, traced again only where more than theta has changed."""
        baseline = model.baseline
        assert isinstance(baseline, ParametricBaseline)
        constants = tuple((b.data_ptr(), b._version) for b in model.buffers())
        known = _TRACED.get(model)
        if known is None or known[0] != constants:
            _TRACED[model] = known = constants, cls(model, baseline)
        return known[1]


_TRACED: WeakKeyDictionary[HybridDynamics, tuple[tuple[Any, ...], StepJacobian]] = (
    WeakKeyDictionary()
)
