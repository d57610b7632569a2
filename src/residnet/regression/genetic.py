"""Genetic programming of equations as document 000 does it (chapters 4 to 6), on the library DEAP.

Individuals are trees over channels and operators. What a tree comes to is taken apart at + and -
into terms, products multiplied out first where `split` says so; each term gets a coefficient by
least squares, and the mean square error that is left is the fitness. Tournaments choose parents,
one-point crossover and uniform mutation make the next generation within a limit of depth, and the
search stops early on validation samples.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal, NamedTuple, final

import numpy as np
import torch
from pydantic import Field, model_validator

from residnet.core.config import Config
from residnet.core.errors import FitError, require_package
from residnet.regression.estimator import Coefficient, Data, Estimator, Solution, whole
from residnet.regression.expressions import (
    ONE,
    Algebra,
    Columns,
    Function,
    Limits,
    Product,
    Sum,
    Term,
    TooLargeError,
    equation,
    symbolic_sum,
    tables,
    term,
    total,
)
from residnet.regression.sparse import SearchConfig, coefficient_row, everything, find, reduce

Operator = Literal["+", "-", "*", "/", "abs", "sin", "cos", "sqrt"]
BINARY = {"+": "add", "-": "subtract", "*": "multiply", "/": "divide"}
BLOCKS = 8
"""Blocks of the record that validation takes turns on where there are too few groups."""
Terms = tuple[Product, ...]
_SINGULAR = 1e-13
"""Share of a term's energy that must be left beside the terms before it; below it the Gram matrix
counts as singular (section 5.1.2).
"""
_TINY = 1e-300
"""Least mean square of a target that errors are divided by."""
_LEAST_SCALE = 1e-100
"""Root mean square of a term below which it is not used."""
_ROWS = 40_000_000
"""Numbers in the cache of columns before it is emptied."""
_CHUNK = 3_000_000
"""Numbers in one batch of columns."""


class EvolutionConfig(Config):
    """How a population is bred; the defaults are Table 6.1's but for the population.

    Attributes:
        population: number of individuals.
        generations: most generations after the first.
        operators: of the trees; `/` is 0 at a divisor of 0 and `sqrt` takes the magnitude (document
            001 section 2.4).
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
    def _possible(self) -> EvolutionConfig:
        if self.crossover + self.mutation > 1:
            raise ValueError(
                "crossover and mutation are shares of the offspring; together at most 1, given"
                f" {self.crossover} + {self.mutation}"
            )
        if not set(self.operators) & BINARY.keys():
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


class EquationSearchConfig(Config):
    """A search for the equations of several outputs.

    Attributes:
        evolution: how equations are bred.
        final: how the terms of the individual that wins are chosen from once more, by the extended
            BIC on all samples, together with those of a sparse search of the usual candidates:
            terms that genetic programming carries along without need go, and what it missed comes
            in. None keeps the individual's, all of them and no others.
        validate_every: number n of which every n-th manoeuvre validates during the search; with
            fewer manoeuvres every n-th eighth of the samples.
        seed: seed of the random choices; each axis has its own.
    """

    evolution: EvolutionConfig = Field(default_factory=EvolutionConfig)
    final: SearchConfig | None = Field(default_factory=SearchConfig)
    validate_every: int = Field(default=4, ge=2, le=BLOCKS)
    seed: int = Field(default=0, ge=0)


class Fitness:
    """The errors of individuals on training and validation samples.

    They are mean square errors over the target's mean square on each.

    Each distinct set of terms is fitted once in the whole search. A generation's new sets go
    through together: columns of the terms that they share are computed once, then Gram matrices,
    Cholesky factors and residuals are batched (document 000 eqs. (5.4)-(5.6)).
    """

    def __init__(
        self,
        algebra: Algebra,
        data: Mapping[str, np.ndarray],
        target: np.ndarray,
        train: np.ndarray,
    ) -> None:
        """From channels [N], the target [N], and which samples [N] train."""
        order = np.argsort(~train, kind="stable")
        self.columns = Columns(
            algebra,
            {name: np.asarray(data[name], dtype=np.float64)[order] for name in algebra.channels},
        )
        self.count = int(train.sum())
        y = torch.from_numpy(np.asarray(target, dtype=np.float64)[order])
        self.y, self.y_validation = y[: self.count], y[self.count :]
        self.energy = [
            max(float(part.square().mean()), _TINY) for part in (self.y, self.y_validation)
        ]
        self.fitted = 0
        self._known: dict[Terms, tuple[float, float, Terms]] = {}
        self._empty()

    def of(self, individuals: Sequence[Terms | None]) -> list[tuple[float, float, Terms]]:
        """Return (training error, validation error, terms that are left) of each.

        Errors are infinite where there are no terms, or they are not independent.
        """
        new = [
            terms
            for terms in dict.fromkeys(individuals)
            if terms is not None and terms not in self._known
        ]
        if new:
            self._cache({product for terms in new for product in terms})
            by_width: dict[int, list[Terms]] = {}
            for terms in new:
                if not terms or not bool(self._usable[[self._rows[p] for p in terms]].all()):
                    self._known[terms] = (np.inf, np.inf, ())
                else:
                    by_width.setdefault(len(terms), []).append(terms)
            for width, group in by_width.items():
                step = max(1, _CHUNK // (width * self._values.shape[1]))
                for start in range(0, len(group), step):
                    self._batch(group[start : start + step])
            self.fitted += len(new)
        nothing = (np.inf, np.inf, ())
        return [nothing if terms is None else self._known[terms] for terms in individuals]

    def _empty(self) -> None:
        self._rows: dict[Product, int] = {}
        self._values = torch.zeros(0, len(self.y) + len(self.y_validation), dtype=torch.float64)
        self._usable = torch.zeros(0, dtype=torch.bool)

    def _cache(self, wanted: set[Product]) -> None:
        """Keep columns of unit mean square over the training samples."""
        if (len(self._rows) + len(wanted)) * self._values.shape[1] > _ROWS:
            self._empty()
        new = sorted(wanted - self._rows.keys())
        if not new:
            return
        values = self.columns.of(new)
        with np.errstate(over="ignore", invalid="ignore"):
            scale = np.sqrt(np.square(values[:, : self.count]).mean(axis=1))
        good = np.isfinite(scale) & (scale > _LEAST_SCALE) & np.isfinite(values).all(axis=1)
        values = np.where(good[:, None], values, 0.0) / np.where(good, scale, 1.0)[:, None]
        self._rows |= {product: len(self._rows) + i for i, product in enumerate(new)}
        self._values = torch.cat((self._values, torch.from_numpy(values)))
        self._usable = torch.cat((self._usable, torch.from_numpy(good)))

    def _batch(self, group: Sequence[Terms]) -> None:
        columns = self._values[torch.tensor([[self._rows[p] for p in terms] for terms in group])]
        x, x_validation = columns[..., : self.count], columns[..., self.count :]
        gram = x @ x.transpose(1, 2) / self.count
        factor, info = torch.linalg.cholesky_ex(gram)
        right = (x @ self.y / self.count)[..., None]
        good = (info == 0) & (factor.diagonal(dim1=1, dim2=2).square().amin(dim=1) > _SINGULAR)
        factor = torch.where(
            good[:, None, None], factor, torch.eye(gram.shape[1], dtype=gram.dtype)
        )
        coefficients = torch.cholesky_solve(right, factor).transpose(1, 2)
        train = (self.y - (coefficients @ x)[:, 0]).square().mean(dim=1) / self.energy[0]
        validation = (self.y_validation - (coefficients @ x_validation)[:, 0]).square().mean(
            dim=1
        ) / self.energy[1]
        for terms, fine, a, b in zip(
            group, good.tolist(), train.tolist(), validation.tolist(), strict=True
        ):
            self._known[terms] = (a, b, terms) if fine else (np.inf, np.inf, ())


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
        seed: of all random choices.

    Raises:
        FitError: without training or validation samples, with values that are not finite, or where
            no individual could be fitted.
        UsageError: where DEAP is not installed.
    """
    require_package("deap", "genetic programming", "gp")
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
    rows = np.flatnonzero(train)
    thinned = np.linspace(0, len(rows) - 1, min(config.rows, len(rows))).round().astype(int)
    chosen = np.sort(np.concatenate((rows[np.unique(thinned)], np.flatnonzero(~train))))
    fitness = Fitness(
        algebra,
        {name: data[name][chosen] for name in algebra.channels},
        target[chosen],
        train[chosen],
    )
    # DEAP draws from Python's own generator
    state = random.getstate()
    random.seed(seed)
    try:
        return _Breeding(algebra, fitness, config).run()
    finally:
        random.setstate(state)


class _Breeding:
    """One search."""

    def __init__(self, algebra: Algebra, fitness: Fitness, config: EvolutionConfig) -> None:
        from deap import gp

        self.gp = gp
        self.algebra, self.fitness, self.config = algebra, fitness, config
        made = self.gp.PrimitiveSet("main", 0)
        for operator in self.config.operators:
            arity = 2 if operator in BINARY else 1
            made.addPrimitive(None, arity, name=BINARY.get(operator, operator))
        for name in self.algebra.channels:
            made.addTerminal(None, name=f"channel {name}")
        if self.config.constants is not None:
            made.addEphemeralConstant(
                f"constant {self.config.constants}", partial(random.uniform, *self.config.constants)
            )
        self.set = made
        out: dict[str, Callable[..., Sum]] = {
            "add": algebra.add,
            "subtract": partial(algebra.add, sign=-1.0),
            "multiply": algebra.multiply,
            "divide": lambda a, b: algebra.multiply(a, algebra.apply("inv", b)),
        }
        functions: tuple[Function, ...] = ("abs", "sin", "cos", "sqrt")
        self.meaning = out | {function: partial(algebra.apply, function) for function in functions}
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

        def described(best: Individual) -> Generation:
            return Generation(-best.fitness, best.validation, len(best.terms))

        best, when, history, reached = population[0], 0, [described(population[0])], False
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
            history.append(described(population[0]))
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
        products: set[Product] = set()
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


@final
class GeneticEquations(Estimator):
    """An equation of the inputs for each output, without intercept, by genetic programming.

    A solution's state is that of an `ExpressionLibrary` under the name `library`, and the
    coefficients of its terms [P, n], `weights.values`.

    Args:
        known: factors (function, channel, power) of terms that the final choice has beside those
            that are bred, by output; none where empty.
    """

    def __init__(self, config: EquationSearchConfig, known: Sequence[Sequence[Term]] = ()) -> None:
        self.config, self.known = config, known

    def solve(self, data: Data) -> list[Solution]:
        x, (_, y, groups, names, outputs) = whole(data.x), data
        config, n = self.config, y.shape[1]
        algebra = Algebra(names, limits_of(config.evolution))
        values, target = x.numpy(), y.numpy()
        columns = {name: values[:, j] for j, name in enumerate(names)}
        groups = torch.zeros(len(x)) if groups is None else groups
        train = ~validating(groups.numpy(), config.validate_every)
        known = [_within(algebra, row) for row in self.known] or [()] * n
        bred = [
            breed(algebra, columns, target[:, k], train, config, n * config.seed + k, known[k])
            for k in range(n)
        ]
        products = sorted({product for found in bred for product in found.products})
        weights = torch.zeros(len(products), n, dtype=torch.float64)
        table: list[Coefficient] = []
        for k, (output, found) in enumerate(zip(outputs, bred, strict=True)):
            for product, value, error in zip(
                found.products, found.values, found.errors, strict=True
            ):
                weights[products.index(product), k] = value
                table.append(Coefficient(output, term(algebra, product), value, error))
        notes = {
            "parameters": len(table),
            "coefficients": [coefficient_row(entry) for entry in table],
            "unexcited": [],
            "equations": {
                output: _written(algebra, output, found)
                for output, found in zip(outputs, bred, strict=True)
            },
        }
        library = tables(algebra, products, config.evolution.nesting)
        state = {f"library.{name}": value for name, value in library.items()}
        return [
            Solution(
                {"kept": [len(found.products) for found in bred]},
                state | {"weights.values": weights},
                tuple(table),
                notes,
            )
        ]


def _within(algebra: Algebra, terms: Sequence[Term]) -> tuple[Product, ...]:
    """Return the terms of these factors that are within the limits of the algebra."""
    out = []
    for factors in terms:
        with suppress(TooLargeError):
            out.append(algebra.product(factors))
    return tuple(out)


class Bred(NamedTuple):
    """The equation of one output.

    Attributes:
        found: what the search found.
        products: terms of the equation.
        values: coefficients of the terms.
        errors: standard errors of the coefficients.
        summary: what the data say about the equation.
    """

    found: Found
    products: tuple[Product, ...]
    values: tuple[float, ...]
    errors: tuple[float, ...]
    summary: dict[str, Any]


def breed(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    train: np.ndarray,
    config: EquationSearchConfig,
    seed: int,
    known: Sequence[Product] = (),
) -> Bred:
    """Search an equation and fit it to all samples.

    Args:
        algebra: of the channels, within the limits of the search.
        data: channels [N] by name.
        target: [N].
        train: which samples train the search; the others validate.
        known: terms that the final choice has beside those that are bred.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    found = evolve(algebra, data, target, train, config.evolution, seed)
    pool = found.terms
    if config.final is not None:
        pool = tuple(sorted({*pool, *known}))
    values = algebra.values(pool, data).T
    names = [term(algebra, product) for product in pool]
    reduced = reduce(
        values,
        target[:, None],
        names,
        [algebra.degree(p) for p in pool],
        [algebra.effort(p) for p in pool],
    )
    kept, within = (
        (everything(reduced, 0), reduced)
        if config.final is None
        else find(reduced, 0, config.final)
    )
    products = tuple(pool[names.index(name)] for name in kept.terms)
    numbers, errors = tuple(kept.values.tolist()), tuple(kept.errors.tolist())
    return Bred(found, products, numbers, errors, kept.summary(within))


def validating(group: np.ndarray, every: int) -> np.ndarray:
    """Return which samples [N] validate, from the numbers of their groups.

    Every n-th group does where there are enough, else blocks of the record.
    """
    numbers = np.unique(group, return_inverse=True)[1]
    if numbers.max(initial=0) + 1 < every:
        numbers = np.arange(len(group)) * BLOCKS // max(len(group), 1)
    return np.asarray(numbers % every == every - 1)


def _written(algebra: Algebra, name: str, bred: Bred) -> dict[str, Any]:
    text = total([term(algebra, product) for product in bred.products], bred.values)
    value = symbolic_sum(algebra, list(zip(bred.products, bred.values, strict=True)))
    return {
        **equation(name, text, value, algebra.channels),
        **bred.summary,
        "bred_terms": len(bred.found.terms),
        "by_sparse_search": [
            term(algebra, product) for product in bred.products if product not in bred.found.terms
        ],
        "generation": bred.found.generation,
        "reached_goal": bred.found.reached,
        "sets_fitted": bred.found.fitted,
        "history": [asdict(generation) for generation in bred.found.history],
    }
