"""Contract checks of heads (residual models), baselines, vessels and other parts.

Every error message is one line with the part, the actual and the expected behaviour.
"""

from __future__ import annotations

import copy
import functools
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from residnet.baselines import BaselineConfig
from residnet.baselines.base import Baseline, ParametricBaseline
from residnet.baselines.config import IdentifiedConfig
from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import Config, validate_config
from residnet.core.errors import ExportError, ResidnetError, UsageError
from residnet.core.external_parts import describe_part_error
from residnet.core.layout import PLANAR_LAYOUT, ROLL_LAYOUT, SIX_DOF_LAYOUT
from residnet.core.log import Log
from residnet.core.names import si_unit, suggest_name
from residnet.core.registry import get_kind
from residnet.core.samples import Samples
from residnet.dynamics.first_step import check_first_step
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.dynamics.store import ModelSpec, load_model, save_model
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout
from residnet.export.torchscript import trace_function
from residnet.heads import HeadConfig
from residnet.heads.base import ClosedFormHead, ResidualHead
from residnet.heads.config import BaseHeadConfig
from residnet.heads.linear import RidgeConfig
from residnet.heads.lstm_config import LstmConfig
from residnet.io.readers.base import LogReader
from residnet.manoeuvres import ManoeuvreConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.trials import (
    ManoeuvreRun,
    SimulatedVessel,
    TrialEnvironment,
    make_manoeuvre_source,
    simulate_manoeuvres,
    simulate_trials,
)
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig, SimulatedTrials
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.symmetry import get_dof
from residnet.physics.vessel import load_vessel
from residnet.preprocessing.prepare import PrepareConfig, prepare_log
from residnet.preprocessing.samples import make_samples

EXAMPLE_SIGNALS = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal").with_thrusters()
"""Signals of the example models: revolutions of two propellers and their forces."""

ROLLING_SIGNALS = SignalsConfig(inputs=("delta", "cmd_thrust"), velocities=("u", "v", "r", "p"))
"""Signals of example models of a patrol vessel with roll."""

SUBMERGED_SIGNALS = SignalsConfig(
    inputs=("delta", "delta_s", "n"), velocities=("u", "v", "r", "w", "p", "q")
)
"""Signals of example models of a torpedo-shaped vehicle in six degrees of freedom."""

_VESSEL_OF_LAYOUT = {
    PLANAR_LAYOUT: "wam_v_cal",
    ROLL_LAYOUT: "patrol_p06_linear",
    SIX_DOF_LAYOUT: "remus_100",
}

EXAMPLE_TIME_STEP = 0.1
"""Time step of the example models in s."""


_DERIVATIVE_SETTINGS = {"kind": "savitzky_golay", "window": 1.1, "order": 2}
"""Derivative of the example samples: parabolas over 11 samples."""


@functools.cache
def make_example_samples(
    vessel: str = "", signals: SignalsConfig = EXAMPLE_SIGNALS, duration: float = 20.0
) -> Samples:
    """Simulate trials and return samples: channels z [N, nz], accelerations [N, n], float64, SI.

    The default vessel is a catamaran with the channels u, v, r, n_port, n_stbd, tau_x, tau_y,
    tau_n.

    Args:
        vessel: name of the vessel. If empty, a catamaran, a patrol vessel for signals with roll, or
            a torpedo-shaped vehicle for six degrees of freedom.
        signals: inputs of the model, which are channels of the logs of the vessel.
        duration: duration of each manoeuvre in s.

    Raises:
        ConfigError: if the vessel does not exist.
        UsageError: if its logs lack an input of `signals`.
    """
    trial_settings = validate_config(
        {
            "vessel": vessel or _VESSEL_OF_LAYOUT[signals.dof.layout],
            "step": EXAMPLE_TIME_STEP,
            "substeps": 1,
            "duration": duration,
            "trials": [
                {"kind": "constant", "drive": [0.5, 0.9], "steer": [-0.4, 0.0, 0.4]},
                {"kind": "zigzag", "count": 4, "heading": ["15 deg"], "start": 2.0},
                {
                    "kind": "random_steps",
                    "count": 4,
                    "dive_amplitude": [0.0, 0.4 if signals.dof.is_six_dof else 0.0],
                },
            ],
            "identification": {"zigzag": 3},
            "validation": {"zigzag": 1},
            "seed": 4,
        },
        SimulatedTrials,
        "make_example_samples",
    )
    config = PrepareConfig.model_validate(
        {"grid": {"step": EXAMPLE_TIME_STEP}, "derivative": _DERIVATIVE_SETTINGS}
    )
    logs = [
        manoeuvre_run.measured_log
        for manoeuvre_run in simulate_trials(trial_settings.draw_manoeuvres(), trial_settings)
    ]
    available_channels = list(logs[0].channels)
    for name in signals.inputs:
        if name not in available_channels:
            raise UsageError(
                f"make_example_samples: the logs of the vessel '{trial_settings.vessel}' have no"
                f" input '{name}'{suggest_name(name, available_channels)}; choose another vessel or"
                " SignalsConfig(inputs=...)"
            )
    prepared = [
        prepare_log(log, "train", signals.input_columns, config, signals.dof) for log in logs
    ]
    return make_samples(prepared, signals.build())


def make_example_spec(
    head: BaseHeadConfig | None, signals: SignalsConfig = EXAMPLE_SIGNALS
) -> ModelSpec:
    """Return the specification of a model with a regression baseline and a head.

    Args:
        head: config of any head; None for the baseline only.
        signals: inputs, forces and velocities of the model.
    """
    example_channels = make_example_samples(signals=signals).z[
        :, : signals.dof.n_dynamic + len(signals.inputs)
    ]
    baseline_terms = ("u", "v", "r", "tau_x", "tau_n")
    return ModelSpec.model_validate(
        {
            "schema": "residnet.model/1",
            "name": "example",
            "role": "baseline" if head is None else "head",
            "signals": signals.model_dump(),
            "baseline": RegressorsConfig(
                terms=baseline_terms if signals.forces else ()
            ).model_dump(),
            "head": None if head is None else head.model_dump(),
            "dt": EXAMPLE_TIME_STEP,
            "integrator": "rk4",
            "low": example_channels.amin(0).tolist(),
            "high": example_channels.amax(0).tolist(),
        }
    )


def make_example_models() -> list[tuple[ModelSpec, HybridDynamics]]:
    """Return fitted models: a baseline, one with a memoryless head, one with a recurrent head."""
    heads = (None, RidgeConfig(), LstmConfig(hidden_size=4))
    return [(spec, make_example_model(spec)) for spec in map(make_example_spec, heads)]


def make_example_model(spec: ModelSpec) -> HybridDynamics:
    """Build the model of a specification of `make_example_spec` and identify its baseline.

    The head is calibrated on the example samples; a closed-form head is fitted to them. A second
    call with an equal specification returns a copy of the first model. It also sets the random
    state of PyTorch to that after the first call, so that results do not depend on the cache.
    """
    key = (type(spec.baseline), type(spec.head), spec.model_dump_json())
    if key not in _EXAMPLE_MODELS:
        model = _identify_example_model(spec)
        _EXAMPLE_MODELS[key] = model, torch.get_rng_state()
    model, random_state = _EXAMPLE_MODELS[key]
    torch.set_rng_state(random_state)
    return copy.deepcopy(model)


_EXAMPLE_MODELS: dict[tuple[type, type, str], tuple[HybridDynamics, Tensor]] = {}
"""Example models by types and content of their specification, with the random state after each.

Heads that search for terms take seconds to fit, and a contract needs the same model several times.
"""


def _identify_example_model(spec: ModelSpec) -> HybridDynamics:
    """Build the model of a specification and identify it from the example samples."""
    torch.manual_seed(0)
    model = spec.build()
    training_samples = make_example_samples(signals=spec.signals)
    spec.baseline.fit_preferred(model.baseline, training_samples)
    with torch.no_grad():
        residual_samples = model.head.residual_samples(
            training_samples, model.baseline(training_samples.z)
        )
    model.head.calibrate(residual_samples)
    if isinstance(model.head, ClosedFormHead):
        model.head.fit_preferred(residual_samples)
    return model.eval()


_N_ROWS = 4
"""Batch size of the contract checks."""
_N_STEPS = 12
"""Number of time steps of the contract checks."""
_MANOEUVRE_TIME_STEP = 0.1
"""Time step of simulated manoeuvres in s."""
_SHORT_SAMPLES = 4
"""Number of samples of a truncated log, on which no index of a manoeuvre is defined."""


def assert_true(condition: bool, message: str) -> None:
    """Check a condition.

    Raises:
        AssertionError: if the condition is false.
    """
    if not condition:
        raise AssertionError(message)


def assert_close(actual: Tensor, expected: Tensor, tolerance: float, message: str) -> None:
    """Check that two tensors agree within a relative tolerance.

    The largest difference is divided by one plus the largest expected magnitude.

    Raises:
        AssertionError: if they differ by more, with the largest difference.
    """
    assert_true(
        actual.shape == expected.shape, f"{message} (shapes {actual.shape}, {expected.shape})"
    )
    if actual.numel():
        difference = float((actual - expected).abs().max()) / (1.0 + float(expected.abs().max()))
        assert_true(difference <= tolerance, f"{message} (largest difference {difference:.2g})")


def assert_finite(values: Tensor, message: str) -> None:
    """Check that all elements of a tensor are finite.

    Raises:
        AssertionError: if an element is infinite or NaN.
    """
    assert_true(bool(torch.isfinite(values).all()), message)


def _trace_module(module: nn.Module, examples: tuple[Tensor, ...], subject: str) -> Any:
    """Trace a module to a TorchScript graph, as training and exports do with the step."""
    frozen = copy.deepcopy(module).requires_grad_(False)
    try:
        return trace_function(frozen, examples, subject)
    except ExportError as error:
        raise AssertionError(str(error)) from error


def _check_round_trip(config: Config, config_union: Any, subject: str) -> None:
    serialised = config.model_dump(mode="json")
    try:
        reloaded, from_union = (
            validate_config(serialised, config_type, "written")
            for config_type in (type(config), config_union)
        )
    except Exception as error:  # validators of a third-party part may raise any error
        raise AssertionError(f"{subject}: its config cannot be read again: {error}") from error
    assert_true(
        reloaded == config, f"{subject}: its config changes when it is written and read back"
    )
    assert_true(
        type(from_union) is type(config),
        f"{subject}: its kind selects {type(from_union).__name__} instead",
    )


def _check_first_step(
    config: BaseHeadConfig | IdentifiedConfig, names: Sequence[str], subject: str
) -> None:
    """Check that a part can be built and that one step returns the expected types and shapes."""
    try:
        check_first_step(config, names)
    except ResidnetError as error:
        message = str(error)
        is_named = message.replace("'", "").startswith(subject)
        named_message = message if is_named else f"{subject}: {message}"
        hint = (
            "; check it with `samples` or `signals` that have its channels"
            if "needs the channel" in message
            else ""
        )
        raise AssertionError(f"{named_message}{hint}") from error


def check_head(config: BaseHeadConfig, signals: SignalsConfig = EXAMPLE_SIGNALS) -> None:
    """Check the contracts of a residual head.

    The checks cover shapes and dtypes, a nonzero residual, deterministic results, independence of
    the rows of a batch, equality of sequences and steps, the memory after a warm-up, tracing,
    finite results far outside the training range, gradients, and storing and loading of a model.

    Args:
        config: config of the head, which must support the channels of `make_example_samples`.
        signals: signals of the example models, for example `ROLLING_SIGNALS` for models with roll.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"head {get_kind(type(config))}"
    _check_first_step(config, signals.channel_names(), subject)
    # an example model with this head, fitted and stored below
    spec = make_example_spec(config, signals)
    _check_round_trip(config, HeadConfig, subject)
    fitted_model = make_example_model(spec)
    samples = make_example_samples(signals=signals).z
    _check_head_config(config, fitted_model.head, signals.channel_names(), subject)
    # a copy, since the checks change the precision; the original is stored and compared below
    model = copy.deepcopy(fitted_model)
    # rows from different manoeuvres, and not from rest at their starts
    start_rows = torch.arange(_N_ROWS) * (len(samples) // _N_ROWS) + 30
    z = samples[start_rows[:, None] + torch.arange(_N_STEPS)[None]]
    case = _HeadCase(subject, model.head.eval(), z, signals.dof.n_dynamic)
    with torch.no_grad():
        _check_single_steps(case)
        max_inside = _check_sequences(case)
        _check_traced_steps(case)
        # tracing was in single precision; the comparison with the model needs double precision
        case.head.double()
        _check_extrapolation(case, samples, max_inside)
        _check_free_run(case, model)
    _check_gradient(case)
    _check_reported_values(case)
    _check_storage(case, spec, fitted_model)


@dataclass(frozen=True)
class _HeadCase:
    """A fitted head and the example channels of its checks.

    Attributes:
        subject: name of the head in messages.
        head: the head in eval mode.
        z: sequences of channels [_N_ROWS, _N_STEPS, nz].
        n_dynamic: number of velocities of the model.
    """

    subject: str
    head: ResidualHead
    z: Tensor
    n_dynamic: int

    def zero_memory(self, n_rows: int, dtype: torch.dtype) -> Tensor:
        """Return the memory without a past."""
        return torch.zeros(n_rows, self.head.n_state, dtype=dtype)

    def run_steps(self, module: Any, channel_steps: Tensor) -> tuple[Tensor, Tensor]:
        """Call a head step by step; returns the residuals and the last memory."""
        s = self.zero_memory(len(channel_steps), channel_steps.dtype)
        residuals = []
        for k in range(channel_steps.shape[1]):
            rho, s = module(channel_steps[:, k], s)
            residuals.append(rho)
        return torch.stack(residuals, dim=1), s


def _check_single_steps(case: _HeadCase) -> None:
    """Check shape, dtype and determinism of a step in both precisions."""
    subject = case.subject
    for dtype in (torch.float32, torch.float64):
        first_channels = case.z[:, 0].to(dtype)
        s = case.zero_memory(_N_ROWS, dtype)
        (rho, next_memory), (repeated, _) = (
            case.head.to(dtype)(first_channels, s) for _ in range(2)
        )
        shapes = {
            "residual": (rho.shape, case.n_dynamic),
            "memory": (next_memory.shape, case.head.n_state),
        }
        for name, (shape, n_columns) in shapes.items():
            expected_shape = (
                f"[B, {case.n_dynamic}]" if name == "residual" else f"[B, n_state = {n_columns}]"
            )
            message = f"{subject}: the {name} has the shape {shape}, not {expected_shape}"
            assert_true(shape == (_N_ROWS, n_columns), message)
        assert_true(
            rho.dtype == next_memory.dtype == dtype,
            f"{subject}: returns {rho.dtype} and {next_memory.dtype} for inputs in {dtype}",
        )
        assert_finite(rho, f"{subject}: the residual at a training sample is not finite")
        assert_true(float(rho.abs().max()) > 0, f"{subject}: the residual is zero everywhere")
        message = f"{subject}: two calls with equal inputs differ; is dropout active in eval mode?"
        assert_true(torch.equal(rho, repeated), message)


def _check_sequences(case: _HeadCase) -> float:
    """Check that sequences, warm-up and rows of a batch agree with single steps.

    Returns:
        The largest residual at the training samples.
    """
    subject = case.subject
    head = case.head
    z = case.z
    residuals, memory = case.run_steps(head, z)
    sequence_residuals = head.teacher_forced_residuals(z)
    assert_close(sequence_residuals, residuals, 1e-9, f"{subject}: sequence differs from steps")
    assert_close(head.warmup(z), memory, 1e-9, f"{subject}: warmup differs from the steps' memory")
    message = f"{subject}: the memory without a past is not zeros [B, {head.n_state}]"
    assert_close(head.warmup(z[:, :0]), case.zero_memory(_N_ROWS, z.dtype), 0.0, message)
    message = f"{subject}: the residual of a row depends on the other rows of the batch"
    for i in range(_N_ROWS):
        row = z[i : i + 1]
        row_sequence_residuals = head.teacher_forced_residuals(row)
        assert_close(row_sequence_residuals, sequence_residuals[i : i + 1], 1e-9, message)
        assert_close(case.run_steps(head, row)[0], residuals[i : i + 1], 1e-9, message)
    return float(sequence_residuals.abs().max())


def _check_traced_steps(case: _HeadCase) -> None:
    """Check that the traced head agrees with the module; the head is in float32 afterwards."""
    subject = case.subject
    z = case.z.float()
    residuals, memory = case.run_steps(case.head.float(), z)
    examples = (z[:, 0], case.zero_memory(_N_ROWS, torch.float32))
    traced = case.head if case.head.export_error else _trace_module(case.head, examples, subject)
    traced_residuals, traced_memory = case.run_steps(traced, z)
    assert_close(
        traced_residuals, residuals, 1e-5, f"{subject}: the traced head gives other residuals"
    )
    assert_close(traced_memory, memory, 1e-5, f"{subject}: the traced head returns another memory")


def _check_extrapolation(case: _HeadCase, samples: Tensor, max_inside: float) -> None:
    """Check that residuals and memory are bounded far outside the training range.

    Args:
        case: the head.
        samples: training samples of the channels [N, nz].
        max_inside: largest residual at training samples.
    """
    subject = case.subject
    head = case.head
    far_channels, farther_channels = (
        samples.mean(0) + std_multiple * samples.std(0) for std_multiple in (1e6, 1e9)
    )
    rho, memory = head(far_channels[None], case.zero_memory(1, samples.dtype))
    farther_residual, _ = head(farther_channels[None], case.zero_memory(1, samples.dtype))
    far_sequence = head.teacher_forced_residuals(far_channels.expand(1, 200, -1))
    assert_finite(
        torch.cat((rho, farther_residual)), f"{subject}: not finite far outside the training range"
    )
    assert_finite(memory, f"{subject}: its memory is not finite far outside the training range")
    assert_finite(far_sequence, f"{subject}: not finite after 200 steps outside the training range")
    max_outside = float(far_sequence.abs().max())
    # a linear head without clamped features would be larger by a factor of 1e6
    assert_true(
        max_outside < 50 * max_inside + 10,
        f"{subject}: diverges outside the training range ({max_outside:.3g}, inside"
        f" {max_inside:.3g}); clamp the features (residnet.heads.base.Features)",
    )


def _check_free_run(case: _HeadCase, model: HybridDynamics) -> None:
    """Check that a rollout agrees with single steps of the model."""
    z = case.z
    x = torch.cat((torch.zeros_like(z[:, 0, :3]), z[:, 0, : case.n_dynamic]), dim=-1)
    w = z[..., case.n_dynamic : case.n_dynamic + model.signals.n_inputs]
    s = torch.rand(_N_ROWS, model.n_state).to(z)
    rollout = Rollout(model.double())
    # the head does not depend on the position, whose integration would only take time
    model.has_position = False
    states, _, memory = rollout(x, w, s)
    for k in range(_N_STEPS):
        x, s = model.step(x, w[:, k], s)
    message = f"{case.subject}: a free run differs from its steps"
    assert_close(states[:, -1], x, 1e-9, message)
    assert_close(memory, s, 1e-9, f"{message}' memory")


def _check_gradient(case: _HeadCase) -> None:
    """Check that the residual has a finite, nonzero gradient with respect to the channels."""
    subject = case.subject
    channels = case.z[:, 0].clone().requires_grad_()
    case.head(channels, case.zero_memory(_N_ROWS, channels.dtype))[0].sum().backward()
    gradient = channels.grad
    assert_true(
        gradient is not None, f"{subject}: cannot be differentiated with respect to the channels"
    )
    assert gradient is not None
    assert_finite(gradient, f"{subject}: its gradient with respect to the channels is not finite")
    assert_true(float(gradient.abs().max()) > 0, f"{subject}: its gradient is zero everywhere")


def _check_reported_values(case: _HeadCase) -> None:
    """Check the values that losses and reports read: numbers of parameters and scales."""
    parameter_counts = case.head.parameter_counts()
    residual_std = case.head.residual_scale()
    assert_true(
        len(parameter_counts) == case.n_dynamic and all(count >= 0 for count in parameter_counts),
        f"{case.subject}: parameter_counts returns {parameter_counts}, expected"
        f" {case.n_dynamic} numbers",
    )
    assert_true(
        residual_std.shape == (case.n_dynamic,) and bool((residual_std > 0).all()),
        f"{case.subject}: residual_scale returns {residual_std.tolist()}, expected"
        f" {case.n_dynamic} positive numbers",
    )


def _check_storage(case: _HeadCase, spec: ModelSpec, fitted_model: HybridDynamics) -> None:
    """Check that a stored model has the same description, state and residuals."""
    subject = case.subject
    with tempfile.TemporaryDirectory() as folder:
        save_model(Path(folder) / "example", spec, fitted_model)
        stored_spec, stored = load_model(Path(folder) / "example")
    assert_true(stored_spec == spec, f"{subject}: its description changes when it is stored")
    fitted_state = fitted_model.state_dict()
    for name, value in stored.state_dict().items():
        is_unchanged = value.dtype == fitted_state[name].dtype and torch.equal(
            value, fitted_state[name]
        )
        assert_true(is_unchanged, f"{subject}: '{name}' changes when the model is stored")
    with torch.no_grad():
        stored_residuals, fitted_residuals = (
            evaluated_model.head.double().eval().teacher_forced_residuals(case.z)
            for evaluated_model in (stored, fitted_model)
        )
    message = f"{subject}: the stored model gives other residuals"
    assert_close(stored_residuals, fitted_residuals, 0.0, message)


def _check_head_config(
    config: BaseHeadConfig, head: ResidualHead, names: Sequence[str], subject: str
) -> None:
    """Check that the properties of a config, known without PyTorch, match its head."""
    config.check_channels(names)
    assert_true(
        config.has_closed_form(names) == isinstance(head, ClosedFormHead),
        f"{subject}: has_closed_form of its config differs from the head",
    )
    assert_true(
        config.has_innovations(names) == (head.has_encoder or head.innovation_time_constant > 0.0),
        f"{subject}: has_innovations of its config differs from the head",
    )


def check_baseline(config: IdentifiedConfig, samples: Samples | None = None) -> None:
    """Check the contracts of a baseline.

    The checks cover reproducible identification, shape, dtype and finiteness of the accelerations,
    independence of the rows of a batch, gradients, tracing, and storing of state and config.

    Args:
        config: config of the baseline.
        samples: samples whose target is the measured acceleration [N, n]; None for the example
            samples.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"baseline {get_kind(type(config))}"
    training_samples = make_example_samples() if samples is None else samples
    resolved = config.without_file_references()
    _check_first_step(resolved, training_samples.names, subject)
    n_dynamic = get_dof(training_samples.names).n_dynamic
    # two fits: a random start or an order of a set would give different coefficients
    baseline, refitted = (resolved.build(training_samples.names) for _ in range(2))
    _check_baseline_config(resolved, baseline, training_samples, subject)
    table = resolved.fit_preferred(baseline, training_samples)
    assert_true(
        resolved.fit_preferred(refitted, training_samples) == table,
        f"{subject}: two fits give different coefficients",
    )
    z = training_samples.z[:: max(len(training_samples) // 40, 1)]
    with torch.no_grad():
        accelerations = baseline(z)
        assert_true(
            accelerations.shape == (len(z), n_dynamic),
            f"{subject}: the accelerations have the shape {accelerations.shape},"
            f" expected [N, {n_dynamic}]",
        )
        assert_finite(accelerations, f"{subject}: its accelerations are not finite")
        assert_close(refitted(z), accelerations, 0.0, f"{subject}: two fits give different results")
        batched = baseline(z[None].expand(2, -1, -1))
        assert_close(batched[1], accelerations, 1e-12, f"{subject}: fails for channels [B, T, nz]")
        # the tolerance allows for different summation orders of matrix products with other batch
        # sizes
        message = f"{subject}: the answer for a row depends on the other rows of the batch"
        assert_close(baseline(z[3:4]), accelerations[3:4], 1e-9, message)
        single_precision = copy.deepcopy(baseline).float()(z.float())
        assert_true(
            single_precision.dtype == torch.float32,
            f"{subject}: returns {single_precision.dtype} for float32",
        )
        assert_close(
            single_precision.double(), accelerations, 1e-3, f"{subject}: float32 differs too much"
        )
    differentiable = z.clone().requires_grad_()
    # autograd needs a dependence on the channels, which a constant baseline does not have
    (baseline(differentiable).sum() + 0.0 * differentiable.sum()).backward()
    gradient = torch.zeros_like(z) if differentiable.grad is None else differentiable.grad
    assert_finite(gradient, f"{subject}: its gradient with respect to the channels is not finite")
    traced = _trace_module(baseline, (z,), subject)
    with torch.no_grad():
        assert_close(traced(z), accelerations, 1e-9, f"{subject}: the traced baseline differs")
    parameter_counts = baseline.parameter_counts()
    assert_true(
        len(parameter_counts) == n_dynamic,
        f"{subject}: parameter_counts returns {parameter_counts}, expected one per axis",
    )
    unfitted = resolved.build(training_samples.names)
    unfitted.load_state_dict(baseline.state_dict())
    with torch.no_grad():
        assert_close(unfitted(z), accelerations, 0.0, f"{subject}: its state dict is incomplete")
    _check_round_trip(resolved, BaselineConfig, subject)


def _check_baseline_config(
    config: IdentifiedConfig, baseline: Baseline, samples: Samples, subject: str
) -> None:
    """Check that the properties of a config, known without PyTorch, match its baseline."""
    names = samples.names
    config.check_channels(names)
    config.validate_samples(samples.origins)
    stated_and_actual = {
        "is_parametric": (
            config.is_parametric(names),
            isinstance(baseline, ParametricBaseline),
        ),
        "has_regressors": (config.has_regressors(names), isinstance(baseline, RegressorBaseline)),
        "has_inertia_matrix": (
            config.has_inertia_matrix(names),
            baseline.inertia_matrix() is not None,
        ),
    }
    for method, (stated, actual) in stated_and_actual.items():
        assert_true(
            stated == actual, f"{subject}: {method} of its config differs from the baseline"
        )


def check_vessel(name: str, time_step: float = 0.1) -> None:
    """Check the contracts of a vessel file.

    The description is one line, the length is positive, and the simulated motion at half of the
    full propulsion command is finite and does not depend on other rows of the batch.

    Args:
        name: name of the vessel, or path of its file.
        time_step: time step of the simulation in s.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"vessel {name}"
    vessel = load_vessel(name)
    assert_true(
        "\n" not in vessel.description.strip(), f"{subject}: its description is not one line"
    )
    assert_true(vessel.length.value > 0, f"{subject}: its length is not positive")
    vessel.check_parameters()
    channels = vessel.plant_channels()
    plant = vessel.build()
    assert_true(
        channels.state_names == plant.state_names and channels.input_names == plant.input_names,
        f"{subject}: plant_channels differs from the plant",
    )
    assert_true(plant.n_commands > 0, f"{subject}: has no commands")
    dynamics = PlantDynamics(plant, time_step)
    x = plant.make_initial_state(3)
    w = torch.zeros(3, len(plant.input_names), dtype=torch.float64)
    half_drive = torch.full((3,), 0.5, dtype=torch.float64)
    w[:, : plant.n_commands] = plant.commands_for_demand(half_drive, 0.2 * half_drive)
    initial_state = x.clone()
    memory = dynamics.initial_state(3).to(x.dtype)
    with torch.inference_mode():
        for _ in range(100):
            x, memory = dynamics.step(x, w, memory)
        assert_finite(x, f"{subject}: its motion is not finite")
        next_states, _ = dynamics.step(initial_state, w, dynamics.initial_state(3).to(x.dtype))
        next_state, _ = dynamics.step(
            initial_state[:1], w[:1], dynamics.initial_state(1).to(x.dtype)
        )
    assert_close(
        next_state,
        next_states[:1],
        1e-12,
        f"{subject}: its motion depends on the other rows of the batch",
    )


def check_manoeuvre(
    manoeuvre: Manoeuvre, vessel: str = "wam_v_cal", duration: float = 30.0
) -> ManoeuvreRun:
    """Check the contracts of a manoeuvre and return a simulation of it.

    The checks cover storing of the config, a finite motion that does not depend on other rows of
    the batch, unchanged exogenous inputs, and indices of a complete and of a truncated log.

    Args:
        manoeuvre: the manoeuvre.
        vessel: name of the simulated vessel.
        duration: duration in s if the manoeuvre does not define it.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"manoeuvre {get_kind(type(manoeuvre))}"
    reloaded = validate_config(manoeuvre.model_dump(mode="json"), ManoeuvreConfig, "written")
    assert_true(reloaded == manoeuvre, f"{subject}: changes when it is written and read back")
    plant = load_vessel(vessel).build()
    duration = manoeuvre.duration_within(duration)
    dynamics = RecordedPlantDynamics(plant, _MANOEUVRE_TIME_STEP)
    single_states, inputs = _simulate([manoeuvre], dynamics, duration)
    paired_states, commands = _simulate([manoeuvre, manoeuvre], dynamics, duration)
    assert_finite(single_states, f"{subject}: the motion is not finite")
    assert_finite(inputs, f"{subject}: a command is not finite")
    n_commands = dynamics.plant.n_commands
    assert_true(
        bool((inputs[:, :, n_commands:] == 0.01).all()),
        f"{subject}: changes exogenous inputs, such as wind and current",
    )
    for row in range(2):
        message = f"{subject}: its motion depends on the other rows of the batch"
        assert_close(paired_states[row], single_states[0], 1e-9, message)
        assert_close(commands[row, :, :n_commands], inputs[0, :, :n_commands], 1e-9, message)
    helm = Helm.from_plant(plant)
    length = load_vessel(vessel).length.value
    simulated_vessel = SimulatedVessel(
        vessel, dynamics, helm, plant.n_commands, plant.make_initial_state(1)
    )
    environment = TrialEnvironment(plant, DisturbanceConfig(), SensorsConfig(), 0)
    manoeuvre_run = simulate_manoeuvres(
        simulated_vessel, [manoeuvre], environment, duration, _MANOEUVRE_TIME_STEP
    )[0]
    _check_indices(manoeuvre.compute_indices(manoeuvre_run.true_log, length), subject)
    motion = manoeuvre_run.true_log
    # a recording may end before a manoeuvre: indices must then be omitted instead of NaN
    short_channels = {name: values[:_SHORT_SAMPLES] for name, values in motion.channels.items()}
    short_log = Log(motion.name, motion.t[:_SHORT_SAMPLES], short_channels, motion.units)
    _check_indices(manoeuvre.compute_indices(short_log, None), subject)
    manoeuvre_limits = manoeuvre.imo_limits(helm, length, 1.0)
    assert_true(
        all(math.isfinite(limit) for limit in manoeuvre_limits.values()),
        f"{subject}: a limit is not finite",
    )
    return manoeuvre_run


def _simulate(
    manoeuvres: list[Manoeuvre], dynamics: RecordedPlantDynamics, duration: float
) -> tuple[Tensor, Tensor]:
    """Simulate a batch of manoeuvres; return states [B, T+1, nx] and inputs [B, T, m]."""
    plant = dynamics.plant
    helm = Helm.from_plant(plant)
    t = (
        torch.arange(max(round(duration / _MANOEUVRE_TIME_STEP), 2), dtype=torch.float64)
        * _MANOEUVRE_TIME_STEP
    )
    initial_states = torch.stack(
        [
            manoeuvre.initial_state(plant.make_initial_state(1)[0], helm.state)
            for manoeuvre in manoeuvres
        ]
    )
    w = torch.zeros(len(manoeuvres), len(t), len(plant.input_names), dtype=torch.float64)
    # a nonzero value shows whether the manoeuvre overwrites exogenous inputs
    w[:, :, plant.n_commands :] = 0.01
    source = make_manoeuvre_source(manoeuvres, helm, t)
    with torch.no_grad():
        states, inputs, _ = Rollout(dynamics, source)(initial_states, w, initial_states[:, :0])
    return states, inputs


def _check_indices(indices: dict[str, Any], subject: str) -> None:
    for name, value in indices.items():
        index_values = np.atleast_1d(np.asarray(value))
        assert_true(
            index_values.dtype.kind in "fiub"
            and bool(np.isfinite(index_values.astype(float)).all()),
            f"{subject}: its index '{name}' is {value!r}, not finite; omit it instead",
        )


def check_reader(config: Config, file: Path) -> Log:
    """Check the contracts of a reader and return the log that it reads.

    The checks cover strictly increasing time, float64 channels in SI units, an unwrapped heading,
    the provenance of the file, reproducible results, and one-line errors for a missing file, a
    folder, an empty file and a corrupt file.

    Args:
        config: config of the reader.
        file: a recording in the format of the reader.

    Raises:
        AssertionError: if a contract is violated; the message names it in one line.
    """
    subject = f"reader {get_kind(type(config))}"
    reader: LogReader = getattr(config, "build")()  # noqa: B009  readers have no common base
    assert_true(isinstance(reader, LogReader), f"{subject}: build does not return a LogReader")
    file = Path(file)
    try:
        log = reader.read(file)
        reread = reader.read(file)
    except ResidnetError as error:
        raise AssertionError(f"{subject}: cannot read the file ({error})") from error
    except Exception as error:  # the code of a user may raise anything
        place = describe_part_error(error, type(reader), "read")
        raise AssertionError(f"{subject}: {place}") from error
    assert_true(
        isinstance(log, Log), f"{subject}: read returned {type(log).__name__}, expected a Log"
    )
    assert_true(log.name == file.stem, f"{subject}: names the log '{log.name}', not '{file.stem}'")
    assert_true(bool(log.channels), f"{subject}: the log has no channels")
    assert_true(log.t.dtype == np.float64, f"{subject}: time is {log.t.dtype}, not float64")
    assert_true(
        log.t.size >= 2, f"{subject}: the log has {log.t.size} samples, at least 2 are needed"
    )
    assert_true(bool((np.diff(log.t) > 0).all()), f"{subject}: time does not strictly increase")
    for name, values in log.channels.items():
        assert_true(values.dtype == np.float64, f"{subject}: {name} is {values.dtype}, not float64")
        unit = log.units[name]
        assert_true(si_unit(unit) == unit, f"{subject}: {name} is in {unit}, not in SI units")
    if "psi" in log.channels:
        psi = log["psi"][np.isfinite(log["psi"])]
        assert_true(
            bool((np.abs(np.diff(psi)) < np.pi).all()),
            f"{subject}: psi jumps by more than 180 deg; unwrap it",
        )
    missing = [key for key in ("source", "sha256") if key not in log.meta]
    assert_true(not missing, f"{subject}: the log's meta lacks {', '.join(missing)}")
    assert_true(
        list(log.channels) == list(reread.channels)
        and all(
            np.array_equal(values, reread.channels[name], equal_nan=True)
            for name, values in log.channels.items()
        ),
        f"{subject}: reads the same file twice with different results",
    )
    with tempfile.TemporaryDirectory() as folder:
        _check_error_messages(reader, Path(folder), file, subject)
    return log


def _check_error_messages(reader: LogReader, folder: Path, file: Path, subject: str) -> None:
    empty_file, damaged_file = (folder / f"{name}{file.suffix}" for name in ("empty", "damaged"))
    empty_file.write_bytes(b"")
    # a fixed seed, so that a failure can be repeated
    damaged_file.write_bytes(np.random.default_rng(0).bytes(4096))
    (folder / "nothing").mkdir()
    cases: list[tuple[Path, str, type[ResidnetError]]] = [
        (folder / f"absent{file.suffix}", "missing", UsageError),
        (folder / "nothing", "an empty folder", ResidnetError),
        (empty_file, "empty", ResidnetError),
        (damaged_file, "random bytes", ResidnetError),
    ]
    for path, description, error_type in cases:
        try:
            reader.read(path)
        except error_type as error:
            message = str(error)
            is_file_named = "\n" not in message and str(path) in message
            assert_true(is_file_named, f"{subject}: its error does not name the file")
        except Exception as error:
            helper = "require_file" if error_type is UsageError else "wrap_read_errors"
            raise AssertionError(
                f"{subject}: a file that is {description} raises {type(error).__name__},"
                f" expected {error_type.__name__}; use {helper} of residnet.io.readers.base"
            ) from error
        else:
            raise AssertionError(f"{subject}: reads a file that is {description}")
