"""The verdict on the selected model of a fit in words, from what the run folder's files hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Content = Mapping[str, Any]
"""What a JSON object holds."""

ZERO = "zero"
UNSEEN = ("test", "external")
"""Splits that no fit has seen."""


@dataclass(frozen=True)
class Evidence:
    """What a verdict is passed on.

    Attributes:
        selected: name of the selected model.
        split: whose free runs count.
        rows: of metrics.json under one protocol over all manoeuvres of that split, by model.
        baseline: name of the first baseline; empty where there is none.
        selection: contents of selection.json; empty where a run has none.
        limits: contents of limits.json for that split and protocol; empty where a run has none.
        doctor: one sentence on what the data doctor found; empty where nobody looked.
    """

    selected: str
    split: str
    rows: Mapping[str, Content]
    baseline: str = ""
    selection: Content = field(default_factory=dict)
    limits: Content = field(default_factory=dict)
    doctor: str = ""


def verdict(evidence: Evidence) -> list[str]:
    """Return the verdict sentence by sentence, the most important first.

    It says whether the selected model is better than `zero` and than the baseline, whether it is
    sound and why it was selected, for which horizon and speed it can be trusted, how much of the
    data lies outside the training range, and what the doctor found. What the files do not hold is
    left out.
    """
    sentences = [
        lead(evidence),
        soundness(evidence),
        str(evidence.selection.get("reason", "")),
        *([] if useless(evidence) else trusted(evidence)),
        outside(evidence),
        evidence.doctor,
    ]
    return [sentence for sentence in sentences if sentence]


def objections(evidence: Evidence) -> list[str]:
    """Return what speaks against using the model at all, as `residnet.export.base.released` asks.

    A model is to be better than `zero`, and than the model that it was built on.
    """
    own = evidence.rows.get(evidence.selected)
    if own is None:
        return []
    return [
        f"on {evidence.split} data its NRMSE is {_nrmse(own):.3g}, that of {other}"
        f" {_nrmse(row):.3g}"
        for other in dict.fromkeys((ZERO, evidence.baseline))
        if (row := evidence.rows.get(other)) is not None and _nrmse(own) > _nrmse(row)
    ]


def useless(evidence: Evidence) -> bool:
    """Return whether the selected model is `zero`, or no better: then no range is to be trusted."""
    own, zero = evidence.rows.get(evidence.selected), evidence.rows.get(ZERO)
    if evidence.selected == ZERO:
        return True
    return own is not None and zero is not None and _nrmse(own) >= _nrmse(zero)


def lead(evidence: Evidence) -> str:
    """Return the first sentence: the selected model against `zero` and the baseline."""
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
        return (
            f"WORSE THAN ZERO: on {split} data the selected model {name} has an NRMSE of"
            f" {error:.3g}{_lost(own)}, and zero, which only holds the velocities that a run starts"
            f" from, {_nrmse(zero):.3g}{_paired(evidence, ZERO)}. Do not use it for prediction."
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
    return f"On {split} data model {name}{better} its NRMSE is {error:.3g}{_lost(own)}."


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
    return (
        "It is sound: no window diverged, it does not run away where the logs have been, and its"
        " damping has the right sign there."
    )


def trusted(evidence: Evidence) -> list[str]:
    """Return up to which horizon and at which speeds the selected model can be trusted."""
    found = (evidence.limits.get("trust") or {}).get(evidence.selected)
    if not found:
        return []
    horizon, speeds = (_reach(found[key]) for key in ("horizons", "speeds"))
    sure = _measured(found["horizons"])
    spread = "by the 95 % interval" if sure else "but there are too few logs for an interval"
    criterion = f"smaller than those of zero, {spread}"
    if horizon is None:
        return ["It cannot be trusted at any horizon: at none its errors are smaller than zero's."]
    ends = [entry["high"] for entry in found["horizons"]]
    late = horizon[0] > min(entry["low"] for entry in found["horizons"])
    text = f"It can be trusted {f'from {horizon[0]:.3g} ' if late else ''}up to {horizon[1]:.3g} s"
    text += " ahead, as far as the runs go" if horizon[1] >= max(ends) else " ahead"
    if found["speeds"]:
        text += (
            f", and at mean speeds of {speeds[0]:.2g} to {speeds[1]:.2g} m/s"
            if speeds is not None
            else ", but in no band of speeds alone"
        )
    return [f"{text}: there its errors are {criterion}."]


def outside(evidence: Evidence) -> str:
    """Return how much of the data lies outside the training range, empty where nobody looked."""
    found = evidence.limits.get("outside") or {}
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


def _paired(evidence: Evidence, other: str) -> str:
    """The paired interval of the difference to another model in brackets, where there is one."""
    compared = (evidence.limits.get("compared") or {}).get(evidence.selected) or {}
    found = compared.get(other)
    if not found:
        return ""
    if found["ci95"] is None:
        return " (too few logs for an interval)"
    low, high = found["ci95"]
    doubt = "" if found["excludes_zero"] else ", which holds zero: the data cannot tell them apart"
    return f" (paired 95 % interval of the difference {low:+.3g} to {high:+.3g}{doubt})"


def _measured(entries: Sequence[Content]) -> bool:
    return any(entry["difference"]["ci95"] is not None for entry in entries)


def _reach(entries: Sequence[Content]) -> tuple[float, float] | None:
    """Ends of the longest run of entries whose errors are smaller than those of zero, None where
    there is none; the interval must say so where there is one.
    """
    sure = _measured(entries)
    best: list[Content] = []
    run: list[Content] = []
    for entry in entries:
        apart = entry["difference"]
        holds = apart["nrmse_mean"] < 0 and (apart["excludes_zero"] or not sure)
        run = [*run, entry] if holds else []
        if len(run) > len(best):
            best = run
    return (float(best[0]["low"]), float(best[-1]["high"])) if best else None


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %" if share >= 0.001 else "less than 0.1 %"
