"""Writes car models as files: a parametric car in any axes and unit in, an OBJ with its MTL out."""

from pathlib import Path

import numpy as np

from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import GLASS, CarModel

NAMES = {1: "m_a", 2: "m_b", 3: "m_c", 4: "m_d", 5: "m_e"}  # names that say nothing


def write_obj(model: CarModel, path: Path, R_file_car: np.ndarray, unit_m: float = 1.0, glass: str = "d 0.4") -> None:
    """Write a car with its surfaces as materials; `R_file_car` turns car axes into the file's."""
    points = model.vertices @ R_file_car.T / unit_m
    lines = [f"mtllib {path.stem}.mtl"] + [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
    for surface, name in NAMES.items():
        lines.append(f"usemtl {name}")
        lines += [f"f {a} {b} {c}" for a, b, c in model.faces[model.surface == surface] + 1]
    path.write_text("\n".join(lines) + "\n")
    mtl = [
        f"newmtl {name}\nKd 0.4 0.4 0.4\n{glass if surface == GLASS else 'd 1.0'}\n" for surface, name in NAMES.items()
    ]
    path.with_suffix(".mtl").write_text("\n".join(mtl))


def turn(axis: int, degrees: float) -> np.ndarray:
    """A rotation (3, 3) about x, y or z."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    R = np.eye(3)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def write_cars(folder: Path, *bodies: str) -> None:
    """Write cars made in code into a folder, as `a.obj`, `b.obj`, ..."""
    cars = {model.name: model for model in parametric_cars()}
    folder.mkdir(parents=True)
    for letter, body in zip("abcd", bodies or ("sedan", "city"), strict=False):
        write_obj(cars[f"parametric_{body}"], folder / f"{letter}.obj", np.eye(3))
