"""Feed-forwards exported from random halves of the ferry's course, outside their range.

    python scripts/bench/feed_forward.py [--halves 10] [--seed 0] [--interval 20]

Half of the segments of the course, drawn at random, identify PLSR and ridge regression of the
residual force (document 002); every other draw also turns the order of the waypoints at random.
Each model is exported with the range of its half. At 20,000 motions, 5,000 each up to 1.2, 3, 10
and 100 times that range, the largest ratio of the commanded to the believed force outside the range
is printed, which may be 1.2, and the largest sway force and yaw moment on straight courses ahead
and astern.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from residnet.core.config import load_config
from residnet.documents.jervan2020.ferry import (
    FerryModelConfig,
    FerryStudyConfig,
    Flown,
    identify,
    record_of,
    study,
)
from residnet.export.feed_forward import ExportedForce, RequiredForce
from residnet.export.torchscript import TorchScriptExporter
from residnet.physics.force_model import ForceModel
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import load_vessel

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


def main() -> None:
    """Print a line for each half and model."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--halves", type=int, default=10, help="random halves")
    parser.add_argument("--seed", type=int, default=0, help="of all draws")
    parser.add_argument("--interval", type=float, default=20.0, help="seconds for each waypoint")
    options = parser.parse_args()
    torch.set_num_threads(1)
    random = torch.Generator().manual_seed(options.seed)
    found = flown(options.interval, random, turned=False)
    for number in range(options.halves):
        if number and number % 2 == 0:
            found = flown(options.interval, random, turned=True)
        for line in judge(found, options.interval, random):
            print(f"half {number:2d}  {line}", flush=True)


if __name__ == "__main__":
    main()
