"""Casting one car into one scan, beside what one would write with trimesh or Open3D, on the same placements in one run.

Usage: python benchmarks/casting.py [KITTI_ROOT] [CAD_FOLDER] [--cars 12] [--rounds 5] [--threads 1] [--fallback]

Ours: which rays are near, each carried into the car's frame at its own firing time, every layer through panes; no
noise. The others: the mesh moved into the scene at the car's moment, their structure built, the first hit of each ray
of the scan with its place. Origins and directions of the scan's rays are worked out beforehand for them, not for ours.
`--threads` binds all to that many cores (one: processor time is counted, more: the clock); `--fallback` has trimesh
without Embree, on one placement (needs rtree).
"""

import argparse
import ctypes
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from augkitti import add_cars, kitti
from augkitti.add_cars import cast_and_measure
from augkitti.cad_models import load_cad_folder
from augkitti.config import Config
from augkitti.frames import F64, invert, rotate_vectors, transform_points
from augkitti.placement import make_scene, propose_car
from augkitti.raycast import CarHits, cast_car, rays_near
from augkitti.scan_pair import PreparedScan, ScanPair, VirtualCar
from augkitti.scanner import load_profile, ray_lines
from pipelines.prepare import prepared_pair

PROFILE, CONFIG = load_profile(), Config()
SAME_M = 1e-3
AROUND_M = 0.3  # beams do not start at the frame's origin
OURS, OURS_FIRST = "ours", "ours, first hits at the car's moment alone"
TRIMESH, FALLBACK = "trimesh, all rays", "trimesh without Embree, all rays"
TRIMESH_LAYERS = "trimesh, all rays, all layers, as ours"
OPEN3D, OPEN3D_NEAR = "Open3D, all rays", "Open3D, rays cropped first"
OPEN3D_KEPT = "Open3D, structure kept, our near rays in the car's frame"


@dataclass(frozen=True, eq=False)
class Placed:
    """A car in one scan of a pair, and the rays of that scan."""

    car: VirtualCar
    pair: ScanPair
    prepared: PreparedScan
    second: bool  # scan 1
    origin: F64  # (R, 3)
    direction: F64  # (R, 3)

    @property
    def pose(self) -> F64:
        """T_velo_car at the car's moment."""
        return self.car.pose1 if self.second else self.car.pose0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kitti", nargs="?", type=Path, default=Path("../shared/kitti"))
    parser.add_argument("cad", nargs="?", type=Path, default=Path("../shared/cad"))
    parser.add_argument("--cars", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--fallback", action="store_true")
    asked = parser.parse_args()
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: asked.threads])
    clock = time.process_time if asked.threads == 1 else time.perf_counter
    o3d = _open3d()
    ways: dict[str, Callable[[Placed], Any]] = {
        OURS: cast_ours,
        OURS_FIRST: cast_ours_first,
        TRIMESH: cast_trimesh,
        TRIMESH_LAYERS: cast_trimesh_layers,
        OPEN3D: lambda placed: cast_open3d(o3d, placed),
        OPEN3D_NEAR: lambda placed: cast_open3d_near(o3d, placed),
        OPEN3D_KEPT: _KeptScenes(o3d),
    }
    placements = list(place_cars(asked.kitti, asked.cad, asked.cars))
    check_agreement(o3d, placements)
    spent: dict[str, list[float]] = defaultdict(list)
    for round_ in range(asked.rounds + 1):
        if round_ == 1:  # round 0 builds what is built once
            spent.clear()
        for placed in placements:
            for name, cast in ways.items():
                spent[name].append(_milliseconds(cast, placed, clock))
    if asked.fallback:
        spent[FALLBACK] = [_milliseconds(cast_fallback, placements[0], clock)]
    show_times(spent, placements, asked.rounds, asked.threads)


def _open3d() -> Any:
    import libusb_package

    ctypes.CDLL(libusb_package.get_library_path(), mode=ctypes.RTLD_GLOBAL)  # its wheel wants one, used or not
    import open3d

    return open3d


def _milliseconds(cast: Callable[[Placed], Any], placed: Placed, clock: Callable[[], float]) -> float:
    start = clock()
    cast(placed)
    return 1e3 * (clock() - start)


def place_cars(root: Path, cad: Path, count: int) -> Iterator[Placed]:
    """Cars where the program would put them and see them well, one a pair, sequences in turn; both scans of each."""
    models = load_cad_folder(cad, CONFIG.categories).models
    sequences = [sequence for sequence in kitti.open_root(root).sequences if sequence.pairs]
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as cache:
        for turn in range(count):
            sequence = sequences[turn % len(sequences)]
            frame0 = sequence.pairs[(5 * (turn // len(sequences))) % len(sequence.pairs)][0]
            pair, prepared, _ = prepared_pair(sequence, frame0, PROFILE, CONFIG, Path(cache))
            scene = make_scene(pair, prepared.scan0, prepared.scan1, CONFIG)
            for _ in range(CONFIG.placement.attempts):
                car = propose_car(scene, [], models, True, None, CONFIG, rng)
                scans = (prepared.scan0, prepared.scan1)
                if car is None:
                    continue
                cast = cast_and_measure(car, pair, *scans, PROFILE, CONFIG, rng)
                if min(returns.returned.sum() for returns in cast.returns) < CONFIG.min_points:
                    continue
                for second in (False, True):
                    placed = Placed(car, pair, scans[second], second, *_lines(scans[second]))
                    assert np.array_equal(cast_ours(placed).range_m, cast.hits[second].range_m), (
                        "not as the program does"
                    )
                    yield placed
                break


def _lines(prepared: PreparedScan) -> tuple[F64, F64]:
    rays = prepared.rays
    return ray_lines(PROFILE, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)


# --- the ways --------------------------------------------------------------------------------------------------------


def cast_ours(placed: Placed) -> CarHits:
    """As `cast_and_measure` does it, without the noise."""
    return add_cars.cast_into_scan(placed.car, int(placed.second), placed.pair, placed.prepared, PROFILE, CONFIG)


def cast_ours_first(placed: Placed) -> CarHits:
    """What the others find: neither layers nor the sweep."""
    near = rays_near(placed.prepared.rays, placed.pose, placed.car.model.size_m, add_cars._NEAR_M)
    T_car_velo = np.broadcast_to(invert(placed.pose), (len(near), 4, 4))
    return cast_car(placed.car.model, T_car_velo, placed.prepared.rays, near, PROFILE, True)


def cast_trimesh(placed: Placed, interface: Any = None) -> tuple[Any, ...]:
    """Place, ray and triangle of each first hit."""
    mesh = _mesh(placed).apply_transform(placed.pose)
    rays = mesh.ray if interface is None else interface(mesh)
    return rays.intersects_location(placed.origin, placed.direction, multiple_hits=False)


def cast_trimesh_layers(placed: Placed) -> tuple[Any, ...]:
    """Every layer that a ray meets, as ours has them behind panes."""
    mesh = _mesh(placed).apply_transform(placed.pose)
    return mesh.ray.intersects_location(placed.origin, placed.direction, multiple_hits=True)


def cast_fallback(placed: Placed) -> tuple[Any, ...]:
    """What trimesh does where it finds no Embree."""
    return cast_trimesh(placed, trimesh.ray.ray_triangle.RayMeshIntersector)


def _mesh(placed: Placed) -> trimesh.Trimesh:
    return trimesh.Trimesh(placed.car.model.vertices, placed.car.model.faces, process=False)


def cast_open3d(o3d: Any, placed: Placed, chosen: Any = slice(None)) -> Any:
    """Ranges of chosen rays; infinite where they meet nothing."""
    scene = _open3d_scene(o3d, transform_points(placed.pose, placed.car.model.vertices), placed)
    return _cast_open3d(o3d, scene, placed.origin[chosen], placed.direction[chosen])


def cast_open3d_near(o3d: Any, placed: Placed) -> Any:
    """Only rays that point at a ball round the car."""
    centre = placed.pose[:3, 3]
    distance = np.linalg.norm(centre)
    radius = np.linalg.norm(placed.car.model.size_m) / 2 + AROUND_M
    return cast_open3d(
        o3d, placed, placed.direction @ (centre / distance) > np.sqrt(max(0, 1 - (radius / distance) ** 2))
    )


class _KeptScenes:
    """Our way with Open3D's structures, one a model, kept: rays in the car's frame at its moment; first hits alone."""

    def __init__(self, o3d: Any) -> None:
        self.o3d = o3d
        self.scenes: dict[str, Any] = {}

    def __call__(self, placed: Placed) -> Any:
        model = placed.car.model
        if model.digest not in self.scenes:
            self.scenes[model.digest] = _open3d_scene(self.o3d, model.vertices, placed)
        near = rays_near(placed.prepared.rays, placed.pose, model.size_m, add_cars._NEAR_M)
        T_car_velo = invert(placed.pose)
        origin = transform_points(T_car_velo, placed.origin[near])
        return _cast_open3d(
            self.o3d, self.scenes[model.digest], origin, rotate_vectors(T_car_velo, placed.direction[near])
        )


def _open3d_scene(o3d: Any, vertices: F64, placed: Placed) -> Any:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(placed.car.model.faces.astype(np.uint32))
    )
    return scene


def _cast_open3d(o3d: Any, scene: Any, origin: F64, direction: F64) -> Any:
    rays = np.concatenate([origin, direction], axis=1, dtype=np.float32, casting="same_kind")
    return scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()


# --- what is printed -------------------------------------------------------------------------------------------------


def check_agreement(o3d: Any, placements: list[Placed]) -> None:
    """First hits of all at the car's moment: which rays meet it, and where."""
    found: dict[str, list[Any]] = defaultdict(list)
    for placed in placements:
        ours = _snapshot(placed)
        theirs = {"Open3D": cast_open3d(o3d, placed).astype(np.float64), "trimesh": _trimesh_ranges(placed)}
        for name, ranges in theirs.items():
            found[name].append((ours, ranges))
    print("First hit of every ray at the car's moment, ours beside theirs\n")
    print("| | rays that meet a car: both | one alone | within 1 mm, of both | median mm | 99.9 % mm | largest mm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, items in found.items():
        ours, theirs = (np.concatenate(column) for column in zip(*items, strict=True))
        both = np.isfinite(ours) & np.isfinite(theirs)
        off = np.abs(ours[both] - theirs[both])
        alone = (np.isfinite(ours) != np.isfinite(theirs)).sum()
        middle, high = 1e3 * np.quantile(off, [0.5, 0.999])
        print(f"| {name} | {both.sum():,} | {alone:,} | {100 * (off <= SAME_M).mean():.3f} %", end=" | ")
        print(f"{middle:.4f} | {high:.4f} | {1e3 * off.max():.2f} |")


def _snapshot(placed: Placed) -> F64:
    """Our first range of each ray (R,); infinite where it meets nothing."""
    rays = placed.prepared.rays
    every = np.arange(len(rays), dtype=np.int32)
    T_car_velo = np.broadcast_to(invert(placed.pose), (len(rays), 4, 4))
    hits = cast_car(placed.car.model, T_car_velo, rays, every, PROFILE, False)
    ranges = np.full(len(rays), np.inf)
    ranges[hits.ray] = hits.range_m[:, 0]
    return ranges


def _trimesh_ranges(placed: Placed) -> F64:
    place, ray, _ = cast_trimesh(placed)
    ranges = np.full(len(placed.origin), np.inf)
    ranges[ray] = ((place - placed.origin[ray]) * placed.direction[ray]).sum(axis=1)
    return ranges


def show_times(spent: dict[str, list[float]], placements: list[Placed], rounds: int, threads: int) -> None:
    """A row for each way; ratios are medians over the same placements and rounds."""
    rays = np.array([len(placed.origin) for placed in placements])
    names = sorted({placed.car.model.name for placed in placements})
    print(
        f"\n{len(placements) // 2} cars of {len(names)} models in two scans each, {rounds} rounds, {threads} core(s);",
        end=" ",
    )
    print(f"{rays.mean():,.0f} rays and {_triangles(placements):,.0f} triangles in the mean\n")
    print("| a car and scan | ms, median | 10 to 90 % | times ours, median | 10 to 90 % | million rays/s of the scan |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, values in spent.items():
        low, high = np.quantile(values, [0.1, 0.9])
        ratio = np.array(values) / np.array(spent[OURS])[: len(values)]
        rate = np.median(np.resize(rays, len(values)) / np.array(values)) / 1e3
        print(f"| {name} | {np.median(values):.2f} | {low:.2f} to {high:.2f} | {np.median(ratio):.2f}", end=" | ")
        print(f"{np.quantile(ratio, 0.1):.2f} to {np.quantile(ratio, 0.9):.2f} | {rate:.2f} |")


def _triangles(placements: list[Placed]) -> float:
    return float(np.mean([len(placed.car.model.faces) for placed in placements]))


if __name__ == "__main__":
    main()
