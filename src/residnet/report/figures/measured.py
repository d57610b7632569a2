"""Figures of measured forces and of what models leave of them (document 002 chapter 5)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from residnet.core.stretches import stretches
from residnet.report.figures.style import DASHED, MASKED, RC, SOLID, legend_above, new_figure, save

FORCE_UNITS = ("surge [N]", "sway [N]", "yaw [N m]")
ACCELERATION_UNITS = ("surge [m/s$^2$]", "sway [m/s$^2$]", "yaw [rad/s$^2$]")


def draw_pair(
    t: Tensor,
    first: Tensor,
    second: Tensor,
    good: Tensor,
    names: Sequence[str],
    title: str,
    path: Path,
    labels: tuple[str, str],
) -> None:
    """Write a figure of two signals of three axes over time, with masked samples shaded.

    Args:
        t: [T] in s.
        first, second: [T, 3].
        good: [T], whether a sample is used.
        names: of the three axes, with units.
        title: of the figure.
        path: PNG file.
        labels: of the two signals.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure = new_figure(4.8)
        panels = figure.subplots(3, 1, sharex=True)
        handles: dict[str, Any] = {}
        for axis, axes in enumerate(panels):
            handles[labels[0]] = axes.plot(
                t, first[:, axis], **{**DASHED, "linewidth": 1.1, "zorder": 3}
            )[0]
            handles[labels[1]] = axes.plot(
                t, second[:, axis], **{**SOLID, "linewidth": 1.1, "zorder": 4}
            )[0]
            for a, b in zip(*stretches(~good.numpy()), strict=True):
                handles["masked"] = axes.axvspan(float(t[a]), float(t[b - 1]), **MASKED)
            axes.set_ylabel(names[axis])
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(float(t[0]), float(t[-1]))
        legend_above(figure, handles)
        save(figure, path, title, f"{title}; {labels[0]} (dashed) and {labels[1]} (solid).")


def draw_scores(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write a figure of every model's error less that of the believed model, with intervals.

    There is a panel for each force; errors are in units of its mean square.

    Args:
        rows: as in force_residual.json.
        path: PNG file.
    """
    from matplotlib import rc_context

    groups = list(dict.fromkeys(row["force"] for row in rows))
    with rc_context(RC):
        counts = [sum(row["force"] == group for row in rows) - 1 for group in groups]
        figure = new_figure(1.0 + 0.28 * sum(counts) + 0.45 * len(groups))
        panels = figure.subplots(
            len(groups), 1, sharex=True, squeeze=False, gridspec_kw={"height_ratios": counts}
        )[:, 0]
        for axes, group in zip(panels, groups, strict=True):
            members = [row for row in rows if row["force"] == group and row["model"] != "believed"][
                ::-1
            ]
            for place, row in enumerate(members):
                apart = row["minus_believed"]
                mean, within = 100 * apart["mean"][3], apart["ci95"][3]
                beyond = within is not None and within[1] < 0
                style = {
                    "color": SOLID["color"] if beyond else "0.35",
                    "marker": "o" if beyond else "s",
                    "markersize": 4.5,
                }
                axes.plot([mean], [place], linestyle="none", **style)
                if within is not None:
                    axes.plot(
                        [100 * within[0], 100 * within[1]],
                        [place, place],
                        color=style["color"],
                        linewidth=1.4,
                    )
            axes.axvline(0.0, color="black", linewidth=0.8)
            axes.set_yticks(range(len(members)), [row["model"] for row in members])
            axes.set_ylim(-0.6, len(members) - 0.4)
            axes.set_title(f"{group} force", loc="left")
            axes.grid(axis="y", visible=False)
            axes.set_xscale("symlog", linthresh=10)
            axes.xaxis.set_major_formatter(lambda value, _: f"{value:+.0f}" if value else "0")
        panels[-1].set_xlabel(
            "squared error less the believed model's, mean over axes [% of the force's mean square]"
        )
        save(
            figure,
            path,
            "Errors beside the believed model",
            "Squared error of each model less that of the believed model where neither saw the"
            " data, with 95 % intervals.",
        )
