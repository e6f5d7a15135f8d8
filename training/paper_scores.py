"""What Tables 1 and 2 are made of: runs, methods, a plain and an augmented data set in; rows of figures out.

Table 1 (ablation) is of the validation splits and has every run; Table 2 (comparison) is of the test splits and has the
runs trained on K and AK beside the baselines. K is the plain set, K+AK its pairs and the augmented ones together. A
method is timed alone, pair by pair: detections that it follows are there before its clock starts.
"""

import os
import statistics
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import numpy as np

from augkitti.command_line import counted
from augkitti.dataset import Dataset
from augkitti.errors import InputError, MachineError
from augkitti.scan_pair import AugmentedPair
from training.baselines import Method
from training.baselines.followed import sure, true_boxes
from training.checkpoint import load_checkpoint, network_of, shipped_checkpoint
from training.evaluate import open_split
from training.paper_tables import BASELINE, NETWORK, OURS, SETS, Row, lines_of, paper_figures
from training.predict import Predictor
from training.predictions import Prediction
from training.score import Rules, Score, truth_of
from training.team import Team

Boxes = Literal["network", "truth"]
SPLITS = {1: "validation", 2: "test"}  # by table
PLAIN, MIXED = SETS
_LABELS = {"direct": "Ours", "dense": "Ours, dense rigid motion", "object": "Ours, object motion"}


@dataclass(frozen=True)
class Compared:
    """A method that stands beside the network in Table 2."""

    name: str  # of its flow and its row
    label: str  # as a reader sees it
    method: Method
    paper: str | None = None  # which of the paper's lines it is to be held against
    most_pairs: int | None = None  # of each set, where it is slow; its row is then of these alone, and says so
    kind: str = BASELINE
    valid_only: bool = False  # its flow is scored where it has an estimate, as in the paper; the row says on what share


@dataclass(frozen=True, eq=False)
class TrainedRun:
    """A network ready to predict, and what it learned from."""

    name: str
    trained_on: str
    step: int
    predictor: Predictor


@dataclass(frozen=True)
class CloseCars:
    """A pair with cars close to each other, and how far off the first run's flow is on these."""

    pair_id: str
    close_epe: float  # metres
    points: int  # of these cars


@dataclass(frozen=True, eq=False)
class Results:
    """All that the tables say."""

    rows: list[dict[str, Any]]  # as `Report.rows`, with the keys that `paper_tables` asks for
    rules: Rules
    about: dict[str, Any]  # JSON
    per_pair: dict[str, list[dict[str, Any]]]  # by method, of K+AK, test split: as `Report.per_pair`
    close: list[CloseCars]  # of K+AK, test split; the worst first

    def as_json(self) -> dict[str, Any]:
        """What `tables.json` holds."""
        rules = {"text": self.rules.as_text(), "grid": self.rules.grid.model_dump(mode="json")}
        return {"rows": self.rows, "rules": rules, "about": self.about}


class PaperSets:
    """The pairs of K and AK, by split; as many of each as are wanted, spread over it.

    Names of pairs begin with their set's, as those of plain and augmented pairs are alike.
    """

    def __init__(self, kitti_data: Path, data: Path, limit: int | None) -> None:
        if kitti_data.resolve() == data.resolve():
            raise InputError(data, "is given for --data and for --kitti-data", "give the plain set to --kitti-data")
        self._sets: dict[str, dict[str, Dataset]] = {
            split: {"K": open_split(kitti_data, split), "AK": open_split(data, split)} for split in SPLITS.values()
        }
        self._limit = limit

    def count(self, split: str) -> int:
        """Of pairs."""
        return sum(len(self._chosen(data)) for data in self._sets[split].values())

    def pairs(self, split: str) -> Iterator[tuple[str, int, int, AugmentedPair]]:
        """Set, number among its chosen pairs, their count, pair: those of K, then those of AK."""
        for name, data in self._sets[split].items():
            chosen = self._chosen(data)
            for number, place in enumerate(chosen):
                pair = data[place]
                yield name, number, len(chosen), replace(pair, pair_id=f"{name}:{pair.pair_id}")

    def find(self, split: str, pair_id: str) -> AugmentedPair:
        """A pair by the name that it has here."""
        name, _, rest = pair_id.partition(":")
        return replace(self._sets[split][name][rest], pair_id=pair_id)

    def plain(self) -> Dataset:
        """K's test split."""
        return self._sets["test"]["K"]

    def _chosen(self, data: Dataset) -> list[int]:
        return spread_over(len(data), len(data) if self._limit is None else self._limit)


def spread_over(count: int, wanted: int) -> list[int]:
    """At most `wanted` of `count` numbers, evenly."""
    kept = min(count, wanted)
    return [k * count // kept for k in range(kept)]


def load_runs(k_runs: Sequence[Path], k_ak_runs: Sequence[Path], team: Team) -> list[TrainedRun]:
    """All networks, those trained on K first.

    Raises:
        InputError: no such run, or one twice; or they see different parts of the world, so that no figures would
            compare.
    """
    on_k, on_both = [*k_runs], [*k_ak_runs] or [shipped_checkpoint()]
    paths = on_k + on_both
    out: list[TrainedRun] = []
    for path, name in zip(paths, run_names(paths), strict=True):
        trained_on = "K" if len(out) < len(on_k) else MIXED
        checkpoint = load_checkpoint(path)
        predictor = Predictor(network_of(checkpoint, path), checkpoint.settings, team)
        if out and Rules.of(checkpoint.settings) != Rules.of(out[0].predictor.settings):
            raise InputError(path, f"has another grid or other detections than {out[0].name}", "give runs of one kind")
        out.append(TrainedRun(name, trained_on, checkpoint.all_steps, predictor))
    return out


@dataclass(frozen=True, eq=False)
class _Question:
    """A pair of a test split, what the networks said of it, and which methods are asked."""

    eval_set: str  # K or AK
    pair: AugmentedPair
    ours: tuple[tuple[str, Prediction, float], ...]  # run, what it said, seconds
    detections: Prediction
    methods: tuple[Compared, ...]


def compare(
    sets: PaperSets, runs: Sequence[TrainedRun], compared: Sequence[Compared], boxes: Boxes, jobs: int = 1
) -> Results:
    """Every run on the validation splits; those of K+AK and every method on the test splits.

    Args:
        sets: the pairs.
        runs: the networks, those trained on K first.
        compared: the other methods.
        boxes: whose boxes these follow.
        jobs: processes that run them; with more than one each has a single thread.

    Raises:
        MachineError: a process was killed.
    """
    rules = Rules.of(runs[0].predictor.settings)
    ablation, comparison = _Book(1, rules), _Book(2, rules)
    for name, _, _, pair in counted(sets.pairs("validation"), sets.count("validation"), "pairs of validation scored"):
        for run in runs:
            ablation.add(name, run.name, pair, *_timed(partial(run.predictor, pair)))
    mixed = [run for run in runs if run.trained_on == MIXED]
    close: list[CloseCars] = []
    questions = _questions(sets, mixed, compared, boxes, rules)
    for asked, answers in counted(_answered(questions, jobs), sets.count("test"), "pairs of test scored"):
        for run_name, prediction, seconds in asked.ours:
            comparison.add(asked.eval_set, run_name, asked.pair, prediction, seconds)
        close += _close_cars(asked.pair, asked.ours[0][1], rules)
        for one, (said, seconds) in zip(asked.methods, answers, strict=True):
            if tuple(said.flows) != (one.name,):
                raise ValueError(f"`{one.name}` gives flows {', '.join(said.flows)}")
            comparison.add(asked.eval_set, one.name, asked.pair, said, seconds)
    rows = [row for run in runs for row in _run_rows(ablation, run)]
    rows += [row for one in compared for row in _method_rows(comparison, one, mixed[0].name)]
    rows += [row for run in mixed for row in _run_rows(comparison, run)]
    ranked = sorted(close, key=lambda one: (-one.close_epe, one.pair_id))
    per_pair = comparison.per_pair([mixed[0].name, *(one.name for one in compared)])
    return Results(rows, rules, {}, per_pair, ranked)


def _questions(
    sets: PaperSets, mixed: Sequence[TrainedRun], compared: Sequence[Compared], boxes: Boxes, rules: Rules
) -> Iterator[_Question]:
    """Every pair of the test splits, the networks' answers first: methods follow the first one's boxes."""
    for name, number, count, pair in sets.pairs("test"):
        ours = tuple((run.name, *_timed(partial(run.predictor, pair))) for run in mixed)
        methods = tuple(one for one in compared if number in spread_over(count, one.most_pairs or count))
        yield _Question(name, pair, ours, _detections(pair, ours[0][1], boxes, rules), methods)


_Answers = list[tuple[Prediction, float]]


def _answered(questions: Iterator[_Question], jobs: int) -> Iterator[tuple[_Question, _Answers]]:
    """The same with what each method says and how long it took, in their order."""
    if jobs == 1:
        for one in questions:
            yield one, _ask(one.pair, one.detections, one.methods)
        return
    # threads are counted when libraries are loaded: the environment must say it before the first task brings them in
    with ProcessPoolExecutor(jobs, get_context("spawn"), os.putenv, ("OMP_NUM_THREADS", "1")) as pool:
        waiting: deque[tuple[_Question, Future[_Answers]]] = deque()
        try:
            for one in questions:
                waiting.append((one, pool.submit(_ask, one.pair, one.detections, one.methods)))
                if len(waiting) > 2 * jobs:
                    first, answers = waiting.popleft()
                    yield first, answers.result()
            while waiting:
                first, answers = waiting.popleft()
                yield first, answers.result()
        except BrokenProcessPool as err:
            problem = "a worker process was killed, as happens when memory runs out"
            raise MachineError("tables", problem, "use fewer --jobs") from err


def _ask(pair: AugmentedPair, detections: Prediction, methods: Sequence[Compared]) -> _Answers:
    return [_timed(partial(one.method, pair, detections)) for one in methods]


class _Book:
    """Scores of one table: by set and by who said it, as some say something of fewer pairs."""

    def __init__(self, table: int, rules: Rules) -> None:
        self.table = table
        self._rules = rules
        self._scores: dict[tuple[str, str], Score] = {}
        self._seconds: dict[tuple[str, str], list[float]] = defaultdict(list)

    def add(self, name: str, who: str, pair: AugmentedPair, said: Prediction, seconds: float) -> None:
        """What `who` says about a pair of the set K or AK."""
        for eval_set in SETS if name == PLAIN else (MIXED,):
            self._scores.setdefault((eval_set, who), Score(self._rules)).add(pair, [said])
            self._seconds[eval_set, who].append(seconds)

    def rows(self, who: str) -> Iterator[dict[str, Any]]:
        """Of K and K+AK, with what every row has: table, set, time and coverage."""
        for eval_set in SETS:
            if (eval_set, who) in self._scores:
                for row in self._scores[eval_set, who].report().rows:
                    yield {
                        **row,
                        "table": self.table,
                        "split": SPLITS[self.table],
                        "eval_set": eval_set,
                        "seconds": statistics.median(self._seconds[eval_set, who]),
                        "coverage": row["covered"],
                    }

    def pairs(self, eval_set: str, who: str) -> int:
        """How many `who` was asked about."""
        return len(self._seconds[eval_set, who])

    def per_pair(self, names: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
        """Errors of every pair of K+AK, by flow."""
        out: dict[str, list[dict[str, Any]]] = {}
        for who in names:
            if (MIXED, who) in self._scores:
                out |= self._scores[MIXED, who].report().per_pair
        return out


def _run_rows(book: _Book, run: TrainedRun) -> Iterator[dict[str, Any]]:
    for row in book.rows(run.name):
        ours = run.trained_on if book.table == 1 else "Ours"
        paper = paper_figures(book.table, row["eval_set"], ours) if row["method"] == OURS else None
        facts = {"trained_on": run.trained_on, "run": run.name, "step": run.step, "kind": NETWORK, "whole": True}
        yield {**row, **facts, "label": _LABELS.get(row["method"], row["method"]), "paper": paper}


def _method_rows(book: _Book, one: Compared, against: str) -> Iterator[dict[str, Any]]:
    for row in book.rows(one.name):
        whole = book.pairs(row["eval_set"], one.name) == book.pairs(row["eval_set"], against)
        facts: dict[str, Any] = {
            "trained_on": None, "run": None, "step": None, "kind": one.kind, "whole": whole,
        }  # fmt: skip
        label = one.label
        if one.valid_only:
            facts["all_points"] = {key: row[key] for key in row["given_only"]}
            row, label = {**row, **row["given_only"]}, f"{label} (valid {100 * row['coverage']:.0f} %)"
        yield {**row, **facts, "label": label, "paper": paper_figures(2, row["eval_set"], one.paper)}


class Again:
    """Single pairs of the test splits once more, for pictures."""

    def __init__(
        self,
        sets: PaperSets,
        runs: Sequence[TrainedRun],
        compared: Sequence[Compared],
        boxes: Boxes,
        rules: Rules,
    ) -> None:
        self.sets, self.rules = sets, rules
        self.labels = {OURS: _LABELS[OURS], **{one.name: one.label for one in compared}}
        self._first = next(run for run in runs if run.trained_on == MIXED)
        self._methods = {one.name: one.method for one in compared}
        self._boxes: Boxes = boxes

    def __call__(self, pair_id: str, methods: Sequence[str] = ()) -> tuple[AugmentedPair, dict[str, Prediction]]:
        """A pair, and what the network (under `direct`) and some methods say about it."""
        pair = self.sets.find("test", pair_id)
        ours = self._first.predictor(pair)
        detections = _detections(pair, ours, self._boxes, self.rules)
        return pair, {OURS: ours, **{name: self._methods[name](pair, detections) for name in methods}}


def best_baselines(rows: Sequence[Row], most: int = 2) -> list[str]:
    """Names of the methods with the least foreground error on K+AK; those of fewer pairs and references left out."""
    lines = [line for line in lines_of(rows, 2) if line.eval_set == MIXED and line.kind == BASELINE and line.contends]
    known = [(line.rows[0]["fg_epe"], line.rows[0]["method"]) for line in lines if line.rows[0]["fg_epe"] is not None]
    return [name for _, name in sorted(known)[:most]]


def _timed(predict: Callable[[], Prediction]) -> tuple[Prediction, float]:
    start = time.perf_counter()
    said = predict()
    return said, time.perf_counter() - start


def _detections(pair: AugmentedPair, ours: Prediction, boxes: Boxes, rules: Rules) -> Prediction:
    return true_boxes(pair, rules.category) if boxes == "truth" else sure(pair, ours, rules.score)


def _close_cars(pair: AugmentedPair, ours: Prediction, rules: Rules) -> list[CloseCars]:
    """The pair, if cars in it stand close to each other."""
    truth = truth_of(pair, rules)
    on_close = truth.fg & np.append(truth.close & truth.judged, False)[truth.object] & ours.where[truth.rows]
    if not truth.close_pairs or not on_close.any():
        return []
    error = np.linalg.norm(ours.flows[OURS][truth.rows][on_close] - truth.flow[on_close], axis=1)
    return [CloseCars(pair.pair_id, float(error.mean()), int(on_close.sum()))]


def run_names(paths: Sequence[Path]) -> list[str]:
    """A name for each run: the last folders of its path, as many as tell it from the others.

    Raises:
        InputError: a run is given twice.
    """
    shipped = shipped_checkpoint().resolve()
    places = [path.resolve() for path in paths]
    for path, place in zip(paths, places, strict=True):
        if places.count(place) > 1:
            raise InputError(path, "is given twice as a run", "give runs trained apart: on K, and on K and AK")
    parts = [_parts(place) if place != shipped else ("shipped",) for place in places]
    names = [mine[-1:] for mine in parts]
    while len(set(names)) < len(names) and any(len(name) < len(mine) for name, mine in zip(names, parts, strict=True)):
        names = [
            mine[-len(name) - 1 :] if names.count(name) > 1 else name for name, mine in zip(names, parts, strict=True)
        ]
    return ["/".join(name) for name in names]


def _parts(place: Path) -> tuple[str, ...]:
    """Of a run's path; two folders above a file that only says `checkpoint.pt` are no name of its own."""
    if place.name == "checkpoint.pt":
        return place.parent.parts[1:]
    return (place.with_suffix("") if place.suffix == ".pt" else place).parts[1:]
