"""Scanner profile and rays: a scan's points in, the ring and tick of each point and every fired ray out.

Conventions (scanner.md section 1, measured on real KITTI scans): the encoder has L ticks a revolution (KITTI: 4000); at
one firing all beams (64) share a tick t; beam b then looks along `alpha = 2 pi / L (t + tick_offset_b) + azimuth_b`,
from `(-side_b sin alpha, side_b cos alpha, height_b)`. The scanner turns clockwise: time runs with decreasing tick,
from the tick before the seam (1999) over 0 (straight ahead, the scan's middle) to the seam (2000).
"""

import hashlib
import json
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64, wrap_angle
from augkitti.scan_pair import I32, NO_TICK, U8, U16, Bool, Scan, ScanRays
from augkitti.yaml_text import read_yaml

DEFAULT_PROFILE = "hdl64e_kitti"
SHIPPED = {DEFAULT_PROFILE: "hdl64e_kitti.json", "hdl32e": "hdl32e.yaml"}  # name: file in `profiles`
PROFILE_FILE = "profile.json"  # in the folder of a fitted profile
_ON_RAY_M = 0.002  # scanner.md: p99.9 of the distance of a point to its ray is 0.78 mm; 2 mm settles the wrap trap
_MIN_POINTS_OF_A_TICK = 4  # a fired tick has about 50 returns; fewer are stray points
_DEFAULT_PERIOD_S = 0.1034  # a revolution of KITTI's scanner (scanner.md: 103.2 to 103.6 ms); profiles may say another
_PER_BEAM = ("height_m", "side_m", "azimuth_rad", "tick_offset", "range_phase_mm", "range_bias_mm")
_NUMBERS = {  # key: the largest that it may be; above 0
    "firing_period_s": 1.0,
    "range_quantum_m": 1.0,
    "coordinate_quantum_m": 1.0,
    "reflectance_quantum": 1.0,
    "min_range_m": 1e4,
    "max_range_m": 1e4,
}
_NEEDED = {
    *("name", "version", "source", "lattice_size", "seam_tick", "shadow_first_ring", "elevation_rad"),
    *("never_returned_ticks", *_NUMBERS, *_PER_BEAM),
}
_OPTIONAL = {"period_s", "noise", "sensor", "spin", "fit"}  # the last three are notes, read by people
_SEE = f"the comments in {Path(__file__).parent / 'profiles' / 'hdl32e.yaml'} explain each key"


@dataclass(frozen=True, eq=False)
class ScannerProfile:
    """What is known of one scanner: its beam table, encoder, quanta and shadow. All arrays are per beam, top first."""

    name: str
    version: int
    source: str
    lattice_size: int
    seam_tick: int
    firing_period_s: float
    period_s: float  # of a revolution, where a scan is made and not read
    range_quantum_m: float
    coordinate_quantum_m: float
    reflectance_quantum: float
    min_range_m: float
    max_range_m: float
    shadow_first_ring: int
    elevation_rad: F64
    height_m: F64
    side_m: F64
    azimuth_rad: F64
    tick_offset: I32
    range_phase_m: F64
    range_bias_m: F64
    blind: Bool = field(repr=False)  # (beams, lattice_size) the ego car's shadow
    content: dict[str, Any] = field(repr=False)  # the file as read: what a shard carries along

    @property
    def beams(self) -> int:
        """Number of beams."""
        return len(self.elevation_rad)

    @property
    def tick_step_rad(self) -> float:
        """Azimuth between two encoder ticks."""
        return 2.0 * np.pi / self.lattice_size

    @property
    def firings(self) -> int:
        """Firings a revolution, to fifties: which of the lattice's ticks are fired differs from scan to scan."""
        return max(50, 50 * round(self.period_s / self.firing_period_s / 50.0))

    @property
    def ring_step_rad(self) -> float:
        """Mean angle between neighbouring beams, to half a milliradian: 0.0075 of KITTI's scanner."""
        steps = float(self.elevation_rad[0] - self.elevation_rad[-1]) / max(1, self.beams - 1)
        return max(1, round(steps / 5e-4)) * 5e-4

    @property
    def reflectance_steps(self) -> int:
        """The largest reflectance that simulated returns have, 0.99, in the scanner's steps."""
        return max(1, round(0.99 / self.reflectance_quantum))

    @cached_property
    def lattice_azimuth_rad(self) -> F64:
        """Direction (beams, lattice_size) in which each beam looks at each tick, radians in [-pi, pi)."""
        ring, tick = np.indices((self.beams, self.lattice_size))
        return tick_azimuth(self, ring.astype(np.uint8), tick.astype(np.uint16))

    @cached_property
    def lattice_cos_sin(self) -> tuple[F64, F64]:
        """Cosine and sine (beams, lattice_size) of `lattice_azimuth_rad`."""
        cosine, sine = sm.sincos(self.lattice_azimuth_rad)[::-1]
        return cosine, sine

    @cached_property
    def elevation_cos_sin(self) -> tuple[F64, F64]:
        """Cosine and sine (beams,) of the beams' elevations."""
        cosine, sine = sm.sincos(self.elevation_rad)[::-1]
        return cosine, sine

    @cached_property
    def digest(self) -> str:
        """sha256 of the profile's content."""
        return hashlib.sha256(json.dumps(self.content, sort_keys=True).encode()).hexdigest()


def load_profile(path: Path | str | None = None) -> ScannerProfile:
    """The shipped profile of KITTI's HDL-64E, a shipped one by name (`hdl32e`), or a file's: JSON, YAML or a folder.

    A YAML file (`.yaml`, `.yml`) may say one number for all beams where JSON has a list. A profile's folder holds it as
    `profile.json`. A shipped name comes before a file of that name: write `./hdl32e` for the file.

    Raises:
        InputError: the file is missing or unreadable, or a key is missing, unknown, out of range or of the wrong size.
    """
    if path is None or is_shipped(path):
        name = DEFAULT_PROFILE if path is None else str(path)
        with resources.as_file(resources.files("augkitti") / "profiles" / SHIPPED[name]) as file:
            return profile_from_content(_content_of_file(file), name)
    file = Path(path) / PROFILE_FILE if Path(path).is_dir() else Path(path)
    return profile_from_content(_content_of_file(file), str(path))


def is_shipped(path: Path | str) -> bool:
    """Whether this is the name of a profile that comes with the program, and no path."""
    return str(path) in SHIPPED


def _content_of_file(file: Path) -> Any:
    """The content of a profile's file, with lists where a YAML file has one number for all beams.

    Raises:
        InputError: it is unreadable, or has a key that no profile has.
    """
    remedy = f"give a profile (JSON, YAML), a folder with {PROFILE_FILE} in it, or a name: {', '.join(sorted(SHIPPED))}"
    if file.suffix in (".yaml", ".yml"):
        content = read_yaml(file, remedy)
    else:
        try:
            content = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as err:
            raise InputError(file, f"not readable as a scanner profile ({err})", remedy) from err
    if not isinstance(content, dict):
        raise InputError(file, "not a scanner profile: no keys and values", remedy)
    for key in content:
        if key not in _NEEDED | _OPTIONAL:
            near = get_close_matches(str(key), sorted(_NEEDED | _OPTIONAL), n=1)
            meant = f"did you mean `{near[0]}`? " if near else ""
            raise InputError(file, f"key `{key}` is unknown", f"{meant}{_SEE}")
    beams = len(content["elevation_rad"]) if isinstance(content.get("elevation_rad"), list) else 0
    for key in _PER_BEAM:
        if isinstance(content.get(key), int | float) and not isinstance(content[key], bool):
            content[key] = [content[key]] * beams
    if content.get("never_returned_ticks") == []:
        content["never_returned_ticks"] = [[] for _ in range(beams)]
    return content


def profile_from_content(content: Any, where: str) -> ScannerProfile:
    """A profile from the parsed content of its file, or of a shard's metadata; `where` names it in errors.

    Raises:
        InputError: a key is missing, out of range or of the wrong size; names the key.
    """
    if not isinstance(content, dict):
        raise InputError(where, "not a scanner profile", f"give a profile; {_SEE}")
    missing = sorted(_NEEDED - set(content))
    if missing:
        raise InputError(where, f"key `{missing[0]}` is missing from the scanner profile", _SEE)
    key = ""
    try:
        key = "elevation_rad"
        elevation = np.asarray(content[key], dtype=np.float64)
        if not (elevation.ndim == 1 and 1 <= len(elevation) <= 255 and (np.abs(elevation) <= np.pi / 2.0).all()):
            raise ValueError("needs 1 to 255 numbers from -pi/2 to pi/2, one a beam")
        if not (np.diff(elevation) < 0).all():
            raise ValueError("must fall from beam to beam: the highest first")
        beams = len(elevation)

        def whole(first: int, last: int) -> int:
            value = int(content[key])
            if not first <= value <= last or value != content[key]:
                raise ValueError(f"must be a whole number from {first} to {last}")
            return value

        def above_0(value: Any, largest: float) -> float:
            number = float(value)
            if not 0.0 < number <= largest:  # NaN is no number here
                raise ValueError(f"must be a number above 0 and up to {largest:g}")
            return number

        def column(largest: float, scale: float = 1.0) -> F64:
            values = np.asarray(content[key], dtype=np.float64)
            if values.shape != (beams,) or not (np.abs(values) <= largest).all():
                raise ValueError(f"needs {beams} numbers from {-largest:g} to {largest:g}, one a beam")
            return values * scale

        key = "version"
        version = whole(0, 1_000_000)
        key = "lattice_size"
        lattice = whole(beams + 1, NO_TICK - 1)
        key = "seam_tick"
        seam = whole(0, lattice - 1)
        key = "shadow_first_ring"
        shadow_first = whole(0, beams)
        numbers: dict[str, float] = {}
        for key, largest in _NUMBERS.items():
            numbers[key] = above_0(content[key], largest)
        key = "period_s"
        period = above_0(content.get(key, _DEFAULT_PERIOD_S), 1.0)
        key = "max_range_m"
        if numbers[key] <= numbers["min_range_m"]:
            raise ValueError("must be above `min_range_m`")
        key = "lattice_size"
        apart = 2.0 * np.pi / lattice * numbers["min_range_m"]
        if apart < numbers["coordinate_quantum_m"]:
            raise ValueError(
                f"ticks lie {1e3 * apart:.2g} mm apart at `min_range_m`, closer than `coordinate_quantum_m`: a point "
                "would not tell its tick; take fewer ticks"
            )
        columns: dict[str, F64] = {}
        limits = (100.0, 100.0, 2.0 * np.pi, float(lattice), 1e4, 1e4)
        for key, largest in zip(_PER_BEAM, limits, strict=True):
            columns[key] = column(largest, 1e-3 if key.endswith("_mm") else 1.0)
        key = "never_returned_ticks"
        blind = _blind(content[key], beams, lattice)
        blind[:shadow_first] = False
    except (TypeError, ValueError, OverflowError, MemoryError) as err:
        raise InputError(where, f"key `{key}` of the scanner profile: {err}", _SEE) from err
    return ScannerProfile(
        name=str(content["name"]),
        version=version,
        source=str(content["source"]),
        lattice_size=lattice,
        seam_tick=seam,
        period_s=period,
        **numbers,
        shadow_first_ring=shadow_first,
        elevation_rad=elevation,
        height_m=columns["height_m"],
        side_m=columns["side_m"],
        azimuth_rad=columns["azimuth_rad"],
        tick_offset=columns["tick_offset"].astype(np.int32),
        range_phase_m=columns["range_phase_mm"],
        range_bias_m=columns["range_bias_mm"],
        blind=blind,
        content=content,
    )


def _blind(shadow: Any, beams: int, lattice: int) -> Bool:
    """(beams, lattice) from runs (first, last) of ticks, a list a beam.

    Raises:
        ValueError: another number of lists, or a run that leaves the lattice.
    """
    if not isinstance(shadow, list) or len(shadow) != beams:
        raise ValueError(f"needs {beams} lists, one a beam")
    blind = np.zeros((beams, lattice), dtype=bool)
    for ring, intervals in enumerate(shadow):
        for first, last in intervals:
            if not 0 <= first <= last < lattice:
                raise ValueError(f"beam {ring} leaves 0 to {lattice - 1}")
            blind[ring, first : last + 1] = True
    return blind


def ray_lines(profile: ScannerProfile, ring: U8, azimuth_rad: F64, elevation_rad: F64) -> tuple[F64, F64]:
    """Origins (R, 3) metres and unit directions (R, 3) of rays, velo frame at each ray's own firing."""
    sin_a, cos_a = sm.sincos(azimuth_rad)
    sin_e, cos_e = sm.sincos(elevation_rad)
    return _lines(profile, ring, cos_a, sin_a, cos_e, sin_e)


def lines_of_rays(profile: ScannerProfile, rays: ScanRays, ray: I32) -> tuple[F64, F64]:
    """Origins (K, 3) and unit directions (K, 3) of some rays of a scan: `ray_lines`, looked up on the lattice."""
    ring, tick = rays.ray_ring[ray], rays.ray_tick[ray]
    off = np.flatnonzero(tick == NO_TICK)
    if len(off) == len(ray):
        return ray_lines(profile, ring, rays.ray_azimuth_rad[ray], rays.ray_elevation_rad[ray])
    at = ring.astype(np.int64) * profile.lattice_size + tick
    if len(off):
        at[off] = 0
    cos_a, sin_a = (table.ravel()[at] for table in profile.lattice_cos_sin)
    cos_e, sin_e = (table[ring] for table in profile.elevation_cos_sin)
    if len(off):  # stray points have rays of their own
        sin_a[off], cos_a[off] = sm.sincos(rays.ray_azimuth_rad[ray[off]])
        sin_e[off], cos_e[off] = sm.sincos(rays.ray_elevation_rad[ray[off]])
    return _lines(profile, ring, cos_a, sin_a, cos_e, sin_e)


def _lines(profile: ScannerProfile, ring: U8, cos_a: F64, sin_a: F64, cos_e: F64, sin_e: F64) -> tuple[F64, F64]:
    side = profile.side_m[ring]
    origin, direction = np.empty((3, len(ring))), np.empty((3, len(ring)))
    origin[0], origin[1], origin[2] = -side * sin_a, side * cos_a, profile.height_m[ring]
    direction[0], direction[1], direction[2] = cos_e * cos_a, cos_e * sin_a, sin_e
    return origin.T, direction.T  # columns stay together: they are what is asked for next


def tick_azimuth(profile: ScannerProfile, ring: U8, tick: U16) -> F64:
    """Direction (radians in [-pi, pi)) in which beams look at ticks."""
    steps = tick.astype(np.float64) + profile.tick_offset[ring]
    return np.asarray(wrap_angle(steps * profile.tick_step_rad + profile.azimuth_rad[ring]), dtype=np.float64)


def tick_time(profile: ScannerProfile, tick: U16, period_s: float) -> F64:
    """Firing times (seconds from the scan's middle) of ticks in a revolution of `period_s`."""
    order = (profile.seam_tick - 1 - tick.astype(np.int64)) % profile.lattice_size
    return (order / profile.lattice_size - 0.5) * period_s


def azimuth_time(azimuth_rad: float, period_s: float) -> float:
    """When (seconds from the scan's middle) the scanner's own azimuth passes a bearing: it turns clockwise."""
    return float(-wrap_angle(azimuth_rad) / (2.0 * np.pi) * period_s)


def fire_rays(profile: ScannerProfile, fired_ticks: U16, period_s: float) -> ScanRays:
    """All rays of a revolution with the given fired ticks (F,) ascending, none returned yet: for scanning a scene."""
    fired = fired_ticks.astype(np.uint16)
    return ScanRays(
        ring=np.zeros(0, np.uint8),
        tick=np.zeros(0, np.uint16),
        ray=np.zeros(0, np.int32),
        ray_ring=np.repeat(np.arange(profile.beams, dtype=np.uint8), len(fired)),
        ray_tick=np.tile(fired, profile.beams),
        ray_azimuth_rad=profile.lattice_azimuth_rad.take(fired, axis=1).reshape(-1),
        ray_elevation_rad=np.repeat(profile.elevation_rad, len(fired)),
        ray_time_s=np.tile(tick_time(profile, fired, period_s), profile.beams),
        ray_point=np.full(profile.beams * len(fired), -1, np.int32),
        ray_blind=profile.blind.take(fired, axis=1).reshape(-1),
    )


def assign_rays(scan: Scan, profile: ScannerProfile) -> ScanRays:
    """The ring and tick of each point, and the whole bundle of fired rays.

    Raw scans: rings are the runs of rising azimuth in the file, named by their elevation (so a scan with rings missing
    works too); a point farther than 2 mm from its ray is tried on all other rings. Two points on one ray: the worse fit
    is stray. A stray point keeps a ray of its own, without a tick, so that it can still be hidden by a car.

    Compensated scans have no exact ticks. Approximation: a point's ray runs from the beam's origin through the point;
    where the azimuth step between neighbours of a ring shows missing returns (1.5 steps of a firing, 360 / 2150
    degrees, or more), rays are filled in evenly, their elevation interpolated relative to the beam table.
    """
    xyz = scan.xyz.astype(np.float64)
    if scan.kind == "compensated":
        return _compensated_rays(xyz, profile)
    ring = _rings_by_run(xyz, profile)
    tick, distance = _nearest_tick(xyz, ring, profile)
    off = np.flatnonzero(distance > _ON_RAY_M)
    if len(off):
        ring[off], tick[off], distance[off] = _best_ring(xyz[off], profile)
    on_ray = distance <= _ON_RAY_M
    counts = np.bincount(tick[on_ray], minlength=profile.lattice_size)
    fired = np.flatnonzero(counts >= min(_MIN_POINTS_OF_A_TICK, profile.beams))
    column = np.full(profile.lattice_size, -1, dtype=np.int64)
    column[fired] = np.arange(len(fired))
    on_ray &= column[tick] >= 0

    rays = fire_rays(profile, fired.astype(np.uint16), scan.period_s)
    ray_of_point = np.where(on_ray, ring.astype(np.int64) * len(fired) + column[tick], -1)
    candidates = np.flatnonzero(on_ray)
    best_last = candidates[np.argsort(-distance[candidates], kind="stable")]
    ray_point = np.full(len(rays), -1, dtype=np.int32)
    ray_point[ray_of_point[best_last]] = best_last  # of two points on a ray the closer to it is written last and stays
    lost = np.flatnonzero(on_ray)
    lost = lost[ray_point[ray_of_point[lost]] != lost]
    ray_of_point[lost] = -1
    stray = np.flatnonzero(ray_of_point < 0)
    ray_of_point[stray] = len(rays) + np.arange(len(stray))
    known_tick = tick.astype(np.uint16)
    known_tick[stray] = NO_TICK
    azimuth, elevation = _line_through(xyz[stray], ring[stray], profile)
    return ScanRays(
        ring=ring,
        tick=known_tick,
        ray=ray_of_point.astype(np.int32),
        ray_ring=np.concatenate([rays.ray_ring, ring[stray]]),
        ray_tick=np.concatenate([rays.ray_tick, known_tick[stray]]),
        ray_azimuth_rad=np.concatenate([rays.ray_azimuth_rad, azimuth]),
        ray_elevation_rad=np.concatenate([rays.ray_elevation_rad, elevation]),
        ray_time_s=np.concatenate([rays.ray_time_s, tick_time(profile, tick[stray].astype(np.uint16), scan.period_s)]),
        ray_point=np.concatenate([ray_point, stray.astype(np.int32)]),
        ray_blind=np.concatenate([rays.ray_blind, np.zeros(len(stray), dtype=bool)]),
    )


def ray_distance(scan: Scan, rays: ScanRays, profile: ScannerProfile) -> F64:
    """Distance (N,) metres of each point from its ray: the rounding of coordinates, if all is right."""
    origin, direction = lines_of_rays(profile, rays, rays.ray)
    offset = scan.xyz.astype(np.float64) - origin
    along = (offset * direction).sum(axis=1)
    return np.asarray(np.sqrt(((offset - along[:, None] * direction) ** 2).sum(axis=1)))


def _rings_by_run(xyz: F64, profile: ScannerProfile) -> U8:
    """Ring of each point by its run of rising azimuth; a run is named by the beam that it fits best."""
    azimuth = sm.arctan2(xyz[:, 1], xyz[:, 0]) % (2.0 * np.pi)
    starts = np.concatenate([[0], np.flatnonzero(np.diff(azimuth) < -np.pi) + 1, [len(xyz)]])
    tan_e, height = sm.tan(profile.elevation_rad), profile.height_m
    rho = sm.hypot(xyz[:, 0], xyz[:, 1])
    rings = np.zeros(len(starts) - 1, dtype=np.uint8)
    for run in range(len(rings)):
        points = np.arange(starts[run], starts[run + 1])
        points = points[:: max(1, len(points) // 64)]
        misfit = np.abs(xyz[points, 2, None] - (height + tan_e * rho[points, None])) / rho[points, None]
        rings[run] = np.argmin(np.median(misfit, axis=0)) if len(points) else 0
    return np.repeat(rings, np.diff(starts))


def _line_through(xyz: F64, ring: U8, profile: ScannerProfile) -> tuple[F64, F64]:
    """Azimuth and elevation of the ray from each beam's origin through each point."""
    rho = np.maximum(sm.hypot(xyz[:, 0], xyz[:, 1]), 1e-6)
    side = profile.side_m[ring]
    azimuth = wrap_angle(sm.arctan2(xyz[:, 1], xyz[:, 0]) - sm.arcsin(np.clip(side / rho, -1.0, 1.0)))
    along = np.sqrt(np.maximum(rho * rho - side * side, 1e-12))
    return np.asarray(azimuth), np.asarray(sm.arctan2(xyz[:, 2] - profile.height_m[ring], along))


def _nearest_tick(xyz: F64, ring: U8, profile: ScannerProfile) -> tuple[npt.NDArray[np.int64], F64]:
    """Nearest tick (N,) of each point on its ring and the distance (N,) metres from that ray."""
    rho = sm.hypot(xyz[:, 0], xyz[:, 1])
    side = profile.side_m[ring]
    azimuth = sm.arctan2(xyz[:, 1], xyz[:, 0]) - sm.arcsin(np.clip(side / np.maximum(rho, 1e-6), -1.0, 1.0))
    along = np.sqrt(np.maximum(rho * rho - side * side, 0.0))
    ticks = (azimuth - profile.azimuth_rad[ring]) / profile.tick_step_rad
    nearest = np.rint(ticks)
    across = along * (ticks - nearest) * profile.tick_step_rad
    elevation = profile.elevation_rad[ring]
    above = sm.cos(elevation) * (xyz[:, 2] - profile.height_m[ring]) - sm.sin(elevation) * along
    tick = (nearest.astype(np.int64) - profile.tick_offset[ring]) % profile.lattice_size
    return tick, sm.hypot(across, above)


def _best_ring(xyz: F64, profile: ScannerProfile) -> tuple[U8, npt.NDArray[np.int64], F64]:
    """Ring, tick and distance of the ray nearest to each of a few points, over all beams."""
    ring = np.zeros(len(xyz), dtype=np.uint8)
    tick, distance = _nearest_tick(xyz, ring, profile)
    for candidate in range(1, profile.beams):
        beam = np.full(len(xyz), candidate, dtype=np.uint8)
        its_tick, its_distance = _nearest_tick(xyz, beam, profile)
        closer = its_distance < distance
        ring[closer], tick[closer], distance[closer] = candidate, its_tick[closer], its_distance[closer]
    return ring, tick, distance


def _compensated_rays(xyz: F64, profile: ScannerProfile) -> ScanRays:
    ring = _rings_by_run(xyz, profile)
    azimuth, elevation = _line_through(xyz, ring, profile)
    step = 2.0 * np.pi / profile.firings
    order = np.lexsort((azimuth, ring))
    rings, azimuths, elevations, points = [], [], [], []
    for beam in range(profile.beams):
        of_beam = order[np.searchsorted(ring[order], beam) : np.searchsorted(ring[order], beam, side="right")]
        if len(of_beam) == 0:
            continue
        seen, deviation = azimuth[of_beam], elevation[of_beam] - profile.elevation_rad[beam]
        gap = np.diff(np.concatenate([seen, [seen[0] + 2.0 * np.pi]]))
        missing = np.maximum(np.rint(gap / step).astype(np.int64) - 1, 0) * (gap >= 1.5 * step)
        left = np.repeat(np.arange(len(seen)), missing)
        nth = np.arange(len(left)) - np.repeat(np.cumsum(missing) - missing, missing) + 1
        share = nth / (missing[left] + 1)
        filled = seen[left] + share * gap[left]
        bent = deviation[left] * (1.0 - share) + np.roll(deviation, -1)[left] * share
        rings.append(np.full(len(seen) + len(filled), beam, dtype=np.uint8))
        azimuths.append(np.concatenate([seen, filled]))
        elevations.append(profile.elevation_rad[beam] + np.concatenate([deviation, bent]))
        points.append(np.concatenate([of_beam, np.full(len(filled), -1)]))
    ray_ring = np.concatenate(rings) if rings else np.zeros(0, np.uint8)
    ray_azimuth = np.asarray(wrap_angle(np.concatenate(azimuths))) if rings else np.zeros(0)
    ray_elevation = np.concatenate(elevations) if rings else np.zeros(0)
    ray_point = (np.concatenate(points) if rings else np.zeros(0)).astype(np.int32)
    by_azimuth = np.lexsort((ray_azimuth, ray_ring))
    ray_ring, ray_azimuth, ray_elevation = ray_ring[by_azimuth], ray_azimuth[by_azimuth], ray_elevation[by_azimuth]
    ray_point = ray_point[by_azimuth]
    ray_of_point = np.full(len(xyz), -1, dtype=np.int32)
    returned = np.flatnonzero(ray_point >= 0)
    ray_of_point[ray_point[returned]] = returned
    ticks = np.rint((ray_azimuth - profile.azimuth_rad[ray_ring]) / profile.tick_step_rad).astype(np.int64)
    tick = (ticks - profile.tick_offset[ray_ring]) % profile.lattice_size
    return ScanRays(
        ring=ring,
        tick=np.full(len(xyz), NO_TICK, dtype=np.uint16),
        ray=ray_of_point,
        ray_ring=ray_ring,
        ray_tick=np.full(len(ray_ring), NO_TICK, dtype=np.uint16),
        ray_azimuth_rad=ray_azimuth,
        ray_elevation_rad=ray_elevation,
        ray_time_s=np.zeros(len(ray_ring)),
        ray_point=ray_point,
        ray_blind=profile.blind[ray_ring, tick] & (ray_point < 0),
    )
