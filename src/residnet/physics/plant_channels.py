"""States and inputs of plants by name, known before a plant is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.errors import ConfigError
from residnet.core.layout import PLANAR_LAYOUT, ROLL_PLANT_LAYOUT, SIX_DOF_PLANT_LAYOUT, StateLayout
from residnet.core.names import WIND_INPUTS

_FORCE_AXES_OF_DOF = {
    PLANAR_LAYOUT.n_dof: ("x", "y", "n"),
    ROLL_PLANT_LAYOUT.n_dof: ("x", "y", "k", "n"),
    SIX_DOF_PLANT_LAYOUT.n_dof: ("x", "y", "z", "k", "m", "n"),
}
_MAX_CONDITION = 1e8
"""Condition number, after scaling, from which a mass matrix counts as singular."""


@dataclass(frozen=True)
class PlantChannels:
    """States and inputs of a plant.

    Attributes:
        state_names: names of the states; those that are not measured begin with `_`.
        command_names: names of the commands, the first inputs.
        exogenous_names: names of the other inputs.
        max_rudder: rudder angle of the full steering command in rad; None without a rudder.
        can_dive: whether a command forces the vessel downwards.
        has_force_commands: whether the vessel can produce any force in surge, sway and yaw.
        max_side_force: largest commanded sway force in N; None if commands are no forces.
    """

    state_names: tuple[str, ...]
    command_names: tuple[str, ...]
    exogenous_names: tuple[str, ...] = ()
    max_rudder: float | None = None
    can_dive: bool = False
    has_force_commands: bool = False
    max_side_force: float | None = None

    @property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs: commands, then exogenous inputs."""
        return self.command_names + self.exogenous_names


def list_exogenous_inputs(layout: StateLayout, *, has_wind: bool) -> tuple[str, ...]:
    """Return the inputs of a hull other than commands.

    They are body forces, current, forces in earth axes and, with wind loads, the true wind.
    """
    return (
        *(f"force_{axis}" for axis in _FORCE_AXES_OF_DOF[layout.n_dof]),
        "current_north",
        "current_east",
        "force_north",
        "force_east",
        *(WIND_INPUTS if has_wind else ()),
    )


def require_invertible_mass(mass: Sequence[Sequence[float]], vessel: str) -> None:
    """Check that a mass matrix [n][n] is positive definite and not nearly singular.

    Raises:
        ConfigError: if it is not.
    """
    # identified mass matrices may be asymmetric, so that the eigenvalues can be complex
    matrix = np.array(mass, dtype=np.float64)
    if (np.linalg.eigvals(matrix).real <= 0).any():
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is not positive definite; added mass (X_udot,"
            " Y_vdot, N_rdot) is negative for a hull"
        )
    # scaled to unit diagonal, because kg and kg m^2 cannot be compared
    scale = np.sqrt(matrix.diagonal())
    condition = float(np.linalg.cond(matrix / np.outer(scale, scale)))
    if condition > _MAX_CONDITION:
        raise ConfigError(
            f"vessel {vessel}: the mass matrix is singular (condition {condition:.1e} after"
            " scaling); check the coupling terms x_G, Y_rdot, N_vdot"
        )
