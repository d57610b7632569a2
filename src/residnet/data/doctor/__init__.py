"""The data doctor: what logs hold, what is wrong with them, and whether a fit would be misled.

A check is a function with `@check` above it, in the module of its subject; it reads a `Record` and
yields findings. `STAGES` says when it looks, and at what state of the log.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.data.align import GridConfig, align
from residnet.data.doctor import actuators, excitation, frames, inputs, values
from residnet.data.doctor.between import Together
from residnet.data.doctor.clock import date_findings
from residnet.data.doctor.effects import Effects
from residnet.data.doctor.excitation import conditioning
from residnet.data.doctor.findings import (
    CHECKS,
    Finding,
    Report,
    imported,
    inspection,
    run,
    summary,
)
from residnet.data.doctor.statistics import MEASURED, Record
from residnet.data.masks import Mask, apply_masks
from residnet.data.motion import as_recorded

__all__ = [
    "CHECKS",
    "STAGES",
    "Finding",
    "Report",
    "actuators",
    "conditioning",
    "date_findings",
    "excitation",
    "frames",
    "inputs",
    "inspect",
    "inspect_together",
    "inspection",
    "summary",
    "values",
]

STAGES = {
    "header": "as recorded",
    "order": "as recorded; a finding here ends the examination",
    "clock": "as recorded, with an increasing clock",
    "values": "with its headings continuous",
    "grid": "on a uniform grid, without what a finding about values says is wrong",
    "inputs": "with its headings continuous",
    "actuators": "without what a finding about values says is wrong",
    "excitation": "with its headings continuous",
    "between": "several logs (`Together`)",
}
"""Stage -> the state of the log that its checks see, in the order of the stages."""


def inspect(log: Log, inputs: Sequence[str] | None = None, masks: Sequence[Mask] = ()) -> Report:
    """Examine one log as recorded (before the grid, whose effect it cannot see).

    Args:
        log: any log.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        masks: rules that will leave samples out of a fit; a finding about such samples only is a
            note.

    Raises:
        UsageError: where the log lacks an input that was named.
        DataError: where the log has fewer than two samples, or a channel holds no number.
    """
    if len(log) < 2:
        raise DataError(f"log {log.name}: {len(log)} samples, at least 2 are needed; leave it out")
    for name, channel in log.channels.items():
        if not np.isfinite(channel).any():
            raise DataError(
                f"log {log.name}: channel {name} holds no number; take it out of the channel map"
            )
    driving = [name for name in log.channels if name not in MEASURED]
    driving = driving if inputs is None else as_recorded(log, inputs)
    log.stack(driving)
    raw = Record(log, driving)
    found = [*imported(log.meta.get("findings", ())), *run("header", raw)]
    source = str(log.meta.get("source", ""))
    broken = [*run("order", raw)]
    if broken:
        return Report(log.name, (*found, *broken), source)
    record = Record(values.unwrapped(log), driving)
    about_values = [*run("values", record)]
    found += [*run("clock", raw), *about_values]
    wrong = [one.at for one in about_values if one.spoils and one.at is not None]
    bad = np.logical_or.reduce([np.zeros(len(log), dtype=bool), *wrong])
    trusted = record if bad.mean() > 0.5 else record.without(bad)
    found += _on_grid(trusted)
    found += [*run("inputs", record), *run("actuators", trusted), *run("excitation", record)]
    left_out = ~apply_masks(log, masks).usable if masks else np.zeros(len(log), dtype=bool)
    found = [one.excused(left_out) for one in found]
    if any(one.level == "will mislead" for one in found):
        effects = Effects(record.without(left_out))
        found = [effects.measured(one) for one in found]
    return Report(log.name, tuple(found), source)


def _on_grid(log: Record) -> list[Finding]:
    """Return the findings of the checks that need a uniform grid, told at the log's own samples."""
    few = log.few
    # from one stretch to the next a heading may have turned round many times
    whole = few.log if few is log else values.unwrapped(few.log)
    try:
        grid = few.on(values.upright(align(whole, GridConfig(step=log.step))))
    except DataError as error:
        return [Finding("fatal", "clock_span", f"frames not checked: {error}")]
    if few is not log:
        # what single samples of a long log do is seen as they were recorded
        return [*run("grid", log.told_by(grid, values.upright(log.log)))]
    found = [*run("grid", grid)]
    near = np.searchsorted(grid.t - grid.t[0], log.t - log.t[0] - 1e-9)
    near = np.minimum(near, len(grid) - 1)
    return [one if one.at is None else dataclasses.replace(one, at=one.at[near]) for one in found]


def inspect_together(
    logs: Sequence[Log],
    inputs: Sequence[str] | None = None,
    splits: Mapping[str, str] | None = None,
) -> Report:
    """Examine logs beside each other: copies, runs cut into files, ranges, excitation.

    The last is whether a fit to all of them has something to learn from.

    Args:
        logs: at least one, each with an increasing clock.
        inputs: channels that drive the vessel; None takes all that no sensor of the motion
            measures.
        splits: log's name -> train, validation or test, where a config says.
    """
    sound = [log for log in logs if len(log) > 1 and not [*run("order", Record(log))]]
    if inputs is not None:
        inputs = [*dict.fromkeys(name for log in sound for name in as_recorded(log, inputs))]
    found = run("between", Together(sound, inputs, splits or {})) if sound else ()
    return Report("together", tuple(found))
