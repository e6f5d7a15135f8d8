"""Splits: a data set's shards and ratios in, train, validation and test lists out; a recording is in one of them only.

`splits.json` is written beside the index, and the card's header is renewed so that loaders find the splits.
"""

import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti import same_math as sm
from augkitti.dataset_index import (
    SPLITS_NAME,
    DatasetIndex,
    ShardEntry,
    check_contract,
    read_index,
    read_json,
    write_card,
    write_text,
)
from augkitti.errors import InputError
from augkitti.remote import as_path
from augkitti.seeds import generator
from augkitti.shards import CONTRACT_VERSION, read_frames

SPLIT_NAMES = ("train", "validation", "test")
RATIOS = (70.0, 10.0, 20.0)  # method.md section 2
GAP_FRAMES = 10  # frames left out where a recording is divided: a second of driving
_EXACT_RECORDINGS = 9  # up to here every assignment is tried: 3^9 = 19 683
_CUTS = 40  # places tried where a recording of a toy set is divided
_STARTS = 12  # of the search beyond
_SWAPS = 400  # recordings from which on swaps are not tried: moves alone come as near as one small recording


@dataclass(frozen=True)
class Splits:
    """All of `splits.json`."""

    splits: dict[str, tuple[str, ...]]  # shard paths by split, in the order of the index
    ratios: tuple[float, ...]
    seed: int
    divides_recordings: bool = False


def split_dataset(
    folder: Path | str,
    ratios: Sequence[float] = RATIOS,
    seed: int = 0,
    like: Path | str | None = None,
    allow_frames_split: bool = False,
    test_on: Sequence[str] = (),
) -> Splits:
    """Split a finished data set: writes `splits.json` and renews the card.

    Args:
        folder: of the data set.
        ratios: of pairs in train, validation and test; any scale.
        seed: decides between assignments that are equally near the ratios.
        like: another data set's `splits.json`, whose recordings to follow (so that K and AK get one split).
        allow_frames_split: where there are too few recordings, divide the longest by frames, with a gap; for toy sets.
        test_on: recordings to test on, whatever their share; the others are divided into train and validation.

    Raises:
        InputError: the folder is unfinished; ratios that are none; too few recordings; recordings that `like` lacks;
            recordings to test on that are not there.
    """
    folder = as_path(folder)
    index = read_index(folder)
    if like is not None:
        splits = split_like(index.shards, as_path(like))
    elif test_on:
        wanted = check_ratios(ratios)
        splits = Splits(split_held_out(index.shards, wanted, seed, test_on, folder), wanted, seed)
    else:
        wanted = check_ratios(ratios)
        recordings = {shard.recording for shard in index.shards if shard.rows}
        if len(recordings) >= sum(ratio > 0 for ratio in wanted):
            splits = Splits(split_recordings(index.shards, wanted, seed), wanted, seed)
        elif allow_frames_split:
            splits = Splits(split_frames(index.shards, wanted, seed, folder), wanted, seed, divides_recordings=True)
        else:
            raise _too_few(folder, len(recordings), sum(ratio > 0 for ratio in wanted))
    write_splits(folder, index, splits)
    return splits


def split_recordings(
    shards: Sequence[ShardEntry], ratios: Sequence[float] = RATIOS, seed: int = 0
) -> dict[str, tuple[str, ...]]:
    """Shard paths by split: whole recordings, as near the ratios in pairs as they allow, no wanted split empty.

    Near is the sum over splits of the pairs too many or too few. Up to 9 recordings every assignment is tried; beyond,
    a seeded search by moves and swaps.

    Raises:
        InputError: fewer recordings than splits.
    """
    wanted = check_ratios(ratios)
    names = sorted({shard.recording for shard in shards})
    rows: Counter[str] = Counter()
    for shard in shards:
        rows[shard.recording] += shard.rows
    pairs = np.array([rows[name] for name in names], dtype=np.int64)
    usable = [i for i in range(len(names)) if pairs[i] > 0]
    used = [k for k, ratio in enumerate(wanted) if ratio > 0]
    if len(usable) < len(used):
        raise _too_few("the data set", len(usable), len(used))
    share = np.array([wanted[k] for k in used]) / sum(wanted)
    chosen = _assign(pairs[usable], share * pairs.sum(), generator(seed, "split"))
    split_of = {names[i]: SPLIT_NAMES[used[k]] for i, k in zip(usable, chosen, strict=True)}
    return _by_split(shards, lambda shard: split_of.get(shard.recording))


def split_held_out(
    shards: Sequence[ShardEntry], ratios: Sequence[float], seed: int, test_on: Sequence[str], folder: Path
) -> dict[str, tuple[str, ...]]:
    """Named recordings are `test`; the others become train and validation, as near their ratios as they allow.

    Raises:
        InputError: a recording that is not there; too few others.
    """
    there = {shard.recording for shard in shards if shard.rows}
    unknown = sorted(set(test_on) - there)
    if unknown:
        raise InputError(folder, f"holds no pair of {', '.join(unknown)}", f"name some of {', '.join(sorted(there))}")
    others = [shard for shard in shards if shard.recording not in test_on]
    rest = split_recordings(others, (*check_ratios(ratios)[:2], 0.0), seed)
    split_of = {path: name for name, paths in rest.items() for path in paths}
    return _by_split(shards, lambda shard: "test" if shard.recording in test_on else split_of.get(shard.path))


def split_like(shards: Sequence[ShardEntry], like: Path) -> Splits:
    """The same recordings in the same splits as another data set, whose `splits.json` lies beside its index.

    Raises:
        InputError: the other is unreadable, divides a recording, or lacks recordings that are here.
    """
    other = read_splits(like)
    recording_of = {shard.path: shard.recording for shard in read_index(like.parent).shards}
    if other.divides_recordings:
        raise InputError(like, "divides a recording, so it says nothing of other shards", "give a split by recording")
    split_of: dict[str, str] = {}
    for name, paths in other.splits.items():
        for path in paths:
            if path not in recording_of:
                raise InputError(like, f"names a shard that its index lacks ({path})", "split that data set again")
            if split_of.setdefault(recording_of[path], name) != name:
                raise InputError(like, f"has {recording_of[path]} in two splits", "split that data set again")
    unknown = sorted({shard.recording for shard in shards} - split_of.keys())
    if unknown:
        raise InputError(
            like, f"has no split for {', '.join(unknown)}", "split without --like, or generate from the same drives"
        )
    return Splits(_by_split(shards, lambda shard: split_of[shard.recording]), other.ratios, other.seed)


def split_frames(
    shards: Sequence[ShardEntry], ratios: Sequence[float], seed: int, folder: Path
) -> dict[str, tuple[str, ...]]:
    """Shard paths by split where there are fewer recordings than splits: one recording is cut up by frames.

    Between two pieces lie more than `GAP_FRAMES` frames: shards in between are left out of all splits. Reads the frame
    numbers of the shards.

    Raises:
        InputError: no recording has enough shards apart in frames.
    """
    wanted = check_ratios(ratios)
    used = [k for k, ratio in enumerate(wanted) if ratio > 0]
    recordings = sorted({shard.recording for shard in shards if shard.rows})
    if len(recordings) >= len(used):
        return split_recordings(shards, ratios, seed)
    needed = len(used) - len(recordings) + 1
    target = np.array([wanted[k] for k in used]) / sum(wanted) * sum(shard.rows for shard in shards)
    best: tuple[float, list[list[ShardEntry]]] | None = None
    for divided in recordings:
        mine = [shard for shard in shards if shard.recording == divided and shard.rows]
        others = [[s for s in shards if s.recording == name and s.rows] for name in recordings if name != divided]
        for pieces in _pieces([(shard, *_frame_range(folder, shard)) for shard in mine], needed):
            parts = [*pieces, *others]
            for order in _orders(len(parts)):
                sizes = np.array([sum(s.rows for s in parts[i]) for i in order])
                cost = float(np.abs(sizes - target).sum())
                if best is None or cost < best[0] - 1e-9:
                    best = cost, [parts[i] for i in order]
    if best is None:
        raise InputError(
            folder,
            f"holds {len(recordings)} recording(s) for {len(used)} splits, and no {needed} groups of shards of one "
            f"recording lie {GAP_FRAMES} frames apart",
            "generate from more drives",
        )
    split_of = {shard.path: SPLIT_NAMES[k] for k, part in zip(used, best[1], strict=True) for shard in part}
    return _by_split(shards, lambda shard: split_of.get(shard.path))


def write_splits(folder: Path, index: DatasetIndex, splits: Splits) -> None:
    """Write `splits.json` and the card with the splits in it."""
    content = {
        "contract": CONTRACT_VERSION,
        "seed": splits.seed,
        "ratios": list(splits.ratios),
        "divides_recordings": splits.divides_recordings,
        "splits": {name: list(paths) for name, paths in splits.splits.items()},
    }
    write_card(folder, index, splits.splits, splits.divides_recordings)
    write_text(folder / SPLITS_NAME, json.dumps(content, indent=1) + "\n")


def read_splits(path: Path) -> Splits:
    """The splits in a `splits.json`.

    Raises:
        InputError: missing, malformed, or of an unknown contract version.
    """
    if not path.is_file():
        raise InputError(path, "does not exist", "make it with `augkitti split`")
    content = read_json(path)
    check_contract(path, content)
    try:
        splits = {str(name): tuple(_strings(paths)) for name, paths in content["splits"].items()}
        ratios = tuple(float(ratio) for ratio in content["ratios"])
        _strings(list(splits))
        if not isinstance(content["divides_recordings"], bool):
            raise ValueError("`divides_recordings` is true or false")
        return Splits(splits, ratios, int(content["seed"]), content["divides_recordings"])
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as err:
        raise InputError(
            path, f"is no splits file ({type(err).__name__}: {err})", "make it with `augkitti split`"
        ) from err


def _strings(values: Any) -> list[str]:
    if not isinstance(values, list) or not all(isinstance(value, str) and value.isprintable() for value in values):
        raise ValueError("a split is a list of shard paths")
    return values


def check_ratios(ratios: Sequence[float]) -> tuple[float, float, float]:
    """The three ratios as they are, if they can be.

    Raises:
        InputError: not three, negative, not finite, or train is nothing.
    """
    values = tuple(float(ratio) for ratio in ratios)
    if len(values) != 3 or not all(math.isfinite(v) and v >= 0 for v in values) or values[0] <= 0:
        raise InputError(
            "--ratios", f"{' '.join(f'{v:g}' for v in values)} are no ratios", "give three, such as 70 10 20"
        )
    return values[0], values[1], values[2]


def pairs_by_split(index: DatasetIndex, splits: Splits) -> dict[str, tuple[int, int]]:
    """Number of pairs and of recordings in each split."""
    by_path = {shard.path: shard for shard in index.shards}
    return {
        name: (sum(by_path[path].rows for path in paths), len({by_path[path].recording for path in paths}))
        for name, paths in splits.splits.items()
    }


def _too_few(where: Path | str, recordings: int, splits: int) -> InputError:
    return InputError(
        where,
        f"holds {recordings} recording(s) for {splits} splits, and a split never divides a recording",
        "generate from more drives, or for a toy set give --allow-frames-split",
    )


def _by_split(shards: Sequence[ShardEntry], name_of: Any) -> dict[str, tuple[str, ...]]:
    named = [(shard.path, name_of(shard)) for shard in shards]
    return {name: tuple(path for path, its in named if its == name) for name in SPLIT_NAMES}


def _assign(pairs: npt.NDArray[np.int64], target: npt.NDArray[np.float64], rng: np.random.Generator) -> list[int]:
    """Which split each recording goes to."""
    order = rng.permutation(len(pairs))  # the seed decides which recording comes first among equals
    shuffled = pairs[order]
    if len(pairs) <= _EXACT_RECORDINGS:
        found = _try_all(shuffled, target)
    else:
        found = min((_search(shuffled, target, rng) for _ in range(_STARTS)), key=lambda one: one[0])[1]
    chosen = np.empty(len(pairs), dtype=np.int64)
    chosen[order] = found
    return [int(k) for k in chosen]


def _try_all(pairs: npt.NDArray[np.int64], target: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    choices = np.array(list(product(range(len(target)), repeat=len(pairs))), dtype=np.int64)
    held = choices[:, :, None] == np.arange(len(target))
    off = (held * pairs[None, :, None]).sum(axis=1) - target
    cost = np.abs(off).sum(axis=1) + 1e-9 * (off**2).sum(axis=1)  # of equal sums the more even one
    cost[~held.any(axis=1).all(axis=1)] = np.inf
    return np.asarray(choices[int(np.argmin(np.round(cost, 6)))])


def _search(
    pairs: npt.NDArray[np.int64], target: npt.NDArray[np.float64], rng: np.random.Generator
) -> tuple[float, npt.NDArray[np.int64]]:
    """Largest first into the split that lacks most, then moves and swaps while they help."""
    splits = len(target)
    jitter = pairs * sm.exp(rng.normal(0.0, 0.3, len(pairs)))
    chosen = np.zeros(len(pairs), dtype=np.int64)
    lacks = target.astype(np.float64).copy()
    for nth, i in enumerate(np.argsort(-jitter, kind="stable")):
        empty = [k for k in range(splits) if lacks[k] == target[k]]
        must = len(pairs) - nth <= len(empty)
        chosen[i] = empty[0] if must else int(np.argmax(lacks / target))
        lacks[chosen[i]] -= pairs[i]
    cost = float(np.abs(lacks).sum())
    if len(pairs) > _SWAPS:
        return _moves(pairs, chosen, lacks)
    while True:
        best = (cost - 1e-9, -1, -1, -1)
        counts = np.bincount(chosen, minlength=splits)
        for i in range(len(pairs)):
            for k in range(splits):
                if k != chosen[i] and counts[chosen[i]] > 1:
                    best = min(best, (_after(lacks, chosen[i], k, int(pairs[i])), i, k, -1))
            for j in range(i + 1, len(pairs)):
                if chosen[i] != chosen[j]:
                    moved = int(pairs[i] - pairs[j])
                    best = min(best, (_after(lacks, chosen[i], chosen[j], moved), i, int(chosen[j]), j))
        _, i, k, j = best
        if i < 0:
            return cost, chosen
        moved = int(pairs[i]) - (int(pairs[j]) if j >= 0 else 0)
        lacks[chosen[i]] += moved
        lacks[k] -= moved
        if j >= 0:
            chosen[j] = chosen[i]
        chosen[i] = k
        cost = float(np.abs(lacks).sum())


def _moves(
    pairs: npt.NDArray[np.int64], chosen: npt.NDArray[np.int64], lacks: npt.NDArray[np.float64]
) -> tuple[float, npt.NDArray[np.int64]]:
    """The best move of one recording to another split, again and again while one helps."""
    splits = len(lacks)
    while True:
        cost = float(np.abs(lacks).sum())
        rest = cost - np.abs(lacks)[:, None] - np.abs(lacks)[None, :]
        size = pairs[:, None].astype(np.float64)
        after = rest[chosen] + np.abs(lacks[chosen][:, None] + size) + np.abs(lacks[None, :] - size)
        after[np.arange(len(pairs)), chosen] = np.inf
        after[np.bincount(chosen, minlength=splits)[chosen] <= 1] = np.inf
        i, k = divmod(int(np.argmin(after)), splits)
        if not after[i, k] < cost - 1e-9:
            return cost, chosen
        lacks[chosen[i]] += pairs[i]
        lacks[k] -= pairs[i]
        chosen[i] = k


def _after(lacks: npt.NDArray[np.float64], a: int, b: int, moved: int) -> float:
    """The cost once `moved` pairs went from split a to split b."""
    total = float(np.abs(lacks).sum())
    return float(total - abs(lacks[a]) - abs(lacks[b]) + abs(lacks[a] + moved) + abs(lacks[b] - moved))


def _frame_range(folder: Path, shard: ShardEntry) -> tuple[int, int]:
    frames = read_frames(folder / shard.path)
    return min(first for first, _ in frames), max(last for _, last in frames)


def _pieces(shards: list[tuple[ShardEntry, int, int]], needed: int) -> Iterator[list[list[ShardEntry]]]:
    """Ways to cut a recording's shards, by first frame, into `needed` runs that lie more than `GAP_FRAMES` apart.

    Shards between two runs are left out. Of very many shards only some places to cut are tried.
    """
    ordered = sorted(shards, key=lambda item: (item[1], item[2], item[0].path))
    step = max(1, len(ordered) // _CUTS)

    def cut(start: int, left: int, taken: list[list[ShardEntry]]) -> Iterator[list[list[ShardEntry]]]:
        if left == 1:
            yield [*taken, [shard for shard, _, _ in ordered[start:]]]
            return
        for end in range(start + 1, len(ordered), step):
            reach = max(last for _, _, last in ordered[start:end])
            following = next((i for i in range(end, len(ordered)) if ordered[i][1] - reach > GAP_FRAMES), None)
            if following is not None:
                yield from cut(following, left - 1, [*taken, [shard for shard, _, _ in ordered[start:end]]])

    if len(ordered) >= needed:
        yield from cut(0, needed, [])


def _orders(count: int) -> list[tuple[int, ...]]:
    """Every order of a few parts; frames in their own order come first."""
    orders = [order for order in product(range(count), repeat=count) if len(set(order)) == count]
    return sorted(orders)


def check_splits(index: DatasetIndex, splits: Splits) -> list[str]:
    """What is wrong between splits and index, one line each; empty where nothing is."""
    problems = []
    by_path = {shard.path: shard for shard in index.shards}
    listed = [path for paths in splits.splits.values() for path in paths]
    problems += [f"{path} is no shard of the index" for path in sorted(set(listed) - by_path.keys())]
    problems += [f"{a} is listed twice" for a, b in pairwise(sorted(listed)) if a == b]
    problems += [
        f"split `{name}` is none of {', '.join(SPLIT_NAMES)}" for name in splits.splits if name not in SPLIT_NAMES
    ]
    if not splits.divides_recordings:
        somewhere = set(listed)
        problems += [f"{path} is in no split" for path in by_path if path not in somewhere]
        problems += _divided(by_path, splits.splits)
    return problems


def _divided(by_path: Mapping[str, ShardEntry], splits: Mapping[str, Sequence[str]]) -> list[str]:
    split_of: dict[str, str] = {}
    problems = []
    for name, paths in splits.items():
        for path in paths:
            if path in by_path and split_of.setdefault(by_path[path].recording, name) != name:
                problems.append(
                    f"recording {by_path[path].recording} is in {split_of[by_path[path].recording]} and {name}"
                )
    return sorted(set(problems))
