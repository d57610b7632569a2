"""Execution of the task `autopilot` in a run folder."""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch

from residnet.autopilot.base import Policy
from residnet.autopilot.evaluation import (
    METRIC_UNITS,
    N_QUIET_RUNS,
    build_sea_row,
    build_step_row,
    build_time_series,
    build_variation_grid,
    compute_run_metrics,
    describe_limit_cycles,
    draw_heading_changes,
    draw_variations,
    evaluate_limit_cycles,
    evaluate_under_conditions,
    list_policy_objections,
    list_unsuitable_conditions,
    simulate_steps,
    simulate_steps_in_waves,
    simulate_steps_in_wind,
)
from residnet.autopilot.export import ExportedHeading
from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ConditionsConfig,
    noise_free,
    settled_time,
    simulate_heading_steps,
)
from residnet.autopilot.heading.controllers import (
    ControlTask,
    DepthConfig,
    ObservedConfig,
    RecurrentPolicy,
    TunableConfig,
    angle_law_of,
    load_recurrent,
)
from residnet.autopilot.heading.policies import LOS_CONSTANTS, DepthPolicy, ObserverPolicy
from residnet.autopilot.heading.tuning import tune_parameters
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.records import (
    AutopilotMetricsFile,
    ControllerKind,
    ControllerNotes,
    ControllersFile,
    HeadingRow,
    SimulatedSettings,
    TurningParameters,
)
from residnet.autopilot.report.heading import (
    CONDITIONS_FILE,
    RESPONSES_FILE,
    VESSELS_FILE,
    axis_words,
    cost_sentences,
    cost_table,
    effort_table,
    settling_table,
)
from residnet.autopilot.training.fit import train_policy
from residnet.autopilot.training.predictor import train_or_resume_controller
from residnet.core.progress import begin_stage, log_message, report_progress
from residnet.core.records import with_explicit_defaults
from residnet.dynamics.store import rebuild_module
from residnet.engine.compiled import CompiledRollout
from residnet.evaluation.metrics_file import SCHEMA
from residnet.physics.nomoto_config import NomotoVesselConfig
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import ExportRequest, SummaryMetric, TaskOutcome

if TYPE_CHECKING:
    from residnet.autopilot.heading.evaluation_config import EvaluationConditions
    from residnet.autopilot.heading.predictive import AnyController
    from residnet.autopilot.tasks.autopilot.config import AutopilotConfig

Controllers = dict[str, tuple[ControllerKind, Policy]]
"""Role (policy, classical, floor and others) and controller by name."""


def execute(config: AutopilotConfig, folder: RunFolder) -> TaskOutcome:
    """Tune classical laws, train policies, and compare them."""
    config = config.with_scaled_times()
    vessel = config.steered_vessel
    nomoto = vessel.estimate_nomoto(config.rudder, config.turning_time)
    log_message(
        f"{config.name}: {config.vessel} answers {config.rudder:.3g} rad of rudder with K ="
        f" {nomoto.gain:.4g} 1/s, T = {nomoto.time:.4g} s"
    )
    steering = ControlTask(vessel, nomoto, config.rudder, config.test.dt)
    controllers: Controllers = {}
    notes: dict[str, ControllerNotes] = {}
    tuned_peers: dict[str, AnyController] = {}
    for name, peer in config.peers.items():
        tuned_peers[name], notes[name] = _tune_peer(name, peer, steering, config)
        role: ControllerKind = "floor" if name == config.floor else "classical"
        controllers[name] = (role, tuned_peers[name].build(steering))
    for name, settings in config.predictive.items():
        predictive_policy, training_notes = train_or_resume_controller(
            name, settings, steering, config.seed, folder
        )
        notes[name] = ControllerNotes.model_validate(training_notes)
        controllers[name] = ("predictive", predictive_policy)
    ablations: Controllers = {}
    for name, policy_config in config.policies.items():
        base_law = None if policy_config.start is None else tuned_peers[policy_config.start]
        policy, training_notes, untrained_policy = _train_policy_or_resume(
            name, base_law, steering, config, folder
        )
        notes[name] = ControllerNotes.model_validate(training_notes)
        controllers = {name: (policy_config.role, policy), **controllers}
        # references of the comparison: the untrained policy, and the policy without its network
        if policy_config.units > 0:
            ablations[f"{name} untrained"] = ("untrained", untrained_policy)
            if isinstance(policy, ObserverPolicy | DepthPolicy):
                ablations[f"{name} network off"] = ("network_off", policy.without_network())
    folder.write_record(
        folder.path / "controllers.json",
        ControllersFile(
            schema="residnet.controllers/1",
            turning=TurningParameters.model_validate(nomoto.to_json()),
            controllers=notes,
        ),
    )
    rows, corner_trajectories, plants = _run_step_tests(controllers, vessel, config)
    if config.conditions is not None:
        condition_rows, condition_table = _evaluate_under_conditions(
            ablations | controllers, config, config.conditions
        )
        rows += condition_rows
        folder.write_table(folder.path / CONDITIONS_FILE, condition_table)
    channels = {**METRIC_UNITS, "cost": "s", "time_outside": "s"} | dict.fromkeys(
        ("heading_swing", "rudder_swing", "error_end", "heading_rms", "rudder_rms", "heel_rms"),
        "rad",
    )
    # metrics of the heading error in rad are metrics of the depth error in m
    depth_units = {"rad": "m", "rad s": "m s"} if config.test.depth else {}
    for name in ("overshoot", "iae", "heading_swing", "error_end"):
        channels[name] = depth_units.get(channels[name], channels[name])
    folder.write_record(
        folder.metrics,
        AutopilotMetricsFile(
            schema=SCHEMA,
            run=config.name,
            channels=channels,
            floor=config.floor,
            flown=SimulatedSettings(
                test=with_explicit_defaults(config.test),
                conditions=config.conditions and with_explicit_defaults(config.conditions),
            ),
            rows=tuple(rows),
        ),
    )
    folder.write_table(folder.path / RESPONSES_FILE, corner_trajectories)
    folder.write_table(folder.path / VESSELS_FILE, plants)
    axis_labels = axis_words(config.test)
    tables = [settling_table(rows, config.floor, axis_labels), effort_table(rows, axis_labels)]
    if config.conditions is not None:
        tables.insert(0, cost_table(rows, axis_labels))
    return TaskOutcome(
        *_summarize(config, rows),
        "\n\n".join(table.to_text() for table in tables),
        exports={
            name: partial(export_model, config, ExportRequest(folder, name))
            for name in config.policies
        },
    )


def _tune_peer(
    name: str, peer: AnyController, steering: ControlTask, config: AutopilotConfig
) -> tuple[AnyController, ControllerNotes]:
    """Tune the missing constants of a classical law; return it and notes."""
    evaluation_conditions = config.conditions
    if not isinstance(peer, TunableConfig) or None not in peer.parameter_values().values():
        return peer, ControllerNotes(config=with_explicit_defaults(peer))
    assert evaluation_conditions is not None
    start_time = time.time()
    begin_stage(f"tuning {name}")
    steering = steering._replace(vessel=_build_vessel_for_conditions(config, evaluation_conditions))
    tuning = tune_parameters(
        peer,
        steering,
        evaluation_conditions.stated,
        evaluation_conditions.evolution,
        config.seed + 11,
        CompiledRollout,
        f"tuning {name}",
    )
    constants = ", ".join(f"{key} {value:.4g}" for key, value in tuning.parameters.items())
    log_message(f"  tuned {name}: {constants}, cost {tuning.cost:.3f} s")
    tuned_peer = peer.with_parameters(tuning.parameters)
    return tuned_peer, ControllerNotes(
        config=with_explicit_defaults(tuned_peer),
        cost=tuning.cost,
        tried=tuning.n_candidates,
        seconds=round(time.time() - start_time, 1),
    )


def _build_vessel_for_conditions(
    config: AutopilotConfig, evaluation_conditions: EvaluationConditions
) -> SteeredPlant:
    """Return the vessel in calm water, or with wind and current if the conditions have them."""
    is_calm = not any(
        conditions.has_weather for conditions in evaluation_conditions.all_conditions.values()
    )
    return SteeredPlant(load_vessel(config.vessel).build(), in_calm_water=is_calm, axis=config.axis)


def _train_policy_or_resume(
    name: str,
    base_law: AnyController | None,
    steering: ControlTask,
    config: AutopilotConfig,
    folder: RunFolder,
) -> tuple[RecurrentPolicy, dict[str, Any], RecurrentPolicy]:
    """Train a policy or load it from an interrupted run; return it, notes, and its initial state.

    `base_law` is the control law that the network is added to; None for none.
    """
    policy_config = config.policies[name]
    evaluation_conditions = config.conditions
    assert evaluation_conditions is not None
    training_vessel = config.training_vessel(name)
    nomoto = steering.nomoto
    training = policy_config.training
    if policy_config.learned is not None and training is not None:
        nomoto = training_vessel.estimate_nomoto(config.rudder, config.turning_time, training.dt)
        log_message(
            f"  {name} learns on {policy_config.learned.model} of {policy_config.learned.run}: K ="
            f" {nomoto.gain:.4g} 1/s, T = {nomoto.time:.4g} s"
        )
    # the untrained policy, from the law and the response of the vessel
    torch.manual_seed(config.seed)
    observed_law = angle_law_of(base_law)
    spec_fields = {
        "state": training_vessel.state,
        **nomoto.to_json(),
        "limit": steering.limit,
        "rate": training_vessel.rate,
        "dt": steering.dt,
        "trained_at": steering.dt if training is None else training.dt,
        "units": policy_config.units,
        **({"law": observed_law.model_dump()} if isinstance(observed_law, ObservedConfig) else {}),
    }
    if isinstance(base_law, DepthConfig):
        depth_law_settings = {name: base_law.complete_parameters()[name] for name in LOS_CONSTANTS}
        spec_fields = {
            "law": spec_fields,
            "steepest": base_law.steepest,
            "sight": depth_law_settings,
        }
    spec = config.policy_spec_class(name).model_validate(spec_fields)
    policy = spec.build()
    # a resumed run restores the policy; otherwise it is trained, if it has a training
    store = RunModelStore(folder)
    notes = store.restore_module(name, policy)
    start_times = (time.time(), time.process_time())
    if notes is None and training is None:
        notes = {"seconds": 0.0, "cpu_seconds": 0.0, "constants": policy.constant_values()}
        store.save_module(name, spec, policy, notes)
        policy = rebuild_module(spec, policy)
    elif notes is None:
        assert training is not None
        begin_stage(f"training {name}")
        compiler = partial(CompiledRollout, max_gradient_ratio=training.outlying)
        notes = train_policy(
            name,
            policy,
            training_vessel,
            training,
            evaluation_conditions.stated,
            config.seed,
            folder.path,
            compiler if training.compiled else None,
        )
        seconds = time.time() - start_times[0]
        cpu = time.process_time() - start_times[1]
        notes |= {"seconds": round(seconds, 1), "cpu_seconds": round(cpu, 1)}
        notes |= {"constants": policy.constant_values()}
        store.save_module(name, spec, policy, notes)
        # reloaded, so that a resumed run has the same policy
        policy = rebuild_module(spec, policy)
    untrained_policy = spec.build().eval().requires_grad_(False).double()
    policy.set_step(steering.dt)
    for built_policy in (policy, untrained_policy):
        built_policy.set_state_columns(steering.vessel.state)
    if training is None:
        return policy.double(), notes, untrained_policy
    log_message(
        f"  {name}: cost {notes['best_validation']:.3f} s, {notes['start_validation']:.3f} s at the"
        f" start, after {notes['seconds']:.0f} s of training"
    )
    notes = {key: value for key, value in notes.items() if key != "curve"}
    return policy.double(), notes, untrained_policy


def load_trained_policy(
    config: AutopilotConfig, models: Path, name: str, dt: float
) -> RecurrentPolicy:
    """Return a trained policy of a finished run, at a step of dt seconds.

    Raises:
        UsageError: if the run lacks the policy, or its files were changed.
    """
    policy = load_recurrent(models / name, config.policy_spec_class(name))
    policy.set_step(dt)
    return policy


def _run_step_tests(
    controllers: Controllers, vessel: SteeredPlant, config: AutopilotConfig
) -> tuple[list[HeadingRow], pd.DataFrame, pd.DataFrame]:
    """Return rows of metrics.json, time series of the corners, and metrics of random vessels."""
    test = config.test
    main_conditions = _main_conditions(config)
    reference_change, settling_band = test.step_and_tolerance
    corner_variations = build_variation_grid(main_conditions.effect, main_conditions.time)
    random_sample = draw_variations(
        main_conditions.effect, main_conditions.time, test.plants, config.seed + 1
    )
    biased_variations = torch.tensor(
        [[1.0, 1.0, test.bias], [1.0, 1.0, -test.bias]], dtype=torch.float64
    )
    plant = load_vessel(config.vessel).build()
    rows: list[HeadingRow] = []
    corner_tables = []
    random_tables = []
    begin_stage("step tests")
    for name, (role, policy) in controllers.items():
        run_step_test = partial(
            simulate_steps, vessel, policy, reference_change, test.dt, test.duration
        )
        tests = {
            "nominal": run_step_test(corner_variations[:1]),
            "corners": run_step_test(corner_variations),
            "random": run_step_test(random_sample),
        }
        rows += [
            build_step_row(name, role, protocol, trajectories, settling_band)
            for protocol, trajectories in tests.items()
        ]
        corner_tables.append(build_time_series(name, tests["corners"], corner_variations))
        step_metrics = {
            key: value.numpy()
            for key, value in compute_run_metrics(tests["random"], settling_band).items()
        }
        variation_columns = {
            "effect": random_sample[:, 0].numpy(),
            "time": random_sample[:, 1].numpy(),
        }
        random_tables.append(
            pd.DataFrame({"controller": name, **variation_columns, **step_metrics})
        )
        timing: dict[str, Any] = {"dt": test.dt, "duration": test.bias_time}
        disturbed_runs = {
            "bias": simulate_heading_steps(
                vessel, policy, torch.full((2,), reference_change), biased_variations, **timing
            )
        }
        if test.wind is not None:
            disturbed_runs["wind"] = simulate_steps_in_wind(
                plant, policy, test.wind, test.heading, **timing
            )
        rows += [
            build_step_row(name, role, key, trajectories, settling_band).model_copy(
                update={"error_end": float(trajectories.error[:, -1].abs().max())}
            )
            for key, trajectories in disturbed_runs.items()
        ]
        if test.sea is not None:
            duration = test.duration + test.sea_time
            sea_runs = simulate_steps_in_waves(
                plant, policy, test.sea, test.heading, test.dt, duration, config.seed + 2
            )
            rows.append(build_sea_row(name, role, sea_runs, test.duration))
    return (
        rows,
        pd.concat(corner_tables, ignore_index=True),
        pd.concat(random_tables, ignore_index=True),
    )


def _main_conditions(config: AutopilotConfig) -> ConditionsConfig:
    return ConditionsConfig() if config.conditions is None else config.conditions.stated


def _evaluate_under_conditions(
    controllers: Controllers, config: AutopilotConfig, evaluation_conditions: EvaluationConditions
) -> tuple[list[HeadingRow], pd.DataFrame]:
    """Return rows of metrics.json and a table of the simulations under the conditions."""
    vessel = _build_vessel_for_conditions(config, evaluation_conditions)
    conditions_by_protocol = {
        "conditions" if name == "stated" else f"beyond_{name}": conditions
        for name, conditions in evaluation_conditions.all_conditions.items()
    }
    sampled_conditions = {
        name: (
            conditions,
            draw_heading_changes(conditions, evaluation_conditions.flights, config.seed),
        )
        for name, conditions in conditions_by_protocol.items()
    }
    noise_free_sample = draw_heading_changes(
        noise_free(evaluation_conditions.stated),
        min(N_QUIET_RUNS, evaluation_conditions.flights),
        config.seed,
    )
    max_delay = max(
        1, *(int(changes.delay_steps.max()) for _, changes in sampled_conditions.values())
    )
    rows: list[HeadingRow] = []
    tables = []
    for number, (name, (role, policy)) in enumerate(controllers.items()):
        report_progress("judging", number, len(controllers))
        conditioned_run = ClosedLoopSimulation(
            vessel,
            policy.double(),
            evaluation_conditions.stated.dt,
            compiler=CompiledRollout,
            max_delay=max_delay,
        )
        for protocol, (conditions, changes) in sampled_conditions.items():
            condition_row, table = evaluate_under_conditions(
                name, role, protocol, conditioned_run, conditions, changes
            )
            rows.append(condition_row)
            tables.append(table)
        rows.append(
            evaluate_limit_cycles(
                name,
                role,
                conditioned_run,
                noise_free_sample,
                settled_time(evaluation_conditions.stated.duration),
            )
        )
    return rows, pd.concat(tables, ignore_index=True)


def _summarize(
    config: AutopilotConfig, rows: list[HeadingRow]
) -> tuple[list[str], dict[str, SummaryMetric]]:
    """Return the verdict and the main figures: settling on the nominal vessel, and worst corner."""
    settling_by_model = {
        (row.model, row.protocol): row.settling.max for row in rows if row.settling is not None
    }
    is_linear = isinstance(load_vessel(config.vessel), NomotoVesselConfig)
    vessel_text = "the linear vessel model" if is_linear else "the nonlinear vessel model"
    sentences = cost_sentences(rows, vessel_text)
    summary_metrics = dict[str, SummaryMetric]()
    reference_change, _ = config.test.step_and_tolerance
    axis_labels = axis_words(config.test)
    for name in config.policies or config.predictive:
        nominal = settling_by_model[name, "nominal"]
        slowest = settling_by_model[name, "corners"]
        summary_metrics[f"{name}_settling_nominal"] = SummaryMetric(nominal, "s")
        summary_metrics[f"{name}_settling_worst"] = SummaryMetric(slowest, "s")
        sentences.append(
            f"Settling time of '{name}' after a step of"
            f" {axis_labels.scale * reference_change:.3g} {axis_labels.unit}: {nominal:.2f} s on"
            f" the nominal vessel, {slowest:.2f} s on the slowest vessel at the corners of the"
            " spread."
        )
    if (scope := _describe_linear_scope(config)) and config.policies:
        sentences.append(scope)
    if config.floor is not None:
        sentences.append(
            f"The fastest possible change of the nominal vessel, by '{config.floor}' that knows it"
            f" exactly, takes {settling_by_model[config.floor, 'nominal']:.2f} s."
        )
    for row in rows:
        if row.protocol == "conditions" and row.model in config.policies:
            summary_metrics[f"{row.model}_cost"] = SummaryMetric(row.mean_cost, "s")
    return sentences, summary_metrics


def _describe_linear_scope(config: AutopilotConfig) -> str:
    """Return that costs and overshoots hold for a linear vessel only; empty for other vessels."""
    if not isinstance(load_vessel(config.vessel), NomotoVesselConfig):
        return ""
    return (
        "Costs, settling times and overshoots hold for the linear model with K and T within the"
        " stated ranges. They are no statement on the overshoot of the vessel itself, whose"
        " steering is nonlinear: measure it in a step of the course."
    )


def export_model(config: AutopilotConfig, request: ExportRequest) -> Path:
    """Write a policy of a run, with its rows of metrics.json in the model card; returns the file.

    Raises:
        UsageError: if the run has no policy of this name.
        WithheldError: if a classical controller has a lower cost and `request.allows_objections` is
            false.
        ExportError: if the file does not reproduce the policy.
    """
    name = request.resolve_model_name(config.policies)
    rows = AutopilotMetricsFile.read(request.run.metrics).rows
    scaled_config = config.with_scaled_times()
    card_fields = {
        "vessel": config.vessel,
        "conditions": _main_conditions(scaled_config).model_dump(mode="json"),
    }
    learned = config.policies[name].learned
    card_fields |= {} if learned is None else {"learned": learned.model_dump(mode="json")}
    if scope := _describe_linear_scope(config):
        card_fields["scope"] = scope
    card_fields |= {
        "not_for": [*list_unsuitable_conditions(name, rows), *describe_limit_cycles(name, rows)]
    }
    exported = ExportedHeading(
        name,
        load_trained_policy(config, request.run.models, name, scaled_config.test.dt),
        fallback=config.safe,
        description=card_fields,
        metrics=[row for row in rows if row.model == name],
    )
    return request.write(exported, list_policy_objections(name, rows))
