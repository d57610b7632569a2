"""Interfaces shared by all export formats: exported step, model card, writer and parity.

A vessel model, a heading policy, a course policy and a feed-forward are all exported as a step with
fixed arguments that is called once per `dt` and receives and returns the memory. In every format a
bad input yields a flag and a finite output, and the next good sample recovers.

The methods of an exported vessel model, with batch size B in all tensors:

- `initial_state(batch) -> s`: memory [B, n_state] without a measured past (zeros).
- `warmup(y_history, w_history) -> s`: memory after a measured past with states [B, T, nx] and
  inputs [B, T, m], oldest first. Invalid samples are skipped.
- `step(x, w, s) -> (x, s, outside)`: state [B, nx], memory and flag [B] after one step `dt`.
- `rollout(x0, w, s) -> (x, s, outside)`: states [B, T+1, nx] from x0 under inputs w [B, T, m],
  memory after the last step, and flag of each step [B, T].
- `band(k) -> half widths` of the prediction bands of u, v, r, heading and position (and p, phi for
  a vessel with roll) k steps after a measured state. Formats without methods have the table in
  the metadata (model card) as `band`.

A controller has `initial_state(y) -> s` for the first measurement y, and `step`, which returns the
command, the memory and the flag `fault`. In a format without methods the memory is initialised with
NaN: the first step then returns the safe command and the flag.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar, final

import numpy as np
import numpy.typing as npt
import torch
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, select_autoescape
from torch import nn

from residnet.core.errors import ExportError, WithheldError
from residnet.core.version import __version__
from residnet.evaluation.assessment import Assessment

if TYPE_CHECKING:
    from residnet.dynamics.store import ModelSpec

NumberArray = npt.NDArray[Any]
SINGLE_TOLERANCE = 1e-5
"""Largest difference in single precision, relative to the range of a channel."""
DOUBLE_TOLERANCE = 1e-12
"""Largest difference in double precision, relative to the range of a channel."""
Attempt = TypeVar("Attempt")


class RoundingError(ExportError):
    """The exported file differs from the model by rounding errors, which grow along the run."""


class LoadedExport(ABC):
    """An exported file that was loaded again; arrays have one row.

    Attributes:
        reorders_sums: whether sums are computed in another order than in torch, so that rounding
            errors may grow.
    """

    reorders_sums: bool = True

    @abstractmethod
    def step(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        """Evaluate the exported step; the results are in the order of `Exportable.results`."""

    def step_rows(self, *step_arguments: NumberArray) -> tuple[Any, ...]:
        """Return the results of one step of many rows."""
        results = zip(
            *(self.step(*row_arguments) for row_arguments in zip(*step_arguments, strict=True)),
            strict=True,
        )
        return tuple(map(np.stack, results))

    def initial_memory(self, *measured_past: NumberArray) -> NumberArray | None:
        """Return the memory after a measured past; None for a format that has only steps.

        Args:
            measured_past: states [T, nx] and inputs [T, m] for a vessel, the first measurement for
                a controller.
        """
        return None

    def rollout(self, *rollout_arguments: NumberArray) -> NumberArray | None:
        """Return the states of a free run of one row; None for a format that has only steps."""
        return None


class Exportable(ABC):
    """An exportable step with its model card and the parity check of an exported file.

    Attributes:
        name: name of the model or policy.
        label: kind and name, for messages.
        dt: time step in s; None for a static map.
        arguments: names and sizes of the arguments of a step; the memory, if any, is last.
        results: names of the results of a step.
        flags: names of the Boolean results, which are last.
        precisions: precisions to try, in this order.
        methods: methods of the module of `build_module` in addition to `forward`.
        objections: reasons against its use, written into the model card; see `require_releasable`.
        assessment: verdict, data findings and log split of its run for the model card; None if it
            is exported without a run folder.
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
        """Check that all parameters are finite.

        Raises:
            ExportError: if a number is not finite; names the first one.
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
        """Return the model card entries of this kind of exportable."""

    @final
    def build_card(self) -> dict[str, Any]:
        """Return the model card, without format, precision and parity."""
        return {**self.card_contents(), **self.provenance()}

    @final
    def provenance(self) -> dict[str, Any]:
        """Return the model card entries common to all formats: build, objections and assessment."""
        assessment = Assessment() if self.assessment is None else self.assessment
        return {
            "build": self.build(),
            "objections": list(self.objections),
            **assessment.model_dump(mode="json"),
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
        # not from the TorchScript module: numbers in a trace have no names
        module = self.build_step_module(self.precisions[-1])
        tensors = {**dict(module.named_parameters()), **dict(module.named_buffers())}
        for name, value in sorted(tensors.items()):
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
        """Check the parity of an exported file and return the entries of the model card on it.

        Args:
            tolerance: largest allowed difference; None for the default of the precision.

        Raises:
            RoundingError: if the results depend on rounding in this precision.
            ExportError: if the file or the exported model is wrong for another reason.
        """


class Exporter(ABC):
    """A format, found by its name.

    Another package adds one with an entry point in the group `residnet.exporters` that leads to a
    subclass without arguments.

    Attributes:
        name: name in `residnet export --format`.
        suffix: suffix of the file name after the name of the model, for example `.pt`.
        about: one line for `residnet list formats`.
        default_name_from_run: whether the default file name is the name of the run, because it
            becomes part of symbols that must be unique in a program.
        is_for_microcontrollers: whether code size and memory decide if a model can be used.
    """

    name: ClassVar[str]
    suffix: ClassVar[str]
    about: ClassVar[str]
    default_name_from_run: ClassVar[bool] = False
    is_for_microcontrollers: ClassVar[bool] = False

    def supports(self, spec: ModelSpec) -> bool:
        """Return whether the format can hold a model; otherwise another one is proposed."""
        return True

    @abstractmethod
    def export(self, exported: Exportable, file: Path) -> Mapping[str, Any]:
        """Write a model or a policy after a parity check and return its model card.

        Args:
            exported: for example a `residnet.export.vessel.ExportedVessel`.
            file: path of the file; its folder is created if necessary.

        Raises:
            UsageError: if the format does not support this kind of exportable.
            ExportError: if the written file does not reproduce the exportable.
        """


Made = TypeVar("Made", bound=Exportable)


def require_releasable(
    exported: Made, objections: Sequence[str], *, allows_objections: bool
) -> Made:
    """Return the exportable with all objections in its model card, if it may be released.

    Args:
        objections: reasons against its use, without full stops: it is worse than constant velocity,
            than the believed model or than the classical law.
        allows_objections: export despite objections.

    Raises:
        WithheldError: if there are objections and `allows_objections` is false.
    """
    exported.objections = tuple(objections)
    if objections and not allows_objections:
        raise WithheldError(
            f"{exported.label} is withheld: {'; '.join(objections)}; `residnet export --anyway`"
            " exports it, and its card lists the objections"
        )
    return exported


def run_in_sufficient_precision(
    exported: Exportable, attempt: Callable[[torch.dtype], Attempt]
) -> tuple[torch.dtype, Attempt]:
    """Return the first precision in which rounding has no effect, and the result of the attempt."""
    for dtype in exported.precisions[:-1]:
        try:
            return dtype, attempt(dtype)
        except RoundingError:
            continue
    return exported.precisions[-1], attempt(exported.precisions[-1])


def get_dtype_name(dtype: torch.dtype) -> str:
    """Return the name of a precision in model cards."""
    return "float64" if dtype == torch.float64 else "float32"


def render_template(template: str, **values: Any) -> str:
    """Return a text file of a format, filled in; values are escaped in XML."""
    return _load_template(template).render(values)


@cache
def _load_template(template: str) -> Template:
    """Compile a template once per process."""
    environment = Environment(
        loader=PackageLoader("residnet", "export"),
        undefined=StrictUndefined,
        autoescape=select_autoescape(("xml.jinja",)),
        trim_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(f"{template}.jinja")


def write_card(file: Path, card: Mapping[str, Any]) -> None:
    """Write the model card of an exported file; its folder is created if necessary."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.with_suffix(".card.json").write_text(json.dumps(card, indent=1) + "\n")
