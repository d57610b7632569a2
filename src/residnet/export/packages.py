"""Packages that single formats need, installed by the extra `export`."""

from __future__ import annotations

import importlib.util

from residnet.core.errors import UsageError


def require_package(name: str, what: str) -> None:
    """Refuse to go on without a package.

    Raises:
        UsageError: that says how to install it.
    """
    if importlib.util.find_spec(name) is None:
        raise UsageError(
            f"{what} needs the package {name}, which is not installed: pip install"
            " 'residnet[export]'"
        )
