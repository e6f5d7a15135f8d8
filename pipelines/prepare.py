"""Stage 1, per scan: reads the source's scans and drive files, writes what depends on one scan alone to the cache.

Reads: the planned pairs' `.bin` files, timestamps, OXTS, poses, calibration.
Writes: `CACHE/prepared/<2 digits>/<digest>.arrays`, one file a scan (rays, ground, drivable region) and one a pair
(ego-motion, labelled points, unlabelled movers). A file's name is the digest of all that its content depends on: the
scan's bytes and times, the labels, the sections of the configuration that matter, the scanner profile, the program. So
neighbouring pairs, other seeds and other cars find what is there, and nothing stale is ever read. Pickle is never
loaded; a damaged file is made again.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.augmentation import prepare_pair, prepare_scan
from augkitti.config import Config
from augkitti.ego_motion import EgoMotion
from augkitti.errors import InputError
from augkitti.frames import F64, is_rigid
from augkitti.kitti import (
    Sequence,
    ego_motion_digest,
    label_reach,
    labels_digest,
    read_ego_motion,
    read_pair,
    read_scan,
    scan_digest,
)
from augkitti.labelled_objects import label_objects
from augkitti.scan_pair import (
    NO_TICK,
    DrivableRegion,
    GroundMap,
    LabelledObjects,
    PreparedPair,
    PreparedScan,
    Scan,
    ScanPair,
    ScanRays,
)
from augkitti.scanner import ScannerProfile, fire_rays
from pipelines.cache import entry_path, load, store, trim
from pipelines.stage import run_tasks

TRIM_EVERY = 4_000  # files made between two looks at the size of the cache


def prepare_all(
    sequences: dict[str, Sequence],
    frames: dict[str, tuple[int, ...]],
    profile: ScannerProfile,
    config: Config,
    cache_folder: Path,
    jobs: int,
    stop: bool,
) -> tuple[int, int]:
    """Fill the cache for the pairs that begin at `frames` of each sequence.

    Args:
        sequences: by name.
        frames: first frames of the planned pairs, by sequence name.
        profile: the scanner.
        config: its `ground`, `drivable` and `movers` sections matter.
        cache_folder: where to keep results.
        jobs: processes.
        stop: let the first unreadable scan end the run; else `augment` meets it again, leaves it out and lists it.

    Returns:
        How many files were made and how many were there already.

    Raises:
        MachineError: the cache cannot be written, or a worker died.
    """
    made = kept = 0
    scans = [(sequences[s], f) for s in sorted(frames) for f in sorted({*frames[s], *(f + 1 for f in frames[s])})]
    pairs = [(sequences[s], f) for s in sorted(frames) for f in frames[s]]
    for work, items, what in ((_scan_task, scans, "scans"), (_pair_task, pairs, "pairs")):
        task = partial(work, profile=profile, config=config, cache_folder=cache_folder, stop=stop)
        for new in run_tasks(task, items, jobs, what, weight=lambda item: 1):
            made, kept = made + new, kept + (not new)
            if new and made % TRIM_EVERY == 0:
                trim(cache_folder)
    trim(cache_folder)
    return made, kept


def _scan_task(
    item: tuple[Sequence, int], profile: ScannerProfile, config: Config, cache_folder: Path, stop: bool
) -> bool:
    try:
        return prepared_scan(*item, profile, config, cache_folder)[1]
    except InputError:
        if stop:
            raise
        return False


def _pair_task(
    item: tuple[Sequence, int], profile: ScannerProfile, config: Config, cache_folder: Path, stop: bool
) -> bool:
    try:
        return prepared_pair(*item, profile, config, cache_folder)[2]
    except InputError:
        if stop:
            raise
        return False


def prepared_scan(
    sequence: Sequence, frame: int, profile: ScannerProfile, config: Config, cache_folder: Path
) -> tuple[PreparedScan, bool]:
    """A prepared scan from the cache, or made and put there; and whether it was made.

    Raises:
        InputError: the scan is unreadable.
    """
    sections = _sections(config, "ground", "drivable")
    path = entry_path(cache_folder, ["scan", scan_digest(sequence, frame), sections, profile.digest])
    if path in _recent:
        return _recent[path], False
    scan = read_scan(sequence, frame, profile.elevation_rad)
    content, made = load(path), False
    try:
        prepared = _unpack(content, scan, profile) if content is not None else None
    except (KeyError, ValueError, IndexError, TypeError):
        prepared = None  # damaged or foreign: made again
    if prepared is None:
        prepared, made = prepare_scan(scan, profile, config), True
        store(path, _pack(prepared))
    _recent[path] = prepared
    while len(_recent) > _KEPT:
        _recent.pop(next(iter(_recent)))
    return prepared, made


_KEPT = 2  # prepared scans in memory: the second scan of a pair is often the first of the next
_recent: dict[Path, PreparedScan] = {}


def prepared_pair(
    sequence: Sequence, frame0: int, profile: ScannerProfile, config: Config, cache_folder: Path
) -> tuple[ScanPair, PreparedPair, bool]:
    """A pair and what depends on its source alone, from the cache, or made and put there; and whether it was made.

    Raises:
        InputError: a scan or a file of the drive is unreadable.
    """
    scan0, scan1 = (prepared_scan(sequence, frame0 + k, profile, config, cache_folder)[0] for k in (0, 1))
    scans = (scan0.scan, scan1.scan)
    coverage, azimuth = label_reach(sequence)
    parts: list[Any] = [ego_motion_digest(sequence, frame0), labels_digest(sequence, frame0), coverage, azimuth]
    parts += [_sections(config, "ground", "drivable", "movers")]
    path = entry_path(cache_folder, ["pair", *parts, profile.digest])
    content = load(path)
    if content is not None:
        T, source, bits = content.get("T_velo1_velo0"), str(content.get("source")), content.get("movers0")
        if T is not None and source in ("oxts", "poses", "registration", "truth") and is_rigid(T, 1e-9):
            pair = read_pair(sequence, frame0, scans, EgoMotion(T, source))  # type: ignore[arg-type]
            try:
                movers0 = _bits(bits, (len(scan0.scan),))
                return pair, PreparedPair(scan0, scan1, _unpack_labelled(content, pair), movers0), False
            except (KeyError, IndexError, TypeError, ValueError):
                pass  # damaged or foreign: made again below
    pair = read_pair(sequence, frame0, scans, read_ego_motion(sequence, frame0, *scans))
    prepared = prepare_pair(pair, scan0, scan1, config)
    content = {"T_velo1_velo0": pair.ego_motion, "source": np.array(pair.ego_source)}
    store(path, content | {"movers0": np.packbits(prepared.movers0)} | _pack_labelled(prepared.labelled))
    return pair, prepared, True


def _pack_labelled(labelled: LabelledObjects) -> dict[str, Any]:
    """Which points are whose: few are anyone's."""
    owned = [np.flatnonzero(instance >= 0).astype(np.int32) for instance in (labelled.instance0, labelled.instance1)]
    return {
        "owned0": owned[0],
        "owner0": labelled.instance0[owned[0]],
        "owned1": owned[1],
        "owner1": labelled.instance1[owned[1]],
        "unknown0": np.packbits(labelled.unknown0),
    }


def _unpack_labelled(packed: dict[str, Any], pair: ScanPair) -> LabelledObjects:
    objects = label_objects(pair)
    instances = []
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        instance = np.full(len(scan), -1, dtype=np.int16)
        owner = packed[f"owner{k}"]
        if len(owner) and not 0 <= int(owner.min()) <= int(owner.max()) < len(objects):
            raise ValueError("points of an object that is not there")
        instance[packed[f"owned{k}"]] = owner
        instances.append(instance)
    return LabelledObjects(objects, instances[0], instances[1], _bits(packed["unknown0"], (len(pair.scan0),)))


def _sections(config: Config, *names: str) -> dict[str, Any]:
    return {name: getattr(config, name).model_dump(mode="json") for name in names}


def _pack(prepared: PreparedScan) -> dict[str, Any]:
    """The few arrays that a prepared scan can be rebuilt from; points come from the scan itself."""
    rays, ground, region = prepared.rays, prepared.ground, prepared.region
    packed: dict[str, Any] = {
        "ring": rays.ring,
        "plane": ground.plane,
        "ground_grid": np.array([*ground.origin_m, ground.cell_m]),
        "height_m": ground.height_m,
        "observed": np.packbits(ground.observed),
        "is_ground": np.packbits(ground.is_ground),
        "region_grid": np.array([*region.origin_m, region.cell_m, region.road_heading_rad]),
        "drivable_shape": np.array(region.drivable.shape),
        "drivable": np.packbits(region.drivable),
        "heading_cells": np.array(region.heading_cells),
        "heading_rad": region.heading_rad,
        "standing": _packed_rows(prepared.standing, len(prepared.scan)),
    }
    if prepared.scan.kind == "raw":  # rays are fired ticks times beams, and the stray points' own
        on_lattice = rays.ray_tick != NO_TICK
        stray = ~on_lattice
        packed |= {
            "tick": rays.tick,
            "fired": np.unique(rays.ray_tick[on_lattice]),
            "stray_azimuth_rad": rays.ray_azimuth_rad[stray],
            "stray_elevation_rad": rays.ray_elevation_rad[stray],
            "stray_time_s": rays.ray_time_s[stray],
        }
    else:
        packed |= {
            "ray": rays.ray,
            "ray_ring": rays.ray_ring,
            "ray_azimuth_rad": rays.ray_azimuth_rad,
            "ray_elevation_rad": rays.ray_elevation_rad,
            "ray_blind": np.packbits(rays.ray_blind),
        }
    return packed


def _unpack(packed: dict[str, Any], scan: Scan, profile: ScannerProfile) -> PreparedScan:
    if len(packed["ring"]) != len(scan):
        raise ValueError("of another scan")
    rays = _raw_rays(packed, scan, profile) if scan.kind == "raw" else _compensated_rays(packed, scan)
    shape = packed["height_m"].shape
    x, y, cell = (float(value) for value in packed["ground_grid"])
    ground = GroundMap(
        plane=packed["plane"],
        origin_m=(x, y),
        cell_m=cell,
        height_m=packed["height_m"],
        observed=_bits(packed["observed"], shape),
        is_ground=_bits(packed["is_ground"], (len(scan),)),
    )
    x, y, cell, heading = (float(value) for value in packed["region_grid"])
    rows, columns = (int(value) for value in packed["drivable_shape"])
    drivable = _bits(packed["drivable"], (rows, columns))
    region = DrivableRegion((x, y), cell, drivable, heading, int(packed["heading_cells"]), packed["heading_rad"])
    if any(
        side * region.heading_cells < cells
        for side, cells in zip(region.heading_rad.shape, drivable.shape, strict=True)
    ):
        raise ValueError("headings of another region")
    standing = np.flatnonzero(_bits(packed["standing"], (len(scan),))).astype(np.int32)
    return PreparedScan(scan, rays, ground, region, standing)


def _raw_rays(packed: dict[str, Any], scan: Scan, profile: ScannerProfile) -> ScanRays:
    ring, tick, fired = packed["ring"], packed["tick"], packed["fired"]
    lattice = fire_rays(profile, fired, scan.period_s)
    stray = np.flatnonzero(tick == NO_TICK)
    column = np.zeros(NO_TICK + 1, dtype=np.int32)
    column[fired] = np.arange(len(fired))
    ray = ring.astype(np.int32)
    ray *= len(fired)
    ray += column[tick]
    ray[stray] = len(lattice) + np.arange(len(stray))
    ray_point = np.full(len(lattice) + len(stray), -1, dtype=np.int32)
    ray_point[ray] = np.arange(len(scan), dtype=np.int32)

    def joined(of_lattice: Any, of_stray: Any) -> Any:
        if len(of_stray) != len(stray):
            raise ValueError("stray rays and stray points differ in number")
        return np.concatenate([of_lattice, of_stray]) if len(stray) else of_lattice

    return ScanRays(
        ring=ring,
        tick=tick,
        ray=ray,
        ray_ring=joined(lattice.ray_ring, ring[stray]),
        ray_tick=joined(lattice.ray_tick, tick[stray]),
        ray_azimuth_rad=joined(lattice.ray_azimuth_rad, packed["stray_azimuth_rad"]),
        ray_elevation_rad=joined(lattice.ray_elevation_rad, packed["stray_elevation_rad"]),
        ray_time_s=joined(lattice.ray_time_s, packed["stray_time_s"]),
        ray_point=ray_point,
        ray_blind=joined(lattice.ray_blind, np.zeros(len(stray), dtype=bool)),
    )


def _compensated_rays(packed: dict[str, Any], scan: Scan) -> ScanRays:
    ray_ring, azimuth = packed["ray_ring"], packed["ray_azimuth_rad"]
    ray_point = np.full(len(ray_ring), -1, dtype=np.int32)
    ray_point[packed["ray"]] = np.arange(len(scan), dtype=np.int32)
    elevation: F64 = packed["ray_elevation_rad"]
    if not len(ray_ring) == len(azimuth) == len(elevation):
        raise ValueError("columns of rays differ in length")
    return ScanRays(
        ring=packed["ring"],
        tick=np.full(len(scan), NO_TICK, dtype=np.uint16),
        ray=packed["ray"],
        ray_ring=ray_ring,
        ray_tick=np.full(len(ray_ring), NO_TICK, dtype=np.uint16),
        ray_azimuth_rad=azimuth,
        ray_elevation_rad=elevation,
        ray_time_s=np.zeros(len(ray_ring)),
        ray_point=ray_point,
        ray_blind=_bits(packed["ray_blind"], (len(ray_ring),)),
    )


def _packed_rows(rows: Any, count: int) -> Any:
    """Ascending row numbers as one bit a row."""
    chosen = np.zeros(count, dtype=bool)
    chosen[rows] = True
    return np.packbits(chosen)


def _bits(packed: Any, shape: tuple[int, ...]) -> Any:
    count = int(np.prod(shape))
    if len(packed) != (count + 7) // 8:
        raise ValueError("bits of another size")
    return np.unpackbits(packed, count=count).view(bool).reshape(shape)
