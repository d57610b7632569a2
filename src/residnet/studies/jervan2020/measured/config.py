"""Task `force_residual`: residual models of measured forces (Jervan 2020, chapter 5).

Every model is cross-validated and compared with two references: zero force and the believed hull.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar, Literal, final

from pydantic import Field, model_validator

from residnet.core.errors import ConfigError
from residnet.physics.hull import HullConfig
from residnet.physics.plant import Hull, HullPlant
from residnet.physics.vessel import load_vessel
from residnet.preprocessing.prepare import PrepareConfig
from residnet.runs.task import ComputingTask, PartName
from residnet.studies.jervan2020.force_logs import (
    FoldsConfig,
    ForceChannelsConfig,
    ForceLogsConfig,
)
from residnet.studies.jervan2020.residual import (
    ResidualModelConfig,
)
from residnet.studies.study import (
    StudyTask,
)

REFERENCE_MODELS = {"zero": "no force at all", "believed": "the believed model alone"}
"""Models without a regression, with which all others are compared."""


class MeasuredModelConfig(ResidualModelConfig):
    """One regression of the residual of measured forces.

    Attributes:
        lag: whether the lag of the thrusters is identified; null for no lag, since an actual force
            has none.
        force: force that the model explains: the actual or the commanded one.
        published: published mean square residuals on the test half of the document, without and
            with this model, in N^2, N^2, (N m)^2; from other trials.
    """

    lag: bool = False
    force: Literal["actual", "commanded"] = "actual"
    published: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    @property
    def evaluation_force(self) -> Literal["actual", "commanded"]:
        """The force on which the model is evaluated.

        A model with lag is evaluated on the actual force, because a fitted lag alone could make the
        residual of the command small.
        """
        return "actual" if self.lag else self.force

    @model_validator(mode="after")
    def _check_combination(self) -> MeasuredModelConfig:
        if self.lag and self.force != "commanded":
            raise ValueError(
                "lag: only commanded forces have a lag; set force to 'commanded', or remove lag"
            )
        if self.fit.choose == "test":
            raise ValueError(
                "fit.choose: with 'test' a model is selected on the samples of its evaluation; use"
                " simplest or least"
            )
        return self


@final
class ForceResidualConfig(StudyTask, ComputingTask):
    """Regressions of the residual force of a believed hull on measured logs, cross-validated.

    Attributes:
        task: `force_residual`.
        believed: vessel with the known hull, by name or file.
        data: the measured logs.
        prepare: time grid, masks, smoothing and differentiation of the velocities.
        channels: names of the channels of force and acceleration.
        validation: settings of the cross-validation.
        models: regressions by name.
    """

    executor_class: ClassVar[str] = "ForceResidualExecutor"
    results_file: ClassVar[str] = "force_residual.json"

    task: Literal["force_residual"]
    believed: str
    data: ForceLogsConfig
    prepare: PrepareConfig
    channels: ForceChannelsConfig
    validation: FoldsConfig = FoldsConfig()
    models: dict[PartName, MeasuredModelConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_combination(self) -> ForceResidualConfig:
        if reserved_names := sorted(set(REFERENCE_MODELS) & set(self.models)):
            raise ValueError(
                f"'{reserved_names[0]}' is reserved for a reference model; use another name"
            )
        if self.prepare.hold != "start":
            raise ValueError("prepare.hold: not used here, because nothing is simulated; remove it")
        if (
            self.validation.gap < self.prepare.grid.step
            or self.validation.segment < 10 * self.prepare.grid.step
        ):
            raise ValueError(
                "validation: gap must be at least one step of the grid, segment at least ten"
            )
        try:
            self.believed_hull()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def believed_hull(self) -> Hull:
        """Return the known hull.

        Raises:
            ConfigError: if the vessel has no hull model with matrices.
        """
        config = load_vessel(self.believed)
        vessel = config.build() if isinstance(config, HullConfig) else None
        if not isinstance(vessel, HullPlant):
            raise ConfigError(
                f"believed: '{self.believed}' is of kind '{config.kind}'; a believed hull needs one"
                " of kind fossen or mass_matrix"
            )
        return vessel.hull

    def input_files(self) -> Sequence[Path]:
        return self.data.find_paths()
