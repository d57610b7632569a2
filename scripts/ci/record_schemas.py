"""Write the reference of the JSON files of a run folder from their typed records.

`python scripts/ci/record_schemas.py` writes `docs/reference/run_files.md` and one JSON schema per
file to `docs/reference/schemas`. With `--check` nothing is written, and the exit code is 1 if a
page is not current.
"""

from __future__ import annotations

import json
import pydoc
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel, RootModel
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from residnet.autopilot.records import (
    AutopilotMetricsFile,
    ControllersFile,
    CourseMetricsFile,
    PolicyNotes,
    RollMetricsFile,
)
from residnet.core.config import Config
from residnet.core.records import StoredFile
from residnet.core.run_records import ExportsFile, ProvenanceFile, SummaryFile
from residnet.evaluation.booklet_records import BookletFile, IndicesFile
from residnet.evaluation.data_records import DataQualityFile, ExcitationFile
from residnet.evaluation.derivatives import DerivativesFile
from residnet.evaluation.limits_records import LimitsFile
from residnet.evaluation.records import (
    BandsFile,
    GoodnessFile,
    MetricsFile,
    SanityFile,
    SelectionFile,
)
from residnet.identification.records import FitNotes
from residnet.quality.records import CompatibilityFile, InspectionFile
from residnet.report.records import MonitorFile, SweepFile, VariantsFile
from residnet.training.records import CurrentsFile

REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY / "docs" / "hooks"))

from config_keys import (  # noqa: E402
    describe_type,
    is_config,
    iterate_keys,
    list_type_arguments,
    read_summary,
)

REFERENCE = REPOSITORY / "docs" / "reference"
RECORDS: dict[str, type[StoredFile]] = {
    "summary.json": SummaryFile,
    "provenance.json": ProvenanceFile,
    "metrics.json": MetricsFile,
    "selection.json": SelectionFile,
    "sanity.json": SanityFile,
    "limits.json": LimitsFile,
    "excitation.json": ExcitationFile,
    "bands.json": BandsFile,
    "goodness.json": GoodnessFile,
    "booklet.json": BookletFile,
    "derivatives.json": DerivativesFile,
    "data_quality.json": DataQualityFile,
    "doctor.json": InspectionFile,
    "compatibility.json": CompatibilityFile,
    "currents.json": CurrentsFile,
    "fit.json": FitNotes,
    "exports.json": ExportsFile,
    "indices.json": IndicesFile,
    "sweep.json": SweepFile,
    "variants.json": VariantsFile,
    "monitor.json": MonitorFile,
    "metrics.json of the task `autopilot`": AutopilotMetricsFile,
    "controllers.json": ControllersFile,
    "fit.json of a policy": PolicyNotes,
    "metrics.json of the task `course`": CourseMetricsFile,
    "metrics.json of the task `roll`": RollMetricsFile,
}
"""Files of a run folder with the class of their contents."""
_SCHEMA_KEY = "Name and version of the format."
_INTRODUCTION = """# Files of a run folder

Each section describes a JSON file of a [run folder](run_folder.md), and each table one kind of
object in it. An optional key may be absent. Numbers are finite and in SI units and rad.
A file with an unknown key, or with a value of another type, is refused in one line.
`scripts/ci/record_schemas.py` writes this page from the classes that read and write the files.
"""


def iterate_records(annotation: object) -> Iterator[type[BaseModel]]:
    """Yield the records in an annotation and in their fields, each before those inside of it.

    The classes of configs are part of another reference, and are not yielded.
    """
    if is_config(annotation) and issubclass(annotation, Config):
        return
    if is_config(annotation):
        yield annotation
        for field in annotation.model_fields.values():
            yield from iterate_records(field.annotation)
    else:
        for part in list_type_arguments(annotation):
            yield from iterate_records(part)


class RecordSchema(GenerateJsonSchema):
    """Generator of the schema of a record, in which a config is any object.

    Readers of configs check them, so that two schemas of one config cannot differ.
    """

    def model_schema(self, schema: core_schema.ModelSchema) -> JsonSchemaValue:
        """Return the schema of a record or a config."""
        if issubclass(schema["cls"], Config):
            return {"type": "object", "title": schema["cls"].__name__}
        return super().model_schema(schema)


def schema_stem(name: str) -> str:
    """Return the file name of a schema without its suffix, such as `metrics_course`."""
    return re.sub(
        r"\W+", "_", name.replace(".json", "").replace("of the task ", "").replace("of a ", "")
    ).strip("_")


def write_schema(name: str, kind: type[StoredFile]) -> str:
    """Return the JSON schema of a file."""
    schema = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": name,
        **{
            key: value
            for key, value in kind.model_json_schema(
                by_alias=True, schema_generator=RecordSchema
            ).items()
            if key != "title"
        },
    }
    return json.dumps(schema, indent=1) + "\n"


def write_section(name: str, kind: type[StoredFile], described: set[type[BaseModel]]) -> list[str]:
    """Return the lines of the page about one file.

    Args:
        name: name of the file.
        kind: class of its contents.
        described: records that the page already describes; those of this file are added.
    """
    schema = f"schemas/{schema_stem(name)}.schema.json"
    first_line = read_summary(kind).replace(f"{name}: ", "").replace(f"models/<model>/{name}: ", "")
    lines = ["", f"## {name}", "", f"{_capitalize(first_line)} [JSON schema]({schema})"]
    records = list(dict.fromkeys(iterate_records(kind)))
    if issubclass(kind, RootModel):
        rows = describe_type(kind.model_fields["root"].annotation)
        lines += ["", f"The file is a {_link(rows)}."]
        described.add(kind)
    for record in records:
        if record in described:
            continue
        described.add(record)
        if record is not kind:
            lines += ["", f"### {record.__name__}", "", read_summary(record)]
        lines += ["", "| key | value | present | meaning |", "| --- | --- | --- | --- |"]
        for key in iterate_keys(record):
            text = _SCHEMA_KEY if key.name == "schema" else _capitalize(key.text or "")
            presence = "optional" if key.default else "always"
            cells = (f"`{key.name}`", _link(key.type), presence, text)
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return lines


def _capitalize(text: str) -> str:
    return text[:1].upper() + text[1:]


def _link(text: str) -> str:
    """Return a type with a link for each record that it names, and the names of config classes."""

    def link(match: re.Match[str]) -> str:
        kind = pydoc.locate(match[1])
        assert isinstance(kind, type)
        name = kind.__name__
        return f"`{name}`" if issubclass(kind, Config) else f"[{name}](#{name.lower()})"

    return re.sub(r"\{(residnet[\w.]*)\}", link, text)


def list_undocumented() -> list[str]:
    """Return the keys of records that no docstring describes."""
    records = dict.fromkeys(record for kind in RECORDS.values() for record in iterate_records(kind))
    return [
        f"{record.__name__}.{key.name}"
        for record in records
        if not issubclass(record, RootModel)
        for key in iterate_keys(record)
        if not key.text and key.name != "schema"
    ]


def build_files() -> dict[Path, str]:
    """Return the contents of the page and of all schemas by path."""
    lines = [_INTRODUCTION.rstrip()]
    files = {}
    described: set[type[BaseModel]] = set()
    for name, kind in RECORDS.items():
        files[REFERENCE / "schemas" / f"{schema_stem(name)}.schema.json"] = write_schema(name, kind)
        lines += write_section(name, kind, described)
    return {REFERENCE / "run_files.md": "\n".join(lines) + "\n", **files}


def list_outdated() -> list[Path]:
    """Return the files of the documentation that differ from the records."""
    return [
        path
        for path, text in build_files().items()
        if not path.is_file() or path.read_text(encoding="utf-8") != text
    ]


def main() -> int:
    """Write the files, or check them; returns the exit code."""
    outdated = list_outdated()
    if sys.argv[1:] == ["--check"]:
        for path in outdated:
            print(f"{path}: not current; run python scripts/ci/record_schemas.py")
        return int(bool(outdated))
    files = build_files()
    for path in outdated:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(files[path], encoding="utf-8")
        print(f"{path}: written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
