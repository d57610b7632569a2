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
            help="A finished fit, logs with turns, or K in 1/s and T in s, such as 0.31,7.4.",
        ),
    ],
    output_file: Annotated[
        Path, typer.Option("--out", metavar="CONFIG", help="Config to write, and the run's name.")
    ] = Path("my_autopilot.yaml"),
    rudder: Annotated[
        str | None,
        typer.Option(help="Largest rudder angle; that of the logs, or 20 deg, if not given."),
    ] = None,
    rate: Annotated[
        str | None, typer.Option(help="Rate of the steering gear; from the logs if not given.")
    ] = None,
    speed: Annotated[str | None, typer.Option(help="Speed at which K and T hold.")] = None,
    classical: Annotated[
        bool,
        typer.Option(
            "--classical", help="Tune a classical law and train no policy; takes a minute at most."
        ),
    ] = False,
    draft: Annotated[bool, typer.Option("--draft", help="Write the config alone.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier files and an earlier run.")
    ] = False,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Train a heading autopilot for your vessel under the conditions that its logs show."""
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
