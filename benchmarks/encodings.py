"""Encodings and compression of a shard, column by column and as a whole, and one pair by its name out of 20,000.

Pairs as `benchmarks/generate.py` makes them. All candidates of a column, and the row in all its ways, take turns on the
same pairs, so that ratios hold on a busy machine; milliseconds are medians, megabytes means. Columns are written to
memory, rows to a file without fsync. The set of 20,000 has one sequence, the worst case of the search for a name: 625
shards of 32 rows with names of their own, and the pairs that are asked for are real ones, the rest without points.

Usage: python benchmarks/encodings.py [KITTI_ROOT] [CAD_FOLDER]
"""

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

import augkitti
from augkitti import kitti, shards
from augkitti.augmentation import augment_pair
from augkitti.cad_models import load_cad_folder
from augkitti.config import Config
from augkitti.dataset_index import KITTI_LICENCE, ShardEntry, make_index, write_index
from augkitti.scan_pair import AugmentedPair, CarModel
from augkitti.scanner import ScannerProfile, load_profile
from augkitti.seeds import pair_seed
from pipelines.prepare import prepared_pair

PAIRS_OF_A_SEQUENCE, VARIANTS = 6, 2
SHARDS, ROWS, ASKED = 625, 32, 20
COLUMNS = ("xyz0", "reflectance0", "ring0", "tick0", "source0", "instance0", "surface0")
COLUMNS += ("flow0", "flow_status0", "removed0")
CODECS = (("none", None), ("snappy", None), ("lz4", None), *(("zstd", level) for level in (-5, -1, 1, 2, 3, 5)))
PLAIN = {"compression": "zstd", "compression_level": 1, "use_dictionary": False, "write_statistics": False}


def main() -> None:
    kitti_root = Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/kitti")
    cad = Path(sys.argv[2] if len(sys.argv) > 2 else "../shared/cad")
    profile, config = load_profile(), Config()
    models = load_cad_folder(cad, config.categories).models
    with tempfile.TemporaryDirectory() as folder:
        pairs = list(made_pairs(kitti_root, models, profile, config, Path(folder)))
        tables = [shards.to_table(pair) for pair in pairs]
        print(f"{len(pairs)} pairs; a column in {len(tables[::4])} of them\n")
        print_columns(tables[::4])
        print_row(tables, Path(folder) / "row.parquet")
        metadata = shards.shard_metadata(config, profile, models)
        asked = make_set(Path(folder) / "set", pairs, config, metadata)
        print_by_name(Path(folder) / "set", asked)


def made_pairs(
    root: Path, models: tuple[CarModel, ...], profile: ScannerProfile, config: Config, folder: Path
) -> Iterator[AugmentedPair]:
    for sequence in kitti.open_root(root).sequences:
        for frame0, _ in sequence.pairs[:PAIRS_OF_A_SEQUENCE]:
            pair, prepared, _ = prepared_pair(sequence, frame0, profile, config, folder / "cache")
            for variant in range(VARIANTS):
                seed, name = pair_seed(0, sequence.name, frame0, variant), f"{sequence.name}/{frame0}/{variant}"
                made = augment_pair(pair, models, profile, config, seed, name, prepared)
                if made is not None:
                    yield made


def print_columns(tables: list[pa.Table]) -> None:
    """Each column under each encoding and codec."""
    print("| column | encoding | codec | MB | write ms | read ms |\n| --- | --- | --- | --- | --- | --- |")
    chosen = shards.writer_options()
    for column in COLUMNS:
        path = f"{column}.list.element"
        if path in chosen["use_dictionary"]:
            encoding = "DICTIONARY"
        else:
            encoding = chosen["column_encoding"][path]
        ours = (encoding, chosen["compression"][path], chosen["compression_level"].get(path))
        ways = candidates(column)
        ways.setdefault(ours, _way(column, *ours))
        alone = [table.select([column]) for table in tables]
        for way, (size, write, read) in measure(alone, ways, pa.BufferOutputStream, lambda k: k.getvalue()).items():
            codec = way[1] if way[2] is None else f"{way[1]} {way[2]}"
            row = (f"{np.mean(size) / 1e6:.4f}", f"{np.median(write):.2f}", f"{np.median(read):.2f}")
            print("|", " | ".join((column, way[0], codec, *row)), "|", "**ours**" if way == ours else "")
    print()


def candidates(column: str) -> dict[tuple[str, str, int | None], dict[str, Any]]:
    type_ = shards.SCHEMA.field(column).type.value_type
    encodings = ["PLAIN", "DICTIONARY", "BYTE_STREAM_SPLIT"]
    encodings += ["DELTA_BINARY_PACKED"] if pa.types.is_integer(type_) else []
    return {(e, codec, level): _way(column, e, codec, level) for e in encodings for codec, level in CODECS}


def _way(column: str, encoding: str, codec: str, level: int | None) -> dict[str, Any]:
    way: dict[str, Any] = {"compression": codec, "compression_level": level, "write_statistics": False}
    if encoding == "DICTIONARY":
        return {**way, "use_dictionary": True}
    return {**way, "use_dictionary": False, "column_encoding": {f"{column}.list.element": encoding}}


def measure(
    tables: list[pa.Table], ways: dict[Any, dict[str, Any]], sink: Callable[[], Any], source: Callable[[Any], Any]
) -> dict[Any, tuple[list[int], list[float], list[float]]]:
    """Bytes, milliseconds of writing and of reading, by way; the ways take turns on each table."""
    found: dict[Any, tuple[list[int], list[float], list[float]]] = defaultdict(lambda: ([], [], []))
    for table in tables:
        for way, options in ways.items():
            start = time.perf_counter()
            target = sink()
            pq.write_table(table, target, **options)
            written = time.perf_counter()
            content = source(target)
            reading = time.perf_counter()
            again = pq.ParquetFile(content).read_row_group(0, use_threads=False)
            end = time.perf_counter()
            assert again.equals(table)
            size = content.stat().st_size if isinstance(content, Path) else content.size
            for values, value in zip(found[way], (size, 1e3 * (written - start), 1e3 * (end - reading)), strict=True):
                values.append(value)
    return found


def print_row(tables: list[pa.Table], path: Path) -> None:
    """The whole row, plain and ours in turns."""
    ways = {"plain, zstd 1": PLAIN, "ours": shards.writer_options()}
    found = measure(tables * 3, ways, lambda: path, lambda target: target)
    print("| row | MB | write ms (10 to 90 %) | read ms (10 to 90 %) |\n| --- | --- | --- | --- |")
    for way, (size, write, read) in found.items():
        print(f"| {way} | {np.mean(size) / 1e6:.3f} | {_spread(write)} | {_spread(read)} |")
    plain, ours = (found[way] for way in ways)
    of = [float(np.median(np.divide(ours[k], plain[k]))) for k in (1, 2)]
    print(f"\nours beside plain, median of the ratios: write {of[0]:.2f}, read {of[1]:.2f}\n")


def _spread(values: list[float]) -> str:
    low, middle, high = np.quantile(values, [0.1, 0.5, 0.9])
    return f"{middle:.1f} ({low:.1f} to {high:.1f})"


def make_set(folder: Path, pairs: list[AugmentedPair], config: Config, metadata: dict[str, Any]) -> list[str]:
    """A data set of 20,000 pairs of one sequence; the names of the real ones among them."""
    generator = np.random.default_rng(0)
    real = dict(zip(generator.choice(SHARDS * ROWS, ASKED, replace=False).tolist(), pairs, strict=False))
    name, hollow = pairs[0].sequence, _hollow(pairs[0])
    entries, asked = [], []
    for shard in range(SHARDS):
        path = folder / "data" / f"{name}-{shard:05d}.parquet"
        numbers = range(shard * ROWS, (shard + 1) * ROWS)
        rows = [
            replace(real.get(number, hollow), pair_id=f"{name}/{number}/0", sequence=name, frame0=number)
            for number in numbers
        ]
        shards.write_shard(path, rows, metadata)
        asked += [row.pair_id for row, number in zip(rows, numbers, strict=True) if number in real]
        relative = path.relative_to(folder).as_posix()
        entries.append(ShardEntry(relative, name, pairs[0].recording, ROWS, path.stat().st_size, "0" * 64))
    write_index(folder, make_index(config, 0, entries, {}, [], KITTI_LICENCE, {"kind": "kitti"}))
    return asked


def _hollow(pair: AugmentedPair) -> AugmentedPair:
    columns = ("xyz", "reflectance", "ring", "tick", "source", "instance", "surface", "removed")
    scan = replace(pair.scan0, **{name: getattr(pair.scan0, name)[:0] for name in columns})
    return replace(pair, scan0=scan, scan1=scan, flow0=pair.flow0[:0], flow_status0=pair.flow_status0[:0])


def print_by_name(folder: Path, asked: list[str]) -> None:
    """One pair by its name, the data set opened anew each time."""
    spent = []
    augkitti.open(folder)[asked[-1]]  # starts the libraries
    for name in asked:
        wall, processor = time.perf_counter(), time.process_time()
        pair = augkitti.open(folder)[name]
        spent.append((1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - processor)))
        assert pair.pair_id == name
    print(f"one pair by name out of {SHARDS * ROWS}, {len(asked)} times, ms in median and at worst: ", end="")
    (wall, processor), (worst, worst_processor) = np.median(spent, axis=0), np.max(spent, axis=0)
    print(f"{wall:.0f} and {worst:.0f} of the clock, {processor:.0f} and {worst_processor:.0f} of a core")


if __name__ == "__main__":
    main()
