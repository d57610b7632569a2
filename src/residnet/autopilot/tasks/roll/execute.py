"""Execution of a roll reduction run in a run folder: tune, train, simulate and compare."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple, final

import numpy as np
import pandas as pd
import torch
from pydantic import Field

from residnet.autopilot.records import (
    ControllerKind,
    RelativeChange,
    RollComparison,
    RollController,
    RollMetricsFile,
    RollRow,
    RollTotal,
)
from residnet.autopilot.report.roll import SIMULATIONS_FILE, sea_table, total_table, verdict_texts
from residnet.autopilot.roll import RollPolicy, RollSimulation
from residnet.autopilot.roll_config import (
    COMBINATIONS,
    GAIN_NAMES,
    HEADING_ONLY,
    LEARNED,
    SEA_STATES,
    TRAINED_LAW,
)
from residnet.autopilot.training.roll import train_roll_policy, tune_roll_law
from residnet.core.progress import begin_stage, log_message
from residnet.dynamics.store import Stored, rebuild_module
from residnet.evaluation.metrics_file import SCHEMA
from residnet.physics.vessel import load_vessel
from residnet.runs.folder import RunFolder
from residnet.runs.model_store import RunModelStore
from residnet.runs.task import SummaryMetric, TaskOutcome

if TYPE_CHECKING:
    from residnet.autopilot.tasks.roll.config import RollTaskConfig

_CHANNELS: Final = {
    "direction": "rad",
    "height": "m",
    "period": "s",
    "roll_rms": "rad",
    "roll_reduction": "-",
    "heading_rms": "rad",
    "rudder_rms": "rad",
    "fin_rms": "rad",
}
_N_RESAMPLES: Final = 2000
"""Bootstrap samples of a confidence interval."""


@final
class RollPolicySpec(Stored):
    """Description of a roll policy without its constants and weights.

    Attributes:
        schema_name: kind and version of the format.
        rudder: limit of the rudder in rad.
        fins: limit of the fins in rad.
        units: number of recurrent units for each of rudder and fins; 0 for the law alone.
        dt: time step in s.
    """

    schema_name: Literal["residnet.roll_policy/1"] = Field(
        default="residnet.roll_policy/1", alias="schema"
    )
    rudder: float
    fins: float
    units: int
    dt: float

    def build(self) -> RollPolicy:
        """Return the policy with constants of zero."""
        return self.build_law(dict.fromkeys(GAIN_NAMES, 0.0))

    def build_law(self, gains: Mapping[str, float], *, is_trained: bool = False) -> RollPolicy:
        """Return the policy with constants of its law, and initial weights of its network.

        Args:
            gains: constants by name.
            is_trained: whether the constants have gradients.
        """
        values = {name: torch.tensor([gains[name]]) for name in GAIN_NAMES}
        limits = self.rudder, self.fins
        return RollPolicy(values, limits, self.units, self.dt, is_trained=is_trained)


class FittedController(NamedTuple):
    """A tuned or trained controller.

    Attributes:
        kind: role of the controller.
        policy: the controller.
        notes: its costs, and the duration of its tuning or training.
    """

    kind: ControllerKind
    policy: RollPolicy
    notes: Mapping[str, Any]


def execute(config: RollTaskConfig, folder: RunFolder) -> TaskOutcome:
    """Tune and train all controllers, simulate them in the same waves, and compare them."""
    controllers = fit_controllers(config, RunModelStore(folder))
    begin_stage("simulations in waves")
    simulations = simulate_controllers(config, controllers)
    rows = build_rows(config, controllers, simulations)
    totals = build_totals(rows)
    judged_costs = simulations.groupby("controller")["cost"].mean()
    comparison = compare_with_classical(config, controllers, simulations, rows)
    metrics = RollMetricsFile(
        schema=SCHEMA,
        run=config.name,
        channels=_CHANNELS,
        speed=make_simulation(config, config.duration).speed,
        comparison=comparison,
        controllers=tuple(
            RollController(
                model=name,
                kind=controller.kind,
                gains=controller.policy.gain_values(),
                tuning_cost=controller.notes["cost"],
                start_cost=controller.notes["start_cost"],
                judged_cost=float(judged_costs[name]),
                seconds=controller.notes["seconds"],
            )
            for name, controller in controllers.items()
        ),
        totals=tuple(totals),
        rows=tuple(rows),
    )
    folder.write_record(folder.metrics, metrics)
    folder.write_table(folder.path / SIMULATIONS_FILE, simulations)
    summary_metrics = {
        f"{total.model}_{name}": SummaryMetric(value, unit)
        for total in totals
        if total.sea_state is None and total.model in (comparison.policy, comparison.classical)
        for name, value, unit in (
            ("roll_rms", total.roll_rms, "rad"),
            ("roll_reduction", total.roll_reduction, "-"),
            ("heading_rms", total.heading_rms, "rad"),
        )
    }
    tables = [total_table(metrics).to_text(), sea_table(metrics).to_text()]
    return TaskOutcome(verdict_texts(metrics), summary_metrics, "\n\n".join(tables))


def make_simulation(config: RollTaskConfig, duration: float) -> RollSimulation:
    """Build simulations in waves of the given duration in s, with the vessel of a config."""
    return RollSimulation(
        load_vessel(config.vessel).build(),
        config.hull.build_box(),
        dt=config.dt,
        duration=duration,
        transient=config.transient,
        noise=config.noise,
    )


def fit_controllers(config: RollTaskConfig, store: RunModelStore) -> dict[str, FittedController]:
    """Tune the classical combinations and train the policy, or load them after an interruption."""
    courses = make_simulation(config, config.duration)
    seas = config.list_seas()
    limits = config.rudder, config.fins
    controllers = dict[str, FittedController]()
    for name, constants in COMBINATIONS.items():

        def tune(policy: RollPolicy, constants: tuple[str, ...] = constants) -> dict[str, float]:
            gains, cost = tune_roll_law(
                courses,
                seas,
                limits,
                constants,
                weights=config.weights,
                settings=config.tuning,
                seed=config.seed,
            )
            for gain_name, value in gains.items():
                getattr(policy, gain_name).data.fill_(value)
            return {"cost": cost}

        controllers[name] = _fit_or_restore(config, store, name, "classical", {}, 0, tune)
    start = controllers["both"].policy
    trained: tuple[tuple[str, ControllerKind, int], ...] = (
        (TRAINED_LAW, "constants", 0),
        (LEARNED, "policy", config.units),
    )
    for name, kind, units in trained:

        def train(policy: RollPolicy, name: str = name) -> dict[str, float]:
            notes = train_roll_policy(
                name,
                policy,
                courses,
                seas,
                config.training,
                weights=config.weights,
                seed=config.seed,
                folder=store.training_folder,
            )
            return {"cost": notes["best_validation"], "start_cost": notes["start_validation"]}

        controllers[name] = _fit_or_restore(
            config, store, name, kind, start.gain_values(), units, train
        )
        start = controllers[name].policy
    return controllers


def _fit_or_restore(
    config: RollTaskConfig,
    store: RunModelStore,
    name: str,
    kind: ControllerKind,
    gains: Mapping[str, float],
    units: int,
    fit: Callable[[RollPolicy], dict[str, float]],
) -> FittedController:
    """Tune or train a controller, or load it from an interrupted run.

    Args:
        config: config of the run.
        store: models of the run.
        name: name of the controller.
        kind: role of the controller.
        gains: initial constants of the law; zero if absent.
        units: number of recurrent units.
        fit: tunes or trains a policy in place; returns its costs.
    """
    spec = RollPolicySpec(rudder=config.rudder, fins=config.fins, units=units, dt=config.dt)
    torch.manual_seed(config.seed)
    initial_gains = dict.fromkeys(GAIN_NAMES, 0.0) | dict(gains)
    policy = spec.build_law(initial_gains, is_trained=kind != "classical")
    notes = store.restore_module(name, policy)
    if notes is None:
        begin_stage(f"tuning {name}" if kind == "classical" else f"training {name}")
        start_time = time.time()
        notes = {"start_cost": None} | fit(policy)
        notes["seconds"] = round(time.time() - start_time, 1)
        store.save_module(name, spec, policy, notes)
        log_message(f"  {name}: cost {notes['cost']:.4f} deg²/m², {notes['seconds']:.0f} s")
    # rebuilt, so that a resumed run has the same policy
    return FittedController(kind, rebuild_module(spec, policy), notes)


def simulate_controllers(
    config: RollTaskConfig, controllers: Mapping[str, FittedController]
) -> pd.DataFrame:
    """Simulate all controllers in the same waves; return one line for each simulation.

    Mean squares are of roll angle, heading error, rudder and fin angle in rad^2.
    """
    seas = config.list_seas()
    n_realisations = config.judging.realisations
    courses = make_simulation(config, config.judging.duration)
    # the waves of the judging differ from those of tuning and training
    inputs, heights = courses.sample_inputs(seas, n_realisations, config.seed + 99)
    tables = []
    for name, controller in controllers.items():
        with torch.no_grad():
            runs = courses.simulate(controller.policy, inputs)
        columns = {
            "cost": runs.costs(heights, config.weights),
            "roll": runs.roll.square().mean(1),
            "heading": runs.heading.square().mean(1),
            "rudder": runs.commands[..., 0].square().mean(1),
            "fins": runs.commands[..., 1].square().mean(1),
        }
        tables.append(
            pd.DataFrame(
                {
                    "controller": name,
                    "sea_state": np.repeat([sea.state for sea in seas], n_realisations),
                    "direction": np.repeat(
                        config.directions * len(config.sea_states), n_realisations
                    ),
                    "realisation": np.tile(np.arange(n_realisations), len(seas)),
                    **{key: values.double().numpy() for key, values in columns.items()},
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def build_rows(
    config: RollTaskConfig,
    controllers: Mapping[str, FittedController],
    simulations: pd.DataFrame,
) -> list[RollRow]:
    """Return the metrics of every controller in every sea."""
    quantities = ["roll", "heading", "rudder", "fins"]
    keys = ["controller", "sea_state", "direction"]
    rms_table = simulations.groupby(keys, sort=False, as_index=False)[quantities].mean()
    rms_table[quantities] **= 0.5
    records = rms_table.to_dict("records")
    reference_rolls = {
        (values["sea_state"], values["direction"]): float(values["roll"])
        for values in records
        if values["controller"] == HEADING_ONLY
    }
    rows = []
    for values in records:
        name = values["controller"]
        height, period = SEA_STATES[values["sea_state"]]
        reference_roll = reference_rolls[values["sea_state"], values["direction"]]
        rows.append(
            RollRow(
                model=name,
                kind=controllers[name].kind,
                split="simulated",
                sea_state=values["sea_state"],
                direction=values["direction"],
                height=height,
                period=period,
                n=config.judging.realisations,
                roll_rms=values["roll"],
                roll_reduction=1.0 - values["roll"] / reference_roll,
                heading_rms=values["heading"],
                rudder_rms=values["rudder"],
                fin_rms=values["fins"],
                is_judged=reference_roll > config.noise,
            )
        )
    return rows


def build_totals(rows: list[RollRow]) -> list[RollTotal]:
    """Return RMS values over all directions of each sea state, and over all seas."""
    totals = []
    models = dict.fromkeys(row.model for row in rows)
    for state in (*dict.fromkeys(row.sea_state for row in rows), None):
        selected_rows = [row for row in rows if state in (None, row.sea_state)]
        mean_squares = {
            name: np.mean(
                [
                    (row.roll_rms**2, row.heading_rms**2)
                    for row in selected_rows
                    if row.model == name
                ],
                axis=0,
            )
            for name in models
        }
        totals += [
            RollTotal(
                model=name,
                sea_state=state,
                roll_rms=float(roll**0.5),
                roll_reduction=1.0 - float((roll / mean_squares[HEADING_ONLY][0]) ** 0.5),
                heading_rms=float(heading**0.5),
            )
            for name, (roll, heading) in mean_squares.items()
        ]
    return totals


def compare_with_classical(
    config: RollTaskConfig,
    controllers: Mapping[str, FittedController],
    simulations: pd.DataFrame,
    rows: list[RollRow],
) -> RollComparison:
    """Compare the policy with the classical combination of the lowest cost in the judging seas.

    The best combination in these seas is an opponent that favours the classical side.
    """
    opponents = [name for name in controllers if name not in (HEADING_ONLY, LEARNED)]
    costs = simulations.groupby("controller")["cost"].mean()
    best_classical = min(opponents, key=lambda name: costs[name])

    def relative_change(quantity: str) -> RelativeChange:
        policy_values, classical_values = (
            simulations.loc[simulations["controller"] == name, quantity]
            .to_numpy()
            .reshape(-1, config.judging.realisations)
            for name in (LEARNED, best_classical)
        )
        return estimate_rms_change(policy_values, classical_values)

    roll = relative_change("roll")
    heading = relative_change("heading")
    judged_rows = {(row.model, row.sea_state, row.direction): row for row in rows if row.is_judged}
    row_pairs = [
        (row, judged_rows[best_classical, state, direction])
        for (name, state, direction), row in judged_rows.items()
        if name == LEARNED
    ]
    return RollComparison(
        policy=LEARNED,
        classical=best_classical,
        roll=roll,
        heading=heading,
        tolerance=config.judging.tolerance,
        is_as_good=roll.value <= 0.0 and heading.value <= config.judging.tolerance,
        n_seas=len(row_pairs),
        n_less_roll=sum(row.roll_rms < law_row.roll_rms for row, law_row in row_pairs),
        n_larger_heading=sum(row.heading_rms > law_row.heading_rms for row, law_row in row_pairs),
    )


def estimate_rms_change(policy: np.ndarray, classical: np.ndarray) -> RelativeChange:
    """Return the relative difference of pooled RMS values with its confidence interval.

    The bootstrap draws realisations of every sea with replacement, the same for both controllers,
    because both are simulated in the same waves.

    Args:
        policy: mean squares of the policy [S, R] in S seas and R realisations.
        classical: mean squares of the classical law [S, R].
    """
    n_seas, n_realisations = policy.shape
    random = np.random.default_rng(0)
    draws = random.integers(n_realisations, size=(_N_RESAMPLES, n_seas, n_realisations))
    resampled = [
        np.take_along_axis(values[None], draws, axis=2).mean(axis=(1, 2))
        for values in (policy, classical)
    ]
    changes = np.sqrt(resampled[0] / resampled[1]) - 1.0
    lower, upper = np.quantile(changes, [0.025, 0.975])
    value = float(np.sqrt(policy.mean() / classical.mean())) - 1.0
    return RelativeChange(value=value, interval=(float(lower), float(upper)))
