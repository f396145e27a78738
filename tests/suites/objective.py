"""Suite of every training objective."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import pytest
import torch

from epo_lightning.forecast import GameParameters, JointForecast
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, Energy
from epo_lightning.objectives.base import Objective, Terms
from epo_lightning.registry import ConfigError, build
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY, STEPS, TABLES

from .games import MODES, build_energy, game_of, in_order, padded

ENERGY = {"name": "features", "own": ["goal", "vel", "acc", "turnr"], "pair": ["proximity"]}


class ObjectiveSuite:
    """An objective is a mean over scenes of named, weighted terms, blind for padding and for what was not observed.

    Attributes:
        config: ``name`` and arguments of the objective.
        solver: a minimiser that goes with it.
    """

    config: ClassVar[dict[str, Any]]
    solver: ClassVar[dict[str, Any]] = {"name": "gradient_descent", "steps": 3}

    @pytest.fixture
    def objective(self) -> Objective:
        return build("objective", self.config)

    @pytest.fixture
    def energy(self) -> Energy:
        return build_energy(ENERGY)

    def game(self, energy: Energy) -> tuple[Scene, GameParameters]:
        minimiser = build("solver", self.solver)
        scene, game = game_of(energy, starts=minimiser.strategies(MODES))
        starts, games = game.initial_controls, minimiser.games(MODES)
        one = game.map(lambda tensor: tensor[:, :games] if tensor.shape[1] == MODES else tensor)
        scene.future_mask[0, 1, 3:] = False
        return scene, GameParameters(**{**vars(one), "initial_controls": starts})

    def forecast(self, energy: Energy, scene: Scene, game: GameParameters) -> JointForecast:
        """A forecast whose modes have logits 0, 1, .."""
        solution = build("solver", self.solver).for_modes(MODES).for_test()(energy, scene, game)
        logits = torch.arange(MODES, dtype=torch.float64).expand(len(scene.history), -1)
        choice = TABLES in build("solver", self.solver).provides
        starts = energy.dynamics.rollout(energy.current_states(scene), game.initial_controls, scene.dt)
        return JointForecast(
            solution.states,
            logits.softmax(1),
            controls=solution.controls,
            initial_states=None if choice else starts,
            parameters=game,
            solution=solution,
            logits=logits,
        )

    def terms(self, objective: Objective, energy: Energy, scene: Scene, game: GameParameters) -> Terms:
        return objective(scene, self.forecast(energy, scene, game), energy)

    @staticmethod
    def weighted(terms: Terms) -> dict[str, torch.Tensor]:
        """The terms that count; others are for the log alone, and need not be means over scenes."""
        return {name: value for name, (weight, value) in terms.items() if weight > 0}

    def test_terms_have_the_declared_names(self, objective, energy):
        assert objective.needs_from_solver <= {PATH, STEPS, STATIONARY, SAMPLES, TABLES}
        assert objective.needs_from_energy <= {GRADIENT, RESIDUALS, FEATURES}
        assert set(objective.weights) == set(objective.term_names)
        terms = self.terms(objective, energy, *self.game(energy))
        for name, (weight, value) in terms.items():
            assert value.shape == ()
            assert value.isfinite()
            assert weight == objective.weights.get(name, 0.0), "what has no weight is for the log alone"

    def test_decoded_goals_are_taught_with_the_weight_of_their_term(self, objective, energy):
        """The term is the cross entropy with the candidate closest to the last position, where both exist."""
        if "goal" not in objective.term_names:
            pytest.skip("this objective has no term for goals")
        scene, game = self.game(energy)
        plain = self.forecast(energy, scene, game)
        candidates, logits = torch.randn(3, 3, 4, 2).double(), torch.randn(3, 3, 4).double()
        exists = torch.ones(3, 3, 4, dtype=torch.bool)
        exists[1, 0, 1:], exists[2, 1] = False, False
        probabilities = torch.where(exists, logits, -torch.inf).softmax(-1).nan_to_num()
        forecast = dataclasses.replace(plain, goal_probabilities=probabilities, goal_logits=logits)
        decoded = dataclasses.replace(scene, goal_candidates=candidates, goal_mask=exists)
        weight, value = objective(decoded, forecast, energy)["goal"]
        means, nearest = [], set()
        for b in range(3):
            taught = [i for i in range(3) if scene.future_mask[b, i, -1] and exists[b, i].any()]
            closest = {i: self.closest(candidates[b, i], exists[b, i], scene.future[b, i, -1, :2]) for i in taught}
            nearest |= {*closest.values()}
            means.append(sum(-float(probabilities[b, i, g].log()) for i, g in closest.items()) / len(taught))
        assert len(nearest) > 1
        assert weight == objective.weights["goal"] > 0
        assert float(value) == pytest.approx(sum(means) / 3)

    @staticmethod
    def closest(candidates: torch.Tensor, exists: torch.Tensor, final: torch.Tensor) -> int:
        return min((int(g) for g in exists.nonzero()), key=lambda g: float((candidates[g] - final).norm()))

    def test_weights_are_checked_by_name(self, objective):
        weights = dict(objective.weights)
        name = next(iter(self.config["weights"]))
        for wrong in ({**weights, "imitaton": 1.0}, {**weights, name: -1.0}, dict.fromkeys(weights, 0.0), {}):
            with pytest.raises(ConfigError, match=r"objective\.weights"):
                build("objective", {**self.config, "weights": wrong})

    def test_terms_are_means_over_scenes(self, objective, energy):
        scene, game = self.game(energy)
        together = self.weighted(self.terms(objective, energy, scene, game))
        alone = [self.weighted(self.terms(objective, energy, scene[b], game[b])) for b in range(3)]
        for name, value in together.items():
            torch.testing.assert_close(value, torch.stack([terms[name] for terms in alone]).mean(), msg=name)

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_does_not_change_the_loss(self, objective, energy, filling):
        scene, game = self.game(energy)
        expected = self.weighted(self.terms(objective, energy, scene, game))
        wide = self.weighted(self.terms(objective, energy, *padded(scene, game, filling)))
        for name, value in expected.items():
            torch.testing.assert_close(wide[name], value, msg=name)

    def test_the_loss_is_invariant_to_the_order_of_agents(self, objective, energy):
        scene, game = self.game(energy)
        expected = self.weighted(self.terms(objective, energy, scene, game))
        other = self.weighted(self.terms(objective, energy, *in_order(energy, scene, game, [2, 0, 1])))
        for name, value in expected.items():
            torch.testing.assert_close(other[name], value, rtol=1e-6, atol=1e-8, msg=name)

    def test_unobserved_steps_do_not_change_the_loss(self, objective, energy):
        """Neither the values nor, for a scene without observations, the gradient."""
        scene, game = self.game(energy)
        scene.future_mask[1] = False
        totals = []
        for filling in (0.0, float("nan")):
            future = torch.where(scene.future_mask[..., None], scene.future, filling)
            leaves = game.map(lambda tensor: tensor.clone().requires_grad_())
            terms = self.terms(objective, energy, dataclasses.replace(scene, future=future), leaves)
            total = sum(weight * value for weight, value in terms.values())
            total.backward()
            totals.append(total.detach())
            for weight in (*leaves.own_weights.values(), *leaves.pair_weights.values()):
                if weight.grad is not None:
                    assert weight.grad.isfinite().all()
                    assert (weight.grad[1] == 0).all()
        torch.testing.assert_close(totals[1], totals[0])

    def test_the_gradient_equals_finite_differences(self, objective, energy):
        """The gradient with respect to the game's weights, through the solution for objectives that use its derivative."""
        scene, game = self.game(energy)
        constant = None if objective.through_solution else self.forecast(energy, scene, game)

        def total(own: dict[str, torch.Tensor]) -> torch.Tensor:
            changed = dataclasses.replace(game, own_weights=own)
            if constant is None:
                terms = self.terms(objective, energy, scene, changed)
            else:
                terms = objective(scene, dataclasses.replace(constant, parameters=changed), energy)
            return sum(weight * value for weight, value in terms.values())

        leaves = {name: weight.clone().requires_grad_() for name, weight in game.own_weights.items()}
        total(leaves).backward()
        direction = {name: torch.randn_like(weight) for name, weight in leaves.items()}
        slope = sum((weight.grad * direction[name]).sum() for name, weight in leaves.items())
        ahead, behind = (
            total({name: weight + sign * 1e-6 * direction[name] for name, weight in game.own_weights.items()})
            for sign in (1, -1)
        )
        assert slope != 0
        torch.testing.assert_close(slope, (ahead - behind) / 2e-6, rtol=1e-4, atol=1e-7)

    def test_a_scene_without_a_future_is_refused(self, objective, energy):
        scene, game = self.game(energy)
        blind = dataclasses.replace(scene, future=None, future_mask=None)
        with pytest.raises(ValueError, match=r"scene\.future"):
            self.terms(objective, energy, blind, game)
