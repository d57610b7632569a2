"""Entry points of residnet's wings: packages of residnet that the core never imports.

A wing, such as `residnet.autopilot`, is a folder with a file entry_points.toml. The file declares
the wing's parts in the groups and the syntax that another package uses in its pyproject.toml, each
as `module:name`. A part is imported when it is first used. This module imports no large
package, because `residnet --help` lists the commands of the wings.
"""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path

import residnet

ENTRY_POINTS_FILE = "entry_points.toml"


@functools.cache
def read_wing_entry_points() -> Mapping[str, Mapping[str, str]]:
    """Read the entry points of all wings without importing any of them.

    Returns:
        Names with their `module:name` by group, for example `residnet.tasks`.
    """
    wing_entry_points: dict[str, dict[str, str]] = {}
    for file in sorted(Path(residnet.__file__).parent.glob(f"*/{ENTRY_POINTS_FILE}")):
        groups = tomllib.loads(file.read_text(encoding="utf-8"))["entry-points"]
        for group, parts in groups.items():
            wing_entry_points.setdefault(group, {}).update(parts)
    return wing_entry_points
