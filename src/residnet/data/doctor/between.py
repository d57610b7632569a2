"""Findings between logs: copies, one run in several files, ranges, excitation, logs apart."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property

import numpy as np

from residnet.core.arrays.paged import LARGE
from residnet.core.log import Log
from residnet.core.names import POSE, VELOCITY
from residnet.core.stretches import stretches
from residnet.data.channels import deviation, median, noise_of
from residnet.data.doctor.clock import EPOCH
from residnet.data.doctor.excitation import conditioning, in_brackets
from residnet.data.doctor.findings import (
    Check,
    Finding,
    Level,
    check,
    share_of,
    show,
)
from residnet.data.doctor.others import Fleet, causes, nothing_steers
from residnet.data.doctor.statistics import MEASURED, Record, averaged, high
from residnet.data.split import row_hashes, sampling
from residnet.data.statistics import FEWEST

# so many rows in a row that two logs share are no chance
_COPIED = 20


class Together:
    """Logs that are examined beside each other; it contains the channels that all of them have.

    Args:
        logs: each with an increasing clock.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        splits: log's name -> train, validation or test, where a config says.
    """

    def __init__(
        self, logs: Sequence[Log], inputs: Sequence[str] | None, splits: Mapping[str, str]
    ) -> None:
        common = set.intersection(*(set(log.channels) for log in logs))
        self.channels = [name for name in logs[0].channels if name in common]
        given = self.channels if inputs is None else inputs
        self.inputs = [name for name in given if name in common and name not in MEASURED]
        self.logs = [Record(log, self.inputs) for log in logs]
        self.splits = splits

    @cached_property
    def fleet(self) -> Fleet | None:
        """The logs, each predicted by a model of the others; None where that cannot be."""
        if len(self.logs) < 2 or not self.inputs:
            return None
        logs = [moved(log) for log in self.logs]
        moving = any(all(name in log for log in logs) for name in VELOCITY)
        return Fleet(logs, self.inputs) if moving else None

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def torn(self, *logs: Record) -> str:
        """Return the splits of logs where these are known and differ."""
        found = [self.splits.get(log.name, "") for log in logs]
        return " and ".join(found) if all(found) and len(set(found)) > 1 else ""


def moved(log: Record) -> Record:
    """Return a log with the velocities that its position and heading tell; others as they are.

    A yaw rate is none of them: differences of smoothed headings accused 3 of 12 good logs.
    """
    if "u" in log or len(log) < FEWEST or not all(name in log for name in POSE):
        return log
    ground = np.gradient(log.smooth("x") + 1j * log.smooth("y"), log.t)
    ahead = ground * np.exp(-1j * log["psi"])
    made = {"u": ahead.real, "v": ahead.imag}
    whole = log.log.replace(
        channels={**made, **log.log.channels},
        units={**dict.fromkeys(made, "m/s"), **log.units},
        meta={**log.log.meta, "derived": tuple(made)},
    )
    return Record(whole, log.inputs)


@check("between", "copied_part", fix="leave it out, or keep both in one split")
def copies(logs: Together, found: Check) -> Iterator[Finding]:
    """Report stretches that two logs, or two places of one log, have in common."""
    velocities = [name for name in VELOCITY if name in logs]
    names = velocities if len(velocities) > 1 else sorted(logs.channels)
    members = [log.log for log in logs.logs]
    if names and (one_of := sampling(members)) > 1:
        # of very many rows a sample tells which logs have some in common
        # of equal rows all are in it, or none
        every = (row_hashes(log, names) for log in members)
        few = [hashes[hashes % np.uint64(one_of) == 0] for hashes in every]
        rows, count = np.unique(np.concatenate(few), return_counts=True)
        twice = rows[(count > 1) & (count <= 2 * len(members))]
        alike = [int(np.isin(part, twice).sum()) * one_of >= _COPIED for part in few]
        members = list(itertools.compress(members, alike))
    if not names or not members:
        return
    # rows are hashed one by one, so that all logs are hashed at once
    whole = Log(
        "together",
        np.concatenate([log.t for log in members]),
        {name: np.concatenate([log[name] for log in members]) for name in names},
        members[0].units,
    )
    hashes = np.split(row_hashes(whole, names), np.cumsum([len(log) for log in members])[:-1])
    owner = np.repeat(np.arange(len(members)), [part.size for part in hashes])
    row = np.concatenate([np.arange(part.size) for part in hashes])
    _, inverse, count = np.unique(np.concatenate(hashes), return_inverse=True, return_counts=True)
    # rows that stand in many places are those of a vessel at rest
    shared = np.flatnonzero((count[inverse] > 1) & (count[inverse] <= 2 * len(members)))
    shared = shared[np.argsort(inverse[shared], kind="stable")]
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for _, same in itertools.groupby(shared.tolist(), key=lambda i: int(inverse[i])):
        for i, j in itertools.combinations(sorted(same), 2):
            key = int(owner[i]), int(owner[j]), int(row[j] - row[i])
            pairs.setdefault(key, []).append(int(row[i]))
    records = {log.name: log for log in logs.logs}
    for (i, j, offset), places in sorted(pairs.items()):
        flags = np.zeros(len(members[i]) + 1, dtype=bool)
        flags[places] = True
        starts, stops = stretches(flags)
        longest = int(np.argmax(stops - starts))
        size, start = int(stops[longest] - starts[longest]), int(starts[longest])
        if size < _COPIED or (i == j and offset == 1):
            continue
        figures = {"rows": size, "first": start, "offset": offset}
        a, b = members[i], members[j]
        if i == j:
            text = (
                f"{a.name}: rows {start} to {start + size - 1} stand again from row"
                f" {start + offset} on"
            )
            yield found(text, figures, code="repeated_block", fix="delete one of the copies")
            continue
        torn = logs.torn(records[a.name], records[b.name])
        level: Level = "fatal" if torn else "will mislead"
        if logs.splits and not {a.name, b.name} <= logs.splits.keys():
            # the config leaves one of them out already
            level = "note"
        across = f" ({torn})" if torn else ""
        if size >= max(len(a), len(b)) - 1:
            text, fix = f"{a.name} and {b.name} are the same{across}", "leave one of them out"
            yield found(text, figures, code="duplicate_log", level=level, fix=fix)
            continue
        first = start + offset
        if len(b) < len(a):
            a, b, first = b, a, start
        text = (
            f"{a.name} is in {share_of(size / len(a))} a copy of rows {first} to"
            f" {first + size - 1} of {b.name}{across}"
        )
        yield found(text, figures, level=level)


_STATES = ("x", "y", "u", "v", "r")


@check("between", "continued", "note")
def continued(logs: Together, found: Check) -> Iterator[Finding]:
    """Report a log that goes on where another ended: one run, cut into files."""
    whole = [len(log) >= 20 and sum(n in log for n in _STATES) >= 4 for log in logs.logs]
    if sum(whole) < 2:
        return

    def each(of: Callable[[np.ndarray], float]) -> np.ndarray:
        """Return a figure of each log and state [L, 5], NaN where it is not measured."""
        return np.array(
            [[of(log[n]) if n in log else np.nan for n in _STATES] for log in logs.logs]
        )

    first, last = each(lambda x: float(x[:3].mean())), each(lambda x: float(x[-3:].mean()))
    noise, fast = each(noise_of), each(lambda x: float(high(x, 0.9)))
    usual = each(lambda x: median(np.abs(np.diff(x))))
    for i, a in enumerate(logs.logs):
        apart = np.abs(first - last[i]) / np.maximum(usual[i] + noise[i] + noise, 1e-12)
        most = np.nan_to_num(np.max(np.where(np.isnan(apart), 0.0, apart), axis=1))
        for j in np.flatnonzero(most <= 30.0):
            b = logs.logs[j]
            if j == i or not (whole[i] and whole[j]):
                continue
            pause, begins = float(b.t[0] - a.t[-1]), float(abs(b.t[0]))
            on_time = min(abs(a.t[-1]), begins) > 2.0 * a.step and 0.0 < pause < 3.0 * a.step
            # where both are at rest nothing tells one quay from another
            resting = math.hypot(*last[i, 2:4]) < 0.2 * math.hypot(*fast[i, 2:4])
            fresh = abs(b.t[0] - a.t[0]) <= 1e-9 or b.t[0] <= 2.0 * a.step
            if not on_time and (not fresh or most[j] > 8.0 or resting):
                continue
            torn = logs.torn(a, b)
            text = f"{b.name} goes on where {a.name} ends"
            text += f", {pause:.2f} s later: one run, cut into files" if on_time else ""
            text += f"; they stand in {torn}" if torn else ""
            fix = "keep them in one split" if torn or not logs.splits else ""
            yield found(text, {"pause": pause}, fix=fix)


@check(
    "between",
    "overlapping",
    "note",
    "two vessels, or two recordings of one run? keep them in one split",
)
def overlapping(logs: Together, found: Check) -> Iterator[Finding]:
    """Report logs of the same time."""
    first, last = np.array([(log.t[0], log.t[-1]) for log in logs.logs]).T
    for i, a in enumerate(logs.logs if float(last.max()) > EPOCH else ()):
        shared = np.minimum(a.t[-1], last[i + 1 :]) - np.maximum(a.t[0], first[i + 1 :])
        dated = np.minimum(a.t[0], first[i + 1 :]) > EPOCH
        for j in np.flatnonzero(dated & (shared > 0.0)).tolist():
            b, seconds = logs.logs[i + 1 + j], float(shared[j])
            yield found(
                f"{a.name} and {b.name} overlap in time for {seconds:.1f} s", {"seconds": seconds}
            )


_LOOKED_AT = 50 * 4 ** np.arange(12) - 1
"""Rows whose commands tell most logs apart: a manoeuvre may begin with a rest."""


@check(
    "between",
    "same_commands",
    "note",
    "repeats show how far the vessel repeats itself; keep them in one split",
)
def same_commands(logs: Together, found: Check) -> Iterator[Finding]:
    """Report logs with the same commands."""
    names = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    few = np.full((len(logs.logs), len(names), _LOOKED_AT.size), np.nan)
    for i, log in enumerate(logs.logs if names else ()):
        at = _LOOKED_AT[len(log) > _LOOKED_AT]
        few[i, :, : at.size] = [log[name][at] for name in names]
    alike = functools.partial(np.isclose, rtol=1e-6, atol=1e-9)
    for i, a in enumerate(logs.logs if names else ()):
        rest = few[i + 1 :]
        # what rests while both last tells nothing
        moves = (np.abs(np.diff(few[i])) > 0.0) & np.isfinite(rest[..., 1:])
        apart = ~alike(few[i], rest) & np.isfinite(few[i] - rest) & moves.any(-1, keepdims=True)
        for b in itertools.compress(logs.logs[i + 1 :], ~apart.any(axis=(1, 2))):
            size = min(len(a), len(b))
            moving = [name for name in names if deviation(a[name][:size]) > 1e-9]
            both = ((a[name][:size], b[name][:size]) for name in moving)
            if size < 50 or not moving or not all(alike(*p, equal_nan=True).all() for p in both):
                continue
            torn = logs.torn(a, b)
            text = (
                f"{a.name} and {b.name} have the same commands ({', '.join(moving)}) over {size}"
                " samples"
            )
            text += f" and stand in {torn}" if torn else ""
            yield found(text, {"samples": size})


@check(
    "between",
    "extrapolation",
    fix="add training logs that go there, or do not trust the model there",
)
def extrapolation(logs: Together, found: Check) -> Iterator[Finding]:
    """Report how much of the other logs lies outside what the training logs cover."""
    train = [log for log in logs.logs if logs.splits.get(log.name) == "train"]
    others = [log for log in logs.logs if logs.splits.get(log.name) in ("validation", "test")]
    for name in logs.channels if train and others else ():
        if name in ("x", "y", "z", "psi"):
            continue
        unit = train[0].units[name]
        low = min(float(np.nanmin(log[name])) for log in train)
        top = max(float(np.nanmax(log[name])) for log in train)
        margin = 0.02 * (top - low)
        for log in others:
            values = log[name][np.isfinite(log[name])]
            share = float(((values < low - margin) | (values > top + margin)).mean())
            if share > 0.01:
                text = (
                    f"{name} of {log.name} ({logs.splits[log.name]}) lies outside the training"
                    f" range {show(low, unit)} to {show(top, unit)} for {share_of(share)} of the"
                    " time"
                )
                level: Level = "will mislead" if share > 0.25 else "note"
                yield found(text, {"share": share}, level=level)


def _relative(*parts: np.ndarray) -> float:
    """Return the spread of a channel over its size, beyond its noise."""
    known = np.concatenate(parts)
    known = known[np.isfinite(known)]
    size = float(np.abs(known).max(initial=0.0))
    return max(float(known.std()) - 1.5 * noise_of(known), 0.0) / size if size > 0.0 else 0.0


_OTHER_SIDE = 0.05
"""Share of turning below which only noise and overshoots turn to a side: .0001 in circles behind
a straight run, .3 and more in zigzags and random steps of five vessels."""


def _awake(log: Record, name: str) -> float:
    """Return the spread of a velocity over the least that counts; below 1 it does not vary.

    Only what its averaged noise does not explain counts.
    """
    samples = max(round(2.0 / log.step), 5)
    smooth = averaged(log[name], samples)
    known = smooth[np.isfinite(smooth)]
    speed = np.hypot(log["u"], log["v"]) if "u" in log and "v" in log else np.zeros(1)
    least = np.radians(0.05) if name == "r" else 0.02 * float(np.abs(np.nanmean(speed)))
    least = max(3.0 * log.noise(name) / np.sqrt(samples), least, 1e-9)
    return float(known.std() / least) if known.size >= 10 else 0.0


@check("between", "no_excitation", fix="record manoeuvres: zigzag, 3-2-1-1")
def excitation(logs: Together, found: Check) -> Iterator[Finding]:
    """Report whether a fit to all logs together has something to learn from."""
    count, velocities = len(logs.logs), [name for name in VELOCITY if name in logs]
    members = [log.few for log in logs.logs]
    awake = {name: max(_awake(log, name) for log in members) for name in velocities}
    if awake and max(awake.values()) < 1.0:
        text = (
            f"no velocity varies beyond its noise in any of {count} logs: a fit would find nothing"
            " but noise"
        )
        yield found(text, {f"{n}_over_noise": v for n, v in awake.items()}, level="fatal")
    elif logs.inputs and "r" in awake:
        smooth = [averaged(log["r"], max(round(2.0 / log.step), 5)) for log in members]
        rate = np.concatenate(smooth)
        to_port = float(np.nansum(np.abs(rate[rate < 0.0])) / np.nansum(np.abs(rate)))
        text, side = "", "port" if to_port > 0.5 else "starboard"
        if awake["r"] < 1.0:
            text = f"none of {count} logs turns beyond its noise: nothing is learned of steering"
        elif min(to_port, 1.0 - to_port) < _OTHER_SIDE:
            text = f"all of {count} logs turn to {side}: how it turns to the other is unknown"
        if text:
            level: Level = "will mislead" if count > 1 else "note"
            fix = "add turns to both sides: zigzag, 3-2-1-1"
            yield found(text, {"port": to_port}, code="one_side", level=level, fix=fix)
    driving = [name for name in logs.inputs if not name.startswith(("wind", "current"))]
    within = {name: max(_relative(log[name]) for log in members) for name in driving}
    among = {name: _relative(*(log[name] for log in members)) for name in driving}
    # constant in each, but not the same in all, tells something
    if driving and max(within.values()) < 1e-3 and max(among.values()) <= 1e-2:
        text = f"no input ({', '.join(driving)}) varies within any of {count} logs"
        text += ": what they do cannot be identified"
        yield found(text, {"spread": max(within.values())})
    held = [name for name in driving if max(within[name], among[name]) < 1e-3]
    if held:
        text = f"{', '.join(held)} never varies: its effect cannot be separated from a constant"
        yield found(text, {"count": len(held)}, code="constant_inputs", level="note", fix="")
    moving = [name for name in (*velocities, *driving) if name not in held]
    # of very many samples evenly spread ones tell the same
    every = -(-sum(len(log) for log in members) // LARGE)
    columns = np.concatenate([log.log.stack(moving)[::every] for log in members])
    columns = columns[np.isfinite(columns).all(axis=1)]
    if driving and len(moving) > 1 and columns.shape[0] >= 10 * len(moving):
        number, worst = conditioning(columns, moving)
        text = f"{count} logs together: condition number of {in_brackets(moving)} {number:.3g}"
        if number > 30.0:
            text += (
                f"; {', '.join(worst)} move together: give one of them, or add manoeuvres that move"
                " them apart"
            )
        yield found(text, {"condition": number}, code="condition", level="note", fix="")


@check("between", "contradicts", fix="")
def contradictions(logs: Together, found: Check) -> Iterator[Finding]:
    """Report logs that a model of the others does not explain, and what would explain them."""
    fleet = logs.fleet
    if fleet is None:
        return
    for name in (told := nothing_steers(fleet))[0]:
        text = (
            f"{name} rests in every log, and {share_of(told[1])} of how the yaw rate changes is"
            " explained by nothing that was recorded: its record is dead"
        )
        fix = "find the channel that holds the steering"
        yield found(text, {"unexplained": told[1]}, code="contradicts_dead", fix=fix)
    if told[0]:
        # without the steering no log explains another
        return
    count = len(fleet.core)
    for i in fleet.apart:
        log, likely = fleet.logs[i], causes(fleet, i)[0]
        split = logs.splits.get(log.name, "")
        if likely.kind == "vessel" and fleet.agreed and fleet.goes_beyond(i):
            text = (
                f"{log.name} goes beyond the inputs of the {count} other logs that agree: they"
                " cannot tell whether it is right"
            )
            yield found(text, code="beyond_others", level="note")
            continue
        left = float(np.nanmax(fleet.scores(fleet.core, [i])[i].left))
        text = (
            f"{log.name}{f' ({split})' if split else ''}: a model of {count} other logs does not"
            f" explain its motion ({left:.2g} times what it leaves of them); {likely.text}"
        )
        if not fleet.agreed:
            text += "; no more than half of the logs agree, so that it may be the others"
        figures = {"left": left, "size": likely.size, "effect": fleet.harm(i)}
        yield found(text, figures, code=f"contradicts_{likely.kind}", fix=_ADVICE[likely.kind])


_ADVICE = {
    "dead": "leave this log out, or restore the record",
    "scale": "correct its unit or scale in this log, or leave it out if an actuator had failed",
    "sign": "correct its sign in this log",
    "offset": "take the offset off in this log",
    "late": "shift the clock of the inputs in this log",
    "exchanged": "exchange both columns in this log",
    "heading": "correct the heading, or the axes of the velocities, of this log",
    "current": "leave it out, give the current as an input, or let the fit estimate it",
    "vessel": "leave it out, or fit it alone",
}
"""What explains a log -> what to do."""


@check(
    "between",
    "dead_commands",
    "note",
    fix="a fit leaves these stretches out (prepare.dead_commands: keep would keep them)",
)
def unexplained_stretches(logs: Together, found: Check) -> Iterator[Finding]:
    """Report motion that no recorded input explains while all of them rest."""
    fleet = logs.fleet
    found_at = [(i, *rest) for i in fleet.told for rest in fleet.rests(i)] if fleet else []
    for i, start, stop in found_at:
        log = logs.logs[i]
        text = (
            f"{log.name}: from t = {log.t[start]:.1f} to {log.t[stop]:.1f} s all inputs rest and"
            " the vessel moves as none of the other logs explains: a hand on the wheel, or a dead"
            " record"
        )
        yield found(text, {"t": log.t[start], "seconds": log.t[stop] - log.t[start]})
