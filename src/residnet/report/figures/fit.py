"""All figures of a run, from its folder alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from residnet.report.figures import booklet as figures_booklet
from residnet.report.figures import errors as figures_errors
from residnet.report.figures import terms as figures_terms
from residnet.report.figures import tracks as figures_tracks
from residnet.report.figures.style import RC, save
from residnet.report.run_reader import RunFiles

_PER_FIGURE = 3


@dataclass(frozen=True)
class FigureFile:
    """A figure on disk and the sentence that says what to look for in it."""

    path: Path
    title: str
    caption: str


def write_figures(run: Path) -> list[FigureFile]:
    """Write `figures/*.png` of a run folder; what the folder has no data for is left out, and
    figures of an earlier call are replaced.

    Args:
        run: folder with metrics.json, and rollouts/, residuals.parquet, models/*/fit.json where
            there are any.

    Returns:
        The figures in the order in which a report shows them.

    Raises:
        UsageError: where the folder holds no metrics.json.
    """
    from matplotlib import rc_context

    files = RunFiles(run)
    for figure_file in read_figures(run):
        figure_file.path.unlink()
    out: list[FigureFile] = []
    with rc_context(RC):
        for name, title, caption, figure in _figures(files):
            # the number keeps the order for whoever lists the folder
            path = run / "figures" / f"{len(out) + 1:02d}_{name}.png"
            save(figure, path, title, caption)
            out.append(FigureFile(path, title, caption))
    return out


def read_figures(run: Path) -> list[FigureFile]:
    """The figures that stand in a run folder, in their order; pictures that do not carry a caption
    are not ours and are left out.
    """
    from PIL import Image

    out = []
    for path in sorted((run / "figures").glob("*.png")):
        with Image.open(path) as picture:
            words = dict(picture.info)
        if "Title" in words and "Description" in words:
            out.append(FigureFile(path, str(words["Title"]), str(words["Description"])))
    return out


def _figures(run: RunFiles) -> Iterator[tuple[str, str, str, Any]]:
    yield from _of_runs(run)
    yield from _of_errors(run)
    yield from figures_booklet.of_booklet(run)
    yield from figures_terms.of_terms(run)
    yield from _of_training(run)


def _of_runs(run: RunFiles) -> Iterator[tuple[str, str, str, Any]]:
    protocol = run.protocols[0]
    windows = run.windows(run.focus)
    chosen = figures_tracks.representative(run, windows, protocol)
    judge = figures_tracks.leading(run)
    if chosen:
        yield (
            "tracks",
            "Tracks",
            (
                f"North up, each from its start: for every kind of manoeuvre in the {run.focus}"
                f" data the run in which {judge} has its median error; look for a predicted track"
                " that turns tighter, wider or later than the measured one."
            ),
            figures_tracks.tracks(run, chosen),
        )
    for window in chosen:
        kind = window.manoeuvre.replace("_", " ")
        yield (
            f"history_{window.manoeuvre}",
            f"Time history: {kind}",
            (
                f"Free run of {window.log} from its first measured state and its inputs alone; look"
                " for lag at the reversals and for levels that stay apart once the motion has"
                " settled. Grey: masked, u and v not scored."
            ),
            figures_tracks.history(run, window),
        )
    for name in run.protocols:
        own = [window for window in windows if window.protocol == name]
        if own:
            yield (
                f"horizon_{name}",
                f"Error against horizon: {name}",
                (
                    f"RMS over the {len(own)} free runs of protocol {name} ({run.focus} data),"
                    " logarithmic; a curve that stays level predicts as well late as early, one"
                    " that climbs drifts; the level that no model undercuts is the measuring"
                    " noise."
                ),
                figures_errors.horizon(run, own),
            )


def _of_errors(run: RunFiles) -> Iterator[tuple[str, str, str, Any]]:
    protocol = run.protocols[0]
    yield (
        "bars",
        "Free-run error by model",
        (
            f"RMSE under protocol {protocol} with 95 % intervals over free runs; {run.focus} bars"
            " well beyond the train bars would mean overfitting."
            if len(run.sides) > 1
            else (
                f"RMSE under protocol {protocol} with 95 % intervals over free runs ({run.focus}"
                " data)."
            )
        ),
        figures_errors.bars(run, protocol),
    )
    path = run.path / "residuals.parquet"
    if not path.is_file():
        return
    import pandas as pd

    frame = pd.read_parquet(path)
    table = {name: np.asarray(frame[name]) for name in ("model", "axis", "target", "predicted")}
    present = set(table["model"].tolist())
    models = [model for model in run.heads if model in present]
    for place in range(0, len(models), _PER_FIGURE):
        yield (
            f"residuals_{place // _PER_FIGURE + 1}" if len(models) > _PER_FIGURE else "residuals",
            "Residual: target against prediction",
            (
                "Acceleration that the baseline leaves (from smoothed derivatives, so noisy itself)"
                " against what each head makes of it; a cloud along the line is learned, a cloud"
                " upright on zero is not in the head's reach."
            ),
            figures_errors.residuals(run, table, models[place : place + _PER_FIGURE]),
        )


def _of_training(run: RunFiles) -> Iterator[tuple[str, str, str, Any]]:
    models = [model for model in run.heads if run.fit(model).get("curve")]
    for place in range(0, len(models), _PER_FIGURE):
        yield (
            f"learning_{place // _PER_FIGURE + 1}" if len(models) > _PER_FIGURE else "learning",
            "Learning curves",
            (
                "Stages (one-step, then free runs of the stated length) have losses of their own,"
                " so only the slopes count; the lower panels decide: the kept weights are those of"
                " the circled epoch, and a curve still falling at its end asks for more epochs."
            ),
            figures_errors.learning_curves(run, models[place : place + _PER_FIGURE]),
        )
