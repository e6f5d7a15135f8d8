"""Records that pass between the steps: scans, rays, labels, cars, the finished pair; arrays only, no behaviour.

Field names follow the shard contract. N is the number of valid points of a scan, R of its fired rays.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from augkitti.frames import F32, F64

Bool = npt.NDArray[np.bool_]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]

ScanKind = Literal["raw", "compensated"]
NO_TICK = 65535  # contract: tick not known (compensated scans, stray points)

# Contract: what a point was measured or cast on.
MEASURED, PAINT, GLASS, TYRE, LAMP, OTHER, THROUGH_GLASS, MIXED = range(8)
SURFACE_NAMES = ("measured", "paint", "glass", "tyre", "lamp", "other", "seen through glass", "mixed at an edge")


@dataclass(frozen=True, eq=False)
class Scan:
    """One revolution as the scanner wrote it; invalid rows (not finite, or all zero) left out."""

    xyz: F32  # (N, 3) metres, velo
    reflectance: F32  # (N,) 0 to 1
    row: I32  # (N,) ascending: the point's row in the source file
    rows_in_file: int  # valid and invalid
    kind: ScanKind
    time_s: float  # middle of the scan (contract: time0 / time1)
    period_s: float  # from the start of the revolution to its end

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class ScanRays:
    """Every ray that the scanner fired in one scan, whether it returned or not, and the ray of every point.

    Rays are sorted by (ring, tick) on raw scans, by (ring, azimuth) on compensated ones. A point lies at
    `origin + range * direction` of its ray, with `scanner.ray_lines` giving the two from azimuth and elevation.
    """

    ring: U8  # (N,) of each point
    tick: U16  # (N,) of each point; NO_TICK for compensated scans and stray points
    ray: I32  # (N,) index of the point's ray (a stray point has one of its own at the end, with NO_TICK)
    ray_ring: U8  # (R,)
    ray_tick: U16  # (R,); NO_TICK for compensated scans
    ray_azimuth_rad: F64  # (R,) direction of the beam seen from above, counter-clockwise from +x
    ray_elevation_rad: F64  # (R,)
    ray_time_s: F64  # (R,) firing time from the scan's middle; 0 for compensated scans
    ray_point: I32  # (R,) index of the measured point; -1 where nothing returned
    ray_blind: Bool  # (R,) in the ego car's shadow: can never return

    def __len__(self) -> int:
        return len(self.ray_ring)

    @cached_property
    def ring_start(self) -> I64:
        """Index of each ring's first ray, up to ring 255; the last entry is where rays of stray points begin."""
        on_lattice = int(np.count_nonzero(self.ray_tick != NO_TICK)) or len(self)
        return np.searchsorted(self.ray_ring[:on_lattice], np.arange(256)).astype(np.int64)


@dataclass(frozen=True, eq=False)
class GroundMap:
    """The ground round the scanner: one plane, and a height map about it that follows crown and slope."""

    plane: F64  # (4,) a, b, c, d with a x + b y + c z + d = 0, unit normal, c > 0
    origin_m: tuple[float, float]  # (x, y) of the corner of cell [0, 0]
    cell_m: float
    height_m: F32  # (rows along x, columns along y) z of the ground at cell centres, finite everywhere
    observed: Bool  # same shape: ground was seen in or near the cell; elsewhere the height is extrapolated
    is_ground: Bool  # (N,) which points of the scan are ground


@dataclass(frozen=True, eq=False)
class DrivableRegion:
    """Where a car may stand: a bird's-eye grid of free cells connected to the road under the ego car."""

    origin_m: tuple[float, float]  # (x, y) of the corner of cell [0, 0]
    cell_m: float
    drivable: Bool  # (rows along x, columns along y)
    road_heading_rad: float  # direction of the ego road at the ego car, near 0
    heading_cells: int  # cells of `drivable` to a side of one cell of `heading_rad`
    heading_rad: F32  # (rows, columns) of the road there, along the ego road rather than against it


@dataclass(frozen=True, eq=False)
class PreparedScan:
    """A scan with all that depends on it alone; what the `prepare` stage caches."""

    scan: Scan
    rays: ScanRays
    ground: GroundMap
    region: DrivableRegion
    standing: I32  # (M,) ascending: points that stand on the ground or hang over it

    @cached_property
    def standing_xyz(self) -> F32:
        """Coordinates (3, M) of the standing points, each a row of its own: they are searched by x, then by y."""
        return np.stack([self.scan.xyz[:, axis].take(self.standing) for axis in range(3)])


@dataclass(frozen=True, eq=False)
class LabelledBox:
    """A real object as its source labels it in one scan."""

    id: str  # the same in neighbouring scans
    category: str  # KITTI's name
    box: F64  # (7,) x, y, z (centre), length, width, height, yaw; metres, radians, velo


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two neighbouring scans with what the source knows about them."""

    sequence: str  # the folder's bare name
    recording: str  # the physical drive behind it
    frame0: int
    frame1: int
    scan0: Scan
    scan1: Scan
    ego_motion: F64  # T_velo1_velo0 over one revolution, middle to middle
    ego_source: Literal["oxts", "poses", "registration", "truth"]
    labels0: tuple[LabelledBox, ...] = ()
    labels1: tuple[LabelledBox, ...] = ()
    label_coverage: Literal["none", "camera", "full"] = "none"
    label_azimuth: tuple[float, float] | None = None  # for "camera": from, to, radians, velo


@dataclass(frozen=True, eq=False)
class CarModel:
    """A car's mesh in its own frame: x forward, y left, z up, metres, origin at the centre of its bounding box."""

    name: str
    category: str  # KITTI's: Car, Van or Truck
    vertices: F64  # (V, 3) metres, car frame
    faces: I32  # (F, 3)
    surface: U8  # (F,) PAINT, GLASS, TYRE, LAMP or OTHER
    opacity: (
        F32  # (F,) 1 for solid faces; below 1 where the file declares glass (an artist's look, not a transmittance)
    )
    size_m: F64  # (3,) length, width, height of the bounding box, mirrors included
    wheelbase_m: float
    rear_axle_x_m: float  # x of the rear axle in the car frame (negative)
    digest: str  # sha256 of the content above


@dataclass(frozen=True, eq=False)
class VirtualCar:
    """A car placed in a pair: where it is, how it moves, how it looks."""

    model: CarModel
    pose0: F64  # T_velo_car at its moment in scan 0, in the frame that the scanner has then
    pose1: F64  # the same in scan 1
    moment0_s: float  # from time0
    moment1_s: float  # from time1
    T_world_car0: F64  # at moment0; world = velo0 at time0
    twist: F64  # (6,) per second, in the car's frame: T_world_car(t) = T_world_car0 exp((t - moment0) twist)
    speed_mps: float  # of the rear axle, over ground; negative when reversing
    yaw_rate_rps: float
    steering_rad: float
    paint: float  # 0 dark to 1 bright: a trait of the car


@dataclass(frozen=True, eq=False)
class ObjectRecord:
    """A row of the contract's `objects`."""

    id: str
    category: str
    origin: Literal["virtual", "labelled"]
    model: str | None = None
    box0: F64 | None = None  # (7,)
    box1: F64 | None = None
    pose0: F64 | None = None  # (4, 4)
    pose1: F64 | None = None
    moment0: float = 0.0
    moment1: float = 0.0
    motion: F64 | None = None  # (4, 4)
    points0: int = 0
    points1: int = 0
    rays0: int | None = None
    rays1: int | None = None
    speed: float | None = None
    yaw_rate: float | None = None
    steering: float | None = None


@dataclass(frozen=True, eq=False)
class LabelledObjects:
    """The source's own objects of a pair, and the measured points that are theirs."""

    objects: tuple[ObjectRecord, ...]  # point counts not yet filled in
    instance0: I16  # (N0,) row in `objects` of each valid point of scan 0; -1 for none
    instance1: I16  # (N1,)
    unknown0: Bool  # (N0,) points whose flow the labels leave open


@dataclass(frozen=True, eq=False)
class PreparedPair:
    """A pair with all that depends on the source alone: whatever cars go in, this stays."""

    scan0: PreparedScan
    scan1: PreparedScan
    labelled: LabelledObjects
    movers0: Bool  # (N0,) points of scan 0 that contradict the ego-motion where the source's labels do not reach


@dataclass(frozen=True, eq=False)
class AugmentedScan:
    """The per-point columns of one scan of a pair, measured points by `source`, then simulated ones by (ring, tick)."""

    xyz: F32  # (N, 3)
    reflectance: F32  # (N,)
    ring: U8
    tick: U16
    source: I32  # row in the source scan; -1 for a simulated return
    instance: I16  # row in objects; -1 for none
    surface: U8
    removed: I32  # rows of the source scan that a virtual car hides, ascending

    def __len__(self) -> int:
        return len(self.xyz)


@dataclass(frozen=True, eq=False)
class AugmentedPair:
    """One row of a shard: everything the contract's columns hold."""

    pair_id: str
    sequence: str
    recording: str
    frame0: int
    frame1: int
    time0: float
    time1: float
    scan_kind: ScanKind
    seed: int
    ego_motion: F64  # (4, 4)
    ego_source: str
    label_coverage: str
    label_azimuth: tuple[float, float] | None
    scan0: AugmentedScan
    scan1: AugmentedScan
    flow0: F32  # (N0, 3)
    flow_status0: U8  # (N0,)
    objects: tuple[ObjectRecord, ...] = field(default_factory=tuple)
