"""Plans of randomly drawn courses past buoys: which are right, refused or too long, and flights.

    python scripts/bench/courses.py [--courses 100] [--protocol sides|enter] [--vessel NAME] ...

Each plan is judged by `course_checks.faults`, which uses nothing of the planner. For a refused
course random Dubins paths are tried: one that passes the check shows that the refusal is wrong.
With `--sampled` all lengths stand beside that of the shortest of so many such paths; with `--fly`
the nominal vessel flies a plan in calm water and in a current from a random direction.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from course_checks import Drawn, draw, faults, sampled

from residnet.control.courses.config import (
    BuoyConfig,
    BuoyCourseConfig,
    PlannedCourse,
    plan_course,
    smallest_turn,
)
from residnet.control.guidance import CourseGuidance, DriftEstimate, TrackKeeping
from residnet.control.heading.classical import HeadingPD
from residnet.control.heading.controllers import Steering
from residnet.control.heading.vessels import SteeredPlant
from residnet.core.errors import ResidnetError
from residnet.dynamics.steering_variation import Vessels
from residnet.physics.vessel import load_vessel
from residnet.tasks.course_run import fly


def arguments() -> argparse.Namespace:
    """Return the options."""
    parser = argparse.ArgumentParser(description=__doc__)
    add = parser.add_argument
    add("--courses", type=int, default=100)
    add("--protocol", choices=("sides", "enter"), default="sides")
    add("--vessel", default="nomoto_oceanos", help="for example patrol_p06_linear")
    add("--rudder", type=float, default=5.0, help="largest angle in deg")
    add("--radius", type=float, help="turning radius in m as unit; the vessel's own")
    add("--count", type=int, nargs=2, default=(6, 10), help="buoys")
    add("--spacing", type=float, nargs=2, default=(3.0, 12.0), help="in turning radii")
    add("--area", type=float, help="edge of the square that buoys lie in, in turning radii")
    add("--clearance", type=float, default=1.0, help="radius of circles in turning radii")
    add("--sides", choices=("random", "starboard", "port"), default="random")
    add("--current", type=float, default=0.0, help="in m/s, for which the plan keeps a margin")
    add("--seed", type=int, default=0)
    add("--first", type=int, default=0, help="number of the first course")
    add("--sampled", type=int, default=0, help="random paths to compare with")
    add("--search", type=int, default=20000, help="random paths tried for a refused course")
    add("--fly", action="store_true")
    add("--pictures", type=Path, help="folder for a picture of each course")
    add("--worst", type=int, default=0, help="only the pictures of so many worst")
    return parser.parse_args()


class Ship:
    """The vessel that courses are planned for, and how it is steered along them."""

    def __init__(self, args: argparse.Namespace) -> None:
        self.vessel = SteeredPlant(load_vessel(args.vessel).build())
        self.limit = math.radians(args.rudder)
        self.turning = self.vessel.turning(self.limit, 300.0, 0.1)
        self.scale = self.turning.speed / (self.turning.gain * self.limit)
        self.dt = 0.05 * max(self.turning.time / 3.94, 1.0)
        self.lookahead = 1.1 * self.scale if self.scale < 50 else 0.5 * self.scale

    def config(self, course: Drawn, current: float) -> BuoyCourseConfig:
        """Return the course as the package's config."""
        buoys = tuple(
            BuoyConfig(
                north=float(place[0]),
                east=float(place[1]),
                leave_to="starboard" if side > 0 else "port",
                radius=float(radius),
            )
            for place, side, radius in zip(course.buoys, course.sides, course.radii, strict=True)
        )
        extra = {"current": current} if "current" in BuoyCourseConfig.model_fields else {}
        return BuoyCourseConfig(
            buoys=buoys,
            acceptance=float(course.radii[0]),
            lookahead=self.lookahead,
            turning_time=25.0 * self.turning.time,
            **extra,
        )

    def tracks(self, planned: PlannedCourse, currents: np.ndarray) -> list[Any]:
        """Return the flights of the nominal vessel in steady currents [B, 2] in m/s."""
        turning, vessel = self.turning, self.vessel
        law = HeadingPD.placed(
            vessel.state,
            gain=turning.gain,
            time=turning.time,
            frequency=8.0 / turning.time,
            damping=1.0,
            limit=self.limit,
        )
        steered = TrackKeeping(law, vessel.state, limit=self.limit, dt=self.dt, rate=vessel.rate)
        guidance = CourseGuidance(
            planned.course,
            self.lookahead,
            vessel.state,
            DriftEstimate(self.lookahead, 0.25 * turning.speed, self.dt),
        )
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(currents), -1)
        return fly(
            Steering(vessel, turning, self.limit, self.dt),
            steered,
            guidance,
            planned,
            self.lookahead,
            3.0 * planned.course.length / turning.speed,
            Vessels(nominal, torch.from_numpy(currents)),
        )


def picture(file: Path, course: Drawn, tracks: dict[str, np.ndarray], title: str) -> None:
    """Draw the buoys with their circles and sides, and whole tracks."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 7))
    for name, track in tracks.items():
        axes.plot(track[:, 1], track[:, 0], label=name, linewidth=1)
    for i, (place, radius, side) in enumerate(
        zip(course.buoys, course.radii, course.sides, strict=True)
    ):
        axes.add_patch(plt.Circle(place[::-1], radius, fill=False, linestyle=":"))
        axes.annotate(f"{i + 1}{'S' if side > 0 else 'P'}", place[::-1])
    axes.plot(*course.start[::-1], "^k")
    axes.set(aspect="equal", title=title)
    if tracks:
        axes.legend()
    figure.savefig(file, dpi=70)
    plt.close(figure)


def judge(args: argparse.Namespace, ship: Ship, steady: Any, number: int) -> dict[str, Any]:
    """Draw, plan, check and, where asked for, compare and fly the course of one number."""
    rng = np.random.default_rng((args.seed, number))
    unit = args.radius or steady.radius
    # a circle that is as tight as the vessel turns is not widened for a rounding error
    course = draw(
        rng,
        args.count,
        (args.spacing[0] * unit, args.spacing[1] * unit),
        None if args.area is None else args.area * unit,
        1.000001 * args.clearance * unit,
    )
    if args.sides != "random":
        course.sides[:] = 1.0 if args.sides == "starboard" else -1.0
    out: dict[str, Any] = {"number": number, "buoys": len(course.buoys)}
    best = math.inf
    if args.sampled:
        best = sampled(rng, course, args.protocol, steady.radius, args.sampled)
        out["sampled"] = best
    started, cpu = time.time(), time.process_time()
    tracks = {}
    try:
        planned = plan_course(
            ship.config(course, args.current),
            args.protocol,
            ship.vessel,
            ship.turning,
            ship.limit,
            steady,
        )
    except ResidnetError as error:
        out["refused"] = str(error)
    else:
        track = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
        out |= {"length": planned.course.length, "faults": faults(track, course, args.protocol)}
        out["ratio"] = planned.course.length / best if math.isfinite(best) else math.nan
        tracks["plan"] = track
    out |= {"seconds": time.time() - started, "cpu": time.process_time() - cpu}
    if "refused" in out and not args.sampled:
        out["sampled"] = sampled(rng, course, args.protocol, steady.radius, args.search)
    if args.fly and "length" in out:
        towards = rng.uniform(-math.pi, math.pi)
        stream = 0.3 * np.array([[0.0, 0.0], [math.cos(towards), math.sin(towards)]])
        for name, flight in zip(("calm", "current"), ship.tracks(planned, stream), strict=True):
            missed = faults(flight.track, course, args.protocol)
            out[name] = missed if flight.finished else [*missed, "not finished"]
            out[f"{name}_aside"] = float(np.abs(flight.cross_track).max())
            tracks[name] = flight.track
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
        title = f"course {number}: {out.get('refused') or '; '.join(out['faults']) or 'right'}"
        picture(args.pictures / f"{number:04d}.png", course, tracks, title[:90])
    return out


def main() -> None:
    """Print a line for each course that is not right, and the totals."""
    args = arguments()
    torch.set_num_threads(1)
    ship = Ship(args)
    steady = smallest_turn(
        ship.config(draw(np.random.default_rng(0), (2, 2), (9, 9), None, 1.0), 0.0),
        ship.vessel,
        ship.turning,
        ship.limit,
    )
    print(f"{args.vessel}: R {steady.radius:.4g} m, K {ship.turning.gain:.4g}/s", end="")
    print(f", T {ship.turning.time:.4g} s, {ship.turning.speed:.3g} m/s", flush=True)
    rows = []
    for number in range(args.first, args.first + args.courses):
        row = judge(args, ship, steady, number)
        rows.append(row)
        wrong = row.get("faults") or row.get("calm") or row.get("current")
        if "refused" in row or wrong or row.get("ratio", 0) > 1.03:
            shown = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
            print("  ".join(f"{k} {v}" for k, v in shown.items()), flush=True)
    planned = [row for row in rows if "length" in row]
    feasible = [row for row in rows if math.isfinite(row.get("sampled", math.inf))]
    ratio = np.array([row["ratio"] for row in planned if math.isfinite(row["ratio"])])
    print(
        f"{len(planned)} of {len(rows)} planned, {sum(not row['faults'] for row in planned)} right"
    )
    cpu, wall = ([row[name] for row in rows] for name in ("cpu", "seconds"))
    print(f"time: median {np.median(cpu):.2f} s, worst {max(cpu):.2f} s of one core", end="")
    print(f" ({max(wall):.2f} s by the clock)")
    refused = [row for row in rows if "refused" in row]
    overlap = sum("circles overlap" in row["refused"] for row in refused)
    named = sum("exclude each other" in row["refused"] for row in refused)
    wrong = sum(math.isfinite(row["sampled"]) for row in refused)
    print(
        f"{len(refused)} refused: {overlap} whose circles overlap, {named} whose buoys exclude each"
        f" other, {len(refused) - overlap - named} others; sampling finds a path for {wrong}"
    )
    if args.sampled:
        got = sum("length" in row for row in feasible)
        print(f"sampling finds {len(feasible)}; of these {got} are planned", end="")
        if len(ratio):
            print(f", length over the sampled: median {np.median(ratio):.3f}", end="")
            print(f", worst {ratio.max():.3f}; {(ratio > 1.03).sum()} above 1.03")
    for name in ("calm", "current") if args.fly else ():
        right = sum(not row[name] for row in planned)
        aside = max((row[f"{name}_aside"] for row in planned), default=math.nan)
        print(f"{name}: {right} of {len(planned)} flown without a miss; aside {aside:.3g} m")


if __name__ == "__main__":
    main()
