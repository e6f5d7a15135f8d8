"""The CAD library: models that nobody described, manifests, sidecars, bad files, cache; and the real models."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from car_files import turn, write_obj
from scipy.spatial import cKDTree

from augkitti import cad_models
from augkitti.cad_formats import read_model
from augkitti.cad_models import CadLibrary, load_cad_folder
from augkitti.cad_soup import face_areas
from augkitti.errors import InputError
from augkitti.parametric_cars import parametric_cars
from augkitti.scan_pair import GLASS, LAMP, PAINT, TYRE, CarModel

CARS = {m.name.removeprefix("parametric_"): m for m in parametric_cars()}


def pane_area(model: CarModel) -> float:
    """Area of glass at cabin height: the windows; lamps glazed with the same material lie lower."""
    middle = model.vertices[model.faces].mean(axis=1)
    return float(face_areas(model.vertices, model.faces)[(model.surface == GLASS) & (middle[:, 2] > 0.0)].sum())


def misfit(model: CarModel, other: CarModel, turned_round: bool = False) -> float:
    """Mean distance of a model's vertices to another's, metres; with `turned_round` of the model facing backwards."""
    some = model.vertices[::7] * ([-1.0, -1.0, 1.0] if turned_round else [1.0, 1.0, 1.0])
    return float(cKDTree(other.vertices).query(some)[0].mean())


# --- models that nobody described ---

FRAMES = {
    "as a car": (np.eye(3), 1.0),
    "y up, centimetres": (turn(0, -90), 0.01),
    "inches, turned by 33 degrees": (turn(0, -90) @ turn(2, 33), 0.0254),
    "upside down, backwards": (turn(2, 180) @ turn(0, 180), 1.0),
    "millimetres, -17.3 degrees": (turn(2, -17.3), 0.001),
}


@pytest.mark.parametrize(
    ("frame", "body"), [(f, b) for f, b in zip(FRAMES, ("sedan", "suv", "van", "truck", "coupe"), strict=True)]
)
def test_axes_unit_wheels_and_windows_are_found(tmp_path, frame, body):
    R, unit = FRAMES[frame]
    write_obj(CARS[body], tmp_path / "thing.obj", R, unit)
    model = load_cad_folder(tmp_path).models[0]
    np.testing.assert_allclose(model.size_m, CARS[body].size_m, rtol=0.01)
    assert misfit(model, CARS[body]) < 0.02 < misfit(model, CARS[body], turned_round=True)
    assert pane_area(model) == pytest.approx(pane_area(CARS[body]), rel=0.02)
    assert model.wheelbase_m == pytest.approx(CARS[body].wheelbase_m, abs=0.03)
    assert model.rear_axle_x_m == pytest.approx(CARS[body].rear_axle_x_m, abs=0.03)
    assert model.category == CARS[body].category


def test_the_origin_is_the_middle_of_the_box_and_translucent_lamps_are_no_windows(tmp_path):
    model = CARS["hatchback"]
    write_obj(model, tmp_path / "a.obj", np.eye(3))
    text = (tmp_path / "a.mtl").read_text().replace("newmtl m_d\nKd 0.4 0.4 0.4\nd 1.0", "newmtl m_d\nd 0.3")
    (tmp_path / "a.mtl").write_text(text)
    loaded = load_cad_folder(tmp_path).models[0]
    np.testing.assert_allclose(loaded.vertices.max(axis=0), -loaded.vertices.min(axis=0), atol=1e-6)
    assert (loaded.surface == LAMP).any()
    assert pane_area(loaded) == pytest.approx(pane_area(model), rel=0.01)
    assert (loaded.opacity[loaded.surface == GLASS] < 1).all()
    assert (loaded.opacity[loaded.surface == PAINT] == 1).all()
    assert (loaded.surface == TYRE).any()


def test_twin_faces_and_faces_without_area_are_left_out(tmp_path):
    model = CARS["city"]
    write_obj(model, tmp_path / "a.obj", np.eye(3))
    lines = (tmp_path / "a.obj").read_text().splitlines()
    faces = [line for line in lines if line.startswith("f ")]
    backwards = ["f " + " ".join(line.split()[:0:-1]) for line in faces[:50]]
    (tmp_path / "a.obj").write_text("\n".join([*lines, *faces[:100], *backwards, "f 1 1 2"]) + "\n")
    loaded = load_cad_folder(tmp_path).models[0]
    assert len(loaded.faces) == len(model.faces)
    corners = np.sort(loaded.faces, axis=1)
    assert len(np.unique(corners, axis=0)) == len(corners)


def test_a_cube_a_lone_wheel_and_a_car_of_unclear_front_are_left_out_with_the_reason(tmp_path):
    write_obj(CARS["city"], tmp_path / "good.obj", np.eye(3))
    box = "v 0 0 0\nv 4 0 0\nv 4 1.7 0\nv 0 1.7 0\nv 0 0 1.5\nv 4 0 1.5\nv 4 1.7 1.5\nv 0 1.7 1.5\n"
    quads = "f 1 2 3 4\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8\n"
    (tmp_path / "box.obj").write_text(box + quads)
    (tmp_path / "cube.obj").write_text(box.replace("1.7", "4").replace("1.5", "4") + quads)
    library = load_cad_folder(tmp_path)
    assert [m.name for m in library.models] == ["good"]
    problems = {r.name: r.problem for r in library.report if r.problem}
    assert set(problems) == {"box", "cube"}
    assert "front cannot be told" in problems["box"]


def test_wheels_in_a_separate_file_go_into_the_arches_or_where_the_sidecar_says(tmp_path):
    model = CARS["estate"]
    is_tyre = np.abs(np.abs(model.vertices[model.faces].mean(axis=1)[:, 1]) - 0.66) < 0.16
    centre_z = -model.size_m[2] / 2 + 0.31
    middle = model.vertices[model.faces].mean(axis=1)
    for axle in (model.rear_axle_x_m, model.rear_axle_x_m + model.wheelbase_m):
        is_tyre[np.hypot(middle[:, 0] - axle, middle[:, 2] - centre_z) < 0.315] |= False
    near = [np.hypot(middle[:, 0] - a, middle[:, 2] - centre_z) < 0.312 for a in (model.rear_axle_x_m,)]
    wheel = near[0] & (middle[:, 1] > 0.5)
    any_wheel = (
        near[0] | (np.hypot(middle[:, 0] - model.rear_axle_x_m - model.wheelbase_m, middle[:, 2] - centre_z) < 0.312)
    ) & (np.abs(middle[:, 1]) > 0.5)
    home = tmp_path / "estate"
    home.mkdir()
    _write_part(model, ~any_wheel, home / "body.obj", np.zeros(3))
    y = model.vertices[model.faces[wheel]][..., 1]
    hub = np.array([model.rear_axle_x_m, (y.min() + y.max()) / 2, centre_z])
    _write_part(model, wheel, home / "tyre.obj", hub)
    found = load_cad_folder(tmp_path).models[0]
    np.testing.assert_allclose(found.size_m, model.size_m, rtol=0.03)
    assert found.wheelbase_m == pytest.approx(model.wheelbase_m, abs=0.05)
    front = [model.rear_axle_x_m + model.wheelbase_m, hub[1], hub[2]]
    centres = [front, [front[0], -front[1], front[2]], list(hub), [hub[0], -hub[1], hub[2]]]
    sidecar = {
        "up_axis": [0, 0, 1],
        "forward_axis": [1, 0, 0],
        "unit_scale": 1.0,
        "wheel_files": ["tyre.obj"],
        "wheel_centres_m": [[float(v) for v in c] for c in centres],
    }
    (home / "body.yaml").write_text(yaml.safe_dump(sidecar))
    placed = load_cad_folder(tmp_path).models[0]
    np.testing.assert_allclose(placed.size_m, model.size_m, rtol=0.003)
    assert placed.wheelbase_m == pytest.approx(model.wheelbase_m, abs=0.01)
    (home / "tyre.obj").unlink()
    (home / "body.yaml").unlink()
    with pytest.raises(InputError, match="no wheels"):
        load_cad_folder(tmp_path)


def _write_part(model: CarModel, chosen: np.ndarray, path: Path, origin: np.ndarray) -> None:
    used, faces = np.unique(model.faces[chosen], return_inverse=True)
    lines = [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in model.vertices[used] - origin]
    lines += ["mtllib part.mtl"]
    faces = faces.reshape(-1, 3) + 1
    for name, mine in (("clear", model.surface[chosen] == GLASS), ("solid", model.surface[chosen] != GLASS)):
        lines += [f"usemtl {name}"] + [f"f {a} {b} {c}" for a, b, c in faces[mine]]
    path.write_text("\n".join(lines) + "\n")
    path.with_name("part.mtl").write_text("newmtl clear\nd 0.3\nnewmtl solid\nd 1\n")


# --- manifests and sidecars ---


def test_a_manifest_overrides_what_the_shape_says_and_a_wrong_front_is_warned_of(tmp_path):
    write_obj(CARS["estate"], tmp_path / "a.obj", np.eye(3))
    entry = {
        "name": "mine",
        "main_file": "a.obj",
        "class": "truck",
        "up_axis": [0, 0, 1],
        "forward_axis": [-1, 0, 0],
        "unit_scale": 1.2,
        "glass": [],
        "drop_materials": ["m_d (a remark)"],
    }
    (tmp_path / "manifest.json").write_text(json.dumps({"models": [entry]}))
    library = load_cad_folder(tmp_path)
    model = library.models[0]
    assert (model.name, model.category) == ("mine", "Truck")
    np.testing.assert_allclose(model.size_m, 1.2 * CARS["estate"].size_m, rtol=1e-3)
    assert not (model.surface == GLASS).any()
    assert any("other way than declared" in d for d in library.report[0].decisions)


def test_a_size_that_contradicts_the_declared_one_leaves_the_model_out(tmp_path):
    write_obj(CARS["sedan"], tmp_path / "a.obj", np.eye(3))
    write_obj(CARS["city"], tmp_path / "b.obj", np.eye(3))
    (tmp_path / "a.yaml").write_text("length_m: 4.9\n")
    library = load_cad_folder(tmp_path)
    assert [m.name for m in library.models] == ["b"]
    assert "length_m is 4.25, but 4.90" in library.report[0].problem


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        "{}",
        '{"models": [{}]}',
        '{"models": 3}',
        '{"models": [{"name": "a", "main_file": "a.obj", "unit_scale": -1}]}',
    ],
)
def test_a_damaged_manifest_is_an_input_error(tmp_path, text):
    write_obj(CARS["city"], tmp_path / "a.obj", np.eye(3))
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json"):
        load_cad_folder(tmp_path)


@pytest.mark.parametrize("text", ["glass: 3\n", "{", "- a\n", "!!python/object/apply:os.system ['true']\n"])
def test_a_damaged_sidecar_leaves_its_model_out(tmp_path, text):
    write_obj(CARS["city"], tmp_path / "a.obj", np.eye(3))
    write_obj(CARS["city"], tmp_path / "b.obj", np.eye(3))
    (tmp_path / "b.yaml").write_text(text)
    library = load_cad_folder(tmp_path)
    assert [m.name for m in library.models] == ["a"]
    assert "b.yaml" in library.report[1].problem


def test_a_manifest_that_points_outside_of_its_folder_is_not_followed(tmp_path):
    home = tmp_path / "cars"
    home.mkdir()
    write_obj(CARS["city"], tmp_path / "secret.obj", np.eye(3))
    write_obj(CARS["city"], home / "a.obj", np.eye(3))
    bad = [{"name": "x", "main_file": "../secret.obj"}, {"name": "../..", "main_file": "secret.obj"}]
    (home / "manifest.json").write_text(json.dumps({"models": bad}))
    library = load_cad_folder(home)
    assert [m.name for m in library.models] == ["a"]
    assert sum("outside of its folder" in (r.problem or "") for r in library.report) == 2


# --- folders ---


def test_a_missing_folder_an_empty_one_and_one_without_a_usable_model_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        load_cad_folder(tmp_path / "gone")
    with pytest.raises(InputError, match=r"no car model; give files that end in \.glb"):
        load_cad_folder(tmp_path)
    (tmp_path / "bad.glb").write_bytes(b"glTF")
    with pytest.raises(InputError, match=r"no usable car model .bad: .*see `augkitti cad check"):
        load_cad_folder(tmp_path)


def test_cad_check_lists_every_file_where_not_one_is_usable(tmp_path, augkitti):
    for number in range(4):
        (tmp_path / f"bad{number}.glb").write_bytes(b"glTF")
    shown = augkitti("cad", "check", str(tmp_path))
    assert shown.exit_code == 1
    assert all(f"bad{number}" in shown.stdout for number in range(4))
    assert "0 usable, 4 left out" in shown.stdout


def test_a_bad_model_among_good_ones_is_listed_and_categories_choose(tmp_path):
    for body in ("truck", "city"):
        write_obj(CARS[body], tmp_path / f"{body}.obj", np.eye(3))
    (tmp_path / "bad.glb").write_bytes(b"glTF\x02\0\0\0\xff\xff\xff\xff")
    library = load_cad_folder(tmp_path, categories=("Car",))
    assert [m.name for m in library.models] == ["city"]
    problems = {r.name: r.problem for r in library.report}
    assert "not readable as GLB" in problems["bad"]
    assert "Truck is not asked for" in problems["truck"]
    assert problems["city"] is None
    with pytest.raises(InputError, match="of category Van"):
        load_cad_folder(tmp_path, categories=("Van",))


def test_the_cache_gives_the_same_model_notices_changes_and_mends_damage(tmp_path, monkeypatch):
    cars, cache = tmp_path / "cars", tmp_path / "cache"
    cars.mkdir()
    write_obj(CARS["city"], cars / "a.obj", np.eye(3))
    first = load_cad_folder(cars, cache_dir=cache)
    (kept,) = cache.iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(cad_models, "build_model", None)  # would fail if it were called
        again = load_cad_folder(cars, cache_dir=cache)
    assert again.models[0].digest == first.models[0].digest
    assert again.report == first.report
    np.testing.assert_array_equal(again.models[0].vertices, first.models[0].vertices)
    whole = kept.read_bytes()
    for damaged in (b"", whole[:1000], whole[:5000] + b"\0\1\2\3" + whole[5004:]):
        kept.write_bytes(damaged)
        assert load_cad_folder(cars, cache_dir=cache).models[0].digest == first.models[0].digest
        assert kept.read_bytes() == whole
    (cars / "a.mtl").write_text((cars / "a.mtl").read_text().replace("d 0.4", "d 0.6"))
    assert load_cad_folder(cars, cache_dir=cache).models[0].digest != first.models[0].digest
    assert not [p for p in cache.iterdir() if p.suffix != ".npz"]


# --- real models ---


@pytest.fixture(scope="module")
def described(cad_root) -> CadLibrary:
    return load_cad_folder(cad_root)


@pytest.fixture(scope="module")
def facts(cad_root) -> dict:
    return {m["name"]: m for m in json.loads((cad_root / "manifest.json").read_text())["models"]}


@pytest.mark.cad
def test_every_described_model_loads_with_its_size_and_windows(described, facts):
    models = {m.name: m for m in described.models}
    assert set(models) == set(facts)
    for name, model in models.items():
        declared = np.array([facts[name][k] for k in ("length_m", "width_m", "height_m")])
        np.testing.assert_allclose(model.size_m, declared, rtol=0.03, err_msg=name)
        assert ((model.surface == GLASS).any()) == bool(facts[name]["glass"]), name
        assert (model.surface == TYRE).any(), name
        if facts[name]["glass"]:
            low = min(0.999, facts[name]["glass"][0]["alpha"])
            assert (model.opacity[model.surface == GLASS] <= max(low, 0.95)).all() or low == 0.999, name
        contact = model.vertices[model.faces[model.surface == TYRE]][..., 2].min()
        assert contact == pytest.approx(-model.size_m[2] / 2, abs=0.02), name
        assert 0.4 * model.size_m[0] < model.wheelbase_m < 0.75 * model.size_m[0], name


@pytest.mark.cad
def test_without_the_manifest_at_least_sixteen_are_found_and_none_is_loaded_wrongly(
    described, facts, cad_root, tmp_path
):
    bare = tmp_path / "cars"
    bare.mkdir()
    for folder in sorted(p for p in cad_root.iterdir() if p.is_dir()):
        shutil.copytree(folder, bare / folder.name)
    library = load_cad_folder(bare)
    truth = {m.name: m for m in described.models}
    said_backwards = {r.name for r in described.report if any("other way than declared" in d for d in r.decisions)}
    right = []
    for model in library.models:
        other = truth[model.name]
        np.testing.assert_allclose(model.size_m, other.size_m, rtol=0.03, err_msg=model.name)
        assert pane_area(model) == pytest.approx(pane_area(other), rel=0.05, abs=0.01), model.name
        backwards = misfit(model, other, turned_round=True) < misfit(model, other)
        assert backwards == (model.name in said_backwards), model.name  # a manifest's front that the shape contradicts
        if not backwards:
            right.append(model.name)
    assert len(right) >= 16
    left_out = {r.name for r in library.report if r.problem}
    assert left_out | {m.name for m in library.models} == set(truth)


@pytest.mark.cad
def test_the_named_materials_are_glass_and_no_other(described, facts, cad_root):
    for model in described.models:
        known = facts[model.name]
        if not known["glass"]:
            continue
        raw = read_model(cad_root / model.name / known["main_file"], cad_root / model.name)
        names = {part.split(" (")[0] for part in known["glass"][0]["material"].split(", ")}
        pane = np.array([m.name in names for m in raw.materials])[raw.material]
        if "exture" in known["glass"][0]["how"]:
            pane &= raw.opacity < 0.95
        corners = np.sort(
            np.round(raw.vertices * known["unit_scale"], 4).view("f8,f8,f8").reshape(-1)[raw.faces[pane]], axis=1
        )
        _, once = np.unique(corners, axis=0, return_index=True)  # panes that are in the file twice count once
        declared = face_areas(raw.vertices * known["unit_scale"], raw.faces[pane][once]).sum()
        area = face_areas(model.vertices, model.faces)[model.surface == GLASS].sum()
        assert area == pytest.approx(declared, rel=0.02), model.name


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [4, 0, 0], [4, 0, 1.5]],
        [[1e300, 0, 0], [0, 1e300, 0], [0, 0, 1e300]],
        [[1e-300, 0, 0], [0, 1e-300, 0], [0, 0, 1e-300]],
        [[1e9, 0, 0], [1e9 + 4, 1.7, 0], [1e9, 0, 1.5]],
    ],
)
@pytest.mark.parametrize("suffix", ["off", "obj"])
def test_degenerate_shapes_are_left_out_with_a_reason(tmp_path, points, suffix):
    rows = [" ".join(f"{v:.17g}" for v in p) for p in points]
    if suffix == "off":
        text = "OFF\n3 1 0\n" + "\n".join(rows) + "\n3 0 1 2\n"
    else:
        text = "\n".join(f"v {row}" for row in rows) + "\nf 1 2 3\n"
    (tmp_path / f"bad.{suffix}").write_text(text)
    with pytest.raises(InputError, match="no usable car model"):
        load_cad_folder(tmp_path)
