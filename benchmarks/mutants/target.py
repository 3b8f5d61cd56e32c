"""What a mutant is, and which parts of the package they are made in."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One mistake.

    Attributes:
        old: Text that is there once in the files of its target.
        new: What it becomes.
        equal: Why it changes no behaviour, if it does not.
        tests: Instead of those of the target.
    """

    old: str
    new: str
    equal: str = ""
    tests: tuple[str, ...] = ()


class Target(NamedTuple):
    """Mutants of some files.

    Attributes:
        files: Pattern in the package.
        tests: Arguments of pytest: the tests around these files, the fastest first.
        mutants: What is tried.
    """

    files: str
    tests: tuple[str, ...]
    mutants: tuple[Mutant, ...]
