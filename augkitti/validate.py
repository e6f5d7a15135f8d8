"""The contract's invariants: a finished pair, and its source scans where they are at hand, in; offences out.

One function an invariant, numbered as in the contract. Nothing of the generating steps is used, only the records, the
frames, the beam table of the shard's own profile and, for wheel contact, the ground of the source scans.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import (
    F64,
    Array,
    box_pose,
    compose,
    footprint_corners,
    footprints_overlap,
    invert,
    is_rigid,
    rotate_vectors,
    se3_exp,
    se3_log,
    transform_points,
    wrap_angle,
    yaw_of,
)
from augkitti.ground import height_at
from augkitti.scan_pair import (
    LAMP,
    MEASURED,
    MIXED,
    NO_TICK,
    OTHER,
    PAINT,
    THROUGH_GLASS,
    TYRE,
    AugmentedPair,
    AugmentedScan,
    GroundMap,
    ObjectRecord,
)
from augkitti.scanner import ScannerProfile, profile_from_content

TITLES = {
    1: "columns agree in length, numbers are finite, values are in range",
    2: "measured points are untouched",
    3: "source and removed are all valid rows of the source scan",
    4: "instances, counts and boxes agree",
    5: "flow is the motion of the point's object",
    6: "motions are rigid and agree with poses and boxes",
    7: "each simulated return has its own fired ray",
    8: "cars hide what is behind them, and nothing else",
    9: "virtual cars: number, returns, room",
    10: "virtual cars stand on the local ground",
    11: "bytes depend on configuration, seed and source alone",
}

_OPAQUE = (PAINT, TYRE, LAMP, OTHER)
_ON_RAY_M, _ON_RAY_SHARE = 0.002, 5e-5  # contract, invariant 7
_IN_BOX_M = 0.25  # contract, invariant 4
_MESH_M = 0.05  # a box is its mesh as cast; rays and twists of a shard are exact to less
_RANGE_NOISE_M = 0.15  # scanner.md section 2: a beam's bias is up to 6 cm, shot to shot 8 mm with tails
_SAME_RAY_RAD = 2e-5  # compensated scans: a return on the ray of a point has its direction but for rounding
_KEPT_SHARE = 0.01  # contract, invariant 8
_MIDDLE = (0.70, 0.25, 0.50)  # contract, invariant 8: share of length and width; of height from, to
_UNDERSIDE_M = 0.35  # contract, invariant 9
_WHEEL_M = 0.10  # contract, invariant 10
_WHEELS = (0.3, 0.4)  # parts of length and width at which wheels touch the ground, either way
_SEAM_RAD = np.deg2rad(15.0)  # contract, frames
_SEAM_SLACK_RAD = np.deg2rad(0.5)  # a box is a little wider than the mesh in it
_LABEL_ABOVE_M = 0.15  # contract, columns: lower points in a labelled box are ground
_SHELL_M = 0.2  # contract, columns: round a moving labelled box the flow is not known
_SLACK_M = 0.01
_SURELY_MOVING_MPS = 1.0  # a label slower than this may be one that stands
_MOVING_MPS = 0.1
_MOMENT_S = 0.003  # the revolution's time is not in the shard: time1 - time0 stands for it


@dataclass(frozen=True)
class Offence:
    """One breach of the contract: where, what stands there, what is wrong."""

    pair_id: str  # or the file's path, for offences of the folder
    invariant: int  # 0 for the folder's own rules
    column: str
    value: str
    message: str


@dataclass(frozen=True, eq=False)
class Source:
    """What a pair was made from."""

    rows0: Array  # (M, 4) float32: every row of the source file
    rows1: Array
    ground0: GroundMap
    ground1: GroundMap


@dataclass(frozen=True, eq=False)
class Rules:
    """What a shard's metadata says that its pairs must keep."""

    profile: ScannerProfile
    cars: tuple[int, int]
    min_points: int
    rolling: bool

    @cached_property
    def _tables(self) -> tuple[F64, F64]:
        p = self.profile
        ticks = np.arange(p.lattice_size)[None, :] + p.tick_offset[:, None]
        azimuth = 2.0 * np.pi / p.lattice_size * ticks + p.azimuth_rad[:, None]
        return np.cos(azimuth), np.sin(azimuth)

    def rays(self, ring: Array, tick: Array) -> tuple[F64, F64]:
        """Origins (K, 3) and unit directions (K, 3) of rays, scanner.md section 1."""
        p = self.profile
        cos_a, sin_a = self._tables[0][ring, tick], self._tables[1][ring, tick]
        cos_e, sin_e = np.cos(p.elevation_rad)[ring], np.sin(p.elevation_rad)[ring]
        side = p.side_m[ring]
        origin = np.stack([-side * sin_a, side * cos_a, p.height_m[ring]], axis=1)
        return origin, np.stack([cos_e * cos_a, cos_e * sin_a, sin_e], axis=1)

    def lines_to(self, xyz: Array, ring: Array) -> tuple[F64, F64]:
        """Origins and unit directions of the lines from beams' origins through points (K, 3)."""
        p = self.profile
        x, y = xyz[:, 0].astype(np.float64), xyz[:, 1].astype(np.float64)
        side = p.side_m[ring]
        azimuth = np.arctan2(y, x) - np.arcsin(np.clip(side / np.maximum(np.hypot(x, y), 1e-6), -1.0, 1.0))
        origin = np.stack([-side * np.sin(azimuth), side * np.cos(azimuth), p.height_m[ring]], axis=1)
        offset = xyz - origin
        return origin, offset / np.maximum(np.sqrt((offset**2).sum(axis=1)), 1e-9)[:, None]

    def nearest_tick(self, xyz: Array, ring: Array) -> npt.NDArray[np.int64]:
        """The tick (K,) at which beams look nearest to points."""
        p = self.profile
        x, y = xyz[:, 0].astype(np.float64), xyz[:, 1].astype(np.float64)
        azimuth = np.arctan2(y, x) - np.arcsin(np.clip(p.side_m[ring] / np.maximum(np.hypot(x, y), 1e-6), -1.0, 1.0))
        ticks = np.rint((azimuth - p.azimuth_rad[ring]) * p.lattice_size / (2.0 * np.pi)).astype(np.int64)
        return np.asarray((ticks - p.tick_offset[ring]) % p.lattice_size)

    def firing_time(self, tick: Array, period_s: float) -> F64:
        """Seconds from the scan's middle at which ticks fire: clockwise, from just before the seam tick down."""
        p = self.profile
        order = (p.seam_tick - 1 - tick.astype(np.int64)) % p.lattice_size
        return np.asarray((order / p.lattice_size - 0.5) * period_s)


Check = Callable[[AugmentedPair, Rules, Source | None], Iterator[Offence]]


def rules_of(metadata: Mapping[str, Any], where: str) -> Rules:
    """The rules that a shard's metadata sets.

    Raises:
        InputError: the metadata lacks them; `where` names the shard.
    """
    try:
        configuration = metadata["configuration"]
        fewest, most = (int(number) for number in configuration["cars"])
        rolling = configuration["shutter"] == "rolling"
        content = metadata["scanner_profile"]
        min_points = int(configuration["min_points"])
    except (KeyError, TypeError, ValueError) as err:
        raise InputError(where, f"metadata without {err}", "generate the shard again") from err
    return Rules(profile_from_content(content, where), (fewest, most), min_points, rolling)


def validate_pair(pair: AugmentedPair, rules: Rules, source: Source | None = None) -> list[Offence]:
    """Every offence of a pair against invariants 1 to 10; without the source, as far as they can be looked at."""
    broken = list(_lengths(pair))
    if broken:
        return broken  # nothing else can be looked at
    with np.errstate(invalid="ignore", over="ignore"):
        return [offence for check in CHECKS.values() for offence in check(pair, rules, source)]


# --- 1 ----------------------------------------------------------------------------------------------------------------

_PER_POINT = ("reflectance", "ring", "tick", "source", "instance", "surface")


def _lengths(pair: AugmentedPair) -> Iterator[Offence]:
    for k, scan in _scans(pair):
        for name in _PER_POINT:
            if len(getattr(scan, name)) != len(scan):
                message = f"the scan has {len(scan)} points"
                yield Offence(pair.pair_id, 1, f"{name}{k}", f"{len(getattr(scan, name))} values", message)
    for name in ("flow0", "flow_status0"):
        if len(getattr(pair, name)) != len(pair.scan0):
            message = f"scan 0 has {len(pair.scan0)} points"
            yield Offence(pair.pair_id, 1, name, f"{len(getattr(pair, name))} values", message)


def columns_are_sound(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 1, with the ranges that the column table gives and the order of rows."""
    report = _Reporter(pair, 1)
    p = rules.profile
    for k, scan in _scans(pair):
        yield from report.rows(f"xyz{k}", ~np.isfinite(scan.xyz).all(axis=1), scan.xyz, "is not finite")
        off = ~((scan.reflectance >= 0.0) & (scan.reflectance <= 1.0))
        yield from report.rows(f"reflectance{k}", off, scan.reflectance, "is not within 0 and 1")
        yield from report.rows(f"ring{k}", scan.ring >= p.beams, scan.ring, f"is no beam: there are {p.beams}")
        known = scan.tick != NO_TICK
        off = known & (scan.tick >= p.lattice_size) if pair.scan_kind == "raw" else known
        yield from report.rows(f"tick{k}", off, scan.tick, f"is no tick of a {pair.scan_kind} scan")
        yield from report.rows(f"surface{k}", scan.surface > MIXED, scan.surface, "is no surface")
        yield from report.rows(f"source{k}", scan.source < -1, scan.source, "is no row")
        yield from report.rows(f"source{k}", _out_of_order(scan), scan.source, "stands out of order")
    yield from report.rows("flow0", ~np.isfinite(pair.flow0).all(axis=1), pair.flow0, "is not finite")
    yield from report.rows("flow_status0", pair.flow_status0 > 1, pair.flow_status0, "is neither 0 nor 1")
    if not pair.pair_id.startswith(f"{pair.sequence}/{pair.frame0}/"):
        yield report.one("pair_id", pair.pair_id, "is not `<sequence>/<frame0>/<variant>`")
    for name, values in _WORDS.items():
        if getattr(pair, name) not in values:
            yield report.one(name, getattr(pair, name), f"is none of {', '.join(values)}")
    if (pair.label_azimuth is None) != (pair.label_coverage != "camera"):
        yield report.one("label_azimuth", pair.label_azimuth, f"does not go with coverage `{pair.label_coverage}`")
    for name in ("time0", "time1", "ego_motion"):
        if not np.isfinite(getattr(pair, name)).all():
            yield report.one(name, getattr(pair, name), "is not finite")
    if not pair.time1 > pair.time0:
        yield report.one("time1", pair.time1, "is not after time0")
    for row, item in enumerate(pair.objects):
        for field in fields(item):
            value = getattr(item, field.name)
            if isinstance(value, float | np.ndarray) and not np.isfinite(value).all():
                yield report.one(f"objects[{row}].{field.name}", value, "is not finite")
        if item.origin not in ("virtual", "labelled"):
            yield report.one(f"objects[{row}].origin", item.origin, "is neither virtual nor labelled")
    ids = [item.id for item in pair.objects]
    for name in sorted({name for name in ids if ids.count(name) > 1}):
        yield report.one("objects.id", name, "stands for two objects")


_WORDS = {
    "scan_kind": ("raw", "compensated"),
    "ego_source": ("oxts", "poses", "registration", "truth"),
    "label_coverage": ("none", "camera", "full"),
}


def _out_of_order(scan: AugmentedScan) -> Array:
    """Rows that do not come after the row before: measured by `source`, then simulated by (ring, tick)."""
    simulated = scan.source < 0
    key = np.where(simulated, scan.ring.astype(np.int64) * 65536 + scan.tick, scan.source.astype(np.int64))
    same_kind = simulated[1:] == simulated[:-1]
    ties = simulated[1:] & (scan.tick[1:] == NO_TICK)  # rays without ticks stand by ring alone
    back = same_kind & np.where(ties, key[1:] < key[:-1], key[1:] <= key[:-1])
    back &= ~simulated[1:] | (key[1:] != key[:-1])  # two returns of one ray are invariant 7's
    back |= simulated[:-1] & ~simulated[1:]
    return np.concatenate([np.zeros(min(1, len(scan)), dtype=bool), back])


# --- 2, 3 -------------------------------------------------------------------------------------------------------------


def measured_points_are_untouched(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 2: bit for bit, where a row of that number is there."""
    if source is None:
        return
    report = _Reporter(pair, 2)
    for k, scan in _scans(pair):
        rows = (source.rows0, source.rows1)[k]
        there = np.flatnonzero((scan.source >= 0) & (scan.source < len(rows)))
        origin = np.ascontiguousarray(rows[scan.source[there]])
        xyz_off = (origin[:, :3].copy().view(np.uint32) != scan.xyz[there].view(np.uint32)).any(axis=1)
        grey_off = origin[:, 3].copy().view(np.uint32) != scan.reflectance[there].view(np.uint32)
        for name, off in (("xyz", xyz_off), ("reflectance", grey_off)):
            all_off = np.zeros(len(scan), dtype=bool)
            all_off[there[off]] = True
            yield from report.rows(f"{name}{k}", all_off, getattr(scan, name), "differs from its source row")


def nothing_appears_or_vanishes(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 3; without the source only that `source` and `removed` are disjoint and hold no row twice."""
    report = _Reporter(pair, 3)
    for k, scan in _scans(pair):
        kept = scan.source[scan.source >= 0]
        back = np.concatenate([np.zeros(min(1, len(scan.removed)), dtype=bool), np.diff(scan.removed) <= 0])
        yield from report.rows(f"removed{k}", back | (scan.removed < 0), scan.removed, "is not ascending")
        both = np.concatenate([kept, scan.removed[scan.removed >= 0]])
        file_rows = None if source is None else (source.rows0, source.rows1)[k]
        size = max(int(both.max(initial=-1)) + 1, 0 if file_rows is None else len(file_rows))
        uses, row = np.bincount(both, minlength=size), np.arange(size)
        yield from report.rows(f"source{k}", uses > 1, row, "stands twice in source and removed", by_value=True)
        if file_rows is None:
            continue
        valid = np.zeros(size, dtype=bool)
        valid[: len(file_rows)] = np.isfinite(file_rows).all(axis=1) & (file_rows != 0.0).any(axis=1)
        vanished = valid & (uses == 0)
        yield from report.rows(f"source{k}", vanished, row, "is a row of the source that vanished", by_value=True)
        yield from report.rows(f"source{k}", ~valid & (uses > 0), row, "is no valid row of the source", by_value=True)


# --- 4, 5, 6 ----------------------------------------------------------------------------------------------------------


def instances_agree(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 4; measured points belong to no virtual car, and to a labelled object only in its box."""
    report = _Reporter(pair, 4)
    virtual = np.array([item.origin == "virtual" for item in pair.objects], dtype=bool)
    for k, scan in _scans(pair):
        known = (scan.instance >= -1) & (scan.instance < len(pair.objects))
        yield from report.rows(f"instance{k}", ~known, scan.instance, f"names none of {len(pair.objects)} objects")
        owned = known & (scan.instance >= 0)
        of_virtual = np.zeros(len(scan), dtype=bool)
        of_virtual[owned] = virtual[scan.instance[owned]]
        simulated = scan.source < 0
        off = simulated != (scan.surface != MEASURED)
        yield from report.rows(f"surface{k}", off, scan.surface, "does not go with its source")
        solid = simulated & (scan.surface >= PAINT) & (scan.surface <= THROUGH_GLASS)
        yield from report.rows(f"instance{k}", solid & ~of_virtual, scan.instance, "of a return is no virtual car")
        off = ~simulated & of_virtual
        yield from report.rows(f"instance{k}", off, scan.instance, "of a measured point is a virtual car")
        mixed = scan.surface == MIXED
        yield from report.rows(
            f"instance{k}", mixed & (scan.instance != -1), scan.instance, "of a mixed point is not -1"
        )
        if k == 0:
            off = mixed & (pair.flow_status0 != 1)
            yield from report.rows("flow_status0", off, pair.flow_status0, "of a mixed point is not 1")
        counts = np.bincount(scan.instance[owned], minlength=len(pair.objects))
        for row, item in enumerate(pair.objects):
            count = (item.points0, item.points1)[k]
            if count != counts[row]:
                yield report.one(f"objects[{row}].points{k}", count, f"the scan has {counts[row]}")
            rays = (item.rays0, item.rays1)[k]
            if item.origin == "virtual" and rays is not None and rays < count:
                yield report.one(f"objects[{row}].rays{k}", rays, f"are fewer than its {count} returns")
            mine = np.flatnonzero(owned & (scan.instance == row))
            box, pose = (item.box0, item.box1)[k], (item.pose0, item.pose1)[k]
            if len(mine) == 0:
                continue
            if box is None:
                yield report.one(f"objects[{row}].box{k}", None, f"{len(mine)} points belong to it")
                continue
            if item.origin == "virtual":
                if pose is None:
                    continue  # invariant 6
                outside = ~_in_box(scan.xyz[mine], pose, box[3:6], _IN_BOX_M) & solid[mine]
                message = f"lies outside the box of its car, grown by {_IN_BOX_M} m"
            else:
                outside = ~_in_box(scan.xyz[mine], box_pose(box), box[3:6], 1e-3) & ~simulated[mine]
                message = "lies outside the labelled box that it belongs to"
            off = np.zeros(len(scan), dtype=bool)
            off[mine[outside]] = True
            yield from report.rows(f"xyz{k}", off, scan.xyz, message)
        if source is not None:
            yield from _points_of_labels(pair, report, k, scan, (source.ground0, source.ground1)[k])


def _points_of_labels(
    pair: AugmentedPair, report: "_Reporter", k: int, scan: AugmentedScan, ground: GroundMap
) -> Iterator[Offence]:
    """Measured points well inside a labelled box and above the ground belong to a labelled object."""
    for row, item in enumerate(pair.objects):
        box = (item.box0, item.box1)[k]
        if item.origin != "labelled" or box is None:
            continue
        reach = float(np.sqrt((box[3:6] ** 2).sum())) / 2.0
        near = np.flatnonzero((scan.source >= 0) & (np.abs(scan.xyz - box[:3]) <= reach).all(axis=1))
        near = near[_in_box(scan.xyz[near], box_pose(box), box[3:6], -_SLACK_M)]
        near = near[scan.xyz[near, 2] - height_at(ground, scan.xyz[near, :2]) > _LABEL_ABOVE_M + _SLACK_M]
        off = np.zeros(len(scan), dtype=bool)
        off[near] = scan.instance[near] < 0
        yield from report.rows(f"instance{k}", off, scan.instance, f"of a point in the box of objects[{row}] is -1")


def flow_is_the_motion(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 5; at status 1 the flow is that of the static world.

    Also where the contract wants status 1: round a moving label, and on one straight behind in a raw scan.
    """
    report = _Reporter(pair, 5)
    scan = pair.scan0
    xyz = scan.xyz.astype(np.float64)
    moved = transform_points(pair.ego_motion, xyz)
    unknown = pair.flow_status0 != 0
    for row, item in enumerate(pair.objects):
        mine = (scan.instance == row) & ~unknown
        if item.motion is None:
            yield from report.rows("flow_status0", mine, pair.flow_status0, f"is 0, objects[{row}] has no motion")
        else:
            moved[mine] = transform_points(item.motion, xyz[mine])
        box = item.box0
        if item.origin != "labelled" or box is None:
            continue
        if pair.scan_kind == "raw" and abs(wrap_angle(np.arctan2(box[1], box[0]) - np.pi)) < _SEAM_RAD:
            yield from report.rows("flow_status0", mine, pair.flow_status0, "is 0 on a label straight behind")
        if abs(item.speed or 0.0) > _SURELY_MOVING_MPS:
            shell = _in_box(scan.xyz, box_pose(box), box[3:6], _SHELL_M - _SLACK_M)
            shell &= ~_in_box(scan.xyz, box_pose(box), box[3:6], _SLACK_M) & (scan.instance < 0) & ~unknown
            yield from report.rows("flow_status0", shell, pair.flow_status0, f"is 0 round the moving objects[{row}]")
    error = np.sqrt(((moved - xyz - pair.flow0) ** 2).sum(axis=1))
    bad = ~(error <= 1e-4)
    yield from report.rows("flow0", bad & ~unknown, pair.flow0, "is not its object's motion", error, "m off")
    yield from report.rows("flow0", bad & unknown, pair.flow0, "at status 1 is not ego-motion", error, "m off")


def motions_are_rigid(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 6; also which fields may be null, that a virtual car's box is its pose's, and its moments."""
    report = _Reporter(pair, 6)
    if not is_rigid(pair.ego_motion):
        yield report.one("ego_motion", pair.ego_motion, "is not a rigid motion to 1e-6")
    for row, item in enumerate(pair.objects):
        name = f"objects[{row}]"
        rigid = {}
        for matrix in ("pose0", "pose1", "motion"):
            value = getattr(item, matrix)
            rigid[matrix] = value is not None and is_rigid(value)
            if value is not None and not rigid[matrix]:
                yield report.one(f"{name}.{matrix}", value, "is not a rigid motion to 1e-6")
        if item.origin == "virtual":
            for needed in (*_OF_VIRTUAL, "box0", "box1", "motion"):
                if getattr(item, needed) is None:
                    yield report.one(f"{name}.{needed}", None, "is null for a virtual car")
        elif any(
            getattr(item, field) is not None for field in ("pose0", "pose1", "model", "rays0", "rays1", "steering")
        ):
            yield report.one(name, item.id, "is labelled and has fields of a virtual car")
        if item.box0 is None and item.box1 is None:
            yield report.one(f"{name}.box0", None, "and box1 are both null")
        if (item.motion is None) != (item.box0 is None or item.box1 is None):
            yield report.one(f"{name}.motion", item.motion, "is null if and only if a box is")
        if all(rigid.values()):
            product = compose(_known(item.pose1), invert(_known(item.pose0)))
            if not np.abs(product - _known(item.motion)).max() <= 1e-6:
                yield report.one(f"{name}.motion", item.motion, "is not pose1 inverse(pose0)")
        if rigid["motion"] and item.box0 is not None and item.box1 is not None and item.motion is not None:
            yield from _box_moves(report, name, item.box0, item.box1, item.motion)
        for k, (box, pose, moment) in enumerate(_in_scans(item)):
            if box is not None and not (box[3:6] > 0.0).all():
                yield report.one(f"{name}.box{k}", box, "has no size")
            if box is not None and pose is not None and rigid[f"pose{k}"]:
                off = np.abs(box[:3] - pose[:3, 3]).max() > 1e-3 or abs(wrap_angle(box[6] - yaw_of(pose))) > 5e-3
                if off:
                    yield report.one(f"{name}.box{k}", box, f"is not where pose{k} is")
            expected = 0.0
            if box is not None and pair.scan_kind == "raw":
                expected = -float(np.arctan2(box[1], box[0])) / (2.0 * np.pi) * (pair.time1 - pair.time0)
            seam = box is not None and abs(wrap_angle(np.arctan2(box[1], box[0]) - np.pi)) < _SEAM_RAD
            if box is not None and not seam and not abs(moment - expected) <= _MOMENT_S:
                message = f"is not when the scanner passes the box ({expected:.4f} s)"
                yield report.one(f"{name}.moment{k}", moment, message)


_OF_VIRTUAL = ("model", "pose0", "pose1", "rays0", "rays1", "speed", "yaw_rate", "steering")


def _box_moves(report: "_Reporter", name: str, box0: F64, box1: F64, motion: F64) -> Iterator[Offence]:
    centre = transform_points(motion, box0[:3])
    if not np.sqrt(((centre - box1[:3]) ** 2).sum()) <= 1e-3:
        yield report.one(f"{name}.box1", box1, "has not the centre of box0 moved by `motion`")
    ahead = rotate_vectors(motion, np.array([np.cos(box0[6]), np.sin(box0[6]), 0.0]))
    if not abs(wrap_angle(np.arctan2(ahead[1], ahead[0]) - box1[6])) <= 5e-3:
        yield report.one(f"{name}.box1", box1, "has not the yaw of box0 turned by `motion`")
    if not np.abs(box0[3:6] - box1[3:6]).max() <= 1e-6:
        yield report.one(f"{name}.box1", box1, "has another size than box0")


# --- 7, 8 -------------------------------------------------------------------------------------------------------------


def returns_have_their_own_ray(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 7 (raw scans); measured points with a tick lie on their ray too, or ring and tick were wrong."""
    if pair.scan_kind != "raw":
        return
    report = _Reporter(pair, 7)
    p = rules.profile
    for k, scan in _scans(pair):
        simulated = scan.source < 0
        known = (scan.ring < p.beams) & (scan.tick < p.lattice_size)
        yield from report.rows(f"tick{k}", simulated & ~known, scan.tick, "of a return is not known")
        rows = None if source is None else (source.rows0, source.rows1)[k]
        fired = _fired_ticks(pair, rules, scan, known, rows)
        key = np.where(known, scan.ring.astype(np.int64) * p.lattice_size + scan.tick, -1)
        new = np.flatnonzero(simulated & known)
        off = np.zeros(len(scan), dtype=bool)
        off[new] = ~fired[scan.tick[new]]
        yield from report.rows(f"tick{k}", off, scan.tick, "was not fired in this scan")
        off = np.zeros(len(scan), dtype=bool)
        off[new] = p.blind[scan.ring[new], scan.tick[new]]
        yield from report.rows(f"tick{k}", off, scan.tick, "lies in the ego car's shadow")
        uses = np.bincount(key[known], minlength=p.beams * p.lattice_size)
        off = np.zeros(len(scan), dtype=bool)
        off[known] = uses[key[known]] > 1
        several = off & simulated
        twice_measured = np.bincount(key[known & ~simulated], minlength=len(uses)) > 1
        off[known] &= twice_measured[key[known]]
        yield from report.rows(f"tick{k}", several, scan.tick, "is on a ray that another return has")
        yield from report.rows(f"tick{k}", off & ~simulated, scan.tick, "is on a ray that another return has")
        on = np.flatnonzero(known)
        origin, direction = rules.rays(scan.ring[on], scan.tick[on])
        along, across = _along_across(scan.xyz[on], origin, direction)
        distance = np.full(len(scan), 0.0)
        distance[on] = np.where(along > 0.0, across, np.inf)
        allowed = np.zeros(len(scan))
        allowed[on] = _ON_RAY_M + _ON_RAY_SHARE * np.abs(along)
        yield from report.rows(f"xyz{k}", ~(distance <= allowed), scan.xyz, "is off its ray", distance, "m")


def _fired_ticks(pair: AugmentedPair, rules: Rules, scan: AugmentedScan, known: Array, rows: Array | None) -> Array:
    """Which ticks (lattice,) were fired: a measured point is on them, or was until a car hid it.

    A car that stands near hides every return of a tick, the sooner the fewer beams there are. Without the source's
    `rows`, two simulated returns or more on one tick speak for it where rows were removed at all.
    """
    size = rules.profile.lattice_size
    fired = np.bincount(scan.tick[known & (scan.source >= 0)], minlength=size) > 0
    new = np.bincount(scan.tick[known & (scan.source < 0)], minlength=size)
    if rows is None:
        return np.asarray(fired | ((new >= 2) & (len(scan.removed) > 0)))
    if (fired | (new == 0)).all():
        return np.asarray(fired)
    removed = scan.removed[(scan.removed >= 0) & (scan.removed < len(rows))]
    _, tick = _rays_of_removed(pair, rules, scan, removed, rows[removed, :3].astype(np.float64))
    fired[tick[tick >= 0]] = True
    return np.asarray(fired)


def cars_hide_what_is_behind(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 8; that removed rows lie behind a car needs the source."""
    report = _Reporter(pair, 8)
    cars = [item for item in pair.objects if _has_poses(item)]
    for k, scan in _scans(pair):
        if source is not None:
            rows = (source.rows0, source.rows1)[k]
            yield from _removed_rows_were_hidden(pair, rules, report, k, scan, rows, cars)
        elif len(scan.removed) and not cars:
            yield report.one(f"removed{k}", scan.removed[0], "there is no virtual car to hide it")
        yield from _nothing_stays_behind(pair, rules, report, k, scan)
        bundle = _bundle(pair, rules, scan) if cars else None
        for item in cars:
            yield from _body_hides(pair, rules, report, k, scan, item, bundle)


def _removed_rows_were_hidden(
    pair: AugmentedPair,
    rules: Rules,
    report: "_Reporter",
    k: int,
    scan: AugmentedScan,
    rows: Array,
    cars: list[ObjectRecord],
) -> Iterator[Offence]:
    removed = scan.removed[(scan.removed >= 0) & (scan.removed < len(rows))]
    if len(removed) == 0:
        return
    xyz = rows[removed, :3].astype(np.float64)
    ring, tick = _rays_of_removed(pair, rules, scan, removed, xyz)
    origin, direction = rules.lines_to(xyz, ring)
    with_tick = np.flatnonzero(tick >= 0)
    origin[with_tick], direction[with_tick] = rules.rays(ring[with_tick], tick[with_tick])
    distance, _ = _along_across(xyz, origin, direction)
    times = _times(pair, rules, np.where(tick >= 0, tick, rules.nearest_tick(xyz, ring)))
    hidden = np.zeros(len(removed), dtype=bool)
    for item in cars:
        size = _known((item.box0, item.box1)[k])[3:6]
        enter, leave = _through_box(pair, rules, item, k, times, origin, direction, -size / 2, size / 2, _MESH_M)
        hidden |= (enter < leave) & (leave > 0.0) & (distance > enter)
    yield from report.rows(f"removed{k}", ~hidden, removed, "is a source row that no virtual car hides", by_value=True)

    on_lattice = (scan.source < 0) & np.isin(scan.surface, _OPAQUE) & (scan.tick < rules.profile.lattice_size)
    new = np.flatnonzero(on_lattice & (scan.ring < rules.profile.beams))
    stop = np.full(rules.profile.beams * rules.profile.lattice_size, -np.inf)
    new_origin, new_direction = rules.rays(scan.ring[new], scan.tick[new])
    key = scan.ring[new].astype(np.int64) * rules.profile.lattice_size + scan.tick[new]
    stop[key] = _along_across(scan.xyz[new], new_origin, new_direction)[0]
    its_stop = stop[ring[with_tick].astype(np.int64) * rules.profile.lattice_size + tick[with_tick]]
    before = np.zeros(len(removed), dtype=bool)
    before[with_tick] = distance[with_tick] < its_stop - _RANGE_NOISE_M
    yield from report.rows(
        f"removed{k}", before & hidden, removed, "is a source row before the return on its ray", by_value=True
    )


def _rays_of_removed(
    pair: AugmentedPair, rules: Rules, scan: AugmentedScan, removed: Array, xyz: F64
) -> tuple[Array, Array]:
    """Ring (K,) and tick (K,; -1 where no ray is near) of removed source rows: their neighbours in the file tell."""
    measured = np.flatnonzero((scan.source >= 0) & (scan.ring < rules.profile.beams))
    if len(measured) == 0:
        return np.zeros(len(removed), np.int64), np.full(len(removed), -1, np.int64)
    after = np.searchsorted(scan.source[measured], removed)
    first = scan.ring[measured[np.maximum(after - 1, 0)]].astype(np.int64)
    last = scan.ring[measured[np.minimum(after, len(measured) - 1)]].astype(np.int64)
    best_ring, best_tick, best = first.copy(), np.full(len(removed), -1, np.int64), np.full(len(removed), np.inf)
    if pair.scan_kind != "raw":
        return best_ring, best_tick
    for ring in (first, last, first + 1, first - 1, last + 1, last - 1):
        ring = np.clip(ring, 0, rules.profile.beams - 1)
        tick = rules.nearest_tick(xyz, ring)
        along, across = _along_across(xyz, *rules.rays(ring, tick))
        better = (across < best) & (across <= _ON_RAY_M + _ON_RAY_SHARE * along)
        best_ring[better], best_tick[better], best[better] = ring[better], tick[better], across[better]
    return best_ring, best_tick


def _nothing_stays_behind(
    pair: AugmentedPair, rules: Rules, report: "_Reporter", k: int, scan: AugmentedScan
) -> Iterator[Offence]:
    p = rules.profile
    message = "is a measured point behind an opaque return of its ray"
    opaque = (scan.source < 0) & np.isin(scan.surface, _OPAQUE) & (scan.ring < p.beams)
    measured = (scan.source >= 0) & (scan.ring < p.beams)
    off = np.zeros(len(scan), dtype=bool)
    if pair.scan_kind == "raw":
        opaque, measured = opaque & (scan.tick < p.lattice_size), measured & (scan.tick < p.lattice_size)
        stop = np.full(p.beams * p.lattice_size, np.inf)
        new, old = np.flatnonzero(opaque), np.flatnonzero(measured)
        reach = np.sqrt((scan.xyz.astype(np.float64) ** 2).sum(axis=1))
        stop[scan.ring[new].astype(np.int64) * p.lattice_size + scan.tick[new]] = reach[new]
        off[old] = reach[old] > stop[scan.ring[old].astype(np.int64) * p.lattice_size + scan.tick[old]]
    else:
        for ring in np.unique(scan.ring[opaque]):
            new, old = np.flatnonzero(opaque & (scan.ring == ring)), np.flatnonzero(measured & (scan.ring == ring))
            beside = _beside(rules, scan.xyz[new], scan.xyz[old], ring)
            for a, b in beside:
                far = (scan.xyz[old[b]] ** 2).sum() > (scan.xyz[new[a]] ** 2).sum()
                off[old[b]] |= bool(far)
    yield from report.rows(f"xyz{k}", off, scan.xyz, message)


def _beside(rules: Rules, new: Array, old: Array, ring: int) -> list[tuple[int, int]]:
    """Pairs (of new, of old) of points on one ring in the same direction."""
    if len(new) == 0 or len(old) == 0:
        return []
    _, d_new = rules.lines_to(new, np.full(len(new), ring))
    _, d_old = rules.lines_to(old, np.full(len(old), ring))
    azimuth_new, azimuth_old = np.arctan2(d_new[:, 1], d_new[:, 0]), np.arctan2(d_old[:, 1], d_old[:, 0])
    order = np.argsort(azimuth_old, kind="stable")
    first = np.searchsorted(azimuth_old[order], azimuth_new - _SAME_RAY_RAD)
    last = np.searchsorted(azimuth_old[order], azimuth_new + _SAME_RAY_RAD, side="right")
    pairs = [(int(a), int(order[i])) for a in np.flatnonzero(last > first) for i in range(first[a], last[a])]
    return [(a, b) for a, b in pairs if abs(d_new[a, 2] - d_old[b, 2]) <= _SAME_RAY_RAD]


def _bundle(pair: AugmentedPair, rules: Rules, scan: AugmentedScan) -> tuple[Array, Array] | None:
    """Fired ticks (F,) of a raw scan, and the measured point (-1: none) of every ring and tick."""
    if pair.scan_kind != "raw":
        return None
    p = rules.profile
    measured = np.flatnonzero((scan.source >= 0) & (scan.ring < p.beams) & (scan.tick < p.lattice_size))
    ring, tick = scan.ring[measured].astype(np.int64), scan.tick[measured].astype(np.int64)
    point = np.full(p.beams * p.lattice_size, -1)
    point[ring * p.lattice_size + tick] = measured
    return np.flatnonzero(np.bincount(tick, minlength=p.lattice_size)), point


def _body_hides(
    pair: AugmentedPair,
    rules: Rules,
    report: "_Reporter",
    k: int,
    scan: AugmentedScan,
    item: ObjectRecord,
    bundle: tuple[Array, Array] | None,
) -> Iterator[Offence]:
    """At most 1 % of the rays through the middle of the body keep a measured point beyond it."""
    p = rules.profile
    pose, box = _known((item.pose0, item.pose1)[k]), _known((item.box0, item.box1)[k])
    share, low, high = _MIDDLE
    size = box[3:6]
    lower = np.array([-share * size[0] / 2, -share * size[1] / 2, (low - 0.5) * size[2]])
    upper = np.array([share * size[0] / 2, share * size[1] / 2, (high - 0.5) * size[2]])
    bearing = np.arctan2(pose[1, 3], pose[0, 3])
    centre_m = max(float(np.hypot(pose[0, 3], pose[1, 3])), 0.1)
    half_m = float(np.hypot(size[0], size[1])) / 2.0
    window = np.pi if centre_m <= half_m + 0.5 else float(np.arcsin(half_m / centre_m)) + np.deg2rad(3.0)

    if bundle is not None:
        fired, point = bundle
        steps = fired[None, :] + p.tick_offset[:, None]
        azimuth = wrap_angle(2.0 * np.pi / p.lattice_size * steps + p.azimuth_rad[:, None] - bearing)
        ring, column = np.nonzero(np.abs(azimuth) <= window)
        tick = fired[column]
        origin, direction = rules.rays(ring, tick)
        times = _times(pair, rules, tick)
        kept = point[ring * p.lattice_size + tick]
    else:
        near = np.abs(wrap_angle(np.arctan2(scan.xyz[:, 1], scan.xyz[:, 0]) - bearing)) <= window + 0.05
        index = np.flatnonzero(near & (scan.ring < p.beams))
        origin, direction = rules.lines_to(scan.xyz[index], scan.ring[index])
        times = np.zeros(len(index))
        kept = np.where(scan.source[index] >= 0, index, -1)
    enter, leave = _through_box(pair, rules, item, k, times, origin, direction, lower, upper, 0.0)
    through = (enter < leave) & (enter > 0.0)
    along, _ = _along_across(scan.xyz[kept], origin, direction)
    beyond = through & (kept >= 0) & (along > enter)
    if beyond.sum() > _KEPT_SHARE * through.sum():
        row = int(kept[np.flatnonzero(beyond)[0]])
        message = f"is one of {beyond.sum()} kept beyond {item.id}, of {through.sum()} rays through its body"
        yield report.one(f"xyz{k}[{row}]", scan.xyz[row], message)


# --- 9, 10 ------------------------------------------------------------------------------------------------------------


def cars_have_room(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 9, with the seam rule, and speed and yaw rate against the poses."""
    report = _Reporter(pair, 9)
    rows = [row for row, item in enumerate(pair.objects) if item.origin == "virtual"]
    fewest, most = rules.cars
    if not fewest <= len(rows) <= most:
        yield report.one("objects", len(rows), f"virtual cars, {fewest} to {most} were asked for")
    if rows and not any(abs(pair.objects[row].speed or 0.0) > _MOVING_MPS for row in rows):
        yield report.one("objects.speed", [pair.objects[row].speed for row in rows], "no virtual car moves")
    for row in rows:
        item = pair.objects[row]
        for k, (scan, count) in enumerate(((pair.scan0, item.points0), (pair.scan1, item.points1))):
            returns = int(np.count_nonzero((scan.instance == row) & (scan.source < 0)))
            if returns < rules.min_points:
                yield report.one(
                    f"objects[{row}].points{k}", count, f"{returns} returns, {rules.min_points} are needed"
                )
        if not _has_poses(item):
            continue
        for k, scan in _scans(pair):
            box, pose = _known((item.box0, item.box1)[k]), _known((item.pose0, item.pose1)[k])
            yield from _touches(pair, report, row, k, box)
            reach = float(np.sqrt((box[3:6] ** 2).sum())) / 2.0
            near = np.flatnonzero((scan.source >= 0) & (np.abs(scan.xyz - pose[:3, 3]) <= reach).all(axis=1))
            height = transform_points(invert(pose), scan.xyz[near])[:, 2] + box[5] / 2.0
            inside = _in_box(scan.xyz[near], pose, box[3:6], 0.0) & (height > _UNDERSIDE_M)
            off = np.zeros(len(scan), dtype=bool)
            off[near[inside]] = True
            yield from report.rows(f"xyz{k}", off, scan.xyz, f"is a measured point inside {item.id}")
        yield from _moves_as_said(pair, report, row, item)
        if pair.scan_kind == "raw":
            yield from _stays_off_the_seam(pair, rules, report, row, item)


def _touches(pair: AugmentedPair, report: "_Reporter", row: int, k: int, box: F64) -> Iterator[Offence]:
    corners = footprint_corners(box)
    for other, item in enumerate(pair.objects):
        other_box = (item.box0, item.box1)[k]
        if other_box is None or other == row or (item.origin == "virtual" and other < row):
            continue
        if footprints_overlap(corners, footprint_corners(other_box)):
            yield report.one(f"objects[{row}].box{k}", box, f"touches the box of objects[{other}] ({item.id})")


def _moves_as_said(pair: AugmentedPair, report: "_Reporter", row: int, item: ObjectRecord) -> Iterator[Offence]:
    """Speed over ground along the car's axis, and yaw rate, from poses, moments and ego-motion."""
    _, twist = _twists(pair, item)
    for name, said, found in (("speed", item.speed, twist[0]), ("yaw_rate", item.yaw_rate, twist[5])):
        if said is not None and not abs(said - found) <= 0.02 + 0.02 * abs(said):
            yield report.one(f"objects[{row}].{name}", said, f"its poses move at {found:.4f}")


def _stays_off_the_seam(
    pair: AugmentedPair, rules: Rules, report: "_Reporter", row: int, item: ObjectRecord
) -> Iterator[Offence]:
    box = _known(item.box0)
    half = box[3:6] / 2.0
    corners = np.array([[sx, sy, sz] for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)]) * half
    last = pair.time1 - pair.time0 + item.moment1
    poses = _car_at(pair, item, np.linspace(item.moment0, last, 9))
    azimuth = np.concatenate([np.arctan2(c[:, 1], c[:, 0]) for c in (transform_points(T, corners) for T in poses)])
    behind = np.abs(wrap_angle(azimuth - np.pi))
    if behind.min() < _SEAM_RAD - _SEAM_SLACK_RAD:
        degrees = np.rad2deg(behind.min())
        yield report.one(f"objects[{row}].box0", box, f"comes within {degrees:.1f} degrees of straight behind")


def cars_stand_on_the_ground(pair: AugmentedPair, rules: Rules, source: Source | None) -> Iterator[Offence]:
    """Invariant 10: four wheels against the height map of each source scan."""
    if source is None:
        return
    report = _Reporter(pair, 10)
    for row, item in enumerate(pair.objects):
        if not _has_poses(item):
            continue
        for k, ground in enumerate((source.ground0, source.ground1)):
            box, pose = _known((item.box0, item.box1)[k]), _known((item.pose0, item.pose1)[k])
            along, beside = _WHEELS
            wheels = np.array(
                [[a * along * box[3], b * beside * box[4], -box[5] / 2.0] for a in (-1, 1) for b in (-1, 1)]
            )
            contact = transform_points(pose, wheels)
            gap = contact[:, 2] - height_at(ground, contact[:, :2])
            worst = float(gap[np.argmax(np.abs(gap))])
            if not abs(worst) <= _WHEEL_M:
                yield report.one(f"objects[{row}].pose{k}", pose[:3, 3], f"a wheel of {item.id} is {worst:+.3f} m off")


CHECKS: dict[int, Check] = {
    1: columns_are_sound,
    2: measured_points_are_untouched,
    3: nothing_appears_or_vanishes,
    4: instances_agree,
    5: flow_is_the_motion,
    6: motions_are_rigid,
    7: returns_have_their_own_ray,
    8: cars_hide_what_is_behind,
    9: cars_have_room,
    10: cars_stand_on_the_ground,
}


# --- geometry shared by the checks --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Reporter:
    pair: AugmentedPair
    invariant: int

    def one(self, column: str, value: Any, message: str) -> Offence:
        return Offence(self.pair.pair_id, self.invariant, column, _text(value), message)

    def rows(
        self,
        column: str,
        off: Any,
        values: Array,
        message: str,
        amount: Array | None = None,
        unit: str = "",
        by_value: bool = False,
    ) -> Iterator[Offence]:
        """One offence for a column: its first offender, and how many there are."""
        count = int(np.count_nonzero(off))
        if count == 0:
            return
        row = int(np.flatnonzero(off)[0])
        if amount is not None:
            message = (
                f"{message} by {amount[row]:.3g} {unit}" if unit == "m" else f"{message}: {amount[row]:.3g} {unit}"
            )
        if count > 1:
            message = f"{message} (and {count - 1} more)"
        yield self.one(column if by_value else f"{column}[{row}]", values[row], message)


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return "[" + " ".join(f"{v:.6g}" for v in value.reshape(-1)) + "]"
    if isinstance(value, float | np.floating):
        return f"{value:.6g}"
    return str(value)


def _scans(pair: AugmentedPair) -> tuple[tuple[int, AugmentedScan], ...]:
    return ((0, pair.scan0), (1, pair.scan1))


def _in_scans(item: ObjectRecord) -> tuple[tuple[F64 | None, F64 | None, float], ...]:
    return ((item.box0, item.pose0, item.moment0), (item.box1, item.pose1, item.moment1))


def _has_poses(item: ObjectRecord) -> bool:
    """A virtual car whose poses and boxes can be reckoned with."""
    if item.origin != "virtual" or item.box0 is None or item.box1 is None:
        return False
    if not np.isfinite(np.concatenate([item.box0, item.box1, [item.moment0, item.moment1]])).all():
        return False
    return (
        item.pose0 is not None and item.pose1 is not None and all(is_rigid(T, 1e-3) for T in (item.pose0, item.pose1))
    )


def _known(value: F64 | None) -> F64:
    assert value is not None  # `_has_poses` was asked
    return value


def _in_box(points: Array, T_velo_box: F64, size: Array, grow_m: float) -> Array:
    local = transform_points(invert(T_velo_box), points)
    return np.asarray((np.abs(local) <= size / 2.0 + grow_m).all(axis=1))


def _along_across(xyz: Array, origin: F64, direction: F64) -> tuple[F64, F64]:
    """Distance (K,) of points along rays, and from them."""
    offset = xyz - origin
    along = (offset * direction).sum(axis=1)
    return along, np.sqrt(((offset - along[:, None] * direction) ** 2).sum(axis=1))


def _times(pair: AugmentedPair, rules: Rules, tick: Array) -> F64:
    """When rays fire, from the scan's middle; NaN where the car is cast at its moment instead."""
    if pair.scan_kind != "raw" or not rules.rolling:
        return np.full(len(tick), np.nan)
    return rules.firing_time(tick, pair.time1 - pair.time0)


def _through_box(
    pair: AugmentedPair,
    rules: Rules,
    item: ObjectRecord,
    k: int,
    times: F64,
    origin: F64,
    direction: F64,
    lower: Array,
    upper: Array,
    grow_m: float,
) -> tuple[F64, F64]:
    """Where rays (K, 3) enter and leave a box in the car's frame, as the car stands at each ray's own time."""
    at, which = np.unique(times, return_inverse=True)
    start = k * (pair.time1 - pair.time0)
    if pair.scan_kind == "raw" and rules.rolling:
        T_car_velo = invert(_car_at(pair, item, start + at))[which.reshape(-1)]
    else:
        T_car_velo = np.broadcast_to(invert(_known((item.pose0, item.pose1)[k])), (len(times), 4, 4))
    local, heading = transform_points(T_car_velo, origin), rotate_vectors(T_car_velo, direction)
    heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)
    one, other = (lower - grow_m - local) / heading, (upper + grow_m - local) / heading
    return np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)


def _twists(pair: AugmentedPair, item: ObjectRecord) -> tuple[F64, F64]:
    """Twists (6,) per second of the scanner and of a car, each in its own frame: constant through their poses."""
    interval = pair.time1 - pair.time0
    ego = se3_log(invert(pair.ego_motion)) / interval
    last = interval + item.moment1
    T_world_car0 = compose(se3_exp(ego, item.moment0), _known(item.pose0))
    T_world_car1 = compose(se3_exp(ego, last), _known(item.pose1))
    return ego, se3_log(compose(invert(T_world_car0), T_world_car1)) / (last - item.moment0)


def _car_at(pair: AugmentedPair, item: ObjectRecord, times: F64) -> F64:
    """`T_velo_car` (K, 4, 4) at times (K,) from the middle of scan 0, in the frame that the scanner has then."""
    ego, twist = _twists(pair, item)
    T_world_car0 = compose(se3_exp(ego, item.moment0), _known(item.pose0))
    T_world_car = compose(T_world_car0, se3_exp(twist, times - item.moment0))
    return compose(invert(se3_exp(ego, times)), T_world_car)
