"""Suite of every minimiser."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
import torch

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.energy import FEATURES, GRADIENT, RESIDUALS, STAGES, Energy
from epo_lightning.registry import build
from epo_lightning.scene import Scene
from epo_lightning.solvers.base import PATH, SAMPLES, STATIONARY, STEPS, TABLES, Minimiser, Stepwise

from .games import HORIZON, MODES, build_energy, game_of, in_order, padded, poisoned

ENERGY = {"name": "features", "own": ["goal", "vel", "acc", "turnr"], "pair": ["proximity"]}


class SolverSuite:
    """A minimiser lowers the energy of every sample independently, and declares what it needs and provides.

    What is drawn at random in training is left out by :meth:`~epo_lightning.solvers.base.Minimiser.for_test`, with which
    all of this is tested.

    Attributes:
        config: ``name`` and arguments of the minimiser.
        converged: arguments with which it comes close to a minimum, for minimisers that provide STATIONARY.
        remaining: share of the gradient's norm at the start that is left there at most.
        tolerance: of controls that two ways of computing should agree on.
    """

    config: ClassVar[dict[str, Any]]
    converged: ClassVar[dict[str, Any]] = {}
    remaining: ClassVar[float] = 1e-5
    tolerance: ClassVar[float] = 1e-9

    def minimiser(self, **changes: Any) -> Minimiser:
        return build("solver", {**self.config, **changes}).for_modes(MODES).for_test()

    @property
    def provides(self) -> frozenset[str]:
        """Solution of the minimiser in training, with what it provides."""
        return build("solver", self.config).provides

    @pytest.fixture
    def energy(self) -> Energy:
        return build_energy(ENERGY)

    def game(self, energy: Energy) -> tuple[Scene, GameParameters]:
        """A game for as many modes, and with as many starts, as the minimiser takes."""
        minimiser = self.minimiser()
        scene, game = game_of(energy, starts=max(MODES, minimiser.strategies(MODES)))
        games = minimiser.games(MODES)
        starts = game.initial_controls
        one = game.map(lambda tensor: tensor[:, :games] if tensor.shape[1] == MODES else tensor)
        return scene, GameParameters(**{**vars(one), "initial_controls": starts})

    def assert_same(self, one: Solution, other: Solution) -> None:
        for name in ("controls", "states", "energy", "initial_energy"):
            given, expected = getattr(one, name), getattr(other, name)
            torch.testing.assert_close(given, expected, rtol=self.tolerance, atol=self.tolerance, msg=name)
        assert torch.equal(one.status, other.status)

    def test_declared_properties_have_their_types(self):
        minimiser = build("solver", self.config)
        assert minimiser.needs_from_energy <= {GRADIENT, RESIDUALS, FEATURES, STAGES}
        assert minimiser.provides <= {PATH, STEPS, STATIONARY, SAMPLES, TABLES}
        assert minimiser.provides
        assert (STEPS in minimiser.provides) == isinstance(minimiser, Stepwise)

    def test_a_solution_is_consistent(self, energy):
        scene, game = self.game(energy)
        solution = self.minimiser()(energy, scene, game)
        assert solution.controls.shape == (3, MODES, 3, HORIZON, 2)
        assert solution.status.shape == (3, MODES)
        assert set(solution.status.flatten().tolist()) <= set(Status)
        states = energy.dynamics.rollout(energy.current_states(scene), solution.controls, scene.dt)
        torch.testing.assert_close(solution.states, states)
        torch.testing.assert_close(solution.energy, energy(scene, game.for_every_mode(MODES), solution.controls))
        if TABLES in self.provides:
            assert solution.tables is not None
            assert solution.assignment is not None
            assert (solution.energy.diff(dim=1) >= -1e-12).all(), "the best choice comes first"
        else:
            starts = game.initial_controls[:, : self.minimiser().strategies(MODES)]
            expected = energy(scene, game, starts).expand_as(solution.initial_energy)
            torch.testing.assert_close(solution.initial_energy, expected)

    def test_a_solution_has_less_energy_than_its_start(self, energy):
        if TABLES in self.provides:
            pytest.skip("this minimiser chooses, and has no start")
        solution = self.minimiser()(energy, *self.game(energy))
        assert (solution.energy < solution.initial_energy).all()

    def test_the_gradient_vanishes_at_converged_solutions(self, energy):
        if STATIONARY not in self.provides:
            pytest.skip("this minimiser does not lead to minima")
        scene, game = self.game(energy)
        with torch.no_grad():
            solution = self.minimiser(**self.converged)(energy, scene, game)

        def norm(controls: torch.Tensor) -> torch.Tensor:
            leaf = controls.detach().requires_grad_()
            return torch.autograd.grad(energy(scene, game, leaf).sum(), leaf)[0].flatten(2).norm(dim=-1)

        torch.testing.assert_close(solution.gradient_norm, norm(solution.controls), rtol=1e-4, atol=1e-6)
        assert (norm(solution.controls) < self.remaining * norm(game.initial_controls)).all()

    def test_samples_are_independent(self, energy):
        scene, game = self.game(energy)
        together = self.minimiser()(energy, scene, game)
        for index in range(3):
            self.assert_same(self.minimiser()(energy, scene[index], game[index]), together[index])

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_does_not_change_solutions(self, energy, filling):
        scene, game = self.game(energy)
        alone, wide = self.minimiser()(energy, scene, game), self.minimiser()(energy, *padded(scene, game, filling))
        torch.testing.assert_close(wide.controls[:, :, :3], alone.controls, rtol=self.tolerance, atol=self.tolerance)
        torch.testing.assert_close(wide.energy, alone.energy)
        assert wide.controls.isfinite().all()
        assert torch.equal(wide.status, alone.status)

    def test_a_poisoned_sample_leaves_the_others_unchanged(self, energy):
        scene, game = self.game(energy)
        healthy, spoiled = self.minimiser()(energy, scene, game), self.minimiser()(energy, poisoned(scene), game)
        assert torch.equal(spoiled.controls[[0, 2]], healthy.controls[[0, 2]])
        assert torch.equal(spoiled.status[[0, 2]], healthy.status[[0, 2]])

    def test_solutions_are_equivariant_to_the_order_of_agents(self, energy):
        scene, game = self.game(energy)
        order = [2, 0, 1]
        expected = self.minimiser()(energy, scene, game)
        other = self.minimiser()(energy, *in_order(energy, scene, game, order))
        torch.testing.assert_close(other.controls, expected.controls[:, :, order], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(other.energy, expected.energy, rtol=1e-6, atol=1e-6)

    def test_the_path_has_the_derivative_of_what_was_computed(self, energy):
        """Derivatives with respect to weights and initial strategies, against finite differences."""
        minimiser = self.minimiser()
        if PATH not in self.provides:
            pytest.skip("this minimiser provides no path")
        scene, game = self.game(energy)
        leaves = game.map(lambda tensor: tensor.clone().requires_grad_())
        direction = game.map(torch.randn_like)

        def total(parameters: GameParameters) -> torch.Tensor:
            return minimiser(energy, scene, parameters).states[..., :2].square().sum()

        def moved(step: float) -> GameParameters:
            own = {name: w + step * direction.own_weights[name] for name, w in game.own_weights.items()}
            pair = {name: w + step * direction.pair_weights[name] for name, w in game.pair_weights.items()}
            starts = game.initial_controls + step * direction.initial_controls
            return GameParameters(
                **{**vars(game), "own_weights": own, "pair_weights": pair, "initial_controls": starts}
            )

        total(leaves).backward()
        slope = sum((w.grad * direction.own_weights[name]).sum() for name, w in leaves.own_weights.items())
        slope = slope + sum((w.grad * direction.pair_weights[name]).sum() for name, w in leaves.pair_weights.items())
        slope = slope + (leaves.initial_controls.grad * direction.initial_controls).sum()
        expected = (total(moved(1e-6)) - total(moved(-1e-6))) / 2e-6
        torch.testing.assert_close(slope, expected, rtol=1e-4, atol=1e-6)
