"""What one run is: the options of `generate` in, checked inputs, the plan and its work folder out.

The work folder `OUT/.augkitti-work` holds `run.json` (settings, identity, plan) and `rows/` (one file a finished
shard). It is there while a run is unfinished; `finish` takes it away. All checks here come before any work.
"""

import hashlib
import json
import os
import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import augkitti
from augkitti.config import Config, load_config
from augkitti.dataset_index import (
    CARD_NAME,
    DATA_NAME,
    INDEX_NAME,
    SPLITS_NAME,
    DatasetIndex,
    file_sha256,
    read_index,
    write_text,
)
from augkitti.errors import InputError, MachineError
from augkitti.kitti import KittiRoot, Sequence, known_ego_motion, label_reach, open_root, read_labels
from augkitti.remote import as_path, copy_here, is_remote, remove_all
from augkitti.scan_pair import CarModel
from augkitti.scanner import ScannerProfile, is_shipped, load_profile
from augkitti.sensor_noise import noise_model, solid_noise
from augkitti.shards import read_metadata, shard_metadata
from pipelines.cache import cache_folder, program_digest
from pipelines.lock import NAME as LOCK_NAME
from pipelines.lock import check_free
from pipelines.plan import ShardPlan, first_choice, plan_shards
from pipelines.streets import Streets, find_streets

if TYPE_CHECKING:
    from augkitti.cad_models import CadLibrary

WORK = ".augkitti-work"
_STATE = "run.json"


@dataclass(frozen=True)
class Options:
    """The options of `generate` that a task in another process needs, as they were given."""

    kitti: Path | None  # None: embedded streets
    cad: Path | None  # None: parametric cars
    out: Path
    n: int
    seed: int
    config: Config
    profile: Path | None = None
    stop_on_error: bool = False
    cache: Path = Path()

    @cached_property
    def scanner(self) -> ScannerProfile:
        """The scanner profile.

        Raises:
            InputError: it is none, or has no noise that virtual cars could return by.
        """
        profile = load_profile(self.profile)
        if self.config.cars[1] > 0:  # once here, not as the reason of every pair that is skipped
            noise_model(profile)
            solid_noise(profile)
        return profile

    @property
    def models(self) -> tuple[CarModel, ...]:
        """The car models to draw from; none for plain pairs."""
        return load_models(self.cad, self.config, self.cache) if self.config.cars[1] > 0 else ()

    @cached_property
    def streets(self) -> Streets | None:
        """The embedded streets that stand in for KITTI; None with `--kitti`."""
        return find_streets(self.n, self.seed, self.scanner, self.cache) if self.kitti is None else None

    @property
    def root(self) -> Path:
        """Where the scans lie."""
        if self.kitti is not None:
            return self.kitti
        assert self.streets is not None
        return self.streets.folder

    @property
    def work(self) -> Path:
        """The work folder."""
        return self.out / WORK

    def __getstate__(self) -> dict[str, Any]:
        names = ("kitti", "cad", "out", "n", "seed", "config", "profile", "stop_on_error", "cache")
        return {name: getattr(self, name) for name in names}  # profiles are read again in each process


@dataclass(frozen=True)
class Run:
    """A run whose input is checked: its sequences and its plan."""

    options: Options
    sequences: dict[str, Sequence]  # usable ones, by name
    shards: tuple[ShardPlan, ...]
    left_out: tuple[dict[str, Any], ...]  # drives that cannot be used at all: source, reason, count
    identity: dict[str, Any]  # what `--resume` compares

    def frames0(self, name: str) -> tuple[int, ...]:
        """First frames of a sequence's pairs."""
        return tuple(first for first, _ in self.sequences[name].pairs)

    def planned_frames(self) -> dict[str, tuple[int, ...]]:
        """First frames of the pairs that are made if none is skipped, by sequence name."""
        frames: dict[str, set[int]] = {}
        there = {name: self.frames0(name) for name in {shard.sequence for shard in self.shards}}
        for shard in self.shards:
            chosen = first_choice(shard, there[shard.sequence], self.options.seed)
            frames.setdefault(shard.sequence, set()).update(chosen)
        return {name: tuple(sorted(frames[name])) for name in sorted(frames)}


def open_run(options: Options) -> Run:
    """Check every input and draw the plan; reads names and small files, and writes nothing.

    Raises:
        InputError: the source, the car models or the profile cannot be used.
    """
    if options.n < 1:
        raise InputError("--n", f"is {options.n}", "ask for at least one pair")
    models = options.models
    root = open_root(options.root)
    sequences, left_out = _usable(root, options)
    pairs_of = [(name, len(sequence.pairs)) for name, sequence in sorted(sequences.items())]
    if not pairs_of:
        why = f"; {left_out[0]['source']}: {left_out[0]['reason']}" if left_out else ""
        remedy = "fetch that file again, or give other drives" if left_out else "give drives with consecutive scans"
        notes = sorted({sequence.note for sequence in root.sequences if sequence.note})
        raise InputError(root.path, "; ".join([f"holds no usable scan pair{why}", *notes]), remedy)
    shards = plan_shards(pairs_of, options.n, options.seed, in_turn=options.kitti is None)
    identity = {
        "program version": f"{augkitti.__version__} ({program_digest()[:12]})",
        "pairs (--n)": options.n,
        "seed": options.seed,
        "configuration": options.config.model_dump(mode="json"),
        "scanner profile": options.scanner.digest,
        "car models": {model.name: model.digest for model in models},
        "source": hashlib.sha256(json.dumps(pairs_of).encode()).hexdigest(),
    }
    return Run(options, sequences, shards, tuple(left_out), identity)


@lru_cache(maxsize=2)
def load_library(cad: Path, categories: tuple[str, ...], cache: Path) -> "CadLibrary":
    """The models of a folder, read once a process."""
    from augkitti.cad_models import load_cad_folder

    return load_cad_folder(copy_here(cad, cache / "cad-copies"), categories, cache / "cad")


def load_models(cad: Path | None, config: Config, cache: Path) -> tuple[CarModel, ...]:
    """The car models of the wanted categories, from a folder or made in code.

    Raises:
        InputError: the folder is missing or holds no usable model of the categories.
    """
    from augkitti.parametric_cars import parametric_cars

    if cad is not None:
        return load_library(cad, config.categories, cache).models
    models = parametric_cars()
    wanted = tuple(model for model in models if model.category in config.categories)
    if not wanted:
        there = ", ".join(sorted({model.category for model in models}))
        raise InputError("--categories", f"no car made in code is a {' or '.join(config.categories)}", f"take {there}")
    return wanted


def _usable(root: KittiRoot, options: Options) -> tuple[dict[str, Sequence], list[dict[str, Any]]]:
    """Sequences with pairs whose own files (calibration, labels, poses) can be read, and those left out."""
    usable, left_out = {}, []
    for sequence in root.sequences:
        pairs = sequence.pairs
        if not pairs:
            continue
        problem = _drive_problem(sequence) or _scans_problem(sequence)
        if problem is None:
            usable[sequence.name] = sequence
        elif options.stop_on_error:
            raise problem
        else:
            left_out.append(skip_entry(problem, root.path, len(pairs)))
    return usable, left_out


def _drive_problem(sequence: Sequence) -> InputError | None:
    """What makes every pair of a drive unusable: a file of the whole drive; None if there is no such thing."""
    first = sequence.pairs[0][0]
    try:
        label_reach(sequence)
        read_labels(sequence, first)
    except InputError as err:
        return err
    places = set()
    for frame0 in {first, sequence.pairs[len(sequence.pairs) // 2][0], sequence.pairs[-1][0]}:
        try:
            known_ego_motion(sequence, frame0)
            return None
        except InputError as err:
            places.add(err.where)
            problem = err
    return problem if len(places) == 1 and len(sequence.pairs) > 1 else None


def _scans_problem(sequence: Sequence) -> InputError | None:
    """The fault of a drive in which no pair has two files of whole points; looks at sizes, stops at a good pair."""
    for frame0, frame1 in sequence.pairs:
        sizes = [sequence.scan_path(frame).stat().st_size for frame in (frame0, frame1)]
        if all(size > 0 and size % 16 == 0 for size in sizes):
            return None
    path = sequence.scan_path(sequence.pairs[0][0])
    return InputError(path, "is empty or cut short, as is a scan of every pair of its drive", "fetch the drive again")


def skip_entry(err: InputError, root: Path, count: int) -> dict[str, Any]:
    """A row of `skipped` in `dataset.json` for an unreadable source, free of this machine's paths."""
    prefix = f"{root}{os.sep}"
    return {"source": err.where.replace(prefix, ""), "reason": err.problem.replace(prefix, ""), "count": count}


# --- the output and its work folder ----------------------------------------------------------------------------------


def check_output(out: Path, resume: bool) -> None:
    """Refuse an output folder that holds something, unless it is a run to be resumed, or that cannot be written.

    Raises:
        InputError: as said.
    """
    try:
        if out.is_dir():
            held = sorted(path.name for path in out.iterdir())
            if WORK in held:
                check_free(out / WORK)
            foreign = [name for name in held if name not in (WORK, DATA_NAME, INDEX_NAME, SPLITS_NAME, CARD_NAME)]
            if held and not resume:
                problem = "holds an unfinished run" if WORK in held else "is not empty"
                raise InputError(out, problem, "take another --out, or --resume to go on with it")
            if held and (foreign or (WORK not in held and INDEX_NAME not in held)):
                raise InputError(out / (foreign or held)[0], "is no part of a run", "take another --out")
        elif out.exists():
            raise InputError(out, "is not a folder", "take another --out")
        if is_remote(out):
            return  # told by the lock, the first thing that is written
        nearest = next(folder for folder in (out, *out.absolute().parents) if folder.exists())
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as err:
        raise InputError(out, f"cannot be written ({err.strerror})", "take another --out, or mend permissions") from err


def finished_index(run: Run) -> DatasetIndex | None:
    """The index of the run's data set if the output folder holds it, finished and whole; takes a broken one's away.

    A set that fell short of its `--n` is finished, too.

    Raises:
        InputError: it holds a finished data set made otherwise; names what differs.
    """
    out, options = run.options.out, run.options
    if (options.work / _STATE).is_file() or not (out / INDEX_NAME).is_file():
        return None
    index = read_index(out)
    wanted = shard_metadata(options.config, options.scanner, options.models)
    readable = [shard for shard in index.shards if (out / shard.path).is_file()]
    found = read_metadata(out / readable[0].path) if readable else wanted
    told = {
        "program_version": "program version",
        "configuration": "configuration",
        "scanner_profile_digest": "scanner profile",
        "cad_models": "car models",
    }
    differs = [name for key, name in told.items() if found.get(key) != wanted[key]]
    if index.seed != options.seed:
        differs.append("seed")
    names = {f"{DATA_NAME}/{shard.name}.parquet" for shard in run.shards}
    if index.asked == options.n and not {shard.path for shard in index.shards} <= names:
        differs.append("source")
    if differs:
        raise InputError(out, f"was made with another {', '.join(differs)}", "resume with the same, or start anew")
    if index.asked != options.n:  # its shards hold other numbers of pairs: all would have to be made again
        remedy = f"take another --out (a larger set holds the pairs of a smaller one), or --n {index.asked}"
        raise InputError(out, f"was finished with --n {index.asked}", remedy)
    if all(shard in readable and file_sha256(out / shard.path) == shard.sha256 for shard in index.shards):
        end_work(out)  # a run may have died just before
        return index
    for name in (INDEX_NAME, SPLITS_NAME, CARD_NAME):
        (out / name).unlink(missing_ok=True)
    return None


def start_work(run: Run, resume: bool) -> None:
    """Write the work folder, or with `resume` check that it belongs to the same run.

    Raises:
        InputError: a run with other settings began there; names what differs.
        MachineError: it cannot be written.
    """
    work = run.options.work
    state = work / _STATE
    if resume and state.is_file():
        before = _read_state(state)["identity"]
        differs = [key for key in run.identity if before.get(key) != run.identity[key]]
        if differs:
            raise InputError(
                run.options.out, f"was begun with another {', '.join(differs)}", "resume with the same, or start anew"
            )
    options = run.options
    settings = {
        "kitti": None if options.kitti is None else str(options.kitti.absolute()),
        "cad": None if options.cad is None else str(options.cad.absolute()),
        "n": options.n,
        "seed": options.seed,
        "config": options.config.model_dump(mode="json"),
        "profile": None if options.profile is None else _profile_place(options.profile),
        "stop_on_error": options.stop_on_error,
        "cache": str(options.cache.absolute()),
    }
    content = {"options": settings, "identity": run.identity, "plan": [shard.as_json() for shard in run.shards]}
    try:
        (work / "rows").mkdir(parents=True, exist_ok=True)
        (options.out / DATA_NAME).mkdir(exist_ok=True)
        write_text(state, json.dumps(content, indent=1))
    except OSError as err:
        raise MachineError(work, f"cannot be written ({err.strerror})", "make room, then go on with --resume") from err


def reopen_run(out: Path) -> Run:
    """The run that an output folder's work folder describes: for stages run alone.

    Raises:
        InputError: there is no unfinished run, or its input is not what it was.
    """
    check_work(out)
    state = out / WORK / _STATE
    content = _read_state(state)
    settings = content["options"]
    try:
        options = Options(
            kitti=_place(settings["kitti"]),
            cad=_place(settings["cad"]),
            out=out,
            n=int(settings["n"]),
            seed=int(settings["seed"]),
            config=Config.model_validate(settings["config"]),
            profile=None if settings["profile"] is None else Path(settings["profile"]),
            stop_on_error=bool(settings["stop_on_error"]),
            cache=Path(settings["cache"]),
        )
        if options.seed < 0:
            raise ValueError("seed")
    except (KeyError, TypeError, ValueError) as err:
        raise InputError(state, "is no run of this program", "begin again in another folder") from err
    try:
        run = open_run(options)
    except OSError as err:  # such as a name that no file can have
        problem = f"names a source that cannot be read ({err.strerror})"
        raise InputError(state, problem, "see that it is there, or begin again in another folder") from err
    start_work(run, resume=True)
    return run


def _profile_place(profile: Path) -> str:
    """A profile as `run.json` names it: a shipped one's name is no path."""
    return str(profile if is_shipped(profile) else profile.absolute())


def _place(given: Any) -> Path | None:
    """A folder as `run.json` names it.

    Raises:
        TypeError: it names none.
    """
    if given is not None and not isinstance(given, str):
        raise TypeError(f"{given!r} is no folder")
    return None if given is None else as_path(given)


def check_work(out: Path) -> None:
    """Refuse a folder without an unfinished run.

    Raises:
        InputError: as said.
    """
    if not (out / WORK / _STATE).is_file():
        raise InputError(out, "holds no unfinished run", "begin with `augkitti prepare`, or use `augkitti generate`")


def config_of(index: DatasetIndex) -> Config:
    """The configuration that a data set was made with.

    Raises:
        InputError: this program has other keys.
    """
    try:
        return Config.model_validate(index.configuration)
    except ValueError as err:
        problem = f"was made by augkitti {index.program_version} with settings that this one does not know"
        raise InputError(INDEX_NAME, problem, "use that version, or generate again") from err


def end_work(out: Path) -> None:
    """Take the work folder away: the data set is finished."""
    work = out / WORK
    if not work.is_dir():
        return
    if is_remote(work):
        (work / _STATE).unlink(missing_ok=True)
        remove_all(work)
        return
    with suppress(OSError):
        (work / _STATE).unlink(missing_ok=True)  # first: without it the run is no longer unfinished
        shutil.rmtree(work / "rows", ignore_errors=True)
        for path in work.iterdir():
            if path.name != LOCK_NAME:
                path.unlink(missing_ok=True)
        (work / LOCK_NAME).unlink(missing_ok=True)  # last: until here no other run may begin
        work.rmdir()


def _read_state(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(content["options"], dict) and isinstance(content["identity"], dict):
            return dict(content)
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    raise InputError(path, "is no run of this program", "begin again in another folder")


def read_options(
    *,
    kitti: Path | None,
    cad: Path | None,
    out: Path,
    n: int,
    seed: int,
    config: Path | None,
    profile: Path | None,
    stop_on_error: bool,
    **changes: Any,
) -> Options:
    """Options from a command line: the configuration file, with what was given beside it on top.

    Raises:
        InputError: the configuration or the profile is bad, or a path does not exist.
    """
    loaded = load_config(config, **changes)
    if seed < 0:
        raise InputError("--seed", f"is {seed}", "give a whole number from 0")
    if cad is not None and not cad.is_dir():
        raise InputError(cad, "is not a folder" if cad.exists() else "does not exist", "give a folder of car models")
    options = Options(kitti, cad, out, n, seed, loaded, profile, stop_on_error, cache_folder())
    assert options.scanner is not None  # read now: a bad profile is told before anything else
    return options
