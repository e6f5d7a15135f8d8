"""The one error a user can cause: which file, what is wrong with it, what to do next."""

from os import PathLike


class InputError(Exception):
    """Bad input of any kind. `str()` gives one line; commands print it and exit with 2.

    Args:
        where: the file, folder, option or config key at fault.
        problem: what is wrong with it.
        remedy: what the user can do.

    Arguments go to `super()` unchanged, so that the error survives pickling out of a worker process.
    """

    def __init__(self, where: str | PathLike[str], problem: str, remedy: str) -> None:
        super().__init__(str(where), problem, remedy)
        self.where = str(where)
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        return " ".join(f"{self.where}: {self.problem}; {self.remedy}".split())
