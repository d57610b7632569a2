"""Physical sanity of a model: does it behave like a vessel, within its data and beyond?"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from residnet.core.layout import LATERAL, RANGE_INPUTS, RANGE_VELOCITIES, SURGE, SWAY, VELOCITIES
from residnet.core.names import STATE, VELOCITY
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, load_model, model_names
from residnet.judge.verdict.sanity_points import (
    Mirror,
    OperatingPoint,
    acceleration,
    operating_points,
    settled_memory,
)

DAMPING, STABILITY, SYMMETRY, MASS, BOUNDED = (
    "damping",
    "stability",
    "symmetry",
    "mass matrix",
    "bounded outside",
)
CHECKS = (DAMPING, STABILITY, SYMMETRY, MASS, BOUNDED)

_DOUBLING = 300.0
_ASYMMETRY = 0.1
_LONG_RUN = 300.0


@dataclass(frozen=True)
class Finding:
    """A finding of one check of one model.

    `ok` is None where the check does not apply or could not be made. `fault` says in a few words
    what makes the model unsound, so that it is not selected; it is empty where the finding is only
    reported.
    """

    model: str
    check: str
    ok: bool | None
    text: str
    fault: str = ""


def check_run(run: Path, *, divergence: float = 3.0) -> list[Finding]:
    """Check every model in a run folder's `models`, but `zero`; empty where there are none.

    Raises:
        UsageError: where a model cannot be read.
    """
    out: list[Finding] = []
    threads = torch.get_num_threads()
    # products this small only lose time to a second thread
    torch.set_num_threads(1)
    try:
        for name in model_names(run / "models"):
            spec, model = load_model(run / "models" / name)
            if spec.role != "zero":
                out += check_model(spec, model, divergence=divergence)
    finally:
        torch.set_num_threads(threads)
    return out


def check_model(
    spec: ModelSpec, model: HybridDynamics, *, divergence: float = 3.0
) -> list[Finding]:
    """Return all checks of one model, in the order of `CHECKS`.

    Args:
        spec: its description; the training ranges are taken from it.
        model: with its numbers filled in; it is brought to float64 and evaluation mode.
        divergence: a velocity beyond this many times its largest training value counts as run away.
    """
    model = model.to(torch.float64).eval()
    points = operating_points(spec, model)
    return [
        check_damping(spec, model, points),
        check_stability(spec, model, points),
        check_symmetry(spec, model),
        Finding(
            spec.name, MASS, None, "not applicable: acceleration-space model, it has no mass matrix"
        ),
        check_bounded(spec, model, divergence),
    ]


def check_damping(
    spec: ModelSpec, model: HybridDynamics, points: Sequence[OperatingPoint]
) -> Finding:
    """Check that each velocity decays by itself.

    Slopes d u_dot/du, d v_dot/dv, d r_dot/dr with the memory settled, by autograd.
    """
    chosen = [point for point in points if point.label in ("rest", "cruise")]
    x = torch.stack([point.x for point in chosen]).requires_grad_()
    # a model may depend on no velocity at all
    nu_dot = (
        acceleration(model, x, torch.stack([point.w for point in chosen])) + 0.0 * x[:, VELOCITIES]
    )
    slopes = torch.stack(
        [
            torch.autograd.grad(nu_dot[:, i].sum(), x, retain_graph=True)[0][:, SURGE + i]
            for i in range(3)
        ],
        dim=1,
    )
    # a slope that is small beside the other point's is no damping at all, as of a purely quadratic
    # drag at rest
    largest = slopes.abs().amax(0)
    wrong = (slopes > 0.05 * largest) | (largest == 0)
    parts = []
    for row, point in enumerate(chosen):
        values = ", ".join(
            f"d{name}′/d{name} {float(slopes[row, i]):+.3g}" for i, name in enumerate(VELOCITY)
        )
        parts.append(f"{point.text}: {values} 1/s")
    if not bool(wrong.any()):
        return Finding(
            spec.name, DAMPING, True, "every velocity decays by itself. " + "; ".join(parts)
        )
    which = [
        f"{VELOCITY[i]} at {point.label}"
        for row, point in enumerate(chosen)
        for i in range(3)
        if bool(wrong[row, i])
    ]
    return Finding(
        spec.name,
        DAMPING,
        False,
        f"not damped (wrong sign or none): {', '.join(which)}. " + "; ".join(parts),
    )


def check_stability(
    spec: ModelSpec, model: HybridDynamics, points: Sequence[OperatingPoint]
) -> Finding:
    """Check how small sway-yaw disturbances grow in straight running at several speeds.

    Memory included, from the Jacobian of a step.
    """
    unstable: list[tuple[OperatingPoint, float]] = []
    parts = []
    for point in points:
        rate = growth_rate(model, point)
        if rate > math.log(2.0) / _DOUBLING:
            unstable.append((point, rate))
        if point.label in ("rest", "cruise"):
            parts.append(
                f"{point.text}: slowest mode "
                + (
                    f"halves in {-math.log(2) / rate:.2g} s"
                    if rate < 0
                    else f"has the rate {rate:+.2g} 1/s"
                )
            )
    summary = "; ".join(parts)
    if not unstable:
        reach = f"{points[0].speed:.2g} to {points[-1].speed:.2g} m/s"
        text = (
            f"sway and yaw are stable in straight running at {reach} (no mode doubles within"
            f" {_DOUBLING:.0f} s). {summary}"
        )
        return Finding(spec.name, STABILITY, True, text)
    inside = [(point, rate) for point, rate in unstable if point.inside]
    worst, rate = max(inside or unstable, key=lambda pair: pair[1])
    where = "inside the training data" if inside else "only outside the training data"
    text = (
        f"sway and yaw unstable in straight running, {where}: worst at {worst.text}, a disturbance"
        f" doubles in {math.log(2) / rate:.2g} s. Some full hulls are so in truth; otherwise do not"
        f" trust long free runs there. {summary}"
    )
    return Finding(spec.name, STABILITY, False, text)


def growth_rate(model: HybridDynamics, point: OperatingPoint) -> float:
    """Return the largest growth rate [1/s] of a small disturbance about a point.

    The disturbance is of (v, r, memory); the rate is the log of the step map's spectral radius over
    dt.
    """
    s = settled_memory(model, point.x[None], point.w[None])
    start = torch.cat((point.x[LATERAL], s[0])).detach()
    count = start.numel()
    z = start.expand(count, count).clone().requires_grad_()
    x = torch.cat((point.x[:SWAY].expand(count, SWAY), z[:, :2]), dim=1)
    after, memory = model.step(x, point.w.expand(count, -1), z[:, 2:])
    # one row of the batch for each output: one backward pass gives the whole Jacobian
    out = torch.cat((after[:, LATERAL], memory), dim=1)
    jacobian = torch.autograd.grad(out.diagonal().sum(), z)[0]
    radius = float(torch.linalg.eigvals(jacobian).abs().max())
    return math.log(max(radius, 1e-12)) / model.dt


def check_symmetry(spec: ModelSpec, model: HybridDynamics, *, samples: int = 500) -> Finding:
    """Check that mirrored states and inputs give the mirrored acceleration.

    Sampled over the symmetric part of the training ranges.
    """
    mirror = Mirror.of(spec.signals.columns)
    if mirror is None:
        text = (
            f"not checked: nobody said which input steers (inputs {', '.join(spec.signals.inputs)};"
            " delta and *_port/*_stbd pairs are understood)"
        )
        return Finding(spec.name, SYMMETRY, None, text)
    x, w = mirror.draw(spec, samples)
    with torch.no_grad():
        plain, mirrored = (
            acceleration(model, x, w),
            acceleration(model, mirror.state(x), mirror.inputs(w)),
        )
    sign = torch.tensor([1.0, -1.0, -1.0], dtype=plain.dtype)
    uneven = 0.5 * (plain - sign * mirrored).abs()
    spread = torch.cat((plain, sign * mirrored)).std(0).clamp(min=1e-12)
    typical, largest = uneven.square().mean(0).sqrt() / spread, uneven.amax(0) / spread
    parts = [
        f"{name}′ {100 * float(t):.1f} % (largest {100 * float(m):.1f} %)"
        for name, t, m in zip(VELOCITY, typical, largest, strict=True)
    ]
    ok = bool((typical <= _ASYMMETRY).all())
    word = "alike" if ok else "differ"
    text = (
        f"port and starboard {word}: the uneven part of the acceleration is up to"
        f" {100 * float(typical.max()):.0f} % of its spread. "
    )
    if not ok:
        text += (
            "A single screw, an offset of the steering or too few turns one way may be the reason. "
        )
    return Finding(
        spec.name,
        SYMMETRY,
        ok,
        text + f"RMS over {samples} points in the training box: " + ", ".join(parts),
    )


def check_bounded(spec: ModelSpec, model: HybridDynamics, divergence: float) -> Finding:
    """Check that the motion stays bounded from rest with inputs at the edges of their ranges."""
    corners = _corners(spec)
    x = torch.zeros(len(corners), len(STATE), dtype=torch.float64)
    limit = (
        torch.maximum(
            torch.tensor(spec.low[RANGE_VELOCITIES]).abs(),
            torch.tensor(spec.high[RANGE_VELOCITIES]).abs(),
        )
        .double()
        .clamp(min=1e-9)
    )
    largest, seconds = torch.zeros(len(corners), 3, dtype=torch.float64), 0.0
    s = model.initial_state(len(corners)).double()
    steps, pause = round(_LONG_RUN / model.dt), max(round(10.0 / model.dt), 1)
    before = x[:, VELOCITIES]
    with torch.no_grad():
        for k in range(1, steps + 1):
            x, s = model.step(x, corners, s)
            seconds = k * model.dt
            if k % 20 == 0 or k == steps:
                largest = torch.maximum(largest, x[:, VELOCITIES].abs() / limit)
                if not bool(torch.isfinite(x).all()) or float(largest.max()) > divergence:
                    break
            if k % pause == 0:
                if (
                    not spec.signals.exogenous
                    and float(((x[:, VELOCITIES] - before).abs() / limit).max()) < 1e-5
                ):
                    break  # settled: nothing more will come
                before = x[:, VELOCITIES]
    ratio = torch.nan_to_num(largest, nan=math.inf).amax(1)
    row = int(ratio.argmax())
    inputs = ", ".join(
        f"{name} {float(value):.3g}"
        for name, value in zip(spec.signals.columns, corners[row], strict=True)
    )
    reached = ", ".join(
        f"{name} {float(part):.2f}" for name, part in zip(VELOCITY, largest[row], strict=True)
    )
    if not bool(torch.isfinite(x).all()) or float(largest.max()) > divergence:
        text = (
            f"runs away within {seconds:.0f} s with {inputs} held from rest (more than"
            f" {divergence:g} times the largest training velocity)"
        )
        return Finding(spec.name, BOUNDED, False, text)
    many = len(corners) > 1
    text = (
        f"{len(corners)} run{'s' if many else ''} of {_LONG_RUN:.0f} s from rest with"
        f" inputs held at their extremes stay{'' if many else 's'} bounded; the farthest"
        f" ({inputs or 'no inputs'}) reaches {reached} of the largest training values"
    )
    return Finding(spec.name, BOUNDED, True, text)


def _corners(spec: ModelSpec, most: int = 64) -> Tensor:
    """Inputs [K, m] at the edges of their ranges, every combination or `most` drawn ones.

    A model without inputs has a single run, from rest.
    """
    low, high = (
        torch.tensor(spec.low[RANGE_INPUTS], dtype=torch.float64),
        torch.tensor(spec.high[RANGE_INPUTS], dtype=torch.float64),
    )
    if low.numel() == 0:
        return low.reshape(1, 0)
    pick = (
        torch.cartesian_prod(
            *[torch.tensor([0.0, 1.0], dtype=torch.float64)] * low.numel()
        ).reshape(-1, low.numel())
        if low.numel() <= 6
        else None
    )
    if pick is None:
        pick = torch.randint(
            0, 2, (most, low.numel()), generator=torch.Generator().manual_seed(0)
        ).double()
    return low + pick * (high - low)
