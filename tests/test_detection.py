"""Anchors, matching, residuals and suppression: by hand, by brute force, and as round trips."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from training.boxes import rotated_iou_bev
from training.config import DetectionConfig, GridConfig, Settings
from training.detection import LEFT_OUT, NEGATIVE, POSITIVE, anchors, decode, encode, match, nms

GRID = GridConfig(x_m=(0.0, 16.0), y_m=(-8.0, 8.0), z_m=(-3.0, 1.0), voxel_m=(0.4, 0.4, 0.5))
TINY = Settings(grid=GRID)
NONE = np.zeros((0, 7))
boxes_near = st.builds(
    lambda x, y, length, width, yaw: np.array([x, y, -1.0, length, width, 1.6, yaw]),
    st.floats(-2.0, 18.0),
    st.floats(-10.0, 10.0),
    st.floats(2.5, 6.0),
    st.floats(1.2, 2.4),
    st.floats(-3.2, 3.2),
)


def car(x: float, y: float, yaw: float = 0.0, length: float = 3.9, width: float = 1.6) -> np.ndarray:
    return np.array([x, y, -1.0, length, width, 1.56, yaw])


def cell_of(x: float, y: float) -> tuple[int, int]:
    """The cell at half resolution, 0.8 m to a side."""
    return int((x - 0.0) // 0.8), int((y + 8.0) // 0.8)


def test_anchors_stand_along_and_across_in_the_middle_of_each_cell_of_half_resolution():
    at = anchors(TINY)
    assert at.shape == (2, 20, 20, 7)
    np.testing.assert_allclose(at[0, 0, 0], [0.4, -7.6, -1.0, 3.9, 1.6, 1.56, 0.0])
    np.testing.assert_allclose(at[1, 19, 3], [15.6, -5.2, -1.0, 3.9, 1.6, 1.56, np.pi / 2])
    with pytest.raises(ValueError, match="read-only"):
        at[0] = 0.0


@given(boxes_near, st.integers(0, 799))
@settings(max_examples=60, deadline=None)
def test_decoding_undoes_encoding_up_to_half_a_turn(box, number):
    at = anchors(TINY).reshape(-1, 7)[number]
    back = decode(encode(box, at), at)
    np.testing.assert_allclose(back[:6], box[:6], atol=1e-9)
    assert np.sin(back[6] - box[6]) == pytest.approx(0.0, abs=1e-9)
    assert -np.pi < back[6] <= np.pi


def test_residuals_are_voxelnets():
    diagonal = np.hypot(3.9, 1.6)
    box = np.array([9.0, 1.0, -0.5, 4.2, 1.8, 1.5, 0.3])
    expected = [1.0 / diagonal, -1.0 / diagonal, 0.5 / 1.56, *np.log([4.2 / 3.9, 1.8 / 1.6, 1.5 / 1.56]), 0.3]
    np.testing.assert_allclose(encode(box, car(8.0, 2.0)), expected)
    turned = encode(np.array([*box[:6], 0.3 + np.pi]), car(8.0, 2.0))
    np.testing.assert_allclose(turned, expected)  # front and rear are one


def test_a_wild_size_is_decoded_to_something_finite():
    at = car(8.0, 0.0)
    big = decode(np.array([0, 0, 0, 900.0, -900.0, 0, 0]), at)
    np.testing.assert_allclose(big[3:5], [3.9 * np.exp(2), 1.6 * np.exp(-2)])


def by_definition(boxes: np.ndarray, config: DetectionConfig) -> np.ndarray:
    """Labels of all anchors from all overlaps: the paper's sentence word by word."""
    at = anchors(TINY)
    labels = np.full(at.shape[:3], NEGATIVE)
    if not len(boxes):
        return labels
    iou = rotated_iou_bev(at.reshape(-1, 7), boxes).reshape(*at.shape[:3], len(boxes))
    inside = (boxes[:, 0] >= 0) & (boxes[:, 0] < 16) & (boxes[:, 1] >= -8) & (boxes[:, 1] < 8)
    iou[..., ~inside] = 0.0
    labels[(iou >= config.negative_iou).any(-1)] = LEFT_OUT
    labels[(iou > config.positive_iou).any(-1)] = POSITIVE
    for number in np.flatnonzero(inside):
        if iou[..., number].max() > 0:
            labels[np.unravel_index(iou[..., number].argmax(), labels.shape)] = POSITIVE
    return labels


@given(st.lists(boxes_near, min_size=0, max_size=3))
@settings(max_examples=40, deadline=None)
def test_labels_are_those_of_all_overlaps(boxes):
    boxes = np.array(boxes).reshape(-1, 7)
    labels, residuals = match(boxes, NONE, TINY)
    expected = by_definition(boxes, TINY.detection)
    # of two anchors that overlap a box alike to the last bit either may be the best
    assert (labels != expected).sum() <= 2 * len(boxes)
    assert ((labels == POSITIVE).sum() > 0) == ((expected == POSITIVE).sum() > 0)
    assert not residuals[np.broadcast_to((labels != POSITIVE)[:, None], residuals.shape)].any()
    assert residuals.dtype == np.float32


@pytest.mark.parametrize("config", [{"positive_iou": 0.35, "negative_iou": 0.2}, {}])
def test_a_positive_anchors_residuals_lead_to_its_box(config):
    boxes = np.array([car(4.1, -3.2, 0.1), car(9.0, 3.0, 1.5), car(12.0, -6.0, 0.8)])
    tiny = Settings(grid=GRID, detection=DetectionConfig(**config))
    labels, residuals = match(boxes, NONE, tiny)
    positive = labels == POSITIVE
    found = decode(np.moveaxis(residuals, 1, -1)[positive], anchors(tiny)[positive])
    nearest = rotated_iou_bev(found, boxes).argmax(1)
    assert set(nearest) == {0, 1, 2}  # also the one that no anchor fits: its best is positive
    np.testing.assert_allclose(found[:, :6], boxes[nearest, :6], atol=1e-5)


def test_an_anchor_on_a_car_is_positive_beside_it_left_out_and_elsewhere_negative():
    labels, _ = match(np.array([car(8.4, 0.4)]), NONE, TINY)
    x, y = cell_of(8.4, 0.4)
    assert labels[0, x, y] == POSITIVE
    assert labels[1, x, y] == NEGATIVE  # across: overlap 0.26
    assert labels[0, x + 1, y] == POSITIVE  # 0.8 m along: 3.1 / 4.7 = 0.66
    assert labels[0, x + 2, y] == NEGATIVE  # 1.6 m along: 2.3 / 5.5 = 0.42
    assert labels[0, x, y + 1] == NEGATIVE  # 0.8 m aside: half of it, 1 / 3
    assert (labels == POSITIVE).sum() == 3
    between, _ = match(np.array([car(8.96, 0.4)]), NONE, TINY)
    assert between[0, x - 1, y] == LEFT_OUT  # 1.36 m along: 2.54 / 5.26 = 0.48


def test_a_cars_best_anchor_is_positive_however_little_it_overlaps():
    labels, _ = match(np.array([car(8.0, 0.0, np.pi / 4)]), NONE, TINY)
    assert (labels == POSITIVE).sum() == 1
    tiny_car = car(8.4, 0.4, 0.0, 0.5, 0.3)
    assert (match(tiny_car[None], NONE, TINY)[0] == POSITIVE).sum() == 1


def test_a_car_whose_centre_is_outside_the_grid_has_no_anchor():
    labels, _ = match(np.array([car(-0.5, 0.4), car(8.0, -40.0)]), NONE, TINY)
    assert not (labels == POSITIVE).any()
    assert labels[0, *cell_of(0.4, 0.4)] == LEFT_OUT  # on the car
    assert labels[1, *cell_of(0.4, 0.4)] == NEGATIVE  # across it
    assert (labels[:, *cell_of(4.4, 0.4)] == NEGATIVE).all()


def test_anchors_on_a_neutral_box_are_left_out_but_not_those_of_a_car_beside_it():
    labels, _ = match(np.array([car(8.4, 0.4)]), np.array([car(8.4, 2.0, 0, 5.0, 2.0)]), TINY)
    assert labels[0, *cell_of(8.4, 0.4)] == POSITIVE
    assert (labels[:, *cell_of(8.4, 2.0)] == LEFT_OUT).all()
    assert (labels[:, *cell_of(10.8, 2.0)] == LEFT_OUT).all()  # its centre is in the box
    assert (labels[:, *cell_of(8.4, 6.0)] == NEGATIVE).all()


def test_anchors_that_are_not_judged_are_left_out_unless_positive():
    labels, _ = match(np.array([car(8.4, 0.4), car(8.4, -5.2)]), NONE, TINY, judged=lambda xy: xy[..., 1] > -2.0)
    assert labels[0, *cell_of(8.4, -5.2)] == POSITIVE
    assert labels[0, *cell_of(8.4, 0.4)] == POSITIVE
    assert (labels[:, *cell_of(3.0, -5.2)] == LEFT_OUT).all()
    assert (labels[:, *cell_of(3.0, 5.2)] == NEGATIVE).all()


def test_of_two_cars_an_anchor_is_for_the_one_that_it_overlaps_more():
    boxes = np.array([car(8.0, 0.4), car(9.2, 0.4)])  # they overlap, as only wrong labels do
    labels, residuals = match(boxes, NONE, TINY)
    positive = labels == POSITIVE
    found = decode(np.moveaxis(residuals, 1, -1)[positive], anchors(TINY)[positive])
    best = rotated_iou_bev(anchors(TINY)[positive], boxes).argmax(1)
    np.testing.assert_allclose(found[:, 0], boxes[best, 0], atol=1e-5)


def test_suppression_keeps_the_surest_of_boxes_that_overlap():
    boxes = np.array([car(8.0, 0.0), car(8.3, 0.1), car(8.0, 4.0), car(8.1, 0.0, 0.1)])
    scores = np.array([0.7, 0.9, 0.6, 0.8])
    assert nms(boxes, scores, TINY).tolist() == [1, 2]


def test_a_suppressed_box_suppresses_none_itself():
    boxes = np.array([car(6.0, 0.0), car(7.6, 0.0), car(9.2, 0.0)])  # neighbours overlap by 0.42, the ends by 0.10
    assert nms(boxes, np.array([0.9, 0.8, 0.7]), TINY).tolist() == [0, 2]


def test_suppression_drops_what_is_unsure_or_not_finite_and_keeps_ties_in_their_order():
    boxes = np.array([car(2.0, -6.0), car(2.0, 6.0), car(12.0, 0.0), car(7.0, 0.0)])
    boxes[2, 0] = np.inf
    assert nms(boxes, np.array([0.5, 0.5, 0.9, 0.49]), TINY).tolist() == [0, 1]
    assert nms(NONE, np.zeros(0), TINY).tolist() == []


def test_suppression_keeps_no_more_than_asked_for():
    few = Settings(grid=GRID, detection=DetectionConfig(most=2))
    boxes = np.array([car(2.0, y) for y in (-6.0, -2.0, 2.0, 6.0)])
    assert nms(boxes, np.array([0.6, 0.9, 0.7, 0.8]), few).tolist() == [1, 3]


@given(st.integers(0, 2**31))
@settings(max_examples=20, deadline=None)
def test_suppression_leaves_no_overlap_and_drops_nothing_without_a_reason(seed):
    rng = np.random.default_rng(seed)
    boxes = np.array([car(*rng.uniform([0, -8], [16, 8]), rng.uniform(-3, 3)) for _ in range(30)])
    scores = rng.uniform(0.5, 1.0, 30)
    kept = nms(boxes, scores, TINY)
    assert (np.diff(scores[kept]) <= 0).all()
    iou = rotated_iou_bev(boxes, boxes)
    assert (iou[np.ix_(kept, kept)] - np.eye(len(kept)) <= 0.3 + 1e-9).all()
    for number in np.setdiff1d(np.arange(30), kept):
        assert ((iou[number, kept] > 0.3) & (scores[kept] >= scores[number])).any()
