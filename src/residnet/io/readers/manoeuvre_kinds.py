"""Kinds of manoeuvres from the names of files and from the motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from residnet.core.log import Log
from residnet.io.header_vocabulary import MANOEUVRE_PATTERNS, normalize_name
from residnet.io.readers.base import locate_file

UNKNOWN = "unknown"
"""Kind of a log that neither its name nor its motion determines."""
_MIN_CIRCLE = 2.0 * np.pi
"""Smallest change of the heading in rad in a turning circle."""
_MIN_ANGLE = np.radians(3.0)
"""Smallest rudder angle in rad that counts as executed."""
_MIN_HELD_SHARE = 0.8
"""Smallest share of the samples at the executed rudder angle in a turning circle, and at either of
both angles in a zigzag."""
_MIN_EXECUTES = 3
"""Fewest changes of the side of the rudder in a zigzag."""
_ANGLE_TOLERANCE = 0.15
"""Largest relative difference from the executed rudder angle."""


def resolve_manoeuvre(setting: str | None, path: Path, log: Log) -> str:
    """Return the kind of manoeuvre of a log.

    Args:
        setting: `folder` takes the name of the folder of the file, `auto` infers the kind from the
            name of the file, else from rudder angle and heading; any other text is the kind itself;
            None means unknown.
        path: file of the log.
        log: the log in SI.
    """
    if setting == "folder":
        return locate_file(path).resolve().parent.name
    if setting == "auto":
        return match_manoeuvre_name(path.stem) or infer_manoeuvre(log) or UNKNOWN
    return setting or UNKNOWN


def match_manoeuvre_name(name: str) -> str:
    """Return the kind of manoeuvre that the name of a file mentions; empty if it mentions none."""
    text = normalize_name(name)
    return next((kind for kind, regex in MANOEUVRE_PATTERNS.items() if regex.search(text)), "")


def infer_manoeuvre(log: Log) -> str:
    """Return `turning_circle` or `zigzag` if rudder angle and heading show it; empty otherwise.

    In a turning circle one rudder angle is held while the heading changes by a full circle. In a
    zigzag the rudder alternates between two opposite angles and the heading swings about its start.
    """
    rudder = next((name for name in ("delta", "cmd_delta") if name in log.channels), None)
    if rudder is None or "psi" not in log.channels:
        return ""
    is_measured = np.isfinite(log[rudder]) & np.isfinite(log["psi"])
    delta = log[rudder][is_measured]
    psi = log["psi"][is_measured]
    # the approach at rudder amidships belongs to both manoeuvres
    is_executed = np.abs(delta) > _MIN_ANGLE
    if is_executed.sum() < 2:
        return ""
    first_sample = int(np.argmax(is_executed))
    angle = float(np.median(np.abs(delta[is_executed])))
    is_held = np.abs(np.abs(delta[first_sample:]) - angle) < _ANGLE_TOLERANCE * angle
    if is_held.mean() < _MIN_HELD_SHARE:
        return ""
    sides = np.sign(delta[first_sample:][is_held])
    n_executes = int((np.diff(sides) != 0.0).sum())
    heading_range = float(np.ptp(psi[first_sample:]))
    if n_executes == 0 and heading_range > _MIN_CIRCLE:
        return "turning_circle"
    return "zigzag" if n_executes >= _MIN_EXECUTES and heading_range < np.pi else ""
