"""One stage: independent tasks in, their results out as they come, with progress on a terminal.

A task gets one thread for arithmetic: workers do not fight over cores, and no sum depends on how many there are.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from joblib import Parallel, delayed, parallel_config
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from augkitti.errors import MachineError

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_tasks(
    task: Callable[[Item], Result], items: Sequence[Item], jobs: int, what: str, weight: Callable[[Item], int]
) -> Iterator[Result]:
    """Run a task on each item with `jobs` processes; results in no particular order.

    Args:
        task: a module's function or a `functools.partial` of one.
        items: what to run it on.
        jobs: number of processes; 1 runs here.
        what: the name of what is counted, for the progress line.
        weight: how many of them an item is.

    Raises:
        MachineError: a worker process died.
    """
    total = sum(weight(item) for item in items)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"))
    quiet = not sys.stderr.isatty()
    with (
        parallel_config(backend="loky", inner_max_num_threads=1),
        Progress(
            *columns, TimeElapsedColumn(), TimeRemainingColumn(), console=Console(stderr=True), disable=quiet
        ) as bar,
    ):
        line = bar.add_task(what, total=total, rate="")
        run = Parallel(n_jobs=min(jobs, max(1, len(items))), return_as="generator_unordered", batch_size=1)
        here = os.getpid()
        try:
            for result, done in run(delayed(_weighed)(task, item, weight(item), here) for item in items):
                bar.advance(line, done)
                speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
                bar.update(line, rate=f"{speed:.1f} {what}/s" if speed else "")
                yield result
        except BrokenProcessPool as err:
            problem = "a worker process was killed, as happens when memory runs out"
            raise MachineError(what, problem, "use fewer --jobs, then go on with --resume") from err


def _weighed(task: Callable[[Item], Result], item: Item, weight: int, main: int) -> tuple[Result, int]:
    if os.getpid() != main and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all: the main process answers, and ends workers
    return task(item), weight


def console() -> Console:
    """Where tables are printed; wide where no terminal says how wide."""
    return Console() if sys.stdout.isatty() else Console(width=160)
