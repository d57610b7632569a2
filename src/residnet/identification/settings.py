"""Settings of an identification, without the source of the logs and the run folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from residnet.baselines import BaselineConfig
from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.config import Config, validate_config
from residnet.core.errors import ConfigError
from residnet.core.external_parts import is_external_part
from residnet.core.model_names import BASELINE, CONSTANT_VELOCITY, PLANT
from residnet.core.names import suggest_name
from residnet.core.registry import is_python_part
from residnet.dynamics.time_steps import Integrator
from residnet.evaluation.band import BandsConfig
from residnet.evaluation.protocol import EvaluationConfig
from residnet.heads import HeadConfig
from residnet.identification.recipe import PART_KEYS, TrainingDataSummary, make_portfolio
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig
from residnet.training.config import TrainingConfig
from residnet.training.current_config import CurrentConfig
from residnet.training.refit_config import RefitConfig

_RESERVED_NAMES = (CONSTANT_VELOCITY, BASELINE, PLANT)


class ModelPartsConfig(Config):
    """The models of a fit.

    Attributes:
        baseline: physical part of the models; required without a recipe.
        baselines: further baselines by name, which heads may use.
        refit: baselines (by name, `baseline` for the first) whose coefficients are refitted through
            rollouts after least squares.
        heads: residual heads by name.
        base_of: baseline of each head by the head's name; `baseline` by default,
            `constant_velocity` for a black-box head.
        ensembles: models by name that average the accelerations of their members.
        means: models by name that average the trajectories of their members; members that diverge
            on a validation window are removed.
        training: training settings by head; other settings follow from the logs.
    """

    baseline: BaselineConfig = ZeroBaselineConfig()
    baselines: dict[str, BaselineConfig] = Field(default_factory=dict)
    refit: dict[str, RefitConfig] = Field(default_factory=dict)
    heads: dict[str, HeadConfig] = Field(default_factory=dict)
    base_of: dict[str, str] = Field(default_factory=dict)
    ensembles: dict[str, Annotated[tuple[str, ...], Field(min_length=2)]] = Field(
        default_factory=dict
    )
    means: dict[str, Annotated[tuple[str, ...], Field(min_length=2)]] = Field(default_factory=dict)
    training: dict[str, TrainingConfig] = Field(default_factory=dict)


class FitSettings(ModelPartsConfig):
    """Settings of an identification.

    Attributes:
        seed: seed of weights and batches.
        prepare: grid, masks, derivatives.
        signals: inputs of the models.
        integrator: integration scheme; the models use the step of the grid.
        current: estimation of constant currents of training and validation logs; null for still
            water.
        evaluation: protocols and scales.
        bands: calibration of prediction intervals by cross-validation over logs; null for none.
        recipe: `standard` sets the parts: a linear baseline, a hull, networks on the hull, for long
            logs also black-box networks, and `ensemble`, the mean of the trajectories of hull and
            networks, which is reported first and exported by default. Terms, sizes and trainings
            follow from the logs. `model_tests` is the same with a hull for tests of a model basin:
            rudder forces saturate, and the asymmetry of a single propeller is not shrunk. Null for
            explicit parts.
        effort: factor of the duration of trainings that follow from the logs: 1 for the usual one,
            less for a quick look.
    """

    seed: int = Field(default=0, ge=0)
    prepare: PrepareConfig
    signals: SignalsConfig
    integrator: Integrator = "rk4"
    current: CurrentConfig | None = None
    evaluation: EvaluationConfig
    bands: BandsConfig | None = BandsConfig()
    recipe: Literal["standard", "model_tests"] | None = None
    effort: float = Field(default=1.0, gt=0, le=10)

    @model_validator(mode="after")
    def apply_recipe(self) -> FitSettings:
        """Set the parts to the portfolio of the recipe, before any log is read."""
        specified_parts = [key for key in PART_KEYS if key in self.model_fields_set]
        if self.recipe is None:
            if "baseline" not in specified_parts:
                raise ValueError("baseline: missing; give its kind, or use `recipe: standard`")
            return self
        if specified_parts:
            raise ValueError(
                f"recipe: {self.recipe} sets {', '.join(PART_KEYS)}; remove"
                f" '{specified_parts[0]}' or the recipe"
            )
        return self.with_parts(TrainingDataSummary.from_channel_names(self.signals.channel_names()))

    def with_parts(self, data_summary: TrainingDataSummary) -> Self:
        """Return the settings with the parts of the recipe for the given logs."""
        portfolio = make_portfolio(data_summary, has_model_tests=self.recipe == "model_tests")
        parts = validate_config(portfolio, ModelPartsConfig, "recipe")
        return self.model_copy(update={key: getattr(parts, key) for key in PART_KEYS})

    @model_serializer(mode="wrap")
    def serialize_without_recipe_parts(
        self, default_serializer: SerializerFunctionWrapHandler
    ) -> dict[str, Any]:
        """Omit the parts that the recipe sets."""
        # a written config must be readable again, and with a recipe explicit parts are refused
        content: dict[str, Any] = default_serializer(self)
        if self.recipe is not None:
            content = {key: value for key, value in content.items() if key not in PART_KEYS}
        return content

    @model_validator(mode="after")
    def check_combination(self) -> FitSettings:
        if self.current is not None and not self.signals.dof.is_planar:
            raise ValueError(
                "current: a current is estimated from u, v and r together with a position; remove"
                f" `current` for a model of {', '.join(self.signals.velocities)}"
            )
        scale_names = tuple(self.evaluation.scales.to_dict())
        required_names = self.signals.dof.active_states
        if scale_names != required_names:
            raise ValueError(
                f"evaluation.scales: the model needs one scale for each of"
                f" {', '.join(required_names)} (signals.velocities); scales are given for"
                f" {', '.join(scale_names) or 'none'}"
            )
        baseline_configs = self.all_baselines
        single_names = (*baseline_configs, *self.heads)
        combined_names = (*self.ensembles, *self.means)
        model_names = (*single_names, *combined_names)
        for name in (*self.baselines, *self.heads, *combined_names):
            if (
                name in _RESERVED_NAMES
                or model_names.count(name) > 1
                or not name.replace("_", "").replace("-", "").isalnum()
            ):
                raise ValueError(
                    f"'{name}' cannot name a model; use letters, digits, '-', '_', each name once"
                    f" and none of {', '.join(_RESERVED_NAMES)}"
                )
        check_known_names("training", self.training, self.heads, "head")
        check_known_names("base_of", self.base_of, self.heads, "head")
        if "zero" in self.base_of.values() and "zero" not in baseline_configs:
            # configs of earlier versions used this name
            raise ValueError("base_of: the model 'zero' is now named 'constant_velocity'")
        check_known_names(
            "base_of", self.base_of.values(), (CONSTANT_VELOCITY, *baseline_configs), "baseline"
        )
        check_known_names("refit", self.refit, baseline_configs, "baseline")
        members = (name for names in self.ensembles.values() for name in names)
        check_known_names("ensembles", members, single_names, "model")
        members = (name for names in self.means.values() for name in names)
        check_known_names("means", members, single_names, "model")
        self.check_parts_fit_together()
        return self

    def check_parts_fit_together(self) -> None:
        """Refuse incompatible parts before any log is read."""
        names = self.signals.channel_names()
        baselines = self.all_baselines
        part_configs: dict[str, Any] = {**baselines, **self.heads}
        for part_name, part_config in part_configs.items():
            try:
                if is_external_part(part_config) or is_python_part(part_config):
                    # only parts of other packages and of Python, because this imports PyTorch
                    from residnet.dynamics.first_step import check_first_step

                    check_first_step(part_config, names)
                part_config.check_channels(names)
            except ConfigError as error:
                raise ValueError(f"{part_name}: {error}") from None
        for part_name, head_config in self.heads.items():
            baseline_config = self.get_baseline_config(part_name)
            try:
                head_config.check_inertia(
                    names, has_inertia_matrix=baseline_config.has_inertia_matrix(names)
                )
            except ConfigError as error:
                raise ValueError(f"heads.{part_name}: {error}") from None
        self._check_ensemble_members(names)
        self._check_refits_and_current(names)

    def _check_ensemble_members(self, names: Sequence[str]) -> None:
        """Refuse heads that read an innovation as members of an ensemble.

        The accelerations of the members are averaged at one common state in each step. The
        innovation of a head compares this state to the one that its own model predicted.
        """
        for ensemble, members in self.ensembles.items():
            for name in members:
                if name in self.heads and self.heads[name].has_innovations(names):
                    raise ValueError(
                        f"ensembles.{ensemble}: '{name}' reads the innovation of its own predicted"
                        " velocities, so that its accelerations cannot be averaged with those of"
                        " other models; list it under `means`, which averages trajectories"
                    )

    def _check_refits_and_current(self, names: Sequence[str]) -> None:
        """Refuse a refit or an estimate of currents with a baseline that does not support it."""
        baselines = self.all_baselines
        for name in self.refit:
            if not baselines[name].is_parametric(names):
                raise ValueError(
                    f"refit.{name}: a refit through rollouts needs a baseline of kind 'regressors',"
                    " 'linear_steady', 'mmg', 'nomoto' or 'nomoto_sideslip'"
                )
        if self.current is not None:
            name = self.current.baseline
            check_known_names("current.baseline", (name,), baselines, "baseline")
            if not baselines[name].has_regressors(names):
                raise ValueError(
                    f"current.baseline: '{name}' has no regressors to estimate a current with;"
                    " name a baseline of kind 'regressors' or 'linear_steady'"
                )

    @property
    def all_baselines(self) -> dict[str, BaselineConfig]:
        """Every baseline by name, the first as `baseline`."""
        return {"baseline": self.baseline, **self.baselines}

    @property
    def model_names(self) -> tuple[str, ...]:
        """Names of all models but `constant_velocity`: baselines, heads, ensembles."""
        return (*self.all_baselines, *self.heads, *self.ensembles, *self.means)

    def get_baseline_name(self, head_name: str) -> str:
        """Return the name of the baseline whose residual a head predicts."""
        return self.base_of.get(head_name, "baseline")

    def get_baseline_config(self, head_name: str) -> BaselineConfig:
        """Return the config of the baseline whose residual a head predicts."""
        name = self.get_baseline_name(head_name)
        return ZeroBaselineConfig() if name == CONSTANT_VELOCITY else self.all_baselines[name]


def check_known_names(
    config_key: str, names_to_check: Iterable[str], valid_names: Iterable[str], noun: str
) -> None:
    """Check that every given name is one of the valid ones.

    Args:
        config_key: setting that contains the names, for the message.
        names_to_check: names in the config.
        valid_names: names that may be used.
        noun: kind of the named objects, for the message.

    Raises:
        ValueError: if a name is unknown; the message suggests the most similar valid name.
    """
    valid_names = tuple(valid_names)
    for name in names_to_check:
        if name not in valid_names:
            raise ValueError(
                f"{config_key}: no {noun} is named '{name}'{suggest_name(name, valid_names)}"
            )
