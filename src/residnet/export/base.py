"""What every export format shares: what is exported, how it is written, how it is checked.

A vessel, a heading policy, a policy along a course and a feed-forward are one kind of thing here:
a step of fixed arguments, called once per `dt`, with the memory passed in and out. Whatever the
format, a bad input gives a flag and a finite output, and the next good sample recovers.

A stepped vessel keeps this contract, with batches of rows B in all tensors:

- `initial_state(batch) -> s`: the memory [B, n_state] without a past, zeros.
- `warmup(y_history, w_history) -> s`: the memory that a measured past leaves, states [B, T, nx] and
  inputs [B, T, m], oldest first. A sample that is no measurement is left out.
- `step(x, w, s) -> (x, s, outside)`: state [B, nx], memory and flag [B] one step of `dt` later.
- `rollout(x0, w, s) -> (x, s, outside)`: states [B, T+1, nx] from x0 on under inputs w [B, T, m],
  the memory after the last step, and the flag of each step [B, T].
- `band(k) -> half widths` of u, v, r, heading and position, then of p and phi where the vessel
  rolls, k steps after a measured state, where a format has methods; the table that it reads stands
  in every card as `band`.

A controller has `initial_state(y) -> s` at the first measurement y, and `step`, which gives the
command, the memory and the flag `fault`. A format without methods starts it with a memory that is
no number: its first answer is the safe command, with the flag.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar, final

import numpy as np
import numpy.typing as npt
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from torch import nn

from residnet.core.errors import ExportError, WithheldError
from residnet.core.version import __version__
from residnet.evaluation.assessment import Assessment

NumberArray = npt.NDArray[Any]
SINGLE_TOLERANCE, DOUBLE_TOLERANCE = 1e-5, 1e-12
"""Largest difference in each precision, as a share of a channel's range."""
Attempt = TypeVar("Attempt")


class RoundingError(ExportError):
    """A file that rounds otherwise than what it was made of, and ends elsewhere for that alone."""


class LoadedExport(ABC):
    """A file that was written, loaded back; arrays of one row.

    Attributes:
        reorders_sums: whether it adds up in another order than torch, so that rounding may grow.
    """

    reorders_sums: bool = True

    @abstractmethod
    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        """Return the results of one step."""

    def step_rows(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        """Return the results of one step of many rows."""
        results = zip(
            *(self.step(*row_arguments) for row_arguments in zip(*step_arguments, strict=True)),
            strict=True,
        )
        return tuple(map(np.stack, results))

    def initial_memory(self, *measured_past: NumberArray) -> NumberArray | None:
        """Return the memory that a past leaves; None where the format has only steps.

        It is measured states [T, nx] and inputs [T, m] of a vessel, and the first measurement of a
        controller.
        """
        return None

    def rollout(self, *rollout_arguments: NumberArray) -> NumberArray | None:
        """Return the states of a free run of one row; None where the format has only steps."""
        return None


class Exportable(ABC):
    """What is exported: a step, what its card says, and how a file of it is checked.

    Attributes:
        name: of the model or policy.
        label: it is, with its name, for messages.
        dt: step in s; None where there is none.
        arguments: names and sizes of what a step takes; the memory stands last where there is any.
        results: names of what a step gives.
        flags: those of them that are truth values; they stand last.
        precisions: that are tried, one after the other.
        methods: of `build_module`, beside `forward`.
        objections: sentences on what speaks against its use, for the card; see `require_releasable`.
        assessment: what its run says of it and of its logs, for the card; None where it is exported
            without a run folder.
    """

    name: str
    label: str
    dt: float | None
    arguments: Sequence[tuple[str, int]]
    results: Sequence[str]
    flags: Sequence[str]
    precisions: Sequence[torch.dtype] = (torch.float32, torch.float64)
    methods: Sequence[str] = ()
    objections: Sequence[str] = ()
    assessment: Assessment | None = None

    def require_finite_numbers(self) -> None:  # noqa: B027 (policies are built from finite numbers)
        """Refuse what holds numbers that are not finite.

        Raises:
            ExportError: that names the first such number.
        """

    @abstractmethod
    def build_module(self, dtype: torch.dtype) -> nn.Module:
        """Return the module of the TorchScript file, in evaluation mode.

        Its `forward` is the step, of batches.
        """

    @abstractmethod
    def build_step_module(self, dtype: torch.dtype) -> nn.Module:
        """Return a module whose `forward` is the step, without checks of shapes."""

    def build_initial_state(self, dtype: torch.dtype) -> nn.Module | None:
        """Return the module that maps the first measurement to the memory; None for a zero memory.

        A controller has one: exported C then holds a function `initial_state`.
        """
        return None

    @abstractmethod
    def card_contents(self) -> dict[str, Any]:
        """Return what the card says of this kind of thing."""

    @final
    def build_card(self) -> dict[str, Any]:
        """Return the card, without format, precision and parity."""
        return {**self.card_contents(), **self.provenance()}

    @final
    def provenance(self) -> dict[str, Any]:
        """Return what the card of every format says: build, objections and assessment."""
        assessment = Assessment() if self.assessment is None else self.assessment
        return {
            "build": self.build(),
            "objections": list(self.objections),
            **assessment.content(),
        }

    @final
    def build(self) -> dict[str, str]:
        """Return the build identity: the same model under the same version has the same one.

        `model_sha256` covers all parameters, buffers and settings, and neither the time of the
        export nor the errors that were measured on logs.
        """
        digest = hashlib.sha256()
        settings = {
            key: value
            for key, value in self.card_contents().items()
            if key not in ("exported", "metrics", "versions")
        }
        digest.update(json.dumps(settings, sort_keys=True, default=str).encode())
        # a module of TorchScript may be a trace, whose numbers have no names
        module = self.build_step_module(self.precisions[-1])
        numbers = {**dict(module.named_parameters()), **dict(module.named_buffers())}
        for name, value in sorted(numbers.items()):
            digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
            digest.update(value.detach().cpu().contiguous().numpy().tobytes())
        model = digest.hexdigest()
        return {
            "identity": f"{__version__}+{model[:16]}",
            "residnet": __version__,
            "model_sha256": model,
        }

    @abstractmethod
    def check_parity(
        self, loaded: LoadedExport, subject: str, dtype: torch.dtype, tolerance: float | None = None
    ) -> dict[str, Any]:
        """Return what the card says of the parity, once a file answers as it must.

        Args:
            tolerance: largest difference; None for what the precision allows.

        Raises:
            RoundingError: where the precision does not determine the answers.
            ExportError: where the file is wrong otherwise, or what was exported is.
        """


class Exporter(ABC):
    """A format, found by its name.

    Another package adds one with an entry point in the group `residnet.exporters` that leads to a
    subclass without arguments.

    Attributes:
        name: what `residnet export --format` knows it by.
        suffix: what follows the model's name in the file's name, for example `.pt`.
        about: one line for `residnet list formats`.
        default_name_from_run: whether a file that is not named takes the name of its run, because
            the file's name becomes part of symbols that must be unique in a program.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    about: ClassVar[str]
    default_name_from_run: ClassVar[bool] = False

    @abstractmethod
    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write a model or a policy, after a parity check, and return what its card says.

        Args:
            exported: for example `residnet.export.vessel.ExportedVessel`, with the attributes
                `spec`, `model` and `metrics`.
            file: where to write; its folder may not exist yet.

        Raises:
            UsageError: where the format cannot hold such a thing.
            ExportError: where what was written does not reproduce it.
        """


Made = TypeVar("Made", bound=Exportable)


def require_releasable(
    exported: Made, objections: Sequence[str], *, allows_objections: bool
) -> Made:
    """Return what may be exported, with all that speaks against it in its card.

    Args:
        objections: sentences without a full stop on why one should do without it: it is worse than
            `zero`, than the believed model or than the law that it stands beside.
        allows_objections: whether it is wanted all the same.

    Raises:
        WithheldError: where something speaks against it, and it is not wanted all the same.
    """
    exported.objections = tuple(objections)
    if objections and not allows_objections:
        raise WithheldError(
            f"{exported.label} is withheld: {'; '.join(objections)}; `residnet export --anyway`"
            " writes it all the same, and its card says so"
        )
    return exported


def run_in_sufficient_precision(
    exported: Exportable, attempt: Callable[[torch.dtype], Attempt]
) -> tuple[torch.dtype, Attempt]:
    """Return the first precision that determines the answers, and what an attempt gave in it."""
    for dtype in exported.precisions[:-1]:
        try:
            return dtype, attempt(dtype)
        except RoundingError:
            continue
    return exported.precisions[-1], attempt(exported.precisions[-1])


def get_dtype_name(dtype: torch.dtype) -> str:
    """Return a precision as cards name it."""
    return "float64" if dtype == torch.float64 else "float32"


def render_template(template: str, **values: Any) -> str:
    """Return a text file of a format, filled in; values are escaped in XML."""
    environment = Environment(
        loader=PackageLoader("residnet", "export"),
        undefined=StrictUndefined,
        autoescape=select_autoescape(("xml.jinja",)),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(f"{template}.jinja").render(values)


def write_card(file: Path, card: Mapping[str, Any]) -> None:
    """Write a card beside its file, in a folder that may not exist yet."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")
