"""What the check scripts share."""

import json

import pytest
from harness import options, run


def test_rows_come_in_the_order_of_their_cases_and_are_printed_and_written(tmp_path, capsys):
    words = ["--seed", "3", "--output", str(tmp_path / "rows.json")]
    chosen = options("One line.\n\nMore.", seed=0, jobs=True, output=True).parse_args(words)
    assert (chosen.seed, chosen.jobs) == (3, 1)
    rows = run(
        lambda case: case**2,
        [3, 1, 2],
        chosen,
        lambda case, row, _: f"{case}: {row}" if case > 1 else "",
        summary=lambda rows: f"{len(rows)} done",
        every=2,
    )
    assert rows == json.loads((tmp_path / "rows.json").read_text()) == [9, 1, 4]
    assert capsys.readouterr().out.splitlines() == ["3: 9", "2 done", "2: 4", "3 done"]


def test_a_case_that_fails_ends_a_check_with_its_error():
    with pytest.raises(ZeroDivisionError):
        run(lambda case: 1 / case, [1, 0], options("One.").parse_args([]), lambda *_: "")
