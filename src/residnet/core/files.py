"""Files that stand in their place whole or not at all, and errors that name them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from residnet.core.errors import UsageError


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yield a path to write to, which takes the place of `path` once it is written to its end.

    A process that is killed meanwhile leaves the old file, or none. The file's folder is made.

    Args:
        path: of the file.

    Raises:
        UsageError: where the file cannot be written.
    """
    partial = path.with_name(f"{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(path)
    except OSError as error:
        _discard(partial)
        raise not_written(path, error) from error
    except BaseException:
        _discard(partial)
        raise


def not_written(path: Path, error: OSError) -> UsageError:
    """Return the error of a file that cannot be written, with the reason that the system gives."""
    reason = error.strerror or str(error)
    return UsageError(
        f"{path}: cannot be written ({reason}); make room or give a place that can be written"
    )


def _discard(partial: Path) -> None:
    try:
        partial.unlink(missing_ok=True)
    except OSError:
        # the folder itself cannot be written; the error under way says so
        return
