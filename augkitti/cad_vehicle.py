"""One vehicle: the triangles of its files and what is known of it in, a car model and the decisions behind it out."""

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from augkitti import same_math as sm
from augkitti.cad_alignment import Wheel, axles, contact_axles, find_wheels, merge_vertices
from augkitti.cad_arches import find_arches
from augkitti.cad_axes import Cues, find_unit, forward_sign, forward_votes, level_axes
from augkitti.cad_formats import SOLID, RawModel
from augkitti.cad_soup import (
    Soup,
    Vector,
    as_soup,
    bounds,
    cleaned,
    joined,
    kept,
    matches,
    of_materials,
    of_names,
    red_faces,
    shadow_planes,
    turned,
)
from augkitti.cad_surfaces import FRONT_NAME, GLASS_NAME, REAR_NAME, WHEEL_NAME, classify
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import CarModel

BACKWARDS_VOTE = 1.0  # votes against a declared front that are worth a warning
CATEGORY_OF_CLASS = {
    "car": "Car",
    "suv": "Car",
    "pickup": "Car",
    "van": "Van",
    "minivan": "Van",
    "truck": "Truck",
    "bus": "Truck",
}


_Length = Annotated[float, Field(gt=0.0, lt=100.0)]
_Component = Annotated[float, Field(gt=-1e3, lt=1e3)]
_Axis = tuple[_Component, _Component, _Component]


class _Glass(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)
    material: str
    alpha: float | None = Field(None, ge=0.0, le=1.0)


class ModelFacts(BaseModel):
    """One entry of a manifest, or a sidecar: what is known of a model. Missing fields are found by heuristics."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False, populate_by_name=True)
    name: str | None = None
    main_file: str | None = None
    vehicle_class: str | None = Field(None, alias="class")
    body: str | None = None
    length_m: _Length | None = None
    width_m: _Length | None = None
    height_m: _Length | None = None
    up_axis: _Axis | None = None
    forward_axis: _Axis | None = None
    unit_scale: float | None = Field(None, gt=1e-9, lt=1e9)
    glass: tuple[_Glass, ...] | None = None
    other_translucent: tuple[str, ...] = ()
    drop_materials: tuple[str, ...] = ()
    wheel_files: tuple[str, ...] = ()
    wheel_centres_m: tuple[_Axis, ...] = ()


def build_model(
    name: str, path: Path, raw: RawModel, wheel_raws: tuple[RawModel, ...], facts: ModelFacts, facts_source: str
) -> tuple[CarModel, tuple[str, ...]]:
    """A car model and the decisions behind it, from the triangles of its file and its wheels' files.

    Raises:
        InputError: axes, unit, wheels or size cannot be told, or contradict the facts.
    """
    said: list[str] = []
    _check_volume(path, raw)
    R, scale, told = _axes(path, raw, facts, facts_source)
    said += told
    soup = as_soup(raw, R, scale)
    wheels: tuple[Wheel, ...] = ()
    if wheel_raws:
        soup, wheels, told = _with_wheels(path, soup, wheel_raws, facts, R, scale)
        said += told
    soup, told = cleaned(soup, facts.drop_materials)
    said += told
    if not len(soup.faces):
        raise InputError(path, "nothing is left after dropping materials", "check `drop_materials`")
    hint = of_names(soup, WHEEL_NAME)
    low, high = bounds(soup)
    soup = replace(soup, vertices=soup.vertices - (low + high) / 2.0)
    wheels = tuple(
        replace(w, x_m=w.x_m - (low + high)[0] / 2, y_m=w.y_m - (low + high)[1] / 2, z_m=w.z_m - (low + high)[2] / 2)
        for w in wheels
    ) or find_wheels(soup.vertices, soup.faces, hint)
    size = high - low
    _check_size(path, size, facts)
    surface, opacity, told = classify(
        soup, size, wheels, hint, None if facts.glass is None else tuple(g.material for g in facts.glass), facts_source
    )
    said += told
    category, told = _category(path, name, size, facts)
    said += told
    ends = axles(wheels)
    if ends is not None:
        said.append(f"{len(wheels)} wheels found: axles at {ends[0]:.2f} and {ends[1]:.2f} m")
    else:
        ends = contact_axles(soup.vertices, soup.faces)
        if ends is not None:
            said.append(f"axles at {ends[0]:.2f} and {ends[1]:.2f} m, where it touches the ground")
        elif not facts_source:
            raise InputError(path, "no wheels on which it stands", "give wheel_files and wheel_centres_m in a sidecar")
        else:
            ends = (0.3 * float(size[0]), -0.3 * float(size[0]))
            said.append("no axles found: wheelbase taken as 0.6 of the length")
    model = finished_model(
        name,
        category,
        soup.vertices,
        soup.faces,
        surface,
        opacity,
        wheelbase_m=ends[0] - ends[1],
        rear_axle_x_m=ends[1],
    )
    return model, tuple(said)


def _check_volume(path: Path, raw: RawModel) -> None:
    """Refuse what has no width, or is so small, large or far away that lengths cannot be told apart."""
    used = raw.vertices[np.unique(raw.faces)]
    low, high = used.min(axis=0), used.max(axis=0)
    extent = np.sort(high / 2.0 - low / 2.0) * 2.0
    far = float(np.abs(used).max())
    if not (1e-3 < extent[2] < 1e7 and extent[0] > 0.02 * extent[2] and far < 1e4 * extent[2]):
        raise InputError(path, "is flat, or not of a vehicle's size in any unit", "export the whole vehicle")


def finished_model(
    name: str,
    category: str,
    vertices: F64,
    faces: Any,
    surface: Any,
    opacity: Any,
    *,
    wheelbase_m: float,
    rear_axle_x_m: float,
) -> CarModel:
    """A `CarModel` with its vertices merged and centred on its bounding box, and its digest taken."""
    vertices, faces = merge_vertices(np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int32))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    # a nanometre grid hides the last bits, in which processors differ
    model = CarModel(
        name,
        category,
        np.round(vertices - (low + high) / 2.0, 9),
        faces,
        np.asarray(surface, dtype=np.uint8),
        np.asarray(opacity, dtype=np.float32),
        np.round(high - low, 9),
        round(float(wheelbase_m), 9),
        round(float(rear_axle_x_m - (low[0] + high[0]) / 2.0), 9),
        "",
    )
    return replace(model, digest=content_digest(model))


def content_digest(model: CarModel) -> str:
    """sha256 of all that a model holds, its digest left out."""
    digest = hashlib.sha256(f"{model.name}\0{model.category}\0{model.wheelbase_m!r}\0{model.rear_axle_x_m!r}".encode())
    for array in (model.vertices, model.faces, model.surface, model.opacity, model.size_m):
        digest.update(str((array.dtype.str, array.shape)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _axes(path: Path, raw: RawModel, facts: ModelFacts, source: str) -> tuple[F64, float, list[str]]:
    """Rotation (3, 3) from file to car axes, metres per file unit, and what was decided: by the facts, else found."""
    if facts.up_axis is not None and facts.forward_axis is not None:
        R, said = _given_axes(path, facts.up_axis, facts.forward_axis), [f"axes: {source}"]
    else:
        R, said = level_axes(raw.vertices, raw.faces, facts.up_axis or raw.up_axis)
    level = as_soup(raw, R, 1.0)
    level = kept(level, ~(shadow_planes(level) | matches(level, facts.drop_materials)))
    if not len(level.faces):
        raise InputError(path, "is nothing but a flat plane", "export the whole vehicle")
    low, high = bounds(level)
    if facts.unit_scale is not None:
        scale, why = facts.unit_scale, f"unit {facts.unit_scale:g} m: {source}"
    else:
        scale, why = find_unit(high - low, raw.unit_m)
    said.append(why)
    clear = np.asarray(level.opacity < SOLID)
    front, rear = of_names(level, FRONT_NAME), of_names(level, REAR_NAME)
    cues = Cues(
        clear if clear.any() else of_materials(level, GLASS_NAME), red_faces(level), front & ~rear, rear & ~front
    )
    centred = (level.vertices - (low + high) / 2.0) * scale
    wheels = find_wheels(centred, level.faces, of_names(level, WHEEL_NAME))
    votes = forward_votes(centred, level.faces, cues, axles(wheels) or contact_axles(centred, level.faces))
    if facts.forward_axis is None:
        sign, why = forward_sign(path, votes)
        R = sm.product(np.diag([sign, sign, 1.0]), R)
        said.append(why)
    elif sum(v for _, v in votes) < -BACKWARDS_VOTE:
        against = ", ".join(f"{cue} {-value:+.2f}" for cue, value in votes)
        said.append(f"WARNING: its shape says that it faces the other way than declared ({against})")
    return R, scale, said


def _given_axes(path: Path, up_axis: Vector, forward_axis: Vector) -> F64:
    up, forward = np.array(up_axis), np.array(forward_axis)
    forward = forward - up * (forward * up).sum() / max((up * up).sum(), 1e-12)
    lengths = np.sqrt((up * up).sum()), np.sqrt((forward * forward).sum())
    if min(lengths) < 1e-3:
        raise InputError(path, "up_axis and forward_axis are zero or parallel", "mend them")
    up, forward = up / lengths[0], forward / lengths[1]
    return np.stack([forward, np.cross(up, forward), up])


def _with_wheels(
    path: Path, body: Soup, raws: tuple[RawModel, ...], facts: ModelFacts, R: F64, scale: float
) -> tuple[Soup, tuple[Wheel, ...], list[str]]:
    """One copy of the wheel files at each wheel centre, turned round on the right side."""
    parts = [as_soup(raw, R, scale) for raw in raws]
    parts = [replace(p, names=tuple(f"wheel {n}" for n in p.names)) for p in parts]
    wheel = joined(parts)
    low, high = bounds(wheel)
    extent = high - low
    said = []
    if int(np.argmin(extent)) == 0 and abs(extent[1] - extent[2]) < 0.1 * extent[2]:
        x, y, z = wheel.vertices.T  # axle along x in its file: x becomes left
        wheel = replace(wheel, vertices=np.stack([-y, x, z], axis=1))
        said.append("wheel turned by 90 degrees: its axle lay along the car")
        low, high = bounds(wheel)
        extent = high - low
    if facts.wheel_centres_m:
        centres = turned(np.array(facts.wheel_centres_m), R)
        said.append(f"{len(centres)} wheels placed from files")
    else:
        low_body, high_body = bounds(body)
        shift = np.array([0.0, (low_body + high_body)[1] / 2.0, 0.0])
        centres, why = find_arches(body.vertices - shift, body.faces, float(extent[2]) / 2.0, float(extent[1]))
        centres = centres + shift
        said.append("4 wheels from files placed in the body's wheel arches")
    if not len(centres):
        raise InputError(
            path,
            f"its wheels are in separate files and nothing says where they belong ({why})",
            "give wheel_centres_m in a sidecar",
        )
    lateral = centres[:, 1].mean()
    placed, wheels = [], []
    for centre in centres:
        left = centre[1] >= lateral
        turn = np.array([1.0, 1.0, 1.0]) if left else np.array([-1.0, -1.0, 1.0])
        placed.append(replace(wheel, vertices=wheel.vertices * turn + centre))
        middle = (low + high) / 2.0 * turn + centre
        wheels.append(
            Wheel(float(middle[0]), float(middle[1]), float(middle[2]), float(extent[2] / 2.0), float(extent[1]))
        )
    return joined([body, *placed]), tuple(wheels), said


def _check_size(path: Path, size: F64, facts: ModelFacts) -> None:
    length, width, height = (float(s) for s in size)
    plausible = 2.2 <= length <= 14.0 and 1.1 <= width <= 3.4 and 0.9 <= height <= 4.2 and length > width
    if not plausible:
        raise InputError(
            path,
            f"{length:.2f} x {width:.2f} x {height:.2f} m is not the size of a car",
            "give unit_scale, up_axis and forward_axis in a sidecar",
        )
    for said, is_, name in ((facts.length_m, length, "length_m"), (facts.width_m, width, "width_m"),
                            (facts.height_m, height, "height_m")):  # fmt: skip
        if said is not None and abs(is_ / said - 1.0) > 0.03:
            raise InputError(
                path, f"{name} is {is_:.2f}, but {said:.2f} was declared", "mend the axes or the declared size"
            )


def _category(path: Path, name: str, size: F64, facts: ModelFacts) -> tuple[str, list[str]]:
    if facts.vehicle_class is not None:
        category = CATEGORY_OF_CLASS.get(facts.vehicle_class.lower())
        if category is None:
            raise InputError(
                path, f"class {facts.vehicle_class!r} is unknown", f"use one of {', '.join(sorted(CATEGORY_OF_CLASS))}"
            )
        return category, []
    word = f"{name} {path.stem}".lower()
    length, _, height = (float(s) for s in size)
    if re.search(r"truck|lorry|bus(?![a-z])", word) and height > 2.0:
        return "Truck", ["category Truck: name and height"]
    if re.search(r"van(?![a-z])|minibus", word):
        return "Van", ["category Van: name"]
    if length > 6.0 or height > 2.4:
        return "Truck", ["category Truck: size"]
    if height > 2.05:
        return "Van", ["category Van: height"]
    return "Car", ["category Car: size"]
