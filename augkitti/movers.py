"""Moving things without labels: a pair and its prepared scans in, the points of scan 0 against the ego-motion out.

The test, for things that stand on the ground (figures and reasons in docs/decisions.md):

1. Both scans are carried into one world frame by the ego-motion, each point at its own firing time, so that what stands
   still coincides. Points that stand out of the ground form clusters in the ground plane.
2. Free space: a point contradicts the other scan where all rays of that scan that pass it went on well beyond it. A
   point that the other scan could not see (something nearer in the way, nothing returned) contradicts nothing.
3. A cluster with such contradictions in it, or in scan 1 near it, is a suspect. It is moved about in the ground plane
   to where it meets scan 1 best.
4. It moves if it must be moved by a clear distance, if it then meets scan 1 clearly better than standing still (in both
   directions: its points find points of scan 1, and those at its new place find it), and if the contradictions are a
   good part of it. A wall, a hedge or the edge of something hidden fails one of these: part of it stands, or nothing
   meets it anywhere.

The ego car's own body, which goes with the scanner, counts as moving while the ego car does. Not found: things slower
than `min_motion_m` a scan, things that scan 1 does not see, things that touch something large that stands.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from augkitti import same_math as sm
from augkitti.config import MoversConfig
from augkitti.frames import F64, Array, se3_exp, se3_log, transform_points
from augkitti.ground import height_at
from augkitti.scan_pair import Bool, PreparedScan, ScanPair

I64 = npt.NDArray[np.int64]

_COLUMNS = 2048  # of a range image: 0.176 degrees, the step of a firing
_TOP_M = 4.0  # above the ground: higher things are leaves, signs and houses
_TRUNCATE_M = 0.5  # a point without a partner counts as this far off
_MAP_M = 0.15  # cell of the map on which a cluster is moved about
_COARSE_SAMPLE = 50  # points of a cluster that are moved about on it
_SAMPLE = 90  # points of a cluster that are compared with the other scan
_PARTNER_M = 0.3  # a point this near to one of the other scan has found it
_SMOOTH_M = 0.09  # misfit of a body that is met all over
_BESIDE_M = 1.2  # parts of one car, seen apart
_CLEAR_M = 0.3  # round a cluster: points of scan 1 this near its new place are to be explained by it
_EGO_BODY_M = (-3.2, 2.2, 1.5)  # rear, front, side of the ego car round its scanner: mirrors are seen there


@dataclass(frozen=True, eq=False)
class Suspect:
    """A cluster of scan 0 that contradicts the ego-motion, and how well a motion explains it."""

    points: I64  # (P,) of scan 0
    members: I64  # the same among the points that stand out of the ground
    length_m: float  # diagonal in the ground plane
    met: int  # points of scan 1 at its new place
    visible: int  # of its points and of those, how many the other scan could see if it stood
    against: int  # how many of these contradict standing
    explained: float  # share of the contradictions that the motion explains
    motion_m: F64  # (2,) in the ground plane that makes it meet scan 1 best
    misfit_still_m: float  # mean distance to the other scan, standing still, truncated
    misfit_moved_m: float  # the same, moved


@dataclass(frozen=True, eq=False)
class _View:
    """One scan in the world frame (velo0 at the middle of scan 0, held still), and its range image to look up."""

    rows: I64  # (S,) points that stand out of the ground, in reach
    points: F64  # (S, 3) world, by rising x
    image: F64  # (rings, columns) nearest range, inf where nothing returned
    elevation_rad: F64  # (rings,) falling
    height_m: F64  # (rings,) of the beams' start
    T_scanner_world: F64  # (columns, 4, 4) when the scanner looks along each column

    def within(self, low: F64, high: F64) -> I64:
        """Indices of points in a box along the axes; points are sorted by x."""
        first, last = np.searchsorted(self.points[:, 0], [low[0], high[0]])
        part = self.points[first:last, 1:]
        return np.asarray(np.flatnonzero(((part > low[1:]) & (part < high[1:])).all(axis=1)) + first)


@dataclass(frozen=True, eq=False)
class _Both:
    """Both scans and what each says of the other."""

    view0: _View
    view1: _View
    past0: Bool  # points of view0 that scan 1 sees past
    past1: Bool
    hidden0: Bool  # points of view0 that scan 1 cannot see
    hidden1: Bool
    tree0: cKDTree
    tree1: cKDTree
    new1: I64  # points of view1 that scan 0 saw past
    tree_new1: cKDTree | None  # of these, in the ground plane


def unlabelled_movers(pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan, config: MoversConfig) -> Bool:
    """Points (N0,) of scan 0 that contradict the ego-motion where the source's labels do not reach."""
    if pair.label_coverage == "full":
        return np.zeros(len(pair.scan0), dtype=bool)
    movers = find_movers(pair, prepared0, prepared1, config)
    if pair.label_coverage == "camera" and pair.label_azimuth is not None:
        azimuth = sm.arctan2(pair.scan0.xyz[:, 1], pair.scan0.xyz[:, 0])
        movers &= (azimuth < pair.label_azimuth[0]) | (azimuth > pair.label_azimuth[1])
    return movers


def find_movers(pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan, config: MoversConfig) -> Bool:
    """Which points (N0,) of scan 0 move against the static world.

    Args:
        pair: two neighbouring scans; its `ego_motion` is what standing things follow.
        prepared0: rays and ground of scan 0; the drivable region is not used.
        prepared1: the same of scan 1.
        config: bounds.
    """
    moving = np.zeros(len(pair.scan0), dtype=bool)
    both = _both(pair, prepared0, prepared1, config)
    found = [] if both is None else [s for s in _suspects(both, config) if moves(s, config)]
    if both is not None and found:
        of_found = np.zeros(len(both.view0.rows), dtype=bool)
        for suspect in found:
            of_found[suspect.members] = True
        of_found[_companions(both, found, of_found, config)] = True
        moving[_with_feet(both.view0.rows[of_found], prepared0, config)] = True
    if float(sm.hypot(pair.ego_motion[0, 3], pair.ego_motion[1, 3])) >= config.min_motion_m:
        moving[_ego_body(prepared0)] = True
    return moving


def find_suspects(
    pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan, config: MoversConfig
) -> list[Suspect]:
    """Steps 1 to 3 of the test: for pictures and for tuning."""
    both = _both(pair, prepared0, prepared1, config)
    return [] if both is None else list(_suspects(both, config))


def moves(suspect: Suspect, config: MoversConfig) -> bool:
    """Step 4 of the test."""
    step = float(sm.hypot(suspect.motion_m[0], suspect.motion_m[1]))
    # What is seen from aside and goes along itself contradicts at its two ends only.
    share = max(config.min_against, 0.3 * min(step / max(suspect.length_m, 0.5), 0.5))
    better = suspect.misfit_moved_m <= config.max_misfit_ratio * suspect.misfit_still_m
    # A long flat side meets itself after any move along it: then the ends decide, if they are clear enough.
    ends = (
        suspect.misfit_moved_m <= _SMOOTH_M
        and suspect.explained >= 0.9
        and suspect.against >= 2.5 * config.min_against * suspect.visible
    )
    return bool(
        step >= config.min_motion_m
        and suspect.met >= 3
        and len(suspect.points) + suspect.met >= 2 * config.min_points
        and suspect.misfit_moved_m <= config.max_misfit_m
        and (better or ends)
        and suspect.against >= max(4.0, share * suspect.visible)
        and suspect.explained >= config.min_explained
    )


def _both(pair: ScanPair, prepared0: PreparedScan, prepared1: PreparedScan, config: MoversConfig) -> _Both | None:
    interval_s = max(pair.scan1.time_s - pair.scan0.time_s, 1e-3)
    per_second = se3_log(pair.ego_motion) / interval_s  # T_velo(t)_world = exp(t per_second)
    view0 = _view(prepared0, per_second, 0.0, config)
    view1 = _view(prepared1, per_second, interval_s, config)
    if len(view0.rows) == 0 or len(view1.rows) == 0:
        return None
    past0, hidden0 = _look(view1, view0.points)
    past1, hidden1 = _look(view0, view1.points)
    new1 = np.flatnonzero(past1)
    tree_new1 = cKDTree(view1.points[new1, :2]) if len(new1) else None
    tree0, tree1 = cKDTree(view0.points), cKDTree(view1.points)
    return _Both(view0, view1, past0, past1, hidden0, hidden1, tree0, tree1, new1, tree_new1)


def _suspects(both: _Both, config: MoversConfig) -> Iterator[Suspect]:
    """Of each cluster; where it stands as a whole, of those parts of it that scan 1 sees past."""
    points = both.view0.points
    for members in _clusters(points, config):
        whole = _suspect(both, members, config)
        if whole is not None:
            yield whole
        if whole is None or not moves(whole, config):
            gone = members[both.past0[members]]
            if len(gone) < config.min_points or len(gone) == len(members):
                continue
            cell = np.floor(points[members, :2] / config.cell_m).astype(np.int64)
            cell -= cell.min(axis=0) - 1
            taken = np.zeros(cell.max(axis=0) + 2, dtype=bool)
            of_gone = cell[both.past0[members]]
            taken[of_gone[:, 0], of_gone[:, 1]] = True
            near = members[ndimage.binary_dilation(taken, np.ones((3, 3)))[cell[:, 0], cell[:, 1]]]
            if len(near) > 0.95 * len(members):
                continue
            for part in _clusters(points[near], config):
                suspect = _suspect(both, near[part], config)
                if suspect is not None:
                    yield suspect


def _suspect(both: _Both, members: I64, config: MoversConfig) -> Suspect | None:
    """Step 3 of the test for some points of view0; None where nothing speaks against their standing."""
    view0, view1 = both.view0, both.view1
    low, high = view0.points[members].min(axis=0), view0.points[members].max(axis=0)
    length = float(sm.hypot(high[0] - low[0], high[1] - low[1]))
    if len(members) < config.min_points or length > config.max_length_m:
        return None
    near = np.zeros(0, dtype=np.int64)
    if both.tree_new1 is not None:
        reach = 0.5 * length + config.max_motion_m
        found = both.tree_new1.query_ball_point(0.5 * (low + high)[:2], reach)
        near = both.new1[np.array(sorted(found), dtype=np.int64)]
    if int(both.past0[members].sum()) + len(near) < max(4.0, config.min_against * len(members)):
        return None
    some = _thinned(members)
    hidden = both.hidden0[some]
    if hidden.mean() < 0.5:
        still = _distance(both.tree1, view0.points[some[~hidden]])
        if (still < 0.15).mean() > 0.97:
            return None  # all of it is met where it stands
    margin = config.max_motion_m + _TRUNCATE_M
    others = view1.points[view1.within(low - margin, high + margin)]
    judged = [
        _judge(both, members, low, high, length, near, motion)
        for motion in _best_motions(view0.points[some], others, view1.points[near], both.tree1, config)
    ]
    return min(judged, key=lambda s: s.misfit_moved_m - 0.2 * s.explained, default=None)


def _judge(both: _Both, members: I64, low: F64, high: F64, length_m: float, near: I64, motion_m: F64) -> Suspect:
    """How well a motion explains a cluster."""
    view0, view1 = both.view0, both.view1
    step = np.array([motion_m[0], motion_m[1], 0.0])
    there = view1.within(low + step - _CLEAR_M, high + step + _CLEAR_M)
    beside = view1.points[near]
    wide = near[((beside > low + step - 1.0) & (beside < high + step + 1.0)).all(axis=1)]
    there = np.union1d(there, wide)
    some, back = _thinned(members), _thinned(there)
    mine, theirs = view0.points[some], view1.points[back]
    trees = both.tree1, both.tree0
    still = _misfit(trees, mine, both.hidden0[some], theirs, both.hidden1[back])
    moved = _misfit(trees, mine + step, _look(view1, mine + step)[1], theirs - step, _look(view0, theirs - step)[1])
    gone, come = members[both.past0[members]], there[both.past1[there]]
    left = _distance(both.tree1, view0.points[_thinned(gone)] + step) < _PARTNER_M
    came = _distance(both.tree0, view1.points[_thinned(come)] - step) < _PARTNER_M
    explained = sum(len(all_of) * float(part.mean()) for all_of, part in ((gone, left), (come, came)) if len(all_of))
    return Suspect(
        points=view0.rows[members],
        members=members,
        length_m=length_m,
        met=len(there),
        visible=int((~both.hidden0[members]).sum() + (~both.hidden1[there]).sum()),
        against=len(gone) + len(come),
        explained=explained / max(1, len(gone) + len(come)),
        motion_m=motion_m,
        misfit_still_m=still,
        misfit_moved_m=moved,
    )


def _companions(both: _Both, found: list[Suspect], of_found: Bool, config: MoversConfig) -> I64:
    """Small clusters beside a mover that scan 1 does not meet where they stood but meets after the mover's motion."""
    points = both.view0.points
    which = np.repeat(np.arange(len(found)), [len(suspect.members) for suspect in found])
    tree = cKDTree(points[np.concatenate([suspect.members for suspect in found])][:, :2])
    rest = np.flatnonzero(~of_found)
    distance, nearest = tree.query(points[rest, :2], distance_upper_bound=_BESIDE_M)
    beside = np.full(len(points), -1, dtype=np.int64)
    beside[rest[np.isfinite(distance)]] = which[nearest[np.isfinite(distance)]]
    more = [np.zeros(0, dtype=np.int64)]
    for members in _clusters(points[beside >= 0], config) if (beside >= 0).any() else ():
        members = np.flatnonzero(beside >= 0)[members]
        seen = members[~both.hidden0[members]]
        if len(seen) and (_distance(both.tree1, points[seen]) < 0.2).mean() > 0.3:
            continue
        motion = found[int(beside[members[0]])].motion_m
        moved = points[members] + np.array([motion[0], motion[1], 0.0])
        if float(_distance(both.tree1, moved).mean()) <= config.max_misfit_m:
            more.append(members)
    return np.concatenate(more)


def _thinned(members: I64) -> I64:
    """At most `_SAMPLE` of them, evenly."""
    return members[:: max(1, -(-len(members) // _SAMPLE))]


def _misfit(trees: tuple[cKDTree, cKDTree], points0: F64, hidden0: Bool, points1: F64, hidden1: Bool) -> float:
    """Mean truncated distance (metres) both ways, over what the other scan can see."""
    both = np.concatenate([_distance(trees[0], points0[~hidden0]), _distance(trees[1], points1[~hidden1])])
    return float(both.mean()) if len(both) else _TRUNCATE_M


def _distance(tree: cKDTree, points: F64) -> F64:
    return np.asarray(np.minimum(tree.query(points, distance_upper_bound=_TRUNCATE_M)[0], _TRUNCATE_M))


def _view(prepared: PreparedScan, per_second: F64, start_s: float, config: MoversConfig) -> _View:
    scan, rays = prepared.scan, prepared.rays
    xyz = scan.xyz.astype(np.float64)
    across = sm.hypot(xyz[:, 0], xyz[:, 1])
    rows = np.flatnonzero(~prepared.ground.is_ground & (across < config.reach_m))
    height = xyz[rows, 2] - height_at(prepared.ground, xyz[rows, :2])
    rows = rows[(height > config.min_height_m) & (height < _TOP_M)]
    times, which = np.unique(rays.ray_time_s[rays.ray[rows]], return_inverse=True)
    points = transform_points(se3_exp(per_second, -(start_s + times))[which], xyz[rows])
    order = np.argsort(points[:, 0], kind="stable")
    rows, points = rows[order], points[order]

    rings = int(rays.ray_ring.max()) + 1
    elevation = _mean_by(rays.ray_ring, rays.ray_elevation_rad, rings)
    height_m = _mean_by(rays.ring, xyz[:, 2] - sm.tan(elevation)[rays.ring] * across, rings)
    image = np.full(rings * _COLUMNS, np.inf)
    pixel = rays.ring.astype(np.int64) * _COLUMNS + _column(sm.arctan2(xyz[:, 1], xyz[:, 0]))
    np.minimum.at(image, pixel, np.sqrt((xyz * xyz).sum(axis=1)))
    azimuth = (np.arange(_COLUMNS) + 0.5) / _COLUMNS * 2.0 * np.pi - np.pi
    # The scanner turns clockwise and looks straight ahead at the scan's middle (scanner.md section 1).
    looks = -azimuth / (2.0 * np.pi) * scan.period_s if scan.kind == "raw" else np.zeros(_COLUMNS)
    T_scanner_world = se3_exp(per_second, start_s + looks)
    return _View(rows, points, image.reshape(rings, _COLUMNS), elevation, height_m, T_scanner_world)


def _mean_by(group: Array, values: F64, groups: int) -> F64:
    return np.bincount(group, values, groups) / np.maximum(np.bincount(group, minlength=groups), 1)


def _column(azimuth_rad: F64) -> I64:
    return np.minimum(((azimuth_rad + np.pi) / (2.0 * np.pi) * _COLUMNS).astype(np.int64), _COLUMNS - 1)


def _look(view: _View, points_world: F64) -> tuple[Bool, Bool]:
    """Which world points (S,) a scan saw past, and which are hidden from it or out of its view."""
    T = view.T_scanner_world
    at = transform_points(T[_COLUMNS // 2], points_world)
    for _ in range(2):  # when the scanner looks there depends on where the point is then
        at = transform_points(T[_column(sm.arctan2(at[:, 1], at[:, 0]))], points_world)
    across = sm.hypot(at[:, 0], at[:, 1])
    distance = np.sqrt((at * at).sum(axis=1))
    column = _column(sm.arctan2(at[:, 1], at[:, 0]))
    rings = len(view.elevation_rad)
    between = -0.5 * (view.elevation_rad[1:] + view.elevation_rad[:-1])  # rising
    ring = np.full(len(at), rings // 2)
    for _ in range(2):  # beams start at two heights
        elevation = sm.arctan2(at[:, 2] - view.height_m[ring], across)
        ring = np.searchsorted(between, -elevation)
    outside = (elevation > view.elevation_rad[0] + 0.004) | (elevation < view.elevation_rad[-1] - 0.004)

    margin = 0.2 + 0.003 * distance  # noise, bias between beams, and 0.2 degrees of ego rotation on slanted surfaces
    nearest = np.full(len(at), np.inf)
    agree = np.zeros(len(at), dtype=bool)
    returns = np.zeros(len(at), dtype=np.int64)
    for up in (-1, 0, 1):
        for aside in (-1, 0, 1):
            found = view.image[np.clip(ring + up, 0, rings - 1), (column + aside) % _COLUMNS]
            nearest = np.minimum(nearest, found)
            agree |= np.abs(found - distance) <= margin
            returns += np.isfinite(found)
    past = (nearest > distance + margin) & (returns >= 4) & ~outside
    hidden = (~agree & (nearest < distance - margin)) | (returns < 2) | outside
    return past, hidden


def _clusters(points: F64, config: MoversConfig) -> Iterator[I64]:
    """Members of each cluster of world points: cells of the ground plane that touch."""
    label = _cluster_of(points, config)
    order = np.argsort(label, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _cluster_of(points: F64, config: MoversConfig) -> I64:
    corner = points[:, :2].min(axis=0)
    cell = ((points[:, :2] - corner) / config.cell_m).astype(np.int64)
    taken = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    taken[cell[:, 0], cell[:, 1]] = True
    label, _ = ndimage.label(taken, np.ones((3, 3)))
    return np.asarray(label[cell[:, 0], cell[:, 1]], dtype=np.int64)


def _best_motions(points: F64, others: F64, new: F64, tree1: cKDTree, config: MoversConfig) -> list[F64]:
    """Translations (2,) in the ground plane that bring points nearest to others; the shortest of equals.

    The first looks at the points alone, the second also wants to come near to `new`, the points of scan 1 that scan 0
    saw past: right for what goes along itself, misleading where another thing came there.
    """
    reach = int(config.max_motion_m / _MAP_M)
    steps = np.arange(-reach, reach + 1)
    far = sm.hypot(steps[:, None], steps[None, :])
    costs = [_cost(points, others, steps) + np.where(far <= reach, 0.01 * _MAP_M * far, 9.0)]
    low, high = points[:, :2].min(axis=0) - config.max_motion_m, points[:, :2].max(axis=0) + config.max_motion_m
    new = new[((new[:, :2] > low) & (new[:, :2] < high)).all(axis=1)]
    if len(new) >= 3:
        costs.append(costs[0] + 0.5 * _cost(new, points, steps)[::-1, ::-1])  # what came is moved back
    motions = []
    for best in sorted({int(np.argmin(cost)) for cost in costs}):
        i, j = np.unravel_index(best, costs[0].shape)
        motions.append(_refined(points, np.array([steps[i], steps[j], 0.0]) * _MAP_M, tree1))
    return motions


def _refined(points: F64, step: F64, tree1: cKDTree) -> F64:
    """A translation freed of the map's cells: to the mean of the nearest points, three times."""
    for _ in range(3):
        distance, partner = tree1.query(points + step, distance_upper_bound=_PARTNER_M)
        met = np.isfinite(distance)
        if met.sum() < 3:
            break
        step[:2] += (tree1.data[partner[met], :2] - points[met, :2] - step[:2]).mean(axis=0)
    return np.asarray(step[:2])


def _cost(points: F64, others: F64, steps: I64) -> F64:
    """Mean truncated distance in the ground plane of moved points to others, for all moves by (steps, steps) cells."""
    margin = int(steps[-1]) * _MAP_M + _TRUNCATE_M
    low = points[:, :2].min(axis=0) - margin
    shape = ((points[:, :2].max(axis=0) + margin - low) / _MAP_M).astype(np.int64) + 1
    cell = np.floor((others[:, :2] - low) / _MAP_M).astype(np.int64)
    cell = cell[((cell >= 0) & (cell < shape)).all(axis=1)]
    if len(cell) == 0:
        return np.full((len(steps), len(steps)), _TRUNCATE_M)
    free = np.ones(shape, dtype=bool)
    free[cell[:, 0], cell[:, 1]] = False
    away = np.minimum(ndimage.distance_transform_edt(free) * _MAP_M, _TRUNCATE_M)
    sample = points[:: -(-len(points) // _COARSE_SAMPLE), :2]
    start = np.floor((sample - low) / _MAP_M).astype(np.int64) + steps[0]
    windows = np.lib.stride_tricks.sliding_window_view(away, (len(steps), len(steps)))
    return np.asarray(windows[start[:, 0], start[:, 1]].mean(axis=0))


def _with_feet(found: I64, prepared: PreparedScan, config: MoversConfig) -> I64:
    """Add what is low and stands in the same cells of the ground plane: wheels and sills under a car's body."""
    xy = prepared.scan.xyz[:, :2].astype(np.float64)
    corner = xy[found].min(axis=0) - config.cell_m
    shape = ((xy[found].max(axis=0) + config.cell_m - corner) / config.cell_m).astype(np.int64) + 1
    cell = np.floor((xy - corner) / config.cell_m).astype(np.int64)
    taken = np.zeros(shape, dtype=bool)
    taken[cell[found, 0], cell[found, 1]] = True
    taken = ndimage.binary_dilation(taken, np.ones((3, 3)))
    near = np.flatnonzero(((cell >= 0) & (cell < shape)).all(axis=1) & ~prepared.ground.is_ground)
    near = near[taken[cell[near, 0], cell[near, 1]]]
    height = prepared.scan.xyz[near, 2] - height_at(prepared.ground, xy[near])
    low = near[(height > 0.1) & (height <= config.min_height_m)]
    return np.concatenate([found, low])


def _ego_body(prepared: PreparedScan) -> I64:
    """Points of the ego car itself: it goes with the scanner, not with the world."""
    rear, front, side = _EGO_BODY_M
    xyz = prepared.scan.xyz
    near = np.flatnonzero((xyz[:, 0] > rear) & (xyz[:, 0] < front) & (np.abs(xyz[:, 1]) < side))
    height = xyz[near, 2] - height_at(prepared.ground, xyz[near, :2])
    return np.asarray(near[height > 0.3])
