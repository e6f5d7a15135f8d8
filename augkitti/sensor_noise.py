"""Sensor noise: the surfaces that rays meet on one car in, what the scanner returns of them out.

Figures come from the `noise` part of the scanner profile, learned from labelled vehicles (`pipelines.fit_vehicles`) and
from smooth surfaces (`pipelines.fit_noise`, key `solid`: shot noise with its tails, isolated drops, range steps); here
is only their form. `simulate_returns` is the seam for another model: same arguments, same result.

An echo has a strength: the surface's own, the car's paint, incidence, range, and chance, in units of chance's standard
deviation. Below 0 nothing returns; up to a threshold the return has reflectance 0; above it, reflectance grows with
strength. So dark cars return less, and more of it as zeros, and zeros stand round the holes (scanner.md: correlation
-0.76). Chance is a field over firings and beams, since real misses come in clumps. A pane reflects the pulse, swallows
it or passes it on, to what stands in the cabin or to the far panes.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy.ndimage import maximum_filter1d
from scipy.signal import lfilter
from scipy.special import expit, ndtr, ndtri

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.range_noise import NoiseProfile, isolated_misses, noise_from_content, shot_error
from augkitti.raycast import CarHits
from augkitti.scan_pair import GLASS, LAMP, MEASURED, OTHER, PAINT, THROUGH_GLASS, TYRE, U8, Bool, ScanRays
from augkitti.scanner import ScannerProfile

_FIRINGS = 2150  # azimuth bins of a noise field: one a firing
_LATE = 4.0 / 3.0  # stray ranges lie from a third of the most before the surface to the most behind it
_MOST_SHOT_M = 0.04  # contract, invariant 4 allows 0.25 m in all: biases, relief and strays take 0.21 m of it
_MOST_STEPS = 12  # of a frame's half width: beside the scanner it would cover the car


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Curve(_Part):
    """A function by straight lines between knots; constant beyond them."""

    at: tuple[float, ...] = Field(min_length=1)
    value: tuple[float, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _one_value_a_knot(self) -> "Curve":
        if len(self.at) != len(self.value) or any(b <= a for a, b in zip(self.at, self.at[1:], strict=False)):
            raise ValueError("`at` must rise, and `value` have as many numbers")
        return self

    def __call__(self, x: Any) -> Any:
        """The value at a number or at each of an array."""
        return np.interp(x, self.at, self.value)


class ClumpModel(_Part):
    """A Gaussian field over firings and beams: two correlation lengths along the ring, the rest white."""

    long: float = Field(ge=0, le=1)  # share of variance
    long_firing: float = Field(ge=0, lt=1)  # correlation to the next firing
    short: float = Field(ge=0, le=1)
    short_firing: float = Field(ge=0, lt=1)
    beam: float = Field(ge=0, lt=1)  # correlation to the next beam at the same azimuth


class KindModel(_Part):
    """Strength of the echo of a kind of surface: `strength` + `gain` x the car's paint score."""

    strength: float
    gain: float
    zero_below: float = Field(ge=0)  # weaker returns have reflectance 0


class BodyModel(_Part):
    """What the echo of a car's outside depends on beside its kind: paint, incidence, range, a pane's frame."""

    paint: Curve  # score by the car's `paint`
    cosine: Curve  # strength by the cosine of incidence
    range_per_50m: float
    frame: float  # strength near panes: pillars are thinner than models have them, and pulses are wide
    frame_m: float = Field(ge=0)  # how near


class GlassModel(_Part):
    """What a pane does to a pulse that it does not reflect, and what stands in the cabin."""

    pass_: float = Field(ge=0, le=1, alias="pass")
    tint: float = Field(ge=0)  # spread of what passes over cars
    cosine: float = Field(ge=0)  # weakens what passes at grazing incidence
    inside_return: float = Field(ge=0, le=1)
    second_pass: float = Field(ge=0, le=1)
    clutter: float = Field(ge=0, le=1)  # chance of meeting what models lack: seats, wheel, people
    clutter_m: Curve  # its depth behind the pane by a number from 0 to 1


class ReflectanceModel(_Part):
    """Reflectance by strength above the threshold of zeros; that of what is seen through panes by chance."""

    strength: Curve
    inside_zero: float = Field(ge=0, le=1)
    inside: Curve  # by a number from 0 to 1


class ReliefModel(_Part):
    """What bodies have and models lack: roughness, relief that is smooth along the ring, and stray ranges."""

    rough_m: float = Field(ge=0)  # standard deviation seen straight on; over the cosine of incidence
    std_m: float = Field(ge=0)
    firing: float = Field(ge=0, lt=1)
    beam: float = Field(ge=0, lt=1)
    stray: float = Field(
        ge=0, le=1
    )  # share of returns that lie up to `most_m` behind the surface, or a third of it before
    most_m: float = Field(ge=0, le=0.13)  # of both: contract, invariant 4 allows 0.25 m, beam biases take 0.06 m of it


class NoiseModel(_Part):
    """What the `noise` part of a scanner profile says of vehicles; other parts of it are read elsewhere."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    source: str
    shot_std_m: float = Field(ge=0)
    isolated_drop: float = Field(ge=0, le=1)
    body: BodyModel
    body_clump: ClumpModel
    paint: KindModel
    pane: KindModel
    tyre: KindModel
    lamp: KindModel
    other: KindModel
    glass: GlassModel
    glass_clump: ClumpModel
    reflectance: ReflectanceModel
    relief: ReliefModel


@lru_cache(maxsize=8)
def noise_model(profile: ScannerProfile) -> NoiseModel:
    """The noise figures of a profile.

    Raises:
        InputError: the profile has no `noise` part, or a key of it is wrong.
    """
    content = profile.content.get("noise")
    if content is None:
        raise InputError(profile.name, "has no `noise`", "run `augkitti fit-noise --profile FOLDER`, which adds it")
    try:
        return NoiseModel.model_validate(content)
    except ValidationError as err:
        first = err.errors()[0]
        key = ".".join(str(part) for part in ("noise", *first["loc"]))
        raise InputError(profile.name, f"key `{key}`: {first['msg']}", "see the shipped scanner profile") from err


@lru_cache(maxsize=8)
def solid_noise(profile: ScannerProfile) -> NoiseProfile | None:
    """The learned noise of solid surfaces in a profile; None where it has none: constants stand for it.

    Raises:
        InputError: the part is damaged.
    """
    content = (profile.content.get("noise") or {}).get("solid")
    return None if content is None else noise_from_content(content, profile.range_bias_m, profile.name)


@dataclass(frozen=True, eq=False)
class CarLook:
    """Traits of one car that stay the same in both scans."""

    paint: float  # 0 dark to 1 bright
    tint: float  # 0 clear to 1 dark panes


@dataclass(frozen=True, eq=False)
class CarReturns:
    """What became of each pulse that met a car. K as in CarHits."""

    stop_m: F64  # (K,) true range at which the pulse ended on the car; inf where it passed through all panes
    returned: Bool  # (K,) whether the scanner saw an echo of it
    range_m: F64  # (K,) as measured: bias, noise and range steps included
    reflectance: F64  # (K,) 0 to 0.99 in the scanner's steps
    surface: U8  # (K,)
    edge_luck: F64 | None = None  # (2, K) from 0 to 1: what becomes of the ray where it is the last before a range step


def simulate_returns(
    hits: CarHits,
    look: CarLook,
    rays: ScanRays,
    profile: ScannerProfile,
    opaque_glass: bool,
    rng: np.random.Generator,
) -> CarReturns:
    """Send one pulse along every ray that meets a car and say what comes back; `opaque_glass`: panes act as paint."""
    model = noise_model(profile)
    count = len(hits.ray)
    ring, azimuth = rays.ray_ring[hits.ray], rays.ray_azimuth_rad[hits.ray]
    grid = FieldGrid(ring, azimuth, profile.ring_step_rad)
    chance = grid.draw(model.body_clump, rng)
    pane_chance = grid.draw(model.glass_clump, rng)
    relief = grid.draw_smooth(model.relief.firing, model.relief.beam, rng)
    white = rng.standard_normal((2, count))
    luck = rng.random((6, count))

    outside = hits.surface[:, 0] if count else np.zeros(0, dtype=np.uint8)
    cosine = hits.cos_incidence[:, 0] if count else np.zeros(0)
    stop = hits.range_m[:, 0].copy() if count else np.zeros(0)
    pane = (outside == GLASS) & (not opaque_glass)
    strength, zero_below = _strength(hits, pane, look, model, grid)
    strength += np.where(pane, pane_chance, chance)
    returned = strength > 0.0
    reflectance = _by_strength(strength - zero_below, model, profile)
    surface = outside.copy()

    through = np.flatnonzero(pane & ~returned & _passes(pane_chance, strength, cosine, look, model))
    if len(through):
        depth = ndtr(chance[through])  # two fields that panes have no other use for
        echo = ndtr(np.sqrt(0.5) * (relief[through] + white[1, through]))
        stop[through], returned[through] = _cabin(hits, through, depth, echo, luck[1, through], model)
        surface[through] = THROUGH_GLASS
        reflectance[through] = _through_glass(1.0 - depth, model, profile)

    true_m = np.where(np.isfinite(stop), stop, 0.0)
    solid = solid_noise(profile)
    if solid is None:
        returned &= luck[2] >= model.isolated_drop
    else:
        returned &= ~isolated_misses(solid, ring, true_m, cosine, reflectance, luck[2])
    inside = surface == THROUGH_GLASS
    rough = np.where(inside, 0.0, model.relief.rough_m / np.maximum(cosine, 0.1))
    error = _shape_error(inside, relief, white[1], luck[0], model)
    if solid is None:
        error += white[0] * sm.hypot(model.shot_std_m, rough)
    else:
        error += np.clip(shot_error(solid, true_m, white[0], luck[3], rough), -_MOST_SHOT_M, _MOST_SHOT_M)
    measured = quantise_range(true_m + profile.range_bias_m[ring] + error, ring, profile)
    returned &= (measured >= profile.min_range_m) & (measured <= profile.max_range_m)
    return CarReturns(stop, returned, measured, reflectance, surface, luck[4:])


def quantise_range(range_m: F64, ring: U8, profile: ScannerProfile) -> F64:
    """Ranges (K,) on the scanner's steps: a multiple of the quantum plus the beam's own phase."""
    phase, quantum = profile.range_phase_m[ring], profile.range_quantum_m
    return np.asarray(phase + quantum * np.rint((range_m - phase) / quantum))


def _strength(hits: CarHits, pane: Bool, look: CarLook, model: NoiseModel, grid: "FieldGrid") -> tuple[F64, F64]:
    """Strength (K,) of the echo of the first surface without chance, and the threshold (K,) of its zeros."""
    if not len(pane):
        return np.zeros(0), np.zeros(0)
    body, outside = model.body, np.where(pane, GLASS, hits.surface[:, 0])
    outside[(outside == GLASS) & ~pane] = PAINT
    score = float(body.paint(look.paint))
    base, zero_below = np.zeros(OTHER + 1), np.zeros(OTHER + 1)
    kinds = ((PAINT, model.paint), (GLASS, model.pane), (TYRE, model.tyre), (LAMP, model.lamp), (OTHER, model.other))
    for kind, part in kinds:
        base[kind], zero_below[kind] = part.strength + part.gain * score, part.zero_below
    strength = base[outside] + body.range_per_50m / 50.0 * hits.range_m[:, 0]
    turned = (outside == PAINT) | (outside == LAMP)
    strength[turned] += body.cosine(hits.cos_incidence[turned, 0])
    if pane.any():
        strength[(outside == PAINT) & grid.near(pane, body.frame_m / float(np.median(hits.range_m[:, 0])))] += (
            body.frame
        )
    return strength, zero_below[outside]


def _passes(pane_chance: F64, strength: F64, cosine: F64, look: CarLook, model: NoiseModel) -> Bool:
    """Which pulses (K,) a pane would let through: those with the least luck, so that they never were reflected ones."""
    glass = model.glass
    clear = 2.0 * float(expit(glass.tint * ndtri(np.clip(1.0 - look.tint, 1e-6, 1 - 1e-6))))  # 1 for the middle car
    chance = np.clip(glass.pass_ * clear * sm.power(cosine, glass.cosine), 1e-6, 1.0 - 1e-6)
    return np.asarray((pane_chance < ndtri(chance)) & (strength <= 0.0))


def _cabin(hits: CarHits, through: Any, depth: F64, echo: F64, luck: F64, model: NoiseModel) -> tuple[F64, Bool]:
    """Where pulses (M,) that passed the first pane end (metres; inf: they leave the car), and which return."""
    glass = model.glass
    ranges, kinds = hits.range_m[through], hits.surface[through]
    met = np.where(depth < glass.clutter, ranges[:, 0] + glass.clutter_m(depth / max(glass.clutter, 1e-9)), np.inf)
    stop = np.full(len(through), np.inf)
    seen = echo < glass.inside_return
    alive, leaves = np.ones(len(through), dtype=bool), luck < glass.second_pass
    for level in range(1, ranges.shape[1]):
        here = alive & (kinds[:, level] != MEASURED)
        clutter = here & (met < ranges[:, level])  # before something of the car: else it would stand outside
        stop[clutter] = met[clutter]
        here &= ~clutter
        goes_on = here & (kinds[:, level] == GLASS) & leaves
        ends = here & ~goes_on
        stop[ends] = ranges[ends, level]
        alive = here & goes_on
        if not alive.any():
            break
    return stop, seen & np.isfinite(stop)


def _by_strength(above: F64, model: NoiseModel, profile: ScannerProfile) -> F64:
    """Reflectance (K,) by strength above the threshold of zeros."""
    value = _in_steps(model.reflectance.strength(above), profile)
    return np.where(above > 0.0, value, 0.0)


def _through_glass(depth: F64, model: NoiseModel, profile: ScannerProfile) -> F64:
    """Reflectance (M,) of what is seen through a pane."""
    part = model.reflectance
    value = _in_steps(part.inside((depth - part.inside_zero) / max(1.0 - part.inside_zero, 1e-9)), profile)
    return np.where(depth < part.inside_zero, 0.0, value)


def _in_steps(value: F64, profile: ScannerProfile) -> F64:
    steps = np.clip(np.rint(value / profile.reflectance_quantum), 1, profile.reflectance_steps)
    return np.asarray(steps * profile.reflectance_quantum)


def _shape_error(inside: Bool, relief: F64, stray: F64, luck: F64, model: NoiseModel) -> F64:
    """Error (K,) metres beside the beam's bias and its shot noise: relief, stray ranges."""
    part = model.relief
    # Late rather than early: towards the scanner an error leaves the car's box, which may be sheared by the sweep too.
    late = part.most_m * (_LATE * ndtr(stray) - (_LATE - 1.0))
    shape = part.std_m * relief + np.where(luck < part.stray, late, 0.0)
    return np.where(inside, 0.0, np.clip(shape, -(_LATE - 1.0) * part.most_m, part.most_m))


class FieldGrid:
    """Draws correlated chance on the patch of (beam, firing) cells that a car covers."""

    def __init__(self, ring: U8, azimuth_rad: F64, ring_step_rad: float) -> None:
        self.ring_step_rad = ring_step_rad
        self.empty = len(ring) == 0
        if self.empty:
            return
        middle = float(sm.arctan2(sm.sin(azimuth_rad).sum(), sm.cos(azimuth_rad).sum()))
        off = (azimuth_rad - middle + np.pi) % (2.0 * np.pi) - np.pi
        column = np.rint(off * (_FIRINGS / (2.0 * np.pi))).astype(np.int64)
        self.row = ring.astype(np.int64) - int(ring.min())
        self.column = column - int(column.min())
        self.shape = (int(self.row.max()) + 1, int(self.column.max()) + 1)

    def draw(self, clump: ClumpModel, rng: np.random.Generator) -> F64:
        """One standard normal value for each ray."""
        if self.empty:
            return np.zeros(0)
        white = max(0.0, 1.0 - clump.long - clump.short)
        field = np.sqrt(clump.long) * self._smooth(clump.long_firing, clump.beam, rng)
        field += np.sqrt(clump.short) * self._smooth(clump.short_firing, clump.beam, rng)
        out = field[self.row, self.column] + np.sqrt(white) * rng.standard_normal(len(self.row))
        return np.asarray(out / np.sqrt(clump.long + clump.short + white))

    def draw_smooth(self, firing: float, beam: float, rng: np.random.Generator) -> F64:
        """One standard normal value for each ray, from a field with one correlation length."""
        return np.zeros(0) if self.empty else np.asarray(self._smooth(firing, beam, rng)[self.row, self.column])

    def near(self, chosen: Bool, angle_rad: float) -> Bool:
        """Which rays lie within an angle of a chosen one along beams and firings, one step at least."""
        field = np.zeros(self.shape, dtype=np.uint8)
        field[self.row[chosen], self.column[chosen]] = 1
        for axis, step in ((0, self.ring_step_rad), (1, 2.0 * np.pi / _FIRINGS)):
            reach = min(max(int(angle_rad / step + 0.5), 1), _MOST_STEPS)
            field = maximum_filter1d(field, 2 * reach + 1, axis=axis)
        return np.asarray(field[self.row, self.column] > 0)

    def _smooth(self, firing: float, beam: float, rng: np.random.Generator) -> Any:
        field = rng.standard_normal(self.shape)
        for axis, rho in ((1, firing), (0, beam)):
            scale = np.sqrt(1.0 - rho * rho)
            field *= scale
            first: list[Any] = [slice(None), slice(None)]
            first[axis] = 0
            field[tuple(first)] /= scale  # the first value is as spread as all others
            field = lfilter([1.0], [1.0, -rho], field, axis=axis)
        return field
