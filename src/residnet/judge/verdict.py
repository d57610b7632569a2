"""The verdict on the selected model of a fit in words, from what the run folder's files hold."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from residnet.core.format import interval, listed, number, plural, shown_unit
from residnet.core.names import END_UNITS

Content = Mapping[str, Any]
"""What a JSON object holds."""

ZERO = "zero"
UNSEEN = ("test", "external")
"""Splits that no fit has seen."""


def by_windows(rows: Sequence[Content], split: str, deciding: str) -> list[str]:
    """Return the protocols of some rows, that by which a split is judged first.

    It is the one that chose between the models, unless the split is too short for it.

    Args:
        deciding: protocol that chose; empty where nothing was chosen.
    """
    names = dict.fromkeys(row["protocol"] for row in rows)
    held = {row["protocol"] for row in rows if row["split"] == split}
    return sorted(names, key=lambda name: (name not in held, name != deciding))


@dataclass(frozen=True)
class Evidence:
    """What a verdict is passed on.

    Attributes:
        selected: name of the selected model.
        split: whose free runs count.
        rows: of metrics.json under one protocol over all manoeuvres of that split, by model.
        baseline: name of the first baseline; empty where there is none.
        selection: contents of selection.json; empty where a run has none.
        limits: contents of limits.json for that split by protocol; empty where a run has none.
        doctor: one sentence on what the data doctor found; empty where nobody looked.
        protocol: by which those runs were made.
        one_sided: what the doctor said of logs that turn to one side, or to none; free runs on such
            logs cannot tell how the model turns.
    """

    selected: str
    split: str
    rows: Mapping[str, Content]
    baseline: str = ""
    selection: Content = field(default_factory=dict)
    limits: Content = field(default_factory=dict)
    doctor: str = ""
    protocol: str = ""
    one_sided: str = ""


LEVELS = {
    "good": "✓ Good",
    "limited": "! Limited",
    "do not use": "✗ Do not use",
    "too few windows": "? Too few windows to say",
}
"""How far the selected model may be used, and the words for it, the best first; the last says that
nobody can know. What they look like stands in the page's styles."""
GOOD, LIMITED, USELESS, UNKNOWN = LEVELS
_FEWEST = 5
"""Windows below which nothing is said of how good a model is."""
FEW_LOGS = 3
"""Logs below which there is no interval, and so nothing is said either."""
_SHARE, _TURN = 0.10, math.radians(10.0)
"""What a good model is off at most: this share of the way sailed and so many radians of heading,
at the upper end of the interval, or twice the noise floor. It is residnet's choice, and stands in
the verdict, so that a reader with other needs can choose another."""
_WORDS = {"depth": " of depth", "attitude": " of attitude"}
"""What stands behind an error of the pose that is no distance over ground and no heading."""
_OF_BEST = 1.5
"""A good model errs at most so many times as much as the best one of the run, floor aside."""


def verdict(evidence: Evidence) -> list[str]:
    """Return the verdict sentence by sentence, the most important first.

    It says how far off the selected model is in metres and degrees after the times that matter,
    what the doctor found in the data, how it fares beside `zero`, the baseline and the noise floor,
    for how many windows and which speeds that holds, how its velocities compare, what speaks
    against it and why it was selected, and how much of the data lies outside the training range.
    What the files do not hold is left out.
    """
    first, *rest = [compared(evidence)] if useless(evidence) else ahead(evidence)
    sentences = [
        first,
        f"That is no more than limited, for {evidence.one_sided}." * bool(evidence.one_sided),
        evidence.doctor,
        *rest,
        soundness(evidence),
        str(evidence.selection.get("reason", "")),
        outside(evidence),
    ]
    return [sentence for sentence in sentences if sentence]


def level(evidence: Evidence) -> str:
    """Return a key of `LEVELS`; empty where the selected model has no free runs."""
    if useless(evidence):
        return USELESS
    if evidence.selected not in evidence.rows:
        return ""
    entries = horizons(evidence)
    if entries and not any(_enough(evidence, entry) for entry in entries):
        return UNKNOWN
    return GOOD if good_until(evidence) and not evidence.one_sided else LIMITED


def horizons(evidence: Evidence) -> list[Content]:
    """Return the horizons at which the errors of the selected model are known, the nearest first.

    They are those of the protocol of the rows, each by the protocol of which most windows last so
    long, named as its `protocol`.
    """
    most: dict[float, dict[str, Any]] = {}
    for protocol in sorted(evidence.limits, key=lambda name: name != evidence.protocol):
        for entry in evidence.limits[protocol].get("horizons") or []:
            seconds, known = entry["seconds"], evidence.selected in entry["models"]
            if seconds in most:
                known &= entry["windows"] > most[seconds]["windows"]
            elif protocol != evidence.protocol:
                known = False
            if known:
                most[seconds] = {**entry, "protocol": protocol}
    return [most[seconds] for seconds in sorted(most)]


def _enough(evidence: Evidence, entry: Content) -> bool:
    """Return whether a horizon has windows, and logs for an interval, by which to judge a model."""
    known = all(entry["models"][evidence.selected]["intervals"].values())
    return known and entry["windows"] >= _FEWEST


def _own(evidence: Evidence) -> Content:
    """Return what limits.json says under the protocol of the rows."""
    found: Content = evidence.limits.get(evidence.protocol) or {}
    return found


def good_until(evidence: Evidence) -> float:
    """Return the time in s up to which the selected model is good; 0 where it never is."""
    row, until = evidence.rows[evidence.selected], 0.0
    if row.get("diverged") and evidence.split in UNSEEN:
        return 0.0
    plants = {name for name, row in evidence.rows.items() if row.get("kind") == "truth"}
    for entry in horizons(evidence):
        if not _enough(evidence, entry):
            return until
        models = entry["models"]
        own, ends = models[evidence.selected], models[evidence.selected]["intervals"]
        # what the plant itself leaves, started from measured states, is noise too
        floors = [entry["floor"], *(models[name] for name in plants & set(models))]
        rivals = set(models) - {evidence.selected} - plants
        for of in ends:
            least = _TURN if END_UNITS[of] == "rad" else _SHARE * entry["sailed"]
            others = [models[name][of] for name in rivals]
            twice = 2.0 * max(floor[of] for floor in floors)
            near = own[of] <= max(twice, _OF_BEST * min(others, default=own[of]))
            beats = ZERO not in models or own[of] <= max(twice, models[ZERO][of])
            if not (near and beats and ends[of][1] <= max(least, twice)):
                return until
        until = float(entry["seconds"])
    return until


def ahead(evidence: Evidence) -> list[str]:
    """Return how far off the selected model is after the times that matter, beside others."""
    entries = horizons(evidence)
    if not entries:
        return [compared(evidence)]
    ends = [of for of in END_UNITS if of in entries[0]["floor"]]
    enough = [entry for entry in entries if _enough(evidence, entry)]
    until = good_until(evidence) if enough else 0.0
    chosen = next((e for e in entries if e["seconds"] == until), (enough or entries)[-1])
    off = _off(chosen, evidence.selected, chosen["sailed"])
    after, wanted = f"{number(chosen['seconds'], 2)} s ahead", []
    if not enough:
        start = (
            f"{plural(chosen['windows'], 'window')} of {plural(chosen['logs'], 'log')} on"
            f" {evidence.split} data cannot say how good {evidence.selected} is ({_FEWEST} of"
            f" {FEW_LOGS} logs are needed); {after} it is off by {off}."
        )
    elif until:
        start = f"Up to {after}, where {evidence.selected} is off by {off}."
    else:
        start = f"{after[0].upper()}{after[1:]} {evidence.selected} is off by {off}."
        limits = {
            "m": f"{100.0 * _SHARE:.0f} % of the way",
            "rad": f"{math.degrees(_TURN):.0f} deg",
        }
        good = listed(list(dict.fromkeys(limits[END_UNITS[of]] for of in ends)))
        wanted = [
            f"Good would be within {good} up to the upper end of the interval, or twice the noise"
            " floor, without a diverged window and near the best model of the run."
        ]
    named = {ZERO: ZERO, evidence.baseline: "the baseline"}
    beside = [
        f"{word} {_off(chosen, name)}"
        for name, word in named.items()
        if name in chosen["models"] and name != evidence.selected
    ]
    # a pose that was integrated from the velocities has no floor but rounding
    known = any(chosen["floor"][of] > 1e-9 for of in ends)
    floor = f"the noise floor (measured velocities, integrated) {_pair(chosen['floor'])}"
    rest = [
        f"{_pair(entry['models'][evidence.selected])} after {entry['seconds']:.4g} s"
        for entry in entries
        if entry is not chosen
    ]
    moves = "position" in ends
    holds = (
        f"It holds for {plural(chosen['windows'], 'free run')} ({chosen['protocol']}) of"
        f" {plural(chosen['logs'], 'log')}"
        + f" at mean speeds of {number(chosen['slowest'], 2)} to"
        f" {number(chosen['fastest'], 2)} m/s" * moves + "."
    )
    return [
        start,
        f"Beside it: {'; '.join([*beside, *([floor] if known else [])])}.",
        *wanted,
        *([f"At other times of these free runs: {'; '.join(rest)}."] if rest else []),
        holds,
        compared(evidence),
    ]


def sized(of: str, error: float) -> str:
    """Return an error of the pose (`END_UNITS`) with its unit."""
    unit, factor = shown_unit(END_UNITS[of])
    return f"{number(factor * error, 2)} {unit}{_WORDS.get(of, '')}"


def _pair(errors: Content) -> str:
    return listed([sized(of, errors[of]) for of in END_UNITS if of in errors])


def _off(entry: Content, name: str, sailed: float = 0.0) -> str:
    """Return errors of position and heading with their intervals as text."""
    own, out = entry["models"][name], []
    for of in (of for of in END_UNITS if of in own):
        ends, text = own["intervals"][of], sized(of, own[of])
        details = [interval(ends, shown_unit(END_UNITS[of])[1], 2)] if ends else []
        if of == "position" and sailed > 0.0:
            details.append(
                f"{number(100.0 * own[of] / sailed, 2)} % of the {number(sailed, 2)} m sailed"
            )
        out.append(text + (f" ({', '.join(details)})" if details else ""))
    known = all(own["intervals"].values()) or sailed == 0.0
    return listed(out) + ("" if known else ", from too few logs for an interval")


def objections(evidence: Evidence) -> list[str]:
    """Return what speaks against using the model at all, as `residnet.export.base.released` asks.

    A model is to be better than `zero`, and than the model that it was built on.
    """
    own = evidence.rows.get(evidence.selected)
    if own is None:
        return []
    return [
        f"on {evidence.split} data its NRMSE is {number(_nrmse(own))}, that of {other}"
        f" {number(_nrmse(row))}"
        for other in dict.fromkeys((ZERO, evidence.baseline))
        if (row := evidence.rows.get(other)) is not None and _nrmse(own) > _nrmse(row)
    ]


def useless(evidence: Evidence) -> bool:
    """Return whether the selected model is `zero`, or is not shown to be better.

    Then no range is to be trusted.
    """
    own, zero = evidence.rows.get(evidence.selected), evidence.rows.get(ZERO)
    if evidence.selected == ZERO:
        return True
    if own is None or zero is None:
        return False
    return _nrmse(own) >= _nrmse(zero) or _alike(evidence, ZERO)


def compared(evidence: Evidence) -> str:
    """Return how the velocities of the selected model compare with `zero` and the baseline."""
    name, split = evidence.selected, evidence.split
    if name == ZERO:
        return (
            "NOTHING BEATS ZERO, which only holds the velocities that a run starts from: no model"
            " of this run is of use for prediction."
        )
    own, zero = evidence.rows.get(name), evidence.rows.get(ZERO)
    if own is None:
        return f"The run holds no free runs of its selected model on {split} data."
    error = _nrmse(own)
    if zero is not None and useless(evidence):
        than = "NO BETTER" if _nrmse(own) <= _nrmse(zero) else "WORSE"
        return (
            f"{than} THAN ZERO: on {split} data the selected model {name} has an NRMSE of"
            f" {number(error)}{_lost(own)}, and zero, which only holds the velocities that a run"
            f" starts from, {number(_nrmse(zero))}{_paired(evidence, ZERO)}. DO NOT USE it for"
            " prediction."
        )
    parts = []
    for other, row in ((ZERO, zero), (evidence.baseline, evidence.rows.get(evidence.baseline))):
        if row is None or other == name:
            continue
        change = 100.0 * (1.0 - error / _nrmse(row)) if _nrmse(row) > 0 else 0.0
        word = "better" if change >= 0 else "WORSE"
        shown = f"the {other}" if other == "baseline" else other
        parts.append(f"{abs(change):.0f} % {word} than {shown}{_paired(evidence, other)}")
    better = f" is {' and '.join(parts)};" if parts else ""
    return f"On {split} data model {name}{better} its NRMSE is {number(error)}{_lost(own)}."


def soundness(evidence: Evidence) -> str:
    """Return whether the selected model is sound, empty where nobody looked."""
    known = {row["model"]: row for row in evidence.selection.get("models", [])}
    entry = known.get(evidence.selected)
    if entry is None or evidence.selected == ZERO:
        return ""
    row = evidence.rows.get(evidence.selected)
    lost = int(row["diverged"]) if row is not None else 0
    faults = list(entry["faults"])
    if lost and row is not None and evidence.split in UNSEEN:
        faults.append(f"{lost} of its {row['windows']} {evidence.split} windows diverged")
    if faults:
        return f"It is UNSOUND: {'; '.join(faults)}."
    return "No window diverged, and no check of its physics speaks against it."


def outside(evidence: Evidence) -> str:
    """Return how much of the data lies outside the training range, empty where nobody looked."""
    found = _own(evidence).get("outside") or {}
    if not found:
        return ""
    share = float(found["share"])
    if share == 0:
        return f"All {evidence.split} data lie inside the range of the training data."
    channels = sorted(found["channels"].items(), key=lambda pair: -pair[1])[:3]
    named = ", ".join(f"{name} {_percent(part)}" for name, part in channels)
    return (
        f"Of the {evidence.split} data, {_percent(share)} lies outside the range of the training"
        f" data ({named}); nothing is known of the model there but these runs."
    )


def diverged_note(row: Content) -> str:
    """Return what stands beside the score of a row with divergences, else an empty text."""
    return f"{row['diverged']}/{row['windows']} diverged" if row.get("diverged") else ""


def _nrmse(row: Content) -> float:
    return float(row["nrmse"]["mean"])


def _lost(row: Content) -> str:
    note = diverged_note(row)
    return f" ({note}, which count with the error of zero)" if note else ""


def _difference(evidence: Evidence, other: str) -> Content:
    """Return the difference to another model, empty where nobody looked."""
    compared = (_own(evidence).get("compared") or {}).get(evidence.selected) or {}
    return compared.get(other) or {}


def _alike(evidence: Evidence, other: str) -> bool:
    """Return whether there is an interval of the difference to another model that holds zero."""
    found = _difference(evidence, other)
    return bool(found) and found["ci95"] is not None and not found["excludes_zero"]


def _paired(evidence: Evidence, other: str) -> str:
    """The paired interval of the difference to another model in brackets, where there is one."""
    found = _difference(evidence, other)
    if not found:
        return ""
    if found["ci95"] is None:
        return " (too few logs for an interval)"
    low, high = found["ci95"]
    doubt = "" if found["excludes_zero"] else ", which holds zero: the data cannot tell them apart"
    return f" (paired 95 % interval of the difference {low:+.3g} to {high:+.3g}{doubt})"


def _percent(share: float) -> str:
    return f"{number(100.0 * share, 2)} %" if share >= 0.001 else "less than 0.1 %"
