"""A bound on the names of numbers in `info`: the same ones in a resumed run, and one warning."""

from __future__ import annotations

from sauna.training.info_names import MAX_NAMES, InfoNames


def row(*names: str) -> dict[str, float]:
    return {"env_steps": 1, "success_rate": 1.0} | {f"info_{name}": 0.0 for name in names}


def test_the_first_names_stay_and_the_others_are_named_once() -> None:
    names = InfoNames([])
    first = [f"n{i}" for i in range(MAX_NAMES - 1)]
    assert names.admit(row(*first)) is None
    late = row("n0", "last", "late", "later")
    warning = names.admit(late)
    assert warning and "'late'" in warning and str(MAX_NAMES) in warning
    assert late == row("n0", "last")
    again = row("late", "n1")
    assert names.admit(again) is None and again == row("n1")


def test_a_resumed_run_has_the_names_of_its_rows() -> None:
    rows = [row(*(f"a{i}" for i in range(20))), row(*(f"b{i}" for i in range(20)))]
    names = InfoNames([])
    for one in rows:
        names.admit(one)
    again = InfoNames([{**one} for one in rows])
    mine, theirs = row("a3", "b19", "b11", "c"), row("a3", "b19", "b11", "c")
    names.admit(mine), again.admit(theirs)
    assert mine == theirs == row("a3", "b11")
