"""Vehicle files (GLB, glTF, OBJ, DAE, PLY, OFF): a path in, triangles with materials and opacity out.

Where an image carries the opacity (`map_d` of MTL, the alpha of glTF's `baseColorTexture`), a face is sampled at seven
places; a face that a window's edge runs through is cut in four, again and again, until its pieces are about 4 cm on a
car, and each piece takes the opacity at its centroid.
"""

import io
import json
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from augkitti.errors import InputError
from augkitti.frames import F32, F64
from augkitti.scan_pair import I32, Bool

MODEL_SUFFIXES = (".glb", ".gltf", ".obj", ".dae", ".ply", ".off")
SOLID = 0.95  # an opacity from here on is solid: JPEG noise in opacity images stays above it
_MAX_BYTES = 512 * 1024 * 1024
_MAX_FACES = 5_000_000
_MAX_PIXELS = 8192 * 8192
_MAX_PLACES = 20_000  # nodes of a COLLADA scene, those that instances repeat counted each time
_EDGE_PER_DIAGONAL = 1 / 130  # 4 cm of a car's 5.2 m
_MAX_CUTS = 7


@dataclass(frozen=True)
class Material:
    """What a file says of a material, as far as a lidar cares."""

    name: str
    node: str  # name of the node or geometry that carries it
    colour: tuple[float, float, float] | None  # red, green, blue, 0 to 1; None where an image has it
    opacity_source: str  # which element of the file gave the opacity; "" for none


@dataclass(frozen=True, eq=False)
class RawModel:
    """A file's triangles in its own axes and units, node transforms applied."""

    vertices: F64  # (V, 3) file coordinates
    faces: I32  # (F, 3)
    material: I32  # (F,) index into materials
    opacity: F32  # (F,) 1 solid
    materials: tuple[Material, ...]
    up_axis: tuple[float, float, float] | None  # where the format or the file declares it
    unit_m: float | None  # metres per file unit, where declared
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Part:
    vertices: F64
    faces: I32
    opacity: F32
    material: Material


def inside(folder: Path, relative: str, owner: Path, start: Path | None = None) -> Path:
    """The path of a file named by `owner`, which must lie in `folder` (links followed).

    Args:
        folder: that it may not leave.
        relative: the name as it stands in the file, percent-encoded or not.
        owner: the file, for errors.
        start: where names begin, in `folder`; by default `folder`.

    Raises:
        InputError: absolute, a URL, or outside of the folder.
    """
    name = unquote(relative).replace("\\", "/")
    remedy = "keep the files of a model in its own folder and name them relative to it"
    if "\0" in name or "://" in name or PurePosixPath(name).is_absolute() or (len(name) > 1 and name[1] == ":"):
        raise InputError(owner, f"points outside of its folder ({relative!r})", remedy)
    try:
        path = ((start or folder) / name).resolve()
        root = folder.resolve()
        path.exists()  # a name too long is told here
    except (OSError, RuntimeError, ValueError) as err:
        raise InputError(owner, f"names a path that does not resolve ({relative!r})", remedy) from err
    if path != root and root not in path.parents:
        raise InputError(owner, f"points outside of its folder ({relative!r})", remedy)
    return path


class _FolderResolver:
    """What trimesh asks for the files that a model names; answers for one folder only."""

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self.root = path, root

    def get(self, name: str) -> bytes:
        # `..` inside the model's folder is fine (Gazebo's meshes/ beside materials/); outside of it is not
        target = inside(self.root, name.strip(), self.path, self.path.parent)
        if not target.is_file():
            raise FileNotFoundError(name)
        if target.stat().st_size > _MAX_BYTES:
            raise InputError(target, "larger than 512 MiB", "simplify the model")
        content = target.read_bytes()
        return _as_utf8(content) if target.suffix.lower() == ".mtl" else content

    def __getitem__(self, name: str) -> bytes:
        return self.get(name)

    def namespaced(self, namespace: str) -> "_FolderResolver":
        return _FolderResolver(self.path.parent / namespace / "x", self.root)

    def keys(self) -> list[str]:
        return sorted(p.name for p in self.path.parent.iterdir() if p.is_file())


def read_model(path: Path, root: Path | None = None) -> RawModel:
    """Read one vehicle file.

    Args:
        path: the file; its suffix tells the format.
        root: the folder that every file it names must lie in; the file's own folder by default.

    Raises:
        InputError: missing, empty, cut short, not of its format, without triangles, or pointing outside of `root`.
    """
    root = root or path.parent
    suffix = path.suffix.lower()
    if suffix not in MODEL_SUFFIXES:
        raise InputError(path, "not a vehicle format", f"use one of {', '.join(MODEL_SUFFIXES)}")
    if not path.is_file():
        raise InputError(path, "no such file", "check the name")
    if path.stat().st_size > _MAX_BYTES:
        raise InputError(path, "larger than 512 MiB", "simplify the model")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # readers warn of dangling images, which a lidar does not need
            data = path.read_bytes()
            resolver = _FolderResolver(path, root)
            if suffix == ".dae":
                parts, up, unit, notes = _read_dae(path, data, resolver)
            elif suffix in (".glb", ".gltf"):
                parts, notes = _read_gltf(path, data, resolver)
                up, unit = (0.0, 1.0, 0.0), 1.0  # the glTF specification: y up, metres
            elif suffix == ".obj":
                parts, notes = _read_obj(path, data, resolver)
                up, unit = None, None
            else:
                parts, notes = _read_plain(path, data, resolver), []
                up, unit = None, None
            return _join(path, parts, up, unit, notes)
    except InputError:
        raise
    except RecursionError as err:
        raise InputError(path, "its nodes are nested without end", "export it again") from err
    except Exception as err:  # the readers raise all sorts on damaged files: KeyError, struct.error, XML errors, ...
        reason = " ".join(f"{type(err).__name__}: {err}".split())[:160]
        raise InputError(path, f"not readable as {suffix[1:].upper()} ({reason})", "export it again") from err


def _join(
    path: Path, parts: list[_Part], up: tuple[float, float, float] | None, unit: float | None, notes: list[str]
) -> RawModel:
    parts = [p for p in parts if len(p.faces)]
    if not parts:
        raise InputError(path, "holds no triangles", "export the mesh, not only curves or points")
    if sum(len(p.faces) for p in parts) > _MAX_FACES:
        raise InputError(path, f"holds more than {_MAX_FACES} triangles", "simplify the model")
    offsets = np.cumsum([0] + [len(p.vertices) for p in parts])
    for p in parts:
        if p.faces.min() < 0 or p.faces.max() >= len(p.vertices):
            raise InputError(path, "a face names a vertex that is not there", "export it again")
    vertices = np.concatenate([p.vertices for p in parts])
    faces = np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=False)]).astype(np.int32)
    material = np.concatenate([np.full(len(p.faces), i, np.int32) for i, p in enumerate(parts)])
    opacity = np.concatenate([p.opacity for p in parts]).astype(np.float32)
    if not np.isfinite(opacity).all():
        notes = [*notes, "an opacity that is no number is taken as solid"]
    opacity = np.clip(np.where(np.isfinite(opacity), opacity, np.float32(1.0)), np.float32(0.0), np.float32(1.0))
    finite = np.isfinite(vertices).all(axis=1)[faces].all(axis=1)
    if not finite.all():
        notes = [*notes, f"{int((~finite).sum())} faces with NaN left out"]
        faces, material, opacity = faces[finite], material[finite], opacity[finite]
    if not len(faces):
        raise InputError(path, "holds no finite triangles", "export it again")
    if up is not None and unit is not None and not (np.isfinite(unit) and unit > 0):
        raise InputError(path, f"declares a unit of {unit} m", "mend the unit element")
    return RawModel(
        np.where(np.isfinite(vertices), vertices, 0.0),
        faces,
        material,
        opacity,
        tuple(p.material for p in parts),
        up,
        unit,
        tuple(notes),
    )


def _load_scene(path: Path, data: bytes, resolver: _FolderResolver, **options: Any) -> Any:
    import trimesh

    return trimesh.load_scene(
        io.BytesIO(data), file_type=path.suffix.lower()[1:], resolver=resolver, process=False, **options
    )


def _scene_meshes(scene: Any) -> list[tuple[str, Any, F64]]:
    """(node name, mesh, vertices with the node transforms applied) of a trimesh scene, in file order."""
    from trimesh import Trimesh

    found: list[tuple[str, Any, F64]] = []
    total = 0
    for node in scene.graph.nodes_geometry:
        T, name = scene.graph[node]
        mesh = scene.geometry[name]
        if isinstance(mesh, Trimesh) and len(mesh.faces):
            total += len(mesh.faces)
            if total > _MAX_FACES:  # one mesh placed ten thousand times: told before it is copied
                raise ValueError(f"holds more than {_MAX_FACES} triangles")
            T = np.asarray(T, dtype=np.float64)
            v = np.asarray(mesh.vertices, dtype=np.float64)
            placed = np.stack(
                [T[i, 0] * v[:, 0] + T[i, 1] * v[:, 1] + T[i, 2] * v[:, 2] + T[i, 3] for i in range(3)], 1
            )
            found.append((str(node), mesh, placed))
    return found


def _part(vertices: F64, faces: Any, opacity: float, material: Material) -> _Part:
    faces = np.asarray(faces, dtype=np.int32).reshape(-1, 3)
    return _Part(vertices, faces, np.full(len(faces), opacity, np.float32), material)


# --- glTF ---


def _gltf_document(data: bytes) -> dict[str, Any]:
    if data[:4] == b"glTF":
        magic_version_length = struct.unpack("<4sII", data[:12])
        if magic_version_length[2] > len(data):
            raise ValueError(f"cut short: {len(data)} of {magic_version_length[2]} bytes")
        length, kind = struct.unpack("<I4s", data[12:20])
        if kind != b"JSON":
            raise ValueError("the first chunk is not JSON")
        data = data[20 : 20 + length]
    document = json.loads(data)
    if not isinstance(document, dict):
        raise ValueError("the top of the JSON is not an object")
    return document


def _check_tree(nodes: list[dict[str, Any]]) -> None:
    """Refuse nodes with two parents: glTF forbids it, and a chain of them is a scene that doubles at each step."""
    children = [child for node in nodes for child in node.get("children", [])]
    if len(set(children)) < len(children):
        raise ValueError("a node has two parents")


def _read_gltf(path: Path, data: bytes, resolver: _FolderResolver) -> tuple[list[_Part], list[str]]:
    document = _gltf_document(data)
    _check_tree(document.get("nodes", []))
    if any(a.get("count", 0) > 3 * _MAX_FACES for a in document.get("accessors", [])):
        raise ValueError("an accessor counts more than any vehicle has")
    for thing in [*document.get("buffers", []), *document.get("images", [])]:
        uri = thing.get("uri", "")
        if uri and not uri.startswith("data:"):
            inside(resolver.root, uri, path, path.parent)
    transmission = {
        m.get("name"): float(
            m.get("extensions", {}).get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0)
        )
        for m in document.get("materials", [])
    }
    scene = _load_scene(path, data, resolver, merge_primitives=False)
    diagonal = _diagonal(scene)
    parts = []
    for node, mesh, vertices in _scene_meshes(scene):
        pbr = getattr(mesh.visual, "material", None)
        name = str(getattr(pbr, "name", None) or "")
        factor = getattr(pbr, "baseColorFactor", None)
        rgba = None if factor is None else np.asarray(factor, dtype=np.float64) / 255.0
        texture = getattr(pbr, "baseColorTexture", None)
        colour = None if rgba is None or texture is not None else (float(rgba[0]), float(rgba[1]), float(rgba[2]))
        alpha = 1.0 if rgba is None else float(rgba[3])
        mode = getattr(pbr, "alphaMode", None) or "OPAQUE"
        through = transmission.get(name, 0.0)
        image = _alpha_image(texture) if mode in ("BLEND", "MASK") else None
        uv = getattr(mesh.visual, "uv", None)
        if mode == "OPAQUE":
            alpha = 1.0  # glTF: without alphaMode the alpha value means nothing
        if image is not None and uv is not None:
            source = f"alphaMode {mode}, alpha of baseColorTexture"
            parts.append(
                _textured(vertices, mesh.faces, uv, image, alpha, Material(name, node, colour, source), diagonal)
            )
        else:
            source = f"alphaMode {mode}, baseColorFactor alpha" if alpha < 1.0 else ""
            if through > 0.0:
                source, alpha = "KHR_materials_transmission", min(alpha, 1.0 - through) if alpha == 1.0 else alpha
            parts.append(_part(vertices, mesh.faces, alpha, Material(name, node, colour, source)))
        if mode == "MASK":
            parts[-1] = _cut_out(parts[-1], float(getattr(pbr, "alphaCutoff", None) or 0.5))
    return parts, []


def _cut_out(part: _Part, cutoff: float) -> _Part:
    """MASK: below the cut-off there is no surface at all, above it a solid one."""
    keep = part.opacity >= cutoff
    material = Material(part.material.name, part.material.node, part.material.colour, "")
    return _Part(part.vertices, part.faces[keep], np.ones(int(keep.sum()), np.float32), material)


def _alpha_image(texture: Any) -> F32 | None:
    """The alpha channel (H, W) of a PIL image, 0 to 1; None where it has none."""
    if texture is None:
        return None
    _check_pixels(texture)
    if texture.mode == "P" and "transparency" in texture.info:
        texture = texture.convert("RGBA")
    if "A" not in texture.getbands():
        return None
    return _as_shares(texture.getchannel("A"))


def _diagonal(scene: Any) -> float:
    bounds = scene.bounds
    return 0.0 if bounds is None else float(np.sqrt(((bounds[1] - bounds[0]) ** 2).sum()))


# --- OBJ ---


def _as_utf8(data: bytes) -> bytes:
    """Text of any encoding as UTF-8: names of materials are often Latin-1, and all else is ASCII."""
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1").encode("utf-8")
    return data


def _read_obj(path: Path, data: bytes, resolver: _FolderResolver) -> tuple[list[_Part], list[str]]:
    data = _as_utf8(data)
    for line in data.splitlines():
        if line.startswith(b"mtllib"):
            name = line.split(None, 1)[1].decode("utf-8", "replace").strip()
            inside(resolver.root, name, path, path.parent)
    scene = _load_scene(path, data, resolver)
    diagonal = _diagonal(scene)
    parts: list[_Part] = []
    notes: list[str] = []
    for node, mesh, vertices in _scene_meshes(scene):
        simple = getattr(mesh.visual, "material", None)
        values = getattr(simple, "kwargs", None) or {}
        name = str(getattr(simple, "name", None) or "")
        kd = _numbers(values.get("kd"))
        colour = (float(kd[0]), float(kd[1]), float(kd[2])) if len(kd) >= 3 else None
        d, tr = _numbers(values.get("d")), _numbers(values.get("tr"))
        if len(d):
            opacity, source = float(d[-1]), "MTL d"
        elif len(tr):
            opacity, source = 1.0 - float(tr[0]), "MTL Tr"
        else:
            opacity, source = 1.0, ""
        opacity = float(np.clip(opacity, 0.0, 1.0))
        image = None
        if values.get("map_d") is not None:
            image, note = _opacity_image(values["map_d"], resolver)
            notes += [note] if note else []
        uv = getattr(mesh.visual, "uv", None)
        if image is not None and uv is not None:
            material = Material(name, node, colour, "MTL map_d")
            parts.append(_textured(vertices, mesh.faces, uv, image, opacity, material, diagonal))
        else:
            parts.append(
                _part(vertices, mesh.faces, opacity, Material(name, node, colour, source if opacity < 1 else ""))
            )
    return parts, notes


def _numbers(value: Any) -> list[float]:
    """The numbers of an MTL statement, whatever shape the reader gives it."""
    if value is None:
        return []
    tokens = value if isinstance(value, list | tuple | np.ndarray) else [value]
    found = []
    for token in tokens:
        for word in str(token).split():
            try:
                found.append(float(word))
            except ValueError:
                continue  # "-halo" and the like
    return found


def _opacity_image(value: Any, resolver: _FolderResolver) -> tuple[F32 | None, str]:
    """The image of a `map_d` statement as opacity (H, W), 0 to 1, and a note where it is not there."""
    from PIL import Image

    words = [str(v) for v in value] if isinstance(value, list | tuple | np.ndarray) else [str(value)]
    name = " ".join(words).split()[-1] if words[0].startswith("-") else " ".join(words).strip()
    try:
        image: Image.Image = Image.open(io.BytesIO(resolver.get(name)))
    except FileNotFoundError:
        return None, f"opacity image {name} is missing: taken as solid"
    _check_pixels(image)
    if "A" in image.getbands():
        image = image.getchannel("A")
    return _as_shares(image), ""


def _check_pixels(image: Any) -> None:
    if image.width * image.height > _MAX_PIXELS:  # a file of some kilobytes can hold a gigabyte of one colour
        raise ValueError(f"an image has {image.width} x {image.height} pixels, more than 8192 x 8192")


def _as_shares(image: Any) -> F32:
    """A PIL image's grey values (H, W), 0 to 1."""
    shares = np.array(image.convert("L"), dtype=np.float32)
    shares /= np.float32(255.0)
    return shares


# --- textured opacity ---

_BARYCENTRIC = np.array(
    [[1, 1, 1], [8, 1, 1], [1, 8, 1], [1, 1, 8], [4.5, 4.5, 1], [1, 4.5, 4.5], [4.5, 1, 4.5]], dtype=np.float64
)
_BARYCENTRIC /= _BARYCENTRIC.sum(axis=1, keepdims=True)


def _textured(
    vertices: F64, faces: Any, uv: Any, image: F32, factor: float, material: Material, diagonal: float
) -> _Part:
    """A part whose opacity is an image's, faces cut where a window's edge runs through them."""
    corners = vertices[np.asarray(faces)]  # (F, 3, 3)
    corner_uv = np.asarray(uv, dtype=np.float64)[np.asarray(faces)][..., :2]  # (F, 3, 2)
    done_corners, done_opacity = [], []
    for cut in range(_MAX_CUTS + 1):
        samples = factor * sample_image(image, np.einsum("sk,fkc->fsc", _BARYCENTRIC, corner_uv, optimize=False))
        solid = samples >= SOLID
        mixed = solid.any(axis=1) & ~solid.all(axis=1)
        edge = np.sqrt(((corners - np.roll(corners, 1, axis=1)) ** 2).sum(axis=2)).max(axis=1)
        split = mixed & (edge > diagonal * _EDGE_PER_DIAGONAL) & (cut < _MAX_CUTS)
        opacity = np.where(mixed, samples[:, 0], np.median(samples, axis=1))
        done_corners.append(corners[~split])
        done_opacity.append(opacity[~split])
        if not split.any():
            break
        corners, corner_uv = _in_four(corners[split]), _in_four(corner_uv[split])
    placed = np.concatenate(done_corners)
    alpha = np.concatenate(done_opacity).astype(np.float32)
    return _Part(placed.reshape(-1, 3), np.arange(len(placed) * 3, dtype=np.int32).reshape(-1, 3), alpha, material)


def _in_four(corners: F64) -> F64:
    """Each triangle (F, 3, C) cut at the middles of its edges: (4 F, 3, C)."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    quarters = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([np.stack(q, axis=1) for q in quarters])


def sample_image(image: F32, uv: F64) -> F64:
    """Values of an image (H, W) at texture coordinates (..., 2): v runs upwards, the image repeats."""
    height, width = image.shape
    uv = np.where(np.isfinite(uv), uv, 0.0)
    column = np.minimum((np.mod(uv[..., 0], 1.0) * width).astype(np.int64), width - 1)
    row = np.minimum((np.mod(1.0 - uv[..., 1], 1.0) * height).astype(np.int64), height - 1)
    return np.asarray(image[row, column], dtype=np.float64)


# --- DAE ---


def _read_dae(
    path: Path, data: bytes, resolver: _FolderResolver
) -> tuple[list[_Part], tuple[float, float, float], float | None, list[str]]:
    import collada
    import defusedxml.ElementTree as ElementTree

    root = ElementTree.fromstring(data, forbid_dtd=True)  # no document types, no entities; pycollada reads the rest
    _check_places(root)
    document = collada.Collada(io.BytesIO(data), ignore=[collada.common.DaeError])
    up = {"X_UP": (1.0, 0.0, 0.0), "Z_UP": (0.0, 0.0, 1.0)}.get(str(document.assetInfo.upaxis), (0.0, 1.0, 0.0))
    unit = document.assetInfo.unitmeter
    notes = []
    for image in document.images:
        try:  # images of a COLLADA file are never opened; where the artist's disk is named, the car is still good
            found = inside(resolver.root, str(image.path), path, path.parent).is_file()
        except InputError:
            found = False
        if not found:
            notes.append(f"image {image.path} is missing")
    parts: list[_Part] = []
    total = 0
    if document.scene is None:
        return parts, up, unit, notes
    for geometry in document.scene.objects("geometry"):
        node = str(getattr(geometry.original, "name", None) or getattr(geometry.original, "id", "") or "")
        for primitive in geometry.primitives():
            if hasattr(primitive, "triangleset"):
                primitive = primitive.triangleset()
            index = getattr(primitive, "vertex_index", None)
            if index is None or np.asarray(index).ndim != 2 or np.asarray(index).shape[1] != 3 or not len(index):
                continue  # lines and points
            total += len(index)
            if total > _MAX_FACES:
                raise ValueError(f"holds more than {_MAX_FACES} triangles")
            effect = getattr(primitive.material, "effect", None)
            name = str(getattr(primitive.material, "name", None) or getattr(primitive.material, "id", None) or "")
            opacity, source = (1.0, "") if effect is None else dae_opacity(effect)
            diffuse = getattr(effect, "diffuse", None)
            colour = None
            if isinstance(diffuse, tuple | list | np.ndarray) and len(diffuse) >= 3:
                colour = (float(diffuse[0]), float(diffuse[1]), float(diffuse[2]))
            vertices = np.asarray(primitive.vertex, dtype=np.float64)
            parts.append(_part(vertices, index, opacity, Material(name, node, colour, source)))
    return parts, up, None if unit is None else float(unit), notes


def _check_places(root: Any) -> None:
    """Refuse scenes that instances of instances blow up, or that hold themselves."""
    named = {node.get("id"): node for node in root.iter() if _local(node) == "node" and node.get("id")}
    known: dict[str, int] = {}

    def places(node: Any, above: tuple[str, ...]) -> int:
        count = 1
        for child in node:
            if _local(child) == "node":
                count += places(child, above)
            elif _local(child) == "instance_node":
                name = str(child.get("url", "")).lstrip("#")
                if name in above:
                    raise ValueError("a node holds itself")
                if name in named and name not in known:
                    known[name] = places(named[name], (*above, name))
                count += known.get(name, 0)
        if count > _MAX_PLACES:
            raise ValueError(f"its scene has more than {_MAX_PLACES} nodes")
        return count

    for scene in root.iter():
        if _local(scene) == "visual_scene":
            places(scene, ())


def _local(element: Any) -> str:
    """An element's name without its namespace."""
    return str(element.tag).rpartition("}")[2]


def dae_opacity(effect: Any) -> tuple[float, str]:
    """Opacity of a COLLADA effect and the element that gave it ("" for solid).

    `A_ONE`: alpha of the transparent colour times transparency; `RGB_ZERO`: one minus luminance times transparency.
    An image as transparent colour is left solid. Source: COLLADA 1.4.1 specification, "Determining Transparency".
    """
    transparent = getattr(effect, "transparent", None)
    if transparent is None or not isinstance(transparent, tuple | list | np.ndarray):
        return 1.0, ""
    red, green, blue, alpha = (float(v) for v in (*transparent, 1.0)[:4])
    amount = getattr(effect, "transparency", None)
    factor = float(amount) if isinstance(amount, int | float | np.floating) else 1.0
    mode = str(getattr(getattr(effect, "opaque_mode", None), "value", None) or getattr(effect, "opaque_mode", "A_ONE"))
    if "RGB_ZERO" in mode:
        opacity = 1.0 - factor * (0.212671 * red + 0.715160 * green + 0.072169 * blue)
    else:
        opacity = alpha * factor
    opacity = float(np.clip(opacity, 0.0, 1.0))
    return (opacity, f"DAE transparent {mode}") if opacity < 1.0 else (1.0, "")


# --- PLY, OFF ---


def _read_plain(path: Path, data: bytes, resolver: _FolderResolver) -> list[_Part]:
    """Files without materials; a PLY's face colours keep their alpha."""
    parts = []
    for node, mesh, vertices in _scene_meshes(_load_scene(path, data, resolver)):
        part = _part(vertices, mesh.faces, 1.0, Material("", node, None, ""))
        if getattr(mesh.visual, "kind", None) in ("face", "vertex") and mesh.visual.face_colors is not None:
            alpha = np.asarray(mesh.visual.face_colors)[:, 3].astype(np.float32) / np.float32(255.0)
            if (alpha < 1.0).any():
                part = _Part(part.vertices, part.faces, alpha, Material("", node, None, "PLY face alpha"))
        parts.append(part)
    return parts


def translucent(raw: RawModel) -> Bool:
    """Faces (F,) that the file declares translucent."""
    return np.asarray(raw.opacity < SOLID)
