"""How a described CAD library loads with its manifest and without: `python benchmarks/cad_library.py ../shared/cad`."""

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from augkitti.cad_models import CadLibrary, load_cad_folder
from augkitti.cad_soup import face_areas
from augkitti.scan_pair import GLASS, CarModel


def pane_area(model: CarModel) -> float:
    middle = model.vertices[model.faces].mean(axis=1)
    return float(face_areas(model.vertices, model.faces)[(model.surface == GLASS) & (middle[:, 2] > 0.0)].sum())


def faces_backwards(model: CarModel, other: CarModel) -> bool:
    tree, some = cKDTree(other.vertices), model.vertices[::7]
    return bool(tree.query(some * [-1.0, -1.0, 1.0])[0].mean() < tree.query(some)[0].mean())


def timed(folder: Path) -> tuple[CadLibrary, float]:
    start = time.perf_counter()
    return load_cad_folder(folder), time.perf_counter() - start


def main() -> None:
    root = Path(sys.argv[1])
    facts = {m["name"]: m for m in json.loads((root / "manifest.json").read_text())["models"]}
    described, seconds = timed(root)
    with tempfile.TemporaryDirectory() as scratch:
        bare = Path(scratch) / "cars"
        shutil.copytree(root, bare, ignore=shutil.ignore_patterns("manifest.json", "*.md"))
        found, bare_seconds = timed(bare)
    alone = {m.name: m for m in found.models}
    problems = {r.name: r.problem for r in found.report}
    print("| model | category | triangles | length x width x height, m | off by | panes, m2 | without the manifest |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    right = 0
    for model in described.models:
        declared = np.array([facts[model.name][k] for k in ("length_m", "width_m", "height_m")])
        off = float(np.abs(model.size_m / declared - 1.0).max())
        if model.name in alone:
            other = alone[model.name]
            size = float(np.abs(other.size_m / declared - 1.0).max())
            panes = abs(pane_area(other) - pane_area(model)) / max(pane_area(model), 0.01)
            round_ = "front opposite" if faces_backwards(other, model) else "front the same"
            right += size < 0.03 and panes < 0.05 and round_ == "front the same"
            verdict = f"size {size:.1%}, panes {panes:.1%}, {round_}"
        else:
            verdict = f"left out: {problems[model.name].split(';')[0]}"
        size_text = " x ".join(f"{s:.2f}" for s in model.size_m)
        print(
            f"| {model.name} | {model.category} | {len(model.faces)} | {size_text} | {off:.1%} "
            f"| {pane_area(model):.2f} | {verdict} |"
        )
    print(f"\nwith the manifest: {len(described.models)} of {len(facts)} in {seconds:.1f} s;", end=" ")
    print(f"without: {right} as the manifest has them, {len(alone)} loaded, in {bare_seconds:.1f} s")


if __name__ == "__main__":
    main()
