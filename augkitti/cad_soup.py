"""All triangles of a vehicle in car axes: joined, cleaned and picked by material, from what a file holds."""

import fnmatch
import re
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from augkitti.cad_alignment import merge_vertices
from augkitti.cad_formats import SOLID, RawModel
from augkitti.frames import F64
from augkitti.scan_pair import Bool

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Soup:
    """All triangles of a vehicle in car axes, wheels in place, not yet centred."""

    vertices: F64
    faces: Any  # (F, 3) int32
    material: Any  # (F,) int32 into names
    opacity: Any  # (F,) float32
    names: tuple[str, ...]  # material name
    nodes: tuple[str, ...]
    colours: tuple[Vector | None, ...]
    sources: tuple[str, ...]


def face_areas(vertices: F64, faces: Any) -> F64:
    """Area (F,) of triangles, square metres."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    return np.asarray(np.sqrt((normal * normal).sum(axis=1)) / 2.0)


def turned(vertices: F64, R: F64) -> F64:
    """Points (N, 3) turned by a rotation (3, 3)."""
    x, y, z = vertices[:, 0], vertices[:, 1], vertices[:, 2]
    return np.stack([R[i, 0] * x + R[i, 1] * y + R[i, 2] * z for i in range(3)], axis=1)


def as_soup(raw: RawModel, R: F64, scale: float) -> Soup:
    """A file's triangles turned by R (3, 3) and scaled to metres."""
    return Soup(
        turned(raw.vertices, R) * scale,
        raw.faces,
        raw.material,
        raw.opacity,
        tuple(m.name for m in raw.materials),
        tuple(m.node for m in raw.materials),
        tuple(m.colour for m in raw.materials),
        tuple(m.opacity_source for m in raw.materials),
    )


def joined(soups: list[Soup]) -> Soup:
    """Several soups as one."""
    vertex_offset = np.cumsum([0] + [len(s.vertices) for s in soups])
    name_offset = np.cumsum([0] + [len(s.names) for s in soups])
    return Soup(
        np.concatenate([s.vertices for s in soups]),
        np.concatenate([s.faces + o for s, o in zip(soups, vertex_offset, strict=False)]).astype(np.int32),
        np.concatenate([s.material + o for s, o in zip(soups, name_offset, strict=False)]).astype(np.int32),
        np.concatenate([s.opacity for s in soups]),
        sum((s.names for s in soups), ()),
        sum((s.nodes for s in soups), ()),
        sum((s.colours for s in soups), ()),
        sum((s.sources for s in soups), ()),
    )


def bounds(soup: Soup) -> tuple[F64, F64]:
    """Lowest and highest corner (3,) of the vertices that faces use."""
    corners = soup.vertices[np.unique(soup.faces)]
    return corners.min(axis=0), corners.max(axis=0)


def cleaned(soup: Soup, drop_materials: tuple[str, ...]) -> tuple[Soup, list[str]]:
    """Without dropped materials, shadow planes, faces without area, and twins of a face."""
    said = []
    keep = np.ones(len(soup.faces), dtype=bool)
    dropped = matches(soup, drop_materials)
    if dropped.any():
        said.append(f"{int(dropped.sum())} faces of dropped materials left out")
    if not drop_materials:
        shadow = shadow_planes(soup)
        if shadow.any():
            said.append(f"{int(shadow.sum())} faces of a shadow plane left out")
        dropped |= shadow
    keep &= ~dropped
    soup = kept(soup, keep)
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
    soup = kept(soup, unique & ~flat)
    return soup, said


def kept(soup: Soup, keep: Bool) -> Soup:
    """Some of the faces (F,)."""
    return replace(soup, faces=soup.faces[keep], material=soup.material[keep], opacity=soup.opacity[keep])


def shadow_planes(soup: Soup) -> Bool:
    """Faces (F,) of materials that lie flat (within 2 cm) at the bottom and are translucent or named so."""
    found = np.zeros(len(soup.faces), dtype=bool)
    low, high = bounds(soup)
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


def matches(soup: Soup, patterns: tuple[str, ...]) -> Bool:
    """Faces (F,) whose material's name is one of the patterns (`*` stands for anything)."""
    wanted = [part for pattern in patterns for part in _name_parts(pattern) if part]
    hits = [any(name == w or fnmatch.fnmatchcase(name, w) for w in wanted) for name in soup.names]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


def of_names(soup: Soup, pattern: re.Pattern[str]) -> Bool:
    """Faces (F,) whose material or node has a name that fits."""
    hits = [bool(pattern.search(n) or pattern.search(m)) for n, m in zip(soup.names, soup.nodes, strict=True)]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


def of_materials(soup: Soup, pattern: re.Pattern[str]) -> Bool:
    """Faces (F,) whose material has a name that fits, or, for a nameless one, whose node has."""
    hits = [bool(pattern.search(n or m)) for n, m in zip(soup.names, soup.nodes, strict=True)]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])


def red_faces(soup: Soup) -> Bool:
    """Faces (F,) of red or orange materials: lamp glass is coloured, panes are not."""
    hits = [c is not None and c[0] > 0.25 and c[0] > 2.0 * max(c[1], c[2]) for c in soup.colours]
    return np.asarray(np.array(hits, dtype=bool)[soup.material])
