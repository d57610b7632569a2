"""The command line; imports stay inside the commands: `--help` must not wait for PyTorch."""

from __future__ import annotations

import json
from contextlib import ExitStack
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from residnet.commands import (
    Quiet,
    ardupilot,
    compare,
    evaluate,
    export,
    limit_threads,
    list_names,
    monitor,
    plan_trial,
    report,
    runs,
    show,
)
from residnet.door import enter
from residnet.terminal import drawn_progress

app = typer.Typer(
    name="residnet",
    help=(
        "Identify models of real vessels from logs: a baseline from physics, a learned residual,"
        " validation in free run, and export for controllers."
    ),
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(wanted: bool) -> None:
    """Print the version and end, where it was asked for."""
    if wanted:
        from residnet.core.version import __version__

        print(f"residnet {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options of all commands."""


class Recipe(StrEnum):
    """Recipes that a config may be drafted with."""

    standard = "standard"


Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "-s",
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of the config, or take one away with ~KEY; may be repeated.",
    ),
]
_CONFIG = "YAML file of one run, or the name of a config that comes with residnet."


@app.command()
def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help=_CONFIG)],
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Run folder; runs/<name> where not given."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run in its folder.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier run in its folder.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1024,
            metavar="N",
            help="Models of a fit that are fitted side by side; one a core where not given.",
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json and the run's folder, for machines.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Write all progress into RUN/log.txt.")
    ] = False,
) -> None:
    """Carry out a run: fit, evaluate, report and export, or any other task."""
    from residnet.core.processes import spread
    from residnet.run_log import RunLog
    from residnet.tasks.loading import config_file, load_task

    limit_threads()
    task = load_task(config, overrides or [])
    log = RunLog(task.place(out)) if verbose else None
    with ExitStack() as stack:
        if log is not None:
            stack.enter_context(log.until_the_end())
        kept = None if log is None else log.line
        stack.enter_context(drawn_progress(quiet=quiet or as_json, kept=kept))
        stack.enter_context(spread(workers))
        finished = task.run(
            source=config_file(config),
            overrides=overrides or [],
            out=out,
            resume=resume,
            overwrite=overwrite,
            opened=None if log is None else log.open,
        )
    if as_json:
        place = {"folder": str(finished.folder.path), "report": str(finished.folder.report)}
        print(json.dumps({**finished.folder.read_summary(), **place}, indent=1))
    else:
        show(finished)


@app.command()
def new(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOGS...", help="Files, folders and bags of any format."),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="CONFIG", help="File to write; my_boat.yaml if not given."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier config of this name.")
    ] = False,
    defaults: Annotated[
        bool, typer.Option("--defaults", help="Ask nothing: take and mark every default.")
    ] = False,
    recipe: Annotated[
        Recipe | None,
        typer.Option(
            help="Fit the portfolio of the standard recipe: minutes more than a few models."
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Draft a complete config from logs: `residnet run` takes it as it is.

    Channels, units, frames, inputs, splits, protocols and models are proposed. What the logs do
    not tell is asked on a terminal; elsewhere the default is taken and marked as a guess.
    """
    from residnet.tasks.drafting.draft import new_config
    from residnet.terminal import asked

    limit_threads()
    with drawn_progress(quiet=quiet):
        ask = asked() if not defaults else None
        file = out or Path("my_boat.yaml")
        standard = recipe is not None
        lines = new_config(logs, file, ask, overwrite=overwrite, standard=standard)
    for line in lines:
        print(line)


@app.command()
def demo(
    folder: Annotated[
        Path, typer.Argument(metavar="[DIR]", help="Folder to write into; demo if not given.")
    ] = Path("demo"),
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the logs of an earlier demo.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write realistic logs of a simulated boat to try things on, as csv and MCAP."""
    from residnet.tasks.demo import write_demo

    limit_threads()
    with drawn_progress(quiet=quiet):
        lines = write_demo(folder, overwrite=overwrite)
    for line in lines:
        print(line)


@app.command()
def check(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help=_CONFIG)],
    overrides: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Validate a config and everything that it names, without running it."""
    from residnet.tasks.loading import load_task

    limit_threads()
    with drawn_progress(quiet=quiet):
        task = load_task(config, overrides or [])
        task.check()
    print(f"{config}: the config is valid (task {task.task}, run {task.name})")


@app.command()
def inspect(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...",
            help="Logs: canonical Parquet, or anything that the config's reader reads.",
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            "--config", metavar="CONFIG", help="A run whose channel map reads these logs."
        ),
    ] = None,
    file: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Write the findings to a file as JSON, too."),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Check logs for faults that would mislead a fit.

    Clocks, gaps, jumps, frozen channels, reference frames, lags, copied channels and excitation
    are checked. The exit code is 1 where a fit would be misled.
    """
    from residnet.core.files import require_file_place
    from residnet.tasks.inspection import inspect_logs

    limit_threads()
    if file is not None:
        require_file_place(file)
    with drawn_progress(quiet=quiet):
        findings = inspect_logs(logs, config)
    print(findings.text)
    if file is not None:
        findings.write(file)
    if findings.misled:
        raise typer.Exit(1)


for command in (evaluate, monitor, export, ardupilot, report, compare, runs):
    app.command()(command)
app.command(name="list")(list_names)
app.command(name="plan-trial")(plan_trial)


def main() -> None:
    """Run the command line; an error that a user can cause is one line and an exit code."""
    enter(app)


if __name__ == "__main__":
    main()
