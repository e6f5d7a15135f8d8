"""Evaluation: a run and data sets in; predictions to a file, figures of them and of the baselines beside them out.

Scoring itself is `score.py`, which needs no torch; this module predicts, reads back, and writes tables and pictures.
"""

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from pydantic import ValidationError

import augkitti
from augkitti.command_line import as_json, counted, is_json, note, print_json
from augkitti.dataset import Dataset, open_dataset
from augkitti.dataset_index import write_text
from augkitti.errors import InputError, MachineError
from augkitti.scan_pair import AugmentedPair
from augkitti.splits import SPLIT_NAMES
from training.checkpoint import Checkpoint, load_checkpoint, network_of, shipped_checkpoint
from training.config import Settings
from training.network import PointFlowNet
from training.pictures import draw_flow
from training.predict import Predictor, limits_of, predict_pairs
from training.predictions import Predictions, write_predictions
from training.report_tables import as_csv, as_latex, print_report
from training.score import Report, Rules, baseline_predictors, score_pairs
from training.team import Precision, Team, team_of

METHOD = "direct"  # whose best, median and worst pairs are drawn, where it is among the methods


@dataclass(frozen=True)
class EvaluateOptions:
    """What is asked for."""

    run: Path | None  # None: the shipped checkpoint
    data: tuple[Path, ...]
    split: str | None = "test"
    json: Path | None = None
    csv: Path | None = None
    tex: Path | None = None
    predictions: Path | None = None  # kept there; scored as it is where it exists
    pictures: Path | None = None
    limit: int | None = None  # of pairs, each set
    neutral: tuple[str, ...] | None = None  # None: as `Rules` has it
    least_points: int | None = None
    threads: int | None = None
    device: str = "auto"
    precision: Precision = "auto"


def evaluate(options: EvaluateOptions) -> Report:
    """The command.

    Raises:
        InputError: data sets without the split, or without pairs in it; no such run; a predictions file of other data
            or of another checkpoint than the run that is given with it.
        MachineError: the disk refused.
    """
    if options.threads:
        torch.set_num_threads(options.threads)
    for path in (options.json, options.csv, options.tex, options.predictions):
        if path is not None and not path.parent.is_dir():
            raise InputError(path, "its folder does not exist", "name a file in a folder that exists")
    if options.pictures is not None and find_spec("matplotlib") is None:
        raise InputError("matplotlib", "is not installed", "pip install 'augkitti[view]', or leave --pictures out")
    sets = _Sets(options.data, options.split)
    with ExitStack() as stack:
        file = options.predictions
        if file is not None and file.exists():
            found = stack.enter_context(Predictions(file))
            settings = _settings_of(found, options.run)
            note(f"{file}: {len(found):,} predictions, scored as they are")
        else:
            if file is None:
                file = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "predictions.parquet"
            settings = _predict_to(file, sets, options)
            found = stack.enter_context(Predictions(file))
        rules = Rules.of(settings)
        if rules.category in (options.neutral or ()):
            raise InputError("--neutral", f"{rules.category} is foreground, so it cannot be neutral", "leave it out")
        if options.neutral is not None:
            rules = replace(rules, neutral=options.neutral)
        if options.least_points is not None:
            rules = replace(rules, least_points=options.least_points)
        predictors = [lambda pair: found.of(pair.pair_id, len(pair.scan0)), *baseline_predictors()]
        pairs = counted(sets.pairs(options.limit), sets.count(options.limit), "pairs scored")
        about = {key: value for key, value in found.about.items() if key != "settings"}
        report = score_pairs(pairs, predictors, rules).report(about)
        evaluated_on = "+".join(path.resolve().name for path in options.data)
        _write(options.json, lambda it: as_json(it.as_json()), report)
        _write(options.csv, as_csv, report)
        _write(options.tex, lambda its: as_latex(its, evaluated_on), report)
        if is_json():
            print_json(report.as_json())
        else:
            print_report(report)  # after the files: its reader may leave early
        if options.pictures is not None:
            _draw(options.pictures, report, sets, found, rules)
    return report


def quick_figures(
    network: PointFlowNet, settings: Settings, data: Sequence[tuple[Path, float]], split: str, limit: int, team: Team
) -> dict[str, float | None]:
    """Figures for the training log, on pairs spread over the split; empty where a data set has none."""
    if why_no_figures(data, split) is not None:
        return {}
    sets = [open_split(folder, split) for folder, _ in data]
    predictor = Predictor(network, settings, team)
    each = max(limit // len(sets), 1)
    pairs = (one[k * len(one) // min(each, len(one))] for one in sets for k in range(min(each, len(one))))
    report = score_pairs(pairs, [predictor], Rules.of(settings)).report()
    rows = {row["method"]: row for row in report.rows}
    wanted = ("fg_epe", "bg_epe", "obj_rot", "obj_tr_centre", "ego_rot", "ego_tr", "ap_bev50", "rigid_tr_local")
    return {**{name: rows["direct"][name] for name in wanted}, "fg_dense": rows["dense"]["fg_epe"]}


def why_no_figures(data: Sequence[tuple[Path, float]], split: str) -> str | None:
    """What is wrong with a split of some data sets; None where all have it.

    Raises:
        InputError: no split has that name.
    """
    if split not in SPLIT_NAMES:
        raise InputError("--validation", f"`{split}` is no split", f"give {', '.join(SPLIT_NAMES)}, or none")
    try:
        for folder, _ in data:
            open_split(folder, split)
    except InputError as err:
        return str(err)
    return None


class _Sets:
    """Data sets, one after the other. Where there are several, their names go before those of their pairs.

    Plain and augmented pairs of the same frames are named alike.
    """

    def __init__(self, folders: Sequence[Path], split: str | None) -> None:
        places = [folder.resolve() for folder in folders]
        if not places:
            raise InputError("--data", "names no data set", "give a folder made by `augkitti generate`")
        for number, place in enumerate(places):
            if place in places[:number]:
                raise InputError(folders[number], "is given twice", "give each data set once")
        names = [place.name for place in places]
        if len(set(names)) < len(names):
            names = [str(place) for place in places]
        before = [f"{name}:" for name in names] if len(names) > 1 else [""]
        self._sets = {name: open_split(folder, split) for name, folder in zip(before, folders, strict=True)}

    def count(self, limit: int | None) -> int:
        """Of pairs, at most `limit` of each set."""
        return sum(min(len(data), limit or len(data)) for data in self._sets.values())

    def pairs(self, limit: int | None) -> Iterator[AugmentedPair]:
        """Of all sets, at most `limit` of each."""
        for before, data in self._sets.items():
            for pair in islice(data, limit):
                yield replace(pair, pair_id=before + pair.pair_id)

    def find(self, name: str) -> AugmentedPair:
        """A pair by the name that it has here."""
        before, data = next((key, data) for key, data in self._sets.items() if name.startswith(key))
        return replace(data[name.removeprefix(before)], pair_id=name)


def open_split(folder: Path, split: str | None) -> Dataset:
    """A data set's split, or all of it.

    Raises:
        InputError: there is none, it has no splits, or no pair in this one.
    """
    if split is not None and not (folder / "splits.json").is_file() and (folder / "dataset.json").is_file():
        raise InputError(folder, "has no splits", f"run `augkitti split {folder}`, or give --split all")
    data = open_dataset(folder, split)
    if not len(data):
        raise InputError(
            folder, f"holds no pair in {split or 'any shard'}", "generate more recordings, and split again"
        )
    return data


def _predict_to(file: Path, sets: _Sets, options: EvaluateOptions) -> Settings:
    """Predict all pairs to a file; the network's settings."""
    path = shipped_checkpoint() if options.run is None else options.run
    checkpoint = load_checkpoint(path)
    network = network_of(checkpoint, path)
    about = {
        "program_version": augkitti.__version__,
        "checkpoint": "shipped" if options.run is None else path.resolve().name,
        "weights": _fingerprint(checkpoint),
        "step": checkpoint.step,
        "data": [folder.resolve().name for folder in options.data],
        "split": options.split or "all",
        "settings": checkpoint.settings.model_dump(mode="json", by_alias=True),
    }
    with team_of(options.device, options.precision) as team:
        predictor = Predictor(network, checkpoint.settings, team)
        pairs = counted(sets.pairs(options.limit), sets.count(options.limit), "pairs predicted")
        try:
            write_predictions(file, predict_pairs(predictor, pairs), about)
        except OSError as err:
            raise MachineError(file, f"cannot be written ({err.strerror})", "free space, or give another file") from err
    return checkpoint.settings


def _settings_of(found: Predictions, run: Path | None) -> Settings:
    """The settings with which a file was predicted.

    Raises:
        InputError: it was predicted by another checkpoint than that of `run`, if one is given.
    """
    if run is not None and found.about.get("weights") != _fingerprint(load_checkpoint(run)):
        raise InputError(
            found.path, f"was predicted by another checkpoint than {run}", "leave the run out, or name another file"
        )
    if "settings" not in found.about:  # another program's
        return load_checkpoint(shipped_checkpoint() if run is None else run).settings
    try:
        return Settings.model_validate(found.about["settings"])
    except ValidationError as err:
        raise InputError(found.path, "holds settings that this program does not know", "predict again") from err


def _fingerprint(checkpoint: Checkpoint) -> str:
    """sha256 of configuration and weights: two checkpoints with the same one predict the same."""
    digest = hashlib.sha256(checkpoint.settings.digest().encode())
    for name, values in sorted(checkpoint.weights.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(values.numpy()).tobytes())
    return digest.hexdigest()


def _write(path: Path | None, text: Callable[[Report], str], report: Report) -> None:
    if path is None:
        return
    try:
        write_text(path, text(report))
    except OSError as err:
        raise MachineError(path, f"cannot be written ({err.strerror})", "give another file") from err


def _draw(folder: Path, report: Report, sets: _Sets, found: Predictions, rules: Rules) -> None:
    """The best, median and worst pair of the network by error over all points."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise MachineError(folder, f"cannot be made ({err.strerror})", "give another folder") from err
    method = METHOD if METHOD in found.methods else found.methods[0]
    errors = {one["pair_id"]: one for one in report.per_pair[method]}
    for which, name in report.telling_pairs(method).items():
        pair = sets.find(name)
        one = found.of(name, len(pair.scan0))
        sure = slice(0) if one.scores is None else one.scores >= rules.score
        boxes, motions, scores = (None if part is None else part[sure] for part in (one.boxes, one.motions, one.scores))
        parts = ((part, errors[name][f"{part}_epe"]) for part in ("fg", "bg"))
        figures = ", ".join(f"{part.upper()} {error:.3f} m" for part, error in parts if error is not None)
        draw_flow(
            folder / f"{which}.png", pair.scan0.xyz, one.flows[method], one.where, limits_of(rules.grid),
            pair.ego_motion, boxes, motions, scores, truth=pair.flow0, known=pair.flow_status0 == 0,
            true_boxes=np.array([item.box0 for item in pair.objects if item.box0 is not None]).reshape(-1, 7),
            title=f"{which} pair by {method} flow: {name}, {figures}",
        )  # fmt: skip
        note(f"{folder / f'{which}.png'}: {name}")
