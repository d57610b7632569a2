"""Paths in configs: `${NAME}` and `~` expanded, relative ones found beside the config first."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema

from residnet.core.config_errors import given
from residnet.core.names import nearest
from residnet.core.resources import shipped_configs


@dataclass(frozen=True)
class _PathRule:
    must_exist: bool
    shipped: bool = False

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(
            self.resolve,
            serialization=core_schema.plain_serializer_function_ser_schema(str, when_used="json"),
        )

    def resolve(self, value: object, info: ValidationInfo) -> Path:
        if not isinstance(value, (str, Path)) or not str(value):
            raise ValueError(f"expected a path {given(value)}")
        path = _expanded(str(value))
        folder: Path | None = (info.context or {}).get("folder")
        places = [place / path for place in (folder, Path.cwd()) if place is not None]
        found = next((place for place in places if _exists(place)), None)
        if found is None and self.must_exist:
            own = shipped_configs() if self.shipped and not path.suffix else {}
            if path.as_posix() in own:
                return own[path.as_posix()].absolute()
            looked = " or ".join(str(place) for place in dict.fromkeys(places))
            hint = f"; residnet has no config '{path}' either{nearest(str(path), own)}"
            raise ValueError(f"no such file or folder: {looked}{hint if own else ''}")
        return (found or places[-1]).absolute()


def _expanded(text: str) -> Path:
    def environment(match: re.Match[str]) -> str:
        # an empty variable would turn ${DATA}/logs into /logs
        if not (value := os.environ.get(match[1])):
            raise ValueError(
                f"environment variable '{match[1]}' is not set; set it (export {match[1]}=...) or"
                " write the path itself"
            )
        return value

    try:
        return Path(re.sub(r"\$\{([^}]*)\}", environment, text)).expanduser()
    except RuntimeError as error:
        raise ValueError(f"no home folder is known for '~' {given(text)}") from error


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


ConfigPath = Annotated[Path, _PathRule(must_exist=False)]
"""Absolute path; `${NAME}` and `~` expanded, a relative one taken from the config's folder if it
exists there, else from the current folder.
"""

ExistingPath = Annotated[Path, _PathRule(must_exist=True)]
"""As `ConfigPath`, and the file or folder exists."""

BaseConfig = Annotated[Path, _PathRule(must_exist=True, shipped=True)]
"""As `ExistingPath`; without an ending it may name a config that comes with residnet."""
