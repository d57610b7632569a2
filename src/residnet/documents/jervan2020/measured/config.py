"""Config of force residuals on measured logs (document 002, chapter 5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config, ConfigPath, Seconds
from residnet.core.errors import ConfigError
from residnet.data.parts import matches
from residnet.data.prepare import PrepareConfig
from residnet.data.readers import ReaderConfig
from residnet.documents.jervan2020.regressions import SurfaceRegression
from residnet.documents.jervan2020.residual_model import ResidualModelConfig
from residnet.physics.fossen import Fossen3, FossenVessel, HullConfig
from residnet.physics.vessel import load_vessel
from residnet.runs.task import ComputingTask

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
_Channels = tuple[str, str, str]


class ForceLogs(Config):
    """Measured logs; `validation` says which part of them tests.

    Attributes:
        reader: format of the logs and their channel map.
        root: folder that the patterns start from.
        logs: file names or patterns such as `nlp*.csv`.
    """

    reader: ReaderConfig
    root: ConfigPath
    logs: tuple[str, ...] = Field(min_length=1)

    def files(self) -> list[Path]:
        """Return the paths of all logs, each once.

        Raises:
            ConfigError: where the folder is not there or a pattern matches nothing.
        """
        if not self.root.is_dir():
            raise ConfigError(f"data: root {self.root} is not a folder; correct `root`")
        return matches(self.root, self.logs, "data: logs")


class ForceChannels(Config):
    """Names of the channels of force and acceleration, beside x, y, psi, u, v and r.

    Attributes:
        actual: forces that acted, in N, N, N m, from measured revolutions and angles of the
            thrusters.
        commanded: forces that the controller commanded, in N, N, N m.
        acceleration: measured accelerations of u, v, r in m/s^2, m/s^2, rad/s^2; null where there
            are none.
    """

    actual: _Channels
    commanded: _Channels
    acceleration: _Channels | None = None

    def columns(self) -> tuple[str, ...]:
        """Return all channels: commanded, actual and measured acceleration."""
        return (*self.commanded, *self.actual, *(self.acceleration or ()))


class FoldsConfig(Config):
    """Cross-validation in which no model is fitted to data near what it predicts.

    Attributes:
        folds: number of parts that are left out in turn: whole logs where there are at least three,
            else equal stretches of time of each log.
        gap: time in s before and after a left-out stretch that is left out of the fit too.
        segment: length in s of the segments that the inner cross-validation leaves out to choose
            orders and penalties, and that the intervals resample.
    """

    folds: int = Field(default=5, ge=2, le=1_000)
    gap: Seconds = Field(default=5.0, ge=0)
    segment: Seconds = Field(default=30.0, gt=0)


class MeasuredModelConfig(ResidualModelConfig):
    """One regression of the residual of measured forces.

    Attributes:
        force: force that the model explains: the actual or the commanded one.
        published: mean square of the residual on the document's own test half, without and with
            this model, in N^2, N^2, (N m)^2; from other trials, with the ferry as it was then.
    """

    force: Literal["actual", "commanded"] = "actual"
    published: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None

    @model_validator(mode="after")
    def _combination(self) -> MeasuredModelConfig:
        if self.lag and self.force != "commanded":
            raise ValueError(
                "lag: forces lag behind commands; set force to 'commanded', or leave lag out"
            )
        if isinstance(self.fit, SurfaceRegression) and self.fit.choose == "test":
            raise ValueError(
                "fit.choose: 'test' lets the samples that judge a model choose it; take simplest or"
                " least"
            )
        return self


class ForceSettings(ComputingTask):
    """Regressions of the residual force of a believed hull on measured logs, cross-validated.

    Attributes:
        believed: vessel whose hull is the known part, by name or file.
        data: the measured logs.
        prepare: time grid, masks, and how velocities are smoothed and differentiated.
        channels: names of the channels of force and acceleration.
        acceleration: acceleration of the regressors: `velocity` for the derivative of the measured
            velocities, `measured` for the log's own acceleration less its mean difference from that
            derivative.
        validation: how the models are cross-validated.
        models: regressions by name.
    """

    believed: str
    data: ForceLogs
    prepare: PrepareConfig
    channels: ForceChannels
    acceleration: Literal["velocity", "measured"] = "velocity"
    validation: FoldsConfig = FoldsConfig()
    models: dict[_Name, MeasuredModelConfig] = Field(min_length=1)

    @model_validator(mode="after")
    def _combination(self) -> ForceSettings:
        if taken := sorted({"zero", "believed"} & set(self.models)):
            raise ValueError(f"'{taken[0]}' cannot name a model: it stands beside all of them")
        if self.acceleration == "measured" and self.channels.acceleration is None:
            raise ValueError("acceleration: 'measured' needs channels.acceleration")
        if self.prepare.hold != "start":
            raise ValueError("prepare.hold: nothing runs forward here, leave it out")
        if (
            self.validation.gap < self.prepare.grid.step
            or self.validation.segment < 10 * self.prepare.grid.step
        ):
            raise ValueError(
                "validation: gap holds at least one step of the grid, segment at least ten"
            )
        try:
            self.hull()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    def hull(self) -> Fossen3:
        """Return the known hull.

        Raises:
            ConfigError: where the vessel is no hull by matrices.
        """
        config = load_vessel(self.believed)
        vessel = config.build() if isinstance(config, HullConfig) else None
        if not isinstance(vessel, FossenVessel):
            raise ConfigError(
                f"believed: '{self.believed}' is of kind '{config.kind}'; a believed hull needs one"
                " of kind fossen or mass_matrix"
            )
        return vessel.hull
