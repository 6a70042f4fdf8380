"""Inputs made wrong at random: each ends in a result or a message, soon, and whole."""

import os

import check_inputs as script
import numpy as np
import pytest


def test_wrong_inputs_end_in_a_message(capsys):
    counts = script.check(count=10, seed=217, jobs=1)  # few that hold every family

    assert counts.total() == 10
    assert {outcome for _, outcome in counts} == {"ok", "refused"}, capsys.readouterr().out
    assert {family for family, _ in counts} == set(script.SHARES)


def misbehave(how):
    """What an offender may do."""
    if how == "hang":
        while True:
            pass
    if how == "crash":
        os._exit(7)
    if how == "memory":
        np.ones(3 * 10**8)  # 2.4e9 bytes
    return "ok", how


def test_the_watch_sees_hangs_crashes_and_memory():
    items = ["one", "hang", "crash", "memory", "two"]

    watched = script.watched(misbehave, items, jobs=1, allowed=lambda _: 0.5)
    found = {item: outcome for item, outcome, _ in watched}

    assert found == {"one": "ok", "two": "ok"} | {k: k for k in ("hang", "crash", "memory")}


@pytest.mark.parametrize(
    ("command", "left", "named"),
    [("check", "shape.draft", "shape.draft"), ("fit", "results/report.json", "report.html")],
)
def test_half_written_output_is_seen(tmp_path, command, left, named):
    (tmp_path / left).parent.mkdir(exist_ok=True)
    (tmp_path / left).touch()
    case = script.Case("text", {}, [command])
    assert named in script.left_behind(case, tmp_path, code=0)
