"""The rows of a data set's shards as they stand in the files, by pair."""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from augkitti.shards import SCHEMA


def rows_of(folder: Path) -> dict[str, pa.Table]:
    """A table of one row for each pair id."""
    rows = {}
    for path in sorted((folder / "data").iterdir()):
        table = pq.read_table(path)
        assert table.column_names == SCHEMA.names
        rows |= {name: table.slice(i, 1) for i, name in enumerate(table["pair_id"].to_pylist())}
    return rows


def assert_among(few: dict[str, pa.Table], many: dict[str, pa.Table], count: int) -> None:
    """See that there are `count` rows in `few`, and that each stands in `many` with every column equal."""
    assert len(few) == count < len(many)
    assert few.keys() <= many.keys()
    differ = [(name, column) for name in few for column in SCHEMA.names if few[name][column] != many[name][column]]
    assert not differ
