"""The command `residnet`, also as `python -m residnet`."""

from __future__ import annotations

import gc

from residnet.exits import run_cli

_OBJECTS = 100_000
"""New objects after which Python looks for cycles. By default it does so every 700, all through the
million that importing torch makes: .5 s of the 6 that `residnet check` takes.
"""


def _command() -> None:
    from residnet.cli import app

    app()


def main() -> None:
    """Run the command line; interruptions are heard before it is imported."""
    gc.set_threshold(_OBJECTS)
    run_cli(_command)


if __name__ == "__main__":
    main()
