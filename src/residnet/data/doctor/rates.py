"""The rates of pose and velocities of a log, averaged alike so that they can be compared."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.signals import noise_of


@dataclass(frozen=True)
class Rates:
    """The rates of a log on a uniform grid, all averaged over the same few seconds.

    Pose and velocities are thus filtered alike.

    Attributes:
        step: time between samples, s.
        ground: rate of the position, north + i east, [T] in m/s.
        through_water: the same from psi, u, v [T], for each convention.
        yaw: rate of psi [T] in rad/s.
        measured: u, v, r as far as the log has them, [T].
        noise: standard deviation of the noise in `yaw` and in the averaged r.
    """

    step: float
    ground: np.ndarray
    through_water: dict[str, np.ndarray]
    yaw: np.ndarray
    measured: dict[str, np.ndarray]
    noise: tuple[float, float]


def average_rates(log: Log, moving: list[str]) -> Rates:
    """Return the rates over windows in which the pose moves by several times its noise."""
    moving = [name for name in moving if np.isfinite(log[name]).any()]
    step, span = float(np.median(np.diff(log.t))), float(log.t[-1] - log.t[0])
    speed = 0.0
    if "u" in moving and "v" in moving:
        squares = log["u"] ** 2 + log["v"] ** 2
        # either may be known where the other is not
        speed = float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else 0.0
    turning = float(np.nanstd(log["r"])) if "r" in moving else 0.0

    def half(noise: float, rate: float) -> int:
        seconds = min(max(1.5, 10.0 * noise / max(rate, 1e-9)), span / 15.0)
        return max(round(0.5 * seconds / step), 3)

    place, turn = (
        half(max(noise_of(log["x"]), noise_of(log["y"])), speed),
        half(noise_of(log["psi"]), turning),
    )
    position = log["x"] + 1j * log["y"]
    u, v = (log[name] if name in moving else np.full(len(log), np.nan) for name in ("u", "v"))
    angles = {
        "as declared": (log["psi"], u + 1j * v),
        "psi reversed": (-log["psi"], u + 1j * v),
        "v reversed": (log["psi"], u - 1j * v),
    }
    through_water = {
        name: _mean(np.exp(1j * angle) * body, place) for name, (angle, body) in angles.items()
    }
    measured = {name: _mean(log[name], turn if name == "r" else place) for name in moving}
    noise = (
        np.sqrt(0.5) * noise_of(log["psi"]) / (turn * step),
        noise_of(log["r"]) / np.sqrt(2.0 * turn) if "r" in moving else 0.0,
    )
    return Rates(
        step,
        _rate(position, place, step),
        through_water,
        _rate(log["psi"], turn, step),
        measured,
        noise,
    )


def _rate(values: np.ndarray, half: int, step: float) -> np.ndarray:
    """Return the central differences [T] over 2 half steps, NaN at the ends."""
    out = np.full(values.shape, np.nan, dtype=values.dtype)
    if values.size > 2 * half:
        out[half:-half] = (values[2 * half :] - values[: -2 * half]) / (2 * half * step)
    return out


def _mean(values: np.ndarray, half: int) -> np.ndarray:
    """Return the trapezoidal means [T] over 2 half steps.

    They are NaN at the ends and where a sample is missing.
    """
    out = np.full(values.shape, np.nan, dtype=values.dtype)
    if values.size > 2 * half:
        weights = np.ones(2 * half + 1)
        weights[[0, -1]] = 0.5
        missing = np.convolve(~np.isfinite(values), np.ones(2 * half + 1), mode="valid") > 0.5
        out[half:-half] = np.where(
            missing,
            np.nan,
            np.convolve(
                np.where(np.isfinite(values), values, 0.0), weights / (2 * half), mode="valid"
            ),
        )
    return out
