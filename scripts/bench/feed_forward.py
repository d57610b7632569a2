"""Feed-forwards of drawn ferries on courses that nothing has seen, beside the believed model.

    python scripts/bench/feed_forward.py [--ferries 10] [--seed 0]

So many ferries are drawn, each with a course of its own: every mass and every damping times 0.5 to
1.5, thrusters of 1.5 to 3 rad/s. A study as a user writes it identifies the residual with three
models. The exported feed-forwards are flown on three new courses: ahead, astern, and with any
heading. Printed are mean position errors, the model that the study selects by its own judging
courses, and the models that it withholds.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import bench
import torch
import yaml

from residnet.physics.force_model import ForceModel
from residnet.runs.folder import RunFolder
from residnet.studies.jervan2020.ferry.config import FerryStudyConfig
from residnet.studies.jervan2020.ferry.execute import (
    find_best_flown_model,
    find_best_model,
    list_feed_forward_objections,
    run_ferry_study,
    write_results,
)
from residnet.studies.jervan2020.ferry.judging import ExportedFeedForward

VESSEL = bench.CONFIGS / "vessels" / "milliampere.yaml"
CONFIG = bench.CONFIGS / "studies" / "jervan2020" / "operation.yaml"


def drawn_ferry(folder: Path, random: torch.Generator) -> Path:
    """Write the file of a ferry that is not quite milliAmpere, and return it."""

    def factor(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand(1, generator=random))

    vessel = yaml.safe_load(VESSEL.read_text())
    for part in (vessel["mass"], *vessel["damping"].values()):
        for value in part.values():
            value["value"] *= factor(0.5, 1.5)
    vessel["name"] = "drawn"
    vessel["actuators"] |= {"x_max": "4 kN", "y_max": "4 kN", "n_max": "8 kN m"}
    response = vessel["actuators"]["response"]
    response |= {"frequency": f"{factor(1.5, 3.0):.3f} rad/s", "damping": factor(0.6, 1.0)}
    file = folder / "drawn.yaml"
    file.write_text(yaml.safe_dump(vessel))
    return file


def drawn_course(random: torch.Generator, *, kind: str = "any", count: int = 12) -> dict[str, Any]:
    """Return waypoints in a square of 30 m, with headings ahead, astern or any of them."""
    points: list[list[Any]] = []
    at = torch.zeros(2)
    heading = 0.0
    while len(points) < count:
        after = 30.0 * torch.rand(2, generator=random) - 15.0
        way = after - at
        if not 8.0 < float(way.norm()) < 25.0:
            continue
        turned = math.atan2(float(way[1]), float(way[0]))
        choice = int(torch.randint(3, (1,), generator=random))
        turned += {"ahead": 0, "astern": 1, "any": choice}[kind] * math.pi
        if kind == "any" and choice == 2:
            turned += 0.5 * math.pi
        heading += math.remainder(turned - heading, 2.0 * math.pi)
        points.append([*(round(float(value), 2) for value in after), round(heading, 4)])
        at = after
    return {"waypoints": points, "interval": 60.0, "frequency": [0.195, 0.195, 0.415]}


MODELS = {
    "plsr": {"fit": {"kind": "plsr"}},
    "surface": {"fit": {"kind": "surface"}},
    "lag_ridge": {"lag": True, "fit": {"kind": "ridge"}},
}
"""Models of the study, as a user lists them."""


def judge_ferry(number: int, random: torch.Generator, folder: Path) -> str:
    """Return the flights of all exported feed-forwards of a drawn ferry on new courses."""
    true = drawn_ferry(folder, random)
    base = yaml.safe_load(CONFIG.read_text())
    content = {key: base[key] for key in ("task", "believed")} | {
        "name": "drawn",
        "true": str(true),
        "loop": base["loop"] | {"step": 0.05, "steps_per_sample": 2},
        "course": drawn_course(random),
        "models": MODELS,
    }
    config = FerryStudyConfig.model_validate(content)
    study = run_ferry_study(config)
    results, _ = write_results(config, study, RunFolder(folder / f"run_{number}"))
    selected = find_best_flown_model(results)
    ferry = config.build_loop(str(true))
    feeds: list[Any] = [(ForceModel(ferry.believed_hull), None)]
    for name in MODELS:
        model = study.whole_course_models.get(name, study.models[name])
        ranges = [(low, high) for low, high in results["models"][name]["exported"]["range"]]
        feeds.append((ExportedFeedForward(model.force, ranges), model.lag))
    paths = [
        config.course.model_validate(drawn_course(random, kind=kind, count=6))
        for kind in ("ahead", "astern", "any")
    ]
    errors = {
        name: sum(flight.tracking_metrics.position_mae for flight in flights if flight) / len(paths)
        for name, flights in zip(
            ["believed", *MODELS], ferry.simulate_courses(paths, feeds), strict=True
        )
    }
    best = min(errors.values())
    withheld = [name for name in MODELS if list_feed_forward_objections(name, results)]
    error_text = ", ".join(f"{name} {error:.4f} m" for name, error in errors.items())
    return (
        f"ferry {number:2d}  {error_text}; selected {selected}"
        f" ({errors[selected] / best:.2f} of the best); smallest residual"
        f" {find_best_model(results)}; withheld: {', '.join(withheld) or 'none'}"
    )


def main() -> None:
    """Print a line for each ferry."""
    given = bench.options(__doc__, ferries=10, seed=0)
    random = torch.Generator().manual_seed(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.ferries):
            print(judge_ferry(number, random, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
