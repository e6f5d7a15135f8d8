"""Truncated distance fields and the patches cut out of them."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import distance_transform_edt

from training.baselines.tdf import FieldConfig, distance_field, in_reach, patches

CONFIG = FieldConfig(voxel_m=0.25, patch=6, truncation=4, reach_m=4.0, low_m=-2.0, high_m=2.0)
seeds = st.integers(0, 2**32)


def points(seed, count=60):
    return np.random.default_rng(seed).uniform([-6, -6, -3], [6, 6, 3], (count, 3))


@given(seeds, st.integers(1, 200))
@settings(max_examples=20, deadline=None)
def test_the_field_is_that_of_scipys_distance_transform(seed, count):
    field = distance_field(points(seed, count), CONFIG)
    occupied = field.value == 1.0
    if occupied.any():
        off = distance_transform_edt(~occupied)
        np.testing.assert_allclose(field.value, np.maximum(1.0 - off / CONFIG.truncation, 0.0), atol=1e-6)


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_the_voxel_of_every_point_in_reach_is_on_a_surface(seed):
    xyz = points(seed)
    xyz = xyz[in_reach(xyz, CONFIG)]
    field = distance_field(xyz, CONFIG)
    at = np.floor((xyz - field.origin_m) / field.voxel_m).astype(int)
    np.testing.assert_array_equal(field.value[tuple(at.T)], 1.0)


def test_a_field_without_points_is_empty():
    assert not distance_field(np.zeros((0, 3)), CONFIG).value.any()


@given(seeds, st.sampled_from([5, 6]))
@settings(max_examples=20, deadline=None)
def test_a_patch_is_the_field_about_its_place(seed, side):
    xyz = points(seed)
    xyz = xyz[in_reach(xyz, CONFIG)]
    field = distance_field(xyz, CONFIG)
    cut = patches(field, xyz, side)
    assert cut.shape == (len(xyz), side, side, side)
    for patch, place in zip(cut, xyz, strict=True):
        middle = (place - field.origin_m) / field.voxel_m
        corner = np.round(middle - side / 2.0 + 1e-9).astype(int)
        a, b, c = (slice(start, start + side) for start in corner)
        np.testing.assert_array_equal(patch, field.value[a, b, c])


def test_patches_move_with_the_points():
    xyz = points(0, 30)
    xyz = xyz[(np.abs(xyz) < [3.0, 3.0, 1.0]).all(axis=1)]
    shift = np.array([2.0, -1.0, 1.0]) * CONFIG.voxel_m
    here = patches(distance_field(xyz, CONFIG), xyz, 6)
    there = patches(distance_field(xyz + shift, CONFIG), xyz + shift, 6)
    np.testing.assert_array_equal(here, there)
