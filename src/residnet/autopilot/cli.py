"""The command `residnet autopilot`; heavy imports are inside it, so that `--help` is fast."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from residnet.cli import QuietOption, TrustOption, print_result
from residnet.terminal import show_progress

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


@app.command()
def autopilot(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN|LOGS...|K,T",
            help="Folder of a finished fit; logs with turns to both sides; or K in 1/s and T in s,"
            " such as 0.31,7.4.",
        ),
    ],
    output_file: Annotated[
        Path,
        typer.Option(
            "--out", metavar="CONFIG", help="Config to write; its name is the name of the run."
        ),
    ] = Path("my_autopilot.yaml"),
    rudder: Annotated[
        str | None,
        typer.Option(
            metavar="RUDDER", help="Largest rudder angle; default: from the logs, else 20 deg."
        ),
    ] = None,
    rate: Annotated[
        str | None,
        typer.Option(
            metavar="RATE", help="Rate limit of the steering gear; default: from the logs."
        ),
    ] = None,
    speed: Annotated[
        str | None, typer.Option(metavar="SPEED", help="Speed for which K and T are valid.")
    ] = None,
    classical: Annotated[
        bool,
        typer.Option(
            "--classical",
            help="Tune a classical law only, without a learned policy (at most a minute).",
        ),
    ] = False,
    draft: Annotated[
        bool, typer.Option("--draft", help="Write the vessel file and the config, without a run.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing files and an earlier run.")
    ] = False,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train and compare heading autopilots for your vessel."""
    from residnet.autopilot.tasks.design import draft_autopilot_config
    from residnet.tasks.registry import load_task

    with show_progress(quiet=quiet):
        config = draft_autopilot_config(
            source,
            output_file,
            rudder=rudder,
            rate=rate,
            speed=speed,
            classical=classical,
            overwrite=overwrite,
        )
        print(f"config: {config}")
        if draft:
            return
        finished_run = load_task(config, []).run(source=config, overwrite=overwrite)
    print_result(finished_run)
    print(f"next: residnet export {finished_run.folder.path} --format c")
