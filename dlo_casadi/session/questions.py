"""The engine of plausibility: a declaration is compared with what may have been meant instead.

A row of a table, a `Mistake`, transforms what was declared or read. `Alternatives` compares rows
by one misfit, and words the one that explains the measurements much better than the declaration.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Self, TypeVar

import numpy as np

from dlo_casadi.errors import worded

T = TypeVar("T")


class Suspicion(NamedTuple):
    """A likely mistake and what to do about it.

    `certain`: nothing else explains the whole session. `pose`: its name, if it concerns only one.
    """

    message: str
    certain: bool
    pose: str = ""

    @classmethod
    def of_pose(cls, name: str, text: str) -> Self:
        """What looks like a mistake in a single pose."""
        return cls(f"{name}: {text}", False, name)


@dataclass(frozen=True)
class Mistake(Generic[T]):
    """One row: something that users declare, or write into a file, otherwise than they mean it.

    Parameters
    ----------
    says : str
        Its description and remedy, see `errors.worded`: `own` and `left` are the misfits without
        and with it, `was` and `meant` what was declared and meant, as in `{was.length:.4g}`.
    meant : callable
        What is compared, had it been declared as it was meant; None where the row does not apply.
    beyond : float
        Misfit of the declaration beyond which no other cause, such as a missing effect, can explain
        the same: then the mistake is certain.
    """

    says: str
    meant: Callable[[T], T | None]
    beyond: float = 0.0


class Explanation(NamedTuple, Generic[T]):
    """A row that may explain a misfit, with what it compares, and the misfits of both."""

    row: Mistake[T]
    was: T
    meant: T
    own: float
    left: float

    def said(self, words: str = "{row}") -> str:
        """Words, in which `{row}` stands for those of the row."""
        values = {"was": self.was, "meant": self.meant, "own": self.own, "left": self.left}
        return worded(words, row=worded(self.row.says, **values), **values)


@dataclass(frozen=True)
class Alternatives(Generic[T]):
    """What may have been meant, and how it is compared with what was declared.

    Parameters
    ----------
    rows : tuple of Mistake
        The likely mistakes first.
    misfit : callable
        How far the measurements are from what was declared.
    doubted : float
        Misfit beyond which what was declared is in doubt.
    enough, share : float
        Largest misfit, and largest share of the declaration's, that an explanation leaves.
    near : float or None
        None: the first row that explains the misfit wins, and no other is tried. Otherwise the
        first whose misfit is at most so many times the smallest of all rows wins, if it explains.
    words : str
        What is said of the row that wins, see `Explanation.said`.
    """

    rows: tuple[Mistake[T], ...]
    misfit: Callable[[T], float]
    doubted: float = 0.0
    enough: float = np.inf
    share: float = np.inf
    near: float | None = None
    words: str = "{row}"

    def contradicted(self, thing: T, own: float) -> bool:
        """Whether the misfit of what was declared needs an explanation."""
        return own > self.doubted

    def explains(self, found: Explanation[T]) -> bool:
        """Whether a row explains that misfit."""
        return found.left < min(self.enough, self.share * found.own)

    def conclusive(self, found: Explanation[T]) -> bool:
        """Whether no further row needs to be tried."""
        return self.near is None and self.explains(found)

    def suspicion(self, found: Explanation[T]) -> Suspicion:
        """Word the row that won."""
        return Suspicion(found.said(self.words), found.own > found.row.beyond)

    def likeliest(self, thing: T) -> Explanation[T] | None:
        """The row that explains the misfit of a thing; None if there is no misfit, or no row."""
        own = self.misfit(thing)
        if not self.contradicted(thing, own):
            return None
        tried: list[Explanation[T]] = []
        for row in self.rows:
            if (meant := row.meant(thing)) is None:
                continue
            tried.append(Explanation(row, thing, meant, own, self.misfit(meant)))
            if self.conclusive(tried[-1]):
                return tried[-1]
        bound = (self.near or 1.0) * min((x.left for x in tried), default=np.inf) + 1e-9
        likely = next((x for x in tried if x.left < bound), None)
        return likely if likely is not None and self.explains(likely) else None

    def suspicions(self, things: Iterable[T]) -> tuple[Suspicion, ...]:
        """Compare things, each by itself."""
        found = (self.likeliest(thing) for thing in things)
        return tuple(self.suspicion(one) for one in found if one is not None)
