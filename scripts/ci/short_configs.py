"""Run every shipped config in a shortened form, to its report.

`shorten_parts` shortens the parts of a config: fewer trials, one epoch, a coarser grid.
`SPECIFIC_OVERRIDES` has further overrides by config. No part of a run is removed. Configs whose
data are absent are reported as skipped; a run that takes longer than `TIME_LIMIT` fails.

    python scripts/ci/short_configs.py [NAME...] [--jobs 2] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import functools
import json
import multiprocessing
import os
import re
import sys
import tempfile
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from residnet.core.config import load_mapping

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs"
TIME_LIMIT = 400
"""Seconds after which a run has failed."""


@dataclass(frozen=True)
class ShortConfig:
    """The shortened form of a config.

    Attributes:
        overrides: overrides of keys; `{runs}` is replaced by the folder of all short runs.
        data: required folder below RESIDNET_DATA; empty for none.
        after: config whose short run is used; empty for none.
    """

    overrides: tuple[str, ...] = ()
    data: str = ""
    after: str = ""


# fewer simulated sea trials
TRIALS = (
    "data.trials=[{kind: constant, drive: [0.4, 0.9], steer: [-0.4, 0.0, 0.4]},"
    " {kind: zigzag, count: 5, heading: [20 deg]}, {kind: acceleration_deceleration, count: 3},"
    " {kind: three_two_one_one, count: 3}]",
    "data.identification={zigzag: 4, acceleration_deceleration: 2, three_two_one_one: 2}",
    "data.validation={zigzag: 1, acceleration_deceleration: 1, three_two_one_one: 1}",
)
# fewer simulated trials under water
DIVES = (
    "data.trials=[{kind: depth_step, count: 4, depth: [1], drive: [0.1, 0.2], dive: [0.1, 0.2]},"
    " {kind: random_steps, count: 4, drive: [0.1, 0.2], steer_amplitude: [0.0, 0.04],"
    " dive_amplitude: [0.0, 0.1], own_amplitude: [0.01, 0.04]}]",
    "data.identification={depth_step: 3, random_steps: 3}",
    "data.validation={depth_step: 1, random_steps: 1}",
)
EPOCH = {
    "steps": "2",
    "one_step": "{epochs: 1, window: 2 s, batch: 32}",
    "multi_step": "[{horizon: 2 s, epochs: 1, batch: 32}]",
}
COARSE = (
    "prepare.grid={step: 0.5 s, held: [n, delta]}",
    "prepare.derivative={kind: savitzky_golay, window: 2.5 s, order: 2}",
    "evaluation.splits=[validation, test]",
)
FLIGHTS = (
    "conditions.flights=8",
    "conditions.stated.dt=0.1 s",
    "conditions.stated.duration=6 s",
    "conditions.stated.hold=1 s",
    "conditions.evolution={flights: 2, population: 2, generations: 1}",
)
BEYOND = "conditions.beyond={delay: {dt: 0.1 s, duration: 6 s, hold: 1 s, delay: [0.6 s, 0.6 s]}}"
POLICY = {
    **{"epochs": "1", "steps": "1", "batch": "16", "validation": "16", "hold": "0 s"},
    **{"compiled": "false", "dt": "0.1 s", "steady": "{flights: 2}"},
}


def override_keys(section: str, values: Mapping[str, str]) -> list[str]:
    """Return overrides of several keys of a section."""
    return [f"{section}.{key}={value}" for key, value in values.items()]


def shorten_parts(content: Mapping[str, Any]) -> list[str]:
    """Return the overrides that follow from the parts of a config."""
    data = content.get("data") or {}
    overrides: list[str] = []
    kinds = {trial["kind"] for trial in data.get("trials", ())}
    overrides += DIVES if "depth_step" in kinds else TRIALS if "three_two_one_one" in kinds else ()
    overrides += COARSE if data.get("kind") == "measured" else ()
    overrides += ["refit={}"] if "refit" in content else []
    overrides += ["bands=null"] if "refit" in content or data.get("kind") == "measured" else []
    for head, settings in content.get("training", {}).items():
        # the training of task `roll` has no heads
        if isinstance(settings, Mapping):
            overrides += override_keys(f"training.{head}", EPOCH)
    if "conditions" in content:
        overrides += [*FLIGHTS, *[BEYOND] * ("beyond" in content["conditions"])]
    for name, policy in (content.get("policies") or {}).items():
        # a config that sets `steady` itself keeps its value
        has_steady = "steady" in policy["training"]
        settings = {k: value for k, value in POLICY.items() if k != "steady" or not has_steady}
        overrides += override_keys(f"policies.{name}.training", settings)
    for name in content.get("predictive", ()):
        overrides.append(f"predictive.{name}.training={{states: 300, epochs: 5, batch: 50}}")
    task = content["task"]
    overrides += ["test.plants=2", "test.dt=0.1 s"] if task == "autopilot" else []
    overrides += ["test.bias_time=20 s"] if "beyond" in content.get("conditions", ()) else []
    overrides += ["course.interval=10 s"] if task == "ferry_study" else []
    overrides += ["repeats=1"] if task == "breeding" else []
    return overrides


def set_durations(seconds: int, *policies: str) -> tuple[str, ...]:
    """Return overrides of the durations of simulations of a slow vessel."""
    return (
        f"conditions.stated.duration={seconds} s",
        *(f"policies.{name}.training.duration={seconds} s" for name in policies),
        f"test.duration={2 * seconds + 2} s",
        f"test.bias_time={2 * seconds + 2} s",
    )


TORPEDO = (
    *("turning_time=8 s", "test.duration=8 s", "test.bias_time=8 s", "~conditions.beyond"),
    *("~peers.pd", "~peers.lqr"),
)
GENETIC = "heads.genetic.evolution={population: 30, generations: 2}"
ALL_SPLITS = "evaluation.splits=[train, validation, test]"
PHYSICS = "baselines.physics={kind: regressors, terms: [u, v, r, n]}"
HEAD = "heads={mlp: {kind: mlp, hidden: [8]}}"
STEPS = ("~training.lstm", *override_keys("training.mlp", EPOCH))
SWEPT = [*TRIALS, HEAD, *STEPS, "bands=null", "export.models=[]"]
FEW = "{drives: [0.35, 0.55, 0.7, 1.0], steers: [0.3], zigzag: 40 s, hold: 10 s, courses: [0.0]}"
HORIZON = "training: {states: 300, epochs: 5}"
ONE_CELL = ("rows.values=[0.2]", "columns.values=[0.2]", "~published")
SPECIFIC_OVERRIDES: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("wam_v_s2", "wam_v_s3", "wam_v_equations"), ("bands=null",)),
    "simulate_wam_v": ("~programme.families",),
    "sweep_quickstart": (
        f"common={SWEPT}",
        "space={heads.mlp.hidden: {choices: [[8], [16]]}}",
        "search.trials=2",
        "runner.workers=1",
    ),
    "kvlcc2": (
        "refit.mmg={horizon: 20 s, every: 40 s, prior: 0, robust: 0.3, iterations: 2}",
        *("booklet.draws=20", ALL_SPLITS),
    ),
    **dict.fromkeys(("esso_osaka", "esso_osaka_no_wind"), (PHYSICS,)),
    "esso_osaka_standard": (
        "data.split={root: '${RESIDNET_DATA}/esso_osaka', train:"
        " [{log: 'zigzag/*13_04_24.csv', from: 0 s, to: 150 s},"
        " {log: 'zigzag/*13_14_21.csv', from: 0 s, to: 150 s}], validation:"
        " [{log: 'zigzag/*13_29_19.csv', from: 0 s, to: 150 s}], test:"
        " [{log: 'zigzag/*13_42_53.csv', from: 0 s, to: 150 s}]}",
        "evaluation.selection=T10",
        "evaluation.protocols={T10: {kind: windows, length: 10 s}}",
        "prepare.grid={step: 1 s, held: [n, delta]}",
        "prepare.derivative={kind: savitzky_golay, window: 5 s, order: 2}",
        "effort=0.01",
    ),
    **dict.fromkeys(("autopilot_remus", "autopilot_remus_depth"), TORPEDO),
    "roll_patrol": (
        *("sea_states=[4]", "duration=30 s", "transient=10 s", "tuning.generations=2"),
        *("training.epochs=1", "training.steps=2", "judging={duration: 40 s, realisations: 3}"),
    ),
    "autopilot_conditions_patrol": (
        *set_durations(12, "learned", "constants"),
        "test.sea_time=10 s",
    ),
    "autopilot_patrol": (*set_durations(12, "policy"), "test.sea_time=10 s"),
    "autopilot_patrol_learned": (
        *set_durations(12, "on_vessel", "on_model"),
        "policies.on_model.learned.run={runs}/patrol_identified",
    ),
    "studies/esso_osaka/ablation": (
        "search.variants={recipe: [], no_mirror: ['heads.mlp.mirror=false']}",
        f"common={[PHYSICS, 'refit={}', HEAD, 'base_of={mlp: hull}', 'ensembles={}', *STEPS]}",
        "search.seeds=[0]",
        "runner.workers=1",
    ),
    "studies/gouletas2020/heading_nomoto": (
        f"predictive={{mlp_printed: {{horizon: 0.01 s, {HORIZON}}},"
        f" mlp_3s_linear: {{horizon: 3 s, linear: true, {HORIZON}}}}}",
    ),
    "studies/gouletas2020/heading_patrol": (
        f"predictive={{mlp_10s: {{horizon: 10 s, hidden: [30], {HORIZON}}}}}",
        *("test.dt=0.25 s", "test.duration=30 s"),
    ),
    "studies/gouletas2020/table_6_3": (
        *("autopilot={runs}/autopilot_nomoto", "spread.flights=2", "protocols=[enter]"),
        *("dt=0.1 s", "line_of_sight=[{kind: lookahead, distance: 17 m}]"),
    ),
    "studies/gouletas2020/table_6_8": (
        *("autopilot={runs}/autopilot_patrol", "protocols=[enter]", "duration=300 s"),
        "line_of_sight=[{kind: lookahead, distance: 123 m}]",
    ),
    "studies/halvorsen2019/force_equations": (GENETIC,),
    "studies/halvorsen2019/jet_equations": (GENETIC,),
    "studies/halvorsen2019/table_5_2": (
        *("rows.values=[2]", "columns.values=[5]", "~published", "~published_error"),
    ),
    "studies/halvorsen2019/table_5_3": ONE_CELL,
    "studies/halvorsen2019/table_5_3_small": ONE_CELL,
    "studies/halvorsen2019/delay": ("rows.values=[none]", "columns.values=[0.0, 0.5]"),
    "studies/halvorsen2019/standard_model": (
        "~trials.planing",
        *(f"trials.{name}.programme={FEW}" for name in ("standard", "calm")),
    ),
    "studies/jervan2020/measured": ("validation.folds=2",),
    "studies/moreno2019/moreno2019": (
        *("heads.gptips.evolution.population=30", "heads.gptips.evolution.generations=2"),
        ALL_SPLITS,
    ),
    "studies/woo2018/outside_terms": (
        "data.trials=[{kind: zigzag, count: 6, heading: [10 deg], steer: [0.15, 0.9],"
        " drive: [1.0, 1.0]}]",
        "data.identification={zigzag: 5}",
        "data.validation={zigzag: 1}",
    ),
}
AFTER = {
    "autopilot_patrol_learned": "patrol_identified",
    "studies/gouletas2020/table_6_3": "autopilot_nomoto",
    "studies/gouletas2020/table_6_8": "autopilot_patrol",
}


def list_shipped_configs() -> list[str]:
    """Return the names of all configs of runs: their paths below configs/, without suffix."""
    files = (path for path in CONFIGS.rglob("*.yaml") if path.parent.name != "vessels")
    return sorted(path.relative_to(CONFIGS).with_suffix("").as_posix() for path in files)


@functools.cache
def shorten_config(name: str) -> ShortConfig:
    """Return the shortened form of a config."""
    file = CONFIGS / f"{name}.yaml"
    content = load_mapping(file)
    base = file.parent / content["base"] if "base" in content else file
    data_match = re.search(r"\$\{RESIDNET_DATA\}/(\w+)", base.read_text(encoding="utf-8"))
    overrides = (*shorten_parts(content), *SPECIFIC_OVERRIDES.get(name, ()))
    return ShortConfig(overrides, data_match[1] if data_match else "", AFTER.get(name, ""))


class Result(NamedTuple):
    """Result of the short run of a config.

    Attributes:
        state: `ok`, `skipped` or `FAILED`.
        reason: reason for a skipped or failed run.
    """

    state: str
    reason: str = ""


def run_config(name: str, runs: Path) -> Result:
    """Run a config in its short form; check its report and that it is finished.

    The run is a fork of this process, which has loaded the libraries: it saves ten seconds.
    """
    short_config = shorten_config(name)
    start_time = time.monotonic()
    folder = runs / name.replace("/", "_")
    data_folder = Path(os.environ.get("RESIDNET_DATA", "")) / short_config.data
    if short_config.data and not data_folder.is_dir():
        result = Result("skipped", f"no RESIDNET_DATA/{short_config.data}")
    else:
        runs.mkdir(parents=True, exist_ok=True)
        command = ["residnet", "run", str(CONFIGS / f"{name}.yaml"), "--out", str(folder)]
        for override in short_config.overrides:
            command += ["-s", override.replace("{runs}", str(runs))]
        result = run_forked(command, folder)
    seconds = time.monotonic() - start_time
    print(f"{result.state:8s} {seconds:6.1f} s  {name}  {result.reason}".rstrip(), flush=True)
    return result


def run_forked(command: list[str], folder: Path) -> Result:
    """Run a command in a fork of this process and check the run folder."""
    output_file = folder.with_suffix(".txt")
    process = multiprocessing.get_context("fork").Process(
        target=run_command, args=(command, output_file)
    )
    process.start()
    process.join(TIME_LIMIT)
    if process.is_alive():
        process.kill()
        return Result("FAILED", f"not done after {TIME_LIMIT} s")
    if process.exitcode:
        last_line = (output_file.read_text().strip().splitlines() or [""])[-1]
        return Result("FAILED", f"exit {process.exitcode}: {last_line}")
    summary = json.loads((folder / "summary.json").read_text())
    if not summary["finished"] or not summary["verdict"]:
        return Result("FAILED", "summary.json does not say finished, or has no verdict")
    has_report = (folder / "report.html").is_file()
    return Result("ok") if has_report else Result("FAILED", "no report.html")


def run_command(command: list[str], output_file: Path) -> None:
    """Run a command in this process, write its output to a file, and end the process."""
    from residnet.__main__ import main

    with output_file.open("w") as stream:
        for output in (sys.stdout, sys.stderr):
            os.dup2(stream.fileno(), output.fileno())
        sys.argv = command
        exit_code: object = 0
        try:
            main()
        except SystemExit as end:
            exit_code = end.code
        sys.stdout.flush()
        sys.stderr.flush()
    # a normal exit would wait for threads of the parent, which do not run in the fork
    os._exit(exit_code if isinstance(exit_code, int) else 0)


def main() -> int:
    """Run the named configs, or all; return 1 if one failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="configs below configs/, without suffix")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel runs")
    parser.add_argument("--out", type=Path, help="folder for the runs; a temporary one otherwise")
    arguments = parser.parse_args()
    shipped_names = list_shipped_configs()
    if unknown_names := sorted({*SPECIFIC_OVERRIDES, *AFTER} - set(shipped_names)):
        raise SystemExit(f"{Path(__file__).name} has unknown configs: {', '.join(unknown_names)}")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    import lightning  # noqa: F401  (every run that trains loads it; forks have it already)

    import residnet.tasks.registry  # noqa: F401

    start_time = time.monotonic()
    selected_names = set(arguments.names or shipped_names)
    selected_names |= {AFTER[name] for name in selected_names if name in AFTER}
    results: list[Result] = []
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(arguments.jobs) as pool:
        runs = arguments.out or Path(temporary)
        # configs whose runs are used by others come first
        for uses_other_run in (False, True):
            names = sorted(n for n in selected_names if (n in AFTER) == uses_other_run)
            results += pool.map(lambda name: run_config(name, runs), names)
    failed = sum(result.state == "FAILED" for result in results)
    skipped = sum(result.state == "skipped" for result in results)
    print(
        f"{len(results)} configs: {failed} failed, {skipped} skipped without data,"
        f" {time.monotonic() - start_time:.0f} s"
    )
    return min(failed, 1)


if __name__ == "__main__":
    sys.exit(main())
