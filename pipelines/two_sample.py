"""Two populations of cars in, how well they can be told apart out: classifiers that never see a test car's track.

A track is one physical car: its views are alike, so views of one track never fall into both the training and the test
part. AUC is of scores given to views left out; every track weighs the same, however many views it has. scikit-learn
(extra `fit`) and torch (the point network only) are imported inside the functions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from augkitti.command_line import counted
from augkitti.errors import InputError
from augkitti.frames import F64, Array
from augkitti.scan_pair import I64, Bool

FOLDS = 5
_POINTS = 128  # of a car that the point network sees
_EPOCHS = 30

Scorer = Callable[[Any, Bool, F64, Any], F64]  # train inputs, is simulated, weights, test inputs -> scores


@dataclass(frozen=True, eq=False)
class Judged:
    """Scores of views that were left out when their judge was trained; higher: more like a simulated one."""

    score: F64  # (V,)
    is_simulated: Bool  # (V,)
    track: tuple[str, ...]  # (V,)
    weight: F64  # (V,) sums to 1 over each track and kind

    @property
    def auc(self) -> float:
        """Chance that a simulated view scores above a real one, tracks weighing the same."""
        return auc(self.score, self.is_simulated, self.weight)


def auc(score: Array, is_positive: Bool, weight: Array | None = None) -> float:
    """Area under the ROC curve: chance that a positive scores above a negative, ties half; NaN without either."""
    weights = np.ones(len(score)) if weight is None else np.asarray(weight, dtype=np.float64)
    _, level = np.unique(score, return_inverse=True)
    above = np.bincount(level, np.where(is_positive, weights, 0.0))
    below = np.bincount(level, np.where(is_positive, 0.0, weights))
    lower = np.cumsum(below) - 0.5 * below
    total = above.sum() * below.sum()
    return float((above * lower).sum() / total) if total > 0.0 else float("nan")


def track_weights(tracks: Sequence[str], is_simulated: Bool) -> F64:
    """Weight (V,) of each view, such that all tracks weigh the same among the real and among the simulated ones."""
    keys = [f"{int(kind)}/{track}" for kind, track in zip(is_simulated, tracks, strict=True)]
    _, which, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.asarray(1.0 / count[which])


def track_folds(tracks: Sequence[str], is_simulated: Bool, folds: int, rng: np.random.Generator) -> I64:
    """Fold (V,) of each view: a track is whole in one of them, real and simulated alike, sizes as equal as may be."""
    kinds: dict[str, set[bool]] = {}
    for track, kind in zip(tracks, is_simulated, strict=True):
        kinds.setdefault(track, set()).add(bool(kind))
    names = sorted(kinds)
    fold_of: dict[str, int] = {}
    for group in ({False, True}, {False}, {True}):  # tracks of one kind alone are spread by themselves
        mine = [name for name in names if kinds[name] == group]
        order = rng.permutation(len(mine))
        fold_of |= {mine[index]: place % folds for place, index in enumerate(order)}
    return np.array([fold_of[track] for track in tracks], dtype=np.int64)


def cross_validate(
    inputs: Any,
    is_simulated: Bool,
    tracks: Sequence[str],
    scorer: Scorer,
    rng: np.random.Generator,
    folds: int = FOLDS,
    repeats: int = 1,
) -> Judged:
    """Score every view by a judge that was trained on other tracks.

    Args:
        inputs: (V, ...) array, one row a view.
        is_simulated: (V,).
        tracks: (V,) names; a simulated view that stands where a real car stood has that car's track.
        scorer: trains on some rows and scores others.
        rng: draws the folds.
        folds: parts; fewer where there are fewer tracks.
        repeats: ways to part the tracks; a view's score is their mean, so that less depends on the parting.

    Raises:
        InputError: fewer than two tracks.
    """
    count = len(set(tracks))
    if count < 2:
        raise InputError("realism", f"{count} labelled tracks", "two are needed to train on one and test on the other")
    weight = track_weights(tracks, is_simulated)
    score = np.zeros(len(is_simulated))
    for _ in range(repeats):
        fold = track_folds(tracks, is_simulated, min(folds, count), rng)
        for part in np.unique(fold):
            train, test = fold != part, fold == part
            both_kinds = is_simulated[train].any() and not is_simulated[train].all()
            score[test] += (
                scorer(inputs[train], is_simulated[train], weight[train], inputs[test]) if both_kinds else 0.5
            )
    return Judged(score / repeats, is_simulated, tuple(tracks), weight)


def bootstrap_auc(
    judged: Mapping[str, Judged], resamples: int, rng: np.random.Generator, tracks: Sequence[str] | None = None
) -> dict[str, F64]:
    """AUC (resamples,) of each column over the same resamples of tracks; judges are not trained anew."""
    names = sorted({track for one in judged.values() for track in one.track}) if tracks is None else list(tracks)
    place = {name: index for index, name in enumerate(names)}
    index = {key: np.array([place[track] for track in one.track]) for key, one in judged.items()}
    out = {key: np.zeros(resamples) for key in judged}
    for k in counted(range(resamples), resamples, "resamples"):
        times = np.bincount(rng.integers(len(names), size=len(names)), minlength=len(names)).astype(np.float64)
        for key, one in judged.items():
            out[key][k] = auc(one.score, one.is_simulated, one.weight * times[index[key]])
    return out


def interval(values: Array, share: float = 0.95) -> tuple[float, float]:
    """The middle `share` of values, NaN left out; (NaN, NaN) where there are none."""
    kept = np.asarray(values)[np.isfinite(values)]
    if not len(kept):
        return float("nan"), float("nan")
    low, high = np.quantile(kept, (0.5 - share / 2.0, 0.5 + share / 2.0))
    return float(low), float(high)


def mean_known(rows: Any) -> F64:
    """Mean over rows (R, ...) of what is known; NaN where nothing is."""
    values = np.asarray(rows, dtype=np.float64)
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


def middle_known(values: Array) -> float:
    """Median of what is known; NaN where nothing is."""
    known = np.asarray(values)[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def separations(features: F64, is_simulated: Bool, weight: F64) -> F64:
    """(F,) how well each feature alone tells the two apart: |2 AUC - 1|; NaN where a side has under five values."""
    out = np.full(features.shape[1], np.nan)
    for column in range(features.shape[1]):
        ok = np.isfinite(features[:, column])
        if min((ok & is_simulated).sum(), (ok & ~is_simulated).sum()) >= 5:
            out[column] = abs(2.0 * auc(features[ok, column], is_simulated[ok], weight[ok]) - 1.0)
    return out


def feature_scorer(seed: int = 0, trees: int = 200) -> Scorer:
    """Judge by features (V, F): the mean of a logistic regression and randomised trees, of scikit-learn.

    Raises:
        InputError: scikit-learn is not installed.
    """
    try:
        from sklearn.ensemble import ExtraTreesClassifier
        from sklearn.impute import SimpleImputer
        from sklearn.linear_model import LogisticRegression
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import QuantileTransformer
    except ImportError as err:
        raise InputError("realism", "needs scikit-learn", "pip install 'augkitti[fit,view]'") from err

    def score(train: Any, is_simulated: Bool, weight: F64, test: Any) -> F64:
        there = np.isfinite(train).any(axis=0)
        train, test = train[:, there], test[:, there]
        line = make_pipeline(
            SimpleImputer(strategy="median", add_indicator=True),
            QuantileTransformer(n_quantiles=min(100, len(train)), output_distribution="normal", random_state=seed),
            LogisticRegression(C=0.05, max_iter=500),
        )
        line.fit(train, is_simulated, logisticregression__sample_weight=weight / weight.mean())
        fill = SimpleImputer(strategy="constant", fill_value=-1.0, add_indicator=False)
        forest = ExtraTreesClassifier(trees, min_samples_leaf=2, max_features="sqrt", random_state=seed, n_jobs=1)
        forest.fit(fill.fit_transform(train), is_simulated, sample_weight=weight)
        return np.asarray(
            0.5 * (line.predict_proba(test)[:, 1] + forest.predict_proba(fill.transform(test))[:, 1]), dtype=np.float64
        )

    return score


@dataclass(frozen=True)
class AtEqualCounts:
    """One half of the tracks, real, against the other half: real, or simulated; S splits of the tracks."""

    auc: F64  # (S,)
    separation: F64  # (S,) mean over the features


def at_equal_counts(
    real: F64,
    others: Mapping[str, F64],
    tracks: Sequence[str],
    scorer: Scorer,
    splits: int,
    rng: np.random.Generator,
) -> dict[str, AtEqualCounts]:
    """What can be told with half of the tracks against the other half: `real` against itself is the floor.

    Args:
        real: (V, F) features of the real views.
        others: (V, F) each: simulated views that stand where the real ones do; row by row.
        tracks: (V,) of the views.
        scorer: trains and scores.
        splits: how many ways to halve the tracks.
        rng: draws them.
    """
    names = np.array(sorted(set(tracks)))
    of_view = np.asarray(tracks)
    everyone = {"real": real, **others}
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in everyone}
    for _ in counted(range(splits), splits, "splits"):
        half = set(rng.permutation(names)[: len(names) // 2])
        first = np.array([track in half for track in of_view])
        seed = int(rng.integers(2**31))
        is_second = np.concatenate([np.zeros(first.sum(), bool), np.ones((~first).sum(), bool)])
        part_tracks = [*of_view[first], *of_view[~first]]
        for name, features in everyone.items():
            part = np.concatenate([real[first], features[~first]])
            judged = cross_validate(part, is_second, part_tracks, scorer, np.random.default_rng(seed))
            apart = mean_known(separations(part, is_second, judged.weight))
            found[name].append((judged.auc, float(apart)))
    return {
        name: AtEqualCounts(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))
        for name, rows in found.items()
    }


def permuted_drops(
    features: F64,
    is_simulated: Bool,
    tracks: Sequence[str],
    groups: Mapping[str, Sequence[int]],
    scorer: Scorer,
    rng: np.random.Generator,
    repeats: int = 5,
) -> dict[str, float]:
    """How much the AUC falls when a group's columns are shuffled over the views to score: what the judge sees."""
    weight = track_weights(tracks, is_simulated)
    fold = track_folds(tracks, is_simulated, min(FOLDS, len(set(tracks))), rng)
    score = np.full(len(is_simulated), 0.5)
    shuffled = {(name, k): score.copy() for name in groups for k in range(repeats)}
    for part in np.unique(fold):
        train, test = fold != part, np.flatnonzero(fold == part)
        variants = [features[test]]
        for name, _ in shuffled:
            changed = features[test].copy()
            order = rng.permutation(len(test))
            columns = list(groups[name])
            changed[:, columns] = changed[order][:, columns]
            variants.append(changed)
        scores = scorer(features[train], is_simulated[train], weight[train], np.concatenate(variants))
        parts = scores.reshape(len(variants), len(test))
        score[test] = parts[0]
        for values, key in zip(parts[1:], shuffled, strict=True):
            shuffled[key][test] = values
    whole = auc(score, is_simulated, weight)
    return {
        name: whole - float(np.mean([auc(shuffled[name, k], is_simulated, weight) for k in range(repeats)]))
        for name in groups
    }


def standardised(features: F64, reference: F64) -> F64:
    """Features (V, F) over the reference's spread about its median; NaN becomes the median, far values are cut."""
    middle = np.array([np.nan_to_num(middle_known(column)) for column in reference.T])
    bounds = np.array([interval(column, 0.8) for column in reference.T])
    spread = np.maximum(np.nan_to_num(bounds[:, 1] - bounds[:, 0]), 1e-6)
    return np.clip(np.where(np.isfinite(features), (features - middle) / spread, 0.0), -3.0, 3.0)


def mmd(a: F64, b: F64) -> float:
    """Squared maximum mean discrepancy (unbiased) of sets (A, F), (B, F); Gaussian kernel of the median distance."""
    both = np.concatenate([a, b])
    square = ((both[:, None] - both[None]) ** 2).sum(axis=2)
    kernel = np.exp(-square / max(float(np.median(square[square > 0.0])) if (square > 0.0).any() else 1.0, 1e-12))
    m, n = len(a), len(b)
    if m < 2 or n < 2:
        return float("nan")
    of_a = (kernel[:m, :m].sum() - m) / (m * (m - 1))
    of_b = (kernel[m:, m:].sum() - n) / (n * (n - 1))
    return float(of_a + of_b - 2.0 * kernel[:m, m:].mean())


def point_sets(
    points: Sequence[F64], shine: Sequence[F64], sizes_m: Sequence[Array], rng: np.random.Generator
) -> Array:
    """(V, 128, 5) float32 for the point network: x, y, z in metres over 2, reflectance, whether it is 0; drawn anew."""
    out = np.zeros((len(points), _POINTS, 5), dtype=np.float32)
    for k, (xyz, value, size) in enumerate(zip(points, shine, sizes_m, strict=True)):
        if len(xyz):
            chosen = rng.choice(len(xyz), _POINTS, replace=len(xyz) < _POINTS)
            out[k, :, :3] = (xyz[chosen] + (0.0, 0.0, 0.5 * float(size[2]) - 0.75)) / 2.0
            out[k, :, 3] = value[chosen]
            out[k, :, 4] = value[chosen] == 0.0
    return out


def point_scorer(seed: int = 0) -> Scorer | None:
    """Judge by points (V, 128, 5): a small PointNet, trained for a few seconds; None where torch is not installed."""
    try:
        import torch
    except ImportError:
        return None

    def score(train: Any, is_simulated: Bool, weight: F64, test: Any) -> F64:
        torch.manual_seed(seed)
        each = torch.nn.Sequential(
            torch.nn.Linear(5, 48), torch.nn.ReLU(), torch.nn.Linear(48, 96), torch.nn.ReLU(), torch.nn.Linear(96, 96)
        )
        whole = torch.nn.Sequential(
            torch.nn.Linear(192, 48), torch.nn.ReLU(), torch.nn.Dropout(0.3), torch.nn.Linear(48, 1)
        )

        def logit(x: Any) -> Any:
            found = each(x)
            return whole(torch.cat([found.max(dim=1).values, found.mean(dim=1)], dim=1))[:, 0]

        x, y = torch.from_numpy(train), torch.from_numpy(is_simulated.astype(np.float32))
        w = torch.from_numpy((weight / weight.mean()).astype(np.float32))
        optimiser = torch.optim.Adam([*each.parameters(), *whole.parameters()], lr=2e-3, weight_decay=1e-4)
        loss_of = torch.nn.BCEWithLogitsLoss(reduction="none")
        whole.train()
        for _ in range(_EPOCHS):
            for batch in torch.split(torch.randperm(len(x)), 32):
                seen = x[batch] + 0.0
                seen[:, :, 1] *= torch.where(torch.rand(len(batch), 1) < 0.5, -1.0, 1.0)  # cars are symmetric
                optimiser.zero_grad()
                loss = (loss_of(logit(seen), y[batch]) * w[batch]).mean()
                loss.backward()
                optimiser.step()
        whole.eval()
        with torch.no_grad():
            return np.asarray(torch.sigmoid(logit(torch.from_numpy(test))).numpy(), dtype=np.float64)

    return score
