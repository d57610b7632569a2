"""The packages of examples/, laid out as pip lays them out, without asking an index."""

from __future__ import annotations

import tomllib
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
SAMPLE = EXAMPLES / "residnet_sample"
TASKS = EXAMPLES / "residnet_tasks"
"""Package with the tasks `actuators` and `import`."""


def install(site: Path, package: Path = SAMPLE) -> Path:
    """Put a package and its entry points into the folder `site`, and return it.

    What pip does for an editable install of a pure package: a link to the sources, and a
    `.dist-info` folder with the metadata of pyproject.toml.
    """
    project = tomllib.loads((package / "pyproject.toml").read_text())["project"]
    info = site / f"{package.name}-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (site / package.name).symlink_to(package / "src" / package.name)
    lines = [f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"]
    (info / "METADATA").write_text("".join(lines))
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))
    return site


def write_package(site: Path, name: str, code: str, **entry_points: str) -> None:
    """Write a package of one module with entry points into the folder `site`.

    Args:
        site: folder on the import path.
        name: name of the module and of the package, whose version is 1.0.
        code: source of the module.
        entry_points: group without `residnet.` -> lines `kind = class` of the module.
    """
    (site / f"{name}.py").write_text(code)
    info = site / f"{name}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    lines = [f"[residnet.{group}]\n{text}\n" for group, text in entry_points.items()]
    (info / "entry_points.txt").write_text("\n".join(lines))
