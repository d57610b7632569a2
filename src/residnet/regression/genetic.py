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
from residnet.regression.estimator import Coefficient, Estimator, EstimatorData, Solution, to_dense
from residnet.regression.expressions import (
    CONSTANT_PRODUCT,
    Algebra,
    ExpressionLimits,
    Factors,
    Function,
    Product,
    ProductEvaluator,
    Sum,
    TooLargeError,
    build_library_state,
    format_equation,
    format_product,
    format_sum,
    products_to_sympy,
)
from residnet.regression.sparse import (
    SparseSearchConfig,
    coefficient_to_dict,
    find_equation,
    fit_all_candidates,
    reduce_problem,
)

Operator = Literal["+", "-", "*", "/", "abs", "sin", "cos", "sqrt"]
BINARY = {"+": "add", "-": "subtract", "*": "multiply", "/": "divide"}
VALIDATION_BLOCKS = 8
"""Blocks of the record that validation takes turns on where there are too few groups."""
Terms = tuple[Product, ...]
_SINGULARITY_TOLERANCE = 1e-13
"""Share of a term's energy that must be left beside the terms before it; below it the Gram matrix
counts as singular (section 5.1.2).
"""
_MIN_MEAN_SQUARE = 1e-300
"""Least mean square of a target that errors are divided by."""
_MIN_TERM_RMS = 1e-100
"""Root mean square of a term below which it is not used."""
_MAX_CACHE_NUMBERS = 40_000_000
"""Numbers in the cache of columns before it is emptied."""
_MAX_BATCH_NUMBERS = 3_000_000
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
    def _validate_settings(self) -> EvolutionConfig:
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


def expression_limits(config: EvolutionConfig) -> ExpressionLimits:
    """Return the limits of the terms of a search."""
    return ExpressionLimits(
        config.max_terms, config.max_degree, config.nesting, config.split == "expand"
    )


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
    final: SparseSearchConfig | None = Field(default_factory=SparseSearchConfig)
    validate_every: int = Field(default=4, ge=2, le=VALIDATION_BLOCKS)
    seed: int = Field(default=0, ge=0)


class FitnessEvaluator:
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
        is_training: np.ndarray,
    ) -> None:
        """From channels [N], the target [N], and which samples [N] train."""
        order = np.argsort(~is_training, kind="stable")
        self._evaluator = ProductEvaluator(
            algebra,
            {name: np.asarray(data[name], dtype=np.float64)[order] for name in algebra.channels},
        )
        self.n_train = int(is_training.sum())
        y = torch.from_numpy(np.asarray(target, dtype=np.float64)[order])
        self.y, self.y_validation = y[: self.n_train], y[self.n_train :]
        self.target_mean_square = [
            max(float(values.square().mean()), _MIN_MEAN_SQUARE)
            for values in (self.y, self.y_validation)
        ]
        self.n_fitted = 0
        self._results: dict[Terms, tuple[float, float, Terms]] = {}
        self._clear_cache()

    def evaluate(self, individuals: Sequence[Terms | None]) -> list[tuple[float, float, Terms]]:
        """Return (training error, validation error, terms that are left) of each.

        Errors are infinite where there are no terms, or they are not independent.
        """
        new_term_sets = [
            terms
            for terms in dict.fromkeys(individuals)
            if terms is not None and terms not in self._results
        ]
        if new_term_sets:
            self._cache_columns({product for terms in new_term_sets for product in terms})
            by_width: dict[int, list[Terms]] = {}
            for terms in new_term_sets:
                if not terms or not bool(
                    self._is_usable[[self._cache_rows[p] for p in terms]].all()
                ):
                    self._results[terms] = (np.inf, np.inf, ())
                else:
                    by_width.setdefault(len(terms), []).append(terms)
            for n_terms, same_size_sets in by_width.items():
                batch_size = max(1, _MAX_BATCH_NUMBERS // (n_terms * self._cached_columns.shape[1]))
                for start in range(0, len(same_size_sets), batch_size):
                    self._fit_batch(same_size_sets[start : start + batch_size])
            self.n_fitted += len(new_term_sets)
        failed_result = (np.inf, np.inf, ())
        return [failed_result if terms is None else self._results[terms] for terms in individuals]

    def _clear_cache(self) -> None:
        self._cache_rows: dict[Product, int] = {}
        self._cached_columns = torch.zeros(
            0, len(self.y) + len(self.y_validation), dtype=torch.float64
        )
        self._is_usable = torch.zeros(0, dtype=torch.bool)

    def _cache_columns(self, products: set[Product]) -> None:
        """Keep columns of unit mean square over the training samples."""
        if (len(self._cache_rows) + len(products)) * self._cached_columns.shape[
            1
        ] > _MAX_CACHE_NUMBERS:
            self._clear_cache()
        missing = sorted(products - self._cache_rows.keys())
        if not missing:
            return
        values = self._evaluator.evaluate(missing)
        with np.errstate(over="ignore", invalid="ignore"):
            rms = np.sqrt(np.square(values[:, : self.n_train]).mean(axis=1))
        is_usable = np.isfinite(rms) & (rms > _MIN_TERM_RMS) & np.isfinite(values).all(axis=1)
        values = np.where(is_usable[:, None], values, 0.0) / np.where(is_usable, rms, 1.0)[:, None]
        self._cache_rows |= {
            product: len(self._cache_rows) + i for i, product in enumerate(missing)
        }
        self._cached_columns = torch.cat((self._cached_columns, torch.from_numpy(values)))
        self._is_usable = torch.cat((self._is_usable, torch.from_numpy(is_usable)))

    def _fit_batch(self, term_sets: Sequence[Terms]) -> None:
        columns = self._cached_columns[
            torch.tensor([[self._cache_rows[p] for p in terms] for terms in term_sets])
        ]
        x, x_validation = columns[..., : self.n_train], columns[..., self.n_train :]
        gram = x @ x.transpose(1, 2) / self.n_train
        cholesky_factor, info = torch.linalg.cholesky_ex(gram)
        right_hand_side = (x @ self.y / self.n_train)[..., None]
        is_solvable = (info == 0) & (
            cholesky_factor.diagonal(dim1=1, dim2=2).square().amin(dim=1) > _SINGULARITY_TOLERANCE
        )
        cholesky_factor = torch.where(
            is_solvable[:, None, None], cholesky_factor, torch.eye(gram.shape[1], dtype=gram.dtype)
        )
        coefficients = torch.cholesky_solve(right_hand_side, cholesky_factor).transpose(1, 2)
        train_error = (self.y - (coefficients @ x)[:, 0]).square().mean(
            dim=1
        ) / self.target_mean_square[0]
        validation_error = (self.y_validation - (coefficients @ x_validation)[:, 0]).square().mean(
            dim=1
        ) / self.target_mean_square[1]
        for terms, is_fitted, train_value, validation_value in zip(
            term_sets,
            is_solvable.tolist(),
            train_error.tolist(),
            validation_error.tolist(),
            strict=True,
        ):
            self._results[terms] = (
                (train_value, validation_value, terms) if is_fitted else (np.inf, np.inf, ())
            )


@dataclass(frozen=True)
class GenerationRecord:
    """The best individual of a generation: relative mean square errors and number of terms."""

    train: float
    validation: float
    terms: int


@dataclass(frozen=True)
class EvolutionResult:
    """What a search found.

    Attributes:
        terms: of the individual of the least validation error among the best of each generation.
        train: its mean square error over the target's mean square on the training samples that the
            search looked at.
        validation: the same on all validation samples.
        generation: when it appeared; 0 is the first population.
        is_goal_reached: whether both errors came below the goal.
        history: the best individual of each generation.
        n_fitted: how many different sets of terms were fitted.
    """

    terms: Terms
    train: float
    validation: float
    generation: int
    is_goal_reached: bool
    history: tuple[GenerationRecord, ...]
    n_fitted: int


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
    is_training: np.ndarray,
    config: EvolutionConfig,
    seed: int,
) -> EvolutionResult:
    """Search the equation of one target.

    Args:
        algebra: of the channels, within `expression_limits` the config.
        data: channels [N] by name.
        target: what the equation is to give, [N].
        is_training: which samples [N] train; the others validate.
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
    if not 0 < is_training.sum() < len(is_training):
        raise FitError(
            f"genetic programming: needs samples to train and to validate, given {int(is_training.sum())}"
            f" of {len(is_training)} to train"
        )
    training_rows = np.flatnonzero(is_training)
    thinned_index = (
        np.linspace(0, len(training_rows) - 1, min(config.rows, len(training_rows)))
        .round()
        .astype(int)
    )
    selected_rows = np.sort(
        np.concatenate((training_rows[np.unique(thinned_index)], np.flatnonzero(~is_training)))
    )
    fitness = FitnessEvaluator(
        algebra,
        {name: data[name][selected_rows] for name in algebra.channels},
        target[selected_rows],
        is_training[selected_rows],
    )
    # DEAP draws from Python's own generator
    random_state = random.getstate()
    random.seed(seed)
    try:
        return _Evolution(algebra, fitness, config).run_evolution()
    finally:
        random.setstate(random_state)


class _Evolution:
    """One search."""

    def __init__(
        self, algebra: Algebra, fitness: FitnessEvaluator, config: EvolutionConfig
    ) -> None:
        from deap import gp

        self.gp = gp
        self.algebra, self.fitness, self.config = algebra, fitness, config
        primitive_set = self.gp.PrimitiveSet("main", 0)
        for operator in self.config.operators:
            arity = 2 if operator in BINARY else 1
            primitive_set.addPrimitive(None, arity, name=BINARY.get(operator, operator))
        for name in self.algebra.channels:
            primitive_set.addTerminal(None, name=f"channel {name}")
        if self.config.constants is not None:
            primitive_set.addEphemeralConstant(
                f"constant {self.config.constants}", partial(random.uniform, *self.config.constants)
            )
        self.primitive_set = primitive_set
        binary_functions: dict[str, Callable[..., Sum]] = {
            "add": algebra.add,
            "subtract": partial(algebra.add, sign=-1.0),
            "multiply": algebra.multiply,
            "divide": lambda a, b: algebra.multiply(a, algebra.apply_function("inv", b)),
        }
        functions: tuple[Function, ...] = ("abs", "sin", "cos", "sqrt")
        self.operator_functions = binary_functions | {
            function: partial(algebra.apply_function, function) for function in functions
        }
        limit_height = self.gp.staticLimit(key=lambda tree: tree.height, max_value=config.depth)
        self.mate = limit_height(self.gp.cxOnePoint)
        self.mutate = limit_height(
            partial(
                self.gp.mutUniform,
                expr=partial(self.gp.genFull, min_=0, max_=2),
                pset=self.primitive_set,
            )
        )

    def run_evolution(self) -> EvolutionResult:
        """Breed generations until the goal, the patience's end or the last one."""
        min_depth, max_depth = self.config.first_depth
        generate_tree = partial(self.gp.genHalfAndHalf, self.primitive_set, min_depth, max_depth)
        initial_population = [
            Individual([self.gp.PrimitiveTree(generate_tree()) for _ in range(self.config.genes)])
            for _ in range(self.config.population)
        ]
        population = self._evaluate_and_sort(initial_population)

        def record_generation(best: Individual) -> GenerationRecord:
            return GenerationRecord(-best.fitness, best.validation, len(best.terms))

        best_individual, best_generation, history, is_goal_reached = (
            population[0],
            0,
            [record_generation(population[0])],
            False,
        )
        for generation in range(self.config.generations + 1):
            is_goal_reached = (
                max(-best_individual.fitness, best_individual.validation) <= self.config.goal
            )
            if (
                is_goal_reached
                or generation == self.config.generations
                or generation - best_generation >= self.config.patience
            ):
                break
            population = self._evaluate_and_sort(
                [*population[: self.config.elite], *self._make_offspring(population)]
            )
            history.append(record_generation(population[0]))
            if population[0].validation < best_individual.validation:
                best_individual, best_generation = population[0], generation + 1
        if not best_individual.terms:
            raise FitError(
                "genetic programming: no individual has terms that the data tell apart; give a"
                " larger population or other operators"
            )
        return EvolutionResult(
            best_individual.terms,
            -best_individual.fitness,
            best_individual.validation,
            best_generation,
            is_goal_reached,
            tuple(history),
            self.fitness.n_fitted,
        )

    def _make_offspring(self, population: Sequence[Individual]) -> list[Individual]:
        """Return children of parents by tournament: crossover, mutation or a copy."""
        from deap import tools

        n_offspring = self.config.population - self.config.elite
        parents = tools.selTournament(population, 2 * n_offspring, self.config.tournament)
        offspring = []
        for first_parent, second_parent in zip(parents[::2], parents[1::2], strict=True):
            random_draw = random.random()
            child = first_parent.copy()
            if random_draw < self.config.crossover:
                self._crossover(child, second_parent.copy())
            elif random_draw < self.config.crossover + self.config.mutation:
                tree_index = random.randrange(len(child.trees))
                (child.trees[tree_index],) = self.mutate(child.trees[tree_index])
            offspring.append(child)
        return offspring

    def _crossover(self, child: Individual, other_parent: Individual) -> None:
        """Cross a tree of each at one point.

        With several genes every other time whole ones are exchanged.
        """
        child_index, other_index = (
            random.randrange(len(child.trees)),
            random.randrange(len(other_parent.trees)),
        )
        if len(child.trees) > 1 and random.random() < 0.5:
            child.trees[child_index] = other_parent.trees[other_index]
        else:
            child.trees[child_index], _ = self.mate(
                child.trees[child_index], other_parent.trees[other_index]
            )

    def _evaluate_and_sort(self, individuals: list[Individual]) -> list[Individual]:
        """Return the individuals with fitness, best first; of equals the one of fewer terms."""
        results = self.fitness.evaluate([self._to_terms(individual) for individual in individuals])
        for individual, (train, validation, terms) in zip(individuals, results, strict=True):
            individual.fitness, individual.validation, individual.terms = -train, validation, terms
        return sorted(individuals, key=lambda i: (-i.fitness, len(i.terms)))

    def _to_terms(self, individual: Individual) -> Terms | None:
        """Return the terms of an individual; None beyond the limits or without any."""
        products: set[Product] = set()
        try:
            for tree in individual.trees:
                if self.config.equal_terms == "reject" and self._has_repeated_term(tree):
                    return None
                tree_sum = self._tree_to_sum(tree)
                products.update(
                    self.algebra.bracket_sum(tree_sum) if self.config.split == "gene" else tree_sum
                )
        except TooLargeError:
            return None
        return tuple(sorted(products)) if 0 < len(products) <= self.config.max_terms else None

    def _has_repeated_term(self, tree: Any) -> bool:
        """Return whether a term stands twice among the branches at + and - from the root down."""
        seen_products: set[Product] = set()
        pending = [0]
        while pending:
            node_index = pending.pop()
            branch = tree.searchSubtree(node_index)
            if tree[node_index].name in ("add", "subtract"):
                pending += [node_index + 1, tree.searchSubtree(node_index + 1).stop]
                continue
            branch_sum = self._tree_to_sum(tree[branch])
            if not seen_products.isdisjoint(branch_sum):
                return True
            seen_products.update(branch_sum)
        return False

    def _tree_to_sum(self, tree: Sequence[Any]) -> Sum:
        """Return the sum that a tree in prefix order comes to."""
        stack: list[Sum] = []
        for node in reversed(tree):
            if node.arity == 2:
                stack.append(self.operator_functions[node.name](stack.pop(), stack.pop()))
            elif node.arity == 1:
                stack.append(self.operator_functions[node.name](stack.pop()))
            else:
                name = node.value
                stack.append(
                    self.algebra.make_channel(name.removeprefix("channel "))
                    if isinstance(name, str)
                    else {CONSTANT_PRODUCT: float(name)}
                )
        return stack[0]


@final
class GeneticEquations(Estimator):
    """An equation of the inputs for each output, without intercept, by genetic programming.

    A solution's state is that of an `ExpressionLibrary` under the name `library`, and the
    coefficients of its terms [P, n], `weights.values`.

    Args:
        extra_terms: factors (function, channel, power) of terms that the final choice has beside those
            that are bred, by output; none where empty.
    """

    def __init__(
        self, config: EquationSearchConfig, extra_terms: Sequence[Sequence[Factors]] = ()
    ) -> None:
        self.config, self.extra_terms = config, extra_terms

    def _solve(self, data: EstimatorData) -> list[Solution]:
        x, (_, y, groups, names, outputs) = to_dense(data.x), data
        config, n_outputs = self.config, y.shape[1]
        algebra = Algebra(names, expression_limits(config.evolution))
        values, target = x.numpy(), y.numpy()
        columns = {name: values[:, j] for j, name in enumerate(names)}
        groups = torch.zeros(len(x)) if groups is None else groups
        is_training = ~validation_mask(groups.numpy(), config.validate_every)
        extra_products = [
            _products_within_limits(algebra, factors) for factors in self.extra_terms
        ] or [()] * n_outputs
        equations = [
            evolve_equation(
                algebra,
                columns,
                target[:, k],
                is_training,
                config,
                n_outputs * config.seed + k,
                extra_products[k],
            )
            for k in range(n_outputs)
        ]
        products = sorted({product for evolved in equations for product in evolved.products})
        weights = torch.zeros(len(products), n_outputs, dtype=torch.float64)
        table: list[Coefficient] = []
        for k, (output, evolved) in enumerate(zip(outputs, equations, strict=True)):
            for product, value, standard_error in zip(
                evolved.products, evolved.values, evolved.standard_errors, strict=True
            ):
                weights[products.index(product), k] = value
                table.append(
                    Coefficient(output, format_product(algebra, product), value, standard_error)
                )
        notes = {
            "parameters": len(table),
            "coefficients": [coefficient_to_dict(coefficient) for coefficient in table],
            "unexcited": [],
            "equations": {
                output: _equation_notes(algebra, output, evolved)
                for output, evolved in zip(outputs, equations, strict=True)
            },
        }
        library = build_library_state(algebra, products, config.evolution.nesting)
        state = {f"library.{name}": value for name, value in library.items()}
        return [
            Solution(
                {"kept": [len(evolved.products) for evolved in equations]},
                state | {"weights.values": weights},
                tuple(table),
                notes,
            )
        ]


def _products_within_limits(algebra: Algebra, terms: Sequence[Factors]) -> tuple[Product, ...]:
    """Return the terms of these factors that are within the limits of the algebra."""
    products = []
    for factors in terms:
        with suppress(TooLargeError):
            products.append(algebra.make_product(factors))
    return tuple(products)


class EvolvedEquation(NamedTuple):
    """The equation of one output.

    Attributes:
        search_result: what the search found.
        products: terms of the equation.
        values: coefficients of the terms.
        standard_errors: standard errors of the coefficients.
        summary: what the data say about the equation.
    """

    search_result: EvolutionResult
    products: tuple[Product, ...]
    values: tuple[float, ...]
    standard_errors: tuple[float, ...]
    summary: dict[str, Any]


def evolve_equation(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    is_training: np.ndarray,
    config: EquationSearchConfig,
    seed: int,
    extra_products: Sequence[Product] = (),
) -> EvolvedEquation:
    """Search an equation and fit it to all samples.

    Args:
        algebra: of the channels, within the limits of the search.
        data: channels [N] by name.
        target: [N].
        is_training: which samples train the search; the others validate.
        extra_products: terms that the final choice has beside those that are bred.

    Raises:
        FitError: where the data do not determine an equation.
        UsageError: where DEAP is not installed.
    """
    search_result = evolve(algebra, data, target, is_training, config.evolution, seed)
    candidate_terms = search_result.terms
    if config.final is not None:
        candidate_terms = tuple(sorted({*candidate_terms, *extra_products}))
    values = algebra.evaluate_products(candidate_terms, data).T
    names = [format_product(algebra, product) for product in candidate_terms]
    all_candidates = reduce_problem(
        values,
        target[:, None],
        names,
        [algebra.count_factors(p) for p in candidate_terms],
        [algebra.complexity(p) for p in candidate_terms],
    )
    equation_fit, problem = (
        (fit_all_candidates(all_candidates, 0), all_candidates)
        if config.final is None
        else find_equation(all_candidates, 0, config.final)
    )
    products = tuple(candidate_terms[names.index(name)] for name in equation_fit.terms)
    coefficient_values, standard_errors = (
        tuple(equation_fit.values.tolist()),
        tuple(equation_fit.standard_errors.tolist()),
    )
    return EvolvedEquation(
        search_result, products, coefficient_values, standard_errors, equation_fit.summary(problem)
    )


def validation_mask(group: np.ndarray, group_interval: int) -> np.ndarray:
    """Return which samples [N] validate, from the numbers of their groups.

    Every n-th group does where there are enough, else blocks of the record.
    """
    group_index = np.unique(group, return_inverse=True)[1]
    if group_index.max(initial=0) + 1 < group_interval:
        group_index = np.arange(len(group)) * VALIDATION_BLOCKS // max(len(group), 1)
    return np.asarray(group_index % group_interval == group_interval - 1)


def _equation_notes(algebra: Algebra, name: str, evolved: EvolvedEquation) -> dict[str, Any]:
    text = format_sum(
        [format_product(algebra, product) for product in evolved.products], evolved.values
    )
    sympy_sum = products_to_sympy(algebra, list(zip(evolved.products, evolved.values, strict=True)))
    return {
        **format_equation(name, text, sympy_sum, algebra.channels),
        **evolved.summary,
        "bred_terms": len(evolved.search_result.terms),
        "by_sparse_search": [
            format_product(algebra, product)
            for product in evolved.products
            if product not in evolved.search_result.terms
        ],
        "generation": evolved.search_result.generation,
        "reached_goal": evolved.search_result.is_goal_reached,
        "sets_fitted": evolved.search_result.n_fitted,
        "history": [asdict(generation) for generation in evolved.search_result.history],
    }
