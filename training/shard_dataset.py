"""Shards to samples: folders of finished data sets in, single pairs out, shuffled, shared among processes, resumable.

An epoch is one list of pairs, the same in every process; a process takes every R-th of it (R ranks), a `DataLoader`
worker whole batches in turn. So no pair comes twice or is lost, and batches are the same for any number of workers.
R ranks with batches of B see together what one process sees in batches of R B. Reads the shard contract alone.

    pairs = ShardPairs([(Path("k"), 1.0), (Path("aug"), 1.0)], "train", settings, training=True, seed=0)
    for batch in load_batches(pairs, settings, workers=2):    # goes on where `load_state_dict` left off
        ...
        pairs.batch_done()                                    # so that `state_dict` knows
    pairs.set_epoch(1)
"""

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from augkitti.dataset import open_dataset
from augkitti.dataset_index import SPLITS_NAME, ShardEntry, read_index
from augkitti.errors import InputError
from augkitti.scan_pair import I64
from augkitti.seeds import generator
from augkitti.shards import read_pair
from augkitti.splits import read_splits
from training.augment_sample import augment_sample
from training.config import Settings
from training.sample import Sample as Sample
from training.sample import sample_of as sample_of
from training.voxelize import Batch, make_batch

_ROUNDING = 1e-6  # of a pair: 0.1 times 10 pairs is one pair


@dataclass(frozen=True)
class _Source:
    """The shards of one data set, with the number of pairs before each."""

    folder: Path
    weight: float
    shards: tuple[ShardEntry, ...]
    starts: I64  # (shards + 1,)

    @property
    def pairs(self) -> int:
        return int(self.starts[-1])


class ShardPairs(IterableDataset[Sample]):
    """The pairs of a split of one or more data sets, as samples.

    In training pairs are shuffled over all shards and sets anew in each epoch, and augmented; a set of weight w gives
    each of its pairs w times an epoch, in the mean over epochs: with 0.5 one half in one epoch, the other in the next.
    Else every pair comes once, in the order of the indices, whatever the weights.

    Args:
        folders: data sets and their weights.
        split: `train`, `validation`, `test`; None for all pairs.
        settings: of augmentation, and the batch if none is given.
        training: as above.
        seed: of order and augmentation.
        batch: pairs of a batch in one process; `settings.train.batch` by default. The loader's must be the same.
        rank: of this process among `ranks`; both from `torch.distributed` by default, where it is up.
        ranks: processes.

    Raises:
        InputError: unfinished or unknown data set, no splits, no such split, an empty one, sets whose splits disagree,
            a weight that is no positive number; while iterating, a shard that is damaged or of another contract.
    """

    def __init__(
        self,
        folders: Sequence[tuple[Path, float]],
        split: str | None,
        settings: Settings,
        training: bool = False,
        seed: int = 0,
        batch: int | None = None,
        rank: int | None = None,
        ranks: int | None = None,
    ) -> None:
        self._sources = tuple(_source(Path(folder), weight, split) for folder, weight in folders)
        if not self._sources:
            raise InputError("--data", "names no data set", "give a folder made by `augkitti generate`")
        if split is not None:
            _check_one_split([source.folder for source in self._sources])
        self.settings, self.training, self.seed = settings, training, seed
        self.batch = batch or settings.train.batch
        up = torch.distributed.is_available() and torch.distributed.is_initialized()
        self.rank = (torch.distributed.get_rank() if up else 0) if rank is None else rank
        self.ranks = (torch.distributed.get_world_size() if up else 1) if ranks is None else ranks
        # shared, so that workers which persist hear of a new epoch
        self._place = torch.zeros(2, dtype=torch.int64).share_memory_()  # type: ignore[no-untyped-call]  # epoch, pairs done by all ranks
        self._errors_as_items = False  # see `load_batches`

    @property
    def epoch(self) -> int:
        """The epoch that the next iteration gives."""
        return int(self._place[0])

    def set_epoch(self, epoch: int) -> None:
        """Turn to the start of an epoch."""
        self._place[0], self._place[1] = epoch, 0

    def batch_done(self, batches: int = 1) -> None:
        """Note that this many batches of the epoch were used, by each rank."""
        self._place[1] += batches * self.batch * self.ranks

    def pairs_in_epoch(self, epoch: int | None = None) -> int:
        """Pairs of an epoch over all ranks; with fractional weights epochs differ by single pairs."""
        number = self.epoch if epoch is None else epoch
        return sum(end - start for start, end in (self._laps(source, number) for source in self._sources))

    def batches_left(self) -> int:
        """Batches, the last perhaps short, that every rank still has in this epoch: as many steps are safe to take.

        A rank may have one more where fewer pairs than ranks remain.
        """
        whole, rest = divmod(max(self.pairs_in_epoch() - int(self._place[1]), 0), self.batch * self.ranks)
        return whole + (rest >= self.ranks)

    @property
    def digest(self) -> str:
        """sha256 of the shards' own digests, in order, with their weights: what a run was trained on."""
        parts = [[source.weight, *(shard.sha256 for shard in source.shards)] for source in self._sources]
        return hashlib.sha256(repr(parts).encode()).hexdigest()

    def state_dict(self) -> dict[str, Any]:
        """Where the epoch stands, in plain values: pairs are counted by `batch_done`."""
        return {"epoch": self.epoch, "pairs_done": int(self._place[1]), "seed": self.seed, "digest": self.digest}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on where another run stood; batch and number of ranks may differ.

        Raises:
            InputError: the state is of other data or of another seed.
        """
        if state["digest"] != self.digest or state["seed"] != self.seed:
            what = "seed" if state["digest"] == self.digest else "data"
            raise InputError(
                self._sources[0].folder, f"not the {what} that the run was begun with", "give the same, or begin anew"
            )
        self._place[0], self._place[1] = state["epoch"], state["pairs_done"]

    def __iter__(self) -> Iterator[Sample]:
        worker = get_worker_info()
        workers, number = (1, 0) if worker is None else (worker.num_workers, worker.id)
        epoch, done = (int(value) for value in self._place)
        order = self._order(epoch)
        for position in places_of(len(order), done, self.rank, self.ranks, self.batch, number, workers):
            source, pair = (int(number) for number in order[position])
            try:
                yield self._sample(source, pair, epoch, int(position))
            except InputError as err:
                if not self._errors_as_items:
                    raise
                yield err  # type: ignore[misc]
                return

    def _sample(self, source: int, pair: int, epoch: int, position: int) -> Sample:
        chosen = self._sources[source]
        shard = int(np.searchsorted(chosen.starts, pair, side="right")) - 1
        path = chosen.folder / chosen.shards[shard].path
        sample = sample_of(read_pair(path, pair - int(chosen.starts[shard])))
        if not self.training:
            return sample
        rng = generator(self.seed, "sample", epoch, position)
        sample = augment_sample(sample, self.settings.train, rng)
        return replace(sample, draw=int(rng.integers(0, 2**63 - 1)))

    def _order(self, epoch: int) -> I64:
        """All pairs of an epoch, (n, 2): data set, pair in it."""
        if not self.training:
            parts = [np.arange(source.pairs) for source in self._sources]
        else:
            parts = [self._drawn(k, epoch) for k in range(len(self._sources))]
        order = np.concatenate([np.stack([np.full(len(part), k), part], axis=1) for k, part in enumerate(parts)])
        return generator(self.seed, "order", epoch).permutation(order) if self.training else order

    def _laps(self, source: _Source, epoch: int) -> tuple[int, int]:
        """First and last place that an epoch takes in the endless row of a set's shuffled rounds."""
        if not self.training:
            return 0, source.pairs
        each = source.weight * source.pairs
        return math.floor(epoch * each + _ROUNDING), math.floor((epoch + 1) * each + _ROUNDING)

    def _drawn(self, number: int, epoch: int) -> I64:
        """The pairs of one set in an epoch: none comes again before all others came."""
        source = self._sources[number]
        start, end = self._laps(source, epoch)
        rounds = range(start // source.pairs, -(-end // source.pairs))
        rows = [generator(self.seed, "round", number, k).permutation(source.pairs) for k in rounds]
        first = start - rounds.start * source.pairs
        return np.concatenate([*rows, np.empty(0, np.int64)])[first : first + end - start].astype(np.int64)


def places_of(pairs: int, done: int, rank: int, ranks: int, batch: int, worker: int, workers: int) -> I64:
    """The places in an epoch of `pairs`, of which `done` were used, that one worker of one rank reads, in order.

    Ranks take turns pair by pair, a rank's workers batch by batch.
    """
    mine = np.arange(done + rank, pairs, ranks)
    return np.asarray(mine[np.arange(len(mine)) // batch % workers == worker])


def load_batches(pairs: ShardPairs, settings: Settings, workers: int = 0, pin_memory: bool = False) -> Iterator[Batch]:
    """The batches that are left of the epoch, voxelised, made by worker processes or in this one.

    Raises:
        InputError: of a damaged shard or an empty scan; from a worker, too, where `DataLoader` would lose its type.
    """
    reader = copy(pairs)
    reader._errors_as_items = True
    loader = DataLoader(
        reader,
        batch_size=pairs.batch,
        num_workers=workers,
        collate_fn=_Collate(settings, pairs.training),
        pin_memory=pin_memory,
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield batch


@dataclass(frozen=True)
class _Collate:
    """`make_batch`, for worker processes: an error is handed on as it is."""

    settings: Settings
    training: bool

    def __call__(self, samples: Sequence[Sample | InputError]) -> Batch | InputError:
        for sample in samples:
            if isinstance(sample, InputError):
                return sample
        try:
            return make_batch([s for s in samples if isinstance(s, Sample)], self.settings, training=self.training)
        except InputError as err:
            return err


def _source(folder: Path, weight: float, split: str | None) -> _Source:
    if not (math.isfinite(weight) and weight > 0.0):
        raise InputError(folder, f"has the weight {weight}", "give a number above 0; 1 takes each pair once an epoch")
    dataset = open_dataset(folder, split)
    shards = tuple(shard for shard in dataset.shards if shard.rows)
    if not shards:
        where = split or "any shard"
        raise InputError(folder, f"holds no pair in {where}", "generate more recordings, and split again")
    return _Source(dataset.folder, weight, shards, np.cumsum([0, *(shard.rows for shard in shards)]))


def _check_one_split(folders: Sequence[Path]) -> None:
    """No recording may be in one split here and in another there: what is tested must not have been trained on."""
    split_of: dict[str, tuple[str, Path]] = {}
    for folder in folders:
        recording_of = {shard.path: shard.recording for shard in read_index(folder).shards}
        splits = read_splits(folder / SPLITS_NAME)
        for name, paths in splits.splits.items():
            for recording in {recording_of[path] for path in paths if path in recording_of}:
                other, where = split_of.setdefault(recording, (name, folder))
                if other != name and where != folder:
                    raise InputError(
                        folder,
                        f"has {recording} in {name}, {where} has it in {other}",
                        f"split it again with `--like {where / SPLITS_NAME}`",
                    )
