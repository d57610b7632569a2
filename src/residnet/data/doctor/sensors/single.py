"""Single samples that no vessel can have had: spikes, fill values, absurd numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding, show
from residnet.data.outliers import spike_cells
from residnet.data.plausible import beyond_belief, fills


def absurd_findings(log: Log) -> Iterator[Finding]:
    """Return the values that no vessel can have, and fill values."""
    for name, values in log.channels.items():
        filled = fills(values)
        if filled.any():
            worst = float(values[np.argmax(filled)])
            text = (
                f"{int(filled.sum())} samples of {name} hold the fill value {worst:g}, first at t ="
                f" {log.t[np.argmax(filled)]:.2f} s: nothing was measured there"
            )
            yield Finding(
                "will mislead",
                "fill_values",
                text,
                {"count": float(filled.sum()), "value": worst},
                "leave these cells empty",
                channels=(name,),
            )
        beyond = beyond_belief(values, log.units[name]) & ~filled
        if beyond.any():
            at = int(np.argmax(beyond))
            text = (
                f"{name} is {show(float(values[at]), log.units[name])} at t = {log.t[at]:.2f} s,"
                f" which no vessel reaches ({int(beyond.sum())} such samples)"
            )
            yield Finding(
                "fatal", "absurd", text, {"count": float(beyond.sum())}, "correct or empty them"
            )


def spike_findings(log: Log) -> Iterator[Finding]:
    """Return the single samples that leave all others and return at once."""
    for name, at in spike_cells(log).items():
        values = log[name]
        worst = int(np.argmax(np.where(at, np.abs(values - np.nanmedian(values)), -1.0)))
        text = (
            f"{int(at.sum())} single samples of {name} stand far out, the worst"
            f" {show(float(values[worst]), log.units[name])} at t = {log.t[worst]:.2f} s"
        )
        yield Finding(
            "will mislead",
            "spikes",
            text,
            {"count": float(at.sum()), "t": float(log.t[worst])},
            "correct or empty these cells; a fit bridges them and leaves them out",
            at,
            channels=(name,),
        )
