"""What is wrong with a file, and how to say it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import NamedTuple

Place = tuple[str | int, ...]
"""Keys and indices that lead from the top of a file to a value."""


PLACEHOLDER = "FILL_IN"
"""What stands in a new configuration where only its user knows the value."""


class Problem(NamedTuple):
    """Something wrong, and where in the file."""

    place: Place
    message: str


class Contradiction(ValueError):  # noqa: N818  (a ValueError is what pydantic collects)
    """What is wrong inside one section: problems by the key they belong to."""

    def __init__(self, *problems: Problem) -> None:
        super().__init__("; ".join(problem.message for problem in problems))
        self.problems = problems


def show(value: object) -> str:
    """Show a value as it stands in the file."""
    if value is None:
        return "nothing"
    text = repr(value) if not isinstance(value, bool) else str(value).lower()
    return text if len(text) <= 60 else text[:57] + "..."


def kind_of(value: object) -> str:
    """Say what a value is: a mapping, a list, text, nothing, or the value itself."""
    return {dict: "a mapping", list: "a list", str: "text", type(None): "nothing"}.get(
        type(value), show(value)
    )


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Name the nearest known word if it is near, all of them otherwise."""
    words = sorted(set(known))
    near = difflib.get_close_matches(word, words, 1, cutoff=0.6)
    if near:
        return f"; did you mean {near[0]!r}?"
    return f"; known here: {', '.join(words)}" if words else ""
