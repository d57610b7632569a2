"""Figures of force-space models (document 002 Figures 4.6, 4.20, 4.22, 4.25)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from residnet.report.figures.style import RC, new_figure, save

_AXES = ("surge", "sway", "yaw")
_COLOURS_SPAN = (6.3, 316.0)
"""Shares in % of the first and the last colour of a surface."""
_MARKS = (("x", "#D55E00"), ("o", "#CC79A7"), ("s", "#E69F00"))


def draw_surface(
    error: Tensor,
    unmodelled: Sequence[float],
    chosen: Mapping[str, Sequence[tuple[int, int]]],
    path: Path,
) -> None:
    """Write a figure of the error that is left, over model order and number of basis functions.

    Args:
        error: mean square error by axis, order and number of basis functions.
        unmodelled: mean square of the residual of each axis.
        chosen: (order, number of basis functions) of each axis, by what chose them.
        path: PNG file.
    """
    from matplotlib import rc_context
    from matplotlib.colors import LogNorm

    with rc_context(RC):
        figure = new_figure(2.9)
        panels = figure.subplots(1, 3, sharey=True)
        for axis, axes in enumerate(panels):
            share = 100.0 * error[axis].numpy() / unmodelled[axis]
            image = axes.imshow(
                share,
                origin="lower",
                aspect="auto",
                cmap="viridis",
                norm=LogNorm(*_COLOURS_SPAN),
                extent=_extent(share),
            )
            for (name, picks), (mark, colour) in zip(chosen.items(), _MARKS, strict=False):
                order, count = picks[axis]
                axes.plot(
                    count, order, mark, color=colour, fillstyle="none", label=name, markersize=7
                )
            # room for marks at the edge
            axes.set_xlim(0.5, share.shape[1] + 0.5)
            axes.set_ylim(-0.5, share.shape[0] + 1.5)
            axes.set_title(_AXES[axis], loc="left")
            axes.set_xlabel("basis functions")
            axes.grid(visible=False)
        panels[0].set_ylabel("model order")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        bar = figure.colorbar(image, ax=panels)
        bar.set_ticks([10, 30, 100, 300], labels=["10", "30", "100", "300"])
        bar.set_label("share of the MSE that is left [%]")
        save(
            figure,
            path,
            "Surface analysis",
            "Share of the unmodelled residual's mean square that is left, by model order and"
            " number of basis functions. Marks show what each rule chose.",
        )


def draw_orders(
    curves: Mapping[str, Tensor], unmodelled: Sequence[float], chosen: int, path: Path
) -> None:
    """Write a figure of the error that is left over the order of a PLSR.

    Args:
        curves: mean square error by order and axis [A, 3], by the samples that it is of.
        unmodelled: mean square of the residual of each axis.
        chosen: order of the model.
        path: PNG file.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure = new_figure(2.6)
        panels = figure.subplots(1, 3, sharey=True)
        for axis, axes in enumerate(panels):
            for (name, error), colour in zip(curves.items(), ("#0072B2", "#D55E00"), strict=False):
                share = error[:, axis].numpy() / unmodelled[axis]
                if np.isfinite(share).any():
                    axes.plot(np.arange(len(share)) + 1, share, color=colour, label=name)
            axes.axvline(chosen, color="0.5", linestyle="--", linewidth=1.0, label="this model")
            axes.set_yscale("log")
            axes.set_title(_AXES[axis], loc="left")
            axes.set_xlabel("model order")
        panels[0].set_ylabel("share of the MSE that is left")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
        save(
            figure,
            path,
            "Error over the order of the PLSR",
            "Share of the unmodelled residual's mean square that is left, by model order: on"
            " segments that were left out of the fit one by one, and on the test half.",
        )


def _extent(share: np.ndarray) -> tuple[float, float, float, float]:
    return (-0.5, share.shape[1] - 0.5, 0.5, share.shape[0] + 0.5)


def draw_weights(terms: Sequence[str], pre: Tensor, title: str, path: Path) -> None:
    """Write a figure of the coefficients of basis functions, scaled by the spread of each.

    Args:
        terms: names of the basis functions.
        pre: scaled coefficients, [J, 3].
        title: of the figure.
        path: PNG file.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure = new_figure(4.6)
        panels = figure.subplots(3, 1, sharex=True)
        for axis, axes in enumerate(panels):
            axes.bar(range(len(terms)), pre[:, axis].abs().numpy(), color="#0072B2")
            axes.set_ylabel(_AXES[axis])
            axes.grid(axis="x", visible=False)
        panels[-1].set_xticks(range(len(terms)), list(terms), rotation=90)
        figure.supylabel("magnitude of the scaled coefficient [-]", fontsize=9)
        save(
            figure,
            path,
            title,
            "Magnitude of the coefficients of scaled basis functions. It shows how much each one"
            " weighs in the model.",
        )
