"""What exported models do with inputs, states and memories that no vessel has.

Every format keeps to these rules, so that a bad sample never ends in a number that is not finite:

- An entry is a *measurement* while it lies within its accepted range: the training range, widened
  on either side by twice the largest magnitude in it (by one SI unit where that is zero, and angles
  by a turn at least). Positions are accepted up to 100 km from the origin, headings up to 1,000
  turns: beyond, float32 no longer resolves one step.
- An entry that is not a number becomes the middle of its training range; position and heading
  become zero. Any other entry beyond the accepted range, infinities included, becomes the nearest
  value of its training range (of its accepted range for position and heading).
- A memory with an entry that is not finite, or beyond what its head can have, is replaced by the
  memory without a past.
- A step that would leave the accepted range, or be no number, is not taken as it is: velocities are
  held at the edge of the accepted range (or where they were, if they are no numbers), and the pose
  moves on with the velocities before the step.

The flag `outside` is true for each row in which any of this happened, and for each row with an
entry beyond the training range. The rules have no memory of their own: the next good sample is
answered as if the bad one had not been, from the state and memory that it is given.
"""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor, nn

from residnet.core.columns import actuators, motion, pose, velocities, velocities_on
from residnet.core.layout import ATTITUDE, PLANAR, POSITION
from residnet.dynamics.base import Dynamics
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec

REACH = 2.0
"""How far beyond the training range a value is accepted, in largest magnitudes of that range."""
_LARGEST = float(torch.finfo(torch.float32).max)
_FARTHEST = 1e5
"""Largest north and east in m."""
_TURNS = 2000.0 * math.pi
"""Largest heading in rad."""
_TURN = 2.0 * math.pi


@final
class Ranges(nn.Module):
    """Training range [low, high] and accepted range [least, most] of values [k].

    Args:
        reach: how far beyond the training range a value is accepted [k].
        dtype: of the numbers.
    """

    def __init__(self, low: Tensor, high: Tensor, reach: Tensor, dtype: torch.dtype) -> None:
        super().__init__()
        self.low, self.high = nn.Buffer(low.to(dtype)), nn.Buffer(high.to(dtype))
        self.least = nn.Buffer((low - reach).to(dtype))
        self.most = nn.Buffer((high + reach).to(dtype))
        self.middle = nn.Buffer((0.5 * (low + high)).to(dtype))

    def inside(self, seen: Tensor) -> Tensor:
        """Return which rows [...] of values [..., k] lie in the training range."""
        return ((seen >= self.low) & (seen <= self.high)).all(dim=-1)

    def accepted(self, seen: Tensor) -> Tensor:
        """Return which rows [...] of values [..., k] are accepted."""
        # comparisons with what is no number are false
        return ((seen >= self.least) & (seen <= self.most)).all(dim=-1)

    def replaced(self, seen: Tensor) -> Tensor:
        """Return values [..., k] with those that are no measurements replaced, as stated above."""
        known = (seen >= self.least) & (seen <= self.most)
        nearest = torch.minimum(torch.maximum(seen, self.low), self.high)
        return torch.where(known, seen, torch.where(torch.isnan(seen), self.middle, nearest))


@final
class GuardedDynamics(Dynamics):
    """A model behind the rules above, whose step is defined and finite whatever it is given.

    The state is x [B, 3 + n + 1]: that of the model and, behind it, the flag of the step that led
    there.

    Args:
        model: in the precision that it shall run in, float32 in exports.
    """

    def __init__(self, model: HybridDynamics, spec: ModelSpec) -> None:
        super().__init__(model.dt, model.integrator)
        self.model = model
        self.largest = _LARGEST
        self.n_state = model.n_state
        self.dof, self.rolls = model.dof, model.rolls
        self.turn_about(ATTITUDE if model.spatial else (), len(spec.signals.live.states) + 1)
        low, high, reach = (
            torch.tensor(part, dtype=torch.float64) for part in (spec.low, spec.high, _reach(spec))
        )
        far = torch.full((len(PLANAR.pose),), _FARTHEST, dtype=torch.float64)
        far[POSITION.stop :] = _TURNS
        if model.spatial:
            # no training range bounds the depth
            depth = spec.signals.live.moving.index("z")
            low[depth], high[depth], reach[depth] = -_FARTHEST, _FARTHEST, 0.0
        low, high = torch.cat((-far, low)), torch.cat((far, high))
        reach = torch.cat((torch.zeros_like(far), reach))
        self.ranges = Ranges(low, high, reach, torch.float32)
        n = len(spec.signals.live.states)
        self.of_state = Ranges(low[:n], high[:n], reach[:n], torch.float32)
        first, last = model.memory_range()
        # finite, so that comparisons alone tell what is no number
        smallest = (first - 1e-3 * first.abs()).clamp(min=-_LARGEST)
        largest = (last + 1e-3 * last.abs()).clamp(max=_LARGEST)
        self.memory_low = nn.Buffer(smallest.to(torch.float32))
        self.memory_high = nn.Buffer(largest.to(torch.float32))

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, nx] of the model at a stage; the flag has none."""
        return torch.cat(
            (
                self.model.rate(motion(x, self.dof), p, rho),
                torch.zeros_like(actuators(x, self.dof)),
            ),
            dim=-1,
        )

    def measured(self, x: Tensor, w: Tensor) -> Tensor:
        """Return which samples [...] are measurements in all entries of x and w [..., m]."""
        return self.ranges.accepted(torch.cat((x, w), dim=-1))

    def accept(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return state [B, 3 + n], inputs [B, m] and memory as they are used, and the flag [B]."""
        seen = torch.cat((x, w), dim=-1)
        used, inside = self.ranges.replaced(seen), self.ranges.inside(seen)
        # no reductions over nothing: not every format has them
        if self.n_state > 0:
            remembers = self.remembers(s)
            inside = inside & remembers
            s = torch.where(remembers.unsqueeze(-1), s, torch.zeros_like(s))
        return motion(used, self.dof), actuators(used, self.dof), s, ~inside

    def remembers(self, s: Tensor) -> Tensor:
        """Return which rows [B] of a memory [B, n_state] the head can have come to."""
        return ((s >= self.memory_low) & (s <= self.memory_high)).all(dim=-1)

    def settle(self, x: Tensor, after: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return state and memory after a step as they are given out, and the flag [B].

        Args:
            x: state before the step [B, 3 + n], accepted.
            after: what the model made of it [B, 3 + n].
            s: memory after the step [B, n_state].
        """
        kept = self.of_state.accepted(after).unsqueeze(-1)
        new = velocities_on(after)
        held = torch.where(torch.isnan(new), velocities(x, self.dof), new)
        coasting = torch.cat((pose(x) + self.dt * self.kinematics(x), held), dim=-1)
        coasting = torch.minimum(torch.maximum(coasting, self.of_state.least), self.of_state.most)
        if self.n_state == 0:
            return torch.where(kept, after, coasting), s, ~kept.squeeze(-1)
        known = (s.abs() <= self.largest).all(dim=-1, keepdim=True)
        # a head of another package may leave what it says of its memory
        s = torch.minimum(torch.maximum(s, self.memory_low), self.memory_high)
        s = torch.where(known, s, torch.zeros_like(s))
        return torch.where(kept, after, coasting), s, ~(kept & known).squeeze(-1)

    def flagged_step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the state [B, 3 + n] and the memory one step later, and the flag [B]."""
        x, w, s, outside = self.accept(x, w, s)
        after, s = self.model.step(x, w, s)
        after, s, left = self.settle(x, after, s)
        return after, s, outside | left

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        after, s, outside = self.flagged_step(motion(x, self.dof), w, s)
        return torch.cat((after, outside.to(x.dtype).unsqueeze(-1)), dim=-1), s

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory [B, n_state] that a measured past leaves, bad samples left out.

        In the place of a sample that is no measurement in every entry stands the last one before it
        that is, or else the first one behind it. Without any the memory is that without a past.

        Args:
            y_history: states [B, T, 3 + n], oldest first; T may be 0.
            w_history: inputs [B, T, m].
        """
        if y_history.shape[1] == 0:
            return torch.zeros(y_history.shape[0], self.n_state)
        good = self.measured(y_history, w_history)
        y, w = hold_measured(y_history, w_history, good)
        s = self.model.warmup(y, w)
        known = (good.any(dim=1) & torch.isfinite(s).all(dim=-1)).unsqueeze(-1)
        return torch.where(known, s, torch.zeros_like(s))


def hold_measured(y: Tensor, w: Tensor, good: Tensor) -> tuple[Tensor, Tensor]:
    """Replace samples that are no measurements by the last measurement before them.

    Samples before the first measurement are replaced by that one. TorchScript compiles this.

    Args:
        y: states [B, T, nx], oldest first; T at least 1.
        w: inputs [B, T, m].
        good: which samples are measurements [B, T].
    """
    index = torch.arange(good.shape[1]).unsqueeze(0).expand_as(good)
    last = torch.where(good, index, torch.full_like(index, -1)).cummax(dim=1)[0]
    first = good.to(torch.long).argmax(dim=1, keepdim=True).expand_as(last)
    chosen = torch.where(last >= 0, last, first).unsqueeze(-1)
    return y.gather(1, chosen.expand_as(y)), w.gather(1, chosen.expand_as(w))


def widening(low: float, high: float) -> float:
    """Return how far beyond its training range a value is accepted, in its own unit."""
    return REACH * (max(abs(low), abs(high)) or 0.5)


def _reach(spec: ModelSpec) -> list[float]:
    """Return how far beyond the training range each velocity and input is accepted."""
    units = spec.signals.units()
    return [
        max(widening(low, high), _TURN if units[name] == "rad" else 0.0)
        for name, (low, high) in spec.ranges.items()
    ]
