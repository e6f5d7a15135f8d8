"""Settings of network, losses and training: a name or a YAML file in, frozen sections with their digest out.

`paper` is PointFlowNet as the paper and `method.md` section 3 fix it; `small` trains in minutes on two cores.
"""

import hashlib
import json
from importlib import resources
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from augkitti.errors import InputError
from augkitti.yaml_text import read_yaml

NAMES = ("paper", "small")


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class GridConfig(_Section):
    """The volume in front of the scanner and its voxels, velo frame, metres."""

    x_m: tuple[float, float] = (0.0, 70.4)
    y_m: tuple[float, float] = (-40.0, 40.0)
    z_m: tuple[float, float] = (-3.0, 1.0)
    voxel_m: tuple[float, float, float] = (0.2, 0.2, 0.4)
    max_points: int = Field(35, ge=1, description="T: points of a voxel that are used, drawn at random")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        sides = zip((self.x_m, self.y_m, self.z_m), self.voxel_m, strict=True)
        x, y, z = (round((high - low) / voxel) for (low, high), voxel in sides)
        return x, y, z

    @model_validator(mode="after")
    def _whole_voxels(self) -> "GridConfig":
        for (low, high), voxel in zip((self.x_m, self.y_m, self.z_m), self.voxel_m, strict=True):
            count = (high - low) / voxel
            if count < 1 or abs(count - round(count)) > 1e-6:
                raise ValueError(f"{low} to {high} m is no whole number of voxels of {voxel} m")
        if self.shape[0] % 8 or self.shape[1] % 4:
            raise ValueError("voxels along x and y must be multiples of 8 and 4: three blocks halve them")
        return self


class NetworkConfig(_Section):
    """Widths and depths; the paper's or VoxelNet's where the paper is silent."""

    reflectance: bool = Field(False, description="a fourth input; with it a network may spot simulated cars")
    vfe: tuple[int, ...] = Field((32, 128), description="widths of the voxel feature encoding layers")
    middle: tuple[int, int, int] = Field((64, 64, 64), description="widths of the three 3D convolutions")
    blocks: tuple[tuple[int, int], ...] = Field(
        ((128, 4), (128, 6), (256, 6)), description="width and number of layers of each 2D block, the first of stride 2"
    )
    upsampled: int = Field(256, description="channels of each up-convolution for detection")
    upsampled_flow: int = Field(64, description="channels of each up-convolution for flow")
    rigid: tuple[int, int] = Field((64, 5), description="width and number of layers of the rigid-motion decoder")
    ego: tuple[int, int] = Field((128, 3), description="width and number of strided layers of the ego-motion branch")

    @model_validator(mode="after")
    def _can_be_built(self) -> "NetworkConfig":
        blocks = [number for block in self.blocks for number in block]
        numbers = (*self.vfe, *self.middle, *blocks, self.upsampled, self.upsampled_flow, *self.rigid, *self.ego)
        if not self.vfe or not self.blocks or min(numbers) < 1 or any(width % 2 for width in self.vfe):
            raise ValueError("widths and depths are 1 or more, those of vfe even; vfe and blocks are not empty")
        return self


class LossConfig(_Section):
    """Weights that the paper does not print, set by hand (docs/decisions.md)."""

    alpha: float = Field(1.0, ge=0.0, description="scene flow")
    beta: float = Field(1.0, ge=0.0, description="rigid motion")
    gamma: float = Field(1.0, ge=0.0, description="ego-motion")
    object: float = Field(1.0, gt=0.0, description="a column on an object counts so often in flow and rigid motion")
    lambda_: float = Field(10.0, ge=0.0, alias="lambda", description="rotation (radians) against translation (metres)")
    detection: float = Field(1.0, ge=0.0)
    positive: float = Field(1.5, ge=0.0, description="classification of positive anchors (VoxelNet)")
    negative: float = Field(1.0, ge=0.0)


class DetectionConfig(_Section):
    """Anchors and matching (VoxelNet), seen from above."""

    anchor_m: tuple[float, float, float] = Field((3.9, 1.6, 1.56), description="length, width, height")
    anchor_z_m: float = Field(-1.0, description="centre")
    positive_iou: float = Field(0.6, gt=0.0, lt=1.0)
    negative_iou: float = Field(0.45, gt=0.0, lt=1.0)
    score: float = Field(0.5, gt=0.0, lt=1.0, description="tau: detections below are dropped when predicting")
    nms_iou: float = Field(0.3, gt=0.0, lt=1.0)
    most: int = Field(100, ge=1, description="boxes kept of one scan")
    category: str = "Car"
    neutral: tuple[str, ...] = Field(("Van", "Truck"), description="neither positive nor negative")


class TrainConfig(_Section):
    """The loop."""

    epochs: float = Field(30.0, gt=0.0)
    batch: int = Field(4, ge=1)
    learning_rate: float = Field(1e-3, gt=0.0)
    weight_decay: float = Field(1e-4, ge=0.0)
    warmup: float = Field(0.05, ge=0.0, lt=1.0, description="share of all steps")
    clip: float = Field(10.0, gt=0.0, description="largest norm of the gradient")
    rotation_rad: float = Field(0.785, ge=0.0, description="largest rotation of a training pair about z")
    wide_share: float = Field(0.0, ge=0.0, le=1.0, description="share of pairs turned by up to a right angle instead")
    scale: float = Field(0.05, ge=0.0, lt=0.5, description="largest change of a training pair's scale")
    flip: bool = Field(True, description="mirror left and right in half of the training pairs")
    box_rotation_rad: float = Field(0.157, ge=0.0, description="largest turn of single objects about their own axis")
    box_shift_m: float = Field(0.5, ge=0.0, description="standard deviation of single objects' shifts")
    ego_shift_m: float = Field(0.0, ge=0.0, description="standard deviation of the observer's shift before scan 1")
    ego_turn_rad: float = Field(0.0, ge=0.0, description="standard deviation of its turn")
    parts: tuple[str, ...] = Field((), description="parts of the network that learn, such as object_decoder; () is all")
    frozen_norms: bool = Field(False, description="batch norms keep their running statistics, as when predicting")
    seed: int = Field(0, ge=0)


class Settings(_Section):
    """All of them; what a checkpoint carries."""

    grid: GridConfig = GridConfig()
    network: NetworkConfig = NetworkConfig()
    loss: LossConfig = LossConfig.model_validate({})
    detection: DetectionConfig = DetectionConfig.model_validate({})
    train: TrainConfig = TrainConfig.model_validate({})

    def digest(self) -> str:
        """sha256 of grid, network and detection: what makes two checkpoints exchangeable."""
        parts = self.model_dump(mode="json", include={"grid", "network", "detection"})
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def load_settings(which: str) -> Settings:
    """The settings of a shipped name (`paper`, `small`) or of a YAML file.

    Raises:
        InputError: no such name or file, not YAML, an unknown key or a value out of range.
    """
    remedy = "see training/configs/paper.yaml"
    shipped = resources.files("training") / "configs" / f"{which}.yaml"
    if which not in NAMES and not Path(which).is_file():
        raise InputError(which, "no such settings", f"give {' or '.join(NAMES)}, or a YAML file")
    path = Path(str(shipped)) if which in NAMES else Path(which)
    try:
        return Settings.model_validate(read_yaml(path, remedy) or {})
    except ValidationError as err:
        first = err.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(which, f"key `{key}`: {first['msg']}", remedy) from err
