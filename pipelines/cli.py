"""The `augkitti` command: arguments in, one library call, an exit code out.

0: done; 1: fewer pairs than asked for, or a check found something; 2: bad input; 3: the machine gave way (disk, memory,
a worker); 130: interrupted (SIGINT); 143: ended (SIGTERM). From 2 on: one line on stderr.
Heavy imports stand inside the commands, so that `augkitti --help` answers at once.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from augkitti import command_line
from augkitti.errors import InputError, MachineError
from augkitti.remote import as_path


class _Group(command_line.Group):
    json_may_name_a_file = ("validate", "fit-sensor", "judge-noise")


app = typer.Typer(cls=_Group, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
config_app = typer.Typer(no_args_is_help=True, help="Every setting of generation.")
cad_app = typer.Typer(no_args_is_help=True, help="Car models.")
data_app = typer.Typer(no_args_is_help=True, help="KITTI on disk.")
cache_app = typer.Typer(no_args_is_help=True, help="What runs keep for the next one.")
app.add_typer(config_app, name="config")
app.add_typer(cad_app, name="cad")
app.add_typer(data_app, name="data")
app.add_typer(cache_app, name="cache")


def _place(text: str) -> Path:
    """A local folder, or an address such as `s3://bucket/folder`."""
    try:
        return as_path(str(text))
    except InputError as err:
        raise typer.BadParameter(str(err)) from None


DEFAULT_OUT = Path("augkitti-data")
EXPORTS = ("opensceneflow", "av2", "semantickitti", "kitti-object", "hplflownet")  # `augkitti.export` is slow to import

Kitti = Annotated[
    Path | None,
    typer.Option(
        parser=_place,
        metavar="PATH",
        envvar="AUGKITTI_KITTI",
        help="Folder with KITTI in it, or an address: s3://bucket/kitti. Without: embedded streets.",
    ),
]
Out = Annotated[Path, typer.Option(parser=_place, metavar="PATH", help="Folder of the data set.")]
Folder = Annotated[
    Path, typer.Argument(parser=_place, metavar="[DATASET]", help="Folder of the data set.", show_default=True)
]
Jobs = Annotated[int, typer.Option(min=1, help="Processes.")]
Scheduler = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers make the shards: tcp://host:8786.")
]
Seed = Annotated[int, typer.Option(min=0, help="Of everything that is drawn.")]
Cad = Annotated[
    Path | None, typer.Option(parser=_place, metavar="PATH", help="Folder of car models. Without: cars made in code.")
]
Pairs = Annotated[int, typer.Option("--n", min=1, help="Pairs to make.")]
Cars = Annotated[str | None, typer.Option(metavar="1-3", help="Virtual cars a pair; 0: plain pairs, labels only.")]
Categories = Annotated[
    list[str] | None, typer.Option(help="KITTI categories of virtual cars: Car, Van, Truck; repeat, or commas.")
]
MinPoints = Annotated[int | None, typer.Option(help="Returns that each car has at least, in both scans.")]
Glass = Annotated[Literal["pass", "opaque"] | None, typer.Option(help="Whether panes let the pulse through.")]
Shutter = Annotated[
    Literal["rolling", "snapshot"] | None, typer.Option(help="Each ray at its own firing time, or all at once.")
]
Profile = Annotated[
    Path | None,
    typer.Option(help="Scanner profile: hdl32e, or a file (JSON, YAML) or folder. Without: KITTI's HDL-64E."),
]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Settings (YAML); see `augkitti config show`.")]
OnError = Annotated[Literal["skip", "stop"], typer.Option(help="Leave out pairs whose source is unreadable, or stop.")]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with an unfinished run.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
JsonFile = Annotated[
    str | None,
    typer.Option("--json", metavar="[FILE]", help="Print JSON instead of tables; with a file: write it there, too."),
]


def _print_version(wanted: bool) -> None:
    if wanted:
        import augkitti

        print(f"augkitti {augkitti.__version__}")
        raise typer.Exit


@app.callback()
def _augkitti(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Nothing but errors and what was asked for.")] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", help="Versions, settings, times; the traceback behind an error.")
    ] = False,
) -> None:
    """Augmented KITTI: virtual cars with exact motion labels in real LiDAR scans."""
    command_line.begin(quiet, verbose)


_GO_ON = "; finished shards are kept, go on with --resume"


@contextmanager
def _answers(at_end: str = "", json: bool = False) -> Iterator[None]:
    """Bad input: one line on stderr, exit code 2. The machine gave way: 3. Interrupted: 130. Told to end: 143."""
    command_line.json_alone(json)
    for library in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM", "NUMEXPR"):  # read when numpy is imported, below
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")  # processes share the work, not threads
    before = _on_sigterm(_terminated)
    try:
        yield
    except InputError as err:
        command_line.trace()
        print(f"augkitti: {err}", file=sys.stderr)
        raise typer.Exit(2) from None
    except MachineError as err:
        command_line.trace()
        print(f"augkitti: {err}", file=sys.stderr)
        raise typer.Exit(3) from None
    except _Terminated:
        print(f"augkitti: told to end{at_end}", file=sys.stderr)
        raise typer.Exit(143) from None
    except BrokenProcessPool:
        print("augkitti: a worker process was killed; use fewer --jobs, memory may be short", file=sys.stderr)
        raise typer.Exit(3) from None
    except KeyboardInterrupt:
        print(f"augkitti: interrupted{at_end}", file=sys.stderr)
        raise typer.Exit(130) from None
    except BrokenPipeError:  # `augkitti ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(0) from None
    finally:
        _on_sigterm(before)


class _Terminated(BaseException):
    """SIGTERM came."""


def _terminated(number: int, frame: Any) -> None:
    raise _Terminated


def _on_sigterm(answer: Any) -> Any:
    """Set what answers SIGTERM; what did before. Only the main thread may."""
    if threading.current_thread() is threading.main_thread():
        return signal.signal(signal.SIGTERM, answer)
    return None


@app.command()
def generate(
    kitti: Kitti = None,
    cad: Cad = None,
    out: Out = DEFAULT_OUT,
    n: Pairs = 20,
    seed: Seed = 0,
    jobs: Jobs = 1,
    cars: Cars = None,
    categories: Categories = None,
    min_points: MinPoints = None,
    glass: Glass = None,
    shutter: Shutter = None,
    profile: Profile = None,
    config: ConfigFile = None,
    on_error: OnError = "skip",
    resume: Resume = False,
    scheduler: Scheduler = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Print the plan with disk and time; touch nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Real scan pairs in, the same with virtual cars and exact motion labels out, as Parquet shards."""
    with _answers(_GO_ON, json):
        from pipelines.generate import generate as run
        from pipelines.run import read_options

        options = read_options(
            kitti=kitti, cad=cad, out=out, n=n, seed=seed, config=config, profile=profile,
            stop_on_error=on_error == "stop", cars=_cars(cars), categories=_categories(categories),
            min_points=min_points, glass=glass, shutter=shutter,
        )  # fmt: skip
        raise typer.Exit(run(options, jobs=jobs, resume=resume, dry_run=dry_run, scheduler=scheduler))


@app.command()
def prepare(
    kitti: Kitti = None,
    cad: Cad = None,
    out: Out = DEFAULT_OUT,
    n: Pairs = 20,
    seed: Seed = 0,
    jobs: Jobs = 1,
    cars: Cars = None,
    categories: Categories = None,
    min_points: MinPoints = None,
    glass: Glass = None,
    shutter: Shutter = None,
    profile: Profile = None,
    config: ConfigFile = None,
    on_error: OnError = "skip",
    resume: Resume = False,
) -> None:
    """Stage 1 of generate. Reads scans and drive files; writes the cache, and the plan to OUT/.augkitti-work."""
    with _answers(_GO_ON):
        from pipelines.generate import prepare_stage
        from pipelines.run import read_options

        options = read_options(
            kitti=kitti, cad=cad, out=out, n=n, seed=seed, config=config, profile=profile,
            stop_on_error=on_error == "stop", cars=_cars(cars), categories=_categories(categories),
            min_points=min_points, glass=glass, shutter=shutter,
        )  # fmt: skip
        prepare_stage(options, jobs=jobs, resume=resume)


@app.command()
def augment(out: Folder = DEFAULT_OUT, jobs: Jobs = 1, scheduler: Scheduler = None) -> None:
    """Stage 2 of generate. Reads the plan, scans, cache, car models; writes OUT/data/*.parquet and a row for each."""
    with _answers():
        from pipelines.generate import augment_stage

        augment_stage(out, jobs=jobs, scheduler=scheduler)


@app.command()
def finish(out: Folder = DEFAULT_OUT, json: Json = False) -> None:
    """Stage 3 of generate. Reads the plan and the shards' rows; writes dataset.json and README.md."""
    with _answers(json=json):
        from pipelines.generate import finish_stage

        raise typer.Exit(finish_stage(out))


@app.command()
def split(
    out: Folder = DEFAULT_OUT,
    ratios: Annotated[tuple[float, float, float], typer.Option(help="Train, validation, test.")] = (70.0, 10.0, 20.0),
    seed: Seed = 0,
    like: Annotated[Path | None, typer.Option(help="A splits.json whose recordings to follow.")] = None,
    test_on: Annotated[
        list[str] | None,
        typer.Option(
            metavar="RECORDING", help="To test on, whatever the ratios: 2011_09_26_drive_0013; repeat, or commas."
        ),
    ] = None,
    allow_frames_split: Annotated[
        bool, typer.Option("--allow-frames-split", help="May divide one recording, with a gap: toy sets only.")
    ] = False,
    json: Json = False,
) -> None:
    """Divide the data set by recording; writes splits.json and the card's header."""
    with _answers(json=json):
        from pipelines.inspect_set import split_set

        named = [name for text in test_on or [] for name in text.split(",") if name]
        if named and like is not None:
            raise InputError("--test-on", "and --like say both what to test on", "give one of them")
        split_set(out, ratios, seed, like, allow_frames_split, named)


@app.command()
def validate(
    out: Folder = DEFAULT_OUT,
    kitti: Kitti = None,
    jobs: Jobs = 1,
    json: JsonFile = None,
) -> None:
    """Check every invariant of the contract on every pair."""
    with _answers(json=json == "-"):
        from pipelines.inspect_set import validate_set

        raise typer.Exit(validate_set(out, kitti, jobs, _json_file(json)))


@app.command()
def view(
    folder: Folder = DEFAULT_OUT,
    pair: Annotated[str | None, typer.Option(help="Pair id. Without: several, or the first.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            parser=_place,
            metavar="PATH",
            help="Folder of pages to write, a picture (x.png), or with --rerun a recording (x.rrd). "
            "Without: augkitti-view.",
        ),
    ] = None,
    pairs: Annotated[int, typer.Option(min=1, help="Most pages, of pairs evenly spread over the set.")] = 24,
    kitti: Kitti = None,
    cad: Cad = None,
    jobs: Jobs = 1,
    rerun: Annotated[bool, typer.Option("--rerun", help="Send a pair to rerun (pip install rerun-sdk).")] = False,
    browse: Annotated[bool, typer.Option("--open", help="Open the index page in a browser.")] = False,
) -> None:
    """Write pages that show pairs in 3D and open from disk; or one picture, or a pair in rerun."""
    with _answers():
        from pipelines.view import view as run
        from pipelines.view import view_in_rerun

        if rerun:
            view_in_rerun(folder, pair, out, kitti)
            return
        written = run(folder, pair, out, kitti, cad, pairs, jobs)
        if browse:
            import webbrowser

            webbrowser.open(written.resolve().as_uri())


@app.command()
def info(
    folder: Folder = DEFAULT_OUT,
    json: Json = False,
    out: Annotated[Path | None, typer.Option(help="Picture to write (PNG).")] = None,
    kitti: Kitti = None,
) -> None:
    """Totals, car points, speeds and yaw rates, beside the labelled motions of real KITTI."""
    with _answers(json=json):
        from pipelines.inspect_set import show_info

        show_info(folder, out, kitti)


@app.command()
def croissant(
    folder: Folder = DEFAULT_OUT,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Beside the data set, not in it.")] = Path("croissant.json"),
    url: Annotated[str | None, typer.Option(help="Of the page that publishes the data set.")] = None,
    published: Annotated[
        datetime | None, typer.Option(formats=["%Y-%m-%d"], help="Date to give. Without: today.", show_default=False)
    ] = None,
) -> None:
    """Write Croissant 1.1 metadata (JSON-LD): every shard with its sha256, every column, the splits."""
    with _answers():
        from pipelines.inspect_set import describe_set

        describe_set(folder, out, url, (published or datetime.now(UTC)).date())


@app.command()
def export(
    folder: Folder = DEFAULT_OUT,
    form: Annotated[
        str,
        typer.Option("--format", metavar="F", help=f"{', '.join(EXPORTS)}.", autocompletion=lambda: list(EXPORTS)),
    ] = "",
    out: Annotated[Path | None, typer.Option(parser=_place, metavar="DIR", help="Folder of the export.")] = None,
    split: Annotated[str | None, typer.Option(help="train, validation or test. Without: all pairs.")] = None,
) -> None:
    """Write the data set in a form that other programs read; an interrupted export goes on."""
    with _answers("; finished pairs are kept, the same command goes on"):
        from pipelines.export import export_set

        if out is None:
            raise InputError("--out", "not given", "name a folder for the export")
        export_set(folder, form, out, split)


@app.command()
def synthesize(
    out: Out,
    drives: Annotated[int, typer.Option(min=1, help="Streets.")] = 10,
    frames: Annotated[int, typer.Option(min=1, help="Scans of each.")] = 40,
    seed: Seed = 0,
    jobs: Jobs = 1,
    profile: Profile = None,
) -> None:
    """Write procedural streets, scanned with the shipped profile, in KITTI's raw layout."""
    with _answers():
        from pipelines.inspect_set import synthesize_drives

        synthesize_drives(out, drives, frames, seed, jobs, profile)


@app.command()
def realism(
    dataset: Annotated[
        Path | None,
        typer.Argument(parser=_place, metavar="[DATASET]", help="Data set whose own cars are judged too."),
    ] = None,
    kitti: Kitti = None,
    cad: Cad = None,
    out: Annotated[Path, typer.Option(help="Folder of the report.")] = Path("realism-report"),
    resimulate: Annotated[
        bool, typer.Option("--resimulate", help="Compare real and simulated cars ray by ray, too.")
    ] = False,
    seed: Seed = 0,
    max_tracks: Annotated[int | None, typer.Option(min=1, help="Stop after so many labelled cars.")] = None,
    views: Annotated[int, typer.Option(min=1, help="Most views of one car.")] = 12,
    profile: Profile = None,
    json: Json = False,
) -> None:
    """Prove how real simulated cars are: one HTML report beside real labelled cars, with a verdict at the top."""
    with _answers(json=json):
        from pipelines.realism import realism as run

        code = run(
            dataset,
            kitti,
            cad,
            out,
            resimulate,
            profile=profile,
            seed=seed,
            max_tracks=max_tracks,
            views_of_a_track=views,
        )
        raise typer.Exit(code)


@app.command("fit-sensor")
def fit_sensor(
    kitti: Kitti = None,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Profile's folder, written.")] = Path("profile"),
    json: JsonFile = None,
) -> None:
    """Learn a scanner's beam table, encoder, spin, steps and shadow from raw scans alone."""
    with _answers(json=json == "-"):
        from pipelines.fit_sensor import fit_sensor as run

        run(_needed(kitti), out, _json_file(json))


@app.command("fit-noise")
def fit_noise(
    kitti: Kitti = None,
    profile: Annotated[
        Path, typer.Option(metavar="DIR", help="Profile's folder, written; its profile.json, if any, is the scanner.")
    ] = Path("profile"),
    cad: Cad = None,
    no_compare: Annotated[
        bool, typer.Option("--no-compare", help="Do not judge models on drives left out; one drive is enough then.")
    ] = False,
    no_vehicles: Annotated[
        bool, typer.Option("--no-vehicles", help="Leave what labelled vehicles return as it is.")
    ] = False,
    seed: Seed = 0,
) -> None:
    """Learn range noise, drops, range steps and what vehicles return from raw scans; needs torch (extra `fit`)."""
    with _answers():
        from pipelines.fit_noise import fit_noise as run

        run(_needed(kitti), profile, cad, compare=not no_compare, vehicles=not no_vehicles, seed=seed)


@app.command("judge-noise")
def judge_noise(
    kitti: Kitti = None,
    profile: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder that `augkitti fit-noise` wrote. Without: the shipped."),
    ] = None,
    json: JsonFile = None,
) -> None:
    """Print how well a noise profile foretells any raw scans: a constant, both models, the shipped one."""
    with _answers(json=json == "-"):
        from pipelines.judge_noise import judge_noise as run

        run(_needed(kitti), profile, _json_file(json))


@config_app.command("show")
def config_show(config: ConfigFile = None, json: Json = False) -> None:
    """Print each key with its value and one line of why; valid YAML."""
    with _answers(json=json):
        from pipelines.inspect_set import show_config

        show_config(config)


@cad_app.command("check")
def cad_check(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of car models.")],
    sheet: Annotated[Path | None, typer.Option(help="Contact sheet to write (PNG).")] = None,
    json: Json = False,
) -> None:
    """Print what each model of a folder is taken for, and why."""
    with _answers(json=json):
        from pipelines.inspect_set import check_cad

        raise typer.Exit(check_cad(folder, sheet))


@data_app.command("status")
def data_status(kitti: Kitti = None, json: Json = False) -> None:
    """Compare a disk with the manifest of KITTI: what is there, missing, cut short, what to fetch."""
    with _answers(json=json):
        from pipelines.inspect_set import show_data_status

        raise typer.Exit(show_data_status(kitti))


@cache_app.command("info")
def cache_info(json: Json = False) -> None:
    """Print where the cache is, what it keeps, and how large it may become ($AUGKITTI_CACHE_GB)."""
    with _answers(json=json):
        from pipelines.cache import show_cache

        show_cache()


@cache_app.command("clear")
def cache_clear() -> None:
    """Remove all that the cache keeps; the next run makes it again."""
    with _answers():
        from pipelines.cache import cache_folder, clear

        count, size = clear(cache_folder())
        command_line.note(f"{count:,} entries removed, {size / 1e9:,.2f} GB")


def _json_file(text: str | None) -> Path | None:
    """The file that `--json` names; None where it prints, or was not given."""
    if text is not None and Path(text).is_dir():
        raise InputError(f"--json {text}", "is a folder", "give --json last, or a file to write")
    return None if text in (None, "-") else Path(str(text))


def _needed(kitti: Path | None) -> Path:
    if kitti is None:
        raise InputError("--kitti", "not given", "name the folder with KITTI in it, or set AUGKITTI_KITTI")
    return kitti


def _cars(text: str | None) -> tuple[int, int] | None:
    """`1-3` or `2` as a range."""
    if text is None:
        return None
    first, dash, last = text.partition("-")
    if not (first.isdecimal() and (last.isdecimal() if dash else True)):
        raise InputError("--cars", f"`{text}` is no range", "give 1-3, 2 or 0")
    return int(first), int(last if dash else first)


def _categories(names: list[str] | None) -> tuple[str, ...] | None:
    return tuple(name.strip() for part in names for name in part.split(",") if name.strip()) if names else None


def main() -> None:
    """Entry point of the command."""
    app(prog_name="augkitti")
