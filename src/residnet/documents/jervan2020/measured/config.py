"""What an analysis of force residuals on measured logs is made of (document 002 chapter 5)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from residnet.core.config import Config, ConfigPath, Seconds
from residnet.core.errors import ConfigError
from residnet.data.prepare import PrepareConfig
from residnet.data.readers import ReaderConfig
from residnet.data.split import matches
from residnet.documents.jervan2020.regressions import SurfaceRegression
from residnet.documents.jervan2020.residual_model import ResidualModelConfig
from residnet.physics.fossen import Fossen3, FossenVessel, HullConfig
from residnet.physics.vessel import load_vessel

_Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$")]
_Channels = tuple[str, str, str]


class ForceLogs(Config):
    """Measured logs; which part of them tests is said by `validation`.

    Attributes:
        reader: format and channel map.
        root: folder that the patterns start from.
        logs: files or patterns such as `nlp*.csv`.
    """

    reader: ReaderConfig
    root: ConfigPath
    logs: tuple[str, ...] = Field(min_length=1)

    def files(self) -> list[Path]:
        """All logs, each once.

        Raises:
            ConfigError: where the folder is not there or a pattern matches nothing.
        """
        if not self.root.is_dir():
            raise ConfigError(f"data: root {self.root} is not a folder; correct `root`")
        return matches(self.root, self.logs, "data: logs")


class ForceChannels(Config):
    """Channels of the logs beside x, y, psi, u, v and r.

    Attributes:
        actual: forces that acted, from measured revolutions and angles of the thrusters, in N, N, N
            m.
        commanded: forces that were asked for.
        acceleration: measured accelerations of u, v and r; null where there are none.
    """

    actual: _Channels
    commanded: _Channels
    acceleration: _Channels | None = None

    def columns(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.commanded, *self.actual, *(self.acceleration or ()))


class FoldsConfig(Config):
    """Cross-validation: every sample is predicted by a model that saw nothing near it.

    Attributes:
        folds: parts that are left out in turn; whole logs where there are at least three, else
            equal stretches of time of each log.
        gap: seconds before and after a left-out stretch that no model learns from either.
        segment: seconds that belong together: a fold of the inner cross-validation that chooses
            orders and penalties, and what intervals resample.
    """

    folds: int = Field(default=5, ge=2)
    gap: Seconds = Field(default=5.0, ge=0)
    segment: Seconds = Field(default=30.0, gt=0)


class MeasuredModelConfig(ResidualModelConfig):
    """One model of the residual of measured forces.

    Attributes:
        force: which force it explains.
        published: MSE on the document's own test half without and with this model, in N^2, N^2, (N
            m)^2; another run of another ferry.
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


class ForceSettings(Config):
    """The residual force of a believed hull on measured logs, explained by regressions and judged
    where they saw nothing.

    Attributes:
        name: of the run.
        believed: vessel whose hull is the known part, by name or file.
        data: logs.
        prepare: grid, masks, and how velocities are smoothed and differentiated.
        channels: forces and accelerations.
        acceleration: `velocity`: derivative of the measured velocities; `measured`: the log's own,
            less its offset to that derivative.
        validation: cross-validation.
        models: by name.
    """

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    description: str = ""
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
        """The known part.

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
