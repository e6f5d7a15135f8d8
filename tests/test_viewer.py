"""The viewer without a browser: what is packed comes back, what is written is safe, small, and the same each time."""

import base64
import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from html.parser import HTMLParser
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from PIL import Image
from viewed_pair import MODEL, write_viewed_set

from augkitti.errors import InputError
from augkitti.frames import pose_from_xyz_yaw
from augkitti.scan_pair import GLASS, PAINT, THROUGH_GLASS, CarModel
from augkitti.scanner import load_profile
from augkitti.viewer import decode_columns, encode_columns, pair_data, source_points
from augkitti.viewer.pages import STATIC, IndexRow, page_names, write_index_page, write_pair_page
from augkitti.viewer.pair_data import rigid_flow, thinned
from augkitti.viewer.panes import beam_origins, through_panes
from augkitti.viewer.thumbnail import SIZE, thumbnail


@pytest.fixture(scope="module")
def viewed(tmp_path_factory):
    root = tmp_path_factory.mktemp("viewed")
    return root, write_viewed_set(root / "aug", root / "kitti", pairs=3, tick_step=40)


def assert_one_line(result, *words):
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1, result.stderr
    assert all(word in result.stderr for word in words), result.stderr


# --- columns ---------------------------------------------------------------------------------------------------------


@given(
    st.sampled_from([np.int32, np.int16, np.uint16, np.uint8]).flatmap(
        lambda dtype: arrays(dtype, array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=9))
    )
)
def test_any_integers_come_back_as_they_were(values):
    contents, packed = encode_columns({"a": values, "b": values})
    back = decode_columns(json.loads(json.dumps(contents)), packed)
    for name in ("a", "b"):
        expected = values.reshape(-1) if values.ndim == 2 and values.shape[1] == 1 else values
        assert back[name].dtype == values.dtype
        if values.size:
            np.testing.assert_array_equal(back[name], expected)


def test_numbers_that_cannot_be_packed_are_refused():
    with pytest.raises(ValueError, match="float64"):
        encode_columns({"a": np.zeros(3)})


def test_bytes_that_are_not_those_of_the_table_are_refused():
    contents, packed = encode_columns({"a": np.arange(9, dtype=np.int32)})
    with pytest.raises(ValueError, match="more than"):
        decode_columns([{**contents[0], "rows": 5}], packed)
    with pytest.raises(ValueError, match="deflated"):
        decode_columns(contents, packed[:-9])


# --- a pair's data ---------------------------------------------------------------------------------------------------


def test_a_packed_pair_holds_the_pair_to_half_a_millimetre(viewed):
    pair = viewed[1][0]
    data = pair_data(pair, load_profile(), {MODEL.name: MODEL})
    columns = decode_columns(data.table["columns"], data.packed)
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        assert np.abs(columns[f"xyz{k}"] * 1e-3 - scan.xyz).max() < 5.1e-4
        assert np.abs(columns[f"reflectance{k}"] / 255 - scan.reflectance).max() < 2.1e-3
        for name in ("ring", "tick", "source", "instance", "surface"):
            np.testing.assert_array_equal(columns[f"{name}{k}"], getattr(scan, name))
    np.testing.assert_array_equal(columns["status0"], pair.flow_status0)
    assert np.abs(rigid_flow(pair) + columns["flow_rest0"] * 1e-3 - pair.flow0).max() < 6e-4


def test_flow_that_breaks_the_contract_is_shown_as_it_is(viewed):
    pair = viewed[1][0]
    flow = pair.flow0.copy()
    flow[17] += np.float32(1.25)
    odd = replace(pair, flow0=flow)
    data = pair_data(odd, load_profile(), {})
    rest = decode_columns(data.table["columns"], data.packed)["flow_rest0"]
    np.testing.assert_array_equal(rest[17], [1250, 1250, 1250])
    assert np.abs(np.delete(rest, 17, axis=0)).max() <= 1


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e9])
def test_a_place_that_is_none_is_refused_with_the_pair_s_name(viewed, value):
    pair = viewed[1][0]
    xyz = pair.scan1.xyz.copy()
    xyz[3, 1] = value
    with pytest.raises(InputError, match=f"{pair.pair_id}.*xyz1"):
        pair_data(replace(pair, scan1=replace(pair.scan1, xyz=xyz)), load_profile(), {})


def test_removed_points_are_the_source_s_rows_and_another_source_is_noticed():
    from hand_made_pair import make_pair

    pair, source0, _ = make_pair()
    np.testing.assert_array_equal(source_points(source0, pair.scan0.removed), source0.xyz[pair.scan0.removed])
    other = replace(source0, row=source0.row[:20], xyz=source0.xyz[:20])
    assert source_points(other, np.array([25], np.int32)) is None
    assert source_points(replace(source0, row=source0.row * 2), np.array([3], np.int32)) is None


def test_a_fine_mesh_is_thinned_and_keeps_its_shape():
    vertices, faces, surface = thinned(MODEL, 2000)
    assert 300 < len(faces) <= 2000
    assert len(surface) == len(faces)
    assert faces.max() < len(vertices)
    assert np.abs(np.ptp(vertices, axis=0) - MODEL.size_m).max() < 0.15
    assert (surface == GLASS).any()


def test_a_mesh_that_is_coarse_enough_is_left_alone():
    vertices, faces, _ = thinned(MODEL, 40_000)
    np.testing.assert_array_equal(vertices, MODEL.vertices)
    np.testing.assert_array_equal(faces, MODEL.faces)


# --- what was seen through windows -----------------------------------------------------------------------------------


def plates(glass_half=0.4):
    """A car of three upright plates across x: a pane of glass in front (x 1), a solid plate low down behind (x -1)."""
    size = np.array([2.0, 2.0, 2.0])

    def plate(x, y, z0, z1):
        return [[x, -y, z0], [x, y, z0], [x, y, z1], [x, -y, z1]]

    corners = np.array(plate(1.0, glass_half, -glass_half, glass_half) + plate(-1.0, 1.0, -1.0, 0.0))
    corners = np.concatenate([corners, [[-1.0, 1.0, 1.0]]])  # so that the bounding box is that of a car
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    surface = np.array([GLASS, GLASS, PAINT, PAINT], np.uint8)
    return CarModel("plates", "Car", corners, faces, surface, np.ones(4, np.float32), size, 1.0, -0.5, "0")


def test_points_behind_a_pane_are_found_and_those_beside_it_or_behind_metal_are_not(viewed):
    pair = viewed[1][0]
    profile = load_profile()
    pose = pose_from_xyz_yaw(-12.0, 0.0, 0.2, np.pi)  # behind the scanner, its nose away: the solid plate first
    facing = pose_from_xyz_yaw(-12.0, 0.0, 0.2, 0.0)  # its pane towards the scanner
    car = replace(pair.objects[2], model="plates", pose0=facing, pose1=facing, motion=None, moment0=0.0, moment1=0.0)
    wanted = np.array(
        [
            [-20.0, 0.0, 0.6],  # through the pane, over the solid plate: seen
            [-12.0, 0.1, 0.3],  # inside
            [-20.0, 3.0, 0.5],  # beside the pane
            [-20.0, 0.0, -0.1],  # through the pane, but the plate stands before it
            [-10.0, 0.0, 0.3],  # before the pane
            [-11.0, 0.0, 0.2],  # on it
        ],
        np.float32,
    )
    n = len(wanted)
    scan = replace(
        pair.scan0, xyz=wanted, reflectance=np.zeros(n, np.float32), ring=np.full(n, 9, np.uint8),
        tick=np.full(n, 65535, np.uint16), source=np.arange(n, dtype=np.int32),
        instance=np.array([-1, 0, -1, -1, -1, 0], np.int16),
        surface=np.array([0, THROUGH_GLASS, 0, 0, 0, GLASS], np.uint8),
    )  # fmt: skip
    shown = replace(pair, scan0=scan, scan1=scan, objects=(car,))
    found = through_panes(shown, 0, {"plates": plates()}, profile)
    assert found.point.tolist() == [0, 1]
    assert found.car.tolist() == [0, 0]
    np.testing.assert_allclose(found.pane[:, 0], -11.0, atol=1e-6)
    origin = beam_origins(wanted, scan.ring, profile)[:2]
    share = (found.pane - origin)[:, 0] / (wanted[:2] - origin)[:, 0]  # on the straight line between
    np.testing.assert_allclose(found.pane, origin + share[:, None] * (wanted[:2] - origin), atol=1e-6)
    turned = replace(car, pose0=pose, pose1=pose)
    assert 3 not in through_panes(replace(shown, objects=(turned,)), 0, {"plates": plates()}, profile).point
    assert len(through_panes(shown, 0, {}, profile).point) == 0


def test_a_pane_is_met_where_the_car_was_when_the_pulse_was_fired(viewed):
    pair = viewed[1][0]
    profile = load_profile()
    pose = pose_from_xyz_yaw(-12.0, 0.0, 0.2, 0.0)
    motion = pose_from_xyz_yaw(2.0, 0.0, 0.0, 0.0)
    car = replace(pair.objects[2], model="plates", pose0=pose, pose1=motion @ pose, motion=motion)
    car = replace(car, moment0=0.0, moment1=0.0)
    late = int(0.75 * profile.lattice_size)  # a quarter of a revolution after the middle
    tick = (profile.seam_tick - 1 - late) % profile.lattice_size
    scan = replace(
        pair.scan0, xyz=np.array([[-20.0, 0.0, 0.6]], np.float32), reflectance=np.zeros(1, np.float32),
        ring=np.full(1, 9, np.uint8), tick=np.array([tick], np.uint16), source=np.zeros(1, np.int32),
        instance=np.full(1, -1, np.int16), surface=np.zeros(1, np.uint8),
    )  # fmt: skip
    found = through_panes(replace(pair, scan0=scan, objects=(car,)), 0, {"plates": plates(1.0)}, profile)
    np.testing.assert_allclose(found.pane[0, 0], -11.0 + 2.0 * 0.25, atol=2e-3)


def test_beams_start_where_the_ray_model_says():
    from augkitti.scanner import fire_rays, ray_lines

    profile = load_profile()
    rays = fire_rays(profile, np.arange(0, 4000, 500, dtype=np.uint16), 0.1)
    origin, direction = ray_lines(profile, rays.ray_ring, rays.ray_azimuth_rad, rays.ray_elevation_rad)
    found = beam_origins(origin + 17.0 * direction, rays.ray_ring, profile)
    np.testing.assert_allclose(found, origin, atol=1e-9)


# --- pages -----------------------------------------------------------------------------------------------------------


class Text(HTMLParser):
    """The tags of a page, and the content of its scripts."""

    def __init__(self):
        super().__init__()
        self.tags, self.scripts, self.open = [], {}, None

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open = dict(attrs).get("id") if tag == "script" else None

    def handle_endtag(self, tag):
        self.open = None

    def handle_data(self, data):
        if self.open:
            self.scripts[self.open] = self.scripts.get(self.open, "") + data


HOSTILE = '"><script>alert(1)</script><!--&amp; $packed ${table}'


def test_no_text_of_a_data_set_is_taken_for_a_page_s_own(viewed, tmp_path):
    pair = replace(viewed[1][0], pair_id=HOSTILE, sequence=HOSTILE)
    data = pair_data(pair, load_profile(), {}, None, HOSTILE)
    write_pair_page(tmp_path / "pair.html", data, "a.html", None, HOSTILE)
    row = IndexRow(HOSTILE, HOSTILE, (0, 1), "a.html", "a.png", ((HOSTILE, 1.0, 2.0, 3),), 0, 9)
    write_index_page(tmp_path / "index.html", [row], HOSTILE, 1, HOSTILE)
    for name, scripts in (("pair.html", 5), ("index.html", 1)):
        page = Text()
        page.feed((tmp_path / name).read_text())
        assert sum(tag == "script" for tag, _ in page.tags) == scripts
    page = Text()
    page.feed((tmp_path / "pair.html").read_text())
    table = json.loads(page.scripts["table"])
    assert table["id"] == HOSTILE
    assert set(decode_columns(table["columns"], base64.b64decode(page.scripts["packed"]))) >= {"xyz0", "flow_rest0"}
    card = Text()
    card.feed((tmp_path / "index.html").read_text())
    (attrs,) = [attrs for tag, attrs in card.tags if attrs.get("class") == "card"]
    assert attrs["data-sequence"] == HOSTILE
    assert json.loads(attrs["data-cars"]) == [[1.0, 2.0, 3]]


def test_page_names_are_plain_and_each_stands_once():
    names = page_names(["a/0/1", "a-0/1", "A/0/1", "../../etc", "", "\u00e4/\n", "x" * 300])
    assert len({name.lower() for name in names}) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]{1,110}", name) for name in names)
    assert names[0] == "a-0-1"


def test_pages_ask_no_other_machine_for_anything():
    from importlib.resources import files

    for name in ("index.html", "pair.html", *(f"static/{name}" for name in STATIC)):
        text = files("augkitti.viewer").joinpath(name).read_text()
        assert not re.search(r"(?:https?:)?//[\w.-]+\.\w+/|\bfetch\(|XMLHttpRequest|\bimport\b.*from|@import", text), (
            name
        )


def test_a_thumbnail_shows_the_cars_and_is_small(viewed):
    content = thumbnail(viewed[1][0])
    picture = Image.open(BytesIO(content))
    assert picture.size == SIZE
    assert len(content) < 60_000
    colours = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    assert (np.abs(colours - [0, 0x72, 0xB2]).max(axis=1) < 40).sum() > 100
    assert thumbnail(viewed[1][0]) == content


# --- the command -----------------------------------------------------------------------------------------------------


def contents(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_pages_of_a_set_hold_what_they_link_to_and_nothing_else(augkitti, viewed, tmp_path):
    result = augkitti("view", viewed[0] / "aug", "--kitti", viewed[0] / "kitti", "--out", "pages")
    assert result.exit_code == 0, result.output
    assert result.stdout == "pages/index.html\n"
    found = contents(tmp_path / "pages")
    stems = [f"{name}-{frame}-0" for name in ["2011_09_26_drive_0007_sync"] for frame in (0, 2, 4)]
    expected = {"index.html", *(f"static/{name}" for name in STATIC)}
    assert set(found) == expected | {f"pairs/{s}.html" for s in stems} | {f"thumbs/{s}.png" for s in stems}
    for path, content in found.items():
        if not path.endswith(".html"):
            continue
        page = Text()
        page.feed(content.decode())
        for _, attrs in page.tags:
            link = attrs.get("href") or attrs.get("src")
            if link and link != "data:,":
                assert (tmp_path / "pages" / path).parent.joinpath(link).resolve().is_file(), (path, link)
    page = Text()
    page.feed(found[f"pairs/{stems[1]}.html"].decode())
    table = json.loads(page.scripts["table"])
    assert table["objects"][2]["mesh"] == 0
    columns = decode_columns(table["columns"], base64.b64decode(page.scripts["packed"]))
    pair = viewed[1][1]
    assert len(columns["removed0"]) == len(pair.scan0.removed) > 0
    steps = {attrs["rel"]: attrs["href"] for tag, attrs in page.tags if tag == "a" and "rel" in attrs}
    assert steps == {"prev": f"{stems[0]}.html", "next": f"{stems[2]}.html"}


def test_the_same_set_gives_the_same_pages_with_one_process_and_with_two(augkitti, viewed, tmp_path):
    for out, jobs in (("a", 1), ("b", 2)):
        assert augkitti("view", viewed[0] / "aug", "--out", out, "--jobs", jobs).exit_code == 0
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_pages_without_the_source_say_so_on_the_page_and_on_stderr(augkitti, viewed, tmp_path):
    result = augkitti("view", viewed[0] / "aug", "--out", "pages", "--pairs", "1")
    assert result.exit_code == 0
    assert "give --kitti" in result.stderr
    assert "1 of 3 pairs" in result.stderr
    (page,) = (tmp_path / "pages" / "pairs").iterdir()
    parsed = Text()
    parsed.feed(page.read_text())
    table = json.loads(parsed.scripts["table"])
    assert "give --kitti" in table["removed_note"]
    assert not any(entry["name"].startswith("removed") for entry in table["columns"])


def test_a_source_that_lacks_the_sequence_costs_the_removed_points_only(augkitti, viewed, tmp_path):
    from tiny_drive import write_drive

    write_drive(tmp_path / "other", frames=(0, 1))
    result = augkitti("view", viewed[0] / "aug", "--kitti", "other", "--out", "pages", "--pairs", "1")
    assert result.exit_code == 0
    assert "removed points are not shown" in result.stderr


def test_a_named_pair_alone_gets_a_page(augkitti, viewed, tmp_path):
    pair = viewed[1][2]
    assert augkitti("view", viewed[0] / "aug", "--pair", pair.pair_id).exit_code == 0
    pages = [path.name for path in (tmp_path / "augkitti-view" / "pairs").iterdir()]
    assert pages == [f"{page_names([pair.pair_id])[0]}.html"]


def test_a_name_that_ends_in_png_still_gives_one_picture(augkitti, viewed, tmp_path):
    pytest.importorskip("matplotlib", reason="pictures need the extra `view`")
    result = augkitti("view", viewed[0] / "aug", "--out", "picture.png")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    assert not (tmp_path / "augkitti-view").exists()


def test_pages_are_written_over_pages_only(augkitti, viewed, tmp_path):
    assert augkitti("view", viewed[0] / "aug", "--out", "pages", "--pairs", 3).exit_code == 0
    assert augkitti("view", viewed[0] / "aug", "--out", "pages", "--pairs", 1).exit_code == 0
    assert len(list((tmp_path / "pages" / "pairs").iterdir())) == 1
    (tmp_path / "pages" / "thesis.txt").write_text("mine")
    assert_one_line(augkitti("view", viewed[0] / "aug", "--out", "pages"), "thesis.txt")
    assert (tmp_path / "pages" / "thesis.txt").read_text() == "mine"
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "index.html").write_text("<p>mine")
    assert_one_line(augkitti("view", viewed[0] / "aug", "--out", "mine"), "mine")
    (tmp_path / "file").write_text("mine")
    assert_one_line(augkitti("view", viewed[0] / "aug", "--out", "file"), "file")
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_bad_input_is_told_in_one_line(augkitti, viewed, tmp_path):
    aug = viewed[0] / "aug"
    assert_one_line(augkitti("view", aug, "--pair", "nobody/0/0"), "nobody/0/0")
    assert_one_line(augkitti("view", aug, "--out", aug / "pages"), "data set")
    assert_one_line(augkitti("view", aug, "--out", "s3://bucket/pages"), "machine")
    assert_one_line(augkitti("view", aug, "--rerun", "--out", "pages"), ".rrd")
    assert augkitti("view", aug, "--pairs", "0").exit_code == 2
    broken = tmp_path / "broken"
    shutil.copytree(aug, broken)
    (shard,) = (broken / "data").iterdir()
    content = bytearray(shard.read_bytes())
    content[200:4000] = bytes(3800)
    shard.write_bytes(content)
    assert_one_line(augkitti("view", broken, "--out", "pages"), shard.name)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["broken"]


def test_rerun_that_is_not_installed_is_named_with_its_remedy(augkitti, viewed, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert_one_line(augkitti("view", viewed[0] / "aug", "--rerun", "--out", "a.rrd"), "pip install rerun-sdk")


def test_rerun_reads_what_is_sent_to_it(augkitti, viewed, tmp_path):
    pytest.importorskip("rerun", reason="needs rerun-sdk")
    pair = viewed[1][1]
    words = ("--rerun", "--pair", pair.pair_id, "--kitti", viewed[0] / "kitti", "--out", "pair.rrd")
    result = augkitti("view", viewed[0] / "aug", *words)
    assert result.exit_code == 0, result.output
    rerun = [sys.executable, "-m", "rerun", "rrd"]
    checked = subprocess.run([*rerun, "verify", "pair.rrd"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr
    printed = subprocess.run([*rerun, "print", "pair.rrd"], capture_output=True, text=True, check=True).stdout
    assert pair.pair_id in printed
    for name in ("points", "removed", "boxes", "flow"):
        assert f"/scan/{name}" in printed
