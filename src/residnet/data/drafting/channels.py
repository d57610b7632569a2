"""The entries of a channel map: units, signs and frames by headers, values and physics.

A vessel moves where it points, more or less, and turns as its heading changes. From that follow the
factor and the sign between a column and the quantity that it stands for, whatever its header says.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

import numpy as np

from residnet.core.layout import Live
from residnet.core.names import BOW_WIND, CHANNEL_UNITS, sides
from residnet.core.units import si_unit, to_si, units
from residnet.data.channels import STILL
from residnet.data.derivatives import local_polynomials
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.words import (
    axis_velocity,
    deep_channel,
    thrown,
    unit_by_size,
    unit_of,
    words_of,
    written_unit,
)
from residnet.data.motion import without_pauses
from residnet.data.readers.base import turned, unwrap
from residnet.data.readers.quantities import (
    COSINE,
    QUATERNION,
    SINE,
    fixes_on_plane,
    unit_quaternion,
    yaw_of,
)

_WINDOW = 1.0
"""Shortest time in s over which positions are differentiated."""
_FITS = 1.35
"""Largest ratio between a measured factor and that of the unit that it stands for."""
CERTAIN = 4.0
"""Standard errors from which a side is told."""
_TELLING = 0.6
"""Least correlation that says anything."""


class Frame(NamedTuple):
    """How columns called x, y, psi become north, east and a heading clockwise from north.

    Attributes:
        swapped: x is the east and y the north.
        from_east: psi counts counter-clockwise from east.
    """

    swapped: bool
    from_east: bool


FRAMES = (Frame(False, False), Frame(True, False), Frame(False, True))
"""Frames that can be told apart; both changes together are a mirror image that fits as well."""
POSE_FRAMES = (Frame(True, True), Frame(True, False))
"""Frames of a pose of ROS, by REP 103 first: x east, y north, headings from east."""


@dataclass(frozen=True)
class Raw:
    """Columns of one log as they stand in its file.

    Attributes:
        t: times [T] in s.
        columns: channel -> values [T] in whatever unit.
    """

    t: np.ndarray
    columns: Mapping[str, np.ndarray]


class Fit(NamedTuple):
    """How a column follows the quantity that it may stand for.

    Attributes:
        factor: that brings the column to SI; negative where it points the other way.
        correlation: between both, without sign.
    """

    factor: float
    correlation: float

    @property
    def telling(self) -> bool:
        """Whether both follow each other."""
        return self.correlation >= _TELLING and np.isfinite(self.factor) and self.factor != 0.0

    def unit(self, expected: str) -> str | None:
        """Return the unit whose factor this is; None where no unit comes near."""
        odd = ("rad/min", "m/min", "cm/s")
        known = [n for n in units() if si_unit(n) == expected and n not in odd]
        best = min(known, key=lambda name: abs(np.log(abs(self.factor) / to_si(name))))
        ratio = abs(self.factor) / to_si(best)
        return best if 1.0 / _FITS < ratio < _FITS else None


class Motion(NamedTuple):
    """The motion of one log by its positions and headings, on a uniform grid.

    Attributes:
        t: times [T].
        forward: speed along the heading [T].
        sideways: speed to starboard [T].
        turning: rate of the heading [T].
    """

    t: np.ndarray
    forward: np.ndarray
    sideways: np.ndarray
    turning: np.ndarray


def heading_of(raw: Raw, unit: str, frame: Frame) -> np.ndarray:
    """Return the heading [T] in rad, unwrapped over its known samples."""
    psi = raw.columns["psi"] * to_si(unit, "rad")
    return unwrap(np.pi / 2 - psi if frame.from_east else psi)


def motion_of(raw: Raw, unit: str, frame: Frame) -> Motion | None:
    """Return the motion by position and heading; None where there are too few of either.

    Args:
        raw: with the columns x, y, psi.
        frame: that is tried.
    """
    psi = heading_of(raw, unit, frame)
    north, east = ("y", "x") if frame.swapped else ("x", "y")
    known = np.isfinite(raw.columns[north]) & np.isfinite(raw.columns[east]) & np.isfinite(raw.t)
    turns = np.isfinite(psi) & np.isfinite(raw.t)
    if min(int(known.sum()), int(turns.sum())) < 30:
        return None
    at = raw.t[known]
    step = float(np.median(np.diff(at)))
    if step <= 0.0 or (at[-1] - at[0]) / step > 1e6:
        return None
    grid = np.arange(at[0], at[-1], step)
    window = max(5, 2 * round(0.5 * _WINDOW / step) + 1)
    if grid.size < 3 * window:
        return None

    def rate(t: np.ndarray, values: np.ndarray) -> np.ndarray:
        return local_polynomials(np.interp(grid, t, values)[:, None], window, 2, step)[1][:, 0]

    speed_north = rate(at, raw.columns[north][known])
    speed_east = rate(at, raw.columns[east][known])
    heading = np.interp(grid, raw.t[turns], psi[turns])
    forward, sideways = turned(speed_north, speed_east, -heading)
    return Motion(grid, forward, sideways, rate(raw.t[turns], psi[turns]))


def along(motions: Sequence[Motion | None]) -> float:
    """Return how far vessels moved where they pointed, from -1 (astern) over 0 (anywhere) to 1."""
    there = [motion for motion in motions if motion is not None]
    ahead = sum(float((m.forward * np.hypot(m.forward, m.sideways)).sum()) for m in there)
    whole = sum(float((m.forward**2 + m.sideways**2).sum()) for m in there)
    return ahead / whole if whole > 0.0 else 0.0


def follows(logs: Sequence[Raw], motions: Sequence[Motion | None], channel: str) -> Fit:
    """Return how a column follows the motion, over all logs that hold it.

    Args:
        logs: with the column.
        motions: of the same logs.
        channel: `u`, `v` or `r`.
    """
    which = {"u": 1, "v": 2, "r": 3}[channel]
    both = alike = column = motion = 0.0
    for raw, moved in zip(logs, motions, strict=True):
        values = raw.columns.get(channel)
        if moved is None or values is None:
            continue
        known = np.isfinite(values) & np.isfinite(raw.t)
        if known.sum() < 30:
            continue
        seen = np.interp(moved.t, raw.t[known], values[known])
        told = moved[which]
        # positions and headings jump at times, which is no motion
        calm = np.abs(told) <= 5.0 * float(np.quantile(np.abs(told), 0.95)) + 1e-12
        # about their means: a bias is no factor, and a steady speed tells one all the same
        mean = 0.0 if channel == "u" else float(seen[calm].mean())
        other = 0.0 if channel == "u" else float(told[calm].mean())
        a, b = seen[calm] - mean, told[calm] - other
        both += float(a @ b)
        # a gyro that was turned over between logs follows in each of them; no frame is told by it
        alike += abs(float(a @ b)) if channel == "r" else float(a @ b)
        column += float(a @ a)
        motion += float(b @ b)
    if min(column, motion) <= 0.0:
        return Fit(0.0, 0.0)
    # of two noisy quantities neither explains the other: the factor lies between both regressions
    correlation = alike / np.sqrt(column * motion)
    return Fit(float(np.sign(both) * np.sqrt(motion / column)), abs(float(correlation)))


def turns_to(
    logs: Sequence[Raw], channel: str, rate: Mapping[int, np.ndarray], angle: str | None = None
) -> tuple[float, float]:
    """Return how a rudder's angle turns the vessel, and the standard error of that.

    The growth of the yaw rate over two seconds is explained by the rudder's mean angle over them
    and by the yaw rate itself. Of planes it is the pitch rate, which weight and buoyancy change by
    the pitch, too.

    Args:
        logs: with the column.
        rate: yaw or pitch rate [T] of each log by its number, rad/s.
        angle: column of the angle that the vessel is righted by; None for none.
    """
    rows, grown = [], []
    for number, raw in enumerate(logs):
        values, r = raw.columns.get(channel), rate.get(number)
        if values is None or r is None:
            continue
        held = np.zeros(raw.t.size) if angle is None else raw.columns[angle]
        known = np.isfinite(values) & np.isfinite(r) & np.isfinite(raw.t) & np.isfinite(held)
        if known.sum() < 50:
            continue
        t, v, w = without_pauses(raw.t[known]), values[known], r[known]
        span = max(2.0, 3.0 * float(np.median(np.diff(t))))
        grid = np.arange(t[0], t[-1] - span, span / 4)
        if grid.size < 10:
            continue
        first, last = np.interp(grid, t, w), np.interp(grid + span, t, w)
        mean = np.mean(
            [np.interp(grid + share * span, t, v) for share in (0.0, 0.25, 0.5, 0.75)], 0
        )
        tilt = np.interp(grid, t, held[known])
        rows.append(np.stack((mean, first, np.ones(grid.size), tilt), axis=1))
        grown.append(last - first)
    if not rows:
        return 0.0, 1.0
    a, b = np.concatenate(rows), np.concatenate(grown)
    scale = np.maximum(np.abs(a).max(axis=0), 1e-12)
    solution, *_ = np.linalg.lstsq(a / scale, b, rcond=1e-9)
    left = b - (a / scale) @ solution
    # neighbouring rows overlap: a quarter of them counts
    variance = 4.0 * float(left @ left) / max(b.size - 3, 1)
    spread = float(np.sqrt(variance * np.linalg.pinv((a / scale).T @ (a / scale))[0, 0]))
    return float(solution[0]), spread


READER = ("data", "reader")
CHANNELS = (*READER, "channels")
_SURE = 0.9
"""Correlation from which a measured factor overrules a header."""
_STEADIER = 0.8
"""Spread of the true wind, in that of what its name says, from which it is told another way.

Of 120 winds of boats that turn, drawn at random, all are told right, and none from north is
misread; of boats that turn by less than a radian a third is taken as its name says.
"""
_SAMPLES = 50
"""Samples of a wind that tell nothing yet."""
_DEEP = ("w", "q", "z", "theta")
"""What a vessel under water is told by, beside the channels of a roll."""
STATE_NAMES = (
    *("x", "y", "psi", "u", "v", "r", "phi", "p", *_DEEP, "wind_speed", "wind_dir"),
    *BOW_WIND,
)
_FIXES = {"x": "latitude", "y": "longitude"}
MAGNETIC = re.compile(r"magn|compass|kompass|\bhdm\b|\(m\)|\bmag(?![a-z])|_mag(?![a-z])", re.I)
_QUATERNION = re.compile(
    r"(?P<stem>(?:.*[\W_])?(?:q|quat|quaternions?|orient|orientation|att|attitude|rot|rotation))"
    r"[\W_]*(?P<part>[xyzwijk0-3])\W*",
    re.IGNORECASE,
)
_PARTS = {**dict(zip("xyzw", QUATERNION, strict=True)), "i": "qx", "j": "qy", "k": "qz"}
_COUNTED = (("qw", "qx", "qy", "qz"), QUATERNION)
"""What counted parts may be: most write the scalar part first, some last."""
_POSE = {
    **{"x": r"position\W*x", "y": r"position\W*y"},
    **{"qw": r"orientation\W*w", "psi": r"orientation\W*yaw"},
}
"""How the columns of a message geometry_msgs/Pose end, and of its yaw in PlotJuggler."""
_NED = re.compile(r"(?:^|[\W_])(?:ned|frd)(?:$|[\W_])", re.IGNORECASE)


def quaternions(columns: Sequence[str]) -> list[dict[str, str]]:
    """Return for each quaternion channel -> column, by what the columns are called.

    Parts that are counted 0 to 3 stand twice, with the scalar part first and last.
    """
    found: dict[str, dict[str, str]] = {}
    for column in columns:
        # units in brackets do not belong to the name
        match = _QUATERNION.fullmatch(re.sub(r"\s*\[\D*\]$|\s*\(\D*\)$", "", column.strip()))
        if match is not None:
            part = match["part"].lower()
            channels = [_PARTS[part]] if part in _PARTS else [row[int(part)] for row in _COUNTED]
            for number, channel in enumerate(channels):
                kind = f"{match['stem']} {number if part.isdigit() else 'named'}"
                found.setdefault(kind, {}).setdefault(channel, column)
    return [parts for parts in found.values() if set(parts) == set(QUATERNION)]


def submerged(columns: Sequence[str], named: Collection[str]) -> dict[str, str]:
    """Return heave, pitch rate, depth and pitch -> column, of vessels that may dive alone.

    They do with depth, pitch and roll, and where nothing turns them.

    Args:
        named: channels that are known already.
    """
    deep = {column: deep_channel(words_of(column)) for column in columns}
    found = {name: column for column, name in reversed(deep.items()) if name}
    found = {name: found[name] for name in _DEEP if name in found}
    whole = "phi" in named and {"z", "theta"} <= found.keys()
    return found if whole or Live.plunging({*named, *found}) else {}


def levelled(
    attitudes: Sequence[dict[str, str]], tables: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, str]:
    """Return the first of quaternions, in the order of its parts that leaves a vessel level.

    Empty where its squares do not add up to one.

    Args:
        attitudes: channel -> column of each, as `quaternions` gave them.
        tables: column -> values of each table.
    """
    if not attitudes:
        return {}
    columns = set(attitudes[0].values())
    whole = [table for table in tables if columns <= set(table)]
    alike = [parts for parts in attitudes if set(parts.values()) == columns]

    def joined(names: Iterable[str]) -> np.ndarray:
        return np.array([np.concatenate([table[name] for table in whole]) for name in names])

    if not whole:
        return {}
    norm = np.sqrt((joined(columns) ** 2).sum(axis=0))
    norm = norm[np.isfinite(norm) & (norm > 0)]
    if not norm.size or abs(float(np.median(norm)) - 1.0) >= 0.02:
        return {}
    return min(alike, key=lambda parts: np.nanmean(joined((parts["qx"], parts["qy"])) ** 2))


def _frames(names: Mapping[str, str], texts: Iterable[str]) -> tuple[Frame, ...]:
    """Return the frames that a position and a heading may have, by what they are called.

    A pose of ROS counts from east, as REP 103 asks, unless something is called NED.
    """
    posed = all(
        re.search(rf"(?:^|[\W_]){ending}$", names[name].strip(), re.IGNORECASE)
        for name, ending in _POSE.items()
        if name in names
    )
    headed = {"qw", "psi"} & set(names)
    return FRAMES if not headed or not posed or any(map(_NED.search, texts)) else POSE_FRAMES


_CIRCLE = re.compile(
    r"(?P<stem>.*?)[\W_]*(?P<part>cosine|cos|sine|sin|(?<![^\W_])[csxy])"
    r"|(?P<head>cos|sin)[\W_]*(?P<tail>.+?)\W*",
    re.IGNORECASE,
)


def circles(
    columns: Sequence[str], tables: Sequence[Mapping[str, np.ndarray]]
) -> dict[str, tuple[str, str]]:
    """Return stem -> columns of an angle's cosine and sine: their squares add up to one.

    Args:
        columns: names, such as `psi_cos` and `psi_sin`, or `alpha_x` and `alpha_y`.
        tables: column -> values of each table.
    """
    found: dict[str, dict[str, str]] = {}
    for column in columns:
        name = column.strip()
        match = _CIRCLE.fullmatch(name) or _CIRCLE.fullmatch(re.sub(r"\s*[\[(].*", "", name))
        if match is not None:
            part = (match["part"] or match["head"])[0].lower()
            side = COSINE if part in "cx" else SINE
            found.setdefault(match["stem"] or match["tail"] or "", {}).setdefault(side, column)
    out = {}
    for stem, parts in found.items():
        pair = (parts.get(COSINE, ""), parts.get(SINE, ""))
        both = [[table[name] for name in pair] for table in tables if {*pair} <= table.keys()]
        size = np.concatenate([np.hypot(*one) for one in both] or [np.zeros(0)])
        size = size[np.isfinite(size)]
        if stem and size.size and np.quantile(np.abs(size - 1.0), 0.9) < 0.02:
            out[stem] = pair
    return out


def drafted_channels(
    names: Mapping[str, str], logs: Sequence[Raw], marks: Marks, texts: Iterable[str] = ()
) -> dict[str, dict[str, Any]]:
    """Return channel -> entry of a channel map.

    Args:
        names: channel -> column.
        texts: names of columns and cells that may tell a frame.
    """
    attitude = {name: column for name, column in names.items() if name in QUATERNION}
    frames = _frames(names, texts)
    rest = {name: column for name, column in names.items() if name not in QUATERNION}
    angles, made = {}, dict[str, tuple[str, ...]]()
    for name in [one.removesuffix(COSINE) for one in names if one.endswith(COSINE)]:
        made[name] = (name + COSINE, name + SINE)
        pair = (rest.pop(name + COSINE), rest.pop(name + SINE))
        rest[name] = f"angle of {' and '.join(pair)} [rad]"
        angles[rest[name]] = pair
    if attitude:
        made["psi"] = QUATERNION
        rest["psi"] = "heading of the quaternion [rad]"
    logs = [_with_angles(raw, made) for raw in logs]
    rest, logs, fixes = _from_fixes(rest, logs, marks)
    entries = Channels(rest, logs, marks, fixes, frames).drafted()
    if fixes:
        entries = {_FIXES.get(name, name): entry for name, entry in entries.items()}
    for name in [one for one, entry in entries.items() if entry["column"] in angles]:
        entry = entries.pop(name)
        cosine, sine = angles[entry["column"]]
        if entry.pop("frame", ""):
            cosine, sine = sine, cosine
        signed = {"sign": entry["sign"]} if "sign" in entry else {}
        entries[name + COSINE] = {"column": cosine, "unit": "-"}
        entries[name + SINE] = {"column": sine, "unit": "-", **signed}
        marks.move((*CHANNELS, name), (*CHANNELS, name + COSINE))
    if not attitude:
        return entries
    psi = entries.pop("psi")
    entries |= {name: {"column": attitude[name], "unit": "-"} for name in QUATERNION}
    entries["qw"] |= {"frame": psi["frame"]} if "frame" in psi else {}
    marks.move((*CHANNELS, "psi"), (*CHANNELS, "qw"))
    turned = "anticlockwise from east" if "frame" in psi else "clockwise from north"
    text = f"no position tells the frame; the heading is taken to count {turned}"
    if {"x", "y"} <= set(rest):
        text = f"position and heading fit together best where the heading counts {turned}"
    marks.guess((*CHANNELS, "qw"), text)
    if re.search(r"\d\W*$", attitude["qw"]):
        text = f"'{attitude['qw']}' is taken as the scalar part, which leaves the vessel level"
        marks.guess((*CHANNELS, "qw"), text)
    return entries


def _with_angles(raw: Raw, made: Mapping[str, tuple[str, ...]]) -> Raw:
    """Return a log with angles in rad that cosine and sine, or the parts of a quaternion, tell."""
    columns = dict(raw.columns)
    for name, parts in made.items():
        if columns.keys() >= {*parts}:
            own = [columns[part] for part in parts]
            whole = len(own) == len(QUATERNION)
            columns[name] = yaw_of(*unit_quaternion(*own)) if whole else np.arctan2(*own[::-1])
    return Raw(raw.t, columns)


def _from_fixes(
    names: Mapping[str, str], logs: Sequence[Raw], marks: Marks
) -> tuple[dict[str, str], list[Raw], float]:
    """Return channel -> column, the logs, and how many degrees one count of x and y is, or 0.

    Where they are latitude and longitude, x, y of the logs are metres north and east of the first
    fix of each.
    """
    fixes = set(_FIXES.values())
    rest = {name: column for name, column in names.items() if name not in fixes}
    if set(_FIXES) <= set(names) and len(rest) < len(names):
        columns = ", ".join(names[name] for name in sorted(fixes & set(names)))
        marks.note(CHANNELS, f"x and y stand beside it; left out: {columns}")
        return rest, list(logs), 0.0
    if not fixes <= set(names) or set(_FIXES) & set(names):
        return dict(names), list(logs), 0.0
    whole = [raw for raw in logs if fixes <= set(raw.columns)]
    cells = {f: np.concatenate([raw.columns[f] for raw in whole] or [np.zeros(0)]) for f in fixes}
    known = {name: values[np.isfinite(values)] for name, values in cells.items()}
    largest = float(np.abs(known["latitude"]).max(initial=0.0))
    # autopilots count ten millionths of a degree in whole numbers
    counts = all(bool((values == np.round(values)).all()) for values in known.values())
    count = 1e-7 if 1e6 < largest <= 90e7 and counts else 1.0
    if not whole or largest * count > 90.0:
        columns = ", ".join(names[name] for name in _FIXES.values())
        marks.note(CHANNELS, f"{columns} are no degrees with decimals; left out")
        return rest, list(logs), 0.0
    if count < 1.0:
        for name in _FIXES.values():
            text = "whole numbers of this size are ten millionths of a degree"
            marks.guess((*CHANNELS, name), text)
    placed = []
    for raw in logs:
        if fixes <= set(raw.columns):
            phi, lam = (np.radians(count * raw.columns[name]) for name in _FIXES.values())
            north, east, origin, _ = fixes_on_plane(phi, lam)
            if origin is not None:
                raw = Raw(raw.t, {**raw.columns, "x": north, "y": east})
        placed.append(raw)
    return {**{name: names[fix] for name, fix in _FIXES.items()}, **rest}, placed, count


@final
class Channels:
    """The entries of a channel map, from names, headers, values and physics."""

    def __init__(
        self,
        names: Mapping[str, str],
        logs: Sequence[Raw],
        marks: Marks,
        fixes: float,
        frames: Sequence[Frame] = FRAMES,
    ) -> None:
        """From channel -> column, logs, and degrees in one count of x and y, 0 for metres.

        The frames are those that are tried, the likeliest first.
        """
        self._fixes, self._frames = float(fixes), tuple(frames)
        self._names, self._logs, self._marks = dict(names), list(logs), marks
        self._frame = self._frames[0]
        self._motions: list[Motion | None] = [None] * len(logs)
        self._psi_unit = "rad"
        self._flipped: set[str] = set()

    def drafted(self) -> dict[str, dict[str, Any]]:
        """Return channel -> entry."""
        if {"x", "y", "psi"} <= set(self._names):
            self._settle_axes()
            self._settle_frame()
            for name in [one for one in ("u", "v", "r") if one in self._names]:
                self._settle_velocity(name)
        elif "psi" in self._names:
            self._psi_unit = self._unit("psi")
        self._settle_wind()
        return {name: self._entry(name) for name in self._names}

    def _settle_velocity(self, name: str) -> None:
        """Leave out what does not move, or is far larger than the motion and does not follow it."""
        moved = [motion for motion in self._motions if motion is not None]
        if not moved:
            return
        place = {"u": 1, "v": 2, "r": 3}[name]
        told = np.concatenate([motion[place] for motion in moved])
        size = to_si(self._unit(name, mark=False), CHANNEL_UNITS[name])
        own = size * self._values(name)
        # a vessel that only drifts has nearly no motion of one of its axes
        whole = told if name == "r" else np.hypot(*np.concatenate([m[1:3] for m in moved], axis=1))
        what = ""
        if float(np.nanstd(own)) < STILL * float(np.std(told)):
            what = "does not move, while position and heading do"
        elif (
            float(np.nanmedian(np.abs(own))) > float(whole.max())
            and not follows(self._logs, self._motions, name).telling
        ):
            what = "is larger than all motion by position and heading, and does not follow it"
        if what:
            column = self._names.pop(name)
            text = f"'{column}' {what}; left out: {name} follows from them"
            self._marks.note(CHANNELS, text)

    @property
    def _posed(self) -> bool:
        """Whether position and heading are called as those of a pose of ROS."""
        return self._frames == POSE_FRAMES

    def _values(self, name: str) -> np.ndarray:
        parts = [raw.columns[name] for raw in self._logs if name in raw.columns]
        return np.concatenate(parts) if parts else np.zeros(0)

    def _settle_frame(self) -> None:
        """Find the unit and frame of the heading under which the vessel moves where it points."""
        written = written_unit(self._names["psi"], "rad")
        sized, _ = unit_by_size("psi", self._values("psi"))
        # a heading that is not wrapped is large in radians too: its size decides only where the
        # motion does not
        other = "rad" if sized == "deg" else "deg"
        tried = [written] if written else [sized, other]
        if not written and np.nanmax(np.abs(self._values("psi")), initial=0.0) > 720.0:
            tried.append("cdeg")
        best = (-np.inf, "rad", self._frames[0])
        for unit in tried:
            for frame in (f for f in self._frames if not (self._fixes and f.swapped)):
                motions = [motion_of(raw, unit, frame) for raw in self._logs]
                score = self._score(motions)
                if score > best[0] + 0.02:
                    best = (score, unit, frame)
                    self._motions = motions
        score, self._psi_unit, self._frame = best
        if written is None:
            reason = f"position and heading fit together best in {self._psi_unit}"
            self._marks.guess((*CHANNELS, "psi"), f"the header has no unit; {reason}")
        x, y = words_of(self._names["x"]), words_of(self._names["y"])
        told = x.has("north") and y.has("east") and not (x.text == "x" or y.text == "y")
        told = told or self._fixes > 0.0
        if not told and not self._posed and self._turns_to_port():
            self._frame = Frame(not self._frame.swapped, not self._frame.from_east)
            self._motions = [motion_of(raw, self._psi_unit, self._frame) for raw in self._logs]
            text = "seen in a mirror the motion fits as well, but thrust to port turns it to port"
            self._marks.guess((*CHANNELS, "psi"), text)
        if self._frame.swapped and not told:
            self._names["x"], self._names["y"] = self._names["y"], self._names["x"]
            text = "the vessel moves where it points only if the column called y is the north"
            if self._posed and self._frame.from_east:
                text = "x is taken as east and y as north, as in a pose of ROS (REP 103)"
            self._marks.guess((*CHANNELS, "x"), text)
        elif self._frame.swapped:
            # named north and east, yet turned about: the heading counts from east
            self._frame = Frame(False, True)
            self._motions = [motion_of(raw, self._psi_unit, self._frame) for raw in self._logs]
        elif not told and not self._frame.from_east:
            text = f"x is taken as north and y as east: with them the heading fits ({score:.2f})"
            self._marks.guess((*CHANNELS, "x"), text)
        if self._frame.from_east:
            text = "the vessel moves where it points only if the heading counts from east"
            if self._posed:
                text = "the heading is taken to count from east, as in a pose of ROS (REP 103)"
            self._marks.guess((*CHANNELS, "psi"), text)
        if score < 0.5:
            text = f"position, heading and velocities fit together badly ({score:.2f} of 1)"
            self._marks.guess((*CHANNELS, "psi"), f"{text}: check units and axes")
        self._frame = Frame(False, self._frame.from_east)

    def _turns_to_port(self) -> bool:
        """Return whether more of a thruster on the port side turns the vessel to port."""
        for port, stbd in sides(self._names).items():
            if re.match(r"(cmd_)?(delta|azimuth)", port):
                continue
            both = [
                (Raw(raw.t, {"more": raw.columns[port] - raw.columns[stbd]}), motion)
                for raw, motion in zip(self._logs, self._motions, strict=True)
                if motion is not None and {port, stbd} <= raw.columns.keys()
            ]
            rates = {k: np.interp(raw.t, m.t, m.turning) for k, (raw, m) in enumerate(both)}
            slope, error = turns_to([raw for raw, _ in both], "more", rates)
            return slope < -CERTAIN * error
        return False

    def _settle_axes(self) -> None:
        """Leave out velocities along x and y that count along north and east, not along the hull.

        Names such as vx and vy do not say which; position and heading do, without them.
        """
        called = [
            name
            for name in ("u", "v")
            if name in self._names and axis_velocity(words_of(self._names[name])) is not None
        ]
        if not called:
            return
        rest = {name: column for name, column in self._names.items() if name not in called}
        alone = Channels(rest, self._logs, Marks(), self._fixes, self._frames)
        alone._settle_frame()
        still = [Raw(raw.t, {**raw.columns, "psi": np.zeros(raw.t.size)}) for raw in self._logs]
        ground = [motion_of(raw, "rad", FRAMES[0]) for raw in still]

        def fit(motions: Sequence[Motion | None], along: Mapping[str, str]) -> float:
            moved = [
                Raw(raw.t, {along[n]: raw.columns[n] for n in called if n in raw.columns})
                for raw in self._logs
            ]
            return float(np.mean([follows(moved, motions, along[n]).correlation for n in called]))

        same, turned = {"u": "u", "v": "v"}, {"u": "v", "v": "u"}
        best = max(fit(ground, same), fit(ground, turned))
        if best > _SURE and best > fit(alone._motions, same) + 0.05:
            columns = ", ".join(self._names.pop(name) for name in called)
            text = f"{columns} follow the motion along north and east, and not along the vessel's"
            self._marks.note(CHANNELS, f"{text} axes; left out, for u and v follow from positions")
            return
        for name in called:
            text = "taken along the vessel's own axes, which position and heading do not contradict"
            self._marks.guess((*CHANNELS, name), text)

    def _score(self, motions: Sequence[Motion | None]) -> float:
        """Return how well position, heading and velocities fit together, at most 1."""
        fits = [follows(self._logs, motions, name) for name in ("u", "v") if name in self._names]
        if len(fits) == 2:
            # only the forward component tells how the heading lies; both count
            return sum(fit.correlation * (fit.factor > 0 or i) for i, fit in enumerate(fits)) / 2
        return along(motions)

    def _settle_wind(self) -> None:
        """Find whether the wind is told from north or from the bow; one without its half goes."""
        for pair in (BOW_WIND[1:], ("wind_speed", "wind_dir")):
            if len(held := {*pair} & {*self._names}) == 1:
                column = self._names.pop(held.pop())
                self._marks.note(CHANNELS, f"'{column}' alone is no wind; left out")
        if "wind_dir" in self._names and BOW_WIND[2] in self._names:
            columns = ", ".join(self._names.pop(name) for name in BOW_WIND[1:])
            self._marks.note(CHANNELS, f"the true wind stands beside it; left out: {columns}")
        old = BOW_WIND[1:] if BOW_WIND[2] in self._names else ("wind_speed", "wind_dir")
        if old[1] not in self._names:
            return
        tried = ["felt", "felt to port", "bow", "bow to port"]
        if old[1] == "wind_dir":
            true = words_of(self._names["wind_dir"]).has("true")
            tried = ["north", *tried[2 * true :]]
        spread = self._spreads(*old)
        best = min(tried, key=lambda one: spread.get(one, np.inf))
        if spread.get(best, np.inf) > _STEADIER * spread.get(tried[0], 0.0):
            best = tried[0]
        if best == "north":
            text = "the direction is taken as that which the true wind comes from, clockwise from"
            self._marks.guess((*CHANNELS, "wind_dir"), f"{text} north")
            return
        felt = best.startswith("felt")
        side = " to port" if best.endswith("port") else ""
        new = BOW_WIND[1:] if felt else ("wind_speed", BOW_WIND[0])
        names = dict(zip(old, new, strict=True))
        self._names = {names.get(name, name): column for name, column in self._names.items()}
        self._logs = [
            Raw(raw.t, {names.get(name, name): values for name, values in raw.columns.items()})
            for raw in self._logs
        ]
        self._flipped |= {new[1]} if side else set()
        wind = "apparent" if felt else "true"
        text = f"taken from the bow{side}, where the {wind} wind comes from:"
        ratio = spread.get(best, 1.0) / max(spread.get("north", 1.0), 1e-9)
        text += f" so the true wind is steadiest ({ratio:.2f} of its spread if told from north)"
        self._marks.guess((*CHANNELS, new[1]), text)

    def _spreads(self, speed: str, angle: str) -> dict[str, float]:
        """Return how a wind may be told -> spread in m/s of the true wind within a log.

        It may be told from north, or from the bow, clockwise or to port, and that which the moving
        vessel feels has its own velocity in it.
        """
        sizes = [to_si(self._unit(n, mark=False), CHANNEL_UNITS[n]) for n in (speed, angle)]
        found: dict[str, list[float]] = {}
        for raw, motion in zip(self._logs, self._motions, strict=True):
            psi = self._headings(raw)
            if psi is None or not {speed, angle} <= raw.columns.keys():
                continue
            size, direction = (
                raw.columns[n] * f for n, f in zip((speed, angle), sizes, strict=True)
            )
            own, ahead = self._own(raw, motion), np.exp(1j * psi)
            winds = {"north": size * np.exp(1j * direction)}
            for end, sign in (("", 1.0), (" to port", -1.0)):
                winds[f"bow{end}"] = size * np.exp(1j * sign * direction) * ahead
                if own is not None:
                    winds[f"felt{end}"] = winds[f"bow{end}"] - own * ahead
            known = np.isfinite(np.stack([*winds.values()])).all(axis=0)
            if known.sum() >= _SAMPLES:
                for name, wind in winds.items():
                    found.setdefault(name, []).append(float(np.var(wind[known])))
        return {name: float(np.sqrt(np.mean(parts))) for name, parts in found.items()}

    def _own(self, raw: Raw, motion: Motion | None) -> np.ndarray | None:
        """Return the velocity [T] ahead and to starboard as a complex number; None without."""
        if {"u", "v"} <= self._names.keys() & raw.columns.keys():
            u, v = (raw.columns[n] * to_si(self._unit(n, mark=False), "m/s") for n in ("u", "v"))
        elif motion is not None:
            u, v = (np.interp(raw.t, motion.t, part) for part in motion[1:3])
        else:
            return None
        return np.asarray(u + 1j * v)

    def _headings(self, raw: Raw) -> np.ndarray | None:
        """Return the heading [T] in rad of a log, from any zero where only a rate tells it."""
        if {"psi"} <= self._names.keys() & raw.columns.keys():
            return heading_of(raw, self._psi_unit, self._frame)
        if {"r"} <= self._names.keys() & raw.columns.keys():
            rate = raw.columns["r"] * to_si(self._unit("r", mark=False), "rad/s")
            step = np.diff(raw.t, prepend=raw.t[:1])
            return np.asarray(np.cumsum(np.nan_to_num(rate * step)))
        return None

    def _unit(self, name: str, *, mark: bool = True) -> str:
        """Return the unit of a channel from its header or its size."""
        found = unit_of(name, self._names[name], self._values(name))
        if mark and found.reason:
            self._marks.guess((*CHANNELS, name), found.reason)
        return str(found.settings["unit"])

    def _entry(self, name: str) -> dict[str, Any]:
        column = self._names[name]
        entry: dict[str, Any] = {"column": column}
        if self._fixes and name in ("x", "y"):
            return entry | {"unit": "deg"} | ({"scale": self._fixes} if self._fixes < 1.0 else {})
        if name == "psi":
            if MAGNETIC.search(column):
                text = f"'{column}' is magnetic by its name, and is taken as true: give `offset`,"
                self._marks.guess((*CHANNELS, name), f"{text} minus the declination at that place")
            entry["unit"] = self._psi_unit
            return entry | ({"frame": "enu"} if self._frame.from_east else {})
        if name in ("u", "v", "r") and {"x", "y", "psi"} <= set(self._names):
            fit = follows(self._logs, self._motions, name)
            return entry | self._rate(name, fit, "position and heading")
        if name == "r" and "psi" in self._names:
            return entry | self._rate(name, self._turned("psi", self._psi_unit, name), "headings")
        if name == "p" and "phi" in self._names:
            unit = self._unit("phi", mark=False)
            return entry | self._rate(name, self._turned("phi", unit, name), "roll angles")
        if name not in STATE_NAMES and (throw := thrown(name, column, self._values(name))):
            self._marks.guess((*CHANNELS, name), throw.reason)
            return entry | throw.settings
        sign = -1 if name in self._flipped else self._sign_by_habit(name)
        return entry | {"unit": self._unit(name)} | ({"sign": sign} if sign < 0 else {})

    def _sign_by_habit(self, name: str) -> int:
        """Return -1 for v and r beside a pose of ROS, which count to port by REP 103, else 1."""
        if not self._posed or name not in ("v", "r"):
            return 1
        text = "taken as positive to port, as beside a pose of ROS (REP 103)"
        self._marks.guess((*CHANNELS, name), text)
        return -1

    def _turned(self, angle: str, unit: str, name: str) -> Fit:
        """Return how a rate follows its angle, which is taken for a heading."""
        held = [raw for raw in self._logs if {angle, name} <= set(raw.columns)]
        angles = [Raw(raw.t, dict.fromkeys(("x", "y", "psi"), raw.columns[angle])) for raw in held]
        frame = self._frame if angle == "psi" else FRAMES[0]
        motions = [motion_of(raw, unit, frame) for raw in angles]
        return follows([Raw(raw.t, {"r": raw.columns[name]}) for raw in held], motions, "r")

    def _rate(self, name: str, fit: Fit, who: str) -> dict[str, Any]:
        """Return unit and sign of a velocity, checked against what it is the rate of.

        Args:
            who: what that is, for a reader.
        """
        key, column, si = (*CHANNELS, name), self._names[name], CHANNEL_UNITS[name]
        written, found = written_unit(column, si), fit.unit(si) if fit.telling else None
        unit = written or found or self._unit(name)
        if written is None and found is not None:
            text = f"the header has no unit; {who} say {found}"
            self._marks.guess(key, f"{text} (correlation {fit.correlation:.2f})")
        elif written and found and fit.correlation >= _SURE:
            ratio = abs(fit.factor) / to_si(written, si)
            if to_si(found) != to_si(written, si) and not 0.6 < ratio < 1.6:
                text = f"the header says {written}, {who} say {found} (factor {ratio:.3g})"
                asked = f"unit of '{column}'"
                unit = self._marks.ask(key, asked, found, text, (found, written))
        entry: dict[str, Any] = {"unit": unit}
        if fit.telling and fit.factor < 0.0:
            entry["sign"] = -1
            what = {"u": "astern", "v": "port", "r": "port", "p": "port"}[name]
            text = f"{who} say that it is positive to {what} (correlation"
            self._marks.guess(key, f"{text} {fit.correlation:.2f})")
        elif not fit.telling and self._sign_by_habit(name) < 0:
            entry["sign"] = -1
        if not fit.telling and written is None:
            self._marks.guess(key, f"{who} do not tell whether {unit} is right")
        return entry
