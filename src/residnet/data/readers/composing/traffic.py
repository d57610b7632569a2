"""The rate, gaps, empty columns and publishers of one series, as its rows tell them."""

from __future__ import annotations

import numpy as np

from residnet.data.readers.recording import Remark, Series, remark

# a gap is this many times the usual step, and this many seconds
_GAP_STEPS, _GAP_SECONDS = 5.0, 0.5
# rows below which nothing is said about publishers
_ENOUGH = 100


def traffic(series: Series) -> list[Remark]:
    """Return the remarks on a series whose rows are in order."""
    if not len(series):
        return [remark("note", "empty_topic", f"topic {series.name}: holds no rows")]
    out = []
    empty = [path for path, values in series.fields.items() if np.isnan(values).all()]
    if empty:
        shown = ", ".join(empty[:6]) + (", ..." if len(empty) > 6 else "")
        out.append(
            remark(
                "note",
                "empty_columns",
                f"topic {series.name}: {len(empty)} fields hold no number ({shown})",
                fields=len(empty),
            )
        )
    if len(series) < 3:
        return out
    step = np.diff(series.clock)
    usual, longest = float(np.median(step)), float(step.max())
    rate = (len(series) - 1) / float(series.clock[-1] - series.clock[0])
    text = (
        f"topic {series.name}: {len(series)} rows, {rate:.3g} Hz, step {usual:.3g} s (median),"
        f" spread {float(np.std(step)):.2g} s, longest {longest:.3g} s"
    )
    out.append(
        remark("note", "topic_rate", text, rows=len(series), rate=rate, step=usual, longest=longest)
    )
    gaps = step > max(_GAP_STEPS * usual, _GAP_SECONDS)
    if gaps.any():
        at = float(series.clock[int(np.argmax(step))])
        text = (
            f"topic {series.name}: {int(gaps.sum())} gaps, the longest {longest:.3g} s at"
            f" {at:.1f} s; nothing is interpolated across"
        )
        out.append(remark("note", "topic_gaps", text, gaps=int(gaps.sum()), longest=longest, at=at))
    return out + publishers(series, step)


def publishers(series: Series, step: np.ndarray) -> list[Remark]:
    """Return a remark where several publishers share the topic.

    They are recognised by the sender that the source names, else by values that leap away and come
    straight back (A, B, A) while rows follow each other at irregular short steps, as two trains of
    messages on one track do, or by such leaps alone where nearly every row is one and they are
    wide.

    Args:
        series: with its rows in order.
        step: between them [T - 1] in s.
    """
    if series.sender is not None and len(series) >= 2:
        names = [str(name) for name in dict.fromkeys(series.sender.tolist())]
        turns = int((series.sender[1:] != series.sender[:-1]).sum())
        if len(names) > 1 and turns >= len(names):
            text = (
                f"topic {series.name}: rows of {len(names)} senders alternate"
                f" ({', '.join(names[:6])}); name one with `sender`"
            )
            return [
                remark("will mislead", "several_publishers", text, senders=len(names), turns=turns)
            ]
    if len(series) < _ENOUGH:
        return []
    short = float((step < 0.2 * step.mean()).mean())
    for path, values in series.fields.items():
        leaps, returns, width = _returns(values)
        bursts = short > 0.15 and returns > 0.05 and returns > 0.3 * leaps
        mixed = short > 0.05 and returns > 0.2 and returns > 0.35 * leaps and width > 0.05
        in_turns = returns > 0.3 and returns > 0.8 * leaps and width > 0.05
        if bursts or mixed or in_turns:
            text = (
                f"topic {series.name}: several publishers seem to write to it: field {path} leaps"
                f" away and straight back in {returns:.0%} of the rows, {short:.0%} of the steps"
                " are shorter than a fifth of the mean; do not use it unless the source tells its"
                " senders apart"
            )
            return [
                remark(
                    "will mislead", "several_publishers", text, returns=returns, short_steps=short
                )
            ]
    return []


def _returns(values: np.ndarray) -> tuple[float, float, float]:
    """Return the share of rows that change twice, that come back, and the leaps' width.

    A row comes back to the value before; the width is a share of the values' range.
    """
    known = values[np.isfinite(values)]
    if known.size < _ENOUGH:
        return 0.0, 0.0, 0.0
    low, high = np.quantile(known, (0.01, 0.99))
    first, second, over = (
        np.abs(np.diff(known))[:-1],
        np.abs(np.diff(known))[1:],
        np.abs(known[2:] - known[:-2]),
    )
    leap = (first > 0.0) & (second > 0.0)
    back = leap & (over <= 0.1 * np.minimum(first, second))
    width = float(np.median(first[back])) / float(high - low) if back.any() and high > low else 0.0
    return float(leap.mean()), float(back.mean()), width
