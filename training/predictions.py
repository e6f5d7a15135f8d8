"""What a method says about pairs of scans in, one Parquet file out, and back: scoring needs no network then.

A row and a row group are one pair. Flow is kept for the points that the method has an estimate for.
"""

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from augkitti.errors import InputError
from augkitti.frames import F32, F64, Array
from augkitti.scan_pair import I32, Bool
from augkitti.shards import replace_whole

VERSION = 1
KEY = b"pointflownet"
_AGAIN = "predict again"


@dataclass(frozen=True, eq=False)
class Prediction:
    """What one method says about one pair. None: the method has no such thing, as against an empty array."""

    pair_id: str
    flows: Mapping[str, F32]  # by name of the way (`direct`, `dense`, `object`; a baseline has one): (N0, 3) metres
    where: Bool  # (N0,) points that it has an estimate for; elsewhere the values of `flows` mean nothing
    ego_motion: F64 | None = None  # (4, 4) T_velo1_velo0
    boxes: F64 | None = None  # (n, 7) of scan 0, velo0; all that may count for average precision, unsure ones too
    scores: F64 | None = None  # (n,) 0 to 1
    motions: F64 | None = None  # (n, 4, 4) from velo0 to velo1; None where boxes are found but not followed
    columns: I32 | None = None  # (C, 2) ix, iy of occupied voxel columns
    column_motions: F32 | None = None  # (C, 3) their rigid motion (t_x, t_y, theta) about the column's centre

    def __post_init__(self) -> None:
        points = len(self.where)
        for name, flow in self.flows.items():
            if flow.shape != (points, 3):
                raise ValueError(f"flow `{name}` is {flow.shape}, not ({points}, 3)")
        if (self.boxes is None) != (self.scores is None) or (self.motions is not None and self.boxes is None):
            raise ValueError("boxes come with scores, motions with boxes")
        if (self.columns is None) != (self.column_motions is None):
            raise ValueError("columns come with their motions")
        n = 0 if self.boxes is None else len(self.boxes)
        c = 0 if self.columns is None else len(self.columns)
        for name, values, shape in (
            ("ego_motion", self.ego_motion, (4, 4)),
            ("boxes", self.boxes, (n, 7)),
            ("scores", self.scores, (n,)),
            ("motions", self.motions, (n, 4, 4)),
            ("columns", self.columns, (c, 2)),
            ("column_motions", self.column_motions, (c, 3)),
        ):
            if values is not None and (values.shape != shape or not np.isfinite(values).all()):
                raise ValueError(f"{name} is {values.shape}, not {shape}, or not finite")


# name, type of the numbers, shape of a row
_PARTS: tuple[tuple[str, Any, tuple[int, ...]], ...] = (
    ("ego_motion", np.float64, (4, 4)),
    ("boxes", np.float64, (-1, 7)),
    ("scores", np.float64, (-1,)),
    ("motions", np.float64, (-1, 4, 4)),
    ("columns", np.int32, (-1, 2)),
    ("column_motions", np.float32, (-1, 3)),
)


def write_predictions(path: Path, predictions: Iterable[Prediction], about: Mapping[str, Any] | None = None) -> int:
    """Write predictions in their order, taken one by one; the file is there whole or not at all. Returns their number.

    Args:
        path: of the file.
        predictions: all with the same names of flows, no pair twice.
        about: JSON: checkpoint, settings, data; `Predictions.about` gives it back.

    Raises:
        ValueError: none, a pair twice, other names of flows, or a flow that is not finite where it should be.
        OSError: the disk refused.
    """
    seen: set[str] = set()
    rows = iter(predictions)
    first = next(rows, None)
    if first is None:
        raise ValueError(f"{path.name}: no predictions to write")
    schema = _schema(tuple(first.flows), about or {})

    def write(file: BinaryIO) -> None:
        floats = [f"flow.{name}.list.element" for name in first.flows] + ["column_motions.list.element"]
        options = {"use_dictionary": False, "compression": "zstd", "compression_level": 1, "write_statistics": False}
        encoding = dict.fromkeys(floats, "BYTE_STREAM_SPLIT")
        with pq.ParquetWriter(file, schema, column_encoding=encoding, **options) as writer:
            for one in _chain(first, rows):
                if one.pair_id in seen or tuple(one.flows) != tuple(first.flows):
                    raise ValueError(f"{path.name}: {one.pair_id} is there already, or has other flows than the first")
                seen.add(one.pair_id)
                writer.write_table(_table(one, schema))

    path.parent.mkdir(parents=True, exist_ok=True)
    replace_whole(path, write)
    return len(seen)


class Predictions:
    """A file of predictions, open; iterating gives them in order, `of(pair_id, points)` one by name.

    Raises:
        InputError: no such file, none of ours, of another version, damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.is_file():
            raise InputError(path, "does not exist", "make it with `pointflownet evaluate`")
        try:
            self._file = pq.ParquetFile(path)
        except (OSError, ValueError, pa.ArrowException) as err:
            raise InputError(path, f"is no predictions file ({_line(err)})", _AGAIN) from err
        try:
            content = json.loads((self._file.schema_arrow.metadata or {})[KEY])
            version, self.methods, self.about = content["version"], tuple(content["methods"]), content["about"]
            if version != VERSION:
                raise InputError(path, f"has version {version!r}", f"this program reads {VERSION}: {_AGAIN}")
            if not self._file.schema_arrow.equals(_schema(self.methods, {})):
                raise ValueError("other columns")
            names = self._file.read(columns=["pair_id"]).column(0).to_pylist()
            if len(set(names)) < len(names):
                raise ValueError("a pair twice")
        except InputError:
            self._file.close()
            raise
        except (KeyError, TypeError, ValueError, OSError, pa.ArrowException) as err:
            self._file.close()
            raise InputError(path, f"is no predictions file ({_line(err)})", _AGAIN) from err
        self._row = {name: row for row, name in enumerate(names)}

    def __len__(self) -> int:
        return len(self._row)

    def __iter__(self) -> Iterator[Prediction]:
        for row in self._row.values():
            yield self._read(row)

    def of(self, pair_id: str, points: int | None = None) -> Prediction:
        """The prediction of a pair.

        Raises:
            InputError: it has none, or for another number of points: the file is of another data set.
        """
        if pair_id not in self._row:
            raise InputError(self.path, f"holds no pair `{pair_id}`", "predict for this data set and split")
        found = self._read(self._row[pair_id])
        if points is not None and len(found.where) != points:
            raise InputError(
                self.path,
                f"has {len(found.where)} points for pair `{pair_id}`, the data set {points}",
                "predict for this data set and split",
            )
        return found

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def __enter__(self) -> "Predictions":
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    def _read(self, row: int) -> Prediction:
        try:
            table = self._file.read_row_group(row, use_threads=False)
            return _prediction(table, self.methods)
        except (OSError, pa.ArrowException, ValueError, TypeError) as err:
            raise InputError(self.path, f"row {row} is damaged ({_line(err)})", _AGAIN) from err


def read_predictions(path: Path) -> Iterator[Prediction]:
    """The predictions of a file in order; errors as `Predictions`."""
    with Predictions(path) as file:
        yield from file


def _schema(methods: tuple[str, ...], about: Mapping[str, Any]) -> pa.Schema:
    fields = [
        pa.field("pair_id", pa.string(), nullable=False),
        pa.field("points", pa.int32(), nullable=False),
        pa.field("where", pa.binary(), nullable=False),  # a bit a point
        *(pa.field(f"flow.{name}", pa.list_(pa.float32()), nullable=False) for name in methods),
        *(pa.field(name, pa.list_(pa.from_numpy_dtype(kind))) for name, kind, _ in _PARTS),
    ]
    content = {"version": VERSION, "methods": list(methods), "about": dict(about)}
    return pa.schema(fields, metadata={KEY: json.dumps(content, sort_keys=True).encode()})


def _table(one: Prediction, schema: pa.Schema) -> pa.Table:
    columns = [
        pa.array([one.pair_id], pa.string()),
        pa.array([len(one.where)], pa.int32()),
        pa.array([np.packbits(one.where).tobytes()], pa.binary()),
    ]
    for name, flow in one.flows.items():
        kept = np.ascontiguousarray(flow[one.where], dtype=np.float32)
        if not np.isfinite(kept).all():
            raise ValueError(f"flow `{name}` of pair {one.pair_id} is not finite")
        columns.append(_list(kept))
    for name, kind, _ in _PARTS:
        values = getattr(one, name)
        columns.append(
            pa.array([None], pa.list_(pa.from_numpy_dtype(kind))) if values is None else _list(values.astype(kind))
        )
    return pa.table(columns, schema=schema)


def _list(values: Array) -> pa.Array:
    flat = np.ascontiguousarray(values).reshape(-1)
    return pa.ListArray.from_arrays(pa.array([0, len(flat)], pa.int32()), pa.array(flat))


def _prediction(table: pa.Table, methods: tuple[str, ...]) -> Prediction:
    if table.num_rows != 1:
        raise ValueError(f"{table.num_rows} rows in a row group")
    points = table.column("points")[0].as_py()
    bits: npt.NDArray[np.uint8] = np.frombuffer(table.column("where")[0].as_py(), np.uint8)
    where = np.unpackbits(bits, count=points).astype(bool)
    flows = {}
    for name in methods:
        flows[name] = np.zeros((points, 3), np.float32)
        flows[name][where] = _numbers(table, f"flow.{name}", np.float32, (-1, 3))
    parts = {name: _numbers(table, name, kind, shape) for name, kind, shape in _PARTS}
    return Prediction(table.column("pair_id")[0].as_py(), flows, where, **parts)


def _numbers(table: pa.Table, name: str, kind: Any, shape: tuple[int, ...]) -> Any:
    item = table.column(name)[0]
    return None if not item.is_valid else item.values.to_numpy().astype(kind, copy=False).reshape(shape)


def _chain(first: Prediction, rest: Iterator[Prediction]) -> Iterator[Prediction]:
    yield first
    yield from rest


def _line(err: BaseException) -> str:
    return " ".join(str(err).split())[:200]
