"""Every setting of generation, frozen: YAML or keyword values in, one checked `Config` and its digest out.

A section belongs to one step. The one line of `description` is what `augkitti config show` prints beside the default.
Lengths are metres, angles radians, times seconds; the unit stands in the name.
"""

import hashlib
import json
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from augkitti.errors import InputError
from augkitti.yaml_text import read_yaml


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class GroundConfig(_Section):
    """Ground plane and local height map (`ground.py`)."""

    cell_m: float = Field(default=0.5, gt=0.1, le=2.0, description="cell of the height map")
    reach_m: float = Field(default=68.0, ge=20.0, le=120.0, description="how far the height map goes each way")
    min_height_m: float = Field(default=1.2, gt=0.0, description="the plane lies at least this far under the sensor")
    max_height_m: float = Field(default=2.5, gt=0.0, description="the plane lies at most this far under the sensor")
    usual_height_m: float = Field(default=1.73, gt=0.0, description="sensor height where no ground is seen")
    max_tilt_rad: float = Field(default=0.10, gt=0.0, le=0.3, description="steepest plane against the sensor")
    plane_radius_m: float = Field(default=20.0, ge=8.0, description="points within it fit the plane")
    inlier_m: float = Field(default=0.20, gt=0.0, description="farther points have no say in the plane")
    ransac_tries: int = Field(default=300, ge=10, description="triples that RANSAC tries, drawn with a fixed seed")
    step_m: float = Field(default=0.25, gt=0.0, description="a cell this much above its surroundings is no ground")
    above_m: float = Field(default=0.12, gt=0.0, description="points up to this above the map are ground; twice it far")
    below_m: float = Field(default=0.30, gt=0.0, description="points down to this below the map are ground")


class DrivableConfig(_Section):
    """Where a car may stand (`drivable.py`)."""

    cell_m: float = Field(default=0.2, ge=0.1, le=1.0, description="cell of the grid")
    reach_m: float = Field(default=62.0, ge=20.0, le=120.0, description="how far the grid goes each way")
    low_m: float = Field(default=0.25, gt=0.0, description="what rises higher over the ground is an obstacle")
    car_height_m: float = Field(default=2.0, gt=0.0, description="what hangs higher over the ground is none")
    pass_m: float = Field(default=0.6, gt=0.0, description="a ray lower than this over a gap shows the gap free")
    kerb_m: float = Field(default=0.03, gt=0.0, description="a step along a ring from which on it bounds the road")
    cross_kerb_m: float = Field(default=0.055, gt=0.0, description="the same from ring to ring, where beams differ")
    rough_m: float = Field(default=0.005, gt=0.0, description="mean stray of heights along a ring; rougher is no road")
    side_m: float = Field(default=0.3, gt=0.0, description="length to each side over which steps and strays are taken")
    join_m: float = Field(
        default=0.6, gt=0.0, description="an edge seen on neighbouring rings is joined over this; far off over more"
    )
    half_width_m: float = Field(default=0.9, gt=0.0, description="half of the width that a car needs")


class MoversConfig(_Section):
    """Unlabelled moving things (`movers.py`)."""

    reach_m: float = Field(60.0, gt=5.0, le=120.0, description="farther points are not tested")
    min_height_m: float = Field(0.3, gt=0.0, description="what stands lower above the ground is not tested by itself")
    cell_m: float = Field(0.3, gt=0.05, description="cells of the ground plane that touch form a cluster")
    min_points: int = Field(6, ge=2, description="smaller clusters are left alone")
    max_length_m: float = Field(15.0, gt=0.0, description="larger clusters never move (walls, hedges)")
    max_motion_m: float = Field(3.6, gt=0.0, description="farthest that a thing moves between two scans")
    min_motion_m: float = Field(0.2, gt=0.0, description="shorter motions are not told from standing")
    max_misfit_m: float = Field(0.2, gt=0.0, description="a moved cluster must meet the other scan this well")
    max_misfit_ratio: float = Field(0.85, gt=0.0, lt=1.0, description="and this much better than standing still")
    min_against: float = Field(0.02, gt=0.0, lt=1.0, description="share of points that contradict standing, at least")
    min_explained: float = Field(0.6, gt=0.0, lt=1.0, description="share of these that the motion explains")


class PlacementConfig(_Section):
    """Where cars are put (`placement.py`)."""

    attempts: int = Field(default=24, ge=1, description="proposals a pair before it is left out for want of room")
    candidates: int = Field(default=512, ge=1, description="places looked at for each drawn motion")
    full_checks: int = Field(default=12, ge=1, description="of these, places whose points and boxes are looked at")
    min_range_m: float = Field(default=4.0, ge=0.0, description="nearest distance of a car's centre from the scanner")
    max_range_m: float = Field(
        default=60.0, gt=0.0, description="farthest; distances between are drawn evenly where there is room"
    )
    wrong_side_weight: float = Field(
        default=0.2, ge=0.0, le=1.0, description="weight of places on the wrong side of a road with right-hand traffic"
    )
    box_gap_m: float = Field(
        default=0.5, ge=0.0, description="free space to labelled boxes, other virtual cars and the ego car"
    )
    point_gap_m: float = Field(default=0.15, ge=0.0, description="free space to measured points, round the car's box")
    point_height_m: float = Field(
        default=0.2,
        gt=0.0,
        le=0.35,
        description="measured points lower above the underside are ground (contract: 0.35)",
    )
    ground_gap_m: float = Field(
        default=0.07, gt=0.0, le=0.1, description="wheels to the ground of each scan (contract: 0.10)"
    )
    min_free_share: float = Field(
        default=0.25, ge=0.0, le=1.0, description="share of rays to the car that nothing stops before"
    )

    @model_validator(mode="after")
    def _in_order(self) -> "PlacementConfig":
        if self.min_range_m >= self.max_range_m:
            raise ValueError("min_range_m must be below max_range_m")
        return self


class MotionConfig(_Section):
    """How cars move (`vehicle_motion.py`)."""

    standing_share: float = Field(default=0.15, ge=0.0, description="weight of standing cars")
    slow_share: float = Field(default=0.25, ge=0.0, description="weight of cars slower than `slow_mps`")
    town_share: float = Field(default=0.20, ge=0.0, description="weight of cars between `slow_mps` and `town_mps`")
    fast_share: float = Field(default=0.40, ge=0.0, description="weight of cars between `town_mps` and `fast_mps`")
    slow_mps: float = Field(default=4.0, gt=0.0, description="upper end of slow speeds")
    town_mps: float = Field(default=15.0, gt=0.0, description="upper end of town speeds")
    fast_mps: float = Field(default=34.0, gt=0.0, description="highest speed")
    moving_mps: float = Field(default=1.0, ge=0.0, description="least speed of a car that must move")
    reversing_share: float = Field(
        default=0.1, ge=0.0, le=1.0, description="share of the slow cars that drive backwards"
    )
    along_share: float = Field(default=0.60, ge=0.0, description="weight of headings along the ego road axis")
    against_share: float = Field(default=0.25, ge=0.0, description="weight of headings against it")
    turning_share: float = Field(default=0.15, ge=0.0, description="weight of turning or crossing cars, half of each")
    heading_spread_rad: float = Field(
        default=0.08, ge=0.0, description="standard deviation of headings about the road axis"
    )
    crossing_spread_rad: float = Field(
        default=0.3, ge=0.0, description="standard deviation of crossing headings about 90 degrees"
    )
    max_steering_rad: float = Field(default=0.6, gt=0.0, lt=1.5, description="largest steering angle")
    max_lateral_mps2: float = Field(default=4.0, gt=0.0, description="largest lateral acceleration of the rear axle")
    steering_spread: float = Field(
        default=0.4,
        ge=0.0,
        description="standard deviation of steering along the road, in parts of what the two limits allow",
    )

    @model_validator(mode="after")
    def _in_order(self) -> "MotionConfig":
        if not self.slow_mps <= self.town_mps <= self.fast_mps or self.moving_mps > self.fast_mps:
            raise ValueError("speeds must rise from slow_mps over town_mps to fast_mps, with moving_mps not above")
        return self


class Config(_Section):
    """The whole configuration of a data set; its digest stands in every shard."""

    cars: tuple[int, int] = Field((1, 3), description="virtual cars a pair, from and to; 0 0 writes plain pairs")
    categories: tuple[Literal["Car", "Van", "Truck"], ...] = Field(
        ("Car",), description="KITTI categories that virtual cars are drawn from"
    )
    min_points: int = Field(20, ge=1, description="returns that each virtual car has at least in both scans")
    glass: Literal["pass", "opaque"] = Field("pass", description="whether panes let the pulse through")
    shutter: Literal["rolling", "snapshot"] = Field(
        "rolling", description="cast each ray at its own firing time, or all at one moment (raw scans)"
    )
    ground: GroundConfig = Field(GroundConfig(), description="ground plane and local height map")
    drivable: DrivableConfig = Field(DrivableConfig(), description="where a car may stand")
    movers: MoversConfig = Field(MoversConfig(), description="unlabelled moving things")
    placement: PlacementConfig = Field(PlacementConfig(), description="where cars are put")
    motion: MotionConfig = Field(MotionConfig(), description="how cars move")

    @field_validator("cars")
    @classmethod
    def _from_is_at_most_to(cls, cars: tuple[int, int]) -> tuple[int, int]:
        if not 0 <= cars[0] <= cars[1]:
            raise ValueError(f"{cars[0]} to {cars[1]} is no range of cars; give two numbers such as 1, 3 or 0, 0")
        return cars

    def digest(self) -> str:
        """sha256 over the sorted JSON of all values."""
        return hashlib.sha256(json.dumps(self.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()


def load_config(path: Path | None, **changes: Any) -> Config:
    """Read a YAML file (None: defaults) and apply `changes` (None values are left out) on top.

    Raises:
        InputError: the file is missing, not YAML, or holds an unknown key or a value out of range.
    """
    values: dict[str, Any] = {}
    if path is not None:
        loaded = read_yaml(path, "see `augkitti config show` for a valid file")
        if loaded is not None and not isinstance(loaded, dict):
            raise InputError(path, "not a table of keys and values", "see `augkitti config show` for a valid file")
        values = loaded or {}
    values.update({key: value for key, value in changes.items() if value is not None})
    try:
        return Config.model_validate(values)
    except ValidationError as err:
        first = err.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        problem = "is unknown" if first["type"] == "extra_forbidden" else first["msg"]
        raise InputError(
            path or "options", f"key `{key}`: {problem}", "see `augkitti config show` for keys and defaults"
        ) from err
