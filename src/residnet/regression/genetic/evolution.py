"""Genetic programming of equations as document 000 does it (chapters 4 and 5), on the library DEAP.

Individuals are trees over channels and operators. What a tree comes to is taken apart at + and -
into terms, products multiplied out first where `split` says so; each term gets a coefficient by
least squares, and the mean square error that is left is the fitness. Tournaments choose parents,
one-point crossover and uniform mutation make the next generation within a limit of depth, and the
search stops early on validation samples.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from residnet.core.errors import FitError, MissingPackageError
from residnet.regression.expressions.algebra import (
    ONE,
    Algebra,
    Function,
    Product,
    Sum,
    TooLargeError,
)
from residnet.regression.genetic.config import BINARY, EvolutionConfig
from residnet.regression.genetic.fitness import Fitness, Terms

_NAMES = {
    "+": "add",
    "-": "subtract",
    "*": "multiply",
    "/": "divide",
    "abs": "abs",
    "sin": "sin",
    "cos": "cos",
    "sqrt": "sqrt",
}


@dataclass(frozen=True)
class Generation:
    """The best individual of a generation: relative mean square errors and number of terms."""

    train: float
    validation: float
    terms: int


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        terms: of the individual of the least validation error among the best of each generation.
        train: its mean square error over the target's mean square on the training samples that the
            search looked at.
        validation: the same on all validation samples.
        generation: when it appeared; 0 is the first population.
        reached: whether both errors came below the goal.
        history: the best individual of each generation.
        fitted: how many different sets of terms were fitted.
    """

    terms: Terms
    train: float
    validation: float
    generation: int
    reached: bool
    history: tuple[Generation, ...]
    fitted: int


class Individual:
    """Trees and, once it is known, minus the training error; DEAP's tournament reads `fitness`."""

    __slots__ = ("fitness", "terms", "trees", "validation")

    def __init__(self, trees: list[Any]) -> None:
        self.trees = trees
        self.fitness = -np.inf
        self.validation = np.inf
        self.terms: Terms = ()

    def copy(self) -> Individual:
        """Return the same trees in lists of their own."""
        return Individual([tree.__class__(tree) for tree in self.trees])


def require_deap() -> ModuleType:
    """Return DEAP's genetic programming.

    Raises:
        MissingPackageError: where it is not installed.
    """
    try:
        from deap import gp
    except ImportError as error:
        raise MissingPackageError(
            "genetic programming needs the library DEAP, which is not installed; install it with:"
            " pip install 'residnet[gp]'"
        ) from error
    module: ModuleType = gp
    return module


def evolve(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    train: np.ndarray,
    config: EvolutionConfig,
    seed: int,
) -> Found:
    """Search the equation of one target.

    Args:
        algebra: of the channels, within `limits_of` the config.
        data: channels [N] by name.
        target: what the equation is to give, [N].
        train: which samples [N] train; the others validate.
        config: how to breed.
        seed: of all random choices.

    Raises:
        FitError: without training or validation samples, with values that are not finite, or where
            no individual could be fitted.
        UsageError: where DEAP is not installed.
    """
    require_deap()
    for name, values in [
        *((name, data[name]) for name in algebra.channels),
        ("the target", target),
    ]:
        if not np.isfinite(values).all():
            raise FitError(f"genetic programming: {name} is not finite in all samples; mask those")
    if not 0 < train.sum() < len(train):
        raise FitError(
            f"genetic programming: needs samples to train and to validate, given {int(train.sum())}"
            f" of {len(train)} to train"
        )
    chosen = np.sort(
        np.concatenate((_thinned(np.flatnonzero(train), config.rows), np.flatnonzero(~train)))
    )
    fitness = Fitness(
        algebra,
        {name: data[name][chosen] for name in algebra.channels},
        target[chosen],
        train[chosen],
        config.prune,
    )
    with _seeded(seed):
        return _Breeding(algebra, fitness, config).run()


def _thinned(indices: np.ndarray, most: int) -> np.ndarray:
    kept = np.linspace(0, len(indices) - 1, min(most, len(indices))).round().astype(int)
    return np.asarray(indices[np.unique(kept)])


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Seed Python's own generator, from which DEAP draws, and put back what stood in it."""
    state = random.getstate()
    random.seed(seed)
    try:
        yield
    finally:
        random.setstate(state)


class _Breeding:
    """One search."""

    def __init__(self, algebra: Algebra, fitness: Fitness, config: EvolutionConfig) -> None:
        self.gp = require_deap()
        self.algebra, self.fitness, self.config = algebra, fitness, config
        self.set = self._primitives()
        self.meaning = _meanings(algebra)
        limit = self.gp.staticLimit(key=lambda tree: tree.height, max_value=config.depth)
        self.mate = limit(self.gp.cxOnePoint)
        self.mutate = limit(
            partial(
                self.gp.mutUniform, expr=partial(self.gp.genFull, min_=0, max_=2), pset=self.set
            )
        )

    def run(self) -> Found:
        """Breed generations until the goal, the patience's end or the last one."""
        low, high = self.config.first_depth
        tree = partial(self.gp.genHalfAndHalf, self.set, low, high)
        first = [
            Individual([self.gp.PrimitiveTree(tree()) for _ in range(self.config.genes)])
            for _ in range(self.config.population)
        ]
        population = self._rated(first)
        best, when, history, reached = population[0], 0, [self._described(population[0])], False
        for generation in range(self.config.generations + 1):
            reached = max(-best.fitness, best.validation) <= self.config.goal
            if (
                reached
                or generation == self.config.generations
                or generation - when >= self.config.patience
            ):
                break
            population = self._rated(
                [*population[: self.config.elite], *self._offspring(population)]
            )
            history.append(self._described(population[0]))
            if population[0].validation < best.validation:
                best, when = population[0], generation + 1
        if not best.terms:
            raise FitError(
                "genetic programming: no individual has terms that the data tell apart; give a"
                " larger population or other operators"
            )
        return Found(
            best.terms,
            -best.fitness,
            best.validation,
            when,
            reached,
            tuple(history),
            self.fitness.fitted,
        )

    def _described(self, best: Individual) -> Generation:
        return Generation(-best.fitness, best.validation, len(best.terms))

    def _primitives(self) -> Any:
        made = self.gp.PrimitiveSet("main", 0)
        for operator in self.config.operators:
            made.addPrimitive(None, 2 if operator in BINARY else 1, name=_NAMES[operator])
        for name in self.algebra.channels:
            made.addTerminal(None, name=f"channel {name}")
        if self.config.one:
            made.addTerminal(1.0)
        if self.config.constants is not None:
            made.addEphemeralConstant(
                f"constant {self.config.constants}", partial(random.uniform, *self.config.constants)
            )
        return made

    def _offspring(self, population: Sequence[Individual]) -> list[Individual]:
        """Return children of parents by tournament: crossover, mutation or a copy."""
        from deap import tools

        wanted = self.config.population - self.config.elite
        parents = tools.selTournament(population, 2 * wanted, self.config.tournament)
        out = []
        for first, second in zip(parents[::2], parents[1::2], strict=True):
            draw = random.random()
            child = first.copy()
            if draw < self.config.crossover:
                self._cross(child, second.copy())
            elif draw < self.config.crossover + self.config.mutation:
                place = random.randrange(len(child.trees))
                (child.trees[place],) = self.mutate(child.trees[place])
            out.append(child)
        return out

    def _cross(self, child: Individual, other: Individual) -> None:
        """Cross a tree of each at one point.

        With several genes every other time whole ones are exchanged.
        """
        here, there = random.randrange(len(child.trees)), random.randrange(len(other.trees))
        if len(child.trees) > 1 and random.random() < 0.5:
            child.trees[here] = other.trees[there]
        else:
            child.trees[here], _ = self.mate(child.trees[here], other.trees[there])

    def _rated(self, individuals: list[Individual]) -> list[Individual]:
        """Return the individuals with fitness, best first; of equals the one of fewer terms."""
        results = self.fitness.of([self._terms(individual) for individual in individuals])
        for individual, (train, validation, terms) in zip(individuals, results, strict=True):
            individual.fitness, individual.validation, individual.terms = -train, validation, terms
        return sorted(individuals, key=lambda i: (-i.fitness, len(i.terms)))

    def _terms(self, individual: Individual) -> Terms | None:
        """Return the terms of an individual; None beyond the limits or without any."""
        products: set[Product] = {ONE} if self.config.intercept else set()
        try:
            for tree in individual.trees:
                if self.config.equal_terms == "reject" and self._repeats(tree):
                    return None
                meant = self._sum(tree)
                products.update(
                    self.algebra.bracket(meant) if self.config.split == "gene" else meant
                )
        except TooLargeError:
            return None
        return tuple(sorted(products)) if 0 < len(products) <= self.config.max_terms else None

    def _repeats(self, tree: Any) -> bool:
        """Return whether a term stands twice among the branches at + and - from the root down."""
        seen: set[Product] = set()
        starts = [0]
        while starts:
            start = starts.pop()
            branch = tree.searchSubtree(start)
            if tree[start].name in ("add", "subtract"):
                starts += [start + 1, tree.searchSubtree(start + 1).stop]
                continue
            meant = self._sum(tree[branch])
            if not seen.isdisjoint(meant):
                return True
            seen.update(meant)
        return False

    def _sum(self, tree: Sequence[Any]) -> Sum:
        """Return the sum that a tree in prefix order comes to."""
        stack: list[Sum] = []
        for node in reversed(tree):
            if node.arity == 2:
                stack.append(self.meaning[node.name](stack.pop(), stack.pop()))
            elif node.arity == 1:
                stack.append(self.meaning[node.name](stack.pop()))
            else:
                name = node.value
                stack.append(
                    self.algebra.channel(name.removeprefix("channel "))
                    if isinstance(name, str)
                    else {ONE: float(name)}
                )
        return stack[0]


def _meanings(algebra: Algebra) -> dict[str, Callable[..., Sum]]:
    out: dict[str, Callable[..., Sum]] = {
        "add": algebra.add,
        "subtract": partial(algebra.add, sign=-1.0),
        "multiply": algebra.multiply,
        "divide": lambda a, b: algebra.multiply(a, algebra.apply("inv", b)),
    }
    functions: tuple[Function, ...] = ("abs", "sin", "cos", "sqrt")
    return out | {function: partial(algebra.apply, function) for function in functions}
