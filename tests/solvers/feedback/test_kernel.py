"""The compiled iteration of LQ games and its derivative: against the same in PyTorch, on random games."""

from __future__ import annotations

import dataclasses
import platform
from types import ModuleType

import pytest
import torch
from games import leaves_of, random_game, random_scene

from epo_lightning.forecast import Status
from epo_lightning.game.dynamics import Unicycle
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.solvers.backward import Implicit
from epo_lightning.solvers.feedback import derivative, iteration, kernel
from epo_lightning.solvers.feedback.iteration import FeedbackGame
from epo_lightning.solvers.feedback.solver import Feedback
from epo_lightning.solvers.gauss_newton.kernel import interface

OWN = ("goal", "heading", "velref", "vel", "acc", "turnr", "velb", "accb", "turnrb")
BOUNDS = {"vel": [-0.05, 0.6], "acc": [-0.3, 0.3], "turnr": [-0.2, 0.2]}
HORIZON = 9
RHO = 5.0
ENERGIES = {
    "rpi": {"own": OWN, "pair": ("clearance",), "margins": {"clearance": 0.5}},
    "decoded margins": {"own": OWN, "pair": ("proximity", "clearance")},
    "lines": {"own": ("goal", "lane", "acc"), "pair": ("proximity",)},
    "lines that slide": {"own": ("lane", "acc"), "pair": ("proximity",), "lane_slides": True},
    "reference controls": {"own": ("accref", "turnrref"), "pair": ("proximity",)},
    "vehicles": {"own": ("goal", "acc"), "pair": ("circles", "headway", "longitudinal", "lateral", "time_to_conflict")},
    "every second step": {"own": OWN, "pair": ("proximity", "lateral"), "pair_stride": 2},
    "no pairs": {"own": OWN, "pair": ()},
    "pairs alone": {"own": (), "pair": ("proximity",)},
}


def random_feedback_game(
    name: str = "rpi", agents: int = 3, scenes: int = 5, modes: int = 2, ends: bool = True
) -> FeedbackGame:
    """Games near each other, with absent agents and, if ``ends``, early ends in some scenes."""
    torch.manual_seed(0)
    energy = FeatureEnergy(bounds=BOUNDS, **ENERGIES[name])
    scene = random_scene(scenes, agents, history=2, horizon=HORIZON, size=2.0, dtype=torch.double)
    mask = torch.ones(scenes, agents, dtype=torch.bool)
    mask[1, 0] = mask[2, -1] = False
    steps = torch.tensor([HORIZON, 6, 1, HORIZON, 4])[:scenes] if ends else None
    scene = dataclasses.replace(scene, agent_mask=mask, game_steps=steps)
    scene.history[1, 0] = torch.nan  # of an absent agent
    game = random_game(scene, modes, HORIZON, own=energy.own, pair=energy.pair)
    return FeedbackGame(energy, scene, game, RHO)


def controls_of(game: FeedbackGame) -> torch.Tensor:
    """Small controls, zero for absent agents."""
    return 0.1 * game.parameters.initial_controls * game.scene.agent_mask[:, None, :, None, None]


@pytest.mark.parametrize("ends", [True, False])
@pytest.mark.parametrize("agents", [1, 2, 4])
@pytest.mark.parametrize("name", ENERGIES)
def test_iterations_are_those_of_pytorch(name: str, agents: int, ends: bool) -> None:
    game = random_feedback_game(name, agents, ends=ends)
    for iterations in (1, 2, 6):
        controls, status = kernel.iterate(game, controls_of(game), iterations, 1e-3)
        wanted, wanted_status = iteration.iterate(game, controls_of(game), iterations, 1e-3)
        assert torch.equal(status, wanted_status)
        torch.testing.assert_close(controls, wanted, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("module", [kernel, iteration])
def test_steps_are_halved_until_no_state_moves_too_far(module: ModuleType) -> None:
    game = random_feedback_game(agents=2, ends=False)
    game.parameters.goals.mul_(1e3)
    start = controls_of(game)
    found, _ = module.iterate(game, start, 1, 1e-3)
    moved = game.one_by_one(2).change(*(game.states(controls).flatten(0, 1)[:, None] for controls in (start, found)))
    assert (moved > 0.75).all()
    assert (moved <= 1.5).all()  # the limit of GameInference.jl


def gradients(module: ModuleType, game: FeedbackGame) -> list[torch.Tensor]:
    """The derivative by all parameters at controls that need not be a solution, as if they were one."""
    leaves = leaves_of(game.parameters)
    controls = controls_of(game)
    cotangent = torch.randn(controls.shape[1:], generator=torch.Generator().manual_seed(1), dtype=torch.double)
    cotangent = cotangent.expand_as(controls).clone()
    cotangent[0, 0] = 0.0  # of a mode without a loss
    solved = torch.ones(controls.shape[:2], dtype=torch.bool)
    solved[-1, -1] = False
    module.attach(dataclasses.replace(game, parameters=leaves), controls, solved, 4).backward(cotangent)
    found = [leaf for leaf in leaves.tensors() if leaf.requires_grad]
    return [torch.zeros_like(leaf) if leaf.grad is None else leaf.grad for leaf in found]


@pytest.mark.parametrize("ends", [True, False])
@pytest.mark.parametrize("agents", [1, 2, 4])
@pytest.mark.parametrize("name", ENERGIES)
def test_derivatives_are_those_of_pytorch(name: str, agents: int, ends: bool) -> None:
    game = random_feedback_game(name, agents, ends=ends)
    found, wanted = gradients(kernel, game), gradients(derivative, game)
    assert any(gradient.any() for gradient in found) or (name, agents) == ("pairs alone", 1)
    for ours, theirs in zip(found, wanted, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-9 * float(theirs.abs().sum()))


@pytest.mark.parametrize("speed", [0.0, 1.0])
def test_vehicles_of_equal_velocity_are_those_of_pytorch(speed: float) -> None:
    """Their time of closest approach is at a kink of the feature."""
    game = random_feedback_game("vehicles", agents=2, ends=False)
    game.scene.history[:] = torch.tensor([0.0, 0.0, 0.0, speed], dtype=torch.double)
    game.scene.history[:, 1, :, 1] = 1.2
    game.scene.agent_mask[:] = True
    still = torch.zeros_like(game.parameters.initial_controls)
    game = dataclasses.replace(game, parameters=dataclasses.replace(game.parameters, initial_controls=still))
    controls, _ = kernel.iterate(game, still, 1, 1e-3)
    torch.testing.assert_close(controls, iteration.iterate(game, still, 1, 1e-3)[0], rtol=1e-7, atol=1e-7)
    for ours, theirs in zip(gradients(kernel, game), gradients(derivative, game), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-7, atol=1e-9 * float(theirs.abs().sum()))


@pytest.mark.parametrize("name", ENERGIES)
def test_results_do_not_depend_on_threads_and_neighbours(name: str) -> None:
    game = random_feedback_game(name)
    many = game.one_by_one(2)[torch.arange(10).repeat(7)]
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        found, status = kernel.iterate(many, controls_of(many), 6, 1e-3)
    finally:
        torch.set_num_threads(before)
    slopes = gradients(kernel, many)
    for row in range(10):
        alone = many[torch.tensor([row])]
        wanted, wanted_status = kernel.iterate(alone, controls_of(alone), 6, 1e-3)
        for copy in range(row, 70, 10):
            assert torch.equal(found[copy], wanted[0])
            assert torch.equal(status[copy], wanted_status[0])
            if 10 <= copy < 69:  # the first and the last game have a derivative of zero
                assert all(torch.equal(slope[copy], slope[row + 10]) for slope in slopes)


def test_all_levels_of_instructions_agree() -> None:
    game = random_feedback_game()
    library, results = interface.library(), []
    levels = library.epo_levels()
    if library.epo_built() == 1 and platform.machine() == "x86_64":
        pytest.skip("the kernel was built for this machine only; build.py --portable builds all levels")
    try:
        for level in range(levels):
            library.epo_choose(level)
            controls, _ = kernel.iterate(game, controls_of(game), 4, 1e-3)
            results.append((controls, torch.cat([found.flatten() for found in gradients(kernel, game)])))
    finally:
        library.epo_choose(levels - 1)
    for controls, gradient in results:
        torch.testing.assert_close(controls, results[0][0], rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(gradient, results[0][1], rtol=1e-7, atol=1e-7)


def test_scenes_without_agents_are_solved() -> None:
    game = random_feedback_game(scenes=3)
    game.scene.agent_mask[0] = False
    controls, status = kernel.iterate(game, controls_of(game), 3, 1e-12)
    assert (status[0] == Status.COMPLETED).all()
    assert not controls[0].any()
    assert (status[1:] != Status.COMPLETED).any()


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
@pytest.mark.parametrize("spoiled", ["own weight", "pair weight", "margin", "goal", "size", "history", "line"])
def test_a_game_that_is_not_finite_stops_alone(spoiled: str, value: float) -> None:
    """Also a pair that is too far apart to touch, and a point of a line that is never the nearest."""
    game = random_feedback_game("lines" if spoiled == "line" else "decoded margins", agents=2)
    game.scene.history[3, 1, :, :2] += 1000.0
    wanted, wanted_status = kernel.iterate(game, controls_of(game), 4, 1e-3)
    slopes = gradients(kernel, game)
    parameters = game.parameters
    assert parameters.goals is not None
    assert game.scene.size is not None
    assert game.scene.references is not None
    tensor, entry = {
        "own weight": (next(iter(parameters.own_weights.values())), (3, 1, 0)),
        "pair weight": (parameters.pair_weights["proximity"], (3, 1, 0)),
        "margin": (parameters.margins.get("clearance"), (3, 1, 0)),
        "goal": (parameters.goals, (3, 1, 0, 0)),
        "size": (game.scene.size, (3, 1, 0)),
        "history": (game.scene.history, (3, 0, -1, 0)),
        "line": (game.scene.references, (3, 1, slice(None), -1, 0)),
    }[spoiled]
    assert tensor is not None
    tensor[entry] = value
    bad = torch.zeros(5, 2, dtype=torch.bool)
    bad[3, 0 if spoiled in ("size", "history", "line") else 1 :] = True
    controls, status = kernel.iterate(game, controls_of(game), 4, 1e-3)
    assert (status[bad] == Status.STOPPED).all()
    assert torch.equal(controls[bad], controls_of(game)[bad])
    assert torch.equal(status[~bad], wanted_status[~bad])
    assert torch.equal(controls[~bad], wanted[~bad])
    for now, before in zip(gradients(kernel, game), slopes, strict=True):
        assert torch.equal(now[~bad], before[~bad])


def test_wrong_types_and_shapes_are_refused() -> None:
    game = random_feedback_game()
    with pytest.raises(ValueError, match=r"double precision on the CPU, not torch\.float32"):
        kernel.iterate(game, controls_of(game).float(), 1, 1e-3)
    with pytest.raises(
        ValueError, match=r"parameters of the shape \[5, 2, 3\] for controls of the shape \[5, 3, 3, 9, 2\]"
    ):
        kernel.attach(game, controls_of(game).repeat(1, 2, 1, 1, 1)[:, :3], torch.ones(5, 3, dtype=torch.bool), 1)


def test_changed_parameters_are_noticed_before_the_backward_pass() -> None:
    game = random_feedback_game()
    leaves = leaves_of(game.parameters)
    weights = {name: weight * 1.0 for name, weight in leaves.own_weights.items()}
    moved = dataclasses.replace(game, parameters=dataclasses.replace(leaves, own_weights=weights))
    controls = kernel.attach(moved, controls_of(game), torch.ones(5, 2, dtype=torch.bool), 2)
    weights["vel"].mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        controls.sum().backward()


@pytest.mark.filterwarnings("ignore:the compiled layer integrates by euler")
@pytest.mark.parametrize("reason", ["backend", "integrator"])
def test_other_games_are_iterated_in_pytorch(reason: str, monkeypatch: pytest.MonkeyPatch) -> None:
    game, solver = random_feedback_game(), Feedback(iterations=2)
    energy = game.energy
    if reason == "backend":
        solver = dataclasses.replace(solver, backend="pytorch")
    else:
        energy = dataclasses.replace(energy, dynamics=Unicycle("heun"))
    used: list[ModuleType] = []
    for module, name in ((kernel, "iterate"), (iteration, "iterate"), (kernel, "attach"), (derivative, "attach")):

        def watched(*arguments: object, module: ModuleType = module, true: object = getattr(module, name)) -> object:
            used.append(module)
            return true(*arguments)

        monkeypatch.setattr(module, name, watched)
    leaves = leaves_of(game.parameters)
    Implicit()(solver, game.energy, game.scene, leaves)
    assert used == ([iteration, derivative] if reason == "backend" else [kernel, kernel])
    used.clear()
    Implicit()(solver, energy, game.scene, leaves)
    assert used == [iteration, derivative]
