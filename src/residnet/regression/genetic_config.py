"""Configuration of the search for equations by genetic programming."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.regression.sparse_config import SparseSearchConfig

Operator = Literal["+", "-", "*", "/", "abs", "sin", "cos", "sqrt"]
VALIDATION_BLOCKS = 8
"""Number of blocks that replace the groups if there are too few groups."""
BINARY = {"+": "add", "-": "subtract", "*": "multiply", "/": "divide"}


class EvolutionConfig(Config):
    """Settings of the evolution.

    The defaults except the population follow Halvorsen 2019, Table 6.1.

    Attributes:
        population: number of individuals.
        generations: maximum number of generations after the initial population.
        operators: operators of the trees. `/` returns 0 for a divisor of 0 and `sqrt` uses the
            magnitude of its argument (Moreno-Salinas et al. 2019, section 2.4).
        constants: range of random constants in trees; None for no constants. Coefficients of terms
            are fitted, so constants matter only as arguments of functions.
        tournament: number of individuals in a selection tournament.
        crossover: share of the offspring created by one-point crossover.
        mutation: share created by uniform mutation, which replaces a node by a full tree of depth
            0 to 2. The remaining offspring are copies.
        depth: maximum depth of a tree.
        first_depth: minimum and maximum depth of the initial trees (ramped half-and-half).
        genes: number of trees per individual (multigene form of Moreno-Salinas et al. 2019, which
            uses 5 trees of depth 3). With several trees, half of the crossovers exchange whole
            trees.
        split: the parts of an individual that get a coefficient: every tree (`gene`), every summand
            of a tree without expansion (`sum`, section 5.1.1), or every summand after expansion
            (`expand`, section 5.1.3).
        equal_terms: treatment of a tree with repeated terms: add them (`merge`), or discard the
            individual (`reject`) as Halvorsen 2019 does, where the Gram matrix is singular (section
            5.1.2).
        max_terms: maximum number of terms of an individual; individuals with more are discarded.
        max_degree: maximum number of factors of a term; individuals with more are discarded.
        nesting: maximum depth of nested functions; magnitudes and brackets count as functions.
        elite: number of best individuals copied unchanged to the next generation.
        goal: relative mean squared error, in training and validation, at which the search ends.
        patience: number of generations without a lower validation error after which it ends.
        rows: maximum number of training samples of the search, decimated evenly; the coefficients
            of the result are fitted to all samples.
    """

    population: int = Field(default=500, ge=2, le=100_000)
    generations: int = Field(default=30, ge=0, le=10_000)
    operators: tuple[Operator, ...] = ("+", "*", "abs")
    constants: tuple[float, float] | None = None
    tournament: int = Field(default=5, ge=1, le=10_000)
    crossover: float = Field(default=0.5, ge=0, le=1)
    mutation: float = Field(default=0.3, ge=0, le=1)
    depth: int = Field(default=10, ge=1, le=17)
    first_depth: tuple[int, int] = (1, 4)
    genes: int = Field(default=1, ge=1, le=20)
    split: Literal["gene", "sum", "expand"] = "expand"
    equal_terms: Literal["merge", "reject"] = "merge"
    max_terms: int = Field(default=40, ge=1, le=200)
    max_degree: int = Field(default=8, ge=1, le=20)
    nesting: int = Field(default=2, ge=0, le=5)
    elite: int = Field(default=1, ge=0)
    goal: float = Field(default=1e-12, ge=0, lt=1)
    patience: int = Field(default=10, ge=1)
    rows: int = Field(default=600, ge=20, le=10_000_000)

    @model_validator(mode="after")
    def _validate_settings(self) -> EvolutionConfig:
        if self.crossover + self.mutation > 1:
            raise ValueError(
                "crossover and mutation: their sum is a share of the offspring and at most 1,"
                f" but is {self.crossover} + {self.mutation}"
            )
        if not set(self.operators) & BINARY.keys():
            raise ValueError("operators: give at least one of +, -, *, /")
        if not 0 <= self.first_depth[0] <= self.first_depth[1] <= self.depth:
            raise ValueError(
                f"first_depth: expected minimum <= maximum <= depth ({self.depth}), but got"
                f" {list(self.first_depth)}"
            )
        if self.equal_terms == "reject" and self.split == "gene":
            raise ValueError(
                "equal_terms: reject needs split: sum or split: expand, because with split: gene"
                " every tree is one term"
            )
        if self.elite >= self.population:
            raise ValueError(
                f"elite: expected less than the population ({self.population}), but got"
                f" {self.elite}"
            )
        return self


class EquationSearchConfig(Config):
    """Settings of a search for the equations of several outputs.

    Attributes:
        evolution: settings of the genetic programming.
        final: settings of the final selection by the extended BIC on all samples, among the terms
            of the best individual and the usual candidates of sparse regression. It removes
            superfluous terms and adds missing ones. None for the terms of the individual.
        validate_every: number n; every n-th manoeuvre is used for validation during the search.
            With fewer than n manoeuvres every n-th eighth of the samples is used.
        seed: random seed; each axis has a different one that is derived from it.
    """

    evolution: EvolutionConfig = Field(default_factory=EvolutionConfig)
    final: SparseSearchConfig | None = Field(default_factory=SparseSearchConfig)
    validate_every: int = Field(default=4, ge=2, le=VALIDATION_BLOCKS)
    seed: int = Field(default=0, ge=0)
