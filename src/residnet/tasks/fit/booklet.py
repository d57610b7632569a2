"""The manoeuvring booklet of a fit: standard manoeuvres of the identified model, with intervals."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from residnet.baselines.base import ParametricBaseline
from residnet.core.errors import ConfigError, DataError
from residnet.core.layout import ROLL_LAYOUT
from residnet.core.log import Log
from residnet.core.names import STATE_NAMES, suggest_name
from residnet.dynamics.ensemble import SampledDynamics
from residnet.evaluation.booklet import (
    BookletConfig,
    BookletPage,
    build_booklet,
    select_scalar_indices,
)
from residnet.identification.fitter import FitStore, FittedModel, Fitter
from residnet.identification.prepared import PreparedSplits
from residnet.identification.settings import FitSettings
from residnet.manoeuvres.actuated import ActuatedDynamics, ConfiguredActuators
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.indices import SteeredZigzag, identify_zigzag
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


def compute_booklet_pages(
    config: BookletConfig,
    fitted_model: FittedModel,
    logs: Mapping[str, Sequence[PreparedLog]],
    limit: np.ndarray,
) -> tuple[list[BookletPage], list[str]]:
    """Simulate the manoeuvring booklet.

    Args:
        config: settings of the manoeuvring booklet.
        fitted_model: the refitted baseline.
        logs: prepared logs by split.
        limit: velocities [n] beyond which a simulated run has diverged.

    Returns:
        The pages, standard manoeuvres first and then repeated trials; and the reasons of those that
        are left out.

    Raises:
        ResidnetError: if the model cannot perform the manoeuvres, or no interval is available.
    """
    craft = build_booklet_vessel(config, fitted_model, config.inputs)
    rudder = config.steering_input()
    pages: list[BookletPage] = []
    remarks: list[str] = []

    def add_page(
        vessel: SimulatedVessel, flights: Sequence[ManoeuvreRun], log: Log | None, split: str
    ) -> None:
        try:
            pages.append(_make_page(vessel, config, flights, limit, log, split))
        except DataError as error:
            if not config.skip_failed:
                raise
            remarks.append(str(error))

    for flights in _simulate_draws(craft, config, fitted_model, config.manoeuvres):
        add_page(craft, flights, None, "")
    measured_trials = _identify_measured_trials(config, logs, rudder, remarks)
    if measured_trials:
        shares = _input_shares_from_trials(config, measured_trials)
        craft = build_booklet_vessel(config, fitted_model, shares)
        craft = replace(
            craft,
            initial_state=torch.cat(
                [_initial_state_of_log(craft, trial.log) for trial in measured_trials]
            ),
        )
        replicas = [_replicate_trial(trial, shares, craft.dynamics.dt) for trial in measured_trials]
        flights_by_trial = _simulate_draws(
            craft, config, fitted_model, [simulated for _, simulated in replicas]
        )
        for trial, (nominal, _), flights in zip(
            measured_trials, replicas, flights_by_trial, strict=True
        ):
            renamed_flights = [replace(flight, manoeuvre=nominal) for flight in flights]
            add_page(craft, renamed_flights, trial.log, trial.split)
    if not pages:
        raise DataError(f"booklet: no manoeuvre can be predicted: {remarks[0]}")
    return pages, remarks


def write_booklet(
    folder: RunFolder,
    config: BookletConfig,
    fitted_model: FittedModel,
    logs: Mapping[str, Sequence[PreparedLog]],
    limit: np.ndarray,
) -> str:
    """Simulate the manoeuvring booklet and write its two files; returns a line for the log.

    Args:
        folder: run folder.
        config: settings of the manoeuvring booklet.
        fitted_model: the refitted baseline.
        logs: prepared logs by split.
        limit: velocities [n] beyond which a simulated run has diverged.

    Raises:
        ResidnetError: if the model cannot perform the manoeuvres, or no interval is available.
    """
    import pandas as pd

    rudder = config.steering_input()
    pages, remarks = compute_booklet_pages(config, fitted_model, logs, limit)
    folder.write_record(
        folder.booklet,
        build_booklet(
            config.model, config.length, config.scale, config.draws, config.level, pages, remarks
        ),
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
        f"booklet: {sum(not page.split for page in pages)} manoeuvres,"
        f" {sum(bool(page.split) for page in pages)} measured trials repeated,"
        f" {config.draws} draws each"
    )


def require_flyable(config: BookletConfig, logs: PreparedSplits, settings: FitSettings) -> None:
    """Check that a model has the inputs and states of the manoeuvring booklet.

    Nothing is simulated.

    Args:
        config: settings of the manoeuvring booklet.
        logs: prepared logs by split.
        settings: settings of the fit, with the parts of a recipe.

    Raises:
        ConfigError: if the model lacks an input or a state of the config.
        UsageError: if the model lacks a state that a manoeuvre needs.
    """
    fitter = Fitter(logs, settings, FitStore(), resolve_recipe=False)
    spec = fitter.build_spec(config.model, "baseline", settings.all_baselines[config.model])
    craft = build_booklet_vessel(config, FittedModel(spec, spec.build(), {}), config.inputs)
    make_manoeuvre_source(
        config.manoeuvres, craft.helm, torch.arange(2, dtype=torch.float64) * spec.dt
    )
    for manoeuvre in config.manoeuvres:
        manoeuvre.initial_state(craft.initial_state[0], craft.helm.state)


def build_booklet_vessel(
    config: BookletConfig, fitted_model: FittedModel, inputs: Mapping[str, InputShare]
) -> SimulatedVessel:
    """Return the model with its actuators as a simulated vessel; batch rows are draws."""
    spec = fitted_model.spec
    model = fitted_model.model.double()
    gear = ConfiguredActuators(inputs, spec.signals.exogenous, spec.dt)
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


class MeasuredTrial(NamedTuple):
    """A measured zigzag or turning circle that the model repeats.

    Attributes:
        log: the log.
        split: its split.
        angle: rudder angle, rad; positive.
        zigzag: parameters of a zigzag; None for a turning circle.
        turn_sign: side of a turning circle, +1 to starboard; of a zigzag that of the first execute.
        start: time of the first helm order in s after the first sample.
        until: change of heading that a turning circle reaches, rad; 0 for a zigzag.
    """

    log: Log
    split: str
    angle: float
    zigzag: SteeredZigzag | None
    turn_sign: float
    start: float
    until: float


_MIN_CIRCLE = 0.5 * math.pi
"""Smallest change of heading of a turning circle that is repeated."""
_MAX_CIRCLE = 3.0 * math.pi
"""Change of heading at which a repeated turning circle ends, as IMO requires."""


def _identify_measured_trials(
    config: BookletConfig,
    logs: Mapping[str, Sequence[PreparedLog]],
    rudder: str,
    remarks: list[str],
) -> list[MeasuredTrial]:
    """Return the zigzags and turning circles of the splits to repeat, zigzags first.

    A trial that cannot be identified is an error, or a remark with `skip_failed`.
    """
    trials: list[MeasuredTrial] = []
    identify_of_kind = {"zigzag": _identify_zigzag_trial, "turning_circle": _identify_circle}
    for kind, identify in identify_of_kind.items():
        for split in config.repeat:
            for prepared in logs.get(split, ()):
                log = prepared.log
                if (
                    log.manoeuvre != kind
                    or rudder not in log.channels
                    or not np.isfinite(log.stack(("psi", rudder))).all()
                ):
                    continue
                try:
                    trials.append(identify(log, split, rudder))
                except DataError as error:
                    # a part of a turning circle has no helm order to repeat
                    if kind == "zigzag" and not config.skip_failed:
                        raise
                    remarks.append(str(error))
    return trials


def _identify_zigzag_trial(log: Log, split: str, rudder: str) -> MeasuredTrial:
    zigzag = identify_zigzag(log, rudder)
    return MeasuredTrial(log, split, zigzag.angle, zigzag, zigzag.first_sign, zigzag.start, 0.0)


def _identify_circle(log: Log, split: str, rudder: str) -> MeasuredTrial:
    """Identify a turning circle: the first helm order, its angle and the change of heading.

    Raises:
        DataError: if the log does not begin before the helm order, or turns too little.
    """
    angle = log[rudder] - np.median(log[rudder][: max(len(log) // 100, 3)])
    held_angle = float(np.median(log[rudder][len(log) // 2 :]))
    is_executed = np.abs(angle) > 0.1 * abs(held_angle)
    first = int(np.argmax(is_executed))
    start = float(log.t[max(first - 1, 0)] - log.t[0])
    turn_sign = float(np.sign(held_angle))
    heading_change = turn_sign * float(log["psi"][-1] - log["psi"][0])
    if not is_executed.any() or first == 0 or heading_change < _MIN_CIRCLE:
        raise DataError(
            f"log {log.name}: no helm order, or a heading change of"
            f" {math.degrees(heading_change):.0f} deg only; a turning circle to repeat needs its"
            " beginning and 90 deg"
        )
    until = min(heading_change, _MAX_CIRCLE)
    return MeasuredTrial(log, split, abs(held_angle), None, turn_sign, start, until)


def _input_shares_from_trials(
    config: BookletConfig, trials: Sequence[MeasuredTrial]
) -> dict[str, InputShare]:
    """Return the input shares; the full commands are the largest inputs in the trials."""
    rudder = config.steering_input()
    max_rudder = max(trial.angle for trial in trials)
    return {
        name: share.model_copy(
            # reversals are those of the measured rudder angle, which contain the dead time
            update={"steer": max_rudder, "limit": max_rudder, "delay": 0.0}
            if name == rudder
            else {"drive": max(float(trial.log[name].mean()) for trial in trials), "limit": None}
        )
        for name, share in config.inputs.items()
    }


def _replicate_trial(
    trial: MeasuredTrial, shares: Mapping[str, InputShare], time_step: float
) -> tuple[Manoeuvre, Manoeuvre]:
    """Return the manoeuvre of a log, and the one that the model performs.

    The steering gear of the model reacts immediately, the real one after a delay: in a zigzag the
    headings at which the measured rudder leaves its position are used. Reversals are detected half
    a step of `time_step` seconds late on average, which is corrected.
    """
    log = trial.log
    drive_shares = [
        float(log[name].mean()) / float(share.drive)
        for name, share in shares.items()
        if share.steer in (0, 0.0) and float(share.drive) != 0.0
    ]
    steer = next(float(share.steer) for share in shares.values() if share.steer not in (0, 0.0))
    drive = min(drive_shares[0], 1.0) if drive_shares else 0.0
    duration = float(log.t[-1] - log.t[0])
    if trial.zigzag is None:
        circle = TurningCircle(
            name=log.name,
            drive=drive,
            steer=trial.turn_sign * trial.angle / steer,
            start=trial.start,
            until=trial.until,
            # a slower model turns longer than the vessel did
            duration=2.0 * duration,
        )
        return circle, circle
    zigzag = Zigzag(
        name=log.name,
        drive=drive,
        steer=trial.angle / steer,
        heading=trial.zigzag.heading,
        first="starboard" if trial.turn_sign > 0 else "port",
        start=trial.start,
        duration=duration,
    )
    departure = trial.zigzag
    heading = departure.departure_heading - 0.5 * time_step * departure.departure_rate
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
        select_scalar_indices(manoeuvre.compute_indices(flight.true_log, None))
        if is_valid_flight(flight, limit)
        else {}
        for flight in flights
    ]
    speed = indices[0].get("approach_speed", 0.0) * config.scale**0.5
    criteria = manoeuvre.imo_limits(craft.helm, config.length * config.scale, speed)
    measured_indices = {}
    if log is not None:
        shifted_log = log.replace(t=log.t - log.t[0])
        measured_indices = select_scalar_indices(manoeuvre.compute_indices(shifted_log, None))
    return BookletPage(name, manoeuvre, flights, indices, criteria, log, split, measured_indices)
