"""The hybrid model, nu_dot = baseline + residual (document 003 eq. (19)), and what it missed.

A residual in force space acts through the head's mass. A head may be shown what was predicted wrong
of the measured past, where unmeasured wind leaves its trace: each step's velocities are compared
with those that the step before predicted. In a free run nothing is left over. So one and the same
step serves both, and nothing has to tell it which is which.
"""

from __future__ import annotations

import math
from typing import final

import torch
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.columns import dynamic_states, pose, with_depth_rate
from residnet.core.layout import ATTITUDE, DegreesOfFreedom
from residnet.dynamics.base import Dynamics, Integrator
from residnet.heads.base import ResidualHead
from residnet.physics.signals import Signals
from residnet.physics.symmetry import get_dof

_PIECE = 20.0
"""Length in s of pieces of a measurement that run side by side, and of the past of each."""
FARTHEST = 100.0
"""Largest velocity or acceleration that a memory may hold, SI."""


@final
class Missed(nn.Module):
    """An acceleration by which steps were predicted wrong, low-passed and kept in the memory.

    It stays in body axes: what settles is forgotten as quickly, before the vessel has turned.

    Args:
        settle: time constant in s.
        dt: step in s.
        live: what moves; n numbers. An angle whose rate is known is never predicted wrong.

    Attributes:
        size: entries of the memory: whether there is a prediction, what it is, what was missed.
    """

    def __init__(self, settle: float, dt: float, live: DegreesOfFreedom) -> None:
        super().__init__()
        self.dof, self.size = live.n_dynamic, 1 + 2 * live.n_dynamic
        self.free = len(live.regressed_indices) == live.n_dynamic
        self.mask = nn.Buffer(live.equation_mask(), persistent=False)
        self.keep = math.exp(-dt / settle)
        self.gain = (1.0 - self.keep) / dt

    def forward(self, x: Tensor, s: Tensor) -> Tensor:
        """Return the acceleration in body axes [B, n].

        Args:
            x: states at the step's start, measured or predicted [B, nx].
            s: memory of the step before [B, 1 + 2 n].
        """
        known, predicted, before = s.split([1, self.dof, self.dof], dim=-1)
        left = (dynamic_states(x, self.dof) - predicted) * known
        if not self.free:
            left = left * self.mask.to(left.dtype)
        missed: Tensor = self.keep * before + self.gain * left
        return missed

    def remembered(self, after: Tensor, missed: Tensor) -> Tensor:
        """Return the memory [B, 1 + 2 n] from the predicted states [B, nx] and what was missed."""
        predicted = dynamic_states(after, self.dof)
        return torch.cat((torch.ones_like(after[:, :1]), predicted, missed), dim=-1)

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [1 + 2 n]."""
        most = torch.full((self.size,), FARTHEST, dtype=torch.float64)
        most[0] = 1.0
        least = -most
        least[0] = 0.0
        return least, most


class HybridDynamics(Dynamics):
    """A hybrid model with the state x [B, 3 + n]: x, y, psi, then what moves, u, v, r and so on.

    The head is evaluated once per step and held over the integrator's stages. A head with a
    `settle` time is shown what was predicted wrong.
    """

    def __init__(
        self,
        signals: Signals,
        baseline: Baseline,
        head: ResidualHead,
        dt: float,
        integrator: Integrator = "rk4",
    ) -> None:
        super().__init__(dt, integrator)
        self.signals = signals
        self.baseline = baseline
        self.head = head
        live = get_dof(signals.names)
        self.dof = live.n_dynamic
        self.whole, self.free = live.is_complete, len(live.regressed_indices) == live.n_dynamic
        self.rolls, self.level = live.has_roll, not live.has_roll
        self.turn_about(ATTITUDE if live.is_six_dof else (), len(live.state_names))
        self.live = nn.Buffer(live.equation_mask(), persistent=False)
        self.living = nn.Buffer(live.active_mask(), persistent=False)
        self.known_rates = nn.Buffer(live.angle_rate_matrix(), persistent=False)
        head.set_step(dt)
        self.missed = (
            Missed(head.innovation_time_constant, dt, live)
            if head.innovation_time_constant > 0.0
            else None
        )
        self.width = head.n_state
        self.n_state = head.n_state + (0 if self.missed is None else self.missed.size)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, 3 + n] from what the step holds fixed.

        That is p = signals.prepare(w) and the residual rho [B, n].
        """
        nu_dot = self.found(self.baseline(self.signals(x, p)), rho, dynamic_states(x, self.dof))
        return torch.cat((self.kinematics(x), nu_dot), dim=-1)

    def found(self, known: Tensor, rho: Tensor, nu: Tensor) -> Tensor:
        """Return nu_dot [..., n] from baseline and residual, each [..., n].

        A velocity that is dead stays so, and an angle moves by what moves nu [..., n].
        """
        nu_dot: Tensor = self.head.combine_accelerations(known, rho)
        if self.free:
            return nu_dot
        nu_dot = nu_dot * self.live.to(nu_dot.dtype)
        if self.rolls:
            nu_dot = nu_dot + nu @ self.known_rates.to(nu.dtype)
        return with_depth_rate(nu_dot, nu) if self.spatial else nu_dot

    def angled(self, x: Tensor, after: Tensor) -> Tensor:
        """Return states [B, 3 + n] whose angles moved with the new velocities."""
        if not self.rolls:
            return after
        if self.spatial:
            # pose, depth and attitude move from where they were, by the new velocities
            nu = dynamic_states(after, self.dof)
            nu = torch.where(self.live.to(x.dtype) > 0.0, nu, dynamic_states(x, self.dof))
            rate = with_depth_rate(nu @ self.known_rates.to(nu.dtype), nu)
            held = torch.cat((pose(x), nu), dim=-1)
            moved = torch.cat((self.kinematics(held), rate), dim=-1)
            return self.moved_on(held, self.dt * moved)
        nu = self.turned(dynamic_states(x, self.dof), dynamic_states(after, self.dof))
        return torch.cat((pose(after), nu), dim=-1)

    def turned(self, nu: Tensor, after: Tensor) -> Tensor:
        """Return what moves [..., n] after a step from nu, its angles by the new velocities.

        As with a pose, that keeps an undamped oscillation bounded.
        """
        angles = nu + self.dt * (after @ self.known_rates.to(after.dtype))
        return torch.where(self.live.to(after.dtype) > 0.0, after, angles)

    def alive(self, x: Tensor) -> Tensor:
        """Return states [..., 3 + n] whose dead velocities are zero, whatever somebody gave."""
        if self.whole:
            return x
        return torch.cat((pose(x), dynamic_states(x, self.dof) * self.living.to(x.dtype)), dim=-1)

    def channels(self, x: Tensor, w: Tensor) -> Tensor:
        """Return what baseline and head see, z [..., nz].

        Args:
            x: states [..., 3 + n].
            w: inputs that belong to each state [..., m].
        """
        z: Tensor = self.signals(x, self.signals.prepare(w))
        return z

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return self.stepped(x, self.signals.prepare(w), s)

    def stepped(self, x: Tensor, p: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later, from p = signals.prepare(w) [B, k]."""
        x = self.alive(x)
        z: Tensor = self.signals(x, p)
        if self.missed is None:
            rho, s = self.head(z, s)
            return self.advanced(x, z, p, rho), s
        missed = self.missed(x, s[:, self.width :])
        rho, own = self.head(torch.cat((z, missed), dim=-1), s[:, : self.width])
        after = self.advanced(x, z, p, rho)
        return after, torch.cat((own, self.missed.remembered(after, missed)), dim=-1)

    def advanced(self, x: Tensor, z: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state [B, 3 + n] one step later.

        Args:
            x: states [B, 3 + n].
            z: their channels [B, nz], which the first stage needs again.
            p: what `signals.prepare` returned for the step's inputs.
            rho: residual of the step [B, n].
        """
        nu_dot = self.found(self.baseline(z), rho, dynamic_states(x, self.dof))
        return self.integrate_from(torch.cat((self.kinematics(x), nu_dot), dim=-1), x, p, rho)

    def known(self, z: Tensor) -> Tensor:
        """Return what the baseline says at channels z [..., nz], accelerations [..., n]."""
        found: Tensor = self.baseline(z)
        return found

    def one_step(self, z: Tensor) -> Tensor:
        """Return nu_dot [B, T, n] along measured channels [B, T, nz] (teacher forcing).

        The head's memory is empty at first.
        """
        return self.taught(z, self.known(z))

    def taught(self, z: Tensor, known: Tensor) -> Tensor:
        """Return what `one_step` does where the baseline's share [B, T, n] is known."""
        if self.missed is not None:
            return self._observed(z, known)
        return self.found(known, self.head.teacher_forced_residuals(z), z[..., : self.dof])

    def _observed(self, z: Tensor, known: Tensor) -> Tensor:
        """Return nu_dot [B, T, n] where the head is shown what was predicted wrong.

        Long measurements are cut into pieces that run side by side, each behind as long a past.
        """
        rows, steps, copies = z.shape[0], z.shape[1], self.head.batch_ensemble_size
        piece = max(round(_PIECE / self.dt), 1)
        first = torch.arange(-piece, steps, piece)
        at = first[:-1, None] if len(first) > 1 else first[:, None]
        place = at + torch.arange(2 * piece)
        inside = ((place >= 0) & (place < steps)).to(z.dtype)
        place = place.clamp(0, steps - 1)
        z, known = (part[:, place].repeat(copies, 1, 1, 1).flatten(0, 1) for part in (z, known))
        inside = inside.repeat(copies * rows, 1)
        n = self.dof
        x = torch.cat((z.new_zeros(z.shape[:-1] + (3,)), z[..., :n]), dim=-1)  # noqa: RUF005
        s, out = z.new_zeros((len(z), self.n_state)), []
        assert self.missed is not None
        for k in range(2 * piece):
            missed = self.missed(x[:, k], s[:, self.width :])
            rho, own = self.head(torch.cat((z[:, k], missed), dim=-1), s[:, : self.width])
            nu_dot = self.found(known[:, k], rho, z[:, k, :n])
            after = torch.cat((x[:, k, :3], x[:, k, 3:] + self.dt * nu_dot), dim=-1)
            s = torch.cat((own, self.missed.remembered(after, missed)), dim=-1)
            s = s * inside[:, k, None]
            out.append(nu_dot)
        each = torch.stack(out[piece:], dim=1).reshape(copies, rows, -1, n)
        return each.mean(0)[:, :steps]

    def acceleration(self, x: Tensor, w: Tensor, s: Tensor) -> Tensor:
        """Return nu_dot [B, n] of baseline and head at states x [B, 3 + n], inputs w and memory."""
        z = self.channels(x, w)
        if self.missed is None:
            rho, _ = self.head(z, s)
        else:
            missed = self.missed(x, s[:, self.width :])
            rho, _ = self.head(torch.cat((z, missed), dim=-1), s[:, : self.width])
        return self.found(self.baseline(z), rho, dynamic_states(x, self.dof))

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory [B, n_state] that a measured past leaves.

        Args:
            y_history: measured states [B, T, 3 + n], oldest first; T may be 0.
            w_history: inputs held over the step that follows each of them [B, T, m].
        """
        if self.missed is None:
            s: Tensor = self.head.warmup(self.channels(y_history, w_history))
            return s
        s = y_history.new_zeros((y_history.shape[0], self.n_state))
        for k in range(y_history.shape[1]):
            s = self.step(y_history[:, k], w_history[:, k], s)[1]
        return s

    @property
    def observes(self) -> bool:
        """Whether the measured past tells the memory how wrong it was predicted."""
        return self.missed is not None

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], of the head and of what was missed."""
        low, high = self.head.memory_bounds()
        if self.missed is None:
            return low, high
        least, most = self.missed.memory_range()
        return torch.cat((low.double(), least)), torch.cat((high.double(), most))
