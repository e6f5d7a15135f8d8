"""A small drive in KITTI raw layout, made in code: a flat road, houses, a parked car and a moving one.

Each scan is cast ray by ray with the shipped profile, every ray at its own firing time from a scanner that drives on
an arc, so that ticks, seam and rolling are those of a real scan; ranges and coordinates are rounded as the scanner's.
All truth is known: `TinyDrive.T_velo1_velo0` and the boxes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from augkitti.frames import compose, invert, pose_from_xyz_yaw, rotate_vectors, se3_exp, transform_points, yaw_of
from augkitti.scanner import azimuth_time, fire_rays, load_profile, ray_lines

PERIOD_S = 0.1035
PACKET_DELAY_S = 0.017
EPOCH_S = 1317042000.0  # 2011-09-26 13:00:00 UTC
GROUND_Z_M = -1.73
T_VELO_IMU = pose_from_xyz_yaw(-0.81, 0.32, -0.8, 0.0)
CAM_FROM_VELO = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
CAM_OFFSET_M = np.array([0.0, -0.08, -0.27])


@dataclass(frozen=True)
class Body:
    """A box that stands or drives straight on; world frame = velo at time 0."""

    name: str
    x: float
    y: float
    yaw: float
    size: tuple[float, float, float]  # length, width, height
    speed_mps: float = 0.0
    reflectance: float = 0.3

    def T_world_body(self, time_s):
        step = self.speed_mps * time_s
        x, y = self.x + step * np.cos(self.yaw), self.y + step * np.sin(self.yaw)
        return pose_from_xyz_yaw(x, y, GROUND_Z_M + self.size[2] / 2.0, self.yaw)


SCENE = (
    Body("house", 12.0, 11.0, 0.0, (14.0, 6.0, 7.0), reflectance=0.25),
    Body("house", 30.0, 12.0, 0.0, (12.0, 6.0, 6.0), reflectance=0.4),
    Body("house", -12.0, 11.5, 0.0, (16.0, 6.0, 7.0), reflectance=0.2),
    Body("house", 18.0, -12.0, 0.0, (16.0, 6.0, 5.0), reflectance=0.3),
    Body("house", -14.0, -12.0, 0.1, (12.0, 6.0, 6.0), reflectance=0.35),
    Body("house", 60.0, 2.0, 0.3, (8.0, 20.0, 8.0), reflectance=0.3),
    Body("parked", 9.0, 5.0, 0.05, (4.2, 1.8, 1.5), reflectance=0.1),
    Body("moving", 16.0, -3.0, 0.0, (4.0, 1.7, 1.5), speed_mps=9.0, reflectance=0.2),
)
LABELLED = ("parked", "moving")


@dataclass(frozen=True)
class TinyDrive:
    """What was written, and its truth."""

    root: Path
    folder: Path
    name: str
    frames: tuple[int, ...]
    T_velo1_velo0: np.ndarray  # the same between all neighbours
    boxes: dict[int, dict[str, np.ndarray]]  # frame -> "parked", "moving" -> contract box


def write_drive(
    root: Path,
    frames: tuple[int, ...] = (0, 1, 2),
    name: str = "2011_09_26_drive_0005_sync",
    labels: str = "tracklets",
    oxts: bool = True,
    truth: bool = False,
    speed_mps: float = 8.0,
    yaw_rate_rps: float = 0.08,
    firings: int = 2150,
    scene: tuple[Body, ...] = SCENE,
) -> TinyDrive:
    """Write `root/raw/DATE/NAME` with its calibration.

    Args:
        frames: numbers of the scans; frames[0] is at the world's origin. Timestamps cover the whole drive from 0, with
            blank lines in the gaps between the frames.
        labels: "tracklets", "tracking" (needs a drive that the manifest knows as one of tracking) or "none".
        oxts: whether there are OXTS packets.
        truth: whether a sidecar gives exact poses and full labels.
        firings: fired ticks a scan, of 4000; a real scan has about 2150.
    """
    twist = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, yaw_rate_rps])

    def T_world_velo(time_s):
        return se3_exp(twist, time_s)

    folder = root / "raw" / name[:10] / name
    (folder / "velodyne_points" / "data").mkdir(parents=True)
    boxes = {}
    for frame in frames:
        middle_s = (frame - frames[0]) * PERIOD_S
        scan = cast_scan(scene, T_world_velo, middle_s, firings)
        scan.tofile(folder / "velodyne_points" / "data" / f"{frame:010d}.bin")
        boxes[frame] = {body.name: box_in_scan(body, T_world_velo, middle_s) for body in scene if body.name in LABELLED}
    write_calibration(folder.parent)
    write_timestamps(folder, frames)
    if oxts:
        write_oxts(folder, frames, T_world_velo, twist)
    if labels == "tracklets":
        (folder / "tracklet_labels.xml").write_text(tracklets_xml(boxes))
    elif labels == "tracking":
        write_tracking_labels(root / "tracking" / "training", "0000", boxes)
    if truth:
        (folder / "augkitti_source.json").write_text('{"label_coverage": "full", "velo_poses": "velo_poses.txt"}')
        write_poses(folder / "velo_poses.txt", frames, T_world_velo)
    step = compose(invert(T_world_velo(PERIOD_S)), T_world_velo(0.0))
    return TinyDrive(root, folder, name, tuple(frames), step, boxes)


def cast_scan(
    scene: tuple[Body, ...], T_world_velo: Callable[..., np.ndarray], middle_s: float, firings: int
) -> np.ndarray:
    """Rows (N, 4) float32 of one scan in KITTI's order."""
    profile = load_profile()
    ticks = np.unique(np.linspace(0, profile.lattice_size - 1, firings).astype(np.uint16))
    rays = fire_rays(profile, ticks, PERIOD_S)
    origin, direction = ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
    times = middle_s + rays.ray_time_s
    T = T_world_velo(times)
    start, along = transform_points(T, origin), rotate_vectors(T, direction)
    with np.errstate(divide="ignore"):
        distance = np.where(along[:, 2] < 0.0, (GROUND_Z_M - start[:, 2]) / along[:, 2], np.inf)
    reflectance = np.full(len(rays), 0.15)
    for body in scene:
        hit = _distance_to_box(body, start, along, times)
        reflectance = np.where(hit < distance, body.reflectance, reflectance)
        distance = np.minimum(distance, hit)
    phase, quantum = profile.range_phase_m[rays.ray_ring], profile.range_quantum_m
    returned = ~rays.ray_blind & (distance > profile.min_range_m) & (distance < profile.max_range_m)
    distance = np.round((distance[returned] - phase[returned]) / quantum) * quantum + phase[returned]
    xyz = np.round(origin[returned] + distance[:, None] * direction[returned], 3)
    ring, azimuth = rays.ray_ring[returned], np.arctan2(xyz[:, 1], xyz[:, 0]) % (2.0 * np.pi)
    order = np.lexsort((azimuth, ring))
    return np.column_stack([xyz, reflectance[returned]])[order].astype("<f4")


def _distance_to_box(body: Body, start: np.ndarray, along: np.ndarray, times: np.ndarray) -> np.ndarray:
    T_body_world = invert(body.T_world_body(0.0))
    travelled = np.column_stack([body.speed_mps * times, np.zeros((len(times), 2))])
    local, heading = transform_points(T_body_world, start) - travelled, rotate_vectors(T_body_world, along)
    half = np.array(body.size) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - local) / heading, (half - local) / heading
    enter, leave = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.where((enter > 0.0) & (enter < leave), enter, np.inf)


def box_in_scan(body: Body, T_world_velo: Callable[..., np.ndarray], middle_s: float) -> np.ndarray:
    """The contract box of a body in a scan: where it is when the scanner looks at it."""
    moment_s = 0.0
    for _ in range(5):
        time_s = middle_s + moment_s
        T_velo_body = compose(invert(T_world_velo(time_s)), body.T_world_body(time_s))
        moment_s = azimuth_time(float(np.arctan2(T_velo_body[1, 3], T_velo_body[0, 3])), PERIOD_S)
    return np.array([*T_velo_body[:3, 3], *body.size, yaw_of(T_velo_body)])


def write_calibration(folder: Path) -> None:
    """The day's three calibration files."""

    def text(values):
        return " ".join(f"{value:.9e}" for value in np.asarray(values).ravel())

    (folder / "calib_imu_to_velo.txt").write_text(
        f"calib_time: 25-May-2012 16:47:16\nR: {text(T_VELO_IMU[:3, :3])}\nT: {text(T_VELO_IMU[:3, 3])}\n"
    )
    (folder / "calib_velo_to_cam.txt").write_text(
        f"calib_time: 15-Mar-2012 11:37:16\nR: {text(CAM_FROM_VELO)}\nT: {text(CAM_OFFSET_M)}\n"
    )
    P = [[720.0, 0.0, 610.0, 45.0], [0.0, 720.0, 173.0, 0.2], [0.0, 0.0, 1.0, 0.003]]
    (folder / "calib_cam_to_cam.txt").write_text(
        f"corner_dist: 9.95e-02\nR_rect_00: {text(np.eye(3))}\nS_rect_02: 1.242e+03 3.75e+02\nP_rect_02: {text(P)}\n"
    )


def stamp(time_s: float) -> str:
    """A line of KITTI's timestamps: UTC with nanoseconds."""
    whole = int(np.floor(time_s))
    return f"{datetime.fromtimestamp(whole, UTC):%Y-%m-%d %H:%M:%S}.{round((time_s - whole) * 1e9):09d}"


def write_timestamps(folder: Path, frames: tuple[int, ...]) -> None:
    """Timestamps of the whole drive; blank where a scan is missing between the first and the last."""
    for part, offset_s in (("", 0.0), ("_start", -PERIOD_S / 2.0), ("_end", PERIOD_S / 2.0)):
        lines = []
        for n in range(max(frames) + 3):
            gap = min(frames) < n < max(frames) and n not in frames
            lines.append("" if gap else stamp(EPOCH_S + (n - frames[0]) * PERIOD_S + offset_s))
        (folder / "velodyne_points" / f"timestamps{part}.txt").write_text("\n".join(lines) + "\n")


def write_oxts(
    folder: Path, frames: tuple[int, ...], T_world_velo: Callable[..., np.ndarray], twist: np.ndarray
) -> None:
    """Packets 17 ms after each scan's middle; east is the world's x."""
    (folder / "oxts" / "data").mkdir(parents=True)
    speed_imu = twist[:3] + np.cross(twist[3:], T_VELO_IMU[:3, 3])  # of the imu's origin, in velo
    for frame in frames:
        T = T_world_velo((frame - frames[0]) * PERIOD_S + PACKET_DELAY_S)
        east, north, up = rotate_vectors(T, speed_imu)
        row = [49.0, 8.4, 112.0, 0.0, 0.0, yaw_of(T), north, east, *speed_imu[:2], up]
        row += [0.0] * 6 + [0.0, 0.0, twist[5]] * 2 + [0.5, 0.07, 4, 10, 4, 4, 0]
        (folder / "oxts" / "data" / f"{frame:010d}.txt").write_text(" ".join(repr(float(v)) for v in row) + "\n")
    lines = [stamp(EPOCH_S + (n - frames[0]) * PERIOD_S + PACKET_DELAY_S) for n in range(max(frames) + 3)]
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(lines) + "\n")


def write_poses(path: Path, frames: tuple[int, ...], T_world_velo: Callable[..., np.ndarray]) -> None:
    """Exact poses of the scans' middles, one line a frame number."""
    lines = []
    for n in range(max(frames) + 1):
        T = T_world_velo((n - frames[0]) * PERIOD_S)
        lines.append(" ".join(repr(float(v)) for v in T[:3].ravel()) if n in frames else "")
    path.write_text("\n".join(lines) + "\n")


def tracklets_xml(boxes: dict[int, dict[str, np.ndarray]]) -> str:
    """`tracklet_labels.xml` of boxes by frame and name, one tracklet a name over all frames without gaps."""
    items = []
    for name in sorted({name for named in boxes.values() for name in named}):
        first = min(boxes)
        poses = ""
        for frame in range(first, max(boxes) + 1):
            x, y, z, _, _, height, yaw = (float(v) for v in boxes.get(frame, boxes[first])[name])
            poses += f"<item><tx>{x!r}</tx><ty>{y!r}</ty><tz>{z - height / 2!r}</tz><rx>0</rx><ry>0</ry>"
            poses += f"<rz>{yaw!r}</rz><state>2</state><truncation>0</truncation></item>\n"
        length, width, height = (float(v) for v in boxes[first][name][3:6])
        items.append(
            f"<item><objectType>Car</objectType><h>{height}</h><w>{width}</w><l>{length}</l>"
            f"<first_frame>{first}</first_frame><poses><count>{len(boxes)}</count>{poses}</poses></item>\n"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        f'<boost_serialization signature="serialization::archive" version="9">\n<tracklets><count>{len(items)}</count>'
        f"{''.join(items)}</tracklets></boost_serialization>\n"
    )


def write_tracking_labels(folder: Path, number: str, boxes: dict[int, dict[str, np.ndarray]]) -> None:
    """`label_02/NUMBER.txt` and its `calib`, with one DontCare row a frame."""
    (folder / "label_02").mkdir(parents=True)
    (folder / "calib").mkdir()
    lines = []
    for frame, named in sorted(boxes.items()):
        lines.append(f"{frame} -1 DontCare -1 -1 -10 1 2 3 4 -1000 -1000 -1000 -10 -1 -1 -1")
        for track, name in enumerate(sorted(named)):
            x, y, z, length, width, height, yaw = (float(v) for v in named[name])
            cam = CAM_FROM_VELO @ np.array([x, y, z - height / 2.0]) + CAM_OFFSET_M
            place = " ".join(repr(float(v)) for v in (height, width, length, *cam, -yaw - np.pi / 2.0))
            lines.append(f"{frame} {track} Car 0 0 0 1 2 3 4 {place}")
    (folder / "label_02" / f"{number}.txt").write_text("\n".join(lines) + "\n")
    tr = np.column_stack([CAM_FROM_VELO, CAM_OFFSET_M])
    P2 = "720 0 610 45 0 720 173 0.2 0 0 1 0.003"
    (folder / "calib" / f"{number}.txt").write_text(
        f"P2: {P2}\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: {' '.join(map(str, tr.ravel()))}\n"
    )


def write_odometry(root: Path, frames: tuple[int, ...] = (0, 1), number: str = "04", speed_mps: float = 8.0) -> Path:
    """`root/odometry/sequences/NUMBER` with poses and times: snapshots, as compensated scans are."""
    folder = root / "odometry" / "sequences" / number
    (folder / "velodyne").mkdir(parents=True)
    (root / "odometry" / "poses").mkdir()
    twist = np.array([speed_mps, 0.0, 0.0, 0.0, 0.0, 0.08])
    tr = np.vstack([np.column_stack([CAM_FROM_VELO, CAM_OFFSET_M]), [0.0, 0.0, 0.0, 1.0]])
    poses, times = [], []
    for n in range(max(frames) + 1):
        T_world_velo = se3_exp(twist, n * PERIOD_S)
        poses.append(" ".join(f"{v:.9e}" for v in compose(compose(tr, T_world_velo), invert(tr))[:3].ravel()))
        times.append(f"{n * PERIOD_S:.6e}")
        if n in frames:
            still = np.broadcast_to(T_world_velo, (1, 4, 4))
            cast_scan(SCENE[:-1], lambda t, T=still: T, n * PERIOD_S, 2150).tofile(folder / "velodyne" / f"{n:06d}.bin")
    (root / "odometry" / "poses" / f"{number}.txt").write_text("\n".join(poses) + "\n")
    (folder / "times.txt").write_text("\n".join(times) + "\n")
    (folder / "calib.txt").write_text(f"Tr: {' '.join(map(str, tr[:3].ravel()))}\n")
    return folder
