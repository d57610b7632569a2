"""Input guard of exported models: handling of invalid inputs, states and memories.

All formats follow these rules, so that a bad sample never yields a non-finite result:

- An entry is *valid* within its accepted range: the training range extended on both sides by twice
  its largest magnitude (by one SI unit if this is zero, and by at least one turn for angles).
  Positions are accepted up to 100 km from the origin and headings up to 1,000 turns, because
  float32 does not resolve one step beyond.
- NaN is replaced by the middle of the training range, and by zero for position and heading. Any
  other entry beyond the accepted range, including infinity, is replaced by the nearest value of the
  training range (of the accepted range for position and heading).
- A memory with a non-finite entry, or an entry beyond the limits of its head (residual model), is
  replaced by the initial memory.
- If the result of a step is NaN or leaves the accepted range, velocities are clamped to the
  accepted range (NaN is replaced by the previous value), and the pose is integrated with the
  velocities before the step.

The flag `outside` is true for each row to which one of these rules was applied, for each row with
an entry beyond the training range by more than its margin, and for each row outside the operating
domain: the relations and the density of the training data (`residnet.dynamics.domain`). The margins
belong to the domain and are zero without one. The rules are stateless: the next good sample is
processed from the state and memory given to it.
"""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.columns import (
    actuator_states,
    all_but_pose,
    dynamic_states,
    pose,
    pose_and_dynamic_states,
)
from residnet.core.layout import ATTITUDE, PLANAR_LAYOUT, POSITION
from residnet.dynamics.base import Dynamics
from residnet.dynamics.domain import DomainCheck
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec

ACCEPTED_RANGE_FACTOR = 2.0
"""Extension of the accepted range beyond the training range, in its largest magnitudes."""
_FLOAT32_MAX = float(torch.finfo(torch.float32).max)
_MAX_POSITION = 1e5
"""Largest north and east in m."""
_MAX_HEADING = 2000.0 * math.pi
"""Largest heading in rad."""
_FULL_TURN = 2.0 * math.pi


@final
class GuardRanges(nn.Module):
    """Training range [lower, upper] and accepted range of values [k].

    Args:
        lower: lower limits of the training range [k].
        upper: upper limits of the training range [k].
        margin: extension of the accepted range beyond the training range [k].
        dtype: precision of the limits.
        flag_margin: extension of the range without a flag beyond the training range [k]; None for
            no extension.
    """

    def __init__(
        self,
        lower: Tensor,
        upper: Tensor,
        margin: Tensor,
        dtype: torch.dtype,
        flag_margin: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.lower = nn.Buffer(lower.to(dtype))
        self.upper = nn.Buffer(upper.to(dtype))
        self.accepted_lower = nn.Buffer((lower - margin).to(dtype))
        self.accepted_upper = nn.Buffer((upper + margin).to(dtype))
        self.midpoint = nn.Buffer((0.5 * (lower + upper)).to(dtype))
        flag_margin = torch.zeros_like(margin) if flag_margin is None else flag_margin
        # a value beyond the accepted range is replaced, and is therefore always flagged
        flag_margin = torch.minimum(flag_margin, margin)
        self.unflagged_lower = nn.Buffer((lower - flag_margin).to(dtype))
        self.unflagged_upper = nn.Buffer((upper + flag_margin).to(dtype))

    def is_in_training_range(self, values: Tensor) -> Tensor:
        """Return which rows [...] of values [..., k] are in the training range and its margin."""
        return ((values >= self.unflagged_lower) & (values <= self.unflagged_upper)).all(dim=-1)

    def is_accepted(self, values: Tensor) -> Tensor:
        """Return which rows [...] of values [..., k] are accepted."""
        # comparisons with NaN are false
        return ((values >= self.accepted_lower) & (values <= self.accepted_upper)).all(dim=-1)

    def replace_unaccepted(self, values: Tensor) -> Tensor:
        """Return values [..., k] with unaccepted ones replaced, see the rules of this module."""
        is_entry_accepted = (values >= self.accepted_lower) & (values <= self.accepted_upper)
        clamped = torch.minimum(torch.maximum(values, self.lower), self.upper)
        return torch.where(
            is_entry_accepted, values, torch.where(torch.isnan(values), self.midpoint, clamped)
        )


@final
class GuardedDynamics(Dynamics):
    """A model with the input guard, whose step is defined and finite for every input.

    The state x [B, 3 + n + 1] is the state of the model followed by the flag of the previous step.

    Args:
        model: the model in its final precision (float32 in exports).
    """

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.float_max = _FLOAT32_MAX
        self.n_state = model.n_state
        self.dof = model.dof
        self.has_roll = model.has_roll
        self.set_attitude_columns(
            ATTITUDE if model.is_spatial else (), len(spec.signals.dof.state_names) + 1
        )
        lower, upper, margin = (
            torch.tensor(values, dtype=torch.float64)
            for values in (spec.low, spec.high, _accepted_margins(spec))
        )
        pose_limit = torch.full((len(PLANAR_LAYOUT.pose),), _MAX_POSITION, dtype=torch.float64)
        pose_limit[POSITION.stop :] = _MAX_HEADING
        if model.is_spatial:
            # the depth does not affect the motion, so that its training range is no limit
            depth_index = spec.signals.dof.dynamic_states.index("z")
            lower[depth_index], upper[depth_index], margin[depth_index] = (
                -_MAX_POSITION,
                _MAX_POSITION,
                0.0,
            )
        lower = torch.cat((-pose_limit, lower))
        upper = torch.cat((pose_limit, upper))
        margin = torch.cat((torch.zeros_like(pose_limit), margin))
        flag_margin = torch.cat((torch.zeros_like(pose_limit), _flag_margins(spec)))
        self.ranges = GuardRanges(lower, upper, margin, torch.float32, flag_margin)
        n_states = len(spec.signals.dof.state_names)
        self.domain_check = (
            None
            if spec.domain is None
            else DomainCheck(spec.domain, spec.signals.dof.state_names, spec.signals.input_columns)
        )
        self.state_ranges = GuardRanges(
            lower[:n_states], upper[:n_states], margin[:n_states], torch.float32
        )
        memory_minimum, memory_maximum = model.memory_bounds()
        # finite limits, so that comparisons also exclude infinity and NaN
        memory_lower = (memory_minimum - 1e-3 * memory_minimum.abs()).clamp(min=-_FLOAT32_MAX)
        memory_upper = (memory_maximum + 1e-3 * memory_maximum.abs()).clamp(max=_FLOAT32_MAX)
        self.memory_lower = nn.Buffer(memory_lower.to(torch.float32))
        self.memory_upper = nn.Buffer(memory_upper.to(torch.float32))

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the model at a stage; the flag has none."""
        return torch.cat(
            (
                self.model.state_derivative(pose_and_dynamic_states(x, self.dof), p, rho),
                torch.zeros_like(actuator_states(x, self.dof)),
            ),
            dim=-1,
        )

    def is_measurement(self, x: Tensor, w: Tensor) -> Tensor:
        """Return which samples [...] are measurements in all entries of x and w [..., m]."""
        return self.ranges.is_accepted(torch.cat((x, w), dim=-1))

    def replace_bad_inputs(
        self, x: Tensor, w: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the guarded state [B, 3 + n], inputs [B, m], memory and the flag [B]."""
        measured_values = torch.cat((x, w), dim=-1)
        replaced_values = self.ranges.replace_unaccepted(measured_values)
        is_inside = self.ranges.is_in_training_range(measured_values)
        if self.domain_check is not None:
            is_inside = is_inside & self.domain_check(
                pose_and_dynamic_states(replaced_values, self.dof),
                actuator_states(replaced_values, self.dof),
            )
        # without memory no reduction over an empty dimension, which some formats do not support
        if self.n_state > 0:
            is_memory_valid = self.is_valid_memory(s)
            is_inside = is_inside & is_memory_valid
            s = torch.where(is_memory_valid.unsqueeze(-1), s, torch.zeros_like(s))
        return (
            pose_and_dynamic_states(replaced_values, self.dof),
            actuator_states(replaced_values, self.dof),
            s,
            ~is_inside,
        )

    def is_valid_memory(self, s: Tensor) -> Tensor:
        """Return which rows [B] of a memory [B, n_state] are within the limits of the head."""
        return ((s >= self.memory_lower) & (s <= self.memory_upper)).all(dim=-1)

    def replace_bad_result(
        self, x: Tensor, next_state: Tensor, s: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the guarded state and memory after a step, and the flag [B].

        Args:
            x: valid state before the step [B, 3 + n].
            next_state: result of the model [B, 3 + n].
            s: memory after the step [B, n_state].
        """
        is_state_accepted = self.state_ranges.is_accepted(next_state).unsqueeze(-1)
        next_velocities = all_but_pose(next_state)
        finite_velocities = torch.where(
            torch.isnan(next_velocities), dynamic_states(x, self.dof), next_velocities
        )
        fallback_state = torch.cat(
            (pose(x) + self.dt * self.kinematics(x), finite_velocities), dim=-1
        )
        fallback_state = torch.minimum(
            torch.maximum(fallback_state, self.state_ranges.accepted_lower),
            self.state_ranges.accepted_upper,
        )
        if self.n_state == 0:
            return (
                torch.where(is_state_accepted, next_state, fallback_state),
                s,
                ~is_state_accepted.squeeze(-1),
            )
        is_memory_finite = (s.abs() <= self.float_max).all(dim=-1, keepdim=True)
        # a head of another package may exceed the limits that it declares
        s = torch.minimum(torch.maximum(s, self.memory_lower), self.memory_upper)
        s = torch.where(is_memory_finite, s, torch.zeros_like(s))
        return (
            torch.where(is_state_accepted, next_state, fallback_state),
            s,
            ~(is_state_accepted & is_memory_finite).squeeze(-1),
        )

    def flagged_step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state [B, 3 + n] and the memory one step later, and the flag [B]."""
        x, w, s, outside = self.replace_bad_inputs(x, w, s)
        next_state, s = self.model.step(x, w, s)
        next_state, s, is_replaced = self.replace_bad_result(x, next_state, s)
        return next_state, s, outside | is_replaced

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        next_state, s, outside = self.flagged_step(pose_and_dynamic_states(x, self.dof), w, s)
        return torch.cat((next_state, outside.to(x.dtype).unsqueeze(-1)), dim=-1), s

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory [B, n_state] after a measured past.

        A sample with an invalid entry is replaced by the last valid sample before it, or by the
        first valid sample after it. Without valid samples the initial memory is returned.

        Args:
            y_history: states [B, T, 3 + n], oldest first; T may be 0.
            w_history: inputs [B, T, m].
        """
        if y_history.shape[1] == 0:
            return torch.zeros(y_history.shape[0], self.n_state)
        is_good = self.is_measurement(y_history, w_history)
        y, w = hold_measured(y_history, w_history, is_good)
        s = self.model.warmup(y, w)
        has_memory = (is_good.any(dim=1) & torch.isfinite(s).all(dim=-1)).unsqueeze(-1)
        return torch.where(has_memory, s, torch.zeros_like(s))


def hold_measured(y: Tensor, w: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
    """Replace invalid samples by the last valid sample before them.

    Samples before the first valid one are replaced by it. TorchScript compiles this function.

    Args:
        y: states [B, T, nx], oldest first; T at least 1.
        w: inputs [B, T, m].
        good: whether samples are valid [B, T].
    """
    index = torch.arange(good.shape[1]).unsqueeze(0).expand_as(good)
    # index of the last valid sample so far, as a running maximum; -1 before the first one
    last = torch.where(good, index, torch.full_like(index, -1)).cummax(dim=1)[0]
    first = good.to(torch.long).argmax(dim=1, keepdim=True).expand_as(last)
    chosen = torch.where(last >= 0, last, first).unsqueeze(-1)
    return y.gather(1, chosen.expand_as(y)), w.gather(1, chosen.expand_as(w))


def accepted_margin(lower: float, upper: float) -> float:
    """Return the extension of the accepted range beyond a training range."""
    return ACCEPTED_RANGE_FACTOR * (max(abs(lower), abs(upper)) or 0.5)


def _accepted_margins(spec: ModelSpec) -> list[float]:
    """Return the extension of the accepted range of each velocity and input."""
    units = spec.signals.channel_units()
    return [
        max(accepted_margin(lower, upper), _FULL_TURN if units[name] == "rad" else 0.0)
        for name, (lower, upper) in spec.ranges.items()
    ]


def _flag_margins(spec: ModelSpec) -> Tensor:
    """Return the extension [k] of the range without a flag of each velocity and input."""
    domain = spec.domain
    margins = {} if domain is None else domain.range_margins
    return torch.tensor([margins.get(name, 0.0) for name in spec.ranges], dtype=torch.float64)
