"""Where the files that come with residnet lie, installed or in a checkout."""

from __future__ import annotations

from pathlib import Path

import residnet


def config_folder() -> Path:
    """Folder `configs`: inside the installed package, or at the top of the checkout that it is
    installed from.
    """
    package = Path(residnet.__file__).parent
    inside = package / "configs"
    return inside if inside.is_dir() else package.parents[1] / "configs"
