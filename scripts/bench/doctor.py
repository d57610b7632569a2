"""How many planted faults the data doctor finds, and what it says about clean logs.

    python scripts/bench/doctor.py [FAULT...] [--vessels 10] [--seed 1000]
    python scripts/bench/doctor.py [FAULT...] --long ROWS [--seed 1000]

The hosts are so many vessels of each kind drawn at random, and measured logs where RESIDNET_DATA
names them. For each fault and kind of host: logs in which a finding above a note names it. Then the
clean logs that have a finding above a note. Limits were tuned on seeds below 1000; report on
others. With --long both ways of looking at one long log of so many rows stand beside each other.
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

_TOGETHER = 3
_MEASURED = 4
"""Measured logs that are looked at together, and how often."""


@dataclass(frozen=True)
class Host:
    """Logs of one vessel, and what a config says of them."""

    ship: Ship
    logs: list[Log]
    inputs: tuple[str, ...] | None = None
    masks: tuple[MaskRule, ...] = ()


def simulated(seed: int, count: int) -> Iterator[Host]:
    """Yield vessels drawn at random."""
    for kind in KINDS:
        for logs in random_logs(kind, seed, count):
            yield Host(ship_of(kind, logs[0]), logs)


def measured(seed: int) -> list[Host]:
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
        for start in range(0, len(files) - _TOGETHER + 1, _TOGETHER):
            logs = [reader.read(file) for file in files[start : start + _TOGETHER]]
            hosts.append(Host(ship, logs, fit.signals.columns, fit.prepare.masks))
    return [hosts[i] for i in random.permutation(len(hosts))][:_MEASURED]


def named(fault: Fault, host: Host, logs: list[Log]) -> bool:
    """Return whether the doctor names a fault of the first log, or of all together."""
    try:
        said = list(inspect_log(logs[0], host.inputs, host.masks).findings)
        said += inspect_log_set(logs, host.inputs).findings
    except ResidnetError as error:
        said = [Finding("fatal", fault.codes[0], str(error))]
    # what the masks of the run leave out is a note
    loud = [
        f
        for f in said
        if f.level != "note" or fault.harmless or f.action == "the config masks these samples"
    ]
    return any(f.code in fault.codes for f in loud)


def loud(log: Log, longest: float) -> set[str]:
    """Return the codes above a note where logs of more than `longest` samples are told by a part.

    An unreadable log has none but `unreadable`.
    """
    statistics._MAX_SUBSAMPLE = longest
    try:
        return {f.code for f in inspect_log(log).findings if f.level != "note"}
    except ResidnetError:
        return {"unreadable"}


def long_logs(rows: int, seed: int, faults: Sequence[Fault]) -> None:
    """Print of each fault in a long log what either look alone finds."""
    usual = statistics._MAX_SUBSAMPLE
    alike = 0
    count = 0
    ship = next(one for one in SHIPS if one.name == "wam_v")
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
        few = loud(log, usual)
        whole = loud(log, math.inf)
        alike = alike + (few == whole)
        count = count + 1
        told = f"by stretches alone {sorted(few - whole)}, by all rows {sorted(whole - few)}"
        said = "alike" if few == whole else told
        print(f"{'none' if fault is None else fault.name}: {said}; {sorted(whole)}", flush=True)
    print(f"both looks say the same of {alike} of {count} logs of {rows} rows")


def main() -> None:
    """Print both tables."""
    given = bench.options(__doc__, faults=(), vessels=10, seed=1000, long=0)
    faults = [f for f in FAULTS if not given.faults or f.name in given.faults]
    if given.long:
        long_logs(given.long, given.seed, faults)
        return
    hosts = [*simulated(given.seed, given.vessels), *measured(given.seed)]
    names = list(dict.fromkeys(host.ship.name for host in hosts))
    table: dict[tuple[str, str], list[bool]] = {}
    checked = 0
    loud = 0
    for number, host in enumerate(hosts):
        for log in host.logs if not given.faults else ():
            said = inspect_log(log, host.inputs, host.masks).findings
            told = [f"{f.code} ({f.effect}): {f.text}" for f in said if f.level != "note"]
            checked = checked + 1
            loud = loud + bool(told)
            if told:
                print(f"alarm: {log.name}: {'; '.join(told)}", file=sys.stderr)
        for fault in faults:
            if host.ship.name not in (*fault.ships, *fault.hosts):
                continue
            random = np.random.default_rng([given.seed, number, len(fault.name)])
            logs = [host.logs[i] for i in random.permutation(len(host.logs))]
            try:
                planted = fault.plant(host.ship, logs, random)
            except Undecidable:
                continue
            rest = [log for log in logs[1:] if len(planted) == 1]
            hit = named(fault, host, [*planted, *rest])
            table.setdefault((fault.name, host.ship.name), []).append(hit)
    print_table(table, faults, names)
    if checked:
        print(f"clean logs with a finding above a note: {loud} of {checked}, {loud / checked:.1%}")


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
