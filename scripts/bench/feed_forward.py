"""Feed-forwards exported from random halves of the ferry's course, outside their range.

    python scripts/bench/feed_forward.py [--halves 10] [--seed 0] [--interval 20]
    python scripts/bench/feed_forward.py --ferries 10

Half of the segments of the course, drawn at random, identify PLSR and ridge regression of the
residual force (document 002); every other draw also turns the order of the waypoints at random.
Each model is exported with the range of its half. At 20,000 motions, 5,000 each up to 1.2, 3, 10
and 100 times that range, the largest ratio of the commanded to the believed force outside the range
is printed, which may be 1.2, and the largest sway force and yaw moment on straight courses ahead
and astern.

With `--ferries`, so many ferries are drawn, each with a course of its own: every mass and every
damping times 0.5 to 1.5, thrusters of 1.5 to 3 rad/s. A study as a user writes it (`fit: {kind:
plsr}`) identifies the residual. What it exports is flown on two courses that nothing has seen,
ahead and astern, beside the believed model. Printed are position errors, and why one is withheld.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor, nn

from residnet.control.motion import Lag
from residnet.core.config import load_config
from residnet.documents.jervan2020.ferry import (
    FerryModelConfig,
    FerryStudyConfig,
    Flown,
    identify,
    objections,
    record_of,
    study,
    written,
)
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.export.torchscript import TorchScriptExporter
from residnet.physics.force_model import ForceModel
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder

VESSEL = Path(__file__).resolve().parents[2] / "configs/vessels/milliampere.yaml"
CONFIG = Path(__file__).resolve().parents[2] / "configs/studies/jervan2020/operation.yaml"
FITS = {
    "plsr": {"kind": "plsr"},
    "plsr_5": {"kind": "plsr", "order": 5},
    "ridge": {"kind": "ridge"},
}
REACHES = (1.2, 3.0, 10.0, 100.0)
"""How far off the drawn motions are, in half widths of the range; beyond about 3 they are replaced
by the nearest value.
"""


def believed() -> ForceModel:
    """Return the believed hull.

    Raises:
        TypeError: where the vessel has another kind of hull.
    """
    built = load_vessel("milliampere").build()
    if not isinstance(built, HullPlant):
        raise TypeError("milliampere has no hull with a mass matrix")
    return ForceModel(built.hull)


def flown(interval: float, random: torch.Generator, *, turned: bool) -> Flown:
    """Fly the course once with the believed model; `turned`: its waypoints in random order."""
    over = [f"course.interval={interval}", "~crossing"]
    config = load_config(CONFIG, over, FerryStudyConfig)
    if turned:
        points = config.course.waypoints
        order = torch.randperm(len(points), generator=random).tolist()
        course = config.course.model_copy(update={"waypoints": tuple(points[i] for i in order)})
        config = config.model_copy(update={"course": course})
    plain = FerryModelConfig.model_validate({"fit": {"kind": "plsr", "order": 3}})
    return study(config.model_copy(update={"models": {"plain": plain}}))


def judge(found: Flown, interval: float, random: torch.Generator) -> list[str]:
    """Return a line for each model that a random half identifies."""
    record, base, lines = record_of(found.first, interval, None), believed(), []
    folds = torch.unique(record.fold)
    half = folds[torch.randperm(len(folds), generator=random)[: len(folds) // 2]]
    record = replace(record, train=torch.isin(record.fold, half))
    motion = torch.cat((record.nu_dot, record.nu), dim=-1)[record.train]
    low, high = motion.amin(0), motion.amax(0)
    middle, width = (low + high) / 2, (high - low) / 2
    for name, fit in FITS.items():
        model = identify(FerryModelConfig.model_validate({"fit": fit}), record, base)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "feed_forward.pt"
            ranges = list(zip(low.tolist(), high.tolist(), strict=True))
            force = RequiredForce(*model.force.parts(), mirrored=True)
            exported = ExportedForce(name, force, ranges, model.fit.notes.get("lag"))
            TorchScriptExporter().export(exported, file)
            exported = torch.jit.load(str(file))
        far = torch.tensor(REACHES, dtype=torch.float64).repeat_interleave(5000).unsqueeze(-1)
        away = far * (2 * torch.rand(len(far), 6, generator=random, dtype=torch.float64) - 1)
        x = middle + width * away
        tau, outside = exported(x[:, :3], x[:, 3:])
        with torch.no_grad():
            known = base(x[:, :3], x[:, 3:])
        ratio = (tau.abs() / (known.abs() + 1e-9))[outside].amax(0)
        straight = torch.zeros(81, 6, dtype=torch.float64)
        straight[:, 3] = torch.linspace(-2, 2, 81)
        across, _ = exported(straight[:, :3], straight[:, 3:])
        text = " / ".join(f"{float(value):.3f}" for value in ratio)
        lines.append(
            f"{name:7s} {int(outside.sum())} of {len(x)} outside; largest ratio {text};"
            f" straight {float(across[:, 1:].abs().max()):.1e} N, N m"
        )
    return lines


class AsExported(nn.Module):
    """An exported file in the place of the model that a course is flown with."""

    def __init__(self, file: Path) -> None:
        super().__init__()
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
    at, heading = torch.zeros(2), 0.0
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
    found = study(config)
    results, _ = written(config, found, RunFolder(folder / f"run_{number}"))
    against = objections("plsr", results)
    model = found.whole.get("plsr", found.models["plsr"])
    file, base_force = folder / "feed_forward.pt", believed()
    force = RequiredForce(*model.force.parts(), mirrored=True)
    ranges = [(low, high) for low, high in results["models"]["plsr"]["exported"]["range"]]
    TorchScriptExporter().export(ExportedForce("plsr", force, ranges, None), file)
    lag: Lag | None = model.lag
    ferry, told = config.ferry(str(true)), []
    for kind in ("ahead", "astern"):
        path = config.course.model_validate(drawn_course(random, kind=kind, count=6))
        feeds: list[Any] = [(base_force, None), (AsExported(file), lag)]
        known, own = (flight.tracking.row()["position_mae"] for flight in ferry.fly(path, feeds))
        told.append(f"{kind} {known:.4f} -> {own:.4f} m ({own / known:.2f})")
    chosen = f"order {model.fit.notes.get('order')}, {'with' if lag else 'without'} lag"
    state = f"withheld: {'; '.join(against)}" if against else "exported"
    return f"ferry {number:2d}  {chosen}; {', '.join(told)}; {state}"


def main() -> None:
    """Print a line for each half and model, or for each ferry."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--halves", type=int, default=10, help="random halves")
    parser.add_argument("--seed", type=int, default=0, help="of all draws")
    parser.add_argument("--interval", type=float, default=20.0, help="seconds for each waypoint")
    parser.add_argument("--ferries", type=int, default=0, help="drawn ferries instead")
    options = parser.parse_args()
    torch.set_num_threads(1)
    random = torch.Generator().manual_seed(options.seed)
    if options.ferries:
        with tempfile.TemporaryDirectory() as folder:
            for number in range(options.ferries):
                print(judge_ferry(number, random, Path(folder)), flush=True)
        return
    found = flown(options.interval, random, turned=False)
    for number in range(options.halves):
        if number and number % 2 == 0:
            found = flown(options.interval, random, turned=True)
        for line in judge(found, options.interval, random):
            print(f"half {number:2d}  {line}", flush=True)


if __name__ == "__main__":
    main()
