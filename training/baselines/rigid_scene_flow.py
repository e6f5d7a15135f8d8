"""Matched vertices with neighbours in, a rigid motion of each vertex out: the energy of Dewan et al., minimised.

Dewan, Caselitz, Tipaldi, Burgard, "Rigid Scene Flow for 3D LiDAR Scans", IROS 2016: a factor graph with a motion T_i
of every vertex p_i, a data term between T_i p_i and the vertex's match q_i, and a neighbourhood term that holds the
motions of neighbours together, log(T_i^-1 T_j); solved by a few Levenberg-Marquardt steps.

A motion is kept as a rotation about the vertex's own place and the place's shift, and neighbours are compared at the
middle between them: about the scanner a rotation would be a shift of metres, and the equations ill-conditioned.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from augkitti.frames import F64, transform_points
from augkitti.scan_pair import I64


@dataclass(frozen=True, eq=False)
class MotionGraph:
    """V vertices, D of which have a match, and E pairs of neighbours."""

    xyz: F64  # (V, 3) metres
    matched: I64  # (D,) rows of vertices; one may come more than once
    point: F64  # (D, 3) what moves with the vertex: itself, or a point beside it
    target: F64  # (D, 3) where its match lies in the second scan
    information: F64  # (D, 3, 3) of each match, in units of 1 / Energy.match_m^2: the identity, or less along a surface
    edges: I64  # (E, 2) rows of vertices, no pair twice


@dataclass(frozen=True)
class Energy:
    """How much the terms weigh. A residual counts fully while it is well below its `_off_m` and little above it."""

    match_m: float = 0.15  # spread of right matches
    match_off_m: float = 0.45  # from here on a match counts as wrong (Geman-McClure)
    neighbour_m: float = 0.03  # spread of the motions of neighbours on one body, at the middle between them
    neighbour_off_m: float = 0.2  # from here on they belong to two bodies (Geman-McClure)
    lever_m: float = 1.0  # what a difference of rotation is multiplied by, to be one of places
    steps: int = 5  # of Levenberg-Marquardt
    damping: float = 1e-3  # of the first step, relative to the diagonal


@dataclass(frozen=True, eq=False)
class Motions:
    """Of V vertices: `x -> rotation (x - xyz) + xyz + shift`."""

    xyz: F64  # (V, 3)
    rotation: F64  # (V, 3, 3)
    shift: F64  # (V, 3) metres

    def moved(self, vertex: I64, points: F64) -> F64:
        """Points (K, 3), each moved with its vertex (K,)."""
        away = points - self.xyz[vertex]
        return np.asarray(np.einsum("kab,kb->ka", self.rotation[vertex], away) + self.xyz[vertex] + self.shift[vertex])


def standing(xyz: F64, shift: F64 | None = None) -> Motions:
    """Vertices (V, 3) that do not turn, and move by `shift` (V, 3), or not at all."""
    turn = np.broadcast_to(np.eye(3), (len(xyz), 3, 3)).copy()
    return Motions(xyz, turn, np.zeros_like(xyz) if shift is None else shift)


def moved_by(T: F64, xyz: F64) -> Motions:
    """Vertices (V, 3) that all follow one motion (4, 4)."""
    turn = np.broadcast_to(T[:3, :3], (len(xyz), 3, 3)).copy()
    return Motions(xyz, turn, transform_points(T, xyz) - xyz)


def solve_motions(graph: MotionGraph, start: Motions, energy: Energy) -> Motions:
    """The motions of least energy near `start`: Levenberg-Marquardt on reweighted least squares, a direct solver.

    Vertices without a match take up what their neighbours have, and keep the start where none has one. Without
    matches the start comes back.
    """
    if not len(graph.matched):
        return start
    pattern = _Pattern(graph)
    now, damping = start, energy.damping
    cost = energy_of(graph, now, energy)
    for _ in range(energy.steps):
        diagonal, across, gradient = _normal_equations(graph, now, energy, pattern)
        step = pattern.solve(diagonal, across, gradient, damping)
        then = _stepped(now, step)
        cost_then = energy_of(graph, then, energy)
        if cost_then < cost:
            settled = cost - cost_then < 1e-3 * cost
            now, cost, damping = then, cost_then, 0.1 * damping
            if settled:
                break
        else:
            damping *= 100.0
    return now


def energy_of(graph: MotionGraph, motions: Motions, energy: Energy) -> float:
    """The sum of both terms, each with its Geman-McClure kernel `s r^2 / (s + r^2)`, r^2 in units of its spread."""
    match = _match_square(graph, _match_residual(graph, motions)[0], energy)
    shift, turn, _, _ = _edge_residual(graph, motions)
    edge = _edge_square(shift, turn, energy)
    bound_match, bound_edge = _bounds(energy)
    return float((bound_match * match / (bound_match + match)).sum() + (bound_edge * edge / (bound_edge + edge)).sum())


def _bounds(energy: Energy) -> tuple[float, float]:
    return (energy.match_off_m / energy.match_m) ** 2, (energy.neighbour_off_m / energy.neighbour_m) ** 2


def _match_residual(graph: MotionGraph, motions: Motions) -> tuple[F64, F64]:
    """(D, 3) `T_i p - q`, and p's (turned) arm from its vertex."""
    away = graph.point - graph.xyz[graph.matched]
    arm = np.einsum("dab,db->da", motions.rotation[graph.matched], away)
    return graph.xyz[graph.matched] + motions.shift[graph.matched] + arm - graph.target, arm


def _match_square(graph: MotionGraph, residual: F64, energy: Energy) -> F64:
    square = np.einsum("da,dab,db->d", residual, graph.information, residual)
    return np.asarray(square / energy.match_m**2)


def _edge_residual(graph: MotionGraph, motions: Motions) -> tuple[F64, F64, F64, F64]:
    """Differences (E, 3) of shift and of rotation vector at the middle of each edge; its (turned) arms from both ends.

    To first order in the difference they are `log(T_i^-1 T_j)` about the middle.
    """
    i, j = graph.edges.T
    half = 0.5 * (graph.xyz[j] - graph.xyz[i])
    arm_i = np.einsum("eab,eb->ea", motions.rotation[i], half)
    arm_j = np.einsum("eab,eb->ea", motions.rotation[j], -half)
    shift = (graph.xyz[j] + motions.shift[j] + arm_j) - (graph.xyz[i] + motions.shift[i] + arm_i)
    relative = np.einsum("eab,ecb->eac", motions.rotation[j], motions.rotation[i])
    return shift, _rotation_vector(relative), arm_i, arm_j


def _edge_square(shift: F64, turn: F64, energy: Energy) -> F64:
    square = np.einsum("ea,ea->e", shift, shift) + energy.lever_m**2 * np.einsum("ea,ea->e", turn, turn)
    return np.asarray(square / energy.neighbour_m**2)


def _normal_equations(
    graph: MotionGraph, motions: Motions, energy: Energy, pattern: "_Pattern"
) -> tuple[F64, F64, F64]:
    """Blocks (V, 6, 6) of the diagonal and (E, 6, 6) of the edges (row i, column j), and the gradient (V, 6).

    A step is (shift, rotation vector) of a vertex: `shift + v`, `exp(w) rotation`.
    """
    bound_match, bound_edge = _bounds(energy)
    residual, arm = _match_residual(graph, motions)
    trust = (bound_match / (bound_match + _match_square(graph, residual, energy))) ** 2 / energy.match_m**2
    jacobian = np.zeros((len(residual), 3, 6))
    jacobian[:, :, :3], jacobian[:, :, 3:] = np.eye(3), -_cross(arm)
    weighed = np.einsum("dak,dab->dkb", jacobian, trust[:, None, None] * graph.information)
    blocks = np.concatenate([weighed @ jacobian, weighed @ residual[:, :, None]], axis=2)
    total = pattern.sum_matches(blocks)

    shift, turn, arm_i, arm_j = _edge_residual(graph, motions)
    trust = (bound_edge / (bound_edge + _edge_square(shift, turn, energy))) ** 2 / energy.neighbour_m**2
    lever = trust * energy.lever_m**2
    # residual = (v_j - [arm_j] w_j) - (v_i - [arm_i] w_i), and w_j - w_i: two blocks of the same shape, of unlike sign
    cross_i, cross_j = _cross(arm_i), _cross(arm_j)
    own = np.zeros((2, len(shift), 6, 7))
    for k, (cross, sign) in enumerate(((cross_i, -1.0), (cross_j, 1.0))):
        own[k, :, :3, :3] = trust[:, None, None] * np.eye(3)
        own[k, :, :3, 3:6] = -trust[:, None, None] * cross
        own[k, :, 3:, :3] = trust[:, None, None] * cross  # transposed, and cross is skew
        own[k, :, 3:, 3:6] = trust[:, None, None] * _skew_square(cross, cross) + lever[:, None, None] * np.eye(3)
        own[k, :, :3, 6] = sign * trust[:, None] * shift
        own[k, :, 3:, 6] = sign * (trust[:, None] * np.einsum("eab,eb->ea", cross, shift) + lever[:, None] * turn)
    across = np.zeros((len(shift), 6, 6))
    across[:, :3, :3] = -trust[:, None, None] * np.eye(3)
    across[:, :3, 3:] = trust[:, None, None] * cross_j
    across[:, 3:, :3] = -trust[:, None, None] * cross_i
    across[:, 3:, 3:] = -trust[:, None, None] * _skew_square(cross_i, cross_j) - lever[:, None, None] * np.eye(3)
    total += pattern.sum_edges(own.reshape(-1, 6, 7))
    return total[:, :, :6], across, total[:, :, 6]


class _Pattern:
    """Which blocks of the normal equations are there: the same at every step."""

    def __init__(self, graph: MotionGraph) -> None:
        self._vertices = len(graph.xyz)
        self._matches = _gather(graph.matched, self._vertices)
        self._ends = _gather(graph.edges.T.reshape(-1), self._vertices)
        i, j = graph.edges.T
        own = np.arange(self._vertices)
        row, column = np.concatenate([own, i, j]), np.concatenate([own, j, i])
        self._order = np.lexsort((column, row))
        self._column = column[self._order]
        self._start = np.searchsorted(row[self._order], np.arange(self._vertices + 1))

    def sum_matches(self, blocks: F64) -> F64:
        """Blocks (D, 6, 7) summed over the matches of each vertex."""
        return np.asarray((self._matches @ blocks.reshape(-1, 6 * 7)).reshape(self._vertices, 6, 7))

    def sum_edges(self, blocks: F64) -> F64:
        """Blocks (2 E, 6, 7), first ends first, summed over the edges of each vertex."""
        return np.asarray((self._ends @ blocks.reshape(-1, 6 * 7)).reshape(self._vertices, 6, 7))

    def solve(self, diagonal: F64, across: F64, gradient: F64, damping: float) -> F64:
        """The step (V, 6) of Levenberg-Marquardt."""
        damped = diagonal.copy()
        k = np.arange(6)
        # the constant holds vertices that nothing reaches where they are
        damped[:, k, k] += damping * diagonal[:, k, k] + 1e-6
        blocks = np.concatenate([damped, across, across.transpose(0, 2, 1)])[self._order]
        size = 6 * self._vertices
        matrix = sparse.bsr_matrix((blocks, self._column, self._start), shape=(size, size)).tocsc()
        factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return np.asarray(-factors.solve(gradient.reshape(-1)).reshape(-1, 6))


def _gather(rows: I64, vertices: int) -> sparse.csr_matrix:
    """(vertices, len(rows)) that sums what belongs to each vertex."""
    return sparse.csr_matrix((np.ones(len(rows)), (rows, np.arange(len(rows)))), shape=(vertices, len(rows)))


def _stepped(motions: Motions, step: F64) -> Motions:
    rotation = np.einsum("vab,vbc->vac", rotations_of(step[:, 3:]), motions.rotation)
    return Motions(motions.xyz, rotation, motions.shift + step[:, :3])


def rotations_of(vector: F64) -> F64:
    """Rotations (K, 3, 3) by rotation vectors (K, 3), Rodrigues' formula."""
    angle = np.sqrt(np.einsum("ka,ka->k", vector, vector))
    W = _cross(vector)
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + a[:, None, None] * W + b[:, None, None] * np.einsum("kab,kbc->kac", W, W))


def _rotation_vector(R: F64) -> F64:
    """Rotation vectors (K, 3) of rotations (K, 3, 3) below a half turn."""
    axis = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine = np.sqrt(np.einsum("ka,ka->k", axis, axis))
    angle = np.arctan2(sine, 0.5 * (np.einsum("kaa->k", R) - 1.0))
    return np.asarray(axis * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0)[:, None])


def _cross(vector: F64) -> F64:
    """Matrices (K, 3, 3) that take x to `vector` cross x."""
    out = np.zeros((len(vector), 3, 3))
    out[:, 0, 1], out[:, 0, 2] = -vector[:, 2], vector[:, 1]
    out[:, 1, 0], out[:, 1, 2] = vector[:, 2], -vector[:, 0]
    out[:, 2, 0], out[:, 2, 1] = -vector[:, 1], vector[:, 0]
    return out


def _skew_square(cross_a: F64, cross_b: F64) -> F64:
    """`cross_a^T cross_b` (K, 3, 3)."""
    return np.asarray(-np.einsum("eab,ebc->eac", cross_a, cross_b))
