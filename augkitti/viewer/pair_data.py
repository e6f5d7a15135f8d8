"""What a pair's page needs: a pair, its cars' models and its source's points in, a table and packed columns out.

Coordinates stand on millimetres, reflectance on 1/255. Flow is stored as what it differs from the rigid motion that the
contract states (the object's, else the ego-motion's), so that a page shows the shard's own flow at next to no bytes.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from augkitti.errors import InputError
from augkitti.frames import F32, F64, Array, transform_points
from augkitti.scan_pair import I32, SURFACE_NAMES, AugmentedPair, CarModel, ObjectRecord, Scan
from augkitti.scanner import ScannerProfile
from augkitti.viewer.columns import Integers, encode_columns
from augkitti.viewer.panes import ThroughPanes, through_panes

MOST_TRIANGLES = 40_000  # of a car on a page; a finer model is thinned
_MM = 1e-3
_FARTHEST_M = 2.0e6  # what 32 bits of millimetres hold
_FIRST_GRID_M, _GRID_GROWS = 0.008, 1.4
_FOLLOW_M = 18.0  # a camera at first stands this far from the cars at least


@dataclass(frozen=True, eq=False)
class PairData:
    """A pair as its page holds it."""

    table: dict[str, Any]  # plain JSON values
    packed: bytes  # the columns that `table["columns"]` names


def source_points(scan: Scan, removed: I32) -> F32 | None:
    """Points (R, 3) of a source scan by their rows; None where the scan is not the one that the rows are of."""
    at = np.searchsorted(scan.row, removed)
    if len(removed) and (at.max() >= len(scan.row) or (scan.row[at] != removed).any()):
        return None
    return np.asarray(scan.xyz[at])


def pair_data(
    pair: AugmentedPair,
    profile: ScannerProfile,
    models: Mapping[str, CarModel],
    removed: tuple[F32, F32] | None = None,
    removed_note: str = "",
) -> PairData:
    """Pack a pair.

    Args:
        pair: to show.
        profile: the scanner; its beams' origins are where rays are drawn from.
        models: meshes of virtual cars by name, where at hand.
        removed: points (R0, 3), (R1, 3) of the source that cars hide, where the source is at hand.
        removed_note: why they are not there.

    Raises:
        InputError: the pair holds numbers that no page can show.
    """
    _check(pair)
    columns: dict[str, Integers] = {}
    panes = [through_panes(pair, k, models, profile) for k in (0, 1)]
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        columns[f"xyz{k}"] = _grid(scan.xyz)
        columns[f"reflectance{k}"] = np.rint(np.clip(scan.reflectance, 0.0, 1.0) * 255.0).astype(np.uint8)
        for name in ("ring", "tick", "source", "instance", "surface"):
            columns[f"{name}{k}"] = getattr(scan, name)
        columns |= _pane_columns(k, panes[k])
        if removed is not None:
            columns[f"removed{k}"] = _grid(removed[k])
    columns["flow_rest0"] = _grid(pair.flow0 - rigid_flow(pair))
    columns["status0"] = pair.flow_status0
    used = sorted({item.model for item in pair.objects if item.origin == "virtual" and item.model} & set(models))
    for number, name in enumerate(used):
        vertices, faces, surface = thinned(models[name], MOST_TRIANGLES)
        columns[f"vertices_{number}"] = _grid(vertices)
        columns[f"faces_{number}"] = faces
        columns[f"kinds_{number}"] = surface
    contents, packed = encode_columns(columns)
    table = {
        "id": pair.pair_id,
        "sequence": pair.sequence,
        "recording": pair.recording,
        "frames": [pair.frame0, pair.frame1],
        "interval_s": pair.time1 - pair.time0,
        "kind": pair.scan_kind,
        "ego_motion": _numbers(pair.ego_motion),
        "ego_source": pair.ego_source,
        "coverage": pair.label_coverage,
        "removed": [len(pair.scan0.removed), len(pair.scan1.removed)],
        "removed_note": "" if removed is not None else removed_note,
        "surfaces": list(SURFACE_NAMES),
        "beams": {"side": _numbers(profile.side_m), "height": _numbers(profile.height_m)},
        "objects": [_object(item, used) for item in pair.objects],
        "camera": first_camera(pair),
        "columns": contents,
    }
    return PairData(table, packed)


def _check(pair: AugmentedPair) -> None:
    for name, values in (("xyz0", pair.scan0.xyz), ("xyz1", pair.scan1.xyz), ("flow0", pair.flow0)):
        if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > _FARTHEST_M:
            raise InputError(pair.pair_id, f"{name} holds numbers that are no places", "see `augkitti validate`")
    matrices = [pair.ego_motion]
    for item in pair.objects:
        matrices += [m for m in (item.box0, item.box1, item.pose0, item.pose1, item.motion) if m is not None]
    if not all(np.isfinite(m).all() for m in matrices):
        raise InputError(pair.pair_id, "a pose, box or motion holds numbers that are none", "see `augkitti validate`")


def rigid_flow(pair: AugmentedPair) -> F64:
    """The flow (N0, 3) that the contract states: of the object's motion at status 0, else of the ego-motion."""
    xyz = pair.scan0.xyz.astype(np.float64)
    moved = transform_points(pair.ego_motion, xyz)
    for row, item in enumerate(pair.objects):
        if item.motion is not None:
            mine = np.flatnonzero((pair.scan0.instance == row) & (pair.flow_status0 == 0))
            moved[mine] = transform_points(item.motion, xyz[mine])
    return np.asarray(moved - xyz)


def _pane_columns(k: int, panes: ThroughPanes) -> dict[str, Integers]:
    return {f"through{k}": panes.point, f"through_car{k}": panes.car, f"pane{k}": _grid(panes.pane)}


def _grid(metres: Array) -> Integers:
    return np.rint(np.asarray(metres, dtype=np.float64) / _MM).astype(np.int32)


def _numbers(values: Array | None) -> list[float] | None:
    return None if values is None else [float(value) for value in np.asarray(values).reshape(-1)]


def _object(item: ObjectRecord, meshes: list[str]) -> dict[str, Any]:
    return {
        "id": item.id,
        "category": item.category,
        "origin": item.origin,
        "model": item.model,
        "mesh": meshes.index(item.model) if item.origin == "virtual" and item.model and item.model in meshes else None,
        **{name: _numbers(getattr(item, name)) for name in ("box0", "box1", "pose0", "pose1", "motion")},
        **{name: getattr(item, name) for name in ("points0", "points1", "rays0", "rays1", "speed", "yaw_rate")},
    }


def thinned(model: CarModel, most: int) -> tuple[F64, I32, Integers]:
    """A model's vertices (V, 3), faces (F, 3) and their surfaces (F,), with at most `most` faces.

    Vertices that fall into one cell of a growing grid become one; faces that shrink to a line go.
    """
    vertices, faces, surface = np.asarray(model.vertices), model.faces, model.surface
    step = _FIRST_GRID_M
    while len(faces) > most:
        cell = np.floor(model.vertices / step).astype(np.int64)
        _, first, of_vertex = np.unique(cell, axis=0, return_index=True, return_inverse=True)
        vertices = model.vertices[first]
        faces = of_vertex.reshape(-1)[model.faces].astype(np.int32)
        kept = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
        _, once = np.unique(np.sort(faces[kept], axis=1), axis=0, return_index=True)
        rows = np.flatnonzero(kept)[np.sort(once)]
        faces, surface = faces[rows], model.surface[rows]
        step *= _GRID_GROWS
    return vertices, faces.astype(np.int32), surface


def first_camera(pair: AugmentedPair) -> dict[str, Any]:
    """Where a page looks from at first: over the scanner's shoulder at the virtual cars; velo0, metres, radians."""
    places = [item.box0[:3] for item in pair.objects if item.origin == "virtual" and item.box0 is not None]
    if not places:
        return {"target": [12.0, 0.0, -1.0], "bearing": float(np.pi), "rise": 0.45, "distance": 42.0}
    near = sorted(places, key=lambda place: float(np.hypot(place[0], place[1])))[:2]
    target = np.mean(near, axis=0)
    spread = max(float(np.hypot(*(place[:2] - target[:2]))) for place in near)
    far = float(np.hypot(target[0], target[1]))
    bearing = float(np.arctan2(-target[1], -target[0])) + 0.3  # the scanner, and a little to the side of it
    distance = max(_FOLLOW_M, 2.2 * spread, 0.55 * far)
    return {
        "target": [float(target[0]), float(target[1]), float(target[2])],
        "bearing": bearing,
        "rise": 0.42,
        "distance": distance,
    }
