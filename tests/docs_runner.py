"""Runs the programs of documentation quickly: one process imports all once, each call is a fork of it.

`python tests/docs_runner.py FOLDER` writes small scripts into FOLDER/bin and answers them on FOLDER/socket, until its
standard input ends. Where the environment has DOCS_CHECK=1 nothing is run:

- `augkitti`, `pointflownet`, and torchrun's `-m training`: every word is parsed as the program parses it;
- `pip install '.[extra]'`: the extra is one of pyproject.toml; `make target`: the Makefile has it;
- `python file.py`: the repository has it; other programs are passed over.

Where it has not, `augkitti generate` makes at most DOCS_PAIRS pairs, and into a new folder where its own is a link to
the set that all blocks share, and every command works in one process. A `python` block is a call of `python -`.
"""

import json
import os
import re
import socket
import stat
import sys
import tomllib
import traceback
from importlib import import_module
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
STUBS = ("pip", "make", "dask", "torchrun", "docker", "git", "kiss_icp_pipeline")
CLIENT = """#!{python} -SE
import json, os, socket, sys
call = {{"program": {program!r}, "words": sys.argv[1:], "folder": os.getcwd(), "environment": dict(os.environ)}}
with socket.socket(socket.AF_UNIX) as talk:
    talk.connect({address!r})
    socket.send_fds(talk, [json.dumps(call).encode()], [0, 1, 2])
    talk.shutdown(socket.SHUT_WR)
    code = talk.recv(16)
sys.exit(int(code or 70))
"""


def serve(folder: Path) -> None:
    address = str(folder / "socket")
    (folder / "bin").mkdir()
    for program in ("augkitti", "pointflownet", "python", *STUBS):
        path = folder / "bin" / program
        path.write_text(CLIENT.format(python=sys.executable, program=program, address=address))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
    import_all()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address)
        listener.listen()
        print("ready", flush=True)
        if os.fork():  # the parent waits for the end of its input, then ends both
            sys.stdin.read()
            os.killpg(0, 15)
        while True:
            talk, _ = listener.accept()
            if os.fork() == 0:
                answer(talk)
            talk.close()
            reap()


def import_all() -> None:
    for name in (
        "matplotlib.backends.backend_agg",
        "matplotlib.figure",
        "pyarrow.dataset",
        "torch",
        "augkitti.cad_models",
        "augkitti.dataset_info",
        "augkitti.validate_folder",
        "pipelines.augment",
        "pipelines.generate",
        "pipelines.inspect_set",
        "training.cli",
    ):
        import_module(name)


def reap() -> None:
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        pass


def answer(talk: socket.socket) -> None:
    """In a process of its own: take the caller's place, run, and tell the exit code."""
    parts, handles = [], []
    while True:
        data, received, _, _ = socket.recv_fds(talk, 1 << 20, 3)
        handles += received
        if not data:
            break
        parts.append(data)
    call = json.loads(b"".join(parts))
    for number, handle in enumerate(handles):
        os.dup2(handle, number)
        os.close(handle)
    os.environ.clear()
    os.environ.update(call["environment"])
    os.chdir(call["folder"])
    try:
        code = run(call["program"], call["words"])
    except SystemExit as err:
        code = err.code if isinstance(err.code, int) else int(err.code is not None)
        if not isinstance(err.code, int | None):
            print(err.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    talk.sendall(str(code).encode())
    os._exit(0)  # what it started is gone: commands work in one process here


def run(program: str, words: list[str]) -> int:
    checked = os.environ.get("DOCS_CHECK") == "1"
    if program in STUBS:
        if not checked:
            raise SystemExit(f"{program}: mark the block `checked only`")
        return check_other(program, words)
    if program == "python":
        if checked:
            return check_python(words)
        exec(compile(_program(words), "block", "exec"), {})
        return 0
    from pipelines.cli import app as augkitti
    from training.cli import app as pointflownet

    app = augkitti if program == "augkitti" else pointflownet
    if checked:
        parse(app, program, words)
        return 0
    app(small(words) if program == "augkitti" else words)
    return 0  # it ends by SystemExit


def _program(words: list[str]) -> str:
    """What `python -`, `python -c PROGRAM` or `python FILE` runs."""
    if words == ["-"]:
        return sys.stdin.read()
    return words[1] if words[0] == "-c" else Path(words[0]).read_text()


def parse(app: object, program: str, words: list[str]) -> None:
    """Let the program parse its words, run nothing."""
    import typer

    command, words = typer.main.get_command(app), list(words)
    while hasattr(command, "commands"):
        if not words or words[0] not in command.commands:
            raise SystemExit(f"{program}: no command {words[:1]}")
        command, program = command.commands[words[0]], f"{program} {words[0]}"
        words = words[1:]
    try:
        command.make_context(program, words)
    except Exception as err:  # click's, of whichever module it comes from
        told = err.format_message() if hasattr(err, "format_message") else err
        raise SystemExit(f"{program}: {told}") from None


def small(words: list[str]) -> list[str]:
    """The same call with fewer pairs."""
    words = list(words)
    for option, most in (("--n", int(os.environ["DOCS_PAIRS"])), ("--jobs", 1)):
        if option in words:
            at = words.index(option) + 1
            words[at] = str(min(int(words[at]), most))
    if words[:1] == ["generate"] and "--out" in words and "--dry-run" not in words:
        out = Path(words[words.index("--out") + 1])
        if out.is_symlink():
            out.unlink()
    return words


def check_other(program: str, words: list[str]) -> int:
    if program == "torchrun" and "training" in words:
        from training.cli import app

        parse(app, "pointflownet", words[words.index("training") + 1 :])
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    if program == "pip":
        for word in words:
            for extra in re.findall(r"(?:^\.|^augkitti)\[(.*)\]", word):
                unknown = set(extra.split(",")) - extras.keys()
                if unknown:
                    raise SystemExit(f"pip: no extra {unknown}")
    if program == "make":
        targets = re.findall(r"^([a-z0-9]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
        for word in words:
            if "=" not in word and word not in targets:
                raise SystemExit(f"make: no target {word}")
    return 0


def check_python(words: list[str]) -> int:
    if words[0] in ("-", "-c"):
        compile(_program(words), "block", "exec")
    elif words[:2] == ["-m", "torch.distributed.run"]:
        return check_other("torchrun", words[2:])
    elif words[0] == "-m" and words[1] in ("pipelines", "training", "augkitti"):
        program, app = {
            "pipelines": ("augkitti", "pipelines.cli"),
            "augkitti": ("augkitti", "pipelines.cli"),
            "training": ("pointflownet", "training.cli"),
        }[words[1]]
        parse(__import__(app, fromlist=["app"]).app, program, words[2:])
    elif words[0].endswith(".py") and "/" in words[0] and not (ROOT / words[0]).is_file():
        raise SystemExit(f"python: no file {words[0]}")
    return 0


if __name__ == "__main__":
    os.setpgrp()
    serve(Path(sys.argv[1]))
