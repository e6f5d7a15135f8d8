"""Pages of the site that no file holds: the command line and files of the root in, generated pages out (mkdocs hooks).

`commands.md` is written anew at each build from the commands themselves, so it is never out of date. `CONTRIBUTING.md`
and `CHANGELOG.md` become pages. A page of `docs/` that `mkdocs.yml` does not name comes under "More", so that a new one
is never lost.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parent.parent
OF_ROOT = {"contributing.md": ("How to contribute", "CONTRIBUTING.md"), "changelog.md": ("Changes", "CHANGELOG.md")}


def on_config(config: Any) -> Any:
    """Complete the list of pages."""
    named = set(re.findall(r"'([^']+\.md)'", repr(config.nav)))
    docs = Path(config.docs_dir)
    more = sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))
    more = [page for page in more if page not in named]
    if more:
        config.nav.append({"More": more})
    config.nav += [{title: page} for page, (title, file) in OF_ROOT.items() if (ROOT / file).is_file()]
    return config


def on_files(files: Any, *, config: Any) -> Any:
    """Add the pages that are made."""
    files.append(File.generated(config, "commands.md", content=command_page()))
    for page, (_, file) in OF_ROOT.items():
        if (ROOT / file).is_file():
            files.append(File.generated(config, page, content=from_root((ROOT / file).read_text())))
    return files


def from_root(text: str) -> str:
    """A page of the root as one of the site: links into `docs/` lose that part, links to other files become text."""

    def mend(found: re.Match[str]) -> str:
        words, target = found[1], found[2]
        if "://" in target or target.startswith("#"):
            return found[0]
        if target.startswith("docs/"):
            return f"[{words}]({target.removeprefix('docs/')})"
        for page, (_, file) in OF_ROOT.items():
            if target == file:
                return f"[{words}]({page})"
        return f"{words} (`{target}`)" if words.strip("`") != target else f"`{target}`"

    return re.sub(r"(?<!!)\[([^\]]*)\]\(([^)\s]+)\)", mend, text)


def command_page() -> str:
    """The reference of both programs as one page (Markdown)."""
    lines = [
        "# Commands",
        "",
        "Made from the programs themselves when this site is built; `augkitti COMMAND --help` says the same.",
        "What each exit code means stands in [habits](cli.md).",
        "",
    ]
    for program, group in programs().items():
        lines += [f"## {program}", "", _plain(group.help), ""]
        for words, command in commands_of(program, group):
            context = typer.Context(command, info_name=words)
            called = " ".join(command.collect_usage_pieces(context))
            records = (parameter.get_help_record(context) for parameter in command.params)
            rows = [f"| `{_plain(name)}` | {_cell(told)} |" for name, told in filter(None, records)]
            lines += [f"### {words}", "", _plain(command.help), "", "```text", f"{words} {called}", "```", ""]
            lines += ["| argument or option | |", "|---|---|", *rows, ""] if rows else []
    return "\n".join(lines)


def programs() -> dict[str, Any]:
    """Both programs as groups of commands."""
    from pipelines.cli import app as augkitti
    from training.cli import app as pointflownet

    return {name: typer.main.get_command(app) for name, app in (("augkitti", augkitti), ("pointflownet", pointflownet))}


def commands_of(words: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Every command that does something, with the words that call it."""
    for name, child in group.commands.items():
        if hasattr(child, "commands"):
            yield from commands_of(f"{words} {name}", child)
        elif not child.hidden:
            yield f"{words} {name}", child


def _plain(text: str | None) -> str:
    return " ".join((text or "").split())


def _cell(text: str) -> str:
    return _plain(text).replace("|", "\\|").replace("<", "&lt;")
