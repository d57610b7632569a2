"""Where the files that come with residnet lie, in an installed package or in a checkout."""

from __future__ import annotations

from pathlib import Path

import residnet


def config_folder() -> Path:
    """Return the folder `configs` that comes with residnet.

    It lies inside an installed package, or at the top of the checkout that is installed.
    """
    package = Path(residnet.__file__).parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parents[1] / "configs"


def shipped_configs() -> dict[str, Path]:
    """Return the configs that come with residnet by name; studies are named by their path too."""
    folder = config_folder()
    files = [file for file in sorted(folder.rglob("*.yaml")) if file.parent.name != "vessels"]
    by_path = {file.relative_to(folder).with_suffix("").as_posix(): file for file in files}
    stems = [file.stem for file in files]
    # a stem that two studies share names neither
    return {file.stem: file for file in files if stems.count(file.stem) == 1} | by_path
