"""What a process that learns or runs a policy needs of its machine: memory, threads, device, company."""

from __future__ import annotations

import ctypes
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

import torch
from torch import Tensor, distributed

# glibc gives large blocks back to the kernel at once and asks for them again at the next step: a third of the
# time of training on a CPU went into page faults. Numbers of mallopt(3), and how much to keep.
_MALLOC = {-3: 32 << 20, -1: (1 << 31) - 1, -2: 256 << 20}  # mmap threshold, trim threshold, top pad


def keep_memory() -> None:
    """Let the C library keep freed memory for the next step; elsewhere than on glibc nothing happens."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for option, value in _MALLOC.items():
            mallopt(option, value)


@dataclass(frozen=True, slots=True)
class Machine:
    """Where one process of a run computes."""

    device: torch.device
    rank: int = 0
    world: int = 1  # processes of the run

    @property
    def leads(self) -> bool:
        """Whether this is the process that validates, tells and saves."""
        return self.rank == 0

    def any(self, flag: bool) -> bool:
        """Whether `flag` is set in any of the processes."""
        if self.world == 1:
            return flag
        told = torch.tensor(float(flag), device=self.device)
        distributed.all_reduce(told)
        return bool(told.item() > 0)

    def wait(self) -> None:
        """Until all processes are here."""
        if self.world > 1:
            distributed.barrier()

    def autocast(self) -> torch.autocast:
        """bfloat16 on a GPU."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.device.type == "cuda")


@contextmanager
def machine(device: str, threads: int) -> Iterator[Machine]:
    """Set this process up: alone, or as one of those that `torchrun` started.

    Raises RuntimeError where a GPU is asked for and there is none.
    """
    keep_memory()
    if threads:
        torch.set_num_threads(threads)
    rank, world = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    chosen = device_of(device, int(os.environ.get("LOCAL_RANK", 0)))
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
        torch.set_float32_matmul_precision("high")
    if world == 1:
        yield Machine(chosen)
        return
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Machine(chosen, rank, world)
    finally:
        distributed.destroy_process_group()


def device_of(name: str, local_rank: int = 0) -> torch.device:
    """What cpu, cuda, cuda:N or auto means here. Raises RuntimeError where there is no such GPU."""
    there = torch.cuda.is_available()
    if name == "auto":
        name = "cuda" if there else "cpu"
    if name.startswith("cuda") and not there:
        raise RuntimeError(f"No GPU for --device {name}: torch finds none here; --device cpu needs none.")
    return torch.device(f"cuda:{local_rank % torch.cuda.device_count()}" if name == "cuda" else name)


class StopRequest:
    """Within it, SIGTERM and SIGINT only set `asked`; a second SIGINT interrupts as usual."""

    def __init__(self) -> None:
        self.asked = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]  # what signal() returned

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.asked = True


def is_finite(*tensors: Tensor) -> bool:
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)
