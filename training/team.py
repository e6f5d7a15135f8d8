"""The processes of a run: what torchrun says in, this process's rank, device and precision out."""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
import torch.distributed as dist

from augkitti.errors import InputError, MachineError
from training.config import NetworkConfig

Precision = Literal["auto", "fp32", "bf16"]
# Channels from which on a processor's matrix unit repays the conversions: with AMX a training step in bfloat16 takes
# 0.6 times as long as in float32 for `paper` (128 to 256), 2 times for `small` (48 to 96).
WIDE = 128


@dataclass(frozen=True)
class Team:
    """This process among those of the run."""

    rank: int
    size: int
    device: torch.device
    bf16: bool
    auto: bool = False  # nobody asked for that precision

    @property
    def leads(self) -> bool:
        """Whether it is the one that logs and saves."""
        return self.rank == 0

    def precision(self) -> AbstractContextManager[Any]:
        """Inside, convolutions run in bfloat16 where the run does."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.bf16 else nullcontext()

    def suited_to(self, network: NetworkConfig) -> "Team":
        """The same; in float32 where bfloat16 was not asked for and would be slower."""
        slower = self.auto and self.device.type == "cpu" and min(width for width, _ in network.blocks) < WIDE
        return replace(self, bf16=self.bf16 and not slower)

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Over all processes; no gradient passes."""
        values = values.detach().clone()
        if self.size > 1:
            dist.all_reduce(values)
        return values

    def gather(self, value: Any) -> list[Any]:
        """One plain value of each process."""
        if self.size == 1:
            return [value]
        values: list[Any] = [None] * self.size
        dist.all_gather_object(values, value)
        return values

    def wait(self) -> None:
        """Until all are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def team_of(device: str = "auto", precision: Precision = "auto") -> Iterator[Team]:
    """Join torchrun's processes if it started this one; alone otherwise.

    Raises:
        InputError: a device that is not there, or not known.
        MachineError: inside, the memory of the device gave way, or a process that reads was killed.
    """
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    place = find_device(device, int(os.environ.get("LOCAL_RANK", "0")))
    if size > 1:
        dist.init_process_group("nccl" if place.type == "cuda" else "gloo")
    try:
        yield Team(rank, size, place, wants_bf16(place, precision), precision == "auto")
    except torch.OutOfMemoryError as err:
        raise MachineError(str(place), "CUDA out of memory", "lower train.batch, or use --config small") from err
    except RuntimeError as err:
        if "allocate memory" not in str(err) and "DataLoader worker" not in str(err):
            raise
        raise MachineError(str(place), str(err), "lower train.batch or --workers") from err
    finally:
        if size > 1:
            dist.destroy_process_group()


def find_device(name: str, local_rank: int = 0) -> torch.device:
    """`auto`: a CUDA GPU where there is one."""
    try:
        device = torch.device(("cuda" if torch.cuda.is_available() else "cpu") if name == "auto" else name)
    except RuntimeError as err:
        raise InputError("--device", f"`{name}` is no device", "give cpu or cuda") from err
    if device.type == "cuda":
        if not torch.cuda.is_available():
            raise InputError("--device", "no CUDA GPU is at hand, or this torch is built without", "give --device cpu")
        device = torch.device("cuda", local_rank if device.index is None else device.index)
        if device.index is not None and device.index >= torch.cuda.device_count():
            raise InputError("--device", f"there is no GPU {device.index}", f"there are {torch.cuda.device_count()}")
        torch.cuda.set_device(device)
    elif device.type != "cpu":
        raise InputError("--device", f"`{name}` is not supported", "give cpu or cuda")
    return device


def wants_bf16(device: torch.device, precision: Precision) -> bool:
    """Whether to run in bfloat16: where asked, or where the GPU, or the processor's matrix unit (AMX), has it."""
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":  # older ones emulate it
        return torch.cuda.is_bf16_supported() and torch.cuda.get_device_capability(device) >= (8, 0)
    return _has_amx()


def _has_amx() -> bool:
    has = getattr(torch.cpu, "_is_amx_tile_supported", None)  # not in older versions of torch
    return has is not None and bool(has())
