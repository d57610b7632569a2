"""First-order wave excitation of a hull from a WAMIT file, in body axes.

Source: WAMIT User Manual, Version 7, chapter 4 (files .2 and .3) and chapter 3 (definitions). The
MSS toolbox (Fossen and Perez) reads the same files. Axes of WAMIT are x forward, y to port, z up;
body axes are x forward, y to starboard, z down. The rotation by 180 deg about x reverses sway force
and yaw moment, and the direction of the waves.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from residnet.core.errors import ConfigError

_COLUMN_NAMES: Final = ("PER", "BETA", "I", "MOD", "PHA", "RE", "IM")
_MODES: Final = (1, 2, 4, 6)
"""Modes of WAMIT for surge, sway, roll and yaw."""
_MODE_SIGNS: Final = (1.0, -1.0, 1.0, -1.0)
"""Sign of each mode in body axes."""
_PARITIES: Final = np.array((1.0, -1.0, -1.0, -1.0))
"""Factor of the force of each mode if the waves come from the mirrored side."""
_LENGTH_POWERS: Final = (2, 2, 3, 3)
"""Exponent m of the unit length in the force rho g A L^m of each mode."""


@dataclass(frozen=True)
class ForceRao:
    """Complex force per wave amplitude on a full circle of directions, body axes.

    The load is Re(H a exp(i phase)) for the elevation a cos(phase) at the body origin.

    Attributes:
        omega: wave frequencies in rad/s, increasing [F].
        response: surge and sway force in N/m, roll and yaw moment in N m/m [F, N, 4]; direction
            j is chi = 2 pi j / N relative to the heading, clockwise, 0 for following seas.
    """

    omega: np.ndarray
    response: np.ndarray

    def interpolate_frequencies(self, omega: np.ndarray) -> np.ndarray:
        """Return the response at frequencies [...], as [..., N, 4].

        Real and imaginary parts are linear between the frequencies of the table. The first value
        applies below the table; above it the response is zero, because short waves cancel along
        the hull.
        """
        upper = np.clip(np.searchsorted(self.omega, omega), 1, len(self.omega) - 1)
        lower = upper - 1
        step = self.omega[upper] - self.omega[lower]
        share = np.clip((omega - self.omega[lower]) / step, 0.0, 1.0)[..., None, None]
        values: np.ndarray = (1.0 - share) * self.response[lower] + share * self.response[upper]
        values[omega > self.omega[-1]] = 0.0
        return values

    def fourier_coefficients(self, omega: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return complex coefficients of cos(m chi) and sin(m chi), each [..., 4, M + 1].

        The trigonometric polynomial interpolates the directions of the table.

        Args:
            omega: wave frequencies in rad/s [...].
        """
        values = np.moveaxis(self.interpolate_frequencies(omega), -2, -1)
        n_directions = values.shape[-1]
        orders = np.arange(n_directions // 2 + 1)
        angles = 2.0 * np.pi * np.arange(n_directions)[:, None] * orders / n_directions
        scale = np.full(len(orders), 2.0 / n_directions)
        scale[0] = 1.0 / n_directions
        if n_directions % 2 == 0:
            # the highest order of an even number of directions occurs once
            scale[-1] = 1.0 / n_directions
        return values @ (np.cos(angles) * scale), values @ (np.sin(angles) * scale)

    def unresolved_share(self, omega: np.ndarray, weights: np.ndarray) -> float:
        """Return the share of the load in the two highest orders of the directions.

        The response of a hull of length L has orders up to about k L / 2. A table with fewer orders
        shows it: its coefficients do not decrease towards the highest order, and values between
        its directions are wrong. Orders 0 and 1 are not counted, which every hull has.

        Args:
            omega: wave frequencies in rad/s [F].
            weights: energy of the waves at these frequencies, any unit [F].

        Returns:
            The largest ratio of root mean squares among surge, sway, roll and yaw.
        """
        cosine, sine = self.fourier_coefficients(omega)
        energy = np.einsum("f,fkm->km", weights, np.abs(cosine) ** 2 + np.abs(sine) ** 2)
        highest = energy[:, max(2, energy.shape[1] - 2) :].sum(axis=1)
        total = energy.sum(axis=1)
        # an axis without load is resolved
        return float(np.sqrt(highest / np.where(total > 0.0, total, 1.0)).max())


def read_wamit_excitation(path: Path, unit_length: float, specific_weight: float) -> ForceRao:
    """Read a WAMIT file .2 (Haskind) or .3 (diffraction) of first-order excitation.

    The columns are period in s, direction in deg, mode, modulus, phase in deg, real part and
    imaginary part. The force is rho g A L^m times the table, m = 2 for forces and 3 for moments.
    Directions of 0 to 180 deg only are completed by port/starboard symmetry.

    Args:
        path: the file.
        unit_length: length L of WAMIT (ULEN in the geometry file) in m.
        specific_weight: rho g in N/m^3.

    Raises:
        ConfigError: if a row is invalid or the directions do not divide the circle evenly.
    """
    conditions = _read_conditions(path)
    periods = sorted({period for period, _ in conditions}, reverse=True)
    directions = sorted({direction for _, direction in conditions})
    if len(periods) < 2:
        raise ConfigError(
            f"{path}: {len(periods)} wave periods, expected at least 2; add periods to the table"
        )
    factors = np.array(
        [
            sign * specific_weight * unit_length**power
            for sign, power in zip(_MODE_SIGNS, _LENGTH_POWERS, strict=True)
        ]
    )
    response = np.zeros((len(periods), len(directions), len(_MODES)), dtype=complex)
    for i, period in enumerate(periods):
        for j, direction in enumerate(directions):
            condition = conditions.get((period, direction), {})
            for k, mode in enumerate(_MODES):
                if mode not in condition:
                    raise ConfigError(
                        f"{path}: no row for period {period:g} s, direction {direction:g} deg,"
                        f" mode {mode}; expected modes 1, 2, 4 and 6 in every condition"
                    )
                response[i, j, k] = condition[mode] * factors[k]
    omega = 2.0 * np.pi / np.array(periods)
    return ForceRao(omega, _complete_circle(path, directions, response))


def _read_conditions(path: Path) -> dict[tuple[float, float], dict[int, complex]]:
    """Return the table by period in s and direction in deg (0 to 360), then by mode.

    Raises:
        ConfigError: if the file or a row is invalid.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(
            f"{path}: is not a readable text file; expected a WAMIT file .2 or .3"
        ) from error
    conditions: dict[tuple[float, float], dict[int, complex]] = {}
    for number, line in enumerate(lines, 1):
        cells = line.split()
        # WAMIT 7 writes a header
        if not cells or (number == 1 and cells[0][0].isalpha()):
            continue
        values = _parse_numbers(cells)
        if len(values) != len(_COLUMN_NAMES) or not np.isfinite(values).all():
            raise ConfigError(
                f"{path}, row {number}: expected the {len(_COLUMN_NAMES)} numbers"
                f" {' '.join(_COLUMN_NAMES)} of a WAMIT file .2 or .3; correct the row"
            )
        period, direction_deg = values[:2]
        mode = int(values[2])
        # limits of zero and infinite frequency, and modes that the plant does not have
        if period <= 0.0 or mode not in _MODES:
            continue
        force = complex(values[5], values[6])
        condition = conditions.setdefault((period, _wrap_degrees(direction_deg)), {})
        if condition.setdefault(mode, force) != force:
            raise ConfigError(
                f"{path}, row {number}: mode {mode} at period {period:g} s and direction"
                f" {direction_deg:g} deg occurs twice; expected one body and one value for each"
            )
    return conditions


def _parse_numbers(cells: list[str]) -> list[float]:
    """Return the numbers of a row, with exponents E or D of Fortran; empty if one is no number."""
    try:
        return [float(cell.upper().replace("D", "E")) for cell in cells]
    except ValueError:
        return []


def _wrap_degrees(angle: float) -> float:
    """Return an angle in the range 0 to 360 deg, rounded so that equal directions compare equal."""
    return round(angle % 360.0, 6) % 360.0


def _complete_circle(path: Path, directions: list[float], response: np.ndarray) -> np.ndarray:
    """Return the response at clockwise directions of a full circle [F, N, 4].

    Args:
        path: the file, for messages.
        directions: directions of WAMIT in deg, increasing [D].
        response: forces in body axes [F, D, 4].

    Raises:
        ConfigError: if the directions do not divide the circle evenly.
    """
    # clockwise angles of body axes are the negative of WAMIT's
    columns = {_wrap_degrees(-direction): response[:, j] for j, direction in enumerate(directions)}
    if directions[-1] <= 180.0:
        for angle, column in list(columns.items()):
            columns.setdefault(_wrap_degrees(-angle), column * _PARITIES)
    angles = np.array(sorted(columns))
    even_angles = 360.0 / len(angles) * np.arange(len(angles))
    if len(angles) < 4 or not np.allclose(angles, even_angles, atol=1e-3):
        raise ConfigError(
            f"{path}: wave directions {', '.join(f'{d:g}' for d in directions)} deg; expected equal"
            " steps from 0 deg over 180 or 360 deg, at most 90 deg apart"
        )
    return np.stack([columns[angle] for angle in angles], axis=1)
