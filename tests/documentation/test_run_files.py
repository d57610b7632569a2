"""The reference of the files of a run folder agrees with the classes that read them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import record_schemas
from made_run import made_run
from pydantic import RootModel

from residnet.core.records import FileRecord, FileRows, StoredFile


def _subclasses(kind: type[StoredFile]) -> set[type[StoredFile]]:
    return {kind}.union(*(_subclasses(child) for child in kind.__subclasses__()))


def test_reference_of_run_files_is_current() -> None:
    outdated = [path.name for path in record_schemas.list_outdated()]
    assert outdated == [], "run python scripts/ci/record_schemas.py"


def test_reference_describes_every_record_and_key() -> None:
    kinds = {
        kind
        for kind in _subclasses(StoredFile)
        if kind.__module__.endswith(("records", "evaluation.derivatives"))
        and "[" not in kind.__name__
    } - {StoredFile, FileRecord, FileRows}
    assert kinds == set(record_schemas.RECORDS.values())
    assert record_schemas.list_undocumented() == []


@pytest.mark.parametrize("name", ["metrics.json", "provenance.json", "data_quality.json"])
def test_schemas_require_the_keys_of_written_files(name: str, tmp_path: Path) -> None:
    content = json.loads((made_run(tmp_path / "run") / name).read_text())
    kind = record_schemas.RECORDS[name]
    schema = json.loads(record_schemas.write_schema(name, kind))
    if issubclass(kind, RootModel):
        schema = schema["$defs"][schema["items"]["$ref"].rpartition("/")[2]]
        (content, *_) = content
    assert set(schema["required"]) <= set(content) <= set(schema["properties"])
    assert schema.get("additionalProperties") is False
