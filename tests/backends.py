"""The suite of all backends of the layer: subclass it, set `solve`, and inherit its tests.

The reference is written for clearness: a dense Jacobian from forward-mode differentiation, a general linear solver, and
plain automatic differentiation through both.
"""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext

import pytest
import torch
from games import ALL, BOUNDS, leaves_of, nearest_points_held, pad, random_game, random_scene, widen
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch.utils._python_dispatch import TorchDispatchMode

from epo_lightning.forecast import GameParameters, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene

STATE_PAIRS = (
    ("circles",),
    ("headway", "proximity"),
    ("longitudinal",),
    ("lateral", "clearance"),
    ("time_to_conflict",),
)
"""Pair features of states, some of them with a feature of the distance."""


class HostMustNotWait(TorchDispatchMode):
    """Fails on every operation whose result the host has to wait for."""

    WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "item", "equal", "is_nonzero", "unique", "bincount")

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.removeprefix("aten::")
        assert not name.startswith(self.WAITING), f"{name} makes the host wait"
        if name in ("index", "index_put", "index_put_", "_index_put_impl_"):
            chosen = [index for index in args[1] if index is not None]
            assert all(index.dtype != torch.bool for index in chosen), "an index of truth values makes the host wait"
        return function(*args, **(kwargs or {}))


def stacked(energy, scene, parameters, controls):
    return torch.cat([r.flatten(2) for r in energy.residuals(scene, parameters, controls).values()], -1)


def reference(energy, scene, parameters, steps, step_size, damping):
    """Damped Gauss-Newton, differentiable by automatic differentiation of everything; every iterate."""
    iterates = [parameters.initial_controls]
    for _ in range(steps):
        controls = iterates[-1]
        with nullcontext() if energy.lane_slides else nearest_points_held():
            jacobian = torch.func.jacfwd(lambda u: stacked(energy, scene, parameters, u).sum((0, 1)))(controls)
        jacobian = jacobian.permute(1, 2, 0, 3, 4, 5).flatten(3)
        residual = stacked(energy, scene, parameters, controls)[..., None]
        matrix = jacobian.mT @ jacobian + damping[..., None, None] * torch.eye(jacobian.shape[-1], dtype=controls.dtype)
        iterates.append(controls - step_size * torch.linalg.solve(matrix, jacobian.mT @ residual).view_as(controls))
    return iterates


def gradients(parameters: GameParameters) -> dict[str, torch.Tensor]:
    """The gradients of the leaves, by name."""
    leaves = {"initial_controls": parameters.initial_controls, "goals": parameters.goals}
    leaves |= {"goal_headings": parameters.goal_headings, "reference_controls": parameters.reference_controls}
    leaves |= {**parameters.own_weights, **parameters.pair_weights}
    leaves |= {f"margin of {name}": margin for name, margin in parameters.margins.items()}
    return {name: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}


@dataclasses.dataclass(frozen=True)
class Draw:
    """A random game: agents may be absent, overlap or not, and leave their bounds or not."""

    agents: int
    horizon: int
    own: frozenset[str]
    pair: tuple[str, ...]
    stride: int
    size: float
    bounded: bool
    absent: int
    seed: int
    ends: tuple[int, int] | None
    lane_slides: bool

    def make(self) -> tuple[FeatureEnergy, Scene, GameParameters]:
        torch.manual_seed(self.seed)
        horizon = self.horizon if self.agents <= 3 else min(self.horizon, 12)  # the reference is dense
        bounds = BOUNDS if self.bounded else dict.fromkeys(BOUNDS, (-99.0, 99.0))
        scene = random_scene(2, self.agents, history=2, size=self.size, dtype=torch.float64)
        scene.size.mul_(0.3 + torch.rand_like(scene.size))  # all sizes differ, and some are wider than long
        mask = torch.ones(2, self.agents, dtype=torch.bool)
        mask[1, self.absent : self.absent + 2] = False
        ends = None if self.ends is None else torch.tensor([min(end, horizon) for end in self.ends])
        scene = dataclasses.replace(scene, agent_mask=mask, game_steps=ends)
        return (
            FeatureEnergy(sorted(self.own), self.pair, bounds, pair_stride=self.stride, lane_slides=self.lane_slides),
            scene,
            random_game(scene, 2, horizon, pair=self.pair or ("proximity",)),
        )


def games(most: int = 8) -> st.SearchStrategy[Draw]:
    """Games of up to ``most`` agents over 3 to 40 steps, with any own features."""
    return st.builds(
        Draw,
        agents=st.integers(1, most),
        horizon=st.integers(3, 40),
        own=st.frozensets(st.sampled_from(ALL), min_size=1),
        pair=st.sampled_from([("proximity",), ("clearance",), ("proximity", "clearance"), *STATE_PAIRS, ()]),
        stride=st.sampled_from([1, 2]),
        size=st.sampled_from([0.01, 1.0, 3.0]),
        bounded=st.booleans(),
        absent=st.integers(0, most),
        seed=st.integers(0, 10_000),
        ends=st.none() | st.tuples(st.integers(1, 40), st.integers(1, 40)),
        lane_slides=st.booleans(),
    )


class BackendSuite:
    """Steps and gradients, the independence of samples, and the survival of bad ones."""

    @staticmethod
    def solve(energy, scene, parameters, steps, step_size, damping, keep_iterates=False):
        raise NotImplementedError

    def damped(self, energy, scene, parameters, steps=2, step_size=0.3, damping=10.0, **options):
        like = parameters.initial_controls
        damping = torch.full(like.shape[:2], damping, dtype=like.dtype)
        return self.solve(energy, scene, parameters, steps, step_size, damping, **options)

    @settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.differing_executors])
    @given(game=games(), steps=st.integers(1, 3), damping=st.sampled_from([1.0, 10.0]))
    def test_values_and_gradients_equal_the_reference(self, game, steps, damping):
        energy, scene, parameters = game.make()
        ours, theirs = leaves_of(parameters), leaves_of(parameters)
        per_sample = damping * (1.0 + torch.rand(parameters.initial_controls.shape[:2], dtype=torch.float64))
        solution = self.solve(energy, scene, ours, steps, 0.3, per_sample, keep_iterates=True)
        present = scene.agent_mask[:, None, :, None, None]
        expected = reference(energy, scene, theirs, steps, 0.3, per_sample)
        expected = [torch.where(present, iterate, 0.0) for iterate in expected]
        states = energy.dynamics.rollout(energy.current_states(scene), expected[-1], scene.dt)
        assert (solution.status == Status.COMPLETED).all()
        for mine, iterate in zip(solution.iterates, expected, strict=True):
            torch.testing.assert_close(mine, iterate, rtol=0, atol=1e-9)
        real = present.expand_as(states)
        torch.testing.assert_close(solution.states[real], states[real], rtol=0, atol=1e-9)
        torch.testing.assert_close(
            solution.initial_energy, energy(scene, parameters, expected[0]), rtol=1e-9, atol=1e-9
        )
        torch.testing.assert_close(solution.energy, energy(scene, parameters, expected[-1]), rtol=1e-9, atol=1e-9)
        end = expected[-1].detach().requires_grad_()
        (slope,) = torch.autograd.grad(energy(scene, parameters, end).sum(), end)
        torch.testing.assert_close(solution.gradient_norm, slope.flatten(2).norm(dim=-1), rtol=1e-8, atol=1e-8)

        # Cotangents of everything that is differentiable: the controls, the states, and an iterate on the way.
        weigh = [torch.randn_like(states), torch.randn_like(expected[0]), torch.randn_like(expected[0])]
        weigh[0] *= present
        for controls, x, middle in (
            (solution.controls, solution.states, solution.iterates[steps // 2]),
            (expected[-1], states, expected[steps // 2]),
        ):
            ((x * weigh[0]).sum() + (controls * weigh[1]).sum() + (middle * weigh[2]).sum()).backward()
        exact = gradients(theirs)
        for name, gradient in gradients(ours).items():
            scale = exact[name].abs().max().clamp_min(1.0) if exact[name].numel() else 1.0
            torch.testing.assert_close(gradient / scale, exact[name] / scale, rtol=0, atol=1e-9, msg=name)

    def single_and_double(self, game):
        """The solutions of one step in single and in double precision, of the same rounded game."""
        energy, scene, parameters = game.make()
        scene, parameters = scene.to(torch.float32), parameters.to(torch.float32)
        double = scene.to(torch.float64), parameters.to(torch.float64)
        return self.damped(energy, scene, parameters, steps=1), self.damped(energy, *double, steps=1)

    @settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.differing_executors])
    @given(game=games(most=4))
    def test_a_float32_step_is_close_to_float64(self, game):
        single, exact = self.single_and_double(game)
        # Metres from a line, the squared distances to a corner and to a point millimetres beside it are equal in single
        # precision. Where the derivative follows the line, which of the two is taken decides on its direction.
        corners = game.lane_slides and "lane" in game.own
        torch.testing.assert_close(single.controls.double(), exact.controls, rtol=0, atol=1e-2 if corners else 5e-5)
        assert single.controls.dtype == single.energy.dtype == torch.float32

    def test_few_float32_steps_are_beside_corners_of_lines(self):
        games = [Draw(1, 20, frozenset(("lane", "vel")), (), 1, 1.0, False, 1, seed, None, True) for seed in range(50)]
        close = 0
        for game in games:
            single, exact = self.single_and_double(game)
            close += bool((single.controls.double() - exact.controls).abs().max() < 5e-5)
        assert close >= 47

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("agents", [1, 2, 4, 6])
    def test_samples_do_not_depend_on_their_batch_bit_for_bit(self, dtype, agents):
        scene = random_scene(19, agents, history=2, size=1.5, dtype=dtype)
        parameters = random_game(scene, modes=3, horizon=9)
        energy = FeatureEnergy(ALL, bounds=BOUNDS)
        leaves = leaves_of(parameters)
        together = self.damped(energy, scene, leaves)
        (together.states.sum() + together.controls.square().sum()).backward()
        for chosen in ([4], [17, 2, 9]):
            few = leaves_of(parameters[chosen])
            alone = self.damped(energy, scene[chosen], few)
            (alone.states.sum() + alone.controls.square().sum()).backward()
            for name in ("controls", "states", "energy", "initial_energy", "gradient_norm"):
                assert torch.equal(getattr(alone, name), getattr(together, name)[chosen]), name
            all_of_them = gradients(leaves)
            for name, gradient in gradients(few).items():
                assert torch.equal(gradient, all_of_them[name][chosen]), name

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    def test_padding_changes_no_bit(self, filling):
        scene = random_scene(5, 3, history=2, size=1.5)
        parameters = random_game(scene)
        energy = FeatureEnergy(ALL, bounds=BOUNDS)
        leaves, wide = leaves_of(parameters), leaves_of(widen(parameters, filling=filling))
        alone, padded = self.damped(energy, scene, leaves), self.damped(energy, pad(scene, filling=filling), wide)
        assert torch.equal(padded.controls[:, :, :3], alone.controls)
        assert (padded.controls[:, :, 3:] == 0).all()
        assert torch.equal(padded.states[:, :, :3], alone.states)
        assert torch.equal(padded.energy, alone.energy)
        assert torch.equal(padded.gradient_norm, alone.gradient_norm)
        assert padded.states.isfinite().all()
        alone.states.square().sum().backward()
        padded.states.square().sum().backward()
        assert torch.equal(wide.initial_controls.grad[:, :, :3], leaves.initial_controls.grad)
        for name, weight in wide.own_weights.items():
            assert torch.equal(weight.grad[:, :, :3], leaves.own_weights[name].grad)
            assert (weight.grad[:, :, 3:] == 0).all()

    @pytest.mark.parametrize(
        "kind", ["history", "weight", "pair weight", "goal", "controls", "overflow", "size", "a point of a line"]
    )
    def test_a_poisoned_sample_stops_and_leaves_the_others_bit_identical(self, kind):
        scene, damping = random_scene(4, 2, history=2, size=3.0), 10.0
        parameters = random_game(scene)
        energy = FeatureEnergy(ALL, bounds=BOUNDS)
        sound = self.damped(energy, scene, parameters, damping=damping)
        poisoned = parameters.map(torch.clone)
        if kind == "history":
            history = scene.history.clone()
            history[1] = torch.nan
            scene = dataclasses.replace(scene, history=history)
        elif kind == "size":
            size = scene.size.clone()
            size[1, 0, 0] = torch.nan
            scene = dataclasses.replace(scene, size=size)
        elif kind == "a point of a line":
            references = scene.references.clone()
            references[1, :, :, 3, 1] = torch.inf
            scene = dataclasses.replace(scene, references=references)
        elif kind == "goal":
            poisoned.goals[1, :, 0] = torch.inf
        elif kind == "controls":
            poisoned.initial_controls[1, :, 0, 3] = torch.nan
        else:
            weight = poisoned.pair_weights["proximity"] if kind == "pair weight" else poisoned.own_weights["acc"]
            weight[1] = 1e30 if kind == "overflow" else torch.nan
        leaves = leaves_of(poisoned)
        solution = self.damped(energy, scene, leaves, damping=damping)
        others = [0, 2, 3]
        assert torch.equal(solution.controls[others], sound.controls[others])
        assert torch.equal(solution.energy[others], sound.energy[others])
        assert (solution.status[others] == sound.status[others]).all()
        assert (solution.status[1] == Status.STOPPED).all()
        # The last good iterate is where it started.
        torch.testing.assert_close(solution.controls[1], poisoned.initial_controls[1], rtol=0, atol=0, equal_nan=True)
        solution.controls[others].sum().backward()
        for name, gradient in gradients(leaves).items():
            assert gradient[others].isfinite().all(), name

    def test_a_singular_sample_is_reported_as_damped(self):
        scene = random_scene(4, 2, history=2, size=0.01)
        parameters = random_game(scene, own=("acc", "turnr"))
        for weight in parameters.own_weights.values():
            weight[1] = 0.0
        solution = self.damped(FeatureEnergy(["acc", "turnr"]), scene, parameters, damping=0.0)
        assert (solution.status == torch.tensor([0, 1, 0, 0])[:, None]).all()
        assert torch.equal(solution.controls[1], parameters.initial_controls[1]), "nothing pulls anywhere"
        assert (solution.controls[0] - 0.49 * parameters.initial_controls[0]).abs().max() < 1e-5, "two steps of 0.3"

    def test_absent_reference_lines_have_no_effect(self):
        scene, energy = random_scene(3, 2, history=2, dtype=torch.float64), FeatureEnergy(["lane", "acc", "turnr"])
        parameters = random_game(scene)
        mask = torch.rand(3, 2, 2) < 0.5
        lines = torch.where(mask[..., None, None], scene.references, torch.nan)
        leaves = leaves_of(parameters)
        masked = dataclasses.replace(scene, references=lines, reference_mask=mask)
        solution = self.damped(energy, masked, leaves)
        followed = mask[:, None].expand(-1, 2, -1, -1).gather(-1, parameters.reference[..., None])[..., 0]
        assert followed.any()
        assert not followed.all()
        lane = torch.where(followed, parameters.own_weights["lane"], 0.0)
        without = dataclasses.replace(parameters, own_weights={**parameters.own_weights, "lane": lane})
        assert (solution.status == Status.COMPLETED).all()
        torch.testing.assert_close(solution.controls, self.damped(energy, scene, without).controls, rtol=0, atol=1e-12)
        solution.controls.square().sum().backward()
        assert (leaves.own_weights["lane"].grad[~followed] == 0).all()
        assert (leaves.own_weights["lane"].grad[followed] != 0).all()

    def test_coincident_agents_stay_finite(self):
        scene = random_scene(2, 3, history=2, size=1.0)
        history = scene.history.clone()
        history[0, 1] = history[0, 0]
        parameters = random_game(scene)
        parameters.initial_controls[0, :, 1] = parameters.initial_controls[0, :, 0]
        leaves = leaves_of(parameters)
        solution = self.damped(FeatureEnergy(ALL, bounds=BOUNDS), dataclasses.replace(scene, history=history), leaves)
        assert (solution.status == Status.COMPLETED).all()
        solution.states.sum().backward()
        assert all(gradient.isfinite().all() for gradient in gradients(leaves).values())

    def test_two_time_steps_and_zero_solver_steps_are_solved(self):
        scene = random_scene(2, 2, history=2, dtype=torch.float64)
        energy = FeatureEnergy(ALL, bounds=BOUNDS)
        parameters = random_game(scene, horizon=2)
        expected = reference(energy, scene, parameters, 2, 0.3, torch.full((2, 2), 10.0, dtype=torch.float64))
        torch.testing.assert_close(self.damped(energy, scene, parameters).controls, expected[-1], rtol=0, atol=1e-9)
        leaves = leaves_of(parameters)
        still = self.damped(energy, scene, leaves, steps=0, keep_iterates=True)
        assert torch.equal(still.controls, parameters.initial_controls)
        assert torch.equal(still.energy, still.initial_energy)
        assert len(still.iterates) == 1
        still.controls.sum().backward()
        assert (leaves.initial_controls.grad == 1).all()

    def test_nan_samples_are_stopped_even_with_zero_steps(self):
        scene = random_scene(2, 2, history=2, size=0.01)
        parameters = random_game(scene)
        parameters.pair_weights["proximity"][1] = torch.nan
        solution = self.damped(FeatureEnergy(ALL, bounds=BOUNDS), scene, parameters, steps=0)
        assert solution.status.tolist() == [[0, 0], [Status.STOPPED] * 2]

    @pytest.mark.parametrize(("kind", "pair"), [("length", ()), ("width", ("circles",)), ("margin", ("clearance",))])
    def test_sizes_and_margins_that_are_no_numbers_stop_their_sample(self, kind, pair):
        own = ("acc", "turnr", "steer")
        scene = random_scene(3, 2, history=2)
        scene.history[:, 1, :, 0] += 100.0  # the agents do not meet
        parameters = random_game(scene, own=own, pair=pair)
        if kind == "margin":
            parameters.margins["clearance"][1] = torch.nan
        else:
            scene.size[1, 0, 0 if kind == "length" else 1] = torch.nan
        for steps in (0, 2):
            solution = self.damped(FeatureEnergy(own, pair), scene, parameters, steps)
            assert solution.status.tolist() == [[0, 0], [Status.STOPPED] * 2, [0, 0]], steps

    def test_stiff_rates_are_accurate_in_single_precision(self):
        scene, own = random_scene(8, 2, history=2, size=1.0), ("goal", "acc", "turnr", "jerk")
        parameters = random_game(scene, 1, 40, own=own, spread=0.2)
        parameters.own_weights["jerk"].fill_(30.0)
        single = self.damped(FeatureEnergy(own), scene, parameters, steps=1)
        exact = self.damped(FeatureEnergy(own), scene.to(torch.float64), parameters.to(torch.float64), steps=1)
        torch.testing.assert_close(single.controls.double(), exact.controls, rtol=0, atol=5e-5)
        assert (single.status == Status.COMPLETED).all()

    def test_small_steps_are_accurate_far_from_the_origin(self):
        scene, own = random_scene(4, 2, history=2, size=0.01), ("acc", "turnr")
        scene.history[..., :2] = 1e4
        scene.history[..., 3] = 0.3
        parameters = random_game(scene, horizon=40, own=own, spread=0.01)
        energy = FeatureEnergy(own)
        single = self.damped(energy, scene, parameters, steps=0)
        exact = self.damped(energy, scene.to(torch.float64), parameters.to(torch.float64), steps=0)
        # A unit in the last place of the coordinates themselves is 1 mm there.
        assert (single.states.double() - exact.states)[..., :2].abs().max() < 1.1e-3

    def test_inputs_are_not_modified(self):
        scene, energy = random_scene(3, 3, history=2, size=2.0), FeatureEnergy(ALL, bounds=BOUNDS)
        parameters = random_game(scene)
        before = parameters.map(torch.clone)
        leaves = leaves_of(parameters)
        cotangent = torch.ones_like(parameters.initial_controls)
        solution = self.damped(energy, scene, leaves)
        solution.controls.backward(cotangent)
        assert (cotangent == 1).all()
        assert torch.equal(leaves.initial_controls, before.initial_controls)
        assert all(torch.equal(leaves.own_weights[name], weight) for name, weight in before.own_weights.items())

    def test_broadcast_and_permuted_inputs_give_the_same_solution(self):
        """Decoders hand over views: weights that were unbound, goals that were expanded over modes."""
        scene, energy = random_scene(3, 3, history=2, size=2.0), FeatureEnergy(ALL, bounds=BOUNDS)
        parameters = random_game(scene)
        own = torch.stack(list(parameters.own_weights.values()), -1)
        views = dataclasses.replace(
            parameters,
            own_weights=dict(zip(parameters.own_weights, own.unbind(-1), strict=True)),
            goals=parameters.goals[:, :1].expand(-1, 2, -1, -1),
            initial_controls=parameters.initial_controls.transpose(2, 3).contiguous().transpose(2, 3),
        )
        plain = dataclasses.replace(parameters, goals=views.goals.contiguous())
        assert torch.equal(self.damped(energy, scene, views).controls, self.damped(energy, scene, plain).controls)
