"""Suite of every energy and every feature."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import pytest
import torch

from epo_lightning.game.double_integrator import DoubleIntegrator
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, STAGES, Energy
from epo_lightning.solvers.gauss_newton.levenberg_marquardt import LevenbergMarquardt

from .games import MODES, build_energy, game_of, in_order, padded, poisoned

NEEDS = {"goals", "goal_headings", "reference", "reference_speed", "size", "context", "order", "reference_controls"}


class EnergySuite:
    """An energy is the potential of a game, keeps samples apart, and declares what it needs and offers.

    Attributes:
        config: ``name`` and arguments of the energy.
        linear: whether it takes linear dynamics instead of the unicycle.
    """

    config: ClassVar[dict[str, Any]]
    linear: ClassVar[bool] = False

    @pytest.fixture
    def energy(self) -> Energy:
        return build_energy(self.config, DoubleIntegrator() if self.linear else None)

    def test_terms_have_the_declared_names_and_shapes(self, energy):
        scene, game = game_of(energy)
        terms = energy.terms(scene, game, game.initial_controls)
        assert set(terms) == {*energy.own, *energy.pair}
        assert all(terms[name].shape == (3, MODES, 3) for name in terms)  # three agents, and three pairs
        own, pair = energy.weighted
        assert set(own) <= set(energy.own)
        assert set(pair) <= set(energy.pair)
        assert energy.goal_terms <= set(energy.own)
        assert energy.offers <= {GRADIENT, RESIDUALS, FEATURES, STAGES}
        assert energy.needs <= NEEDS
        assert ("order" in energy.needs) == (energy.pair_order is not None)
        assert set(energy.decoded_margins) <= set(pair)
        total = energy(scene, game, game.initial_controls)
        assert total.isfinite().all()
        torch.testing.assert_close(total, sum(term.sum(-1) for term in terms.values()))

    def test_optional_inputs_may_be_missing(self, energy):
        scene, game = game_of(energy)
        without = {"references": None, "reference_mask": None} if "reference" not in energy.needs else {}
        without |= {} if "reference_speed" in energy.needs else {"reference_speed": None}
        bare = dataclasses.replace(
            scene, goal_candidates=None, goal_mask=None, future=None, future_mask=None, **without
        )
        expected = energy(scene, game, game.initial_controls)
        assert torch.equal(energy(bare, game, game.initial_controls), expected)

    def test_a_missing_required_input_is_named(self, energy):
        scene, game = game_of(energy)
        for name in energy.needs:
            of_game = name in ("goals", "goal_headings", "reference", "context", "order", "reference_controls")
            lacking, holder = (game, "game") if of_game else (scene, "scene")
            lacking = dataclasses.replace(lacking, **{name: None})
            with pytest.raises(ValueError, match=name):
                energy(*((scene, lacking) if holder == "game" else (lacking, game)), game.initial_controls)

    def test_the_energy_is_the_potential_of_a_game(self, energy):
        """A change of one agent's strategy changes the energy by as much as that agent's objective (Theorem 1)."""
        scene, game = game_of(energy)
        controls = game.initial_controls
        before, objective = energy(scene, game, controls), energy.objectives(scene, game, controls)
        for agent in range(3):
            other = controls.clone()
            other[:, :, agent] = 0.5 * torch.randn_like(other[:, :, agent])
            change = energy.objectives(scene, game, other)[:, :, agent] - objective[:, :, agent]
            torch.testing.assert_close(energy(scene, game, other) - before, change, rtol=1e-9, atol=1e-9)

    def test_samples_and_modes_are_independent(self, energy):
        scene, game = game_of(energy)
        together = energy(scene, game, game.initial_controls)
        for index in range(3):
            alone = energy(scene[index], game[index], game.initial_controls[[index]])
            torch.testing.assert_close(alone[0], together[index], rtol=1e-12, atol=1e-12)
        swapped = game.map(lambda tensor: tensor.flip(1) if tensor.shape[1] == MODES else tensor)
        flipped = energy(scene, swapped, game.initial_controls.flip(1)).flip(1)
        torch.testing.assert_close(flipped, together, rtol=1e-12, atol=1e-12)

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_does_not_change_the_energy(self, energy, filling):
        scene, game = game_of(energy)
        wide_scene, wide = padded(scene, game, filling)
        controls, wide_controls = (g.initial_controls.clone().requires_grad_() for g in (game, wide))
        alone, together = energy(scene, game, controls), energy(wide_scene, wide, wide_controls)
        torch.testing.assert_close(together, alone, rtol=1e-12, atol=1e-12)
        if GRADIENT in energy.offers:
            (expected,) = torch.autograd.grad(alone.sum(), controls)
            (gradient,) = torch.autograd.grad(together.sum(), wide_controls)
            torch.testing.assert_close(gradient[:, :, :3], expected, rtol=1e-10, atol=1e-10)
            assert (gradient[:, :, 3:] == 0).all()

    def test_a_poisoned_sample_leaves_the_others_unchanged(self, energy):
        scene, game = game_of(energy)
        controls = game.initial_controls.clone().requires_grad_()
        healthy, spoiled = energy(scene, game, controls), energy(poisoned(scene), game, controls)
        assert torch.equal(spoiled[[0, 2]], healthy[[0, 2]])
        if GRADIENT in energy.offers:
            (expected,) = torch.autograd.grad(healthy.sum(), controls)
            (gradient,) = torch.autograd.grad(spoiled.sum(), controls)
            assert torch.equal(gradient[[0, 2]], expected[[0, 2]])

    def test_the_energy_is_equivariant_to_the_order_of_agents(self, energy):
        scene, game = game_of(energy)
        other_scene, other = in_order(energy, scene, game, [2, 0, 1])
        expected = energy(scene, game, game.initial_controls)
        torch.testing.assert_close(energy(other_scene, other, other.initial_controls), expected, rtol=1e-12, atol=1e-12)

    def test_the_gradient_equals_finite_differences(self, energy):
        if GRADIENT not in energy.offers:
            pytest.skip("this energy offers no gradient")
        scene, game = game_of(energy)
        controls = game.initial_controls.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(energy(scene, game, controls).sum(), controls)
        for direction in torch.randn(5, *controls.shape, dtype=torch.float64):
            ahead, behind = (energy(scene, game, controls.detach() + sign * 1e-6 * direction) for sign in (1, -1))
            slope = (gradient * direction).flatten(2).sum(-1)
            torch.testing.assert_close(slope, (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-6)

    def test_tables_hold_the_energies_of_all_choices(self, energy):
        scene, game = game_of(energy)
        one = game.map(lambda tensor: tensor[:, :1] if tensor.shape[1] == MODES else tensor)
        candidates = game.initial_controls
        unary, pair = energy.tables(scene, one, candidates)
        assert unary.shape == (3, 3, MODES)
        assert pair.shape == (3, 3, MODES, MODES)
        for choice in ([0, 1, 0], [1, 1, 0]):
            controls = torch.stack([candidates[:, k, i] for i, k in enumerate(choice)], 1)[:, None]
            expected = sum(unary[:, i, k] for i, k in enumerate(choice))
            for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
                expected = expected + pair[:, p, choice[i], choice[j]]
            torch.testing.assert_close(energy(scene, one, controls)[:, 0], expected, rtol=1e-10, atol=1e-10)


class FeatureSuite(EnergySuite):
    """A feature obeys the rules of an energy that consists of it alone, and the solver knows its derivative.

    Attributes:
        own, pair: name of the feature, as an own or as a pair feature.
        bounds: of the feature's signal, for violations.
    """

    own: ClassVar[str] = ""
    pair: ClassVar[str] = ""
    bounds: ClassVar[dict[str, list[float]]] = {}

    @pytest.fixture
    def energy(self) -> Energy:
        assert bool(self.own) != bool(self.pair), "a feature is an own or a pair feature"
        own, pair = ([self.own] if self.own else []), ([self.pair] if self.pair else [])
        return build_energy({"name": "features", "own": own, "pair": pair, "bounds": self.bounds})

    def test_terms_are_quadratic_in_their_weights(self, energy):
        scene, game = game_of(energy)
        value = energy(scene, game, game.initial_controls)
        assert (value > 0).any(), "the feature is active in some of the random games"
        doubled = {
            kind: {name: 2.0 * weight for name, weight in getattr(game, kind).items()}
            for kind in ("own_weights", "pair_weights")
        }
        heavy = dataclasses.replace(game, **doubled)
        torch.testing.assert_close(energy(scene, heavy, game.initial_controls), 4.0 * value)

    def test_the_gradient_of_the_solver_equals_autograd(self, energy):
        """A step with a damping far above the curvature goes against the gradient, by 1 / damping of it."""
        scene, game = game_of(energy)
        controls = game.initial_controls.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(energy(scene, game, controls).sum(), controls)
        solver = LevenbergMarquardt(steps=1, step_size=1.0, damping=1e9, backend="pytorch")
        step = solver(energy, scene, game).controls - game.initial_controls
        torch.testing.assert_close(-1e9 * step, gradient, rtol=1e-4, atol=1e-5)
