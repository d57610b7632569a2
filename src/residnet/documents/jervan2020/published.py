"""Figures that document 002 (Jervan 2020) prints for its own models."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config


class Published(Config):
    """Figures that document 002 prints for one model, to stand beside the figures of a run.

    The numbers stand as printed, except where a correction of the document says otherwise. A figure
    that the document does not print is left out (null).

    Attributes:
        mse: mean square of the residual on the unseen half in N^2, N^2, (N m)^2 (Tables 4.2, 4.5,
            4.7, 4.15); surge, sway and yaw.
        position_mae: mean position error on the course in m (Tables 4.4, 4.10).
        position_mse: mean square position error on the course in m^2 (Tables 4.4, 4.10).
        heading_mae: mean heading error on the course in deg (Tables 4.4, 4.10).
        tau: mean absolute commanded force in N, N, N m (Tables 4.3, 4.9).
        feedback: mean absolute force of the feedback alone in N, N, N m (Tables 4.3, 4.9).
        crossing_position_mae: mean position error in the operational crossing in m (Table 4.12).
        crossing_position_mse: mean square position error in the crossing in m^2 (Table 4.12).
        crossing_heading_mae: mean heading error in the crossing in deg (Table 4.12).
        alone: mean square error of u, v, r and of their derivatives against the desired motion
            without feedback, in (m/s)^2, (m/s)^2, (rad/s)^2 and the same per second squared
            (Table 4.8, correction J21).
        crossing_power: mean power in W that position and heading take in the crossing (Table 4.13).
        coefficients: coefficients of the basis functions in surge, sway and yaw in SI units
            (Table 4.11), by basis function.
    """

    mse: tuple[float, float, float] | None = None
    position_mae: float | None = None
    position_mse: float | None = None
    heading_mae: float | None = None
    tau: tuple[float, float, float] | None = None
    feedback: tuple[float, float, float] | None = None
    crossing_position_mae: float | None = None
    crossing_position_mse: float | None = None
    crossing_heading_mae: float | None = None
    alone: tuple[float, float, float, float, float, float] | None = None
    crossing_power: tuple[float, float] | None = None
    coefficients: dict[str, tuple[float, float, float]] = Field(default_factory=dict)
