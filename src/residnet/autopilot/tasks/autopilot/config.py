"""Task `autopilot`: train heading or depth policies, tune classical laws and compare them."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, final

import torch
from pydantic import Field, model_validator

from residnet.autopilot.heading.conditions import ConditionsConfig
from residnet.autopilot.heading.controllers import (
    BangBangConfig,
    DepthConfig,
    DepthPolicySpec,
    NetworkPolicySpec,
    ObservedConfig,
    ObserverPolicySpec,
    RecurrentSpec,
    TunableConfig,
    angle_law_of,
)
from residnet.autopilot.heading.evaluation_config import EvaluationConditions, StepTestConfig
from residnet.autopilot.heading.predictive import AnyController, PredictiveConfig
from residnet.autopilot.heading.steering_variation import DEPTH, HEADING, Axis
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredModel, SteeredPlant
from residnet.autopilot.records import ControllerKind
from residnet.autopilot.training.config import PolicyTraining
from residnet.core.config import Config, Radians, Seconds
from residnet.core.errors import ConfigError, FitError
from residnet.core.progress import log_message
from residnet.dynamics.store import load_model, resolve_model_name
from residnet.manoeuvres.trials_config import DisturbanceConfig, WindConfig
from residnet.physics.vessel import VesselName, load_vessel
from residnet.runs.task import ComputingTask, ExportRequest, PackageTask, PartName


class LearnedModelConfig(Config):
    """A model of the vessel that an earlier run (task `fit`) identified from logs.

    Attributes:
        run: folder of that run.
        model: name of the model; `selected` is the one chosen on validation data.
    """

    run: Path
    model: str = "selected"


class PolicyConfig(Config):
    """A recurrent policy of heading or depth, trained under the run's conditions.

    Attributes:
        start: name of a classical law with an observer (kind `ptos` or `lqr_observer`, or `depth`
            with such an inner law). The network is added to this law; its tuned constants are the
            initial values of the training. Null for a network alone, without law,
            observer or predictor.
        units: number of units of the recurrent network; 0 to train the constants of a law only.
        learned: learned model to train on instead of the vessel; the policy is
            compared on the vessel.
        training: settings of the training; null for the tuned law of `start` without training,
            which requires `units: 0`.
    """

    start: PartName | None
    units: int = Field(default=16, ge=0, le=10_000)
    learned: LearnedModelConfig | None = None
    training: PolicyTraining | None = PolicyTraining()

    @property
    def role(self) -> ControllerKind:
        """Role in the rows of metrics.json: policy, network, constants, or law."""
        if self.training is None:
            return "law"
        if self.start is None:
            return "network"
        return "policy" if self.units else "constants"

    @model_validator(mode="after")
    def _require_trainable(self) -> Self:
        if self.start is None and self.units == 0:
            raise ValueError("units: a policy without a law needs a network, at least one unit")
        if self.training is None and (self.units > 0 or self.learned is not None):
            raise ValueError("training: null is the tuned law alone; set units: 0, remove learned")
        return self


@final
class AutopilotConfig(PackageTask, ComputingTask):
    """Policies of heading or depth trained through the vessel, compared with tuned controllers.

    Attributes:
        seed: seed of weights, batches and random vessels.
        vessel: name or file of the vessel.
        rudder: rudder limit of the controllers in rad.
        turning_time: time in s until a turn at this angle is steady.
        pace: factor on all times in `test`, `conditions` and the trainings of `policies`, except
            delays; `vessel` for the turning time of the vessel divided by the turning time of the
            vessel of Gouletas 2020.
        test: step test of all controllers, over the vessels of `conditions.stated`.
        conditions: conditions of the tuning, training and evaluation; null to compare peers with
            given constants in `test` only.
        policies: learned policies by name.
        predictive: predictive autopilots of Gouletas 2020 by name.
        peers: classical controllers by name; constants that are not given are tuned.
        floor: peer with exact knowledge of the vessel (time-optimal); settling times are reported
            as multiples of its settling time.
        safe: command of an exported policy for invalid inputs: the last valid command, or rudder
            amidships.
    """

    task: Literal["autopilot"]
    seed: int = Field(default=0, ge=0)
    vessel: VesselName
    rudder: Radians = Field(gt=0, lt=1.5)
    turning_time: Seconds = Field(default=100.0, gt=0)
    pace: Literal["vessel"] | Annotated[float, Field(gt=0, le=1_000)] = 1.0
    test: StepTestConfig
    conditions: EvaluationConditions | None = None
    policies: dict[PartName, PolicyConfig] = Field(default_factory=dict)
    predictive: dict[PartName, PredictiveConfig] = Field(default_factory=dict)
    peers: dict[PartName, AnyController] = Field(default_factory=dict)
    floor: PartName | None = None
    safe: Literal["hold", "amidships"] = "amidships"

    supported_commands: ClassVar[tuple[str, ...]] = ("report", "export")
    section_module: ClassVar[str] = "residnet.autopilot.report.heading"

    @model_validator(mode="after")
    def _validate_names(self) -> Self:
        names = [*self.policies, *self.predictive, *self.peers]
        if not self.policies and not self.predictive:
            raise ValueError("policies: give at least one policy here or under 'predictive'")
        if duplicates := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"'{duplicates[0]}' names two controllers; names are unique in a run")
        self._validate_axis()
        if self.floor is not None and not isinstance(self.peers.get(self.floor), BangBangConfig):
            raise ValueError(f"floor: '{self.floor}' must name a peer of kind bang_bang")
        self._validate_policies()
        if self.conditions is None:
            self._validate_without_conditions()
            return self
        if self.pace != 1.0 and self.predictive:
            raise ValueError("pace: give the times of 'predictive' as the vessel needs them")
        for name, conditions in self.conditions.all_conditions.items():
            if conditions.dt != self.test.dt:
                raise ValueError(
                    f"conditions.{name}: dt must be that of test, {self.test.dt:g} s, got"
                    f" {conditions.dt:g} s"
                )
        return self

    def _validate_policies(self) -> None:
        """Refuse policies without conditions, and initial controllers without an observer."""
        for name, policy in self.policies.items():
            if self.conditions is None:
                raise ValueError(f"policies.{name}: give 'conditions' for its training")
            if policy.start is None:
                continue
            if not isinstance(angle_law_of(self.peers.get(policy.start)), ObservedConfig):
                raise ValueError(
                    f"policies.{name}.start: '{policy.start}' must name a peer of kind ptos or"
                    " lqr_observer, or of kind depth with such a pitch"
                )

    def _validate_without_conditions(self) -> None:
        """Refuse settings that require evaluation conditions: tuned constants and a pace."""
        for name, peer in self.peers.items():
            if isinstance(peer, TunableConfig) and None in peer.parameter_values().values():
                raise ValueError(
                    f"peers.{name}: give all constants, or 'conditions' for their tuning"
                )
        if self.pace != 1.0:
            raise ValueError("pace: it scales the times of 'conditions', which are missing")

    def _validate_axis(self) -> None:
        is_depth = self.test.depth is not None
        conditions_by_name = {} if self.conditions is None else self.conditions.all_conditions
        for name, conditions in conditions_by_name.items():
            if (conditions.depth is not None) != is_depth:
                raise ValueError(
                    f"conditions.{name}.depth: required with test.depth, and allowed only with it"
                )
        for name, peer in self.peers.items():
            if isinstance(peer, DepthConfig) != is_depth:
                expected_kind = "depth, with its law under 'pitch'" if is_depth else "any but depth"
                raise ValueError(
                    f"peers.{name}: test.depth is {'given' if is_depth else 'not given'}, so its"
                    f" kind must be {expected_kind}"
                )
        for name, policy in self.policies.items():
            if is_depth and policy.start is None:
                raise ValueError(f"policies.{name}: a depth policy begins with a peer (start)")
        if is_depth and (self.predictive or self.pace != 1.0):
            raise ValueError(
                "test.depth: remove 'predictive' and 'pace', which apply to the heading only"
            )

    @model_validator(mode="after")
    def _validate_vessel(self) -> Self:
        plant = load_vessel(self.vessel).build()
        unit_command = torch.ones(1, dtype=torch.float64)
        if self.axis.command not in plant.input_names[: plant.n_commands]:
            raise ValueError(
                f"vessel: '{self.vessel}' has no command '{self.axis.command}' to steer its"
                f" {self.axis.name} with; it has {', '.join(plant.input_names[: plant.n_commands])}"
            )
        command_index = plant.input_names.index(self.axis.command)
        max_rudder = float(plant.commands_for_demand(unit_command, unit_command)[0, command_index])
        if self.test.depth is not None and plant.dive_commands is not None:
            max_rudder = float(plant.dive_commands[command_index])
        if self.rudder > (1.0 + 1e-6) * max_rudder:
            raise ValueError(
                f"rudder: vessel '{self.vessel}' has {max_rudder:.4g} rad at most, given"
                f" {self.rudder:.4g}"
            )
        wind = None if self.test.wind is None else WindConfig(speed=self.test.wind, direction=0.0)
        DisturbanceConfig(wind=wind, waves=self.test.sea).check_plant(plant, self.vessel)
        conditions_by_name = {} if self.conditions is None else self.conditions.all_conditions
        for name in (
            name
            for conditions in conditions_by_name.values()
            for name in conditions.required_inputs()
        ):
            if name not in plant.input_names:
                raise ValueError(
                    f"conditions: vessel '{self.vessel}' has no input '{name}'; it has"
                    f" {', '.join(plant.input_names)}"
                )
        return self

    @property
    def axis(self) -> Axis:
        """The controlled axis: heading or depth."""
        return HEADING if self.test.depth is None else DEPTH

    @property
    def steered_vessel(self) -> SteeredPlant:
        """The vessel in calm water."""
        return SteeredPlant(load_vessel(self.vessel).build(), axis=self.axis)

    def policy_spec_class(self, name: str) -> type[RecurrentSpec]:
        """Return the class of the stored description of a policy."""
        if self.test.depth is not None:
            return DepthPolicySpec
        return NetworkPolicySpec if self.policies[name].start is None else ObserverPolicySpec

    def provenance_seed(self) -> int:
        """Return the seed of weights, batches and random vessels."""
        return self.seed

    def check(self) -> None:
        """Check that the vessel and learned models turn steadily and can perform the tests.

        Raises:
            UsageError: if a run or a model is missing.
            FitError: if a learned model does not turn steadily towards the rudder.
            ConfigError: if the vessel does not turn steadily, a change of heading takes longer than
                its simulation, disturbances need all of the rudder, or the inputs of a learned
                model differ from those of the vessel.
        """
        learned_models = [
            (self.training_vessel(name), policy.training.dt)
            for name, policy in self.policies.items()
            if policy.learned is not None and policy.training is not None
        ]
        vessel = self.steered_vessel
        try:
            nomoto = vessel.estimate_nomoto(self.rudder, self.turning_time)
        except FitError as error:
            raise ConfigError(f"vessel '{self.vessel}' cannot be steered: {error}") from error
        config = self.with_scaled_times()
        # `minimum_turn_time` is a lower bound for turns only: a change of depth also needs a path
        heading_changes = (
            {} if config.test.depth else {"test": (config.test.heading, config.test.duration)}
        )
        if config.conditions is not None:
            main_conditions = config.conditions.stated
            if config.test.depth is None:
                heading_changes["conditions.stated"] = (
                    main_conditions.heading[0],
                    main_conditions.duration,
                )
            for name, conditions in config.conditions.all_conditions.items():
                if conditions.bias + _DISTURBANCE_STD_FACTOR * conditions.push >= config.rudder:
                    raise ConfigError(
                        f"conditions.{name}: a bias of {math.degrees(conditions.bias):.3g} deg and"
                        f" a push of {math.degrees(conditions.push):.3g} deg need all of the"
                        f" rudder of {math.degrees(config.rudder):.3g} deg; increase the rudder, or"
                        " reduce bias or push"
                    )
        for key, (change, duration) in heading_changes.items():
            minimum_time = minimum_turn_time(nomoto, config.rudder, vessel.rate, change)
            if minimum_time > duration:
                raise ConfigError(
                    f"{key}.duration: a change of heading of {math.degrees(change):.3g} deg takes"
                    f" this vessel at least {minimum_time:.3g} s, given {duration:.3g} s; increase"
                    " the duration or the rudder"
                )
        for model, dt in learned_models:
            model.estimate_nomoto(self.rudder, self.turning_time, dt)

    def training_vessel(self, name: str) -> SteeredPlant | SteeredModel:
        """Return the vessel of a training: the vessel under the conditions, or a learned model.

        Raises:
            UsageError: if the run or the model is missing.
            ConfigError: if its inputs differ from the vessel's inputs, or the conditions have
                weather, which a learned model does not describe.
        """
        assert self.conditions is not None
        learned_config = self.policies[name].learned
        has_weather = any(
            conditions.has_weather for conditions in self.conditions.all_conditions.values()
        )
        if learned_config is None:
            plant = load_vessel(self.vessel).build()
            return SteeredPlant(plant, in_calm_water=not has_weather, axis=self.axis)
        if has_weather:
            raise ConfigError(
                f"policies.{name}.learned: a learned model does not describe wind and current;"
                " remove them from conditions"
            )
        spec, model = load_model(
            learned_config.run
            / "models"
            / resolve_model_name(learned_config.run, learned_config.model)
        )
        return SteeredModel(model, spec.signals.regressor_columns, spec.hold, self.steered_vessel)

    def with_scaled_times(self) -> AutopilotConfig:
        """Return the config with its times multiplied by its pace, the pace itself being one.

        Delays of the electronics are not scaled. `overshoot_weight` and `travel_weight` are scaled,
        because they are costs of a degree in s.

        Raises:
            FitError: if the vessel does not turn steadily.
        """
        pace = self.pace
        if pace == "vessel":
            vessel = self.steered_vessel
            nomoto = vessel.estimate_nomoto(self.rudder, self.turning_time)
            minimum_time = minimum_turn_time(nomoto, self.rudder, vessel.rate)
            # rounded to two digits, so that the scaled times are readable
            pace = float(f"{minimum_time / minimum_turn_time(*REFERENCE_STEERING, None):.2g}")
            log_message(f"  pace {pace:g}: a change of 30 deg takes {minimum_time:.3g} s at least")
        if pace == 1.0 or self.conditions is None:
            return self

        def scale_fields(config: Any, *names: str) -> Any:
            values = {name: getattr(config, name) for name in names}
            return config.model_copy(
                update={n: float(f"{pace * v:.6g}") for n, v in values.items() if v is not None}
            )

        def scale_conditions(conditions: ConditionsConfig) -> ConditionsConfig:
            time_fields = (
                "hold",
                "duration",
                "push_time",
                "dt",
                "overshoot_weight",
                "travel_weight",
            )
            scaled: ConditionsConfig = scale_fields(conditions, *time_fields)
            return scaled

        scaled_conditions = {
            name: scale_conditions(item) for name, item in self.conditions.all_conditions.items()
        }
        conditions = {"stated": scaled_conditions.pop("stated"), "beyond": scaled_conditions}
        policies = {
            name: item.model_copy(
                update={
                    "training": item.training
                    and scale_fields(item.training, "dt", "hold", "duration")
                }
            )
            for name, item in self.policies.items()
        }
        updates = {
            "pace": 1.0,
            "test": scale_fields(self.test, "dt", "duration", "bias_time"),
            "conditions": self.conditions.model_copy(update=conditions),
            "policies": policies,
        }
        return self.model_copy(update=updates)

    def export_model(self, request: ExportRequest) -> Path:
        """Export a policy of a finished run for controllers; returns the file."""
        file: Path = self.call_executor("export_model", request)
        return file


_DISTURBANCE_STD_FACTOR = 2.0
"""Number of standard deviations of the slow disturbance that the rudder must compensate."""
_REFERENCE_STEP = math.radians(30.0)
"""Change of heading in rad whose minimum time defines the pace of a vessel."""
REFERENCE_STEERING = NomotoModel(3.47, 3.94, 3.2), math.radians(5.0)
"""K, T and rudder of the vessel of Gouletas 2020; times in configs refer to it at a pace of one."""


def minimum_turn_time(
    nomoto: NomotoModel, rudder_limit: float, rate: float | None, change: float = _REFERENCE_STEP
) -> float:
    """Return the smallest time in s of a change of heading [rad] by T r_dot + r = K delta.

    Time-optimal control: full rudder, then full counter-rudder until the yaw rate is zero at the
    new heading. The finite rate of the rudder adds the time of two movements from amidships.
    """
    steady_yaw_rate = abs(nomoto.gain) * rudder_limit
    time_constant = nomoto.time

    def turn_and_time(first_duration: float) -> tuple[float, float]:
        # from r(t1) = r_max (1 - exp(-t1 / T)) the counter-rudder needs T log(1 + r(t1) / r_max)
        second_duration = time_constant * math.log1p(
            1.0 - math.exp(-first_duration / time_constant)
        )
        return steady_yaw_rate * (
            first_duration - second_duration
        ), first_duration + second_duration

    lower = 0.0
    upper = time_constant
    while turn_and_time(upper)[0] < change:
        upper *= 2.0
    for _ in range(60):
        midpoint = 0.5 * (lower + upper)
        lower, upper = (
            (lower, midpoint) if turn_and_time(midpoint)[0] > change else (midpoint, upper)
        )
    return turn_and_time(upper)[1] + (0.0 if rate is None else 2.0 * rudder_limit / rate)
