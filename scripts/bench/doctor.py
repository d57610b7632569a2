"""Evaluate the data checks: detection of planted faults, and findings in clean logs.

    python scripts/bench/doctor.py [FAULT...] [--vessels 10] [--seed 1000]
    python scripts/bench/doctor.py [FAULT...] --long ROWS [--seed 1000]

Faults are planted in logs of random vessels of each kind, and in measured logs if RESIDNET_DATA is
set. The table has the number of logs in which a finding above a note names the fault, by fault and
kind of vessel. The last line is the number of clean logs with a finding above a note. Limits were
tuned on seeds below 1000; use other seeds for an evaluation. With --long the findings in a long log
from a subsample and from all rows are compared.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bench
import numpy as np
from large_data import simulate
from planted import FAULTS, SHIPS, Fault, Ship, Undecidable
from random_vessels import KINDS, random_logs, ship_of

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.preprocessing.masks import MaskRule
from residnet.quality import Finding, inspect_log, inspect_log_set, statistics

_LOGS_PER_HOST = 3
"""Number of measured logs that are checked together."""
_MAX_MEASURED_HOSTS = 4
"""Largest number of groups of measured logs."""


@dataclass(frozen=True)
class Host:
    """Logs of one vessel, with inputs and masks of its config."""

    ship: Ship
    logs: list[Log]
    inputs: tuple[str, ...] | None = None
    masks: tuple[MaskRule, ...] = ()


def simulate_hosts(seed: int, count: int) -> Iterator[Host]:
    """Yield vessels drawn at random."""
    for kind in KINDS:
        for logs in random_logs(kind, seed, count):
            yield Host(ship_of(kind, logs[0]), logs)


def read_measured_hosts(seed: int) -> list[Host]:
    """Return measured model tankers, three logs at a time."""
    from residnet.tasks.registry import load_task

    folder = os.environ.get("RESIDNET_DATA")
    if not folder:
        return []
    random = np.random.default_rng(seed)
    hosts = []
    for name in ("esso_osaka", "kvlcc2"):
        fit: Any = load_task(bench.CONFIGS / f"{name}.yaml")
        reader = fit.data.reader.build()
        files = sorted((Path(folder) / name).rglob("*.csv"))
        files = [files[i] for i in random.permutation(len(files))]
        arm = (0.6, 1.5) if name == "esso_osaka" else (1.4, 3.5)
        ship = Ship(
            "tanker", name, "0 s", "0 s", {}, arm=arm, lag=(0.7, 1.4), bias=(0.1, 0.3),
            steer=("delta",), actual="delta", demand="delta",
        )  # fmt: skip
        for start in range(0, len(files) - _LOGS_PER_HOST + 1, _LOGS_PER_HOST):
            logs = [reader.read(file) for file in files[start : start + _LOGS_PER_HOST]]
            hosts.append(Host(ship, logs, fit.signals.regressor_columns, fit.prepare.masks))
    return [hosts[i] for i in random.permutation(len(hosts))][:_MAX_MEASURED_HOSTS]


def is_detected(fault: Fault, host: Host, logs: list[Log]) -> bool:
    """Return whether the data checks name a fault of the first log, or of all logs together."""
    try:
        findings = list(inspect_log(logs[0], host.inputs, host.masks).findings)
        findings += inspect_log_set(logs, host.inputs).findings
    except ResidnetError as error:
        findings = [Finding("fatal", fault.codes[0], str(error))]
    # samples that the masks of the run exclude are a note
    counted_findings = [
        f
        for f in findings
        if f.level != "note" or fault.harmless or f.action == "the config masks these samples"
    ]
    return any(f.code in fault.codes for f in counted_findings)


def find_codes(log: Log, longest: float) -> set[str]:
    """Return the codes of the findings above a note.

    Args:
        log: the checked log.
        longest: number of samples above which a subsample is checked.

    Returns:
        The codes; `unreadable` for a log that cannot be checked.
    """
    statistics._MAX_SUBSAMPLE = longest
    try:
        return {f.code for f in inspect_log(log).findings if f.level != "note"}
    except ResidnetError:
        return {"unreadable"}


def compare_long_logs(rows: int, seed: int, faults: Sequence[Fault]) -> None:
    """Print the findings in long logs that only a subsample or only all rows give, by fault."""
    usual_limit = statistics._MAX_SUBSAMPLE
    n_equal = 0
    n_logs = 0
    ship = next(candidate for candidate in SHIPS if candidate.name == "wam_v")
    hosts = simulate(2, rows, seed)
    for number, fault in enumerate([None, *faults]):
        if fault is not None and ship.name not in fault.ships and "twin" not in fault.hosts:
            continue
        random = np.random.default_rng([seed, number])
        try:
            log = hosts[0] if fault is None else fault.plant(ship, hosts, random)[0]
        except (Undecidable, KeyError):
            # the boat has no such channel
            continue
        subsample_codes = find_codes(log, usual_limit)
        all_codes = find_codes(log, math.inf)
        n_equal = n_equal + (subsample_codes == all_codes)
        n_logs = n_logs + 1
        difference_text = (
            f"by stretches alone {sorted(subsample_codes - all_codes)}, by all rows"
            f" {sorted(all_codes - subsample_codes)}"
        )
        text = "alike" if subsample_codes == all_codes else difference_text
        print(f"{'none' if fault is None else fault.name}: {text}; {sorted(all_codes)}", flush=True)
    print(f"both looks say the same of {n_equal} of {n_logs} logs of {rows} rows")


def main() -> None:
    """Print both tables."""
    options = bench.options(__doc__, faults=(), vessels=10, seed=1000, long=0)
    faults = [f for f in FAULTS if not options.faults or f.name in options.faults]
    if options.long:
        compare_long_logs(options.long, options.seed, faults)
        return
    hosts = [*simulate_hosts(options.seed, options.vessels), *read_measured_hosts(options.seed)]
    names = list(dict.fromkeys(host.ship.name for host in hosts))
    table: dict[tuple[str, str], list[bool]] = {}
    n_checked = 0
    n_alarms = 0
    for number, host in enumerate(hosts):
        for log in host.logs if not options.faults else ():
            findings = inspect_log(log, host.inputs, host.masks).findings
            texts = [f"{f.code} ({f.effect}): {f.text}" for f in findings if f.level != "note"]
            n_checked = n_checked + 1
            n_alarms = n_alarms + bool(texts)
            if texts:
                print(f"alarm: {log.name}: {'; '.join(texts)}", file=sys.stderr)
        for fault in faults:
            if host.ship.name not in (*fault.ships, *fault.hosts):
                continue
            random = np.random.default_rng([options.seed, number, len(fault.name)])
            logs = [host.logs[i] for i in random.permutation(len(host.logs))]
            try:
                planted_logs = fault.plant(host.ship, logs, random)
            except Undecidable:
                continue
            other_logs = [log for log in logs[1:] if len(planted_logs) == 1]
            has_finding = is_detected(fault, host, [*planted_logs, *other_logs])
            table.setdefault((fault.name, host.ship.name), []).append(has_finding)
    print_table(table, faults, names)
    if n_checked:
        print(
            f"clean logs with a finding above a note: {n_alarms} of {n_checked},"
            f" {n_alarms / n_checked:.1%}"
        )


def print_table(
    table: Mapping[tuple[str, str], Sequence[bool]], faults: Sequence[Fault], ships: Sequence[str]
) -> None:
    """Print how often each planted fault was found, by ship and in total."""
    print(f"{'fault':28s}" + "".join(f"{name:>11s}" for name in ships) + "        all")
    all_hits: list[bool] = []
    for fault in faults:
        row = [table.get((fault.name, name), []) for name in ships]
        hits_of_fault = [hit for hits in row for hit in hits]
        all_hits += hits_of_fault
        cells = [f"{sum(hits)}/{len(hits)}" if hits else "-" for hits in (*row, hits_of_fault)]
        print(f"{fault.name:28s}" + "".join(f"{cell:>11s}" for cell in cells))
    if all_hits:
        n_found = sum(all_hits)
        print(f"\nplanted faults found: {n_found} of {len(all_hits)}, {np.mean(all_hits):.1%}")


if __name__ == "__main__":
    main()
