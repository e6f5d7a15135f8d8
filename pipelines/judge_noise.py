"""Raw scans and a learned noise profile in, how well the profile's models foretell them out.

Returns on smooth patches, bracketed rays and range steps (`augkitti.noise_patches`) of any raw scans, labelled or not,
are set against the three models of each kind (`augkitti.range_noise`). Clumps of misses need labelled vehicles.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import augkitti
from augkitti import kitti, noise_patches, range_noise
from augkitti.command_line import as_json, aside, counted, is_json, print_json
from augkitti.config import Config
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.kitti import KittiRoot
from augkitti.kitti import Sequence as Drive
from augkitti.labelled_views import clump_correlations, clump_sums, vehicle_views, view_rays
from augkitti.noise_patches import JudgedEdges, JudgedRays, JudgedReturns, JudgedShots
from augkitti.pair_motion import ego_twist
from augkitti.parametric_cars import parametric_cars
from augkitti.range_noise import MODELS, NoiseProfile, RayConditions, ReturnConditions
from augkitti.resimulate import resimulate
from augkitti.scanner import ScannerProfile, assign_rays, load_profile

MOST_SCANS = 100  # 70 MB each while they are judged; more tell the same
MIN_EXPECTED = 50  # drops: below, a class says nothing
CLASS_KEYS = ("drop.class_lowest", "drop.class_highest", "drop.classes", "drop.classes_within")
_SHARE = 0.5  # of the returns that are judged: half of them tell the same
_CLASS_RATIO = (0.6, 1.7)  # foretold to seen drops of a class that is well foretold
_CHUNK = 100_000
_RANGES_M = (0.0, 8.0, 12.0, 20.0, 30.0, 45.0, np.inf)
_SHINES = (0.0, 0.005, 0.1, 0.2, 0.3, 0.4, 0.5, np.inf)
_COSINES = (0.0, 0.15, 0.3, 0.5, 0.75, np.inf)

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Judged:
    """What several scans have to say."""

    scans: tuple[tuple[str, str, int], ...]  # (recording, sequence, frame) by number
    tried: int
    returns: JudgedReturns
    rays: JudgedRays
    edges: JudgedEdges
    shots: JudgedShots

    @property
    def share_kept(self) -> float:
        """Share of the tried returns that lie on smooth patches."""
        return len(self.returns.ring) / max(self.tried, 1)

    @property
    def recording(self) -> npt.NDArray[np.str_]:
        """Name of each scan's recording."""
        return np.array([name for name, _, _ in self.scans])

    def of(self, chosen: Sequence[int] | npt.NDArray[Any]) -> "Judged":
        """Some of the scans; `tried` in proportion."""
        keep = np.zeros(len(self.scans), dtype=bool)
        keep[np.asarray(chosen)] = True
        return replace(
            self,
            tried=round(self.tried * keep.mean()),
            returns=noise_patches.take(self.returns, keep[self.returns.scan]),
            rays=noise_patches.take(self.rays, keep[self.rays.scan]),
            edges=noise_patches.take(self.edges, keep[self.edges.scan]),
            shots=noise_patches.take(self.shots, keep[self.shots.scan]),
        )


def raw_scans(root: KittiRoot, layouts: tuple[str, ...] = ("raw", "object")) -> list[tuple[Drive, int]]:
    """The scans that noise can be learned from.

    Raises:
        InputError: there is none.
    """
    scans = [(s, f) for s in root.sequences if s.kind == "raw" and s.layout in layouts for f in s.frames]
    if not scans:
        others = sum(len(s.frames) for s in root.sequences if s.kind == "compensated")
        if others:
            raise InputError(
                root.path,
                f"all of its {others} scans are compensated: their points were moved off the scanner's rays",
                "give raw drives (`raw/DATE/DRIVE_sync`); nothing can be fitted for a raw profile from these",
            )
        raise InputError(root.path, "no raw scans in it", "give raw drives (`raw/DATE/DRIVE_sync`)")
    return scans


def most_scans(scans: list[tuple[Drive, int]]) -> list[tuple[Drive, int]]:
    """At most `MOST_SCANS` of the scans, evenly spread."""
    if len(scans) <= MOST_SCANS:
        return scans
    return [scans[i] for i in np.linspace(0, len(scans) - 1, MOST_SCANS).astype(int)]


def left_out(root: KittiRoot) -> str | None:
    """A line on a root's compensated scans, which are never mixed with its raw ones; None if it has none."""
    others = sum(len(s.frames) for s in root.sequences if s.kind == "compensated")
    return f"{others} compensated scans are left out: their points were moved off the rays" if others else None


def twist_of(drive: Drive, frame: int) -> F64 | None:
    """The scanner's twist (6,) per second during a scan from the drive's own files; None where they do not tell."""
    if drive.layout != "raw":
        return None
    first = frame if frame + 1 in drive.frames else frame - 1
    if first not in drive.frames:
        return None
    motion = kitti.known_ego_motion(drive, first)
    if motion is None:
        return None
    interval = kitti.scan_time(drive, first + 1)[0] - kitti.scan_time(drive, first)[0]
    return ego_twist(motion.T_velo1_velo0, interval)


def judge_scans(
    scans: Sequence[tuple[Drive, int]], scanner: ScannerProfile, share: float = _SHARE, seed: int = 0
) -> Judged:
    """Patches, bracketed rays and edges of scans, all chosen without what is judged."""
    rng = np.random.default_rng(seed)
    parts, tried = [], 0
    for number, (drive, frame) in enumerate(counted(scans, len(scans), "scans")):
        scan = kitti.read_scan(drive, frame, scanner.elevation_rad)
        noise_patches.check_raw(scan, f"{drive.name}, frame {frame}")
        rays = assign_rays(scan, scanner)
        returns, count = noise_patches.judge_returns(
            scan, rays, scanner, number, twist_of(drive, frame), share=share, rng=rng
        )
        tried += count
        parts.append(
            (
                returns,
                noise_patches.judge_rays(scan, rays, scanner, number),
                noise_patches.judge_edges(scan, rays, scanner, number),
                noise_patches.judge_shots(scan, rays, scanner, number),
            )
        )
    return Judged(
        tuple((drive.recording if drive.layout == "raw" else drive.name, drive.name, frame) for drive, frame in scans),
        tried,
        noise_patches.concatenate(part[0] for part in parts),
        noise_patches.concatenate(part[1] for part in parts),
        noise_patches.concatenate(part[2] for part in parts),
        noise_patches.concatenate(part[3] for part in parts),
    )


def return_conditions(returns: JudgedReturns, bias_m: F64) -> ReturnConditions:
    """Conditions of judged returns, given the biases."""
    return ReturnConditions(
        ring=returns.ring,
        range_m=returns.range_m,
        cos_incidence=returns.cos_incidence,
        reflectance=returns.reflectance,
        slope=returns.slope,
        rough_m=returns.rough_m,
        spread_m=noise_patches.ring_spread(returns, bias_m),
        white_gain=returns.white_gain,
        ring_gain=(returns.ring_weight**2).sum(axis=1),
    )


def ray_conditions(rays: JudgedRays) -> RayConditions:
    """Conditions of judged rays."""
    return RayConditions(
        *(rays.ring, rays.range_m, rays.cos_incidence, rays.reflectance, rays.slope),
        *(rays.rough_m, rays.lost_own, rays.lost_beside),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Figures


def figures_of(profile: NoiseProfile, judged: Judged) -> dict[str, float]:
    """Figures of all models on judged scans, by flat keys; nats a return, shares, counts of isolated drops."""
    raw = judged.returns.residual_m
    at = return_conditions(judged.returns, profile.bias_m)
    left = raw - noise_patches.expected_residual(judged.returns, profile.bias_m)
    out = {"share_kept": judged.share_kept, "returns": float(len(raw)), "nll.constant_tails": _fair_nll(profile, raw)}
    nll: dict[str, list[F64]] = {name: [] for name in MODELS}
    chance: dict[str, list[F64]] = {name: [] for name in MODELS}
    for start in range(0, len(raw), _CHUNK):
        rows = np.arange(start, min(start + _CHUNK, len(raw)))
        some = range_noise.take_conditions(at, rows)
        for name in MODELS:
            mix = range_noise.mixture(profile, name, some)
            y = raw[rows] if name == "constant" else left[rows]
            nll[name].append(-range_noise.log_density(mix, y))
            chance[name].append(range_noise.cumulative(mix, y))
    for name in MODELS:
        off_middle = np.abs(np.concatenate(chance[name]) - 0.5)
        out[f"nll.{name}"] = float(np.concatenate(nll[name]).mean())
        out[f"coverage68.{name}"] = float((off_middle < 0.34).mean())
        out[f"coverage95.{name}"] = float((off_middle < 0.475).mean())
    out["nll.shipped"] = out[f"nll.{profile.shipped}"]
    out["coverage68"], out["coverage95"] = (out[f"{key}.{profile.shipped}"] for key in ("coverage68", "coverage95"))

    missed, rays = ~judged.rays.returned, ray_conditions(judged.rays)
    out["rays"], out["drop.observed"] = float(len(missed)), float(missed.sum())
    for name in MODELS:
        lost = range_noise.miss_chance(profile, name, rays)
        out[f"drop.logloss.{name}"] = float(-np.where(missed, np.log(lost), np.log1p(-lost)).mean())
        out[f"drop.predicted.{name}"] = float(lost.sum())
        ratios = [expected / max(seen, 1) for _, expected, seen in drop_classes(lost, missed, rays)]
        within = sum(_CLASS_RATIO[0] <= ratio <= _CLASS_RATIO[1] for ratio in ratios)
        summary = (min(ratios, default=1.0), max(ratios, default=1.0), float(len(ratios)), float(within))
        out |= {f"{key}.{name}": value for key, value in zip(CLASS_KEYS, summary, strict=True)}
    out |= {key: out[f"{key}.{profile.shipped_drop}"] for key in ("drop.predicted", *CLASS_KEYS)}
    outcome, several = judged.edges.outcome, max(len(judged.edges.outcome), 1)
    mixed, nothing = range_noise.edge_chance(profile, judged.edges.far_m - judged.edges.near_m)
    out["edge.mixed_predicted"], out["edge.nothing_predicted"] = (float(p.sum()) / several for p in (mixed, nothing))
    out["edge.mixed_observed"] = float((outcome == noise_patches.MIXED_BETWEEN).sum()) / several
    out["edge.nothing_observed"] = float((outcome == noise_patches.NOTHING).sum()) / several
    return out


def _fair_nll(profile: NoiseProfile, raw: F64) -> float:
    """Of a constant that has components elsewhere, so that far outliers do not decide."""
    core = profile.arrays["constant_core"]
    tails = core[2:].reshape(-1, 3)
    one = np.ones((len(raw), 1))
    weight = np.concatenate([[1.0 - tails[:, 0].sum()], tails[:, 0]])
    mean, std = np.concatenate([core[:1], tails[:, 1]]), np.concatenate([core[1:2], tails[:, 2]])
    return float(-range_noise.log_density(range_noise.Mixture(one * weight, one * mean, one * std), raw).mean())


def drop_classes(
    lost: F64, missed: npt.NDArray[np.bool_], at: RayConditions, least: float = MIN_EXPECTED
) -> list[tuple[str, float, int]]:
    """Name, expected and observed drops of classes of range, incidence, reflectance, slope and beam that expect 50."""
    found = []
    for key, values, edges in (
        ("range", at.range_m, _RANGES_M),
        ("reflectance", at.reflectance, _SHINES),
        ("cosine", at.cos_incidence, _COSINES),
        ("beam", at.ring.astype(np.float64), tuple(float(b) for b in range(0, 257, 8))),
        ("slope", at.slope.astype(np.float64), (0.0, 1.0, 2.0)),
    ):
        which = np.searchsorted(np.asarray(edges), values, side="right") - 1
        expected = np.bincount(which, lost, len(edges))
        seen = np.bincount(which, missed, len(edges))
        found += [(f"{key} from {edges[i]:g}", float(expected[i]), int(seen[i])) for i in range(len(edges))]
    return [row for row in found if row[1] >= least]


def clump_figures(root: KittiRoot, scanner: ScannerProfile, seed: int = 0, draws: int = 2) -> dict[str, float | None]:
    """Correlation of "returned" on bodies to the next firing (also four on, next beam), real and simulated.

    Of labelled vehicles that nothing covers, and of parametric cars in their place; None where there are too few.
    """
    keys = ("", "_four_on", "_next_beam")
    models, rng = parametric_cars(), np.random.default_rng(seed)
    real, simulated, tracks = [], [], set()
    for view in vehicle_views(root, scanner):
        tracks.add(view.track)
        real.append(clump_sums(view_rays(view, scanner)))
        for _ in range(draws):
            measured = resimulate(view, models, scanner, Config(), rng).range_m
            simulated.append(clump_sums(view_rays(view, scanner, measured)))
    if len(tracks) < 2:
        return {f"drop.clump_{side}{key}": None for side in ("predicted", "observed") for key in keys}
    out: dict[str, float | None] = {}
    for side, sums in (("predicted", simulated), ("observed", real)):
        for key, value in zip(keys, clump_correlations(sums), strict=True):
            out[f"drop.clump_{side}{key}"] = float(value) if np.isfinite(value) else None
    return out


# ---------------------------------------------------------------------------------------------------------------------
# The command


def judge_noise(root: Path, profile: Path | None = None, out: Path | None = None, say: Say = print) -> dict[str, Any]:
    """Figures of a profile (the shipped one by default) on a root's raw scans, as a table and as JSON.

    Raises:
        InputError: no raw scans, a damaged scan, or no such profile.
    """
    opened = kitti.open_root(root)
    scans = most_scans(raw_scans(opened))
    scanner, noise = profile_of(profile)
    if (others := left_out(opened)) is not None:
        (aside if is_json() else say)(others)
    judged = judge_scans(scans, scanner)
    if not len(judged.returns.ring) or not len(judged.rays.ring):
        raise InputError(
            root, "no smooth patches in its scans", "nothing can be judged from these: give scans of streets"
        )
    figures: dict[str, Any] = {"program_version": augkitti.__version__}
    figures |= {**figures_of(noise, judged), **clump_figures(opened, scanner)}
    figures |= {"scans": len(scans), "profile": noise.name}
    figures |= {"shipped": noise.shipped, "shipped_drop": noise.shipped_drop}
    if is_json():
        print_json(figures)
    else:
        for line in table(figures):
            say(line)
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(as_json(figures), encoding="utf-8")
    return figures


def profile_of(folder: Path | None) -> tuple[ScannerProfile, NoiseProfile]:
    """The scanner and noise of a profile's folder, or the shipped ones.

    Raises:
        InputError: a file of it is missing or damaged.
    """
    if folder is None:
        return load_profile(), range_noise.load_noise()
    if not folder.is_dir():
        raise InputError(folder, "no folder with profile.json and noise.npz", "run `augkitti fit-noise` first")
    return load_profile(folder / "profile.json"), range_noise.load_noise(folder)


def table(figures: dict[str, Any]) -> list[str]:
    """Figures as lines to print."""
    lines = [
        f"{figures['returns']:,.0f} returns on smooth patches, {100 * figures['share_kept']:.1f} % of those tried",
        "                 nats/return    68 %    95 %   log-loss of drops   drops foretold",
    ]
    rows = [(name, name, name) for name in MODELS] + [("shipped", figures["shipped"], figures["shipped_drop"])]
    for title, name, drop in rows:
        lines.append(
            f"{title:<16} {figures[f'nll.{name}']:11.3f} {figures[f'coverage68.{name}']:7.3f} "
            f"{figures[f'coverage95.{name}']:7.3f} {figures[f'drop.logloss.{drop}']:19.6f} "
            f"{figures[f'drop.predicted.{drop}']:16.0f}"
        )
    lines.append(f"shipped: {figures['shipped']} range, {figures['shipped_drop']} drops")
    lines.append(f"constant with tails {figures['nll.constant_tails']:8.3f}")
    lines.append(
        f"{figures['drop.classes_within']:.0f} of {figures['drop.classes']:.0f} classes foretold within 0.6 to 1.7 "
        "of what is seen"
    )
    lines.append(
        f"drops seen: {figures['drop.observed']:.0f} of {figures['rays']:.0f} bracketed rays; foretold to seen "
        f"by class: {figures['drop.class_lowest']:.2f} to {figures['drop.class_highest']:.2f}"
    )
    lines.append(
        f"range steps: mixed {figures['edge.mixed_observed']:.3f} (foretold {figures['edge.mixed_predicted']:.3f}), "
        f"nothing {figures['edge.nothing_observed']:.3f} ({figures['edge.nothing_predicted']:.3f})"
    )
    if figures.get("drop.clump_observed") is not None:
        pairs = (
            f"{figures[f'drop.clump_observed{key}']:.2f} ({figures[f'drop.clump_predicted{key}']:.2f})"
            for key in ("", "_four_on", "_next_beam")
        )
        lines.append("clumps on bodies, next firing, four on, next beam, real (simulated): " + ", ".join(pairs))
    elif "drop.clump_observed" in figures:
        lines.append("clumps: too few labelled vehicles to tell")
    return lines
