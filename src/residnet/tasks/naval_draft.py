"""Draft of a manoeuvring booklet and of derivatives for `residnet new --length L --scale S`.

The manoeuvring booklet has the standard manoeuvres of IMO resolution MSC.137(76) within the tested
rudder angles: turning circles, 10/10 and 20/20 zigzags, pull-outs, and a stopping trial where the
logs contain astern revolutions. The steering gear follows from the logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.config import Quantity
from residnet.core.errors import FitError, UsageError
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes, Key
from residnet.physics.actuators.steering_gear import (
    SteeringGear,
    estimate_rudder_rate,
    identify_steering_gear,
)
from residnet.physics.similarity import is_drive, is_rudder

BOOKLET_KEY: Key = ("booklet",)
DERIVATIVES_KEY: Key = ("derivatives",)
_IMO_RUDDER_DEG = 35.0
"""Rudder angle of turning circles in deg (MSC.137(76), section 5.3.1: 35 deg or the maximum)."""
_APPROACH_SHARE = 0.02
"""Part of a log at its start that counts as the approach."""
_DURATION_LENGTHS = 150.0
"""Time limit of a manoeuvre in ship lengths travelled at the approach speed."""
_PULL_OUT_LENGTHS = 5.0
"""Time in ship lengths over which the yaw rate after a pull-out must be steady."""
_MIN_WHOLE_LOGS = 3
"""Smallest number of logs of which whole ones are held out instead of parts in time."""


@dataclass(frozen=True)
class NavalParticulars:
    """Particulars on the command line of `residnet new`, as texts with units or SI numbers.

    Attributes:
        length: length of the vessel in the logs.
        scale: length of the ship divided by the length of the vessel in the logs.
        particulars: further particulars by name: beam, draught, mass.
    """

    length: float
    scale: float
    particulars: Mapping[str, float]

    @classmethod
    def from_options(
        cls,
        length: str | float | None,
        scale: float | None,
        options: Mapping[str, str | float | None],
    ) -> NavalParticulars | None:
        """Return the particulars of a command line; None without a length.

        Raises:
            UsageError: if a value has a wrong unit or is not positive, or the length is missing.
        """
        given_options = {name: text for name, text in options.items() if text is not None}
        if length is None:
            if scale is not None or given_options:
                name = "scale" if scale is not None else next(iter(given_options))
                raise UsageError(f"--{name}: needs --length too, the length in the logs")
            return None
        units = {"length": "m", "beam": "m", "draught": "m", "mass": "kg"}
        values = {}
        for name, text in {"length": length, **given_options}.items():
            try:
                values[name] = Quantity(units[name]).convert(_to_number(text))
            except ValueError as error:
                raise UsageError(f"--{name}: {error}") from None
            if not values[name] > 0.0:
                raise UsageError(f"--{name}: expected a positive number, got {text}")
        ratio = 1.0 if scale is None else scale
        if not 0.0 < ratio < math.inf:
            raise UsageError(f"--scale: expected a positive number such as 50, got {ratio:g}")
        return cls(values.pop("length"), ratio, values)


def _to_number(text: str | float) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def approach_speed(logs: Sequence[Log]) -> float:
    """Return the median speed in m/s at the beginning of logs, before the first helm order."""
    speeds = []
    for log in logs:
        n_samples = max(int(_APPROACH_SHARE * len(log)), 3)
        speed = np.hypot(log["u"][:n_samples], log["v"][:n_samples])
        if np.isfinite(speed).any():
            speeds.append(float(np.nanmedian(speed)))
    return float(np.median(speeds)) if speeds else math.nan


def draft_naval_sections(
    logs: Sequence[Log],
    inputs: Sequence[str],
    naval: NavalParticulars,
    model: str,
    draft_notes: DraftNotes,
) -> dict[str, Any]:
    """Return the sections `booklet` and `derivatives` of a config.

    Args:
        logs: logs with complete motion, in SI units.
        inputs: inputs of the model.
        naval: length, scale and further particulars.
        model: name of the refitted baseline.
        draft_notes: receives the reasons of the values.

    Returns:
        The sections; a section that the logs do not allow is missing, with a note.
    """
    speed = approach_speed(logs)
    rudders = [name for name in inputs if is_rudder(name)]
    if not speed > 0.0 or len(rudders) != 1:
        reason = (
            "the logs have no approach speed"
            if len(rudders) == 1
            else f"it needs one rudder among the inputs, and there are {rudders or 'none'}"
        )
        draft_notes.add_guess(("description",), f"no booklet and no derivatives: {reason}")
        return {}
    rudder = rudders[0]
    largest_rudder_deg = math.degrees(max(float(np.nanmax(np.abs(log[rudder]))) for log in logs))
    # measured angles overshoot the ordered ones by noise and offsets
    angle_deg = min(5.0 * math.floor(largest_rudder_deg / 5.0 + 0.1), _IMO_RUDDER_DEG)
    if angle_deg < 5.0:
        draft_notes.add_guess(
            ("description",),
            f"no booklet: the rudder moves by {largest_rudder_deg:.2g} deg at most",
        )
        return {}
    gear = _estimate_gear(logs, rudder, draft_notes)
    shares: dict[str, dict[str, str | float]] = {
        rudder: {"steer": f"{max(angle_deg, _IMO_RUDDER_DEG):g} deg", **gear}
    }
    # all other inputs are constant during the manoeuvres
    drives = [name for name in inputs if name != rudder]
    for name in drives:
        level = float(np.median(np.concatenate([log[name] for log in logs])))
        shares[name] = {"drive": _round(level)} if is_drive(name) else {"centre": _round(level)}
        if not is_drive(name):
            draft_notes.add_guess(
                (*BOOKLET_KEY, "inputs", name), "held at its median in all manoeuvres"
            )
    # standard manoeuvres at the tested rudder angle; durations scale with the time per length
    time_unit = naval.length / speed
    manoeuvres = _draft_manoeuvres(angle_deg, time_unit)
    if any(is_drive(name) and float(np.nanmin(log[name])) < 0.0 for log in logs for name in drives):
        manoeuvres.append(
            {"kind": "stopping", "name": "full_astern_stop", "drive": 1.0, "start": "0 s"}
        )
    else:
        draft_notes.add_note(
            (*BOOKLET_KEY, "manoeuvres"),
            "no stopping trial: no log contains astern revolutions, whose effect is unknown",
        )
    if angle_deg < _IMO_RUDDER_DEG:
        draft_notes.add_note(
            (*BOOKLET_KEY, "manoeuvres"),
            f"turning circles at {angle_deg:g} deg, the largest tested angle; IMO requires"
            f" {_IMO_RUDDER_DEG:g} deg or the maximum",
        )
    draft_notes.add_note(
        BOOKLET_KEY,
        "standard manoeuvres with 95 % intervals, compared with IMO resolution MSC.137(76), and"
        " the measured zigzags and turning circles next to their repetition by the model",
    )
    draft_notes.add_note(
        (*BOOKLET_KEY, "initial"), "median speed at the beginning of the logs (approach)"
    )
    sections: dict[str, Any] = {
        "booklet": {
            "model": model,
            "length": f"{naval.length:g} m",
            "scale": naval.scale,
            "inputs": shares,
            "initial": {"u": f"{speed:.4g} m/s"},
            "duration": f"{_round(_DURATION_LENGTHS * time_unit):g} s",
            "repeat": ["train", "validation", "test"],
            "skip_failed": True,
            "manoeuvres": manoeuvres,
        },
        "derivatives": {
            "model": model,
            "scale": naval.scale,
            "length": f"{naval.length:g} m",
            "speed": f"{speed:.4g} m/s",
            **{
                name: f"{value:g} {'kg' if name == 'mass' else 'm'}"
                for name, value in naval.particulars.items()
            },
        },
    }
    missing = [name for name in ("beam", "draught", "mass") if name not in naval.particulars]
    note = "hydrodynamic derivatives about the approach speed, in SI, prime and bis systems"
    if missing:
        note += (
            f"; without {', '.join(missing)} they are those of accelerations (forces divided by"
            " mass and added mass)"
        )
    draft_notes.add_note(DERIVATIVES_KEY, note)
    return sections


def _round(value: float) -> float:
    return float(f"{value:.4g}")


def _estimate_gear(
    logs: Sequence[Log], rudder: str, draft_notes: DraftNotes
) -> dict[str, str | float]:
    """Return rate, lag and delay of the steering gear for a config, with a note on their source."""
    key = (*BOOKLET_KEY, "inputs", rudder)
    command = f"cmd_{rudder}"
    try:
        if not rudder.startswith("cmd_") and all(command in log.channels for log in logs):
            gear = identify_steering_gear(logs, command, rudder)
            source = f"steering gear identified from {command} and {rudder}: {gear.describe()}"
        else:
            gear = estimate_rudder_rate(logs, rudder)
            source = (
                f"{gear.describe()}, from {gear.n_movements} rudder movements; a lag or dead time"
                " needs the commanded angle too, or declare lag and delay here"
            )
    except FitError as error:
        draft_notes.add_guess(key, f"{error}; without it the overshoot is underestimated")
        return {}
    draft_notes.add_guess(key, source)
    return _gear_settings(gear)


def _gear_settings(gear: SteeringGear) -> dict[str, str | float]:
    settings: dict[str, str | float] = {}
    if gear.rate is not None:
        settings["rate"] = f"{math.degrees(gear.rate.value):.3g} deg/s"
    if gear.lag is not None:
        settings["lag"] = f"{gear.lag.value:.3g} s"
    if gear.delay is not None:
        settings["delay"] = f"{gear.delay.value:.3g} s"
    return settings


def _draft_manoeuvres(angle_deg: float, time_unit: float) -> list[dict[str, Any]]:
    """Return the standard manoeuvres of a booklet, up to a rudder angle, in its order."""
    common = {"drive": 1.0, "start": "0 s"}
    sides = {"starboard": 1.0, "port": -1.0}
    manoeuvres: list[dict[str, Any]] = [
        {
            "kind": "turning_circle",
            "name": f"circle_{angle_deg:g}_{side}",
            "rudder": f"{sign * angle_deg:g} deg",
            **common,
        }
        for side, sign in sides.items()
    ]
    pull_out_deg = min(angle_deg, 20.0)
    manoeuvres += [
        {
            "kind": "turning_circle",
            "name": f"pull_out_{side}",
            "rudder": f"{sign * pull_out_deg:g} deg",
            "until": "180 deg",
            "pull_out": True,
            "steady": {"window": f"{_round(_PULL_OUT_LENGTHS * time_unit):g} s"},
            **common,
        }
        for side, sign in sides.items()
    ]
    manoeuvres += [
        {
            "kind": "zigzag",
            "name": f"zigzag_{nominal:g}_{nominal:g}",
            "rudder": f"{nominal:g} deg",
            "heading": f"{nominal:g} deg",
            "reversals": 3,
            **common,
        }
        for nominal in (10.0, 20.0)
        if nominal <= angle_deg
    ]
    return manoeuvres


def choose_held_out_logs(logs: Mapping[Path, Log]) -> dict[str, list[Path]] | None:
    """Return a split of few manoeuvres into whole logs: the mildest ones are held out.

    The test log is the mildest zigzag, else the mildest log; the validation log is the mildest of
    the others. A model is then tested within the range of its training data.

    Args:
        logs: logs by path.

    Returns:
        Paths by split; None if there are too few logs or enough for the usual split.
    """
    if not _MIN_WHOLE_LOGS <= len(logs) < 5:
        return None
    by_activity = sorted(logs, key=lambda path: float(np.nanstd(logs[path]["r"])))
    test = next((path for path in by_activity if logs[path].manoeuvre == "zigzag"), by_activity[0])
    other_paths = [path for path in by_activity if path != test]
    return {"train": sorted(other_paths[1:]), "validation": [other_paths[0]], "test": [test]}
