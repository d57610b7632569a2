"""Carry out the task `simulate`: sea trials as canonical logs, and their manoeuvring indices."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from residnet.core.errors import ConfigError
from residnet.core.files import make_file_stem
from residnet.core.progress import log_message
from residnet.dynamics.store import load_model
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.evaluation.booklet import build_index_rows, build_indices_file
from residnet.manoeuvres.actuated import ActuatedDynamics, ConfiguredActuators, PlantActuators
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.trials import (
    ManoeuvreRun,
    SimulatedVessel,
    TrialEnvironment,
    build_plant,
    build_trial_vessel,
    make_manoeuvre_source,
    simulate_manoeuvres,
    simulate_trials,
)
from residnet.manoeuvres.trials_config import (
    check_simulated_vessel,
)
from residnet.physics.vessel import load_vessel
from residnet.report.figure_files import write_figures
from residnet.report.sections.manoeuvres import indices_text, trial_figures
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, TaskOutcome
from residnet.tasks.simulate.config import DEFAULT_TIME_STEP

if TYPE_CHECKING:
    from residnet.tasks.simulate.config import ModelChoice, Programme, SimulateConfig

_MAX_SHOWN_ROWS = 24
"""Maximum number of manoeuvres whose indices are shown on the terminal."""


def execute(config: SimulateConfig, folder: RunFolder) -> TaskOutcome:
    """Simulate the manoeuvres, and write logs, indices and figures.

    A manoeuvre that does not reach its stop condition is a failure if the config lists it; a
    randomly drawn one is only reported.

    Raises:
        UsageError: if the vessel or model cannot perform the manoeuvres.
    """
    programme = config.programme
    if programme is not None:
        if programme.model is not None and programme.disturbance.waves is not None:
            log_message(
                f"model '{programme.model.model_folder.name}' has no input for wave loads; it is"
                " simulated in calm water"
            )
        flights_by_craft = [
            (craft, simulate_all(programme, craft, sea)) for craft, sea in build_crafts(programme)
        ]
        length = programme.hull_length
        n_listed = len(programme.manoeuvres)
        crafts = zip(("logs", "model_logs"), flights_by_craft, strict=False)
        flights_by_folder = [
            (subfolder, flight) for subfolder, (_, flights) in crafts for flight in flights
        ]
    else:
        assert config.data is not None
        manoeuvres = config.data.draw_manoeuvres()
        flights_by_craft = [
            (build_trial_vessel(config.data), simulate_trials(manoeuvres, config.data))
        ]
        length = load_vessel(config.data.vessel).length.value
        n_listed = 0
        flights_by_split = zip(
            config.data.assign_splits(manoeuvres), flights_by_craft[0][1], strict=True
        )
        flights_by_folder = [(f"logs/{split}", flight) for split, flight in flights_by_split]
    for subfolder, flight in flights_by_folder:
        flight.measured_log.save(
            folder.path / subfolder / f"{make_file_stem(flight.measured_log.name)}.parquet"
        )
    rows = [
        row
        for craft, flights in flights_by_craft
        for row in build_index_rows(craft, flights, length)
    ]
    indices = build_indices_file(config.name, length, rows)
    folder.write_record(folder.indices, indices)
    figures = trial_figures({craft.name: flights for craft, flights in flights_by_craft})
    write_figures(folder.figures, figures)
    n_flights = len(flights_by_folder)
    faulty_rows = [row for row in rows if row.fault]
    completion_text = (
        f"{len(faulty_rows)} of {n_flights} manoeuvres were NOT completed"
        if faulty_rows
        else f"All {n_flights} manoeuvres were completed"
    )
    verdict = [
        f"{completion_text} by {' and '.join(craft.name for craft, _ in flights_by_craft)}; the"
        " logs are in the folder logs."
    ]
    verdict += [f"{row.craft}, {row.log}: {row.fault}." for row in faulty_rows[:5]]
    fault_messages = [
        (f"{craft.name}, {flight.measured_log.name}: {flight.fault_text}", number < n_listed)
        for craft, flights in flights_by_craft
        for number, flight in enumerate(flights)
        if flight.fault_text
    ]
    for line, _ in fault_messages:
        log_message(line)
    failures = [line for line, is_listed in fault_messages if is_listed]
    failure_message = failures and (
        f"{failures[-1]} ({len(failures)} of {n_flights} runs were not completed;"
        " increase their duration, drive or steer)"
    )
    return TaskOutcome(
        verdict,
        {
            "logs": SummaryMetric(n_flights),
            "flights_with_a_fault": SummaryMetric(len(faulty_rows)),
        },
        indices_text(indices) if len(rows) <= _MAX_SHOWN_ROWS else "",
        failure_message or "",
    )


def check_programme(config: SimulateConfig) -> None:
    """Build vessel, model and all manoeuvres without a simulation.

    Raises:
        ResidnetError: if one of them cannot be built.
    """
    programme = config.programme
    assert programme is not None
    times = torch.arange(2, dtype=torch.float64) * (programme.step or DEFAULT_TIME_STEP)
    for craft, _ in build_crafts(programme):
        make_manoeuvre_source(programme.loaded_manoeuvres, craft.helm, times)
        for manoeuvre in programme.loaded_manoeuvres:
            manoeuvre.initial_state(craft.initial_state[0], craft.helm.state)


def build_crafts(programme: Programme) -> list[tuple[SimulatedVessel, TrialEnvironment]]:
    """Return the vessel, then the model, each with its environment.

    Raises:
        UsageError: if one of them cannot perform the manoeuvres.
    """
    model = None if programme.model is None else _build_model_craft(programme, programme.model)
    step = programme.step or (DEFAULT_TIME_STEP if model is None else model[0].dynamics.dt)
    crafts_and_seas = (
        [] if programme.vessel is None else [_build_vessel_craft(programme, programme.vessel, step)]
    )
    return crafts_and_seas if model is None else [*crafts_and_seas, model]


def simulate_all(
    programme: Programme, craft: SimulatedVessel, sea: TrialEnvironment
) -> list[ManoeuvreRun]:
    """Simulate the manoeuvres of a programme as rows of one batch, which takes the least time."""
    step = programme.step or (
        craft.dynamics.dt if programme.model is not None else DEFAULT_TIME_STEP
    )
    meta = {"vessel": programme.vessel, "craft": craft.name}
    return simulate_manoeuvres(
        craft, programme.loaded_manoeuvres, sea, programme.duration, step, meta
    )


def _build_vessel_craft(
    programme: Programme, vessel: str, step: float
) -> tuple[SimulatedVessel, TrialEnvironment]:
    plant = build_plant(vessel, programme.disturbance)
    check_simulated_vessel(vessel, step, programme.substeps, programme.disturbance, programme.noise)
    craft = SimulatedVessel(
        load_vessel(vessel).name,
        RecordedPlantDynamics(plant, step, programme.substeps),
        Helm.from_plant(plant),
        plant.n_commands,
        _set_initial_state(programme, plant.make_initial_state(1), plant.state_names, vessel),
    )
    return craft, TrialEnvironment(plant, programme.disturbance, programme.noise, programme.seed)


def _build_model_craft(
    programme: Programme, choice: ModelChoice
) -> tuple[SimulatedVessel, TrialEnvironment]:
    """Build a learned model with its actuators as a vessel that performs manoeuvres."""
    name = choice.model_folder.name
    (spec, model) = load_model(choice.model_folder)
    step = spec.dt
    if programme.step is not None and abs(programme.step - step) > 1e-9:
        raise ConfigError(
            f"programme.step ({programme.step:g} s) must be that of model '{name}' ({step:g} s);"
            " leave it out"
        )
    vessel = choice.actuators or programme.vessel
    plant = None
    actuators: ConfiguredActuators | PlantActuators
    forces: Callable[[Tensor], Tensor] | None = None
    if choice.inputs:
        actuators = ConfiguredActuators(choice.inputs, spec.signals.exogenous, step)
    elif vessel is not None:
        plant = load_vessel(vessel).build()
        actuators = PlantActuators(plant, step, programme.substeps)
        forces = Helm.from_plant(plant).forces
    else:
        raise ConfigError(
            "a model needs actuators to manoeuvre: name a vessel in programme.model.actuators"
            " whose actuators it uses, or set programme.model.inputs"
        )
    # a learned model has no input for wave loads
    wind_only = programme.disturbance.model_copy(update={"waves": None})
    actuated = ActuatedDynamics(
        model.double(), spec.signals.regressor_columns, spec.hold, actuators
    )
    logged_channels = (
        *actuated.state_names,
        *actuators.input_names[: actuators.n_commands],
        *programme.disturbance.logged_inputs,
    )
    programme.noise.check_sensors(logged_channels, step, name)
    if missing_inputs := [
        channel
        for channel in programme.disturbance.logged_inputs
        if channel not in actuators.input_names
    ]:
        raise ConfigError(
            f"disturbance.wind: model '{name}' and its actuators have no input"
            f" '{missing_inputs[0]}'"
        )
    helm = Helm(actuators.commands_for_demand, actuated.state_names, actuators.input_names, forces)
    start = _set_initial_state(
        programme, actuated.make_initial_state(1), actuated.state_names, name
    )
    sea = TrialEnvironment(plant, wind_only, programme.noise, programme.seed)
    return SimulatedVessel(name, actuated, helm, actuators.n_commands, start), sea


def _set_initial_state(
    programme: Programme, states: Tensor, state_names: tuple[str, ...], craft_name: str
) -> Tensor:
    """Overwrite states [1, nx] by the entries of `programme.initial`, and return them."""
    programme.require_states(state_names, craft_name)
    for name, value in programme.initial.items():
        states[:, state_names.index(name)] = float(value)
    return states
