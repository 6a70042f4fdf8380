"""The engine that compares what users may have meant, and that each row of its tables is in use."""

from dataclasses import dataclass

import numpy as np
import pytest

from dlo_casadi.session import mistakes
from dlo_casadi.session.axes import exchanges
from dlo_casadi.session.lines import Lines
from dlo_casadi.session.questions import Alternatives, Mistake


@dataclass(frozen=True)
class Number:
    """A declared number, zero being right."""

    value: float


def taking(*steps, beyond=0.0):
    """Rows that each take a number from what was declared; no row where that is None."""
    return tuple(
        Mistake(
            f"less {step}: {{was.value:g}} -> {{meant.value:g}}, {{own:g}} -> {{left:g}}",
            lambda number, step=step: None if step is None else Number(number.value - step),
            beyond,
        )
        for step in steps
    )


def asked(rows, value=10.0, **rule):
    """What is suspected of a number whose misfit is its size."""
    return Alternatives(rows, lambda number: abs(number.value), **rule).suspicions([Number(value)])


def test_the_first_row_that_explains_enough_is_worded():
    rows = taking(1, None, 8, 10)
    assert [x.message for x in asked(rows, share=0.35)] == ["less 8: 10 -> 2, 10 -> 2"]
    assert [x.message for x in asked(rows, enough=1.0)] == ["less 10: 10 -> 0, 10 -> 0"]
    assert asked(rows[:2], share=0.35) == ()
    assert asked((), share=0.35) == ()


def test_of_rows_that_are_nearly_alike_the_likelier_one_is_worded():
    rows = taking(7, 8, 9)
    assert asked(rows, share=0.35)[0].message.startswith("less 7")
    assert asked(rows, share=0.35, near=1.0)[0].message.startswith("less 9")
    assert asked(rows, share=0.35, near=2.0)[0].message.startswith("less 8")
    # The likelier one is near the best, but does not explain.
    assert asked(taking(5, 7), share=0.35, near=2.0) == ()


def test_what_is_not_in_doubt_is_not_asked():
    assert asked(taking(10), doubted=10.0) == ()
    assert asked(taking(10), doubted=9.9)


@pytest.mark.parametrize("value", [1.0, 3.0])
def test_only_beyond_what_effects_leave_a_mistake_is_certain(value):
    (found,) = asked(taking(value, beyond=2.0), value)
    assert found.certain == (value > 2.0)


@pytest.mark.parametrize("d", [2, 3])
def test_rows_of_frames_are_those_of_the_dimension(d):
    """Each exchange of axes alone, and with another origin; the latter for three lines or more."""
    rng = np.random.default_rng(0)

    def applying(count):
        ends = rng.normal(size=(count, 2, d))
        names = tuple("abcd"[:count])
        known = np.zeros(count, dtype=bool)
        lines = Lines(names, ends, ends, np.ones(count), 1.0, np.zeros((count, 2)), known)
        return [meant for row in mistakes.FRAMES if (meant := row.meant(lines)) is not None]

    others = len(exchanges(d)) - 1
    assert len(applying(4)) == 1 + 2 * others
    assert len(applying(2)) == 1 + others
