"""The motion at the vessel's centre: levers, earth-fixed to body velocities, derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.errors import UsageError
from residnet.data.derivatives import SavitzkyGolay
from residnet.data.readers.composing.parts import Part
from residnet.data.readers.composing.quantities import Derived, Lever


def at_centre(
    north: np.ndarray, east: np.ndarray, psi: np.ndarray, lever: Lever
) -> tuple[np.ndarray, np.ndarray]:
    """Return the position of the vessel's centre from that of an antenna at `lever`, all [T].

    The lever is in body axes; m and rad.
    """
    c, s = np.cos(psi), np.sin(psi)
    return north - c * lever.x + s * lever.y, east - s * lever.x - c * lever.y


def body_velocity(
    north: np.ndarray, east: np.ndarray, psi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the components along body x and y of an earth-fixed velocity, all [T].

    Source: document 003 eq. (4), transposed.
    """
    c, s = np.cos(psi), np.sin(psi)
    return c * north + s * east, c * east - s * north


def centre_velocity(
    u: np.ndarray, v: np.ndarray, r: np.ndarray, lever: Lever
) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity of the vessel's centre from that of a point at `lever`.

    For a rigid body u_P = u - r y, v_P = v + r x.
    """
    return u + r * lever.y, v - r * lever.x


def derive_motion(
    pose: Sequence[Part], config: Derived, lever: Lever, times: np.ndarray, step: float
) -> dict[str, np.ndarray]:
    """Return x, y, psi, u, v, r [T] on a uniform clock, smoothed and differentiated.

    This is done at the rate of the positions.

    The polynomials run on a grid that divides the log's step until it is as fine as the topics;
    nothing is smoothed across a gap.

    Args:
        pose: the parts that hold x, y (of the antenna) and psi.
        config: windows and order.
        lever: of the antenna.
        times: of the log's samples, s.
        step: between them, s.

    Raises:
        UsageError: where position or heading is missing.
        ConfigError: where a window holds too few samples.
    """
    held = {name for part in pose for name in part.log.channels}
    if not {"x", "y", "psi"} <= held:
        raise UsageError(
            "velocity: kind 'derived' needs position and heading; give both, or channels u, v, r"
        )
    usual = min(part.step for part in pose)
    share = max(1, round(step / usual))
    fine = step / share
    # one window beyond the log's ends where the topics reach further
    reach = int(np.ceil(max(config.window, config.yaw_window or 0.0) / fine))
    grid = times[0] + fine * np.arange(-reach, share * (times.size - 1) + reach + 1)
    motion: dict[str, np.ndarray] = {}
    for part in pose:
        motion.update(part.at(grid, fine))
    x, y = at_centre(motion["x"], motion["y"], motion["psi"], lever)
    translation, yaw = SavitzkyGolay(window=config.window, order=config.order), _yaw(config)
    place, place_rate, _ = translation.derive(
        np.stack((x, y), axis=1), fine, np.zeros(grid.size, dtype=int)
    )
    angle, angle_rate, _ = yaw.derive(motion["psi"][:, None], fine, np.zeros(grid.size, dtype=int))
    psi = angle[:, 0]
    u, v = body_velocity(place_rate[:, 0], place_rate[:, 1], psi)
    out = {"x": place[:, 0], "y": place[:, 1], "psi": psi, "u": u, "v": v, "r": angle_rate[:, 0]}
    return {name: values[reach : grid.size - reach : share] for name, values in out.items()}


def _yaw(config: Derived) -> SavitzkyGolay:
    return SavitzkyGolay(window=config.yaw_window or config.window, order=config.order)
