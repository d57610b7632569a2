"""Sources of inputs that simulate several manoeuvres in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, final

import torch
from torch import Tensor

from residnet.engine.rollout import Source
from residnet.physics.environment import IrregularWaves
from residnet.physics.plant import Plant

if TYPE_CHECKING:
    from residnet.manoeuvres.base import BatchValues, ClosedLoopManoeuvre, Helm


def replace_commands(command: Tensor, w: Tensor) -> Tensor:
    """Return the inputs [B, m] with their first columns replaced by commands [B, c]."""
    return torch.cat((command, w[:, command.shape[-1] :]), dim=-1)


@final
class ScheduleSource(Source):
    """A source of precomputed open-loop commands [B, T, c]."""

    def __init__(self, commands: Tensor) -> None:
        super().__init__()
        self.commands = commands

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        return replace_commands(self.commands[:, k].to(w.dtype), w), memory


@final
class ClosedLoopSource(Source):
    """Closed-loop manoeuvres of one kind, one for each row of a batch."""

    def __init__(self, manoeuvres: Sequence[ClosedLoopManoeuvre], helm: Helm, t: Tensor) -> None:
        super().__init__()
        self.manoeuvre_type = type(manoeuvres[0])
        manoeuvre_parameters = [manoeuvre.law_parameters(helm) for manoeuvre in manoeuvres]
        self.batch_parameters: BatchValues = {
            # lists of different length, such as the angles of spirals, are padded
            name: torch.nn.utils.rnn.pad_sequence(
                [torch.tensor(row[name], dtype=torch.float64) for row in manoeuvre_parameters],
                batch_first=True,
            )
            if isinstance(manoeuvre_parameters[0][name], list)
            else torch.tensor([row[name] for row in manoeuvre_parameters], dtype=torch.float64)
            for name in manoeuvre_parameters[0]
        }
        self.batch_parameters["dt"] = t[1] - t[0]
        self.state_columns = {
            name: helm.state_column(name) for name in self.manoeuvre_type.observed_states
        }
        self.demand_commands = helm.commands_for
        self.times = t.tolist()
        self.can_stop = any(manoeuvre.end_condition is not None for manoeuvre in manoeuvres)

    def initial(self, x: Tensor) -> Tensor:
        return self.manoeuvre_type.initial_memory(*self._observe(x))

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m]; conditions are evaluated at the start of the step."""
        motion, parameters = self._observe(x)
        *demands, memory = self.manoeuvre_type.step_law(motion, parameters, self.times[k], memory)
        return replace_commands(self.demand_commands(*demands), w), memory

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return whether the manoeuvre of each row has ended, [B] bool."""
        return self.manoeuvre_type.has_ended(*self._observe(x), self.times[k], memory)

    def _observe(self, x: Tensor) -> tuple[BatchValues, BatchValues]:
        """Return the observed states, and the parameters in the precision of the states."""
        motion = {name: x[:, column] for name, column in self.state_columns.items()}
        return motion, {name: value.to(x.dtype) for name, value in self.batch_parameters.items()}


@final
class StackedSource(Source):
    """Manoeuvres of several kinds in one batch; each source controls a block of rows."""

    def __init__(self, sources: Sequence[Source], rows: Sequence[int]) -> None:
        super().__init__()
        self.sources: Sequence[Source] = torch.nn.ModuleList(sources)  # type: ignore[assignment]
        self.row_counts = list(rows)
        self.widths = [0] * len(self.row_counts)
        self.can_stop = any(source.can_stop for source in sources)

    def initial(self, x: Tensor) -> Tensor:
        """Return the memories of all sources, padded to the widest, [B, k]."""
        blocks = zip(self.sources, x.split(self.row_counts), strict=True)
        memories = [source.initial(block) for source, block in blocks]
        # a rollout has one memory tensor: narrower memories are padded
        self.widths = [memory.shape[1] for memory in memories]
        return torch.cat([self._pad_memory(memory, max(self.widths)) for memory in memories])

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m], each block of rows from its source."""
        inputs = []
        memories = []
        for source, x_block, w_block, memory_block in zip(
            self.sources,
            x.split(self.row_counts),
            w.split(self.row_counts),
            self._split_memory(memory),
            strict=True,
        ):
            source_inputs, next_memory = source(x_block, w_block, k, memory_block)
            inputs.append(source_inputs)
            memories.append(self._pad_memory(next_memory, memory.shape[1]))
        return torch.cat(inputs), torch.cat(memories)

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return which rows [B] have finished, each block of rows by its source."""
        blocks = zip(
            self.sources, x.split(self.row_counts), self._split_memory(memory), strict=True
        )
        return torch.cat(
            [
                source.is_finished(x_block, k, memory_block)
                for source, x_block, memory_block in blocks
            ]
        )

    @staticmethod
    def _pad_memory(memory: Tensor, width: int) -> Tensor:
        return torch.nn.functional.pad(memory, (0, width - memory.shape[1]))

    def _split_memory(self, memory: Tensor) -> list[Tensor]:
        blocks = zip(memory.split(self.row_counts), self.widths, strict=True)
        return [block[:, :width] for block, width in blocks]


@final
class StopRecorder(Source):
    """A source that records the step at which each row stopped.

    `stop_step` [B] is the number of this step; -1 for a row that did not stop.
    """

    def __init__(self, source: Source, rows: int) -> None:
        super().__init__()
        self.source = source
        self.can_stop = source.can_stop
        self.stop_step = torch.full((rows,), -1)

    def initial(self, x: Tensor) -> Tensor:
        self.stop_step = torch.full((x.shape[0],), -1)
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        inputs_and_memory: tuple[Tensor, Tensor] = self.source(x, w, k, memory)
        return inputs_and_memory

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        """Return the rows that have stopped now or before."""
        # only the first stop counts, since the rollout continues for the other rows
        stops_now = self.source.is_finished(x, k, memory) & (self.stop_step < 0)
        self.stop_step = torch.where(stops_now, k, self.stop_step)
        return self.stop_step >= 0


@final
class RecordedSource(Source):
    """A source of prescribed inputs [B, T, m]; NaN entries are taken from the environment."""

    def __init__(self, values: Tensor) -> None:
        super().__init__()
        self.values = values

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        recorded_inputs = self.values[:, k].to(w.dtype)
        return torch.where(torch.isnan(recorded_inputs), w, recorded_inputs), memory


@final
class WaveForceSource(Source):
    """A source that adds wave forces to the inputs of another source.

    The forces are those at the position of the vessel at the start of each step, constant over it.
    """

    def __init__(self, source: Source, waves: IrregularWaves, plant: Plant, dt: float) -> None:
        super().__init__()
        self.source = source
        self.waves = waves
        self.dt = dt
        self.can_stop = source.can_stop
        self.pose_columns = [plant.state_names.index(name) for name in ("x", "y", "psi")]
        axis_names = ("force_x", "force_y", "force_k", "force_n")
        available_axes = [name for name in axis_names if name in plant.input_names]
        force_matrix = torch.zeros(len(axis_names), len(plant.input_names), dtype=torch.float64)
        for name in available_axes:
            force_matrix[axis_names.index(name), plant.input_names.index(name)] = 1.0
        self.register_buffer("force_matrix", force_matrix, persistent=False)
        self.force_matrix: Tensor

    def initial(self, x: Tensor) -> Tensor:
        return self.source.initial(x)

    def forward(self, x: Tensor, w: Tensor, k: int, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the inputs [B, m] with the force of the waves at the time of step k."""
        inputs, memory = self.source(x, w, k, memory)
        force = self.waves(
            x[:, self.pose_columns[0]],
            x[:, self.pose_columns[1]],
            x[:, self.pose_columns[2]],
            k * self.dt,
        )
        return inputs + (force @ self.force_matrix).to(inputs.dtype), memory

    def is_finished(self, x: Tensor, k: int, memory: Tensor) -> Tensor:
        return self.source.is_finished(x, k, memory)
