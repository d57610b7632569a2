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
