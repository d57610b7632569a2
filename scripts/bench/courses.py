"""Plan random courses past buoys: number of correct and rejected plans, simulations along them.

    python scripts/bench/courses.py [--courses 100] [--seed 0] [--protocol sides|enter]
        [--vessel NAME] [--clearance 1] [--current 0] [--fly]

Each plan is checked by its points alone (`find_faults`), without code of the planner; clearances
are radii of circles in turning radii. Plans have a margin for a `--current` in m/s. With `--fly`
the nominal vessel is simulated along a plan in calm water and in 0.3 m/s from a random direction.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from typing import Any

import bench
import numpy as np
import torch
from numpy.typing import NDArray

from residnet.autopilot.courses.config import (
    BuoyConfig,
    BuoyCourseConfig,
    PlannedCourse,
    plan_course,
    smallest_turn,
)
from residnet.autopilot.guidance import CourseGuidance, DriftEstimate, TrackKeeping
from residnet.autopilot.heading.classical import HeadingPD
from residnet.autopilot.heading.controllers import ControlTask
from residnet.autopilot.heading.steering_variation import Vessels
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.tasks.course.execute import simulate_course
from residnet.core.errors import ResidnetError
from residnet.physics.vessel import load_vessel

Array = NDArray[np.float64]
RUDDER = math.radians(5.0)
BUOYS = (6, 10)
"""Smallest and largest number of buoys."""
SPACING = (3.0, 12.0)
"""Smallest and largest distance of successive buoys in turning radii."""


@dataclass(frozen=True)
class DrawnCourse:
    """A course from the origin: buoys [N, 2] and radius in m, sides [N] (+1 to starboard)."""

    buoys: Array
    radius: float
    sides: Array


def draw_course(rng: np.random.Generator, unit: float, radius: float) -> DrawnCourse:
    """Draw a course; the direction to the next buoy is uniform."""
    position = np.zeros(2)
    positions = []
    for _ in range(int(rng.integers(BUOYS[0], BUOYS[1] + 1))):
        direction = rng.uniform(-math.pi, math.pi)
        distance = rng.uniform(*(unit * limit for limit in SPACING))
        position = position + distance * np.array([math.cos(direction), math.sin(direction)])
        positions.append(position)
    return DrawnCourse(np.array(positions), radius, rng.choice([-1.0, 1.0], len(positions)))


def find_passing_samples(track: Array, buoys: Array) -> list[int]:
    """Return the samples at which the buoys are passed: in order, with the least distance sum."""
    distance = np.hypot(*np.moveaxis(track[:, None] - buoys, -1, 0))
    distance_sum = distance[:, 0]
    best_samples = []
    for i in range(1, len(buoys)):
        min_sum = np.minimum.accumulate(distance_sum)
        best_sample = np.maximum.accumulate(
            np.where(distance_sum <= min_sum, np.arange(len(distance_sum)), 0)
        )
        best_samples.append(best_sample)
        distance_sum = distance[:, i] + min_sum
    passing_samples = [int(distance_sum.argmin())]
    for best_sample in reversed(best_samples):
        passing_samples.append(int(best_sample[passing_samples[-1]]))
    return passing_samples[::-1]


def find_faults(track: Array, course: DrawnCourse, protocol: str) -> list[str]:
    """Return the faults of a track [N, 2]: order, side of closest approach, clearance.

    The closest approach on the complete track and the one at the passing sample of the buoy are
    checked. If the track starts in a circle, this circle is checked from the sample at which the
    track, outside of it, approaches it again.
    """
    texts = []
    radius = course.radius
    passing_samples = find_passing_samples(track, course.buoys)
    for i, (place, side) in enumerate(zip(course.buoys, course.sides, strict=True)):
        distance = np.hypot(*(track - place).T)
        if protocol == "enter":
            if distance[passing_samples[i]] > radius:
                texts.append(
                    f"buoy {i + 1} missed by {distance[passing_samples[i]] - radius:.3g} m"
                )
            continue
        first_sample = 0
        if distance[0] < radius:
            outside_samples = np.flatnonzero(distance >= radius)
            first_sample = int(outside_samples[0]) if len(outside_samples) else len(track) - 1
            while (
                first_sample < len(track) - 1
                and distance[first_sample + 1] >= distance[first_sample]
            ):
                first_sample += 1
        if distance[first_sample:].min() < radius:
            texts.append(f"buoy {i + 1} cleared by {distance[first_sample:].min() - radius:.3g} m")
        closest_sample = first_sample + int(distance[first_sample:].argmin())
        for name, sample in (
            ("in its turn", passing_samples[i]),
            ("on the whole course", closest_sample),
        ):
            step = track[min(sample + 1, len(track) - 1)] - track[max(sample - 1, 0)]
            to_buoy = place - track[sample]
            if (step[0] * to_buoy[1] - step[1] * to_buoy[0]) * side <= 0:
                texts.append(f"buoy {i + 1} on the wrong side {name}")
    return texts


class SteeredShip:
    """A vessel for which courses are planned, with its controller and guidance."""

    def __init__(self, vessel: str) -> None:
        self.vessel = SteeredPlant(load_vessel(vessel).build())
        self.turning = self.vessel.estimate_nomoto(RUDDER, 300.0, 0.1)
        scale = self.turning.speed / (self.turning.gain * RUDDER)
        self.dt = 0.05 * max(self.turning.time / 3.94, 1.0)
        self.lookahead = 1.1 * scale if scale < 50 else 0.5 * scale
        any_course = DrawnCourse(np.array([[9.0, 0.0], [18.0, 0.0]]), 1.0, np.ones(2))
        config = self.config(any_course, 0.0)
        self.steady = smallest_turn(config, self.vessel, self.turning, RUDDER)

    def config(self, course: DrawnCourse, current: float) -> BuoyCourseConfig:
        """Return the course as a config of residnet."""
        buoys = tuple(
            BuoyConfig(north=x, east=y, leave_to=side, radius=course.radius)
            for (x, y), side in zip(
                course.buoys.tolist(), np.where(course.sides > 0, "starboard", "port"), strict=True
            )
        )
        return BuoyCourseConfig(
            buoys=buoys,
            acceptance=course.radius,
            lookahead=self.lookahead,
            turning_time=25.0 * self.turning.time,
            current=current,
        )

    def tracks(self, planned: PlannedCourse, currents: np.ndarray) -> list[Any]:
        """Simulate the nominal vessel in steady currents [B, 2] in m/s."""
        turning = self.turning
        vessel = self.vessel
        law = HeadingPD.from_pole_placement(
            vessel.state,
            gain=turning.gain,
            time=turning.time,
            frequency=8.0 / turning.time,
            damping=1.0,
            limit=RUDDER,
        )
        controller = TrackKeeping(law, vessel.state, limit=RUDDER, dt=self.dt, rate=vessel.rate)
        guidance = CourseGuidance(
            planned.course,
            self.lookahead,
            vessel.state,
            DriftEstimate(self.lookahead, 0.25 * turning.speed, self.dt),
        )
        nominal = torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64).expand(len(currents), -1)
        return simulate_course(
            ControlTask(vessel, turning, RUDDER, self.dt),
            controller,
            guidance,
            planned,
            self.lookahead,
            3.0 * planned.course.length / turning.speed,
            Vessels(nominal, torch.from_numpy(currents)),
        )


def evaluate_course(args: argparse.Namespace, ship: SteeredShip, number: int) -> dict[str, Any]:
    """Draw, plan and check the course of a number; simulate it if requested."""
    rng = np.random.default_rng((args.seed, number))
    # a circle with the turning radius must not be enlarged because of a rounding error
    radius = 1.000001 * args.clearance * ship.steady.radius
    course = draw_course(rng, ship.steady.radius, radius)
    row: dict[str, Any] = {"number": number, "buoys": len(course.buoys)}
    config = ship.config(course, args.current)
    start_time = time.process_time()
    try:
        planned = plan_course(config, args.protocol, ship.vessel, ship.turning, RUDDER, ship.steady)
    except ResidnetError as error:
        return {**row, "refused": str(error), "seconds": time.process_time() - start_time}
    row["seconds"] = time.process_time() - start_time
    track = planned.course.track[: int(planned.course.length / planned.course.step) + 2]
    row["faults"] = find_faults(track, course, args.protocol)
    if args.fly:
        direction = rng.uniform(-math.pi, math.pi)
        currents = 0.3 * np.array([[0.0, 0.0], [math.cos(direction), math.sin(direction)]])
        for name, flight in zip(("calm", "current"), ship.tracks(planned, currents), strict=True):
            texts = find_faults(flight.track, course, args.protocol)
            row[name] = texts if flight.finished else [*texts, "not finished"]
    return row


def main() -> None:
    """Print a line for each course with faults, and the totals."""
    args = bench.options(
        __doc__, courses=100, seed=0, protocol="sides", vessel="nomoto_oceanos",
        clearance=1.0, current=0.0, fly=False,
    )  # fmt: skip
    ship = SteeredShip(args.vessel)
    rows = []
    print(f"{args.vessel}: R {ship.steady.radius:.4g} m, K {ship.turning.gain:.4g}/s", end="")
    print(f", T {ship.turning.time:.4g} s, {ship.turning.speed:.3g} m/s", flush=True)
    for number in range(args.courses):
        rows.append(evaluate_course(args, ship, number))
        row = rows[-1]
        if any(row.get(name) for name in ("refused", "faults", "calm", "current")):
            rounded_row = {k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}
            print("  ".join(f"{k} {v}" for k, v in rounded_row.items()), flush=True)
    planned = [row for row in rows if "refused" not in row]
    n_correct = sum(not row["faults"] for row in planned)
    print(f"{len(planned)} of {len(rows)} planned, {n_correct} right")
    seconds = [row["seconds"] for row in rows]
    print(f"time: median {np.median(seconds):.2f} s, worst {max(seconds):.2f} s of one core")
    for name in ("calm", "current") if args.fly else ():
        n_correct = sum(not row[name] for row in planned)
        print(f"{name}: {n_correct} of {len(planned)} flown without a miss")


if __name__ == "__main__":
    main()
