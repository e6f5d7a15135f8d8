"""The `pointflownet` command: arguments in, one call, an exit code out.

0: done; 2: bad input; 3: the machine gave way (disk, memory); 130: interrupted. From 2 on: one line on stderr.
Heavy imports stand inside the commands, so that `pointflownet --help` answers at once.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

import typer

from augkitti import command_line
from augkitti.errors import InputError, MachineError


class _Group(command_line.Group):
    json_may_name_a_file = ("evaluate",)


app = typer.Typer(cls=_Group, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)

Data = Annotated[
    list[str],
    typer.Option("--data", metavar="DIR[=WEIGHT]", help="Data set; repeat to mix. A pair comes WEIGHT times an epoch."),
]
Config = Annotated[str, typer.Option("--config", help="paper, small, or a YAML file like training/configs/paper.yaml.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Precision = Annotated[Literal["auto", "fp32", "bf16"], typer.Option(help="auto: bf16 where it is quicker (GPU, AMX).")]
Threads = Annotated[int | None, typer.Option(min=1, help="Of the processor, a process.")]
Run = Annotated[
    Path | None,
    typer.Option("--run", metavar="DIR", help="A run's folder or checkpoint. Without: the shipped checkpoint."),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        import augkitti

        print(f"pointflownet {augkitti.__version__}")
        raise typer.Exit


@app.callback()
def _pointflownet(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Nothing but errors and what was asked for.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Versions; the traceback behind an error.")] = False,
) -> None:
    """PointFlowNet: scene flow, cars and their rigid motion from two LiDAR scans."""
    command_line.begin(quiet, verbose)


@contextmanager
def _answers(needs_torch: bool = True, at_interrupt: str = "") -> Iterator[None]:
    """Bad input: one line on stderr, exit code 2. The machine gave way: 3. Interrupted: 130."""
    try:
        if needs_torch:
            _find_torch()
        yield
    except InputError as err:
        command_line.trace()
        print(f"pointflownet: {err}", file=sys.stderr)
        raise typer.Exit(2) from None
    except MachineError as err:
        command_line.trace()
        print(f"pointflownet: {err}", file=sys.stderr)
        raise typer.Exit(3) from None
    except KeyboardInterrupt:
        print(f"pointflownet: interrupted{at_interrupt}", file=sys.stderr)
        raise typer.Exit(130) from None
    except BrokenPipeError:  # `pointflownet ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(0) from None


def _find_torch() -> None:
    from importlib.util import find_spec

    for name in ("torch", "shapely"):
        if find_spec(name) is None:
            raise InputError(name, "is not installed", "pip install 'augkitti[train]'")


@app.command()
def train(
    data: Data,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the run: checkpoint, settings, log.")],
    config: Config = "small",
    split: Annotated[str, typer.Option(help="Of the data sets to train on; all: no splits needed.")] = "train",
    validation: Annotated[str, typer.Option(help="Split for figures on the way; none: no figures.")] = "validation",
    steps: Annotated[int | None, typer.Option(min=1, help="Optimisation steps. Without: the settings' epochs.")] = None,
    minutes: Annotated[float | None, typer.Option(min=0.0, help="Stop then, whatever is left.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Instead of the settings'.")] = None,
    workers: Annotated[int, typer.Option(min=0, help="Processes that read and voxelise.")] = 0,
    threads: Threads = None,
    device: Device = "auto",
    precision: Precision = "auto",
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --out.")] = False,
    init: Annotated[Path | None, typer.Option(metavar="DIR", help="Start from the weights of a run.")] = None,
    save_every: Annotated[int, typer.Option(min=1, help="Steps between checkpoints.")] = 500,
    validate_every: Annotated[int, typer.Option(min=0, help="Steps between figures; 0: none.")] = 500,
) -> None:
    """Train on shards. Several processes: torchrun --nproc-per-node 2 -m training train ..."""
    with _answers(at_interrupt="; the last checkpoint is kept, go on with --resume"):
        from training.config import load_settings
        from training.train import TrainOptions
        from training.train import train as run

        settings = load_settings(config)
        if seed is not None:
            settings = settings.model_copy(update={"train": settings.train.model_copy(update={"seed": seed})})
        run(
            TrainOptions(
                data=_weighted(data), settings=settings, out=out, split=None if split == "all" else split,
                validation=None if validation == "none" else validation, steps=steps, minutes=minutes, workers=workers,
                threads=threads, device=device, precision=precision, resume=resume, init=init, save_every=save_every,
                validate_every=validate_every,
            )
        )  # fmt: skip


@app.command()
def evaluate(
    data: Annotated[
        list[Path], typer.Option("--data", metavar="DIR", help="Folder of a data set; repeat to score several as one.")
    ],
    run: Annotated[
        Path | None, typer.Argument(metavar="[RUN]", help="A run's folder or checkpoint. Without: the shipped one.")
    ] = None,
    split: Annotated[str, typer.Option(help="train, validation or test; all: no splits needed.")] = "test",
    json: Annotated[
        Path | None,
        typer.Option(metavar="[FILE]", help="Print JSON instead of tables; with a file: write it there, too."),
    ] = None,
    csv: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the rows there.")] = None,
    tex: Annotated[Path | None, typer.Option(metavar="FILE", help="Write rows as the paper's LaTeX there.")] = None,
    predictions: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Keep predictions there; a file that exists is scored.")
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw the best, median and worst pair there.")
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first pairs of each set.")] = None,
    neutral: Annotated[
        str, typer.Option(metavar="NAMES", help="Categories that count for nothing, with commas between; or none.")
    ] = "Van",
    least_points: Annotated[int, typer.Option(min=0, help="Boxes with fewer points are ignored.")] = 5,
    threads: Threads = None,
    device: Device = "auto",
    precision: Precision = "auto",
) -> None:
    """Predict to a file, then score it beside zero motion, true ego-motion and ego-motion by registration."""
    with _answers():
        from training.evaluate import EvaluateOptions
        from training.evaluate import evaluate as score

        command_line.json_alone(json == Path("-"))
        score(
            EvaluateOptions(
                run=run, data=tuple(data), split=None if split == "all" else split,
                json=None if json == Path("-") else json, csv=csv, tex=tex, predictions=predictions,
                pictures=pictures, limit=limit,
                neutral=() if neutral == "none" else tuple(name.strip() for name in neutral.split(",")),
                least_points=least_points, threads=threads, device=device, precision=precision,
            )
        )  # fmt: skip


@app.command()
def tables(
    data: Annotated[Path, typer.Option("--data", metavar="DIR", help="Augmented data set (AK), split.")],
    kitti_data: Annotated[Path, typer.Option("--kitti-data", metavar="DIR", help="Plain data set (K), split alike.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for index.html, tables.tex, tables.json, figures.")],
    k_runs: Annotated[
        list[Path] | None,
        typer.Option("--runs", metavar="K K_AK", help="A run trained on K and one trained on both; repeat for seeds."),
    ] = None,
    k_ak_runs: Annotated[
        list[Path] | None, typer.Argument(metavar="[K_AK]...", help="Runs trained on both. Without: the shipped one.")
    ] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Pairs of each set and split, spread over it.")] = None,
    boxes: Annotated[Literal["truth", "network"], typer.Option(help="Whose boxes the baselines follow.")] = "network",
    jobs: Annotated[
        int, typer.Option(min=1, help="Processes that run baselines; their times are then of a thread, side by side.")
    ] = 1,
    threads: Threads = None,
    device: Device = "auto",
    precision: Precision = "auto",
) -> None:
    """Tables 1 and 2 of the paper and its figures as one HTML page, LaTeX and JSON."""
    with _answers():
        from training.tables import TablesOptions
        from training.tables import tables as make

        make(
            TablesOptions(
                data=data, kitti_data=kitti_data, out=out, k_runs=tuple(k_runs or ()), k_ak_runs=tuple(k_ak_runs or ()),
                limit=limit, boxes=boxes, jobs=jobs, threads=threads, device=device, precision=precision,
            )
        )  # fmt: skip


@app.command()
def predict(
    scan0: Annotated[Path, typer.Argument(help="First scan: .bin (KITTI), .npy, .pcd or .ply.")],
    scan1: Annotated[Path, typer.Argument(help="Next scan.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help=".npz: xyz0, flow0, ego_motion, boxes, motions, scores.")],
    run: Run = None,
    picture: Annotated[Path | None, typer.Option(metavar="FILE", help="Draw the flow there, as PNG.")] = None,
    threads: Threads = None,
    device: Device = "auto",
    precision: Precision = "auto",
) -> None:
    """Flow, cars and motions of any two scans, without labels."""
    with _answers():
        from training.predict import predict_files

        predict_files(scan0, scan1, out, run, picture, threads, device, precision)


@app.command()
def equivariance(
    out: Annotated[Path, typer.Option(metavar="FILE", help="The chart, as PNG.")],
    seeds: Annotated[int, typer.Option(min=1, help="Networks a point of the chart.")] = 5,
    steps: Annotated[int, typer.Option(min=1, help="Optimisation steps a network.")] = 300,
) -> None:
    """Rigid motion from flow in world against local coordinates, the paper's Fig. 3b; 5 minutes on a core."""
    with _answers():
        from training.equivariance import equivariance as run

        run(out, seeds, steps)


@app.command("export")
def export(
    run: Annotated[Path, typer.Argument(help="A run's folder or checkpoint.")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="The checkpoint, weights alone, in half precision.")],
) -> None:
    """A finished run as one small file for `--run`."""
    with _answers():
        from training.checkpoint import export as write

        write(run, out)


def _weighted(data: list[str]) -> tuple[tuple[Path, float], ...]:
    """`aug` or `aug=0.5`; a folder whose name holds `=` may be given with a weight behind."""
    out = []
    for text in data:
        folder, sign, weight = text.rpartition("=")
        if not sign or Path(text).exists():
            out.append((Path(text), 1.0))
            continue
        try:
            out.append((Path(folder), float(weight)))
        except ValueError:
            raise InputError("--data", f"`{weight}` of `{text}` is no number", "give DIR or DIR=WEIGHT") from None
    return tuple(out)


def main() -> None:
    """Entry point of the command."""
    app(prog_name="pointflownet")


if __name__ == "__main__":
    main()
