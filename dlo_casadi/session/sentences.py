"""Tables of sentences: a row says where it applies, and what fills its template."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from dlo_casadi.errors import worded

T = TypeVar("T")
Values = dict[str, Any]


@dataclass(frozen=True)
class Sentence(Generic[T]):
    """One row.

    Parameters
    ----------
    says : str
        Its template, see `errors.worded`.
    found : callable
        What it may be said of -> values of the template, once for each time that it is said.
    """

    says: str
    found: Callable[[T], Iterable[Values]]


def said_of(thing: T, rows: Iterable[Sentence[T]]) -> list[str]:
    """All sentences that rows have on a thing, in their order."""
    return [worded(row.says, **values) for row in rows for values in row.found(thing)]
