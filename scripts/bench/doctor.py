"""How many planted faults the data doctor finds, and what it says about clean logs.

    python scripts/bench/doctor.py [--vessels N] [--seed S] [--shipped SEEDS] [FAULT...]
    python scripts/bench/doctor.py --long ROWS [--seed S] [FAULT...]

The hosts are vessels drawn at random, measured logs where RESIDNET_DATA names them, and with
--shipped the shipped vessels. For each fault and kind of host: logs in which a finding above a note
names it. Then the clean logs that have a finding above a note. Limits were tuned on seeds below
1000; report on others.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from large_data import simulate
from planted import FAULTS, SHIPS, Fault, Ship, Undecidable, clean
from random_vessels import KINDS, random_logs, ship_of

from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.data.doctor import Finding, inspect, inspect_together, statistics
from residnet.data.masks import Mask

_CONFIGS = Path(__file__).resolve().parents[2] / "configs"
_ROTATED = 3


@dataclass(frozen=True)
class Host:
    """Logs of one vessel, and what a config says of them."""

    ship: Ship
    logs: list[Log]
    inputs: tuple[str, ...] | None = None
    masks: tuple[Mask, ...] = ()

    def findings(self, logs: Sequence[Log], first_only: bool = False) -> list[Finding]:
        """Everything that the doctor says of logs, each and together."""
        members = logs[:1] if first_only else logs
        found = [f for log in members for f in inspect(log, self.inputs, self.masks).findings]
        return [*found, *inspect_together(logs, self.inputs).findings]


def simulated(seed: int, count: int) -> Iterator[Host]:
    """Vessels drawn at random."""
    for kind in KINDS:
        for logs in random_logs(kind, seed, count):
            yield Host(ship_of(kind, logs[0]), logs)


def shipped(seeds: int) -> Iterator[Host]:
    """The shipped vessels."""
    for ship in SHIPS:
        for seed in range(seeds):
            yield Host(ship, clean(ship, seed))


def measured(seed: int) -> Iterator[Host]:
    """Measured model tankers, three logs at a time."""
    from residnet.tasks.registry import load_task

    folder = os.environ.get("RESIDNET_DATA")
    if not folder:
        return
    random = np.random.default_rng(seed)
    about = {"lag": (0.7, 1.4), "bias": (0.1, 0.3)}
    hosts = []
    for name in ("esso_osaka", "kvlcc2"):
        fit: Any = load_task(_CONFIGS / f"{name}.yaml")
        reader = fit.data.reader.build()
        files = sorted((Path(folder) / name).rglob("*.csv"))
        files = [files[i] for i in random.permutation(len(files))]
        arm = (0.6, 1.5) if name == "esso_osaka" else (1.4, 3.5)
        ship = Ship(
            "tanker", name, "0 s", "0 s", {}, arm=arm, **about, steer=("delta",), actual="delta",
            demand="delta",
        )  # fmt: skip
        for start in range(0, len(files) - _ROTATED + 1, _ROTATED):
            logs = [reader.read(file) for file in files[start : start + _ROTATED]]
            hosts.append(Host(ship, logs, fit.signals.columns, fit.prepare.masks))
    yield from (hosts[i] for i in random.permutation(len(hosts)))


def alarms(host: Host) -> list[str]:
    """What the doctor says above a note of each clean log, one entry for each log."""
    out = []
    for log in host.logs:
        loud = [f for f in inspect(log, host.inputs, host.masks).findings if f.level != "note"]
        out.append("; ".join(f"{f.code} ({f.effect}): {f.text}" for f in loud))
    return out


def _named(fault: Fault, host: Host, logs: list[Log], verbose: bool) -> bool:
    try:
        said = host.findings(logs, first_only=True)
    except ResidnetError as error:
        said = [Finding("fatal", fault.codes[0], str(error))]
    # what the masks of the run leave out is a note
    loud = [
        f
        for f in said
        if f.level != "note" or fault.harmless or f.action == "the config masks these samples"
    ]
    named = any(f.code in fault.codes for f in loud)
    if not named or verbose:
        told = [(f.code, f.effect and round(f.effect, 3)) for f in said if f.code in fault.codes]
        others = sorted({f.code for f in said if f.level != "note"})
        word = "found" if named else "missed"
        print(f"{word}: {fault.name}, {logs[0].name}: {told}, else {others}", file=sys.stderr)
    return named


def loud(log: Log, longest: float) -> set[str]:
    """Return the codes above a note where logs of more than `longest` samples are told by a part.

    An unreadable log has none but `unreadable`.
    """
    statistics._LONG = longest
    try:
        return {f.code for f in inspect(log).findings if f.level != "note"}
    except ResidnetError:
        return {"unreadable"}


def long_logs(rows: int, seed: int, faults: Sequence[Fault]) -> None:
    """Print of each fault in a long log what either look alone finds."""
    usual, alike, count = statistics._LONG, 0, 0
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
        few, whole = loud(log, usual), loud(log, math.inf)
        alike, count = alike + (few == whole), count + 1
        told = f"by stretches alone {sorted(few - whole)}, by all rows {sorted(whole - few)}"
        said = "alike" if few == whole else told
        print(f"{'none' if fault is None else fault.name}: {said}; {sorted(whole)}", flush=True)
    print(f"both looks say the same of {alike} of {count} logs of {rows} rows")


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vessels", type=int, default=10, help="of each kind, drawn at random")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--shipped", type=int, default=0, help="seeds of the shipped vessels")
    parser.add_argument("--measured", type=int, default=4, help="sets of three measured logs")
    parser.add_argument("--long", type=int, help="rows of long logs")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("faults", nargs="*")
    given = parser.parse_args()
    if given.long:
        chosen = [f for f in FAULTS if not given.faults or f.name in given.faults]
        long_logs(given.long, given.seed, chosen)
        return
    hosts = [
        *simulated(given.seed, given.vessels),
        *shipped(given.shipped),
        *list(measured(given.seed))[: given.measured],
    ]
    names = list(dict.fromkeys(host.ship.name for host in hosts))
    table: dict[tuple[str, str], list[bool]] = {}
    checked, loud = 0, 0
    faults = [f for f in FAULTS if not given.faults or f.name in given.faults]
    for number, host in enumerate(hosts):
        if not given.faults:
            for log, text in zip(host.logs, alarms(host), strict=True):
                checked, loud = checked + 1, loud + bool(text)
                if text:
                    print(f"alarm: {log.name}: {text}", file=sys.stderr)
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
            hit = _named(fault, host, [*planted, *rest], given.verbose)
            table.setdefault((fault.name, host.ship.name), []).append(hit)
    print(f"{'fault':28s}" + "".join(f"{name:>11s}" for name in names) + "        all")
    every: list[bool] = []
    for fault in faults:
        row = [table.get((fault.name, name), []) for name in names]
        joined = [hit for hits in row for hit in hits]
        every += joined
        cells = [f"{sum(hits)}/{len(hits)}" if hits else "-" for hits in (*row, joined)]
        print(f"{fault.name:28s}" + "".join(f"{cell:>11s}" for cell in cells))
    if every:
        print(f"\nplanted faults found: {sum(every)} of {len(every)}, {np.mean(every):.1%}")
    if checked:
        print(f"clean logs with a finding above a note: {loud} of {checked}, {loud / checked:.1%}")


if __name__ == "__main__":
    main()
