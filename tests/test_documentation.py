"""Every code block of the README and of docs/ is run, or checked word by word where it says why it cannot be.

A block of `sh` or `python` runs as it stands, in its page's folder, by bash with `set -e` or by Python. What stands
in for what a reader has:

- the home folder is a temporary one, with `kitti` (a real drive and two odometry sequences where
  `AUGKITTI_TEST_KITTI` has them, else embedded streets in KITTI's layout) and `cars` (two car models);
- the working folder has `aug` and `kitti` as a reader would have them by then: a split set of the embedded street, and
  the streets behind it, and what earlier blocks of its page have made;
- `augkitti generate` makes at most `PAIRS` pairs; commands work in one process (`--jobs 1`).

A block that cannot run has `<!-- checked only: why -->` on the line above: then every option of our own commands in it
is parsed by the command itself, extras, targets and files are looked up, Python is compiled (tests/docs_runner.py).
`yaml` and `json` are parsed; `text` is passed over; a block that does not say what it is fails.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest
import yaml
from car_files import write_cars

ROOT = Path(__file__).resolve().parent.parent
REAL_DRIVE = "raw/2011_09_26/2011_09_26_drive_0002_sync"  # the shortest of the shared ones
PAIRS = 11  # of three streets, so that they can be split
PAGES = [ROOT / name for name in ("README.md", "CONTRIBUTING.md")] + sorted((ROOT / "docs").rglob("*.md"))
FENCE = re.compile(
    r"^(?P<indent> *)(?P<ticks>`{3,})(?P<kind>[^\n`]*)\n(?P<text>.*?)^(?P=indent)(?P=ticks)\s*$", re.M | re.S
)
MARK = re.compile(r"<!-- checked only: (.+?) -->\s*$")
RUN = {"sh": "sh", "bash": "sh", "python": "python", "py": "python"}


@dataclass(frozen=True)
class Block:
    page: Path
    line: int
    kind: str
    text: str
    why_not: str | None

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def blocks_of(page: Path) -> list[Block]:
    text = page.read_text()
    found = []
    for fence in FENCE.finditer(text):
        mark = MARK.search(text[: fence.start()])
        lines = [line.removeprefix(fence["indent"]) for line in fence["text"].splitlines()]
        line = text.count("\n", 0, fence.start()) + 1
        found.append(Block(page, line, fence["kind"].strip(), "\n".join(lines) + "\n", mark[1] if mark else None))
    return found


BLOCKS = [block for page in PAGES if page.is_file() for block in blocks_of(page)]
SHARED = ("aug", "kitti")


@pytest.fixture(scope="module")
def runner(tmp_path_factory):
    """A function that runs or checks a block in a folder: exit code and all that it printed."""
    for library in ("torch", "matplotlib", "datasets", "polars", "duckdb", "mlcroissant"):
        pytest.importorskip(library, reason="of requirements-dev.txt")
    place = tmp_path_factory.mktemp("docs")
    home = place / "home"
    home.mkdir()
    base = {name: value for name, value in os.environ.items() if not name.startswith(("AUGKITTI", "DOCS_"))}
    base |= {
        "HOME": str(home),
        "HF_HOME": str(place / "hf"),
        "HF_HUB_OFFLINE": "1",
        "AUGKITTI_CACHE": str(place / "cache"),
        "DOCS_PAIRS": str(PAIRS),
        "PYTHONPATH": str(ROOT),
        "PATH": f"{place / 'bin'}{os.pathsep}{os.environ['PATH']}",
    }
    words = [sys.executable, str(ROOT / "tests" / "docs_runner.py"), str(place)]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=base) as process:
        assert process.stdout.readline() == "ready\n"

        def run(text, kind, folder, checked):
            prelude = "set -e\n" + ("kill() { :; }\n" if checked else "")
            command = ["bash", "-c", prelude + text] if kind == "sh" else [str(place / "bin" / "python"), "-"]
            done = subprocess.run(
                command,
                input=None if kind == "sh" else text,
                stdin=subprocess.DEVNULL if kind == "sh" else None,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                cwd=folder,
                env=base | ({"DOCS_CHECK": "1"} if checked else {}),
                timeout=600,
                check=False,
            )
            return done.returncode, done.stdout

        real = Path(os.environ.get("AUGKITTI_TEST_KITTI", ROOT.parent / "shared" / "kitti"))
        code, told = run(f"augkitti generate --n {PAIRS} --out aug\naugkitti split aug\n", "sh", place, False)
        assert code == 0, told
        (streets,) = (path for path in (place / "cache" / "streets").iterdir() if path.is_dir())
        (place / "kitti").symlink_to(streets)
        if (real / REAL_DRIVE).is_dir() and (real / "odometry").is_dir():
            day = (home / "kitti" / REAL_DRIVE).parent
            day.mkdir(parents=True)
            for path in (real / REAL_DRIVE, *(real / REAL_DRIVE).parent.glob("calib_*.txt")):
                (day / path.name).symlink_to(path)
            (home / "kitti" / "odometry").symlink_to(real / "odometry")
        else:
            (home / "kitti").symlink_to(streets)
        write_cars(home / "cars")
        yield run, place
        process.stdin.close()


@pytest.fixture(scope="module")
def folders(runner):
    """The working folder of a page: one for all its blocks."""
    _, place = runner

    def folder(page):
        made = place / "pages" / page.stem
        if not made.is_dir():
            made.mkdir(parents=True)
            for name in SHARED:
                (made / name).symlink_to(place / name)
            (made / "pipelines").symlink_to(ROOT / "pipelines")  # its script is called from the checkout
        return made

    yield folder
    shutil.rmtree(place / "pages", ignore_errors=True)


def test_there_are_blocks_and_each_says_what_it_is():
    assert len(BLOCKS) > 25
    unknown = [block.name for block in BLOCKS if block.kind not in {*RUN, "yaml", "json", "text", "bibtex"}]
    assert not unknown, "say what the block is: sh, python, yaml, json, bibtex or text"


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.kind in RUN], ids=lambda block: block.name)
def test_a_block_runs_or_says_why_not_and_is_checked(block, runner, folders):
    run, _ = runner
    code, told = run(block.text, RUN[block.kind], folders(block.page), block.why_not is not None)
    assert code == 0, told


@pytest.mark.parametrize("block", [b for b in BLOCKS if b.kind in ("yaml", "json")], ids=lambda block: block.name)
def test_data_in_a_block_can_be_read(block):
    assert (json.loads if block.kind == "json" else yaml.safe_load)(block.text) is not None


@pytest.mark.parametrize(
    ("text", "kind", "why"),
    [
        ("augkitti generate --pairs 3", "sh", "--pairs"),
        ("augkitti generate --n three", "sh", "integer"),
        ("augkitti genarate", "sh", "no command"),
        ("pointflownet train --data a", "sh", "--out"),
        ("torchrun --nproc-per-node 2 -m training train --dta a --out b", "sh", "--dta"),
        ("pip install '.[veiw]'", "sh", "no extra"),
        ("make dmeo", "sh", "no target"),
        ("python benchmarks/nothing.py", "sh", "no file"),
        ("for pair in", "python", "SyntaxError"),
        ("augkitti split aug || augkitti splt aug", "sh", ""),
    ],
)
def test_a_block_that_is_checked_only_is_found_out(text, kind, why, runner, folders, tmp_path):
    run, _ = runner
    code, told = run(text, kind, tmp_path, True)
    if why:
        assert code != 0
        assert why in told
    else:
        assert code == 0, told


def test_a_block_that_runs_and_fails_is_found_out(runner, tmp_path):
    run, _ = runner
    assert run("augkitti info nothing-here\necho went on", "sh", tmp_path, False) == (
        2,
        "augkitti: nothing-here: does not exist; give a folder made by `augkitti generate`\n",
    )
    code, told = run("import augkitti\naugkitti.open('nothing-here')", "python", tmp_path, False)
    assert code == 1
    assert "does not exist" in told
    code, told = run("make demo", "sh", tmp_path, False)
    assert code != 0
    assert "checked only" in told


# --- the site ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built as `make docs` builds it: any warning (a dead link, a lost page) is an error."""
    pytest.importorskip("material", reason="needs mkdocs-material, of requirements-dev.txt")
    out = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)]
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def test_the_site_builds_strictly_and_names_every_page(site):
    start = (site / "index.html").read_text()
    for page in (ROOT / "docs").rglob("*.md"):
        place = page.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert (site / place).is_file()
        assert f'href="{place}"' in start or place == "index.html", f"{place} is not in the list of pages"


def test_the_command_reference_of_the_site_has_every_command_and_option(site):
    import typer

    from pipelines.cli import app as augkitti
    from training.cli import app as pointflownet

    text = (site / "commands.html").read_text()

    def options(command):
        if hasattr(command, "commands"):
            return [option for child in command.commands.values() for option in options(child)]
        return [option for parameter in command.params for option in parameter.opts if option.startswith("--")]

    for name, app in (("augkitti", augkitti), ("pointflownet", pointflownet)):
        group = typer.main.get_command(app)
        assert all(f"{name} {command}" in text for command in group.commands)
        missing = {option for option in options(group) if f"<code>{option}" not in text}
        assert not missing


def test_the_site_fetches_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        loaded = re.findall(
            r'<(?:script|img|iframe)[^>]*\bsrc="?([^">\s]+)|<link[^>]*href="?([^">\s]+)', page.read_text()
        )
        assert not [a or b for a, b in loaded if "://" in (a or b) and "rel=canonical" not in (a or b)]


def test_pages_of_the_root_lead_to_pages_of_the_site(monkeypatch):
    pytest.importorskip("mkdocs", reason="needs mkdocs-material, of requirements-dev.txt")
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from _site import from_root

    told = from_root("[a](docs/shards.md#x) [b](augkitti/shards.py) [`Makefile`](Makefile) [c](https://a.org) [d](#e)")
    assert told == "[a](shards.md#x) b (`augkitti/shards.py`) `Makefile` [c](https://a.org) [d](#e)"


def test_files_that_pages_name_are_there():
    """Paths of our own in code spans, such as `augkitti/shards.py`, `tests/test_x.py`, `docs/log.md`."""
    missing = []
    for page in (page for page in PAGES if page.is_file()):
        for path in re.findall(
            r"`((?:augkitti|pipelines|training|tests|benchmarks|docs)/[\w/]+\.(?:py|md|sh|yaml|json|npz|pt))`",
            page.read_text(),
        ):
            if not (ROOT / path).exists():
                missing.append(f"{page.name}: {path}")
    assert not missing


def test_links_of_the_readme_lead_somewhere():
    for target in re.findall(r"\]\(([^)#\s]+)", (ROOT / "README.md").read_text()):
        assert "://" in target or (ROOT / target).exists(), target
