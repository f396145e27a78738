"""Labels of rows with the same title: their differing settings, written as overrides."""

from __future__ import annotations

import shlex
from typing import Any

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given
from hypothesis import strategies as st

from epo_lightning.report.labels import labels, natural, short_keys, varying, word

texts = st.text(st.characters(codec="ascii", min_codepoint=32, exclude_characters="\x7f"), min_size=1)
plain = st.none() | st.booleans() | st.integers(-1000, 10**6) | st.floats(allow_nan=False) | texts
CONFIG: dict[str, Any] = {
    "backbone": {"name": "v_lstm", "width": 128},
    "solver": {"name": "lm", "steps": 2},
    "data": {"windows": {"history": 10}},
    "seed": 1,
}


def changed(section: str, **values: Any) -> dict[str, Any]:
    return {**CONFIG, section: {**CONFIG[section], **values}}


@given(plain | st.lists(plain, max_size=3))
def test_override_words_are_read_back_as_their_values(value: Any) -> None:
    (argument,) = shlex.split(word("optimizer.lr", value))
    override = OverridesParser.create().parse_override(argument)
    assert override.key_or_group == "optimizer.lr"

    def bare(read: Any) -> Any:
        return [bare(entry) for entry in read] if isinstance(read, list) else getattr(read, "text", read)

    read = bare(override.value())
    assert read == value
    assert type(read) is type(value)


def test_varying_settings_equal_those_found_by_hand() -> None:
    four, wide = changed("solver", steps=4), changed("backbone", width=64)
    assert varying([CONFIG, four, wide]) == [
        {"backbone.width": 128, "solver.steps": 2},
        {"backbone.width": 128, "solver.steps": 4},
        {"backbone.width": 64, "solver.steps": 2},
    ]
    assert varying([CONFIG]) == [{}]
    assert varying([CONFIG, {**CONFIG, "seed": 2, "title": "x"}]) == [{}, {}]


def test_keys_are_shortened_while_unambiguous() -> None:
    keys = ["solver.steps", "solver.name", "data.windows.history"]
    assert short_keys(keys, CONFIG) == {
        "solver.steps": "steps",
        "solver.name": "solver.name",
        "data.windows.history": "history",
    }


def test_labels_equal_those_written_by_hand() -> None:
    settings = [{"solver.steps": steps, "solver.name": name} for steps, name in ((2, "lm"), (4, "x" * 40))]
    assert labels("V", settings, CONFIG, ["aaaa", "bbbb"]) == [
        "V, steps=2, solver=lm",
        f"V, steps=4, solver={'x' * 23}…",
    ]
    assert labels("V", [{}], CONFIG, ["aaaa"]) == ["V"]


def test_long_lists_of_names_are_told_by_what_they_lack() -> None:
    def of(*lists: list[Any]) -> list[str]:
        settings = [{"energy.own": own} for own in lists]
        return labels("V", settings, CONFIG, ["aaaa", "bbbb", "cccc"][: len(lists)])

    own = ["goal", "vel", "acc", "turnr", "jerk"]
    assert of(own, own[1:], own[:3]) == ["V", "V, own without goal", "V, own without turnr, jerk"]
    assert of(own[:2], []) == ["V, own=[goal,vel]", "V, own=[]"], "short lists are shown"
    assert of(own, ["turnacc"]) == ["V, own=[goal,vel,acc,turnr,jer…", "V, own=[turnacc]"], "none contains the other"
    assert of([10**12, 10**13], [10**12]) == ["V, own=[1000000000000,10000000…", "V, own=[1000000000000]"], "no names"


def test_an_empty_mapping_is_told_by_the_settings_that_it_lacks() -> None:
    fixed, free = {**CONFIG, "energy": {"margins": {"clearance": 0.5}}}, {**CONFIG, "energy": {"margins": {}}}
    assert varying([fixed, free]) == [{"energy.margins.clearance": 0.5}, {"energy.margins.clearance": None}]


def test_labels_round_numbers_unless_that_makes_them_equal() -> None:
    def of(*rates: float) -> list[str]:
        return labels("V", [{"solver.rate": rate, "solver.steps": 1234} for rate in rates], CONFIG, ["a", "b"])

    assert of(0.00034538226139400343, 0.0005) == ["V, rate=0.000345, steps=1234", "V, rate=0.0005, steps=1234"]
    assert of(0.0003453, 0.0003454) == ["V, rate=0.0003453, steps=1234", "V, rate=0.0003454, steps=1234"]


def test_rows_with_too_long_labels_are_named_by_their_parts_or_their_identity() -> None:
    rows = ["0123456789abcdef", "fedcba9876543210"]
    four = [{f"solver.k{number}": number + row for number in range(4)} for row in range(2)]
    assert labels("V", four, CONFIG, rows) == ["V, k0=0, k1=1, k2=2, k3=3", "V, k0=1, k1=2, k2=3, k3=4"]
    many = [{f"solver.k{number}": number + row for number in range(5)} for row in range(2)]
    assert labels("V", many, CONFIG, rows) == ["V, row 01234567", "V, row fedcba98"]
    parts = [{**entry, "backbone.name": name} for entry, name in zip(many, ("v_lstm", "vibes"), strict=True)]
    assert labels("V", parts, CONFIG, rows) == ["V, backbone=v_lstm", "V, backbone=vibes"]
    long = [{"solver.name": "x" * 50 + end} for end in "ab"]
    first, second = labels("V", long, CONFIG, rows)
    assert first != second


@pytest.mark.parametrize("values", [[2, 4, 12], [7, "a", "b", None], [0.0005, 0.01, 1]])
def test_numbers_sort_as_numbers(values: list[Any]) -> None:
    settings = [{"solver.steps": value} for value in values]
    assert sorted([*settings[1:], settings[0]], key=natural) == settings


def test_a_key_that_ends_like_a_longer_word_is_as_short_as_others() -> None:
    keys = ["solver.steps", "solver.test_steps", "optimizer.lr", "scheduler.final_lr"]
    assert list(short_keys(keys, {}).values()) == ["steps", "test_steps", "lr", "final_lr"]
