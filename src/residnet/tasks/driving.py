"""Which channels of logs drive the vessel, and which of those that say the same are taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from residnet.core.layout import ALIVE, SIX, Live
from residnet.core.log import Log
from residnet.core.names import ACCELERATION, BOW_WIND, CHANNEL_UNITS, STATE, WIND_INPUTS
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.reading import INPUTS
from residnet.data.drafting.words import PLANES, input_channel, state_channel, words_of
from residnet.data.readers.quantities import QUATERNION

_PASSIVE = (
    *(*STATE, *ACCELERATION, *SIX.moving, "latitude", "longitude", *QUATERNION),
    *(*WIND_INPUTS, *BOW_WIND, "current_north", "current_east"),
)
_STILL = 2e-3
"""Spread of an input, as a share of its size, below which it stays where it is."""
_SAME = 0.9995
"""Correlation from which two inputs count as one."""
_MOST = 8
"""Most inputs that a drafted config takes."""
_FORCES = ("tau_x", "tau_y", "tau_n")


def driving(logs: Sequence[Log], marks: Marks) -> tuple[str, ...]:
    """Return the channels that drive the vessel; empty where the logs hold none.

    Those that stay where they are, what was ordered beside what was measured, and one of two that
    move alike are left out.

    Args:
        logs: in SI.
        marks: is told what was left out and why.
    """
    values = {
        name: np.concatenate([log[name] for log in logs])
        for name in logs[0].channels
        if name not in _PASSIVE and all(name in log.channels for log in logs)
    }
    # the signals of a control loop: of e_yaw, r_yaw, u_yaw and y_yaw the second drives the vessel
    loops = {
        n[2:] for n in values if n.startswith("y_") and {f"u{n[1:]}", f"r{n[1:]}"} <= {*values}
    }
    own = {f"{signal}_{loop}" for loop in loops for signal in "eruy"}
    acting = [
        name
        for name in values
        if (name in own and name[0] == "u") or (name not in own and _acts(name, marks))
    ]
    if loops:
        marks.guess(
            INPUTS, f"u_{min(loops)} is taken as what a controller asks for, by the names beside it"
        )
    names = [name for name in acting if _moves(name, values[name], marks)]
    names = _measured(_forces(logs, names, marks), marks)
    out: list[str] = []
    for name in names:
        twin = next((other for other in out if _alike(values[name], values[other])), None)
        if twin is None:
            out.append(name)
            continue
        if name in CHANNEL_UNITS and twin not in CHANNEL_UNITS:
            # an angle or revolutions say more than a share or pulses
            out[out.index(twin)], name, twin = name, twin, name
        marks.guess(INPUTS, f"{name} moves as {twin} does in every log, and is left out")
    if len(out) > _MOST:
        marks.guess(INPUTS, f"of {len(out)} possible inputs the first {_MOST} are taken")
    return tuple(out[:_MOST])


def _acts(name: str, marks: Marks) -> bool:
    """Return whether the name of a channel does not say that it measures something else."""
    words = words_of(name)
    if input_channel(words) is not None:
        return True
    passive = not words.lacks("voltage", "age", "depth", "index", "machinery")
    if passive or state_channel(words) is not None:
        marks.note(INPUTS, f"{name} is left out: by its name it drives nothing")
        return False
    marks.guess(INPUTS, f"{name} is taken, though its name does not say what it drives")
    return True


def _moves(name: str, values: np.ndarray, marks: Marks) -> bool:
    known = values[np.isfinite(values)]
    if known.size > 1 and float(np.std(known)) > _STILL * float(np.abs(known).max()):
        return True
    level = float(np.median(known)) if known.size else 0.0
    marks.guess(INPUTS, f"{name} stays at {level:.4g}: its effect cannot be told, it is left out")
    return False


def _forces(logs: Sequence[Log], names: Sequence[str], marks: Marks) -> list[str]:
    """Return one set of forces where there are any; it stands for all actuators."""
    sets: dict[str, list[str]] = {}
    for name in names:
        force = next((f for f in _FORCES if name == f or name.startswith(f"{f}_")), None)
        if force is not None:
            sets.setdefault(name.removeprefix(force), []).append(name)
    shares = {tuple(found): _explained(logs, found) for found in sets.values() if len(found) > 1}
    if not shares:
        return list(names)
    told = ", ".join(f"{', '.join(found)}: {share:.2f}" for found, share in shares.items())
    marks.guess(
        INPUTS, f"forces stand for all actuators; share of the accelerations explained: {told}"
    )
    return list(max(shares.items(), key=lambda pair: pair[1])[0])


def _explained(logs: Sequence[Log], names: Sequence[str]) -> float:
    """Return the mean share of the accelerations that velocities and inputs explain in a line."""
    rows, grown = [], []
    for log in logs:
        wanted = [name for name in (*STATE[3:], *names) if name in log.channels]
        if len(wanted) < 3 + len(names):
            continue
        table = log.stack(wanted)
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
    return float((1.0 - left.var(axis=0) / np.maximum(y.var(axis=0), 1e-300)).mean())


def _measured(names: Sequence[str], marks: Marks) -> list[str]:
    """Return the channels without commands whose outcome is measured, and thrust beside turns."""
    turning = [name for name in names if name == "n" or name.startswith("n_")]
    out = []
    for name in names:
        partners = []
        if "cmd" in name:
            measured = name.removesuffix("_cmd").removeprefix("cmd_")
            partners = [measured, measured.replace("cmd_", "")]
        if name.startswith("cmd_"):
            partners.append(f"n_{name.removeprefix('cmd_')}")
        found = next((other for other in partners if other in names and other != name), None)
        if found is not None:
            marks.guess(INPUTS, f"{found} is taken as measured, and not what was ordered ({name})")
        elif name.removesuffix("_rate") in {*names} - {name}:
            marks.note(INPUTS, f"{name} is left out beside {name.removesuffix('_rate')}")
        elif name.startswith("thrust") and turning:
            marks.note(INPUTS, f"{name} is left out beside {turning[0]}: it follows from it")
        else:
            out.append(name)
    return out


def _alike(a: np.ndarray, b: np.ndarray) -> bool:
    known = np.isfinite(a) & np.isfinite(b)
    if known.sum() < 10 or min(float(np.std(a[known])), float(np.std(b[known]))) == 0.0:
        return False
    return abs(float(np.corrcoef(a[known], b[known])[0, 1])) > _SAME


def lacks(names: Sequence[str], live: Live = ALIVE) -> str:
    """Return what no input does, `drives` or `steers`; empty where both are done.

    A vessel that does not turn needs none that steers, one that does not move none that drives.

    Forces, thrusters that turn, and several thrusters do both.
    """
    plain = [name.removeprefix("cmd_") for name in names if not PLANES.match(name)]
    steering = [name.startswith("delta") for name in plain]
    driving = [name in ("n", "thrust", "throttle") for name in plain]
    # one whose name says neither may do either
    rest = [n for n, s, d in zip(plain, steering, driving, strict=True) if not (s or d)]
    both = any(name.startswith(("tau", "azimuth", "nozzle")) for name in rest)
    if both or any(steering) + any(driving) + len(rest) > 1:
        return ""
    lacking = "drives" if any(steering) else "steers"
    return lacking if {"drives": live.moves, "steers": live.turns}[lacking] else ""
