"""Raw KITTI drives in, a learned noise profile out: patches, biases, three models of each kind, judged drive by drive.

torch is needed here alone, and imported inside the functions that fit. What they find is plain arrays
(`augkitti.range_noise`), which numpy evaluates. A profile is a folder: `profile.json` (beam table, biases, all that
simulation needs), `noise.npz` (all models, for `augkitti judge-noise`) and `noise.md` (the card; `README.md` beside it
is the scanner's own, of `augkitti fit-sensor`).
"""

import importlib.util
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from augkitti import kitti, noise_patches, range_noise
from augkitti.command_line import counted, note
from augkitti.errors import InputError
from augkitti.frames import F64
from augkitti.kitti import KittiRoot
from augkitti.labelled_views import vehicle_views
from augkitti.noise_patches import MIXED_BETWEEN, NOTHING, JudgedEdges, JudgedReturns, JudgedShots
from augkitti.range_noise import CORE, OUTPUTS, Model, NoiseProfile, RayConditions, ReturnConditions
from augkitti.resimulate import own_returns
from augkitti.scan_pair import CarModel
from augkitti.scanner import ScannerProfile, load_profile
from pipelines.judge_noise import (
    CLASS_KEYS,
    Judged,
    Say,
    figures_of,
    judge_scans,
    left_out,
    most_scans,
    raw_scans,
    ray_conditions,
    return_conditions,
)

MIN_RETURNS = 20_000  # of smooth patches: below, biases of the outer beams are not known
MIN_SCANS = 4
MIN_EDGES = 200  # boundaries of labelled vehicles
MOST_FOLDS = 6
_BLOCK_BEAMS = 32  # lasers that share an optical block; a trend over them is a wall's tilt as well
_SHOT_RANGES_M = (2.0, 5.0, 8.0, 12.0, 18.0, 25.0, 40.0, 80.0)
_EDGE_STEPS_M = (1.0, 2.0, 4.0, 8.0, 16.0)
_HIDDEN = 24
_BATCH = 4096
_ELSEWHERE = ((0.004, 0.0, 0.15), (0.002, 0.0, 0.7), (0.001, 0.0, 4.0))  # weight, mean, spread to start from
_CORE_START = ((0.75, 0.0, 0.8), (0.2, 0.0, 1.6), (0.05, 0.0, 4.0))
_BEAM_SPREAD = 0.4  # of the beams' logits of a miss about the rest, as a prior

# ---------------------------------------------------------------------------------------------------------------------
# The command


def fit_noise(
    root: Path,
    folder: Path,
    models: Path | None = None,
    compare: bool = True,
    vehicles: bool = True,
    steps: int = 1500,
    seed: int = 0,
    say: Say = note,
) -> NoiseProfile:
    """Learn a scanner's noise from a root's raw scans and write it to a profile's folder.

    Args:
        root: KITTI on disk; drives and object scans, labelled or not.
        folder: written; its `profile.json`, if any (`augkitti fit-sensor`), is the scanner, else the shipped one is.
        models: folder of car models to stand in for labelled vehicles, beside the parametric ones.
        compare: leave one drive out after the other, and blocks of frames; the better model ships. Without, one drive
            is enough, nothing says how good the models are, and the parametric ones ship.
        vehicles: learn what labelled vehicles return, too.
        steps: of the optimiser; the network takes twice as many.
        seed: of which returns are judged.
        say: what to do with messages.

    Raises:
        InputError: no raw scans, too few of them, or one drive only where models are to be compared.
    """
    _needs_torch()
    opened = kitti.open_root(root)
    scans = raw_scans(opened)
    scanner = load_profile(folder / "profile.json") if (folder / "profile.json").is_file() else load_profile()
    drives = {drive.recording for drive, _ in scans}
    if len(scans) < MIN_SCANS:
        raise InputError(
            root,
            f"{len(scans)} raw scans; noise needs {MIN_SCANS}",
            "give more; from these the beam table can still be fitted (`augkitti fit-sensor`), with the shipped noise",
        )
    if compare and len(drives) < 2:
        raise InputError(
            root,
            "one drive only: no model can be judged on scans that it was not fitted on",
            "give a second drive; `--no-compare` still fits the parametric models and the biases, unjudged",
        )
    scans = most_scans(scans)
    say(f"{len(scans)} raw scans of {len(drives)} recordings; scanner: {scanner.name}")
    if (others := left_out(opened)) is not None:
        say(others)
    judged = judge_scans(scans, scanner, seed=seed)
    say(f"{len(judged.returns.ring):,} returns on smooth patches: {100 * judged.share_kept:.1f} % of those tried")
    if len(judged.returns.ring) < MIN_RETURNS:
        raise InputError(
            root,
            f"{len(judged.returns.ring):,} returns on smooth patches; {MIN_RETURNS:,} are needed",
            "give more scans, of streets; the beam table can still be fitted (`augkitti fit-sensor`)",
        )
    facts: dict[str, Any] = {
        "scans": {name: int((judged.recording == name).sum()) for name in sorted(set(judged.recording))},
        "returns": len(judged.returns.ring),
        "rays": len(judged.rays.ring),
        "share_kept": round(judged.share_kept, 4),
    }
    shipped: tuple[Model, Model] = ("parametric", "parametric")
    if compare:
        facts["folds"] = compare_models(judged, scanner, steps, say)
        facts["blocks"] = _short(judge_blocks(judged, scanner, steps))
        shipped = better_models(list(facts["folds"].values()))
        facts["folds"] = {name: as_shipped(figures, *shipped) for name, figures in facts["folds"].items()}
        facts["blocks"] = as_shipped(facts["blocks"], *shipped)
        inside = [facts["blocks"][key] for key in ("coverage68", "coverage95")]
        say(f"held-out blocks of frames: {inside[0]} in the 68 % interval, {inside[1]} in that of 95 %")
    profile = fit_profile(judged, scanner, f"{scanner.name}_noise", shipped, steps, facts)
    say(f"shipped: {profile.shipped} range, {profile.shipped_drop} drops")
    of_cars = vehicle_edges(opened, scanner) if vehicles else None
    if vehicles and of_cars is None:
        say(f"fewer than {MIN_EDGES} silhouettes of labelled vehicles: mixed points as at all range steps")
    if of_cars is not None:
        profile = replace(profile, arrays={**profile.arrays, "edge.car": of_cars})
    write_profile(folder, profile, scanner)
    if vehicles:
        from pipelines.fit_vehicles import fit_vehicles

        content = json.loads((folder / "profile.json").read_text(encoding="utf-8"))
        content["noise"] |= fit_vehicles(opened, content, _car_models(models), say=say)
        _write_json(folder / "profile.json", content)
    say(f"written: {folder}")
    return profile


def write_profile(folder: Path, profile: NoiseProfile, scanner: ScannerProfile) -> None:
    """`profile.json`, `noise.npz` and the card `noise.md`; vehicle keys stay, or are the shipped ones."""
    folder.mkdir(parents=True, exist_ok=True)
    base = {**load_profile().content["noise"], **scanner.content.get("noise", {})}
    shot = float(np.median(profile.arrays["shot_m"][:, 1]))
    lost = float(profile.arrays["constant"][2])
    solid = range_noise.solid_part(profile)
    noise = {**base, "shot_std_m": round(shot, 5), "isolated_drop": round(lost, 6), "solid": solid}
    content = {**scanner.content, "noise": noise}
    content["range_bias_mm"] = [round(1e3 * float(bias), 2) for bias in profile.bias_m]
    _write_json(folder / "profile.json", content)
    range_noise.save_noise(profile, folder / "noise.npz")
    (folder / "noise.md").write_text(card(profile), encoding="utf-8")


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=1, sort_keys=False) + "\n", encoding="utf-8")


def _needs_torch() -> None:
    if importlib.util.find_spec("torch") is None:
        raise InputError(
            "torch", "not installed, and the network is fitted with it", "run `pip install 'augkitti[fit]'`"
        )


def _car_models(folder: Path | None) -> Sequence[CarModel]:
    if folder is None:
        return ()
    from augkitti.cad_models import load_cad_folder
    from pipelines.cache import cache_folder

    models = load_cad_folder(folder, cache_dir=cache_folder() / "cad").models
    return [model for model in models if model.category in ("Car", "Van")]


def compare_models(judged: Judged, scanner: ScannerProfile, steps: int, say: Say = note) -> dict[str, dict[str, Any]]:
    """Figures on each recording (or group of them) of profiles fitted on the others, biases included.

    Object scans are fitted on but are no fold: each is of another drive.
    """
    names = sorted({name for (name, drive, _) in judged.scans if name != drive}) or sorted(set(judged.recording))
    groups = [names[i::MOST_FOLDS] for i in range(min(MOST_FOLDS, len(names)))]
    folds = {}
    for group in counted(groups, len(groups), "folds"):
        held = np.isin(judged.recording, group)
        rest, unseen = judged.of(np.flatnonzero(~held)), judged.of(np.flatnonzero(held))
        if not len(unseen.returns.ring) or len(rest.returns.ring) < MIN_RETURNS // 2:
            continue
        profile = fit_profile(rest, scanner, "fold", ("parametric", "parametric"), steps, {})
        figures = folds["+".join(group)] = _short(figures_of(profile, unseen))
        nll, loss = ([figures[f"{key}.{m}"] for m in range_noise.MODELS] for key in ("nll", "drop.logloss"))
        say(
            f"without {'+'.join(group)}: nats a return {nll[0]} constant, {nll[1]} parametric, {nll[2]} network; "
            f"log-loss of drops {loss[0]}, {loss[1]}, {loss[2]}"
        )
    return folds


def judge_blocks(judged: Judged, scanner: ScannerProfile, steps: int) -> dict[str, Any]:
    """Figures on the middle quarter of each recording's scans of a profile fitted on the rest."""
    held: list[int] = []
    for name in set(judged.recording):
        its = np.flatnonzero(judged.recording == name)
        if len(its) >= 4:
            first = (len(its) - len(its) // 4) // 2
            held.extend(its[first : first + len(its) // 4].tolist())
    rest = np.setdiff1d(np.arange(len(judged.scans)), held)
    if not held:  # every recording is short: the last scan of all
        held, rest = [len(judged.scans) - 1], np.arange(len(judged.scans) - 1)
    profile = fit_profile(judged.of(rest), scanner, "block", ("parametric", "parametric"), steps, {})
    return figures_of(profile, judged.of(held))


def better_models(folds: Sequence[dict[str, Any]]) -> tuple[Model, Model]:
    """Of the parametric form and the network: the one that foretells unseen drives better; of ranges, and of drops."""
    choice: list[Model] = []
    for key in ("nll", "drop.logloss"):
        parametric, network = (np.mean([fold[f"{key}.{model}"] for fold in folds]) for model in range_noise.MODELS[1:])
        choice.append("network" if network < parametric else "parametric")
    return choice[0], choice[1]


def as_shipped(figures: dict[str, Any], shipped: Model, shipped_drop: Model) -> dict[str, Any]:
    """Figures of a fold, those of the shipped models those of the models that ship after all."""
    of_range = {key: figures[f"{key}.{shipped}"] for key in ("coverage68", "coverage95")}
    of_drops = {key: figures[f"{key}.{shipped_drop}"] for key in ("drop.predicted", *CLASS_KEYS)}
    return {**figures, **of_range, **of_drops, "nll.shipped": figures[f"nll.{shipped}"]}


def _short(figures: dict[str, float]) -> dict[str, Any]:
    return {key: float(f"{value:.5g}") for key, value in figures.items()}


def card(profile: NoiseProfile) -> str:
    """The readable card of a profile, Markdown."""
    facts, arrays = profile.facts, profile.arrays
    scale, shape = arrays["parametric.scale"], arrays["parametric.shape"]
    lines = [
        f"# Noise profile {profile.name}",
        "",
        f"Ranges: {profile.shipped} model; isolated drops: {profile.shipped_drop} model. Raw scans only: compensated",
        "ones tell nothing of this. Written by `augkitti fit-noise`; judged on other scans by `augkitti judge-noise`.",
        "",
        "## Fitted on",
        "",
        f"{facts.get('returns', 0):,} returns on smooth patches ({100 * facts.get('share_kept', 0.0):.1f} % of those"
        f" tried), {facts.get('rays', 0):,} bracketed rays, of these scans:",
        "",
        *(f"- {name}: {count}" for name, count in facts.get("scans", {}).items()),
        "",
        "## Figures",
        "",
    ]
    folds = {**{f"without {name}": fold for name, fold in facts.get("folds", {}).items()}}
    if facts.get("blocks"):
        folds["blocks of frames left out"] = facts["blocks"]
    if folds:
        lines += [
            "Nats a return (a: one normal; a': one normal and far components; b: parametric; c: network); what the",
            "68 % and 95 % intervals of the shipped model hold; log-loss of isolated drops; foretold to seen drops,",
            "lowest and highest class with 50 expected, and how many of them lie within 0.6 to 1.7.",
            "",
            "| | a | a' | b | c | 68 % | 95 % | loss a | b | c | drops: foretold / seen | classes |",
            "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
        ]
        for name, f in folds.items():
            nll = " | ".join(f"{f[f'nll.{m}']:.3f}" for m in ("constant", "constant_tails", "parametric", "network"))
            loss = " | ".join(f"{f[f'drop.logloss.{m}']:.5f}" for m in range_noise.MODELS)
            inside = " | ".join(f"{f[key]:.3f}" for key in ("coverage68", "coverage95"))
            lines.append(
                f"| {name} | {nll} | {inside} | {loss} | {f['drop.predicted']:.0f} / "
                f"{f['drop.observed']:.0f} | {f['drop.class_lowest']:.2f} - {f['drop.class_highest']:.2f}, "
                f"{f['drop.classes_within']:.0f} of {f['drop.classes']:.0f} |"
            )
    else:
        lines.append("None: fitted without comparing (`--no-compare`).")
    shot = ", ".join(f"{1e3 * std:.1f} at {at:.0f} m" for at, std in arrays["shot_m"])
    mixed, lost = arrays["edge"][:, 1], arrays["edge"][:, 2]
    lines += [
        "",
        "## What it says",
        "",
        f"- One beam from shot to shot, mm: {shot}.",
        f"- Biases of beams: standard deviation {1e3 * arrays['bias_m'].std():.1f} mm, at most "
        f"{1e3 * np.abs(arrays['bias_m']).max():.0f} mm, trends over blocks of {_BLOCK_BEAMS} beams taken out.",
        f"- Parametric: white variance = {scale[0]:.3f} x (spread along rings / cosine of incidence)^2; a beam's",
        f"  share over a patch = {scale[1]:.2g} + ({scale[2]:.2g} + {scale[3]:.3f} x spread of rings^2) / cosine^2",
        f"  + {scale[4]:.2g} x (range / 10 m)^2 + {scale[5]:.2g} where bright (m^2).",
        "- Tails: "
        + ", ".join(f"{w:.3f} of {k:.2f} times the scale" for w, _, k in shape[:CORE])
        + "; elsewhere: "
        + ", ".join(f"{w:.4f} with {s:.2f} m" for w, _, s in shape[CORE:])
        + ".",
        f"- Isolated drops: {100 * arrays['constant'][2]:.3f} % of bracketed rays.",
        "- Range steps from "
        + ", ".join(
            f"{step:g} m: mixed {a:.3f}, nothing {b:.3f}"
            for step, a, b in zip(arrays["edge"][:, 0], mixed, lost, strict=True)
        )
        + ".",
        "- Where a vehicle stands before something: mixed {:.3f}, nothing {:.3f}.".format(*arrays["edge.car"]),
        "",
        "## What it cannot know",
        "",
        "- A bias common to all beams, nor a slow trend over beams: a plane fitted to neighbouring beams has it too.",
        "- Bias that changes with range or incidence stays in the spread. So does the relief of surfaces: the scale",
        "  follows what the neighbours show of it.",
        "- Drops are those between neighbours that return. Clumps (dark paint, glass) need labelled vehicles.",
        "- Tails come with whatever stands before the surface: leaves, wires, rain.",
        "",
    ]
    return "\n".join(lines)


# ---------------------------------------------------------------------------------------------------------------------
# Biases


def fit_biases(returns: JudgedReturns, beams: int, rounds: int = 8) -> F64:
    """Bias (beams,) metres of each beam from the residuals: least squares whose weights fall with the distance.

    A common offset and slow trends over beams leave hardly a residual, and are taken out.
    """
    ring = returns.ring.astype(np.int64)
    neighbours = np.clip(ring[:, None] + np.array(noise_patches.RING_OFFSETS), 0, beams - 1)
    column = np.concatenate([ring[:, None], neighbours], axis=1)  # (n, 7) beams that a residual depends on
    value = np.concatenate([np.ones((len(ring), 1)), -returns.ring_weight], axis=1)
    y, slant = returns.residual_m, 1.0 / returns.cos_incidence
    bias = np.zeros(beams)
    for _ in range(rounds):
        left = y - (value * bias[column]).sum(axis=1)
        spread = noise_patches.ring_spread(returns, bias)
        std = np.sqrt(0.008**2 + (0.5 * returns.rough_m * slant) ** 2 + (0.006**2 + spread**2) * slant**2 * 0.7)
        weight = 1.0 / (std**2 * (1.0 + (left / std) ** 2 / 4.0))
        normal, right = np.zeros((beams, beams)), np.zeros(beams)
        for i in range(7):
            weighted = weight * value[:, i]
            right += np.bincount(column[:, i], weighted * y, beams)
            for j in range(7):
                at = column[:, i] * beams + column[:, j]
                normal += np.bincount(at, weighted * value[:, j], beams * beams).reshape(beams, beams)
        bias = np.linalg.solve(normal + 1e-4 * np.trace(normal) / beams * np.eye(beams), right)
    return without_trends(bias)


def without_trends(bias_m: F64) -> F64:
    """Biases less a cubic over each block of 32 beams: planes cannot tell it from tilt and bend."""
    out, blocks = bias_m.copy(), max(1, round(len(bias_m) / _BLOCK_BEAMS))
    for rows in np.array_split(np.arange(len(bias_m)), blocks):
        place = np.linspace(-1.0, 1.0, len(rows))
        out[rows] -= np.polyval(np.polyfit(place, bias_m[rows], min(3, len(rows) - 1)), place)
    return out


# ---------------------------------------------------------------------------------------------------------------------
# One profile


def fit_profile(
    judged: Judged,
    scanner: ScannerProfile,
    name: str,
    shipped: tuple[Model, Model],
    steps: int = 1500,
    facts: dict[str, Any] | None = None,
) -> NoiseProfile:
    """All three models of each kind from judged scans; `shipped`: which of them to use, of ranges and of drops."""
    bias = fit_biases(judged.returns, scanner.beams)
    at = return_conditions(judged.returns, bias)
    raw = judged.returns.residual_m
    residual = raw - noise_patches.expected_residual(judged.returns, bias)
    arrays: dict[str, F64] = {"bias_m": bias}
    missed = 1.0 - float(judged.rays.returned.mean())
    arrays["constant"] = np.array([raw.mean(), raw.std(), np.clip(missed, 1e-6, 0.5)])
    arrays |= _fit_mixtures(at, raw, residual, steps)
    arrays |= _fit_misses(ray_conditions(judged.rays), ~judged.rays.returned, scanner.beams, steps)
    arrays["shot_m"] = shot_table(judged.shots)
    arrays["edge"], arrays["edge.share"] = edge_tables(judged.edges)
    arrays["edge.car"] = _edge_shares(judged.edges)
    arrays["surface"] = surface_figures(judged.returns, at, residual, scanner)
    about = {"kind": "raw", "scanner": scanner.name, **(facts or {})}
    return NoiseProfile(name, shipped[0], shipped[1], about, arrays)


def _fit_mixtures(at: ReturnConditions, raw: F64, residual: F64, steps: int) -> dict[str, F64]:
    """Arrays of the three models of a return's range."""
    import torch

    torch.manual_seed(0)
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    features = range_noise.return_features(at)
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    slant = 1.0 / np.maximum(at.cos_incidence, range_noise._MIN_COSINE) ** 2
    bright = at.reflectance >= range_noise._BRIGHT
    tens = (at.range_m / 10.0) ** 2
    white, ring = 1.0 + at.white_gain, 1.0 + at.ring_gain
    terms = np.stack(
        [at.rough_m**2 * slant * white, ring, slant * ring, at.spread_m**2 * slant * ring, tens * ring, bright * ring],
        axis=1,
    )

    def tensor(values: Any) -> Any:
        return torch.tensor(np.asarray(values), dtype=torch.float32)

    x, t = tensor((features - mean) / std), tensor(terms)
    y, y_raw = tensor(residual), tensor(raw)

    def shape_parameters() -> dict[str, Any]:
        parts = np.array([*_CORE_START, *_ELSEWHERE])
        return {
            "logit": tensor(np.log(parts[:, 0])).requires_grad_(),
            "offset": tensor(np.zeros(len(parts))).requires_grad_(),
            "size": tensor(np.log(parts[:, 2])).requires_grad_(),
        }

    def nll(target: Any, scale: Any, shape: dict[str, Any], bend: Any) -> Any:
        scale = torch.clamp(scale * torch.exp(0.5 * bend[:, 0]), min=1e-4)
        logit = shape["logit"][None] + torch.zeros((len(target), 1))
        elsewhere = [bend[:, 4]] * (logit.shape[1] - CORE)
        change = torch.stack([torch.zeros_like(bend[:, 0]), bend[:, 2], bend[:, 3], *elsewhere], 1)
        log_weight = torch.log_softmax(logit + change, dim=1)
        size = torch.exp(shape["size"])
        tilt = torch.stack([torch.zeros_like(bend[:, 5]), bend[:, 5], bend[:, 5]], 1)
        core_mean = scale[:, None] * (shape["offset"][None, :CORE] + 0.25 * bend[:, 1, None] + 0.5 * tilt)
        middle = torch.cat([core_mean, shape["offset"][None, CORE:].expand(len(target), -1)], 1)
        spread = torch.cat([scale[:, None] * size[None, :CORE], size[None, CORE:].expand(len(target), -1)], 1)
        z = (target[:, None] - middle) / spread
        return -torch.logsumexp(log_weight - 0.5 * z * z - torch.log(spread) - 0.9189385332, dim=1)

    def train(parameters: list[Any], loss: Callable[[Any], Any], count: int, rate: float, decay: float = 0.0) -> None:
        optimiser = torch.optim.AdamW(parameters, lr=rate, weight_decay=decay)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=rate, total_steps=count)
        for _ in range(count):
            rows = torch.from_numpy(rng.integers(0, len(y), min(_BATCH, len(y))))
            optimiser.zero_grad()
            loss(rows).mean().backward()
            optimiser.step()
            schedule.step()

    def shape_array(shape: dict[str, Any]) -> F64:
        weight = torch.softmax(shape["logit"], 0)
        return torch.stack([weight, shape["offset"], torch.exp(shape["size"])], 1).detach().numpy().astype(np.float64)

    zeros = torch.zeros((min(_BATCH, len(y)), OUTPUTS))
    # A fairer constant: one normal for the surface, and the same components elsewhere.
    fair = shape_parameters()
    fair_scale = tensor(np.log(0.045)).requires_grad_()
    one = tensor([0.0, -30.0, -30.0, *[0.0] * len(_ELSEWHERE)])

    def fair_loss(rows: Any) -> Any:
        shape = {**fair, "logit": fair["logit"] + one}
        return nll(y_raw[rows], torch.exp(fair_scale).expand(len(rows)), shape, zeros)

    train([*fair.values(), fair_scale], fair_loss, steps // 2, 0.03)
    table = shape_array({**fair, "logit": fair["logit"] + one})
    size = float(torch.exp(fair_scale).detach())
    core = np.array([table[0, 1] * size, table[0, 2] * size])
    arrays = {"constant_core": np.concatenate([core, table[CORE:].ravel()]), "features.mean": mean, "features.std": std}

    def scale_of(log_scale: Any, rows: Any) -> Any:
        return torch.sqrt((t[rows] * torch.exp(log_scale)).sum(1) + 1e-10)

    start = np.log([0.5, 4e-6, 4e-6, 0.4, 1e-6, 1e-3])
    shape, log_scale = shape_parameters(), tensor(start).requires_grad_()
    train([*shape.values(), log_scale], lambda rows: nll(y[rows], scale_of(log_scale, rows), shape, zeros), steps, 0.03)
    arrays["parametric.scale"] = np.exp(log_scale.detach().numpy().astype(np.float64))
    arrays["parametric.shape"] = shape_array(shape)

    shape = {name: value.detach().clone().requires_grad_() for name, value in shape.items()}
    log_scale = log_scale.detach().clone().requires_grad_()
    sizes = (x.shape[1], _HIDDEN, _HIDDEN, OUTPUTS)
    net = [torch.nn.Linear(a, b) for a, b in itertools.pairwise(sizes)]
    with torch.no_grad():
        net[2].weight.mul_(0.1)
        net[2].bias.zero_()

    def bend_of(rows: Any) -> Any:
        hidden = x[rows]
        for layer in net[:2]:
            hidden = torch.nn.functional.softsign(layer(hidden))
        return torch.clamp(net[2](hidden), -4.0, 4.0)

    train(
        [*shape.values(), log_scale, *(value for layer in net for value in layer.parameters())],
        lambda rows: nll(y[rows], scale_of(log_scale, rows), shape, bend_of(rows)),
        2 * steps,
        0.01,
        1e-3,
    )
    arrays["network.scale"] = np.exp(log_scale.detach().numpy().astype(np.float64))
    arrays["network.shape"] = shape_array(shape)
    for i, layer in enumerate(net):
        arrays[f"network.w{i}"] = layer.weight.detach().numpy().T.astype(np.float64)
        arrays[f"network.b{i}"] = layer.bias.detach().numpy().astype(np.float64)
    return arrays


def _fit_misses(at: RayConditions, missed: npt.NDArray[np.bool_], beams: int, steps: int) -> dict[str, F64]:
    """Arrays of the models of isolated misses. Of many rays that returned a tenth stands for all."""
    import torch

    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    share = min(1.0, max(0.1, 20_000 / max(len(missed), 1)))
    kept = missed | (rng.random(len(missed)) < share)
    at = RayConditions(*(getattr(at, f.name)[kept] for f in fields(RayConditions)))
    gone, each = missed[kept], np.where(missed[kept], 1.0, 1.0 / share)
    features = range_noise.ray_features(at)
    mean, std = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-3)
    standard, ring = (features - mean) / std, at.ring.astype(np.int64)
    line, beam_line = fit_logistic(standard, gone, each, ring, beams)
    arrays = {
        "drop.parametric": line,
        "drop.beam": beam_line,
        "drop.features.mean": mean,
        "drop.features.std": std,
    }
    x = torch.tensor(standard, dtype=torch.float32)
    y, weight = torch.tensor(gone, dtype=torch.float32), torch.tensor(each, dtype=torch.float32)
    rings, total = torch.from_numpy(ring), float(each.sum())
    base = float(np.log(max(gone.sum(), 1) / max(total - gone.sum(), 1.0)))
    first, second = torch.nn.Linear(x.shape[1], 16), torch.nn.Linear(16, 1)
    with torch.no_grad():
        second.bias.fill_(base)
        second.weight.mul_(0.1)
    beam = torch.zeros(beams, requires_grad=True)
    optimiser = torch.optim.Adam([*first.parameters(), *second.parameters(), beam], lr=0.02)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=0.02, total_steps=steps)
    for _ in counted(range(steps), steps, "steps"):
        rows = torch.from_numpy(rng.integers(0, len(y), min(32768, len(y))))
        optimiser.zero_grad()
        z = second(torch.nn.functional.softsign(first(x[rows])))[:, 0] + beam[rings[rows]]
        wrong = torch.nn.functional.binary_cross_entropy_with_logits(z, y[rows], reduction="none")
        prior = 0.5 * (beam**2).sum() / _BEAM_SPREAD**2 + 0.5 * ((first.weight**2).sum() + (second.weight**2).sum())
        loss: Any = 1e3 * ((weight[rows] * wrong).mean() / weight.mean() + prior / total)
        loss.backward()
        optimiser.step()
        schedule.step()
    for i, layer in enumerate((first, second)):
        arrays[f"drop.network.w{i}"] = layer.weight.detach().numpy().T.astype(np.float64)
        arrays[f"drop.network.b{i}"] = layer.bias.detach().numpy().astype(np.float64)
    arrays["drop.network.beam"] = beam.detach().numpy().astype(np.float64)
    return arrays


def fit_logistic(
    x: F64, gone: npt.NDArray[np.bool_], weight: F64, ring: npt.NDArray[np.int64], beams: int, rounds: int = 20
) -> tuple[F64, F64]:
    """Logit of a miss, linear in standardised features: (1 + F,) with the constant first, and one term a beam (beams,).

    Penalised likelihood by Newton's steps, halved where they overshoot.
    """
    columns = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    several, y = columns.shape[1], gone.astype(np.float64)
    penalty = np.concatenate([[0.0], np.ones(several - 1), np.full(beams, _BEAM_SPREAD**-2)])
    base = (weight * y).sum() / max((weight * (1.0 - y)).sum(), 1.0)
    found = np.zeros(several + beams)
    found[0] = np.log(max(base, 1e-6))

    def logit(value: F64) -> F64:
        return np.asarray(columns @ value[:several] + value[several:][ring])

    def cost(value: F64) -> float:
        z = logit(value)
        return float((weight * (np.logaddexp(0.0, z) - y * z)).sum() + 0.5 * (penalty * value**2).sum())

    now = cost(found)
    for _ in range(rounds):
        p = 1.0 / (1.0 + np.exp(-np.clip(logit(found), -30.0, 30.0)))
        slope, curve = weight * (y - p), weight * p * (1.0 - p)
        gradient = np.concatenate([columns.T @ slope, np.bincount(ring, slope, beams)]) - penalty * found
        hessian = np.diag(penalty + 1e-6)
        hessian[:several, :several] += (columns * curve[:, None]).T @ columns
        cross = np.stack([np.bincount(ring, curve * columns[:, i], beams) for i in range(several)])
        hessian[:several, several:] += cross
        hessian[several:, :several] += cross.T
        hessian[several:, several:] += np.diag(np.bincount(ring, curve, beams))
        step = np.linalg.solve(hessian, gradient)
        size = 1.0
        while cost(found + size * step) > now and size > 1e-4:
            size *= 0.5
        found = found + size * step
        before, now = now, cost(found)
        if before - now < 1e-3:
            break
    return found[:several], found[several:]


def shot_table(shots: JudgedShots) -> F64:
    """Range (m) and spread (m) of one beam from shot to shot (k, 2): medians of absolute deviations.

    Of the half whose neighbours lie smoothest: roughness is the surface's; neighbours say nothing of a shot's luck.
    """
    rows = []
    for low, high in itertools.pairwise(_SHOT_RANGES_M):
        there = (shots.range_m >= low) & (shots.range_m < high)
        if there.sum() >= 200:
            there &= shots.spread_m <= np.median(shots.spread_m[there])
            rows.append((0.5 * (low + high), 1.4826 * np.median(np.abs(shots.deviation_m[there]))))
    return np.array(rows or [(10.0, 0.008)])


def edge_tables(edges: JudgedEdges) -> tuple[F64, F64]:
    """Chances of a mixed point and of nothing by range step (k, 3), and quantiles (21,) of a mixed point's place."""
    step, rows = edges.far_m - edges.near_m, []
    for low, high in zip(_EDGE_STEPS_M, (*_EDGE_STEPS_M[1:], np.inf), strict=True):
        its = edges.outcome[(step >= low) & (step < high)]
        several = max(len(its), 1)
        mixed, nothing = (its == MIXED_BETWEEN).sum(), (its == NOTHING).sum()
        rows.append((low, mixed / several, nothing / several))
    share = edges.share[np.isfinite(edges.share)]
    quantiles = np.quantile(share, np.linspace(0, 1, 21)) if len(share) >= 20 else np.linspace(0.05, 0.95, 21)
    return np.array(rows, dtype=np.float64), np.asarray(quantiles, dtype=np.float64)


def _edge_shares(edges: JudgedEdges) -> F64:
    several = max(len(edges.outcome), 1)
    return np.array([(edges.outcome == kind).sum() / several for kind in (MIXED_BETWEEN, NOTHING)], dtype=np.float64)


def vehicle_edges(root: KittiRoot, scanner: ScannerProfile) -> F64 | None:
    """Chances (2,) of a mixed point and of nothing where a labelled vehicle stands before something; None if few."""
    found = []
    views_of_all = counted(vehicle_views(root, scanner), None, "views of vehicles")
    for _, its in itertools.groupby(views_of_all, key=lambda view: (view.sequence, view.frame)):
        views = list(its)  # a scan at a time: all would not fit into memory
        rayed = views[0].scan
        of_vehicle = np.zeros(len(rayed.scan), dtype=np.float32)
        for view in views:
            point = rayed.rays.ray_point[view.ray[own_returns(view, scanner)]]
            of_vehicle[point[point >= 0]] = 1.0
        edges = noise_patches.judge_edges(replace(rayed.scan, reflectance=of_vehicle), rayed.rays, scanner)
        found.append(noise_patches.take(edges, edges.reflectance_near > 0.5))  # the near side's: it marks vehicles here
    if sum(len(edges.outcome) for edges in found) < MIN_EDGES:
        return None
    return _edge_shares(noise_patches.concatenate(found))


def surface_figures(returns: JudgedReturns, at: ReturnConditions, residual: F64, scanner: ScannerProfile) -> F64:
    """Spread along rings and of rings on the smoother walls, and how long along the ring a beam keeps its error."""
    walls = (at.slope == noise_patches.WALL) & (at.cos_incidence > 0.6) & (at.range_m < 30.0)
    rough = np.quantile(at.rough_m[walls], 0.25) if walls.sum() > 200 else 0.005
    spread = np.quantile(at.spread_m[walls], 0.25) if walls.sum() > 200 else 0.005
    # Of neighbouring judged returns of one ring (steps of 2): the correlation of what is left, tails cut.
    scale = 1.4826 * np.median(np.abs(residual[walls])) if walls.any() else 0.02
    calm = np.clip(residual / scale, -3.0, 3.0)
    key = (returns.scan * 256 + returns.ring) * scanner.lattice_size + returns.step
    order = np.argsort(key)
    order = order[walls[order]]
    lags = []
    for lag in (4, 8, 16):
        where = np.searchsorted(key[order], key[order] + lag)
        where = np.minimum(where, max(len(order) - 1, 0))
        both = key[order][where] == key[order] + lag if len(order) else np.zeros(0, dtype=bool)
        if both.sum() > 200:
            lags.append((lag / 1.86, float(np.corrcoef(calm[order][both], calm[order][where][both])[0, 1])))
    firing = 0.98
    if len(lags) == 3 and lags[0][1] > lags[2][1] > 0.0:
        firing = float((lags[2][1] / lags[0][1]) ** (1.0 / (lags[2][0] - lags[0][0])))
    return np.array([rough, spread, min(firing, 0.999)])
