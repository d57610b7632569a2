"""Contracts of heads, baselines, vessels, manoeuvres, readers and export formats.

Each complaint is one line that names the part, what it does, and what it should do.
"""

from __future__ import annotations

import copy
import functools
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from residnet.baselines import BaselineConfig
from residnet.baselines.base import IdentifiedConfig
from residnet.baselines.regressors import RegressorsConfig
from residnet.core.config import Config, validate
from residnet.core.errors import ExportError, ResidnetError, UsageError
from residnet.core.layout import PLANAR, ROLL, SIX
from residnet.core.log import Log
from residnet.core.names import si_unit
from residnet.core.registry import kind_of
from residnet.core.samples import Samples
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.readers.base import LogReader
from residnet.data.simulated import (
    Craft,
    Disturbance,
    Flight,
    Sea,
    SensorNoise,
    SimulatedTrials,
    fly,
    fly_trials,
    source_of,
)
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, RecordedPlantDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.export.base import Exporter
from residnet.export.guard import GuardedDynamics
from residnet.export.torchscript import trace_function
from residnet.export.vessel import ExportedVessel
from residnet.heads import HeadConfig
from residnet.heads.base import ClosedFormHead, FeatureConfig
from residnet.heads.linear import RidgeConfig
from residnet.heads.lstm import LstmConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.physics.signals import SignalsConfig
from residnet.physics.symmetry import live_of
from residnet.physics.vessel import load_vessel

SIGNALS = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").resolved()
"""Inputs of the example models: the revolutions of two propellers, and the forces they make."""

ROLLING = SignalsConfig(inputs=("delta", "cmd_thrust"), velocities=("u", "v", "r", "p"))
"""Inputs of example models of a patrol vessel that rolls."""

SUBMERGED = SignalsConfig(
    inputs=("delta", "delta_s", "n"), velocities=("u", "v", "r", "w", "p", "q")
)
"""Inputs of example models of a torpedo in six degrees of freedom."""

_VESSELS = {PLANAR: "wam_v_cal", ROLL: "patrol_p06_linear", SIX: "remus_100"}

STEP = 0.1
"""Step of the example models in s."""


_DERIVATIVE = {"kind": "savitzky_golay", "window": 1.1, "order": 2}


@functools.cache
def example_samples(
    vessel: str = "", signals: SignalsConfig = SIGNALS, duration: float = 20.0
) -> Samples:
    """Return samples of simulated trials: channels z [N, nz], accelerations [N, n], float64, SI.

    Without arguments these are trials of a catamaran with the channels u, v, r, n_port, n_stbd,
    tau_x, tau_y, tau_n.

    Args:
        vessel: name of the vessel; that catamaran, a patrol vessel for signals with roll, or a
            torpedo for six degrees of freedom.
        signals: what drives the model; channels of the vessel's logs.
        duration: of each manoeuvre in s.
    """
    trials = SimulatedTrials.model_validate(
        {
            "vessel": vessel or _VESSELS[signals.live.layout],
            "step": STEP,
            "substeps": 1,
            "duration": duration,
            "trials": [
                {"kind": "constant", "drive": [0.5, 0.9], "steer": [-0.4, 0.0, 0.4]},
                {"kind": "zigzag", "count": 4, "heading": ["15 deg"], "start": 2.0},
                {
                    "kind": "random_steps",
                    "count": 4,
                    "dive_amplitude": [0.0, 0.4 if signals.live.spatial else 0.0],
                },
            ],
            "identification": {"zigzag": 3},
            "validation": {"zigzag": 1},
            "seed": 4,
        }
    )
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": _DERIVATIVE})
    logs = [flight.log for flight in fly_trials(trials.draw(), trials)]
    prepared = [prepare(log, "train", signals.columns, config, signals.live) for log in logs]
    return samples(prepared, signals.build())


def example_spec(head: FeatureConfig | None, signals: SignalsConfig = SIGNALS) -> ModelSpec:
    """Return the description of a model with an equation as baseline and a head, or none.

    Args:
        head: config of any head.
        signals: inputs, forces and velocities of the model.
    """
    seen = example_samples(signals=signals).z[:, : signals.live.size + len(signals.inputs)]
    forces = ("u", "v", "r", "tau_x", "tau_n")
    return ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "example",
            "role": "baseline" if head is None else "head",
            "signals": signals.model_dump(),
            "baseline": RegressorsConfig(terms=forces if signals.forces else ()).model_dump(),
            "head": None if head is None else head.model_dump(),
            "dt": STEP,
            "integrator": "rk4",
            "low": seen.amin(0).tolist(),
            "high": seen.amax(0).tolist(),
        }
    )


def example_models() -> list[tuple[ModelSpec, HybridDynamics]]:
    """Return fitted models: a baseline alone, one with a memoryless head, one with a memory."""
    heads = (None, RidgeConfig(), LstmConfig(hidden_size=4))
    return [(spec, example_model(spec)) for spec in map(example_spec, heads)]


def example_model(spec: ModelSpec) -> HybridDynamics:
    """Return the model of a description from `example_spec`, its baseline identified.

    A head takes its scales from the example samples; a closed form is fitted on them too.
    """
    torch.manual_seed(0)
    model, known = spec.build(), example_samples(signals=spec.signals)
    spec.baseline.fit(model.baseline, known)
    with torch.no_grad():
        residual = model.head.residual_target(known, model.baseline(known.z))
    model.head.calibrate(residual)
    if isinstance(model.head, ClosedFormHead):
        model.head.solve(residual)
    return model.eval()


_ROWS, _STEPS = 4, 12
_STEP, _SHORT = 0.1, 4
"""Step of flights in s, and rows of one that ended at once."""


def require(condition: bool, message: str) -> None:
    """Stop where a contract is broken.

    Raises:
        AssertionError: with the message, where the condition does not hold.
    """
    if not condition:
        raise AssertionError(message)


def require_equal(found: Tensor, expected: Tensor, tolerance: float, message: str) -> None:
    """Stop where two tensors of one shape differ by more than a share of the larger number.

    Raises:
        AssertionError: with the message and the largest difference.
    """
    require(found.shape == expected.shape, f"{message} (shapes {found.shape}, {expected.shape})")
    if found.numel():
        difference = float((found - expected).abs().max()) / (1.0 + float(expected.abs().max()))
        require(difference <= tolerance, f"{message} (largest difference {difference:.2g})")


def require_finite(values: Tensor, message: str) -> None:
    """Stop where a tensor holds what is no number.

    Raises:
        AssertionError: with the message.
    """
    require(bool(torch.isfinite(values).all()), message)


def _traced(module: nn.Module, examples: tuple[Tensor, ...], who: str) -> Any:
    """Record a module as a TorchScript graph, as training and exports do with a model's step."""
    frozen = copy.deepcopy(module).requires_grad_(False)
    try:
        return trace_function(frozen, examples, who)
    except ExportError as error:
        raise AssertionError(str(error)) from error


def _read_back(config: Config, union: Any, who: str) -> None:
    written = config.model_dump(mode="json")
    try:
        again, known = (validate(written, kind, "written") for kind in (type(config), union))
    except Exception as error:  # also of a validator that the part brings
        raise AssertionError(f"{who}: its config cannot be read back: {error}") from error
    require(again == config, f"{who}: its config changes when it is written and read back")
    require(type(known) is type(config), f"{who}: its name leads to {type(known).__name__} instead")


def check_head(config: FeatureConfig, signals: SignalsConfig = SIGNALS) -> None:
    """Check everything that residnet relies on in a head.

    Shapes and precision, a residual that is not zero, equal answers for equal questions, rows of a
    batch that do not see each other, sequences that equal steps, the memory of a past, TorchScript,
    finite answers far outside of the training range, gradients, and a model that is stored and
    loaded without a change.

    Args:
        config: of the head; it must work with the channels of `example_samples`.
        signals: of the models; those of `examples.ROLLING` move roll too.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who, spec, n = f"head {kind_of(type(config))}", example_spec(config, signals), signals.live.size
    _read_back(config, HeadConfig, who)
    fitted, samples = example_model(spec), example_samples(signals=signals).z
    # what follows changes precision
    model = copy.deepcopy(fitted)
    head = model.head.eval()
    # channels [4, 12, nz] from the middle of the example samples
    begin = torch.arange(_ROWS) * (len(samples) // _ROWS) + 30
    z = samples[begin[:, None] + torch.arange(_STEPS)[None]]

    def empty(rows: int, dtype: torch.dtype) -> Tensor:
        return torch.zeros(rows, head.n_state, dtype=dtype)

    def stepped(module: Any, given: Tensor) -> tuple[Tensor, Tensor]:
        s, residuals = empty(len(given), given.dtype), []
        for k in range(given.shape[1]):
            rho, s = module(given[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1), s

    with torch.no_grad():
        for dtype in (torch.float32, torch.float64):
            first, s = z[:, 0].to(dtype), empty(_ROWS, dtype)
            (rho, after), (again, _) = (head.to(dtype)(first, s) for _ in range(2))
            shapes = {"residual": (rho.shape, n), "memory": (after.shape, head.n_state)}
            for name, (shape, size) in shapes.items():
                wanted = f"[B, {n}]" if name == "residual" else f"[B, n_state = {size}]"
                message = f"{who}: the {name} has the shape {shape}, not {wanted}"
                require(shape == (_ROWS, size), message)
            require(
                rho.dtype == after.dtype == dtype,
                f"{who}: answers {rho.dtype} and {after.dtype} where it is asked in {dtype}",
            )
            require_finite(rho, f"{who}: the residual at a training sample is not finite")
            require(float(rho.abs().max()) > 0, f"{who}: the residual is zero everywhere")
            message = f"{who}: two answers to one question differ; is it in eval?"
            require(torch.equal(rho, again), message)
        residuals, memory = stepped(head, z)
        whole = head.sequence(z)
        require_equal(whole, residuals, 1e-9, f"{who}: sequence differs from steps")
        require_equal(head.warmup(z), memory, 1e-9, f"{who}: warmup differs from the steps' memory")
        message = f"{who}: the memory without a past is not zeros [B, {head.n_state}]"
        require_equal(head.warmup(z[:, :0]), empty(_ROWS, z.dtype), 0.0, message)
        message = f"{who}: the answer for a row depends on the other rows of the batch"
        for i in range(_ROWS):
            alone = z[i : i + 1]
            require_equal(head.sequence(alone), whole[i : i + 1], 1e-9, message)
            require_equal(stepped(head, alone)[0], residuals[i : i + 1], 1e-9, message)
        single = z.float()
        rho, memory = stepped(head.float(), single)
        examples = (single[:, 0], empty(_ROWS, torch.float32))
        traced = head if head.refusal else _traced(head, examples, who)
        same, after = stepped(traced, single)
        require_equal(same, rho, 1e-5, f"{who}: the traced head gives other residuals")
        require_equal(after, memory, 1e-5, f"{who}: the traced head keeps another memory")
        head.double()
        far, further = (samples.mean(0) + times * samples.std(0) for times in (1e6, 1e9))
        rho, memory = head(far[None], empty(1, z.dtype))
        beyond, _ = head(further[None], empty(1, z.dtype))
        held = head.sequence(far.expand(1, 200, -1))
        x = torch.cat((torch.zeros_like(z[:, 0, :3]), z[:, 0, :n]), dim=-1)
        w, s = z[..., n : n + model.signals.inputs], torch.rand(_ROWS, model.n_state).to(z)
        free = Rollout(model.double())
        model.positions = False
        states, _, memory = free(x, w, s)
        for k in range(_STEPS):
            x, s = model.step(x, w[:, k], s)
        message = f"{who}: a free run differs from its steps"
        require_equal(states[:, -1], x, 1e-9, message)
        require_equal(memory, s, 1e-9, f"{message}' memory")
    require_finite(torch.cat((rho, beyond)), f"{who}: not finite far outside of the training range")
    require_finite(memory, f"{who}: its memory is not finite far outside of the training range")
    require_finite(held, f"{who}: not finite after 200 steps outside of the training range")
    inside, largest = float(whole.abs().max()), float(held.abs().max())
    require(
        largest < 50 * inside + 10,
        f"{who}: runs away outside of the training range ({largest:.3g}, inside {inside:.3g});"
        " hold the features at its edge (residnet.heads.base.Features)",
    )
    first = z[:, 0].clone().requires_grad_()
    head(first, empty(_ROWS, z.dtype))[0].sum().backward()
    slope = first.grad
    require(slope is not None, f"{who}: cannot be differentiated with respect to the channels")
    assert slope is not None
    require_finite(slope, f"{who}: its gradient with respect to the channels is not finite")
    require(float(slope.abs().max()) > 0, f"{who}: its gradient is zero everywhere")
    counts, spread = head.parameter_count(), head.residual_std()
    require(
        len(counts) == n and all(count >= 0 for count in counts),
        f"{who}: parameter_count gives {counts}, not one number for each of {n} axes",
    )
    require(
        spread.shape == (n,) and bool((spread > 0).all()),
        f"{who}: residual_std gives {spread.tolist()}, not {n} positive numbers",
    )
    with tempfile.TemporaryDirectory() as folder:
        save_model(Path(folder) / "example", spec, fitted)
        stored_spec, stored = load_model(Path(folder) / "example")
    require(stored_spec == spec, f"{who}: its description changes when it is stored")
    state = fitted.state_dict()
    for name, value in stored.state_dict().items():
        same_number = value.dtype == state[name].dtype and torch.equal(value, state[name])
        require(same_number, f"{who}: '{name}' changes when the model is stored")
    with torch.no_grad():
        kept, given = (part.head.double().eval().sequence(z) for part in (stored, fitted))
    require_equal(kept, given, 0.0, f"{who}: the stored model gives other residuals")


def check_baseline(config: IdentifiedConfig, samples: Samples | None = None) -> None:
    """Check everything that residnet relies on in a baseline.

    It is identified from samples, twice with the same result; its accelerations have the right
    shape and precision, are finite, do not depend on the company of a row, can be differentiated
    and recorded by torch; its numbers survive a state dict, its config a file.

    Args:
        config: of the baseline.
        samples: whose target is the measured acceleration [N, n]; those of a catamaran with two
            propellers (`example_samples`) where None.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"baseline {kind_of(type(config))}"
    known = example_samples() if samples is None else samples
    resolved = config.resolved()
    n = live_of(known.names).size
    baseline, again = (resolved.build(known.names) for _ in range(2))
    table = resolved.fit(baseline, known)
    require(resolved.fit(again, known) == table, f"{who}: two fits give different coefficients")
    z = known.z[:: max(len(known) // 40, 1)]
    with torch.no_grad():
        accelerations = baseline(z)
        require(
            accelerations.shape == (len(z), n),
            f"{who}: the accelerations have the shape {accelerations.shape}, not [N, {n}]",
        )
        require_finite(accelerations, f"{who}: its accelerations are not finite")
        require_equal(again(z), accelerations, 0.0, f"{who}: two fits give different answers")
        together = baseline(z[None].expand(2, -1, -1))
        require_equal(together[1], accelerations, 1e-12, f"{who}: fails for channels [B, T, nz]")
        message = f"{who}: the answer for a row depends on the other rows of the batch"
        require_equal(baseline(z[3:4]), accelerations[3:4], 1e-9, message)
        single = copy.deepcopy(baseline).float()(z.float())
        require(single.dtype == torch.float32, f"{who}: answers {single.dtype} in float32")
        require_equal(single.double(), accelerations, 1e-3, f"{who}: float32 differs too much")
    moving = z.clone().requires_grad_()
    # a baseline that knows nothing may answer with a constant
    (baseline(moving).sum() + 0.0 * moving.sum()).backward()
    gradient = torch.zeros_like(z) if moving.grad is None else moving.grad
    require_finite(gradient, f"{who}: its gradient with respect to the channels is not finite")
    traced = _traced(baseline, (z,), who)
    with torch.no_grad():
        require_equal(traced(z), accelerations, 1e-9, f"{who}: traced, it answers otherwise")
    counts = baseline.parameter_count()
    require(len(counts) == n, f"{who}: parameter_count gives {counts}, not one for each axis")
    empty = resolved.build(known.names)
    empty.load_state_dict(baseline.state_dict())
    with torch.no_grad():
        require_equal(empty(z), accelerations, 0.0, f"{who}: its state dict does not hold it all")
    _read_back(resolved, BaselineConfig, who)


def check_vessel(name: str, step: float = 0.1) -> None:
    """Check that a vessel can be built and stepped.

    Its description is one line, its length positive, its motion under half drive finite, and equal
    for a vessel alone and one of several.

    Args:
        name: of the vessel, or path of its file.
        step: of the simulation in s.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"vessel {name}"
    vessel = load_vessel(name)
    require("\n" not in vessel.description.strip(), f"{who}: its description is not one line")
    require(vessel.length.value > 0, f"{who}: its length is not positive")
    plant = vessel.build()
    require(plant.commands > 0, f"{who}: has no commands")
    dynamics = PlantDynamics(plant, step)
    x = plant.approach(3)
    w = torch.zeros(3, len(plant.inputs), dtype=torch.float64)
    half = torch.full((3,), 0.5, dtype=torch.float64)
    w[:, : plant.commands] = plant.demand(half, 0.2 * half)
    start, memory = x.clone(), dynamics.initial_state(3).to(x.dtype)
    with torch.no_grad():
        for _ in range(100):
            x, memory = dynamics.step(x, w, memory)
        require_finite(x, f"{who}: its motion is not finite")
        first, _ = dynamics.step(start, w, dynamics.initial_state(3).to(x.dtype))
        alone, _ = dynamics.step(start[:1], w[:1], dynamics.initial_state(1).to(x.dtype))
    require_equal(alone, first[:1], 1e-12, f"{who}: moves otherwise beside other vessels")


def check_manoeuvre(
    manoeuvre: Manoeuvre, vessel: str = "wam_v_cal", duration: float = 30.0
) -> Flight:
    """Check everything that residnet relies on in a manoeuvre, and return a flight of it.

    It is written and read back, flown alone and beside another of its kind with equal results, with
    a finite motion; inputs that are not commands pass through it; its indices are asked for, of the
    whole flight and of one that is too short for any.

    Args:
        manoeuvre: what to fly.
        vessel: name of the vessel that flies it.
        duration: in s, where the manoeuvre gives none.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"manoeuvre {kind_of(type(manoeuvre))}"
    read = validate(manoeuvre.model_dump(mode="json"), ManoeuvreConfig, "written")
    require(read == manoeuvre, f"{who}: changes when it is written and read back")
    plant = load_vessel(vessel).build()
    duration = manoeuvre.lasts(duration)
    dynamics = RecordedPlantDynamics(plant, _STEP)
    alone, inputs = _flown([manoeuvre], dynamics, duration)
    pair, commands = _flown([manoeuvre, manoeuvre], dynamics, duration)
    require_finite(alone, f"{who}: the motion is not finite")
    require_finite(inputs, f"{who}: a command is not finite")
    count = dynamics.plant.commands
    require(
        bool((inputs[:, :, count:] == 0.01).all()),
        f"{who}: changes inputs that are no commands, such as wind and current",
    )
    for row in range(2):
        message = f"{who}: flown beside another one it does something else"
        require_equal(pair[row], alone[0], 1e-9, message)
        require_equal(commands[row, :, :count], inputs[0, :, :count], 1e-9, message)
    helm, length = Helm.from_plant(plant), load_vessel(vessel).length.value
    craft = Craft(vessel, dynamics, helm, plant.commands, plant.approach(1))
    sea = Sea(plant, Disturbance(), SensorNoise(), 0)
    flight = fly(craft, [manoeuvre], sea, duration, _STEP)[0]
    _check_indices(manoeuvre.indices(flight.motion, length), who)
    motion = flight.motion
    few = {name: values[:_SHORT] for name, values in motion.channels.items()}
    short = Log(motion.name, motion.t[:_SHORT], few, motion.units)
    _check_indices(manoeuvre.indices(short, None), who)
    limits = manoeuvre.limits(helm, length, 1.0)
    require(all(math.isfinite(limit) for limit in limits.values()), f"{who}: a limit is not finite")
    return flight


def _flown(
    manoeuvres: list[Manoeuvre], dynamics: RecordedPlantDynamics, seconds: float
) -> tuple[Tensor, Tensor]:
    """Return states [B, T+1, nx] and inputs [B, T, m] of manoeuvres of one kind side by side."""
    plant = dynamics.plant
    helm = Helm.from_plant(plant)
    t = torch.arange(max(round(seconds / _STEP), 2), dtype=torch.float64) * _STEP
    start = torch.stack([m.begin(plant.approach(1)[0], helm.state) for m in manoeuvres])
    w = torch.zeros(len(manoeuvres), len(t), len(plant.inputs), dtype=torch.float64)
    w[:, :, plant.commands :] = 0.01
    source = source_of(manoeuvres, helm, t)
    with torch.no_grad():
        states, inputs, _ = Rollout(dynamics, source)(start, w, start[:, :0])
    return states, inputs


def _check_indices(indices: dict[str, Any], who: str) -> None:
    for name, value in indices.items():
        numbers = np.atleast_1d(np.asarray(value))
        require(
            numbers.dtype.kind in "fiub" and bool(np.isfinite(numbers.astype(float)).all()),
            f"{who}: its index '{name}' is {value!r}, not finite numbers; leave it out instead",
        )


def check_reader(config: Config, file: Path) -> Log:
    """Check everything that residnet relies on in a reader, and return the log that it read.

    Time that strictly increases, channels in SI units as float64, a heading without jumps, the
    file's identity, the same log twice, and one-line errors for a file that is missing, a folder,
    an empty file and a damaged one.

    Args:
        config: of the reader.
        file: a recording that the reader can read.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"reader {kind_of(type(config))}"
    reader: LogReader = getattr(config, "build")()  # noqa: B009  readers have no common base
    require(isinstance(reader, LogReader), f"{who}: build gives no LogReader")
    file = Path(file)
    log, again = reader.read(file), reader.read(file)
    require(log.name == file.stem, f"{who}: names the log '{log.name}', not '{file.stem}'")
    require(bool(log.channels), f"{who}: the log has no channels")
    require(log.t.dtype == np.float64, f"{who}: time is {log.t.dtype}, not float64")
    require(log.t.size >= 2, f"{who}: the log has {log.t.size} samples, at least 2 are needed")
    require(bool((np.diff(log.t) > 0).all()), f"{who}: time does not strictly increase")
    for name, values in log.channels.items():
        require(values.dtype == np.float64, f"{who}: {name} is {values.dtype}, not float64")
        unit = log.units[name]
        require(si_unit(unit) == unit, f"{who}: {name} is in {unit}, not in SI units")
    if "psi" in log.channels:
        psi = log["psi"][np.isfinite(log["psi"])]
        require(bool((np.abs(np.diff(psi)) < np.pi).all()), f"{who}: psi jumps by half a circle")
    missing = [key for key in ("source", "sha256") if key not in log.meta]
    require(not missing, f"{who}: the log's meta lacks {', '.join(missing)}")
    require(
        list(log.channels) == list(again.channels)
        and all(
            np.array_equal(values, again.channels[name], equal_nan=True)
            for name, values in log.channels.items()
        ),
        f"{who}: reads the same file twice with different results",
    )
    with tempfile.TemporaryDirectory() as folder:
        _check_refusals(reader, Path(folder), file, who)
    return log


def _check_refusals(reader: LogReader, folder: Path, file: Path, who: str) -> None:
    empty, damaged = (folder / f"{name}{file.suffix}" for name in ("empty", "damaged"))
    empty.write_bytes(b"")
    damaged.write_bytes(np.random.default_rng(0).bytes(4096))
    (folder / "nothing").mkdir()
    cases: list[tuple[Path, str, type[ResidnetError]]] = [
        (folder / f"absent{file.suffix}", "missing", UsageError),
        (folder / "nothing", "an empty folder", ResidnetError),
        (empty, "empty", ResidnetError),
        (damaged, "random bytes", ResidnetError),
    ]
    for path, what, kind in cases:
        try:
            reader.read(path)
        except kind as error:
            text = str(error)
            named = "\n" not in text and str(path) in text
            require(named, f"{who}: its error does not name the file")
        except Exception as error:
            raise AssertionError(
                f"{who}: a file that is {what} raises {type(error).__name__}, not {kind.__name__}"
            ) from error
        else:
            raise AssertionError(f"{who}: reads a file that is {what}")


def check_exporter(exporter: Exporter) -> None:
    """Check everything that residnet relies on in an export format.

    It writes the file that it is given, in a folder that does not exist yet, returns a card, leaves
    the model's numbers as they are, and refuses with one line what it cannot hold.

    Args:
        exporter: the format.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"export format {exporter.name}"
    require(bool(exporter.about) and "\n" not in exporter.about, f"{who}: `about` is not one line")
    require(exporter.suffix.count(".") >= 1, f"{who}: the suffix {exporter.suffix!r} has no ending")
    for spec, model in example_models():
        before = {name: value.clone() for name, value in model.state_dict().items()}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "exports" / f"{spec.name}{exporter.suffix}"
            try:
                card = exporter.export(ExportedVessel(spec, model), file)
            except UsageError as error:
                require("\n" not in str(error), f"{who}: refuses a model in more than one line")
                require(not file.exists(), f"{who}: leaves a file of a model that it refuses")
                continue
            require(file.exists(), f"{who}: writes no {file.name}")
            require(isinstance(card, Mapping) and bool(card), f"{who}: returns no card")
            left = [path.name for path in file.parent.iterdir() if path.name.endswith(".partial")]
            require(not left, f"{who}: leaves {', '.join(left)} behind")
        for name, value in model.state_dict().items():
            wanted = before[name].to(torch.float64)
            message = f"{who}: changes '{name}' of the model"
            require_equal(value.to(torch.float64), wanted, 1e-6, message)


_BEFORE, _AFTER = 6, 8
_BAD_STEP = 3
"""Step of bad values: good ones come before it and after it."""
_FAR = (1e38, -1e38, 1e20, -1e20, 1e9, -1e9, 1e5)
_WRONG = (float("nan"), float("inf"), float("-inf"), *_FAR)
"""Values that stand in the place of an entry; times of the range's edge are drawn as well."""


def check_bad_inputs(
    exported: Any, spec: ModelSpec, model: HybridDynamics, *, cases: int = 200, seed: int = 0
) -> None:
    """Check that an exported model gives a flag and finite numbers, whatever it is given.

    Each case is a short free run in which entries of a state, of inputs or of a memory are replaced
    at one step by what is no number, infinite or far off. All that comes out is finite; what is
    beyond the training range is flagged, and nothing else; what is not flagged is the model's own
    answer; good samples after the bad one are answered as if it had not been.

    Args:
        exported: anything with `initial_state`, `warmup`, `step` and `rollout` that takes and gives
            tensors, as `residnet.export.base` says.
        spec: of the model that was exported.
        model: that model; its precision is changed to float32.
        cases: number of free runs.
        seed: of the cases.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"exported {spec.name}"
    guard = GuardedDynamics(model.float().eval(), spec)
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        first, n = PLANAR.pose_columns.stop, guard.dof
        low, high = guard.ranges.low[first:], guard.ranges.high[first:]
        share = 0.05 + 0.9 * torch.rand(cases, _BEFORE + _AFTER, low.numel(), generator=random)
        seen = low + share * (high - low)
        pose = 40.0 * torch.rand(cases, _BEFORE + _AFTER, 3, generator=random) - 20.0
        y, w = torch.cat((pose, seen[..., :n]), dim=-1), seen[..., n:]
        x, w, past, given = y[:, _BEFORE], w[:, _BEFORE:], y[:, :_BEFORE], w[:, :_BEFORE]
        s = exported.warmup(past, given)
        require_equal(s, model.warmup(past, given), 1e-4, f"{who}: warms up otherwise")
        _check_steps(exported, guard, x, w, s, random, who)
        _check_rollout(exported, x, w, s, random, who)
        _check_histories(exported, past, given, random, who)


def damage(values: Tensor, edge: Tensor, share: float, random: torch.Generator) -> Tensor:
    """Return values [B, k] with a share of the entries replaced, some just beyond the edge [k]."""
    wrong = torch.tensor(_WRONG)[torch.randint(len(_WRONG), values.shape, generator=random)]
    times = 10.0 ** (6.0 * torch.rand(values.shape, generator=random) - 2.0)
    beyond = (edge + edge.abs().clamp(min=1e-3) * times).expand_as(values)
    kind = torch.rand(values.shape, generator=random)
    chosen = torch.rand(values.shape, generator=random) < share
    return torch.where(chosen, torch.where(kind < 0.7, wrong, beyond), values)


def _check_steps(
    exported: Any,
    guard: GuardedDynamics,
    x: Tensor,
    w: Tensor,
    s: Tensor,
    random: torch.Generator,
    who: str,
) -> None:
    """Step freely with one bad sample, then on with good ones."""
    columns = x.shape[1]
    for k in range(w.shape[1]):
        before, inputs, memory = x, w[:, k], s
        if k == _BAD_STEP:
            where = torch.rand(3, len(x), 1, generator=random) < 0.5
            before = torch.where(where[0], damage(x, guard.ranges.high[:columns], 0.4, random), x)
            edge = guard.ranges.high[columns:]
            inputs = torch.where(where[1], damage(inputs, edge, 0.5, random), inputs)
            edge = guard.memory_high
            memory = torch.where(where[2], damage(s, edge, 1.0 / (1 + s.shape[1]), random), s)
        x, s, outside = exported.step(before, inputs, memory)
        _check_answer(guard, (before, inputs, memory), (x, s, outside), f"{who}, step {k}")
        if k == _BAD_STEP:
            # what the controller measures next is good again, and so is what it remembers
            middle = 0.5 * (guard.ranges.low + guard.ranges.high).expand(len(x), -1)
            measured, inputs = middle[:, :columns], middle[:, columns:]
            for kept in (s, exported.initial_state(len(x))):
                answer = exported.step(measured, inputs, kept)
                _check_answer(guard, (measured, inputs, kept), answer, f"{who}, after a bad sample")


def _check_answer(
    guard: GuardedDynamics,
    given: tuple[Tensor, Tensor, Tensor],
    answer: tuple[Tensor, Tensor, Tensor],
    who: str,
) -> None:
    """Check what came out of one step: finite, flagged where it must be, else the model's own."""
    x, w, s = given
    after, memory, outside = answer
    require(outside.dtype == torch.bool, f"{who}: the flag is {outside.dtype}, not bool")
    require(outside.shape == (len(x),), f"{who}: the flag has the shape {outside.shape}, not [B]")
    require_finite(after, f"{who}: a state is not finite")
    require_finite(memory, f"{who}: a memory is not finite")
    seen = torch.cat((x, w), dim=-1)
    inside = ((seen >= guard.ranges.low) & (seen <= guard.ranges.high)).all(dim=-1)
    inside &= guard.remembers(s)
    missed = ~inside & ~outside
    require(not bool(missed.any()), f"{who}: {int(missed.sum())} bad samples are not flagged")
    own, left = guard.model.step(x, w, s)
    sound = (
        inside
        & (own >= guard.ranges.least[:6]).all(dim=-1)
        & (own <= guard.ranges.most[:6]).all(dim=-1)
    )
    false = sound & outside
    require(not bool(false.any()), f"{who}: {int(false.sum())} good samples are flagged")
    require_equal(after[sound], own[sound], 1e-4, f"{who}: a good sample is answered otherwise")
    require_equal(memory[sound], left[sound], 1e-4, f"{who}: a good sample is remembered otherwise")
    expected, kept, _ = guard.flagged_step(x, w, s)
    require_equal(after, expected, 1e-4, f"{who}: a bad sample is answered otherwise than stated")
    require_equal(memory, kept, 1e-4, f"{who}: a bad sample is remembered otherwise than stated")


def _check_rollout(
    exported: Any, x: Tensor, w: Tensor, s: Tensor, random: torch.Generator, who: str
) -> None:
    """Check that a rollout with bad samples is the same as its steps."""
    w = w.clone()
    w[:, _BAD_STEP] = damage(w[:, _BAD_STEP], w.amax((0, 1)), 0.5, random)
    first = damage(x, x.amax(0), 0.1, random)
    states, last, flags = exported.rollout(first, w, s)
    require(
        states.shape == (len(x), w.shape[1] + 1, x.shape[1]) and flags.shape == w.shape[:2],
        f"{who}: a rollout gives the shapes {tuple(states.shape)} and {tuple(flags.shape)}",
    )
    require_finite(states, f"{who}: a rollout gives a state that is not finite")
    after, memory, raised = first, s, []
    for k in range(w.shape[1]):
        after, memory, outside = exported.step(after, w[:, k], memory)
        raised.append(outside)
        message = f"{who}: a rollout differs from its steps at step {k}"
        require_equal(states[:, k + 1], after, 1e-5, message)
    require(
        torch.equal(flags, torch.stack(raised, dim=1)),
        f"{who}: a rollout raises other flags than its steps",
    )
    require_equal(last, memory, 1e-5, f"{who}: a rollout ends with another memory than its steps")


def _check_histories(
    exported: Any, past: Tensor, given: Tensor, random: torch.Generator, who: str
) -> None:
    """Check that bad samples of a history are left out."""
    y, w = past.clone(), given.clone()
    bad = torch.rand(y.shape[:2], generator=random) < 0.4
    y[bad] = torch.nan
    w[bad.roll(1, dims=0)] = torch.inf
    require_finite(exported.warmup(y, w), f"{who}: a history with gaps leaves what is no number")
    empty = exported.initial_state(len(y))
    nothing = exported.warmup(torch.full_like(y, torch.nan), w)
    require_equal(nothing, empty, 0.0, f"{who}: a history without a number leaves a memory")
    held = past.clone()
    held[:, 2], w = held[:, 1], given.clone()
    w[:, 2] = w[:, 1]
    lost = past.clone()
    lost[:, 2, 4] = torch.nan
    require_equal(
        exported.warmup(lost, given),
        exported.warmup(held, w),
        1e-5,
        f"{who}: the last good sample does not stand for a bad one in a history",
    )
