"""One view of one car with its rays in, numbers that say how it looks to the scanner out.

A view is every ray that can meet the car's box and that nothing else stopped before it, whether it returned or not:
misses tell real cars from simulated ones more surely than points do. Zones, crop and ground trim are those of
`labelled_views` (scanner.md section 3), the same for real and simulated views.
"""

import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from augkitti.frames import F64, Array, box_pose, invert, rotate_vectors, transform_points
from augkitti.labelled_views import CROP_M, INSIDE, SURFACE, TRIM_M, BoxRays, judge_rays
from augkitti.raycast import cross_box
from augkitti.scan_pair import I32, U8, Bool, ScanRays
from augkitti.scanner import ScannerProfile, lines_of_rays

CROSSING_M = 0.25  # a ray counts for a zone that it crosses for longer
FIRING_RAD = 2.0 * np.pi / 2150.0  # scanner.md: 2146 to 2164 firings a revolution
HEIGHT_EDGES = (0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95)  # shares of the height, above the underside
BEV_CELLS = (24, 12)  # along length and width, over the box grown by a tenth
REFLECTANCE_BINS = 100

# (from, to) along length, width (about the middle) and height (above the underside), in shares of the box
Zone = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_OF_BODY = ((-0.45, 0.45), (-0.44, 0.44))
_OF_CABIN = ((-0.30, 0.20), (-0.40, 0.40))
_CABIN_FROM = 0.55  # above it a car is only as long as its cabin

FEATURES = {  # name: what it says, in words for the report
    "points_log": "how many points the car has",
    "rings": "share of the rings over the car that have points",
    "return_low": "returns at sill height",
    "return_body": "returns on the body",
    "return_cabin": "returns at window height",
    "return_roof": "returns at roof height",
    "window_surface": "share of window rays stopped by the pane",
    "window_inside": "share of window rays stopped inside the cabin",
    "clump_next": "misses on the body follow misses (next firing)",
    "clump_four": "misses on the body follow misses (four firings on)",
    "clump_beam": "misses on the body follow misses (next beam)",
    "clump_window": "misses at window height follow misses (next firing)",
    "hole_mean": "mean length of the body's holes",
    "hole_longest": "longest hole of the body",
    "hole_number": "number of holes a body ray",
    "residual_along": "roughness along the ring",
    "residual_tail": "share of points over 4 cm off their neighbours on the ring",
    "residual_across": "roughness from ring to ring",
    "zero_body": "share of body returns with reflectance 0",
    "zero_window": "share of returns at window height with reflectance 0",
    "reflectance_middle": "median reflectance, zeros left out",
    "reflectance_spread": "spread of reflectance, zeros left out",
    "reflectance_high": "share of returns with reflectance over 0.9",
    "reflectance_smooth": "reflectance is like that of the firing before",
    "reflectance_white": "step of reflectance to the next firing",
    "depth_spread": "spread of depth behind the box's face, body",
    "depth_inside": "median depth of returns inside the cabin",
    "span_along": "length that the points span, in shares of the box",
    "span_across": "width that the points span, in shares of the box",
    "span_up": "height that the points span, in shares of the box",
    "step_azimuth": "irregularity of the azimuth steps",
    "ring_gap": "angle between the rings",
}


@dataclass(frozen=True, eq=False)
class CarRays:
    """One view of one car; K rays sorted by (ring, azimuth from the car's middle), none of them stopped before the box.

    Build it with `car_rays`, which leaves out covered rays and sorts.
    """

    box: F64  # (7,) x, y, z, length, width, height, yaw
    ring: U8  # (K,)
    turn_rad: F64  # (K,) azimuth from the box's middle, counter-clockwise
    elevation_rad: F64  # (K,)
    origin: F64  # (K, 3) in the box's frame
    direction: F64  # (K, 3) in the box's frame
    range_m: F64  # (K,) inf where nothing returned
    reflectance: F64  # (K,) 0 where nothing returned
    judged: BoxRays  # windows, body and returns, as scanner.md counts them

    def __len__(self) -> int:
        return len(self.ring)

    @cached_property
    def entry_m(self) -> F64:
        """(K,) where (metres along each ray) rays enter the box."""
        half = self.box[3:6] / 2.0
        return cross_box(self.origin, self.direction, -half, half)[0]

    @cached_property
    def on_car(self) -> Bool:
        """(K,) whether the ray's return is of the car: in the grown box, above the trimmed ground."""
        half = self.box[3:6] / 2.0
        at = self.origin + np.where(np.isfinite(self.range_m), self.range_m, 0.0)[:, None] * self.direction
        inside = (np.abs(at) <= half + CROP_M).all(axis=1) & (at[:, 2] > TRIM_M - half[2])
        return np.asarray(inside & np.isfinite(self.range_m))

    @cached_property
    def points(self) -> F64:
        """(P, 3) the car's points in the box's frame."""
        which = self.on_car
        return np.asarray(self.origin[which] + self.range_m[which, None] * self.direction[which])

    def crosses(self, zone: Zone) -> Bool:
        """(K,) whether each ray crosses a zone for more than 0.25 m."""
        low = np.array([zone[0][0], zone[1][0], zone[2][0] - 0.5]) * self.box[3:6]
        high = np.array([zone[0][1], zone[1][1], zone[2][1] - 0.5]) * self.box[3:6]
        enter, leave = cross_box(self.origin, self.direction, low, high)
        return np.asarray((leave - enter > CROSSING_M) & (enter > 0.0))


def car_rays(
    rays: ScanRays, ray: I32, measured_m: F64, reflectance: Array, box: F64, profile: ScannerProfile
) -> CarRays:
    """A view from rays (K,) of a scan that cross a box (7,), their ranges (inf: nothing) and reflectance (K,).

    Rays that something else stopped more than 0.25 m before the box are left out. Coordinates are rounded to the
    scanner's steps, as a scan file has them.
    """
    judged = judge_rays(rays, ray, measured_m, box, profile)
    turn = (rays.ray_azimuth_rad[ray] - np.arctan2(box[1], box[0]) + np.pi) % (2.0 * np.pi) - np.pi
    order = np.lexsort((turn, rays.ray_ring[ray]))
    order = order[~judged.is_covered[order]]
    origin, direction = lines_of_rays(profile, rays, ray[order])
    measured = np.asarray(measured_m, dtype=np.float64)[order]
    at = origin + np.where(np.isfinite(measured), measured, 0.0)[:, None] * direction
    at = np.rint(at / profile.coordinate_quantum_m) * profile.coordinate_quantum_m
    rounded = ((at - origin) * direction).sum(axis=1)
    T_box_velo = invert(box_pose(box))
    return CarRays(
        box=np.asarray(box, dtype=np.float64),
        ring=rays.ray_ring[ray[order]],
        turn_rad=turn[order],
        elevation_rad=rays.ray_elevation_rad[ray[order]],
        origin=transform_points(T_box_velo, origin),
        direction=rotate_vectors(T_box_velo, direction),
        range_m=np.where(np.isfinite(measured), rounded, np.inf),
        reflectance=np.where(np.isfinite(measured), np.asarray(reflectance, dtype=np.float64)[order], 0.0),
        judged=BoxRays(**{name: values[order] for name, values in vars(judged).items()}),
    )


Pairs = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]


def firing_pairs(view: CarRays, among: Bool, steps: int) -> Pairs:
    """Indices (first, second) of rays of one ring, both `among`, that lie `steps` firings apart."""
    rows = np.arange(len(view) - steps) if len(view) > steps else np.zeros(0, np.intp)
    ahead = rows + steps
    step = view.turn_rad[ahead] - view.turn_rad[rows]
    near = (view.ring[ahead] == view.ring[rows]) & (np.abs(step / FIRING_RAD - steps) < 0.6)
    near &= among[rows] & among[ahead]
    return rows[near], ahead[near]


def beam_pairs(view: CarRays, among: Bool) -> Pairs:
    """Indices (upper, lower) of rays of neighbouring rings, both `among`, at the same azimuth within half a firing."""
    rows = np.flatnonzero(among)
    key = view.ring.astype(np.float64) * 8.0 + view.turn_rad  # turns lie within +-pi: rings do not mix
    wanted = key[rows] + 8.0
    after = np.clip(np.searchsorted(key, wanted), 1, max(len(key) - 1, 1))
    nearest = np.where(
        wanted - key[after - 1] <= np.abs(key[np.minimum(after, len(key) - 1)] - wanted), after - 1, after
    )
    nearest = np.minimum(nearest, len(key) - 1)
    near = (np.abs(key[nearest] - wanted) < 0.5 * FIRING_RAD) & among[nearest]
    return rows[near], nearest[near]


def correlation(values: Array, pairs: Pairs) -> float:
    """Correlation of a value with that of its partner; NaN where it does not vary or there are under ten pairs."""
    first, second = (np.asarray(values[index], dtype=np.float64) for index in pairs)
    if len(first) < 10:
        return float("nan")
    a, b = first - first.mean(), second - second.mean()
    scale = float(np.sqrt((a * a).sum() * (b * b).sum()))
    return float((a * b).sum() / scale) if scale > 1e-12 else float("nan")


def returns_by_height(view: CarRays) -> F64:
    """Share of expected rays that returned from the car, in each band of `HEIGHT_EDGES`; NaN where none crosses it."""
    return np.array([_mean(view.on_car[view.crosses(zone)]) for zone in _bands()])


def holes(view: CarRays) -> F64:
    """Lengths (H,), in firings, of the runs of misses on the body, along the rings."""
    body = np.flatnonzero(view.judged.is_body)
    if len(body) == 0:
        return np.zeros(0)
    missed = ~view.judged.returns[body]
    starts_ring = np.concatenate([[True], np.diff(view.ring[body].astype(np.int64)) != 0])
    starts_run = starts_ring | np.concatenate([[True], np.diff(missed.astype(np.int8)) != 0])
    length = np.bincount(np.cumsum(starts_run) - 1)
    return np.asarray(length[missed[starts_run]], dtype=np.float64)


def ring_counts(view: CarRays) -> F64:
    """(256, 2) by ring: rays through the body or the cabin, and those of them that returned from the car."""
    over = view.judged.is_body | view.judged.is_window
    return np.stack(
        [np.bincount(view.ring[chosen], minlength=256) for chosen in (over, over & view.on_car)], axis=1
    ).astype(np.float64)


def reflectance_counts(view: CarRays) -> F64:
    """(2, 100) of the car's returns by hundredths of reflectance: on the body, at window height."""
    step = np.clip(np.rint(view.reflectance * REFLECTANCE_BINS), 0, REFLECTANCE_BINS - 1).astype(np.int64)
    zones = (view.judged.is_body, view.judged.is_window)
    return np.stack([np.bincount(step[view.on_car & zone], minlength=REFLECTANCE_BINS) for zone in zones]).astype(
        np.float64
    )


def residuals_along(view: CarRays) -> F64:
    """Distance (metres, signed) of body and cabin points from the line of their two neighbours on the ring."""
    rows = np.arange(1, len(view) - 1)
    ok = _neighbours(view, rows, -1) & _neighbours(view, rows, 1)
    middle = rows[ok]
    return np.asarray(view.range_m[middle] - 0.5 * (view.range_m[middle - 1] + view.range_m[middle + 1]))


def residuals_across(view: CarRays) -> F64:
    """Distance (metres, signed) of points from the line of those on the rings above and below."""
    upper, lower = beam_pairs(view, view.on_car)
    below = np.full(len(view), -1)
    below[upper] = lower
    above = np.full(len(view), -1)
    above[lower] = upper
    middle = np.flatnonzero((below >= 0) & (above >= 0))
    a, b, c = above[middle], middle, below[middle]
    ea, eb, ec = view.elevation_rad[a], view.elevation_rad[b], view.elevation_rad[c]
    share = (eb - ea) / (ec - ea)
    return np.asarray(view.range_m[b] - (1.0 - share) * view.range_m[a] - share * view.range_m[c])


def bev_occupancy(view: CarRays) -> F64:
    """Share (24, 12) of the car's points in each cell from above, over the box grown by a tenth; sums to 1, or 0."""
    at = view.points[:, :2] / (1.1 * view.box[3:5]) + 0.5
    counts, _, _ = np.histogram2d(at[:, 0], at[:, 1], bins=BEV_CELLS, range=((0.0, 1.0), (0.0, 1.0)))
    return np.asarray(counts / max(counts.sum(), 1.0))


def car_features(view: CarRays) -> F64:
    """One number for each of `FEATURES`; NaN where the view does not tell."""
    judged, on_car, returned = view.judged, view.on_car, view.judged.returns
    body, cabin = judged.is_body, judged.is_window
    low, roof = view.crosses((*_OF_BODY, (0.12, 0.25))), view.crosses((*_OF_CABIN, (0.90, 1.0)))
    miss = holes(view)
    along, across = residuals_along(view), residuals_across(view)
    shine = view.reflectance
    seen = shine[on_car & (shine > 0.0)]
    next_on_car = firing_pairs(view, on_car, 1)
    depth = (view.range_m - view.entry_m)[on_car & body]
    inside = cabin & (judged.window_class == INSIDE)
    points = view.points / view.box[3:6]
    over = body | cabin
    rings_over, rings_with = len(np.unique(view.ring[over])), len(np.unique(view.ring[on_car & over]))
    first, second = firing_pairs(view, np.ones(len(view), dtype=bool), 1)
    steps = (view.turn_rad[second] - view.turn_rad[first]) / FIRING_RAD
    values = {
        "points_log": float(np.log1p(on_car.sum())),
        "rings": rings_with / rings_over if rings_over else np.nan,
        "return_low": _mean(on_car[low]),
        "return_body": _mean(returned[body]),
        "return_cabin": _mean(on_car[cabin]),
        "return_roof": _mean(on_car[roof]),
        "window_surface": _mean(judged.window_class[cabin] == SURFACE),
        "window_inside": _mean(judged.window_class[cabin] == INSIDE),
        "clump_next": correlation(returned, firing_pairs(view, body, 1)),
        "clump_four": correlation(returned, firing_pairs(view, body, 4)),
        "clump_beam": correlation(returned, beam_pairs(view, body)),
        "clump_window": correlation(on_car, firing_pairs(view, cabin, 1)),
        "hole_mean": _mean(miss),
        "hole_longest": float(miss.max(initial=0.0)) if body.any() else np.nan,
        "hole_number": len(miss) / body.sum() if body.any() else np.nan,
        "residual_along": _mad(along),
        "residual_tail": _mean(np.abs(along) > 0.04),
        "residual_across": _mad(across),
        "zero_body": _mean(shine[on_car & body] == 0.0),
        "zero_window": _mean(shine[on_car & cabin] == 0.0),
        "reflectance_middle": float(np.median(seen)) if len(seen) >= 5 else np.nan,
        "reflectance_spread": float(np.std(seen)) if len(seen) >= 5 else np.nan,
        "reflectance_high": _mean(shine[on_car] > 0.9),
        "reflectance_smooth": correlation(shine, next_on_car),
        "reflectance_white": _mean(np.abs(shine[next_on_car[1]] - shine[next_on_car[0]])),
        "depth_spread": float(np.ptp(np.quantile(depth, (0.1, 0.9)))) if len(depth) >= 10 else np.nan,
        "depth_inside": float(np.median(judged.depth_m[inside])) if inside.sum() >= 3 else np.nan,
        "span_along": _span(points[:, 0]),
        "span_across": _span(points[:, 1]),
        "span_up": _span(points[:, 2]),
        "step_azimuth": float(np.std(steps)) if len(steps) >= 10 else np.nan,
        "ring_gap": _ring_gap(view),
    }
    assert values.keys() == FEATURES.keys()
    return np.array([float(values[name]) for name in FEATURES])


def density_aware_chamfer(a: F64, b: F64, unit_m: float, sharpness: float = 200.0) -> float:
    """Density-aware Chamfer distance of two point sets (A, 3), (B, 3) metres: 0 equal, 1 nothing alike.

    Wu et al., NeurIPS 2021: each point's nearest neighbour counts exp(-sharpness d^2) over the number of points that
    share it; `unit_m` is the length taken for 1 (half a car).
    """
    from scipy.spatial import cKDTree

    if not len(a) or not len(b):
        return 1.0
    sides = []
    for here, there in ((a, b), (b, a)):
        distance, which = cKDTree(there).query(here)
        crowd = np.bincount(which, minlength=len(there))[which]
        share = len(there) / len(here)  # equal sets of unequal density are far apart only by the density
        sides.append(
            float((1.0 - np.exp(-sharpness * (distance / unit_m) ** 2) * np.minimum(share / crowd, 1.0)).mean())
        )
    return 0.5 * (sides[0] + sides[1])


def jensen_shannon(p: Array, q: Array) -> float:
    """Jensen-Shannon divergence, in bits (0 to 1), of two histograms; each is scaled to sum to 1."""
    a, b = (np.asarray(h, dtype=np.float64).ravel() for h in (p, q))
    a, b = a / max(a.sum(), 1e-300), b / max(b.sum(), 1e-300)
    middle = 0.5 * (a + b)
    return float(0.5 * (_kl_bits(a, middle) + _kl_bits(b, middle)))


def _kl_bits(p: F64, q: F64) -> float:
    there = p > 0.0
    return float((p[there] * np.log2(p[there] / q[there])).sum())


def _bands() -> list[Zone]:
    bands: list[Zone] = []
    for low, high in itertools.pairwise(HEIGHT_EDGES):
        along, across = _OF_CABIN if low >= _CABIN_FROM else _OF_BODY
        bands.append((along, across, (low, high)))
    return bands


def _neighbours(view: CarRays, rows: npt.NDArray[np.intp], side: int) -> Bool:
    """Whether a point's neighbour on its ring is a point of the car too, one or two firings off, no step between."""
    there = rows + side
    turn = np.abs(view.turn_rad[there] - view.turn_rad[rows])
    step = np.abs(np.where(np.isfinite(view.range_m), view.range_m, 0.0)[there] - view.range_m[rows])
    near = (view.ring[there] == view.ring[rows]) & (turn < 1.6 * FIRING_RAD) & (step < 0.3)
    return np.asarray(near & view.on_car[there] & view.on_car[rows])


def _ring_gap(view: CarRays) -> float:
    """Median angle, in degrees, between neighbouring rings, relative to where on the scanner they are."""
    rings, first = np.unique(view.ring, return_index=True)
    if len(rings) < 3:
        return float("nan")
    step = np.diff(view.elevation_rad[first]) / np.diff(rings.astype(np.float64))
    return float(np.rad2deg(np.std(step)))


def _mean(values: Array) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def _mad(values: F64) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values)))) if len(values) >= 5 else float("nan")


def _span(values: F64) -> float:
    return float(np.ptp(np.quantile(values, (0.02, 0.98)))) if len(values) >= 5 else float("nan")
