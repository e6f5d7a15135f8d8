"""The CAD library: a folder of vehicle files in, car models in the car frame and the decisions behind them out.

A `manifest.json` in the folder, or a YAML file beside a model with the same stem and the fields of one manifest entry,
overrides what the heuristics of `cad_alignment.py` find. Finished models are cached by the digest of all their files.
"""

import fnmatch
import hashlib
import json
import os
import re
import tempfile
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from augkitti.cad_alignment import Wheel, axles, contact_axles, face_components, find_wheels, merge_vertices
from augkitti.cad_arches import find_arches
from augkitti.cad_axes import Cues, find_unit, forward_sign, forward_votes, level_axes
from augkitti.cad_formats import MODEL_SUFFIXES, SOLID, RawModel, inside, read_model
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import GLASS, LAMP, OTHER, PAINT, TYRE, U8, Bool, CarModel

LOADER_VERSION = 1  # part of the cache key: raise it when a file would come out differently
Vector = tuple[float, float, float]
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
_WHEEL_NAME = re.compile(r"wheel|whee[kl]|tire|tyre|tier\b|rubber|pneu|reifen|\brim|_rim|roue|rad\b|felge", re.I)
_TYRE_NAME = re.compile(r"tire|tyre|(?<![a-z])tier(?![a-z])|rubber|pneu|reifen", re.I)
_LAMP_NAME = re.compile(
    r"(head|tail|brake|fog|signal|turn).?(light|lamp|lt)|(?<![a-z])(lights?|lamps?|lens|optics?|indicator|phares?|feux?)"
    r"(?![a-z])|reflector|scheinwerfer|leuchte|blinker",
    re.I,
)
_GLASS_NAME = re.compile(r"glass|window(?!.?(trim|frame|seal))|windshield|windscreen|vitre|scheibe|pane(?![a-z])", re.I)
_FRONT_NAME = re.compile(
    r"(?<![a-z])front|head.?(light|lamp|lt)|windshield|windscreen|steer|bonnet|hood|_F[LR]?(?![a-z])"
)
_REAR_NAME = re.compile(r"(?<![a-z])rear|tail|brake.?(light|lamp|lt)|exhaust|trunk|boot(?![a-z])|_[BR][LR](?![a-z])")
_PANE_NAME = re.compile(r"window(?!.?(trim|frame|seal))|windshield|windscreen", re.I)
_OTHER_NAME = re.compile(
    r"interior|interieur|seat|siege|dash|steer|under|dessous|chrome|plastic|void|grill|trim|rim|wheel|chassis|engine|"
    r"exhaust|caliper|disc|floor|carpet|mirror_glass|plate|plaque",
    re.I,
)


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
    length_m: float | None = Field(None, gt=0)
    width_m: float | None = Field(None, gt=0)
    height_m: float | None = Field(None, gt=0)
    up_axis: Vector | None = None
    forward_axis: Vector | None = None
    unit_scale: float | None = Field(None, gt=0)
    glass: tuple[_Glass, ...] | None = None
    other_translucent: tuple[str, ...] = ()
    drop_materials: tuple[str, ...] = ()
    wheel_files: tuple[str, ...] = ()
    wheel_centres_m: tuple[Vector, ...] = ()


@dataclass(frozen=True)
class CadDecision:
    """A row of `augkitti cad check`: what became of one model, and why."""

    name: str
    file: str  # relative to the library's folder
    category: str
    size_m: Vector | None  # length, width, height
    triangles: int
    glass_share: float  # of the surface's area
    decisions: tuple[str, ...]
    problem: str | None  # why it was left out; None for a usable model


@dataclass(frozen=True)
class CadLibrary:
    """The usable models of a folder, sorted by name, and what was decided about every file."""

    models: tuple[CarModel, ...]
    report: tuple[CadDecision, ...]


@dataclass(frozen=True)
class _Candidate:
    name: str
    main: Path
    root: Path  # every file of the model lies in here
    facts: ModelFacts
    facts_source: str  # "manifest", "sidecar x.yaml" or "" for none
    wheel_files: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class _Soup:
    """All triangles of a vehicle in car axes, wheels in place, not yet centred."""

    vertices: F64
    faces: Any  # (F, 3) int32
    material: Any  # (F,) int32 into names
    opacity: Any  # (F,) float32
    names: tuple[str, ...]  # material name
    nodes: tuple[str, ...]
    colours: tuple[Vector | None, ...]
    sources: tuple[str, ...]


def load_cad_folder(
    folder: Path, categories: tuple[str, ...] | None = None, cache_dir: Path | None = None
) -> CadLibrary:
    """Load every vehicle of a folder; a bad one among good ones is left out and listed with the reason.

    Each subfolder is one vehicle or several files; loose files are vehicles of their own.

    Args:
        folder: where the models are, with or without `manifest.json`.
        categories: KITTI categories to keep (`Car`, `Van`, `Truck`); None for all.
        cache_dir: where finished models are kept between runs; None for no cache.

    Raises:
        InputError: no such folder, a damaged manifest, or not one usable model.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "name a folder of car models, or leave --cad out")
    models: list[CarModel] = []
    report: list[CadDecision] = []
    for candidate in _candidates(folder):
        if isinstance(candidate, CadDecision):
            report.append(candidate)
            continue
        relative = candidate.main.relative_to(folder.resolve()).as_posix()
        try:
            model, decisions = _load_cached(candidate, cache_dir)
        except InputError as err:
            why = f"{err.problem}; {err.remedy}"
            report.append(CadDecision(candidate.name, relative, "", None, 0, 0.0, (), " ".join(why.split())))
            continue
        problem = None
        if categories is not None and model.category not in categories:
            problem = f"category {model.category} is not asked for"
        else:
            models.append(model)
        report.append(_decision_of(model, relative, decisions, problem))
    if not models:
        asked = "" if categories is None else f" of category {' or '.join(categories)}"
        reasons = (
            "; ".join(f"{r.name}: {r.problem}" for r in report[:3]) or f"no file ends in {', '.join(MODEL_SUFFIXES)}"
        )
        raise InputError(folder, f"no usable car model{asked} ({reasons})", "see `augkitti cad check` for every file")
    return CadLibrary(
        tuple(sorted(models, key=lambda m: m.name)), tuple(sorted(report, key=lambda r: (r.name, r.file)))
    )


def _decision_of(model: CarModel, file: str, decisions: tuple[str, ...], problem: str | None) -> CadDecision:
    area = face_areas(model.vertices, model.faces)
    share = float(area[model.surface == GLASS].sum() / area.sum())
    length, width, height = (float(s) for s in model.size_m)
    return CadDecision(
        model.name, file, model.category, (length, width, height), len(model.faces), share, decisions, problem
    )


def face_areas(vertices: F64, faces: Any) -> F64:
    """Area (F,) of triangles, square metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(np.sqrt((normal * normal).sum(axis=1)) / 2.0)


# --- which files are vehicles ---


def _candidates(folder: Path) -> list["_Candidate | CadDecision"]:
    root = folder.resolve()
    found: list[_Candidate | CadDecision] = []
    covered: set[Path] = set()
    for facts in _read_manifest(root / "manifest.json"):
        name = facts.name or ""
        try:
            found.append(_from_manifest(root, name, facts))
            covered.update(_covered(root, found[-1]))
        except InputError as err:
            found.append(CadDecision(name, facts.main_file or "", "", None, 0, 0.0, (), f"{err.problem}; {err.remedy}"))
    names = {c.name for c in found}
    groups: dict[Path, list[Path]] = {}
    for path in sorted(root.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if path.suffix.lower() not in MODEL_SUFFIXES or hidden or not path.is_file():
            continue
        if path.resolve() in covered or any(parent in covered for parent in path.resolve().parents):
            continue
        parts = path.relative_to(root).parts
        groups.setdefault(root / parts[0] if len(parts) > 1 else root, []).append(path)
    for group, paths in sorted(groups.items()):
        bodies = [p for p in paths if not _is_wheel_file(p)] or paths
        wheels = tuple(p for p in paths if p not in bodies)
        for path in bodies:
            name = group.name if len(bodies) == 1 and group != root else path.stem
            while name in names:
                name += "_2"
            names.add(name)
            found.append(_from_file(root, group, name, path, wheels, len(bodies)))
    return found


def _is_wheel_file(path: Path) -> bool:
    """By name; `car_no_wheels` is a body."""
    without = re.search(r"(no|without|ohne|sans).?(wheel|tire|tyre)", path.stem, re.I)
    return bool(_WHEEL_NAME.search(path.stem)) and not without


def _covered(root: Path, candidate: "_Candidate | CadDecision") -> list[Path]:
    if isinstance(candidate, CadDecision):
        return []
    return [candidate.main, *candidate.wheel_files] if candidate.root == root else [candidate.root]


def _read_manifest(path: Path) -> list[ModelFacts]:
    if not path.is_file():
        return []
    remedy = "mend it, or take it away and let the loader find axes and windows"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        entries = document["models"]
        facts = [ModelFacts.model_validate(e) for e in entries]
    except ValidationError as err:
        first = err.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise InputError(path, f"key `{key}`: {first['msg']}", remedy) from err
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as err:
        raise InputError(path, f"not a manifest ({type(err).__name__}: {err})", remedy) from err
    for entry in facts:
        if not entry.name or not entry.main_file:
            raise InputError(path, "an entry without `name` or `main_file`", remedy)
    return facts


def _from_manifest(root: Path, name: str, facts: ModelFacts) -> _Candidate:
    manifest = root / "manifest.json"
    home = inside(root, name, manifest)
    home = home if home.is_dir() else root
    main = inside(home, facts.main_file or "", manifest)
    if not main.is_file():
        raise InputError(main, "the manifest names it, but it is not there", "add the file or take the entry out")
    wheels = tuple(inside(home, w, manifest) for w in facts.wheel_files)
    return _Candidate(name, main, home, facts, "manifest", wheels)


def _from_file(
    root: Path, group: Path, name: str, path: Path, wheels: tuple[Path, ...], bodies: int
) -> "_Candidate | CadDecision":
    relative = path.relative_to(root).as_posix()
    try:
        if not str(path.resolve()).startswith(str(root) + os.sep):
            raise InputError(path, "links to a place outside of the folder", "copy the file in")
        facts, source = _read_sidecar(path)
        named = tuple(inside(path.parent, w, path) for w in facts.wheel_files)
    except InputError as err:
        return CadDecision(name, relative, "", None, 0, 0.0, (), f"{err.where}: {err.problem}; {err.remedy}")
    # with several bodies in one folder nothing tells whose the wheels are
    return _Candidate(
        facts.name or name, path.resolve(), group, facts, source, named or (wheels if bodies == 1 else ())
    )


def _read_sidecar(model: Path) -> tuple[ModelFacts, str]:
    for suffix in (".yaml", ".yml"):
        path = model.with_suffix(suffix)
        if not path.is_file():
            continue
        remedy = "give it the fields of one manifest entry"
        try:
            return ModelFacts.model_validate(
                yaml.safe_load(path.read_text(encoding="utf-8")) or {}
            ), f"sidecar {path.name}"
        except ValidationError as err:
            first = err.errors()[0]
            key = ".".join(str(part) for part in first["loc"])
            raise InputError(path.name, f"key `{key}`: {first['msg']}", remedy) from err
        except (OSError, UnicodeDecodeError, yaml.YAMLError, RecursionError) as err:
            raise InputError(path.name, f"not readable as YAML ({err})", remedy) from err
    return ModelFacts.model_validate({}), ""


# --- one vehicle ---


def _load_one(candidate: _Candidate) -> tuple[CarModel, tuple[str, ...]]:
    raw = read_model(candidate.main, candidate.root)
    wheels = tuple(read_model(w, candidate.root) for w in candidate.wheel_files)
    notes = list(raw.warnings)
    if len(notes) > 1:
        notes = [f"{notes[0]} and {len(notes) - 1} more warnings"]
    model, decisions = build_model(candidate.name, candidate.main, raw, wheels, candidate.facts, candidate.facts_source)
    return model, (*decisions, *notes)


def build_model(
    name: str, path: Path, raw: RawModel, wheel_raws: tuple[RawModel, ...], facts: ModelFacts, facts_source: str
) -> tuple[CarModel, tuple[str, ...]]:
    """A car model and the decisions behind it, from the triangles of its file and its wheels' files.

    Raises:
        InputError: axes, unit, wheels or size cannot be told, or contradict the facts.
    """
    said: list[str] = []
    R, scale, told = _axes(path, raw, facts, facts_source)
    said += told
    soup = _as_soup(raw, R, scale)
    wheels: tuple[Wheel, ...] = ()
    if wheel_raws:
        soup, wheels, told = _with_wheels(path, soup, wheel_raws, facts, R, scale)
        said += told
    soup, told = _cleaned(soup, facts)
    said += told
    if not len(soup.faces):
        raise InputError(path, "nothing is left after dropping materials", "check `drop_materials`")
    hint = _of_names(soup, _WHEEL_NAME)
    low, high = _bounds(soup)
    soup = replace(soup, vertices=soup.vertices - (low + high) / 2.0)
    wheels = tuple(
        replace(w, x_m=w.x_m - (low + high)[0] / 2, y_m=w.y_m - (low + high)[1] / 2, z_m=w.z_m - (low + high)[2] / 2)
        for w in wheels
    ) or find_wheels(soup.vertices, soup.faces, hint)
    size = high - low
    _check_size(path, size, facts)
    surface, opacity, told = classify(soup, size, wheels, hint, facts, facts_source)
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
    vertices = np.round(vertices - (low + high) / 2.0, 9)
    model = CarModel(
        name,
        category,
        vertices,
        faces,
        np.asarray(surface, dtype=np.uint8),
        np.asarray(opacity, dtype=np.float32),
        np.asarray(high - low),
        float(wheelbase_m),
        float(rear_axle_x_m - (low[0] + high[0]) / 2.0),
        "",
    )
    return replace(model, digest=_content_digest(model))


def _content_digest(model: CarModel) -> str:
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
    level = _as_soup(raw, R, 1.0)
    level = _kept(level, ~(_shadow_planes(level) | _matches(level, facts.drop_materials)))
    if not len(level.faces):
        raise InputError(path, "is nothing but a flat plane", "export the whole vehicle")
    low, high = _bounds(level)
    if facts.unit_scale is not None:
        scale, why = facts.unit_scale, f"unit {facts.unit_scale:g} m: {source}"
    else:
        scale, why = find_unit(high - low, raw.unit_m)
    said.append(why)
    clear = np.asarray(level.opacity < SOLID)
    front, rear = _of_names(level, _FRONT_NAME), _of_names(level, _REAR_NAME)
    cues = Cues(clear if clear.any() else _of_materials(level, _GLASS_NAME), _red(level), front & ~rear, rear & ~front)
    centred = (level.vertices - (low + high) / 2.0) * scale
    wheels = find_wheels(centred, level.faces, _of_names(level, _WHEEL_NAME))
    votes = forward_votes(centred, level.faces, cues, axles(wheels) or contact_axles(centred, level.faces))
    if facts.forward_axis is None:
        sign, why = forward_sign(path, votes)
        R = np.diag([sign, sign, 1.0]) @ R
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


def _turned(vertices: F64, R: F64) -> F64:
    x, y, z = vertices[:, 0], vertices[:, 1], vertices[:, 2]
    return np.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=1)


def _as_soup(raw: RawModel, R: F64, scale: float) -> _Soup:
    return _Soup(
        _turned(raw.vertices, R) * scale,
        raw.faces,
        raw.material,
        raw.opacity,
        tuple(m.name for m in raw.materials),
        tuple(m.node for m in raw.materials),
        tuple(m.colour for m in raw.materials),
        tuple(m.opacity_source for m in raw.materials),
    )


def _joined(soups: list[_Soup]) -> _Soup:
    vertex_offset = np.cumsum([0] + [len(s.vertices) for s in soups])
    name_offset = np.cumsum([0] + [len(s.names) for s in soups])
    return _Soup(
        np.concatenate([s.vertices for s in soups]),
        np.concatenate([s.faces + o for s, o in zip(soups, vertex_offset, strict=False)]).astype(np.int32),
        np.concatenate([s.material + o for s, o in zip(soups, name_offset, strict=False)]).astype(np.int32),
        np.concatenate([s.opacity for s in soups]),
        sum((s.names for s in soups), ()),
        sum((s.nodes for s in soups), ()),
        sum((s.colours for s in soups), ()),
        sum((s.sources for s in soups), ()),
    )


def _bounds(soup: _Soup) -> tuple[F64, F64]:
    corners = soup.vertices[np.unique(soup.faces)]
    return corners.min(axis=0), corners.max(axis=0)


def _with_wheels(
    path: Path, body: _Soup, raws: tuple[RawModel, ...], facts: ModelFacts, R: F64, scale: float
) -> tuple[_Soup, tuple[Wheel, ...], list[str]]:
    """One copy of the wheel files at each wheel centre, turned round on the right side."""
    parts = [_as_soup(raw, R, scale) for raw in raws]
    parts = [replace(p, names=tuple(f"wheel {n}" for n in p.names)) for p in parts]
    wheel = _joined(parts)
    low, high = _bounds(wheel)
    extent = high - low
    said = []
    if int(np.argmin(extent)) == 0 and abs(extent[1] - extent[2]) < 0.1 * extent[2]:
        x, y, z = wheel.vertices.T  # axle along x in its file: x becomes left
        wheel = replace(wheel, vertices=np.stack([-y, x, z], axis=1))
        said.append("wheel turned by 90 degrees: its axle lay along the car")
        low, high = _bounds(wheel)
        extent = high - low
    if facts.wheel_centres_m:
        centres = _turned(np.array(facts.wheel_centres_m), R)
        said.append(f"{len(centres)} wheels placed from files")
    else:
        low_body, high_body = _bounds(body)
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
    return _joined([body, *placed]), tuple(wheels), said


def _cleaned(soup: _Soup, facts: ModelFacts) -> tuple[_Soup, list[str]]:
    """Without dropped materials, shadow planes, faces without area, and twins of a face."""
    said = []
    keep = np.ones(len(soup.faces), dtype=bool)
    dropped = _matches(soup, facts.drop_materials)
    if dropped.any():
        said.append(f"{int(dropped.sum())} faces of dropped materials left out")
    if not facts.drop_materials:
        shadow = _shadow_planes(soup)
        if shadow.any():
            said.append(f"{int(shadow.sum())} faces of a shadow plane left out")
        dropped |= shadow
    keep &= ~dropped
    soup = _kept(soup, keep)
    if not len(soup.faces):
        return soup, said
    vertices, faces = merge_vertices(soup.vertices, soup.faces)
    soup = replace(soup, vertices=vertices, faces=faces)
    area = face_areas(vertices, faces)
    flat = area < 1e-9
    order = np.sort(faces, axis=1)
    # of twins the most solid one stays: paint under a decal, not the other way round
    rank = np.lexsort((np.arange(len(faces)), -soup.opacity.astype(np.float64)))
    _, first = np.unique(order[rank], axis=0, return_index=True)
    unique = np.zeros(len(faces), dtype=bool)
    unique[rank[first]] = True
    if flat.any():
        said.append(f"{int(flat.sum())} faces without area left out")
    twins = ~unique & ~flat
    if twins.any():
        said.append(f"{int(twins.sum())} duplicate faces left out")
    soup = _kept(soup, unique & ~flat)
    return soup, said


def _kept(soup: _Soup, keep: Bool) -> _Soup:
    return replace(soup, faces=soup.faces[keep], material=soup.material[keep], opacity=soup.opacity[keep])


def _shadow_planes(soup: _Soup) -> Bool:
    """Faces (F,) of materials that lie flat (within 2 cm) at the bottom and are translucent or named so."""
    found = np.zeros(len(soup.faces), dtype=bool)
    low, high = _bounds(soup)
    for i in range(len(soup.names)):
        mine = soup.material == i
        if not mine.any():
            continue
        corners = soup.vertices[soup.faces[mine]].reshape(-1, 3)
        flat = np.ptp(corners[:, 2]) < 0.02 * (high - low)[2] and corners[:, 2].max() < low[2] + 0.1 * (high - low)[2]
        named = re.search(r"shadow|schatten|ombre|ground", f"{soup.names[i]} {soup.nodes[i]}", re.I)
        if flat and (named or (soup.opacity[mine] < SOLID).mean() > 0.3):
            found |= mine
    return found


def _name_parts(pattern: str) -> list[str]:
    """The material names of a manifest field: `a, b` is two, a remark in brackets at the end is none."""
    return [re.sub(r"\s*\([^()]*\)\s*$", "", part).strip() for part in pattern.split(", ")] + [pattern]


def _matches(soup: _Soup, patterns: tuple[str, ...]) -> Bool:
    """Faces (F,) whose material's name is one of the patterns (`*` stands for anything)."""
    wanted = [part for pattern in patterns for part in _name_parts(pattern) if part]
    hits = [any(name == w or fnmatch.fnmatchcase(name, w) for w in wanted) for name in soup.names]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


def _of_names(soup: _Soup, pattern: re.Pattern[str]) -> Bool:
    """Faces (F,) whose material or node has a name that fits."""
    hits = [bool(pattern.search(n) or pattern.search(m)) for n, m in zip(soup.names, soup.nodes, strict=True)]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


def _of_materials(soup: _Soup, pattern: re.Pattern[str]) -> Bool:
    """Faces (F,) whose material has a name that fits, or, for a nameless one, whose node has."""
    hits = [bool(pattern.search(n or m)) for n, m in zip(soup.names, soup.nodes, strict=True)]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


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


def classify(
    soup: _Soup, size: F64, wheels: tuple[Wheel, ...], hint: Bool, facts: ModelFacts, source: str
) -> tuple[U8, Any, list[str]]:
    """Surface class (F,) and opacity (F,) of each face of a centred soup, and what decided on the windows."""
    middle = soup.vertices[soup.faces].mean(axis=1)
    clear = np.asarray(soup.opacity < SOLID)
    on_wheel, tread = _wheel_faces(middle, wheels, hint)
    if facts.glass is not None:
        glass, said = _declared_glass(soup, clear & ~on_wheel, facts, source)
    else:
        glass, said = _found_glass(soup, middle, clear & ~on_wheel, size, on_wheel)
    surface = np.full(len(soup.faces), PAINT, dtype=np.uint8)
    surface[_of_names(soup, _OTHER_NAME)] = OTHER
    surface[_of_names(soup, _LAMP_NAME)] = LAMP
    surface[clear] = LAMP
    surface[on_wheel] = OTHER
    surface[glass] = GLASS
    named_tyre = _of_names(soup, _TYRE_NAME)
    surface[(named_tyre & (on_wheel | hint)) if named_tyre.any() else tread] = TYRE
    opacity = np.where((surface == GLASS) | (surface == LAMP), soup.opacity, np.float32(1.0)).astype(np.float32)
    return surface, opacity, said


def _wheel_faces(middle: F64, wheels: tuple[Wheel, ...], hint: Bool) -> tuple[Bool, Bool]:
    """Faces (F,) within a wheel's cylinder, and those on its outer third: the tyre."""
    on_wheel = np.zeros(len(middle), dtype=bool)
    tread = np.zeros(len(middle), dtype=bool)
    for w in wheels:
        radius = np.sqrt((middle[:, 0] - w.x_m) ** 2 + (middle[:, 2] - w.z_m) ** 2) / w.radius_m
        beside = np.abs(middle[:, 1] - w.y_m) <= w.width_m / 2.0 + 0.01
        mine = (radius <= 1.02) & beside
        if (mine & hint).any():
            mine &= hint
        on_wheel |= mine
        tread |= mine & (radius > 0.64)
    return on_wheel | (hint & (middle[:, 2] < 0.0) & bool(wheels)), tread


def _declared_glass(soup: _Soup, clear: Bool, facts: ModelFacts, source: str) -> tuple[Bool, list[str]]:
    glass = np.zeros(len(soup.faces), dtype=bool)
    for entry in facts.glass or ():
        named = _matches(soup, (entry.material,))
        if not named.any():
            raise InputError(source, f"no material is named {entry.material!r}", "mend field `glass`")
        # an image tells the panes of a shared material; without one the whole material is glass
        by_image = np.array([("map_d" in s) or ("Texture" in s) for s in soup.sources])[soup.material]
        glass |= named & clear if (named & by_image).any() else named
    return glass, [f"glass: {source}" if facts.glass else f"no glass: {source}"]


def _found_glass(soup: _Soup, middle: F64, clear: Bool, size: F64, wheels: Bool) -> tuple[Bool, list[str]]:
    """Windows without a manifest: translucent faces at cabin height that are not lamps; by name where none is declared.

    A material is judged as a whole; one whose opacity is an image's holds panes and lamps alike and is judged piece by
    piece. Cabin height is the upper half, where head lamps and most tail lamps do not reach.
    """
    area = face_areas(soup.vertices, soup.faces)
    high = middle[:, 2] > 0.0
    lamp = _of_names(soup, _LAMP_NAME) & ~_of_names(soup, _PANE_NAME)
    group = soup.material.astype(np.int64)
    shared = (
        np.array(["map_d" in s or "Texture" in s or "face alpha" in s for s in soup.sources])[soup.material] & clear
    )
    if shared.any():
        welded, faces = merge_vertices(soup.vertices, soup.faces[shared], 1e-4)
        group[shared] = len(soup.names) + face_components(len(welded), faces)
    # one material on many nodes is one material
    first = {n: i for i, n in reversed(list(enumerate(soup.names)))}
    one = np.array([first[n] if n else i for i, n in enumerate(soup.names)])
    group = np.where(shared, group, one[soup.material])
    glass = _mostly_high(group, clear & ~lamp & ~_red(soup), high, area)
    if glass.any():
        return glass, ["glass: " + ", ".join(sorted({soup.sources[m] for m in np.unique(soup.material[glass])}))]
    named = _of_materials(soup, _GLASS_NAME) & ~lamp & ~wheels
    glass = _mostly_high(group, named, high, area)
    if glass.any():
        return glass, ["glass: by name only, nothing is declared translucent"]
    return glass, ["no glass: nothing is declared translucent or named so"]


def _mostly_high(group: Any, chosen: Bool, high: Bool, area: F64) -> Bool:
    """Those chosen faces (F,) whose group has at least half of its chosen area at cabin height."""
    count = int(group.max()) + 1
    whole = np.bincount(group, area * chosen, count)
    above = np.bincount(group, area * (chosen & high), count)
    return np.asarray(chosen & (above >= 0.5 * whole)[group])


def _red(soup: _Soup) -> Bool:
    """Faces (F,) of red or orange materials: lamp glass is coloured, panes are not."""
    hits = [c is not None and c[0] > 0.25 and c[0] > 2.0 * max(c[1], c[2]) for c in soup.colours]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


# --- cache ---


def _load_cached(candidate: _Candidate, cache_dir: Path | None) -> tuple[CarModel, tuple[str, ...]]:
    if cache_dir is None:
        return _load_one(candidate)
    path = Path(cache_dir) / f"car-{_files_digest(candidate)}.npz"
    kept = _read_cache(path)
    if kept is not None:
        return kept
    model, decisions = _load_one(candidate)
    _write_cache(path, model, decisions)
    return model, decisions


def _files_digest(candidate: _Candidate) -> str:
    """sha256 over every file that may count for a model, its facts, and the version of this loader."""
    import trimesh

    digest = hashlib.sha256(f"{LOADER_VERSION}\0{trimesh.__version__}\0{candidate.name}\0".encode())
    digest.update(candidate.facts.model_dump_json().encode())
    digest.update(candidate.facts_source.encode())
    own = {candidate.main, *candidate.wheel_files}
    for path in sorted(candidate.root.rglob("*")):
        if not path.is_file() or (path.suffix.lower() in MODEL_SUFFIXES and path.resolve() not in own):
            continue
        if path.name == "manifest.json":
            continue  # its entry is in the facts
        content = path.read_bytes()
        digest.update(f"{path.relative_to(candidate.root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    digest.update(candidate.main.relative_to(candidate.root).as_posix().encode())
    return digest.hexdigest()


def _read_cache(path: Path) -> tuple[CarModel, tuple[str, ...]] | None:
    """A finished model; None where there is none or the file is damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as kept:
            text = json.loads(str(kept["text"]))
            model = CarModel(
                text["name"],
                text["category"],
                kept["vertices"],
                kept["faces"],
                kept["surface"],
                kept["opacity"],
                kept["size_m"],
                text["wheelbase_m"],
                text["rear_axle_x_m"],
                text["digest"],
            )
        decisions = tuple(str(d) for d in text["decisions"])
        return (model, decisions) if _content_digest(model) == model.digest else None
    except (OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile):
        return None


def _write_cache(path: Path, model: CarModel, decisions: tuple[str, ...]) -> None:
    text = {
        "name": model.name,
        "category": model.category,
        "wheelbase_m": model.wheelbase_m,
        "rear_axle_x_m": model.rear_axle_x_m,
        "digest": model.digest,
        "decisions": list(decisions),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(
                    file,
                    text=np.array(json.dumps(text)),
                    vertices=model.vertices,
                    faces=model.faces,
                    surface=model.surface,
                    opacity=model.opacity,
                    size_m=model.size_m,
                )
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as err:
        raise InputError(path.parent, f"not writable ({err.strerror})", "name another cache folder") from err
