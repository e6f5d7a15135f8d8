"""Label files: boxes against values worked out by hand, and every malformed file one error."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_drive import CAM_FROM_VELO, CAM_OFFSET_M

from augkitti.errors import InputError
from augkitti.frames import invert, rigid
from augkitti.kitti_labels import _camera_box, read_object_labels, read_tracking_labels, read_tracklets

T_VELO_CAM = invert(rigid(CAM_FROM_VELO, CAM_OFFSET_M))
POSE = "<item><tx>10</tx><ty>-2</ty><tz>-1.7</tz><rz>{rz}</rz><truncation>{truncation}</truncation></item>"
HEAD = '<?xml version="1.0" encoding="UTF-8" standalone="yes" ?>\n<!DOCTYPE boost_serialization>\n'


def tracklets(poses: str, size: str = "<h>1.5</h><w>1.6</w><l>4</l>", head: str = HEAD) -> str:
    return (
        f"{head}<boost_serialization><tracklets><count>1</count><item><objectType>Van</objectType>{size}"
        f"<first_frame>7</first_frame><poses>{poses}</poses></item></tracklets></boost_serialization>"
    )


def test_a_tracklet_becomes_centre_boxes_from_its_first_frame(tmp_path: Path) -> None:
    path = tmp_path / "tracklet_labels.xml"
    path.write_text(tracklets(POSE.format(rz=0.5, truncation=0) + POSE.format(rz=4.0, truncation=1)))
    boxes = read_tracklets(path)
    assert list(boxes) == [7, 8]
    (first,), (second,) = boxes[7], boxes[8]
    assert (first.id, first.category) == ("tracklet_000", "Van")
    assert second.id == first.id
    np.testing.assert_allclose(first.box, [10.0, -2.0, -0.95, 4.0, 1.6, 1.5, 0.5])
    assert second.box[6] == pytest.approx(4.0 - 2.0 * np.pi)


def test_poses_outside_the_image_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "tracklet_labels.xml"
    path.write_text(tracklets("".join(POSE.format(rz=0, truncation=t) for t in (2, 0, 3))))
    assert list(read_tracklets(path)) == [8]


ENTITY = '<!DOCTYPE x [<!ENTITY a "10"><!ENTITY b SYSTEM "file:///etc/passwd">]>\n'


@pytest.mark.parametrize(
    "text",
    [
        "",
        "<boost_serialization>",
        "<boost_serialization/>",
        tracklets(POSE.replace("10", "&a;").format(rz=0, truncation=0), head=ENTITY),
        tracklets(POSE.replace("10", "&b;").format(rz=0, truncation=0), head=ENTITY),
        tracklets(POSE.format(rz="north", truncation=0)),
        tracklets(POSE.format(rz="nan", truncation=0)),
        tracklets(POSE.format(rz=0, truncation=0), size="<h>1.5</h><w>1.6</w>"),
        tracklets(POSE.format(rz=0, truncation=0), size="<h>1.5</h><w>1.6</w><l>0</l>"),
        tracklets(POSE.format(rz=0, truncation=0)).replace("<first_frame>7", "<first_frame>inf"),
        tracklets(POSE.format(rz=0, truncation=0)).replace("<poses>", "<x>").replace("</poses>", "</x>"),
        tracklets(POSE.format(rz=0, truncation=0)).replace("Van", ""),
    ],
)
def test_malformed_tracklets_are_one_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "tracklet_labels.xml"
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_tracklets(path)
    assert "tracklet_labels.xml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_tracklets_that_are_no_text_are_one_error(tmp_path: Path) -> None:
    path = tmp_path / "tracklet_labels.xml"
    path.write_bytes(b"\xff\xfe\x00<\x01")
    with pytest.raises(InputError):
        read_tracklets(path)


ROW = "{frame} {track} {kind} 0 0 0 1 2 3 4 1.5 1.6 4.0 {x} {y} {z} {ry}\n"


def test_tracking_rows_become_velo_boxes_of_the_drives_frames(tmp_path: Path) -> None:
    path = tmp_path / "0003.txt"
    # camera: 2 m to the right, bottom 1.65 m down, 10 m ahead, facing ahead (rotation_y = -90 degrees)
    path.write_text(
        ROW.format(frame=4, track=11, kind="Car", x=2, y=1.65, z=10, ry=-np.pi / 2)
        + ROW.format(frame=4, track=-1, kind="DontCare", x=-1000, y=-1000, z=-1000, ry=-10)
        + "\n"
    )
    boxes = read_tracking_labels(path, T_VELO_CAM, first_frame=100)
    assert list(boxes) == [104]
    (car,) = boxes[104]
    assert (car.id, car.category) == ("tracking_0003_011", "Car")
    np.testing.assert_allclose(car.box, [10.27, -2.0, -0.98, 4.0, 1.6, 1.5, 0.0], atol=1e-12)


NO_ANGLE = "0 1 Car 0 0 0 1 2 3 4 1.5 1.6 4 2 1 10 1e300"


@pytest.mark.parametrize(
    "line", ["0 1", "0 1 Car 0 0 0 1 2 3 4 1 1 1", "x 1 Car", "0 1 Car" + " a" * 14, "0 y Van", NO_ANGLE]
)
def test_malformed_tracking_rows_are_one_error_with_the_line(tmp_path: Path, line: str) -> None:
    path = tmp_path / "0003.txt"
    path.write_text("\n" + line + "\n")
    with pytest.raises(InputError, match=r"0003.txt:2"):
        read_tracking_labels(path, T_VELO_CAM)


def test_object_rows_are_tracking_rows_without_frame_and_track(tmp_path: Path) -> None:
    path = tmp_path / "000008.txt"
    path.write_text("Car 0 0 0 1 2 3 4 1.5 1.6 4.0 2 1.65 10 -1.5707963267948966\nDontCare " + "-1 " * 14 + "\n")
    (car,) = read_object_labels(path, T_VELO_CAM)
    np.testing.assert_allclose(car.box, [10.27, -2.0, -0.98, 4.0, 1.6, 1.5, 0.0], atol=1e-12)
    path.write_text("Car 0 0 0\n")
    with pytest.raises(InputError):
        read_object_labels(path, T_VELO_CAM)


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.1, 3.1))
def test_yaw_is_minus_rotation_y_minus_a_right_angle(rotation_y: float) -> None:
    words = [repr(v) for v in (1.5, 1.6, 4.0, 1.0, 1.7, 20.0, rotation_y)]
    box = _camera_box("Car", words, T_VELO_CAM, "here")
    assert box is not None
    expected = -rotation_y - np.pi / 2.0
    np.testing.assert_allclose([np.cos(box[6]), np.sin(box[6])], [np.cos(expected), np.sin(expected)], atol=1e-12)
