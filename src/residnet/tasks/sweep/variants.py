"""Carry out `search: variants` of a sweep: an ablation of a fit over several seeds.

Each variant is fitted with each seed. Errors are compared window by window, with paired intervals.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from residnet.core.errors import DataError
from residnet.core.format import format_signed
from residnet.core.processes import process_pool
from residnet.core.progress import report_progress
from residnet.core.run_records import ProvenanceFile
from residnet.evaluation.intervals import bootstrap_intervals, make_resampling_blocks
from residnet.report.records import VariantRow, VariantsFile
from residnet.report.run_reader import RunFiles
from residnet.report.sections.variants import VARIANTS_FILE, tabulate_variants
from residnet.runs.folder import RunFolder
from residnet.runs.task import SummaryMetric, TaskOutcome

if TYPE_CHECKING:
    import pandas as pd

    from residnet.tasks.sweep.config import SweepConfig, VariantSearch


def compare_variants_of_fit(
    config: SweepConfig, search: VariantSearch, folder: RunFolder
) -> TaskOutcome:
    """Fit all variants and write the comparison; finished runs are reused.

    Raises:
        ResidnetError: if a variant cannot be run, or the system ends a process.
    """
    import pandas as pd

    folder_by_job = {
        (variant, seed): folder.path / "variants" / f"{variant}.{seed}"
        for variant in search.variants
        for seed in search.seeds
    }
    seconds = dict[tuple[str, int], float]()
    n_workers = config.runner.n_parallel
    if n_workers == 1:
        for number, (job, folder_path) in enumerate(folder_by_job.items()):
            report_progress("fits of the variants", number, len(folder_by_job))
            seconds[job] = _run_variant(config, *job, folder_path)
        report_progress("fits of the variants", len(folder_by_job), len(folder_by_job))
    else:
        with process_pool(n_workers) as pool:
            job_arguments = [
                (config, *job, folder_path) for job, folder_path in folder_by_job.items()
            ]
            durations = pool.map(_run_variant, *zip(*job_arguments, strict=True))
            seconds = dict(zip(folder_by_job, durations, strict=True))
    errors = pd.concat(
        {
            job: compute_window_errors(folder_path, search.model, search.split)
            for job, folder_path in folder_by_job.items()
        },
        names=["variant", "seed"],
    )
    rows = compare_variants(errors, search.reference)
    rows = [
        row.model_copy(
            update={
                "overrides": tuple(search.variants[row.variant]),
                "seconds": float(np.mean([seconds[row.variant, seed] for seed in search.seeds])),
            }
        )
        for row in rows
    ]
    comparison = VariantsFile(
        schema="residnet.variants/1",
        run=config.name,
        model=search.model,
        split=search.split,
        reference=search.reference,
        rows=tuple(rows),
    )
    folder.write_record(folder.path / VARIANTS_FILE, comparison)
    summary_metrics = {
        f"nrmse_{row.variant}_{row.protocol}": SummaryMetric(row.nrmse_mean) for row in rows
    }
    text = tabulate_variants(rows, search.reference).to_text()
    return TaskOutcome(_summarize_variants(rows, search.reference), summary_metrics, text)


def _summarize_variants(rows: Sequence[VariantRow], reference: str) -> list[str]:
    """Return a sentence for each protocol on the variant with the lowest error."""
    sentences = []
    for protocol in dict.fromkeys(row.protocol for row in rows):
        protocol_rows = [row for row in rows if row.protocol == protocol]
        # diverged runs have the constant-velocity error: variants without them are ranked first
        best_row = min(protocol_rows, key=lambda row: (row.diverged > 0, row.nrmse_mean))
        is_any_diverged = any(row.diverged for row in protocol_rows)
        qualifier = " of the variants without divergence" if is_any_diverged else ""
        sentence = (
            f"{protocol}: '{best_row.variant}' has the smallest free-run NRMSE{qualifier},"
            f" {best_row.nrmse_mean:.4f}"
        )
        if best_row.diverged:
            sentence = (
                f"{protocol}: every variant DIVERGED in some windows, which count with the error of"
                f" constant velocity; '{best_row.variant}' has the smallest NRMSE,"
                f" {best_row.nrmse_mean:.4f}"
            )
        interval = best_row.difference_ci95
        if best_row.variant != reference and interval is not None:
            limits = " to ".join(map(format_signed, interval))
            sentence += (
                f"; difference to '{reference}' {format_signed(best_row.difference)} (95 %"
                f" confidence interval {limits})"
            )
        sentences.append(f"{sentence}.")
        diverged_rows = [row for row in protocol_rows if row.diverged]
        if diverged_rows:
            diverged_text = ", ".join(
                f"'{row.variant}' in {row.diverged} windows" for row in diverged_rows
            )
            sentences.append(f"{protocol}: free runs DIVERGED: {diverged_text}.")
    return sentences


def _run_variant(config: SweepConfig, variant: str, seed: int, folder_path: Path) -> float:
    """Run one variant with one seed unless it is finished; returns the duration in s."""
    if not RunFolder(folder_path).is_finished:
        task, overrides = config.build_variant(variant, seed)
        task.run(
            source=config.base,
            overrides=overrides,
            output_folder=folder_path,
            resume=True,
            report=False,
        )
    return ProvenanceFile.read(RunFolder(folder_path).provenance).seconds


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
    if name not in windows[0].predicted:
        raise DataError(f"{run}: no model '{name}' among {', '.join(windows[0].predicted)}")
    scales = {name: files.metrics.scales[name] for name in files.dof.active_states}
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


def compare_variants(errors: pd.DataFrame, reference: str) -> list[VariantRow]:
    """Return one row per variant and protocol.

    A row has the number of windows that diverged, the mean error over windows and seeds, its
    standard deviation over seeds (None for one seed), the smallest and largest of the seeds, and
    the difference from the reference variant over the same windows, seeds averaged first, with its
    95 % interval by blocks of windows.

    Args:
        errors: results of `compute_window_errors`, by variant and seed.
        reference: name of the reference variant.
    """
    import pandas as pd

    rows: list[VariantRow] = []
    for (variant, protocol), variant_errors in errors.groupby(["variant", "protocol"], sort=False):
        reference_errors = errors.loc[reference]
        mean_errors, reference_mean = (
            error_table.groupby(["log", "window"], sort=False)["nrmse"].mean()
            for error_table in (
                variant_errors,
                reference_errors[reference_errors["protocol"] == protocol],
            )
        )
        differences = mean_errors - reference_mean
        logs = pd.factorize(mean_errors.index.get_level_values("log"))[0]
        (interval,) = bootstrap_intervals(
            differences.to_numpy()[:, None], make_resampling_blocks(logs)
        )
        by_seed = variant_errors.groupby("seed")["nrmse"].mean()
        rows.append(
            VariantRow(
                variant=str(variant),
                protocol=str(protocol),
                seeds=len(by_seed),
                windows=len(mean_errors),
                diverged=int(variant_errors["diverged"].sum()),
                nrmse_mean=float(by_seed.mean()),
                nrmse_sd=float(by_seed.std()) if len(by_seed) > 1 else None,
                nrmse_range=(float(by_seed.min()), float(by_seed.max())),
                difference=float(differences.mean()),
                difference_ci95=None if variant == reference else interval,
            )
        )
    return rows
