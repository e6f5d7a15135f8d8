"""The index and the card of a data set: what its shards hold in, `dataset.json` and `README.md` out, and back.

The index is written last, so a folder without it is unfinished. Nothing in either depends on time, machine or path.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import yaml

from augkitti import __version__
from augkitti.config import Config
from augkitti.errors import InputError
from augkitti.remote import as_path
from augkitti.shards import CONTRACT_VERSION
from augkitti.shards import replace_whole as replace_whole

INDEX_NAME = "dataset.json"
CARD_NAME = "README.md"
SPLITS_NAME = "splits.json"
DATA_NAME = "data"

KITTI_LICENCE = (
    "Made from KITTI (Geiger et al., IJRR 2013), CC BY-NC-SA 3.0: give credit, no commercial use, share under the "
    "same licence."
)
STREET_LICENCE = "Made from procedural streets of this program: no real scans in it; MIT licence."
_MODELS_LICENCE = (
    "Virtual cars are shapes of car models, whose names and digests stand in each shard (metadata `augkitti`, "
    "`cad_models`): `parametric_*` are this program's own, others keep the licences of their authors."
)
_LICENCE_IDS = {KITTI_LICENCE: "cc-by-nc-sa-3.0", STREET_LICENCE: "mit"}  # as data set hubs name them


@dataclass(frozen=True)
class ShardEntry:
    """One shard as the index knows it."""

    path: str  # from the data set's folder, with forward slashes
    sequence: str
    recording: str
    rows: int
    bytes: int
    sha256: str


@dataclass(frozen=True)
class DatasetIndex:
    """All of `dataset.json`."""

    configuration: dict[str, Any]
    seed: int
    shards: tuple[ShardEntry, ...]  # by path
    totals: dict[str, Any]
    skipped: tuple[dict[str, Any], ...]  # source, reason, count
    licence: str  # of the source data
    source: dict[str, Any]  # {"kind": "kitti"} or {"kind": "embedded", "digest": ...}
    configuration_digest: str = ""
    program_version: str = __version__
    contract: int = CONTRACT_VERSION

    @property
    def rows(self) -> int:
        """Number of pairs."""
        return sum(shard.rows for shard in self.shards)

    @property
    def asked(self) -> int:
        """Number of pairs that were asked for; `totals.pairs_short` of them could not be made."""
        short = self.totals.get("pairs_short", 0)
        return self.rows + (short if isinstance(short, int) else 0)


def make_index(
    config: Config,
    seed: int,
    shards: Iterable[ShardEntry],
    totals: Mapping[str, Any],
    skipped: Iterable[Mapping[str, Any]],
    licence: str,
    source: Mapping[str, Any],
) -> DatasetIndex:
    """An index from plain values; shards and skips are put in order.

    Args:
        config: that all shards were made with.
        seed: of the data set.
        shards: see `shard_entry`.
        totals: numbers over all shards, by name; `pairs`, `shards` and `bytes` are added.
        skipped: rows with `source`, `reason` and `count`.
        licence: `KITTI_LICENCE`, `STREET_LICENCE`, or another line.
        source: what the scans came from; no path of this machine in it.
    """
    rows = tuple(sorted(shards, key=lambda shard: shard.path))
    skips = [dict(skip) for skip in skipped]
    return DatasetIndex(
        configuration=config.model_dump(mode="json"),
        configuration_digest=config.digest(),
        seed=seed,
        shards=rows,
        totals={
            **dict(totals),
            "pairs": sum(shard.rows for shard in rows),
            "shards": len(rows),
            "bytes": sum(shard.bytes for shard in rows),
        },
        skipped=tuple(sorted(skips, key=lambda skip: (str(skip.get("source")), str(skip.get("reason"))))),
        licence=licence,
        source=dict(source),
    )


def shard_entry(folder: Path, path: Path, sequence: str, recording: str, rows: int) -> ShardEntry:
    """A shard's entry, its size and sha256 measured."""
    return ShardEntry(
        path=path.relative_to(folder).as_posix(),
        sequence=sequence,
        recording=recording,
        rows=rows,
        bytes=path.stat().st_size,
        sha256=file_sha256(path),
    )


def file_sha256(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_index(folder: Path, index: DatasetIndex) -> None:
    """Write `dataset.json`; call it when all else of the folder is there."""
    write_text(folder / INDEX_NAME, json.dumps(asdict(index), indent=1, sort_keys=True, allow_nan=False) + "\n")


def read_index(folder: Path | str) -> DatasetIndex:
    """The index of a finished data set.

    Raises:
        InputError: the folder is missing or unfinished, or its index is malformed or of an unknown contract version.
    """
    folder = as_path(folder)
    path = folder / INDEX_NAME
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "does not exist"
        raise InputError(folder, problem, "give a folder made by `augkitti generate`")
    if not path.is_file():
        raise InputError(
            folder, f"has no {INDEX_NAME}, so it is unfinished or no data set", "finish it with `augkitti generate`"
        )
    content = read_json(path)
    check_contract(path, content)
    try:
        shards = tuple(
            ShardEntry(
                path=_inside(str(row["path"])),
                sequence=str(row["sequence"]),
                recording=str(row["recording"]),
                rows=_count(row["rows"]),
                bytes=_count(row["bytes"]),
                sha256=str(row["sha256"]),
            )
            for row in content["shards"]
        )
        return DatasetIndex(
            configuration=dict(content["configuration"]),
            configuration_digest=str(content["configuration_digest"]),
            seed=int(content["seed"]),
            shards=shards,
            totals=dict(content["totals"]),
            skipped=tuple(dict(skip) for skip in content["skipped"]),
            licence=str(content["licence"]),
            source=dict(content["source"]),
            program_version=str(content["program_version"]),
        )
    except (KeyError, TypeError, ValueError, OverflowError) as err:
        raise InputError(path, f"is no index of a data set ({type(err).__name__}: {err})", "generate it again") from err


def read_json(path: Path) -> dict[str, Any]:
    """A JSON file with a table in it.

    Raises:
        InputError: missing, not JSON, or no table.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as err:
        raise InputError(path, f"not readable as JSON ({err})", "generate it again, or copy it again") from err
    if not isinstance(content, dict):
        raise InputError(path, "is no table of keys and values", "generate it again, or copy it again")
    return content


def check_contract(path: Path, content: Mapping[str, Any]) -> None:
    """Refuse a contract version that this program does not know.

    Raises:
        InputError: as said.
    """
    version = content.get("contract")
    if version != CONTRACT_VERSION or isinstance(version, bool):
        raise InputError(path, f"has contract version {version!r}", f"this program reads {CONTRACT_VERSION}: update it")


_LOADING = """\
## Loading

A row is a pair and a row group, so any Parquet reader reads it, pair by pair. `aug` is this folder.

```python
import augkitti  # records of numpy arrays; its `Dataset` is one for torch's DataLoader, too

for pair in augkitti.open("aug"):
    print(pair.pair_id, pair.scan0.xyz.shape, pair.flow0.shape)

import datasets  # Hugging Face: finds the splits in the header above

splits = datasets.load_dataset("aug")

import pyarrow.dataset  # and all that read Parquet

ego_motion = pyarrow.dataset.dataset("aug/data").to_table(columns=["pair_id", "ego_motion"])

import polars

objects = polars.scan_parquet("aug/data/*.parquet").select("pair_id", "objects").collect()

import duckdb

speeds = duckdb.sql("select pair_id, unnest(objects).speed from 'aug/data/*.parquet'").fetchall()
```

Points and flow are flat lists of x, y, z: `reshape(-1, 3)`; matrices are 4 x 4, row by row. Scan 0 is in `velo0`, scan
1 in `velo1` (x forward, y left, z up, metres): `xyz0 + flow0` lies in `velo1`, ego-motion included. Leave points of
`flow_status0` 1 out of losses and scores: their motion is not known. The Parquet schema tells what each column means.

## Looking

`augkitti view aug` shows pairs in a browser, `augkitti info aug` tells and draws the figures of all of them,
`augkitti validate aug` checks every pair, and `augkitti croissant aug` writes Croissant metadata. No picture lies
in this folder, which holds data alone; the program's documentation has some.

## Please cite

Behl, Paschalidou, Donn\u00e9, Geiger: PointFlowNet: Learning Representations for Rigid Motion Estimation from Point
Clouds, CVPR 2019. Geiger, Lenz, Stiller, Urtasun: Vision meets Robotics: The KITTI Dataset, IJRR 2013.
"""


def write_card(
    folder: Path,
    index: DatasetIndex,
    splits: Mapping[str, Sequence[str]] | None = None,
    divides_recordings: bool = False,
) -> None:
    """Write `README.md`: licence, figures, how to load, and the YAML header by which loaders find the splits.

    Args:
        folder: of the data set.
        index: its index.
        splits: shard paths by split; without, all shards are one split, `train`, as loaders want at least one.
        divides_recordings: the splits share a recording (toy sets); said in the card.
    """
    write_text(folder / CARD_NAME, card(index, splits, divides_recordings))


def card(
    index: DatasetIndex, splits: Mapping[str, Sequence[str]] | None = None, divides_recordings: bool = False
) -> str:
    """The card's text, see `write_card`."""
    files = [{"split": name, "path": list(paths)} for name, paths in (splits or {}).items() if paths]
    header: dict[str, Any] = {
        "pretty_name": "Augmented KITTI",
        "license": _LICENCE_IDS.get(index.licence, "other"),
        "tags": ["lidar", "point-cloud", "scene-flow", "kitti"],
        "configs": [
            {
                "config_name": "default",
                "data_files": files or [{"split": "train", "path": f"{DATA_NAME}/*.parquet"}],
            }
        ],
    }
    plain = index.configuration.get("cars") == [0, 0]
    lines = [
        "---",
        yaml.safe_dump(header, sort_keys=False, width=1000).rstrip(),
        "---",
        "",
        "# Plain KITTI pairs with their real labels" if plain else "# Augmented KITTI",
        "",
        "Pairs of neighbouring LiDAR scans with scene flow, objects and their rigid motions"
        + ("." if plain else "; virtual cars were cast into the scans."),
        f"Shard contract version {index.contract}, made by augkitti {index.program_version}, seed {index.seed}, "
        f"configuration `{index.configuration_digest[:16]}`.",
        "",
        f"**Licence of the source data.** {index.licence}",
        *([] if plain else [_MODELS_LICENCE]),
        "",
        "| figure | value |",
        "|---|---|",
        f"| recordings | {len({shard.recording for shard in index.shards})} |",
        *(f"| {name.replace('_', ' ')} | {_figure(value)} |" for name, value in sorted(index.totals.items())),
        f"| skipped source pairs | {sum(int(skip.get('count', 1)) for skip in index.skipped)} |",
        "",
    ]
    if splits is not None:
        lines += _split_lines(index, splits, divides_recordings)
    return "\n".join([*lines, _LOADING])


def _split_lines(index: DatasetIndex, splits: Mapping[str, Sequence[str]], divides_recordings: bool) -> list[str]:
    by_path = {shard.path: shard for shard in index.shards}
    lines = ["## Splits", "", "| split | pairs | shards | recordings |", "|---|---|---|---|"]
    for name, paths in splits.items():
        shards = [by_path[path] for path in paths]
        recordings = len({shard.recording for shard in shards})
        lines.append(f"| {name} | {sum(shard.rows for shard in shards)} | {len(shards)} | {recordings} |")
    lines.append("")
    if divides_recordings:
        lines += [
            "**These splits divide a recording** (`--allow-frames-split`): neighbouring scenes stand in several, "
            "so scores on them say nothing about new roads. For trying things out only.",
            "",
        ]
    return lines


def _figure(value: Any) -> str:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return json.dumps(value) if isinstance(value, dict | list) else str(value)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4g}"


def write_text(path: Path, text: str) -> None:
    """Write a text file whole: a temporary file beside it is renamed when all is on disk."""
    replace_whole(path, lambda file: file.write(text.encode("utf-8")))


def _inside(path: str) -> str:
    parts = PurePosixPath(path).parts
    if not parts or PurePosixPath(path).is_absolute() or ".." in parts or "\\" in path or not path.isprintable():
        raise ValueError(f"shard path {path!r} leads out of the folder")
    return path


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise ValueError(f"{value!r} is no count")
    return value
