"""The command `residnet`, also as `python -m residnet`."""

from __future__ import annotations

from residnet.exits import enter


def _command() -> None:
    from residnet.cli import app

    app()


def main() -> None:
    """Run the command line; interruptions are heard before it is imported."""
    enter(_command)


if __name__ == "__main__":
    main()
