"""Pairs with their truth and what methods say about them in, figures out; without torch, so a new figure needs no GPU.

`Score.add` takes pair after pair, `Score.report` gives the rows. Every method is judged on the same points: flow
known, inside the grid, not on a neutral or an ignored box. What it has no estimate for moves with its ego-motion, or
not at all.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import F32, F64, Array, transform_points
from augkitti.scan_pair import AugmentedPair, Bool
from training.baselines import BASELINES, rigid_flow
from training.boxes import covered_bev, gaps_bev, iou_3d, rotated_iou_bev
from training.config import GridConfig, Settings
from training.metrics import (
    DYNAMIC_M,
    Buckets,
    accuracy,
    average_precision,
    end_point_error,
    match_one_to_one,
    rotation_error,
    spread,
    translation_error,
    wrapped,
    yaw_error,
)
from training.predictions import Prediction
from training.rigid_motion import motion_of, world_to_local
from training.sample import is_labelled

I64 = npt.NDArray[np.int64]
Predictor = Callable[[AugmentedPair], Prediction]

CLASSES = ("BACKGROUND", "CAR", "OTHER_VEHICLES", "PEDESTRIAN", "WHEELED_VRU", "OTHER")  # bucketed-scene-flow-eval's
_CLASS_OF = {"Car": 1, "Van": 2, "Truck": 2, "Tram": 2, "Pedestrian": 3, "Person_sitting": 3, "Cyclist": 4}
RANGES_M = (0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, np.inf)
SPEEDS_M = (0.0, 0.05, 0.2, 0.5, 1.0, 1.5, 2.0, 2.5, np.inf)  # over ground, metres a pair: at 10 Hz tenths of m/s
POINTS = (0.0, 10.0, 20.0, 50.0, 100.0, 200.0, 500.0, 1000.0, np.inf)
_APS = {"ap_bev50": ("bev", 0.5), "ap_bev70": ("bev", 0.7), "ap_3d50": ("3d", 0.5), "ap_3d70": ("3d", 0.7)}
_FOUND = "ap_bev50"  # the overlap that makes a detection a true positive, whose motion is judged
_ON_NEUTRAL = 0.5  # share of a detection's footprint on boxes that do not count: it does not count either


@dataclass(frozen=True)
class Rules:
    """What counts; the same for every method, printed with the figures."""

    grid: GridConfig = field(default_factory=GridConfig)
    category: str = "Car"  # foreground
    neutral: tuple[str, ...] = ("Van",)  # their points and detections upon them count for nothing
    least_points: int = 5  # cars with fewer in the grid count for nothing either
    score: float = 0.5  # detections of lower score count for average precision alone
    close_m: float = 4.0  # cars nearer to each other than this are scored apart
    close_between: Literal["footprints", "centres"] = "footprints"
    within_m: float = 35.0  # |x|, |y| of points for three-way and bucketed errors: bucketed-scene-flow-eval's default

    @classmethod
    def of(cls, settings: Settings, **changes: Any) -> "Rules":
        """With the grid, category and score threshold of a network's settings; what is neutral here is not theirs."""
        rules = cls(settings.grid, settings.detection.category, score=settings.detection.score)
        return replace(rules, **changes)

    def as_text(self) -> str:
        """In two lines."""
        grid = ", ".join(
            f"{axis} {low:g} to {high:g}"
            for axis, (low, high) in zip("xyz", (self.grid.x_m, self.grid.y_m, self.grid.z_m), strict=True)
        )
        neutral = " and ".join(self.neutral) or "nothing"
        return (
            f"Points of known flow with {grid} m. Foreground is {self.category}, background all else; {neutral} "
            f"neutral; boxes under {self.least_points} points ignored.\n"
            f"Object motions over detections of score {self.score:g} or more, BEV IoU 0.5, one to one by score. Cars "
            f"whose {self.close_between} are closer than {self.close_m:g} m also apart. Three-way and bucketed errors "
            f"within {self.within_m:g} m."
        )


@dataclass(frozen=True, eq=False)
class Truth:
    """What a pair's shard row says, cut to what is judged: K points, B objects with a box, C cells of true cars."""

    pair_id: str
    rows: I64  # (K,) of the points in scan 0, ascending
    points: int  # N0
    xyz: F64  # (K, 3)
    flow: F64  # (K, 3)
    own_m: F64  # (K,) speed over ground, metres a pair
    fg: Bool  # (K,) on a car that counts
    bg: Bool  # (K,) neither on a car nor on anything neutral
    kind: I64  # (K,) row in CLASSES
    object: I64  # (K,) row in boxes of foreground points; -1 elsewhere
    boxes: F64  # (B, 7)
    counts: Bool  # (B,) cars whose points are foreground
    judged: Bool  # (B,) of these, what detection has to find: centre in the grid, where labels reach, or virtual
    motions: F64  # (B, 4, 4)
    has_motion: Bool  # (B,)
    own_motion_m: F64  # (B,) how far the centre moves over ground; NaN where not known
    on_points: I64  # (B,) points in the grid
    close: Bool  # (B,) another car or neutral box stands closer than Rules.close_m
    close_pairs: int  # of cars that count
    virtual: Bool  # (B,)
    neutral: Bool  # (B,) a detection upon it does not count
    ego_motion: F64  # (4, 4)
    cells: npt.NDArray[np.int32]  # (C, 2) columns most of whose points are one car's
    cell_motions: F64  # (C, 3) that car's motion about the cell's centre
    labels_reach: Callable[[Array], Bool]  # (n, 2) places -> (n,)


def inside_grid(xyz: Array, grid: GridConfig) -> Bool:
    """Which points (N, 3) lie in the grid; its upper faces are outside."""
    low = np.array([grid.x_m[0], grid.y_m[0], grid.z_m[0]])
    high = np.array([grid.x_m[1], grid.y_m[1], grid.z_m[1]])
    return np.asarray(((xyz >= low) & (xyz < high)).all(axis=-1))


def truth_of(pair: AugmentedPair, rules: Rules) -> Truth:
    """What of a pair is judged, and what the right answer is.

    Raises:
        InputError: a point names an object that is not there.
    """
    if len(pair.scan0) and not -1 <= pair.scan0.instance.min() <= pair.scan0.instance.max() < len(pair.objects):
        raise InputError(pair.pair_id, f"a point names none of its {len(pair.objects)} objects", "generate it again")
    inside = inside_grid(pair.scan0.xyz, rules.grid)
    rows_of = np.array([row for row, item in enumerate(pair.objects) if item.box0 is not None], dtype=np.int64)
    items = [pair.objects[row] for row in rows_of]
    place = np.full(len(pair.objects) + 1, -1, dtype=np.int64)
    place[rows_of] = np.arange(len(items))
    kind_of = np.array([_CLASS_OF.get(item.category, len(CLASSES) - 1) for item in pair.objects] + [0], dtype=np.int64)
    instance = pair.scan0.instance.astype(np.int64)
    on_points = np.bincount(instance[inside & (instance >= 0)], minlength=len(pair.objects))[: len(pair.objects)]

    is_car = np.array([item.category == rules.category for item in pair.objects], dtype=bool)
    is_neutral = np.array([item.category in rules.neutral for item in pair.objects], dtype=bool)
    has_box = np.isin(np.arange(len(pair.objects)), rows_of)
    counts = is_car & has_box & (on_points >= rules.least_points)
    silent = np.append((is_car & ~counts) | is_neutral, False)  # last: no object

    known = inside & (pair.flow_status0 == 0)
    rows = np.flatnonzero(known & ~silent[instance])
    xyz = pair.scan0.xyz[rows].astype(np.float64)
    flow = pair.flow0[rows].astype(np.float64)
    fg = np.append(counts, False)[instance[rows]]

    boxes = np.array([item.box0 for item in items]).reshape(-1, 7)
    has_motion = np.array([item.motion is not None for item in items], dtype=bool)
    motions = np.array([np.eye(4) if item.motion is None else item.motion for item in items]).reshape(-1, 4, 4)
    centres = boxes[:, :3]
    own_motion = translation_error(motions, pair.ego_motion[None], centres)
    own_motion[~has_motion] = np.nan
    virtual = np.array([item.origin == "virtual" for item in items], dtype=bool)
    reach = partial(is_labelled, coverage=pair.label_coverage, azimuth=pair.label_azimuth)
    judged = counts[rows_of] & inside_grid(centres, rules.grid) & (virtual | reach(centres[:, :2]))
    near = (is_car | is_neutral)[rows_of]
    between = gaps_bev(boxes, boxes)
    if rules.close_between == "centres":
        between = np.linalg.norm(boxes[:, None, :2] - boxes[None, :, :2], axis=2)
    gaps = between + np.where(np.eye(len(boxes), dtype=bool) | ~near[None], np.inf, 0.0)
    both = (gaps < rules.close_m) & counts[rows_of][:, None] & counts[rows_of][None]
    cells, cell_motions = _cells_of_cars(pair, np.flatnonzero(known), counts, rules.grid)
    return Truth(
        pair_id=pair.pair_id,
        rows=rows,
        points=len(pair.scan0),
        xyz=xyz,
        flow=flow,
        own_m=end_point_error(flow, rigid_flow(pair.ego_motion, pair.scan0.xyz[rows])),
        fg=fg,
        bg=~fg,
        kind=kind_of[instance[rows]],
        object=np.where(fg, place[instance[rows]], -1),
        boxes=boxes,
        counts=counts[rows_of],
        judged=judged,
        motions=motions,
        has_motion=has_motion,
        own_motion_m=own_motion,
        on_points=on_points[rows_of],
        close=np.asarray((gaps < rules.close_m).any(axis=1), dtype=bool),
        close_pairs=int(both.sum()) // 2,
        virtual=virtual,
        neutral=near & ~judged,
        ego_motion=pair.ego_motion,
        cells=cells,
        cell_motions=cell_motions,
        labels_reach=reach,
    )


def _cells_of_cars(pair: AugmentedPair, rows: I64, counts: Bool, grid: GridConfig) -> tuple[npt.NDArray[np.int32], F64]:
    """Voxel columns most of whose points of known flow are one car's (of equal numbers the car's), and its motion."""
    size = np.array(grid.voxel_m[:2])
    low = np.array([grid.x_m[0], grid.y_m[0]])
    column = np.floor((pair.scan0.xyz[rows, :2] - low) / size).astype(np.int64)
    shape = grid.shape
    flat = np.clip(column[:, 0], 0, shape[0] - 1) * shape[1] + np.clip(column[:, 1], 0, shape[1] - 1)
    body = pair.scan0.instance[rows].astype(np.int64) + 1
    bodies = len(pair.objects) + 1
    pairs, number = np.unique(flat * bodies + body, return_counts=True)
    order = np.lexsort((pairs % bodies, number, pairs // bodies))  # of equal numbers the world first
    columns = pairs[order] // bodies
    last = np.append(columns[1:] != columns[:-1], True)[: len(columns)]
    winner = pairs[order][last]
    item = winner % bodies - 1
    moving = np.array([o.motion is not None for o in pair.objects] + [False], dtype=bool)
    mine = np.append(counts, False)[item] & moving[item]
    cell = np.stack([winner[mine] // bodies // shape[1], winner[mine] // bodies % shape[1]], axis=1)
    motions = np.array([pair.objects[k].motion for k in item[mine]]).reshape(-1, 4, 4)
    return cell.astype(np.int32), world_to_local(motion_of(motions), low + (cell + 0.5) * size)


@dataclass(frozen=True, eq=False)
class _Detections:
    """How a prediction's boxes meet the truth; the same for all its flows."""

    scores: F64  # (n,)
    match: dict[str, I64]  # by figure: row of the truth, -1 for none
    judged: dict[str, Bool]  # by figure: counts as right or wrong


def _detect(truth: Truth, prediction: Prediction, rules: Rules) -> _Detections | None:
    if prediction.boxes is None or prediction.scores is None:
        return None
    boxes, scores = prediction.boxes, prediction.scores
    judged_rows = np.flatnonzero(truth.judged)
    overlap = {"bev": rotated_iou_bev(boxes, truth.boxes[judged_rows]), "3d": iou_3d(boxes, truth.boxes[judged_rows])}
    on_neutral = covered_bev(boxes, truth.boxes[truth.neutral]).sum(axis=1) >= _ON_NEUTRAL
    on_judged = (covered_bev(boxes, truth.boxes[judged_rows]) >= _ON_NEUTRAL).any(axis=1)
    where_judged = on_judged | (truth.labels_reach(boxes[:, :2]) & inside_grid(boxes[:, :3], rules.grid) & ~on_neutral)
    match, judged = {}, {}
    for name, (how, least) in _APS.items():
        found = match_one_to_one(overlap[how], scores, least)
        match[name] = np.append(judged_rows, -1)[found]
        judged[name] = where_judged | (found >= 0)
    return _Detections(scores, match, judged)


class _Tally:
    """Sums and lists of one method, pair after pair."""

    def __init__(self) -> None:
        self.pairs: list[dict[str, Any]] = []
        self.ego: list[tuple[float, ...]] = []
        self.groups = {name: np.zeros(5) for name in ("fg", "bg")}  # points, error, strict, relaxed, outliers
        self.given = {name: np.zeros(2) for name in ("fg", "bg")}  # points with an estimate, their error
        self.bg_range = np.zeros((2, len(RANGES_M) - 1))
        self.three_way = Buckets.empty(2, np.array([0.0, DYNAMIC_M, np.inf]))
        self.bucketed = Buckets.empty(len(CLASSES))
        self.objects: list[F64] = []  # (b, len(_OBJECT)) of every pair
        self.cells: list[F64] = []  # (c, 2) errors of translation and rotation
        self.detections: dict[str, list[tuple[F64, Bool]]] = {name: [] for name in _APS}
        self.left_out = 0
        self.has_boxes = self.has_motions = self.has_cells = False


# what is kept of every car that counts, by method
_OBJECT = (
    "points", "error", "spread", "range", "speed", "close", "judged", "found",
    "rot", "tr_lidar", "tr_centre", "yaw", "tr_centre_xy",
)  # fmt: skip
_AT = {name: k for k, name in enumerate(_OBJECT)}


class Score:
    """Figures of several methods over the same pairs."""

    def __init__(self, rules: Rules) -> None:
        self.rules = rules
        self._tallies: dict[str, _Tally] = {}
        self._names: list[tuple[str, ...]] = []
        self._pairs = 0
        self._close_pairs = 0
        self._virtual = 0

    def add(self, pair: AugmentedPair, predictions: Sequence[Prediction]) -> None:
        """One more pair, with what every method says about it; the methods are the same for all pairs.

        Raises:
            InputError: a flow is not finite where there is an estimate, or the pair is damaged.
            ValueError: other methods than before, a method twice, a prediction of another pair.
        """
        names = [name for one in predictions for name in one.flows]
        if len(set(names)) != len(names) or (self._tallies and names != list(self._tallies)):
            raise ValueError(f"pair {pair.pair_id} has methods {', '.join(names)}, not {', '.join(self._tallies)}")
        truth = truth_of(pair, self.rules)
        for one in predictions:
            if one.pair_id != pair.pair_id or len(one.where) != truth.points:
                raise ValueError(f"prediction of {one.pair_id}, {len(one.where)} points, for pair {pair.pair_id}")
            detections = _detect(truth, one, self.rules)
            for name, flow in one.flows.items():
                tally = self._tallies.setdefault(name, _Tally())
                _add_one(tally, truth, one, flow, detections, self.rules)
        self._pairs += 1
        self._close_pairs += truth.close_pairs
        self._virtual += int((truth.judged & truth.virtual).sum())

    def report(self, about_run: dict[str, Any] | None = None) -> "Report":
        """The rows, in the order in which the methods came.

        Raises:
            InputError: no pairs came.
        """
        if not self._pairs:
            raise InputError("the data", "hold no pairs to score", "give another split, or a data set with pairs")
        rows = [_row(name, tally, self._pairs) for name, tally in self._tallies.items()]
        for row in rows:
            row["close"]["pairs_of_cars"] = self._close_pairs
        return Report(rows, self.rules, about_run or {}, {n: t.pairs for n, t in self._tallies.items()})


@dataclass(frozen=True)
class Report:
    """Figures of all methods, and of every pair by method."""

    rows: list[dict[str, Any]]  # JSON: the columns of `report_tables.COLUMNS` and more; None where there is nothing
    rules: Rules
    about: dict[str, Any]  # JSON: data, split, checkpoint
    per_pair: dict[str, list[dict[str, Any]]]  # pair_id, fg_epe, bg_epe, all_epe, ego_rot, ego_tr

    def as_json(self) -> dict[str, Any]:
        """What `--json` writes."""
        rules = asdict(self.rules) | {"grid": self.rules.grid.model_dump(mode="json")}
        return {"rows": self.rows, "rules": rules, "about": self.about}

    def telling_pairs(self, method: str) -> dict[str, str]:
        """Names of the `best`, `median` and `worst` pair of a method by error over all points; fewer of few pairs."""
        scored = [one for one in self.per_pair[method] if one["all_epe"] is not None]
        ordered = sorted(scored, key=lambda one: (one["all_epe"], one["pair_id"]))
        if not ordered:
            return {}
        names = {"best": ordered[0], "median": ordered[len(ordered) // 2], "worst": ordered[-1]}
        return {which: one["pair_id"] for which, one in names.items()}


def score_pairs(
    pairs: Iterable[AugmentedPair],
    predictors: Sequence[Predictor],
    rules: Rules,
    score: Score | None = None,
) -> Score:
    """Every pair through every predictor, judged. `score` goes on with one that has pairs of another data set.

    A file of predictions is one: `lambda pair: file.of(pair.pair_id, len(pair.scan0))`; a baseline is another.
    """
    score = Score(rules) if score is None else score
    for pair in pairs:
        score.add(pair, [predictor(pair) for predictor in predictors])
    return score


def baseline_predictors(names: Sequence[str] = tuple(BASELINES)) -> list[Predictor]:
    """The rows that always stand beside the network."""
    return [lambda pair, method=BASELINES[name]: method(pair, None) for name in names]  # type: ignore[misc]


def _add_one(
    tally: _Tally, truth: Truth, prediction: Prediction, flow: F32, detections: _Detections | None, rules: Rules
) -> None:
    given = prediction.where[truth.rows]
    said = flow[truth.rows].astype(np.float64)
    if not np.isfinite(said[given]).all():
        raise InputError(truth.pair_id, "its predicted flow is not finite", "predict again")
    rest = truth.xyz[~given]
    said[~given] = 0.0 if prediction.ego_motion is None else transform_points(prediction.ego_motion, rest) - rest
    wrong = said - truth.flow
    error = np.asarray(np.linalg.norm(wrong, axis=1))
    flags = accuracy(error, np.asarray(np.linalg.norm(truth.flow, axis=1)))
    means: dict[str, float | None] = {}
    for name, mine in (("fg", truth.fg), ("bg", truth.bg)):
        here = np.array([mine.sum(), error[mine].sum(), *(flag[mine].sum() for flag in flags)])
        tally.groups[name] += here
        tally.given[name] += (mine & given).sum(), error[mine & given].sum()
        means[f"{name}_epe"] = _share(here[1], here[0])
    means["all_epe"] = _share(float(error.sum()), len(error))

    bin_ = _bins(np.hypot(truth.xyz[truth.bg, 0], truth.xyz[truth.bg, 1]), RANGES_M)
    for k, weights in enumerate((None, error[truth.bg])):
        tally.bg_range[k] += np.bincount(bin_, weights, minlength=len(RANGES_M) - 1)
    near = np.abs(truth.xyz[:, :2]).max(axis=1, initial=0.0) < rules.within_m
    tally.three_way.add(truth.fg[near].astype(np.int64), error[near], truth.own_m[near])
    tally.bucketed.add(truth.kind[near], error[near], truth.own_m[near])

    tally.objects.append(_object_rows(truth, wrong, error, prediction, detections, rules))
    _add_ego(tally, truth, prediction, means)
    _add_cells(tally, truth, prediction, rules)
    if detections is not None:
        tally.has_boxes = True
        tally.has_motions |= prediction.motions is not None
        for name in _APS:
            kept = detections.judged[name]
            tally.detections[name].append((detections.scores[kept], (detections.match[name] >= 0)[kept]))
        tally.left_out += int((~detections.judged[_FOUND]).sum())


def _object_rows(
    truth: Truth, wrong: F64, error: F64, prediction: Prediction, detections: _Detections | None, rules: Rules
) -> F64:
    """What is kept of the pair's cars, (b, len(_OBJECT)); NaN where there is nothing."""
    out = np.full((len(truth.boxes), len(_OBJECT)), np.nan)
    mine = truth.fg
    columns: dict[str, Array] = {
        "points": np.bincount(truth.object[mine], minlength=len(out)),
        "error": np.bincount(truth.object[mine], error[mine], minlength=len(out)),
        "spread": spread(wrong[mine], truth.object[mine], len(out)),
        "range": np.hypot(truth.boxes[:, 0], truth.boxes[:, 1]),
        "speed": truth.own_motion_m,
        "close": truth.close,
        "judged": truth.judged,
        "found": np.zeros(len(out)),
    }
    for name, values in columns.items():
        out[:, _AT[name]] = values
    if detections is not None:
        sure = (detections.match[_FOUND] >= 0) & (detections.scores >= rules.score)
        which, row = np.flatnonzero(sure), detections.match[_FOUND][sure]
        out[row, _AT["found"]] = 1.0
        if prediction.motions is not None:
            known = truth.has_motion[row]
            which, row = which[known], row[known]
            said, true, centre = prediction.motions[which], truth.motions[row], truth.boxes[row, :3]
            at = transform_points(said, centre) - transform_points(true, centre)
            out[row, _AT["rot"]] = rotation_error(said, true)
            out[row, _AT["tr_lidar"]] = translation_error(said, true)
            out[row, _AT["tr_centre"]] = translation_error(said, true, centre)
            out[row, _AT["yaw"]] = yaw_error(said, true)
            out[row, _AT["tr_centre_xy"]] = np.hypot(at[:, 0], at[:, 1])
    return np.column_stack([out, truth.on_points])[truth.counts]


def _add_ego(tally: _Tally, truth: Truth, prediction: Prediction, means: dict[str, float | None]) -> None:
    said = prediction.ego_motion
    ego: tuple[float, ...] | None = None
    if said is not None:
        off = said[:2, 3] - truth.ego_motion[:2, 3]
        ego = (
            float(rotation_error(said, truth.ego_motion)),
            float(translation_error(said, truth.ego_motion)),
            float(yaw_error(said, truth.ego_motion)),
            float(np.hypot(*off)),
        )
        tally.ego.append(ego)
    rest = {"ego_rot": ego and ego[0], "ego_tr": ego and ego[1]}
    tally.pairs.append({"pair_id": truth.pair_id, **means, **rest})


def _add_cells(tally: _Tally, truth: Truth, prediction: Prediction, rules: Rules) -> None:
    """Errors of the dense rigid motion, about each cell's own centre, where true cars are."""
    if prediction.columns is None or prediction.column_motions is None:
        return
    tally.has_cells = True
    width = rules.grid.shape[1]
    said = prediction.columns[:, 0].astype(np.int64) * width + prediction.columns[:, 1]
    true = truth.cells[:, 0].astype(np.int64) * width + truth.cells[:, 1]
    _, which, row = np.intersect1d(said, true, return_indices=True)
    off = prediction.column_motions[which].astype(np.float64) - truth.cell_motions[row]
    tally.cells.append(np.stack([np.hypot(off[:, 0], off[:, 1]), np.abs(wrapped(off[:, 2]))], axis=1))


def _row(name: str, tally: _Tally, pairs: int) -> dict[str, Any]:
    """A method's figures."""
    groups = {**tally.groups, "all": tally.groups["fg"] + tally.groups["bg"]}
    given = {**tally.given, "all": tally.given["fg"] + tally.given["bg"]}
    objects = np.concatenate(tally.objects) if tally.objects else np.zeros((0, len(_OBJECT) + 1))
    judged = objects[:, _AT["judged"]] == 1.0
    moved = _motions(objects, tally)
    cells = np.concatenate(tally.cells) if tally.cells else np.zeros((0, 2))
    ego = np.array(tally.ego) if len(tally.ego) == pairs and pairs else None
    covered = _share(given["all"][0], groups["all"][0])
    return {
        "method": name,
        **{f"{group}_epe": _share(groups[group][1], groups[group][0]) for group in groups},
        **{f"obj_{key}": moved[key] for key in ("rot", "tr_lidar", "tr_centre")},
        **{key: None if ego is None else float(ego[:, k].mean()) for k, key in enumerate(("ego_rot", "ego_tr"))},
        **{key: _precision(tally, key, int(judged.sum())) for key in _APS},
        "pairs": pairs,
        "fg_points": int(groups["fg"][0]),
        "bg_points": int(groups["bg"][0]),
        "objects": int(judged.sum()),
        "true_positives": moved["found"],
        "obj_motions": moved["motions"],
        **{f"obj_{key}": moved[key] for key in ("yaw", "tr_centre_xy")},
        **{key: None if ego is None else float(ego[:, k + 2].mean()) for k, key in enumerate(("ego_yaw", "ego_tr_xy"))},
        "rigid_tr_local": float(cells[:, 0].mean()) if len(cells) else None,
        "rigid_rot": float(cells[:, 1].mean()) if len(cells) else None,
        "rigid_cells": len(cells) if tally.has_cells else None,
        "covered": covered,
        "given_only": {f"{group}_epe": _share(given[group][1], given[group][0]) for group in given},
        "detections": sum(len(scores) for scores, _ in tally.detections[_FOUND]) if tally.has_boxes else None,
        "detections_not_judged": tally.left_out if tally.has_boxes else None,
        "accuracy": {
            group: {
                "acc_s": _share(sums[2], sums[0]),
                "acc_r": _share(sums[3], sums[0]),
                "outliers": _share(sums[4], sums[0]),
                "points": int(sums[0]),
            }
            for group, sums in groups.items()
        },
        "three_way": _three_way(tally.three_way),
        "bucketed": _bucketed(tally.bucketed),
        "by_range": _by(objects, tally, _AT["range"], RANGES_M, tally.bg_range),
        "by_speed": _by(objects, tally, _AT["speed"], SPEEDS_M),
        "by_points": _by(objects, tally, len(_OBJECT), POINTS),
        "close": _of_objects(objects[objects[:, _AT["close"]] == 1.0], tally),
        "apart": _of_objects(objects[objects[:, _AT["close"]] == 0.0], tally),
        "spread": {
            "mean": _mean(objects[:, _AT["spread"]]),
            "objects": int(np.isfinite(objects[:, _AT["spread"]]).sum()),
        },
    }


def _precision(tally: _Tally, name: str, truths: int) -> float | None:
    if not tally.has_boxes:
        return None
    scores, true = (np.concatenate(part) for part in zip(*tally.detections[name], strict=True))
    return average_precision(scores, true, truths)


def _motions(objects: F64, tally: _Tally) -> dict[str, Any]:
    """Mean errors of motion over the objects found, their number, and how many have a known motion."""
    keys = ("rot", "tr_lidar", "tr_centre", "yaw", "tr_centre_xy")
    found = objects[:, _AT["found"]] == 1.0
    return {
        **{key: _mean(objects[:, _AT[key]]) for key in keys},
        "found": int(found.sum()) if tally.has_boxes else None,
        "motions": int(np.isfinite(objects[:, _AT["rot"]]).sum()) if tally.has_motions else None,
    }


def _of_objects(objects: F64, tally: _Tally) -> dict[str, Any]:
    """Figures of some of the cars: flow over their points, share found, motions of those found; with counts."""
    judged = objects[objects[:, _AT["judged"]] == 1.0]
    moved = _motions(objects, tally)
    points = float(objects[:, _AT["points"]].sum())
    return {
        "fg_epe": _share(float(objects[:, _AT["error"]].sum()), points),
        "fg_points": int(points),
        "objects": len(judged),
        "recall": _share(float(judged[:, _AT["found"]].sum()), len(judged)) if tally.has_boxes else None,
        "obj_motions": moved["motions"],
        **{f"obj_{key}": moved[key] for key in ("rot", "tr_lidar", "tr_centre")},
    }


def _by(
    objects: F64, tally: _Tally, column: int, edges: Sequence[float], background: F64 | None = None
) -> list[dict[str, Any]]:
    """`_of_objects` for each bin of one of their columns; by range the background's error too."""
    bins = _bins(objects[:, column], edges)
    out = []
    for k in range(len(edges) - 1):
        upper = edges[k + 1]
        one = {"from": edges[k], "to": None if np.isinf(upper) else upper, **_of_objects(objects[bins == k], tally)}
        if background is not None:
            one |= {"bg_epe": _share(background[1, k], background[0, k]), "bg_points": int(background[0, k])}
        out.append(one)
    return out


def _three_way(buckets: Buckets) -> dict[str, Any]:
    """Foreground dynamic, foreground static, background static, and the mean of the three (Argoverse 2)."""
    error = buckets.mean_error()
    three = {"fd": error[1, 1], "fs": error[1, 0], "bs": error[0, 0]}
    return {
        **{key: _figure(value) for key, value in three.items()},
        "mean": _figure(np.mean(list(three.values()))),
        "points": {"fd": int(buckets.count[1, 1]), "fs": int(buckets.count[1, 0]), "bs": int(buckets.count[0, 0])},
    }


def _bucketed(buckets: Buckets) -> dict[str, Any]:
    """Static error and normalised dynamic error by class, and their means over the classes that have some."""
    figures = buckets.static_and_dynamic()
    out: dict[str, Any] = {
        name: {
            "static_epe": _figure(figures[k, 0]),
            "dynamic_error": _figure(figures[k, 1]),
            "static_points": int(buckets.count[k, 0]),
            "dynamic_points": int(buckets.count[k, 1:].sum()),
        }
        for k, name in enumerate(CLASSES)
        if buckets.count[k].any()
    }
    out["mean"] = {"static_epe": _mean(figures[:, 0]), "dynamic_error": _mean(figures[:, 1])}
    return out


def _bins(values: Array, edges: Sequence[float]) -> I64:
    """Bin of each value; one past the last for NaN."""
    return np.asarray(np.searchsorted(np.asarray(edges), values, side="right") - 1, dtype=np.int64)


def _mean(values: F64) -> float | None:
    """Over what is finite; None where nothing is."""
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else None


def _share(part: float, whole: float) -> float | None:
    return float(part / whole) if whole else None


def _figure(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
