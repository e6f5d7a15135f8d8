"""What holds for all that Table 2 compares: an answer, without a value that is no number, whatever a pair lacks."""

from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from matched_scene import corner_and_box
from scored_pair import an_object, make_pair
from street_of_boxes import street_pair

from augkitti.frames import is_rigid
from training.baselines.followed import sure, true_boxes
from training.score import Rules, Score
from training.tables import COMPARED

NEEDS_OPEN3D = pytest.mark.skipif(find_spec("libusb_package") is None, reason="Open3D is not installed (extra `fit`)")


def each(methods):
    """A test for each, by name."""
    marks = {one.name: NEEDS_OPEN3D if one.name.startswith("fpfh") else () for one in methods}
    return pytest.mark.parametrize("one", [pytest.param(one, id=one.name, marks=marks[one.name]) for one in methods])


EVERY = each(COMPARED)
FOLLOWING = each([one for one in COMPARED if one.name.removesuffix("_strong") in ("icp", "fpfh", "3dmatch", "dewan")])
TRUTH = ("ego_true",)  # is told the ego-motion


@pytest.fixture(scope="module")
def driving():
    return street_pair([an_object(12, 3, step=1.5, turn=0.05), an_object(20, -4, step=-0.8)])


def answer(one, pair, detections):
    """What a method says, after what must hold of it always; and its flow."""
    said = one.method(pair, detections)
    assert tuple(said.flows) == (one.name,)
    (flow,) = said.flows.values()
    assert flow.shape == (len(pair.scan0), 3)
    assert said.where.shape == (len(pair.scan0),)
    assert np.isfinite(flow).all()
    assert is_rigid(said.ego_motion)
    if said.motions is not None:
        assert len(said.motions) == len(said.boxes)
        assert all(is_rigid(motion) for motion in said.motions)
    return said, flow


@EVERY
def test_identical_scans_stand_still(one):
    pair, _ = corner_and_box(ego=np.eye(4), own=np.eye(4))
    said, flow = answer(one, pair, true_boxes(pair))
    np.testing.assert_allclose(said.ego_motion, np.eye(4), atol=5e-3)
    assert said.where.any()
    np.testing.assert_allclose(flow[said.where], 0.0, atol=0.01)


@EVERY
@pytest.mark.parametrize("points", [0, 1, 2, 3])
def test_an_object_with_hardly_a_point_has_a_motion(one, points):
    pair = make_pair([an_object(12, 0)], points=points)
    said, _ = answer(one, pair, true_boxes(pair))
    if said.motions is not None and points < 3:
        np.testing.assert_array_equal(said.motions[0], said.ego_motion)


@EVERY
def test_cars_without_a_world_have_motions(one):
    pair = street_pair([an_object(12, 3, step=1.0)], world=False)
    answer(one, pair, true_boxes(pair))


@FOLLOWING
def test_without_detections_there_are_no_motions_of_objects(one):
    pair, _ = corner_and_box()
    nothing = replace(true_boxes(pair), boxes=np.zeros((0, 7)), scores=np.zeros(0))
    flows = []
    for detections in (None, nothing, sure(pair, true_boxes(pair), 1.5)):
        said, flow = answer(one, pair, detections)
        assert said.motions.shape == (0, 4, 4)
        flows.append(flow)
    np.testing.assert_array_equal(flows[0], flows[1])
    np.testing.assert_array_equal(flows[0], flows[2])


@EVERY
@pytest.mark.parametrize("empty", [("scan0",), ("scan1",), ("scan0", "scan1")], ids="+".join)
def test_an_empty_scan_tells_of_no_motion(one, empty, driving):
    pair = without_points(driving, empty)
    said, _ = answer(one, pair, true_boxes(pair))
    if one.name not in TRUTH:
        np.testing.assert_array_equal(said.ego_motion, np.eye(4))


@EVERY
def test_a_row_of_pairs_that_lack_all_holds_no_value_that_is_no_number(one, driving):
    score = Score(Rules())
    for pair in (make_pair([an_object(12, 0)], points=0, background=()), without_points(driving, ("scan1",))):
        score.add(pair, [one.method(pair, true_boxes(pair))])
    (row,) = score.report().rows
    numbers = list(numbers_in(row))
    assert {"fg_epe", "by_points"} <= set(row)
    assert len(numbers) > len(row)
    assert np.isfinite(numbers).all()


def numbers_in(value):
    """All numbers of a row, those in its tables too."""
    if isinstance(value, dict | list | tuple):
        for part in value.values() if isinstance(value, dict) else value:
            yield from numbers_in(part)
    elif isinstance(value, int | float):
        yield value


def without_points(pair, empty):
    """The pair with empty scans."""
    none = np.zeros(0, dtype=np.int64)
    names = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface")
    nothing = replace(pair.scan0, **{name: getattr(pair.scan0, name)[none] for name in names})
    changes = dict.fromkeys(empty, nothing)
    if "scan0" in empty:
        changes |= {"flow0": pair.flow0[none], "flow_status0": pair.flow_status0[none]}
    return replace(pair, **changes)
