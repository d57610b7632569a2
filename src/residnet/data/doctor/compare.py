"""Findings between logs: copies, overlaps, runs cut into files, same commands, ranges."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from residnet.core.log import Log
from residnet.core.names import VELOCITY
from residnet.core.stretches import stretches
from residnet.data.doctor.findings import Finding, Level, share_of, show
from residnet.data.doctor.signals import MEASURED, noise_of
from residnet.data.split import row_hashes, sampled_hashes, sampling

# so many rows in a row that two logs share are no chance
_COPIED = 20
_EPOCH = 1e8
_OUTSIDE = 0.25
_STATES = ("x", "y", "u", "v", "r")
_FAR = 30.0
"""Usual changes by which the states may differ across a pause."""


def comparison_findings(
    logs: Sequence[Log], splits: Mapping[str, str] | None = None
) -> list[Finding]:
    """Return the findings between logs, each of which has an increasing clock.

    Args:
        logs: all logs that are looked at together.
        splits: log's name -> its split, where a config says.
    """
    given = splits or {}
    found = list(_copies(logs, given))
    ends = [_Ends.of(log) for log in logs]
    for i, j in _near(ends):
        found += _continued(logs[i], logs[j], ends[i], ends[j], given)
    for a, b in itertools.combinations(logs, 2):
        found += [*_overlapping(a, b), *_same_commands(a, b, given)]
    return [*found, *_ranges(logs, given)]


def _copies(logs: Sequence[Log], splits: Mapping[str, str]) -> Iterator[Finding]:
    """Return the stretches that two logs, or two places of one log, have in common."""
    names = [name for name in VELOCITY if all(name in log.channels for log in logs)]
    names = (
        names if len(names) > 1 else sorted(set.intersection(*(set(log.channels) for log in logs)))
    )
    if not names:
        return
    one_of = sampling(logs)
    if one_of > 1:
        logs = _alike(logs, names, one_of)
        if not logs:
            return
    hashes = [row_hashes(log, names) for log in logs]
    owner = np.repeat(np.arange(len(logs)), [part.size for part in hashes])
    row = np.concatenate([np.arange(part.size) for part in hashes])
    joined = np.concatenate(hashes)
    _, inverse, count = np.unique(joined, return_inverse=True, return_counts=True)
    # rows that stand in many places are those of a vessel at rest
    shared = np.flatnonzero((count[inverse] > 1) & (count[inverse] <= 2 * len(logs)))
    if shared.size < _COPIED:
        return
    order = shared[np.argsort(inverse[shared], kind="stable")]
    pairs: dict[tuple[int, int, int], list[int]] = {}
    for _, members in itertools.groupby(order.tolist(), key=lambda i: int(inverse[i])):
        for i, j in itertools.combinations(sorted(members), 2):
            pairs.setdefault((int(owner[i]), int(owner[j]), int(row[j] - row[i])), []).append(
                int(row[i])
            )
    for (i, j, offset), rows in sorted(pairs.items()):
        if i == j and offset == 1:
            continue
        flags = np.zeros(len(logs[i]) + 1, dtype=bool)
        flags[rows] = True
        starts, stops = stretches(flags)
        longest = int((stops - starts).max(initial=0))
        if longest >= _COPIED:
            yield _copy(
                logs[i], logs[j], int(starts[np.argmax(stops - starts)]), offset, longest, splits
            )


def _alike(logs: Sequence[Log], names: Sequence[str], one_of: int) -> list[Log]:
    """Return the logs of which some rows stand in another one, by a sample of all rows."""
    kept = [sampled_hashes(log, names, one_of) for log in logs]
    found, count = np.unique(np.concatenate(kept), return_counts=True)
    twice = found[(count > 1) & (count <= 2 * len(logs))]
    alike = [int(np.isin(part, twice).sum()) for part in kept]
    return [log for log, same in zip(logs, alike, strict=True) if same * one_of >= _COPIED]


def _copy(
    a: Log, b: Log, start: int, offset: int, count: int, splits: Mapping[str, str]
) -> Finding:
    figures = {"rows": float(count), "first": float(start), "offset": float(offset)}
    if a is b:
        text = (
            f"{a.name}: rows {start} to {start + count - 1} stand again from row"
            f" {start + offset} on"
        )
        return Finding("will mislead", "repeated_block", text, figures, "delete one of the copies")
    leak = splits.get(a.name) != splits.get(b.name)
    across = (
        f" ({splits[a.name]} and {splits[b.name]})"
        if leak and a.name in splits and b.name in splits
        else ""
    )
    level: Level = "fatal" if across else "will mislead"
    if splits and not (a.name in splits and b.name in splits):
        # the config leaves one of them out already
        level = "note"
    if count >= max(len(a), len(b)) - 1:
        return Finding(
            level,
            "duplicate_log",
            f"{a.name} and {b.name} are the same{across}",
            figures,
            "leave one of them out",
        )
    part, whole, first = (
        (b, a, start) if len(b) - count < len(a) - count else (a, b, start + offset)
    )
    share = share_of(count / len(part))
    text = (
        f"{part.name} is in {share} a copy of rows {first} to {first + count - 1} of"
        f" {whole.name}{across}"
    )
    return Finding(level, "copied_part", text, figures, "leave it out, or keep both in one split")


@dataclass(frozen=True)
class _Ends:
    """Where a log begins and ends, and how much is usual from sample to sample.

    Attributes:
        step: median time between samples in s.
        first: mean of the first three samples by state.
        last: mean of the last three.
        change: median change between samples.
        noise: standard deviation of white noise.
    """

    step: float
    first: dict[str, float]
    last: dict[str, float]
    change: dict[str, float]
    noise: dict[str, float]

    @classmethod
    def of(cls, log: Log) -> _Ends:
        """Return the ends of a log."""
        states = [name for name in _STATES if name in log.channels]
        changes = {name: np.abs(np.diff(log[name])) for name in states}
        known = {name: change[np.isfinite(change)] for name, change in changes.items()}
        return cls(
            float(np.median(np.diff(log.t))) if len(log) > 1 else 0.0,
            {name: float(log[name][:3].mean()) for name in states},
            {name: float(log[name][-3:].mean()) for name in states},
            {name: float(np.median(part)) for name, part in known.items() if part.size},
            {name: noise_of(log[name]) for name in states},
        )

    def usual(self, other: _Ends, name: str) -> float:
        """Return how far apart the states of two logs are that go on from each other."""
        change = self.change.get(name)
        return 0.0 if change is None else change + self.noise[name] + other.noise[name]


def _near(ends: Sequence[_Ends]) -> list[tuple[int, int]]:
    """Return the pairs of which the second may begin where the first ends, in order.

    Of thousands of logs few are left to look at.
    """
    near = ~np.eye(len(ends), dtype=bool)
    for name in _STATES:
        has = np.array([name in end.first for end in ends])
        first, last, change, noise = (
            np.array([getattr(end, part).get(name, 0.0) for end in ends])
            for part in ("first", "last", "change", "noise")
        )
        usual = change[:, None] + noise[:, None] + noise[None, :]
        apart = np.abs(first[None, :] - last[:, None])
        near &= ~(has[:, None] & has[None, :]) | (apart <= _FAR * np.maximum(usual, 1e-12))
    return [(int(i), int(j)) for i, j in np.argwhere(near)]


def _continued(
    a: Log, b: Log, ends_a: _Ends, ends_b: _Ends, splits: Mapping[str, str]
) -> Iterator[Finding]:
    """Return a log that goes on where another ended: one run, cut into files."""
    states = [name for name in _STATES if name in ends_a.first and name in ends_b.first]
    if len(states) < 4 or len(a) < 20 or len(b) < 20:
        return
    step = ends_a.step
    pause = float(b.t[0] - a.t[-1])
    on_time = abs(a.t[-1]) > 2.0 * step and 0.0 < pause < 3.0 * step and abs(b.t[0]) > 2.0 * step
    if not on_time and abs(b.t[0] - a.t[0]) > 1e-9 and b.t[0] > 2.0 * step:
        return
    for name in states:
        apart = abs(ends_b.first[name] - ends_a.last[name])
        allowed = (_FAR if on_time else 8.0) * max(ends_a.usual(ends_b, name), 1e-12)
        if not apart <= allowed:
            return
    if not on_time and float(np.hypot(a["u"][-1], a["v"][-1])) < 0.2 * float(
        np.nanquantile(np.hypot(a["u"], a["v"]), 0.9)
    ):
        # where both are at rest nothing tells one quay from another
        return
    torn = a.name in splits and b.name in splits and splits[a.name] != splits[b.name]
    text = (
        f"{b.name} goes on where {a.name} ends, {pause:.2f} s later: one run, cut into files"
        if on_time
        else f"{b.name} goes on where {a.name} ends"
    )
    text += f"; they stand in {splits[a.name]} and {splits[b.name]}" if torn else ""
    action = "keep them in one split" if torn or not splits else ""
    yield Finding("note", "continued", text, {"pause": pause}, action)


def _overlapping(a: Log, b: Log) -> Iterator[Finding]:
    first, last = max(a.t[0], b.t[0]), min(a.t[-1], b.t[-1])
    if min(a.t[0], b.t[0]) > _EPOCH and last > first:
        text = f"{a.name} and {b.name} overlap in time for {last - first:.1f} s"
        yield Finding(
            "note",
            "overlapping",
            text,
            {"seconds": float(last - first)},
            "two vessels, or two recordings of one run? keep them in one split",
        )


def _same_commands(a: Log, b: Log, splits: Mapping[str, str]) -> Iterator[Finding]:
    names = [
        name
        for name in a.channels
        if name in b.channels and name not in MEASURED and not name.startswith(("wind", "current"))
    ]
    size = min(len(a), len(b))
    if size < 50:
        return
    # a few samples tell most pairs apart
    for at in (0, size // 3, 2 * size // 3, size - 1):
        for name in names:
            same = np.isclose(a[name][at], b[name][at], rtol=1e-6, atol=1e-9, equal_nan=True)
            if not same and float(np.nanstd(a[name][:size])) > 1e-9:
                return
    moving = [name for name in names if float(np.nanstd(a[name][:size])) > 1e-9]
    if not moving:
        return
    if all(
        np.allclose(a[name][:size], b[name][:size], rtol=1e-6, atol=1e-9, equal_nan=True)
        for name in moving
    ):
        torn = a.name in splits and b.name in splits and splits[a.name] != splits[b.name]
        text = (
            f"{a.name} and {b.name} have the same commands ({', '.join(moving)}) over {size}"
            " samples"
        )
        text += f" and stand in {splits[a.name]} and {splits[b.name]}" if torn else ""
        yield Finding(
            "note",
            "same_commands",
            text,
            {"samples": size},
            "repeats show how far the vessel repeats itself; keep them in one split",
        )


def _ranges(logs: Sequence[Log], splits: Mapping[str, str]) -> Iterator[Finding]:
    """Return how much of the test logs lies outside what the training logs cover."""
    train = [log for log in logs if splits.get(log.name) == "train"]
    others = [log for log in logs if splits.get(log.name) in ("validation", "test")]
    if not train or not others:
        return
    for name in (
        name
        for name in train[0].channels
        if name not in ("x", "y", "psi") and all(name in log.channels for log in (*train, *others))
    ):
        known = np.concatenate([log[name] for log in train])
        low, high = float(np.nanmin(known)), float(np.nanmax(known))
        margin = 0.02 * (high - low)
        for log in others:
            values = log[name][np.isfinite(log[name])]
            share = float(((values < low - margin) | (values > high + margin)).mean())
            if share > 0.01:
                text = (
                    f"{name} of {log.name} ({splits[log.name]}) lies outside the training range"
                    f" {show(low, log.units[name])} to "
                )
                text += f"{show(high, log.units[name])} for {share_of(share)} of the time"
                level: Level = "will mislead" if share > _OUTSIDE else "note"
                yield Finding(
                    level,
                    "extrapolation",
                    text,
                    {"share": share},
                    "add training logs that go there, or do not trust the model there",
                )
