"""The errors a command tells in one line: which file, what is wrong with it, what to do next."""

from os import PathLike


class _Told(Exception):
    """An error with a place, a problem and a remedy; arguments go to `super()` unchanged, so that it pickles."""

    def __init__(self, where: str | PathLike[str], problem: str, remedy: str) -> None:
        super().__init__(str(where), problem, remedy)
        self.where = str(where)
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return " ".join(f"{self.where}: {self.problem}; {self.remedy}".split())


class InputError(_Told):
    """Bad input of any kind, a user's to mend. `str()` gives one line; commands print it and exit with 2.

    Args:
        where: the file, folder, option or config key at fault.
        problem: what is wrong with it.
        remedy: what the user can do.

    Survives pickling out of a worker process.
    """


class MachineError(_Told):
    """The machine gave way under a run whose input is good: disk full, folder gone, worker killed. Exit code 3.

    Never a reason to leave a pair out, so it is no `InputError`. Arguments as there.
    """
