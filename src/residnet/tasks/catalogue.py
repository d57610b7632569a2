"""`residnet list`: what there is to choose from, read from the unions themselves."""

from __future__ import annotations

from typing import Any, get_args

from residnet.baselines import BaselineConfig
from residnet.data.readers import ReaderConfig
from residnet.heads import HeadConfig
from residnet.manoeuvres import ManoeuvreConfig
from residnet.physics.vessel import load_vessel, vessel_files
from residnet.tasks.union import TaskConfig


def catalogue(what: str) -> list[tuple[str, str]]:
    """Names and one-line descriptions of `vessels`, `heads`, `manoeuvres`, `readers`, `tasks` or
    `baselines`.
    """
    if what == "vessels":
        return [(name, load_vessel(name).description) for name in vessel_files()]
    unions: dict[str, Any] = {
        "heads": HeadConfig,
        "manoeuvres": ManoeuvreConfig,
        "readers": ReaderConfig,
        "tasks": TaskConfig,
        "baselines": BaselineConfig,
    }
    members = get_args(get_args(unions[what])[0])
    return [(_tag(member), (member.__doc__ or "").strip().splitlines()[0]) for member in members]


def _tag(member: Any) -> str:
    field = member.model_fields.get("kind") or member.model_fields["task"]
    return str(get_args(field.annotation)[0])
