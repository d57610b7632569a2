"""Where the trials of a sweep run: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from typing import Annotated, Any, Literal

from pydantic import Field

from residnet.core.config import Config
from residnet.core.errors import FitError, MissingPackageError
from residnet.core.processes import ThisProcess, processes, spread


class ProcessesConfig(Config):
    """Processes of this machine, side by side.

    Attributes:
        kind: of the runner.
        workers: number of processes; null for as many as there are cores. One works without a
            process of its own.
    """

    kind: Literal["processes"] = "processes"
    workers: int | None = Field(default=None, ge=1, le=1_024)

    def check(self) -> None:
        """Check nothing: processes need no package."""

    @property
    def side_by_side(self) -> int:
        """Return how many trials run at a time."""
        if self.workers is not None:
            return self.workers
        from joblib import cpu_count

        return int(cpu_count())

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """Hold the processes; an interruption ends them all at once. One worker is this process.

        Raises:
            FitError: where the system ends one of them.
        """
        if self.side_by_side == 1:
            with spread(1):
                yield ThisProcess()
            return
        with processes(self.side_by_side) as pool:
            yield pool


class RayConfig(Config):
    """Tasks of a Ray cluster, or of Ray on this machine.

    The run folder must lie where every node sees it under the same path.

    Attributes:
        kind: of the runner.
        workers: trials at a time.
        address: of the cluster, for example `auto` on one of its nodes; null starts Ray on this
            machine.
        cpus: cores that a trial takes.
        gpus: share of a GPU that a trial takes.
    """

    kind: Literal["ray"]
    workers: int = Field(ge=1, le=100_000)
    address: str | None = None
    cpus: float = Field(default=1.0, gt=0)
    gpus: float = Field(default=0.0, ge=0)

    def check(self) -> None:
        """Check that Ray is installed.

        Raises:
            MissingPackageError: where it is not.
        """
        if importlib.util.find_spec("ray") is None:
            raise MissingPackageError(
                "runner.kind: ray needs the package ray; install it with: pip install"
                " 'residnet[ray]'"
            )

    @property
    def side_by_side(self) -> int:
        """Return how many trials run at a time."""
        return self.workers

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """Hold a connection to Ray, whose processes end with this one.

        Raises:
            FitError: where the cluster cannot be reached or ends a process.
        """
        self.check()
        import ray

        try:
            ray.init(
                address=self.address,
                # a cluster has cores of its own
                num_cpus=None if self.address else max(round(self.workers * self.cpus), 1),
                include_dashboard=None if self.address else False,
                log_to_driver=False,
                configure_logging=False,
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise FitError(f"runner.address: Ray cannot be reached ({error})") from error
        try:
            yield _RayExecutor(ray, self.cpus, self.gpus)
        except ray.exceptions.RayError as error:
            raise FitError(
                f"runner: Ray has ended a trial ({str(error).splitlines()[0]}); continue with"
                " --resume"
            ) from error
        finally:
            ray.shutdown()


class _RayExecutor(Executor):
    """An executor whose work runs as Ray tasks."""

    def __init__(self, ray: Any, cpus: float, gpus: float) -> None:
        self._wrap = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=0)

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Hand work to Ray; returns its future."""
        found: Future[Any] = self._wrap(work).remote(*args, **kwargs).future()
        return found


RunnerConfig = Annotated[ProcessesConfig | RayConfig, Field(discriminator="kind")]
