"""A reader of the tables of one logger: time, pose, speed in knots, yaw rate, commands."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal, final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.frames import unwrap_angle
from residnet.core.log import Log
from residnet.io.readers.base import (
    ConfiguredReader,
    describe_provenance,
    require_file,
    require_increasing,
    require_samples,
)

_KNOT = 1852.0 / 3600.0


@final
class KnotsConfig(ConfiguredReader):
    """Tables without a header: t [s], x [m], y [m], heading [deg], u [kn], v [kn], r [deg/s].

    Columns after the seventh are the revolutions of the propellers in 1/s.

    Attributes:
        kind: name of this reader in a config.
    """

    kind: Literal["knots"] = "knots"

    def read(self, path: Path) -> Log:
        """Read a log in SI units with unwrapped psi."""
        require_file(path)
        try:
            table = np.loadtxt(path, delimiter=",", ndmin=2)
        except ValueError as error:
            raise DataError(f"{path}: not a table of numbers ({error}); export it again") from error
        if table.shape[1] < 7:
            raise DataError(f"{path}: expected at least 7 columns, got {table.shape[1]}")
        t = table[:, 0]
        require_samples(path, t)
        require_increasing(path, t, lambda i: f"line {i + 1}")
        channels = {
            "x": table[:, 1],
            "y": table[:, 2],
            "psi": unwrap_angle(table[:, 3] * math.pi / 180.0),
            "u": table[:, 4] * _KNOT,
            "v": table[:, 5] * _KNOT,
            "r": table[:, 6] * math.pi / 180.0,
        }
        commands = dict(zip(("n_port", "n_stbd"), table[:, 7:].T, strict=False))
        meta = describe_provenance(path, len(t), 0)
        return Log(path.stem, t, channels | commands, meta=meta)
