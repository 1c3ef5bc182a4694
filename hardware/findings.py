"""What a check has to say about a part of the hardware."""

from __future__ import annotations

from typing import NamedTuple


class Finding(NamedTuple):
    """One thing that a check found.

    Parameters
    ----------
    check : str
        Name of the check.
    where : str
        The part, net or place.
    message : str
        What is wrong there.
    change : str, optional
        What removes a hazard: a thing that works as built, but not within every part's limits. A
        fault has none: with it the hardware cannot work.
    """

    check: str
    where: str
    message: str
    change: str = ""

    @property
    def hazard(self) -> bool:
        """Whether it is a hazard rather than a fault."""
        return bool(self.change)

    def __str__(self) -> str:
        """One line for a person."""
        line = f"{self.check}: {self.where}: {self.message}"
        return f"{line}; {self.change}" if self.change else line
