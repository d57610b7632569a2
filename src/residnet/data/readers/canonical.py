"""Reader of residnet's own Parquet logs (`Log.save`)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, final

from residnet.core.config import Config
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.core.names import CHANNEL_UNITS
from residnet.data.readers.base import (
    LogReader,
    provenance,
    require_file,
    require_increasing,
    require_samples,
    require_values,
)


class CanonicalConfig(Config):
    """Logs that residnet wrote: they hold names, units and masks, so nothing is declared."""

    kind: Literal["canonical"] = "canonical"

    def build(self) -> CanonicalReader:
        """Build the reader of canonical logs."""
        return CanonicalReader()


@final
class CanonicalReader(LogReader):
    """Reads what `Log.save` wrote; where the log itself came from stays in `meta["origin"]`."""

    def read(self, path: Path) -> Log:
        """Return the log in `path`; see `LogReader.read`.

        Raises:
            UsageError: where the file is missing, is no canonical log, or gives a known channel
                another unit than its SI unit.
            DataError: where time does not increase, the file holds no samples, or a channel holds
                no number.
        """
        require_file(path)
        log = Log.load(path)
        for name, unit in log.units.items():
            if unit != CHANNEL_UNITS.get(name, unit):
                raise UsageError(
                    f"{path}: channel {name} is in [{unit}], a canonical log holds it in"
                    f" [{CHANNEL_UNITS[name]}]; convert it and save again"
                )
        t = log.t
        require_samples(path, t)
        require_increasing(path, t, lambda i: f"row {i + 1}")
        for name, values in log.channels.items():
            require_values(path, name, name, values)
        origin = {key: log.meta[key] for key in ("source", "sha256") if key in log.meta}
        meta = {
            **log.meta,
            **({"origin": origin} if origin else {}),
            **provenance(path, len(log), 0),
        }
        return log.replace(name=path.stem, t=t, meta=meta)
