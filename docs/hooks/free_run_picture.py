"""Draw the picture of README and site: one manoeuvre of a finished run, measured and in free run.

residnet run quickstart
python docs/hooks/free_run_picture.py runs/quickstart three_two_one_one_03 docs/free_run.svg
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

MODELS = {
    "baseline": ("linear baseline", "tab:orange"),
    "plsr": ("baseline + PLSR residual", "tab:blue"),
}


def draw_figure(table: pd.DataFrame) -> plt.Figure:
    """Return the figure: track, yaw rate and speed over time.

    Args:
        table: a file of `rollouts/test` as a run writes it, SI units and rad.
    """
    plt.rcParams["svg.hashsalt"] = "residnet"
    figure, (track, yaw, surge) = plt.subplots(
        1, 3, figsize=(10, 3.4), layout="constrained", width_ratios=(0.8, 1, 1)
    )
    manoeuvre = table[table["protocol"] == "manoeuvre"]
    # residnet cannot know the true motion: the noise of the measured yaw rate is the sensor's
    for index, (name, (label, colour)) in enumerate(MODELS.items()):
        rows = manoeuvre[manoeuvre["model"] == name]
        if index == 0:
            track.plot(rows["y"], rows["x"], "0.6", linewidth=4, label="measured")
            yaw.plot(rows["t"], np.degrees(rows["r"]), "0.6", linewidth=3)
            surge.plot(rows["t"], rows["u"], "0.6", linewidth=3)
        track.plot(rows["y_hat"], rows["x_hat"], colour, label=label)
        yaw.plot(rows["t"], np.degrees(rows["r_hat"]), colour)
        surge.plot(rows["t"], rows["u_hat"], colour)
    track.set(xlabel="east (m)", ylabel="north (m)", title="Track", aspect="equal")
    track.margins(x=0.4)
    yaw.set(xlabel="time (s)", ylabel="yaw rate (deg/s)", title="Yaw rate")
    surge.set(xlabel="time (s)", ylabel="surge velocity (m/s)", title="Surge velocity")
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


def main(run: str, log: str, out: str) -> None:
    """Draw `log` of the finished run in folder `run` to the file `out`."""
    table = pd.read_parquet(Path(run) / "rollouts" / "test" / f"{log}.parquet")
    draw_figure(table).savefig(out, metadata={"Date": None})


if __name__ == "__main__":
    main(*sys.argv[1:])
