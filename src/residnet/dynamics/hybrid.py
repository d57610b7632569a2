"""The hybrid model, nu_dot = baseline + residual (document 003 eq. (19)), and its disturbance.

A residual in force space acts through the head's mass. An unknown slowly varying force, such as
unmeasured wind, is estimated from a measured past: each step's velocities are compared with those
that the step before predicted, and what is left over moves the estimate, as an observer does. In a
free run nothing is left over, and the estimate is held or decays. So one and the same step serves
both, and nothing has to tell it which is which.
"""

from __future__ import annotations

import math
from typing import final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.baselines.base import Baseline
from residnet.core.columns import heading, pose, sinking, turning, velocities
from residnet.core.config import Config, Seconds
from residnet.core.frames import to_body, to_earth
from residnet.core.layout import ALIVE, ATTITUDE, Live
from residnet.dynamics.base import Dynamics, Integrator
from residnet.heads.base import ResidualHead
from residnet.physics.signals import Signals
from residnet.physics.symmetry import live_of

_PIECE = 20.0
"""Length in s of pieces of a measurement that run side by side, and of the past of each."""
FARTHEST = 100.0
"""Largest velocity or acceleration that a memory may hold, SI."""


class DisturbanceConfig(Config):
    """Settings of an unknown force that a model estimates from the measured past.

    Attributes:
        settle: time constant at which the estimate follows what the model does not explain.
        decay: time constant at which it is forgotten; null holds it over the whole prediction.
    """

    settle: Seconds = Field(default=20.0, gt=0)
    decay: Seconds | None = Field(default=None, gt=0)

    def build(self, dt: float, live: Live = ALIVE) -> Disturbance:
        """Return the observer for a step of dt."""
        return Disturbance(self, dt, live=live)


@final
class Disturbance(nn.Module):
    """The observer: an acceleration north and east and one in yaw, kept in the memory.

    Args:
        config: time constants.
        dt: step in s.
        body: keep it in body axes, where it is forgotten before the vessel has turned.
        live: what moves; n numbers. An angle whose rate is known has no disturbance.

    Attributes:
        size: entries of the memory: whether there is a prediction, what it is, the estimate.
    """

    def __init__(
        self, config: DisturbanceConfig, dt: float, *, body: bool = False, live: Live = ALIVE
    ) -> None:
        super().__init__()
        self.body = body
        self.dof, self.size = live.size, 1 + 2 * live.size
        self.free = len(live.learned) == live.size
        self.register_buffer("mask", live.mask(), persistent=False)
        self.mask: Tensor
        self.gain = (1.0 - math.exp(-dt / config.settle)) / dt
        self.keep = 1.0 if config.decay is None else math.exp(-dt / config.decay)

    def forward(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        """Return the acceleration in body axes [B, n] and the new estimate [B, n].

        Args:
            x: states at the step's start, measured or predicted [B, nx].
            s: memory of the step before [B, 1 + 2 n].
        """
        known, predicted, before = s.split([1, self.dof, self.dof], dim=-1)
        left = (velocities(x, self.dof) - predicted) * known
        if not self.free:
            left = left * self.mask.to(left.dtype)
        if self.body:
            estimate = self.keep * before + self.gain * left
            return estimate, estimate
        north, east = to_earth(left[:, 0], left[:, 1], heading(x))
        seen = torch.cat((torch.stack((north, east), dim=-1), left[:, 2:]), dim=-1)
        estimate = self.keep * before + self.gain * seen
        ahead, across = to_body(estimate[:, 0], estimate[:, 1], heading(x))
        return torch.cat((torch.stack((ahead, across), dim=-1), estimate[:, 2:]), dim=-1), estimate

    def remembered(self, after: Tensor, estimate: Tensor) -> Tensor:
        """Return the memory [B, 1 + 2 n] from the predicted states [B, nx] and estimate [B, n]."""
        predicted = velocities(after, self.dof)
        return torch.cat((torch.ones_like(after[:, :1]), predicted, estimate), dim=-1)

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
    `settle` time is shown the estimate of what was predicted wrong, in place of adding it.
    """

    def __init__(
        self,
        signals: Signals,
        baseline: Baseline,
        head: ResidualHead,
        dt: float,
        integrator: Integrator = "rk4",
        disturbance: Disturbance | None = None,
    ) -> None:
        super().__init__(dt, integrator)
        self.signals = signals
        self.baseline = baseline
        self.head = head
        live = live_of(signals.names)
        self.dof = live.size
        self.whole, self.free = live.whole, len(live.learned) == live.size
        self.rolls, self.level = live.rolls, not live.rolls
        self.turn_about(ATTITUDE if live.spatial else (), len(live.states))
        for name, value in {
            "live": live.mask(),
            "living": live.alive(),
            "known_rates": live.known_rates(),
        }.items():
            self.register_buffer(name, value, persistent=False)
        self.live: Tensor
        self.living: Tensor
        self.known_rates: Tensor
        head.set_step(dt)
        self.shown = head.settle > 0.0
        if self.shown:
            # a low-pass: what settles is forgotten as quickly
            low_pass = DisturbanceConfig(settle=head.settle, decay=head.settle)
            disturbance = Disturbance(low_pass, dt, body=True, live=live)
        self.disturbance = disturbance
        self.width = head.n_state
        self.n_state = head.n_state + (0 if disturbance is None else disturbance.size)

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return x_dot [B, 3 + n] from what the step holds fixed.

        That is p = signals.prepare(w) and the residual rho [B, n].
        """
        nu_dot = self.found(self.baseline(self.signals(x, p)), rho, velocities(x, self.dof))
        return torch.cat((self.kinematics(x), nu_dot), dim=-1)

    def found(self, known: Tensor, rho: Tensor, nu: Tensor) -> Tensor:
        """Return nu_dot [..., n] from baseline and residual, each [..., n].

        A velocity that is dead stays so, and an angle moves by what moves nu [..., n].
        """
        nu_dot: Tensor = self.head.accelerations(known, rho)
        if self.free:
            return nu_dot
        nu_dot = nu_dot * self.live.to(nu_dot.dtype)
        if self.rolls:
            nu_dot = nu_dot + nu @ self.known_rates.to(nu.dtype)
        return sinking(nu_dot, nu) if self.spatial else nu_dot

    def angled(self, x: Tensor, after: Tensor) -> Tensor:
        """Return states [B, 3 + n] whose angles moved with the new velocities."""
        if not self.rolls:
            return after
        if self.spatial:
            # pose, depth and attitude move from where they were, by the new velocities
            nu = velocities(after, self.dof)
            nu = torch.where(self.live.to(x.dtype) > 0.0, nu, velocities(x, self.dof))
            rate = sinking(nu @ self.known_rates.to(nu.dtype), nu)
            held = torch.cat((pose(x), nu), dim=-1)
            moved = torch.cat((self.kinematics(held), rate), dim=-1)
            return self.moved_on(held, self.dt * moved)
        nu = self.turned(velocities(x, self.dof), velocities(after, self.dof))
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
        return torch.cat((pose(x), velocities(x, self.dof) * self.living.to(x.dtype)), dim=-1)

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
        if self.disturbance is None:
            rho, s = self.head(z, s)
            return self.advanced(x, z, p, rho), s
        unknown, estimate = self.disturbance(x, s[:, self.width :])
        seen = torch.cat((z, unknown), dim=-1) if self.shown else z
        rho, own = self.head(seen, s[:, : self.width])
        after = self.advanced(x, z, p, rho if self.shown else rho + unknown)
        return after, torch.cat((own, self.disturbance.remembered(after, estimate)), dim=-1)

    def advanced(self, x: Tensor, z: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        """Return the state [B, 3 + n] one step later.

        Args:
            x: states [B, 3 + n].
            z: their channels [B, nz], which the first stage needs again.
            p: what `signals.prepare` returned for the step's inputs.
            rho: residual of the step [B, n].
        """
        if self.positions or self.signals.wind or self.spatial:
            nu_dot = self.found(self.baseline(z), rho, velocities(x, self.dof))
            return self.integrate_from(torch.cat((self.kinematics(x), nu_dot), dim=-1), x, p, rho)
        row, held = self.baseline.ahead(p)
        return self.moved(x, row, held, rho)

    def moved(self, x: Tensor, row: Tensor, held: list[Tensor], rho: Tensor) -> Tensor:
        """Return the state [B, 3 + n] one step later where nothing but what moves enters.

        The heading follows once, the position stays.

        Args:
            x: states [B, 3 + n].
            row: what the baseline found ahead for the step [B, q].
            held: what it found for all steps.
            rho: residual of the step [B, n].
        """
        place, psi, nu = x.split([2, 1, self.dof], dim=-1)
        nu_dot = self.found(self.baseline.at(nu, row, held), rho, nu)
        total, mean = self.weights[0] * nu_dot, self.weights[0] * turning(nu, self.dof)
        for i in range(1, len(self.nodes)):
            stage = torch.add(nu, nu_dot, alpha=self.dt * self.nodes[i])
            nu_dot = self.found(self.baseline.at(stage, row, held), rho, stage)
            total = torch.add(total, nu_dot, alpha=self.weights[i])
            mean = torch.add(mean, turning(stage, self.dof), alpha=self.weights[i])
        after = torch.add(nu, total, alpha=self.dt)
        if self.rolls and self.semi_implicit:
            after = self.turned(nu, after)
        turned = turning(after, self.dof) if self.semi_implicit else mean
        psi = torch.add(psi, turned, alpha=self.dt)
        return torch.cat((place, psi, after), dim=-1)

    def ahead(self, w: Tensor, s: Tensor) -> tuple[list[list[Tensor]], list[list[Tensor]]]:
        """Return what a stretch of steps needs that no state decides; see `Dynamics.ahead`."""
        p = self.signals.prepare(w)
        rows: list[list[Tensor]] = []
        if self.positions or self.signals.wind or self.spatial:
            for row in p.unbind(1):
                rows.append([row, row])
            return rows, [[], [], []]
        known, held = self.baseline.ahead(p)
        own, kept = self.head.ahead(p, s[:, : self.width])
        ones, others = known.unbind(1), own.unbind(1)
        for k in range(len(ones)):
            rows.append([ones[k], others[k]])
        steps: list[Tensor] = []
        if self.baseline.linear and self.level:
            # a step is linear in states, row and residual: what it does to the unit of each
            unit = torch.eye(12, dtype=w.dtype, device=w.device)
            x, row, rho = unit.split([6, 3, 3], dim=-1)
            steps.append(self.moved(x, row, held, rho))
        return rows, [held, kept, steps]

    def go(
        self, x: Tensor, row: list[Tensor], shared: list[list[Tensor]], s: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the state and the memory one step later, by what `ahead` found."""
        if self.positions or self.signals.wind or self.spatial:
            return self.stepped(x, row[0], s)
        x = self.alive(x)
        nu = velocities(x, self.dof)
        estimate = nu
        if self.disturbance is None:
            rho, own = self.head.at(nu, row[1], s, shared[1])
        else:
            unknown, estimate = self.disturbance(x, s[:, self.width :])
            seen = torch.cat((nu, unknown), dim=-1) if self.shown else nu
            rho, own = self.head.at(seen, row[1], s[:, : self.width], shared[1])
            rho = rho if self.shown else rho + unknown
        if self.baseline.linear and self.level:
            after = torch.cat((x, row[0], rho), dim=-1) @ shared[2][0]
        else:
            after = self.moved(x, row[0], shared[0], rho)
        if self.disturbance is None:
            return after, own
        return after, torch.cat((own, self.disturbance.remembered(after, estimate)), dim=-1)

    def known(self, z: Tensor) -> Tensor:
        """Return what the baseline says at channels z [..., nz], accelerations [..., n]."""
        found: Tensor = self.baseline(z)
        return found

    def one_step(self, z: Tensor) -> Tensor:
        """Return nu_dot [B, T, n] along measured channels [B, T, nz] (teacher forcing).

        The head's memory is empty at first.
        """
        known = self.baseline(z)
        if self.shown:
            return self._observed(z, known)
        rho = self.head.sequence(z)
        return self.found(known, rho, z[..., : self.dof])

    def _observed(self, z: Tensor, known: Tensor) -> Tensor:
        """Return nu_dot [B, T, n] where the head is shown what was predicted wrong.

        Long measurements are cut into pieces that run side by side, each behind as long a past.
        """
        rows, steps, copies = z.shape[0], z.shape[1], self.head.copies
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
        assert self.disturbance is not None
        for k in range(2 * piece):
            unknown, estimate = self.disturbance(x[:, k], s[:, self.width :])
            rho, own = self.head(torch.cat((z[:, k], unknown), dim=-1), s[:, : self.width])
            nu_dot = self.found(known[:, k], rho, z[:, k, :n])
            after = torch.cat((x[:, k, :3], x[:, k, 3:] + self.dt * nu_dot), dim=-1)
            s = torch.cat((own, self.disturbance.remembered(after, estimate)), dim=-1)
            s = s * inside[:, k, None]
            out.append(nu_dot)
        each = torch.stack(out[piece:], dim=1).reshape(copies, rows, -1, n)
        return each.mean(0)[:, :steps]

    def acceleration(self, x: Tensor, w: Tensor, s: Tensor) -> Tensor:
        """Return nu_dot [B, n] of baseline and head at states x [B, 3 + n], inputs w and memory."""
        z = self.channels(x, w)
        if self.shown:
            assert self.disturbance is not None
            unknown, _ = self.disturbance(x, s[:, self.width :])
            rho, _ = self.head(torch.cat((z, unknown), dim=-1), s[:, : self.width])
        else:
            rho, _ = self.head(z, s[:, : self.width])
        return self.found(self.baseline(z), rho, velocities(x, self.dof))

    def warmup(self, y_history: Tensor, w_history: Tensor) -> Tensor:
        """Return the memory [B, n_state] that a measured past leaves.

        Args:
            y_history: measured states [B, T, 3 + n], oldest first; T may be 0.
            w_history: inputs held over the step that follows each of them [B, T, m].
        """
        if self.disturbance is None:
            s: Tensor = self.head.warmup(self.channels(y_history, w_history))
            return s
        s = y_history.new_zeros((y_history.shape[0], self.n_state))
        for k in range(y_history.shape[1]):
            s = self.step(y_history[:, k], w_history[:, k], s)[1]
        return s

    def memory_range(self) -> tuple[Tensor, Tensor]:
        """Return the least and largest memory [n_state], of the head and of the observer."""
        low, high = self.head.memory_range()
        if self.disturbance is None:
            return low, high
        least, most = self.disturbance.memory_range()
        return torch.cat((low.double(), least)), torch.cat((high.double(), most))
