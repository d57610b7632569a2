"""How well a trajectory was followed and with how much effort (document 002 section 3.5)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from residnet.core.frames import wrap
from residnet.core.layout import HEADING, POSITION, RANGE_VELOCITIES, velocities_on


@dataclass(frozen=True)
class Tracking:
    """The metrics of one run in closed loop; SI, angles in rad.

    Attributes:
        position_mae, position_mse: of the distance to the desired position in m, m^2 (4.6).
        heading_mae, heading_mse: of the wrapped heading error in rad, rad^2 (4.7).
        tau: mean |tau| commanded in surge, sway, yaw.
        feedback: mean |tau_FB| in surge, sway, yaw.
        motion_mse: of the velocities and accelerations against the desired ones in (m/s)^2,
            (m/s)^2, (rad/s)^2 and per second squared (Table 4.8).
        energy: integral of |tau' nu| in J, surge and sway, then yaw.
        power: the same per second in W (Table 4.13).
        iaew: integral of |e| times integral of power (3.18), position [m s J] and heading [rad s
            J].
    """

    position_mae: float
    position_mse: float
    heading_mae: float
    heading_mse: float
    tau: tuple[float, float, float]
    feedback: tuple[float, float, float]
    motion_mse: tuple[float, ...]
    energy: tuple[float, float]
    power: tuple[float, float]
    iaew: tuple[float, float]

    def row(self) -> dict[str, float | list[float]]:
        """Return the metrics for JSON."""
        return {
            key: list(value) if isinstance(value, tuple) else value
            for key, value in asdict(self).items()
        }


def tracking(
    pose: Tensor, motion: Tensor, desired: Tensor, command: Tensor, feedback: Tensor, dt: float
) -> Tracking:
    """Return the metrics of a run in closed loop.

    Args:
        pose: x, y, psi [T, 3].
        motion: nu, nu_dot [T, 6].
        desired: eta_d, nu_d, nu_dot_d [T, 9].
        command: tau_c [T, 3].
        feedback: its part tau_FB [T, 3].
        dt: step in s.
    """
    position = (desired[:, POSITION] - pose[:, POSITION]).norm(dim=-1)
    heading = wrap(desired[:, HEADING] - pose[:, HEADING]).abs()
    work = command * motion[:, RANGE_VELOCITIES]
    # the power of keeping the position and of keeping the heading are told apart (Table 4.13)
    energy = [float(work[:, :2].sum(-1).abs().sum() * dt), float(work[:, 2].abs().sum() * dt)]
    errors = [float(position.sum() * dt), float(heading.sum() * dt)]
    seconds, missed = dt * len(pose), (velocities_on(desired) - motion).square().mean(0).tolist()
    tau, fed = command.abs().mean(0).tolist(), feedback.abs().mean(0).tolist()
    return Tracking(
        float(position.mean()),
        float(position.square().mean()),
        float(heading.mean()),
        float(heading.square().mean()),
        (tau[0], tau[1], tau[2]),
        (fed[0], fed[1], fed[2]),
        tuple(missed),
        (energy[0], energy[1]),
        (energy[0] / seconds, energy[1] / seconds),
        (errors[0] * energy[0], errors[1] * energy[1]),
    )


def mse(residual: Tensor) -> list[float]:
    """Return the mean square of a residual [N, 3] by axis."""
    return [float(value) for value in torch.mean(residual.square(), dim=0)]
