"""The command line; imports stay inside the commands: `--help` must not wait for PyTorch."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, final

import typer

from residnet.core.errors import ResidnetError
from residnet.core.ownership import Manifest, manifest_for, recorded_folder, require_replaceable
from residnet.core.progress import Progress, ProgressCallback, listen
from residnet.exits import enter

if TYPE_CHECKING:
    from residnet.data.drafting.questions import Answer, Question
    from residnet.runs.task import Finished


SILENCE = 5.0
"""Seconds without a line after which one says what is still being done."""
Keep = Callable[[str], None]
"""Is given one line after the other."""


@contextmanager
def drawn_progress(*, quiet: bool = False, kept: Keep | None = None) -> Iterator[None]:
    """Draw the progress of everything within the context on standard error.

    Args:
        quiet: draw nothing.
        kept: is given every line, whatever is drawn.
    """
    drawn: AbstractContextManager[ProgressCallback | None] = nullcontext()
    if not quiet:
        drawn = _bars() if sys.stderr.isatty() else _Lines()
    with drawn as then:

        def hear(progress: Progress) -> None:
            ended = progress.done is not None and progress.done == progress.total
            if kept is not None and (progress.message or ended):
                kept(progress.message or f"{progress.stage}: done")
            if then is not None:
                then(progress)

        with listen(hear):
            yield


class _Lines:
    """One line for each message, and one for each counted stage that ends without a message.

    Where neither comes for a while, a line tells what is still being done, how far, and since when.
    """

    def __init__(self) -> None:
        self._complete: set[str] = set()
        self._ended = threading.Event()
        self._doing = self._begun = self._stage = ""
        self._since = self._told = time.monotonic()

    def __enter__(self) -> _Lines:
        threading.Thread(target=self._watch, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(SILENCE / 5):
            now = time.monotonic()
            if self._doing and now - self._told >= SILENCE:
                self._print(f"  {self._doing}: {now - self._since:.0f} s so far")

    def _print(self, line: str) -> None:
        self._told = time.monotonic()
        print(line, file=sys.stderr, flush=True)

    def __call__(self, progress: Progress) -> None:
        if progress.message:
            self._print(progress.message)
        if progress.stage and progress.done is None:
            self._begun = self._doing = progress.stage
            self._since = self._told
        if progress.done is None or progress.total is None:
            return
        if progress.stage != self._stage:
            self._stage, self._since = progress.stage, time.monotonic()
        if progress.done < progress.total:
            self._complete.discard(progress.stage)
            self._doing = f"{progress.stage}, {progress.done:g} of {progress.total:g}"
        elif progress.stage not in self._complete:
            self._complete.add(progress.stage)
            self._doing = self._begun
            if not progress.message:
                self._print(f"  {progress.stage}: all {progress.total:g} done")


@contextmanager
def _bars() -> Iterator[ProgressCallback]:
    """Draw one bar for each counted stage that is under way, and one for the stage begun last.

    Bars move, and tell the time that is gone, without a word of the work.
    """
    from rich import progress as rich
    from rich.console import Console

    columns = (
        rich.TextColumn("{task.description}", markup=False),
        rich.BarColumn(),
        rich.MofNCompleteColumn(),
        rich.TimeRemainingColumn(elapsed_when_finished=True),
        rich.TimeElapsedColumn(),
    )
    console = Console(stderr=True, highlight=False, markup=False)
    stages: dict[str, rich.TaskID] = {}

    def hear(progress: Progress) -> None:
        if progress.message:
            console.print(progress.message)
        if progress.done is None and progress.total is None:
            if progress.stage:
                if "" in stages:
                    bars.remove_task(stages.pop(""))
                stages[""] = bars.add_task(progress.stage, total=None)
            return
        if progress.stage not in stages:
            stages[progress.stage] = bars.add_task(progress.stage, total=None)
        bars.update(stages[progress.stage], completed=progress.done or 0, total=progress.total)
        if progress.total is not None and (progress.done or 0) >= progress.total:
            bars.remove_task(stages.pop(progress.stage))

    with rich.Progress(*columns, console=console, transient=True) as bars:
        yield hear


def asked() -> Answer | None:
    """Return what asks the user; None where nobody sits at the terminal."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None
    return _ask


def _ask(question: Question) -> str:
    """Ask one question until its answer can be used; an empty answer takes the default."""
    options = f" ({', '.join(question.options)})" if question.options else ""
    print(f"{question.text}: {question.reason}", file=sys.stderr)
    asking = f"  {'.'.join(question.key)}{options} [{question.default}]: "
    while True:
        print(asking, end="", file=sys.stderr, flush=True)
        given = input().strip() or question.default
        if not question.options or given in question.options:
            return given
        print(f"  '{given}' is none of {', '.join(question.options)}", file=sys.stderr)


@final
class RunLog:
    """Lines with the time of day, written as they come once the run's folder stands.

    Args:
        folder: that the run will have; a run that ends before it stands has its log beside it.
        wanted: keep the lines; else nothing is written.
    """

    def __init__(self, folder: Path, *, wanted: bool = True) -> None:
        self._beside = folder.with_name(f"{folder.name}.log.txt")
        self._wanted, self._held = wanted, ""
        self._file: Path | None = None

    def line(self, text: str) -> None:
        """Add one line with the time of day."""
        self._add(f"{time.strftime('%H:%M:%S')} {text.strip()}\n")

    def open(self, folder: Path) -> None:
        """Write into a folder from now on, behind what an interrupted run left there."""
        self._file = folder / "log.txt"
        if self._wanted:
            self._claim(self._file)
        self._add("")

    @contextmanager
    def until_the_end(self) -> Iterator[None]:
        """Add the traceback where what is done within the context ends badly, Ctrl-C included."""
        try:
            yield
        except BaseException as error:
            if self._file is None and self._wanted:
                # the error under way counts more than a log that cannot be written
                with suppress(ResidnetError):
                    self._claim(self._beside)
                    self._file = self._beside
            self._add("".join(traceback.format_exception(error)))
            raise

    @staticmethod
    def _claim(file: Path) -> None:
        """Record a log before its first line.

        Raises:
            UsageError: if the file is the user's.
        """
        manifest = manifest_for(file)
        manifest.require_replaceable(file)
        manifest.record(file, None)

    def _add(self, text: str) -> None:
        self._held += text
        if self._file is not None and self._wanted:
            with self._file.open("a", encoding="utf-8", errors="backslashreplace") as stream:
                stream.write(self._held)
            self._held = ""


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
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Options of all commands."""
    # small products are thirty times slower where several libraries fight for the cores
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


Quiet = Annotated[bool, typer.Option("--quiet", help="Show no progress, the result only.")]
RunPath = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option(
        "-s",
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of the config, or take one away with ~KEY; may be repeated.",
    ),
]
Given = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[PATH]...", help="Logs in the order of time: files or folders."),
]
Logs = Annotated[
    list[Path] | None,
    typer.Option("--logs", metavar="PATH", help="The same, one at a time; may be repeated."),
]


def _trust(context: typer.Context, trust: bool) -> bool:
    """Allow parts outside of the allow-lists until the command ends, where the user asks for it."""
    if trust:
        from residnet.core.trust import trusting

        context.with_resource(trusting())
    return trust


Trust = Annotated[
    bool,
    typer.Option(
        "--trust",
        callback=_trust,
        help="Make and load parts that are not stored as data, such as other classes of"
        " scikit-learn. They can run code: only for configs and runs whose source you trust.",
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
    trust: Trust = False,
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
    from residnet.tasks.registry import config_file, load_task

    task = load_task(config, overrides or [])
    log = RunLog(task.place(out), wanted=verbose)
    drawn = drawn_progress(quiet=quiet or as_json, kept=log.line)
    with log.until_the_end(), drawn, spread(workers):
        finished = task.run(
            source=config_file(config),
            overrides=overrides or [],
            out=out,
            resume=resume,
            overwrite=overwrite,
            opened=log.open,
        )
    if as_json:
        place = {"folder": str(finished.folder.path), "report": str(finished.folder.report)}
        print(json.dumps({**finished.folder.read_summary(), **place}, indent=1))
    else:
        show(finished)


@app.command()
def new(
    logs: Annotated[
        list[Path], typer.Argument(metavar="LOGS...", help="Files, folders and bags of any format.")
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
    quiet: Quiet = False,
) -> None:
    """Draft a complete config from logs: `residnet run` takes it as it is.

    Channels, units, frames, inputs, splits, protocols and models are proposed. What the logs do
    not tell is asked on a terminal; elsewhere the default is taken and marked as a guess.
    """
    from residnet.tasks.drafting import new_config

    with drawn_progress(quiet=quiet):
        ask, file = None if defaults else asked(), out or Path("my_boat.yaml")
        lines = new_config(logs, file, ask, overwrite=overwrite)
    print("\n".join(lines))


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
    """Write realistic logs of a simulated boat to try things on, in several layouts."""
    from residnet.tasks.demo import write_demo

    with drawn_progress(quiet=quiet):
        lines = write_demo(folder, overwrite=overwrite)
    print("\n".join(lines))


@app.command()
def check(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help=_CONFIG)],
    overrides: Overrides = None,
    trust: Trust = False,
    quiet: Quiet = False,
) -> None:
    """Validate a config and everything that it names, without running it."""
    from residnet.tasks.registry import load_task

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
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Write the findings to a file as JSON, too."),
    ] = None,
    trust: Trust = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the findings as JSON, for machines.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Check logs for faults that would mislead a fit.

    Clocks, gaps, jumps, frozen channels, reference frames, lags, copied channels and excitation
    are checked. The exit code is 1 where a fit would be misled.
    """
    from residnet.core.files import require_file_place
    from residnet.tasks.inspection import inspect_logs

    if out is not None:
        require_file_place(out)
        require_replaceable(out)
    with drawn_progress(quiet=quiet or as_json):
        findings = inspect_logs(logs, config)
    print(json.dumps(findings.content, indent=1) if as_json else findings.text)
    if out is not None:
        findings.write(out)
    if findings.misled:
        raise typer.Exit(1)


def _named(run: Path, *parts: list[Path] | None) -> list[Path]:
    """Return the logs that a command line names.

    Raises:
        UsageError: where there is none.
    """
    from residnet.core.errors import UsageError

    logs = [path for part in parts for path in part or ()]
    if not logs:
        raise UsageError(f"{run}: which logs? Name files or folders of logs behind the run")
    return logs


@app.command()
def evaluate(
    folder: RunPath,
    given: Given = None,
    logs: Logs = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Where results go; RUN/external-<time> where not given."
        ),
    ] = None,
    trust: Trust = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted evaluation in its folder.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier evaluation in its folder.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Evaluate the models of a finished run in free run on other logs."""
    from residnet.core.files import require_room
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import finished_task

    with drawn_progress(quiet=quiet):
        run, task = finished_task(folder, "evaluate")
        require_room(out or folder)
        named = _named(folder, given, logs)
        with name_damaged_key(folder):
            finished = task.evaluate_on(run, named, out, resume=resume, overwrite=overwrite)
    show(finished)


@app.command()
def monitor(
    folder: RunPath,
    given: Given = None,
    logs: Logs = None,
    model: Annotated[str, typer.Option(help="Name of the model.")] = "selected",
    window: Annotated[str, typer.Option(help="Length of the short free runs.")] = "10 s",
    stretch: Annotated[str, typer.Option(help="Time that is looked back over.")] = "300 s",
    false_alarm: Annotated[str, typer.Option(help="Mean time between false alarms.")] = "10 h",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for a page and monitor.json."),
    ] = None,
    refit: Annotated[
        Path | None,
        typer.Option(
            "--refit",
            metavar="DIR",
            help="Put the changes that are named into a copy of the model, in a new run folder.",
        ),
    ] = None,
    trust: Trust = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what was found as JSON, for machines.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Watch new logs with a model of a finished fit, and name what has changed.

    The exit code is 1 where there is an alarm. A refit leaves the run as it is.
    """
    from residnet.core.files import require_room, whole
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import finished_task

    if out is not None:
        require_room(out)
        Manifest(out).require_replaceable(out / "monitor.json")
        Manifest(out).require_replaceable(out / "report.html")
    settings = {"window": window, "stretch": stretch, "false_alarm": false_alarm}
    with drawn_progress(quiet=quiet or as_json):
        run, task = finished_task(folder, "monitor")
        named = _named(folder, given, logs)
        with name_damaged_key(folder):
            found, refitted = task.monitor(run, named, model, settings, refit)
    content: list[dict[str, Any]] = [log.content() for log in found]
    lines = [line for log in found for line in log.text()]
    if refitted is not None:
        lines += refitted.text()
        content.append({"refit": refitted.content()})
    document = json.dumps(content, indent=1)
    if out is not None:
        from residnet.tasks.fit_service import write_watched

        with recorded_folder(out):
            lines.append(f"page: {write_watched(out, found)}")
            with whole(out / "monitor.json") as part:
                part.write_text(document + "\n")
    print(document if as_json else "\n".join(lines))
    if any(log.since is not None for log in found):
        raise typer.Exit(1)


@app.command(name="plan-trial")
def plan_trial(
    folder: RunPath,
    model: Annotated[
        str, typer.Option(help="Refitted baseline; the booklet's or the first if not given.")
    ] = "",
    time: Annotated[str, typer.Option(help="How long each trial lasts.")] = "120 s",
    area: Annotated[
        str | None, typer.Option(help="Largest distance from the start, such as '200 m'.")
    ] = None,
    speed: Annotated[str | None, typer.Option(help="Largest speed, such as '3 m/s'.")] = None,
    rudder: Annotated[float, typer.Option(help="Largest share of full steer.")] = 1.0,
    count: Annotated[int, typer.Option(help="Number of trials to choose.")] = 3,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder for next_trials.yaml and tracks."),
    ] = None,
    trust: Trust = False,
    quiet: Quiet = False,
) -> None:
    """Say which manoeuvres to run next, and by how much they would narrow the predictions."""
    from residnet.core.files import require_room
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import finished_task

    if out is not None:
        require_room(out)
    limits = {"time": time, "area": area, "speed": speed, "rudder": rudder, "count": count}
    with drawn_progress(quiet=quiet):
        run, task = finished_task(folder, "plan-trial")
        with name_damaged_key(folder):
            planned = task.plan_trial(run, model, limits)
    print(planned.text())
    for file in planned.write(out) if out is not None else []:
        print(f"written: {file}")


@app.command()
def export(
    folder: RunPath,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            metavar="NAME",
            help="Name of the model; 'selected' for the single one chosen on validation data; the"
            " one that is reported first where not given.",
        ),
    ] = "predictor",
    file_format: Annotated[
        str, typer.Option("--format", metavar="FORMAT", help="One of `residnet list formats`.")
    ] = "torchscript",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write; RUN/exports/<model>.pt where not given, and RUN/exports/<run>.c"
            " for C, whose names begin with the file's.",
        ),
    ] = None,
    anyway: Annotated[
        bool,
        typer.Option(
            "--anyway", help="Write what is worse than doing without it, too; its card says so."
        ),
    ] = False,
    trust: Trust = False,
    quiet: Quiet = False,
) -> None:
    """Export a model of a finished run for controllers, after a parity check."""
    from residnet.core.files import require_file_place
    from residnet.core.run_loader import name_damaged_key
    from residnet.runs.task import ExportRequest
    from residnet.tasks.registry import finished_task

    with drawn_progress(quiet=quiet):
        run, task = finished_task(folder, "export")
        require_file_place(out or run.exports / model)
        with name_damaged_key(folder):
            written = task.export_model(ExportRequest(run, model, out, file_format, anyway))
    print(written)


@app.command()
def autopilot(
    source: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN|LOGS...|K,T",
            help="A finished fit, logs with turns, or K in 1/s and T in s, such as 0.31,7.4.",
        ),
    ],
    out: Annotated[
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
    draft: Annotated[bool, typer.Option("--draft", help="Write the config alone.")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace earlier files and an earlier run.")
    ] = False,
    trust: Trust = False,
    quiet: Quiet = False,
) -> None:
    """Train a heading autopilot for your vessel under the conditions that its logs show."""
    from residnet.tasks.own_autopilot import draft_autopilot
    from residnet.tasks.registry import load_task

    with drawn_progress(quiet=quiet):
        config = draft_autopilot(
            source, out, rudder=rudder, rate=rate, speed=speed, overwrite=overwrite
        )
        print(f"config: {config}")
        if draft:
            return
        finished = load_task(config, []).run(source=config, overwrite=overwrite)
    show(finished)
    print(f"next: residnet export {finished.folder.path} --format c")


@app.command()
def ardupilot(
    source: Annotated[
        str, typer.Argument(metavar="VESSEL|RUN", help="A vessel, or the folder of a finished fit.")
    ],
    model: Annotated[
        str, typer.Option("--model", metavar="NAME", help="Name of the model of a run.")
    ] = "selected",
    servo: Annotated[
        list[str] | None,
        typer.Option(
            "--servo",
            metavar="COMMAND=OUTPUT:LOW:HIGH",
            help="Servo output of a command and its values at 1000 and 2000 us, SI.",
        ),
    ] = None,
    port: Annotated[int, typer.Option("--port", help="UDP port that ArduPilot sends to.")] = 9002,
    trust: Trust = False,
) -> None:
    """Simulate a vessel or a learned model for ArduPilot (sim_vehicle.py --model JSON)."""
    from residnet.simulators.ardupilot import ArduPilotBackEnd, servos
    from residnet.simulators.vehicle import vehicle

    boat = vehicle(source, model=model, dt=0.0025)
    end = ArduPilotBackEnd(boat, servos(boat, servo or ()), port)
    print(f"{boat.name} listens at UDP port {end.port}; Ctrl-C ends it", flush=True)
    for name, at in zip(boat.inputs, end.servos, strict=False):
        print(f"  {name}: servo output {at.channel}, {at.low:g} to {at.high:g}", flush=True)
    end.serve()


@app.command()
def report(folder: RunPath, quiet: Quiet = False) -> None:
    """Write the figures and the report of a finished run again."""
    from residnet.tasks.registry import report_run

    with drawn_progress(quiet=quiet):
        page = report_run(folder)
    print(page)


@app.command()
def trust(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run, or of a single model.")
    ],
) -> None:
    """Accept a run folder as it stands: list what is new or changed, and write its checksums.

    Do this only if you trust where the folder comes from. Nothing in it runs, but its numbers are
    taken as those of a run, and later commands may replace the listed files.
    """
    from residnet.core.run_loader import accept_run

    lines = accept_run(folder)
    print("\n".join([*lines, f"{folder}: accepted, {len(lines)} files were new or changed"]))


@app.command()
def compare(
    folders: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Folders of finished fits.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the page.")] = Path(
        "comparison"
    ),
    quiet: Quiet = False,
) -> None:
    """Set finished fits side by side: errors on common logs, paired intervals, configs."""
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.compare import compare_runs

    with drawn_progress(quiet=quiet), name_damaged_key(folders[0]):
        text, page = compare_runs(folders, out)
    print(text)
    print(f"page: {page}")


@app.command()
def runs(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder of runs.")] = Path("runs"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List the runs below a folder with task, state, best figure and age."""
    from residnet.tasks.registry import runs_below, runs_text

    entries = runs_below(folder)
    print(json.dumps(entries, indent=1) if as_json else runs_text(folder, entries))


@app.command(name="list")
def list_names(
    what: Annotated[
        Literal[
            "vessels", "heads", "manoeuvres", "readers", "tasks", "baselines", "formats", "configs"
        ],
        typer.Argument(help="Kind of part to list."),
    ],
) -> None:
    """List the parts that a config may name, with a line about each."""
    from residnet.tasks.registry import catalogue

    for name, about in catalogue(what):
        print(f"{name:28s} {about}")


def show(finished: Finished) -> None:
    """Print the verdict and table of a run, its exported files and its report."""
    if finished.outcome.level:
        print(f"{finished.outcome.level.capitalize()}:")
    for sentence in finished.outcome.verdict:
        print(sentence)
    if finished.outcome.table:
        print(finished.outcome.table)
    for file in finished.exports:
        print(f"exported: {file}")
    if finished.folder.report.is_file():
        print(f"report: {finished.folder.report}")


def main() -> None:
    """Run the command line; an error that a user can cause is one line and an exit code."""
    enter(app)


if __name__ == "__main__":
    main()
