"""Checkpoints: a network with all that its training needs to go on in, one file out, and back.

The file holds tensors, numbers and text only: `torch.load(weights_only=True)` reads it, and nothing in it can run.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import ValidationError

from augkitti.command_line import note
from augkitti.errors import InputError, MachineError
from augkitti.shards import replace_whole
from training.config import Settings
from training.network import PointFlowNet

FORMAT = 1  # a change of meaning raises it
NAME = "checkpoint.pt"  # in a run's folder
SHIPPED = "small.pt"
_TRAIN_AGAIN = "give a folder that `pointflownet train --out` wrote, or its checkpoint.pt"


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """All of a file. A finished one holds weights and settings only."""

    settings: Settings
    weights: dict[str, torch.Tensor]
    step: int = 0  # optimisation steps done
    data_digest: str = ""  # of the shards that it was trained on
    optimiser: dict[str, Any] | None = None
    random: dict[str, Any] = field(default_factory=dict)  # torch's and numpy's states
    reader: dict[str, Any] = field(default_factory=dict)  # where the shards' reader stands
    facts: dict[str, Any] = field(default_factory=dict)  # how it was made, plain values

    @property
    def all_steps(self) -> int:
        """Steps done, with those of the runs that it began from."""
        return self.step + int(self.facts.get("steps_before", 0))


def save_checkpoint(path: Path, checkpoint: Checkpoint, half: bool = False) -> None:
    """Write it; the file is there whole or not at all.

    Args:
        path: of the file; its folder is made.
        checkpoint: what to write.
        half: weights in half precision; for a finished network (an optimiser's small steps would be lost).

    Raises:
        MachineError: the disk refused.
    """
    weights = {
        name: value.detach().to("cpu", torch.float16 if half and value.is_floating_point() else value.dtype)
        for name, value in checkpoint.weights.items()
    }
    content = {
        "format": FORMAT,
        "settings": checkpoint.settings.model_dump_json(by_alias=True),
        "digest": checkpoint.settings.digest(),
        "weights": weights,
        "step": checkpoint.step,
        "data_digest": checkpoint.data_digest,
        "optimiser": checkpoint.optimiser,
        "random": checkpoint.random,
        "reader": json.dumps(checkpoint.reader),
        "facts": json.dumps(checkpoint.facts, sort_keys=True),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_whole(path, lambda file: torch.save(content, file))
    except OSError as err:
        raise MachineError(path, f"cannot be written ({err.strerror})", "free space, or give another --out") from err


def load_checkpoint(path: Path) -> Checkpoint:
    """A checkpoint from its file or its run's folder.

    Raises:
        InputError: missing, not readable, no checkpoint, of another format, or settings that this program refuses.
    """
    file = path / NAME if path.is_dir() else path
    if not file.is_file():
        raise InputError(file, "does not exist", _TRAIN_AGAIN)
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as err:  # zip, pickle and torch each raise their own
        reason = " ".join(str(err).split())[:120] or type(err).__name__
        raise InputError(file, f"not readable as a checkpoint ({reason})", _TRAIN_AGAIN) from err
    if not isinstance(content, dict) or "format" not in content:
        raise InputError(file, "not a checkpoint of this program", _TRAIN_AGAIN)
    if content["format"] != FORMAT:
        raise InputError(
            file, f"has checkpoint format {content['format']!r}", f"this program reads {FORMAT}: train again"
        )
    try:
        settings = Settings.model_validate_json(content["settings"])
        if settings.digest() != content["digest"]:
            raise InputError(file, "its settings do not fit its digest: made by another version", "train again")
        return Checkpoint(
            settings,
            {name: _full(value) for name, value in content["weights"].items()},
            int(content["step"]),
            str(content["data_digest"]),
            content["optimiser"],
            dict(content["random"]),
            dict(json.loads(content["reader"])),
            dict(json.loads(content["facts"])),
        )
    except (ValidationError, KeyError, TypeError, ValueError, AttributeError) as err:
        raise InputError(file, f"not a whole checkpoint ({type(err).__name__})", _TRAIN_AGAIN) from err


def export(run: Path, out: Path) -> None:
    """Write a run's weights and settings alone, in half precision; says how large the file is."""
    whole = load_checkpoint(run)
    facts = {**whole.facts, "steps_done": whole.step}
    finished = Checkpoint(whole.settings, whole.weights, whole.step, whole.data_digest, facts=facts)
    save_checkpoint(out, finished, half=True)
    note(f"{out}: {out.stat().st_size / 1e6:.2f} MB, {whole.all_steps:,} steps")


def shipped_checkpoint() -> Path:
    """The file that comes with the program: `small` on embedded streets, made by `make checkpoint`."""
    path = Path(str(resources.files("training") / "checkpoints" / SHIPPED))
    if not path.is_file():
        raise InputError(path, "is not installed", "name a run: pointflownet train --config small --out runs/a")
    return path


def network_of(checkpoint: Checkpoint, where: str | Path = "checkpoint") -> PointFlowNet:
    """The network with its weights, ready to predict.

    Raises:
        InputError: the weights are not this network's.
    """
    network = PointFlowNet(checkpoint.settings)
    fill(network, checkpoint.weights, where)
    return network.eval()


def fill(network: torch.nn.Module, weights: Mapping[str, torch.Tensor], where: str | Path) -> None:
    """Put weights into a network; InputError where they are another's."""
    own = network.state_dict()
    odd = {*own} ^ {*weights} | {name for name in {*own} & {*weights} if own[name].shape != weights[name].shape}
    if odd:
        few = f"{min(odd)} and {len(odd) - 1} more"
        raise InputError(where, f"has other layers than this program's network: {few}", "train again")
    network.load_state_dict(dict(weights))


def check_fits(checkpoint: Checkpoint, settings: Settings, data_digest: str, where: str | Path) -> None:
    """That a run may go on from here.

    Raises:
        InputError: it was made with other settings, with other data, or holds no optimiser.
    """
    if checkpoint.optimiser is None:
        raise InputError(where, "holds weights only, training cannot go on", "start anew with --init")
    if checkpoint.settings.digest() != settings.digest():
        raise InputError(where, "is of another network or grid than --config", "give its settings.yaml as --config")
    if checkpoint.settings != settings:
        old, new = checkpoint.settings, settings
        changed = ", ".join(name for name in type(new).model_fields if getattr(old, name) != getattr(new, name))
        raise InputError(where, f"was made with other settings: {changed}", "give its settings.yaml as --config")
    if checkpoint.data_digest != data_digest:
        raise InputError(where, "was trained on other shards than --data", "resume with the same data sets and split")


def random_states(rng: np.random.Generator | None = None) -> dict[str, Any]:
    """Torch's (and CUDA's) states, and a numpy generator's; tensors and text."""
    states: dict[str, Any] = {"torch": torch.get_rng_state()}
    if torch.cuda.is_available():
        states["cuda"] = torch.cuda.get_rng_state()
    if rng is not None:
        states["numpy"] = json.dumps(rng.bit_generator.state)
    return states


def set_random_states(states: Mapping[str, Any], rng: np.random.Generator | None = None) -> None:
    """Undo `random_states`."""
    if "torch" in states:
        torch.set_rng_state(states["torch"])
    if "cuda" in states and torch.cuda.is_available():
        torch.cuda.set_rng_state(states["cuda"])
    if rng is not None and "numpy" in states:
        rng.bit_generator.state = json.loads(states["numpy"])


def _full(value: torch.Tensor) -> torch.Tensor:
    return value.float() if value.dtype in (torch.float16, torch.bfloat16) else value
