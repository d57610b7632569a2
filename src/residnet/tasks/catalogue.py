"""`residnet list`: what there is to choose from, read from the unions themselves."""

from __future__ import annotations

from typing import Any

from residnet.baselines import BaselineConfig
from residnet.core.config import load_mapping
from residnet.core.errors import ResidnetError
from residnet.core.files import shipped_configs
from residnet.core.registry import ThirdParty, broken_line, listed
from residnet.data.readers import ReaderConfig
from residnet.export import exporters
from residnet.heads import HeadConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.physics.vessel import broken_vessels, load_vessel, vessel_files
from residnet.tasks.union import TaskConfig


def catalogue(what: str) -> list[tuple[str, str]]:
    """Return names and one-line descriptions of what there is, third-party parts included.

    Args:
        what: `vessels`, `heads`, `manoeuvres`, `readers`, `tasks`, `baselines`, `formats` or
            `configs`.
    """
    if what == "vessels":
        known = [(name, _description(name)) for name in vessel_files()]
        return known + [_broken(part) for part in broken_vessels()]
    if what == "configs":
        files = {file: name for name, file in reversed(shipped_configs().items())}
        return [
            (name, str(load_mapping(file).get("description") or ""))
            for file, name in sorted(files.items())
        ]
    if what == "formats":
        return [
            _broken(part) if isinstance(part, ThirdParty) else (name, part.about)
            for name, part in exporters().items()
        ]
    unions: dict[str, Any] = {
        "heads": HeadConfig,
        "manoeuvres": ManoeuvreConfig,
        "readers": ReaderConfig,
        "tasks": TaskConfig,
        "baselines": BaselineConfig,
    }
    return listed(unions[what])


def _description(vessel: str) -> str:
    try:
        return load_vessel(vessel).description
    except ResidnetError as error:
        # one wrong file of another package must not hide all others
        return f"(cannot be used: {error})"


def _broken(part: ThirdParty) -> tuple[str, str]:
    return part.name, broken_line(part)
