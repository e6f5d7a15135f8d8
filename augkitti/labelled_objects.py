"""Labelled objects: a pair's own labels in, contract rows with rigid motion and the points of each object out."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from augkitti import same_math as sm
from augkitti.frames import (
    F64,
    Array,
    box_pose,
    compose,
    invert,
    points_in_box,
    wrap_angle,
    yaw_of,
)
from augkitti.ground import height_at
from augkitti.pair_motion import T_world_scanner, ego_twist
from augkitti.scan_pair import I16, LabelledBox, LabelledObjects, ObjectRecord, PreparedScan, ScanPair
from augkitti.scanner import azimuth_time

ABOVE_GROUND_M = 0.15  # contract: lower points in a box are ground
SHELL_M = 0.2  # contract: round a moving labelled box the flow is not known
SEAM_RAD = np.deg2rad(15.0)  # contract: straight behind, the sweep sees things twice or not at all
_STANDING_M = 0.1  # displacement over ground below which a box stands: boxes of parked cars wander by 6 cm a scan


def label_points(pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan) -> LabelledObjects:
    """Match the boxes of both scans by id, give each its motion, and find its points."""
    objects = label_objects(pair)
    boxes0 = [o.box0 for o in objects]
    instance0 = _points_of(prepared0, boxes0)
    instance1 = _points_of(prepared1, [o.box1 for o in objects])
    unknown0 = np.zeros(len(pair.scan0), dtype=bool)
    for row, item in enumerate(objects):
        mine = instance0 == row
        if item.motion is None or (pair.scan0.kind == "raw" and (_at_seam(item.box0) or _at_seam(item.box1))):
            unknown0 |= mine
        if item.box0 is not None and (
            item.motion is None or abs(item.speed or 0.0) * pair_interval(pair) > _STANDING_M
        ):
            near = _near(pair.scan0.xyz.T, item.box0, SHELL_M)
            xyz, T_velo_box, size = pair.scan0.xyz[near], box_pose(item.box0), item.box0[3:6]
            shell = points_in_box(xyz, T_velo_box, size, SHELL_M) & ~points_in_box(xyz, T_velo_box, size)
            unknown0[near[shell & (instance0[near] < 0)]] = True
    return LabelledObjects(objects, instance0, instance1, unknown0)


def label_objects(pair: ScanPair) -> tuple[ObjectRecord, ...]:
    """The contract's rows of a pair's labels, each with its motion; points are not counted yet."""
    by_id1 = {label.id: label for label in pair.labels1}
    ids0 = {label.id for label in pair.labels0}
    rows: list[tuple[LabelledBox | None, LabelledBox | None]] = [(a, by_id1.get(a.id)) for a in pair.labels0]
    rows += [(None, label) for label in pair.labels1 if label.id not in ids0]
    twist = ego_twist(pair.ego_motion, pair_interval(pair))
    return tuple(_object(pair, twist, first, second) for first, second in rows)


def pair_interval(pair: ScanPair) -> float:
    """Seconds from the middle of scan 0 to the middle of scan 1."""
    return pair.scan1.time_s - pair.scan0.time_s


def _object(pair: ScanPair, twist: F64, first: LabelledBox | None, second: LabelledBox | None) -> ObjectRecord:
    named = first or second
    assert named is not None
    moment0 = _moment(pair.scan0.kind, first, pair.scan0.period_s)
    moment1 = _moment(pair.scan1.kind, second, pair.scan1.period_s)
    item = ObjectRecord(
        id=named.id,
        category=named.category,
        origin="labelled",
        box0=None if first is None else first.box,
        box1=None if second is None else second.box,
        moment0=moment0,
        moment1=moment1,
    )
    if first is None or second is None:
        return item
    box1 = np.concatenate([second.box[:3], first.box[3:6], second.box[6:]])  # one body: one size
    T_velo0_box, T_velo1_box = box_pose(first.box), box_pose(box1)
    elapsed = pair_interval(pair) + moment1 - moment0
    T_world_box0 = compose(T_world_scanner(twist, moment0), T_velo0_box)
    T_world_box1 = compose(T_world_scanner(twist, pair_interval(pair) + moment1), T_velo1_box)
    moved = T_world_box1[:3, 3] - T_world_box0[:3, 3]
    forward = float((moved * T_world_box0[:3, 0]).sum())
    return replace(
        item,
        box1=box1,
        motion=compose(T_velo1_box, invert(T_velo0_box)),
        speed=float(np.copysign(np.sqrt((moved * moved).sum()), forward)) / elapsed,
        yaw_rate=float(wrap_angle(yaw_of(T_world_box1) - yaw_of(T_world_box0))) / elapsed,
    )


def _moment(kind: str, label: LabelledBox | None, period_s: float) -> float:
    if label is None or kind == "compensated":
        return 0.0
    return azimuth_time(float(sm.arctan2(label.box[1], label.box[0])), period_s)


def _at_seam(box: F64 | None) -> bool:
    return box is not None and abs(float(wrap_angle(sm.arctan2(box[1], box[0]) - np.pi))) < SEAM_RAD


def _points_of(prepared: PreparedScan, boxes: list[F64 | None]) -> I16:
    xyz: Array = prepared.scan.xyz
    owner = np.full(len(xyz), -1, dtype=np.int16)
    for row, box in enumerate(boxes):
        if box is None:
            continue
        near = prepared.standing[_near(prepared.standing_xyz, box, 0.0)]
        near = near[points_in_box(xyz[near], box_pose(box), box[3:6])]
        above = xyz[near, 2] - height_at(prepared.ground, xyz[near, :2].astype(np.float64)) > ABOVE_GROUND_M
        near = near[above]
        owner[near[owner[near] < 0]] = row
    return owner


def _near(xy: Array, box: F64, grow_m: float) -> npt.NDArray[np.intp]:
    """Indices of the points (2 or 3, N) in the upright square round a box, grown all round: a first, quick choice."""
    reach = float(sm.hypot(box[3] / 2.0 + grow_m, box[4] / 2.0 + grow_m)) + 0.01
    near = np.flatnonzero(np.abs(xy[0] - float(box[0])) <= reach)
    return np.asarray(near[np.abs(xy[1, near] - float(box[1])) <= reach])
