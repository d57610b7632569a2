"""The manoeuvring booklet of a fit: standard manoeuvres of the identified model, with intervals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import ConfigError, DataError
from residnet.core.layout import ROLL_LAYOUT
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES, suggest_name
from residnet.dynamics.ensemble import SampledDynamics
from residnet.evaluation.booklet import BookletConfig, BookletPage, build_booklet
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.actuated import ActuatedDynamics, GivenActuators
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.manoeuvres.indices import identify_zigzag
from residnet.manoeuvres.input_shares import InputShare
from residnet.manoeuvres.trials import (
    ManoeuvreRun,
    SimulatedVessel,
    TrialEnvironment,
    make_manoeuvre_source,
    simulate_manoeuvres,
)
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig
from residnet.preprocessing.prepare import PreparedLog
from residnet.runs.folder import RunFolder

_PARAMETER_PATH = "model.baseline.theta"


def write_booklet(
    folder: RunFolder,
    config: BookletConfig,
    fitted_model: FittedModel,
    logs: Mapping[str, Sequence[PreparedLog]],
    limit: np.ndarray,
) -> str:
    """Simulate the booklet; write booklet.json and booklet.parquet; returns a line for the log.

    Args:
        folder: run folder.
        config: settings of the booklet.
        fitted_model: the refitted baseline.
        logs: prepared logs by split.
        limit: velocities [n] beyond which a simulated run has diverged.

    Raises:
        ResidnetError: if the model cannot perform the manoeuvres, or no interval is available.
    """
    import pandas as pd

    craft = _build_craft(config, fitted_model, config.inputs)
    rudder = config.steering_input()
    pages = [
        _make_page(craft, config, flights, limit)
        for flights in _simulate_draws(craft, config, fitted_model, config.manoeuvres)
    ]
    measured_zigzags = [
        (prepared.log, split)
        for split in config.repeat
        for prepared in logs.get(split, ())
        if prepared.log.manoeuvre == "zigzag"
        and np.isfinite(prepared.log.stack(("psi", rudder))).all()
    ]
    if measured_zigzags:
        shares = _input_shares_from_logs(config, [log for log, _ in measured_zigzags])
        craft = _build_craft(config, fitted_model, shares)
        craft = replace(
            craft,
            initial_state=torch.cat(
                [_initial_state_of_log(craft, log) for log, _ in measured_zigzags]
            ),
        )
        zigzags = [
            _replicate_zigzag(log, rudder, shares, craft.dynamics.dt) for log, _ in measured_zigzags
        ]
        flights_by_zigzag = _simulate_draws(
            craft, config, fitted_model, [gear_zigzag for _, gear_zigzag in zigzags]
        )
        for measured_log, (zigzag, _), flights in zip(
            measured_zigzags, zigzags, flights_by_zigzag, strict=True
        ):
            renamed_flights = [replace(flight, manoeuvre=zigzag) for flight in flights]
            pages.append(_make_page(craft, config, renamed_flights, limit, *measured_log))
    folder.write_record(
        folder.booklet,
        build_booklet(config.model, config.length, config.scale, config.draws, config.level, pages),
    )
    parts = []
    for page in pages:
        motion_by_draw = [(-1, page.measured_log)] if page.measured_log is not None else []
        motion_by_draw += [(i, f.true_log) for i, f in enumerate(page.runs) if page.indices[i]]
        for draw, log in motion_by_draw:
            # trajectories of the draws are stored about every half second
            stride = max(round(0.5 / float(log.t[1] - log.t[0])), 1) if draw > 0 else 1
            columns = {name: log[name][::stride] for name in STATE_NAMES}
            rudder_angle = log[rudder] if rudder in log.channels else log[f"cmd_{rudder}"]
            page_columns = {"page": page.name, "draw": draw, "t": log.t[::stride] - log.t[0]}
            parts.append(
                pd.DataFrame({**page_columns, **columns, "rudder": rudder_angle[::stride]})
            )
    folder.write_table(folder.booklet.with_suffix(".parquet"), pd.concat(parts))
    return (
        f"booklet: {len(config.manoeuvres)} manoeuvres, {len(measured_zigzags)} measured zigzags"
        f" repeated,"
        f" {config.draws} draws each"
    )


def require_flyable(config: BookletConfig, logs: PreparedSplits, settings: FitSettings) -> None:
    """Check that a model has the inputs and states of the booklet, without a simulation.

    Args:
        config: settings of the booklet.
        logs: prepared logs by split.
        settings: settings of the fit, with the parts of a recipe.

    Raises:
        ConfigError: if the model lacks an input or a state of the config.
        UsageError: if the model lacks a state that a manoeuvre needs.
    """
    fitter = Fitter(logs, settings, FitStore(), resolve_recipe=False)
    spec = fitter.build_spec(config.model, "baseline", settings.all_baselines[config.model])
    craft = _build_craft(config, FittedModel(spec, spec.build(), {}), config.inputs)
    make_manoeuvre_source(
        config.manoeuvres, craft.helm, torch.arange(2, dtype=torch.float64) * spec.dt
    )
    for manoeuvre in config.manoeuvres:
        manoeuvre.initial_state(craft.initial_state[0], craft.helm.state)


def _build_craft(
    config: BookletConfig, fitted_model: FittedModel, inputs: Mapping[str, InputShare]
) -> SimulatedVessel:
    """Return the model with its actuators as a simulated vessel; batch rows are draws."""
    spec = fitted_model.spec
    model = fitted_model.model.double()
    gear = GivenActuators(inputs, spec.signals.exogenous, spec.dt)
    actuated = ActuatedDynamics(model, spec.signals.regressor_columns, spec.hold, gear)
    start = actuated.make_initial_state(1)
    for name, value in config.initial.items():
        if name not in actuated.state_names:
            raise ConfigError(
                f"booklet.initial: '{config.model}' has no state"
                f" '{name}'{suggest_name(name, actuated.state_names)}"
            )
        start[:, actuated.state_names.index(name)] = float(value)
    helm = Helm(gear.commands_for_demand, actuated.state_names, gear.input_names)
    return SimulatedVessel(config.model, actuated, helm, gear.n_commands, start)


def _simulate_draws(
    craft: SimulatedVessel,
    config: BookletConfig,
    fitted_model: FittedModel,
    manoeuvres: Sequence[Manoeuvre],
) -> Iterator[list[ManoeuvreRun]]:
    """Yield the simulated runs of each manoeuvre: fitted parameters first, then the draws."""
    parameter_draws = sample_parameters(fitted_model, config.draws, config.seed)
    repeated_manoeuvres = [
        manoeuvre for manoeuvre in manoeuvres for _ in range(len(parameter_draws))
    ]
    start = (
        craft.initial_state.repeat_interleave(len(parameter_draws), 0)
        if len(craft.initial_state) > 1
        else craft.initial_state
    )
    sampled_craft = replace(
        craft,
        dynamics=SampledDynamics(craft.dynamics, _PARAMETER_PATH, parameter_draws),
        initial_state=start,
    )
    sea = TrialEnvironment(None, DisturbanceConfig(), SensorsConfig(), config.seed)
    flights = simulate_manoeuvres(
        sampled_craft, repeated_manoeuvres, sea, config.duration, craft.dynamics.dt
    )
    for first_flight in range(0, len(flights), len(parameter_draws)):
        yield flights[first_flight : first_flight + len(parameter_draws)]


def _initial_state_of_log(craft: SimulatedVessel, log: Log) -> torch.Tensor:
    """Return the initial state [1, nx] of a log, for the states that it contains."""
    x = craft.initial_state[:1].clone()
    for column, name in enumerate(craft.helm.state):
        if name in log.channels and np.isfinite(log[name][0]):
            x[0, column] = float(log[name][0])
    return x


def sample_parameters(fitted_model: FittedModel, draws: int, seed: int) -> torch.Tensor:
    """Return the fitted parameters and `draws` samples of their distribution, [1 + draws, ...]."""
    baseline = fitted_model.model.baseline
    assert isinstance(baseline, ParametricBaseline), "the configuration was validated"
    assert fitted_model.covariance is not None, "the configuration was validated"
    eigenvalues, eigenvectors = torch.linalg.eigh(fitted_model.covariance)
    normal_draws = torch.from_numpy(
        np.random.default_rng([seed, 7]).standard_normal((draws, len(eigenvalues)))
    )
    theta = baseline.theta.detach().double().flatten().repeat(1 + draws, 1)
    theta[1:, baseline.free_indices()] += (
        normal_draws * eigenvalues.clamp(min=0.0).sqrt() @ eigenvectors.T
    )
    return theta.reshape(1 + draws, *baseline.theta.shape)


def _input_shares_from_logs(config: BookletConfig, logs: Sequence[Log]) -> dict[str, InputShare]:
    """Return the input shares; full drive and steer are the largest inputs in the logs."""
    rudder = config.steering_input()
    max_rudder = max(identify_zigzag(log, rudder).angle for log in logs)
    return {
        name: share.model_copy(
            update={"steer": max_rudder, "limit": max_rudder}
            if name == rudder
            else {"drive": max(float(log[name].mean()) for log in logs), "limit": None}
        )
        for name, share in config.inputs.items()
    }


def _replicate_zigzag(
    log: Log, rudder: str, shares: Mapping[str, InputShare], time_step: float
) -> tuple[Zigzag, Zigzag]:
    """Return the zigzag of a log, and the same with the reversals at the measured headings.

    The steering gear of the model reacts immediately, the real one after a delay: the headings at
    which the measured rudder leaves its position are used. Reversals are detected half a step of
    `time_step` seconds late on average, which is corrected.
    """
    steered_indices = identify_zigzag(log, rudder)
    drive_shares = [
        float(log[name].mean()) / float(share.drive)
        for name, share in shares.items()
        if name != rudder
    ]
    zigzag = Zigzag(
        name=log.name,
        drive=min(drive_shares[0], 1.0) if drive_shares else 0.0,
        steer=steered_indices.angle / float(shares[rudder].steer),
        heading=steered_indices.heading,
        first="starboard" if steered_indices.first_sign > 0 else "port",
        start=steered_indices.start,
        duration=float(log.t[-1] - log.t[0]),
    )
    heading = steered_indices.departure_heading - 0.5 * time_step * steered_indices.departure_rate
    return zigzag, zigzag.model_copy(update={"heading": heading})


def is_valid_flight(flight: ManoeuvreRun, limit: np.ndarray) -> bool:
    """Return whether a run ended by its stop condition with all velocities below the limit [n]."""
    motion_states = np.abs(flight.true_log.stack(ROLL_LAYOUT.dynamic_states[: len(limit)]))
    return flight.fault_text is None and bool((motion_states <= limit).all())


def _make_page(
    craft: SimulatedVessel,
    config: BookletConfig,
    flights: Sequence[ManoeuvreRun],
    limit: np.ndarray,
    log: Log | None = None,
    split: str = "",
) -> BookletPage:
    """Return the page of one manoeuvre: indices of all draws and of the repeated log.

    Raises:
        DataError: if the run with fitted parameters does not end, or diverges.
    """
    manoeuvre = flights[0].manoeuvre
    name = flights[0].true_log.name
    if flights[0].fault_text:
        raise DataError(
            f"booklet: {config.model}, {name}: {flights[0].fault_text}; give more"
            " duration, or another model"
        )
    if not is_valid_flight(flights[0], limit):
        raise DataError(
            f"booklet: {config.model}, {name}: the model leaves the range of its training data as"
            " far as a free run that diverges; ask for less rudder or drive, or add logs that"
            " cover them"
        )
    indices = [
        manoeuvre.compute_indices(flight.true_log, None) if is_valid_flight(flight, limit) else {}
        for flight in flights
    ]
    speed = indices[0].get("approach_speed", 0.0) * config.scale**0.5
    criteria = manoeuvre.imo_limits(craft.helm, config.length * config.scale, speed)
    measured_indices = (
        {} if log is None else manoeuvre.compute_indices(log.replace(t=log.t - log.t[0]), None)
    )
    return BookletPage(name, manoeuvre, flights, indices, criteria, log, split, measured_indices)
