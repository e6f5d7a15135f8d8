"""Reading vehicle files: opacity by each format's own rules, nothing outside of the folder, no traceback."""

import base64
import json
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from augkitti.cad_formats import dae_opacity, inside, read_model, sample_image
from augkitti.cad_models import load_cad_folder
from augkitti.errors import InputError

SQUARE = (
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl pane\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
)


def obj(folder, mtl):
    (folder / "car.obj").write_text("mtllib car.mtl\n" + SQUARE)
    (folder / "car.mtl").write_text("newmtl pane\nKd 0.1 0.2 0.3\n" + mtl)
    return read_model(folder / "car.obj")


def gltf(folder, material, translation=(0, 0, 0), **changes):
    """A triangle as glTF with its buffer in a data URI."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    buffer = points + np.array([0, 1, 2, 0], np.uint16).tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": list(translation)}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [{"name": "pane", **material}],
        "buffers": [
            {
                "byteLength": len(buffer),
                "uri": "data:application/octet-stream;base64," + base64.b64encode(buffer).decode(),
            }
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 6},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 1, 0]},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        **changes,
    }
    path = folder / "car.gltf"
    path.write_text(json.dumps(document))
    return path


@pytest.mark.parametrize(
    ("mtl", "opacity"),
    [
        ("d 0.25\n", 0.25),
        ("Tr 0.7\n", 0.3),
        ("d 0.4\nTr 0.4\n", 0.4),
        ("", 1.0),
        ("Tr 0\n", 1.0),
        ("d 1\nTr 0.9\n", 1.0),
    ],
)
def test_mtl_d_is_opacity_and_wins_over_tr(tmp_path, mtl, opacity):
    np.testing.assert_allclose(obj(tmp_path, mtl).opacity, opacity, atol=1e-6)


def test_an_opacity_image_is_sampled_with_v_upwards_and_faces_are_cut_at_a_windows_edge(tmp_path):
    image = np.full((100, 100), 255, np.uint8)
    image[:50, :30] = 76  # top left of the image: small u, large v
    Image.fromarray(image).save(tmp_path / "opacity.png")
    raw = obj(tmp_path, "d 1.0\nmap_d opacity.png\n")
    middle = raw.vertices[raw.faces].mean(axis=1)
    a, b, c = (raw.vertices[raw.faces[:, k]] for k in range(3))
    area = np.sqrt((np.cross(b - a, c - a) ** 2).sum(axis=1)) / 2
    assert area.sum() == pytest.approx(1.0)
    clear = raw.opacity < 0.9
    assert area[clear].sum() == pytest.approx(0.15, abs=0.01)
    assert ((middle[clear, 0] < 0.31) & (middle[clear, 1] > 0.49)).all()


def test_a_missing_opacity_image_is_a_warning_and_the_faces_are_solid(tmp_path):
    raw = obj(tmp_path, "map_d gone.png\n")
    assert (raw.opacity == 1).all()
    assert "gone.png" in raw.warnings[0]


def test_images_repeat_outside_of_zero_to_one():
    image = np.arange(4, dtype=np.float32).reshape(2, 2)
    uv = np.array([[0.25, 0.75], [1.25, 0.75], [0.25, -0.75], [0.75, 0.25]])
    np.testing.assert_array_equal(sample_image(image, uv), [0, 0, 2, 3])


@pytest.mark.parametrize(
    ("material", "opacity"),
    [
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.4]}, "alphaMode": "BLEND"}, 0.4),
        ({"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.4]}}, 1.0),
        ({"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}}, 0.1),
        ({}, 1.0),
    ],
)
def test_gltf_is_translucent_by_blend_or_transmission_only(tmp_path, material, opacity):
    raw = read_model(gltf(tmp_path, material))
    np.testing.assert_allclose(raw.opacity, opacity, atol=0.01)
    assert raw.up_axis == (0.0, 1.0, 0.0)


def test_gltf_nodes_place_their_meshes(tmp_path):
    raw = read_model(gltf(tmp_path, {}, translation=(5, 6, 7)))
    np.testing.assert_allclose(raw.vertices.min(axis=0), [5, 6, 7])


@pytest.mark.parametrize(
    ("transparent", "amount", "mode", "opacity"),
    [
        ((1, 1, 1, 1), 1.0, "A_ONE", 1.0),
        ((1, 1, 1, 0.25), 1.0, "A_ONE", 0.25),
        ((0.5, 0.5, 0.5, 1), 1.0, "RGB_ZERO", 0.5),
        ((0, 0, 0, 1), 1.0, "RGB_ZERO", 1.0),
        ((1, 1, 1, 1), 0.4, "RGB_ZERO", 0.6),
        (None, 0.5, "A_ONE", 1.0),
    ],
)
def test_collada_opacity_follows_its_mode(transparent, amount, mode, opacity):
    effect = SimpleNamespace(transparent=transparent, transparency=amount, opaque_mode=mode)
    assert dae_opacity(effect)[0] == pytest.approx(opacity, abs=1e-4)


def test_a_collada_file_with_entities_is_refused(tmp_path):
    path = tmp_path / "car.dae"
    path.write_text('<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><COLLADA>&b;</COLLADA>')
    with pytest.raises(InputError):
        read_model(path)


@pytest.mark.parametrize(
    "name", ["../secret.mtl", "/etc/passwd", "a/../../b", "file:///etc/passwd", "C:\\x", "%2e%2e/x"]
)
def test_paths_out_of_the_folder_are_refused(tmp_path, name):
    home = tmp_path / "car"
    home.mkdir()
    with pytest.raises(InputError, match="outside of its folder"):
        inside(home, name, home / "car.obj")


def test_a_link_out_of_the_folder_is_refused(tmp_path):
    home = tmp_path / "car"
    home.mkdir()
    (tmp_path / "secret.png").write_text("x")
    (home / "link.png").symlink_to(tmp_path / "secret.png")
    with pytest.raises(InputError, match="outside of its folder"):
        inside(home, "link.png", home / "car.obj")


def test_an_obj_or_gltf_that_names_a_file_outside_is_refused(tmp_path):
    home = tmp_path / "car"
    home.mkdir()
    (home / "car.obj").write_text("mtllib ../car.mtl\n" + SQUARE)
    with pytest.raises(InputError, match="outside of its folder"):
        read_model(home / "car.obj")
    path = gltf(home, {}, buffers=[{"byteLength": 42, "uri": "../secret.bin"}])
    with pytest.raises(InputError, match="outside of its folder"):
        read_model(path)


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "dae", "ply", "off"])
@pytest.mark.parametrize("content", [b"", b"\0" * 64, b"not a model\n", b"{}", b"<a/>", b"\xff\xfe\x00garbage"])
def test_garbage_is_an_input_error_in_every_format(tmp_path, suffix, content):
    path = tmp_path / f"car.{suffix}"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_model(path)
    assert "\n" not in str(caught.value)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_reads_or_is_an_input_error(tmp_path, data):
    source = gltf(tmp_path, {}).read_bytes()
    if data.draw(st.booleans()):  # as GLB
        text = source + b" " * (-len(source) % 4)
        source = struct.pack("<4sII", b"glTF", 2, 20 + len(text)) + struct.pack("<I4s", len(text), b"JSON") + text
        path = tmp_path / "cut.glb"
    else:
        path = tmp_path / "cut.gltf"
    at = data.draw(st.integers(0, len(source) - 1))
    if data.draw(st.booleans()):
        source = source[:at]
    else:
        source = source[:at] + bytes([data.draw(st.integers(0, 255))]) + source[at + 1 :]
    path.write_bytes(source)
    try:
        raw = read_model(path)
    except InputError:
        return
    assert np.isfinite(raw.vertices).all()
    assert raw.faces.max() < len(raw.vertices)


def test_faces_with_nan_are_left_out_and_said(tmp_path):
    (tmp_path / "car.off").write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\nnan 0 0\n3 0 1 2\n3 0 1 3\n")
    raw = read_model(tmp_path / "car.off")
    assert len(raw.faces) == 1
    assert "NaN" in raw.warnings[0]


def test_names_in_latin_1_are_read(tmp_path):
    (tmp_path / "car.obj").write_bytes(("mtllib car.mtl\n" + SQUARE.replace("pane", "tür")).encode("latin-1"))
    (tmp_path / "car.mtl").write_bytes("newmtl tür\nd 0.25\n".encode("latin-1"))
    raw = read_model(tmp_path / "car.obj")
    assert raw.materials[0].name == "tür"
    np.testing.assert_allclose(raw.opacity, 0.25)


def test_an_opacity_that_is_no_number_is_solid_and_said(tmp_path):
    raw = obj(tmp_path, "d nan\n")
    assert (raw.opacity == 1).all()
    assert "no number" in raw.warnings[0]


def test_a_chain_of_nodes_that_doubles_at_each_step_is_refused(tmp_path):
    nodes = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    with pytest.raises(InputError, match="two parents"):
        read_model(gltf(tmp_path, {}, nodes=nodes))


def test_a_mesh_placed_a_million_times_is_refused(tmp_path):
    path = tmp_path / "car.dae"
    nodes = "".join(f'<node id="n{k}">{f"""<instance_node url="#n{k + 1}"/>""" * 10}</node>' for k in range(12))
    for first, problem in (("n0", "more than"), ("self", "holds itself")):
        path.write_text(
            '<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><library_nodes>'
            f'{nodes}<node id="self"><instance_node url="#self"/></node></library_nodes><library_visual_scenes>'
            f'<visual_scene id="s"><node><instance_node url="#{first}"/></node></visual_scene>'
            '</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>'
        )
        with pytest.raises(InputError, match=problem):
            read_model(path)


def test_an_image_of_more_pixels_than_memory_is_refused(tmp_path):
    Image.new("1", (9000, 9000)).save(tmp_path / "huge.png")
    with pytest.raises(InputError, match="pixels"):
        obj(tmp_path, "map_d huge.png\n")


OUTSIDE = ("../secret", "/etc/hostname", "file:///etc/hostname", "http://localhost/x", "%2e%2e/secret", "%252e%252e/x")


@pytest.mark.parametrize("name", [*OUTSIDE, "link", "..%5csecret", "A" * 5000, "\ud800"])
@pytest.mark.parametrize("how", ["buffer", "image", "mtllib", "map_d", "sidecar", "manifest"])
def test_no_file_leads_out_of_its_folder(tmp_path, how, name):
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "secret").write_bytes(b"secret" * 100)
    (home / "link").symlink_to(tmp_path / "secret")
    where, words = json.dumps(name), name.encode("utf-8", "surrogatepass")
    if how == "buffer":
        gltf(home, {}, buffers=[{"byteLength": 42, "uri": name}])
    elif how == "image":
        gltf(home, {}, images=[{"uri": name}])
    else:
        (home / "car.obj").write_bytes(
            b"mtllib " + (words if how == "mtllib" else b"car.mtl") + b"\n" + SQUARE.encode()
        )
        (home / "car.mtl").write_bytes(b"newmtl pane\nmap_d " + (words if how == "map_d" else b"gone.png") + b"\n")
    if how == "sidecar":
        (home / "car.yaml").write_text(f"wheel_files: [{where}]\n")
    elif how == "manifest":
        (home / "manifest.json").write_text(f'{{"models": [{{"name": "x", "main_file": {where}}}]}}')
    with pytest.raises(InputError) as caught:
        load_cad_folder(home)
    assert "secretsecret" not in str(caught.value)
    if name in (*OUTSIDE[:4], "link"):
        assert "outside of its folder" in str(caught.value)
