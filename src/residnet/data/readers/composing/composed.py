"""The config that says what to take from a recording, and the reader that composes it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Literal, final

from pydantic import Field, model_validator

from residnet.core.config import Config, Seconds
from residnet.core.log import Log
from residnet.data.readers.base import LogReader, require_samples
from residnet.data.readers.composing.clocks import align_clocks
from residnet.data.readers.composing.compose import Plan, compose
from residnet.data.readers.composing.quantities import (
    ClockConfig,
    Derived,
    FieldMap,
    HeadingConfig,
    OfTopic,
    PositionConfig,
    Uniform,
    VelocityConfig,
)
from residnet.data.readers.composing.wanted import CLOCK_ONLY, EVERYTHING, Wanted
from residnet.data.readers.files import digest
from residnet.data.readers.messages import standard_plan
from residnet.data.readers.recording import Recording


class RecordingConfig(Config, ABC):
    """What to take from a recording.

    Attributes:
        channels: canonical names (or names of your own) -> field of a topic.
        position: source of x and y.
        heading: source of psi.
        velocity: source of u and v (and r) where they are not channels.
        standard_messages: standard messages of ROS map themselves to what is not declared, by
            REP-103 (ENU, forward-left-up).
        clock: the log's clock.
        delays: topic -> time in s by which what it says is older than its time says; `estimated`
            takes, for a topic without header stamps, the usual latency of those that have them.
        zone: time by which the recorder's clock is ahead of UTC, s; null estimates it where topics
            have stamps and arrivals.
        longest_gap: longest step that is interpolated across, s; slow topics may always step over
            three of their usual steps.
        manoeuvre: kind of manoeuvre of every recording, `folder` takes the name of the folder it
            lies in, null says that it is not known.
    """

    channels: dict[str, FieldMap] = Field(default_factory=dict)
    position: PositionConfig | None = None
    heading: HeadingConfig | None = None
    velocity: VelocityConfig | None = None
    standard_messages: bool = True
    clock: ClockConfig = Field(default_factory=OfTopic)
    delays: dict[str, Seconds | Literal["estimated"]] = Field(default_factory=dict)
    zone: Seconds | None = None
    longest_gap: Seconds = Field(default=1.0, gt=0.0)
    manoeuvre: str | None = None

    @model_validator(mode="after")
    def _fits(self) -> RecordingConfig:
        for name, entry in self.channels.items():
            entry.require_fit(name)
        if isinstance(self.velocity, Derived) and not isinstance(self.clock, Uniform):
            raise ValueError(
                "velocity: kind 'derived' needs a uniform clock; set clock: {kind: uniform, step:"
                " 0.1 s}"
            )
        given = [
            name
            for name, there in (
                ("x, y", self.position),
                ("psi", self.heading),
                ("u, v", self.velocity),
            )
            if there is not None
        ]
        double = [name for names in given for name in names.split(", ") if name in self.channels]
        if double:
            raise ValueError(
                f"channels: {', '.join(double)} given here and by position, heading or velocity;"
                " take one of them away"
            )
        return self

    @abstractmethod
    def load(self, path: Path, wanted: Wanted) -> Recording:
        """Return the recording in `path`, at least the series that are wanted.

        Raises:
            ResidnetError: where it cannot be read.
        """

    def build(self) -> RecordingReader:
        """Build the reader of recordings with this config."""
        return RecordingReader(self)


@final
class RecordingReader(LogReader):
    """Reads a recording and composes one log from it."""

    def __init__(self, config: RecordingConfig) -> None:
        self._config = config

    def read(self, path: Path) -> Log:
        """Return the log in `path`.

        See `LogReader.read`. `meta["findings"]` says what was noticed and mended on the way in.

        Raises:
            UsageError: where the file, a topic or a field is missing, or a package that the format
                needs.
            DataError: where the contents cannot be used.
        """
        config = self._config
        delays = {
            topic: None if delay == "estimated" else delay for topic, delay in config.delays.items()
        }
        recording = align_clocks(config.load(path, self._wanted()), delays, config.zone)
        plan = Plan(config.channels, config.position, config.heading, config.velocity)
        if config.standard_messages:
            plan = standard_plan(recording, plan)
        log = compose(recording, plan, config.clock, config.longest_gap)
        require_samples(path, log.t)
        manoeuvre = path.resolve().parent.name if config.manoeuvre == "folder" else config.manoeuvre
        meta = {**log.meta, "source": str(path), "sha256": digest(recording.files or (path,))}
        name = path.name if path.is_dir() else path.stem
        return log.replace(name=name, manoeuvre=manoeuvre or "unknown", meta=meta)

    def _wanted(self) -> Wanted:
        """Return what the config names; everything where standard messages may add to it."""
        config = self._config
        if config.standard_messages:
            return EVERYTHING
        named = [(entry.topic, entry.field) for entry in config.channels.values()]
        for source in (config.position, config.heading, config.velocity):
            if source is not None and not isinstance(source, Derived):
                named += [(source.topic, field) for field in source.fields]
        clock = (
            [(config.clock.topic, CLOCK_ONLY)]
            if isinstance(config.clock, OfTopic) and config.clock.topic is not None
            else []
        )
        return Wanted([*named, *clock])
