"""How many planted faults the data doctor finds on simulated vessels, and what it says about clean
logs.

    python scripts/bench/doctor.py [SEEDS] [FAULT...]

For each fault and vessel: logs in which a finding above a note names it, of so many seeds. Then the
findings above a note on clean logs.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from planted import FAULTS, SHIPS, clean

from residnet.core.errors import ResidnetError
from residnet.data.doctor import Finding, inspect, inspect_together


def findings(logs: list) -> list[Finding]:
    """Everything above a note, in each log and between them."""
    found = [finding for log in logs for finding in inspect(log).findings]
    return [
        finding for finding in (*found, *inspect_together(logs).findings) if finding.level != "note"
    ]


def main() -> None:
    """Print both tables."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 20
    wanted = sys.argv[2:]
    found = {(fault.name, ship.name): 0 for fault in FAULTS for ship in SHIPS}
    alarms: dict[str, list[str]] = {}
    checked = 0
    for ship in SHIPS:
        for seed in range(seeds):
            logs = clean(ship, seed)
            if not wanted:
                for log in logs:
                    checked += 1
                    alarms.setdefault(ship.name, []).extend(
                        f"seed {seed} {log.name}: {f.code}: {f.text}" for f in findings([log])
                    )
                alarms[ship.name] += [
                    f"seed {seed} together: {f.code}: {f.text}"
                    for f in inspect_together(logs).findings
                    if f.level != "note"
                ]
            for number, fault in enumerate(FAULTS):
                if ship.name not in fault.ships or (wanted and fault.name not in wanted):
                    continue
                random = np.random.default_rng([seed, number])
                order = random.permutation(len(logs))
                try:
                    said = findings(fault.plant(ship, [logs[i] for i in order], random))
                except ResidnetError as error:
                    said = [Finding("fatal", "error", str(error))]
                named = any(finding.code in fault.codes for finding in said)
                found[fault.name, ship.name] += named
                if not named:
                    which = logs[order[0]].name
                    print(
                        f"missed: {fault.name}, {ship.name}, seed {seed}, {which}:"
                        f" {[finding.code for finding in said]}",
                        file=sys.stderr,
                    )
    print(f"{'fault':26s}" + "".join(f"{ship.name:>10s}" for ship in SHIPS) + f"   (of {seeds})")
    for fault in FAULTS:
        if not wanted or fault.name in wanted:
            print(
                f"{fault.name:26s}"
                + "".join(
                    f"{found[fault.name, ship.name] if ship.name in fault.ships else '-':>10}"
                    for ship in SHIPS
                )
            )
    print(f"\nclean logs: {checked}, findings above a note: {sum(map(len, alarms.values()))}")
    for name, lines in alarms.items():
        for line in lines:
            print(f"  {name}: {line}")


if __name__ == "__main__":
    main()
