"""Searching the equation of the mass-spring-damper, once and over a table of settings."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from residnet.core import progress
from residnet.documents.halvorsen2019.breeding.config import (
    CHANNELS,
    BreedingSettings,
    NoiseConfig,
    RecordConfig,
)
from residnet.heads.genetic import GeneticConfig
from residnet.regression.expressions.algebra import Algebra
from residnet.regression.expressions.text import term
from residnet.regression.genetic.config import limits_of
from residnet.regression.genetic.equations import breed, validating


@dataclass(frozen=True)
class Trial:
    """The outcome of one search for the equation.

    Attributes:
        error: mean square error on the test record without noise, in (m/s^2)^2.
        right: whether the terms are the true ones.
        terms: terms of the equation.
        values: their coefficients.
    """

    error: float
    right: bool
    terms: tuple[str, ...]
    values: tuple[float, ...]


def attempt(record: RecordConfig, noise: NoiseConfig, head: GeneticConfig, seed: int) -> Trial:
    """Search the equation of u_dot once.

    Args:
        record: record that the equation is searched in.
        noise: noise on the record.
        head: how the equation is searched.
        seed: seed of the noise and of the search.

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


def search_table(config: BreedingSettings) -> list[dict[str, Any]]:
    """Search the equation with every combination of the two settings; returns one row for each.

    Raises:
        ResidnetError: where DEAP is not installed or the data do not determine an equation.
    """
    rows, cells = [], config.cells()
    for done, (i, j) in enumerate(cells):
        progress.report("searching equations", done, len(cells))
        rows.append(_row(config, i, j))
    progress.report("searching equations", len(cells), len(cells))
    return rows


def _row(config: BreedingSettings, i: int, j: int) -> dict[str, Any]:
    settings = config.cell(i, j)
    started = time.process_time()
    trials = [attempt(*settings, seed) for seed in range(config.repeats)]
    errors = [trial.error for trial in trials]
    published, published_error = (
        None if table is None else table[i][j]
        for table in (config.published, config.published_error)
    )
    return {
        "row": config.rows.values[i],
        "column": config.columns.values[j],
        "found": sum(error < config.threshold for error in errors),
        "published_found": published,
        "right": sum(trial.right for trial in trials),
        "error": sum(errors) / len(errors),
        "published_error": published_error,
        "seconds": (time.process_time() - started) / config.repeats,
        "equations": [dict(zip(trial.terms, trial.values, strict=True)) for trial in trials],
    }
