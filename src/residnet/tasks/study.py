"""Task `study`: ablation of a fit, with several seeds for each variant and paired intervals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from residnet.core.config import BaseConfig, load_config
from residnet.core.errors import DataError, UsageError
from residnet.core.files import read_json
from residnet.core.format import format_count, format_signed
from residnet.core.names import suggest_name
from residnet.core.processes import process_pool
from residnet.core.progress import report_progress
from residnet.evaluation.metrics import bootstrap_intervals, make_resampling_blocks
from residnet.report.blocks import (
    Cell,
    Column,
    Section,
    Table,
    Text,
    build_table,
    format_paired_interval,
)
from residnet.report.figure import (
    BLUE,
    Case,
    Figure,
    GlyphStyle,
    Panel,
    error_bars,
    join_with_gaps,
    tick_labels,
)
from residnet.report.figure_files import write_figures
from residnet.report.run_reader import JsonObject, RunFiles
from residnet.runs.folder import RunFolder
from residnet.runs.task import PartName, SummaryMetric, Task, TaskOutcome
from residnet.tasks.fit.config import FitConfig

if TYPE_CHECKING:
    import pandas as pd


class StudyConfig(Task):
    """Variants of one fit, each over several seeds, compared window by window.

    Attributes:
        base: config of a fit: a path, or the name of a config that comes with residnet; paths in it
            are relative to its own folder.
        common: overrides of the base for all variants.
        variants: overrides of the base by name of the variant.
        reference: variant with which the others are compared.
        model: model whose free-run errors are compared; `selected` for the model that each run
            selects on validation data.
        split: split of the compared windows.
        seeds: seeds with which each variant is fitted.
        workers: number of runs in parallel processes.
    """

    task: Literal["study"]
    base: BaseConfig
    common: tuple[str, ...] = ()
    variants: dict[PartName, tuple[str, ...]] = Field(min_length=2)
    reference: str
    model: str = "selected"
    split: Literal["validation", "test"] = "test"
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = Field(default=(0, 1, 2), min_length=1)
    workers: int = Field(default=1, ge=1, le=1_024)

    @model_validator(mode="after")
    def _validate_study(self) -> StudyConfig:
        if self.reference not in self.variants:
            raise ValueError(
                "reference: no variant is named"
                f" '{self.reference}'{suggest_name(self.reference, self.variants)}"
            )
        if len(set(self.seeds)) < len(self.seeds):
            raise ValueError(f"seeds: each only once, given {list(self.seeds)}")
        return self

    def build_overrides(self, variant: str, seed: int) -> list[str]:
        """Return the overrides of the base for one run."""
        return [
            *self.common,
            *self.variants[variant],
            f"name={self.name}.{variant}.{seed}",
            f"seed={seed}",
        ]

    def check(self) -> None:
        """Check that every variant is a valid fit with the compared model.

        Raises:
            ConfigError: if a variant is not a valid config.
            UsageError: if a variant has no such model.
        """
        for variant in self.variants:
            fit = load_config(self.base, self.build_overrides(variant, self.seeds[0]), FitConfig)
            fit.check()
            models = ("selected", *fit.model_names)
            if self.model not in models:
                raise UsageError(
                    f"variant {variant}: no model is named"
                    f" '{self.model}'{suggest_name(self.model, models)}"
                )

    def input_files(self) -> list[Path]:
        return [self.base]

    def provenance_seed(self) -> int:
        return self.seeds[0]

    def execute(self, folder: RunFolder) -> TaskOutcome:
        """Fit all variants and write the comparison; finished runs are reused.

        Raises:
            ResidnetError: if a variant cannot be run, or the system ends a process.
        """
        folder_by_job = {
            (variant, seed): folder.path / "variants" / f"{variant}.{seed}"
            for variant in self.variants
            for seed in self.seeds
        }
        seconds = dict[tuple[str, int], float]()
        if self.workers == 1:
            for number, (job, folder_path) in enumerate(folder_by_job.items()):
                report_progress("fits of the study", number, len(folder_by_job))
                seconds[job] = _run_variant(self, *job, folder_path)
            report_progress("fits of the study", len(folder_by_job), len(folder_by_job))
        else:
            with process_pool(self.workers) as pool:
                job_arguments = [
                    (self, *job, folder_path) for job, folder_path in folder_by_job.items()
                ]
                durations = pool.map(_run_variant, *zip(*job_arguments, strict=True))
                seconds = dict(zip(folder_by_job, durations, strict=True))
        import pandas as pd

        errors = pd.concat(
            {
                job: compute_window_errors(folder_path, self.model, self.split)
                for job, folder_path in folder_by_job.items()
            },
            names=["variant", "seed"],
        )
        rows = compare_variants(errors, self.reference)
        for row in rows:
            row["overrides"] = list(self.variants[row["variant"]])
            row["seconds"] = float(np.mean([seconds[row["variant"], seed] for seed in self.seeds]))
        content = {
            "schema": "residnet.study/1",
            "run": self.name,
            "model": self.model,
            "split": self.split,
            "reference": self.reference,
            "rows": rows,
        }
        folder.write_json(folder.path / "study.json", content)
        summary_metrics = {
            f"nrmse_{row['variant']}_{row['protocol']}": SummaryMetric(row["nrmse_mean"])
            for row in rows
        }
        text = tabulate_variants(rows, self.reference).to_text()
        return TaskOutcome(_summarize_variants(rows, self.reference), summary_metrics, text)

    @classmethod
    def report_sections(cls, run: RunFolder) -> Sequence[Section]:
        content = RunFiles(run.path).read_json("study.json")
        rows = content["rows"]
        figure_blocks = write_figures(run.figures, [plot_differences(rows, content["reference"])])
        explanation = [
            f"Free-run NRMSE of model {content['model']} on {content['split']} data, mean over the"
            f" windows and {format_count(rows[0]['seeds'], 'seed')}.",
            f"Difference: to {content['reference']} over the same windows, seeds averaged first;"
            " negative is better, and a bold interval excludes 0. Its 95 % interval comes from"
            " blocks of windows.",
        ]
        table = tabulate_variants(rows, content["reference"])
        return [Section("", [table, *figure_blocks, Text(explanation, is_secondary=True)])]


def _summarize_variants(rows: Sequence[dict[str, Any]], reference: str) -> list[str]:
    """Return a sentence for each protocol on the variant with the lowest error."""
    sentences = []
    for protocol in dict.fromkeys(row["protocol"] for row in rows):
        protocol_rows = [row for row in rows if row["protocol"] == protocol]
        # diverged runs have the constant-velocity error: variants without them are ranked first
        best_row = min(
            protocol_rows, key=lambda row: (int(row["diverged"]) > 0, float(row["nrmse_mean"]))
        )
        qualifier = " of the steady ones" if any(row["diverged"] for row in protocol_rows) else ""
        sentence = (
            f"{protocol}: '{best_row['variant']}' has the least free-run NRMSE{qualifier},"
            f" {best_row['nrmse_mean']:.4f}"
        )
        if best_row["diverged"]:
            sentence = (
                f"{protocol}: EVERY VARIANT DIVERGED in some windows; of the errors, which count"
                f" those windows as constant velocity does, that of '{best_row['variant']}' is"
                f" the least,"
                f" {best_row['nrmse_mean']:.4f}"
            )
        interval = best_row["difference_ci95"]
        if best_row["variant"] != reference and interval is not None:
            sentence += (
                f"; that is {best_row['difference']:+.4f} [{interval[0]:+.4f}, {interval[1]:+.4f}]"
                f" from '{reference}'"
            )
        sentences.append(f"{sentence}.")
        diverged_rows = [row for row in protocol_rows if row["diverged"]]
        if diverged_rows:
            diverged_text = ", ".join(
                f"'{row['variant']}' in {row['diverged']} windows" for row in diverged_rows
            )
            sentences.append(f"{protocol}: free runs DIVERGED: {diverged_text}.")
    return sentences


def _run_variant(study: StudyConfig, variant: str, seed: int, folder_path: Path) -> float:
    """Run one variant with one seed unless it is finished; returns the duration in s."""
    if not RunFolder(folder_path).is_finished:
        overrides = study.build_overrides(variant, seed)
        load_config(study.base, overrides, FitConfig).run(
            source=study.base,
            overrides=overrides,
            output_folder=folder_path,
            resume=True,
            report=False,
        )
    return float(read_json(RunFolder(folder_path).provenance)["seconds"])


def compute_window_errors(run: Path, model: str, split: str) -> pd.DataFrame:
    """Return the errors of one model of a finished run, from its stored rollouts.

    Args:
        model: name of a model; `selected` for the model chosen on validation data.

    Returns:
        A row for each window: protocol, log, window, nrmse (mean over the velocities; a diverged
        window has the error of `constant_velocity`) and diverged.

    Raises:
        DataError: if the run has no such model or split.
    """
    import pandas as pd

    files = RunFiles(run)
    name = files.selected if model == "selected" else model
    windows = files.read_split_windows(split)
    if not windows:
        raise DataError(f"{run}: no rollouts of the split '{split}'")
    if name is None or name not in windows[0].predicted:
        raise DataError(f"{run}: no model '{name}' among {', '.join(windows[0].predicted)}")
    scales = {name: float(files.metrics["scales"][name]) for name in files.dof.active_states}
    return pd.DataFrame(
        {
            "protocol": window.protocol,
            "log": window.log,
            "window": window.number,
            "nrmse": window.mean_nrmse(name, scales),
            "diverged": window.diverged[name],
        }
        for window in windows
    )


def compare_variants(errors: pd.DataFrame, reference: str) -> list[dict[str, Any]]:
    """Return one row per variant and protocol.

    A row has the number of windows that diverged, the mean error over windows and seeds, its
    standard deviation over seeds (None for one seed), the smallest and largest of the seeds, and
    the difference to the reference variant over the same windows, seeds averaged first, with its
    95 % interval by blocks of windows.

    Args:
        errors: results of `compute_window_errors`, by variant and seed.
        reference: name of the reference variant.
    """
    import pandas as pd

    rows = []
    for (variant, protocol), variant_errors in errors.groupby(["variant", "protocol"], sort=False):
        reference_errors = errors.loc[reference]
        differences_mean, reference_mean = (
            error_table.groupby(["log", "window"], sort=False)["nrmse"].mean()
            for error_table in (
                variant_errors,
                reference_errors[reference_errors["protocol"] == protocol],
            )
        )
        differences_mean -= reference_mean
        logs = pd.factorize(differences_mean.index.get_level_values("log"))[0]
        (interval,) = bootstrap_intervals(
            differences_mean.to_numpy()[:, None], make_resampling_blocks(logs)
        )
        by_seed = variant_errors.groupby("seed")["nrmse"].mean()
        rows.append(
            {
                "variant": variant,
                "protocol": protocol,
                "seeds": len(by_seed),
                "windows": len(differences_mean),
                "diverged": int(variant_errors["diverged"].sum()),
                "nrmse_mean": float(by_seed.mean()),
                "nrmse_sd": float(by_seed.std()) if len(by_seed) > 1 else None,
                "nrmse_range": [float(by_seed.min()), float(by_seed.max())],
                "difference": float(differences_mean.mean()),
                "difference_ci95": None if variant == reference else interval,
            }
        )
    return rows


def plot_differences(rows: Sequence[JsonObject], reference: str) -> Figure:
    """Plot the differences to the reference with intervals, one panel for each protocol.

    Args:
        reference: name of the reference variant.
    """
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))
    names = [name for name in dict.fromkeys(row["variant"] for row in rows) if name != reference]
    panel_curves = []
    panels = []
    for protocol in protocols:
        protocol_rows = [
            row for row in rows if row["protocol"] == protocol and row["variant"] != reference
        ]
        positions = [names.index(row["variant"]) for row in protocol_rows]
        interval_spans = [
            (position, *row["difference_ci95"])
            for position, row in zip(positions, protocol_rows, strict=True)
            if row["difference_ci95"]
        ]
        interval_lines = join_with_gaps(
            [
                error_bars(*[[part] for part in interval_span])[::-1]
                for interval_span in interval_spans
            ]
        )
        points = (
            np.array([row["difference"] for row in protocol_rows]),
            np.array(positions, dtype=float),
        )
        panel_curves.append(
            {"interval": interval_lines, "difference": points, "zero": (np.zeros(1), np.zeros(1))}
        )
        label = f"{protocol}: NRMSE minus that of {reference} [-]"
        panels.append(
            Panel(
                "",
                label,
                height=80 + 31 * len(names),
                group=protocol,
                y_names=tick_labels(names),
                y_limits=(len(names) - 0.5, -0.5),
            )
        )
    return Figure(
        "study",
        "Variants of the recipe",
        f"Free-run error of each variant minus that of {reference}, mean over windows and seeds."
        " The bars are 95 % intervals over logs.",
        {
            "zero": GlyphStyle("", "#666666", width=0.8, kind="upright", z_order=1),
            "interval": GlyphStyle("95 % interval", width=1.2),
            "difference": GlyphStyle("difference", BLUE, kind="points", size=4.5, z_order=4),
        },
        panels,
        [Case("", panel_curves)],
        columns=len(protocols),
    )


def tabulate_variants(rows: Sequence[JsonObject], reference: str) -> Table:
    """Return the table of variants with error and difference under each protocol.

    Args:
        reference: name of the reference variant.
    """
    by_variant: dict[str, dict[str, JsonObject]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], {})[row["protocol"]] = row
    protocols = list(dict.fromkeys(row["protocol"] for row in rows))

    def format_error(row: JsonObject) -> Cell:
        # results of earlier versions have no count of diverged windows
        n_diverged = int(row.get("diverged", 0))
        note = f"{n_diverged} diverged" if n_diverged else ""
        protocol_rows = [other for other in rows if other["protocol"] == row["protocol"]]
        is_lowest = row["nrmse_mean"] == min(other["nrmse_mean"] for other in protocol_rows)
        return Cell(
            f"{row['nrmse_mean']:.4f}", note, "bad" if n_diverged else "best" if is_lowest else ""
        )

    protocol_columns: list[Column] = [
        ("NRMSE", format_error),
        ("sd of seeds", lambda row: row["nrmse_sd"], 4),
        (
            "difference",
            lambda row: format_signed(row["difference"]) if row["difference_ci95"] else "",
            str,
        ),
        ("95 % interval", lambda row: format_paired_interval(row["difference_ci95"], "")),
    ]
    return build_table(
        by_variant.values(),
        [
            ("variant", lambda row: row[protocols[0]]["variant"]),
            *(
                (title, lambda row, name=name, of=cell_function: of(row[name]), *number_format)
                for name in protocols
                for title, cell_function, *number_format in protocol_columns
            ),
            ("run [s]", f"{protocols[0]}.seconds", 0),
            ("what changes", lambda row: ", ".join(row[protocols[0]]["overrides"])),
        ],
        groups=[*((f"protocol {name}", len(protocol_columns)) for name in protocols), ("", 2)],
        is_selected=lambda row: row[protocols[0]]["variant"] == reference,
    )
