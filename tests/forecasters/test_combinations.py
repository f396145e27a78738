"""Combinations of energy, minimiser, derivative and objective: each is trained for a step or refused with a reason."""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import pytest
import torch
from games import random_scene
from suites import model

from epo_lightning import registry
from epo_lightning.experiment.config.compose import compose
from epo_lightning.forecast import GameParameters, Solution
from epo_lightning.forecasters import build_forecaster
from epo_lightning.game.energy import Energy
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import Minimiser

OPTIONS = {
    "energy": ("rpi", "augmented_rpi", "neural", "collision", "convex"),
    "solver": (
        *("levenberg_marquardt", "gradient_descent", "newton", "lbfgs", "langevin"),
        *("both_sides", "feedback", "best_response", "augmented_lagrangian", "enumeration", "sum_product"),
    ),
    "backward": ("unrolled", "truncated", "implicit", "implicit backward.hessian=gauss_newton", "detached"),
    "objective": ("imitation", "contrastive", "laplace", "conditional"),
}
DIFFERENTIABLE = ("rpi", "augmented_rpi", "neural", "convex")
STEPS = ("levenberg_marquardt", "gradient_descent")
MINIMA = (*STEPS, "newton", "lbfgs", "both_sides", "best_response", "augmented_lagrangian")
TABLES = ("enumeration", "sum_product")


CHANGES = {
    ("solver", "newton"): {"steps": 4},
    ("solver", "lbfgs"): {"steps": 4},
    ("solver", "best_response"): {"rounds": 2},
    ("solver", "augmented_lagrangian"): {"rounds": 8},
    ("solver", "gradient_descent"): {"steps": 3, "step_size": 1e-4},
    ("solver", "langevin"): {"steps": 3, "delta": 1e-2},
}
"""A few steps suffice here; they are small, because untrained weights do not allow larger ones."""


@cache
def section(kind: str, option: str) -> dict[str, Any]:
    """The configuration of a part, composed once; not to be changed."""
    config = compose("train", ["experiment=rpi/v_lstm_epo", *f"{kind}={option}".split()])[kind]
    return {**config, **CHANGES.get((kind, option), {})}


def works(energy: str, solver: str, backward: str, objective: str) -> bool:
    """Table 1 and its empty cells, written out once more."""
    if solver == "feedback":
        return False  # the energy has features between time steps, such as the jerk
    if solver in ("levenberg_marquardt", "both_sides", "best_response", "augmented_lagrangian") and energy != "rpi":
        return False  # knows the structure of features alone
    if solver not in TABLES and energy not in DIFFERENTIABLE:
        return False
    if objective == "imitation":
        return {
            "unrolled": solver in STEPS or solver in TABLES,
            "truncated": solver in STEPS,
            "implicit": solver in MINIMA,
            "implicit backward.hessian=gauss_newton": solver in MINIMA and energy in ("rpi", "convex"),
            "detached": False,
        }[backward]
    if objective == "conditional":
        return solver in TABLES and backward == "unrolled"
    if backward != "detached":
        return False
    if solver in TABLES:
        return False
    return objective == "contrastive" or energy in ("rpi", "convex")  # laplace: sums of squares


def configuration(chosen: dict[str, str]) -> dict:
    convex = chosen["energy"] == "convex"
    return model(
        {"name": "epo", "modes": 2},
        **{kind: section(kind, option) for kind, option in chosen.items()},
        dynamics={"name": "double_integrator" if convex else "unicycle"},
        horizon=6,
    )


@pytest.mark.parametrize("energy", OPTIONS["energy"])
@pytest.mark.parametrize("solver", OPTIONS["solver"])
def test_every_combination_takes_a_step_or_is_refused(energy: str, solver: str) -> None:
    torch.manual_seed(1)
    scene = random_scene(4, 2, history=4, horizon=6, size=1.0)
    for backward, objective in itertools.product(OPTIONS["backward"], OPTIONS["objective"]):
        chosen = {"energy": energy, "solver": solver, "backward": backward, "objective": objective}
        if not works(**chosen):
            with pytest.raises(ConfigError, match=r"With this instead it works|More than two parts") as refusal:
                build_forecaster(configuration(chosen))
            remedies_work(str(refusal.value), chosen)
            continue
        forecaster = build_forecaster(configuration(chosen)).train()
        terms = forecaster.losses(scene, forecaster(scene))
        loss = sum(weight * value for weight, value in terms.values())
        assert loss.isfinite(), chosen
        loss.backward()
        gradients = [p.grad for p in forecaster.parameters() if p.grad is not None]
        assert all(gradient.isfinite().all() for gradient in gradients), chosen
        assert sum(gradient.abs().sum() for gradient in gradients) > 0, chosen
        # A step along the gradient, and the next forecast is another one.
        before = forecaster(scene).states.detach()
        torch.optim.SGD(forecaster.parameters(), 1e-2).step()
        assert not torch.equal(forecaster(scene).states, before), chosen


@pytest.mark.parametrize("backward", ["unrolled", "truncated"])
def test_newton_steps_are_not_differentiated_through_steps(backward: str) -> None:
    chosen = {"energy": "rpi", "solver": "game", "backward": backward, "objective": "imitation"}
    with pytest.raises(
        ConfigError,
        match=r"levenberg_marquardt as it is set provides solutions with an implicit derivative.*"
        r"backward=implicit",
    ):
        build_forecaster(configuration(chosen))


class Plain(Minimiser):
    """A solver of one's own that declares nothing."""

    def __call__(self, energy: Energy, scene: Scene, parameters: GameParameters) -> Solution:
        raise NotImplementedError


def test_a_solver_that_declares_nothing_is_told_so_and_what_it_works_with(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(registry._PARTS["solver"], "plain", Plain)
    chosen = {"energy": "rpi", "solver": "levenberg_marquardt", "backward": "unrolled", "objective": "imitation"}
    with pytest.raises(
        ConfigError,
        match=r"and solver=plain as it is set provides nothing, because its `provides` is empty: declare there .*STATIONARY "
        r"for backward=implicit, STEPS for backward=truncated, PATH or TABLES for backward=unrolled; .* instead it works: "
        r".*solver=levenberg_marquardt",
    ):
        build_forecaster({**configuration(chosen), "solver": {"name": "plain"}})


def options_of(kinds: tuple[str, ...]) -> itertools.product:
    return itertools.product(*(OPTIONS[kind] for kind in kinds))


def remedies_work(message: str, chosen: dict[str, str]) -> None:
    """Every change that a refusal names is one that works; it names none only where no two changes do."""
    if "More than two parts" in message:
        pairs = itertools.combinations(OPTIONS, 2)
        changed = ({**chosen, **dict(zip(kinds, new, strict=True))} for kinds in pairs for new in options_of(kinds))
        assert not any(works(**after) for after in changed)
        return
    remedies = message.split("With this instead it works: ")[1].split(", or ")
    names = {"features": "rpi"}
    for remedy in remedies:
        words = [word.replace("an energy named ", "energy=").split("=") for word in remedy.split(" with ")]
        after = {**chosen, **{kind: names.get(name, name) for kind, name in words}}
        assert after != chosen
        assert works(**after), (message, after)
