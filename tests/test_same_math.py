"""Elementary functions of our own: right to the last places, and the same for numbers and arrays on any processor."""

import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from augkitti import same_math as sm
from augkitti.frames import is_rigid, orthonormal, rigid, se3_exp

angle = st.floats(-1e4, 1e4)
length = st.floats(-1e6, 1e6).map(lambda v: 0.0 if abs(v) < 1e-200 else v)


def ulps(got, exact):
    return np.max(np.abs(got - exact) / np.spacing(np.abs(exact).astype(np.float64)))


def test_values_are_right_to_three_units_in_the_last_place():
    rng = np.random.default_rng(0)
    a, b, u = rng.uniform(-100.0, 100.0, (3, 50_001))
    u /= 100.0
    wide = (a.astype(np.longdouble), b.astype(np.longdouble), u.astype(np.longdouble))
    assert ulps(sm.sin(a), np.sin(wide[0])) < 3
    assert ulps(sm.cos(a), np.cos(wide[0])) < 3
    assert ulps(sm.tan(u), np.tan(wide[2])) < 3
    assert ulps(sm.arctan2(a, b), np.arctan2(wide[0], wide[1])) < 3
    assert ulps(sm.arcsin(u), np.arcsin(wide[2])) < 3
    assert ulps(sm.exp(a), np.exp(wide[0])) < 3
    assert ulps(sm.log(np.abs(a)), np.log(np.abs(wide[0]))) < 3


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(angle, length, length), min_size=1, max_size=9))
def test_a_number_alone_and_in_an_array_give_the_same_bits(rows):
    turn, y, x = (np.array(column) for column in zip(*rows, strict=True))
    assert sm.sin(turn).tolist() == [sm.sin(value) for value in turn.tolist()]
    assert sm.cos(turn).tolist() == [sm.cos(value) for value in turn.tolist()]
    assert sm.arctan2(y, x).tolist() == [sm.arctan2(*values) for values in zip(y.tolist(), x.tolist(), strict=True)]


@pytest.mark.parametrize(("y", "x"), [(0.0, 0.0), (0.0, -1.0), (-0.0, -1.0), (1.0, 0.0), (-1.0, 0.0), (2.0, 2.0)])
def test_angles_on_the_axes_are_numpys(y, x):
    assert sm.arctan2(y, x) == sm.arctan2(np.array([y]), np.array([x]))[0] == np.arctan2(y, x)


def test_the_nearest_rotation_and_the_blurred_map_are_the_libraries_ones():
    T = se3_exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 1.1]))
    off = T[:3, :3] + np.random.default_rng(1).normal(0.0, 1e-4, (3, 3))
    u, _, vt = np.linalg.svd(off)
    np.testing.assert_allclose(orthonormal(rigid(off, T[:3, 3]))[:3, :3], u @ vt, atol=1e-14)
    assert is_rigid(orthonormal(rigid(off, T[:3, 3])), 1e-14)
    grid = np.random.default_rng(2).normal(size=(40, 30))
    np.testing.assert_allclose(sm.gaussian_filter(grid, 1.7), ndimage.gaussian_filter(grid, 1.7), atol=1e-13)
    np.testing.assert_allclose(sm.product(off, T[:3, 3]), off @ T[:3, 3], atol=1e-14)


DIGEST = """
import hashlib, numpy as np
from augkitti import same_math as sm
a, b = np.random.default_rng(0).uniform(-100.0, 100.0, (2, 20_000))
found = [sm.sin(a), sm.cos(a), sm.tan(a), sm.arctan2(a, b), sm.arcsin(a / 100.0), sm.exp(a), sm.log(np.abs(a)),
         sm.power(np.abs(a), 2.5), sm.hypot(a, b), sm.product(a.reshape(-1, 4), b[:16].reshape(4, 4))]
theirs = np.arctan2(a, b)
print(hashlib.sha256(b"".join(x.tobytes() for x in found)).hexdigest(), hashlib.sha256(theirs.tobytes()).hexdigest())
"""


def test_no_bit_depends_on_what_numpy_blas_and_the_c_library_find_in_the_processor():
    import numpy._core._multiarray_umath as built

    without = {
        "NPY_DISABLE_CPU_FEATURES": " ".join(name for name in built.__cpu_dispatch__ if built.__cpu_features__[name]),
        "OPENBLAS_CORETYPE": "Nehalem",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-FMA4,-AVX512F",
    }
    ran = [
        subprocess.run(
            [sys.executable, "-c", DIGEST], env={**os.environ, **more}, capture_output=True, text=True, check=True
        ).stdout.split()
        for more in ({}, without)
    ]
    assert ran[0][0] == ran[1][0]
    if ran[0][1] == ran[1][1]:
        pytest.skip("numpy's own arctangent has the same bits with and without: this processor shows nothing")
