"""The errors that a user can cause, told in one line: what was expected, what came."""

from __future__ import annotations

LONGEST = 1000  # characters of an error
LARGEST_INTEGER = 2**53  # that files, tables and pages can hold


class InvalidInput(ValueError):
    """Something from outside is not what was expected."""

    def __init__(self, expected: str, got: str | None = None) -> None:
        super().__init__(one_line(expected if got is None else f"{expected}; got {got}"))


def one_line(text: str) -> str:
    """`text` in one line that is not endless."""
    line = " ".join(text.splitlines())
    return line if len(line) <= LONGEST else line[: LONGEST - 3] + "..."


class WorkLost(InvalidInput):
    """The machines that did the work are gone: what was in hand is lost, what was done before is not."""


def describe(value: object) -> str:
    """A short, one-line form of `value` for an error message."""
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def one_of(name: str, names: object, got: object) -> InvalidInput:
    """The error for a `name` that is not one of `names`."""
    choices = ", ".join(str(n) for n in names)  # ty: ignore[not-iterable]
    return InvalidInput(f"{name}: expected one of {choices}", repr(got))
