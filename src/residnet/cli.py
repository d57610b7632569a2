"""The command line. Commands import what they need, so that `--help` is fast."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer.core import TyperGroup
from typer.main import get_command

from residnet.core.ownership import Manifest, record_folder, require_replaceable
from residnet.core.wings import read_wing_entry_points
from residnet.exits import run_cli
from residnet.terminal import ProgressLogFile, interactive_prompt, show_progress

if TYPE_CHECKING:
    from residnet.runs.task import FinishedRun


class _WingGroup(TyperGroup):
    """Group of the core commands and the commands of wings, which are imported on use."""

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), *self._wing_commands()]

    # the class of a command depends on the version of typer
    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if (command := super().get_command(ctx, cmd_name)) is not None:
            return command
        if (object_path := self._wing_commands().get(cmd_name)) is None:
            return None
        module, _, name = object_path.partition(":")
        return get_command(getattr(importlib.import_module(module), name))

    @staticmethod
    def _wing_commands() -> Mapping[str, str]:
        return read_wing_entry_points().get("residnet.commands", {})


app = typer.Typer(
    name="residnet",
    cls=_WingGroup,
    help=(
        "Identify models of real vessels from logs: a baseline from physics, a learned residual,"
        " validation in free run, and export for controllers."
    ),
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _print_version(is_requested: bool) -> None:
    """Print the version and exit, if requested."""
    if is_requested:
        from residnet.core.version import __version__

        print(f"residnet {__version__}")
        raise typer.Exit


@app.callback()
def _set_thread_limits(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of all commands."""
    # small matrix products are thirty times slower if several thread pools compete for the cores
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


QuietOption = Annotated[
    bool, typer.Option("--quiet", help="Print only the result, without progress.")
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")]
OverridesOption = Annotated[
    list[str] | None,
    typer.Option(
        "-s",
        "--set",
        metavar="KEY=VALUE",
        help="Override a key of the config, or remove one with ~KEY; may be repeated.",
    ),
]
LogArguments = Annotated[
    list[Path] | None,
    typer.Argument(metavar="[PATH]...", help="Logs in chronological order: files or folders."),
]
LogOptions = Annotated[
    list[Path] | None,
    typer.Option(
        "--logs",
        metavar="PATH",
        help="A log file or folder, as alternative to PATH; may be repeated.",
    ),
]


def _allow_untrusted_parts(context: typer.Context, trust: bool) -> bool:
    """Allow parts that are not stored as data until the command ends, if requested."""
    if trust:
        from residnet.core.trust import trusting

        context.with_resource(trusting())
    return trust


TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust",
        callback=_allow_untrusted_parts,
        help="Allow parts that can execute code, such as unlisted classes of scikit-learn."
        " Use it only for configs and runs whose source you trust.",
    ),
]
_CONFIG_HELP = "YAML file of one run, or the name of a shipped config (`residnet list configs`)."


@app.command()
def run(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help=_CONFIG_HELP)],
    overrides: OverridesOption = None,
    output_folder: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Run folder; default: runs/<name>."),
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
            help="Number of models fitted in parallel; default: number of cores.",
        ),
    ] = None,
    trust: TrustOption = False,
    quiet: QuietOption = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print summary.json and the run folder as JSON.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Write all progress messages to RUN/log.txt.")
    ] = False,
) -> None:
    """Run a config: fit, evaluate, report and export."""
    from residnet.core.processes import worker_limit
    from residnet.tasks.registry import load_task, resolve_config_file

    task = load_task(config, overrides or [])
    log_file = ProgressLogFile(task.resolve_folder(output_folder), is_enabled=verbose)
    progress_display = show_progress(quiet=quiet or as_json, sink=log_file.add_line)
    with log_file.log_traceback(), progress_display, worker_limit(workers):
        finished_run = task.run(
            source=resolve_config_file(config),
            overrides=overrides or [],
            output_folder=output_folder,
            resume=resume,
            overwrite=overwrite,
            on_open=log_file.start_file,
        )
    if as_json:
        folder_fields = {
            "folder": str(finished_run.folder.path),
            "report": str(finished_run.folder.report),
        }
        summary = finished_run.folder.read_summary().to_content()
        print(json.dumps({**summary, **folder_fields}, indent=1))
    else:
        print_result(finished_run)


@app.command()
def new(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOGS...", help="Log files, folders or bags in any supported format."
        ),
    ],
    output_file: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="CONFIG", help="Config to write; default: my_boat.yaml."
        ),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an existing config.")
    ] = False,
    defaults: Annotated[
        bool,
        typer.Option(
            "--defaults", help="Do not ask questions; use defaults and mark them as guesses."
        ),
    ] = False,
    names: Annotated[
        str | None,
        typer.Option(
            "--names",
            metavar="T,X,Y,...",
            help="Names of all columns in order, for tables without a header line.",
        ),
    ] = None,
    step: Annotated[
        str | None,
        typer.Option(
            "--step",
            metavar="TIME",
            help="Time between two rows, such as '0.1 s', for tables without a time column.",
        ),
    ] = None,
    length: Annotated[
        str | None,
        typer.Option(
            metavar="LENGTH",
            help="Length of the vessel in the logs, such as '3.2 m'; adds a manoeuvring booklet"
            " and derivatives.",
        ),
    ] = None,
    scale: Annotated[
        float | None,
        typer.Option(
            metavar="RATIO", help="Scale ratio: length of the ship divided by length of the model."
        ),
    ] = None,
    beam: Annotated[
        str | None, typer.Option(metavar="BEAM", help="Beam of the vessel in the logs.")
    ] = None,
    draught: Annotated[
        str | None, typer.Option(metavar="DRAUGHT", help="Draught of the vessel in the logs.")
    ] = None,
    mass: Annotated[
        str | None,
        typer.Option(metavar="MASS", help="Mass displacement of the vessel in the logs."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Draft a config for `residnet run` from logs.

    The draft has channels, units, frames, inputs, splits, protocols and models. In a terminal, the
    command asks for values that the logs do not determine; otherwise it uses a default and marks it
    as a guess.
    """
    from residnet.io.drafting.questions import READER_KEY
    from residnet.tasks.drafting import STOP, write_new_config
    from residnet.tasks.naval_draft import NavalParticulars

    options = {(*READER_KEY, "names"): names, (*READER_KEY, "time", "step"): step}
    answers = {key: answer for key, answer in options.items() if answer is not None}
    naval = NavalParticulars.from_options(
        length, scale, {"beam": beam, "draught": draught, "mass": mass}
    )
    with show_progress(quiet=quiet):
        prompt = None if defaults else interactive_prompt()
        config_file = output_file or Path("my_boat.yaml")
        lines = write_new_config(
            logs, config_file, prompt, overwrite=overwrite, answers=answers, naval=naval
        )
    print("\n".join(lines))
    if lines[-1].startswith(STOP):
        raise typer.Exit(1)


@app.command()
def demo(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder of the logs.")] = Path(
        "demo"
    ),
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace existing demo logs.")
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Write example logs of a simulated boat in several formats."""
    from residnet.tasks.demo import write_demo

    with show_progress(quiet=quiet):
        lines = write_demo(folder, overwrite=overwrite)
    print("\n".join(lines))


@app.command()
def check(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help=_CONFIG_HELP)],
    overrides: OverridesOption = None,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Validate a config, its files and packages without a run."""
    from residnet.tasks.registry import load_task

    with show_progress(quiet=quiet):
        task = load_task(config, overrides or [])
        task.check()
    print(f"{config}: the config is valid (task {task.task}, run {task.name})")


@app.command()
def inspect(
    logs: Annotated[
        list[Path],
        typer.Argument(
            metavar="LOG...",
            help="Logs in any format that the reader of the config supports; without --config, any"
            " format that `residnet new` reads.",
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option("--config", metavar="CONFIG", help="Config whose channel map reads the logs."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="Also write the findings to a JSON file."),
    ] = None,
    trust: TrustOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Check logs for errors that would mislead a fit.

    The checks cover clocks, gaps, jumps, frozen channels, reference frames, lags, copied channels
    and excitation. The exit code is 1 if a finding would mislead a fit.
    """
    from residnet.core.files import require_writable_file
    from residnet.tasks.inspection import inspect_logs

    if out is not None:
        require_writable_file(out)
        require_replaceable(out)
    with show_progress(quiet=quiet or as_json):
        findings = inspect_logs(logs, config)
    print(json.dumps(findings.inspection.to_content(), indent=1) if as_json else findings.text)
    if out is not None:
        findings.write(out)
    if findings.has_problems:
        raise typer.Exit(1)


def _collect_log_paths(run: Path, *path_groups: list[Path] | None) -> list[Path]:
    """Return the logs of a command line.

    Raises:
        UsageError: if there is no log.
    """
    from residnet.core.errors import UsageError

    logs = [path for path_group in path_groups for path in path_group or ()]
    if not logs:
        raise UsageError(f"{run}: no logs given; name files or folders of logs after the run")
    return logs


@app.command()
def evaluate(
    folder: RunArgument,
    log_arguments: LogArguments = None,
    log_options: LogOptions = None,
    output_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder of the results; default: RUN/external-<time>."
        ),
    ] = None,
    trust: TrustOption = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted evaluation.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier evaluation in the folder.")
    ] = False,
    quiet: QuietOption = False,
) -> None:
    """Evaluate the models of a finished fit on other logs."""
    from residnet.core.files import require_free_space
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import open_finished_task

    with show_progress(quiet=quiet):
        run, task = open_finished_task(folder, "evaluate")
        require_free_space(output_folder or folder)
        named = _collect_log_paths(folder, log_arguments, log_options)
        with name_damaged_key(folder):
            finished_run = task.evaluate_on_logs(
                run, named, output_folder, resume=resume, overwrite=overwrite
            )
    print_result(finished_run)


@app.command()
def monitor(
    folder: RunArgument,
    log_arguments: LogArguments = None,
    log_options: LogOptions = None,
    model: Annotated[str, typer.Option(metavar="NAME", help="Name of the model.")] = "selected",
    window: Annotated[str, typer.Option(metavar="TIME", help="Length of each free run.")] = "10 s",
    stretch: Annotated[
        str, typer.Option(metavar="TIME", help="Time span of the data in each score test.")
    ] = "300 s",
    false_alarm: Annotated[
        str, typer.Option(metavar="TIME", help="Mean time between false alarms.")
    ] = "10 h",
    output_folder: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR", help="Folder of the report and monitor.json."),
    ] = None,
    refit: Annotated[
        Path | None,
        typer.Option(
            "--refit",
            metavar="DIR",
            help="New run folder for a copy of the model with the identified changes.",
        ),
    ] = None,
    trust: TrustOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
    quiet: QuietOption = False,
) -> None:
    """Detect changes of a vessel in new logs.

    A model of a finished fit predicts the new logs; score tests on its errors name the change. The
    exit code is 1 if there is an alarm. A refit does not change the run.
    """
    from residnet.core.files import atomic_write, require_free_space
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import open_finished_task

    if output_folder is not None:
        require_free_space(output_folder)
        Manifest(output_folder).require_replaceable(output_folder / "monitor.json")
        Manifest(output_folder).require_replaceable(output_folder / "report.html")
    settings = {"window": window, "stretch": stretch, "false_alarm": false_alarm}
    with show_progress(quiet=quiet or as_json):
        run, task = open_finished_task(folder, "monitor")
        log_paths = _collect_log_paths(folder, log_arguments, log_options)
        with name_damaged_key(folder):
            monitored_logs, refit_result = task.monitor(run, log_paths, model, settings, refit)
    from residnet.report.records import MonitoredLogRow, MonitorFile, RefitRow

    rows: list[MonitoredLogRow | RefitRow] = [log.to_record() for log in monitored_logs]
    lines = [line for log in monitored_logs for line in log.to_lines()]
    if refit_result is not None:
        lines += refit_result.to_lines()
        rows.append(refit_result.to_record())
    document = json.dumps(MonitorFile(tuple(rows)).to_content(), indent=1)
    if output_folder is not None:
        from residnet.tasks.fit.service import write_monitoring_page

        with record_folder(output_folder):
            lines.append(f"page: {write_monitoring_page(output_folder, monitored_logs)}")
            with atomic_write(output_folder / "monitor.json") as temporary_file:
                temporary_file.write_text(document + "\n")
    print(document if as_json else "\n".join(lines))
    if any(log.alarm_time is not None for log in monitored_logs):
        raise typer.Exit(1)


@app.command(name="plan-trial")
def plan_trial(
    folder: RunArgument,
    model: Annotated[
        str,
        typer.Option(
            metavar="NAME", help="Refitted baseline; default: that of the booklet, else the first."
        ),
    ] = "",
    time: Annotated[str, typer.Option(metavar="TIME", help="Duration of each trial.")] = "120 s",
    area: Annotated[
        str | None,
        typer.Option(metavar="DISTANCE", help="Largest distance from the start, such as '200 m'."),
    ] = None,
    speed: Annotated[
        str | None, typer.Option(metavar="SPEED", help="Largest speed, such as '3 m/s'.")
    ] = None,
    rudder: Annotated[
        float, typer.Option(metavar="RATIO", help="Largest rudder command as a share of its range.")
    ] = 1.0,
    count: Annotated[int, typer.Option(metavar="N", help="Number of trials to propose.")] = 3,
    output_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder of next_trials.yaml, the tracks and a report."
        ),
    ] = None,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Plan the next trials by the information they add."""
    from residnet.core.files import require_free_space
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import open_finished_task

    if output_folder is not None:
        require_free_space(output_folder)
    limits = {"time": time, "area": area, "speed": speed, "rudder": rudder, "count": count}
    with show_progress(quiet=quiet):
        run, task = open_finished_task(folder, "plan-trial")
        with name_damaged_key(folder):
            next_trials = task.plan_trial(run, model, limits)
    print(next_trials.to_text())
    for file in next_trials.write_files(output_folder) if output_folder is not None else []:
        print(f"written: {file}")


@app.command()
def export(
    folder: RunArgument,
    model: Annotated[
        str,
        typer.Option(
            "--model",
            metavar="NAME",
            help="Name of the model, or 'selected' for the single model chosen on validation data;"
            " default: the model that the report rates.",
        ),
    ] = "predictor",
    file_format: Annotated[
        str, typer.Option("--format", metavar="FORMAT", help="One of `residnet list formats`.")
    ] = "torchscript",
    output_file: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write; default: RUN/exports/<model>.pt, or RUN/exports/<run>.c for C. The"
            " symbols of a C file begin with its name.",
        ),
    ] = None,
    allows_objections: Annotated[
        bool,
        typer.Option(
            "--anyway",
            help="Export a model that is worse than the baseline or rated 'do not use'; its card"
            " lists the reasons.",
        ),
    ] = False,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Export a model for controllers, with a parity check."""
    from residnet.core.files import require_writable_file
    from residnet.core.run_loader import name_damaged_key
    from residnet.runs.task import ExportRequest
    from residnet.tasks.registry import open_finished_task

    with show_progress(quiet=quiet):
        run, task = open_finished_task(folder, "export")
        require_writable_file(output_file or run.exported_models / model)
        with name_damaged_key(folder):
            exported_file = task.export_model(
                ExportRequest(run, model, output_file, file_format, allows_objections)
            )
    print(exported_file)


@app.command()
def ardupilot(
    source: Annotated[
        str,
        typer.Argument(
            metavar="VESSEL|RUN",
            help="Vessel (`residnet list vessels`), or folder of a finished fit.",
        ),
    ],
    model: Annotated[
        str, typer.Option("--model", metavar="NAME", help="Model of the run.")
    ] = "selected",
    servo: Annotated[
        list[str] | None,
        typer.Option(
            "--servo",
            metavar="COMMAND=OUTPUT:LOW:HIGH",
            help="Servo output of a command, and the command in SI units at 1000 and 2000 us.",
        ),
    ] = None,
    port: Annotated[
        int, typer.Option("--port", metavar="N", help="UDP port to which ArduPilot sends.")
    ] = 9002,
    trust: TrustOption = False,
) -> None:
    """Simulate a vessel or a model for ArduPilot.

    It implements the JSON interface of `sim_vehicle.py --model JSON`."""
    from residnet.simulators.ardupilot import ArduPilotBackend, assign_servos
    from residnet.simulators.vehicle import load_vehicle

    vehicle_model = load_vehicle(source, model=model, dt=0.0025)
    back_end = ArduPilotBackend(vehicle_model, assign_servos(vehicle_model, servo or ()), port)
    print(f"{vehicle_model.name} listens on UDP port {back_end.port}; Ctrl-C stops it", flush=True)
    for name, servo_output in zip(vehicle_model.inputs, back_end.servos, strict=False):
        print(
            f"  {name}: servo output {servo_output.channel}, {servo_output.lower_command:g} to"
            f" {servo_output.upper_command:g}",
            flush=True,
        )
    back_end.serve()


@app.command()
def derivatives(
    folder: RunArgument,
    length: Annotated[
        str, typer.Option(metavar="LENGTH", help="Length between perpendiculars, such as '7 m'.")
    ],
    speed: Annotated[
        str,
        typer.Option(
            metavar="SPEED", help="Speed about which the forces are expanded, such as '1.2 m/s'."
        ),
    ],
    model: Annotated[
        str,
        typer.Option(
            "--model", metavar="NAME", help="Model whose baseline is expanded in a Taylor series."
        ),
    ] = "baseline",
    draught: Annotated[
        str | None, typer.Option(metavar="DRAUGHT", help="Draught, such as '0.46 m'.")
    ] = None,
    beam: Annotated[
        str | None, typer.Option(metavar="BEAM", help="Beam, such as '1.27 m'.")
    ] = None,
    mass: Annotated[
        str | None, typer.Option(metavar="MASS", help="Displacement, such as '3270 kg'.")
    ] = None,
    centre_of_gravity: Annotated[
        str,
        typer.Option(
            "--xg",
            metavar="DISTANCE",
            help="Distance of the centre of gravity ahead of the origin.",
        ),
    ] = "0 m",
    gyradius: Annotated[
        float,
        typer.Option(metavar="RATIO", help="Radius of gyration in yaw divided by the length."),
    ] = 0.25,
    density: Annotated[
        str, typer.Option(metavar="DENSITY", help="Density of the water.")
    ] = "1000 kg/m^3",
    scale: Annotated[
        float,
        typer.Option(
            metavar="RATIO", help="Scale ratio: length at full scale divided by length in the logs."
        ),
    ] = 1.0,
    density_ratio: Annotated[
        float,
        typer.Option(
            metavar="RATIO",
            help="Density of the water at full scale divided by the density in the logs.",
        ),
    ] = 1.0,
    order: Annotated[
        int, typer.Option(metavar="N", help="Highest order of the Taylor series, 1 to 3.")
    ] = 1,
    output_file: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE",
            help="File to write, with the extension .json, .csv, .m, .yaml (vessel) or .sdf.",
        ),
    ] = None,
    format_name: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar="FORMAT",
            help="Format of --out: json, csv, matlab, vessel, mss or sdf; default: by extension.",
        ),
    ] = None,
    trust: TrustOption = False,
) -> None:
    """Print hydrodynamic derivatives with standard errors.

    The units are SI, prime I, prime II and bis.

    With beam, draught and mass, they are derivatives of
    forces instead of accelerations.
    """
    from residnet.core.errors import UsageError
    from residnet.core.files import write_owned
    from residnet.export.derivative_files import render_derivatives
    from residnet.tasks.derivatives import derive_run

    if format_name is not None and output_file is None:
        raise UsageError("--format: needs --out, the file to write")
    particulars = {
        "length": length,
        "speed": speed,
        "draught": draught,
        "beam": beam,
        "mass": mass,
        "centre_of_gravity": centre_of_gravity,
        "gyradius": gyradius,
        "density": density,
    }
    table = derive_run(
        folder,
        model,
        {name: value for name, value in particulars.items() if value is not None},
        order=order,
        scale=scale,
        density_ratio=density_ratio,
    )
    print(table.to_text())
    if output_file is not None:
        text = render_derivatives(table, output_file, format_name)
        with write_owned(output_file) as temporary_file:
            temporary_file.write_text(text)
        print(f"written: {output_file}")


@app.command()
def scale(
    folder: RunArgument,
    scale: Annotated[
        float,
        typer.Option(
            "--scale",
            metavar="RATIO",
            help="Scale ratio: length at full scale divided by length in the logs.",
        ),
    ],
    output_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder of the new run; default: RUN_full_scale."
        ),
    ] = None,
    models: Annotated[
        list[str] | None,
        typer.Option("--model", metavar="NAME", help="Model to scale; default: all models."),
    ] = None,
    density_ratio: Annotated[
        float,
        typer.Option(
            metavar="RATIO",
            help="Density of the water at full scale divided by the density in the logs.",
        ),
    ] = 1.0,
    resistance: Annotated[
        float,
        typer.Option(
            metavar="RATIO", help="Resistance coefficient of the ship divided by that of the model."
        ),
    ] = 1.0,
    form_factor: Annotated[
        float | None,
        typer.Option(
            metavar="K", help="Form factor k: resistance by ITTC 1978 instead of --resistance."
        ),
    ] = None,
    total_resistance: Annotated[
        float | None,
        typer.Option(
            metavar="C_TM",
            help="Total resistance coefficient C_TM of the towing test; needed with --form-factor.",
        ),
    ] = None,
    length: Annotated[
        str | None,
        typer.Option(metavar="LENGTH", help="Length of the model; needed with --form-factor."),
    ] = None,
    speed: Annotated[
        str | None,
        typer.Option(metavar="SPEED", help="Speed of the model; needed with --form-factor."),
    ] = None,
    propeller: Annotated[
        float,
        typer.Option(
            metavar="RATIO", help="Thrust at full scale divided by the thrust by Froude's law."
        ),
    ] = 1.0,
    rudder: Annotated[
        float,
        typer.Option(
            metavar="RATIO", help="Rudder force at full scale divided by the force by Froude's law."
        ),
    ] = 1.0,
    source: Annotated[
        str, typer.Option(metavar="TEXT", help="Source of the factors, stored with the run.")
    ] = "",
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier run in the folder.")
    ] = False,
    trust: TrustOption = False,
    quiet: QuietOption = False,
) -> None:
    """Scale the models and logs of a fit by Froude's law.

    The new run can be evaluated, exported and simulated like any other run. Froude's law ignores
    viscosity. Factors of resistance, propeller and rudder correct this; state their source.
    """
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.registry import open_finished_task
    from residnet.tasks.scale_settings import ScaleRequest, make_scale_settings

    with show_progress(quiet=quiet):
        run, task = open_finished_task(folder, "scale")
        scaling, effects = make_scale_settings(
            scale,
            density_ratio,
            {"resistance": resistance, "propeller": propeller, "rudder": rudder, "source": source},
            form_factor=form_factor,
            total_resistance=total_resistance,
            length=length,
            speed=speed,
        )
        output = output_folder or folder.with_name(f"{folder.resolve().name}_full_scale")
        with name_damaged_key(folder):
            request = ScaleRequest(run, output, scaling, effects, models or (), overwrite)
            finished_run = task.scale_run(request)
    print_result(finished_run)


@app.command()
def report(
    folder: RunArgument,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write a client report as PDF.")] = False,
    template: Annotated[
        str,
        typer.Option(
            metavar="NAME|FILE",
            help="Template of the PDF: 'client', or your own Typst file (.typ).",
        ),
    ] = "client",
    logo: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Image in the header of the PDF.")
    ] = None,
    text: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML file with title, subtitle, client, author, reference, introduction and"
            " conclusions.",
        ),
    ] = None,
    output_file: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="PDF file; default: RUN/client_report.pdf."),
    ] = None,
    quiet: QuietOption = False,
) -> None:
    """Rewrite the report of a finished run, or write a PDF."""
    from residnet.tasks.registry import report_run, write_client_pdf

    with show_progress(quiet=quiet):
        if pdf:
            page = write_client_pdf(folder, output_file, template, logo, text)
        else:
            page = report_run(folder)
    print(page)


@app.command()
def trust(
    folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run or of a single model.")
    ],
) -> None:
    """Accept new and changed files of a run folder.

    The command lists these files and writes their checksums. Use it only if you trust the source of
    the folder: its numbers are then used as results of a run, and later commands may replace its
    files. It executes no code of the folder.
    """
    from residnet.core.run_loader import accept_run

    lines = accept_run(folder)
    print("\n".join([*lines, f"{folder}: accepted, {len(lines)} files were new or changed"]))


@app.command()
def compare(
    folders: Annotated[
        list[Path], typer.Argument(metavar="RUN RUN...", help="Folders of finished fits.")
    ],
    output_folder: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder of the report.")
    ] = Path("comparison"),
    quiet: QuietOption = False,
) -> None:
    """Compare finished fits on common logs.

    The report has errors, paired confidence intervals and differences of settings."""
    from residnet.core.run_loader import name_damaged_key
    from residnet.tasks.compare import compare_runs

    with show_progress(quiet=quiet), name_damaged_key(folders[0]):
        text, page = compare_runs(folders, output_folder)
    print(text)
    print(f"page: {page}")


@app.command()
def runs(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Folder of runs.")] = Path("runs"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List runs with task, state, best result and age."""
    from residnet.tasks.registry import format_runs, list_runs

    rows = list_runs(folder)
    content = [row.model_dump(mode="json") for row in rows]
    print(json.dumps(content, indent=1) if as_json else format_runs(folder, rows))


@app.command(name="list")
def list_names(
    part_kind: Annotated[
        Literal[
            "vessels", "heads", "manoeuvres", "readers", "tasks", "baselines", "formats", "configs"
        ],
        typer.Argument(
            metavar="KIND",
            help="Kind of part.",
        ),
    ],
) -> None:
    """List the parts that a config can use."""
    from residnet.tasks.registry import list_catalogue

    for name, description in list_catalogue(part_kind):
        print(f"{name:28s} {description}")


def print_result(finished_run: FinishedRun) -> None:
    """Print the verdict and table of a run, its exported files and its report."""
    if finished_run.outcome.level:
        print(f"{finished_run.outcome.level.capitalize()}:")
    for sentence in finished_run.outcome.verdict:
        print(sentence)
    if finished_run.outcome.table:
        print(finished_run.outcome.table)
    for file in finished_run.exports:
        print(f"exported: {file}")
    if finished_run.folder.report.is_file():
        print(f"report: {finished_run.folder.report}")


def main() -> None:
    """Run the command line; an error that a user can cause is one line and an exit code."""
    run_cli(_build_command())


@cache
def _build_command() -> Callable[[], object]:
    """Build the command line once per process, since reading all signatures takes 30 ms."""
    return get_command(app)


if __name__ == "__main__":
    main()
