"""Which channels of logs drive the vessel, and which of those that say the same are taken."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.log import Log
from residnet.core.names import ACCELERATION, STATE
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.reading import INPUTS
from residnet.data.drafting.words import input_channel, state_channel, words_of
from residnet.data.readers.quantities import QUATERNION
from residnet.physics.environment.wind import WIND_INPUTS

_PASSIVE = (
    *(*STATE, *ACCELERATION, "phi", "p", "latitude", "longitude", *QUATERNION),
    *(*WIND_INPUTS, "current_north", "current_east"),
)
_STILL = 2e-3
"""Spread of an input, as a share of its size, below which it stays where it is."""
_SAME = 0.9995
_MOST = 8
_FORCES = ("tau_x", "tau_y", "tau_n")


def driving(logs: Sequence[Log], marks: Marks) -> tuple[str, ...]:
    """Return the channels that drive the vessel; empty where the logs hold none.

    Args:
        logs: in SI.
        marks: is told what was left out and why.
    """
    names = [name for name in logs[0].channels if name not in _PASSIVE]
    names = [name for name in names if all(name in log.channels for log in logs)]
    names = _acting(names, marks)
    names = _moving(logs, names, marks)
    names = _forces(logs, names, marks)
    names = _measured(names, marks)
    names = _different(logs, names, marks)
    if len(names) > _MOST:
        marks.guess(INPUTS, f"of {len(names)} possible inputs the first {_MOST} are taken")
    return tuple(names[:_MOST])


def _joined(logs: Sequence[Log], name: str) -> np.ndarray:
    return np.concatenate([log[name] for log in logs])


def _acting(names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels whose names do not say that they measure something else."""
    out = []
    for name in names:
        words = words_of(name)
        if input_channel(words) is not None:
            out.append(name)
        elif state_channel(words) is not None or not words.lacks(
            "voltage", "age", "depth", "index", "machinery"
        ):
            marks.note(INPUTS, f"{name} is left out: by its name it drives nothing")
        else:
            marks.guess(INPUTS, f"{name} is taken, though its name does not say what it drives")
            out.append(name)
    return out


def _moving(logs: Sequence[Log], names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels that do not stay where they are."""
    out = []
    for name in names:
        values = _joined(logs, name)
        known = values[np.isfinite(values)]
        size = float(np.abs(known).max(initial=0.0))
        if known.size < 2 or float(np.std(known)) <= _STILL * size:
            level = float(np.median(known)) if known.size else 0.0
            marks.guess(
                INPUTS, f"{name} stays at {level:.4g}: its effect cannot be told, it is left out"
            )
            continue
        out.append(name)
    return out


def _forces(logs: Sequence[Log], names: Sequence[str], marks: Marks) -> list[str]:
    """Return one set of forces where there are any; it stands for all actuators."""
    sets: dict[str, list[str]] = {}
    for name in names:
        for force in _FORCES:
            if name == force or name.startswith(f"{force}_"):
                sets.setdefault(name.removeprefix(force), []).append(name)
    whole = {suffix: found for suffix, found in sets.items() if len(found) > 1}
    if not whole:
        return list(names)
    shares = {suffix: explained(logs, found) for suffix, found in whole.items()}
    best = max(shares, key=lambda suffix: shares[suffix])
    told = ", ".join(f"{', '.join(whole[s])}: {share:.2f}" for s, share in shares.items())
    marks.guess(
        INPUTS, f"forces stand for all actuators; share of the accelerations explained: {told}"
    )
    return whole[best]


def explained(logs: Sequence[Log], names: Sequence[str]) -> float:
    """Return the mean share of the accelerations that velocities and inputs explain in a line."""
    rows, grown = [], []
    for log in logs:
        values = [log.channels[name] for name in (*STATE[3:], *names) if name in log.channels]
        if len(values) < 3 + len(names):
            continue
        table = np.stack(values, axis=1)
        span = max(1, round(1.0 / float(np.median(np.diff(log.t)))))
        known = np.isfinite(table).all(axis=1)
        both = known[span:] & known[:-span]
        rows.append(table[:-span][both])
        grown.append((table[span:, :3] - table[:-span, :3])[both])
    if not rows or sum(map(len, rows)) < 50:
        return 0.0
    x, y = np.concatenate(rows), np.concatenate(grown)
    x = np.column_stack(((x - x.mean(0)) / np.maximum(x.std(0), 1e-12), np.ones(len(x))))
    left = y - x @ np.linalg.lstsq(x, y, rcond=1e-9)[0]
    shares = 1.0 - left.var(axis=0) / np.maximum(y.var(axis=0), 1e-300)
    return float(shares.mean())


def _measured(names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels without commands whose outcome is measured, and thrust beside turns."""
    turning = [name for name in names if name == "n" or name.startswith("n_")]
    out = []
    for name in names:
        partners = [_partner(name), _partner(name).replace("cmd_", "")]
        found = next((other for other in partners if other in names and other != name), None)
        if name.startswith("cmd_") and found is None:
            side = name.removeprefix("cmd_")
            found = f"n_{side}" if f"n_{side}" in names else None
        if found is not None:
            marks.guess(INPUTS, f"{found} is taken as measured, and not what was ordered ({name})")
        elif name.startswith("thrust") and turning:
            marks.note(INPUTS, f"{name} is left out beside {turning[0]}: it follows from it")
        else:
            out.append(name)
    return out


def _partner(name: str) -> str:
    """Return the name of what was measured of a command."""
    return name.removesuffix("_cmd").removeprefix("cmd_") if "cmd" in name else name


def _different(logs: Sequence[Log], names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels without those that equal one before them."""
    out: list[str] = []
    values = {name: _joined(logs, name) for name in names}
    for name in names:
        twin = next((other for other in out if _alike(values[name], values[other])), None)
        if twin is not None:
            marks.guess(INPUTS, f"{name} moves as {twin} does in every log, and is left out")
            continue
        out.append(name)
    return out


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < 10 or min(float(np.std(a[known])), float(np.std(b[known]))) == 0.0:
        return False
    return abs(float(np.corrcoef(a[known], b[known])[0, 1])) > _SAME


def roles(names: Sequence[str]) -> Mapping[str, tuple[str, ...]]:
    """Return the inputs that push (`drive`) and those that turn (`steer`), by their names."""
    steer = tuple(name for name in names if name.removeprefix("cmd_").startswith("delta"))
    drive = tuple(
        name for name in names if name.removeprefix("cmd_") in ("n", "thrust", "throttle")
    )
    return {"drive": drive, "steer": steer}


def lacks(names: Sequence[str]) -> str:
    """Return what no input does, `drives` or `steers`; empty where both are done.

    Forces, thrusters that turn, and several thrusters do both.
    """
    acting = roles(names)
    rest = [name for name in names if name not in (*acting["drive"], *acting["steer"])]
    pushing = [name for name in rest if not name.removeprefix("cmd_").startswith("delta")]
    if len(pushing) > 1 or any(name.startswith(("tau", "azimuth", "nozzle")) for name in rest):
        return ""
    if not acting["steer"]:
        return "steers"
    return "" if acting["drive"] or pushing else "drives"
