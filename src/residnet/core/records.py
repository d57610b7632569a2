"""Base classes of the typed contents of JSON files in a run folder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, ClassVar, Generic, Self, TypeVar

from pydantic import BaseModel, ConfigDict, RootModel, ValidationError

from residnet.core.errors import UsageError
from residnet.core.run_loader import read_json_value, require_listed

RowT = TypeVar("RowT", bound="Record")
ModelT = TypeVar("ModelT", bound=BaseModel)


def with_explicit_defaults(settings: ModelT) -> ModelT:
    """Return settings in which each default counts as set, so that a record writes it."""
    return type(settings).model_validate(settings.model_dump(mode="json"))


class Record(BaseModel):
    """A JSON object with a fixed set of keys; numbers are finite.

    Keys that were not set are not written. A key that a later version adds needs a default, so
    that files of earlier versions can still be read.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, allow_inf_nan=False
    )


class OpenRecord(Record):
    """A JSON object with some known keys; heads, baselines and other parts may add keys."""

    model_config = ConfigDict(extra="allow")


class StoredFile(BaseModel):
    """The contents of a whole JSON file, which can be written and read."""

    _json_type: ClassVar[type] = dict

    def to_json_text(self) -> str:
        """Return the text of the file. Keys that were not set are absent."""
        return self.model_dump_json(by_alias=True, exclude_unset=True, indent=1) + "\n"

    def to_content(self) -> Any:
        """Return the contents as `json.loads` gives them, for a message to another program."""
        return self.model_dump(mode="json", by_alias=True, exclude_unset=True)

    @classmethod
    def read(cls, path: Path, folder: Path | None = None) -> Self:
        """Read a file of a run folder.

        Args:
            path: path of the file.
            folder: folder that no symbolic link may leave; None for the folder of the file.

        Raises:
            UsageError: if there is no such file, it is no JSON of the expected kind, or a key is
                missing, unknown or of another type.
        """
        content = read_json_value(path, folder)
        if not isinstance(content, cls._json_type):
            expected = "list" if cls._json_type is list else "object"
            found_type = "list" if isinstance(content, list) else type(content).__name__
            raise UsageError(
                f"{path}: expected a JSON {expected}, found {found_type}; restore the file or"
                " repeat the run"
            )
        try:
            return cls.model_validate(content)
        except ValidationError as error:
            # one fault per message is enough: the file was damaged or written by another version
            first_error = error.errors(include_url=False)[0]
            key = ".".join(str(part) for part in first_error["loc"])
            location = f"key '{key}'" if key else "its contents"
            raise UsageError(
                f"{path}: {location}: {first_error['msg'].lower()}; restore the file or repeat the"
                " run with this version"
            ) from None

    @classmethod
    def read_optional(cls, run: Path, name: str) -> Self | None:
        """Read a file of a run folder that not every run has; None if it does not exist.

        Args:
            run: the run folder.
            name: path of the file within the folder.

        Raises:
            UsageError: if the manifest of the folder does not list the file, or it cannot be read.
        """
        path = run / name
        if not os.path.lexists(path):
            return None
        require_listed(run, name)
        return cls.read(path, run)


class FileRecord(Record, StoredFile):
    """The contents of a whole file.

    A subclass declares the key `schema` with the name of the format, such as `residnet.metrics/1`.
    """


class FileRows(RootModel[tuple[RowT, ...]], StoredFile, Generic[RowT]):
    """The contents of a file that is a list of rows."""

    _json_type: ClassVar[type] = list

    model_config = ConfigDict(frozen=True)
