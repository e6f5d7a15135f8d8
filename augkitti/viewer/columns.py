"""Columns for a browser: integer arrays in, one deflated run of bytes and its table of contents out, and back.

Neighbouring points are alike: each column is stored as differences from row to row, zigzag coded so that small ones of
either sign have small numbers, byte plane by byte plane (all lowest bytes first), and the whole is deflated.
`static/decode.js` undoes this in the browser.
"""

import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.integer[Any]]

_WIDTHS = {"int32": 4, "int16": 2, "uint16": 2, "uint8": 1}
_LEVEL = 6  # 9 takes three times as long for one per cent


def encode_columns(columns: Mapping[str, Integers]) -> tuple[list[dict[str, Any]], bytes]:
    """Pack integer arrays (N,) or (N, C) of the types int32, int16, uint16 and uint8.

    Returns:
        The table of contents (for each column its name, type, rows and numbers a row), and the bytes.

    Raises:
        ValueError: an array of another type or shape.
    """
    contents, parts = [], []
    for name, values in columns.items():
        width = _WIDTHS.get(values.dtype.name)
        if width is None or values.ndim not in (1, 2):
            raise ValueError(f"{name}: {values.dtype} of {values.ndim} dimensions cannot be packed")
        rows = values if values.ndim == 2 else values[:, None]
        contents.append({"name": name, "type": values.dtype.name, "rows": len(rows), "each": rows.shape[1]})
        parts.append(_planes(rows, width))
    return contents, zlib.compress(b"".join(parts), _LEVEL)


def _planes(rows: Integers, width: int) -> bytes:
    """Differences from row to row, modulo the type's range, zigzag coded, in byte planes."""
    bits = 8 * width
    wide = rows.astype(np.int64)
    steps = np.diff(wide, axis=0, prepend=np.zeros((1, wide.shape[1]), np.int64))
    half = 1 << (bits - 1)
    steps = (steps + half) % (2 * half) - half
    coded = ((steps << 1) ^ (steps >> (bits - 1))) & (2 * half - 1)
    flat = np.ascontiguousarray(coded.T.reshape(-1)).astype(f"<u{width}")
    return flat.view(np.uint8).reshape(-1, width).T.tobytes()


def decode_columns(contents: Sequence[Mapping[str, Any]], packed: bytes) -> dict[str, Integers]:
    """What `encode_columns` packed, array by array; what `static/decode.js` does, in Python.

    Raises:
        ValueError: the bytes are not those of the table of contents.
    """
    try:
        body = zlib.decompress(packed)
    except zlib.error as err:
        raise ValueError(f"not deflated ({err})") from err
    columns: dict[str, Integers] = {}
    at = 0
    for entry in contents:
        width, rows, each = _WIDTHS[entry["type"]], int(entry["rows"]), int(entry["each"])
        size = width * rows * each
        planes = np.frombuffer(body, np.uint8, size, at).reshape(width, rows * each)
        coded = np.ascontiguousarray(planes.T).view(f"<u{width}").reshape(each, rows).astype(np.int64)
        steps = (coded >> 1) ^ -(coded & 1)
        values = np.cumsum(steps, axis=1).T.astype(entry["type"])  # wraps round as the differences did
        columns[entry["name"]] = values if each > 1 else values.reshape(-1)
        at += size
    if at != len(body):
        raise ValueError(f"{len(body) - at} bytes more than the table of contents names")
    return columns
