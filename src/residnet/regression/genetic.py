"""Genetic programming of equations by the method of Halvorsen 2019 (chapters 4 to 6), with DEAP.

Individuals are trees of channels and operators. The expression of a tree is split at + and - into
terms, after expansion of products if `split` is `expand`. Least squares gives every term a
coefficient, and the fitness is the mean squared error. Tournament selection, one-point crossover
and uniform mutation with a depth limit create the next generation. The error on validation samples
ends the search (early stopping).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple, final

import numpy as np
import torch

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
from residnet.regression.genetic_config import (
    BINARY,
    VALIDATION_BLOCKS,
    EquationSearchConfig,
    EvolutionConfig,
)
from residnet.regression.sparse import (
    coefficient_to_dict,
    find_equation,
    fit_all_candidates,
    reduce_problem,
)

Terms = tuple[Product, ...]
"""Sorted products of an individual. Individuals with equal products share a fit."""
_SINGULARITY_TOLERANCE = 1e-13
"""Squared pivot of the Cholesky factor below which a Gram matrix counts as singular.

Source: Halvorsen 2019, section 5.1.2.
"""
_MIN_MEAN_SQUARE = 1e-300
"""Lower bound of the mean square of a target in a denominator."""
_MIN_TERM_RMS = 1e-100
"""Root mean square below which a term counts as zero."""
_MAX_CACHE_ELEMENTS = 40_000_000
"""Maximum number of array elements in the cache of columns; it is cleared above."""
_MAX_BATCH_ELEMENTS = 3_000_000
"""Maximum number of array elements in one batch of columns."""


def expression_limits(config: EvolutionConfig) -> ExpressionLimits:
    """Return the limits on size and nesting of expressions that a config sets."""
    return ExpressionLimits(
        config.max_terms, config.max_degree, config.nesting, config.split == "expand"
    )


class FitErrors(NamedTuple):
    """Errors of the least-squares fit of a set of terms.

    Attributes:
        train: relative mean squared error on the training samples; infinite without a fit.
        validation: relative mean squared error on the validation samples; infinite without a fit.
        terms: the fitted terms; empty without a fit.
    """

    train: float
    validation: float
    terms: Terms


_FAILED_FIT = FitErrors(np.inf, np.inf, ())


class FitnessEvaluator:
    """Computes relative mean squared errors of individuals on training and validation samples.

    Each distinct set of terms is fitted once per search. The new sets of a generation share the
    columns of their terms, and Gram matrices, Cholesky factors and residuals are computed in
    batches (Halvorsen 2019, eqs. (5.4)-(5.6)).
    """

    def __init__(
        self,
        algebra: Algebra,
        data: Mapping[str, np.ndarray],
        target: np.ndarray,
        is_training: np.ndarray,
    ) -> None:
        """Prepare the evaluation.

        Args:
            algebra: algebra of the channels.
            data: channels [N] by name.
            target: target [N].
            is_training: mask of the training samples [N]; the others are for validation.
        """
        # training samples first: both subsets are slices of one array of columns
        order = np.argsort(~is_training, kind="stable")
        self._evaluator = ProductEvaluator(
            algebra,
            {name: np.asarray(data[name], dtype=np.float64)[order] for name in algebra.channels},
        )
        self.n_train = int(is_training.sum())
        y = torch.from_numpy(np.asarray(target, dtype=np.float64)[order])
        self.y = y[: self.n_train]
        self.y_validation = y[self.n_train :]
        self.target_mean_square = [
            max(float(values.square().mean()), _MIN_MEAN_SQUARE)
            for values in (self.y, self.y_validation)
        ]
        self.n_fitted = 0
        self._results: dict[Terms, FitErrors] = {}
        self._clear_cache()

    def evaluate(self, individuals: Sequence[Terms | None]) -> list[FitErrors]:
        """Return the errors of each set of terms.

        Errors are infinite for an empty set, a non-finite term and linearly dependent terms.
        """
        new_term_sets = [
            terms
            for terms in dict.fromkeys(individuals)
            if terms is not None and terms not in self._results
        ]
        if new_term_sets:
            self._cache_columns({product for terms in new_term_sets for product in terms})
            # sets of equal size are fitted in one batched Cholesky factorisation
            by_width: dict[int, list[Terms]] = {}
            for terms in new_term_sets:
                if not terms or not bool(
                    self._is_usable[[self._cache_rows[p] for p in terms]].all()
                ):
                    self._results[terms] = _FAILED_FIT
                else:
                    by_width.setdefault(len(terms), []).append(terms)
            for n_terms, same_size_sets in by_width.items():
                batch_size = max(
                    1, _MAX_BATCH_ELEMENTS // (n_terms * self._cached_columns.shape[1])
                )
                for start in range(0, len(same_size_sets), batch_size):
                    self._fit_batch(same_size_sets[start : start + batch_size])
            self.n_fitted += len(new_term_sets)
        return [_FAILED_FIT if terms is None else self._results[terms] for terms in individuals]

    def _clear_cache(self) -> None:
        """Forget all columns of products; results of term sets are retained."""
        self._cache_rows: dict[Product, int] = {}
        self._cached_columns = torch.zeros(
            0, len(self.y) + len(self.y_validation), dtype=torch.float64
        )
        self._is_usable = torch.zeros(0, dtype=torch.bool)

    def _cache_columns(self, products: set[Product]) -> None:
        """Add the columns of products to the cache, scaled to unit mean square in training."""
        if (len(self._cache_rows) + len(products)) * self._cached_columns.shape[
            1
        ] > _MAX_CACHE_ELEMENTS:
            self._clear_cache()
        missing = sorted(products - self._cache_rows.keys())
        if not missing:
            return
        # non-finite and zero columns are marked as unusable instead of raising an error
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
        """Fit term sets of equal size by least squares and store their errors."""
        columns = self._cached_columns[
            torch.tensor([[self._cache_rows[p] for p in terms] for terms in term_sets])
        ]
        x = columns[..., : self.n_train]
        x_validation = columns[..., self.n_train :]
        # a singular Gram matrix is replaced by the identity, and its result is discarded below
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
                FitErrors(train_value, validation_value, terms) if is_fitted else _FAILED_FIT
            )


@dataclass(frozen=True)
class GenerationRecord:
    """The best individual of a generation.

    Attributes:
        train: relative mean squared error on the training samples.
        validation: relative mean squared error on the validation samples.
        terms: number of terms.
    """

    train: float
    validation: float
    terms: int


@dataclass(frozen=True)
class EvolutionResult:
    """Result of a search.

    Attributes:
        terms: terms of the individual of minimum validation error among the best individuals of
            all generations.
        train: relative mean squared error of `terms` on the decimated training samples.
        validation: relative mean squared error of `terms` on all validation samples.
        generation: generation in which the individual appeared; 0 is the initial population.
        is_goal_reached: whether both errors are below the goal.
        history: best individual of each generation.
        n_fitted: number of distinct sets of terms that were fitted.
    """

    terms: Terms
    train: float
    validation: float
    generation: int
    is_goal_reached: bool
    history: tuple[GenerationRecord, ...]
    n_fitted: int


class Individual:
    """Trees of an individual and its errors; DEAP reads `fitness`, minus the training error."""

    __slots__ = ("fitness", "terms", "trees", "validation")

    def __init__(self, trees: list[Any]) -> None:
        self.trees = trees
        self.fitness = -np.inf
        self.validation = np.inf
        self.terms: Terms = ()

    def copy(self) -> Individual:
        """Return a copy whose trees can be changed independently."""
        return Individual([tree.__class__(tree) for tree in self.trees])


def evolve(
    algebra: Algebra,
    data: Mapping[str, np.ndarray],
    target: np.ndarray,
    is_training: np.ndarray,
    config: EvolutionConfig,
    seed: int,
) -> EvolutionResult:
    """Search the equation of one target by genetic programming.

    Args:
        algebra: algebra of the channels with the limits of `expression_limits`.
        data: channels [N] by name.
        target: target [N].
        is_training: mask of the training samples [N]; the others are for validation.
        config: settings of the evolution.
        seed: random seed.

    Raises:
        FitError: if training or validation samples are missing, values are not finite, or no
            individual can be fitted.
        UsageError: if DEAP is not installed.
    """
    require_package("deap", "genetic programming", "gp")
    for name, values in [
        *((name, data[name]) for name in algebra.channels),
        ("the target", target),
    ]:
        if not np.isfinite(values).all():
            raise FitError(f"genetic programming: {name} is not finite in all samples; mask these")
    if not 0 < is_training.sum() < len(is_training):
        raise FitError(
            "genetic programming needs training and validation samples, but"
            f" {int(is_training.sum())} of {len(is_training)} samples are for training; give more"
            " manoeuvres"
        )
    # decimate the training samples evenly; all validation samples are used
    training_rows = np.flatnonzero(is_training)
    decimated_index = (
        np.linspace(0, len(training_rows) - 1, min(config.rows, len(training_rows)))
        .round()
        .astype(int)
    )
    selected_rows = np.sort(
        np.concatenate((training_rows[np.unique(decimated_index)], np.flatnonzero(~is_training)))
    )
    fitness = FitnessEvaluator(
        algebra,
        {name: data[name][selected_rows] for name in algebra.channels},
        target[selected_rows],
        is_training[selected_rows],
    )
    # DEAP draws from the global generator of Python: seed it, and restore its state afterwards
    random_state = random.getstate()
    random.seed(seed)
    try:
        return _Evolution(algebra, fitness, config).run_evolution()
    finally:
        random.setstate(random_state)


class _Evolution:
    """Genetic programming of one equation with the operators of DEAP."""

    def __init__(
        self, algebra: Algebra, fitness: FitnessEvaluator, config: EvolutionConfig
    ) -> None:
        from deap import gp

        self.gp = gp
        self.algebra = algebra
        self.fitness = fitness
        self.config = config
        # the primitives are names only; `_tree_to_sum` evaluates trees to sums of products
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
        # an operator that exceeds the depth returns a copy of a parent (Koza's limit)
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
        """Evolve until the goal, the end of the patience or the last generation."""
        min_depth, max_depth = self.config.first_depth
        generate_tree = partial(self.gp.genHalfAndHalf, self.primitive_set, min_depth, max_depth)
        initial_population = [
            Individual([self.gp.PrimitiveTree(generate_tree()) for _ in range(self.config.genes)])
            for _ in range(self.config.population)
        ]
        population = self._evaluate_and_sort(initial_population)

        def record_generation(best: Individual) -> GenerationRecord:
            return GenerationRecord(-best.fitness, best.validation, len(best.terms))

        best_individual = population[0]
        best_generation = 0
        history = [record_generation(population[0])]
        is_goal_reached = False
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
                best_individual = population[0]
                best_generation = generation + 1
        if not best_individual.terms:
            raise FitError(
                "genetic programming: no individual has linearly independent terms on these data;"
                " give a larger population or other operators"
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
        """Create offspring of tournament winners by crossover, mutation or copying."""
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
        """Cross a random tree of the child with one of another parent, in place.

        With several genes, half of the crossovers exchange whole trees.
        """
        child_index = random.randrange(len(child.trees))
        other_index = random.randrange(len(other_parent.trees))
        if len(child.trees) > 1 and random.random() < 0.5:
            child.trees[child_index] = other_parent.trees[other_index]
        else:
            child.trees[child_index], _ = self.mate(
                child.trees[child_index], other_parent.trees[other_index]
            )

    def _evaluate_and_sort(self, individuals: list[Individual]) -> list[Individual]:
        """Evaluate individuals and sort them by fitness, ties by the number of terms."""
        results = self.fitness.evaluate([self._to_terms(individual) for individual in individuals])
        for individual, result in zip(individuals, results, strict=True):
            individual.fitness = -result.train
            individual.validation = result.validation
            individual.terms = result.terms
        return sorted(individuals, key=lambda i: (-i.fitness, len(i.terms)))

    def _to_terms(self, individual: Individual) -> Terms | None:
        """Return the terms of an individual; None if it has none or exceeds the limits."""
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
        """Return whether the summands of a tree, split at + and - from the root, repeat a term."""
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
        """Evaluate a tree in prefix order to a sum of products."""
        stack: list[Sum] = []
        # prefix order read backwards: the operands are on the stack before their operator
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
    """Genetic programming of an equation without intercept for each output.

    The state of a solution is that of an `ExpressionLibrary` with the prefix `library.`, and the
    coefficients of its terms [P, n] as `weights.values`.

    Args:
        config: settings of the search.
        extra_terms: additional candidates of the final selection per output, each a sequence of
            factors (function, channel, power); no additional candidates if empty.
    """

    def __init__(
        self, config: EquationSearchConfig, extra_terms: Sequence[Sequence[Factors]] = ()
    ) -> None:
        self.config = config
        self.extra_terms = extra_terms

    def _solve(self, data: EstimatorData) -> list[Solution]:
        x = to_dense(data.x)
        _, y, groups, names, outputs = data
        config = self.config
        n_outputs = y.shape[1]
        algebra = Algebra(names, expression_limits(config.evolution))
        values = x.numpy()
        target = y.numpy()
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
                # distinct seeds for all outputs of all runs
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
    """Return the products of factors that do not exceed the limits of the algebra."""
    products = []
    for factors in terms:
        with suppress(TooLargeError):
            products.append(algebra.make_product(factors))
    return tuple(products)


class EvolvedEquation(NamedTuple):
    """Equation of one output.

    Attributes:
        search_result: result of the genetic programming.
        products: terms of the equation.
        values: coefficients of the terms.
        standard_errors: standard errors of the coefficients.
        summary: diagnostics of the equation.
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
    """Search an equation, select its terms and fit it to all samples.

    Args:
        algebra: algebra of the channels with the limits of the search.
        data: channels [N] by name.
        target: target [N].
        is_training: mask of the training samples [N]; the others are for validation.
        config: settings of the search.
        seed: random seed.
        extra_products: additional candidates of the final selection.

    Raises:
        FitError: if the data do not determine an equation.
        UsageError: if DEAP is not installed.
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
    # the reduced problem sorts and removes candidates, so map its terms back to products
    products = tuple(candidate_terms[names.index(name)] for name in equation_fit.terms)
    coefficient_values = tuple(equation_fit.values.tolist())
    standard_errors = tuple(equation_fit.standard_errors.tolist())
    return EvolvedEquation(
        search_result, products, coefficient_values, standard_errors, equation_fit.summary(problem)
    )


def validation_mask(group: np.ndarray, group_interval: int) -> np.ndarray:
    """Return the mask of the validation samples [N]: the samples of every n-th group.

    Args:
        group: group number of each sample [N].
        group_interval: number n. With fewer than n groups, `VALIDATION_BLOCKS` blocks of the record
            are used instead.
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
