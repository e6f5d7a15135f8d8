"""The command that redoes the paper's experiments: runs and data sets in; Tables 1 and 2 and its figures out.

`COMPARED` is what stands beside the network: one record more is one row more in every file and on the page.
"""

import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from augkitti.command_line import as_json, note, signed
from augkitti.dataset_index import write_text
from augkitti.errors import InputError, MachineError
from training.baselines import ego_registration, ego_true, zero
from training.baselines.clusters import ego_icp_clusters
from training.baselines.dewan import dewan, dewan_strong
from training.baselines.fpfh import fpfh, fpfh_strong
from training.baselines.icp import icp, icp_strong
from training.baselines.three_d_match import three_d_match, three_d_match_strong
from training.paper_figures import draw_all
from training.paper_scores import (
    MIXED,
    SPLITS,
    Again,
    Boxes,
    Compared,
    PaperSets,
    Results,
    TrainedRun,
    compare,
    load_runs,
)
from training.paper_tables import FIGURES, REFERENCE, latex_of, lines_of
from training.tables_page import captions_of, page_of
from training.team import Precision, Team, team_of

SLOW = 10  # pairs of each set, for methods that describe every keypoint by a network
COMPARED: tuple[Compared, ...] = (
    Compared("zero", "Nothing moves", zero, kind=REFERENCE),
    Compared("ego_true", "True ego-motion, all stands", ego_true, kind=REFERENCE),
    Compared("ego_registration", "GICP ego-motion, all stands", ego_registration),
    Compared("icp", "ICP+Det.", icp, "ICP+Det."),
    Compared("icp_strong", "ICP+Det., strong", icp_strong),
    Compared("clusters", "GICP, ICP of clusters", ego_icp_clusters),
    Compared("3dmatch", "3DMatch+Det.", three_d_match, "3DMatch+Det.", most_pairs=SLOW),
    Compared("3dmatch_strong", "3DMatch+Det., strong", three_d_match_strong, most_pairs=SLOW),
    Compared("fpfh", "FPFH+Det.", fpfh, "FPFH+Det."),
    Compared("fpfh_strong", "FPFH+Det., strong", fpfh_strong),
    Compared("dewan", "Dewan et al.+Det.", dewan, "Dewan et al.+Det.", valid_only=True),
    Compared("dewan_strong", "Dewan et al.+Det., strong", dewan_strong, valid_only=True),
)


@dataclass(frozen=True)
class TablesOptions:
    """What is asked for."""

    data: Path  # augmented pairs
    kitti_data: Path  # plain ones
    out: Path
    k_runs: tuple[Path, ...] = ()  # trained on K, one a seed
    k_ak_runs: tuple[Path, ...] = ()  # trained on K and AK; none: the shipped checkpoint
    limit: int | None = None  # pairs of each set and split, spread over it
    boxes: Boxes = "network"  # whose boxes the baselines follow
    jobs: int = 1  # processes that run the baselines; with more than one each has a single thread
    threads: int | None = None
    device: str = "auto"
    precision: Precision = "auto"
    fig3b: tuple[int, int] = (2, 200)  # seeds and steps a network


def tables(options: TablesOptions, compared: Sequence[Compared] | None = None) -> Results:
    """The command: `index.html`, `tables.tex`, `tables.json` and `figures/` in a folder.

    Args:
        options: what is asked for.
        compared: what stands beside the network; `COMPARED` where not given.

    Raises:
        InputError: data sets without the splits, or without pairs in them; runs that are none or do not fit each other.
        MachineError: the disk refused.
    """
    compared = COMPARED if compared is None else compared
    if options.threads:
        torch.set_num_threads(options.threads)
    if len(options.k_ak_runs) < len(options.k_runs):
        counts = f"{len(options.k_runs)} runs trained on K, {len(options.k_ak_runs)} on K and AK"
        raise InputError("--runs", counts, "name a K+AK run behind each: --runs runs/k runs/k_ak")
    if find_spec("matplotlib") is None:
        raise InputError("matplotlib", "is not installed", "pip install 'augkitti[view]'")
    sets = PaperSets(options.kitti_data, options.data, options.limit)
    _make_folder(options.out / "figures")
    with team_of(options.device, options.precision) as team:
        runs = load_runs(options.k_runs, options.k_ak_runs, team)
        found = compare(sets, runs, compared, options.boxes, options.jobs)
        found.about.update(_about(options, runs, team))
        _print_tables(found.rows)
        again = Again(sets, runs, compared, options.boxes, found.rules)
        # before the figures: minutes of scoring are safe then
        _write(options.out / "tables.json", as_json(found.as_json()))
        _write(options.out / "tables.tex", latex_of(found.rows, captions_of(found)))
        pictures = draw_all(options.out / "figures", found, again, runs[-1].predictor.network, options.fig3b)
    _write(options.out / "index.html", page_of(found, pictures))
    note(f"{options.out / 'index.html'}: tables and {len(pictures)} figures; tables.tex and tables.json beside it")
    return found


def _about(options: TablesOptions, runs: Sequence[TrainedRun], team: Team) -> dict[str, Any]:
    return {
        "data": {"K": options.kitti_data.resolve().name, "AK": options.data.resolve().name},
        "limit": options.limit,
        "boxes": options.boxes,
        "boxes_of": None if options.boxes == "truth" else next(run.name for run in runs if run.trained_on == MIXED),
        "runs": [{"name": run.name, "trained_on": run.trained_on, "step": run.step} for run in runs],
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "jobs": options.jobs,
            "device": torch.cuda.get_device_name(team.device) if team.device.type == "cuda" else team.device.type,
        },
    }


def _processor() -> str:
    """Its model, as far as the system tells."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def _write(path: Path, text: str) -> None:
    try:
        write_text(path, text)
    except OSError as err:
        raise MachineError(path, f"cannot be written ({err.strerror})", "free space, or give another --out") from err


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as err:
        raise InputError(folder, f"cannot be made ({err.strerror})", "give another --out") from err


def _print_tables(rows: Sequence[Mapping[str, Any]]) -> None:
    """Both on the screen, the paper's figures in brackets."""
    for table in SPLITS:
        shown = Table(
            title=signed(f"Table {table}, {SPLITS[table]}"), box=SIMPLE_HEAD, title_justify="left", pad_edge=False
        )
        for heading in ("set", "method", "trained on", *(f"{heading}\n{key}" for key, heading, _ in FIGURES), "s/pair"):
            shown.add_column(heading, no_wrap=True)
        for line in lines_of(rows, table):
            cells = []
            for key, _, digits in FIGURES:
                one, paper = line.figure(key), line.paper.get(key)
                text = "-" if one is None else f"{one.mean:.{digits + 1}f}"
                cells.append(text if paper is None else f"{text} ({paper:.{digits}f})")
            seconds = line.figure("seconds")
            shown.add_row(
                line.eval_set,
                line.label,
                line.trained_on or "",
                *cells,
                "" if seconds is None else f"{seconds.mean:.2f}",
            )
        Console(width=200).print(shown)
