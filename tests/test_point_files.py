"""Point clouds of any usual kind, read alike; and files that are none, told in one line."""

import io
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from augkitti.errors import InputError
from training.point_files import _unpack_lzf, read_points

XYZ = np.array([[1.5, -2.25, 0.5], [30.0, 4.0, -1.7], [7.0, 0.125, 2.0]], np.float32)
STRENGTH = np.array([0.0, 0.25, 1.0], np.float32)
ROWS = np.column_stack([XYZ, STRENGTH])


def pcd(how, body, fields="x y z intensity", size="4 4 4 4", kind="F F F F", count="1 1 1 1", points=3, extra=""):
    head = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {size}\nTYPE {kind}\nCOUNT {count}\nWIDTH {points}\n"
    return f"{head}HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\n{extra}POINTS {points}\nDATA {how}\n".encode() + body


def ply(how, body, points=3, strength="intensity", kind="float"):
    names = "".join(f"property {kind} {name}\n" for name in ("x", "y", "z", *([strength] if strength else [])))
    return f"ply\nformat {how} 1.0\nelement vertex {points}\n{names}end_header\n".encode() + body


def npy(rows):
    file = io.BytesIO()
    np.save(file, rows)
    return file.getvalue()


def literal_lzf(plain):
    return b"".join(bytes([len(part) - 1]) + part for part in (plain[i : i + 32] for i in range(0, len(plain), 32)))


def lines(rows):
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows).encode()


BY_FIELD = ROWS.T.tobytes()
PACKED = literal_lzf(BY_FIELD)
GOOD = {
    "kitti.bin": ROWS.tobytes(),
    "four.npy": npy(ROWS),
    "double.npy": npy(ROWS.astype(np.float64)),
    "five.npy": npy(np.column_stack([ROWS, np.arange(3)])),
    "ascii.pcd": pcd("ascii", lines(ROWS)),
    "binary.pcd": pcd("binary", ROWS.tobytes()),
    "double.pcd": pcd("binary", ROWS.astype("<f8").tobytes(), size="8 8 8 8", kind="F F F F"),
    "compressed.pcd": pcd("binary_compressed", struct.pack("<II", len(PACKED), len(BY_FIELD)) + PACKED),
    "UPPER.PCD": pcd("binary", ROWS.tobytes()),
    "ascii.ply": ply("ascii", lines(ROWS)),
    "binary.ply": ply("binary_little_endian", ROWS.tobytes()),
    "big.ply": ply("binary_big_endian", ROWS.astype(">f4").tobytes()),
    "double.ply": ply("binary_little_endian", ROWS.astype("<f8").tobytes(), kind="double"),
    "reflectance.ply": ply("ascii", lines(ROWS), strength="reflectance"),
}


def written(tmp_path, name, content):
    path = tmp_path / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("name", GOOD)
def test_every_kind_of_file_gives_the_same_points(tmp_path, name):
    found = read_points(written(tmp_path, name, GOOD[name]))
    np.testing.assert_array_equal(found.xyz, XYZ)
    np.testing.assert_array_equal(found.reflectance, STRENGTH)
    assert found.xyz.dtype == found.reflectance.dtype == np.float32
    assert found.row.tolist() == [0, 1, 2]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("three.npy", npy(XYZ)),
        ("three.pcd", pcd("binary", XYZ.tobytes(), "x y z", "4 4 4", "F F F", "1 1 1")),
        ("three.ply", ply("binary_little_endian", XYZ.tobytes(), strength=None)),
    ],
)
def test_without_strengths_reflectance_is_zero(tmp_path, name, content):
    found = read_points(written(tmp_path, name, content))
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert not found.reflectance.any()


def test_other_fields_in_any_order_are_passed_over(tmp_path):
    kinds = np.dtype(
        [("ring", "<u2"), ("z", "<f4"), ("normal", "<f4", 3), ("y", "<f4"), ("intensity", "u1"), ("x", "<f4")]
    )
    table = np.zeros(3, kinds)
    for k, name in enumerate("xyz"):
        table[name] = XYZ[:, k]
    table["intensity"] = [0, 51, 255]
    content = pcd("binary", table.tobytes(), "ring z normal y intensity x", "2 4 4 4 1 4", "U F F F U F", "1 1 3 1 1 1")
    found = read_points(written(tmp_path, "a.pcd", content))
    np.testing.assert_array_equal(found.xyz, XYZ)
    np.testing.assert_allclose(found.reflectance, [0.0, 0.2, 1.0])


def test_rows_that_are_no_measurement_are_left_out_and_the_others_known_by_row(tmp_path):
    rows = np.concatenate([[[0, 0, 0, 0], [np.nan, 1, 1, 0]], ROWS[:2], [[np.inf, 1, 1, 0]], ROWS[2:]]).astype("f4")
    found = read_points(written(tmp_path, "a.bin", rows.tobytes()))
    np.testing.assert_array_equal(found.xyz, XYZ)
    assert found.row.tolist() == [2, 3, 5]


@pytest.mark.parametrize("ending", [".pcd", ".ply"])
@pytest.mark.parametrize("way", [{}, {"write_ascii": True}, {"compressed": True}])
def test_files_that_open3d_writes_are_read(tmp_path, ending, way):
    o3d = pytest.importorskip("open3d")
    if ending == ".ply" and "compressed" in way:
        pytest.skip("there is no compressed .ply")
    rng = np.random.default_rng(0)
    xyz = rng.normal(0, 10, (500, 3)).round(2).astype(np.float32)  # round: repeated bytes for the compressor
    strength = rng.random(500).round(1).astype(np.float32)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(xyz))
    cloud.point["intensity"] = o3d.core.Tensor(strength[:, None])
    path = tmp_path / f"a{ending}"
    assert o3d.t.io.write_point_cloud(str(path), cloud, **way)
    found = read_points(path)
    np.testing.assert_allclose(found.xyz, xyz, atol=1e-5)
    np.testing.assert_allclose(found.reflectance, strength, atol=1e-5)


BAD = {
    "a.bin": ROWS.tobytes()[:-3],
    "none.bin": b"",
    "zero.bin": np.zeros((5, 4), "f4").tobytes(),
    "a.npy": npy(ROWS)[:-8],
    "text.npy": b"hello",
    "flat.npy": npy(np.zeros(12)),
    "two.npy": npy(np.ones((4, 2))),
    "words.npy": npy(np.array([["a", "b", "c"]])),
    "object.npy": npy(ROWS)[:10] + b"\x00" * 60,
    "text.pcd": b"hello",
    "cut.pcd": pcd("binary", ROWS.tobytes()[:-1]),
    "short.pcd": pcd("ascii", lines(ROWS[:2])),
    "words.pcd": pcd("ascii", b"a b c d\n"),
    "fields.pcd": pcd("binary", ROWS.tobytes(), "a b c d"),
    "kind.pcd": pcd("binary", ROWS.tobytes(), kind="F F F Q"),
    "many.pcd": pcd("binary", ROWS.tobytes(), points=10**12),
    "huge.pcd": pcd("binary", ROWS.tobytes(), count="1 1 1 99999"),
    "how.pcd": pcd("zip", ROWS.tobytes()),
    "lzf.pcd": pcd("binary_compressed", struct.pack("<II", 3, len(BY_FIELD)) + b"\xff\xff\xff"),
    "cutlzf.pcd": pcd("binary_compressed", struct.pack("<II", len(PACKED), len(BY_FIELD)) + PACKED[:20]),
    "head.pcd": pcd("binary_compressed", b"\x01"),
    "text.ply": b"hello",
    "cut.ply": ply("binary_little_endian", ROWS.tobytes()[:-1]),
    "short.ply": ply("ascii", lines(ROWS[:2])),
    "none.ply": ply("ascii", b"", points=0),
    "a.las": b"",
}


@pytest.mark.parametrize("name", BAD)
def test_broken_files_are_told_in_one_line(tmp_path, name):
    path = written(tmp_path, name, BAD[name])
    with pytest.raises(InputError) as caught:
        read_points(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith(str(path))


def test_missing_files_and_folders_are_told(tmp_path):
    (tmp_path / "folder.ply").mkdir()
    for name in ("missing.bin", "missing.ply", "folder.ply"):
        with pytest.raises(InputError, match="does not exist"):
            read_points(tmp_path / name)


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(GOOD)), st.integers(0, 10**6), st.integers(0, 255), st.integers(0, 10**6))
def test_a_damaged_byte_or_a_cut_gives_points_or_one_line(tmp_path_factory, name, at, value, cut):
    content = bytearray(GOOD[name])
    content[at % len(content)] = value
    del content[cut % (2 * len(content)) :]
    path = tmp_path_factory.mktemp("damaged") / name
    path.write_bytes(content)
    try:
        found = read_points(path)
    except InputError:
        return
    assert np.isfinite(found.xyz).all()
    assert ((found.reflectance >= 0) & (found.reflectance <= 1)).all()


@given(st.binary(min_size=1, max_size=200))
def test_plain_runs_unpack_to_themselves(plain):
    assert _unpack_lzf(literal_lzf(plain), len(plain)) == plain


def test_copies_unpack_even_where_they_reach_into_themselves():
    assert _unpack_lzf(b"\x01ab" + bytes([(4 << 5) | 0, 1]), 8) == b"abababab"
    assert _unpack_lzf(b"\x00a" + bytes([7 << 5, 10, 0]), 20) == b"a" * 20
    for packed in (b"\x00a" + bytes([1 << 5, 5]), b"\x05ab"):
        with pytest.raises(ValueError, match="compressed block"):
            _unpack_lzf(packed, 8)
