from __future__ import annotations

import json

import pytest

from ingest.errors import DynoscopeError, LogError
from pipeline.console import Problems, print_json, print_table, progress, talk


def test_talk_goes_to_stderr_and_results_to_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    talk("hello")
    print_json({"ü": [1, None]})
    with progress("working", 2) as step:
        step("one")
        step("two")
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"ü": [1, None]}
    assert captured.err == "hello\n[1/2] one\n[2/2] two\n"


def test_table_is_aligned_and_empty_where_nothing_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(
        [{"a": "long name", "b": 1.23456}, {"a": "x", "b": None, "c": "unseen"}], {"a": "A", "b": "B"}
    )
    assert capsys.readouterr().out == "A          B\nlong name  1.235\nx\n"


def test_problems_are_raised_together_in_order() -> None:
    problems = Problems()
    for name in ("first", "second"):
        with problems:
            raise LogError(name)
    with pytest.raises(DynoscopeError, match=r"^first\nsecond$"):
        problems.raise_any()


def test_one_problem_keeps_its_kind_and_none_raises_nothing() -> None:
    problems = Problems()
    problems.raise_any()
    with problems:
        raise LogError("only")
    with pytest.raises(LogError, match=r"^only$"):
        problems.raise_any()


def test_bugs_are_not_collected() -> None:
    problems = Problems()
    with pytest.raises(ZeroDivisionError), problems:
        1 / 0  # noqa: B018
