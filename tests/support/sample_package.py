"""The sample package of examples/, laid out as pip lays it out, without asking an index."""

from __future__ import annotations

import tomllib
from pathlib import Path

SAMPLE = Path(__file__).parents[2] / "examples" / "residnet_sample"


def install(site: Path) -> Path:
    """Put the sample package and its entry points into the folder `site`, and return it.

    What pip does for an editable install of a pure package: a link to the sources, and a
    `.dist-info` folder with the metadata of pyproject.toml.
    """
    project = tomllib.loads((SAMPLE / "pyproject.toml").read_text())["project"]
    info = site / f"residnet_sample-{project['version']}.dist-info"
    info.mkdir(parents=True)
    (site / "residnet_sample").symlink_to(SAMPLE / "src" / "residnet_sample")
    lines = [f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"]
    (info / "METADATA").write_text("".join(lines))
    groups = [
        f"[{group}]\n" + "".join(f"{name} = {target}\n" for name, target in points.items())
        for group, points in project["entry-points"].items()
    ]
    (info / "entry_points.txt").write_text("\n".join(groups))
    return site
