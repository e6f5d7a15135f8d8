"""A finished data set as a Python sequence: its folder in, pairs as records of numpy arrays out."""

from bisect import bisect_right
from collections.abc import Iterator
from itertools import accumulate
from pathlib import Path

from augkitti.dataset_index import SPLITS_NAME, DatasetIndex, ShardEntry, read_index
from augkitti.errors import InputError
from augkitti.remote import as_path
from augkitti.scan_pair import AugmentedPair
from augkitti.shards import read_pair, read_pair_ids, read_pairs
from augkitti.splits import read_splits


class Dataset:
    """The pairs of a finished data set, in the order of its index; read from disk as they are asked for.

    `for pair in dataset`, `len(dataset)`, `dataset[17]` and `dataset["2011_09_26_drive_0005_sync/12/0"]` work. Holds no
    open file, so it can be pickled into workers. `augkitti.open` makes one.

    Args:
        folder: made by `augkitti generate`.
        split: `train`, `validation` or `test`, where `augkitti split` has been run; None for all pairs.

    Raises:
        InputError: the folder is unfinished, of an unknown contract version, or has no such split.
    """

    def __init__(self, folder: Path | str, split: str | None = None) -> None:
        self.folder = as_path(folder)
        self.index = read_index(self.folder)
        self.shards = self.index.shards if split is None else _shards_of(self.folder, self.index, split)
        self._ends = tuple(accumulate(shard.rows for shard in self.shards))

    def __len__(self) -> int:
        return self._ends[-1] if self._ends else 0

    def __iter__(self) -> Iterator[AugmentedPair]:
        for shard in self.shards:
            yield from read_pairs(self.folder / shard.path)

    def __getitem__(self, key: int | str) -> AugmentedPair:
        if isinstance(key, str):
            return read_pair(*self._place(key))
        number = key + len(self) if key < 0 else key
        if not 0 <= number < len(self):
            raise IndexError(f"pair {key} of {len(self)}")
        shard = bisect_right(self._ends, number)
        first = self._ends[shard - 1] if shard else 0
        return read_pair(self.folder / self.shards[shard].path, number - first)

    @property
    def pair_ids(self) -> list[str]:
        """The names of all pairs, in order; reads one column."""
        return [name for shard in self.shards for name in read_pair_ids(self.folder / shard.path)]

    def _place(self, pair_id: str) -> tuple[Path, int]:
        sequence = pair_id.split("/")[0]
        paths = [shard.path for shard in self.shards if shard.sequence == sequence]
        low, high = 0, len(paths)
        while low < high:  # a sequence's shards are in the order of rounds and frames
            middle = (low + high) // 2
            names = read_pair_ids(self.folder / paths[middle])
            if pair_id in names:
                return self.folder / paths[middle], names.index(pair_id)
            if _order(pair_id) < min(map(_order, names), default=(0, 0)):
                high = middle
            else:
                low = middle + 1
        for path in paths:  # unless another program wrote them
            names = read_pair_ids(self.folder / path)
            if pair_id in names:
                return self.folder / path, names.index(pair_id)
        raise InputError(self.folder, f"holds no pair `{pair_id}`", "names are `<sequence>/<frame0>/<variant>`")


_SPARE_VARIANT, _SPARE_PASSES = 1_000_000, 4  # as `pipelines.plan` numbers spares


def _order(pair_id: str) -> tuple[int, int]:
    """Round and first frame of a pair, by which a sequence's shards are in order; of an odd name anything."""
    try:
        frame0, variant = (int(part) for part in pair_id.split("/")[1:])
    except ValueError:
        return 0, 0
    return variant if variant < _SPARE_VARIANT else (variant - _SPARE_VARIANT) // _SPARE_PASSES, frame0


def open_dataset(folder: Path | str, split: str | None = None) -> Dataset:
    """The pairs of a finished data set, or of one of its splits, as a `Dataset`. `augkitti.open` is this function."""
    return Dataset(folder, split)


def _shards_of(folder: Path, index: DatasetIndex, split: str) -> tuple[ShardEntry, ...]:
    splits = read_splits(folder / SPLITS_NAME).splits
    if split not in splits:
        raise InputError(folder, f"has no split `{split}`", f"it has {', '.join(splits)}")
    wanted = set(splits[split])
    return tuple(shard for shard in index.shards if shard.path in wanted)
