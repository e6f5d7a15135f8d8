import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hand_made_pair import SIZE, make_pair
from PIL import Image

from augkitti.drivable import with_headings
from augkitti.errors import InputError
from augkitti.scan_pair import PAINT, CarModel, GroundMap

pytest.importorskip("matplotlib", reason="pictures need the extra `view`")
from augkitti.draw import draw_pair, range_image


def cube():
    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * SIZE
    faces = [
        [0, 1, 3],
        [0, 3, 2],
        [4, 6, 7],
        [4, 7, 5],
        [0, 4, 5],
        [0, 5, 1],
        [2, 3, 7],
        [2, 7, 6],
        [0, 2, 6],
        [0, 6, 4],
    ]
    faces = np.array([*faces, [1, 5, 7], [1, 7, 3]], np.int32)
    surface = np.full(12, PAINT, np.uint8)
    return CarModel("hand_made", "Car", corners, faces, surface, np.ones(12, np.float32), SIZE, 2.6, -1.3, "0")


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def near_colour(image, rgb, off=12):
    return int((np.abs(image - np.array(rgb)).max(axis=2) <= off).sum())


def test_a_pair_with_all_that_can_be_known_makes_a_picture(tmp_path):
    pair, source0, source1 = make_pair()
    region = with_headings((-40.0, -20.0), 0.5, np.ones((160, 80), bool), 0.0)
    plane, height = np.array([0, 0, 1, 1.73]), np.full((120, 120), -1.73, np.float32)
    ground = GroundMap(plane, (-60.0, -60.0), 1.0, height, height < 0, np.zeros(len(source0), bool))
    path = tmp_path / "pair.png"
    draw_pair(pair, path, source0, source1, region, ground, [cube()])
    image = pixels(path)
    assert image.shape[0] > 1000
    assert image.shape[1] > 1500
    assert near_colour(image, (0x00, 0x72, 0xB2)) > 300  # the virtual car
    assert near_colour(image, (0xDD, 0x00, 0x00)) > 20  # what it hides
    assert near_colour(image, (0xD9, 0xEF, 0xE3)) > 10000  # the region


def test_a_picture_needs_nothing_but_the_pair_and_then_shows_no_removed_points(tmp_path):
    pair, *_ = make_pair()
    draw_pair(pair, tmp_path / "pair.png")
    image = pixels(tmp_path / "pair.png")
    assert near_colour(image, (0x00, 0x72, 0xB2)) > 300
    assert near_colour(image, (0xDD, 0x00, 0x00)) == 0


def test_a_pair_without_virtual_cars_or_objects_is_drawn(tmp_path):
    pair, *_ = make_pair()
    nobody = np.full(len(pair.scan0), -1, np.int16)
    plain = replace(pair, objects=(), scan0=replace(pair.scan0, instance=nobody))
    draw_pair(plain, tmp_path / "plain.png")
    assert (tmp_path / "plain.png").stat().st_size > 10000


def test_the_same_pair_gives_the_same_picture(tmp_path):
    pair, source0, _ = make_pair()
    for name in ("a.png", "b.png"):
        draw_pair(pair, tmp_path / name, source0)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_picture_that_cannot_be_written_names_the_path(tmp_path):
    pair, *_ = make_pair()
    with pytest.raises(InputError, match=r"missing.*cannot be written"):
        draw_pair(pair, tmp_path / "missing" / "pair.png")


def test_a_range_image_keeps_the_nearest_point_and_puts_left_on_the_left():
    xyz = np.array([[10.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 7.0, 0.0], [0.0, -3.0, 0.0]])
    image = range_image(xyz, np.array([2, 2, 3, 3], np.uint8), columns=360)
    assert image.shape == (64, 360)
    assert np.isfinite(image).sum() == 3
    assert image[2, 180] == 5.0
    assert image[3, 90] == 7.0
    assert image[3, 270] == 3.0


def test_drawing_is_imported_without_matplotlib():
    code = "import sys, augkitti.draw, augkitti.dataset_info; assert 'matplotlib' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
