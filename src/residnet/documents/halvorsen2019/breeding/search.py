"""Chapter 5 of document 000 (Halvorsen 2019): the mass-spring-damper that genetic programming is
tried on, with noise, and how often it is found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from residnet.core.config import Config, Seconds
from residnet.heads.genetic import GeneticConfig
from residnet.physics.mass_spring_damper import MassSpringDamperConfig
from residnet.regression.expressions.algebra import Algebra
from residnet.regression.expressions.text import term
from residnet.regression.genetic.config import limits_of
from residnet.regression.genetic.equations import breed, validating

CHANNELS = ("x", "u", "tau_x")
Record = dict[str, np.ndarray]


class RecordConfig(Config):
    """A record of the mass-spring-damper under a square wave of the force, from rest (section
    5.3.1, Figure 5.3).

    Attributes:
        system: mass, damping, stiffness and amplitude of the force.
        length: of the record.
        step: between samples; the force is held over a step.
        period: of the square wave; 6 pi s in the document.
        test_period: of the square wave of the record that equations are scored on.
    """

    system: MassSpringDamperConfig = Field(default_factory=MassSpringDamperConfig)
    length: Seconds = Field(default=50.0, gt=0)
    step: Seconds = Field(default=0.1, gt=0)
    period: Seconds = Field(default=float(6 * np.pi), gt=0)
    test_period: Seconds = Field(default=10.0, gt=0)

    def record(self, period: float) -> Record:
        """Displacement x, its rate u, the force tau_x and the acceleration u_dot, [N] each, without
        noise.
        """
        from scipy.linalg import expm

        m, d, k = (getattr(self.system, name).value for name in ("m", "d", "k"))
        t = self.step * np.arange(round(self.length / self.step))
        force = self.system.tau_max * np.where(np.mod(t, period) < period / 2, 1.0, -1.0)
        block = np.zeros((3, 3))
        block[:2] = [[0.0, 1.0, 0.0], [-k / m, -d / m, 1.0 / m]]
        held = expm(block * self.step)[:2]
        path = np.zeros((len(t), 2))
        for i in range(1, len(t)):
            path[i] = held @ [*path[i - 1], force[i - 1]]
        x, u = path.T
        return {"x": x, "u": u, "tau_x": force, "u_dot": (force - d * u - k * x) / m}

    def truth(self) -> dict[str, float]:
        """Coefficients of u_dot (4.2)."""
        m, d, k = (getattr(self.system, name).value for name in ("m", "d", "k"))
        return {"tau_x": 1.0 / m, "u": -d / m, "x": -k / m}


class NoiseConfig(Config):
    """Uniform noise as a share of each signal's range (5.14).

    Attributes:
        on: the acceleration (`output`), what the equation is made of (`inputs`), or all.
        factor: amplitude over the range, largest minus smallest.
    """

    on: Literal["output", "inputs", "all"] = "all"
    factor: float = Field(default=0.0, ge=0)

    def added(self, record: Record, random: np.random.Generator) -> Record:
        """The record with noise."""
        noisy = {"output": ("u_dot",), "inputs": CHANNELS, "all": (*CHANNELS, "u_dot")}[self.on]
        return {
            name: (
                v + self.factor * np.ptp(v) * random.uniform(-1, 1, len(v)) if name in noisy else v
            )
            for name, v in record.items()
        }


@dataclass(frozen=True)
class Trial:
    """One run: mean square error on the test record without noise, whether the terms are the true
    ones, and the equation.
    """

    error: float
    right: bool
    terms: tuple[str, ...]
    values: tuple[float, ...]


def attempt(record: RecordConfig, noise: NoiseConfig, head: GeneticConfig, seed: int) -> Trial:
    """Search the equation of u_dot once.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    clean = record.record(record.period)
    data = noise.added(clean, np.random.default_rng(seed))
    algebra = Algebra(CHANNELS, limits_of(head.evolution))
    train = ~validating(np.zeros(len(clean["x"]), dtype=int), head.validate_every)
    bred = breed(algebra, data, data["u_dot"], train, head, seed)
    test = record.record(record.test_period)
    predicted = (
        np.array(bred.values) @ algebra.values(bred.products, test)
        if bred.products
        else np.zeros(len(test["x"]))
    )
    names = tuple(term(algebra, product) for product in bred.products)
    return Trial(
        float(np.square(predicted - test["u_dot"]).mean()),
        set(names) == set(record.truth()),
        names,
        bred.values,
    )


def as_text(
    rows: Sequence[Mapping[str, Any]], keys: tuple[str, str], repeats: int, threshold: float
) -> str:
    """A table of cells: how many of the runs came below the threshold, with the published number
    where there is one, and the mean error.
    """
    first, second = ([*dict.fromkeys(row[axis] for row in rows)] for axis in ("row", "column"))
    cells = {(row["row"], row["column"]): row for row in rows}
    out = [
        (
            f"Runs of {repeats} with a mean square error below {threshold:g} (published in"
            f" brackets); right terms; mean square error on average; rows: {keys[0]}, columns:"
            f" {keys[1]}."
        ),
        "",
        "| | "
        + " | ".join(f"{value:g}" if isinstance(value, float) else str(value) for value in second)
        + " |",
        "|---" * (len(second) + 1) + "|",
    ]
    for value in first:
        out.append(
            f"| {value} | "
            + " | ".join(_cell(cells.get((value, other))) for other in second)
            + " |"
        )
    return "\n".join(out) + "\n"


def _cell(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    published = "" if row["published_found"] is None else f" ({row['published_found']:g})"
    return f"{row['found']}{published}; {row['right']}; {row['error']:.1e}"


def draw(
    rows: Sequence[Mapping[str, Any]], keys: tuple[str, str], repeats: int, file: Path
) -> None:
    """Found runs over the columns, one line for each row; published ones dotted."""
    from matplotlib import rc_context

    from residnet.report.figures.style import RC, new_figure, save

    with rc_context(RC):
        figure = new_figure(3.2)
        axes = figure.subplots()
        for number, value in enumerate(dict.fromkeys(row["row"] for row in rows)):
            own = [row for row in rows if row["row"] == value]
            x = range(len(own))
            axes.plot(
                x,
                [row["found"] for row in own],
                marker="o",
                markersize=3,
                color=f"C{number}",
                label=str(value),
            )
            if all(row["published_found"] is not None for row in own):
                axes.plot(
                    x, [row["published_found"] for row in own], linestyle=":", color=f"C{number}"
                )
        longest = max(
            (
                [row["column"] for row in rows if row["row"] == value]
                for value in {row["row"] for row in rows}
            ),
            key=len,
        )
        axes.set_xticks(range(len(longest)), [str(value) for value in longest])
        axes.set_xlabel(keys[1])
        axes.set_ylabel(f"found, of {repeats}")
        axes.legend(title=keys[0], ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
        save(
            figure,
            file,
            "Equations found",
            "Runs below the error threshold: ours (lines), published (dotted).",
        )
