"""Patches of a distance field in, descriptors out: the network of 3DMatch (Zeng et al., CVPR 2017), and one in small.

`PAPER` is the paper's: 30 x 30 x 30 voxels, eight convolutions with a max pooling after the second, a feature layer of
512: 14.3 million parameters. `SMALL` has the same shape for 16 x 16 x 16 voxels and two processor cores.

Departures: descriptors have unit length, so that the margin of the loss means the same in both; voxels are as wide as
streets and rings of a scanner ask for, not as a desk does.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import normalize

from augkitti.errors import InputError
from augkitti.frames import F32, F64
from augkitti.shards import replace_whole
from training.baselines.tdf import FieldConfig

FORMAT = 1
SHIPPED = "3dmatch_small.pt"
_TRAIN_AGAIN = "make it again: python benchmarks/train_3dmatch.py"
_AT_ONCE = 256  # patches: what their first layers give stays in the processor's cache


@dataclass(frozen=True)
class DescriptorConfig:
    """Layers, and the field that they read."""

    before: tuple[int, ...] = (64, 64)  # widths of the convolutions before the max pooling
    after: tuple[int, ...] = (128, 128, 256, 256, 512, 512)  # after it, each 3 voxels wide where so many are left
    feature: int = 512
    field: FieldConfig = field(default_factory=FieldConfig)


PAPER = DescriptorConfig()
SMALL = DescriptorConfig((8, 16), (48, 96, 128), 64, FieldConfig(voxel_m=0.2, patch=16))
CONFIGS = {"paper": PAPER, "small": SMALL}


class DescriptorNetwork(nn.Module):
    """(B, P, P, P) patches -> (B, F) descriptors of unit length."""

    def __init__(self, config: DescriptorConfig) -> None:
        super().__init__()
        self.config = config
        side, channels = config.field.patch, 1
        layers: list[nn.Module] = []
        for stage in (config.before, config.after):
            for width in stage:
                kernel = min(3, side)
                layers += [nn.Conv3d(channels, width, kernel), nn.ReLU(inplace=True)]
                side, channels = side - kernel + 1, width
            if stage is config.before:
                layers.append(nn.MaxPool3d(2))
                side //= 2
        if side != 1:
            raise ValueError(f"{side} voxels to a side are left, not 1: other layers, or another patch")
        self.layers = nn.Sequential(*layers)
        self.feature = nn.Linear(channels, config.feature)  # the paper's 1 x 1 convolution

    def forward(self, patch: Tensor) -> Tensor:
        """Descriptors of patches."""
        return normalize(self.feature(self.layers(patch[:, None]).flatten(1)), dim=1)


def contrastive_loss(feature0: Tensor, feature1: Tensor, xyz1: Tensor, margin: float, apart_m: float) -> Tensor:
    """Partners to 0, strangers to the margin: (B, F), (B, F), (B, 3) m -> scalar.

    Rows are partners; every other row whose place in scan 1 lies farther than `apart_m` off is a stranger. 3DMatch
    draws as many strangers as partners; here all strangers within the margin count, and both sides weigh the same.
    """
    partner = (feature0 - feature1).square().sum(dim=1)
    distance = torch.cdist(feature0, feature1)
    stranger = torch.cdist(xyz1, xyz1) > apart_m
    inside = (margin - distance[stranger]).clamp(min=0.0)
    count = torch.count_nonzero(inside).clamp(min=1)
    return partner.mean() + inside.square().sum() / count


def describe(network: DescriptorNetwork, patch: F32) -> F64:
    """Descriptors (K, F) of patches (K, P, P, P)."""
    if not len(patch):
        return np.zeros((0, network.config.feature))
    with torch.inference_mode():
        parts = [network(part) for part in torch.split(torch.from_numpy(patch), _AT_ONCE)]  # type: ignore[no-untyped-call]
    return np.asarray(torch.cat(parts).numpy(), dtype=np.float64)


def save_network(path: Path, network: DescriptorNetwork, facts: Mapping[str, Any] | None = None) -> None:
    """Weights in half precision, layers and how they were made; the file is there whole or not at all."""
    content = {
        "format": FORMAT,
        "config": asdict(network.config),
        "weights": {name: value.detach().to("cpu", torch.float16) for name, value in network.state_dict().items()},
        "facts": dict(facts or {}),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_whole(path, lambda file: torch.save(content, file))


def load_network(path: Path) -> DescriptorNetwork:
    """The network of a file, ready to describe; the file holds nothing that can run.

    Raises:
        InputError: missing, not readable, or not such a file.
    """
    if not path.is_file():
        raise InputError(path, "does not exist", _TRAIN_AGAIN)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
        if content["format"] != FORMAT:
            raise InputError(path, f"has format {content['format']!r}, not {FORMAT}", _TRAIN_AGAIN)
        config = dict(content["config"])
        config["field"] = FieldConfig(**config["field"])
        network = DescriptorNetwork(DescriptorConfig(**config))
        network.load_state_dict(content["weights"])
    except InputError:
        raise
    except Exception as err:  # zip, pickle and torch each raise their own
        reason = " ".join(str(err).split())[:120] or type(err).__name__
        raise InputError(path, f"no descriptor network ({reason})", _TRAIN_AGAIN) from err
    return network.eval()


def shipped_network() -> Path:
    """The file that comes with the program: `SMALL`, trained on embedded streets by benchmarks/train_3dmatch.py."""
    return Path(str(resources.files("training") / "checkpoints" / SHIPPED))
