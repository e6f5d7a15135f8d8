"""A pair and detections in, what Dewan et al. say of it out: flow of some points, motions of world and detections.

Dewan, Caselitz, Tipaldi, Burgard, "Rigid Scene Flow for 3D LiDAR Scans", IROS 2016, pooled over detections and
background as PointFlowNet's section 4 has it ("Dewan et al. + Det."). What stands on the ground is thinned to vertices,
which are matched by SHOT (`shot`); a factor graph (`rigid_scene_flow`) gives every vertex a motion of its own. On the
ground, where descriptors tell nothing, vertices take up the motion of what stands round them.

An estimate counts where half of the matches round a vertex bear its motion out; only points beside such a vertex have
flow, that of the vertex. Their share is the coverage that `score` gives. Flow stays that of the points, also in boxes:
pooled motions are the figures of objects and of ego-motion, and painting boxes with them would hide what the method
says.

`dewan` is the method plain: descriptors in frames of their own, matches anywhere within the largest motion, motions
pooled by least squares. Its energy is the paper's; that each vertex starts from the motion most matches round it agree
on, what counts as valid, all sizes, and the ground are ours, and better than what PointFlowNet's table shows.
`dewan_strong` lays the scans over each other first (`augkitti.ego_motion.register`), so that matches are looked for
within what things move over ground, and standing wins where few matches say otherwise; describes in upright frames;
asks matches to be mutual; then draws the surfaces that the motions lay over each other together, point to plane; and
pools by RANSAC.

Defined results: without detections there are no motions of objects; an object with fewer than three points that have
flow moves with the ego-motion; where nothing on the background has flow the ego-motion is the start's (the identity;
in `dewan_strong` registration, if both scans hold 20 points); an empty or bare scan has flow nowhere; scans that are
the same stand still, but for what thinning shifts (centimetres in `dewan`); nothing is ever NaN.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from augkitti.config import GroundConfig
from augkitti.ego_motion import register
from augkitti.frames import F32, F64, transform_points
from augkitti.ground import fit_ground, standing_points
from augkitti.scan_pair import I64, AugmentedPair, Bool
from training.baselines.followed import FEWEST_POINTS, boxes_of, object_points
from training.baselines.rigid_fit import fit_rigid, ransac_rigid
from training.baselines.rigid_scene_flow import Energy, MotionGraph, Motions, moved_by, solve_motions, standing
from training.baselines.shot import describe, reference_frames, support_of, upright_frames
from training.predictions import Prediction


@dataclass(frozen=True)
class Region:
    """Where flow is looked for, in velo0; elsewhere no point has an estimate."""

    x_m: tuple[float, float] = (-5.0, 45.0)
    y_m: tuple[float, float] = (-30.0, 30.0)
    z_m: tuple[float, float] = (-4.0, 3.0)


@dataclass(frozen=True)
class DewanConfig:
    """Sizes and thresholds; without arguments those of the plain method."""

    name: str = "dewan"
    region: Region = Region()
    surface_m: float = 0.15  # a scan is thinned to one point a cell of so much, on which descriptors are taken
    normal_points: int = 12  # that a normal is fitted to
    radius_m: float = 1.5  # of descriptors
    vertex_m: float = 0.4  # cells of vertices on what stands
    target_m: float = 0.2  # cells of what they are matched to: finer, since a match is no better than its grid
    ground_m: float = 1.0  # cells of vertices on the ground
    window_m: float = 3.0  # the largest motion
    laid_over: bool = False  # scans are registered first
    upright: bool = False  # descriptors in upright frames
    mutual: bool = False  # a match is one only if no other vertex beside it fits its target better
    refined: int = 0  # rounds in which surfaces are drawn to each other, too
    near_m: float = 0.5  # surfaces that belong together are no further apart
    energy: Energy = field(default_factory=Energy)
    fine: Energy = field(default_factory=lambda: Energy(match_m=0.05, match_off_m=0.2, steps=2))  # of these rounds
    neighbours: int = 8  # of each vertex, at most
    reach_m: float = 1.2  # to neighbours on what stands
    voters: int = 16  # matches round a vertex that choose its start
    for_standing: int = 0  # votes beforehand for the start that the laid over scans give
    agree_m: float = 0.4  # matches that the motion of a vertex misses by less bear it out
    bear_out: int = 8  # as many have to, of the `voters` nearest
    bear_out_m: float = 4.0  # and no further away
    ground_reach_m: float = 8.0  # the same for the ground, which is one body
    still_m: float = 0.15  # the ground's motion is borne out by what stands and moves within so much of it
    beside_m: float = 0.6  # a point has the motion of the vertex that is no further away


PLAIN = DewanConfig()
STRONG = replace(
    PLAIN, name="dewan_strong", window_m=3.5, laid_over=True, upright=True, mutual=True, for_standing=3, refined=2
)


def dewan(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """As the paper has it, as far as the module says: per-point motions, pooled by least squares."""
    return scene_flow_of(pair, detections, PLAIN)


def dewan_strong(pair: AugmentedPair, detections: Prediction | None = None) -> Prediction:
    """As strong as it can be made today; see above."""
    return scene_flow_of(pair, detections, STRONG)


def scene_flow_of(pair: AugmentedPair, detections: Prediction | None, config: DewanConfig) -> Prediction:
    """Either of the two; the module tells how."""
    start = register(pair.scan0.xyz, pair.scan1.xyz) if config.laid_over else np.eye(4)
    scan0 = thinned(pair.scan0.xyz, start, config.region, config.vertex_m, config)
    # what leaves the region is still found
    scan1 = thinned(pair.scan1.xyz, np.eye(4), _grown(config.region, config.window_m), config.target_m, config)
    upright = upright_motions(scan0, scan1, config)
    ground = ground_motions(scan0, upright, config)
    flow, where = painted(pair.scan0.xyz, start, scan0.stands, upright, ground, config)
    return pooled(pair, detections, flow, where, start, config)


@dataclass(frozen=True, eq=False)
class Thinned:
    """A scan as the method sees it; in velo1, that of scan 0 as far as the start lays it there."""

    stands: Bool  # (N,) points of the scan that stand, or hang, above the ground
    surface: F64  # (S, 3) of these, in the region
    normals: F64  # (S, 3) towards the scanner
    upright: F64  # (A, 3) vertices upon it
    ground: F64  # (G, 3) vertices on the ground


@dataclass(frozen=True, eq=False)
class Estimate:
    """Motions of V vertices, and which of them count."""

    motions: Motions
    valid: Bool  # (V,)


def thinned(xyz: F32, T_velo1_velo: F64, region: Region, cell_m: float, config: DewanConfig) -> Thinned:
    """A scan (N, 3) cut to the region, and thinned: cells of `cell_m` on what stands, of `config.ground_m` below."""
    stands = np.zeros(len(xyz), dtype=bool)
    stands[standing_points(xyz, fit_ground(xyz, GroundConfig()))] = True
    kept = _inside(xyz, region)
    points = transform_points(T_velo1_velo, xyz[kept & stands])
    surface = cell_means(points, config.surface_m)
    away = surface - T_velo1_velo[:3, 3]
    normals = fit_normals(surface, config.normal_points)
    normals *= np.where(np.einsum("sa,sa->s", normals, away) > 0.0, -1.0, 1.0)[:, None]
    ground = cell_means(transform_points(T_velo1_velo, xyz[kept & ~stands]), config.ground_m)
    return Thinned(stands, surface, normals, cell_means(points, cell_m), ground)


def cell_means(points: F64, cell_m: float) -> F64:
    """The mean of the points (N, 3) in each cube of `cell_m` that holds some, (C, 3)."""
    if not len(points):
        return np.zeros((0, 3))
    cell = np.floor(points / cell_m).astype(np.int64) + (1 << 20)
    _, which = np.unique((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2], return_inverse=True)
    count = np.bincount(which)
    return np.stack([np.bincount(which, points[:, k]) / count for k in range(3)], axis=1)


def fit_normals(points: F64, count: int) -> F64:
    """Unit normals (N, 3), of unknown side: the direction in which the `count` nearest points spread least."""
    if len(points) < 3:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    _, near = cKDTree(points).query(points, min(count, len(points)))
    away = points[near] - points[near].mean(axis=1, keepdims=True)
    return np.asarray(np.linalg.eigh(np.einsum("nka,nkb->nab", away, away))[1][:, :, 0])


def descriptors(scan: Thinned, config: DewanConfig) -> F32:
    """SHOT (A, 352) of the upright vertices."""
    support = support_of(scan.surface, scan.upright, config.radius_m)
    frames = upright_frames(scan.upright) if config.upright else reference_frames(support)
    return describe(support, scan.normals, frames)


def best_matches(xyz0: F64, said0: F32, xyz1: F64, said1: F32, config: DewanConfig) -> tuple[I64, I64]:
    """Rows (D,), (D,) of vertices and of what resembles each most within the largest motion, by the descriptors.

    With `config.mutual` what a target resembles most has to lie beside the vertex.
    """
    nothing = np.zeros(0, dtype=np.int64)
    told0, told1 = said0.any(axis=1), said1.any(axis=1)
    if not told0.any() or not told1.any():
        return nothing, nothing
    best, score = np.full(len(xyz0), -1), np.full(len(xyz0), -np.inf)
    back, back_score = np.full(len(xyz1), -1), np.full(len(xyz1), -np.inf)
    block = np.floor(xyz0[:, :2] / _BLOCK_M).astype(np.int64)
    _, block = np.unique((block[:, 0] << 32) + block[:, 1], return_inverse=True)
    for k in range(int(block.max()) + 1):
        rows = np.flatnonzero((block == k) & told0)
        if not len(rows):
            continue
        low, high = xyz0[rows].min(axis=0) - config.window_m, xyz0[rows].max(axis=0) + config.window_m
        columns = np.flatnonzero(told1 & ((xyz1 >= low) & (xyz1 <= high)).all(axis=1))
        if not len(columns):
            continue
        alike = said0[rows] @ said1[columns].T
        apart = ((xyz0[rows, None] - xyz1[None, columns]) ** 2).sum(axis=2)
        alike[apart > config.window_m**2] = -np.inf
        at = alike.argmax(axis=1)
        best[rows], score[rows] = columns[at], alike[np.arange(len(rows)), at]
        at = alike.argmax(axis=0)
        value = alike[at, np.arange(len(columns))]
        better = value > back_score[columns]
        back[columns[better]], back_score[columns[better]] = rows[at[better]], value[better]
    rows = np.flatnonzero(np.isfinite(score))
    if config.mutual:
        rows = rows[np.linalg.norm(xyz0[back[best[rows]]] - xyz0[rows], axis=1) < 1.5 * config.vertex_m]
    return rows, best[rows]


def upright_motions(scan0: Thinned, scan1: Thinned, config: DewanConfig) -> Estimate:
    """The motion of every upright vertex of scan 0, from matches and neighbours."""
    said0, said1 = descriptors(scan0, config), descriptors(scan1, config)
    rows, targets = best_matches(scan0.upright, said0, scan1.upright, said1, config)
    at, target = scan0.upright[rows], scan1.upright[targets]
    edges = neighbours_of(scan0.upright, config.neighbours, config.reach_m)
    start = standing(scan0.upright, voted(scan0.upright, at, target - at, config))
    graph = MotionGraph(scan0.upright, rows, at, target, np.tile(np.eye(3), (len(rows), 1, 1)), edges)
    motions = solve_motions(graph, start, config.energy)
    for _ in range(config.refined):
        motions = solve_motions(with_surfaces(graph, motions, scan0, scan1, config), motions, config.fine)
    return Estimate(motions, borne_out(motions, at, target, config.agree_m, config.bear_out_m, config))


def with_surfaces(
    graph: MotionGraph, motions: Motions, scan0: Thinned, scan1: Thinned, config: DewanConfig
) -> MotionGraph:
    """The graph with every surface point beside a vertex drawn to the plane of scan 1 that it lies nearest to.

    Along that plane it is drawn as little as by a match, whose own say shrinks as much: in `config.fine`'s spread.
    """
    distance, vertex = cKDTree(graph.xyz).query(scan0.surface, distance_upper_bound=config.beside_m)
    point, vertex = scan0.surface[np.isfinite(distance)], vertex[np.isfinite(distance)]
    distance, near = cKDTree(scan1.surface).query(motions.moved(vertex, point), distance_upper_bound=config.near_m)
    met = np.isfinite(distance)
    point, vertex, near = point[met], vertex[met], near[met]
    normal = scan1.normals[near]
    loose = (config.fine.match_m / config.energy.match_m) ** 2
    plane = (1.0 - loose) * np.einsum("da,db->dab", normal, normal) + loose * np.eye(3)
    return MotionGraph(
        graph.xyz,
        np.concatenate([graph.matched, vertex]),
        np.concatenate([graph.point, point]),
        np.concatenate([graph.target, scan1.surface[near]]),
        np.concatenate([loose * graph.information, plane]),
        graph.edges,
    )


def ground_motions(scan0: Thinned, upright: Estimate, config: DewanConfig) -> Estimate:
    """The motion of every vertex on the ground, whose descriptors say nothing: that of what stands on it.

    Around the motion that most of what stands has, so that the ground does not follow what drives over it.
    """
    rows = np.flatnonzero(upright.valid)
    at = upright.motions.xyz[rows]
    target = at + upright.motions.shift[rows]
    most, _ = ransac_rigid(at, target, config.still_m, np.random.default_rng(0), draws=100)
    start = moved_by(most, scan0.ground)
    near = _nearest(scan0.ground, at, config.neighbours, config.ground_reach_m)
    vertex, said = near[:, 0], rows[near[:, 1]]
    point = scan0.ground[vertex]
    graph = MotionGraph(
        scan0.ground,
        vertex,
        point,
        upright.motions.moved(said, point),
        np.tile(np.eye(3), (len(vertex), 1, 1)),
        neighbours_of(scan0.ground, config.neighbours, _GROUND_REACH_M),
    )
    motions = solve_motions(graph, start, replace(config.energy, match_off_m=config.still_m))
    return Estimate(motions, borne_out(motions, at, target, config.still_m, config.ground_reach_m, config))


def neighbours_of(xyz: F64, count: int, reach_m: float) -> I64:
    """Pairs (E, 2) of vertices (V, 3): each with the `count` nearest within reach, no pair twice."""
    pairs = np.sort(_nearest(xyz, xyz, count + 1, reach_m), axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0)


def voted(xyz: F64, at: F64, shift: F64, config: DewanConfig) -> F64:
    """A shift (V, 3) for each vertex: that of the matches (D, 3) round it which most others there agree with."""
    if not len(at) or not len(xyz):
        return np.zeros_like(xyz)
    _, near = cKDTree(at).query(xyz, np.arange(1, min(config.voters, len(at)) + 1))
    said = shift[near]
    agree = ((said[:, :, None] - said[:, None]) ** 2).sum(axis=3) < config.agree_m**2
    votes = agree.sum(axis=2) + config.for_standing * ((said**2).sum(axis=2) < config.agree_m**2)
    most = votes.argmax(axis=1)
    chosen = agree[np.arange(len(xyz)), most]
    return np.asarray(np.einsum("vk,vka->va", chosen, said) / chosen.sum(axis=1)[:, None])


def borne_out(motions: Motions, at: F64, target: F64, within_m: float, reach_m: float, config: DewanConfig) -> Bool:
    """Which vertices (V,) have a motion that takes enough of the nearest points (D, 3) to their targets (D, 3)."""
    valid = np.zeros(len(motions.xyz), dtype=bool)
    if not len(at) or not len(valid):
        return valid
    distance, near = cKDTree(at).query(motions.xyz, np.arange(1, min(config.voters, len(at)) + 1))
    vertex = np.repeat(np.arange(len(valid)), near.shape[1])
    off = np.linalg.norm(motions.moved(vertex, at[near.reshape(-1)]) - target[near.reshape(-1)], axis=1)
    good = (off.reshape(near.shape) < within_m) & (distance < reach_m)
    return np.asarray(good.sum(axis=1) >= config.bear_out)


def painted(
    xyz: F32, start: F64, stands: Bool, upright: Estimate, ground: Estimate, config: DewanConfig
) -> tuple[F32, Bool]:
    """Flow (N, 3) of a scan's points, that of the nearest vertex, and where there is one that counts (N,).

    What stands has that of upright vertices, all else that of vertices on the ground.
    """
    flow, where = np.zeros((len(xyz), 3), np.float32), np.zeros(len(xyz), dtype=bool)
    inside = _inside(xyz, config.region)
    for mine, said, beside_m in ((stands, upright, config.beside_m), (~stands, ground, config.ground_m)):
        rows = np.flatnonzero(inside & mine)
        if not said.valid.any() or not len(rows):
            continue
        laid = transform_points(start, xyz[rows])
        distance, vertex = cKDTree(said.motions.xyz).query(laid, distance_upper_bound=beside_m)
        kept = np.isfinite(distance)
        kept[kept] = said.valid[vertex[kept]]
        flow[rows[kept]] = said.motions.moved(vertex[kept], laid[kept]) - xyz[rows[kept]]
        where[rows[kept]] = True
    return flow, where


def pooled(
    pair: AugmentedPair, detections: Prediction | None, flow: F32, where: Bool, start: F64, config: DewanConfig
) -> Prediction:
    """What is said of the pair, with motions pooled over the points that have flow in each detection, and outside."""
    boxes = boxes_of(detections)
    inside = object_points(pair.scan0.xyz, boxes)
    background = where.copy()
    for rows in inside:
        background[rows] = False
    ego_motion = _pool(pair.scan0.xyz, flow, np.flatnonzero(background), start, config)
    motions = [_pool(pair.scan0.xyz, flow, rows[where[rows]], ego_motion, config) for rows in inside]
    return Prediction(
        pair.pair_id,
        {config.name: flow},
        where,
        ego_motion=ego_motion,
        boxes=boxes,
        scores=np.zeros(0) if detections is None or detections.scores is None else detections.scores,
        motions=np.array(motions).reshape(-1, 4, 4),
    )


def _pool(xyz: F32, flow: F32, rows: I64, otherwise: F64, config: DewanConfig) -> F64:
    if len(rows) < FEWEST_POINTS:
        return otherwise
    rows = rows[:: 1 + len(rows) // 4000]
    points = xyz[rows].astype(np.float64)
    if not config.laid_over:
        return fit_rigid(points, points + flow[rows])
    return ransac_rigid(points, points + flow[rows], 0.1, np.random.default_rng(0), draws=100)[0]


_BLOCK_M = 6.0  # vertices that are compared at once
_GROUND_REACH_M = 6.0  # rings on the ground are as far apart as this


def _nearest(of: F64, among: F64, count: int, reach_m: float) -> I64:
    """Pairs (P, 2) of rows: each with the `count` nearest within reach."""
    if not len(of) or not len(among):
        return np.zeros((0, 2), dtype=np.int64)
    distance, near = cKDTree(among).query(of, np.arange(1, min(count, len(among)) + 1), distance_upper_bound=reach_m)
    row, column = np.nonzero(np.isfinite(distance))
    return np.stack([row, near[row, column]], axis=1).astype(np.int64)


def _inside(xyz: F32, region: Region) -> Bool:
    low, high = np.transpose([region.x_m, region.y_m, region.z_m]).astype(np.float32)
    return np.asarray(((xyz >= low) & (xyz < high)).all(axis=1))


def _grown(region: Region, by_m: float) -> Region:
    return Region(*((low - by_m, high + by_m) for low, high in (region.x_m, region.y_m, region.z_m)))
