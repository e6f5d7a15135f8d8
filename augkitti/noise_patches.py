"""Local patches: raw scans with their rays in; judged returns, rays and edges with the conditions of each out.

A return is judged by a plane through its neighbours on OTHER beams (three rings above and below, eight encoder steps
to each side). Patches are chosen by those neighbours alone, never by what is judged, so that a return that lies far
off stays in, and the tails are real. Nothing here needs labels, nor the beams' biases: what biases of the neighbours
do to a prediction is linear (`ring_weight`), so it is taken out afterwards, with biases from the scans that are fitted.

Judged rays are fired rays between neighbours on their own ring that lie on one smooth line: returned or not (isolated
drops; clumps do not qualify). Judged edges are rays between two smooth pieces of a ring that lie apart in range.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import I64, NO_TICK, U8, Bool, Scan, ScanRays
from augkitti.scanner import ScannerProfile, lines_of_rays

RING_OFFSETS = (-3, -2, -1, 1, 2, 3)
GROUND, WALL, SLANTED = range(3)  # of a patch's normal: |n_z| above 0.9, below 0.3, between
KEPT_NEAR, KEPT_FAR, MIXED_BETWEEN, NOTHING = range(4)  # outcomes at an edge

_STEPS = np.arange(-8, 9)  # encoder steps (0.09 degrees) to each side; one firing is 1.86 of them
_MIN_NEIGHBOURS = 20
_MIN_OF_A_RING = 4
_OUTLIER_SHARE = 0.06  # of the neighbours, beyond 3 sigma of the patch
_ROUGH_M = 0.02  # across the surface, within rings
_REACH_M = 2.0  # of neighbours from where the middle one lies: on far ground three rings span many metres
_RING_OFF_M = (0.02, 0.07)  # mean of a ring off the plane: across the surface, and along the ray (biases reach 0.06 m)
_MIN_COSINE = 0.1
_RANGE_M = (2.0, 75.0)
_CHUNK = 8192
_LINE_SIDE = 4  # neighbours to each side of a judged ray; three of them have to be there
_LINE_OFF_M = 0.05  # of the neighbours from their line
_FRINGE_STEPS = 40  # round the ego car's shadow
_ROUND_STEPS = 12  # encoder steps to each side, in which other lost rays are counted
_EDGE_SIDE = 3
_EDGE_STEP_M = 1.0
_MIXED_M = 0.25  # scanner.md section 2: a mixed point is this far from both sides

Record = TypeVar("Record", "JudgedReturns", "JudgedRays", "JudgedEdges", "JudgedShots")


@dataclass(frozen=True, eq=False)
class JudgedReturns:
    """Returns on smooth patches. n of them; six neighbouring rings in the order of `RING_OFFSETS`."""

    scan: I64  # (n,) number of the scan among those given
    ring: U8  # (n,)
    step: I64  # (n,) encoder step of the azimuth: tick plus the beam's offset
    range_m: F64  # (n,) at which the neighbours' plane is met
    cos_incidence: F64  # (n,)
    reflectance: F64  # (n,) of the judged return itself
    slope: U8  # (n,) GROUND, WALL or SLANTED
    residual_m: F64  # (n,) measured range less the plane's
    white_gain: F64  # (n,) variance of the plane's range for neighbours with unit white noise
    rough_m: F64  # (n,) spread of the neighbours along their rings about the plane, across the surface
    ring_weight: F64  # (n, 6) derivative of the plane's range by each ring's bias; sums to 1 nearly
    ring_slant: F64  # (n, 6) what a ring's bias does to its residual: its cosine of incidence over the judged ray's
    ring_residual_m: F64  # (n, 6) mean of each ring off the plane, along the rays; NaN where a ring has too few points
    ring_hat: F64  # (n, 6, 6) derivative of the plane at each ring by each ring's bias


@dataclass(frozen=True, eq=False)
class JudgedRays:
    """Fired rays that their neighbours on the ring bracket."""

    scan: I64
    ring: U8
    range_m: F64  # (n,) where the neighbours' line is met
    cos_incidence: F64  # (n,)
    reflectance: F64  # (n,) median of the neighbours'
    slope: U8
    rough_m: F64  # (n,) spread of the neighbours about their line
    lost_own: F64  # (n,) share of other rays near on the ring that returned nothing
    lost_beside: (
        F64  # (n,) the same on the rings above and below: the smaller of the two, since one may look at the sky
    )
    returned: Bool


@dataclass(frozen=True, eq=False)
class JudgedEdges:
    """Rays between two smooth pieces of a ring that lie more than 1 m apart in range. Each boundary counts once."""

    scan: I64
    ring: U8
    near_m: F64
    far_m: F64
    reflectance_near: F64
    outcome: U8  # KEPT_NEAR (a clean boundary), MIXED_BETWEEN or NOTHING
    share: F64  # of the way from near to far, for mixed points; else NaN


@dataclass(frozen=True, eq=False)
class JudgedShots:
    """Returns against the parabola through three firings to each side on their own ring: one beam, shot to shot."""

    scan: I64
    ring: U8
    range_m: F64
    reflectance: F64
    deviation_m: F64  # scaled so that its spread is that of one return
    spread_m: F64  # of the six neighbours about their parabola


@dataclass(frozen=True, eq=False)
class _Grid:
    """A scan's rays by (ring, encoder step), so that neighbours in azimuth are neighbours in the table."""

    ray: I64  # (beams, lattice) index of the fired ray; -1 none
    xyz: F64  # (beams, lattice, 3) NaN where nothing returned
    time_s: F64  # (beams, lattice)
    range_m: F64  # (beams, lattice) NaN where nothing returned
    reflectance: F64


def concatenate(parts: Iterable[Record]) -> Record:
    """Several scans' records as one.

    Raises:
        ValueError: no parts.
    """
    several = list(parts)
    kind: Any = type(several[0])
    return kind(**{f.name: np.concatenate([getattr(part, f.name) for part in several]) for f in fields(kind)})  # type: ignore[no-any-return]


def take(record: Record, rows: npt.NDArray[Any]) -> Record:
    """Some rows (indices or mask) of a record."""
    kind: Any = type(record)
    return kind(**{f.name: getattr(record, f.name)[rows] for f in fields(kind)})  # type: ignore[no-any-return]


def check_raw(scan: Scan, where: str) -> None:
    """Refuse compensated scans: their points lie centimetres off the rays.

    Raises:
        InputError: the scan is not a raw one.
    """
    if scan.kind != "raw":
        raise InputError(
            where,
            "compensated scans cannot tell a raw scanner's noise: their points were moved off their rays",
            "give raw drives or object scans; nothing can be fitted from these",
        )


def judge_returns(
    scan: Scan,
    rays: ScanRays,
    profile: ScannerProfile,
    number: int = 0,
    twist: F64 | None = None,
    share: float = 1.0,
    rng: np.random.Generator | None = None,
) -> tuple[JudgedReturns, int]:
    """Returns on smooth patches, and how many were tried.

    Args:
        scan: a raw scan.
        rays: its rays (`scanner.assign_rays`).
        profile: the scanner.
        number: what `scan` of the result says.
        twist: (6,) motion of the scanner per second in its own frame (`pair_motion.ego_twist`). Neighbouring rings
            look at one azimuth up to 5 ms apart, 6 cm at 11 m/s; without, that stays in the residuals.
        share: of the returns that are tried, drawn with `rng`; all by default.
        rng: needed where `share` is below 1.

    Raises:
        InputError: the scan is a compensated one.
    """
    check_raw(scan, f"scan {number}")
    grid = _grid(scan, rays, profile)
    ring, step = np.nonzero(np.isfinite(grid.range_m))
    if share < 1.0:
        drawn = (rng or np.random.default_rng(0)).random(len(ring)) < share
        ring, step = ring[drawn], step[drawn]
    parts = [
        _judge_chunk(grid, rays, profile, number, twist, ring[at : at + _CHUNK], step[at : at + _CHUNK])
        for at in range(0, max(len(ring), 1), _CHUNK)
    ]
    return concatenate(parts), len(ring)


def _judge_chunk(
    grid: _Grid, rays: ScanRays, profile: ScannerProfile, number: int, twist: F64 | None, ring: I64, step: I64
) -> JudgedReturns:
    count = len(ring)
    rows = ring[:, None] + np.array(RING_OFFSETS)
    on = (rows >= 0) & (rows < profile.beams)
    rows = np.clip(rows, 0, profile.beams - 1)
    columns = (step[:, None] + _STEPS) % profile.lattice_size
    cell = rows[:, :, None] * profile.lattice_size + columns[:, None, :]  # (n, 6, 17)
    ray = grid.ray[ring, step].astype(np.int32)
    origin, direction = lines_of_rays(profile, rays, ray)
    xyz = grid.xyz.reshape(-1, 3)[cell]
    if twist is not None:  # into the scanner's frame at the judged return's own firing
        later = grid.time_s.reshape(-1)[cell] - grid.time_s[ring, step][:, None, None]
        moved = twist[:3] + np.cross(twist[3:], xyz)
        xyz = xyz + later[..., None] * moved
    off = xyz - origin[:, None, None, :]
    there = on[:, :, None] & np.isfinite(off[..., 0])
    off[~there] = 0.0
    middle = _middle_range(np.einsum("nrsk,nk->nrs", off, direction), there)
    beside = slice(RING_OFFSETS.index(-1), RING_OFFSETS.index(1) + 1)
    seen_beside = there[:, beside].sum(axis=(1, 2))
    there &= np.linalg.norm(off - (middle[:, None] * direction)[:, None, None, :], axis=-1) < _REACH_M
    off[~there] = 0.0
    flat = np.hypot(direction[:, 0], direction[:, 1])
    e1 = np.stack([-direction[:, 1] / flat, direction[:, 0] / flat, np.zeros(count)], axis=1)
    e2 = np.cross(direction, e1)
    a, b, c = (np.einsum("nrsk,nk->nrs", off, axis) for axis in (e1, e2, direction))
    weight = there.astype(np.float64)
    coefficient, inverse, residual, of_ring, mean = _fit(a, b, c, weight)
    within = np.where(there, residual - mean[:, :, None], np.nan)
    total = there.sum(axis=(1, 2))
    spread = _median_of_absolute(within, there) * 1.4826
    good = there & (np.abs(np.nan_to_num(within)) < 3.0 * np.maximum(spread, 0.008)[:, None, None])
    weight = good.astype(np.float64)
    coefficient, inverse, residual, of_ring, mean = _fit(a, b, c, weight)
    within = residual - mean[:, :, None]

    kept = weight.sum(axis=(1, 2))
    freedom = np.maximum(kept - 3.0 - (of_ring > 0).sum(axis=1), 1.0)
    steepness = np.sqrt(1.0 + coefficient[:, 1] ** 2 + coefficient[:, 2] ** 2)
    cosine = 1.0 / steepness
    rough = np.sqrt((weight * within**2).sum(axis=(1, 2)) / freedom) * cosine
    full = of_ring >= _MIN_OF_A_RING
    left, right = weight[:, :, _STEPS < 0].sum(axis=(1, 2)), weight[:, :, _STEPS > 0].sum(axis=(1, 2))
    smooth = (
        (kept >= _MIN_NEIGHBOURS)
        & (kept >= (1.0 - _OUTLIER_SHARE) * total)
        & (weight[:, beside].sum(axis=(1, 2)) >= (1.0 - _OUTLIER_SHARE) * seen_beside)
        & (of_ring[:, beside].min(axis=1) >= _MIN_OF_A_RING)
        & (full.sum(axis=1) >= 4)
        & (np.minimum(left, right) >= 0.3 * kept)
        & (rough <= _ROUGH_M)
        & (np.where(full, np.abs(mean), 0.0).max(axis=1) <= _RING_OFF_M[0] / cosine + _RING_OFF_M[1])
        & (cosine >= _MIN_COSINE)
        & (coefficient[:, 0] > _RANGE_M[0])
        & (coefficient[:, 0] < _RANGE_M[1])
    )
    normal = (coefficient[:, 1, None] * e1 + coefficient[:, 2, None] * e2 - direction) * cosine[:, None]
    sums = np.stack([weight, weight * a, weight * b], axis=-1).sum(axis=2)  # (n, 6, 3)
    centre = sums / np.maximum(of_ring, 1.0)[:, :, None]
    spread_by_ring = np.einsum("nij,nrj->nri", inverse, sums)
    # A bias moves a return along its own ray, not along the judged one.
    lines = np.stack([a, b, c], axis=-1) / np.maximum(np.linalg.norm(off, axis=-1), 1e-9)[..., None]
    towards = (
        lines[..., 2] - coefficient[:, 1, None, None] * lines[..., 0] - coefficient[:, 2, None, None] * lines[..., 1]
    )
    slant = (weight * towards).sum(axis=2) / np.maximum(of_ring, 1.0)
    measured = np.einsum("nk,nk->n", grid.xyz[ring, step] - origin, direction)
    result = JudgedReturns(
        scan=np.full(count, number, dtype=np.int64),
        ring=ring.astype(np.uint8),
        step=step.astype(np.int64),
        range_m=coefficient[:, 0],
        cos_incidence=cosine,
        reflectance=grid.reflectance[ring, step],
        slope=_slope_of(normal[:, 2]),
        residual_m=measured - coefficient[:, 0],
        white_gain=inverse[:, 0, 0],
        rough_m=rough,
        ring_weight=spread_by_ring[:, :, 0] * slant,
        ring_slant=slant,
        ring_residual_m=np.where(full, mean, np.nan),
        ring_hat=np.einsum("nri,nsi->nrs", centre, spread_by_ring * slant[:, :, None]),
    )
    return take(result, smooth)


def _fit(a: F64, b: F64, c: F64, weight: F64) -> tuple[F64, F64, F64, F64, F64]:
    """Plane c = x0 + x1 a + x2 b: coefficients (n, 3), inverse normal matrix, residuals, points and mean by ring."""
    ones = np.ones_like(a)
    columns = (ones, a, b)
    matrix = np.empty((len(a), 3, 3))
    right = np.empty((len(a), 3))
    for i in range(3):
        weighted = weight * columns[i]
        right[:, i] = (weighted * c).sum(axis=(1, 2))
        for j in range(i, 3):
            matrix[:, i, j] = matrix[:, j, i] = (weighted * columns[j]).sum(axis=(1, 2))
    matrix[:, (0, 1, 2), (0, 1, 2)] += 1e-9
    inverse = np.linalg.inv(matrix)
    coefficient = np.einsum("nij,nj->ni", inverse, right)
    fitted = coefficient[:, 0, None, None] + coefficient[:, 1, None, None] * a + coefficient[:, 2, None, None] * b
    residual = c - fitted
    of_ring = weight.sum(axis=2)
    mean = np.asarray((weight * residual).sum(axis=2) / np.maximum(of_ring, 1.0))
    return coefficient, np.asarray(inverse), residual, of_ring, mean


def _middle_range(along: F64, there: Bool) -> F64:
    """Median range (n,) of the rings next above and below: the judged return's own range must not choose."""
    near = slice(RING_OFFSETS.index(-1), RING_OFFSETS.index(1) + 1)
    flat = np.where(there[:, near], along[:, near], np.inf).reshape(len(along), -1)
    flat.sort(axis=1)
    half = np.minimum(there[:, near].sum(axis=(1, 2)) // 2, flat.shape[1] - 1)
    value = flat[np.arange(len(flat)), half]
    return np.where(np.isfinite(value), value, 0.0)


def _median_of_absolute(values: F64, there: Bool) -> F64:
    flat = np.where(there, np.abs(values), np.inf).reshape(len(values), -1)
    flat.sort(axis=1)
    return np.asarray(flat[np.arange(len(flat)), np.minimum(there.sum(axis=(1, 2)) // 2, flat.shape[1] - 1)])


def ring_spread(judged: JudgedReturns, bias_m: F64) -> F64:
    """Spread (n,) metres of the rings' means off the plane, across the surface, once the beams' biases are out."""
    bias = neighbour_bias(judged, bias_m)
    known = np.isfinite(judged.ring_residual_m)
    left = np.where(
        known, judged.ring_residual_m - judged.ring_slant * bias + np.einsum("nrs,ns->nr", judged.ring_hat, bias), 0.0
    )
    freedom = np.maximum(known.sum(axis=1) - 2, 1)
    return np.asarray(np.sqrt((left**2).sum(axis=1) / freedom) * judged.cos_incidence)


def neighbour_bias(judged: JudgedReturns, bias_m: F64) -> F64:
    """Biases (n, 6) of the neighbouring rings of each judged return."""
    rows = np.clip(judged.ring[:, None].astype(np.int64) + np.array(RING_OFFSETS), 0, len(bias_m) - 1)
    return np.asarray(bias_m[rows])


def expected_residual(judged: JudgedReturns, bias_m: F64) -> F64:
    """Residual (n,) that the beams' biases alone would leave."""
    return np.asarray(bias_m[judged.ring] - (judged.ring_weight * neighbour_bias(judged, bias_m)).sum(axis=1))


def judge_shots(scan: Scan, rays: ScanRays, profile: ScannerProfile, number: int = 0) -> JudgedShots:
    """Returns with three firings to each side on a smooth piece of their ring, chosen by those six alone.

    Raises:
        InputError: the scan is a compensated one.
    """
    check_raw(scan, f"scan {number}")
    rows = _by_firing(scan, rays, profile)
    shifts = (-3, -2, -1, 1, 2, 3)
    ring, at = np.nonzero(np.isfinite(rows.range_m))
    y = np.stack([np.roll(rows.range_m, -k, axis=1)[ring, at] for k in shifts], axis=1)
    whole = np.isfinite(y).all(axis=1) & (y.max(axis=1) - y.min(axis=1) < 1.0)
    ring, at, y = ring[whole], at[whole], y[whole]
    step = np.stack([np.roll(rows.step, -k, axis=1)[ring, at] for k in shifts], axis=1) - rows.step[ring, at][:, None]
    half = profile.lattice_size // 2
    place = ((step + half) % profile.lattice_size - half) / 2.0  # firings are one or two encoder steps apart
    powers = np.stack([np.ones_like(place), place, place * place], axis=-1)
    inverse = np.linalg.inv(np.einsum("nki,nkj->nij", powers, powers))
    parabola = np.einsum("nij,nkj,nk->ni", inverse, powers, y)
    spread = np.sqrt(((y - np.einsum("nki,ni->nk", powers, parabola)) ** 2).sum(axis=1) / 3.0)
    ok = (spread < 0.025) & (np.abs(parabola[:, 1]) < 0.3)
    ring, at, middle = ring[ok], at[ok], parabola[ok, 0]
    return JudgedShots(
        scan=np.full(len(ring), number, dtype=np.int64),
        ring=ring.astype(np.uint8),
        range_m=middle,
        reflectance=rows.reflectance[ring, at],
        deviation_m=(rows.range_m[ring, at] - middle) / np.sqrt(1.0 + inverse[ok, 0, 0]),
        spread_m=spread[ok],
    )


def judge_rays(scan: Scan, rays: ScanRays, profile: ScannerProfile, number: int = 0) -> JudgedRays:
    """Fired rays, returned or not, whose neighbours on their ring lie on one smooth line.

    Three of the four neighbours on each side are there, and lie within 5 cm of their parabola.
    The ego car's shadow is left out, and its borders, where the car itself takes some pulses.

    Raises:
        InputError: the scan is a compensated one.
    """
    check_raw(scan, f"scan {number}")
    rows = _by_firing(scan, rays, profile)
    shifts = [k for k in range(-_LINE_SIDE, _LINE_SIDE + 1) if k]
    ranges = np.stack([np.roll(rows.range_m, -k, axis=1) for k in shifts])
    there = np.isfinite(ranges)
    before, after = there[:_LINE_SIDE].sum(axis=0), there[_LINE_SIDE:].sum(axis=0)
    candidate = rows.fired & ~_near_shadow(profile)[np.arange(profile.beams)[:, None], rows.step]
    candidate &= (before >= 3) & (after >= 3)
    ring, at = np.nonzero(candidate)
    s = np.where(there, ranges, 0.0)[:, ring, at].T  # (n, 8)
    w = there[:, ring, at].T.astype(np.float64)
    place = np.array(shifts, dtype=np.float64) / _LINE_SIDE
    powers = np.stack([np.ones(8), place, place**2], axis=1)
    normal = np.einsum("nk,ki,kj->nij", w, powers, powers) + 1e-9 * np.eye(3)
    line = np.linalg.solve(normal, np.einsum("nk,ki,nk->ni", w, powers, s)[:, :, None])[:, :, 0]
    off = np.where(w > 0, s - line @ powers.T, 0.0)
    smooth = np.abs(off).max(axis=1) < _LINE_OFF_M
    rough = np.sqrt((off**2).sum(axis=1) / np.maximum(w.sum(axis=1) - 3.0, 1.0))
    ring, at, line, rough = ring[smooth], at[smooth], line[smooth], rough[smooth]
    reflectance = np.stack([np.roll(rows.reflectance, -k, axis=1)[ring, at] for k in shifts])
    cosine, normal_z = _incidence(rows, profile, ring, at, line)
    known = np.isfinite(cosine)
    ring, at, line, rough = ring[known], at[known], line[known], rough[known]
    lost_own, lost_beside = _lost_round(rows, ring, at)
    return JudgedRays(
        scan=np.full(len(ring), number, dtype=np.int64),
        ring=ring.astype(np.uint8),
        range_m=line[:, 0],
        cos_incidence=cosine[known],
        reflectance=np.nanmedian(reflectance[:, known], axis=0) if len(ring) else np.zeros(0),
        slope=_slope_of(normal_z[known]),
        rough_m=rough,
        lost_own=lost_own,
        lost_beside=lost_beside,
        returned=np.isfinite(rows.range_m[ring, at]),
    )


def judge_edges(scan: Scan, rays: ScanRays, profile: ScannerProfile, number: int = 0) -> JudgedEdges:
    """Boundaries between two smooth pieces of a ring: the ray between is clean, mixed, or nothing.

    Three firings on each side lie within 10 cm (and 1 % of the range) of a line; the sides are more than 1 m apart at
    the boundary. A clean boundary lies between two rays, a mixed or lost one is a ray of its own; each counts once.

    Raises:
        InputError: the scan is a compensated one.
    """
    check_raw(scan, f"scan {number}")
    rows = _by_firing(scan, rays, profile)
    parts: list[JudgedEdges] = []
    for ray_between in (0, 1):  # none: the sides touch; one: it is judged
        first = [np.roll(rows.range_m, k, axis=1) for k in range(1, _EDGE_SIDE + 1)]  # before this column
        second = [np.roll(rows.range_m, -k, axis=1) for k in range(ray_between, ray_between + _EDGE_SIDE)]
        bend0 = np.abs(first[0] - 2.0 * first[1] + first[2])
        bend1 = np.abs(second[0] - 2.0 * second[1] + second[2])
        limit = np.maximum(0.1, 0.01 * np.minimum(first[0], second[0]))
        with np.errstate(invalid="ignore"):
            edge = (bend0 < limit) & (bend1 < limit) & (np.abs(first[0] - second[0]) > _EDGE_STEP_M)
            edge &= np.abs(first[0] - first[2]) < 0.5
            edge &= np.abs(second[0] - second[2]) < 0.5
        edge &= rows.fired & ~rows.blind
        ring, at = np.nonzero(edge)
        a, b = first[0][ring, at], second[0][ring, at]
        near, far = np.minimum(a, b), np.maximum(a, b)
        shine0, shine1 = np.roll(rows.reflectance, 1, axis=1), np.roll(rows.reflectance, -ray_between, axis=1)
        reflectance = np.where(a < b, shine0[ring, at], shine1[ring, at])
        between = rows.range_m[ring, at]
        share = (between - near) / (far - near)
        if ray_between:
            lost = ~np.isfinite(between)
            mixed = ~lost & (between > near + _MIXED_M) & (between < far - _MIXED_M)
            outcome = np.where(lost, NOTHING, np.where(mixed, MIXED_BETWEEN, KEPT_FAR)).astype(np.uint8)
            chosen = lost | mixed
        else:
            outcome = np.full(len(ring), KEPT_NEAR, dtype=np.uint8)
            chosen = np.ones(len(ring), dtype=bool)
        share = np.where(outcome == MIXED_BETWEEN, share, np.nan)
        record = JudgedEdges(
            np.full(len(ring), number, dtype=np.int64), ring.astype(np.uint8), near, far, reflectance, outcome, share
        )
        parts.append(take(record, chosen))
    return concatenate(parts)


@dataclass(frozen=True, eq=False)
class _Firings:
    """A scan's rays by (ring, order of azimuth among the fired ones)."""

    fired: Bool  # (beams, width)
    blind: Bool
    range_m: F64  # NaN where nothing returned
    reflectance: F64
    step: I64  # encoder step, as in _Grid
    xyz: F64  # (beams, width, 3)
    grid: _Grid


def _by_firing(scan: Scan, rays: ScanRays, profile: ScannerProfile) -> _Firings:
    grid = _grid(scan, rays, profile)
    width = int((grid.ray >= 0).sum(axis=1).max(initial=1))
    beams = profile.beams
    step = np.zeros((beams, width), dtype=np.int64)
    fired = np.zeros((beams, width), dtype=bool)
    for beam in range(beams):
        its = np.flatnonzero(grid.ray[beam] >= 0)
        step[beam, : len(its)], fired[beam, : len(its)] = its, True
    row = np.arange(beams)[:, None]
    blind = np.where(fired, rays.ray_blind[np.maximum(grid.ray[row, step], 0)], True)
    range_m = np.where(fired, grid.range_m[row, step], np.nan)
    return _Firings(fired, blind, range_m, grid.reflectance[row, step], step, grid.xyz[row, step], grid)


def _grid(scan: Scan, rays: ScanRays, profile: ScannerProfile) -> _Grid:
    shape = (profile.beams, profile.lattice_size)
    lattice = np.flatnonzero(rays.ray_tick != NO_TICK)
    ring = rays.ray_ring[lattice].astype(np.int64)
    step = (rays.ray_tick[lattice].astype(np.int64) + profile.tick_offset[ring]) % profile.lattice_size
    ray = np.full(shape, -1, dtype=np.int64)
    ray[ring, step] = lattice
    time_s = np.zeros(shape)
    time_s[ring, step] = rays.ray_time_s[lattice]
    back = lattice[rays.ray_point[lattice] >= 0].astype(np.int32)
    point = rays.ray_point[back]
    ring = rays.ray_ring[back].astype(np.int64)
    step = (rays.ray_tick[back].astype(np.int64) + profile.tick_offset[ring]) % profile.lattice_size
    origin, direction = lines_of_rays(profile, rays, back)
    at = scan.xyz[point].astype(np.float64)
    xyz = np.full((*shape, 3), np.nan)
    range_m, reflectance = np.full(shape, np.nan), np.full(shape, np.nan)
    xyz[ring, step] = at
    range_m[ring, step] = ((at - origin) * direction).sum(axis=1)
    reflectance[ring, step] = scan.reflectance[point]
    return _Grid(ray, xyz, time_s, range_m, reflectance)


def _near_shadow(profile: ScannerProfile) -> Bool:
    """Cells (beams, lattice) by encoder step in the ego car's shadow or near it, on the ring or one beside."""
    shadow = np.stack([np.roll(row, int(by)) for row, by in zip(profile.blind, profile.tick_offset, strict=True)])
    near = _round_sum(shadow, _FRINGE_STEPS) > 0
    near[1:] |= near[:-1].copy()
    near[:-1] |= near[1:].copy()
    return np.asarray(near)


def _lost_round(rows: _Firings, ring: I64, at: I64) -> tuple[F64, F64]:
    """Shares (n,) of fired rays near judged ones that returned nothing: on their own ring, and on those beside."""
    grid, step = rows.grid, rows.step[ring, at]
    shape = grid.ray.shape
    blind = np.ones(shape, dtype=bool)
    of_ring, of_firing = np.nonzero(rows.fired)
    blind[of_ring, rows.step[of_ring, of_firing]] = rows.blind[of_ring, of_firing]
    fired = (grid.ray >= 0) & ~blind
    lost = fired & ~np.isfinite(grid.range_m)
    count, gone = (_round_sum(table, _ROUND_STEPS) for table in (fired, lost))
    own = (gone[ring, step] - lost[ring, step]) / np.maximum(count[ring, step] - fired[ring, step], 1.0)
    beside, seen = np.zeros(len(ring)), np.zeros(len(ring))
    for off in RING_OFFSETS:
        on = (ring + off >= 0) & (ring + off < shape[0])
        other = np.clip(ring + off, 0, shape[0] - 1)
        beside += np.where(on, gone[other, step], 0.0)
        seen += np.where(on, count[other, step], 0.0)
    return own, beside / np.maximum(seen, 1.0)


def _round_sum(table: Bool, reach: int) -> F64:
    """Sums over so many columns to each side, round the circle."""
    ends = np.concatenate([table[:, -reach:], table, table[:, :reach]], axis=1)
    total = np.concatenate([np.zeros((len(table), 1)), ends.cumsum(axis=1)], axis=1)
    width = 2 * reach + 1
    return np.asarray(total[:, width:] - total[:, :-width], dtype=np.float64)


def _incidence(rows: _Firings, profile: ScannerProfile, ring: I64, at: I64, line: F64) -> tuple[F64, F64]:
    """Cosine of incidence and |normal z| (n,) at judged rays: along from their ring, across from the rings beside."""
    step = rows.step[ring, at]
    azimuth = step * profile.tick_step_rad + profile.azimuth_rad[ring]
    elevation = profile.elevation_rad[ring]
    direction = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    e1 = np.stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(ring))], axis=1)
    firing = 2.0 * np.pi / max(rows.fired.shape[1], 1) * _LINE_SIDE
    along = line[:, :1] * firing * np.cos(elevation)[:, None] * e1 + line[:, 1:2] * direction
    here = line[:, :1] * direction + np.stack([0 * azimuth, 0 * azimuth, profile.height_m[ring]], axis=1)
    best = np.full((len(ring), 3), np.nan)
    nearest = np.full(len(ring), np.inf)
    for side in (-1, 1):
        other = ring + side
        on = (other >= 0) & (other < profile.beams)
        other = np.clip(other, 0, profile.beams - 1)
        cells = rows.grid.xyz[other[:, None], (step[:, None] + np.arange(-2, 3)) % profile.lattice_size]
        found = np.isfinite(cells[..., 0])
        mean = np.where(found[..., None], cells, 0.0).sum(axis=1) / np.maximum(found.sum(axis=1), 1)[:, None]
        apart = np.where(on & found.any(axis=1), np.linalg.norm(mean - here, axis=1), np.inf)
        closer = apart < nearest  # of the two rings beside, the one whose returns lie nearer: an edge is no tilt
        best[closer], nearest[closer] = (mean - here)[closer], apart[closer]
    normal = np.cross(along, best)
    length = np.linalg.norm(normal, axis=1)
    normal = normal / np.where(length > 0, length, np.nan)[:, None]
    return np.abs((normal * direction).sum(axis=1)), normal[:, 2]


def _slope_of(normal_z: F64) -> U8:
    upright = np.abs(normal_z)
    return np.where(upright > 0.9, GROUND, np.where(upright < 0.3, WALL, SLANTED)).astype(np.uint8)
