"""Classes the faces of a vehicle as paint, glass, tyre, lamp or other, from materials, names and places."""

import re
from typing import Any

import numpy as np

from augkitti.cad_alignment import Wheel, face_components, merge_vertices
from augkitti.cad_formats import SOLID
from augkitti.cad_soup import Soup, face_areas, matches, of_materials, of_names, red_faces
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import GLASS, LAMP, OTHER, PAINT, TYRE, U8, Bool

WHEEL_NAME = re.compile(
    r"wheel|whee[kl]|tire|tyre|tier\b|rubber|pneu|reifen|\brim|_rim|roue|(?<![a-z])rad(?![a-z])|felge", re.I
)
_TYRE_NAME = re.compile(r"tire|tyre|(?<![a-z])tier(?![a-z])|rubber|pneu|reifen", re.I)
_LAMP_NAME = re.compile(
    r"(head|tail|brake|fog|signal|turn).?(light|lamp|lt)|(?<![a-z])(lights?|lamps?|lens|optics?|indicator|phares?|feux?)"
    r"(?![a-z])|reflector|scheinwerfer|leuchte|blinker",
    re.I,
)
GLASS_NAME = re.compile(r"glass|window(?!.?(trim|frame|seal))|windshield|windscreen|vitre|scheibe|pane(?![a-z])", re.I)
FRONT_NAME = re.compile(
    r"(?<![a-z])front|head.?(light|lamp|lt)|windshield|windscreen|steer|bonnet|hood|_F[LR]?(?![a-z])"
)
REAR_NAME = re.compile(r"(?<![a-z])rear|tail|brake.?(light|lamp|lt)|exhaust|trunk|boot(?![a-z])|_[BR][LR](?![a-z])")
_PANE_NAME = re.compile(r"window(?!.?(trim|frame|seal))|windshield|windscreen", re.I)
_OTHER_NAME = re.compile(
    r"interior|interieur|seat|siege|dash|steer|under|dessous|chrome|plastic|void|grill|trim|rim|wheel|chassis|engine|"
    r"exhaust|caliper|disc|floor|carpet|mirror_glass|plate|plaque",
    re.I,
)


def classify(
    soup: Soup, size: F64, wheels: tuple[Wheel, ...], hint: Bool, declared: tuple[str, ...] | None, source: str
) -> tuple[U8, Any, list[str]]:
    """Surface class (F,) and opacity (F,) of each face of a centred soup, and what decided on the windows."""
    middle = soup.vertices[soup.faces].mean(axis=1)
    clear = np.asarray(soup.opacity < SOLID)
    on_wheel, tread = _wheel_faces(middle, wheels, hint)
    if declared is not None:
        glass, said = _declared_glass(soup, clear & ~on_wheel, declared, source)
    else:
        glass, said = _found_glass(soup, middle, clear & ~on_wheel, size, on_wheel)
    surface = np.full(len(soup.faces), PAINT, dtype=np.uint8)
    surface[of_names(soup, _OTHER_NAME)] = OTHER
    surface[of_names(soup, _LAMP_NAME)] = LAMP
    surface[clear] = LAMP
    surface[on_wheel] = OTHER
    surface[glass] = GLASS
    named_tyre = of_names(soup, _TYRE_NAME)
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


def _declared_glass(soup: Soup, clear: Bool, materials: tuple[str, ...], source: str) -> tuple[Bool, list[str]]:
    glass = np.zeros(len(soup.faces), dtype=bool)
    for material in materials:
        named = matches(soup, (material,))
        if not named.any():
            raise InputError(source, f"no material is named {material!r}", "mend field `glass`")
        # an image tells the panes of a shared material; without one the whole material is glass
        by_image = np.array([("map_d" in s) or ("Texture" in s) for s in soup.sources])[soup.material]
        glass |= named & clear if (named & by_image).any() else named
    return glass, [f"glass: {source}" if materials else f"no glass: {source}"]


def _found_glass(soup: Soup, middle: F64, clear: Bool, size: F64, wheels: Bool) -> tuple[Bool, list[str]]:
    """Windows without a manifest: translucent faces at cabin height that are not lamps; by name where none is declared.

    A material is judged as a whole; one whose opacity is an image's holds panes and lamps alike and is judged piece by
    piece. Cabin height is the upper half, where head lamps and most tail lamps do not reach.
    """
    area = face_areas(soup.vertices, soup.faces)
    high = middle[:, 2] > 0.0
    lamp = of_names(soup, _LAMP_NAME) & ~of_names(soup, _PANE_NAME)
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
    glass = _mostly_high(group, clear & ~lamp & ~red_faces(soup), high, area)
    if glass.any():
        return glass, ["glass: " + ", ".join(sorted({soup.sources[m] for m in np.unique(soup.material[glass])}))]
    named = of_materials(soup, GLASS_NAME) & ~lamp & ~wheels
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
