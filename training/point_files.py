"""Point clouds of any usual kind: a `.bin`, `.npy`, `.pcd` or `.ply` file in, points and reflectance out.

`.bin` is KITTI's (rows of x, y, z, reflectance in float32), raw or odometry. The PCD reader is our own, since open3d
weighs 450 MB: versions 0.5 to 0.7, ascii, binary and binary_compressed. `.ply` is read by trimesh.
"""

import io
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from augkitti.errors import InputError
from augkitti.frames import F32, Array
from augkitti.kitti import read_scan_rows, valid_rows
from augkitti.scan_pair import I64

_STRENGTHS = ("intensity", "reflectance", "reflectivity", "remission", "scalar_intensity", "i")
_AGAIN = "write it again, or convert it to .npy of (N, 3) or (N, 4)"
_MOST_POINTS = 20_000_000  # a header may claim anything


@dataclass(frozen=True, eq=False)
class Points:
    """A scan without labels: what can be measured, rows that are not finite or all zero left out."""

    xyz: F32  # (N, 3) metres, scanner frame: x forward, y left, z up
    reflectance: F32  # (N,) 0 to 1; zeros where the file has none
    row: I64  # (N,) row in the file, ascending


def read_points(path: Path) -> Points:
    """The points of a file, by its ending.

    Raises:
        InputError: unknown ending, missing, not readable, cut short, of another shape, or without a point.
    """
    readers: dict[str, Callable[[Path], Array]] = {
        ".bin": read_scan_rows,
        ".npy": _read_npy,
        ".pcd": _read_pcd,
        ".ply": _read_ply,
    }
    if path.suffix.lower() not in readers:
        raise InputError(path, f"no reader for `{path.suffix}`", f"give one of {', '.join(readers)}")
    if not path.is_file():
        raise InputError(path, "does not exist", "check the path")
    rows = readers[path.suffix.lower()](path)
    if rows.ndim != 2 or rows.shape[1] < 3:
        raise InputError(path, f"has shape {rows.shape}, not (N, 3) or (N, 4)", "rows are x, y, z[, reflectance]")
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is left out below
        rows = np.ascontiguousarray(rows[:, :4], dtype=np.float32)
    if rows.shape[1] == 3:
        rows = np.concatenate([rows, np.zeros((len(rows), 1), np.float32)], axis=1)
    kept = np.flatnonzero(valid_rows(rows) & rows[:, :3].any(axis=1))
    rows = rows[kept]
    if not len(rows):
        raise InputError(path, "holds no valid point", "give a scan with points that are finite and not all zero")
    return Points(rows[:, :3], _as_share(rows[:, 3]), kept)


def _as_share(strength: F32) -> F32:
    """Reflectance as 0 to 1: files of other programs have bytes (0 to 255)."""
    largest = float(strength.max())
    scale = 1.0 if largest <= 1.0 else 255.0 if largest <= 255.0 else largest
    return np.asarray(np.clip(strength / np.float32(scale), 0.0, 1.0), dtype=np.float32)


def _read_npy(path: Path) -> Array:
    try:
        rows = np.load(path, allow_pickle=False)
    except Exception as err:  # numpy lets the tokenizer read the header, and whatever that raises through
        raise InputError(path, f"not readable as .npy ({_line(err)})", _AGAIN) from err
    if not isinstance(rows, np.ndarray) or rows.dtype.kind not in "fiu":
        raise InputError(path, f"holds {getattr(rows, 'dtype', type(rows).__name__)}, not numbers", _AGAIN)
    return rows


def _read_ply(path: Path) -> Array:
    import trimesh

    try:
        content = path.read_bytes()
        loaded: Any = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
        xyz = np.asarray(loaded.vertices, dtype=np.float64)
        raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data")
        names = (raw.dtype.names or ()) if isinstance(raw, np.ndarray) else tuple(raw) if isinstance(raw, dict) else ()
        found = [raw[name] for name in names if name.lower() in _STRENGTHS]
        strength = np.asarray(found[0], dtype=np.float64).reshape(len(xyz), 1) if found else np.zeros((len(xyz), 0))
    except Exception as err:  # trimesh raises whatever its parsers meet
        raise InputError(path, f"not readable as .ply ({_line(err)})", _AGAIN) from err
    told = re.search(rb"^element[ \t]+vertex[ \t]+(\d+)", content[:65536], re.MULTILINE)
    if told and len(xyz) < int(told.group(1)):  # trimesh is content with fewer
        raise InputError(path, f"is cut short: {len(xyz)} of {int(told.group(1))} points", _AGAIN)
    return np.concatenate([xyz, strength], axis=1)


def _read_pcd(path: Path) -> Array:
    """x, y, z and the strength of the return, if any, of a PCD file."""
    try:
        content = path.read_bytes()
        table = _pcd_table(content)
    except (OSError, ValueError, KeyError, IndexError, MemoryError, OverflowError) as err:
        raise InputError(path, f"not readable as .pcd ({_line(err)})", _AGAIN) from err
    names = {name.lower(): name for name in table.dtype.names or ()}
    if not {"x", "y", "z"} <= set(names):
        raise InputError(path, f"has fields {', '.join(names)}, not x, y, z", _AGAIN)
    wanted = ["x", "y", "z", *[name for name in _STRENGTHS if name in names][:1]]
    columns = [np.asarray(table[names[name]], dtype=np.float64) for name in wanted]
    if any(column.ndim != 1 for column in columns):
        raise InputError(path, "has several numbers in a coordinate", _AGAIN)
    return np.stack(columns, axis=1)


def _pcd_table(content: bytes) -> Array:
    """The points as a structured array; ValueError where the file contradicts itself."""
    end = re.search(rb"^DATA[ \t]+(\w+)[^\n]*\n", content[:65536], re.MULTILINE)
    if not end:
        raise ValueError("no DATA line")
    header: dict[str, list[str]] = {}
    for line in content[: end.start()].decode("ascii", "replace").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            header[words[0].upper()] = words[1:]
    names, sizes, kinds = header["FIELDS"], [int(w) for w in header["SIZE"]], header["TYPE"]
    counts = [int(w) for w in header.get("COUNT", ["1"] * len(names))]
    points = int(header["POINTS"][0]) if "POINTS" in header else int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
    if not len(names) == len(sizes) == len(kinds) == len(counts) or not 0 <= points <= _MOST_POINTS:
        raise ValueError("FIELDS, SIZE, TYPE, COUNT and POINTS do not fit together")
    if any(kind not in "FIU" or size not in (1, 2, 4, 8) or not 0 < count < 4096 for kind, size, count in zip(
        kinds, sizes, counts, strict=True)):  # fmt: skip
        raise ValueError("a field of unknown type")
    types = [f"<{kind.lower()}{size}" for kind, size in zip(kinds, sizes, strict=True)]
    unique = [name if name not in names[:i] and name != "_" else f"_{i}" for i, name in enumerate(names)]
    dtype = np.dtype([(n, t) if c == 1 else (n, t, (c,)) for n, t, c in zip(unique, types, counts, strict=True)])
    body = content[end.end() :]
    how = end.group(1).lower()
    if how == b"ascii":
        with warnings.catch_warnings():  # of blank lines, and of no line at all
            warnings.simplefilter("ignore", UserWarning)
            flat = np.loadtxt(io.BytesIO(body), dtype=np.float64, ndmin=2, max_rows=points or 1)[:points]
        if flat.shape != (points, sum(counts)):
            raise ValueError(f"{len(flat)} of {points} points")
        table, at = np.zeros(points, dtype), 0
        for name, count in zip(unique, counts, strict=True):
            table[name] = flat[:, at] if count == 1 else flat[:, at : at + count]
            at += count
        return table
    if how == b"binary":
        if len(body) < points * dtype.itemsize:
            raise ValueError(f"{len(body) // dtype.itemsize} of {points} points")
        return np.frombuffer(body, dtype, count=points)
    if how != b"binary_compressed":
        raise ValueError(f"DATA {how.decode('ascii', 'replace')}")
    packed, whole = (int(n) for n in np.frombuffer(body[:8], "<u4", count=2))
    if whole != points * dtype.itemsize or len(body) < 8 + packed:
        raise ValueError("its compressed block is cut short")
    plain, table, at = _unpack_lzf(body[8 : 8 + packed], whole), np.zeros(points, dtype), 0
    for name, kind, count in zip(unique, types, counts, strict=True):  # field by field there
        size = points * count * np.dtype(kind).itemsize
        table[name] = np.frombuffer(plain[at : at + size], kind).reshape(table[name].shape)
        at += size
    return table


def _unpack_lzf(packed: bytes, size: int) -> bytes:
    """LZF: runs of plain bytes, and copies of what went before."""
    out, at = bytearray(), 0
    while at < len(packed):
        control = packed[at]
        at += 1
        if control < 32:
            out += packed[at : at + control + 1]
            at += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += packed[at]
            at += 1
        length += 2
        start = len(out) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        if start < 0 or len(out) > size:
            raise ValueError("its compressed block is damaged")
        source = out[start : start + length]
        out += (source * (length // len(source) + 1))[:length]  # a copy may reach into itself
    if len(out) != size:
        raise ValueError("its compressed block has another size")
    return bytes(out)


def _line(err: BaseException) -> str:
    return " ".join(str(err).split())[:200] or type(err).__name__
