"""One stage: independent tasks in, their results out as they come, with progress.

A task gets one thread for arithmetic: workers do not fight over cores, and no sum depends on how many there are.
Tasks run in processes of this machine, or on the workers of a Dask scheduler; joblib hands them out either way.
"""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack
from typing import Any, TypeVar

from joblib import Parallel, delayed, parallel_config
from rich.console import Console

from augkitti.command_line import progress
from augkitti.errors import InputError, MachineError
from pipelines.cache import program_digest

WORKERS_COME_S = 600.0  # how long a scheduler without workers is waited for: a batch system starts them when it can
_CONNECT_S = 20.0
_AHEAD = 4_096  # tasks a scheduler is given beyond those that run: enough for workers that join later

Item = TypeVar("Item")
Result = TypeVar("Result")


def run_tasks(
    task: Callable[[Item], Result],
    items: Sequence[Item],
    jobs: int,
    what: str,
    weight: Callable[[Item], int],
    scheduler: str | None = None,
) -> Iterator[Result]:
    """Run a task on each item with `jobs` processes; results in no particular order.

    Args:
        task: a module's function or a `functools.partial` of one.
        items: what to run it on.
        jobs: number of processes; 1 runs here.
        what: the name of what is counted, for the progress line.
        weight: how many of them an item is.
        scheduler: address of a Dask scheduler, whose workers run the tasks instead; `jobs` is not used then.

    Raises:
        InputError: the scheduler does not answer, or Dask is not installed.
        MachineError: a worker process died (with a scheduler: several under one task), or is of another program.
    """
    total = sum(weight(item) for item in items)
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(parallel_config(backend="loky", inner_max_num_threads=1))
            workers, ahead, weighed, here = min(jobs, max(1, len(items))), "2 * n_jobs", _weighed, str(os.getpid())
        else:
            client = stack.enter_context(_connected(scheduler))
            stack.enter_context(parallel_config(backend=_on_workers(client)))
            workers, ahead, weighed, here = -1, f"2 * n_jobs + {_AHEAD}", _on_worker, program_digest()
        advance = stack.enter_context(progress(total, what))
        try:
            run = Parallel(n_jobs=workers, return_as="generator_unordered", batch_size=1, pre_dispatch=ahead)
            for result, done in run(delayed(weighed)(task, item, weight(item), here) for item in items):
                advance(done)
                yield result
        except BrokenProcessPool as err:
            problem = "a worker process was killed, as happens when memory runs out"
            raise MachineError(what, problem, "use fewer --jobs, then go on with --resume") from err
        except (CancelledError, TimeoutError) as err:  # none but Dask's
            problem = f"the scheduler was lost, or has no workers ({type(err).__name__})"
            raise MachineError(str(scheduler), problem, "start it and its workers, then go on with --resume") from err
        except Exception as err:
            if type(err).__name__ != "KilledWorker":  # Dask's: several workers died one after another under one task
                raise
            problem = "workers kept dying under one task, as happens when memory runs out or time is up"
            raise MachineError(
                str(scheduler), problem, "give workers more memory or time, then go on with --resume"
            ) from err


def _on_workers(client: Any) -> Any:
    """joblib's backend for Dask, but that a single worker, the first to come, is used: joblib would run tasks here."""
    from joblib._dask import DaskDistributedBackend

    class OnWorkers(DaskDistributedBackend):  # type: ignore[misc]
        def effective_n_jobs(self, n_jobs: int) -> int:
            return int(max(2, super().effective_n_jobs(n_jobs)))

    return OnWorkers(client=client, wait_for_workers_timeout=WORKERS_COME_S)


def check_scheduler(scheduler: str) -> None:
    """See that a Dask scheduler answers.

    Raises:
        InputError: as `run_tasks`.
    """
    _connected(scheduler).close()


def _connected(scheduler: str) -> Any:
    """A client of a Dask scheduler.

    Raises:
        InputError: as `run_tasks`.
    """
    try:
        from distributed import Client
    except ImportError:
        raise InputError("--scheduler", "needs Dask", 'pip install "augkitti[distributed]"') from None
    try:
        return Client(scheduler, timeout=_CONNECT_S)
    except (OSError, ValueError) as err:
        problem = f"does not answer ({type(err).__name__})"
        raise InputError(f"--scheduler {scheduler}", problem, "give one such as tcp://host:8786") from err


def _on_worker(task: Callable[[Item], Result], item: Item, weight: int, main: str) -> tuple[Result, int]:
    """On a worker of a scheduler, which may be another machine: first see that it would make the same bytes.

    Args:
        task: what to run.
        item: what to run it on.
        weight: handed back with the result.
        main: the digest of the main process's program.

    Raises:
        MachineError: the worker's program is another, or it shares its process between tasks.
    """
    from distributed import get_worker

    worker = get_worker()
    if program_digest() != main:
        problem = "has another version of augkitti, or of a library under it"
        raise MachineError(worker.address, problem, "install the same on every worker (constraints.txt)")
    if worker.state.nthreads != 1:
        raise MachineError(worker.address, "runs several tasks at once", "start workers with --nthreads 1")
    return task(item), weight


def _weighed(task: Callable[[Item], Result], item: Item, weight: int, main: str) -> tuple[Result, int]:
    if str(os.getpid()) != main and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all: the main process answers, and ends workers
    return task(item), weight


class _Pipe(Console):
    """A console whose reader may leave early: the command answers that, not rich."""

    def on_broken_pipe(self) -> None:
        """Let the error through."""
        raise


def console() -> Console:
    """Where tables are printed; wide where no terminal says how wide."""
    return _Pipe() if sys.stdout.isatty() else _Pipe(width=160)
