"""Exact Jacobians of the step of a model, for many states at once.

The step is traced once into a CasADi expression and differentiated there, so that no baseline and
no integrator needs derivatives of its own.
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
from residnet.engine.c_code import CompilerError, load_library
from residnet.engine.lowering import lower, to_scalar_function
from residnet.heads.base import ZeroHead

# calls the function that CasADi generates for each row
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


class _BaselineStep(nn.Module):
    """One step of a model without its residual, as a function of the baseline's parameters too."""

    def __init__(self, model: HybridDynamics, theta_shape: torch.Size) -> None:
        super().__init__()
        self.theta_shape = theta_shape
        head = ZeroHead(model.signals.names)
        self.model = HybridDynamics(model.signals, model.baseline, head, model.dt, model.integrator)

    def forward(self, x: Tensor, w: Tensor) -> Tensor:
        no_memory = x[:, :0]
        return self.model.step(x, w, no_memory)[0]

    def step_with_theta(self, x: Tensor, w: Tensor, theta: Tensor) -> tuple[Tensor]:
        """Return the state one step later, for flattened parameters theta [1, size]."""
        weights = {"model.baseline.theta": theta.reshape(self.theta_shape)}
        # baseline and signals refer to the same modules; with tie_weights=True theta would be
        # replaced under each of their names
        next_state: Tensor = torch.func.functional_call(self, weights, (x, w), tie_weights=False)
        return (next_state,)


@final
class StepJacobian:
    """Jacobian of a step: of heading and dynamic states with respect to state and parameters.

    The position is omitted, because the dynamics in body axes do not depend on it. All numbers are
    float64.

    Attributes:
        free_indices: indices of the free parameters in the flattened theta.
    """

    def __init__(self, model: HybridDynamics, baseline: ParametricBaseline) -> None:
        self.theta = baseline.theta
        self.free_indices: list[int] = baseline.free_indices().tolist()
        self.n_rows = 1 + model.dof

        # trace the step and differentiate the expression
        n_inputs = model.signals.n_inputs + 2 * model.signals.has_wind
        sizes = {"x": HEADING + self.n_rows, "w": n_inputs, "theta": self.theta.numel()}
        traced_step = _BaselineStep(model, baseline.theta.shape).step_with_theta
        step = lower(traced_step, [*sizes.items()], ["next_state"], "step")
        x, w, theta = (ca.SX.sym(name, size) for name, size in sizes.items())
        next_state = to_scalar_function(step)(x, w, theta)
        variables = ca.vertcat(x[HEADING:], theta[self.free_indices])
        jacobian = ca.jacobian(next_state[HEADING:], variables)

        # CasADi stores matrices by columns, torch by rows
        transposed = ca.cse([ca.densify(jacobian.T)])
        self.function = ca.Function("jacobian", [x, w, theta], transposed)
        self._library = self._compile(sizes, jacobian.numel())

    def _compile(self, sizes: dict[str, int], n_entries: int) -> Any:
        """Return the compiled library; None without a compiler."""
        function = self.function
        code = ca.CodeGenerator("jacobian.c")
        code.add(function)
        loop = _LOOP.format(
            iw=function.sz_iw() + 1,
            w=function.sz_w() + 1,
            arg=function.sz_arg(),
            res=function.sz_res(),
            nx=sizes["x"],
            nw=sizes["w"],
            size=n_entries,
        )
        try:
            return load_library(code.dump() + loop)
        except CompilerError:
            return None

    def __call__(self, x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
        """Return the Jacobians by state [B, 1 + n, 1 + n] and by parameters [B, 1 + n, P].

        Args:
            x: states [B, nx].
            w: inputs [B, m].
        """
        x = x.contiguous()
        w = w.contiguous()
        theta = self.theta.detach().flatten().contiguous()
        if self._library is None:
            # CasADi's interpreter takes twenty times as long as the compiled function
            columns = self.function(x.numpy().T, w.numpy().T, theta.numpy()).full()
            jacobian = torch.from_numpy(columns).reshape(-1, len(x), self.n_rows).permute(1, 2, 0)
        else:
            n_columns = self.n_rows + len(self.free_indices)
            jacobian = torch.empty(len(x), self.n_rows, n_columns, dtype=torch.float64)
            pointers = [ctypes.c_void_p(part.data_ptr()) for part in (x, w, theta, jacobian)]
            self._library.jacobians(*pointers, ctypes.c_long(len(x)))
        by_state, by_theta = jacobian.split([self.n_rows, len(self.free_indices)], dim=-1)
        return by_state, by_theta

    @classmethod
    def of_model(cls, model: HybridDynamics) -> StepJacobian:
        """Return the Jacobian of a model, traced again only if more than theta has changed."""
        baseline = model.baseline
        assert isinstance(baseline, ParametricBaseline)
        constants = tuple((buffer.data_ptr(), buffer._version) for buffer in model.buffers())
        traced = _TRACED.get(model)
        if traced is None or traced[0] != constants:
            traced = (constants, cls(model, baseline))
            _TRACED[model] = traced
        return traced[1]


# Jacobians by model, with the addresses and versions of the buffers that they were traced with
_TRACED: WeakKeyDictionary[HybridDynamics, tuple[tuple[Any, ...], StepJacobian]] = (
    WeakKeyDictionary()
)
