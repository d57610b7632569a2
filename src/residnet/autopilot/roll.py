"""Roll reduction in waves by rudder and stabiliser fins: sea, control laws, evaluation.

The vessel holds a straight course in irregular waves. The rudder controls the heading and damps the
roll (rudder roll damping), the fins damp the roll. Source of the arrangement: Gouletas 2020,
section 5.2.2.3; T. Perez, Ship Motion Control, 2005.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, final

import numpy as np
import torch
from torch import Tensor, nn

from residnet.autopilot.heading.policies import OddGRUCell
from residnet.autopilot.roll_config import GAIN_NAMES, SEA_STATES, RollWeights, Sea
from residnet.core.errors import ConfigError
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.compiled import CompiledRollout
from residnet.engine.rollout import Rollout, Source
from residnet.physics.environment_config import HullBoxConfig, WavesConfig
from residnet.physics.plant import HullPlant, Plant

_MEASURED: Final = ("psi", "r", "phi", "p")
"""Measured states, in the order of the inputs of a policy."""
_FEATURE_SCALES: Final = (0.05, 0.02, 0.1, 0.1)
"""Typical magnitudes of the measured states in rad and rad/s."""
_N_COMMANDS: Final = 2
"""Commands of a policy: rudder and fins."""
_MAX_NETWORK_SHARE: Final = 0.5
"""Largest contribution of the network as a share of the limits of rudder and fins."""


def sample_wave_loads(
    waves: WavesConfig, rows: int, speed: float, t: Tensor, random: np.random.Generator
) -> Tensor:
    """Return wave loads X, Y [N], K, N [N m] on a straight northerly course, [B, T, 4].

    The loads are first-order loads of a box or a table (see `IrregularWaves`) at
    the encounter frequency (Gouletas 2020, eq. (5.31)). Changes of speed and heading by the motion
    are neglected; they are a few per cent and a few degrees.

    Args:
        waves: sea state and box.
        rows: number B of realisations.
        speed: speed in m/s.
        t: times [T] in s.
        random: random generator.
    """
    sea = waves.build(rows, random)
    course = torch.zeros(rows, dtype=torch.float64)
    encounter = sea.omega - sea.wave_number * speed * torch.cos(sea.direction)
    phase = encounter[:, None, :] * t[None, :, None] + sea.phase[:, None, :]
    if sea.rao_coefficients:
        in_phase, table_quadrature = sea.table_response(course)
        return torch.einsum(
            "btk,bk,bkj->btj", torch.cos(phase), sea.amplitude, in_phase
        ) + torch.einsum("btk,bk,bkj->btj", torch.sin(phase), sea.amplitude, table_quadrature)
    quadrature, yaw = sea.force_response(course)
    in_quadrature = torch.einsum("btk,bk,bkj->btj", torch.sin(phase), sea.amplitude, quadrature)
    yaw_moment = torch.einsum("btk,bk,bk->bt", torch.cos(phase), sea.amplitude, yaw)
    return torch.cat((in_quadrature, yaw_moment[..., None]), dim=-1)


class RollPolicy(nn.Module):
    """Heading PD with rudder roll damping and fin PD, and an optional recurrent network.

    The law is delta = -K_psi psi_f - K_r r_f - K_p p - K_phi phi and alpha = -F_p p - F_phi phi.
    psi_f and r_f are heading error and yaw rate after a low-pass filter, so that the rudder does
    not respond to the yaw motion at wave frequency, which it cannot reduce. The network adds to
    both angles. It is an odd function of the measurements, so that the policy is symmetric with
    respect to port and starboard.

    Args:
        gains: constants by name, `GAIN_NAMES`; tensors [B, 1] for a constant of each row.
        limits: limits of rudder and fins in rad.
        units: number of recurrent units of each network, one network for the rudder and one for
            the fins; 0 for the law alone.
        dt: time step in s.
        is_trained: whether the constants of the law are trainable parameters.
    """

    def __init__(
        self,
        gains: Mapping[str, Tensor],
        limits: tuple[float, float],
        units: int,
        dt: float,
        *,
        is_trained: bool = False,
    ) -> None:
        super().__init__()

        def make_gain(name: str) -> nn.Parameter:
            value = gains[name].detach().clone().reshape(-1, 1)
            return nn.Parameter(value, requires_grad=is_trained)

        self.heading_gain = make_gain("heading_gain")
        self.yaw_rate_gain = make_gain("yaw_rate_gain")
        self.filter_share = make_gain("filter_share")
        self.rudder_roll_rate_gain = make_gain("rudder_roll_rate_gain")
        self.rudder_roll_gain = make_gain("rudder_roll_gain")
        self.fin_roll_rate_gain = make_gain("fin_roll_rate_gain")
        self.fin_roll_gain = make_gain("fin_roll_gain")
        self.limits = limits
        self.units = units
        self.dt = dt
        n_features = len(_MEASURED) + _N_COMMANDS
        self.cells = nn.ModuleList(
            [OddGRUCell(n_features, units, dt) for _ in range(_N_COMMANDS)] if units > 0 else []
        )
        self.n_state = 2 + _N_COMMANDS * units

    def gain_values(self) -> dict[str, float]:
        """Return the constants of the law by name (`GAIN_NAMES`), of the first row of a batch."""
        return {name: float(getattr(self, name)[0, 0]) for name in GAIN_NAMES}

    def copy_law(self) -> RollPolicy:
        """Return the law with the present constants, without network and gradients."""
        gains = {name: getattr(self, name) for name in GAIN_NAMES}
        return RollPolicy(gains, self.limits, 0, self.dt)

    def forward(self, measured: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return rudder and fin commands [B, 2] in rad, and the next memory [B, n_state].

        Args:
            measured: heading error, yaw rate, roll angle and roll rate [B, 4], SI.
            memory: filtered heading and yaw rate, then the memory of the network.
        """
        r = measured[:, 1:2]
        phi = measured[:, 2:3]
        p = measured[:, 3:4]
        share = self.filter_share.clamp(0.0, 1.0)
        heading = memory[:, 0:1] + share * (measured[:, 0:1] - memory[:, 0:1])
        yaw_rate = memory[:, 1:2] + share * (r - memory[:, 1:2])
        rudder = (
            -self.heading_gain * heading
            - self.yaw_rate_gain * yaw_rate
            - self.rudder_roll_rate_gain * p
            - self.rudder_roll_gain * phi
        )
        fin = -self.fin_roll_rate_gain * p - self.fin_roll_gain * phi
        states = [heading, yaw_rate]
        commands = [rudder, fin]
        if self.units > 0:
            scales = torch.tensor([_FEATURE_SCALES], dtype=measured.dtype)
            law = torch.cat((rudder / self.limits[0], fin / self.limits[1]), dim=1)
            features = torch.cat((measured / scales, law.clamp(-1.0, 1.0)), dim=1)
            for i, cell in enumerate(self.cells):
                start = 2 + i * self.units
                output, state = cell(features, memory[:, start : start + self.units], self.dt)
                addition = _MAX_NETWORK_SHARE * self.limits[i] * torch.tanh(output)
                commands[i] = commands[i] + addition
                states.append(state)
        limited = [
            command.clamp(-limit, limit)
            for command, limit in zip(commands, self.limits, strict=True)
        ]
        return torch.cat(limited, dim=1), torch.cat(states, dim=1)


@final
class RollControlledCourse(Source):
    """A policy in the loop; the inputs [B, m + 4] are those of the plant, then sensor noise."""

    def __init__(self, policy: RollPolicy, plant: Plant) -> None:
        super().__init__()
        self.policy = policy
        self.columns = [plant.state_names.index(name) for name in _MEASURED]
        self.n_inputs = len(plant.input_names)
        self.depends_on_step = False

    def initial(self, x: Tensor) -> Tensor:
        return torch.zeros(x.shape[0], self.policy.n_state, dtype=x.dtype)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        states = torch.cat([x[:, column : column + 1] for column in self.columns], dim=1)
        commands, memory = self.policy(states + w[:, self.n_inputs :], memory)
        return torch.cat((commands, w[:, _N_COMMANDS : self.n_inputs]), dim=1), memory


class RollRuns(NamedTuple):
    """Simulated courses of B rows over T steps, without the initial transient.

    Attributes:
        roll: roll angle [B, T] in rad.
        heading: heading error [B, T] in rad.
        commands: angles of rudder and fins [B, T, 2] in rad.
    """

    roll: Tensor
    heading: Tensor
    commands: Tensor

    def costs(self, heights: Tensor, weights: RollWeights) -> Tensor:
        """Return the cost [B] in deg^2 per m^2 of squared significant wave height."""
        mean_squares = (
            self.roll.square().mean(1)
            + weights.heading * self.heading.square().mean(1)
            + weights.effort * self.commands.square().sum(2).mean(1)
        )
        return math.degrees(math.degrees(1.0)) * mean_squares / heights.square()


@final
class RollSimulation:
    """Simulations of a vessel with rudder and fins on a straight course in waves.

    Args:
        plant: vessel with the commands cmd_delta, cmd_fin and cmd_thrust.
        hull: box for the wave loads.
        dt: time step in s.
        duration: duration of a simulation in s.
        transient: initial interval in s that is not evaluated.
        noise: standard deviation of the white noise of angles in rad and rates in rad/s.

    Raises:
        ConfigError: if the vessel has no fins.
    """

    def __init__(
        self,
        plant: Plant,
        hull: HullBoxConfig,
        *,
        dt: float = 0.1,
        duration: float = 80.0,
        transient: float = 20.0,
        noise: float = math.radians(0.1),
    ) -> None:
        if not isinstance(plant, HullPlant) or tuple(plant.input_names[:2]) != (
            "cmd_delta",
            "cmd_fin",
        ):
            raise ConfigError(
                "roll reduction: the vessel has no stabiliser fins; give its rudders the section"
                " `fins`, as in configs/vessels/patrol_fins.yaml"
            )
        self.plant = plant
        self.hull = hull
        self.dt = dt
        self.n_steps = round(duration / dt)
        self.n_transient = round(transient / dt)
        self.noise = noise
        self.speed = float(plant.make_initial_state(1)[0, plant.state_names.index("u")])
        # a copy, because the simulations are in single precision
        self._model = PlantDynamics(copy.deepcopy(plant), dt).float()
        self._compiled: dict[tuple[int, bool, bool], CompiledRollout] = {}

    def sample_inputs(
        self, seas: Sequence[Sea], rows_per_sea: int, seed: int
    ) -> tuple[Tensor, Tensor]:
        """Return inputs [B, T, m + 4] of random realisations, float32, and wave heights [B] in m.

        Rows of one sea follow each other.
        """
        random = np.random.default_rng(seed)
        generator = torch.Generator().manual_seed(seed)
        t = self.dt * torch.arange(self.n_steps, dtype=torch.float64)
        loads = torch.cat(
            [
                sample_wave_loads(sea.waves(self.hull), rows_per_sea, self.speed, t, random)
                for sea in seas
            ]
        )
        names = self.plant.input_names
        w = torch.zeros(len(loads), self.n_steps, len(names) + len(_MEASURED))
        full_drive = torch.ones(1, dtype=torch.float64)
        commands = self.plant.commands_for_demand(full_drive, 0.0 * full_drive)[0]
        w[..., : len(commands)] = commands.float()
        for i, name in enumerate(("force_x", "force_y", "force_k", "force_n")):
            w[..., names.index(name)] = loads[..., i].float()
        noise = torch.randn(len(loads), self.n_steps, len(_MEASURED), generator=generator)
        w[..., len(names) :] = self.noise * noise
        heights = torch.tensor([SEA_STATES[sea.state][0] for sea in seas])
        return w, heights.repeat_interleave(rows_per_sea)

    def simulate(self, policy: RollPolicy, w: Tensor) -> RollRuns:
        """Simulate a policy in float32, with gradients if its parameters require them."""
        source = RollControlledCourse(policy, self.plant)
        rollout = Rollout(self._model, source)
        x0 = self.plant.make_initial_state(1).float().expand(len(w), -1)
        arguments = (x0, w, w[:, 0, :0])
        is_per_row = policy.heading_gain.shape[0] > 1
        has_gradient = torch.is_grad_enabled() and policy.heading_gain.requires_grad
        # a rollout that is compiled without gradients has none
        key = (policy.units, is_per_row, has_gradient)
        if key not in self._compiled:
            row_tensors = [f"source.policy.{name}" for name in GAIN_NAMES] if is_per_row else []
            self._compiled[key] = CompiledRollout(rollout, *arguments, row_tensors=row_tensors)
        states, inputs, _ = self._compiled[key].with_rollout(rollout)(*arguments)
        names = self.plant.state_names
        evaluated = slice(self.n_transient, None)
        return RollRuns(
            states[:, 1:, names.index("phi")][:, evaluated],
            states[:, 1:, names.index("psi")][:, evaluated],
            inputs[:, evaluated, :_N_COMMANDS],
        )
