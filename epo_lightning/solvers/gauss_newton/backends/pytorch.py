"""Damped Gauss-Newton steps in PyTorch, on any device: the quadratic model of all problems, factorised in blocks.

One step solves (J^T J + lambda I) d = -J^T r and moves u to u + alpha d. Read this module in this order: :func:`solve` takes
the steps, :class:`_Step` is one step with its adjoint, :func:`factorise` prepares the solution for d. The matrix is
factorised in other unknowns than u, the *nodes*: speed and heading after every step (:mod:`.iterate`). In shapes, a
problem is the game of one scene in one mode, E pairs are evaluated, and C components have one size.

*Splitting.* Two agents are coupled if a pair feature of theirs is not zero; agents that no such pairs connect are
independent. On a CPU every problem is split into the connected components of its coupled pairs, and components of the same
size are factorised together. The solution of an agent then depends on its component alone, to the last bit, and a scene
with few coupled pairs takes little more time than its agents alone. On a GPU, finding the components would make the host
wait; there every problem is one matrix, and no operation synchronises.

*Differentiation.* Autograd does not record the factorisation. For a cotangent v of u + alpha d, one more solve with the same
factor gives mu = (J^T J + lambda I)^-1 alpha v. With the scalar

    phi(u, p) = -<J mu, r + J d>     with mu and d held constant,

the gradient with respect to the parameters p is dphi/dp, and that with respect to the controls u is v + dphi/du. Both are
computed in closed form (:mod:`~epo_lightning.solvers.gauss_newton.pullback`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from epo_lightning.forecast import GameParameters, Solution, Status
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.host import readable
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton import blocks
from epo_lightning.solvers.gauss_newton.edges import Group
from epo_lightning.solvers.gauss_newton.expansion import expand
from epo_lightning.solvers.gauss_newton.pullback import pullback
from epo_lightning.solvers.gauss_newton.quadratic_model import QuadraticModel

LEAST_DAMPING, MOST_DAMPING = 1e-7, 1e7
"""Range of the adaptive damping."""
RETRIES = 4
"""Number of times that a failed Cholesky factorisation is repeated with more damping."""
LEAST_RAISED_DAMPING = 1e-3
"""The k-th repetition adds 10^k max(damping, this number) to the damping."""
_HOLDING = 1e30
"""Finite stand-in for infinite damping in the matrices, which avoids inf - inf."""


def solve(
    energy: FeatureEnergy,
    scene: Scene,
    parameters: GameParameters,
    steps: int,
    step_size: float,
    damping: Float[Tensor, "B M *agents"],
    keep_iterates: bool = False,
    exact: bool = False,
    split: bool | None = None,
) -> Solution:
    """Take ``steps`` steps from ``parameters.initial_controls``.

    The controls and states of the solution are differentiable with respect to weights, margins, goals, their headings,
    reference controls and initial controls, by unrolling.

    Args:
        energy, scene, parameters: the game, already validated.
        steps: number of optimisation steps.
        step_size: alpha.
        damping: lambda of every problem, or of every agent; infinite damping keeps the agent's controls exactly.
        keep_iterates: whether the solution carries all iterates, from the initial to the last.
        exact: whether the steps use the Hessian (Newton steps); they have no derivative.
        split: whether problems are split into components; by default, on a CPU.
    """
    controls = torch.where(scene.agent_mask[:, None, :, None, None], parameters.initial_controls, 0.0)
    split = readable(controls) if split is None else split
    game = Game(energy, scene, parameters, step_size, damping.detach().to(controls.dtype).flatten(0, 1), split, exact)
    tensors = game.tensors()
    status = torch.where(game.finite_inputs, Status.COMPLETED, Status.STOPPED)
    iterates = [controls]
    initial_energy = None
    for _ in range(steps):
        controls, outcome, value = _Step.apply(game, controls, *tensors)
        initial_energy = value if initial_energy is None else initial_energy
        status = torch.maximum(status, outcome)
        iterates.append(controls)
    with torch.no_grad():
        last = expand(energy, scene, parameters, controls, every_pair=not split)
        # `cumsum` adds agent by agent, and absent ones add an exact zero; `sum` may round differently with the padding.
        gradient_norm = last.gradient.square().flatten(2).sum(-1).cumsum(1)[:, -1].sqrt().view_as(status)
        final_energy = last.value.view_as(status)
    return Solution(
        controls=controls,
        states=energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
        if controls.requires_grad
        else last.at.states,
        initial_energy=final_energy if initial_energy is None else initial_energy,
        energy=final_energy,
        gradient_norm=gradient_norm,
        status=status,
        iterates=tuple(iterates) if keep_iterates else None,
    )


@dataclasses.dataclass(frozen=True)
class Game:
    """A game, the step size and the damping: everything that stays the same from step to step."""

    energy: FeatureEnergy
    scene: Scene
    parameters: GameParameters
    step_size: float
    damping: Float[Tensor, " problems *agents"]
    split: bool
    exact: bool = False

    @cached_property
    def finite_inputs(self) -> Bool[Tensor, "B M"]:
        """Mask of the games with finite inputs (:meth:`~epo_lightning.game.feature_energy.FeatureEnergy.finite_inputs`)."""
        return self.energy.finite_inputs(self.scene, self.parameters)

    def tensors(self) -> list[Tensor]:
        """The tensors of a game that have a gradient: weights, margins and targets."""
        parameters = self.parameters
        tensors = [parameters.own_weights[name] for name in self.energy.own]
        tensors += [parameters.pair_weights[name] for name in self.energy.pair]
        tensors += [parameters.margins[name] for name in self.energy.decoded_margins]
        return tensors + [getattr(parameters, name) for name in self.energy.targets]

    def with_tensors(self, tensors: Sequence[Tensor]) -> GameParameters:
        """The game's parameters with these tensors."""
        given = iter(tensors)
        return dataclasses.replace(
            self.parameters,
            own_weights={name: next(given) for name in self.energy.own},
            pair_weights={name: next(given) for name in self.energy.pair},
            margins={name: next(given) for name in self.energy.decoded_margins},
            **{name: next(given) for name in self.energy.targets},
        )

    def gradient_of_phi(
        self, model: QuadraticModel, tensors: Sequence[Tensor], adjoint: Tensor, step: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """The gradient of phi by the controls and by :meth:`tensors`, with the parts of declared and undeclared features."""
        shape = model.at.controls.shape
        found = pullback(model, adjoint, step)
        by_controls = found.controls.transpose(-1, -2).reshape(shape)
        gradients = [found.own.get(name) for name in self.energy.own]
        gradients += [found.pair.get(name) for name in self.energy.pair]
        gradients += [found.margins.get(name) for name in self.energy.decoded_margins]
        gradients += [getattr(found, name) for name in self.energy.targets]
        by = [
            torch.zeros_like(tensor) if gradient is None else gradient.reshape(tensor.shape)
            for tensor, gradient in zip(tensors, gradients, strict=True)
        ]
        if self.energy.undeclared is not None:
            directions = torch.stack([change.transpose(-1, -2).reshape(shape) for change in (adjoint, step)])
            extra, rest = pullback_undeclared(
                self.energy.undeclared, self.scene, self.with_tensors, model.at.controls, tensors, directions
            )
            by_controls = by_controls + extra
            by = [one + other for one, other in zip(by, rest, strict=True)]
        return by_controls, by


class _Step(torch.autograd.Function):
    """u -> u + alpha d with its adjoint; see the module's docstring."""

    @staticmethod
    def forward(ctx: Any, game: Game, controls: Tensor, *tensors: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        parameters = game.with_tensors(tensors)
        model = expand(game.energy, game.scene, parameters, controls, not game.split, game.exact)
        factorised = factorise(model, game.damping, game.split)
        step = factorised.solve(-model.gradient).transpose(-1, -2).reshape(controls.shape)
        status = factorised.status.view(controls.shape[:2])
        moved = controls + game.step_size * step
        solved = game.finite_inputs & (status != Status.STOPPED) & moved.flatten(2).isfinite().all(-1)
        accepted = solved[..., None, None, None]
        status = torch.where(solved, status, Status.STOPPED)
        value = model.value.view(controls.shape[:2])
        if any(ctx.needs_input_grad):
            ctx.game, ctx.factorised = game, factorised
            # The scene is saved so that autograd raises an error if it was changed in place before the backward pass.
            ctx.save_for_backward(torch.where(accepted, step, 0.0), solved, *tensors, *game.scene.tensors())
        ctx.mark_non_differentiable(status, value)
        return torch.where(accepted, moved, controls), status, value

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cotangent: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        game, factorised = ctx.game, ctx.factorised
        model = factorised.model
        step, solved, *tensors = ctx.saved_tensors
        tensors = tensors[: len(game.tensors())]
        shape = cotangent.shape
        adjoint = factorised.solve(game.step_size * planar(cotangent))
        adjoint = torch.where(solved.flatten()[:, None, None, None], adjoint, 0.0)
        by_controls, by = game.gradient_of_phi(model, tensors, adjoint, planar(step))
        by_controls = torch.where(solved[..., None, None, None], by_controls, 0.0)
        by = [torch.where(solved.view(*shape[:2], *[1] * (g.dim() - 2)), g, 0.0) for g in by]
        return None, cotangent + by_controls, *by


@dataclasses.dataclass(frozen=True)
class Factorisation:
    """The factorised matrices J^T J + lambda I of all problems.

    Attributes:
        model: the quadratic model.
        groups: components of equal size, each group factorised in one batch.
        factors: the factors of each group.
        status: a :class:`Status` per problem.
        held: mask of the agents with infinite damping; None where damping is given per problem.
    """

    model: QuadraticModel
    groups: list[Group]
    factors: list[blocks.Factors]
    status: Int[Tensor, " problems"]
    held: Bool[Tensor, "problems N"] | None = None

    def solve(self, right: Float[Tensor, "problems N 2 K"]) -> Float[Tensor, "problems N 2 K"]:
        """(J^T J + lambda I)^-1 times a covector of the controls; zero for controls after the end of a game."""
        active = self.model.at.within_game
        if active is not None:
            right = right.where(active, 0.0)
        covector = self.model.at.to_nodes(right.to(torch.float64))
        parts = [f.solve(_gather(group, covector)) for f, group in zip(self.factors, self.groups, strict=True)]
        solved = self.model.at.to_controls(_scatter(self.groups, parts, covector)).to(right.dtype)
        if active is not None:
            solved = solved.where(active, 0.0)
        return solved if self.held is None else torch.where(self.held[..., None, None], 0.0, solved)


def factorise(
    model: QuadraticModel, damping: Float[Tensor, " problems *agents"], split: bool, retry: bool | None = None
) -> Factorisation:
    """Factorise the matrices of all problems; if problems are split, the matrix of each component separately.

    With ``retry``, the factorisation of a matrix that is not positive definite is repeated with more and more damping
    (:data:`RETRIES`); the other matrices are not affected. If no attempt succeeds, the status is STOPPED, and the results of
    :meth:`Factorisation.solve` for this matrix have no meaning.

    Args:
        model: the quadratic model of the energy.
        damping: lambda of every problem, or of every agent.
        split: whether problems are split into components.
        retry: whether to try again with more damping; by default, if problems are split.
    """
    held = damping.isinf() if damping.dim() == 2 else None
    if held is not None:
        damping = damping.clamp_max(_HOLDING)
    groups = _components(model, held) if split else [Group.whole(model.edges)]
    factors = []
    status = torch.zeros(model.at.problems, dtype=torch.long, device=damping.device)
    for group in groups:
        found, failed = blocks.factorise(model, damping, group)
        outcome = torch.where(failed, Status.STOPPED, Status.COMPLETED)
        if (split if retry is None else retry) and failed.any():
            _retry(model, damping, group, found, outcome)
        factors.append(found)
        if group.agents is None:
            status = outcome
        else:  # a problem has the worst status of its components
            status = status.scatter_reduce(0, group.agents[:, 0] // model.at.agents, outcome, "amax")
    return Factorisation(model, groups, factors, status, held)


def _retry(
    model: QuadraticModel,
    damping: Float[Tensor, " problems *agents"],
    group: Group,
    factors: blocks.Factors,
    outcome: Int[Tensor, " C"],
) -> None:
    """Factorise matrices without a factor again with increasing damping; writes ``factors`` and ``outcome`` in place."""
    raised = damping.clamp_min(LEAST_RAISED_DAMPING)
    for _ in range(RETRIES):
        raised = 10.0 * raised
        where = (outcome == Status.STOPPED).nonzero()[:, 0]
        if len(where) == 0:
            return
        again, failed = blocks.factorise(model, damping + raised, group.subset(where))
        factors.put(where, again, ~failed)
        outcome[where[~failed]] = Status.DAMPED


def _components(model: QuadraticModel, held: Bool[Tensor, "problems N"] | None = None) -> list[Group]:
    """The connected components of coupled pairs in every problem; absent and held agents are in no group."""
    edges = model.edges
    problems, agents = edges.problems, edges.agents
    moving = model.at.present.flatten()
    links = model.linked
    if held is not None:  # a pair with a held agent affects only the other agent, so it connects no agents
        moving = moving & ~held.flatten()
        links = links & moving[edges.first] & moving[edges.second]
    linked = bool(links.all())
    if edges.every and linked and bool(moving.all()) and agents > 0:
        return [Group.whole(edges)]
    chosen = None if linked else links.nonzero()[:, 0]
    first, second = edges.first, edges.second
    if chosen is not None:
        first, second = first[chosen], second[chosen]
    # Label propagation: every agent takes the lowest label among the agents it is connected with.
    label = torch.arange(problems * agents)
    while True:
        lowest = torch.minimum(label[first], label[second])
        lower = label.scatter_reduce(0, first, lowest, "amin").scatter_reduce(0, second, lowest, "amin")
        lower = lower[lower]
        if torch.equal(lower, label):
            break
        label = lower
    size_of = torch.bincount(label, minlength=len(label))[label] * moving
    order = label.argsort(stable=True)
    sizes = size_of[order]
    groups = []
    component, place = torch.empty_like(label), torch.empty_like(label)
    for size in sizes.unique().tolist():
        if size == 0:
            continue
        members = order[sizes == size].view(-1, size)
        count = len(members)
        component[members] = torch.arange(count)[:, None]
        place[members] = torch.arange(size)
        within = (size_of[first] == size).nonzero()[:, 0]
        one, other = first[within], second[within]
        whole = size == agents and count == problems
        groups.append(
            Group(
                None if whole else members,
                count,
                size,
                within if chosen is None else chosen[within],
                component[one],
                place[one],
                place[other],
            )
        )
    return groups


def planar(controls: Float[Tensor, "B M N K 2"]) -> Float[Tensor, "problems N 2 K"]:
    """Controls in the layout of the quadratic model."""
    return controls.flatten(0, 1).transpose(-1, -2).contiguous()


def _gather(group: Group, values: Float[Tensor, "problems N 2 K"]) -> Float[Tensor, "C n"]:
    """Vectors of problems in the order of a group's unknowns."""
    by_agent = values if group.agents is None else values.flatten(0, 1)[group.agents]
    return by_agent.permute(0, 3, 2, 1).reshape(group.count, -1)


def _scatter(groups: Sequence[Group], parts: Sequence[Tensor], like: Float[Tensor, "problems N 2 K"]) -> Tensor:
    """Vectors [C, n] of groups in the layout of problems, zero for agents that are in no group."""
    steps = like.shape[-1]
    rows = torch.zeros_like(like).flatten(0, 1)
    for group, part in zip(groups, parts, strict=True):
        by_agent = part.view(group.count, steps, 2, group.size).permute(0, 3, 2, 1)
        if group.agents is None:
            return by_agent.reshape(like.shape)
        rows[group.agents] = by_agent
    return rows.view_as(like)


def pullback_undeclared(
    energy: FeatureEnergy,
    scene: Scene,
    with_tensors: Callable[[Sequence[Tensor]], GameParameters],
    controls: Float[Tensor, "B M N K 2"],
    tensors: Sequence[Tensor],
    directions: Float[Tensor, "2 B M N K 2"],
) -> tuple[Float[Tensor, "B M N K 2"], list[Tensor]]:
    """The gradient of phi by the controls and by some tensors, by automatic differentiation.

    Args:
        energy: the features that count, such as the undeclared ones of a game.
        scene: the scene.
        with_tensors: function from tensors to the game's parameters with these tensors.
        controls: the iterate.
        tensors: the tensors by which the gradient is wanted.
        directions: the adjoint mu and the step d.
    """
    with torch.enable_grad():
        controls = controls.detach().requires_grad_()
        leaves = [tensor.detach().requires_grad_() for tensor in tensors]
        residuals, (along_adjoint, along_step) = energy.linearisation(scene, with_tensors(leaves), controls, directions)
        phi = -(along_adjoint * (residuals + along_step)).sum()
        by_controls, *by = torch.autograd.grad(phi, [controls, *leaves], allow_unused=True, materialize_grads=True)
    return by_controls, list(by)
