"""Raw scans of one scanner in, its profile out: beam table, encoder, spin, quanta and the rays that never return.

Nothing is known beforehand but the order of points in the file: ring by ring, top beam first, azimuth rising from 0 to
360 degrees within a ring. Everything else follows from the coordinates:

1. elevation and height of a beam from the line z = height + tan(elevation) x along;
2. the encoder's lattice: the coarsest period of azimuth that all rings share, at any range;
3. side offset and azimuth of a beam: a point's azimuth is k steps + azimuth + asin(side / rho), k whole;
4. tick offsets: all beams fire at the same ticks, and the gaps between those (one step or two) tell where a ring's own
   count stands against the others';
5. the seam, and with it the spin: the one tick where a scan does not continue itself but the next scan of the drive.

Conventions are those of `augkitti.scanner`. Two choices are free and made here: ticks are counted so that the outermost
total azimuth offsets (tick offset x step + azimuth) lie evenly about zero, to the nearest tick; and a beam's azimuth is
what is left of its total within half a step. No other constant is free: azimuth 0 is the coordinates' own.
"""

import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import I64, NO_TICK, Bool, Scan
from augkitti.scanner import ScannerProfile, assign_rays, lines_of_rays, profile_from_content

MIN_SCANS = 3  # of one scanner; a single scan gives 4e-5 rad (scanner.md), but nothing then tells a slip
MIN_RING_POINTS = 200  # of a beam, over all scans
MIN_SHADOW_SCANS = 20  # each tick is fired in about every second scan

Spin = Literal["clockwise", "counter-clockwise"]

_ON_RAY_M = 0.002  # as in augkitti.scanner
_OFF_RAY_MEDIAN_M = 0.001  # scanner.md: raw scans 0.39 mm, compensated ones 11 to 19 mm
_TRIM_M = 0.002
_TICK_MARGIN = 0.01  # KITTI's scans: 0.03, for a shift by 13 ticks, which are 7 firings
_LEAST_RUN = 3  # points
_MANY_SCANS = 8  # fewer leave beams with hundreds of points only
_FAR_M = 8.0  # nearer points' azimuths are too coarse to show a fine lattice
_INVERSE_RANGE_BIN = 0.004  # per metre: within it, a side offset moves azimuths by less than a tenth of a step
_SPECTRUM = 1 << 17  # bins of azimuth: lattices up to a quarter of it are seen
_LEAST_LATTICE = 256
_MOST_SIDE_M = 0.15
_SIDE_STEP_M = 0.001
_SAMPLE = 3000  # points of a ring that the search of its side offset looks at
_RANGE_BIN_M = 0.00025
_RANGE_SCANS = 40  # whose ranges the quantum is taken from
_SEAM_SLACK = 2  # ticks: the seam is measured so well, and no better (scanner.md)
_MOST_STEP = (
    0.03  # of log range: edges of things count no more than this; shared drives need one pair with it, 4 with 0.1
)
_SHADOW_TICKS = 8  # shorter runs of silent ticks happen by chance
_SHADOW_REACH = 3  # ticks on either side that must be silent, too
_SHADOW_SHOTS = 20  # rays fired in that neighbourhood, at least
_SHADOW_ELSEWHERE = 0.85  # return rate of the beam outside of its silent runs: below, silence may be sky
_COORDINATE_QUANTA_M = (0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001)

Complex = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class SourceScan:
    """A scan and where it is from."""

    scan: Scan
    drive: str  # the physical recording
    frame: int
    timed: bool  # `scan.period_s` was measured, not assumed

    @property
    def where(self) -> str:
        """For messages."""
        return f"{self.drive}, frame {self.frame}"


@dataclass(frozen=True, eq=False)
class BeamTable:
    """Lines and encoder positions of all beams (B), top first; see `augkitti.scanner` for what the fields mean."""

    lattice_size: int
    lattice_power: float  # share of power that far points keep at the lattice's frequency: 1 is a perfect lattice
    elevation_rad: F64
    height_m: F64
    side_m: F64
    azimuth_rad: F64
    tick_offset: I64
    tick_match: F64  # (B,) share of the beam's points on ticks that other beams fired as well
    tick_margin: F64  # (B,) by how much of it the next best offset falls short
    points: I64  # (B,) that the beam was fitted on

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.elevation_rad)


@dataclass(frozen=True)
class Seam:
    """Where the scan begins and ends on the encoder, and which way time runs."""

    tick: int
    spin: Spin
    measured: bool  # else assumed: straight behind, clockwise
    pairs: int  # consecutive scans that were looked at
    raw_tick: int | None  # the tick of the best score, before it was taken for straight behind


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a number of scans say about a scanner whose beam table is known. B beams, T ticks."""

    scans: dict[str, int]  # of each drive
    left_out: tuple[tuple[str, int, str], ...]  # drive, frame, reason of scans that lie off the rays
    distance_m: F64  # sample of distances of points to their rays, strays (below) not among them
    points: int
    strays: int  # points on no fired ray, or second on one
    fired: I64  # (T,) scans in which a tick was fired
    returned: I64  # (B, T) scans in which a ray returned
    firings: tuple[int, int, int]  # fewest, median, most ticks fired in a scan
    gaps: dict[int, float]  # share of each gap between fired ticks
    firing_period_s: float
    timed: bool  # the firing period is from timestamps of start and end
    seam: Seam
    coordinate_quantum_m: float
    reflectance_quantum: float
    range_quantum_m: float | None  # None: ranges show no steps
    range_phase_m: F64  # (B,)
    range_lock: (
        float  # share of amplitude that ranges keep at the quantum's frequency; rounding alone leaves less than 1
    )
    min_range_m: float
    max_range_m: float


# ---------------------------------------------------------------------------------------------------------------------
# Beam table


def fit_beams(scans: Sequence[SourceScan]) -> BeamTable:
    """Beam table and encoder of the scanner that took the scans.

    Raises:
        InputError: too few scans, compensated scans among them, points not ring by ring, no encoder lattice (scans
            that were compensated, resampled or taken with another scanner), or a beam with too few points.
    """
    check_scans(scans)
    clouds = [_cloud(source) for source in scans]
    beams = _beam_count(clouds)
    whole = [cloud for cloud in clouds if cloud.runs == beams]
    ring = [cloud.run for cloud in whole]
    points = _by_ring(whole, ring, beams)
    for number, part in enumerate(points):
        if len(part.rho) < MIN_RING_POINTS:
            raise InputError(
                scans[0].where,
                f"and the other scans hold {len(part.rho)} points of beam {number}; {MIN_RING_POINTS} are needed",
                "give more scans, of streets with buildings; no beam table can be fitted from these",
            )
    lattice, power = find_lattice(points)
    if lattice == 0:
        raise InputError(
            scans[0].where,
            f"and the other scans show no encoder steps in azimuth (at most {power:.3f} of a perfect lattice's power): "
            "they were compensated, resampled, or are of several scanners",
            "give raw drives as KITTI has them (`raw/DATE/DRIVE_sync`); only elevations within 0.1 degrees could be "
            "fitted from these, which is no profile",
        )
    lines = np.array([_fit_line(part, 0.0) for part in points])
    if not (np.diff(lines[:, 0]) < 0.0).all():
        raise InputError(
            scans[0].where,
            "and the other scans do not hold one ring after the other, top beam first",
            "give scans as KITTI has them; nothing can be fitted without the rings",
        )
    step = 2.0 * np.pi / lattice
    turns = np.array([_fit_turn(part, step) for part in points])
    side, azimuth = turns[:, 0], turns[:, 1]
    lines = np.array([_fit_line(part, s) for part, s in zip(points, side, strict=True)])
    ticks, match, margin = _align_ticks(whole, ring, side, azimuth, lattice)
    total = ticks * step + azimuth
    ticks = ticks - int(np.rint((total.max() + total.min()) / 2.0 / step))
    return BeamTable(
        lattice_size=lattice,
        lattice_power=power,
        elevation_rad=np.arctan(lines[:, 0]),
        height_m=lines[:, 1],
        side_m=side,
        azimuth_rad=azimuth,
        tick_offset=ticks,
        tick_match=match,
        tick_margin=margin,
        points=np.array([len(part.rho) for part in points], dtype=np.int64),
    )


def check_scans(scans: Sequence[SourceScan]) -> None:
    """Refuse what no beam table can be fitted from.

    Raises:
        InputError: compensated scans, or too few.
    """
    for source in scans:
        if source.scan.kind != "raw":
            raise InputError(
                source.where,
                "is compensated: its points were moved off the scanner's rays, and raw and compensated scans are "
                "never mixed",
                "give raw drives or object scans; nothing of a raw profile can be fitted from this one",
            )
    if len(scans) < MIN_SCANS:
        raise InputError(
            scans[0].where if scans else "scans",
            f"{len(scans)} raw scans; a beam table needs {MIN_SCANS}",
            "give more; until then the shipped profile is KITTI's own scanner",
        )


@dataclass(frozen=True, eq=False)
class _Cloud:
    """A scan in the coordinates of the fit, split where azimuth wraps."""

    theta: F64  # azimuth, 0 to 2 pi
    rho: F64  # distance from the axis
    z: F64
    run: I64  # (N,) which run of rising azimuth
    runs: int


@dataclass(frozen=True, eq=False)
class _RingPoints:
    """The points of one beam in several scans."""

    theta: F64
    rho: F64
    z: F64


def _cloud(source: SourceScan) -> _Cloud:
    xyz = source.scan.xyz.astype(np.float64)
    theta = np.arctan2(xyz[:, 1], xyz[:, 0]) % (2.0 * np.pi)
    wraps = np.diff(theta, prepend=theta[:1]) < -np.pi
    # Points on the wrong side of a wrap can make a run of their own between two rings.
    starts = np.flatnonzero(wraps)
    wraps[starts[np.diff(np.append(starts, len(theta))) < _LEAST_RUN]] = False
    run = np.cumsum(wraps).astype(np.int64)
    return _Cloud(theta, np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]), 1e-3), xyz[:, 2], run, int(run[-1]) + 1)


def _beam_count(clouds: Sequence[_Cloud]) -> int:
    """The number of rings that most scans have; cut scans have fewer."""
    count, scans = Counter(cloud.runs for cloud in clouds).most_common(1)[0]
    if not 2 <= count <= 255 or scans < MIN_SCANS:
        raise InputError(
            "scans",
            f"azimuth wraps {count} times a scan in {scans} of {len(clouds)} scans: rings cannot be told apart",
            f"give {MIN_SCANS} scans whose points stand ring by ring, azimuth rising from 0 to 360 degrees in each",
        )
    return count


def _by_ring(clouds: Sequence[_Cloud], ring: Sequence[I64], beams: int) -> list[_RingPoints]:
    """The points of each beam, over all scans."""
    edges = [np.searchsorted(r, np.arange(beams + 1)) for r in ring]
    return [
        _RingPoints(
            *(
                np.concatenate([getattr(cloud, name)[e[b] : e[b + 1]] for cloud, e in zip(clouds, edges, strict=True)])
                for name in ("theta", "rho", "z")
            )
        )
        for b in range(beams)
    ]


def _fit_line(points: _RingPoints, side_m: float) -> tuple[float, float]:
    """Slope and height of a beam: z = height + slope x along. Rounding is the same near and far, so are weights."""
    along = np.sqrt(np.maximum(points.rho**2 - side_m**2, 1e-9))
    keep = np.ones(len(along), dtype=bool)
    slope, height = 0.0, 0.0
    for _ in range(8):  # strays of the wrap lie a ring off: centimetres
        slope, height = _straight(along[keep], points.z[keep])
        residual = np.abs(points.z - height - slope * along)
        kept = residual <= max(_TRIM_M, 4.0 * float(np.median(residual)))
        if (kept == keep).all():
            break
        keep = kept
    return slope, height


def _straight(x: F64, y: F64) -> tuple[float, float]:
    """Slope and intercept of the least-squares line."""
    middle = x.mean()
    away = x - middle
    slope = float((away * y).sum() / max(float((away * away).sum()), 1e-12))
    return slope, float(y.mean() - slope * middle)


def find_lattice(rings: Sequence[_RingPoints]) -> tuple[int, float]:
    """Number of encoder steps a turn (0: none is seen), and the share of power at that frequency.

    Azimuths of far points in a narrow class of range, where a side offset is one shift for all, have a spectrum with
    full power at the lattice's number and its multiples. Powers of all classes and rings are summed, so shifts do not
    matter. Firings that are even in time make a peak, too, but a fraction, and another one in each scan.
    """
    power = np.zeros(_SPECTRUM // 4)
    most = 0.0
    far = sorted(rings, key=lambda ring: -int((ring.rho > _FAR_M).sum()))[:16]
    for ring in far:
        inverse = np.floor(1.0 / ring.rho / _INVERSE_RANGE_BIN).astype(np.int64)
        for part in range(int(1.0 / _FAR_M / _INVERSE_RANGE_BIN)):
            theta = ring.theta[inverse == part]
            if len(theta) < 50:
                continue
            bins = np.floor(theta / (2.0 * np.pi) * _SPECTRUM).astype(np.int64) % _SPECTRUM
            counts = np.bincount(bins, minlength=_SPECTRUM)
            spectrum = np.fft.rfft(counts)[: len(power)]
            power += np.abs(spectrum) ** 2 - len(theta)
            most += len(theta) * (len(theta) - 1.0)
    share = power / max(most, 1.0)
    share[:_LEAST_LATTICE] = 0.0
    best = float(share.max())
    if best < 0.2:  # nothing: 0.01; a lattice with 1 mm rounding: 0.97
        return 0, best
    lattice = int(np.flatnonzero(share > 0.6 * best)[0])
    return lattice, float(share[lattice])


def _fit_turn(points: _RingPoints, step_rad: float) -> tuple[float, float]:
    """Side offset (metres) and azimuth (radians, within half a step) of a beam.

    A search of the side offset that brings all azimuths to one phase of the lattice, then least squares of the points'
    distances across their rays: the same weight for every millimetre, so far points settle the azimuth and near ones
    the side.
    """
    turn = 2.0 * np.pi / step_rad
    chosen = slice(None, None, max(1, len(points.rho) // _SAMPLE))
    theta, inverse = points.theta[chosen], 1.0 / points.rho[chosen]
    weight = 1.0 / (1.0 + (turn * 0.0003 * inverse) ** 2)
    sides = np.arange(-_MOST_SIDE_M, _MOST_SIDE_M + _SIDE_STEP_M / 2, _SIDE_STEP_M)
    base = weight * np.exp(1j * turn * theta)
    forward = np.exp(-1j * turn * inverse * _SIDE_STEP_M)
    at = np.exp(-1j * turn * inverse * sides[0])
    sums = np.zeros(len(sides), dtype=np.complex128)
    for i in range(len(sides)):
        sums[i] = (base * at).sum()
        at = at * forward
    best = int(np.argmax(np.abs(sums)))
    side, azimuth = float(sides[best]), float(np.angle(sums[best])) / turn
    for _ in range(6):
        along = np.sqrt(np.maximum(points.rho**2 - side**2, 1e-9))
        off = points.theta - np.arcsin(np.clip(side / points.rho, -1.0, 1.0)) - azimuth
        across = along * (off - np.rint(off / step_rad) * step_rad)
        # A near point is on some tick whatever the offset: only points that could also be off say anything.
        keep = (np.abs(across) <= _TRIM_M) & (along * step_rad > 2.0 * _TRIM_M)
        more_azimuth, more_side = _straight(along[keep], across[keep])
        side, azimuth = side + more_side, azimuth + more_azimuth
        if abs(more_side) < 1e-8 and abs(more_azimuth) < 1e-10:
            break
    return side, float((azimuth + step_rad / 2.0) % step_rad - step_rad / 2.0)


def _align_ticks(
    clouds: Sequence[_Cloud], ring: Sequence[I64], side: F64, azimuth: F64, lattice: int
) -> tuple[I64, F64, F64]:
    """Tick offset (B,) of each beam, the share (B,) of its points on ticks that others fired, the margin (B,) of that.

    The ring with most points leads; then every ring is set against the ticks that several rings agree on.
    """
    beams = len(side)
    step = 2.0 * np.pi / lattice
    seen = np.zeros((len(clouds), beams, lattice))
    for number, (cloud, r) in enumerate(zip(clouds, ring, strict=True)):
        off = cloud.theta - np.arcsin(np.clip(side[r] / cloud.rho, -1.0, 1.0)) - azimuth[r]
        k = np.rint(off / step)
        on = np.abs(off - k * step) * cloud.rho < _TRIM_M
        seen[number, r[on], k[on].astype(np.int64) % lattice] = 1.0
    spectra = np.fft.rfft(seen, axis=2)
    leader = seen[:, int(seen.sum(axis=(0, 2)).argmax())]
    offset = np.zeros(beams, dtype=np.int64)
    match, margin = np.zeros(beams), np.zeros(beams)
    for _ in range(3):
        towards = np.conj(np.fft.rfft(leader, axis=1))
        for beam in range(beams):
            alike = np.fft.irfft((spectra[:, beam] * towards).sum(axis=0), lattice)
            offset[beam] = int(alike.argmax())
            second, best = np.partition(alike, -2)[-2:]
            match[beam] = best / max(seen[:, beam].sum(), 1.0)
            margin[beam] = 1.0 - second / max(best, 1.0)
        rolled = np.zeros((len(clouds), lattice))
        for beam in range(beams):
            rolled += np.roll(seen[:, beam], -offset[beam], axis=1)
        leader = (rolled >= max(2.0, 0.06 * beams)).astype(np.float64)
    offset = (offset - offset[0] + lattice // 2) % lattice - lattice // 2
    return offset, match, margin


# ---------------------------------------------------------------------------------------------------------------------
# What scans say once the table is known


def gather(table: BeamTable, scans: Iterable[SourceScan]) -> Evidence:
    """Everything of a profile that is not in the beam table.

    Args:
        table: of the scanner.
        scans: in order of drive and frame: the seam needs consecutive ones. Read one by one, none is kept.

    Raises:
        InputError: a scan is compensated, or all of them lie off the rays.
    """
    profile = profile_from_content(_content_of(table), "fitted beam table")
    beams, lattice = table.beams, table.lattice_size
    fired, returned = np.zeros(lattice, dtype=np.int64), np.zeros((beams, lattice), dtype=np.int64)
    counts: Counter[str] = Counter()
    gaps: Counter[int] = Counter()
    left_out, distances, firings = [], [], []
    periods: list[float] = []
    assumed: list[float] = []
    ranges: list[tuple[npt.NDArray[np.uint8], F64]] = []
    coordinates, shades = [], []
    shortest, longest, points, on_rays, pairs = np.inf, 0.0, 0, 0, 0
    steps = np.zeros((3, lattice))
    before: tuple[str, int, F64] | None = None
    for source in scans:
        check_scans([source] * MIN_SCANS)
        scan = source.scan
        rays = assign_rays(scan, profile)
        on = rays.tick != NO_TICK
        origin, direction = lines_of_rays(profile, rays, rays.ray)
        offset = scan.xyz.astype(np.float64) - origin
        along = (offset * direction).sum(axis=1)
        distance = np.sqrt(((offset - along[:, None] * direction) ** 2).sum(axis=1))
        # Points off every ray have made-up rays of their own, so the share on rays judges, not the distance alone.
        if on.mean() < 0.9 or np.median(distance[on]) > _OFF_RAY_MEDIAN_M:
            reason = f"{100 * float(on.mean()):.1f} % of its points lie on rays of the table"
            left_out.append((source.drive, source.frame, reason))
            before = None
            continue
        counts[source.drive] += 1
        ticks = np.unique(rays.ray_tick[rays.ray_tick != NO_TICK]).astype(np.int64)
        fired[ticks] += 1
        returned[rays.ring[on], rays.tick[on]] += 1
        firings.append(len(ticks))
        gaps.update(np.diff(ticks).tolist())
        (periods if source.timed else assumed).append(scan.period_s / len(ticks))
        points += len(scan)
        on_rays += int(on.sum())
        distances.append(distance[on][::5])
        far = np.sqrt((scan.xyz.astype(np.float64) ** 2).sum(axis=1))
        shortest, longest = min(shortest, float(far.min())), max(longest, float(far.max()))
        if len(ranges) < _RANGE_SCANS:
            ranges.append((rays.ring[on], along[on]))
            coordinates.append(scan.xyz[:: max(1, len(scan) // 2000)].astype(np.float64).ravel())
            shades.append(np.unique(np.rint(scan.reflectance.astype(np.float64) * 1e5)))
        image = np.full((beams, lattice), np.nan)
        image[rays.ring[on], rays.tick[on]] = np.log(along[on])
        if before is not None and before[:2] == (source.drive, source.frame - 1):
            steps += _seam_steps(before[2], image, int(np.quantile(np.diff(ticks), 0.9)))
            pairs += 1
        before = (source.drive, source.frame, image)
    if not counts:
        where = "{}, frame {}".format(*left_out[0]) if left_out else "scans"
        raise InputError(where, "no scan lies on the beam table's rays", "give raw scans of one scanner")
    quantum, phase, lock = _range_steps(ranges, beams)
    total = max(sum(gaps.values()), 1)
    return Evidence(
        scans=dict(counts),
        left_out=tuple(left_out),
        distance_m=np.concatenate(distances),
        points=points,
        strays=points - on_rays,
        fired=fired,
        returned=returned,
        firings=(min(firings), int(np.median(firings)), max(firings)),
        gaps={gap: number / total for gap, number in sorted(gaps.items()) if number / total > 5e-4},
        firing_period_s=float(np.median(periods or assumed)),
        timed=bool(periods),
        seam=_find_seam(steps, pairs, lattice),
        coordinate_quantum_m=_coordinate_quantum(np.concatenate(coordinates)),
        reflectance_quantum=_reflectance_quantum(np.unique(np.concatenate(shades)) / 1e5),
        range_quantum_m=quantum,
        range_phase_m=phase,
        range_lock=lock,
        min_range_m=shortest,
        max_range_m=longest,
    )


def _seam_steps(before: F64, after: F64, reach: int) -> F64:
    """Mean step (3, T) of log range over tick t: within a scan, and to the next scan in either direction of spin.

    `before` and `after` (B, T) are consecutive scans, NaN where nothing returned; `reach` ticks to either side are
    compared, so many that one of them was fired. Row 1: the side t and up of the
    earlier scan against the side below t of the later one (time runs with falling tick: clockwise); row 2: the other
    way round.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # means of nothing
        sides = []
        for image in (before, after):
            rolled = np.stack([np.roll(image, -i, axis=1) for i in range(reach)])
            up = np.nanmean(rolled, axis=0)
            sides.append((np.roll(up, reach, axis=1), up))  # below t, from t on
        (below0, up0), (below1, up1) = sides
        steps = [(up0 - below0, up1 - below1), (up0 - below1,), (below0 - up1,)]
        rows = [
            np.mean([np.nanmean(np.minimum(np.abs(s), _MOST_STEP), axis=0) for s in pair], axis=0) for pair in steps
        ]
    return np.asarray(np.nan_to_num(np.array(rows)), dtype=np.float64)


def _find_seam(steps: F64, pairs: int, lattice: int) -> Seam:
    """The tick at which a scan continues the next one better than itself, if there is one."""
    behind = lattice // 2
    if pairs == 0:
        return Seam(behind, "clockwise", False, 0, None)
    gain = (steps[0] - steps[1:]) / pairs
    spin = int(gain.max(axis=1).argmax())
    tick = int(gain[spin].argmax())
    apart = np.abs((np.arange(lattice) - tick + lattice // 2) % lattice - lattice // 2) > 16
    if gain[spin, tick] <= 0.0 or gain[spin, tick] < 2.0 * max(float(gain[:, apart].max()), 0.0):
        return Seam(behind, "clockwise", False, pairs, None)  # the ego car stood: every tick continues itself
    exact = behind if abs(tick - behind) <= _SEAM_SLACK else tick
    return Seam(exact, "clockwise" if spin == 0 else "counter-clockwise", True, pairs, tick)


def _coordinate_quantum(values_m: F64) -> float:
    """The coarsest grid that coordinates stand on."""
    for quantum in _COORDINATE_QUANTA_M:
        steps = values_m / quantum
        # float32 resolves 8 micrometres at 80 m
        if np.mean(np.abs(steps - np.rint(steps)) * quantum < 1e-5) > 0.999:
            return quantum
    return 1e-5


def _reflectance_quantum(values: F64) -> float:
    """The step between values of reflectance."""
    return float(np.round(np.median(np.diff(values)), 5)) if len(values) > 1 else 0.01


def _range_steps(ranges: Sequence[tuple[npt.NDArray[np.uint8], F64]], beams: int) -> tuple[float | None, F64, float]:
    """Quantum (metres) of raw ranges, phase (B,) metres of each beam within half of it, and how sharp it is."""
    ring = np.concatenate([r for r, _ in ranges])
    along = np.concatenate([s for _, s in ranges])
    order = np.argsort(ring, kind="stable")
    edges = np.searchsorted(ring[order], np.arange(beams + 1))
    parts = [along[order[edges[b] : edges[b + 1]]] for b in range(beams)]
    size = 1 << int(np.ceil(np.log2(max(float(along.max()), 1.0) / _RANGE_BIN_M)))
    power = np.zeros(size // 2 + 1)
    most = 0.0
    for part in parts:
        counts = np.bincount(np.floor(part / _RANGE_BIN_M).astype(np.int64).clip(0), minlength=size)
        power += np.abs(np.fft.rfft(counts[:size])) ** 2 - len(part)
        most += len(part) * (len(part) - 1.0)
    frequency = np.arange(len(power)) / (size * _RANGE_BIN_M)
    power[frequency < 20.0] = 0.0  # steps of more than 5 cm are no quantum of ranges
    share = power / max(most, 1.0)
    if share.max() < 0.02:
        return None, np.zeros(beams), float(np.sqrt(max(share.max(), 0.0)))
    peak = int(np.flatnonzero(share > 0.6 * share.max())[0])
    near = slice(max(peak - 3, 0), peak + 4)
    rate = float((frequency[near] * share[near].clip(0)).sum() / share[near].clip(0).sum())
    quantum = float(np.round(1.0 / rate, 5))
    phase = np.zeros(beams)
    for beam, part in enumerate(parts):
        phase[beam] = np.angle(np.exp(2j * np.pi * part / quantum).mean()) / (2.0 * np.pi) * quantum if len(part) else 0
    return quantum, phase, float(np.sqrt(share[peak]))


def silent_rays(fired: I64, returned: I64) -> tuple[Bool, int]:
    """Rays (B, T) that never returned in all scans, and the first beam of the block that has some.

    A run of at least 8 ticks that were fired often and never returned, nor did the 3 ticks on either side of each: a
    lower bound, since a ray wrongly held for blind takes returns from simulated cars. Sky never returns either: only
    beams that otherwise return nearly everywhere count, from the bottom up without a gap.
    """
    beams = len(returned)
    reach = np.arange(-_SHADOW_REACH, _SHADOW_REACH + 1)
    shots = sum(np.roll(fired, int(i)) for i in reach)
    echoes = sum(np.roll(returned, int(i), axis=1) for i in reach)
    silent = (np.asarray(echoes) == 0) & (np.asarray(shots) >= _SHADOW_SHOTS)
    core = np.zeros_like(silent)
    for beam in range(beams):
        for first, last in runs_of(silent[beam]):
            if last - first + 1 >= _SHADOW_TICKS:
                core[beam, first : last + 1] = True
    rate = np.where(core, 0, returned).sum(axis=1) / np.maximum(np.where(core, 0, fired).sum(axis=1), 1)
    first = beams
    while first > 0 and rate[first - 1] >= _SHADOW_ELSEWHERE and core[first - 1].any():
        first -= 1
    core[:first] = False
    return core, first


def runs_of(row: Bool) -> list[tuple[int, int]]:
    """First and last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(np.int8)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


# ---------------------------------------------------------------------------------------------------------------------
# The profile


def cannot_tell(table: BeamTable, evidence: Evidence) -> tuple[str, ...]:
    """What these scans do not tell, a sentence each."""
    said = ["Range biases of the beams are zero until `augkitti fit-noise`; a bias common to all is never seen."]
    if not _enough_for_shadow(evidence):
        few = "one drive" if len(evidence.scans) < 2 else f"{sum(evidence.scans.values())} scans"
        said.append(
            f"Rays that never return are not given: from {few} the ego car's shadow cannot be told from a scene that "
            f"hardly changes; two drives and {MIN_SHADOW_SCANS} scans are needed."
        )
    if sum(evidence.scans.values()) < _MANY_SCANS:
        said.append(
            "Beams are known roughly only: three scans of one drive leave up to 0.006 degrees and 0.4 mm; "
            f"{_MANY_SCANS} scans of different places are better."
        )
    if not evidence.seam.measured:
        why = "no two consecutive scans" if evidence.seam.pairs == 0 else "no tick stands out where a scan ends"
        said.append(f"Spin and seam are assumed (clockwise, straight behind): {why}; give drives that move.")
    elif evidence.seam.spin != "clockwise":
        said.append("The scanner turns counter-clockwise; simulation knows clockwise ones only: times would run wrong.")
    if not evidence.timed:
        said.append("The firing period rests on an assumed turn of 103.5 ms: no timestamps of start and end.")
    if evidence.range_quantum_m is None:
        said.append("Ranges show no steps; the coordinates' own rounding stands for them.")
    if len(evidence.scans) < 2:
        said.append("No figure here is of a drive that was held out.")
    weak = np.flatnonzero((table.tick_match < 0.97) | (table.tick_margin < _TICK_MARGIN))
    if len(weak):
        said.append(
            f"Tick offsets of beams {weak.tolist()} are doubtful: few points on common ticks, or gaps between firings "
            "that repeat too evenly to tell one offset from another."
        )
    said += [f"Left out: {drive}, frame {frame}: {reason}." for drive, frame, reason in evidence.left_out]
    return tuple(said)


def profile_content(table: BeamTable, evidence: Evidence, name: str) -> dict[str, Any]:
    """The profile as its file has it (`augkitti.scanner.load_profile`), without a `noise` part.

    Args:
        table: from `fit_beams`.
        evidence: from `gather`.
        name: of the profile.
    """
    if _enough_for_shadow(evidence):
        silent, first = silent_rays(evidence.fired, evidence.returned)
    else:
        silent, first = np.zeros(evidence.returned.shape, dtype=bool), table.beams
    quantum = evidence.range_quantum_m or evidence.coordinate_quantum_m
    drives = ", ".join(f"{drive} ({scans})" for drive, scans in sorted(evidence.scans.items()))
    median, p99, p999 = (1e3 * float(q) for q in np.quantile(evidence.distance_m, [0.5, 0.99, 0.999]))
    return _content_of(table) | {
        "name": name,
        "source": f"augkitti fit-sensor on {sum(evidence.scans.values())} raw scans: {drives}",
        "seam_tick": evidence.seam.tick,
        "spin": evidence.seam.spin if evidence.seam.measured else f"{evidence.seam.spin} (assumed)",
        "firing_period_s": round(evidence.firing_period_s, 9),
        "range_quantum_m": quantum,
        "coordinate_quantum_m": evidence.coordinate_quantum_m,
        "reflectance_quantum": evidence.reflectance_quantum,
        "min_range_m": float(np.floor(evidence.min_range_m * 1e3) / 1e3),
        "max_range_m": float(np.round(evidence.max_range_m, 1)),
        "shadow_first_ring": first,
        "range_phase_mm": [round(1e3 * float(phase), 2) for phase in evidence.range_phase_m],
        "never_returned_ticks": [[list(run) for run in runs_of(row)] for row in silent],
        "fit": {
            "scans": dict(sorted(evidence.scans.items())),
            "point_to_ray_mm": {"median": round(median, 4), "p99": round(p99, 4), "p999": round(p999, 4)},
            "points_on_fired_rays": round(1.0 - evidence.strays / max(evidence.points, 1), 7),
            "fired_ticks": list(evidence.firings),
            "gaps": {str(gap): round(share, 4) for gap, share in evidence.gaps.items()},
            "lattice_power": round(table.lattice_power, 4),
            "range_lock": round(evidence.range_lock, 4),
            "seam_measured_at": evidence.seam.raw_tick,
            "consecutive_scans": evidence.seam.pairs,
            "return_rate": [
                round(float(r), 3) for r in evidence.returned.sum(axis=1) / max(int(evidence.fired.sum()), 1)
            ],
            "cannot_tell": list(cannot_tell(table, evidence)),
        },
    }


def fitted_profile(content: dict[str, Any]) -> ScannerProfile:
    """The profile of such content, checked as a file's is."""
    return profile_from_content(content, "fitted profile")


def table_profile(table: BeamTable) -> ScannerProfile:
    """A profile with the beam table alone, enough for `augkitti.scanner.assign_rays`."""
    return profile_from_content(_content_of(table), "fitted beam table")


def _enough_for_shadow(evidence: Evidence) -> bool:
    return len(evidence.scans) >= 2 and sum(evidence.scans.values()) >= MIN_SHADOW_SCANS


def _content_of(table: BeamTable) -> dict[str, Any]:
    """Content of a profile with a beam table and placeholders for all else."""
    return {
        "name": "fitted",
        "version": 1,
        "source": "augkitti fit-sensor",
        "sensor": f"{table.beams} beams, uncompensated scans",
        "lattice_size": table.lattice_size,
        "seam_tick": table.lattice_size // 2,
        "firing_period_s": 1e-4,
        "range_quantum_m": 0.001,
        "coordinate_quantum_m": 0.001,
        "reflectance_quantum": 0.01,
        "min_range_m": 1.0,
        "max_range_m": 100.0,
        "shadow_first_ring": table.beams,
        "elevation_rad": [round(float(v), 7) for v in table.elevation_rad],
        "height_m": [round(float(v), 5) for v in table.height_m],
        "side_m": [round(float(v), 5) for v in table.side_m],
        "azimuth_rad": [round(float(v), 7) for v in table.azimuth_rad],
        "tick_offset": [int(v) for v in table.tick_offset],
        "range_phase_mm": [0.0] * table.beams,
        "range_bias_mm": [0] * table.beams,
        "never_returned_ticks": [[] for _ in range(table.beams)],
    }
