"""Typed contents of the JSON files that every task writes into its run folder."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from residnet.core.records import FileRecord, Record


class MainFigure(Record):
    """A main figure of a run in SI units.

    Attributes:
        value: the number; None if it is not finite.
        unit: unit of the value; `-` for a dimensionless number.
    """

    value: float | None
    unit: str


class SummaryFile(FileRecord):
    """summary.json: the results of a run in brief.

    Attributes:
        task: name of the task.
        finished: whether the run is complete.
        level: level of the verdict, a key of `residnet.evaluation.verdict.LEVEL_TEXTS`; empty
            without a verdict.
        verdict: sentences for a reader who reads nothing else.
        figures: main figures by name.
    """

    schema_name: Literal["residnet.summary/1"] = Field(alias="schema")
    task: str
    finished: bool
    level: str = ""
    verdict: tuple[str, ...]
    figures: dict[str, MainFigure]


class ProvenanceFile(FileRecord):
    """provenance.json: how a run was made.

    Attributes:
        residnet: version of residnet.
        command: arguments of the process.
        config: file of the config; None for a config made in Python.
        overrides: overrides of keys of the config.
        seed: seed of all random numbers.
        git: Git revision of residnet; None if it is not a checkout.
        python: version of Python.
        machine: operating system and processor.
        packages: versions of packages; None if a package is not installed.
        part_packages: versions of the packages that registered parts of the config, such as a
            reader, a baseline or a head.
        started: time of the start, UTC.
        seconds: duration in s.
        inputs: SHA-256 of each input file.
    """

    residnet: str
    command: tuple[str, ...]
    config: str | None
    overrides: tuple[str, ...]
    seed: int
    git: str | None
    python: str
    machine: str
    packages: dict[str, str | None]
    part_packages: dict[str, str] = Field(default_factory=dict)
    started: str
    seconds: float
    inputs: dict[str, str]


class ExportRow(Record):
    """The outcome of the export of one model.

    Attributes:
        model: name of the model.
        file: the exported file, relative to the run folder if it is in it; None if it failed.
        fault: why the model was not exported; None if it was.
    """

    model: str
    file: str | None
    fault: str | None


class ExportsFile(FileRecord):
    """exports.json: the outcome of each export.

    Attributes:
        exports: outcomes by model.
    """

    schema_name: Literal["residnet.exports/1"] = Field(alias="schema")
    exports: tuple[ExportRow, ...]
