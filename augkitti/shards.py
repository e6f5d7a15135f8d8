"""Shards: finished pairs in, one Parquet file out, and back; `SCHEMA` is the one statement of the columns.

A row is a pair and a row group is a row, so any pair is one seek away. `python -m augkitti.shards` prints the schema's
page of the documentation.
"""

import errno
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO
from uuid import uuid4

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from augkitti import __version__
from augkitti.config import Config
from augkitti.errors import InputError
from augkitti.remote import as_path, is_remote, open_anywhere, put_whole
from augkitti.scan_pair import AugmentedPair, AugmentedScan, CarModel, ObjectRecord
from augkitti.scanner import ScannerProfile

CONTRACT_VERSION = 1  # a change of meaning raises it; readers refuse a version that they do not know
METADATA_KEY = b"augkitti"


def _column(name: str, type_: pa.DataType, meaning: str, null: bool = False) -> pa.Field:
    return pa.field(name, type_, nullable=null, metadata={"meaning": meaning})


_MATRIX = pa.list_(pa.float64())
_BOX = pa.list_(pa.float64())

OBJECT = pa.struct(
    [
        _column("id", pa.string(), "a labelled object keeps it in neighbouring pairs"),
        _column("category", pa.string(), "KITTI's: `Car`, `Van`, `Truck`, `Pedestrian`, ... (a bus is a `Truck`)"),
        _column("origin", pa.string(), "`virtual`, or `labelled` (from the drive's own labels)"),
        _column("model", pa.string(), "CAD model of a virtual car", null=True),
        _column(
            "box0", _BOX, "7 numbers: centre x, y, z, length, width, height, yaw; null where not labelled", null=True
        ),
        _column("box1", _BOX, "the same in scan 1", null=True),
        _column("pose0", _MATRIX, "4 x 4, `T_velo0_car` of a virtual car: origin at its box's centre", null=True),
        _column("pose1", _MATRIX, "4 x 4, `T_velo1_car`", null=True),
        _column("moment0", pa.float64(), "seconds from `time0` at which `box0`, `pose0` and `speed` hold"),
        _column("moment1", pa.float64(), "seconds from `time1` at which `box1` and `pose1` hold"),
        _column("motion", _MATRIX, "4 x 4, maps the object's points from velo0 to velo1; null if a box is", null=True),
        _column("points0", pa.int32(), "its points in scan 0"),
        _column("points1", pa.int32(), "its points in scan 1"),
        _column(
            "rays0", pa.int32(), "virtual: rays that would meet it if it stood alone, before glass, noise", null=True
        ),
        _column("rays1", pa.int32(), "the same in scan 1", null=True),
        _column("speed", pa.float64(), "m/s over ground in scan 0, negative when reversing", null=True),
        _column("yaw_rate", pa.float64(), "rad/s over ground in scan 0", null=True),
        _column("steering", pa.float64(), "steering angle of a virtual car, rad", null=True),
    ]
)


def _scan_columns(k: int) -> list[pa.Field]:
    return [
        _column(f"xyz{k}", pa.list_(pa.float32()), f"3 N{k}: points, row-major, metres, velo{k}"),
        _column(f"reflectance{k}", pa.list_(pa.float32()), f"N{k}: 0 to 1"),
        _column(f"ring{k}", pa.list_(pa.uint8()), f"N{k}: beam, 0 = highest"),
        _column(f"tick{k}", pa.list_(pa.uint16()), f"N{k}: encoder tick of the firing, 0 to 3999; 65535 = not known"),
        _column(f"source{k}", pa.list_(pa.int32()), f"N{k}: row in the source scan; -1 for a simulated return"),
        _column(f"instance{k}", pa.list_(pa.int16()), f"N{k}: row in `objects`; -1 for none"),
        _column(
            f"surface{k}",
            pa.list_(pa.uint8()),
            f"N{k}: 0 measured; simulated: 1 paint, 2 glass, 3 tyre, 4 lamp, 5 other, 6 seen through glass, "
            "7 mixed at an edge",
        ),
    ]


SCHEMA = pa.schema(
    [
        _column("pair_id", pa.string(), "unique in the data set: `<sequence>/<frame0>/<variant>`"),
        _column("sequence", pa.string(), "the source folder's bare name"),
        _column("recording", pa.string(), "the physical drive behind it; two names of one drive share it"),
        _column("frame0", pa.int32(), "frame number of scan 0"),
        _column("frame1", pa.int32(), "frame number of scan 1"),
        _column("time0", pa.float64(), "middle of scan 0, seconds (raw: UTC epoch; odometry: `times.txt`)"),
        _column("time1", pa.float64(), "middle of scan 1, seconds"),
        _column("scan_kind", pa.string(), "`raw` or `compensated`"),
        _column("seed", pa.int64(), "the pair's own seed"),
        _column("ego_motion", _MATRIX, "4 x 4, `T_velo1_velo0` of static points over one revolution"),
        _column("ego_source", pa.string(), "`oxts`, `poses`, `registration` or `truth`"),
        _column("label_coverage", pa.string(), "where the source's labels reach: `none`, `camera` or `full`"),
        _column("label_azimuth", pa.list_(pa.float64()), "for `camera`: from, to, radians, velo", null=True),
        *_scan_columns(0),
        *_scan_columns(1),
        _column("flow0", pa.list_(pa.float32()), "3 N0: displacement from velo0 to velo1 coordinates, metres"),
        _column("flow_status0", pa.list_(pa.uint8()), "N0: 0 known; 1 not known: leave out of losses and scores"),
        _column("removed0", pa.list_(pa.int32()), "rows of source scan 0 that a virtual car hides, ascending"),
        _column("removed1", pa.list_(pa.int32()), "rows of source scan 1 that a virtual car hides, ascending"),
        _column("objects", pa.list_(OBJECT), "the pair's objects, virtual and labelled"),
    ]
)

_FLAT = [field.name for field in SCHEMA if not pa.types.is_list(field.type)]
# measured column by column with `benchmarks/encodings.py`
_STORED = {
    **dict.fromkeys(("xyz0", "xyz1", "flow0", "tick0", "tick1"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys(("reflectance0", "reflectance1"), "RLE_DICTIONARY"),
    **dict.fromkeys(("source0", "source1", "removed0", "removed1"), "BYTE_STREAM_SPLIT"),
    **dict.fromkeys((f"{name}{k}" for name in ("ring", "instance", "surface") for k in (0, 1)), "PLAIN"),
    "flow_status0": "PLAIN",
}


def writer_options() -> dict[str, Any]:
    """Encodings and compression of a shard, as `pyarrow.parquet` takes them; small columns are stored as they are."""
    stored = {f"{name}.list.element": how for name, how in _STORED.items()}
    squeezed = [path for path in stored if path.startswith(("flow0", "reflectance"))]
    dictionary = [path for path, encoding in stored.items() if encoding == "RLE_DICTIONARY"]
    return {
        "use_dictionary": dictionary,
        "column_encoding": {path: encoding for path, encoding in stored.items() if path not in dictionary},
        "compression": {path: "zstd" if path in squeezed else "lz4" for path in stored},
        "compression_level": dict.fromkeys(squeezed, 1),
        "write_statistics": _FLAT,
    }


def shard_metadata(config: Config, profile: ScannerProfile, models: Iterable[CarModel]) -> dict[str, Any]:
    """What every shard of a data set says of how it was made; the scanner profile is carried whole."""
    return {
        "contract": CONTRACT_VERSION,
        "program_version": __version__,
        "configuration": config.model_dump(mode="json"),
        "configuration_digest": config.digest(),
        "scanner_profile": profile.content,
        "scanner_profile_digest": profile.digest,
        "cad_models": {model.name: model.digest for model in sorted(models, key=lambda model: model.name)},
    }


def write_shard(path: Path, pairs: Iterable[AugmentedPair], metadata: Mapping[str, Any]) -> int:
    """Write pairs of one sequence, in their order; the file is there whole or not at all.

    Args:
        path: of the shard; a temporary file beside it is renamed when all is on disk.
        pairs: at least one; taken one by one, so that a generator needs memory for one pair only.
        metadata: JSON content of the file's `augkitti` key, see `shard_metadata`.

    Returns:
        Number of rows.

    Raises:
        ValueError: no pairs, pairs of two sequences, a pair twice, or columns of unequal length.
        OSError: the disk refused.
    """
    text = json.dumps(dict(metadata), sort_keys=True, separators=(",", ":"), allow_nan=False)
    schema = SCHEMA.with_metadata({METADATA_KEY: text.encode()})
    path.parent.mkdir(parents=True, exist_ok=True)
    seen: set[str] = set()

    def write(file: BinaryIO) -> None:
        sequence = None
        with pq.ParquetWriter(file, schema, **writer_options()) as writer:
            for pair in pairs:
                sequence = sequence or pair.sequence
                if pair.pair_id in seen or pair.sequence != sequence:
                    raise ValueError(f"{path.name}: {pair.pair_id} is there already, or of another sequence")
                seen.add(pair.pair_id)
                writer.write_table(to_table(pair, schema))
        if not seen:
            raise ValueError(f"{path.name}: a shard needs at least one pair")

    replace_whole(path, write)
    return len(seen)


def replace_whole(path: Path, write: Callable[[BinaryIO], Any]) -> None:
    """Let `write` fill a temporary file beside `path`, then rename it: the file is there whole or not at all.

    On an object store a local file is handed over when it is whole.
    """
    if is_remote(path):
        put_whole(path, write)
        return
    temporary = path.parent / f".{path.name}.{os.getpid()}.{uuid4().hex[:8]}.tmp"
    try:
        with temporary.open("xb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk: a rename outlives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    except OSError as err:
        if err.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # file systems that know no such thing
            raise
    finally:
        os.close(descriptor)


def to_table(pair: AugmentedPair, schema: pa.Schema = SCHEMA) -> pa.Table:
    """One pair as a table of one row."""
    n0, n1 = len(pair.scan0), len(pair.scan1)
    values: dict[str, Any] = {
        name: getattr(pair, name) for name in (*_FLAT, "ego_motion", "label_azimuth", "flow0", "flow_status0")
    }
    values["ego_motion"] = pair.ego_motion.reshape(-1)
    for k, scan in enumerate((pair.scan0, pair.scan1)):
        for name in ("xyz", *_PER_POINT, "removed"):
            values[f"{name}{k}"] = getattr(scan, name)
    for name, length in _lengths(n0, n1):
        if len(values[name]) != length:
            raise ValueError(f"{pair.pair_id}: {name} has {len(values[name])} rows, the scan {length}")
    values["objects"] = [_object_row(item) for item in pair.objects]
    return pa.Table.from_arrays([_array(values[field.name], field.type) for field in schema], schema=schema)


_PER_POINT = ("reflectance", "ring", "tick", "source", "instance", "surface")


def _lengths(n0: int, n1: int) -> list[tuple[str, int]]:
    """Columns that have a row a point, with how many."""
    columns = [(f"{name}{k}", n) for name in _PER_POINT for k, n in enumerate((n0, n1))]
    return [*columns, ("flow0", n0), ("flow_status0", n0)]


def _array(value: Any, type_: pa.DataType) -> pa.Array:
    if isinstance(value, np.ndarray):
        flat = np.ascontiguousarray(value).reshape(-1)
        if flat.dtype != type_.value_type.to_pandas_dtype():
            raise ValueError(f"{flat.dtype} where {type_.value_type} belongs")
        return pa.ListArray.from_arrays(pa.array([0, len(flat)], pa.int32()), pa.array(flat), type=type_)
    if isinstance(value, tuple):
        value = list(value)
    return pa.array([value], type_)


def _object_row(item: ObjectRecord) -> dict[str, Any]:
    row = {}
    for field in OBJECT:
        value = getattr(item, field.name)
        row[field.name] = value.reshape(-1).tolist() if isinstance(value, np.ndarray) else value
    return row


def open_shard(path: Path) -> tuple[pq.ParquetFile, dict[str, Any]]:
    """An open shard and its metadata.

    Raises:
        InputError: missing, no Parquet file, no shard, of an unknown contract version, or of other columns.
    """
    try:
        file = pq.ParquetFile(open_anywhere(path), pre_buffer=is_remote(path))
    except (OSError, pa.ArrowException, UnicodeDecodeError) as err:
        problem = "does not exist" if not as_path(path).exists() else f"not readable as Parquet ({_line(err)})"
        raise InputError(path, problem, "generate the data set again, or copy it again") from err
    try:
        metadata = json.loads((file.schema_arrow.metadata or {})[METADATA_KEY])
        contract = metadata["contract"]
    except (KeyError, TypeError, ValueError, RecursionError) as err:
        file.close()
        raise InputError(
            path, "not a shard: no `augkitti` metadata", "give a folder made by `augkitti generate`"
        ) from err
    if contract != CONTRACT_VERSION:
        file.close()
        raise InputError(
            path, f"has contract version {contract!r}", f"this program reads {CONTRACT_VERSION}: update it"
        )
    if not file.schema_arrow.equals(SCHEMA):
        different = [
            name
            for name in dict.fromkeys([*SCHEMA.names, *file.schema_arrow.names])
            if name not in SCHEMA.names
            or file.schema_arrow.get_field_index(name) < 0
            or not file.schema_arrow.field(name).equals(SCHEMA.field(name))
        ]
        file.close()
        raise InputError(
            path, f"columns differ from the contract: {', '.join(different) or 'their order'}", "generate it again"
        )
    return file, metadata


def read_metadata(path: Path) -> dict[str, Any]:
    """The JSON of a shard's `augkitti` key; errors as `open_shard`."""
    file, metadata = open_shard(path)
    file.close()
    return metadata


def read_pair(path: Path, row: int) -> AugmentedPair:
    """One pair of a shard; reads its row group alone.

    Raises:
        InputError: as `open_shard`; no such row; a damaged row.
    """
    file, _ = open_shard(path)
    with file:
        if not 0 <= row < file.num_row_groups:
            raise InputError(path, f"has {file.num_row_groups} rows, none numbered {row}", "give a row that is there")
        return _row_group(file, path, row)


def read_pairs(path: Path, rows: Sequence[int] | None = None) -> Iterator[AugmentedPair]:
    """The pairs of a shard (or some rows of it), one after another; errors as `read_pair`."""
    file, _ = open_shard(path)
    with file:
        for row in range(file.num_row_groups) if rows is None else rows:
            yield _row_group(file, path, row)


def read_pair_ids(path: Path) -> list[str]:
    """The names of a shard's pairs in order; errors as `open_shard`."""
    file, _ = open_shard(path)
    with file:
        names: list[str] = _plain_columns(file, path, ["pair_id"])[0]
        return names


def read_frames(path: Path) -> list[tuple[int, int]]:
    """`frame0` and `frame1` of a shard's pairs in order; errors as `open_shard`."""
    file, _ = open_shard(path)
    with file:
        first, second = _plain_columns(file, path, ["frame0", "frame1"])
    return list(zip(first, second, strict=True))


def _plain_columns(file: pq.ParquetFile, path: Path, names: list[str]) -> list[list[Any]]:
    table = _read(path, lambda: file.read(columns=names, use_threads=False))
    if any(table.column(name).null_count for name in names):
        raise InputError(path, f"holds a row without {' or '.join(names)}", "generate it again, or copy it again")
    try:
        return [table.column(name).to_pylist() for name in names]
    except UnicodeDecodeError as err:
        raise InputError(path, f"damaged ({_line(err)})", "generate it again, or copy it again") from err


def _row_group(file: pq.ParquetFile, path: Path, row: int) -> AugmentedPair:
    table = _read(path, lambda: file.read_row_group(row, use_threads=False))
    if table.num_rows != 1:
        raise InputError(path, f"row group {row} holds {table.num_rows} rows, not one", "generate it again")
    try:
        return from_table(table)
    except (ValueError, TypeError, KeyError) as err:
        raise InputError(path, f"row {row} is damaged ({_line(err)})", "generate it again, or copy it again") from err


def _read(path: Path, read: Any) -> pa.Table:
    try:
        return read()
    except (OSError, pa.ArrowException, UnicodeDecodeError) as err:
        raise InputError(path, f"damaged ({_line(err)})", "generate it again, or copy it again") from err


def from_table(table: pa.Table) -> AugmentedPair:
    """The pair in a table of one row; its arrays are read-only views.

    Raises:
        ValueError: a list has a length that its meaning does not allow, or a null stands where none may.
    """
    row: dict[str, Any] = {}
    for field in SCHEMA:
        column = table.column(field.name).combine_chunks()
        column = column.chunk(0) if isinstance(column, pa.ChunkedArray) else column
        if column.null_count and not field.nullable:
            raise ValueError(f"{field.name} is null")
        if pa.types.is_list(field.type) and not pa.types.is_struct(field.type.value_type) and not column.null_count:
            values = column.flatten()
            if values.null_count:
                raise ValueError(f"{field.name} holds nulls")
            row[field.name] = values.to_numpy(zero_copy_only=True)
        else:
            row[field.name] = column[0].as_py()
    scans = [
        AugmentedScan(
            xyz=_shaped(row[f"xyz{k}"], f"xyz{k}", (-1, 3)),
            removed=row[f"removed{k}"],
            **{name: row[f"{name}{k}"] for name in _PER_POINT},
        )
        for k in (0, 1)
    ]
    for name, length in _lengths(len(scans[0].xyz), len(scans[1].xyz)):
        values = row[name]
        found = len(values) // 3 if name == "flow0" else len(values)
        if found != length:
            raise ValueError(f"{name} has {found} rows, the scan {length}")
    azimuth = row["label_azimuth"]
    values = {name: row[name] for name in _FLAT}
    return AugmentedPair(
        **values,
        ego_motion=_shaped(row["ego_motion"], "ego_motion", (4, 4)),
        label_azimuth=None if azimuth is None else tuple(_shaped(azimuth, "label_azimuth", (2,)).tolist()),
        scan0=scans[0],
        scan1=scans[1],
        flow0=_shaped(row["flow0"], "flow0", (-1, 3)),
        flow_status0=row["flow_status0"],
        objects=tuple(_object_of(item) for item in row["objects"]),
    )


_SHAPES = {"box0": (7,), "box1": (7,), "pose0": (4, 4), "pose1": (4, 4), "motion": (4, 4)}


def _object_of(row: dict[str, Any]) -> ObjectRecord:
    if row is None:
        raise ValueError("objects holds a null")
    for field in OBJECT:
        if row[field.name] is None and not field.nullable:
            raise ValueError(f"objects.{field.name} is null")
    arrays = {
        name: None if row[name] is None else _shaped(np.array(row[name], np.float64), f"objects.{name}", shape)
        for name, shape in _SHAPES.items()
    }
    return ObjectRecord(**{**row, **arrays})


def _shaped(values: Any, name: str, shape: tuple[int, ...]) -> Any:
    try:
        return values.reshape(shape)
    except ValueError:
        wanted = "a multiple of 3" if shape == (-1, 3) else str(int(np.prod(shape)))
        raise ValueError(f"{name} has {values.size} values, not {wanted}") from None


def _line(err: BaseException) -> str:
    return " ".join(str(err).split())[:200]


def schema_page() -> str:
    """The schema as a page of documentation (Markdown)."""

    def table(fields: Iterable[pa.Field], first: str) -> list[str]:
        rows = [f"| {first} | type | meaning |", "|---|---|---|"]
        for field in fields:
            meaning = field.metadata[b"meaning"].decode()
            rows.append(f"| `{field.name}` | {_type_name(field)} | {meaning} |")
        return rows

    return "\n".join(
        [
            "# Columns of a shard",
            "",
            f"Contract version {CONTRACT_VERSION}. Generated from `augkitti.shards.SCHEMA` by "
            "`python -m augkitti.shards > docs/shards.md`; a test holds the two together.",
            "",
            "A shard is a Parquet file with pairs of one sequence; a row is a pair (scan 0, scan 1) and a row group.",
            "Metres, radians, seconds. `velo0` and `velo1` are the scanner's frames (x forward, y left, z up); `T_a_b`",
            "maps coordinates in b to coordinates in a; matrices are 4 x 4, row-major. N0, N1 are numbers of points.",
            "Rows of a scan: measured points by `source`, then simulated ones by (ring, tick). File metadata: key",
            f"`{METADATA_KEY.decode()}`, JSON: contract, program version, configuration, scanner profile, CAD models",
            "and their digests.",
            "",
            *table(SCHEMA, "column"),
            "",
            *table(OBJECT, "field of `objects`"),
            "",
        ]
    )


def _type_name(field: pa.Field) -> str:
    type_ = field.type
    if pa.types.is_list(type_):
        inner = "struct" if pa.types.is_struct(type_.value_type) else str(type_.value_type).replace("double", "float64")
        name = f"list<{inner.replace('float', 'float32') if inner == 'float' else inner}>"
    else:
        name = str(type_).replace("double", "float64")
    return name + (", null" if field.nullable else "")


if __name__ == "__main__":
    print(schema_page(), end="")
