"""The config of the task `autopilot`: vessel, test, policies and their peers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator

from residnet.control.conditions.config import ConditionsConfig
from residnet.control.conditions.evolution import EvolutionConfig
from residnet.control.heading.controllers import BangBangConfig
from residnet.control.observed.config import AnyController, ObservedConfig
from residnet.control.observed.stored import NetworkPolicySpec, ObservedPolicySpec, RecurrentSpec
from residnet.core.config import Config, MetresPerSecond, Radians, Seconds
from residnet.core.names import nearest
from residnet.data.simulated.environment import Disturbance, WindField
from residnet.documents.gouletas2020.config import PredictiveConfig
from residnet.dynamics.simulated import check_steps
from residnet.physics.environment.waves import WavesConfig
from residnet.physics.vessel import VesselName, load_vessel
from residnet.runs.task import ComputingTask
from residnet.training.policies.autopilot_config import AutopilotTraining, SpreadConfig
from residnet.training.policies.conditions_config import ConditionsTraining

_Units = Annotated[int, Field(ge=1)]
_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]


class LearnedConfig(Config):
    """A model of the vessel that an earlier run (task `fit`) identified from logs.

    Attributes:
        run: folder of that run.
        model: name of the model; `selected` is the one chosen on validation data.
    """

    run: Path
    model: str = "selected"


class PolicyConfig(Config):
    """A neural heading policy.

    Attributes:
        hidden: widths of the layers.
        observer: bandwidth of the disturbance observer as a multiple of 1/T.
        training: how it is trained.
        learned: a learned model to train on instead of the vessel itself; the policy is then
            compared on the vessel.
        imitate: name of a peer whose commands it learns to give; null to train it for fast changes
            without overshoot.
    """

    hidden: Annotated[tuple[_Units, ...], Field(min_length=1)] = (24, 24)
    observer: float = Field(default=8.0, ge=1)
    training: AutopilotTraining = AutopilotTraining()
    learned: LearnedConfig | None = None
    imitate: _Name | None = None


class RecurrentConfig(Config):
    """A recurrent heading policy, trained under the run's conditions.

    Attributes:
        start: name of a peer with an observer, of kind `ptos` or `lqr_observer`: the network stands
            beside its law, whose constants as tuned are where training begins, and they are trained
            too. Null for a network alone, without law, observer or predictor.
        units: of the recurrent network; 0 trains the constants of a law alone.
        training: how it is trained.
    """

    start: _Name | None
    units: int = Field(default=16, ge=0, le=10_000)
    training: ConditionsTraining = ConditionsTraining()

    @property
    def spec(self) -> type[RecurrentSpec]:
        """The kind of description that the policy is stored with."""
        return NetworkPolicySpec if self.start is None else ObservedPolicySpec

    @property
    def kind(self) -> str:
        """What the rows of metrics.json call it: policy, network, or constants."""
        if self.start is None:
            return "network"
        return "policy" if self.units else "constants"

    @model_validator(mode="after")
    def _something(self) -> RecurrentConfig:
        if self.start is None and self.units == 0:
            raise ValueError("units: a policy without a law needs a network, at least one unit")
        return self


class JudgedConditions(Config):
    """The conditions that all controllers of a run are tuned, trained and judged under.

    Attributes:
        stated: the conditions themselves, with the cost of a flight.
        flights: number of judged flights, which no tuning or training sees.
        beyond: further conditions by name, outside of those of tuning and training, that
            controllers are judged under only.
        evolution: the search for the constants of peers.
        tuned_in: folder of a finished run of the same vessel, rudder, conditions and search, whose
            constants peers of the same name and kind take, so that runs with several seeds are
            compared with the same laws; null to tune them here.
    """

    stated: ConditionsConfig = ConditionsConfig()
    flights: int = Field(default=1500, ge=2, le=1_000_000)
    beyond: dict[_Name, ConditionsConfig] = Field(default_factory=dict)
    evolution: EvolutionConfig = EvolutionConfig()
    tuned_in: Path | None = None


class StepTestConfig(Config):
    """The one test of all controllers: a step of the heading reference, from straight ahead.

    Attributes:
        heading: change of the reference in rad; no prefilter smooths it.
        band: heading error in rad; the change has settled at the last entry into this band.
        overshoot: limit in rad that peers are tuned under, and that policies are chosen by.
        dt: step of simulation and controllers in s.
        duration: of a flight in s.
        plants: number of random vessels of the spread, beside its corners.
        bias: constant rudder angle of the steady-error test in rad.
        bias_error: largest heading error in rad that is left after `bias_time`.
        bias_time: duration of the steady-error test in s.
        wind: mean wind speed in m/s of the same test in wind, from eight directions and without
            bias; null for none.
        sea: waves in which the course is kept after the step; null for none.
        sea_time: how long in s, counted from the end of the step's flight.
    """

    heading: Radians = Field(default=0.5235987755982988, gt=0, lt=3.1)
    band: Radians = Field(default=0.017453292519943295, gt=0)
    overshoot: Radians = Field(default=0.0017453292519943296, gt=0)
    dt: Seconds = Field(default=0.02, gt=0)
    duration: Seconds = Field(gt=0)
    plants: int = Field(default=200, ge=1, le=100_000)
    bias: Radians = Field(default=0.017453292519943295, ge=0)
    bias_error: Radians = Field(default=0.0034906585039886592, gt=0)
    bias_time: Seconds = Field(default=60.0, gt=0)
    wind: MetresPerSecond | None = Field(default=None, gt=0)
    sea: WavesConfig | None = None
    sea_time: Seconds = Field(default=120.0, gt=0)

    @model_validator(mode="after")
    def _flown_in_time(self) -> StepTestConfig:
        for name in ("duration", "bias_time", "sea_time"):
            check_steps(getattr(self, name), self.dt, name)
        return self

    def weather(self) -> Disturbance:
        """Return the wind and waves that the vessel must be able to feel."""
        return Disturbance(
            wind=None if self.wind is None else WindField(speed=self.wind, direction=0.0),
            waves=self.sea,
        )


class AutopilotSettings(ComputingTask):
    """Heading policies trained through the vessel, beside tuned classical controllers.

    Attributes:
        seed: of weights, batches and random vessels.
        vessel: name or file of the vessel.
        rudder: largest rudder angle in rad that controllers may use.
        turning_time: time in s until the turn at that angle is steady.
        pace: multiple of all times in `test`, `conditions` and the trainings of `recurrent`,
            delays aside; `vessel` for how many times as long as that of document 004 the vessel
            takes for a heading change.
        spread: of vessels and disturbances, for training, tuning and comparison alike.
        test: the step of the heading reference that all controllers fly.
        policies: neural policies by name.
        predictive: the document's own autopilots, by name.
        conditions: that all controllers are tuned, trained and judged under; null to tune linear
            peers for the step of `test` alone.
        recurrent: policies with a recurrent network, by name, trained under `conditions`.
        peers: by name; gains that are left out are tuned.
        floor: peer that knows the vessel exactly: the others are measured in multiples of its
            settling time.
        tuning_points: candidates of each of four rounds of tuning.
        safe: what an exported policy commands while its inputs are wrong: the last good command, or
            rudder amidships.
    """

    seed: int = Field(default=0, ge=0)
    vessel: VesselName
    rudder: Radians = Field(gt=0, lt=1.5)
    turning_time: Seconds = Field(default=100.0, gt=0)
    pace: Literal["vessel"] | Annotated[float, Field(gt=0, le=1_000)] = 1.0
    spread: SpreadConfig = SpreadConfig()
    test: StepTestConfig
    policies: dict[_Name, PolicyConfig] = Field(default_factory=dict)
    conditions: JudgedConditions | None = None
    recurrent: dict[_Name, RecurrentConfig] = Field(default_factory=dict)
    predictive: dict[_Name, PredictiveConfig] = Field(default_factory=dict)
    peers: dict[_Name, AnyController] = Field(default_factory=dict)
    floor: _Name | None = None
    tuning_points: int = Field(default=256, ge=16, le=100_000)
    safe: Literal["hold", "amidships"] = "amidships"

    @model_validator(mode="after")
    def _names(self) -> AutopilotSettings:
        names = [*self.policies, *self.recurrent, *self.predictive, *self.peers]
        if not self.policies and not self.recurrent:
            raise ValueError("policies: give at least one policy here or under 'recurrent'")
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"'{twice[0]}' names two controllers; names are unique in a run")
        for name, policy in self.policies.items():
            if policy.imitate is not None and policy.imitate not in self.peers:
                raise ValueError(
                    f"policies.{name}.imitate: no peer"
                    f" '{policy.imitate}'{nearest(policy.imitate, self.peers)}"
                )
        if self.floor is not None and not isinstance(self.peers.get(self.floor), BangBangConfig):
            raise ValueError(f"floor: '{self.floor}' must name a peer of kind bang_bang")
        return self

    @model_validator(mode="after")
    def _under_conditions(self) -> AutopilotSettings:
        for name, wanted in self.recurrent.items():
            if self.conditions is None:
                raise ValueError(f"recurrent.{name}: give 'conditions' to train it under")
            if wanted.start is None:
                continue
            if not isinstance(self.peers.get(wanted.start), ObservedConfig):
                raise ValueError(
                    f"recurrent.{name}.start: '{wanted.start}' must name a peer of kind ptos or"
                    " lqr_observer"
                )
        for name, peer in self.peers.items():
            if self.conditions is not None or not isinstance(peer, ObservedConfig):
                continue
            if None in peer.parameters().values():
                raise ValueError(
                    f"peers.{name}: give all constants, or 'conditions' to tune them under"
                )
        if self.conditions is not None:
            flown = {"stated": self.conditions.stated, **self.conditions.beyond}
            for name, conditions in flown.items():
                if conditions.dt != self.test.dt:
                    raise ValueError(
                        f"conditions.{name}: dt must be that of test, {self.test.dt:g} s, given"
                        f" {conditions.dt:g} s"
                    )
        return self

    @model_validator(mode="after")
    def _at_a_pace(self) -> AutopilotSettings:
        if self.pace != 1.0 and (self.policies or self.predictive or self.conditions is None):
            raise ValueError(
                "pace: only runs under 'conditions' with policies under 'recurrent' alone have a"
                " pace; give the times of others as the vessel needs them"
            )
        return self

    @model_validator(mode="after")
    def _felt(self) -> AutopilotSettings:
        plant = load_vessel(self.vessel).build()
        one = torch.ones(1, dtype=torch.float64)
        most = float(plant.demand(one, one)[0, 0])
        if self.rudder > (1.0 + 1e-6) * most:
            raise ValueError(
                f"rudder: vessel '{self.vessel}' has {most:.4g} rad at most, given"
                f" {self.rudder:.4g}"
            )
        self.test.weather().check(plant, self.vessel)
        needs = dict.fromkeys(self.spread.needs(), "spread")
        if self.conditions is not None:
            for conditions in (self.conditions.stated, *self.conditions.beyond.values()):
                needs |= dict.fromkeys(conditions.needs(), "conditions")
        for name, key in needs.items():
            if name not in plant.inputs:
                raise ValueError(
                    f"{key}: vessel '{self.vessel}' has no input '{name}'; it has"
                    f" {', '.join(plant.inputs)}"
                )
        return self

    def recorded_seed(self) -> int:
        """Return the seed of weights, batches and random vessels."""
        return self.seed
