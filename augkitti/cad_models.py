"""The CAD library: a folder of vehicle files in, car models in the car frame and the decisions behind them out.

A `manifest.json` in the folder, or a YAML file beside a model with the same stem and the fields of one manifest entry,
overrides what the heuristics of `cad_alignment.py` find. Finished models are cached by the digest of all their files.
"""

import hashlib
import io
import json
import os
import re
import tempfile
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from augkitti.cad_formats import MODEL_SUFFIXES, inside, read_model
from augkitti.cad_soup import Vector, face_areas
from augkitti.cad_surfaces import WHEEL_NAME
from augkitti.cad_vehicle import ModelFacts, build_model, content_digest
from augkitti.errors import InputError
from augkitti.scan_pair import GLASS, CarModel
from augkitti.yaml_text import read_yaml

LOADER_VERSION = 3  # part of the cache key: raise it when a file would come out differently


@dataclass(frozen=True)
class CadDecision:
    """A row of `augkitti cad check`: what became of one model, and why."""

    name: str
    file: str  # relative to the library's folder
    category: str
    size_m: Vector | None  # length, width, height
    triangles: int
    glass_share: float  # of the surface's area
    decisions: tuple[str, ...]
    problem: str | None  # why it was left out; None for a usable model


@dataclass(frozen=True)
class CadLibrary:
    """The usable models of a folder, sorted by name, and what was decided about every file."""

    models: tuple[CarModel, ...]
    report: tuple[CadDecision, ...]


@dataclass(frozen=True)
class _Candidate:
    name: str
    main: Path
    root: Path  # every file of the model lies in here
    facts: ModelFacts
    facts_source: str  # "manifest", "sidecar x.yaml" or "" for none
    wheel_files: tuple[Path, ...]


def load_cad_folder(
    folder: Path, categories: tuple[str, ...] | None = None, cache_dir: Path | None = None
) -> CadLibrary:
    """As `check_cad_folder`, where there is a usable model to go on with.

    Raises:
        InputError: as there, or not one usable model.
    """
    library = check_cad_folder(folder, categories, cache_dir)
    if not library.models:
        asked = "" if categories is None else f" of category {' or '.join(categories)}"
        reasons = "; ".join(f"{row.name}: {row.problem}" for row in library.report[:3])
        problem = f"no usable car model{asked} ({reasons})"
        raise InputError(folder, problem, f"see `augkitti cad check {folder}` for every file")
    return library


def check_cad_folder(
    folder: Path, categories: tuple[str, ...] | None = None, cache_dir: Path | None = None
) -> CadLibrary:
    """Load every vehicle of a folder; a bad one is left out and listed with the reason.

    Each subfolder is one vehicle or several files; loose files are vehicles of their own.

    Args:
        folder: where the models are, with or without `manifest.json`.
        categories: KITTI categories to keep (`Car`, `Van`, `Truck`); None for all.
        cache_dir: where finished models are kept between runs; None for no cache.

    Raises:
        InputError: no such folder, a damaged manifest, or no file that could be a model.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "name a folder of car models, or leave --cad out")
    models: list[CarModel] = []
    report: list[CadDecision] = []
    for candidate in _candidates(folder):
        if isinstance(candidate, CadDecision):
            report.append(candidate)
            continue
        relative = candidate.main.relative_to(folder.resolve()).as_posix()
        try:
            model, decisions = _load_cached(candidate, cache_dir)
        except InputError as err:
            report.append(CadDecision(candidate.name, relative, "", None, 0, 0.0, (), err.reason))
            continue
        problem = None
        if categories is not None and model.category not in categories:
            problem = f"category {model.category} is not asked for"
        else:
            models.append(model)
        report.append(_decision_of(model, relative, decisions, problem))
    if not report:
        raise InputError(folder, "no car model", f"give files that end in {', '.join(MODEL_SUFFIXES)}")
    return CadLibrary(
        tuple(sorted(models, key=lambda m: m.name)), tuple(sorted(report, key=lambda r: (r.name, r.file)))
    )


def _decision_of(model: CarModel, file: str, decisions: tuple[str, ...], problem: str | None) -> CadDecision:
    area = face_areas(model.vertices, model.faces)
    share = float(area[model.surface == GLASS].sum() / area.sum())
    length, width, height = (float(s) for s in model.size_m)
    return CadDecision(
        model.name, file, model.category, (length, width, height), len(model.faces), share, decisions, problem
    )


# --- which files are vehicles ---


def _candidates(folder: Path) -> list["_Candidate | CadDecision"]:
    root = folder.resolve()
    found: list[_Candidate | CadDecision] = []
    covered: set[Path] = set()
    for facts in _read_manifest(root / "manifest.json"):
        name = facts.name or ""
        try:
            found.append(_from_manifest(root, name, facts))
            covered.update(_covered(root, found[-1]))
        except InputError as err:
            found.append(CadDecision(name, facts.main_file or "", "", None, 0, 0.0, (), err.reason))
    names = {c.name for c in found}
    groups: dict[Path, list[Path]] = {}
    for path in sorted(root.rglob("*")):
        hidden = any(part.startswith(".") for part in path.relative_to(root).parts)
        if path.suffix.lower() not in MODEL_SUFFIXES or hidden or not path.is_file():
            continue
        if path.resolve() in covered or any(parent in covered for parent in path.resolve().parents):
            continue
        parts = path.relative_to(root).parts
        groups.setdefault(root / parts[0] if len(parts) > 1 else root, []).append(path)
    for group, paths in sorted(groups.items()):
        bodies = [p for p in paths if not _is_wheel_file(p)] or paths
        wheels = tuple(p for p in paths if p not in bodies)
        for path in bodies:
            name = group.name if len(bodies) == 1 and group != root else path.stem
            while name in names:
                name += "_2"
            names.add(name)
            found.append(_from_file(root, group, name, path, wheels, len(bodies)))
    return found


def _is_wheel_file(path: Path) -> bool:
    """By name; `car_no_wheels` is a body."""
    without = re.search(r"(no|without|ohne|sans).?(wheel|tire|tyre)", path.stem, re.I)
    return bool(WHEEL_NAME.search(path.stem)) and not without


def _covered(root: Path, candidate: "_Candidate | CadDecision") -> list[Path]:
    if isinstance(candidate, CadDecision):
        return []
    return [candidate.main, *candidate.wheel_files] if candidate.root == root else [candidate.root]


def _read_manifest(path: Path) -> list[ModelFacts]:
    if not path.is_file():
        return []
    remedy = "mend it, or take it away and let the loader find axes and windows"
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        entries = document["models"]
        facts = [ModelFacts.model_validate(e) for e in entries]
    except ValidationError as err:
        raise InputError(path, _first_problem(err), remedy) from err
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as err:
        raise InputError(path, f"not a manifest ({type(err).__name__}: {err})", remedy) from err
    for entry in facts:
        if not entry.name or not entry.main_file:
            raise InputError(path, "an entry without `name` or `main_file`", remedy)
    return facts


def _first_problem(err: ValidationError) -> str:
    first = err.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    return f"key `{key[:80]}`: {first['msg'][:200]}"


def _from_manifest(root: Path, name: str, facts: ModelFacts) -> _Candidate:
    manifest = root / "manifest.json"
    home = inside(root, name, manifest)
    home = home if home.is_dir() else root
    main = inside(home, facts.main_file or "", manifest)
    if not main.is_file():
        raise InputError(main, "the manifest names it, but it is not there", "add the file or take the entry out")
    wheels = tuple(inside(home, w, manifest) for w in facts.wheel_files)
    return _Candidate(name, main, home, facts, "manifest", wheels)


def _from_file(
    root: Path, group: Path, name: str, path: Path, wheels: tuple[Path, ...], bodies: int
) -> "_Candidate | CadDecision":
    relative = path.relative_to(root).as_posix()
    try:
        if not str(path.resolve()).startswith(str(root) + os.sep):
            raise InputError(path, "links to a place outside of the folder", "copy the file in")
        facts, source = _read_sidecar(path)
        named = tuple(inside(path.parent, w, path) for w in facts.wheel_files)
    except InputError as err:
        return CadDecision(name, relative, "", None, 0, 0.0, (), str(err))
    # with several bodies in one folder nothing tells whose the wheels are
    return _Candidate(
        facts.name or name, path.resolve(), group, facts, source, named or (wheels if bodies == 1 else ())
    )


def _read_sidecar(model: Path) -> tuple[ModelFacts, str]:
    for suffix in (".yaml", ".yml"):
        path = model.with_suffix(suffix)
        if not path.is_file():
            continue
        remedy = "give it the fields of one manifest entry"
        content = read_yaml(path, remedy) or {}
        try:
            return ModelFacts.model_validate(content), f"sidecar {path.name}"
        except ValidationError as err:
            raise InputError(path.name, _first_problem(err), remedy) from err
    return ModelFacts.model_validate({}), ""


def _load_one(candidate: _Candidate) -> tuple[CarModel, tuple[str, ...]]:
    raw = read_model(candidate.main, candidate.root)
    wheels = tuple(read_model(w, candidate.root) for w in candidate.wheel_files)
    notes = list(raw.warnings)
    if len(notes) > 1:
        notes = [f"{notes[0]} and {len(notes) - 1} more warnings"]
    model, decisions = build_model(candidate.name, candidate.main, raw, wheels, candidate.facts, candidate.facts_source)
    return model, (*decisions, *notes)


# --- cache ---


def _load_cached(candidate: _Candidate, cache_dir: Path | None) -> tuple[CarModel, tuple[str, ...]]:
    if cache_dir is None:
        return _load_one(candidate)
    try:
        path = Path(cache_dir) / f"car-{_files_digest(candidate)}.npz"
    except OSError as err:
        raise InputError(candidate.main, f"its files are not readable ({err.strerror})", "check permissions") from err
    kept = _read_cache(path)
    if kept is not None:
        return kept
    model, decisions = _load_one(candidate)
    _write_cache(path, model, decisions)
    return model, decisions


def _files_digest(candidate: _Candidate) -> str:
    """sha256 over every file that may count for a model, its facts, and the version of this loader."""
    import trimesh

    digest = hashlib.sha256(f"{LOADER_VERSION}\0{trimesh.__version__}\0{candidate.name}\0".encode())
    digest.update(candidate.facts.model_dump_json().encode())
    digest.update(candidate.facts_source.encode())
    own = {candidate.main, *candidate.wheel_files}
    for path in sorted(candidate.root.rglob("*")):
        if not path.is_file() or (path.suffix.lower() in MODEL_SUFFIXES and path.resolve() not in own):
            continue
        if path.name == "manifest.json":
            continue  # its entry is in the facts
        content = path.read_bytes()
        digest.update(f"{path.relative_to(candidate.root).as_posix()}\0{len(content)}\0".encode())
        digest.update(content)
    digest.update(candidate.main.relative_to(candidate.root).as_posix().encode())
    return digest.hexdigest()


def _read_cache(path: Path) -> tuple[CarModel, tuple[str, ...]] | None:
    """A finished model; None where there is none or the file is damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as kept:
            text = json.loads(str(kept["text"]))
            model = CarModel(
                text["name"],
                text["category"],
                kept["vertices"],
                kept["faces"],
                kept["surface"],
                kept["opacity"],
                kept["size_m"],
                text["wheelbase_m"],
                text["rear_axle_x_m"],
                text["digest"],
            )
        decisions = tuple(str(d) for d in text["decisions"])
        return (model, decisions) if content_digest(model) == model.digest else None
    except (OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, NotImplementedError, RuntimeError):
        return None  # the reader of zip files raises the last two on damaged flags
    except (zipfile.BadZipFile, zlib.error, MemoryError, tokenize.TokenError, SyntaxError):
        return None


def _write_cache(path: Path, model: CarModel, decisions: tuple[str, ...]) -> None:
    text = {
        "name": model.name,
        "category": model.category,
        "wheelbase_m": model.wheelbase_m,
        "rear_axle_x_m": model.rear_axle_x_m,
        "digest": model.digest,
        "decisions": list(decisions),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(
                    file,
                    text=np.array(json.dumps(text)),
                    vertices=model.vertices,
                    faces=model.faces,
                    surface=model.surface,
                    opacity=model.opacity,
                    size_m=model.size_m,
                )
            os.replace(temporary, path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as err:
        raise InputError(path.parent, f"not writable ({err.strerror})", "name another cache folder") from err
