"""Every exported model and autopilot under bad inputs and memories.

python scripts/bench/bad_inputs.py [--cases 1000] [--seed 0] [RUN ...]

Without a run, a model with each kind of head, a baseline alone, a delay line with a ratio, an
ensemble, autopilots and a course past buoys are exported; with runs, each of their models.
Each case is a short free run in which entries of a state, of inputs or of a memory are replaced by
what is no number, infinite or far off. A line for each tells whether all answers were finite and
flagged, and good samples answered by the model itself. The exit code is 1 where one was not.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from residnet.baselines import BaselineConfig
from residnet.control.courses.course_plan import Course
from residnet.control.guidance.course_guidance import CourseGuidance
from residnet.control.guidance.drift import DriftEstimate
from residnet.control.heading.policies import NetworkPolicy
from residnet.control.heading.turning import Turning
from residnet.core.errors import ResidnetError
from residnet.core.registry import kinds
from residnet.dynamics.ensemble import mean_of
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec, load_model, model_names
from residnet.export import ExportedVessel, exporter
from residnet.export.policy import COURSE, ExportedCourse, for_export
from residnet.heads import HeadConfig, SymbolicConfig
from residnet.heads.delay_line import DelayConfig
from residnet.heads.symbolic import SymbolicHead
from residnet.physics.signals import SignalsConfig
from residnet.testing import check_bad_inputs
from residnet.testing.bad_inputs import check_bad_measurements
from residnet.testing.examples import example_model, example_samples, example_spec

Model = tuple[ModelSpec, HybridDynamics]

# what makes a kind quick, and what it cannot do without
HEADS: dict[str, dict[str, Any]] = {
    "genetic": {"evolution": {"population": 60, "generations": 3}},
    "kernel": {"folds": 2, "penalties": [0.1]},
}
BASELINES: dict[str, tuple[dict[str, Any], str]] = {
    "believed": ({"vessel": "wam_v_cal"}, "wam_v_cal"),
    "equations": ({"u": {"u": -0.4, "tau_x": 0.003}, "r": {"r": -1.0}}, "wam_v_cal"),
    "linear_steady": (
        {"settled": 10, "speed": ["random_steps"], "steering": ["zigzag"]},
        "wam_v_cal",
    ),
    "regressors": ({"terms": ["u", "v", "r", "u|u|", "tau_x", "tau_n"]}, "wam_v_cal"),
    "still": ({}, "wam_v_cal"),
    "mmg": (
        {
            "hull": {"length": 6, "beam": 2, "draught": 0.4, "mass": 1500, "x_G": 0},
            "propeller": {"diameter": 0.3, "x": -0.48, "thrust": [0.29, -0.28, -0.14]},
            "rudder": {"area": 0.1, "aspect": 1.5, "race": 0.6},
        },
        "example_rudder_boat",
    ),
    "nomoto": ({}, "example_rudder_boat"),
    "nomoto_sideslip": ({}, "example_rudder_boat"),
}
FORCE: dict[str, Any] = {"space": "force", "terms": ["u_dot", "r_dot", "u", "v", "r"]}
RUDDER = SignalsConfig(inputs=("n", "delta"))


def main() -> int:
    """Read the options, print a line for each model, return the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("runs", nargs="*", type=Path, metavar="RUN")
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    torch.set_num_threads(1)
    random = np.random.default_rng(options.seed)
    checks = of_runs(options.runs) if options.runs else every_kind(random)
    failed = 0
    for name, check in checks:
        begun = time.perf_counter()
        try:
            check(options.cases, options.seed)
            answer = f"{options.cases} cases: flagged, finite, recovered"
        except AssertionError as error:
            answer = f"FAILED: {error}"
            failed += 1
        except ResidnetError as error:
            answer = f"not exported: {error}"
        print(f"{name:28s} {answer} ({time.perf_counter() - begun:.1f} s)", flush=True)
    return 1 if failed else 0


Check = Callable[[int, int], None]


def every_kind(random: np.random.Generator) -> Iterator[tuple[str, Check]]:
    """Yield a check for each kind of model and controller, by name."""
    for kind in kinds(HeadConfig):
        yield f"head {kind}", lambda cases, seed, kind=kind: vessel(headed(kind), cases, seed)
    for kind in ("mlp", "lstm"):
        yield (
            f"head {kind}, mirrored",
            lambda cases, seed, kind=kind: vessel(headed(kind, mirror=True), cases, seed),
        )
    yield (
        "head ridge, force space",
        lambda cases, seed: vessel(headed("ridge", "believed", **FORCE), cases, seed),
    )
    for kind in kinds(BaselineConfig):
        known = kind if kind in BASELINES else None
        if known is not None:
            yield (
                f"baseline {kind}",
                lambda cases, seed, kind=kind: vessel(based(kind), cases, seed),
            )
    yield "ratio of a delayed input", lambda cases, seed: vessel(delayed(), cases, seed)
    yield "ensemble", lambda cases, seed: vessel(ensemble(), cases, seed)
    for safe in ("hold", "amidships"):
        gain, seconds, speed = 10.0 ** random.uniform([-1.5, 0.0, 0.0], [0.5, 2.0, 1.0])
        turning = Turning(float(gain), float(seconds), float(speed))
        limit = float(np.radians(random.uniform(5.0, 40.0)))
        rate = limit * float(10.0 ** random.uniform(-1.0, 1.0))
        yield (
            f"autopilot, {safe}",
            lambda cases, seed, a=(turning, limit, rate), safe=safe: autopilot(
                policy(*a), safe, cases, seed
            ),
        )
        yield (
            f"course, {safe}",
            lambda cases, seed, a=(turning, limit, rate), safe=safe: course(
                policy(*a), safe, cases, seed
            ),
        )


def of_runs(runs: list[Path]) -> Iterator[tuple[str, Check]]:
    """Yield a check for each vessel model of finished runs."""
    for run in runs:
        for name in model_names(run / "models"):
            yield (
                f"{run.name}/{name}",
                lambda cases, seed, folder=run / "models" / name: vessel(
                    load_model(folder), cases, seed
                ),
            )


def vessel(made: Model, cases: int, seed: int) -> None:
    """Export a model, and check the file."""
    spec, model = made
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.pt"
        exporter("torchscript").export(ExportedVessel(spec, model), file)
        check_bad_inputs(torch.jit.load(str(file)), spec, model, cases=cases, seed=seed)


def described(baseline: dict[str, Any], head: Any, trials: str) -> ModelSpec:
    """Return the description of a model of a vessel's example trials."""
    spec = example_spec(None)
    signals = spec.signals if trials == "wam_v_cal" else RUDDER
    z = example_samples(trials, signals).z
    seen = torch.cat((z[:, :3], z[:, 3 : 3 + len(signals.columns)]), dim=1)
    return ModelSpec.model_validate(
        spec.model_dump(by_alias=True)
        | {
            "signals": signals.model_dump(),
            "baseline": baseline,
            "head": head,
            "low": seen.amin(0).tolist(),
            "high": seen.amax(0).tolist(),
        }
    )


def headed(kind: str, baseline: str = "regressors", **settings: Any) -> Model:
    """Return a fitted model with a head of this kind."""
    known = {"kind": baseline} | BASELINES[baseline][0]
    head = {"kind": kind} | HEADS.get(kind, {}) | settings
    spec = described(known, head, "wam_v_cal")
    return spec, example_model(spec)


def based(kind: str) -> Model:
    """Return a baseline of this kind, identified from its vessel's trials."""
    settings, trials = BASELINES[kind]
    spec = described({"kind": kind} | settings, None, trials)
    model = spec.build().eval()
    spec.baseline.fit(model.baseline, example_samples(trials, spec.signals))
    return spec, model


def delayed() -> Model:
    """Return a model whose residual divides by revolutions of some steps ago."""
    delay = DelayConfig(channels=("n_port",), longest=6)
    head = SymbolicConfig(terms=("u n_port^-1", "v"), delay=delay)
    spec = example_spec(head)
    model, known = spec.build().eval(), example_samples()
    spec.baseline.fit(model.baseline, known)
    part = model.head
    assert isinstance(part, SymbolicHead)
    part.calibrate(known)
    part.features.low[3] = 1.0
    part.line.steps.fill_(4.0)
    part.coefficients.fill_(0.01)
    return spec, model


def ensemble() -> Model:
    """Return the mean of models with and without a memory."""
    pairs = [headed("lstm"), headed("ridge"), delayed()]
    members = tuple(spec for spec, _ in pairs)
    spec = pairs[0][0].model_copy(update={"role": "ensemble", "head": None, "members": members})
    return spec, mean_of([model for _, model in pairs])


def policy(turning: Turning, limit: float, rate: float) -> NetworkPolicy:
    """Return a policy with random weights."""
    torch.manual_seed(0)
    made = NetworkPolicy(
        tuple(COURSE), turning=turning, limit=limit, dt=0.1, rate=rate, units=8
    )
    for weights in made.network.parameters():
        torch.nn.init.normal_(weights, std=0.3)
    return made.eval().requires_grad_(False)


def autopilot(own: NetworkPolicy, safe: Any, cases: int, seed: int) -> None:
    """Check an exported heading policy."""
    module = for_export(own, safe)
    both = torch.jit.script(module)
    # the reference is a heading too
    low, high = (torch.cat((edge, edge[:1])) for edge in (module.low, module.high))
    check_bad_measurements(
        lambda y, s: both.step(y[:, :3], y[:, 3:], s),
        lambda y: both.initial_state(y[:, :3]),
        low,
        high,
        (module.memory_low, module.memory_high),
        own.limit,
        cases=cases,
        seed=seed,
    )


def course(own: NetworkPolicy, safe: Any, cases: int, seed: int) -> None:
    """Check an exported policy with the guidance of a bend."""
    # a turn that a third of the rudder makes
    radius = 3.0 * own.speed / (own.gain * own.limit)
    angle = np.linspace(0.0, 2.0, 1001)
    track = radius * np.stack((np.sin(angle), 1.0 - np.cos(angle)), axis=-1)
    rudder = np.full(len(angle), own.limit / 3.0)
    planned = Course(0.002 * radius, track, angle, angle, rudder, 5.0 * radius)
    sight = 3.0 * own.speed * own.dt + 0.3 * radius
    guidance = CourseGuidance(planned, sight, tuple(COURSE), DriftEstimate(10.0, 0.8, 0.02))
    module = ExportedCourse(own, guidance, safe).eval()
    both = torch.jit.script(module)
    check_bad_measurements(
        lambda y, s: both.step(y, s)[:3],
        both.initial_state,
        module.low,
        module.high,
        (module.memory_low, module.memory_high),
        own.limit,
        cases=cases,
        seed=seed,
    )


if __name__ == "__main__":
    sys.exit(main())
