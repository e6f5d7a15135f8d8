"""The errors a command tells in one line: which file, what is wrong with it, what to do next."""

from os import PathLike

_LONGEST = 400  # characters of a problem that are shown; a damaged file may hold a number of thousands of digits


class _Told(Exception):
    """An error with a place, a problem and a remedy; arguments go to `super()` unchanged, so that it pickles."""

    def __init__(self, where: str | PathLike[str], problem: str, remedy: str) -> None:
        super().__init__(str(where), problem, remedy)
        self.where = str(where)
        self.problem = problem
        self.remedy = remedy

    @property
    def reason(self) -> str:
        """The problem and the remedy in one line, without the place."""
        problem = self.problem if len(self.problem) <= _LONGEST else f"{self.problem[:_LONGEST]} ..."
        return _one_line(f"{problem}; {self.remedy}")

    def __str__(self) -> str:
        return f"{_one_line(self.where)}: {self.reason}"


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


def _one_line(text: str) -> str:
    """Without breaks, and without what a terminal would act on: a damaged file's words stand in messages."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in " ".join(text.split()))
