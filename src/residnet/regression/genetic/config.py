"""Settings of genetic programming, as document 000 has them (chapters 4 to 6)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.regression.expressions.algebra import Limits
from residnet.regression.sparse import SearchConfig

Operator = Literal["+", "-", "*", "/", "abs", "sin", "cos", "sqrt"]
BINARY = ("+", "-", "*", "/")


class EvolutionConfig(Config):
    """How a population is bred; the defaults are Table 6.1's but for the population.

    Attributes:
        population: number of individuals.
        generations: most generations after the first.
        operators: of the trees; `/` is 0 at a divisor of 0 and `sqrt` takes the magnitude (document
            001 section 2.4).
        one: whether trees may also hold the number 1.
        constants: range of random constants in trees; None for none. A term's factor is fitted, so
            that they only matter within functions.
        tournament: individuals among which a parent is the best.
        crossover: share of an offspring generation from one-point crossover.
        mutation: share from uniform mutation, which puts a full tree of depth 0 to 2 in a node's
            place; the rest is copied.
        depth: highest depth of a tree.
        first_depth: least and largest depth of the first trees, half of them full, half grown.
        genes: trees per individual (multigene form of document 001; there 5 of depth 3); of two
            crossovers one then exchanges whole trees.
        split: what gets a coefficient: every `gene`, every summand of the tree as it stands (`sum`,
            section 5.1.1), or every summand when it is multiplied out (`expand`, section 5.1.3).
        equal_terms: what becomes of a tree in which a term stands twice: its terms are added
            (`merge`), or it takes no part (`reject`), as in the document, whose Gram matrix is then
            singular (section 5.1.2).
        intercept: whether the constant always is a term.
        prune: share of the target's energy that a term must explain beside those before it
            (orthogonal least squares, section 5.1.4); 0 keeps all.
        max_terms: most terms of an individual; those with more take no part, nor those with
            products of more than `max_degree` factors.
        max_degree: most factors of a term.
        nesting: most functions within functions; bars of a magnitude and brackets count.
        elite: how many of the best go over unchanged.
        goal: mean square error over the target's mean square, in training and validation, at which
            the search ends.
        patience: generations without a better validation error after which it ends.
        rows: most training samples that the search looks at, evenly thinned; coefficients in the
            result are fitted to all.
    """

    population: int = Field(default=500, ge=2, le=100_000)
    generations: int = Field(default=30, ge=0, le=10_000)
    operators: tuple[Operator, ...] = ("+", "*", "abs")
    one: bool = False
    constants: tuple[float, float] | None = None
    tournament: int = Field(default=5, ge=1, le=10_000)
    crossover: float = Field(default=0.5, ge=0, le=1)
    mutation: float = Field(default=0.3, ge=0, le=1)
    depth: int = Field(default=10, ge=1, le=17)
    first_depth: tuple[int, int] = (1, 4)
    genes: int = Field(default=1, ge=1, le=20)
    split: Literal["gene", "sum", "expand"] = "expand"
    equal_terms: Literal["merge", "reject"] = "merge"
    intercept: bool = False
    prune: float = Field(default=0.0, ge=0, lt=1)
    max_terms: int = Field(default=40, ge=1, le=200)
    max_degree: int = Field(default=8, ge=1, le=20)
    nesting: int = Field(default=2, ge=0, le=5)
    elite: int = Field(default=1, ge=0)
    goal: float = Field(default=1e-12, ge=0, lt=1)
    patience: int = Field(default=10, ge=1)
    rows: int = Field(default=600, ge=20, le=10_000_000)

    @model_validator(mode="after")
    def _possible(self) -> EvolutionConfig:
        if self.crossover + self.mutation > 1:
            raise ValueError(
                "crossover and mutation are shares of the offspring; together at most 1, given"
                f" {self.crossover} + {self.mutation}"
            )
        if not set(self.operators) & set(BINARY):
            raise ValueError("operators: trees need one of +, -, *, / at least")
        if not 0 <= self.first_depth[0] <= self.first_depth[1] <= self.depth:
            raise ValueError(
                f"first_depth: expected least <= largest <= depth ({self.depth}), given"
                f" {list(self.first_depth)}"
            )
        if self.equal_terms == "reject" and self.split == "gene":
            raise ValueError(
                "equal_terms: a gene is one term whatever stands in it; reject goes with split sum"
                " or expand"
            )
        if self.elite >= self.population:
            raise ValueError(
                f"elite: must leave room for offspring in a population of {self.population}, given"
                f" {self.elite}"
            )
        return self


def limits_of(config: EvolutionConfig) -> Limits:
    """Return the limits of the terms of a search."""
    return Limits(config.max_terms, config.max_degree, config.nesting, config.split == "expand")


BLOCKS = 8
"""Blocks of the record that validation takes turns on where there are too few groups."""


class EquationSearchConfig(Config):
    """A search for the equations of several outputs.

    Attributes:
        evolution: how equations are bred.
        final: how the terms of the individual that wins are chosen from once more, by the extended
            BIC on all samples; terms that genetic programming carries along without need go. None
            keeps all.
        validate_every: number n of which every n-th manoeuvre validates during the search; with
            fewer manoeuvres every n-th eighth of the samples.
        seed: seed of the random choices; each axis has its own.
    """

    evolution: EvolutionConfig = Field(default_factory=EvolutionConfig)
    final: SearchConfig | None = Field(default_factory=SearchConfig)
    validate_every: int = Field(default=4, ge=2, le=BLOCKS)
    seed: int = Field(default=0, ge=0)
