"""The figures of a fit, from its run folder alone."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from residnet.report.blocks import Figure
from residnet.report.figures import bands as figures_bands
from residnet.report.figures import booklet as figures_booklet
from residnet.report.figures import errors as figures_errors
from residnet.report.figures import terms as figures_terms
from residnet.report.figures import tracks as figures_tracks
from residnet.report.figures.files import Drawing, write_drawings
from residnet.report.figures.learning import learning_curves
from residnet.report.format import plural
from residnet.report.run_reader import RunFiles

_PER_FIGURE = 3
"""Most models that share one figure."""


def write_figures(run: RunFiles) -> list[Figure]:
    """Write `figures/*.png` of a fit or an evaluation; what the folder has no data for is left out.

    Figures of an earlier call are replaced.

    Returns:
        The figures in the order in which a report shows them.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    return write_drawings(run.path / "figures", drawings(run))


def drawings(run: RunFiles) -> Iterator[Drawing]:
    """Draw all figures of a fit.

    Args:
        run: folder with metrics.json, and rollouts/, residuals.parquet, models/*/fit.json where
            there are any.

    Yields:
        Each figure with its title and caption.
    """
    yield from _of_runs(run)
    yield from _of_errors(run)
    yield from figures_bands.of_bands(run)
    yield from figures_booklet.of_booklet(run)
    yield from figures_terms.of_terms(run)
    yield from figures_terms.of_breeding(run)
    yield from _of_training(run)


def _of_runs(run: RunFiles) -> Iterator[Drawing]:
    protocol = run.protocols[0]
    windows = run.windows(run.focus)
    chosen = figures_tracks.representative(run, windows, protocol)
    judge = figures_tracks.leading(run)
    if chosen:
        yield Drawing(
            "tracks",
            "Tracks",
            (
                "North is up, and each track begins at its start. Of every kind of manoeuvre in"
                f" the {run.focus} data this is the run in which {judge} has its median error."
                " Look for a predicted track that turns tighter, wider or later than the measured"
                " one."
            ),
            figures_tracks.tracks(run, chosen),
        )
    for window in chosen:
        kind = window.manoeuvre.replace("_", " ")
        yield Drawing(
            f"history_{window.manoeuvre}",
            f"Time history: {kind}",
            (
                f"Free run of {window.log} from its first measured state and its inputs alone."
                " Look for lag at the reversals and for levels that stay apart once the motion has"
                " settled. Where the ground is grey, samples are masked and u and v are not scored."
            ),
            figures_tracks.history(run, window),
        )
    for name in run.protocols:
        of_protocol = [window for window in windows if window.protocol == name]
        runs = plural(len(of_protocol), "free run")
        if of_protocol:
            yield Drawing(
                f"horizon_{name}",
                f"Error against horizon: {name}",
                (
                    f"Root mean square over {runs} of protocol {name} ({run.focus} data), on a"
                    " logarithmic scale. A model whose curve stays level predicts as well late as"
                    " early; one whose curve climbs drifts. The level that no model undercuts is"
                    " the measurement noise."
                ),
                figures_errors.horizon(run, of_protocol),
            )


def _of_errors(run: RunFiles) -> Iterator[Drawing]:
    protocol = run.protocols[0]
    yield Drawing(
        "bars",
        "Free-run error by model",
        (
            f"Root mean square error under protocol {protocol} with 95 % intervals over free runs."
            f" {run.focus.capitalize()} bars well beyond the train bars would mean overfitting."
            if len(run.sides) > 1
            else (
                f"Root mean square error under protocol {protocol} with 95 % intervals over free"
                f" runs ({run.focus} data)."
            )
        ),
        figures_errors.bars(run, protocol),
    )
    frame = run.frame("residuals.parquet")
    if frame is None:
        return
    table = {name: np.asarray(frame[name]) for name in ("model", "axis", "target", "predicted")}
    present = set(table["model"].tolist())
    models = [model for model in run.heads if model in present]
    for place in range(0, len(models), _PER_FIGURE):
        yield Drawing(
            f"residuals_{place // _PER_FIGURE + 1}" if len(models) > _PER_FIGURE else "residuals",
            "Residual: target against prediction",
            (
                "The acceleration that the baseline leaves, against what each head predicts of it."
                " The target comes from smoothed derivatives, so it is noisy itself. A head has"
                " learned a cloud along the line; it cannot reach a cloud upright on zero."
            ),
            figures_errors.residuals(run, table, models[place : place + _PER_FIGURE]),
        )


def _of_training(run: RunFiles) -> Iterator[Drawing]:
    models = [model for model in run.heads if run.fit(model).get("curve")]
    for place in range(0, len(models), _PER_FIGURE):
        yield Drawing(
            f"learning_{place // _PER_FIGURE + 1}" if len(models) > _PER_FIGURE else "learning",
            "Learning curves",
            (
                "Each stage (one-step, then free runs of the stated length) has a loss of its own,"
                " so only the slopes count. The lower panels decide: the weights of the circled"
                " epoch are kept. A curve that still falls at its end asks for more epochs."
            ),
            learning_curves(run, models[place : place + _PER_FIGURE]),
        )
