"""Fuzzing of every reader: a valid small file of each format in, seeded mutations of it read in a limited process out.

`make fuzz` runs 2,000 mutations a format and prints the table of docs/reliability.md; `test_fuzz.py` runs 100. A case
is `read` (the reader's result passes plain checks), `refused` (an `InputError` of one line) or a fault: any other
exception or warning, words on stderr, more than 2 s of processor time, 1 GB of memory asked for, a crash, a hang.
A case is given by its format and number alone, so that `python tests/fuzz_readers.py --case FORMAT NUMBER` shows it.
"""

import argparse
import contextlib
import gc
import json
import os
import random
import re
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

CPU_S = 2.0
MEMORY_BYTES = 1 << 30  # over what the program takes with the valid file read
HANG_S = 60.0  # wall clock: on a busy machine 2 s of processor time may take long


@dataclass(frozen=True)
class Format:
    """One format: how its valid files are made, which of them are harmed, and what reads them."""

    name: str
    make: Callable[[Path], list[Path]]  # writes a folder that reads well; returns the files to harm
    read: Callable[[Path], None]  # reads the folder through the public functions, checks the result
    kind: str = "words"  # which harms fit: words, json, yaml, xml, glb or bytes


# --- valid files ---------------------------------------------------------------------------------------------------

DRIVE = "2011_09_26_drive_0005_sync"
DAY = Path("raw/2011_09_26")
FIRINGS = 90


def _drive(folder: Path, *names: str, **options) -> list[Path]:
    from tiny_drive import write_drive

    write_drive(folder, frames=(0, 1, 2), name=DRIVE, firings=FIRINGS, **options)
    return [folder / name for name in names]


def _sequence(folder: Path, name: str = DRIVE):
    from augkitti.kitti import open_root

    return open_root(folder).sequence(name)


def _finite(*arrays) -> None:
    for array in arrays:
        assert np.isfinite(array).all(), "a number that is not finite came through"


def _check_motion(motion) -> None:
    from augkitti.frames import is_rigid

    assert motion is None or is_rigid(motion.T_velo1_velo0, 1e-6), "no rigid motion came through"


def _check_boxes(boxes) -> None:
    for box in boxes:
        _finite(box.box)
        assert box.box.shape == (7,)
        assert (box.box[3:6] > 0.0).all()


def _read_drive(folder: Path) -> None:
    from augkitti.kitti import known_ego_motion, label_reach, read_labels, read_scan, scan_digest

    sequence = _sequence(folder)
    scan = read_scan(sequence, 1)
    _finite(scan.xyz, scan.reflectance, scan.time_s, scan.period_s)
    scan_digest(sequence, 1)
    _check_motion(known_ego_motion(sequence, 1))
    for frame in (0, 1):
        _check_boxes(read_labels(sequence, frame))
    _, azimuth = label_reach(sequence)
    _finite(azimuth or 0.0)


def _tracking(*names: str) -> Callable[[Path], list[Path]]:
    def make(folder: Path) -> list[Path]:
        from tiny_drive import write_drive

        write_drive(folder, frames=(0, 1, 2), name="2011_09_26_drive_0005_sync", labels="tracking", firings=FIRINGS)
        (folder / "raw/2011_09_26/calib_cam_to_cam.txt").unlink()  # so that image 2 comes from the tracking calibration
        return [folder / "tracking/training" / name for name in names]

    return make


def _read_tracking(folder: Path) -> None:
    from augkitti.kitti import label_reach, read_labels

    sequence = _sequence(folder)
    for frame in (0, 1, 2):
        _check_boxes(read_labels(sequence, frame))
    _, azimuth = label_reach(sequence)
    _finite(azimuth or 0.0)


def _objects(*names: str) -> Callable[[Path], list[Path]]:
    def make(folder: Path) -> list[Path]:
        from tiny_drive import write_drive

        inner = folder / "from"
        write_drive(inner, frames=(0,), name="2011_09_26_drive_0005_sync", labels="tracking", firings=FIRINGS)
        home = folder / "object/training"
        for name in ("velodyne", "label_2", "calib"):
            (home / name).mkdir(parents=True)
        scan = inner / "raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data/0000000000.bin"
        scan.rename(home / "velodyne/000000.bin")
        (inner / "tracking/training/calib/0000.txt").rename(home / "calib/000000.txt")
        rows = (inner / "tracking/training/label_02/0000.txt").read_text().splitlines()
        (home / "label_2/000000.txt").write_text("".join(f"{row.split(' ', 2)[2]}\n" for row in rows))
        return [home / name for name in names]

    return make


def _read_objects(folder: Path) -> None:
    from augkitti.kitti import label_reach, open_root, read_labels

    sequence = open_root(folder).sequence("object_training")
    _check_boxes(read_labels(sequence, 0))
    label_reach(sequence)


def _odometry(*names: str) -> Callable[[Path], list[Path]]:
    def make(folder: Path) -> list[Path]:
        import tiny_drive

        tiny_drive.write_odometry(folder)
        return [folder / "odometry" / name for name in names]

    return make


def _read_odometry(folder: Path) -> None:
    from augkitti.kitti import known_ego_motion, open_root, scan_time

    sequence = open_root(folder).sequence("odometry_04")
    _check_motion(known_ego_motion(sequence, 0))
    _finite(*scan_time(sequence, 0), *scan_time(sequence, 1))


# A car of three boxes with two panes, as small as the loader takes; x forward, z up, metres.
FACTS = {"class": "car", "up_axis": [0, 0, 1], "forward_axis": [1, 0, 0], "unit_scale": 1.0, "length_m": 4.2}
BOXES = {
    "body": (-2.1, 2.1, -0.85, 0.85, 0.3, 0.9),
    "pane": (-1.4, 0.7, -0.7, 0.7, 0.9, 1.45),
    "wheel": (-1.6, -1.0, -0.8, 0.8, 0.0, 0.6),
    "wheel_2": (1.0, 1.6, -0.8, 0.8, 0.0, 0.6),
}
QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))


def _box(name: str) -> tuple[np.ndarray, np.ndarray]:
    x0, x1, y0, y1, z0, z1 = BOXES[name]
    vertices = np.array([[x, y, z] for z in (z0, z1) for y in (y0, y1) for x in (x0, x1)])
    faces = np.array([tri for a, b, c, d in QUADS for tri in ((a, b, c), (a, c, d))])
    return vertices, faces


def _all_boxes() -> tuple[np.ndarray, np.ndarray]:
    parts = [_box(name) for name in BOXES]
    return np.concatenate([v for v, _ in parts]), np.concatenate([f + 8 * i for i, (_, f) in enumerate(parts)])


def _sidecar(folder: Path, **changes) -> Path:
    import yaml

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "car.yaml"
    path.write_text(yaml.safe_dump({**FACTS, **changes}, sort_keys=False))
    return path


def _read_cars(folder: Path) -> None:
    from augkitti.cad_models import load_cad_folder

    library = load_cad_folder(folder)
    for decision in library.report:
        assert len(str(decision.problem).splitlines()) == 1, f"a problem of several lines: {decision.problem!r}"
    for model in library.models:
        _finite(model.vertices, model.opacity, model.size_m, model.wheelbase_m, model.rear_axle_x_m)
        assert len(model.faces)
        assert model.faces.min() >= 0
        assert model.faces.max() < len(model.vertices)


def _obj(folder: Path) -> list[Path]:
    _sidecar(folder)
    lines, count = ["mtllib car.mtl", "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"], 0
    for name in BOXES:
        vertices, _ = _box(name)
        lines += [f"o {name}", f"usemtl {name.removesuffix('_2')}"]
        lines += [f"v {x:g} {y:g} {z:g}" for x, y, z in vertices]
        lines += ["f " + " ".join(f"{count + k + 1}/{t}" for k, t in zip(q, (1, 2, 3, 4), strict=True)) for q in QUADS]
        count += 8
    (folder / "car.obj").write_text("\n".join(lines) + "\n")
    (folder / "car.mtl").write_text(
        "newmtl body\nKd 0.5 0.1 0.1\nd 1.0\n\nnewmtl pane\nKd 0.1 0.1 0.1\nd 0.9\nmap_d pane.png\n\n"
        "newmtl wheel\nKd 0.05 0.05 0.05\nTr 0.0\n"
    )
    _png(folder / "pane.png")
    return [folder / "car.obj", folder / "car.obj", folder / "car.mtl"]


def _png(path: Path) -> None:
    from PIL import Image

    Image.fromarray(np.full((16, 16), 80, np.uint8)).save(path)


def _opacity_image(folder: Path) -> list[Path]:
    _obj(folder)
    return [folder / "pane.png"]


def _scene():
    import trimesh

    scene = trimesh.Scene()
    for name in BOXES:
        vertices, faces = _box(name)
        turned = np.stack([vertices[:, 0], vertices[:, 2], -vertices[:, 1]], axis=1)  # glTF: y up
        pane = name == "pane"
        material = trimesh.visual.material.PBRMaterial(
            name=name, baseColorFactor=[90, 90, 90, 90 if pane else 255], alphaMode="BLEND" if pane else "OPAQUE"
        )
        visual = trimesh.visual.TextureVisuals(uv=np.zeros((8, 2)), material=material)
        mesh = trimesh.Trimesh(turned, faces, visual=visual, process=False)
        scene.add_geometry(mesh, node_name=name, geom_name=name)
    return scene


def _glb(folder: Path) -> list[Path]:
    _sidecar(folder, up_axis=[0, 1, 0])
    (folder / "car.glb").write_bytes(_scene().export(file_type="glb"))
    return [folder / "car.glb"]


def _gltf(folder: Path) -> list[Path]:
    _sidecar(folder, up_axis=[0, 1, 0])
    for name, content in _scene().export(file_type="gltf").items():
        (folder / name.replace("model.gltf", "car.gltf")).write_bytes(content)
    return [folder / "car.gltf"] * 3 + sorted(folder.glob("*.bin"))[:1]


def _dae(folder: Path) -> list[Path]:
    _sidecar(folder)
    effects, materials, geometries, nodes = [], [], [], []
    for name in BOXES:
        vertices, faces = _box(name)
        amount = "0.3" if name == "pane" else "1"
        effects.append(
            f'<effect id="{name}-fx"><profile_COMMON><technique sid="c"><lambert>'
            f"<diffuse><color>0.5 0.1 0.1 1</color></diffuse>"
            f'<transparent opaque="A_ONE"><color>1 1 1 {amount}</color></transparent>'
            f"<transparency><float>1</float></transparency></lambert></technique></profile_COMMON></effect>\n"
        )
        materials.append(f'<material id="{name}-m" name="{name}"><instance_effect url="#{name}-fx"/></material>\n')
        numbers = " ".join(f"{v:g}" for v in vertices.ravel())
        geometries.append(
            f'<geometry id="{name}-g" name="{name}"><mesh><source id="{name}-p">'
            f'<float_array id="{name}-a" count="24">{numbers}</float_array><technique_common>'
            f'<accessor source="#{name}-a" count="8" stride="3"><param name="X" type="float"/>'
            f'<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>\n'
            f'<vertices id="{name}-v"><input semantic="POSITION" source="#{name}-p"/></vertices>'
            f'<triangles count="12" material="paint"><input semantic="VERTEX" source="#{name}-v" offset="0"/>'
            f"<p>{' '.join(map(str, faces.ravel()))}</p></triangles></mesh></geometry>\n"
        )
        nodes.append(
            f'<node id="{name}"><matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#{name}-g">'
            f"<bind_material><technique_common>"
            f'<instance_material symbol="paint" target="#{name}-m"/></technique_common></bind_material>'
            f"</instance_geometry></node>\n"
        )
    (folder / "car.dae").write_text(
        '<?xml version="1.0" encoding="utf-8"?>\n'
        '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">\n'
        '<asset><created>2011-09-26</created><modified>2011-09-26</modified><unit name="meter" meter="1"/>'
        "<up_axis>Z_UP</up_axis></asset>\n"
        '<library_images><image id="i"><init_from>paint.png</init_from></image></library_images>\n'
        f"<library_effects>{''.join(effects)}</library_effects>\n"
        f"<library_materials>{''.join(materials)}</library_materials>\n"
        f"<library_geometries>{''.join(geometries)}</library_geometries>\n"
        f'<library_visual_scenes><visual_scene id="s">{"".join(nodes)}</visual_scene></library_visual_scenes>\n'
        '<scene><instance_visual_scene url="#s"/></scene>\n</COLLADA>\n'
    )
    return [folder / "car.dae"]


def _plain(suffix: str, **options) -> Callable[[Path], list[Path]]:
    def make(folder: Path) -> list[Path]:
        import trimesh

        _sidecar(folder)
        vertices, faces = _all_boxes()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        content = mesh.export(file_type=suffix, **options)
        path = folder / f"car.{suffix}"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return [path]

    return make


def _sidecar_yaml(folder: Path) -> list[Path]:
    _obj(folder)
    return [
        _sidecar(
            folder,
            width_m=1.7,
            glass=[{"material": "pane", "alpha": 0.3}],
            drop_materials=["shadow"],
            wheel_files=[],
            wheel_centres_m=[[1.3, 0.8, 0.3]],
        )
    ]


def _cad_manifest(folder: Path) -> list[Path]:
    _obj(folder / "car")
    (folder / "car/car.yaml").unlink()
    entry = {"name": "car", "main_file": "car.obj", **FACTS, "glass": [{"material": "pane", "alpha": 0.3}]}
    path = folder / "manifest.json"
    path.write_text(json.dumps({"models": [{**entry, "wheel_files": [], "drop_materials": ["shadow"]}]}, indent=1))
    return [path]


def _car_cache(folder: Path) -> list[Path]:
    from augkitti.cad_models import load_cad_folder

    _obj(folder / "cars")
    load_cad_folder(folder / "cars", cache_dir=folder / "cache")
    return sorted((folder / "cache").glob("*.npz"))


def _read_car_cache(folder: Path) -> None:
    from augkitti.cad_models import load_cad_folder

    (model,) = load_cad_folder(folder / "cars", cache_dir=folder / "cache").models
    _finite(model.vertices)
    assert len(model.vertices) == 32, "a damaged cache file was believed"


def _config(folder: Path) -> list[Path]:
    import yaml

    from augkitti.config import Config

    path = folder / "config.yaml"
    path.write_text(yaml.safe_dump(Config().model_dump(mode="json"), sort_keys=False))
    return [path]


def _read_config(folder: Path) -> None:
    from augkitti.config import load_config

    load_config(folder / "config.yaml").digest()


def _profile(folder: Path) -> list[Path]:
    from augkitti.scanner import load_profile

    path = folder / "profile.json"
    path.write_text(json.dumps(load_profile().content, indent=1))
    return [path]


def _read_profile(folder: Path) -> None:
    from augkitti.scanner import fire_rays, load_profile, ray_lines

    profile = load_profile(folder / "profile.json")
    rays = fire_rays(profile, np.arange(0, profile.lattice_size, 500).astype(np.uint16), 0.1)
    _finite(rays.ray_azimuth_rad, rays.ray_time_s)
    _finite(*ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad))
    assert len(profile.digest) == 64


def _noise(folder: Path) -> list[Path]:
    from augkitti.range_noise import load_noise, save_noise

    save_noise(load_noise(), folder / "noise.npz")
    return [folder / "noise.npz"]


def _read_noise(folder: Path) -> None:
    from augkitti.range_noise import load_noise, solid_part

    profile = load_noise(folder)
    _finite(*profile.arrays.values())
    solid_part(profile)


def _prepared(folder: Path) -> list[Path]:
    from augkitti.config import Config
    from augkitti.scanner import load_profile
    from pipelines.prepare import prepared_pair

    _drive(folder)
    prepared_pair(_sequence(folder), 0, load_profile(), Config(), folder)
    files = sorted((folder / "prepared").rglob("*.arrays"))
    for path in files:
        path.with_suffix(".kept").write_bytes(path.read_bytes())
    return files


def _read_prepared(folder: Path) -> None:
    from pipelines.cache import load

    for path in sorted((folder / "prepared").rglob("*.arrays")):
        whole, found = path.with_suffix(".kept").read_bytes(), load(path)
        assert found is None or path.read_bytes() == whole, "a damaged cache file was believed"
        assert found is not None or path.read_bytes() != whole, "a whole cache file was not"


def _run_state(folder: Path) -> list[Path]:
    from pipelines.run import WORK, open_run, read_options, start_work

    _drive(folder / "kitti")
    given = {"cad": None, "seed": 0, "config": None, "profile": None, "stop_on_error": False}
    start_work(open_run(read_options(kitti=folder / "kitti", out=folder / "out", n=2, **given)), resume=False)
    return [folder / "out" / WORK / "run.json"]


def _read_run_state(folder: Path) -> None:
    from augkitti.errors import InputError, MachineError
    from pipelines.run import reopen_run

    try:
        reopen_run(folder / "out")
    except MachineError as err:  # an address that a word made of a path: its store gives no answer
        raise InputError(err.where, err.problem, err.remedy) from None


def _source_sidecar(folder: Path) -> list[Path]:
    return _drive(folder, f"{DAY}/{DRIVE}/augkitti_source.json", f"{DAY}/{DRIVE}/velo_poses.txt", truth=True)


def _data_set(folder: Path) -> list[Path]:
    from pair_factory import make_pair, metadata, write_whole_index

    from augkitti.dataset_index import shard_entry
    from augkitti.shards import write_shard
    from augkitti.splits import split_dataset

    entries = []
    for number in range(3):
        sequence = f"2011_09_26_drive_{9000 + number}_sync"
        made = make_pair(sequence, tick_step=80)
        path = folder / "data" / f"{sequence}-00000.parquet"
        write_shard(path, [made.pair], metadata())
        entries.append(shard_entry(folder, path, sequence, made.pair.recording, 1))
    write_whole_index(folder, entries)
    split_dataset(folder)
    return [folder / "data" / f"{entries[0].sequence}-00000.parquet"]


def _index(folder: Path) -> list[Path]:
    _data_set(folder)
    return [folder / "dataset.json"]


def _splits(folder: Path) -> list[Path]:
    _data_set(folder)
    return [folder / "splits.json"]


def _read_data_set(folder: Path) -> None:
    from augkitti.dataset import open_dataset

    first = next(iter(open_dataset(folder)), None)
    for pair in () if first is None else (first,):
        assert pair.flow0.shape == pair.scan0.xyz.shape
        for scan in (pair.scan0, pair.scan1):
            for name in ("reflectance", "ring", "tick", "source", "instance", "surface"):
                assert len(getattr(scan, name)) == len(scan), f"{name} has another length than xyz"
    for split in ("train", "validation", "test"):
        with contextlib.suppress(IndexError):
            _ = open_dataset(folder, split)[0]


def _read_shard(folder: Path) -> None:
    from augkitti.scanner import profile_from_content
    from augkitti.shards import read_frames, read_metadata, read_pair, read_pair_ids

    (path,) = (folder / "data").glob("*9000*")
    profile_from_content(read_metadata(path).get("scanner_profile"), str(path))
    assert all(isinstance(name, str) for name in read_pair_ids(path))
    read_frames(path)
    read_pair(path, 0)
    _read_data_set(folder)


def _read_index(folder: Path) -> None:
    from augkitti.dataset_index import card, read_index
    from augkitti.splits import check_splits, read_splits

    index = read_index(folder)
    card(index)
    splits = read_splits(folder / "splits.json")
    for problem in check_splits(index, splits):
        assert len(problem.splitlines()) == 1, f"a problem of several lines: {problem!r}"
    _read_data_set(folder)


STAMPS = ("timestamps.txt", "timestamps_start.txt", "timestamps_end.txt")
FORMATS = (
    Format(
        "velodyne .bin",
        lambda folder: _drive(folder, f"{DAY}/{DRIVE}/velodyne_points/data/0000000001.bin"),
        _read_drive,
        kind="bytes",
    ),
    Format("oxts", lambda folder: _drive(folder, f"{DAY}/{DRIVE}/oxts/data/0000000001.txt"), _read_drive),
    Format(
        "timestamps",
        lambda folder: _drive(
            folder,
            *(f"{DAY}/{DRIVE}/velodyne_points/{name}" for name in STAMPS),
            f"{DAY}/{DRIVE}/oxts/timestamps.txt",
        ),
        _read_drive,
    ),
    Format(
        "calib of a day",
        lambda folder: _drive(folder, *(f"{DAY}/calib_{n}.txt" for n in ("imu_to_velo", "velo_to_cam", "cam_to_cam"))),
        _read_drive,
    ),
    Format(
        "tracklets XML", lambda folder: _drive(folder, f"{DAY}/{DRIVE}/tracklet_labels.xml"), _read_drive, kind="xml"
    ),
    Format("augkitti_source.json, velo_poses.txt", _source_sidecar, _read_drive, kind="json"),
    Format("tracking label_02", _tracking("label_02/0000.txt"), _read_tracking),
    Format("tracking calib", _tracking("calib/0000.txt"), _read_tracking),
    Format("object label_2, calib", _objects("label_2/000000.txt", "calib/000000.txt"), _read_objects),
    Format(
        "odometry poses, times, calib",
        _odometry("poses/04.txt", "sequences/04/times.txt", "sequences/04/calib.txt"),
        _read_odometry,
    ),
    Format("GLB", _glb, _read_cars, kind="glb"),
    Format("glTF", _gltf, _read_cars, kind="json"),
    Format("OBJ, MTL", _obj, _read_cars),
    Format("opacity image", _opacity_image, _read_cars, kind="bytes"),
    Format("DAE", _dae, _read_cars, kind="xml"),
    Format("PLY", _plain("ply", encoding="ascii"), _read_cars),
    Format("PLY, binary", _plain("ply"), _read_cars, kind="bytes"),
    Format("OFF", _plain("off"), _read_cars),
    Format("CAD sidecar YAML", _sidecar_yaml, _read_cars, kind="yaml"),
    Format("CAD manifest.json", _cad_manifest, _read_cars, kind="json"),
    Format("car cache", _car_cache, _read_car_cache, kind="bytes"),
    Format("configuration YAML", _config, _read_config, kind="yaml"),
    Format("scanner profile JSON", _profile, _read_profile, kind="json"),
    Format("noise profile .npz", _noise, _read_noise, kind="bytes"),
    Format("prepared .arrays", _prepared, _read_prepared, kind="bytes"),
    Format("run.json", _run_state, _read_run_state, kind="json"),
    Format("shard", _data_set, _read_shard, kind="bytes"),
    Format("dataset.json", _index, _read_index, kind="json"),
    Format("splits.json", _splits, _read_index, kind="json"),
)
BY_NAME = {item.name: item for item in FORMATS}


# --- mutations -----------------------------------------------------------------------------------------------------

NUMBERS = (
    *("0", "-0", "-1", "1", "2", "7", "255", "256", "65535", "65536", "2147483647", "2147483648", "4294967295"),
    *("-2147483649", "9223372036854775807", "9223372036854775808", "1e30", "-1e30", "1e155", "1e300", "-1e308"),
    *("1e309", "1e-300", "5e-324", "nan", "-nan", "inf", "-inf", "NaN", "Infinity", "0.5", "1.5", "1e9", "0x1F"),
    *("1_0", "9" * 30, "9" * 400, "9" * 5000, "1.0.0", "1,5", "--1", "1e", ".", "+", "٣", "１２", "½", "1e999999999"),
)
WORDS = (
    *("", " ", "x", "null", "~", "true", "false", "[]", "{}", "[[]]", '""', "''", '"x"', "[1, 2]", '{"a": 1}', "\\"),
    *("../../etc/passwd", "/etc/passwd", "file:///etc/passwd", "http://localhost:1/x", "%2e%2e%2fx", "..\\x", "C:\\x"),
    *("\0", "é", "\U0001f4a5", "\u2028", "\u0085", "\ufeff", "\u202e", "\ud7ff", "\x1b[31m", "a\nb", "\r", "\x0c"),
    *("A" * 300, "A" * 5000, "%", "%00", "&amp;", "&x;", "<a>", "]]>", "<!--", "*a", "&a b", "!!python/name:os", "!x"),
    *(".inf", ".nan", "2001-01-01", "1:30", "on", "no", "? :", "- - -", "|", ">", "<<: *x", "#", "DontCare", "Car"),
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_TOKEN = re.compile(rb'"[^"\n]*"|[A-Za-z_][\w.\-]*|[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?|[^\s\w]')
_INTS = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0xFFFFFFFE, 0x10000000)
_FLOATS = (float("nan"), float("inf"), float("-inf"), 3e38, -3e38, 1e-40, -0.0, 0.0, 1e20)


def mutated(content: bytes, rng: random.Random, kind: str) -> bytes:
    """Between one and four harms, one after another: two in three such as the format is made of, one of bytes."""
    if rng.random() < 0.01:
        return b""
    of_kind = rng.random() < 0.67
    for _ in range(rng.choice((1, 1, 1, 2, 2, 3, 4))):
        harms = HARMS[kind] if of_kind else BYTE_HARMS
        if not content or len(content) > 1 << 20:  # lines a thousand times over: enough
            break
        content = rng.choice(harms)(content, rng)
    return content


def _span(content: bytes, rng: random.Random) -> tuple[int, int]:
    start = rng.randrange(len(content))
    length = rng.choice((1, 2, 4, 8, 16, 100, 1000, len(content) // 3 + 1))
    return start, min(len(content), start + length)


def _flip(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _byte(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content))
    return content[:at] + bytes([rng.choice((0, 0xFF, 0x80, 0x0A, 0x20, rng.randrange(256)))]) + content[at + 1 :]


def _truncate(content: bytes, rng: random.Random) -> bytes:
    return content[: rng.choice((rng.randrange(len(content)), len(content) - 1, min(len(content), rng.randrange(40))))]


def _behead(content: bytes, rng: random.Random) -> bytes:
    return content[rng.choice((1, 4, rng.randrange(len(content)))) :]


def _insert(content: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(content) + 1)
    return content[:at] + rng.randbytes(rng.choice((1, 2, 4, 16, 300))) + content[at:]


def _cut_out(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    return content[:start] + content[end:]


def _duplicate(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    times = rng.choice((1, 1, 2, 10))
    return content[:end] + content[start:end] * times + content[end:]


def _overwrite(content: bytes, rng: random.Random) -> bytes:
    start, end = _span(content, rng)
    at = rng.randrange(len(content))
    piece = rng.choice((bytes(end - start), b"\xff" * (end - start), content[start:end], rng.randbytes(end - start)))
    return content[:at] + piece + content[at + len(piece) :]


def _integer(content: bytes, rng: random.Random) -> bytes:
    at, size = rng.randrange(len(content)), rng.choice((1, 2, 4, 8))
    at -= at % rng.choice((1, size))
    value = rng.choice(_INTS) & ((1 << 8 * size) - 1)
    return content[:at] + value.to_bytes(size, rng.choice(("little", "little", "big"))) + content[at + size :]


def _float(content: bytes, rng: random.Random) -> bytes:
    value = np.array(rng.choice(_FLOATS), rng.choice(("<f4", "<f4", "<f8"))).tobytes()
    at = rng.randrange(len(content))
    at -= at % len(value)
    return content[:at] + value + content[at + len(value) :]


BYTE_HARMS = (_flip, _byte, _truncate, _behead, _insert, _cut_out, _duplicate, _overwrite, _integer, _float)


def _encoded(word: str) -> bytes:
    return word.encode("utf-8", "surrogatepass")


def _number_token(content: bytes, rng: random.Random) -> bytes:
    found = list(_NUMBER.finditer(content))
    if not found:
        return _flip(content, rng)
    for match in sorted(rng.sample(found, min(len(found), rng.choice((1, 1, 1, 3)))), key=lambda m: -m.start()):
        content = content[: match.start()] + _encoded(rng.choice(NUMBERS)) + content[match.end() :]
    return content


def _any_token(content: bytes, rng: random.Random) -> bytes:
    found = list(_TOKEN.finditer(content))
    if not found:
        return _flip(content, rng)
    match = rng.choice(found)
    other = rng.choice(found).group()
    word = rng.choice((_encoded(rng.choice(WORDS)), _encoded(rng.choice(NUMBERS)), other))
    if match.group().startswith(b'"') and rng.random() < 0.6:
        word = b'"' + word.strip(b'"') + b'"'
    return content[: match.start()] + word + content[match.end() :]


def _lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.split(b"\n")
    at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
    match rng.randrange(8):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[other])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            lines.insert(at, b"")
        case 4:
            lines[at:at] = [lines[other]] * rng.choice((10, 1000))
        case 5:
            return rng.choice((b" ", b"", b"\r\n", b"\r", b"\n\n")).join(lines)
        case 6:
            lines[at] = lines[at] + b" " + lines[other]
        case 7:
            lines[at] = _encoded(rng.choice(WORDS))
    return b"\n".join(lines)


def _json_value(content: bytes, rng: random.Random) -> bytes:
    """One value of a JSON text exchanged for one of another kind, a key taken away, or nesting without end."""
    try:
        document = json.loads(content)
    except (ValueError, RecursionError):
        return _any_token(content, rng)
    places = []

    def walk(node, depth=0):
        for key in list(node) if isinstance(node, dict) else range(min(len(node), 40)):
            places.append((node, key))
            if isinstance(node[key], dict | list) and depth < 30:
                walk(node[key], depth + 1)

    if not isinstance(document, dict | list):
        return _any_token(content, rng)
    walk(document)
    if not places:
        return b"{}"
    shallow = [place for place in places if isinstance(place[0], dict)] or places
    node, key = rng.choice(rng.choice((places, shallow)))
    deep = rng.choice(("[" * 5000 + "]" * 5000, '{"a":' * 3000 + "1" + "}" * 3000)) if rng.random() < 0.05 else None
    if rng.random() < 0.15:
        del node[key]
    else:
        odd = (None, True, -1, 0, 1, 2**31, 2**63, 10**400, 1e308, float("nan"), float("inf"), 0.5, "", "x", "../x")
        more = ([], {}, [[]], [None], [1e400], {"a": 1}, "\ud800", "A" * 5000, "a\nb", [0] * 20, "/etc/passwd", "1e999")
        node[key] = "@@" if deep else rng.choice((*odd, *more, node[key], [node[key]], rng.choice(places)[0]))
    try:
        text = json.dumps(document, indent=rng.choice((None, 1)))
    except (ValueError, RecursionError):  # the document in itself
        return _any_token(content, rng)
    return _encoded(text.replace('"@@"', deep) if deep else text)


def _tag(content: bytes, rng: random.Random) -> bytes:
    """An XML element doubled, emptied, taken away or nested; entities and document types declared."""
    found = list(re.finditer(rb"<(\w+)[^<>]*>([^<>]*)</\1>", content))
    if not found:
        return _any_token(content, rng)
    match = rng.choice(found)
    bomb = '<!ENTITY a "x">' + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in pairwise("abcdefghij"))
    outside = '<!ENTITY j SYSTEM "file:///etc/passwd">'
    name = match.group(1)
    match rng.randrange(6):
        case 0:
            piece = match.group() * rng.choice((2, 50))
        case 1:
            piece = b""
        case 2:
            piece = b"<" + name + b"/>"
        case 3:
            piece = (b"<" + name + b">") * 3000 + (b"</" + name + b">") * 3000
        case 4:
            piece = b"<" + name + b">" + _encoded(rng.choice(WORDS)) + b"</" + name + b">"
        case 5:
            head = _encoded(f"<!DOCTYPE x [{rng.choice((bomb, outside))}]>")
            start = content.find(b"?>") + 2 if content.startswith(b"<?xml") else 0
            body = re.sub(rb"<!DOCTYPE[^>]*>", b"", content[start:])
            return content[:start] + head + body.replace(match.group(2), b"&j;", 1)
    return content[: match.start()] + piece + content[match.end() :]


def _yaml_bomb(content: bytes, rng: random.Random) -> bytes:
    """Aliases of aliases, or nesting without end, in place of a value or beside all else."""
    names = "abcdefghi"
    bomb = 'a: &a ["x","x","x","x","x","x","x","x","x"]\n' + "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in pairwise(names)
    )
    merges = 'a: &a {"x": 1}\n' + "".join(
        f"{b}: &{b} {{<<: [{','.join([f'*{a}'] * 9)}]}}\n" for a, b in pairwise(names)
    )
    more = (
        merges,
        "deep: " + "[" * 3000 + "]" * 3000 + "\n",
        "deep: " + "{a: " * 2000 + "}" * 2000 + "\n",
        "&a a: *a\n",
    )
    chosen = rng.choice((bomb, bomb.replace("\n", ", "), *more)).encode()
    lines = content.split(b"\n")
    at = rng.randrange(len(lines))
    if rng.random() < 0.5 and b":" in lines[at]:
        end = b" *i" if chosen.startswith(b"a:") else b" " + chosen.partition(b":")[2]
        return (bomb.encode() if end == b" *i" else b"") + b"\n".join(
            [*lines[:at], lines[at].partition(b":")[0] + b":" + end, *lines[at + 1 :]]
        )
    return b"\n".join([*lines[:at], chosen, *lines[at:]])


def _loader():
    import yaml

    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _dumper():
    import yaml

    return getattr(yaml, "CSafeDumper", yaml.SafeDumper)


def _yaml_value(content: bytes, rng: random.Random) -> bytes:
    """As `_json_value`, in YAML."""
    import yaml

    if b"&" in content:  # a bomb is in it already
        return _lines(content, rng)
    with contextlib.suppress(yaml.YAMLError, ValueError, RecursionError):
        harmed = _json_value(json.dumps(yaml.load(content, Loader=_loader())).encode(), rng)
        text = yaml.dump(json.loads(harmed), Dumper=_dumper(), sort_keys=False, allow_unicode=True)
        return text.encode("utf-8", "surrogatepass")
    return _any_token(content, rng)


def _glb_chunk(content: bytes, rng: random.Random) -> bytes:
    """A GLB with one of its chunks harmed and all lengths right."""
    length = int.from_bytes(content[12:16], "little")
    text, rest = content[20 : 20 + length], content[28 + length :]
    if content[:4] != b"glTF" or not text.startswith(b"{"):
        return _flip(content, rng)
    if rng.random() < 0.75:
        text = _json_value(text, rng)
    elif rest:
        rest = rng.choice(BYTE_HARMS)(rest, rng)
    text, rest = text + b" " * (-len(text) % 4), rest + bytes(-len(rest) % 4)
    body = len(text).to_bytes(4, "little") + b"JSON" + text + len(rest).to_bytes(4, "little") + b"BIN\0" + rest
    return b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body


def _floats(content: bytes, rng: random.Random) -> bytes:
    """Four-byte numbers at their places exchanged for odd ones."""
    values = np.frombuffer(content[: len(content) // 4 * 4], "<f4").copy()
    if not len(values):
        return _flip(content, rng)
    count = rng.choice((1, 1, 4, 100, len(values) // 4))
    at = np.array([rng.randrange(len(values)) for _ in range(count)], dtype=int)
    values[at] = np.array([rng.choice(_FLOATS) for _ in range(count)], dtype="<f4")
    return values.tobytes()


_WORD_HARMS = (_number_token, _number_token, _number_token, _any_token, _lines)
HARMS = {
    "words": _WORD_HARMS,
    "json": (_json_value, _json_value, _json_value, _json_value, *_WORD_HARMS),
    "yaml": (_yaml_value, _yaml_value, _yaml_value, _yaml_bomb, *_WORD_HARMS),
    "xml": (_tag, *_WORD_HARMS),
    "glb": (_glb_chunk,),
    "bytes": (_floats, _integer),
}


def _harm_archive(path: Path, rng: random.Random) -> None:
    """An archive that is a good one, of which one file is harmed."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = rng.choice(sorted(members))
    with zipfile.ZipFile(path, "w") as archive:
        for member, content in members.items():
            archive.writestr(member, mutated(content, rng, "bytes") if member == name else content)


def _harm_shard(path: Path, rng: random.Random) -> None:
    """A shard that is good Parquet, but whose columns, values or metadata are not the contract's."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    at = rng.randrange(table.num_columns)
    name, type_ = table.column_names[at], table.schema.field(at).type
    kind = rng.randrange(6)
    if kind == 0:
        table = table.drop_columns([name])
    elif kind == 1:
        metadata = table.schema.metadata or {}
        table = table.replace_schema_metadata({**metadata, b"augkitti": mutated(metadata[b"augkitti"], rng, "json")})
    else:
        value = table.column(at)[0].as_py()
        if kind == 2:
            value = None
        elif isinstance(value, list):
            value = rng.choice((value[:-1], value * 2, [], [None], [None, *value]))
        elif isinstance(value, str):
            value = rng.choice(WORDS)
        else:
            value = rng.choice((-1, 0, 2**31 - 1))
        with contextlib.suppress(pa.ArrowException, TypeError):
            schema = pa.schema([pa.field(f.name, f.type, metadata=f.metadata) for f in table.schema])
            nullable = kind == 2 and rng.random() < 0.5
            field_ = schema.field(at) if nullable else table.schema.field(at)
            table = table.set_column(at, field_, pa.array([value], type_))
    try:
        pq.write_table(table, path, row_group_size=rng.choice((1, 10)))
    except pa.ArrowException:  # a null where the schema allows none
        pq.write_table(table.drop_columns([name]), path)


# --- cases ---------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What became of the cases of one format."""

    read: int = 0
    refused: int = 0
    faults: list[tuple[int, str]] = field(default_factory=list)  # number of the case, what happened
    refusals: list[str] = field(default_factory=list)


class _Bench:
    """One format's folder, and how a case is done to it: in the worker process."""

    def __init__(self, item: Format, folder: Path) -> None:
        self.item, self.folder = item, folder
        self.files = item.make(folder)
        self.kept = {path: path.read_bytes() for path in self.files}
        self.stamp = 0
        item.read(folder)  # the valid file is read, or the rest means nothing

    def harm(self, number: int) -> Path:
        rng = random.Random(f"{self.item.name}/{number}")
        path = rng.choice(self.files)
        if self.item.name == "shard" and rng.random() < 0.4:
            _harm_shard(path, rng)
        elif self.item.name == "noise profile .npz" and rng.random() < 0.6:
            _harm_archive(path, rng)
        else:
            path.write_bytes(mutated(self.kept[path], rng, self.item.kind))
        self._touch(path)
        return path

    def mend(self, path: Path) -> None:
        path.write_bytes(self.kept[path])
        self._touch(path)

    def _touch(self, path: Path) -> None:
        self.stamp += 1  # readers know a changed file by size and time, and two cases come faster than clocks tick
        os.utime(path, ns=(self.stamp * 1_000_000, self.stamp * 1_000_000))


def _case(bench: _Bench, number: int, noise: int) -> tuple[str, str]:
    from augkitti.errors import InputError

    try:
        path = bench.harm(number)
    except BaseException:  # the harm's own fault: no case
        os.dup2(os.open(bench.folder.parent / "start", os.O_WRONLY | os.O_APPEND), 2)
        raise
    started = time.process_time()
    try:
        bench.item.read(bench.folder)
        outcome = "read", ""
    except InputError as err:
        text, cause = str(err), _memory_error(err)
        if len(text.splitlines()) != 1:
            outcome = "fault", f"a message of several lines: {text!r}"[:300]
        elif len(text) > 1000:
            outcome = "fault", f"a message of {len(text)} characters: {text[:200]}"
        elif cause:
            outcome = "fault", f"asked for more than 1 GB: {text}"
        else:
            outcome = "refused", text
    except BaseException as err:
        place = [f for f in traceback.extract_tb(err.__traceback__) if "augkitti" in f.filename]
        where = f"{Path(place[-1].filename).name}:{place[-1].lineno} " if place else ""
        outcome = "fault", f"{where}{type(err).__name__}: {' '.join(str(err).split())[:300]}"
    took = time.process_time() - started
    if outcome[0] != "fault" and took > CPU_S:
        outcome = "fault", f"took {took:.1f} s ({outcome[0]} {outcome[1]})"
    if outcome[0] != "fault" and os.fstat(noise).st_size:
        os.lseek(noise, 0, os.SEEK_SET)
        outcome = "fault", f"wrote to stderr: {os.read(noise, 200)!r}"
    os.ftruncate(noise, 0)
    bench.mend(path)
    return outcome


def _memory_error(err: BaseException | None) -> bool:
    while err is not None:
        if isinstance(err, MemoryError) or "MemoryError" in str(err) or "malloc of size" in str(err):
            return True
        err = err.__cause__ or err.__context__
    return False


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    size = pages * resource.getpagesize() + MEMORY_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (size, resource.RLIM_INFINITY))


def work(folder: Path) -> None:
    """The worker: lines `FORMAT<tab>FIRST<tab>LAST` in, a line of JSON a case out."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    noise = os.open(folder / "stderr", os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_TRUNC)
    os.dup2(noise, 1)
    start = os.dup(2)
    warnings.simplefilter("error")
    benches: dict[str, _Bench] = {}
    for line in sys.stdin:
        name, first, last = line.rstrip("\n").split("\t")
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        if name not in benches:
            os.dup2(start, 2)
            home = folder / f"{os.getpid()}-{len(benches)}"
            home.mkdir()
            benches[name] = _Bench(BY_NAME[name], home)
        gc.collect()  # what the making of the files left behind does not count
        os.dup2(noise, 2)
        _limit_memory()
        for number in range(int(first), int(last)):
            answers.write(json.dumps([number, *_case(benches[name], number, noise)]) + "\n")
            answers.flush()


class Workers:
    """Runs cases in a process of limited memory, which is started anew where a case kills or hangs it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.process = folder, None
        self.buffer = b""

    def run(self, name: str, first: int, last: int) -> Outcome:
        """Cases `first` to `last` - 1 of a format."""
        outcome, number = Outcome(), first
        while number < last:
            self._start()
            self.process.stdin.write(f"{name}\t{number}\t{last}\n".encode())
            self.process.stdin.flush()
            while number < last:
                line = self._line()
                if line is None:
                    outcome.faults.append((number, self._stop()))
                    number += 1
                    break
                at, kind, text = json.loads(line)
                assert at == number
                if kind == "fault":
                    outcome.faults.append((number, text))
                elif kind == "refused":
                    outcome.refused += 1
                    outcome.refusals.append(text)
                else:
                    outcome.read += 1
                number += 1
        return outcome

    def _start(self) -> None:
        if self.process is None:
            here = Path(__file__).resolve()
            paths = [str(here.parent.parent), str(here.parent), os.environ.get("PYTHONPATH", "")]
            one = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
            env = {**os.environ, **one, "PYTHONPATH": os.pathsep.join(paths), "ARROW_NUM_THREADS": "1"}
            command = [sys.executable, str(here), "--worker", str(self.folder)]
            self.errors = (self.folder / "start").open("wb")
            self.process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.errors, env=env
            )

    def _line(self) -> bytes | None:
        while b"\n" not in self.buffer:
            ready, _, _ = select.select([self.process.stdout], [], [], HANG_S)
            piece = os.read(self.process.stdout.fileno(), 65536) if ready else b""
            if not piece:
                return None
            self.buffer += piece
        line, _, self.buffer = self.buffer.partition(b"\n")
        return line

    def _stop(self) -> str:
        try:
            self.process.wait(timeout=5.0)
            hung = False
        except subprocess.TimeoutExpired:
            hung = True
        self.close()
        said = (self.folder / "start").read_text(errors="replace").strip().splitlines()
        return "hung" if hung else f"the process died ({self.code}) {said[-1] if said else ''}".strip()

    def close(self) -> None:
        """Kill the process: it has nothing to lose, and what another test forked may hold its input open."""
        if self.process is not None:
            self.process.kill()
            self.process.stdin.close()
            self.code = self.process.wait()
            self.process.stdout.close()
            self.errors.close()
        self.process, self.buffer = None, b""


# --- the table -----------------------------------------------------------------------------------------------------


def table(outcomes: dict[str, Outcome]) -> str:
    """The table of docs/reliability.md."""
    lines = ["| format | mutations | read | refused | faults |", "|---|---|---|---|---|"]
    for name, one in outcomes.items():
        total = one.read + one.refused + len(one.faults)
        lines.append(f"| {name} | {total:,} | {one.read:,} | {one.refused:,} | {len(one.faults):,} |")
    return "\n".join(lines)


def _run_one(name: str, first: int, last: int) -> Outcome:
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        workers = Workers(Path(folder))
        try:
            return workers.run(name, first, last)
        finally:
            workers.close()


def _show(name: str, number: int) -> None:
    with tempfile.TemporaryDirectory(prefix="fuzz") as folder:
        bench = _Bench(BY_NAME[name], Path(folder))
        path = bench.harm(number)
        print(f"{path.relative_to(folder)}: {path.read_bytes()[:3000]!r}")
        warnings.simplefilter("error")
        bench.item.read(bench.folder)
        print("read")


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=2000, help="mutations a format")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--format", action="append", choices=list(BY_NAME), help="only this one; again for more")
    parser.add_argument("--reasons", action="store_true", help="say why files were refused")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--case", nargs=2, metavar=("FORMAT", "NUMBER"), help="show one case with its traceback")
    options = parser.parse_args()
    if options.worker:
        work(options.worker)
        return 0
    if options.case:
        _show(options.case[0], int(options.case[1]))
        return 0
    from concurrent.futures import ThreadPoolExecutor

    names = options.format or list(BY_NAME)
    with ThreadPoolExecutor(options.jobs) as pool:
        found = pool.map(lambda name: _run_one(name, options.first, options.first + options.cases), names)
        outcomes = {}
        for name, one in zip(names, found, strict=True):
            outcomes[name] = one
            print(f"{name}: {one.read} read, {one.refused} refused, {len(one.faults)} faults", file=sys.stderr)
            if options.reasons:
                reasons = Counter(re.sub(r"[\d.]+|^.*?: ", "#", text)[:90] for text in one.refusals)
                print("".join(f"    {n} x {reason}\n" for reason, n in reasons.most_common()), file=sys.stderr, end="")
            kinds = Counter(re.sub(r"[\d.]+", "#", text)[:110] for _, text in one.faults)
            for kind, count in kinds.most_common():
                number, text = next(f for f in one.faults if re.sub(r"[\d.]+", "#", f[1])[:110] == kind)
                print(f"  {count} x, first {number}: {text}", file=sys.stderr)
    print(table(outcomes))
    return 1 if any(one.faults for one in outcomes.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
