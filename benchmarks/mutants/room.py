"""What a mutant is, and the rooms of the package that they are made in."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """One mistake.

    Attributes:
        old: Text that is there once in the files of its room.
        new: What it becomes.
        equal: Why it changes no behaviour, if it does not.
        tests: Instead of those of the room.
    """

    old: str
    new: str
    equal: str = ""
    tests: tuple[str, ...] = ()


class Room(NamedTuple):
    """Mutants of some files.

    Attributes:
        files: Pattern in the package.
        tests: Arguments of pytest: the tests around these files, the fastest first.
        mutants: What is tried.
    """

    files: str
    tests: tuple[str, ...]
    mutants: tuple[Mutant, ...]
