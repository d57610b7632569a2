"""Print what learning brings under stated conditions, from finished runs of the task `autopilot`.

Each run may have another seed; the last line holds the means.

    for seed in 0 1 2; do
      residnet run autopilot_conditions -s seed=$seed --out runs/conditions_$seed
    done
    python scripts/bench/autopilot_margins.py runs/conditions_0 runs/conditions_1 runs/conditions_2
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

DEG = 180.0 / math.pi
COLUMNS = (
    "cost [s]",
    "best classical [s]",
    "below it [%]",
    "below PD [%]",
    "network off [%]",
    "constants alone [%]",
    "overshoot 95 % [deg]",
    "travel / PD's",
    "swing heading [deg]",
    "swing rudder [deg]",
    "nominal entry [s]",
    "nominal overshoot [deg]",
    "worst beyond [%]",
    "diverged",
)


def margins(run: Path, name: str) -> list[float]:
    """The figures of one run in the order of `COLUMNS`; those that a run lacks are no numbers."""
    if not (run / "metrics.json").is_file():
        raise SystemExit(f"{run} holds no metrics.json: name the folder of a finished run")
    rows: list[dict[str, Any]] = json.loads((run / "metrics.json").read_text())["rows"]
    find = {(row["model"], row["protocol"]): row for row in rows}
    own = find[(name, "conditions")]
    cost = own["cost"]["mean"]
    judged = [row for row in rows if row["protocol"] == "conditions"]
    classical = [row for row in judged if row["kind"] == "classical"]
    best = min(row["cost"]["mean"] for row in classical)

    def other(model: str) -> float:
        row = find.get((model, "conditions"))
        return math.nan if row is None else float(row["cost"]["mean"])

    beyond = []
    for protocol in {row["protocol"] for row in rows if row["protocol"].startswith("beyond_")}:
        least = min(find[(row["model"], protocol)]["cost"]["mean"] for row in classical)
        beyond.append(100 * (find[(name, protocol)]["cost"]["mean"] / least - 1))
    constants = [row["model"] for row in judged if row["kind"] == "constants"]
    quiet, nominal = find[(name, "quiet")], find[(name, "nominal")]
    pd = find.get(("pd", "conditions"))
    return [
        cost,
        best,
        100 * (1 - cost / best),
        100 * (1 - cost / other("pd")),
        100 * (other(f"{name} network off") / cost - 1),
        100 * (1 - cost / other(constants[0])) if constants else math.nan,
        DEG * own["overshoot"]["p95"],
        own["travel"]["mean"] / pd["travel"]["mean"] if pd else math.nan,
        DEG * quiet["heading_swing"]["max"],
        DEG * quiet["rudder_swing"]["max"],
        nominal["settling"]["max"],
        DEG * nominal["overshoot"]["max"],
        max(beyond, default=math.nan),
        float(sum(row["diverged"] for row in rows if row["model"] == name and "diverged" in row)),
    ]


def main() -> None:
    """Print a line for each figure, a column for each run, and the mean."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--policy", default="learned")
    given = parser.parse_args()
    found = [margins(run, given.policy) for run in given.runs]
    print(f"{'':24s}" + "".join(f"{run.name:>16s}" for run in given.runs) + f"{'mean':>16s}")
    for place, title in enumerate(COLUMNS):
        values = [row[place] for row in found]
        shown = [*values, sum(values) / len(values)]
        print(f"{title:24s}" + "".join(f"{value:16.3f}" for value in shown))


if __name__ == "__main__":
    main()
