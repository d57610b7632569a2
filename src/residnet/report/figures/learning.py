"""Figures of the training of heads: loss and validation error by epoch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from residnet.report.figures.style import new_figure, short_label, styled, styles
from residnet.report.run_reader import Content, RunFiles


@styled
def learning_curves(run: RunFiles, models: Sequence[str]) -> Any:
    """Draw loss and free-run error on validation data by epoch, a column for each trained head.

    Lines separate the stages.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(4.2)
    panels = figure.subplots(2, len(models), sharex="col", sharey="row", squeeze=False)
    look = styles(run)
    for column, model in enumerate(models):
        curve = run.fit(model)["curve"]
        epoch = np.array([point["epoch"] for point in curve]) + 1
        stage = np.array([point.get("stage", 0) for point in curve])
        loss, validation = (
            np.array([_number(point.get(key)) for point in curve]) for key in ("loss", "validation")
        )
        top, bottom = panels[:, column]
        line = {
            "gid": short_label(run, model),
            "color": look[model]["color"],
            "linewidth": 1.4,
            "marker": ".",
            "markersize": 4,
        }
        for number in np.unique(stage):
            top.plot(epoch[stage == number], loss[stage == number], **line)
        _validation(bottom, epoch, validation, line)
        reference = run.row(run.baseline, "validation", run.protocols[0])
        if reference is not None:
            bottom.axhline(
                reference["nrmse"]["mean"],
                color=look[str(run.baseline)]["color"],
                linestyle="--",
                linewidth=1.2,
                label=str(run.baseline),
            )
        _stages(top, bottom, epoch, stage, run.resolved, model)
        top.set_yscale("log")
        top.set_title(short_label(run, model), pad=14)
        bottom.set_xlabel("epoch")
        bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0, 0].set_ylabel("training loss [-]")
    panels[1, 0].set_ylabel("free-run error on\nvalidation, NRMSE [-]")
    panels[1, 0].legend(loc="best")
    figure.align_ylabels(panels[:, 0])
    return figure


def _validation(axes: Any, epoch: np.ndarray, validation: np.ndarray, line: dict[str, Any]) -> None:
    """Draw the errors on validation data with a ring at the best epoch."""
    finite = np.isfinite(validation)
    axes.plot(epoch[finite], validation[finite], **line)
    if finite.any():
        best = int(np.nanargmin(validation))
        axes.plot(
            epoch[best],
            validation[best],
            "o",
            color="black",
            markerfacecolor="none",
            markersize=7,
            label="best epoch",
        )


def _stages(
    top: Any, bottom: Any, epoch: np.ndarray, stage: np.ndarray, resolved: Content, model: str
) -> None:
    settings = (resolved.get("training") or {}).get(model) or {}
    steps = settings.get("multi_step") or []
    for number in np.unique(stage):
        begin = float(epoch[stage == number][0]) - 0.5
        if begin > epoch[0]:
            for axes in (top, bottom):
                axes.axvline(begin, color="0.5", linewidth=0.8, gid="next stage")
        index = int(number) - 1
        text = (
            "one-step"
            if index < 0
            else f"{steps[index]['horizon']:g} s"
            if index < len(steps)
            else f"stage {index + 1}"
        )
        middle = float(epoch[stage == number].mean())
        top.annotate(
            text,
            (middle, 1.0),
            (0, 2),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            ha="center",
            fontsize=8,
            color="0.25",
        )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan
