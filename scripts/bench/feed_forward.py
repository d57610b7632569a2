"""Feed-forwards of drawn ferries on courses that nothing has seen, beside the believed model.

    python scripts/bench/feed_forward.py [--ferries 10] [--seed 0]

So many ferries are drawn, each with a course of its own: every mass and every damping times 0.5 to
1.5, thrusters of 1.5 to 3 rad/s. A study as a user writes it (`fit: {kind: plsr}`) identifies the
residual. What it exports is flown on two courses, ahead and astern. Printed are position errors,
and why one is withheld.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import bench
import torch
import yaml
from torch import Tensor, nn

from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.export.torchscript import TorchScriptExporter
from residnet.physics.force_model import ForceModel
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.studies.jervan2020.ferry.config import FerryStudyConfig
from residnet.studies.jervan2020.ferry.execute import (
    list_feed_forward_objections,
    run_ferry_study,
    write_results,
)

VESSEL = bench.CONFIGS / "vessels" / "milliampere.yaml"
CONFIG = bench.CONFIGS / "studies" / "jervan2020" / "operation.yaml"


class AsExported(nn.Module):
    """What is exported of a model, in the place of the model that a course is flown with."""

    def __init__(self, model: Any, ranges: list[list[float]]) -> None:
        super().__init__()
        force = RequiredForce(*model.force.parts(), is_mirrored=True)
        limits = [(low, high) for low, high in ranges]
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "feed_forward.pt"
            TorchScriptExporter().export(ExportedForce("plsr", force, limits, None), file)
            self.exported = torch.jit.load(str(file))

    def at_heading(self, nu_dot: Tensor, nu: Tensor, psi: Tensor) -> Tensor:
        """Return the force [..., 3] at nu_dot and nu [..., 3], at any heading."""
        tau: Tensor = self.exported(nu_dot.reshape(-1, 3), nu.reshape(-1, 3))[0]
        return tau.reshape(nu.shape)


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


def judge_ferry(number: int, random: torch.Generator, folder: Path) -> str:
    """Return what a drawn ferry's exported feed-forward does on courses that nothing has seen."""
    true = drawn_ferry(folder, random)
    base = yaml.safe_load(CONFIG.read_text())
    content = {key: base[key] for key in ("task", "believed")} | {
        "name": "drawn",
        "true": str(true),
        "loop": base["loop"] | {"step": 0.05, "every": 2},
        "course": drawn_course(random),
        "models": {"plsr": {"fit": {"kind": "plsr"}, "fly": True}},
    }
    config = FerryStudyConfig.model_validate(content)
    found = run_ferry_study(config)
    results, _ = write_results(config, found, RunFolder(folder / f"run_{number}"))
    against = list_feed_forward_objections("plsr", results)
    model = found.whole_course_models.get("plsr", found.models["plsr"])
    required = AsExported(model, results["models"]["plsr"]["exported"]["range"])
    hull = load_vessel("milliampere").build()
    assert isinstance(hull, HullPlant)
    ferry = config.build_loop(str(true))
    told = []
    for kind in ("ahead", "astern"):
        path = config.course.model_validate(drawn_course(random, kind=kind, count=6))
        feeds: list[Any] = [(ForceModel(hull.hull), None), (required, model.lag)]
        known, own = (
            flight.tracking_metrics.to_json()["position_mae"]
            for flight in ferry.simulate(path, feeds)
        )
        told.append(f"{kind} {known:.4f} -> {own:.4f} m ({own / known:.2f})")
    chosen = f"order {model.fit.notes.get('order')}, {'with' if model.lag else 'without'} lag"
    state = f"withheld: {'; '.join(against)}" if against else "exported"
    return f"ferry {number:2d}  {chosen}; {', '.join(told)}; {state}"


def main() -> None:
    """Print a line for each ferry."""
    given = bench.options(__doc__, ferries=10, seed=0)
    random = torch.Generator().manual_seed(given.seed)
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.ferries):
            print(judge_ferry(number, random, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
