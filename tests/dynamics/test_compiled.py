"""A closed loop in compiled C: its flights and its gradient are those of torch."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from residnet.core.errors import ExportError
from residnet.core.processes import worker_limit
from residnet.dynamics.base import Dynamics
from residnet.engine import c_code, rollout_source
from residnet.engine.compiled import CompiledRollout, _clip_row_gradients
from residnet.engine.rollout import Rollout, Source

DT = 0.1


class Boat(Dynamics):
    """A vessel that uses what gradients find hard: places used twice, bends, saturations."""

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        twice = x[:, [0, 1, 1]]
        bent = torch.atan2(twice[:, :1], 1.0 + twice[:, 1:2].square())
        drag = torch.where(x[:, :1] > 0.1, x[:, :1].abs().sqrt(), x[:, :1])
        return torch.cat((p - drag - bent, torch.sin(twice[:, 2:]) + x[:, :1].sign() * p), dim=1)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return x + DT * self.state_derivative(x, w[:, :1], s), 0.9 * s + w[:, 1:2]


class Helm(Source):
    """A controller with weights, whose command arrives as many steps late as each row says."""

    def __init__(self, longest: int = 3) -> None:
        super().__init__()
        self.longest = longest
        self.mix = nn.Linear(3, 2)
        self.gain = nn.Parameter(torch.tensor(0.7))

    def initial(self, x: Tensor) -> Tensor:
        return torch.zeros(x.shape[0], self.longest + 1, dtype=x.dtype)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        error = torch.remainder(w[:, :1] - x[:, 1:2] + torch.pi, 2 * torch.pi) - torch.pi
        both = torch.tanh(self.mix(torch.cat((error, x), dim=1)))
        command = (torch.exp(self.gain) * both.sum(1, keepdim=True)).clamp(-1.0, 1.0)
        queue = torch.cat((command, memory[:, : self.longest]), dim=1)
        late = queue.gather(1, w[:, 1:2].to(torch.int64))
        kept = torch.cat((queue[:, : self.longest], both[:, 1:]), dim=1)
        return torch.cat((late, both[:, :1]), dim=1), kept


def loop(longest: int = 3) -> tuple[Rollout, tuple[Tensor, Tensor, Tensor]]:
    torch.manual_seed(2)
    rows = 21
    steps = 30
    wanted = 2.0 * torch.randn(rows, 1)
    late = (torch.arange(rows) % (longest + 1.0))[:, None]
    w = torch.stack((wanted.expand(-1, steps), late.expand(-1, steps)), dim=2)
    return Rollout(Boat(DT, "rk4"), Helm(longest)), (torch.randn(rows, 2), w, torch.zeros(rows, 1))


def assert_close_slopes(
    rollout: Rollout, fast: CompiledRollout, given: tuple[Tensor, Tensor, Tensor]
) -> None:
    weights = list(rollout.parameters())
    found, known = (
        torch.autograd.grad(x.square().mean() + w.sum() * 0.01, weights)
        for x, w, _ in (fast(*given), rollout(*given))
    )
    for one, other in zip(found, known, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize(
    ("longest", "most"), [(3, torch.inf), (3, 1e9), (40, torch.inf)], ids=["sum", "rows", "late"]
)
def test_flights_and_gradient_are_those_of_torch(longest: int, most: float) -> None:
    """Gradients are summed, or each row's is looked at before; commands may be 40 steps late."""
    rollout, given = loop(longest)
    fast = CompiledRollout(rollout, *given, max_gradient_ratio=most)
    for one, other in zip(fast(*given)[:2], rollout(*given)[:2], strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=2e-5)
    assert_close_slopes(rollout, fast, given)


def test_what_is_no_number_stays_so_and_subnormal_numbers_stay_numbers() -> None:
    rollout, (x, w, s) = loop()
    lost = x.clone()
    lost[3, 0], lost[5, 1] = torch.nan, torch.inf
    with torch.no_grad():
        fast = CompiledRollout(
            rollout, x, w, s, max_gradient_ratio=1e9
        )  # what flies alone has no gradient
        (found, *_), (wanted, *_) = fast(lost, w, s), rollout(lost, w, s)
    assert torch.equal(found.isfinite(), wanted.isfinite())
    assert not found[3].isfinite().all()
    # nor does a library change how the process computes
    assert float(torch.tensor(1e-310, dtype=torch.float64) * 0.5) == 5e-311


@pytest.mark.parametrize(
    ("dtype", "most", "close", "tiny"),
    [(torch.float32, 88.5, 4e-7, 1e-37), (torch.float64, 709.5, 1e-15, 1e-307)],
)
def test_functions_of_many_numbers_are_right_to_the_last_digits(
    dtype: torch.dtype, most: float, close: float, tiny: float
) -> None:
    functions = rollout_source._VECTOR_FUNCTIONS[dtype]
    source = rollout_source._write_prelude(dtype) + "".join(
        f"void each_{name}(const REAL *a, REAL *o, long n)"
        f" {{ for (long i = 0; i < n; i += LANES) *(U *)(o + i) = v_{name}(*(U *)(a + i)); }}\n"
        for name in functions
    )
    library = c_code.load_library(source)
    ends = [-torch.inf, -2.0 * most, -1.02 * most, 0.0, most + 1.0, torch.inf, torch.nan, -0.0]
    given = torch.cat(
        (
            torch.linspace(-most, most, 200_000, dtype=dtype),
            torch.linspace(-2.0, 2.0, 200_000, dtype=dtype),
            torch.logspace(-30.0, 0.0, 31_984, dtype=dtype),
            torch.tensor(2 * ends, dtype=dtype),
        )
    )
    for name in functions:
        found = torch.empty_like(given)
        wanted = getattr(torch, name)(given.double()).to(dtype)
        room = ctypes.c_void_p(given.data_ptr()), ctypes.c_void_p(found.data_ptr())
        library[f"each_{name}"](*room, ctypes.c_long(len(given)))
        torch.testing.assert_close(found, wanted, rtol=close, atol=tiny, equal_nan=True)


def test_the_number_of_threads_changes_nothing() -> None:
    rollout, given = loop()
    alone = CompiledRollout(rollout, *given)
    weights = list(rollout.parameters())
    one = torch.autograd.grad(alone(*given)[0].sum(), weights)
    with worker_limit(4):
        several = torch.autograd.grad(alone(*given)[0].sum(), weights)
    assert all(map(torch.equal, one, several))


class Cut(Helm):
    """A controller that does not answer for what it makes of its last command."""

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        held = memory[:, :1].detach()
        acting, memory = super().forward(x, w, k, memory)
        steep = (200.0 * (held - x[:, :1])).clamp(-1.0, 1.0) * self.gain.detach()
        return torch.cat((acting[:, :1] + 0.1 * steep, acting[:, 1:]), dim=1), memory


def test_what_a_loop_detaches_has_no_gradient_and_a_steep_one_is_compiled() -> None:
    rollout, given = loop()
    rollout.source = Cut()
    fast = CompiledRollout(rollout, *given)
    assert_close_slopes(rollout, fast, (given[0], given[1][:, :3], given[2]))


def test_a_missing_compiler_and_source_that_does_not_compile_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_CACHE", str(tmp_path))
    with pytest.raises(ExportError, match="does not compile"):
        c_code.load_library("int f(")
    assert not list(tmp_path.iterdir())
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.delenv("CC", raising=False)
    rollout, given = loop()
    with pytest.raises(ExportError, match="no C compiler"):
        CompiledRollout(rollout, *given)


SOURCE = "double twice(double x) { return 2.0 * x; }\n"


def called(library: ctypes.CDLL) -> float:
    library.twice.restype = ctypes.c_double
    found: float = library.twice(ctypes.c_double(1.5))
    return found


def test_the_same_source_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RESIDNET_CACHE", str(tmp_path / "kept"))
    calls: list[Path] = []
    compile_one = c_code._run_compiler

    def counted(tool: str, source: str, flags: Sequence[str], out: Path) -> None:
        calls.append(out)
        compile_one(tool, source, flags, out)

    monkeypatch.setattr(c_code, "_run_compiler", counted)
    assert [called(c_code.load_library(SOURCE)) for _ in range(2)] == [3.0, 3.0]
    assert len(calls) == 1
    c_code.load_library(SOURCE.replace("2.0", "4.0"))
    assert len(calls) == 2
    libraries = list((tmp_path / "kept" / "residnet-cache").glob("*.so"))
    assert len(libraries) == 2
    # a library that somebody edited is not loaded, and not replaced
    # a new file: the old one is mapped into this process
    libraries[0].unlink()
    libraries[0].write_bytes(b"mine")
    assert called(c_code.load_library(SOURCE)) == 3.0
    assert called(c_code.load_library(SOURCE.replace("2.0", "4.0"))) == 6.0
    assert libraries[0].read_bytes() == b"mine"
    assert len(calls) == 4
    # where nothing can be written, it is compiled each time
    monkeypatch.setenv("RESIDNET_CACHE", str(libraries[0] / "below"))
    assert called(c_code.load_library(SOURCE)) == 3.0
    assert len(calls) == 5


def test_the_cache_deletes_no_file_of_the_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_CACHE", str(tmp_path))
    monkeypatch.setattr(c_code, "_MAX_CACHED_LIBRARIES", 1)
    cache = tmp_path / "residnet-cache"
    cache.mkdir()
    mine = [folder / f"{n}.so" for folder in (tmp_path, cache) for n in range(5)]
    for number, file in enumerate(mine):
        file.write_text(str(number))
        os.utime(file, (number, number))
    for factor in ("2.0", "4.0", "8.0"):
        c_code.load_library(SOURCE.replace("2.0", factor))
    assert [file.read_text() for file in mine] == [str(number) for number in range(10)]
    assert len(set(cache.glob("*.so")) - set(mine)) == 1


def test_a_flight_whose_gradient_explodes_does_not_drown_the_others() -> None:
    gradients = torch.tensor([[1.0, 0.0], [0.0, 2.0], [3e9, 4e9], [torch.inf, 0.0], [6.0, 8.0]])
    asked = torch.tensor([1.0, 1.0, 1.0, 1.0, 4.0])
    held = _clip_row_gradients(gradients, asked, 2.0)
    # the median row has 2.5 times what was asked of it
    assert torch.allclose(held[2], torch.tensor([3.0, 4.0]))
    assert torch.equal(held[3], torch.zeros(2))
    for row in (0, 1, 4):
        assert torch.equal(held[row], gradients[row])
