"""Messages about errors in the code of parts of other packages."""

from __future__ import annotations

import traceback
from pathlib import Path
from typing import Any

from residnet.core.names import truncate
from residnet.core.registry import find_registered_package, get_part_package


def is_external_part(config: Any) -> bool:
    """Return whether the code of a part comes from a user or from another package."""
    return type(config).__module__.partition(".")[0] != "residnet"


def describe_part_class(part_class: type[Any], config: Any) -> str:
    """Return class and package of a part for messages, such as `(class X of package Y 1.0)`."""
    package = get_part_package(type(config)) or part_class.__module__.partition(".")[0]
    return f"(class {part_class.__name__} of package {package})"


def describe_part_error(error: Exception, part_class: type[Any], method: str) -> str:
    """Return type, place and message of an error in a method of a part.

    The place is the innermost frame in the file of the method.
    """
    function = getattr(part_class, method)
    file = getattr(getattr(function, "__code__", None), "co_filename", "")
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == file
    ]
    place = f" ({Path(file).name}, line {lines[-1]})" if lines else ""
    text = truncate(" ".join(str(error).split()), 200)
    return f"{type(error).__name__} in {method} of {part_class.__name__}{place}: {text}"


def describe_external_error(error: BaseException) -> str:
    """Return a message about an error that passed through a package with registered parts.

    Returns:
        The message with the innermost place in that package; empty if there is no such package.
    """
    message = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = find_registered_package(str(frame.f_globals.get("__name__")))
        if package is not None:
            text = truncate(" ".join(str(error).split()), 200)
            message = (
                f"{type(error).__name__} in {frame.f_code.co_qualname}"
                f" ({Path(frame.f_code.co_filename).name}, line {line}) of the package {package}:"
                f" {text}; correct it there"
            )
    return message
