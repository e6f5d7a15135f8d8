"""The embedded default: a seed and a scanner profile in, drives of procedural streets in KITTI's raw layout out.

Each drive has its own street, scanned ray by ray at each ray's own firing time. Beside KITTI's files a drive holds
`augkitti_source.json` with `velo_poses.txt` (exact scanner poses) and `truth/NNNNNNNNNN.npz`, one a scan, with a value
for each row of the scan file: `object` (int16: the tracklet-independent number of the body, -1 for none), `ground`
(uint8: 0 none, 1 road, 2 pavement and kerb, 3 other land), `moving` (bool), `mixed` (bool: between two surfaces).
Tracklets reach as far as KITTI's: what the front camera sees.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter
from scipy.special import expit, ndtr

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import (
    F32,
    F64,
    Array,
    box_pose,
    compose,
    invert,
    rotate_vectors,
    se3_exp,
    se3_log,
    transform_points,
    wrap_angle,
    yaw_of,
)
from augkitti.parametric_cars import parametric_cars
from augkitti.raycast import MeshCaster, cast_car, rays_near
from augkitti.scan_pair import I16, U8, U16, Bool, ScanRays
from augkitti.scanner import ScannerProfile, azimuth_time, fire_rays, ray_lines
from augkitti.seeds import generator
from augkitti.sensor_noise import CarLook, noise_model, quantise_range, simulate_returns
from augkitti.street import Body, Street, body_poses, build_street, scanner_poses
from augkitti.street_objects import ASPHALT, GRASS, KERB, MARKING, PAVEMENT

METHOD = "street 3"  # part of the digest: raise it when what is drawn or how it is scanned changes
DATE = "2000_01_01"  # a day on which KITTI recorded nothing
ROAD, SIDEWALK, LAND = 1, 2, 3

_CLOTHES_RETURN = 0.94
_SEE_M = 85.0
_LABEL_M = 75.0  # KITTI's annotators went about this far
_START = datetime(2000, 1, 1, 12, 0, 1, tzinfo=UTC)
_T_VELO_IMU = np.array([[1.0, 0, 0, -0.81], [0, 1.0, 0, 0.32], [0, 0, 1.0, -0.8], [0, 0, 0, 1.0]])
_FRINGE, _FRINGE_RETURN = (
    0.01,
    0.5,
)  # of a turn; real scans: beams 44 to 63 lose 3 to 13 % of all rays beside the shadow
_FOCAL, _CENTRE, _IMAGE = 720.0, (610.0, 172.0), (1242, 375)
_CAMERA_AZIMUTH = (-float(sm.arctan((_IMAGE[0] - _CENTRE[0]) / _FOCAL)), float(sm.arctan(_CENTRE[0] / _FOCAL)))

# A material a row, in the order of `street_objects`: mean reflectance, its spread, roughness along the ray (m),
# share of pulses lost at any range.
_MATERIALS = np.array(
    [
        [0.22, 0.07, 0.004, 0.000],  # asphalt
        [0.60, 0.12, 0.004, 0.000],  # marking
        [0.30, 0.07, 0.005, 0.000],  # pavement
        [0.33, 0.08, 0.006, 0.000],  # kerb
        [0.36, 0.09, 0.030, 0.005],  # grass
        [0.28, 0.08, 0.012, 0.002],  # brick
        [0.38, 0.08, 0.006, 0.002],  # plaster
        [0.08, 0.10, 0.010, 0.550],  # window
        [0.25, 0.08, 0.015, 0.010],  # roof
        [0.25, 0.10, 0.008, 0.010],  # wood
        [0.27, 0.14, 0.020, 0.050],  # leaf
        [0.28, 0.08, 0.012, 0.010],  # bark
        [0.25, 0.15, 0.004, 0.050],  # metal
        [0.95, 0.04, 0.010, 0.000],  # sign
    ]
)


@dataclass(frozen=True, eq=False)
class EgoTruth:
    """Where the scanner is: constant twists through its poses at the scans' middles."""

    middle_s: F64  # (K + 2,) middles, with one before the first and one after the last
    period_s: F64  # (K + 2,)
    T_world_velo: F64  # (K + 2, 4, 4)


@dataclass(frozen=True, eq=False)
class StreetScan:
    """One scan as it goes to disk, with the truth of each row."""

    rows: F32  # (N, 4) x, y, z, reflectance
    object: I16  # (N,) index of the body; -1 for none
    ground: U8  # (N,) 0 none, 1 road, 2 pavement, 3 land
    moving: Bool  # (N,)
    mixed: Bool  # (N,)
    boxes: F64  # (B, 7) of every body at its moment, velo
    seen: Array  # (B,) points on each body


def synthesize(
    out: Path,
    drives: int,
    frames: int,
    seed: int,
    profile: ScannerProfile,
    jobs: int = 1,
    on_drive: Callable[[int], None] | None = None,
) -> tuple[Path, ...]:
    """Write drives of `frames` scans each under `out` and return their folders.

    The same arguments give the same bytes, whatever `jobs` is; `on_drive` is told of each drive that is done. The whole
    is written to a temporary folder beside `out` and renamed at the end, so that a run that breaks off leaves nothing
    half done.

    Raises:
        InputError: `out` holds something already or cannot be written, or a count is not positive.
    """
    if drives < 1 or frames < 1 or drives > 9999:
        raise InputError(
            "synthesize", f"{drives} drives of {frames} frames", "ask for 1 to 9999 drives, 1 frame or more"
        )
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(out, "is not an empty folder", "name a new one")
    part = out.parent / f".{out.name}.part-{os.getpid()}"
    try:
        try:
            (part / DATE).mkdir(parents=True)
            for name, text in _calibration().items():
                (part / DATE / name).write_text(text, encoding="utf-8")
            names = []
            for name in Parallel(n_jobs=jobs, return_as="generator")(
                delayed(_write_drive)(part / DATE, index, frames, seed, profile) for index in range(drives)
            ):
                names.append(name)
                if on_drive is not None:
                    on_drive(1)
            os.replace(part, out)
        except OSError as err:
            raise InputError(out, f"cannot be written ({err.strerror})", "name another folder, or make room") from err
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return tuple(out / DATE / name for name in names)


def street_digest(drives: int, frames: int, seed: int, profile: ScannerProfile) -> str:
    """sha256 over all that `synthesize` depends on: names a cache folder before anything is drawn."""
    recipe = [METHOD, drives, frames, seed, profile.digest, *(model.digest for model in parametric_cars())]
    return hashlib.sha256(json.dumps(recipe).encode()).hexdigest()


def content_digest(root: Path) -> str:
    """sha256 over the names and bytes of all files under a folder, whatever order the disk lists them in."""
    digest = hashlib.sha256()
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        digest.update(hashlib.sha256(path.relative_to(root).as_posix().encode()).digest())
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def drive_street(seed: int, index: int, frames: int, period_s: float) -> Street:
    """The street of drive `index` (from 0), a scan every `period_s`. Paces go round from a drawn place."""
    first = int(generator(seed, "pace").integers(5))
    return build_street(generator(seed, "street", index), (frames - 1) * period_s, first + index)


def ego_truth(street: Street, frames: int, period_s: float, rng: np.random.Generator) -> EgoTruth:
    """Times and scanner poses of a drive; a scan starts when the one before ends, as KITTI's do."""
    period = period_s + rng.uniform(-1.5e-4, 1.5e-4, frames + 2)
    edge = np.concatenate([[0.0], np.cumsum(period)])
    middle = 0.5 * (edge[1:] + edge[:-1])
    middle -= middle[1]
    return EgoTruth(middle, period, scanner_poses(street, middle))


def scanner_poses_at(ego: EgoTruth, time_s: Array) -> F64:
    """`T_world_velo` (T, 4, 4) at times (T,) from the middle of scan 0."""
    t = np.asarray(time_s, dtype=np.float64)
    leg = np.clip(np.searchsorted(ego.middle_s, t, side="right") - 1, 0, len(ego.middle_s) - 2)
    out = np.zeros(t.shape + (4, 4))
    for i in np.unique(leg):
        of_leg = leg == i
        twist = se3_log(compose(invert(ego.T_world_velo[i]), ego.T_world_velo[i + 1]))
        share = (t[of_leg] - ego.middle_s[i]) / (ego.middle_s[i + 1] - ego.middle_s[i])
        out[of_leg] = compose(ego.T_world_velo[i], se3_exp(twist, share))
    return out


def scan_street(
    street: Street, caster: MeshCaster, ego: EgoTruth, frame: int, profile: ScannerProfile, rng: np.random.Generator
) -> StreetScan:
    """One revolution through the street, each ray cast at its own firing time from where the scanner is then."""
    middle, period = float(ego.middle_s[frame + 1]), float(ego.period_s[frame + 1])
    fired = _fired_ticks(profile, period, rng)
    rays = fire_rays(profile, fired, period)
    beams, firings = profile.beams, len(fired)
    firing_time = middle + rays.ray_time_s[:firings]
    T_world_velo = scanner_poses_at(ego, firing_time)
    origin, direction = ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
    origin_world = transform_points(T_world_velo, origin.reshape(beams, firings, 3)).reshape(-1, 3)
    direction_world = rotate_vectors(T_world_velo, direction.reshape(beams, firings, 3)).reshape(-1, 3)

    alive = np.flatnonzero(~rays.ray_blind)
    face, reach, cosine = caster.first_hit(origin_world[alive], direction_world[alive])
    stop = np.full(len(rays), np.inf)
    stop[alive] = np.where(face >= 0, reach, np.inf)
    material = np.full(len(rays), -1, dtype=np.int64)
    material[alive] = np.where(face >= 0, street.still.material[face].astype(np.int64), -1)
    incidence = np.ones(len(rays))
    incidence[alive] = cosine
    returned, measured, reflectance = _still_returns(rays, material, stop, incidence, (beams, firings), profile, rng)
    body_of = np.full(len(rays), -1, dtype=np.int16)
    boxes = np.zeros((len(street.bodies), 7))
    for index, body in enumerate(street.bodies):
        T_velo_body, boxes[index] = _at_its_moment(body, ego, frame)
        if sm.hypot(*boxes[index, :2]) > _SEE_M:
            continue
        drift = 0.3 + (body.track.speed_mps + 20.0) * period / 4.0 if body.moving else 0.3 + 20.0 * period / 4.0
        near = rays_near(rays, T_velo_body, body.model.size_m, drift)
        near = near[~rays.ray_blind[near]]
        of_firing = near % firings
        used, which = np.unique(of_firing, return_inverse=True)
        T_world_body = body_poses(body, firing_time[used])
        T_body_velo = compose(invert(T_world_body), T_world_velo[used])
        hits = cast_car(body.model, T_body_velo[which], rays, near, profile, opaque_glass=False)
        echoes = simulate_returns(hits, CarLook(body.paint, body.tint), rays, profile, False, rng)
        seen = echoes.returned
        if body.model.category in ("Pedestrian", "Cyclist"):  # clothes scatter; the noise model knows cars alone
            seen = rng.random(len(seen)) < _CLOTHES_RETURN
        first = echoes.stop_m < stop[hits.ray]
        ray = hits.ray[first]
        stop[ray], returned[ray], measured[ray] = echoes.stop_m[first], seen[first], echoes.range_m[first]
        reflectance[ray], body_of[ray], material[ray] = echoes.reflectance[first], index, -1
    returned, measured, mixed = _at_edges(stop, returned, measured, rays, (beams, firings), profile, rng)

    xyz = (
        np.rint((origin + direction * measured[:, None]) / profile.coordinate_quantum_m) * profile.coordinate_quantum_m
    )
    distance = np.sqrt((xyz * xyz).sum(axis=1))
    kept = np.flatnonzero(
        returned & (distance >= profile.min_range_m) & (distance <= profile.max_range_m) & ~rays.ray_blind
    )
    turn = sm.arctan2(xyz[kept, 1], xyz[kept, 0]) % (2.0 * np.pi)
    kept = kept[np.lexsort((turn, rays.ray_ring[kept]))]
    ground = _ground_truth(material[kept])
    moving = np.array([*(_moves(body, middle, period) for body in street.bodies), False])
    of_body = np.where(mixed[kept], -1, body_of[kept]).astype(np.int16)
    return StreetScan(
        rows=np.concatenate([xyz[kept], reflectance[kept, None]], axis=1).astype("<f4"),
        object=of_body,
        ground=np.where(mixed[kept], 0, ground).astype(np.uint8),
        moving=moving[of_body],
        mixed=mixed[kept],
        boxes=boxes,
        seen=np.bincount(of_body[of_body >= 0], minlength=len(street.bodies)),
    )


def _fired_ticks(profile: ScannerProfile, period_s: float, rng: np.random.Generator) -> U16:
    """Firing is uniform in time; the encoder is read at each firing."""
    count = int(period_s / profile.firing_period_s - rng.random())
    order = np.floor((np.arange(count) + rng.random()) * profile.firing_period_s / period_s * profile.lattice_size)
    ticks = (profile.seam_tick - 1 - order.astype(np.int64)) % profile.lattice_size
    return np.unique(ticks).astype(np.uint16)


def _ground_truth(material: Array) -> Array:
    found = np.zeros(len(material), dtype=np.uint8)
    found[(material == ASPHALT) | (material == MARKING)] = ROAD
    found[(material == PAVEMENT) | (material == KERB)] = SIDEWALK
    found[material == GRASS] = LAND
    return found


def _moves(body: Body, middle_s: float, period_s: float) -> bool:
    """Whether a body goes 1 cm or more within the scan; one at the end of its way stands."""
    T = body_poses(body, middle_s + np.array([-0.5, 0.5]) * period_s)
    return bool(np.sqrt(((T[1, :3, 3] - T[0, :3, 3]) ** 2).sum()) > 0.01)


def _at_its_moment(body: Body, ego: EgoTruth, frame: int) -> tuple[F64, F64]:
    """`T_velo_body` and contract box when the scanner's azimuth passes the body's centre, in its frame of then."""
    middle, period = float(ego.middle_s[frame + 1]), float(ego.period_s[frame + 1])
    moment = 0.0
    T_velo_body = np.eye(4)
    for _ in range(6):
        time = np.array([middle + moment])
        T_velo_body = compose(invert(scanner_poses_at(ego, time)[0]), body_poses(body, time)[0])
        moment = azimuth_time(float(sm.arctan2(T_velo_body[1, 3], T_velo_body[0, 3])), period)
    return T_velo_body, np.array([*T_velo_body[:3, 3], *body.model.size_m, yaw_of(T_velo_body)])


# --- what comes back -----------------------------------------------------------------------------------------------


def _still_returns(
    rays: ScanRays,
    material: Array,
    range_m: F64,
    cosine: F64,
    grid: tuple[int, int],
    profile: ScannerProfile,
    rng: np.random.Generator,
) -> tuple[Bool, F64, F64]:
    """Whether each ray (R,) returns from what stands still, its measured range, its reflectance."""
    table = _MATERIALS[np.maximum(material, 0)]
    hit = material >= 0
    reach = np.where(hit, range_m, 1.0)
    shine = 0.9 * _along_ring(grid, 0.93, rng) + 0.43 * rng.standard_normal(len(rays))
    value = np.clip(table[:, 0] + table[:, 1] * shine, 0.005, 0.99)
    echo = sm.log(value * np.maximum(cosine, 0.01)) - 2.0 * sm.log(reach / 40.0)
    chance = (1.0 - table[:, 3]) * expit(2.5 * (echo + 6.0))
    chance = np.where(_shadow_fringe(profile)[rays.ray_ring, rays.ray_tick], _FRINGE_RETURN * chance, chance)
    luck = ndtr(0.8 * _along_ring(grid, 0.8, rng) + 0.6 * rng.standard_normal(len(rays)))
    rough = sm.hypot(round(noise_model(profile).shot_std_m, 3), table[:, 2] / np.maximum(cosine, 0.15))
    noise = np.minimum(rough, 0.15) * rng.standard_normal(len(rays))
    measured = quantise_range(reach + profile.range_bias_m[rays.ray_ring] + noise, rays.ray_ring, profile)
    steps = np.clip(np.rint(value / profile.reflectance_quantum), 0, profile.reflectance_steps)
    weak = 0.05 + 0.95 * expit(-1.5 * (echo + 3.6))  # exact zeros mean an echo below the scale
    steps = np.where(ndtr(_along_ring(grid, 0.9, rng)) < weak, 0.0, steps)
    return hit & (luck < chance), measured, steps * profile.reflectance_quantum


def _shadow_fringe(profile: ScannerProfile) -> Bool:
    """(beams, lattice) the border of the ego car's shadow: the car's own edges take many of these pulses too."""
    width = 2 * round(_FRINGE * profile.lattice_size) + 1
    near = maximum_filter1d(profile.blind.astype(np.uint8), width, axis=1, mode="wrap") > 0
    return np.asarray(near & ~profile.blind)


def _at_edges(
    stop: F64,
    returned: Bool,
    measured: F64,
    rays: ScanRays,
    grid: tuple[int, int],
    profile: ScannerProfile,
    rng: np.random.Generator,
) -> tuple[Bool, F64, Bool]:
    """At steps in range along a ring a pulse falls on both surfaces: some return from between, some not at all."""
    depth = stop.reshape(grid)
    other = np.roll(depth, -1, axis=1)
    both = np.isfinite(depth) & np.isfinite(other)
    gap = np.where(both, other, 0.0) - np.where(both, depth, 0.0)
    step = np.abs(gap) > 1.0
    luck, share = rng.random(grid), rng.uniform(0.1, 0.9, grid)
    mixed = (step & (luck < 0.095)).ravel() & returned
    lost = (step & (luck > 1.0 - 0.12)).ravel()
    between = np.where(step, depth + share * gap, 0.0).ravel()
    ranges = np.where(mixed, quantise_range(between, rays.ray_ring, profile), measured)
    return returned & ~lost, ranges, mixed & ~lost


def _along_ring(grid: tuple[int, int], correlation: float, rng: np.random.Generator) -> F64:
    """Standard normal values (R,), each ring a chain of its own with this correlation from firing to firing."""
    field = rng.standard_normal(grid)
    field[:, 1:] *= np.sqrt(1.0 - correlation * correlation)
    return np.asarray(lfilter([1.0], [1.0, -correlation], field, axis=1)).ravel()


# --- KITTI's files -------------------------------------------------------------------------------------------------


def _write_drive(day: Path, index: int, frames: int, seed: int, profile: ScannerProfile) -> str:
    name = f"{DATE}_drive_{index + 1:04d}_sync"
    street = drive_street(seed, index, frames, profile.period_s)
    ego = ego_truth(street, frames, profile.period_s, generator(seed, "clock", index))
    caster = MeshCaster(street.still.vertices, street.still.faces)
    folder = day / name
    for part in ("velodyne_points/data", "oxts/data", "truth"):
        (folder / part).mkdir(parents=True)
    scans = []
    for frame in range(frames):
        scan = scan_street(street, caster, ego, frame, profile, generator(seed, "scan", index, frame))
        (folder / "velodyne_points" / "data" / f"{frame:010d}.bin").write_bytes(scan.rows.tobytes())
        np.savez_compressed(
            folder / "truth" / f"{frame:010d}.npz",
            object=scan.object,
            ground=scan.ground,
            moving=scan.moving,
            mixed=scan.mixed,
        )
        scans.append((scan.boxes, scan.seen))
    _write_times(folder / "velodyne_points", ego)
    _write_oxts(folder / "oxts", street, ego, index, generator(seed, "oxts", index))
    _text(folder / "tracklet_labels.xml", _tracklets(street, scans))
    lines = [" ".join(repr(float(v)) for v in T[:3].ravel()) for T in ego.T_world_velo[1:-1]]
    _text(folder / "velo_poses.txt", "\n".join(lines) + "\n")
    _text(
        folder / "augkitti_source.json",
        json.dumps({"label_coverage": "camera", "velo_poses": "velo_poses.txt"}, indent=2) + "\n",
    )
    return name


def _text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="\n")


def _stamp(time_s: float) -> str:
    nanoseconds = round(float(time_s) * 1e9)
    moment = _START + timedelta(seconds=nanoseconds // 10**9)
    return f"{moment:%Y-%m-%d %H:%M:%S}.{nanoseconds % 10**9:09d}"


def _write_times(folder: Path, ego: EgoTruth) -> None:
    middle, half = ego.middle_s[1:-1], 0.5 * ego.period_s[1:-1]
    for suffix, times in (("", middle), ("_start", middle - half), ("_end", middle + half)):
        _text(folder / f"timestamps{suffix}.txt", "".join(_stamp(t) + "\n" for t in times))


_OXTS_COLUMNS = (
    *("lat", "lon", "alt", "roll", "pitch", "yaw", "vn", "ve", "vf", "vl", "vu", "ax", "ay", "az", "af", "al", "au"),
    *("wx", "wy", "wz", "wf", "wl", "wu", "pos_accuracy", "vel_accuracy"),
    *("navstat", "numsats", "posmode", "velmode", "orimode"),
)


def _write_oxts(folder: Path, street: Street, ego: EgoTruth, index: int, rng: np.random.Generator) -> None:
    """Packets 5 to 38 ms after the scans' middles, with the unit's own small errors."""
    middle = ego.middle_s[1:-1]
    packet = middle + np.clip(0.017 + 0.0045 * rng.standard_normal(len(middle)), 0.005, 0.038)
    _text(folder / "timestamps.txt", "".join(_stamp(t) + "\n" for t in packet))
    _text(folder / "dataformat.txt", "".join(f"{column}\n" for column in _OXTS_COLUMNS))
    earth_m, lat0, lon0 = 6378137.0, 49.0 + 0.01 * index, 8.4
    scale = float(sm.cos(np.deg2rad(lat0)))
    north0 = scale * earth_m * float(sm.log(sm.tan(np.deg2rad(90.0 + lat0) / 2.0)))
    east0 = scale * earth_m * float(np.deg2rad(lon0))
    step = 0.01
    drift = np.cumsum(rng.normal(0.0, 0.01, (len(packet), 3)), axis=0)
    for frame, t in enumerate(packet):
        T = compose(scanner_poses(street, t + step * np.array([-1.0, 0.0, 1.0])), _T_VELO_IMU)
        position, R = T[:, :3, 3], T[1, :3, :3]
        velocity = (position[2] - position[0]) / (2.0 * step) + rng.normal(0.0, 0.01, 3)
        acceleration = (position[2] - 2.0 * position[1] + position[0]) / (step * step) + [0.0, 0.0, 9.81]
        rate = se3_log(compose(invert(T[0]), T[2]))[3:] / (2.0 * step) + rng.normal(0.0, 0.001, 3)
        yaw = float(sm.arctan2(R[1, 0], R[0, 0]))
        pitch = float(sm.arctan2(-R[2, 0], sm.hypot(R[0, 0], R[1, 0])))
        roll = float(sm.arctan2(R[2, 1], R[2, 2]))
        roll, pitch, yaw = np.array([roll, pitch, yaw]) + rng.normal(0.0, 1e-4, 3)
        east, north, up = position[1] + drift[frame]
        lat = float(np.rad2deg(2.0 * sm.arctan(sm.exp((north0 + north) / (scale * earth_m))))) - 90.0
        lon = float(np.rad2deg((east0 + east) / (scale * earth_m)))
        c, s = sm.cos(yaw), sm.sin(yaw)
        forward, left = c * velocity[0] + s * velocity[1], -s * velocity[0] + c * velocity[1]
        a, w = sm.product(R.T, acceleration), sm.product(R, rate)
        values = [
            lat,
            lon,
            110.0 + up,
            roll,
            pitch,
            float(wrap_angle(yaw)),
            velocity[1],
            velocity[0],
            forward,
            left,
            velocity[2],
            *a,
            c * acceleration[0] + s * acceleration[1],
            -s * acceleration[0] + c * acceleration[1],
            acceleration[2],
            *rate,
            c * w[0] + s * w[1],
            -s * w[0] + c * w[1],
            w[2],
            0.05,
            0.02,
        ]
        words = [f"{v:.14g}" for v in values] + ["4", "10", "4", "4", "0"]
        _text(folder / "data" / f"{frame:010d}.txt", " ".join(words) + "\n")


def _in_camera(box: F64) -> bool:
    """Whether the front camera sees a corner of a box."""
    corners = transform_points(
        box_pose(box), np.array([[i, j, 0.0] for i in (-0.5, 0.0, 0.5) for j in (-0.5, 0.5)]) * box[3:6]
    )
    turn = sm.arctan2(corners[:, 1], corners[:, 0])
    return bool(((turn >= _CAMERA_AZIMUTH[0]) & (turn <= _CAMERA_AZIMUTH[1])).any())


def _tracklets(street: Street, scans: list[tuple[F64, Array]]) -> str:
    """`tracklet_labels.xml`: what the camera sees; in between, poses marked as outside the image."""
    items = []
    for index, body in enumerate(street.bodies):
        labelled = [
            bool(seen[index]) and _in_camera(boxes[index]) and float(sm.hypot(*boxes[index, :2])) <= _LABEL_M
            for boxes, seen in scans
        ]
        if not any(labelled):
            continue
        first, last = labelled.index(True), len(labelled) - 1 - labelled[::-1].index(True)
        poses = "".join(_tracklet_pose(scans[frame][0][index], labelled[frame]) for frame in range(first, last + 1))
        length, width, height = (float(v) for v in body.model.size_m)
        items.append(
            f"\t<item>\n\t\t<objectType>{body.model.category}</objectType>\n"
            f"\t\t<h>{height!r}</h>\n\t\t<w>{width!r}</w>\n\t\t<l>{length!r}</l>\n"
            f"\t\t<first_frame>{first}</first_frame>\n"
            f"\t\t<poses>\n\t\t\t<count>{last - first + 1}</count>\n\t\t\t<item_version>2</item_version>\n"
            f"{poses}\t\t</poses>\n\t\t<finished>1</finished>\n\t</item>\n"
        )
    return (
        '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'
        '<boost_serialization signature="serialization::archive" version="9">\n<tracklets>\n'
        f"\t<count>{len(items)}</count>\n\t<item_version>1</item_version>\n"
        f"{''.join(items)}</tracklets>\n</boost_serialization>\n"
    )


def _tracklet_pose(box: F64, seen: bool) -> str:
    x, y, z = float(box[0]), float(box[1]), float(box[2] - 0.5 * box[5])
    return (
        f"\t\t\t<item><tx>{x!r}</tx><ty>{y!r}</ty><tz>{z!r}</tz><rx>0</rx><ry>0</ry><rz>{float(box[6])!r}</rz>"
        f"<state>2</state><occlusion>0</occlusion><truncation>{0 if seen else 3}</truncation></item>\n"
    )


def _calibration() -> dict[str, str]:
    """A round-numbered camera, scanner and inertial unit, mounted as on KITTI's car."""
    identity = "1 0 0 0 1 0 0 0 1"
    T_velo_imu = _T_VELO_IMU[:3, 3]
    projection = f"{_FOCAL} 0 {_CENTRE[0]} 0 0 {_FOCAL} {_CENTRE[1]} 0 0 0 1 0"
    cameras = "".join(
        f"S_{k:02d}: {_IMAGE[0]} {_IMAGE[1]}\nR_{k:02d}: {identity}\nT_{k:02d}: 0 0 0\n"
        f"S_rect_{k:02d}: {_IMAGE[0]} {_IMAGE[1]}\nR_rect_{k:02d}: {identity}\nP_rect_{k:02d}: {projection}\n"
        for k in range(4)
    )
    head = "calib_time: 01-Jan-2000 12:00:00\n"
    return {
        "calib_velo_to_cam.txt": f"{head}R: 0 -1 0 0 0 -1 1 0 0\nT: 0 -0.08 -0.27\ndelta_f: 0 0\ndelta_c: 0 0\n",
        "calib_imu_to_velo.txt": f"{head}R: {identity}\nT: {T_velo_imu[0]} {T_velo_imu[1]} {T_velo_imu[2]}\n",
        "calib_cam_to_cam.txt": f"{head}corner_dist: 0.1\n{cameras}",
    }
