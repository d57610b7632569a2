"""Evaluation of named regressors on tensors of channels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from residnet.physics.terms import Factor, parse_term


class TermLibrary(nn.Module):
    """Computes the values [..., J] of J terms from channels [..., nz].

    Every term is a product of columns of [1, z, |z|, 1/z, functions of z], gathered by index, so
    that the number of tensor operations is the maximum number of factors instead of the number of
    terms. 1/z and functions are computed only for the channels that need them.
    """

    def __init__(self, terms: Sequence[str], names: Sequence[str]) -> None:
        super().__init__()
        self.terms = tuple(terms)
        parsed_terms = [parse_term(term, names) for term in terms]
        channel_keys = [
            (name, is_magnitude, "") for is_magnitude in (False, True) for name in names
        ]
        function_keys = {
            (parsed_factor.name, parsed_factor.function or "1/")
            for factors in parsed_terms
            for parsed_factor in factors
            if parsed_factor.function or parsed_factor.power < 0
        }
        # columns are 1, z, |z|, then functions and reciprocals; the key is (channel, magnitude,
        # function)
        column_of_key = {key: i + 1 for i, key in enumerate(channel_keys)}
        # the first entry is a placeholder: TorchScript takes no empty list
        self.function_columns = [("", 0)]
        for name, function in sorted(function_keys):
            column_of_key[name, False, function] = len(column_of_key) + 1
            self.function_columns.append((function, names.index(name)))
        columns = [
            [index for factor in factors for index in _factor_columns(factor, column_of_key)]
            for factors in parsed_terms
        ]
        self.n_terms = len(columns)
        self.max_factors = max([len(factor_columns) for factor_columns in columns], default=0)
        # column 0 is the constant 1: it fills terms with fewer factors
        padded_columns = [
            factor_columns + [0] * (self.max_factors - len(factor_columns))
            for factor_columns in columns
        ]
        factor_index = (
            torch.tensor(padded_columns, dtype=torch.long).reshape(self.n_terms, self.max_factors).T
        )
        self.factor_index = nn.Buffer(factor_index.contiguous(), persistent=False)
        # if every term is one channel, an index select replaces the products
        self.is_linear = self.n_terms > 0 and all(
            len(factor_columns) == 1 and 0 < factor_columns[0] <= len(names)
            for factor_columns in columns
        )
        channel_index = factor_index[0] - 1 if self.is_linear else factor_index.new_zeros(0)
        self.channel_index = nn.Buffer(channel_index, persistent=False)
        self.is_identity = self.is_linear and channel_index.tolist() == list(range(len(names)))

    def forward(self, z: Tensor) -> Tensor:
        """Compute the terms [..., J] at channels z [..., nz]."""
        if self.is_linear:
            return z if self.is_identity else z.index_select(-1, self.channel_index)
        if self.max_factors == 0:
            # constants need no channel
            return z.new_ones(z.shape[:-1] + (self.n_terms,))  # noqa: RUF005 (TorchScript)
        columns = [torch.ones_like(z[..., :1]), z, z.abs()]
        for function, channel in self.function_columns:
            if function != "":
                columns.append(_evaluate_function(function, z.narrow(-1, channel, 1)))
        column_values = torch.cat(columns, dim=-1)
        values = column_values.index_select(-1, self.factor_index[0])
        for d in range(1, self.max_factors):
            values = values * column_values.index_select(-1, self.factor_index[d])
        return values


def _evaluate_function(name: str, x: Tensor) -> Tensor:
    """Evaluate one of `TERM_FUNCTIONS`, or 1/x, any shape."""
    if name == "sin":
        return torch.sin(x)
    if name == "cos":
        return torch.cos(x)
    # the clamp keeps the derivative of the root finite at zero, where it would be infinite
    if name == "sqrt":
        return torch.sqrt(x.abs().clamp(min=1e-24))
    if name == "ssqrt":
        return x.sign() * torch.sqrt(x.abs().clamp(min=1e-24))
    if name == "inv":
        # the inner where avoids 1/0, whose infinite gradient the outer where could not remove
        return torch.where(x == 0, x, torch.where(x == 0, torch.ones_like(x), x).reciprocal())
    return x.reciprocal()


def _factor_columns(
    factor: Factor, column_of_key: Mapping[tuple[str, bool, str], int]
) -> list[int]:
    """Return the indices of the columns whose product is the factor."""
    if factor.power > 0:
        return [column_of_key[factor.name, factor.magnitude, factor.function]] * factor.power
    inverse_column = column_of_key[factor.name, False, "1/"]
    # 1/|z| = |z| / z^2
    magnitude_columns = (
        [column_of_key[factor.name, True, ""], inverse_column] if factor.magnitude else []
    )
    return [*magnitude_columns, inverse_column] * -factor.power
