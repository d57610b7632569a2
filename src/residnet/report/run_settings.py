"""The settings in the resolved.yaml of a run that its report shows.

The configs of tasks are defined in packages that import the report. These models read only the keys
that a page shows, and ignore all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from residnet.core.config import load_mapping
from residnet.core.errors import UsageError

SettingsT = TypeVar("SettingsT", bound="ShownSettings")


class ShownSettings(BaseModel):
    """Some keys of a mapping in a config."""

    model_config = ConfigDict(extra="ignore", frozen=True)


class ChannelSettings(ShownSettings):
    """The unit of a channel in the channel map of a reader; None for the canonical unit."""

    unit: str | None = None


class ReaderSettings(ShownSettings):
    """The reader of measured logs.

    Attributes:
        kind: format of the logs.
        channels: channel map.
    """

    kind: str = "files"
    channels: Mapping[str, ChannelSettings] = Field(default_factory=dict)


class NoiseSettings(ShownSettings):
    """Standard deviations of the noise of simulated sensors, in SI units and rad."""

    u: float = 0.0
    v: float = 0.0
    r: float = 0.0


class DataSettings(ShownSettings):
    """The source of the logs.

    Attributes:
        kind: `simulated` or `measured`.
        vessel: name of the simulated vessel.
        seed: seed of the simulation.
        noise: noise of the simulated sensors.
        reader: reader of measured logs.
    """

    kind: str = ""
    vessel: str | None = None
    seed: int | None = None
    noise: NoiseSettings | None = None
    reader: ReaderSettings | None = None


class RunSettings(ShownSettings):
    """The settings of a run of any task.

    Attributes:
        name: name of the run.
        description: one sentence on it.
        data: source of its logs.
    """

    name: str = ""
    description: str = ""
    data: DataSettings | None = None


class SignalSettings(ShownSettings):
    """The inputs of the models.

    Attributes:
        velocities: velocities of the models; empty if they are not recorded.
        inputs: commands or actuator states.
        exogenous: further inputs, such as wind.
        forces: vessel whose thrusters give the forces, or their settings; None for none.
    """

    velocities: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    exogenous: tuple[str, ...] = ()
    forces: object = None


class PartSettings(ShownSettings):
    """The kind of a part, such as a baseline."""

    kind: str = ""


class ProtocolSettings(ShownSettings):
    """A protocol of free runs.

    Attributes:
        kind: `windows` or `manoeuvre`.
        length: length of a window in s.
        first: start of the first window in s.
        initial: time over which initial velocities are averaged, in s.
    """

    kind: str = "not described"
    length: float | None = None
    first: float = 0.0
    initial: float | None = None


class EvaluationSettings(ShownSettings):
    """The evaluation by free runs.

    Attributes:
        selection: protocol that selects the model; empty if it is not recorded.
        protocols: protocols by name.
    """

    selection: str = ""
    protocols: Mapping[str, ProtocolSettings] = Field(default_factory=dict)


class TrainingStage(ShownSettings):
    """A stage of training over free runs of `horizon` seconds."""

    horizon: float


class TrainingSettings(ShownSettings):
    """The training of a network; `multi_step` are its stages over free runs."""

    multi_step: tuple[TrainingStage, ...] = ()


class InputShareSettings(ShownSettings):
    """An input in the manoeuvres of a booklet.

    Attributes:
        steer: value at the full steering command, SI or text with a unit; None or 0 for an input
            that does not steer.
        rate: rate of the steering gear in rad/s or text with a unit; None if it is not limited.
        lag: time constant of the steering gear in s; None for none.
        delay: dead time of the steering gear in s; None for none.
    """

    steer: float | str | None = None
    rate: float | str | None = None
    lag: float | None = None
    delay: float | None = None


class BookletSettings(ShownSettings):
    """The manoeuvring booklet; `inputs` are the inputs of the models by name."""

    inputs: Mapping[str, InputShareSettings] = Field(default_factory=dict)


class FitRunSettings(RunSettings):
    """The settings of a fit.

    Attributes:
        signals: inputs of the models.
        baseline: first baseline; None if it is not recorded.
        evaluation: evaluation by free runs.
        training: training of the networks by model.
        booklet: manoeuvring booklet; None without one.
    """

    signals: SignalSettings = SignalSettings()
    baseline: PartSettings | None = None
    evaluation: EvaluationSettings = EvaluationSettings()
    training: Mapping[str, TrainingSettings] = Field(default_factory=dict)
    booklet: BookletSettings | None = None


class HeadSettings(ShownSettings):
    """The settings of a residual head.

    Attributes:
        kind: kind of head.
        features: channels that it reads; empty for all.
        hidden: sizes of the layers of a network.
        hidden_size: number of hidden units of a recurrent network.
        per_axis: whether each axis has its own settings.
    """

    kind: str = ""
    features: tuple[str, ...] | None = None
    hidden: tuple[int, ...] | int | None = None
    hidden_size: int | None = None
    per_axis: bool = False


class ModelSettings(ShownSettings):
    """The description of a model in its model.json.

    Attributes:
        role: kind of the model.
        signals: inputs of the model.
        head: residual head; None without one.
        dt: step in s; None if it is not recorded.
        integrator: integration scheme.
        low: smallest training value of each velocity and input.
        high: largest training value of each velocity and input.
    """

    role: str = ""
    signals: SignalSettings = SignalSettings()
    head: HeadSettings | None = None
    dt: float | None = None
    integrator: str = ""
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()


def read_settings(run: Path, kind: type[SettingsT]) -> SettingsT:
    """Read the shown settings of a run; defaults if it has no resolved.yaml.

    Args:
        run: the run folder.
        kind: class of the settings.

    Raises:
        UsageError: if a key has another type.
        ResidnetError: if the file is not readable.
    """
    path = run / "resolved.yaml"
    return parse_settings(load_mapping(path) if path.is_file() else {}, kind, path)


def parse_settings(content: Mapping[str, object], kind: type[SettingsT], path: Path) -> SettingsT:
    """Return the shown settings in the contents of a file.

    Raises:
        UsageError: if a key has another type.
    """
    try:
        # null means that a key is not set
        return kind.model_validate({key: value for key, value in content.items() if value})
    except ValidationError as error:
        first_error = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first_error["loc"])
        raise UsageError(
            f"{path}: key '{key}': {first_error['msg'].lower()}; restore the file or repeat the run"
        ) from None
