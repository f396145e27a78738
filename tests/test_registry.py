"""The registry of parts: what it refuses names the files, and says what to do."""

from __future__ import annotations

from functools import partial
from importlib import import_module

import pytest

from epo_lightning import registry
from epo_lightning.registry import ConfigError, check_keys, lookup, register


@pytest.fixture(autouse=True)
def _registered_parts_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    for group in registry._HOMES:
        registry.parts(group)  # modules are imported, and register their parts, only once
    monkeypatch.setattr(registry, "_PARTS", {group: dict(parts) for group, parts in registry._PARTS.items()})


def part() -> None:
    """A part."""


def other() -> None:
    """Another one."""


def test_two_parts_of_one_name_are_named_with_their_places() -> None:
    register("backbone", "mine")(part)
    register("backbone", "mine")(part)  # the same again
    here = rf"{__file__}:\d+"
    with pytest.raises(ConfigError, match=f"two parts of the group 'backbone' are called 'mine', in {here} and {here}"):
        register("backbone", "mine")(other)


def test_a_part_that_is_defined_again_replaces_the_one_before() -> None:
    """A cell of a notebook runs twice."""

    def again() -> type:
        @register("backbone", "mine")
        class Mine:
            pass

        return Mine

    again()
    assert again() is lookup("backbone", "mine")


@pytest.mark.parametrize("name", ["", 3, None])
def test_names_are_texts(name: object) -> None:
    with pytest.raises(ConfigError, match="the name of a part must be a text that is not empty"):
        register("metric", name)  # type: ignore[arg-type]


def test_unknown_groups_are_refused_where_a_part_is_registered() -> None:
    with pytest.raises(ConfigError, match=r"@register\('backbones', 'gru'\): .*did you mean 'backbone'"):
        register("backbones", "gru")


@pytest.mark.parametrize(
    ("group", "name", "words"),
    [
        (
            "backbone",
            "recurrent",
            r'A new one has @register\("backbone", "recurrent"\) above it, in a file of epo_light',
        ),
        ("optimizer", "muon", r"above it, in epo_lightning/optimizers\.py, or in a module that an entry point"),
        ("format", "my_csv", r"above it, in a file of epo_lightning/data/recorded/formats, or .*\(pip install -e"),
        ("backbone", "v_lst", "did you mean 'v_lstm'. known: [^.]*$"),
    ],
)
def test_unknown_parts_are_refused_with_the_place_of_new_ones(group: str, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=f"unknown {group} '{name}': .*{words}"):
        lookup(group, name)


def test_parameters_of_a_part_have_names() -> None:
    class Own:
        def __init__(self, *args: float, final: int = 1, **kwargs: float) -> None: ...

    register("forecaster", "own")(Own)
    said = rf"forecaster 'own' \({__file__}:\d+\) takes \*args.*, \*\*kwargs.*, but the signature .*: name all its"
    with pytest.raises(ConfigError, match=said):
        check_keys("forecaster", {"name": "own", "control_scale": 1.0})


def test_an_import_that_fails_is_named_with_its_module() -> None:
    with (
        pytest.raises(
            ConfigError, match=r"the module mine.parts cannot be .*No module named 'no_such_package'; install"
        ),
        registry._importing("mine.parts"),
    ):
        import_module("no_such_package")
    with (
        pytest.raises(ConfigError, match=r"No module named 'epo_lightning.encoder'; check the spelling"),
        registry._importing("mine.parts"),
    ):
        import_module("epo_lightning.encoder")
    with pytest.raises(ConfigError, match=r"^mine\.py:2 is not Python: "), registry._importing("mine.parts"):
        compile("a = 1\nb = = 2", "mine.py", "exec")
    with (
        pytest.raises(ConfigError, match=r"mine\.parts fails when it is imported: ZeroDivisionError: .*; --traceback"),
        registry._importing("mine.parts"),
    ):
        raise ZeroDivisionError("division by zero")


def test_parts_without_a_name_of_their_own_can_be_registered() -> None:
    small = partial(part)
    register("backbone", "small")(small)
    assert lookup("backbone", "small") is small
    with pytest.raises(ConfigError, match="two parts of the group 'backbone' are called 'small'"):
        register("backbone", "small")(partial(part))
