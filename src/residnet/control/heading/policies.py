"""Learned policies: an observer and a law with a recurrent network, or a network alone.

They steer the heading, or the dive angle under a depth policy.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.control.base import Policy
from residnet.control.heading.classical import HeadingLaw
from residnet.control.heading.turning import Turning
from residnet.core.frames import wrap
from residnet.dynamics.steering_variation import DEPTH, HEADING, Axis


class AnglePolicy(Policy, ABC):
    """A policy that turns a heading, or the dive angle of a depth policy.

    Attributes:
        dt: step in s.
    """

    dt: float

    def read_from(self, state: Sequence[str]) -> None:
        """Take heading and yaw rate, and the speed, from a state with these names."""
        self.psi, self.u, self.r = state.index("psi"), state.index("u"), state.index("r")

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt = dt


class HeadingPolicy(AnglePolicy, ABC):
    """A heading policy with K, T and speed of its vessel, a rudder, and a memory with ranges.

    Attributes:
        axis: that it steers.
        measured: what it is given, with units; what it steers by stands first.
        gain: K of its vessel in 1/s.
        time: T of its vessel in s.
        speed: at which K and T hold, in m/s.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; infinite where it stands at its command at once.
        travel: most that the rudder moves in a step, in rad.
    """

    axis: ClassVar[Axis] = HEADING
    measured: ClassVar[Mapping[str, str]] = {"psi": "rad", "u": "m/s", "r": "rad/s"}

    def __init__(
        self, state: Sequence[str], turning: Turning, limit: float, rate: float | None
    ) -> None:
        super().__init__()
        self.read_from(state)
        self.gain, self.time, self.speed = turning.gain, turning.time, turning.speed
        self.limit = limit
        self.rate = math.inf if rate is None else rate

    def at(self, dt: float) -> None:
        super().at(dt)
        # a large number where the rudder has no rate: infinity would spoil gradients
        self.travel = min(self.rate * dt, 2.0 * self.limit)

    @abstractmethod
    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        """Return what the entries of the memory can be, [low, high] by name, with some room.

        Args:
            turn: fastest yaw rate in rad/s that is measured.
            angle: largest rudder angle in rad, relative to that of a course where one is followed.
        """

    @abstractmethod
    def described(self) -> dict[str, Any]:
        """Return what the card of an exported policy says of its structure."""


@final
class OddCell(nn.Module):
    """A gated recurrent unit whose memory changes sign with its features.

    Gates see the sizes of features and memory, so that they are even; the candidate has no bias, so
    that it is odd (K. Cho and others, 2014, for the gates). A step of another length than that of
    training moves the memory by as much per second.

    Args:
        dt: step of training in s.
        hidden: units of an odd layer between memory and output; 0 for none.
    """

    def __init__(self, features: int, units: int, dt: float, hidden: int = 0) -> None:
        super().__init__()
        both = features + units
        self.gates = nn.Linear(both, 2 * units)
        self.candidate = nn.Linear(both, units, bias=False)
        self.hidden = nn.Linear(both, hidden, bias=False) if hidden > 0 else None
        self.out = nn.Linear(both + hidden, 1, bias=False)
        nn.init.normal_(self.gates.weight, std=1.0 / math.sqrt(both))
        nn.init.zeros_(self.gates.bias)
        nn.init.normal_(self.candidate.weight, std=1.0 / math.sqrt(both))
        nn.init.zeros_(self.out.weight)
        self.units, self.trained_at = units, dt

    def forward(self, features: Tensor, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Return the output [B, 1] and the memory [B, units] after a step of dt seconds."""
        sizes = torch.cat((features, memory), dim=1).abs()
        update, reset = torch.sigmoid(self.gates(sizes)).chunk(2, dim=1)
        kept = (1.0 - update).clamp(min=1e-6)
        if dt != self.trained_at:
            kept = kept.pow(dt / self.trained_at)
        candidate = torch.tanh(self.candidate(torch.cat((features, reset * memory), dim=1)))
        memory = candidate + kept * (memory - candidate)
        known = torch.cat((features, memory), dim=1)
        if self.hidden is not None:
            known = torch.cat((known, torch.tanh(self.hidden(known))), dim=1)
        output: Tensor = self.out(known)
        return output, memory


CONSTANTS = ("heading_rate", "yaw_rate_rate", "push_rate", "cross_rate")
"""Of the observer: how fast heading, yaw rate and push follow what is measured in 1/s, and how
fast the yaw rate follows the heading's innovation in 1/s^2."""

_LOST = 0.35
"""Difference in rad between measured and expected heading beyond which the estimate is lost."""


class Estimate(NamedTuple):
    """What is known of the vessel at a step, each [B, 1], SI.

    Attributes:
        heading, r: now.
        push: rudder angle that what pushes the bow stands for.
        heading_ahead, r_ahead: once the pending commands have arrived.
        surprise_heading, surprise_r: measured less expected.
    """

    heading: Tensor
    r: Tensor
    push: Tensor
    heading_ahead: Tensor
    r_ahead: Tensor
    surprise_heading: Tensor
    surprise_r: Tensor


@final
class HeadingObserver(nn.Module):
    """A Luenberger observer of T r_dot + r = K (delta + push - c psi), with a predictor.

    The rudder is taken to act `lag` seconds after its command; the predictor adds what the commands
    of these seconds will do, in closed form. K grows and T falls with the speed; c, which is zero
    but for a dive angle, falls with its square. Where heading or yaw rate are far from what was
    expected, the estimate begins anew at what is measured.

    Args:
        turning: K, T and speed of the vessel about straight ahead.
        limit: largest push in rad.
        lag: time in s between a command and its rudder; 0 for no predictor.
        dt: step in s.
    """

    def __init__(self, turning: Turning, limit: float, lag: float, dt: float) -> None:
        super().__init__()
        self.gain, self.time, self.c = turning.gain, turning.time, turning.righting
        self.limit, self.lag, self.lost = limit, lag, _LOST
        self.dt, self.pending = dt, round(lag / dt)
        self.register_buffer("left", torch.zeros(0), persistent=False)
        self.left: Tensor
        self.at(dt)

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt, self.pending = dt, round(self.lag / dt)
        # time in s that is left of the lag when each pending command has acted, the oldest first
        left = dt * torch.arange(self.pending - 1, -1, -1, dtype=torch.float64)
        self.left = left.to(self.left.dtype)

    def forward(
        self,
        psi: Tensor,
        r: Tensor,
        heading: Tensor,
        yaw_rate: Tensor,
        push: Tensor,
        pending: Tensor,
        ratio: Tensor,
        constants: list[Tensor],
    ) -> Estimate:
        """Return the estimate with a measurement taken in.

        Args:
            psi, r: measured heading and yaw rate [B, 1].
            heading, yaw_rate, push: expected before the measurement, [B, 1].
            pending: rudder angles [B, pending] that have still to act, the oldest first.
            ratio: speed [B, 1] over that of K and T.
            constants: `CONSTANTS`, [1] or [B, 1] each.
        """
        surprise_heading, surprise_r = wrap(psi - heading), r - yaw_rate
        # no vessel does this within a step: measurements were missing, and the estimate is taken
        # up anew where they come back, with the push as it was
        full = 3.0 * self.gain * ratio * self.limit
        lost = (surprise_heading.abs() > self.lost) | (surprise_r.abs() > full)
        heading, yaw_rate = torch.where(lost, psi, heading), torch.where(lost, r, yaw_rate)
        nothing = torch.zeros_like(surprise_r)
        surprise_heading = torch.where(lost, nothing, surprise_heading)
        surprise_r = torch.where(lost, nothing, surprise_r)
        shares = [1.0 - torch.exp(-self.dt * rate) for rate in constants[:2]]
        turn = shares[1] * surprise_r + self.dt * constants[3] * surprise_heading
        heading, yaw_rate = heading + shares[0] * surprise_heading, yaw_rate + turn
        per_push = self.time / (self.gain * ratio.square())
        push = (push + constants[2] * per_push * turn).clamp(-self.limit, self.limit)
        ahead, r_ahead = heading, yaw_rate
        if self.pending > 0:
            felt = self.righted(push, heading, ratio)
            ahead, r_ahead = self._ahead(heading, yaw_rate, felt, pending, ratio)
        return Estimate(heading, yaw_rate, push, ahead, r_ahead, surprise_heading, surprise_r)

    def righted(self, push: Tensor, heading: Tensor, ratio: Tensor) -> Tensor:
        """Return the push [B, 1] in rad of rudder with what rights the vessel at an angle."""
        return push if self.c == 0.0 else push - self.c / ratio.square() * heading

    def _ahead(
        self, heading: Tensor, r: Tensor, push: Tensor, pending: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return heading and yaw rate [B, 1] when the pending rudder angles have acted."""
        constant = self.time / ratio
        step = 1.0 - torch.exp(-self.dt / constant)
        later = torch.exp(-self.left / constant)
        acting = self.gain * ratio * (pending + push)
        lag = self.dt * self.pending
        kept = torch.exp(-lag / constant)
        r_ahead = kept * r + (acting * step * later).sum(1, keepdim=True)
        turned = (acting * (self.dt - constant * step * later)).sum(1, keepdim=True)
        return heading + constant * (1.0 - kept) * r + turned, r_ahead

    def expected(
        self, heading: Tensor, r: Tensor, push: Tensor, rudder: Tensor, ratio: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return heading [-pi, pi) and yaw rate [B, 1] a step later under a rudder angle."""
        constant = self.time / ratio
        steady = self.gain * ratio * (rudder + push)
        change = (1.0 - torch.exp(-self.dt / constant)) * (steady - r)
        return wrap(heading + self.dt * steady - constant * change), r + change


FIXED = ("heading", "yaw_rate", "push", "rudder", "last_command")
"""Memory of every observed policy; pending rudder angles and the network's units stand behind."""
_FEATURES = 11
"""Columns that the network sees; `ObservedPolicy.forward` lists them."""
_DEGREE = math.pi / 180.0


@final
class ObservedPolicy(HeadingPolicy):
    """The command clamp(limit (law + network) - push), with the law on estimates.

    An observer estimates heading, yaw rate and push, a predictor where they will be once the
    pending commands have arrived; the law sees these, and the push is taken away, with what rights
    a dive angle. The network is a
    recurrent residual, odd, so that port and starboard are alike; its output starts at zero. With
    no units there is no network.

    Memory s [B, 5 + pending + units]: `FIXED` in rad and rad/s, rudder angles that have still to
    act, the oldest first, and the network's units.

    Args:
        turning: K, T and speed of the vessel about straight ahead.
        constants: of the law, then `observer.CONSTANTS`, all positive.
        limit: of the rudder in rad.
        dt: step of the controller in s; `at` changes it.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        lag: time in s between a command and its rudder; 0 for no predictor.
        units: of the network; 0 for none.
        trained_at: step in s that the network is trained at.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        law: HeadingLaw,
        constants: Mapping[str, float | Tensor],
        limit: float,
        dt: float,
        rate: float | None = None,
        lag: float = 0.0,
        units: int = 0,
        trained_at: float = 0.04,
    ) -> None:
        super().__init__(state, turning, limit, rate)
        self.units, self.degree = units, _DEGREE
        self.law = law
        self.observer = HeadingObserver(turning, limit, lag, dt)
        self.names = (*law.constants, *CONSTANTS)
        self.own = len(law.constants)
        values = [torch.as_tensor(constants[name], dtype=torch.float32) for name in self.names]
        self.constants = torch.nn.Parameter(torch.stack(values, dim=-1).log())
        self.network = OddCell(_FEATURES, max(units, 1), trained_at).requires_grad_(units > 0)
        self.trained_at = trained_at
        self.at(dt)

    def at(self, dt: float) -> None:
        super().at(dt)
        self.observer.at(dt)
        self.n_state = len(FIXED) + self.observer.pending + self.units

    def without_network(self) -> ObservedPolicy:
        """Return a copy whose network gives nothing: the law with its constants as they are."""
        alone = copy.deepcopy(self)
        torch.nn.init.zeros_(alone.network.out.weight)
        return alone

    def values(self) -> dict[str, float]:
        """Return the constants by name."""
        found = torch.exp(self.constants.detach()).tolist()
        return dict(zip(self.names, found, strict=True))

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        newest = 5 + self.observer.pending
        parts = (s[:, :3], rudder, s[:, 4:newest])
        if self.observer.pending > 0:
            parts = (s[:, :3], rudder, torch.cat((s[:, 4 : newest - 1], rudder), dim=1))
        return torch.cat((parts[0], parts[1], parts[2], s[:, newest:]), dim=1)

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        push, rudder, half = 1.001 * self.limit, 1.001 * angle, 1.001 * math.pi
        most = dict(zip(FIXED, (half, 3.0 * turn, push, rudder, rudder), strict=True))
        most |= {f"pending_{k}": rudder for k in range(self.observer.pending)}
        most |= {f"unit_{k}": 1.001 for k in range(self.units)}
        return {name: (-high, high) for name, high in most.items()}

    def described(self) -> dict[str, Any]:
        """Return the constants of law and observer, the predictor's lag and the network's units."""
        return {
            "kind": "observed",
            "constants": self.values(),
            "lag": self.observer.lag,
            "units": self.units,
            "trained_at": self.trained_at,
        }

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start: heading and yaw rate as seen, rudder amidships."""
        heading = wrap(x[:, self.psi : self.psi + 1])
        rest = torch.zeros(x.shape[0], self.n_state - 2, dtype=x.dtype)
        return torch.cat((heading, x[:, self.r : self.r + 1], rest), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        fixed, waiting = 5, self.observer.pending
        rudder, last = s[:, 3:4], s[:, 4:5]
        pending = s[:, fixed : fixed + waiting]
        constants = list(torch.exp(self.constants).split(1, dim=-1))
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        psi = x[:, self.psi : self.psi + 1]
        seen = self.observer(
            psi,
            x[:, self.r : self.r + 1],
            s[:, 0:1],
            s[:, 1:2],
            s[:, 2:3],
            pending,
            ratio,
            constants[self.own :],
        )
        error = wrap(reference - seen.heading_ahead)
        decay = ratio / self.time
        force = decay * self.gain * ratio * self.limit
        felt = self.observer.righted(seen.push, seen.heading_ahead, ratio)
        acting = (rudder + felt) / self.limit
        law = self.law(error, seen.r_ahead, acting, force, decay, constants[: self.own])
        law = law - felt / self.limit
        memory = s[:, fixed + waiting :]
        wish = law
        if self.units > 0:
            full = self.gain * ratio * self.limit
            noise = math.sqrt(self.dt / self.trained_at)
            features = torch.cat(
                (
                    torch.tanh(wrap(reference - psi) / self.degree),
                    torch.tanh(error / self.degree),
                    torch.tanh(error / (5.0 * self.degree)),
                    error / (30.0 * self.degree),
                    1.7 * seen.r_ahead / full,
                    torch.tanh(17.0 * seen.r_ahead / full),
                    5.0 * seen.push / self.limit,
                    (3.0 * noise / self.degree) * seen.surprise_heading,
                    (52.0 * noise) * seen.surprise_r / full,
                    last / self.limit,
                    torch.tanh(law),
                ),
                dim=1,
            )
            correction, memory = self.network(features, memory, self.dt)
            wish = law + correction
        command = self.limit * wish.clamp(-1.0, 1.0)
        follows = rudder + (command - rudder).clamp(-self.travel, self.travel)
        queue = torch.cat((pending, follows), dim=1)
        felt = self.observer.righted(seen.push, seen.heading, ratio)
        heading, yaw_rate = self.observer.expected(seen.heading, seen.r, felt, queue[:, 0:1], ratio)
        s = torch.cat((heading, yaw_rate, seen.push, follows, command, queue[:, 1:], memory), dim=1)
        return command, s


@final
class NetworkPolicy(HeadingPolicy):
    """The command clamp(limit network): what it knows of its vessel it has learned in flight.

    The network is a gated recurrent unit with an odd layer behind it, so that port and starboard
    are alike. It sees heading error, yaw rate, the rudder's angle and the last command. Its output
    starts at zero: untrained, it holds the rudder amidships. K and speed of the vessel are scales
    of what it sees.

    Memory s [B, 2 + units]: rudder and last command in rad, then the network's units.

    Args:
        turning: K, T and speed of the vessel about straight ahead.
        limit: of the rudder in rad.
        dt: step of the controller in s; `at` changes it.
        rate: of the rudder in rad/s; None where it stands at its command at once.
        units: of the network, at least one.
        trained_at: step in s that the network is trained at.
    """

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        limit: float,
        dt: float,
        rate: float | None = None,
        units: int,
        trained_at: float = 0.04,
    ) -> None:
        super().__init__(state, turning, limit, rate)
        self.units, self.degree, self.trained_at = units, _DEGREE, trained_at
        self.network = OddCell(8, units, trained_at, hidden=units)
        self.n_state = 2 + units
        self.at(dt)

    def values(self) -> dict[str, float]:
        """Return no constants: there is no law that has any."""
        return {}

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        return torch.cat((rudder, s[:, 1:]), dim=1)

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        most = dict.fromkeys(("rudder", "last_command"), 1.001 * angle)
        most |= {f"unit_{k}": 1.001 for k in range(self.units)}
        return {name: (-high, high) for name, high in most.items()}

    def described(self) -> dict[str, Any]:
        """Return the network's units and the step of its training."""
        return {"kind": "network", "units": self.units, "trained_at": self.trained_at}

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        rudder, last, memory = s[:, 0:1], s[:, 1:2], s[:, 2:]
        ratio = (x[:, self.u : self.u + 1] / self.speed).clamp(0.3, 3.0)
        error = wrap(reference - x[:, self.psi : self.psi + 1]) / self.degree
        turning = x[:, self.r : self.r + 1] / (self.gain * ratio * self.limit)
        features = torch.cat(
            (
                torch.tanh(error),
                torch.tanh(error / 5.0),
                torch.tanh(error / 20.0),
                error / 30.0,
                1.7 * turning,
                torch.tanh(17.0 * turning),
                rudder / self.limit,
                last / self.limit,
            ),
            dim=1,
        )
        wish, memory = self.network(features, memory, self.dt)
        command = self.limit * wish.clamp(-1.0, 1.0)
        follows = rudder + (command - rudder).clamp(-self.travel, self.travel)
        return command, torch.cat((follows, command, memory), dim=1)


SIGHT = ("lookahead", "depth_rate", "drift_rate")
"""Of a depth policy: look-ahead distance in m, and how fast depth and drift follow what is
measured, in 1/s."""
DEEP = 1.2e4
"""Largest depth in m, beyond the deepest sea."""
_DRIFT = 0.5
"""Largest drift of the depth as a share of the speed."""


@final
class DepthPolicy(HeadingPolicy):
    """Depth by the stern planes: a line of sight down to it, and a law on the dive angle.

    The dive angle wanted is atan((z_d - z) / lookahead) - d / u, within `steepest`, with depth z
    and drift d of z_dot = u sin(dive) + d estimated: what buoyancy and the angle of attack do to
    the depth stands in d (T. I. Fossen, Handbook of Marine Craft, 2nd ed. 2021, section 12.4, for
    the line of sight). The law sees the dive angle -theta as heading and -q as yaw rate.

    Memory s [B, 2 + k]: z expected [m], d [m/s], then that of the law.

    Args:
        turning: K, T, c and speed of the dive angle.
        constants: `SIGHT`, all positive.
        steepest: largest dive angle wanted in rad.
        limit, rate, dt: as of a heading policy, of the planes.
    """

    axis = DEPTH
    measured: ClassVar[Mapping[str, str]] = {"z": "m", "u": "m/s", "theta": "rad", "q": "rad/s"}

    def __init__(
        self,
        state: Sequence[str],
        *,
        turning: Turning,
        law: AnglePolicy,
        constants: Mapping[str, float | Tensor],
        steepest: float,
        limit: float,
        dt: float,
        rate: float | None = None,
    ) -> None:
        super().__init__(state, turning, limit, rate)
        self.law, self.steepest, self.share = law, steepest, _DRIFT
        law.read_from(tuple(HeadingPolicy.measured))
        values = [torch.as_tensor(constants[name], dtype=torch.float32) for name in SIGHT]
        self.constants = torch.nn.Parameter(torch.stack(values, dim=-1).log())
        self.at(dt)

    def read_from(self, state: Sequence[str]) -> None:
        """Take depth, speed, pitch and pitch rate from a state with these names."""
        self.columns = [state.index(name) for name in self.measured]

    def at(self, dt: float) -> None:
        super().at(dt)
        self.law.at(dt)
        self.n_state = 2 + self.law.n_state

    def without_network(self) -> DepthPolicy:
        """Return a copy whose law has no network."""
        alone, law = copy.deepcopy(self), self.law
        assert isinstance(law, ObservedPolicy)
        alone.law = law.without_network()
        return alone

    def values(self) -> dict[str, float]:
        """Return the constants by name, those of an observed law too."""
        found = dict(zip(SIGHT, torch.exp(self.constants.detach()).tolist(), strict=True))
        return found | (self.law.values() if isinstance(self.law, ObservedPolicy) else {})

    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        assert isinstance(self.law, HeadingPolicy)
        fast = 3.1 * self.share * self.speed
        own = {"depth": (-1.01 * DEEP, 1.01 * DEEP), "drift": (-fast, fast)}
        return own | self.law.memory_ranges(turn, angle)

    def described(self) -> dict[str, Any]:
        """Return the constants, the steepest dive, and what the law says of itself."""
        assert isinstance(self.law, HeadingPolicy)
        return {
            "kind": "depth",
            "constants": dict(zip(SIGHT, torch.exp(self.constants.detach()).tolist(), strict=True)),
            "steepest": self.steepest,
            "law": self.law.described(),
        }

    def told(self, s: Tensor, rudder: Tensor) -> Tensor:
        return torch.cat((s[:, :2], self.law.told(s[:, 2:], rudder)), dim=1)

    def _angled(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the depth [B, 1], and dive angle, speed and rate [B, 3] as the law sees them."""
        z, u, theta, q = x[:, self.columns].split(1, dim=1)
        return z, torch.cat((-theta, u, -q), dim=1)

    def initial_state(self, x: Tensor) -> Tensor:
        """Return the memory at the start: the depth as seen, no drift."""
        z, angled = self._angled(x)
        return torch.cat((z, torch.zeros_like(z), self.law.initial_state(angled)), dim=-1)

    def forward(self, x: Tensor, reference: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        z, angled = self._angled(x)
        lookahead, follow, learn = torch.exp(self.constants).split(1, dim=-1)
        u = angled[:, 1:2].clamp(0.3 * self.speed, 3.0 * self.speed)
        surprise = z - s[:, 0:1]
        # no vessel does this within a step: the estimate begins anew, with the drift as it was
        surprise = torch.where(surprise.abs() > u, torch.zeros_like(z), surprise)
        known = z - surprise
        depth = known + (1.0 - torch.exp(-self.dt * follow)) * surprise
        most = self.share * u
        drift = s[:, 1:2] + (self.dt * follow * learn) * surprise
        drift = torch.minimum(torch.maximum(drift, -most), most)
        wanted = torch.atan((reference - depth) / lookahead) - drift / u
        wanted = wanted.clamp(-self.steepest, self.steepest)
        command, memory = self.law(angled, wanted, s[:, 2:])
        moved = depth + self.dt * (u * torch.sin(angled[:, 0:1]) + drift)
        return command, torch.cat((moved, drift, memory), dim=1)
