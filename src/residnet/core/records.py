"""Base classes of the typed contents of JSON files in a run folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError

from residnet.core.errors import DataError
from residnet.core.files import read_json

RecordT = TypeVar("RecordT", bound="FileRecord")


class Record(BaseModel):
    """A JSON object with a fixed set of keys; numbers are finite."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False
    )


class FileRecord(Record):
    """The contents of a whole file, which names its format under `schema`."""

    def to_json_text(self) -> str:
        """Return the text of the file. Keys that were not set are absent."""
        return self.model_dump_json(by_alias=True, exclude_unset=True, indent=1) + "\n"

    def to_content(self) -> dict[str, Any]:
        """Return the contents as `json.loads` gives them."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    @classmethod
    def read(cls: type[RecordT], path: Path) -> RecordT:
        """Read a file of a run folder.

        Raises:
            UsageError: if there is no such file or it holds no JSON object.
            DataError: if a key is missing, unknown or of another type.
        """
        content = read_json(path)
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            # one fault per message is enough: the file was damaged or written by another version
            first_error = error.errors(include_url=False)[0]
            key = ".".join(map(str, first_error["loc"])) or "its contents"
            raise DataError(
                f"{path}: key '{key}': {first_error['msg'].lower()}; run the fit again"
            ) from None
