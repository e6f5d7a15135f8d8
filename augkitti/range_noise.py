"""A learned noise profile and the conditions of returns or rays in; densities, quantiles, samples and chances out.

Three models of a return's range against the surface that it comes from, all mixtures of normal distributions round the
beam's bias: `constant` (one normal), `parametric` (a scale from range, incidence, roughness and reflectance; heavy
tails of fixed shape) and `network` (the same form, whose scale, shift and tails a small network bends). Likewise three
of the chance that a ray is lost on a smooth surface, and one of what happens at range steps. A profile is plain arrays;
fitting them is `pipelines.fit_noise`. What reaches shards goes through `same_math`.
"""

import io
import json
import tokenize
import zipfile
import zlib
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.special import expit, ndtr

from augkitti import same_math as sm
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.scan_pair import U8

DEFAULT_NOISE = "hdl64e_kitti_noise"
Model = Literal["constant", "parametric", "network"]
MODELS: tuple[Model, ...] = ("constant", "parametric", "network")
GROUND, WALL, SLANTED = range(3)  # as in noise_patches
MIXED_M = 0.25  # a mixed point is this far from both sides (scanner.md section 2)
CORE = 3  # components of the mixture on the surface itself; those after it are returns from elsewhere

_FORMAT = 1
_SIMULATED = ("shot_m", "parametric.shape", "surface", "edge", "edge.car", "edge.share")
_DAMAGED = (zipfile.BadZipFile, zlib.error, tokenize.TokenError, SyntaxError, RuntimeError, AttributeError, TypeError)
_RETURN_FEATURES, _RAY_FEATURES = 12, 30  # columns of `return_features`, `ray_features`
_LN_SQRT_2PI = 0.9189385332046727
_BRIGHT = 0.97  # reflectance: signs, plates
_MIN_COSINE = 0.08
_MIN_STD_M = 1e-4
_BODY_KNOTS = tuple(  # ranges, cosines of incidence, reflectances; a value belongs to the next knot at or below it
    np.array(knots)
    for knots in ((4.0, 8.0, 12.0, 18.0, 25.0, 35.0, 45.0, 60.0), (0.1, 0.3, 0.5, 0.7, 0.9), (0.0, 0.02, 0.1, 0.3, 0.6))
)
_MOST_MISSES = 0.03  # chances of isolated misses are cut there in simulation
_PATCH_RANGE_M = (2.0, 80.0)


@dataclass(frozen=True, eq=False)
class ReturnConditions:
    """What a return's range error depends on. All (n,)."""

    ring: U8
    range_m: F64
    cos_incidence: F64
    reflectance: F64
    slope: U8  # GROUND, WALL or SLANTED
    rough_m: F64  # spread of the neighbours along their rings, across the surface
    spread_m: F64  # of the rings' means, across the surface, biases taken out
    white_gain: F64  # of the plane that the return is judged by; 0 where the surface is known
    ring_gain: F64  # sum of the squared weights of the neighbouring rings; 0 where the surface is known


@dataclass(frozen=True, eq=False)
class RayConditions:
    """What the chance of an isolated miss depends on. All (n,)."""

    ring: U8
    range_m: F64
    cos_incidence: F64
    reflectance: F64
    slope: U8
    rough_m: F64  # spread of the neighbours on the ring
    lost_own: F64  # share of other rays near on the ring that returned nothing
    lost_beside: F64  # the same on the rings beside


@dataclass(frozen=True, eq=False)
class Mixture:
    """Normal components of each return's residual, less its beams' biases. (n, K); K may be 1."""

    weight: F64
    mean_m: F64
    std_m: F64


@dataclass(frozen=True, eq=False)
class NoiseProfile:
    """A learned noise profile: plain arrays of three models, and which of them is to be used."""

    name: str
    shipped: Model  # of the range: the better of `parametric` and `network` on unseen drives
    shipped_drop: Model  # of isolated misses: likewise
    facts: dict[str, Any]  # what it was fitted on, figures: as on the card
    arrays: dict[str, F64]  # see `ARRAYS`

    @cached_property
    def bias_m(self) -> F64:
        """Bias (beams,) metres of each beam. A common offset and slow trends over beams are not known: set to 0."""
        return self.arrays["bias_m"]

    @cached_property
    def body_misses(self) -> F64:
        """Chance that a ray is lost alone on a smooth upright surface: (beams, ranges, cosines, reflectances)."""
        beams = len(self.bias_m)
        shape = (beams, *(len(knots) for knots in _BODY_KNOTS))
        ring, *cell = (index.ravel() for index in np.indices(shape))
        range_m, cosine, shine = (knots[i] for knots, i in zip(_BODY_KNOTS, cell, strict=True))
        count, none = len(ring), np.zeros(len(ring))
        wall, rough = np.full(count, WALL, dtype=np.uint8), np.full(count, self.arrays["shot_m"][0, 1])
        at = RayConditions(ring.astype(np.uint8), range_m, cosine, shine, wall, rough, none, none)
        return miss_chance(self, self.shipped_drop, at).reshape(shape)


ARRAYS = {  # name: dimensions
    "bias_m": 1,  # (beams,)
    "constant": 1,  # mean, std (metres), chance of a miss
    "constant_core": 1,  # mean, std, weight, mean and std of three components elsewhere: a fairer constant
    "parametric.scale": 1,  # variances: see `_variances`
    "parametric.shape": 2,  # (K, 3): weight, offset, multiple of the scale; elsewhere: weight, mean_m, std_m
    "network.scale": 1,
    "network.shape": 2,
    "network.w0": 2,
    "network.b0": 1,
    "network.w1": 2,
    "network.b1": 1,
    "network.w2": 2,
    "network.b2": 1,
    "features.mean": 1,
    "features.std": 1,
    "drop.parametric": 1,
    "drop.beam": 1,  # (beams,) logit of each beam beside the rest
    "drop.network.w0": 2,
    "drop.network.b0": 1,
    "drop.network.w1": 2,
    "drop.network.b1": 1,
    "drop.network.beam": 1,
    "drop.features.mean": 1,
    "drop.features.std": 1,
    "shot_m": 2,  # (k, 2) range, spread of one beam from shot to shot
    "surface": 1,  # rough_m and spread_m of smooth walls; correlation of the patch's share to the next firing
    "edge": 2,  # (k, 3) step from (m), chance of a mixed point, of nothing
    "edge.car": 1,  # chance of a mixed point, of nothing where a car stands before something
    "edge.share": 1,  # quantiles of a mixed point's place between near (0) and far (1)
}


_SIZES: dict[str, tuple[int, ...]] = {  # 0: any number, at least one; those that depend on others are in `_damaged`
    "bias_m": (0,),
    "constant": (3,),
    "constant_core": (11,),
    "parametric.scale": (6,),
    "parametric.shape": (6, 3),
    "network.scale": (6,),
    "network.shape": (6, 3),
    "features.mean": (_RETURN_FEATURES,),
    "features.std": (_RETURN_FEATURES,),
    "drop.features.mean": (_RAY_FEATURES,),
    "drop.features.std": (_RAY_FEATURES,),
    "shot_m": (0, 2),
    "surface": (3,),
    "edge": (0, 3),
    "edge.car": (2,),
    "edge.share": (21,),
}


def load_noise(path: Path | None = None) -> NoiseProfile:
    """The shipped noise profile, or one written by `augkitti fit-noise` (its folder or its `.npz`).

    Raises:
        InputError: the file is missing, damaged, or not such a profile.
    """
    if path is None:
        return _shipped()
    file = Path(path)
    if file.is_dir():
        found = sorted(file.glob("*noise.npz"))
        if len(found) != 1:
            raise InputError(file, f"{len(found)} files `*noise.npz` in it", "run `augkitti fit-noise` first")
        file = found[0]
    return _read(file)


@lru_cache(maxsize=1)
def _shipped() -> NoiseProfile:
    with resources.as_file(resources.files("augkitti") / "profiles" / f"{DEFAULT_NOISE}.npz") as file:
        return _read(file)


def solid_part(profile: NoiseProfile) -> dict[str, Any]:
    """What simulation needs of a profile, as JSON for the key `noise.solid` of a scanner profile."""
    names = _simulated(profile.shipped, profile.shipped_drop)
    arrays = {name: _rounded(profile.arrays[name]) for name in names}
    return {"shipped": profile.shipped, "shipped_drop": profile.shipped_drop, "arrays": arrays}


def _simulated(shipped: Model, shipped_drop: Model) -> list[str]:
    """Names of the arrays that simulation needs."""
    names = [*_SIMULATED, *(n for n in ARRAYS if n.startswith(f"{shipped}.") and n not in _SIMULATED)]
    names += [n for n in ARRAYS if n.startswith((f"drop.{shipped_drop}", "drop.features"))]
    names += ["drop.beam"] if shipped_drop == "parametric" else []
    return names + (["features.mean", "features.std"] if shipped == "network" else [])


def _damaged(arrays: dict[str, F64]) -> str | None:
    """The first array of a profile that is not finite or has not the size that `ARRAYS` says; None if all are sound."""
    size = {name: values.shape for name, values in arrays.items()}
    beams = size["bias_m"]
    wanted = {**_SIZES, "drop.beam": beams, "drop.network.beam": beams, "drop.parametric": (_RAY_FEATURES + 1,)}
    for prefix, entry, layers in (("network", _RETURN_FEATURES, 3), ("drop.network", _RAY_FEATURES, 2)):
        width = entry
        for layer in range(layers):
            end = OUTPUTS if prefix == "network" else 1
            out = end if layer == layers - 1 else size.get(f"{prefix}.b{layer}", (0,))[0]
            wanted |= {f"{prefix}.w{layer}": (width, out), f"{prefix}.b{layer}": (out,)}
            width = out
    for name, values in arrays.items():
        if values.ndim != ARRAYS[name] or not np.isfinite(values).all():
            return name
        for have, need in zip(values.shape, wanted.get(name, values.shape), strict=True):
            if have != need and (need or not have):
                return name
    return None


def _rounded(values: F64) -> Any:
    if values.ndim:
        return [_rounded(row) for row in values]
    return float(f"{float(values):.6g}")


def noise_from_content(content: Any, bias_m: F64, where: str) -> NoiseProfile:
    """The key `noise.solid` of a scanner profile, with the profile's own biases.

    Raises:
        InputError: a part is missing or damaged.
    """
    remedy = "run `augkitti fit-noise`, or see the shipped scanner profile"
    try:
        shipped, shipped_drop, given = content["shipped"], content["shipped_drop"], content["arrays"]
        arrays = {name: np.asarray(given[name], dtype=np.float64) for name in given if name in ARRAYS}
        if shipped not in MODELS[1:] or shipped_drop not in MODELS[1:]:
            raise ValueError(f"model `{shipped}` or `{shipped_drop}`")
        if missing := sorted(set(_simulated(shipped, shipped_drop)) - set(arrays)):
            raise ValueError(f"{missing[0]} missing")
    except (KeyError, TypeError, ValueError) as err:
        raise InputError(where, f"key `noise.solid` is damaged: {err}", remedy) from err
    arrays["bias_m"] = bias_m
    if (name := _damaged(arrays)) is not None:
        raise InputError(where, f"key `noise.solid.arrays.{name}` is damaged", remedy)
    return NoiseProfile(where, shipped, shipped_drop, {}, arrays)


def save_noise(profile: NoiseProfile, path: Path) -> None:
    """Write a profile as arrays without pickle; the same profile gives the same bytes."""
    head = {"format": _FORMAT, "name": profile.name, "shipped": profile.shipped, "shipped_drop": profile.shipped_drop}
    facts = json.dumps({**profile.facts, **head})
    content = {"facts": np.frombuffer(facts.encode(), dtype=np.uint8), **profile.arrays}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in sorted(content):
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(entry, "w") as target:
                np.lib.format.write_array(target, np.ascontiguousarray(content[name]), allow_pickle=False)


def _read(file: Path) -> NoiseProfile:
    remedy = "run `augkitti fit-noise`, or leave `--profile` out for the shipped one"
    try:
        with np.load(io.BytesIO(file.read_bytes()), allow_pickle=False) as archive:
            content = {name: archive[name] for name in archive.files}
        facts = json.loads(content.pop("facts").tobytes().decode())
        arrays = {name: np.asarray(content[name], dtype=np.float64) for name in ARRAYS}
    except KeyError as err:
        raise InputError(file, f"{err} is missing from the noise profile", remedy) from err
    except (OSError, ValueError, EOFError, MemoryError, NotImplementedError, RecursionError, *_DAMAGED) as err:
        raise InputError(file, f"not readable as a noise profile ({err})", remedy) from err
    chosen: list[Any] = [facts.get(k) for k in ("shipped", "shipped_drop")] if isinstance(facts, dict) else [None]
    if not set(chosen) <= set(MODELS[1:]) or facts.get("format") != _FORMAT:
        raise InputError(file, "not a noise profile of this version", remedy)
    if (damaged := _damaged(arrays)) is not None:
        raise InputError(file, f"`{damaged}` of the noise profile is damaged", remedy)
    return NoiseProfile(str(facts.get("name")), chosen[0], chosen[1], facts, arrays)


# ---------------------------------------------------------------------------------------------------------------------
# Range


def return_features(at: ReturnConditions) -> F64:
    """What the network sees of returns (n, 12), not yet standardised."""
    cosine = np.maximum(at.cos_incidence, _MIN_COSINE)
    range_m = np.clip(at.range_m, *_PATCH_RANGE_M)
    return np.stack(
        [
            sm.log(range_m / 10.0),
            np.maximum(6.0 - range_m, 0.0) / 4.0,
            sm.log(cosine),
            cosine,
            np.clip(at.reflectance, 0.0, 1.0),
            (at.reflectance < 0.005).astype(np.float64),
            (at.reflectance >= _BRIGHT).astype(np.float64),
            (at.slope == GROUND).astype(np.float64),
            (at.slope == WALL).astype(np.float64),
            (at.ring < 32).astype(np.float64),
            sm.log(np.maximum(at.rough_m, 5e-4)),
            sm.log(np.maximum(at.spread_m, 5e-4)),
        ],
        axis=1,
    )


def variances(scale: F64, at: ReturnConditions) -> tuple[F64, F64]:
    """White variance, and the one that a beam keeps over a patch (n,) square metres, of the return itself.

    `scale` (6,): share of the neighbours' spread along their rings; a constant; one over the cosine; share of the
    spread of rings; one with range (per 10 m); one of bright surfaces.
    """
    cosine = np.maximum(at.cos_incidence, _MIN_COSINE)
    slant = 1.0 / (cosine * cosine)
    tens = at.range_m / 10.0
    white = scale[0] * at.rough_m * at.rough_m * slant
    patch = scale[1] + (scale[2] + scale[3] * at.spread_m * at.spread_m) * slant + scale[4] * tens * tens
    return white, patch + scale[5] * (at.reflectance >= _BRIGHT)


def mixture(profile: NoiseProfile, model: Model, at: ReturnConditions) -> Mixture:
    """Residuals less what biases leave (`noise_patches.expected_residual`); of `constant` residuals as they are."""
    arrays, count = profile.arrays, len(at.ring)
    if model == "constant":
        mean, std = arrays["constant"][:2]
        return Mixture(np.ones((count, 1)), np.full((count, 1), mean), np.full((count, 1), std))
    white, patch = variances(arrays[f"{model}.scale"], at)
    scale = np.sqrt(white * (1.0 + at.white_gain) + patch * (1.0 + at.ring_gain))
    shape = arrays[f"{model}.shape"]
    bend = np.zeros((count, OUTPUTS)) if model == "parametric" else network_outputs(profile, at)
    return bent_mixture(scale, shape, bend)


OUTPUTS = 6  # of the network: scale, shift, logits of the second and third component and of elsewhere, tails' tilt


def network_outputs(profile: NoiseProfile, at: ReturnConditions) -> F64:
    """How the network bends the parametric form (n, 6)."""
    arrays = profile.arrays
    hidden = (return_features(at) - arrays["features.mean"]) / arrays["features.std"]
    for layer in (0, 1):
        hidden = soft_sign(sm.product(hidden, arrays[f"network.w{layer}"]) + arrays[f"network.b{layer}"])
    return np.clip(sm.product(hidden, arrays["network.w2"]) + arrays["network.b2"], -4.0, 4.0)


def soft_sign(x: F64) -> F64:
    """x / (1 + |x|): bends like a sigmoid, and rounds the same everywhere."""
    return np.asarray(x / (1.0 + np.abs(x)))


def bent_mixture(scale: F64, shape: F64, bend: F64) -> Mixture:
    """Components (n, K) from a scale (n,), a shape (K, 3) and what a network adds (n, 6)."""
    count, several = len(scale), len(shape)
    scale = np.maximum(scale * sm.exp(0.5 * bend[:, 0]), _MIN_STD_M)
    logit = np.tile(np.asarray(sm.log(np.maximum(shape[:, 0], 1e-12))), (count, 1))
    logit[:, 1] += bend[:, 2]
    logit[:, 2] += bend[:, 3]
    logit[:, CORE:] += bend[:, 4, None]
    weight = np.asarray(sm.exp(logit - logit.max(axis=1, keepdims=True)))
    weight /= weight.sum(axis=1, keepdims=True)
    mean, std = np.empty((count, several)), np.empty((count, several))
    mean[:, :CORE] = scale[:, None] * (shape[:CORE, 1] + bend[:, 1, None] * 0.25)
    mean[:, 1:CORE] += scale[:, None] * bend[:, 5, None] * 0.5
    std[:, :CORE] = scale[:, None] * shape[:CORE, 2]
    mean[:, CORE:], std[:, CORE:] = shape[CORE:, 1], shape[CORE:, 2]
    return Mixture(weight, mean, std)


def log_density(mix: Mixture, residual_m: F64) -> F64:
    """Log of the density (n,), nats, of residuals in metres."""
    z = (residual_m[:, None] - mix.mean_m) / mix.std_m
    parts = sm.log(np.maximum(mix.weight, 1e-300)) - 0.5 * z * z - sm.log(mix.std_m) - _LN_SQRT_2PI
    top = parts.max(axis=1)
    return np.asarray(top + sm.log(np.asarray(sm.exp(parts - top[:, None])).sum(axis=1)))


def cumulative(mix: Mixture, residual_m: F64) -> F64:
    """Chance (n,) of a residual below the one given."""
    return np.asarray((mix.weight * ndtr((residual_m[:, None] - mix.mean_m) / mix.std_m)).sum(axis=1))


def quantile(mix: Mixture, chance: float) -> F64:
    """Residual (n,) metres below which `chance` of the returns lie, to 0.01 mm."""
    low = (mix.mean_m - 40.0 * mix.std_m).min(axis=1)
    high = (mix.mean_m + 40.0 * mix.std_m).max(axis=1)
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = cumulative(mix, middle) < chance
        low, high = np.where(below, middle, low), np.where(below, high, middle)
        if float((high - low).max(initial=0.0)) < 1e-5:
            break
    return np.asarray(0.5 * (low + high))


def surface_conditions(
    profile: NoiseProfile, ring: U8, range_m: F64, cos_incidence: F64, reflectance: F64
) -> ReturnConditions:
    """Conditions of returns on a known, smooth, upright surface: a car's body."""
    count = len(ring)
    shot = np.interp(range_m, profile.arrays["shot_m"][:, 0], profile.arrays["shot_m"][:, 1])
    return ReturnConditions(
        ring=ring,
        range_m=range_m,
        cos_incidence=cos_incidence,
        reflectance=reflectance,
        slope=np.full(count, WALL, dtype=np.uint8),
        rough_m=shot * cos_incidence,
        spread_m=np.full(count, profile.arrays["surface"][1]),
        white_gain=np.zeros(count),
        ring_gain=np.zeros(count),
    )


def range_error(profile: NoiseProfile, at: ReturnConditions, white: F64, luck: F64, patch: F64) -> F64:
    """Range errors (K,) metres of returns from the surfaces that were judged, beside the beams' biases.

    Args:
        profile: learned noise; its shipped model is used.
        at: conditions, `surface_conditions` for known surfaces.
        white: (K,) standard normal, independent.
        luck: (K,) from 0 to 1, independent: which component of the mixture.
        patch: (K,) standard normal for the share that a beam keeps over a patch, correlated along the ring by
            `arrays["surface"][2]` a firing and independent between beams.
    """
    of_white, of_patch = variances(profile.arrays[f"{profile.shipped}.scale"], at)
    scale, spread = np.sqrt(of_white + of_patch), np.sqrt(of_white) * white + np.sqrt(of_patch) * patch
    part, which, offset, size = _components(profile, at, luck)
    return np.asarray(offset[which, part] * scale + size[which, part] * spread)


def shot_error(profile: NoiseProfile, range_m: F64, white: F64, luck: F64, rough_m: Any = 0.0) -> F64:
    """Range errors (K,) metres of a smooth body: one beam from shot to shot, as measured, with heavy tails.

    Bodies have relief of their own (`sensor_noise`), so what a beam keeps over a patch, and the size that goes with
    roughness of walls and ground, stay out; tails are the parametric model's, which are the same everywhere.

    Args:
        profile: learned noise.
        range_m: (K,) true ranges.
        white: (K,) standard normal, independent.
        luck: (K,) from 0 to 1, independent: which component of the mixture.
        rough_m: standard deviation (K,) of white noise that is added.
    """
    shape = profile.arrays["parametric.shape"][:CORE]
    size = shape[:, 2] * float((shape[:, 0] / shape[:, 2]).sum() / shape[:, 0].sum())  # so that its spread (MAD) is one
    bounds = shape[:, 0].cumsum()
    target = luck * bounds[-1]
    part = (target > bounds[0]).astype(np.intp) + (target > bounds[1])
    std = np.interp(range_m, profile.arrays["shot_m"][:, 0], profile.arrays["shot_m"][:, 1]) * size[part]
    return np.asarray(np.sqrt(std * std + rough_m * rough_m) * white)


def _components(
    profile: NoiseProfile, at: ReturnConditions, luck: F64
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], F64, F64]:
    """Component (K,) of each return, its class (K,), and by class offsets and sizes (C, 3) in units of the scale."""
    shape = profile.arrays[f"{profile.shipped}.shape"][:CORE]
    if profile.shipped == "parametric":
        first, which = np.zeros(1, dtype=np.intp), np.zeros(len(luck), dtype=np.intp)
        bend = np.zeros((1, OUTPUTS))
    else:
        first, which = _alike(at)
        bend = network_outputs(profile, take_conditions(at, first))
    logit = np.tile(np.asarray(sm.log(np.maximum(shape[:, 0], 1e-12))), (len(first), 1))
    logit[:, 1:] += bend[:, 2:4]
    edges = np.asarray(sm.exp(logit - logit.max(axis=1, keepdims=True))).cumsum(axis=1)
    target = luck * edges[which, 2]
    part = (target > edges[which, 0]).astype(np.intp) + (target > edges[which, 1])
    grown = np.asarray(sm.exp(0.5 * bend[:, 0]))[:, None]
    offset = shape[None, :, 1] + 0.25 * bend[:, 1, None] + 0.5 * bend[:, 5, None] * (np.arange(CORE) > 0)
    return part, which, grown * offset, grown * shape[None, :, 2]


def _alike(at: ReturnConditions) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """One row of each class of like conditions, and each row's (K,) class: the network need not see every ray."""
    shine = np.rint(5.0 * at.reflectance) + (at.reflectance >= 0.005) + (at.reflectance >= _BRIGHT)  # 0 to 7
    key = np.rint(at.range_m / 2.0) * 10.0 + np.rint(8.0 * at.cos_incidence)
    key = (key * 10.0 + shine) * 2.0 + (at.ring < 32)
    _, first, which = np.unique(key.astype(np.int64), return_index=True, return_inverse=True)
    return first, which


# ---------------------------------------------------------------------------------------------------------------------
# Isolated misses


def ray_features(at: RayConditions) -> F64:
    """What the models of misses see of rays (n, 30), not yet standardised."""
    cosine = np.clip(at.cos_incidence, 0.03, 1.0)
    range_m = np.clip(at.range_m, *_PATCH_RANGE_M)
    shine = np.clip(at.reflectance, 0.0, 1.0)
    ground, upper = (at.slope == GROUND).astype(np.float64), (at.ring < 32).astype(np.float64)
    far, slant, weak = sm.log(range_m / 10.0), sm.log(cosine), sm.log(shine + 0.02)
    columns = [far, slant, cosine, weak, shine, ground, upper, (at.slope == WALL).astype(np.float64)]
    columns += [np.maximum(range_m - knot, 0.0) / 10.0 for knot in (12.0, 20.0, 30.0, 40.0)]
    columns += [np.maximum(6.0 - range_m, 0.0) / 4.0, (shine < 0.005).astype(np.float64)]
    columns += [far * ground, far * upper, slant * ground, slant * upper, weak * ground, weak * upper]
    columns += [weak * far, slant * far, slant * slant, weak * weak]
    rough = sm.log(np.clip(at.rough_m, 1e-3, 0.1) / 0.01)
    own, beside = sm.log(at.lost_own + 0.01), sm.log(at.lost_beside + 0.01)
    columns += [rough, rough * ground, own, beside, own * own, own * rough]
    return np.stack(columns, axis=1)


def miss_chance(profile: NoiseProfile, model: Model, at: RayConditions) -> F64:
    """Chance (n,) that a ray which meets a smooth surface is lost alone, between neighbours that return."""
    arrays = profile.arrays
    if model == "constant":
        return np.full(len(at.ring), arrays["constant"][2])
    x = (ray_features(at) - arrays["drop.features.mean"]) / arrays["drop.features.std"]
    if model == "parametric":
        logit = sm.product(x, arrays["drop.parametric"][1:]) + arrays["drop.parametric"][0]
        logit = logit + arrays["drop.beam"][at.ring]
    else:
        hidden = soft_sign(sm.product(x, arrays["drop.network.w0"]) + arrays["drop.network.b0"])
        logit = sm.product(hidden, arrays["drop.network.w1"])[:, 0] + arrays["drop.network.b1"][0]
        logit = logit + arrays["drop.network.beam"][at.ring]
    return np.asarray(expit(np.clip(logit, -15.0, 5.0)))


def isolated_misses(
    profile: NoiseProfile, ring: U8, range_m: F64, cos_incidence: F64, reflectance: F64, luck: F64
) -> npt.NDArray[np.bool_]:
    """Which of the rays (K,) that meet a solid upright surface are lost alone; `luck` (K,) from 0 to 1."""
    lost = np.zeros(len(ring), dtype=bool)
    at = np.flatnonzero(luck < _MOST_MISSES)  # few can be lost: the others need no chance worked out
    cell = [
        np.searchsorted(knots[1:], value[at], side="right")
        for knots, value in zip(_BODY_KNOTS, (range_m, cos_incidence, reflectance), strict=True)
    ]
    lost[at] = luck[at] < profile.body_misses[ring[at], cell[0], cell[1], cell[2]]
    return lost


# ---------------------------------------------------------------------------------------------------------------------
# Edges


def edge_chance(profile: NoiseProfile, step_m: F64) -> tuple[F64, F64]:
    """Chance (K,) of a mixed point and of nothing at a boundary with a given range step; 0 at steps up to 1 m."""
    table = profile.arrays["edge"]
    row = np.clip(np.searchsorted(table[:, 0], step_m, side="right") - 1, 0, len(table) - 1)
    there = step_m >= table[0, 0]
    return np.where(there, table[row, 1], 0.0), np.where(there, table[row, 2], 0.0)


def mixed_range(profile: NoiseProfile, near_m: F64, far_m: F64, luck: F64) -> F64:
    """Ranges (K,) metres of mixed points between two sides, 0.25 m off both; `luck` (K,) from 0 to 1 says where."""
    quantiles = profile.arrays["edge.share"]
    step = far_m - near_m
    share = np.interp(luck, np.arange(len(quantiles)) / (len(quantiles) - 1.0), quantiles)
    return np.asarray(near_m + np.clip(share * step, MIXED_M, np.maximum(step - MIXED_M, MIXED_M)))


def take_conditions(at: ReturnConditions, rows: npt.NDArray[Any]) -> ReturnConditions:
    """Some rows of the conditions."""
    return ReturnConditions(**{f.name: getattr(at, f.name)[rows] for f in fields(at)})
