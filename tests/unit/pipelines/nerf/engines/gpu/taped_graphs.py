"""A stand-in for CUDA graphs on a CPU: operations are noted while they are recorded, then repeated.

What a CUDA graph does to a training step, these do too. Numbers of Python are as they were when the
step was recorded; tensors are the very ones that were there then, with what is in them now.
Recording does nothing. A replay draws new random numbers. And what a graph makes lies in memory
that all graphs of a recorder share: it is spoiled before another one runs, and reading what another
graph made is an error, as is to ask for a value.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

SPOILED_INTEGER = 77


def tensors_of(values: Any) -> list[Tensor]:
    return [item for item in tree_leaves(values) if isinstance(item, Tensor)]


def memory_of(values: Tensor) -> int:
    """What two tensors have in common that share their memory."""
    return values.untyped_storage().data_ptr()


def written_by(func: Any, args: Any, kwargs: Any) -> Iterator[Tensor]:
    """The arguments that an operation changes."""
    for place, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            given = args[place] if place < len(args) else kwargs.get(argument.name)
            yield from tensors_of(given)


@dataclass
class Tape:
    """One recorded graph.

    entries: operations with their arguments and results. made: what they made, by its memory.
    """

    owner: TapedGraphs
    entries: list[tuple[Any, Any, Any, Any]] = field(default_factory=list)
    made: dict[int, Tensor] = field(default_factory=dict)

    @torch.no_grad()
    def replay(self) -> None:
        for tape in self.owner.tapes:
            tape.spoil()
        for func, args, kwargs, results in self.entries:
            again = func(*args, **kwargs)
            if not func._schema.is_mutable:
                for old, new in zip(tensors_of(results), tensors_of(again), strict=True):
                    old.detach().copy_(new)
        self.owner.replays += 1

    def spoil(self) -> None:
        """Another graph, or this one anew, writes into this memory."""
        for values in self.made.values():
            values.fill_(math.nan if values.is_floating_point() else SPOILED_INTEGER)


class _Recording(TorchDispatchMode):
    """Notes operations, and what must be put back when they have been noted."""

    def __init__(self, tape: Tape) -> None:
        super().__init__()
        self._tape = tape
        self._before: dict[int, tuple[Tensor, Tensor]] = {}
        self._random: dict[int, tuple[torch.Generator, Tensor]] = {}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, made = kwargs or {}, self._tape.made
        assert func.overloadpacket.__name__ != "_local_scalar_dense", "a value was asked for"
        inputs = tensors_of((args, kwargs))
        for tape in self._tape.owner.tapes:
            foreign = {memory_of(each) for each in inputs} & tape.made.keys()
            assert not foreign, f"{func} reads what another graph made"
        for each in written_by(func, args, kwargs):
            memory = memory_of(each)
            if memory not in made and memory not in self._before:
                whole = torch.as_strided(each.detach(), *_whole(each))
                self._before[memory] = (whole, whole.clone())
        for item in tree_leaves((args, kwargs)):
            if isinstance(item, torch.Generator):
                self._random.setdefault(id(item), (item, item.get_state()))
        results = func(*args, **kwargs)
        if func.is_view:
            return results
        self._tape.entries.append((func, args, kwargs, results))
        if not func._schema.is_mutable:
            known = {memory_of(each) for each in inputs}
            for result in tensors_of(results):
                if memory_of(result) not in known:
                    made[memory_of(result)] = torch.as_strided(result.detach(), *_whole(result))
        return results

    def undo(self) -> None:
        for tensor, before in self._before.values():
            tensor.copy_(before)
        for generator, state in self._random.values():
            generator.set_state(state)


def _whole(values: Tensor) -> tuple[tuple[int], tuple[int], int]:
    """Size, stride and offset of all of a tensor's memory."""
    size = values.untyped_storage().nbytes() // values.element_size()
    return (size,), (1,), 0


class TapedGraphs:
    """A `graphs.Recorder`. tapes: what was recorded so far; replays: how often any was repeated."""

    def __init__(self) -> None:
        self.tapes: list[Tape] = []
        self.replays = 0

    def record(self, work: Callable[[], None]) -> Tape:
        tape = Tape(self)
        with _Recording(tape) as recording:
            work()
        recording.undo()
        self.tapes.append(tape)
        return tape
