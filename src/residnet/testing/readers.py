"""The contract of readers of logs."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from residnet.core.config import Config
from residnet.core.errors import ResidnetError, UsageError
from residnet.core.log import Log
from residnet.core.names import si_unit
from residnet.core.registry import kind_of
from residnet.data.readers import LogReader
from residnet.testing.require import require


def check_reader(config: Config, file: Path) -> Log:
    """Check everything that residnet relies on in a reader, and return the log that it read.

    Time that strictly increases, channels in SI units as float64, a heading without jumps, the
    file's identity, the same log twice, and one-line errors for a file that is missing, a folder,
    an empty file and a damaged one.

    Args:
        config: of the reader.
        file: a recording that the reader can read.

    Raises:
        AssertionError: one line that says which contract is broken.
    """
    who = f"reader {kind_of(type(config))}"
    reader: LogReader = getattr(config, "build")()  # noqa: B009  readers have no common base
    require(isinstance(reader, LogReader), f"{who}: build gives no LogReader")
    file = Path(file)
    log, again = reader.read(file), reader.read(file)
    _check_log(log, file, who)
    require(
        list(log.channels) == list(again.channels)
        and all(
            np.array_equal(values, again.channels[name], equal_nan=True)
            for name, values in log.channels.items()
        ),
        f"{who}: reads the same file twice with different results",
    )
    with tempfile.TemporaryDirectory() as folder:
        _check_refusals(reader, Path(folder), file, who)
    return log


def _check_log(log: Log, file: Path, who: str) -> None:
    require(log.name == file.stem, f"{who}: names the log '{log.name}', not '{file.stem}'")
    require(bool(log.channels), f"{who}: the log has no channels")
    require(log.t.dtype == np.float64, f"{who}: time is {log.t.dtype}, not float64")
    require(log.t.size >= 2, f"{who}: the log has {log.t.size} samples, at least 2 are needed")
    require(bool((np.diff(log.t) > 0).all()), f"{who}: time does not strictly increase")
    for name, values in log.channels.items():
        require(values.dtype == np.float64, f"{who}: {name} is {values.dtype}, not float64")
        unit = log.units[name]
        require(si_unit(unit) == unit, f"{who}: {name} is in {unit}, not in SI units")
    if "psi" in log.channels:
        psi = log["psi"][np.isfinite(log["psi"])]
        require(bool((np.abs(np.diff(psi)) < np.pi).all()), f"{who}: psi jumps by half a circle")
    missing = [key for key in ("source", "sha256") if key not in log.meta]
    require(not missing, f"{who}: the log's meta lacks {', '.join(missing)}")


def _check_refusals(reader: LogReader, folder: Path, file: Path, who: str) -> None:
    empty, damaged = (folder / f"{name}{file.suffix}" for name in ("empty", "damaged"))
    empty.write_bytes(b"")
    damaged.write_bytes(np.random.default_rng(0).bytes(4096))
    _require_refusal(reader, folder / f"absent{file.suffix}", "missing", UsageError, who)
    nothing = folder / "nothing"
    nothing.mkdir()
    for path, what in ((nothing, "an empty folder"), (empty, "empty"), (damaged, "random bytes")):
        _require_refusal(reader, path, what, ResidnetError, who)


def _require_refusal(
    reader: LogReader, path: Path, what: str, kind: type[ResidnetError], who: str
) -> None:
    try:
        reader.read(path)
    except kind as error:
        text = str(error)
        require("\n" not in text and str(path) in text, f"{who}: its error does not name the file")
    except Exception as error:
        raise AssertionError(
            f"{who}: a file that is {what} raises {type(error).__name__}, not {kind.__name__}"
        ) from error
    else:
        raise AssertionError(f"{who}: reads a file that is {what}")
