"""Sensor noise: the surfaces that rays meet on one car in, what the scanner returns of them out.

Figures come from the `noise` part of the scanner profile (measured: scanner.md sections 2 and 3); here is only their
form. `simulate_returns` is the seam for a learned model: same arguments, same result.

A pulse that meets a pane is reflected, absorbed or passed on; one that meets a solid surface returns if the echo is
strong enough, which depends on the car's paint, on incidence and range. Chance along neighbouring rays is drawn from
fields that are correlated from firing to firing and from beam to beam, since real misses come in clumps.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from scipy.signal import lfilter
from scipy.special import expit, ndtr, ndtri

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.raycast import CarHits
from augkitti.scan_pair import GLASS, LAMP, MEASURED, PAINT, THROUGH_GLASS, TYRE, U8, Bool, ScanRays
from augkitti.scanner import ScannerProfile

_FIRINGS = 2150  # azimuth bins of a noise field: one a firing


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ClumpModel(_Part):
    """A Gaussian field over firings and beams: two correlation lengths along the ring, the rest white."""

    long: float = Field(ge=0, le=1)  # share of variance
    long_firing: float = Field(ge=0, lt=1)  # correlation to the next firing
    short: float = Field(ge=0, le=1)
    short_firing: float = Field(ge=0, lt=1)
    beam: float = Field(ge=0, lt=1)  # correlation to the next beam at the same azimuth


class BodyModel(_Part):
    """Logit of a return from paint: intercept + cosine * cos + paint * z + range_per_50m * range / 50 m."""

    intercept: float
    cosine: float
    paint: float
    range_per_50m: float


class GlassModel(_Part):
    """What a pane does to a pulse; `tint` spreads cars, `cosine` weakens what passes at grazing incidence."""

    reflect: float = Field(ge=0, le=1)
    pass_: float = Field(ge=0, le=1, alias="pass")
    tint: float = Field(ge=0)
    inside_return: float = Field(ge=0, le=1)
    second_pass: float = Field(ge=0, le=1)
    cosine: float = Field(ge=0)


class ReflectanceModel(_Part):
    """Shares of exact zeros, and quantiles of the rest, as a field that is smooth along the ring."""

    body_zero: float = Field(ge=0, le=1)
    glass_zero: float = Field(ge=0, le=1)
    inside_zero: float = Field(ge=0, le=1)
    firing: float = Field(ge=0, lt=1)
    beam: float = Field(ge=0, lt=1)
    quantiles: tuple[float, ...]
    values: tuple[float, ...]


class NoiseModel(_Part):
    """The `noise` part of a scanner profile."""

    source: str
    shot_std_m: float = Field(ge=0)
    grazing_std_m: float = Field(ge=0)  # roughness over cos of incidence
    isolated_drop: float = Field(ge=0, le=1)
    body: BodyModel
    body_clump: ClumpModel
    glass: GlassModel
    glass_clump: ClumpModel
    tyre_return: float = Field(ge=0, le=1)
    lamp_return: float = Field(ge=0, le=1)
    other_return: float = Field(ge=0, le=1)
    reflectance: ReflectanceModel


@lru_cache(maxsize=8)
def noise_model(profile: ScannerProfile) -> NoiseModel:
    """The noise figures of a profile.

    Raises:
        InputError: the profile has no `noise` part, or a key of it is wrong.
    """
    try:
        return NoiseModel.model_validate(profile.content.get("noise"))
    except ValidationError as err:
        first = err.errors()[0]
        key = ".".join(str(part) for part in ("noise", *first["loc"]))
        raise InputError(profile.name, f"key `{key}`: {first['msg']}", "see the shipped scanner profile") from err


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
    count, layers = hits.range_m.shape
    ring, azimuth = rays.ray_ring[hits.ray], rays.ray_azimuth_rad[hits.ray]
    fields = _FieldGrid(ring, azimuth)
    body_luck = ndtr(fields.draw(model.body_clump, rng))
    pane_luck = ndtr(fields.draw(model.glass_clump, rng))
    inside_luck = ndtr(fields.draw(model.glass_clump, rng))
    shine = ndtr(fields.draw_smooth(model.reflectance.firing, model.reflectance.beam, rng))
    shot = rng.standard_normal(count)
    lost = rng.random(count) < model.isolated_drop

    clear = expit(model.glass.tint * ndtri(np.clip(1.0 - look.tint, 1e-6, 1 - 1e-6)))  # 0.5 for the middle car
    stop = np.full(count, np.inf)
    layer_of_stop = np.full(count, -1, dtype=np.int64)
    returned = np.zeros(count, dtype=bool)
    alive = np.ones(count, dtype=bool)
    panes = np.zeros(count, dtype=np.int64)
    for level in range(layers):
        surface, cosine, distance = hits.surface[:, level], hits.cos_incidence[:, level], hits.range_m[:, level]
        here = alive & (surface != MEASURED)
        if not here.any():
            break
        pane = here & (surface == GLASS) & (not opaque_glass)
        luck = np.where(panes == 0, pane_luck, inside_luck)
        passes = np.where(panes == 0, model.glass.pass_, model.glass.second_pass) * 2.0 * clear
        passes = np.clip(passes * sm.power(cosine, model.glass.cosine), 0.0, 1.0 - model.glass.reflect)
        reflects = np.where(panes == 0, model.glass.reflect, 0.5 * model.glass.reflect)
        shines_back = pane & (luck < reflects)
        goes_on = pane & (luck > 1.0 - passes)
        solid = here & ~pane
        chance = np.where(panes == 0, _solid_return(surface, cosine, distance, look, model), model.glass.inside_return)
        echo = solid & (np.where(panes == 0, body_luck, inside_luck) < chance)
        ends = here & ~goes_on
        stop[ends], layer_of_stop[ends] = distance[ends], level
        returned |= shines_back | echo
        panes[goes_on] += 1
        alive &= ~ends
    returned &= ~lost
    rows = np.arange(count)
    last = np.maximum(layer_of_stop, 0)
    surface = hits.surface[rows, last]
    surface[(panes > 0) & (layer_of_stop > 0)] = THROUGH_GLASS
    cosine = np.maximum(hits.cos_incidence[rows, last], 0.1)
    true_m = np.where(np.isfinite(stop), stop, 0.0)
    noise = shot * sm.hypot(model.shot_std_m, np.where(surface == THROUGH_GLASS, 0.0, model.grazing_std_m / cosine))
    measured = quantise_range(true_m + profile.range_bias_m[ring] + noise, ring, profile)
    returned &= (measured >= profile.min_range_m) & (measured <= profile.max_range_m)
    return CarReturns(stop, returned, measured, _reflectance(surface, shine, look, model, profile), surface)


def quantise_range(range_m: F64, ring: U8, profile: ScannerProfile) -> F64:
    """Ranges (K,) on the scanner's steps: a multiple of the quantum plus the beam's own phase."""
    phase, quantum = profile.range_phase_m[ring], profile.range_quantum_m
    return np.asarray(phase + quantum * np.rint((range_m - phase) / quantum))


def _solid_return(surface: U8, cosine: F64, distance: F64, look: CarLook, model: NoiseModel) -> F64:
    body = model.body
    score = ndtri(np.clip(look.paint, 1e-6, 1 - 1e-6))
    reach = np.where(np.isfinite(distance), distance, 0.0) / 50.0
    paint = expit(body.intercept + body.cosine * cosine + body.paint * score + body.range_per_50m * reach)
    chance = np.where((surface == PAINT) | (surface == GLASS), paint, model.other_return)
    chance = np.where(surface == TYRE, model.tyre_return, chance)
    return np.asarray(np.where(surface == LAMP, model.lamp_return, chance))


def _reflectance(surface: U8, shine: F64, look: CarLook, model: NoiseModel, profile: ScannerProfile) -> F64:
    part = model.reflectance
    # Dark cars show more zeros (scanner.md: correlation -0.76 with the body's return rate).
    zero = np.full(len(surface), np.clip(part.body_zero + 0.7 * (0.5 - look.paint), 0.02, 0.98))
    zero = np.where(surface == GLASS, part.glass_zero, zero)
    zero = np.where(surface == THROUGH_GLASS, part.inside_zero, zero)
    zero = np.where(surface == TYRE, 0.8, zero)
    zero = np.where(surface == LAMP, 0.05, zero)
    above = np.clip((shine - zero) / (1.0 - zero), 0.0, 1.0)
    value = np.interp(above, part.quantiles, part.values)
    value = np.where(surface == LAMP, 0.5 + 0.49 * above, value)
    steps = np.clip(np.rint(value / profile.reflectance_quantum), 1, 99)
    return np.where(shine < zero, 0.0, steps * profile.reflectance_quantum)


class _FieldGrid:
    """Draws correlated chance on the patch of (beam, firing) cells that a car covers."""

    def __init__(self, ring: U8, azimuth_rad: F64) -> None:
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
        field += np.sqrt(white) * rng.standard_normal(self.shape)
        return np.asarray(field[self.row, self.column] / np.sqrt(clump.long + clump.short + white))

    def draw_smooth(self, firing: float, beam: float, rng: np.random.Generator) -> F64:
        """One standard normal value for each ray, from a field with one correlation length."""
        return np.zeros(0) if self.empty else np.asarray(self._smooth(firing, beam, rng)[self.row, self.column])

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
