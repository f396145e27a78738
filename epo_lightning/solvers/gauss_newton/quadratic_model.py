"""The quadratic model of an energy around joint strategies, and how that model changes with everything it is made of.

Unknowns are not the controls u but the speeds and headings z_l = z_0 + dt sum_{j<l} u_j at the nodes l = 1 .. K, because in
them the model is nearly local. With e_l the heading's unit vector and e'_l the one to its left, a position changes as

    dp_k = dt sum_{l<k} M_l dz_l,   M_l = [e_l, v_l e'_l]     (explicit Euler; other integrators weigh l = k as well),

so what positions contribute to the matrix at (l, l') with l >= l' is M_l^T [dt^2 sum_{k>l} Q_k] M_l', Q_k the curvature in
p_k: one thin matrix product gives the whole lower triangle. Everything else is a band: controls are first differences of z,
their rates second ones, speeds stand on the diagonal, and steering angles couple a turn rate with the speed before it. What
a model holds are these curvatures; a solver puts them together.

Arrays are laid out [S, N, component, K] with S = B M samples; components of z and u are speed and heading, acceleration and
turn rate. Pairs are a list of E edges between agents, numbered s N + i through all samples.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from epo_lightning.game.circles import overlap
from epo_lightning.game.feature_energy import FeatureEnergy, along
from epo_lightning.game.features import (
    OwnFeature,
    PairFeature,
    Source,
    foot,
    slope,
    steering,
    steering_curvatures,
)
from epo_lightning.game.pairs import pair_mask
from epo_lightning.scene import HEADING, SPEED, TURN_RATE, GameParameters, Scene
from epo_lightning.solvers.gauss_newton.edges import Edges

Shape = tuple[Tensor, Tensor | None, Tensor | None]
"""Value, slope and curvature of an elementwise function; None for a slope of one or a curvature of zero."""


def _bend(function: Callable[..., Tensor], value: Tensor, *others: Tensor) -> Shape:
    """Value, slope and curvature of an elementwise function."""

    def steepness(argument: Tensor, *rest: Tensor) -> Tensor:
        return slope(function, argument, *rest)[1]

    return function(value, *others), *slope(steepness, value, *others)


def _outer(vector: Tensor, dim: int) -> Tensor:
    """The entries xx, xy and yy of v v^T."""
    x, y = vector.unbind(dim)
    return torch.stack((x * x, x * y, y * y), dim)


def _suffix(values: Float[Tensor, "*rest K"]) -> Float[Tensor, "*rest K"]:
    """Sums over this entry of the last dimension and all after it."""
    return values.flip(-1).cumsum(-1).flip(-1)


def _ahead(values: Float[Tensor, "*rest K"]) -> Float[Tensor, "*rest K"]:
    """The next entry of the last dimension, zero after the last one."""
    return torch.nn.functional.pad(values[..., 1:], (0, 1))


@dataclass(frozen=True)
class _Read:
    """A declared own feature at the iterate: which signal it reads, and its shape there."""

    name: str
    feature: OwnFeature
    weight: Float[Tensor, "S N 1"]
    shape: Shape


class QuadraticModel:
    """The energy around joint strategies u: its value, gradient and Gauss-Newton (or exact) matrix, in the unknowns z.

    Attributes:
        value: E(u), by sample.
        edges: the pairs that were looked at.
        linked: which of them couple their agents at all.
    """

    @torch.no_grad()
    def __init__(
        self,
        energy: FeatureEnergy,
        scene: Scene,
        parameters: GameParameters,
        controls: Float[Tensor, "B M N K 2"],
        every_pair: bool,
        exact: bool = False,
    ) -> None:
        batch, modes, agents, steps, _ = controls.shape
        self.of, self.scene, self.parameters, self.dt = energy, scene, parameters, scene.dt
        self.samples, self.agents, self.steps = batch * modes, agents, steps
        self.beta, self.exact = energy.dynamics.beta, exact
        self.around = energy.surroundings(scene, parameters)
        self.controls = controls
        self.states = energy.dynamics.rollout(self.around.initial, controls, scene.dt)
        self.u = controls.flatten(0, 1).transpose(-1, -2).contiguous()
        self.x = self.states.flatten(0, 1).transpose(-1, -2).contiguous()
        heading, speed = self.x[:, :, HEADING], self.x[:, :, SPEED]
        self.unit = torch.stack((heading.cos(), heading.sin()), 2)
        self.left = torch.stack((-self.unit[:, :, 1], self.unit[:, :, 0]), 2)
        # How velocities change with speed and heading, M_l = [e, v e']: [S, N, component, xy, K].
        self.moves = torch.stack((self.unit, speed[:, :, None] * self.left), 2)

        rows = self.samples, agents
        self.control_force = controls.new_zeros(*rows, 2, steps)
        self.control_stiffness = controls.new_zeros(*rows, 2, steps)
        self.rate_stiffness: Tensor | None = None  # [S, N, 2, K], zero at K - 1
        self.node_force = controls.new_zeros(*rows, 2, steps)
        self.node_stiffness = controls.new_zeros(*rows, 2, steps)
        self.cross: Tensor | None = None  # [S, N, 2, K]: a node's speed with the heading there and at the next node
        self.pull = controls.new_zeros(*rows, 5, steps)  # at positions: forces x, y and curvatures xx, xy, yy
        self.blocks: Tensor | None = None  # [S, N, 2 K, 2 K] of undeclared own features
        self.agent_value = controls.new_zeros(rows)
        self.reads = [self._read(name, feature) for name, feature in energy.own_features.items()]
        self._read_pairs(every_pair)
        if exact:
            self._bend_undeclared()
        force = self._after(self.pull[:, :, :2])
        if exact:
            # A force on later positions bends with the heading: e'' = -e.
            self.node_stiffness[:, :, 1] -= speed * (self.unit * force).sum(2)
            self._crossed()[:, :, 0] += (self.left * force).sum(2)
        self.node_force += (self.moves * force[:, :, None]).sum(3)
        self.value = self.agent_value.cumsum(1)[:, -1]  # one after the other: absent agents add an exact zero

    @property
    def present(self) -> Bool[Tensor, "S N"]:
        """Which agents exist."""
        mask = self.scene.agent_mask
        return mask[:, None].expand(-1, self.samples // len(mask), -1).reshape(self.samples, self.agents)

    # --- gradient -----------------------------------------------------------------------------------------------------

    @property
    def gradient(self) -> Float[Tensor, "S N 2 K"]:
        """dE/du."""
        return self.control_force + self.dt * _suffix(self.node_force)

    def to_nodes(self, covector: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """What a gradient in the controls is in the nodes: u_l = (z_{l+1} - z_l) / dt."""
        return (covector - _ahead(covector)) / self.dt

    def to_controls(self, change: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """The controls that change the nodes like this."""
        return torch.diff(change, dim=-1, prepend=torch.zeros_like(change[..., :1])) / self.dt

    def _after(self, values: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """dt times the sum over the positions that a node's velocity leads to."""
        sums = _suffix(values)
        if self.beta == 1.0:
            return self.dt * _ahead(sums)
        return self.dt * (self.beta * _ahead(sums) + (1.0 - self.beta) * sums)

    def _travel(self, velocity: Float[Tensor, "*rows K"]) -> Float[Tensor, "*rows K"]:
        """How positions change with the velocities at the nodes."""
        sums = velocity.cumsum(-1)
        before = torch.nn.functional.pad(sums[..., :-1], (1, 0))
        return self.dt * (before if self.beta == 1.0 else self.beta * before + (1.0 - self.beta) * sums)

    # --- what every feature contributes -------------------------------------------------------------------------------

    def _by_sample(self, values: Tensor | None) -> Float[Tensor, "S N 1"]:
        """Values [B, 1 or M, N] of agents, by sample."""
        assert values is not None
        batch = values.shape[0]
        return values.expand(batch, self.samples // batch, self.agents).reshape(self.samples, self.agents, 1)

    def _crossed(self) -> Tensor:
        if self.cross is None:
            self.cross = torch.zeros_like(self.node_stiffness)
        return self.cross

    def _count(self, force: Tensor, value: Tensor) -> None:
        self.agent_value += 0.5 * (force * value).flatten(2).sum(-1)

    def _read(self, name: str, feature: OwnFeature) -> _Read:
        weight = self._by_sample(self.of.own_weight(self.scene, self.parameters, name))
        square = weight.square()
        match feature.source:
            case Source.STEERING:
                shape = self._read_steering(square)
            case Source.POSITION:
                shape = self._read_lane(square)
            case Source.FINAL_POSITION:
                assert self.around.goals is not None
                offset = self.x[:, :, :2, -1] - self.around.goals.flatten(0, 1)
                force = square * offset
                self.pull[:, :, :2, -1] += force
                self.pull[:, :, 2::2, -1] += square
                self._count(force, offset)
                shape = offset, None, None
            case Source.TRAJECTORY:
                self._read_undeclared(feature, weight)
                shape = weight, None, None
            case _:
                shape = self._read_signal(feature, square)
        return _Read(name, feature, weight, shape)

    def _read_signal(self, feature: OwnFeature, square: Tensor) -> Shape:
        if feature.source is Source.CONTROL:
            signal = self.u[:, :, feature.channel]
        elif feature.source is Source.RATE:
            signal = self.u[:, :, feature.channel].diff(dim=-1) / self.dt
        else:
            signal = self.x[:, :, SPEED]
            if feature.needs:
                signal = signal - self._by_sample(self.around.reference_speed)
        if feature.bounded:
            shape: Shape = *self.of.shape(feature, signal), None
        else:
            shape = (signal, None, None) if feature.function is None else _bend(feature.function, signal)
        value, steepness, bend = shape
        force = square * value
        self._count(force, value)
        stiffness = square if steepness is None else square * steepness.square()
        if self.exact and bend is not None:
            stiffness = stiffness + force * bend
        if steepness is not None:
            force = force * steepness
        match feature.source:
            case Source.CONTROL:
                self.control_force[:, :, feature.channel] += force
                self.control_stiffness[:, :, feature.channel] += stiffness
            case Source.RATE:
                if self.rate_stiffness is None:
                    self.rate_stiffness = torch.zeros_like(self.control_stiffness)
                force = force / self.dt
                self.control_force[:, :, feature.channel, 1:] += force
                self.control_force[:, :, feature.channel, :-1] -= force
                self.rate_stiffness[:, :, feature.channel, :-1] += stiffness
            case _:
                self.node_force[:, :, 0] += force
                self.node_stiffness[:, :, 0] += stiffness
        return shape

    def _steered(self) -> tuple[Tensor, Tensor, Tensor]:
        """Turn rate, the speed before it, and the wheelbase."""
        start = self._by_sample(self.around.initial[..., SPEED])
        before = torch.cat((start, self.x[:, :, SPEED, :-1]), -1)
        return self.u[:, :, TURN_RATE], before, self._by_sample(self.around.wheelbase)

    def _read_steering(self, square: Tensor) -> Shape:
        angle, by_turn_rate, by_speed = steering(*self._steered())
        force = square * angle
        self._count(force, angle)
        stiffness = square * by_turn_rate.square(), square * by_turn_rate * by_speed, square * by_speed.square()
        if self.exact:
            bends = steering_curvatures(*self._steered())
            stiffness = tuple(part + force * bend for part, bend in zip(stiffness, bends, strict=True))  # type: ignore[assignment]
        self.control_force[:, :, TURN_RATE] += force * by_turn_rate
        self.control_stiffness[:, :, TURN_RATE] += stiffness[0]
        # The initial speed is no unknown; that of node l acts together with the turn rate between nodes l and l + 1.
        self.node_force[:, :, 0, :-1] += (force * by_speed)[..., 1:]
        self.node_stiffness[:, :, 0, :-1] += stiffness[2][..., 1:]
        cross = stiffness[1][..., 1:] / self.dt
        self._crossed()[:, :, 0, :-1] -= cross
        self._crossed()[:, :, 1, :-1] += cross
        return angle, by_turn_rate, by_speed

    def _read_lane(self, square: Tensor) -> Shape:
        assert self.around.line is not None
        position = self.states[..., :2]
        nearest, tangent = foot(position, self.around.line)
        offset, tangent = (rows.flatten(0, 1).transpose(-1, -2).contiguous() for rows in (position - nearest, tangent))
        square = square[..., None]
        force = square * offset
        self.pull[:, :, :2] += force
        self.pull[:, :, 2::2] += square
        if self.exact:
            self.pull[:, :, 2:] -= square * _outer(tangent, 2)
        self._count(force, offset)
        return offset, tangent, None

    def _read_undeclared(self, feature: OwnFeature, weight: Tensor) -> None:
        assert feature.function is not None
        turned = self._node_directions()
        moved = self.of.dynamics.tangent(self.states, turned, self.dt)
        value, change = along(feature.function, (self.states, self.controls), (moved, turned))
        present = self.scene.agent_mask[:, None, :, None]
        value = weight * torch.where(present, value, 0.0).flatten(0, 1)
        change = weight * torch.where(present, change, 0.0).flatten(1, 2)  # [2 K, S, N, R]
        self._count(value, value)
        jacobian = change.permute(1, 2, 0, 3)
        self.node_force += (jacobian @ value[..., None]).view_as(self.node_force)
        if not self.exact:
            block = jacobian @ jacobian.mT
            self.blocks = block if self.blocks is None else self.blocks + block

    def _node_directions(self) -> Float[Tensor, "D B M N K 2"]:
        """The controls that move one node alone, component after component."""
        unit = torch.eye(2 * self.steps, dtype=self.u.dtype, device=self.u.device)
        unit = self.to_controls(unit.view(-1, 1, 1, 1, 2, self.steps)).transpose(-1, -2)
        return unit.expand(-1, *self.controls.shape)

    def _read_pairs(self, every_pair: bool) -> None:
        energy = self.of
        self.pair_reads: list[tuple[str, PairFeature, Tensor, Shape]] = []
        if not energy.pair or self.agents < 2:
            self.edges = Edges.none(self.samples, self.agents, self.u.device)
        elif every_pair:
            self.edges = Edges.all(self.samples, self.agents, self.u.device)
        else:
            self.edges = Edges.near(energy, self.scene, self.parameters, self.states)
        edges = self.edges
        count = len(edges.pair)
        self.pair_curvature: Tensor | None = None  # [E, 3, K]: what a pair's agents share, with its sign turned
        self.pair_blocks: Tensor | None = None  # [E, 2 K, 2 K] of undeclared pair features: first by second agent
        self.linked = torch.zeros(count, dtype=torch.bool, device=self.u.device)
        if count == 0:
            return
        position = energy.at_pair_steps(self.x[:, :, :2].transpose(-1, -2)).transpose(-1, -2)
        offset = edges.difference(position)
        squared = offset.square().sum(1)
        apart = squared > 0
        root = torch.where(apart, squared, 1.0).sqrt()
        self.distance = torch.where(apart, root, 0.0)
        self.nearness = torch.where(apart, 1.0 / root, 0.0)
        self.normal = offset * self.nearness[:, None]
        force = torch.zeros_like(self.distance)
        stiffness, value = torch.zeros_like(force), torch.zeros_like(force)
        for name, feature in energy.pair_features.items():
            weight = energy.pair_weight(self.scene, self.parameters, name).flatten()
            weight = (weight if edges.every else weight.index_select(0, edges.pair))[:, None]
            if feature.source is Source.TRAJECTORY:
                self._read_undeclared_pair(feature, weight)
                self.pair_reads.append((name, feature, weight, (weight, None, None)))
                continue
            reach = (
                energy.reach(self.scene)[:, None].expand(-1, self.samples // len(self.scene.agent_mask), -1).flatten()
            )
            reach = (reach if edges.every else reach.index_select(0, edges.pair))[:, None]
            shape: Shape
            if feature.function is overlap:
                shape = *energy.pair_shape(feature, self.distance, reach), None
            else:
                shape = _bend(feature.function, self.distance, reach)
            depth, steepness, bend = shape
            assert steepness is not None
            square = weight.square()
            pull = square * depth
            value += pull * depth
            if self.exact and bend is not None:
                stiffness += pull * bend
            force += pull * steepness
            stiffness += square * steepness.square()
            self.pair_reads.append((name, feature, weight, shape))
        if any(feature.source is Source.DISTANCE for feature in energy.pair_features.values()):
            self.linked |= (stiffness != 0).any(1)
            pulled = force[:, None] * self.normal
            curvature = stiffness[:, None] * _outer(self.normal, 1)
            if self.exact:
                turning = force * self.nearness
                curvature -= turning[:, None] * _outer(self.normal, 1)
                curvature[:, ::2] += turning[:, None]
            self.pair_curvature = self._every_step(curvature)
            curvature = self.pair_curvature
            pulled = self._every_step(pulled)
            edges.spread_(self.pull, torch.cat((pulled, curvature), 1), torch.cat((-pulled, curvature), 1))
            sample = edges.first // self.agents * self.agents  # an energy of pairs is put down to the first agent
            self.agent_value.flatten().index_add_(0, sample, 0.5 * value.sum(-1))

    def _bend_undeclared(self) -> None:
        """Second derivatives of undeclared features, by automatic differentiation of their gradient, entry by entry."""
        own = [read.name for read in self.reads if read.feature.source is Source.TRAJECTORY]
        pair = [name for name, feature, _, _ in self.pair_reads if feature.source is Source.TRAJECTORY]
        if not own and not pair:
            return
        part = dataclasses.replace(self.of, own=own, pair=pair)
        with torch.enable_grad():
            controls = self.controls.detach().requires_grad_()
            energy = part(self.scene, self.parameters.map(Tensor.detach), controls).sum()
            (gradient,) = torch.autograd.grad(energy, controls, create_graph=True)
            rows = []
            for unit in torch.eye(controls[0, 0].numel(), dtype=controls.dtype, device=controls.device):
                along_unit = (gradient * unit.view(controls.shape[2:])).sum()
                rows.append(
                    torch.autograd.grad(along_unit, controls, retain_graph=True, allow_unused=True)[0]
                    if along_unit.requires_grad
                    else None
                )
        bends = torch.stack([torch.zeros_like(controls) if row is None else row for row in rows])
        bends = bends.flatten(1, 2).view(self.agents, self.steps, 2, self.samples, self.agents, self.steps, 2)
        at_nodes = self.to_nodes(self.to_nodes(bends.permute(3, 0, 2, 4, 6, 5, 1)).transpose(-1, -2))  # [S i c j d k l]
        at_nodes = at_nodes.permute(0, 1, 3, 2, 5, 4, 6)
        at_nodes = at_nodes.reshape(self.samples, self.agents, self.agents, 2 * self.steps, 2 * self.steps)
        self.blocks = at_nodes.diagonal(dim1=1, dim2=2).movedim(-1, 1)
        if pair:
            rows_of = self.edges.first * self.agents + self.edges.second % self.agents
            self.pair_blocks = at_nodes.flatten(0, 2)[rows_of]

    def _every_step(self, values: Float[Tensor, "E c L"]) -> Float[Tensor, "E c K"]:
        """Values at the steps at which pairs are looked at, and zeros in between."""
        stride = self.of.pair_stride
        if stride == 1:
            return values
        every = values.new_zeros(*values.shape[:2], self.steps)
        every[..., stride - 1 :: stride] = values
        return every

    def _read_undeclared_pair(self, feature: PairFeature, weight: Tensor) -> None:
        edges = self.edges
        states = self.of.at_pair_steps(self.states.flatten(0, 1))
        both = edges.ends(states)
        moved = self.of.dynamics.tangent(self.states, self._node_directions(), self.dt).flatten(1, 2)
        moved = self.of.at_pair_steps(moved).permute(1, 2, 0, 3, 4)  # [S, N, 2 K, L, 4]
        first, second = (side.transpose(0, 1) for side in edges.ends(moved))
        sizes: tuple[Tensor, ...] = ()
        if feature.needs:
            modes = self.samples // len(self.scene.agent_mask)
            sizes = edges.ends(self.of.size(self.scene).repeat_interleave(modes, 0)[:, :, None])
        exists = pair_mask(self.scene)[:, None].expand(-1, self.samples // len(self.scene.agent_mask), -1)
        exists = exists.flatten().index_select(0, edges.pair)[:, None]
        if feature.stepwise:  # eight slopes per step, in the states of both, instead of 4 K through the function
            unit = torch.eye(8, dtype=states.dtype, device=states.device)
            unit = unit[:, None, None].expand(-1, *both[0].shape[:2], -1)
            value, slopes = along(feature.function, both, (unit[..., :4], unit[..., 4:]), *sizes)
            by_first, by_second = (
                (slope.movedim(0, -1) * side).sum(-1)
                for slope, side in zip(slopes.split(4), (first, second), strict=True)
            )
        else:
            still = torch.zeros_like(first)
            value, by_first = along(feature.function, both, (first, still), *sizes)
            _, by_second = along(feature.function, both, (still, second), *sizes)
        value, by_first, by_second = (weight * torch.where(exists, part, 0.0) for part in (value, by_first, by_second))
        jacobians = by_first.permute(1, 0, 2), by_second.permute(1, 0, 2)  # [E, 2 K, R]
        self.linked |= ((by_first != 0).any(-1).any(0)) & exists[:, 0]
        forces = (side @ value[..., None] for side in jacobians)
        edges.spread_(self.node_force, *(force.view(-1, 2, self.steps) for force in forces))
        sample = edges.first // self.agents * self.agents
        self.agent_value.flatten().index_add_(0, sample, 0.5 * value.square().sum(-1))
        if self.exact:
            return
        if self.blocks is None:
            self.blocks = value.new_zeros(self.samples, self.agents, 2 * self.steps, 2 * self.steps)
        edges.spread_(self.blocks, *(side @ side.mT for side in jacobians))
        shared = jacobians[0] @ jacobians[1].mT
        self.pair_blocks = shared if self.pair_blocks is None else self.pair_blocks + shared

    # --- differentiation ----------------------------------------------------------------------------------------------

    def pullback(
        self, adjoint: Float[Tensor, "S N 2 K"], step: Float[Tensor, "S N 2 K"]
    ) -> tuple[Float[Tensor, "S N 2 K"], dict[str, Tensor], dict[str, Tensor], Tensor | None]:
        """Gradient of phi = -<J mu, r + J d> for constant changes mu (``adjoint``) and d (``step``) of the controls.

        Undeclared features are left out: automatic differentiation takes care of them.

        Returns:
            by controls; by own weights [S, N]; by pair weights [S, P]; by goals [S, N, 2].
        """
        dt = self.dt
        changes = torch.stack((adjoint, step))
        nodes = dt * changes.cumsum(-1)
        moved = self._travel((self.moves * nodes[:, :, :, :, None]).sum(3))  # [2, S, N, xy, K]
        mu, mu_node, mu_position = adjoint, nodes[0], moved[0]
        # Forces that phi exerts on controls, nodes, and positions with their changes along mu and d.
        control = -self.control_stiffness * mu
        node = -self.node_stiffness * mu_node
        if self.rate_stiffness is not None:
            rate = -self.rate_stiffness * (_ahead(mu) - mu) / dt**2
            control -= rate - torch.nn.functional.pad(rate[..., :-1], (1, 0))
        position = mu.new_zeros(self.samples, self.agents, 3, 2, self.steps)
        own: dict[str, Tensor] = {}
        goals = None
        for name, feature, weight, (value, steepness, bend) in (
            (r.name, r.feature, r.weight, r.shape) for r in self.reads
        ):
            square = weight.square()
            match feature.source:
                case Source.TRAJECTORY:
                    continue
                case Source.STEERING:
                    along_mu, ahead = self._pull_steering(value, steepness, bend, square, changes, nodes, control, node)
                case Source.POSITION:
                    along_mu, ahead = mu_position, value + moved[1]
                    assert steepness is not None
                    across = mu_position - steepness * (steepness * mu_position).sum(2, keepdim=True)
                    position[:, :, 0] -= square[..., None] * across
                    position[:, :, 1] -= square[..., None] * ahead
                    position[:, :, 2] -= square[..., None] * mu_position
                case Source.FINAL_POSITION:
                    along_mu, ahead = mu_position[..., -1], value + moved[1, ..., -1]
                    pull = square * along_mu
                    position[:, :, 0, :, -1] -= pull
                    position[:, :, 1, :, -1] -= square * ahead
                    position[:, :, 2, :, -1] -= pull
                    goals = pull
                case _:
                    if feature.source is Source.CONTROL:
                        along_mu, along_d = changes[:, :, :, feature.channel]
                    elif feature.source is Source.RATE:
                        along_mu, along_d = changes[:, :, :, feature.channel].diff(dim=-1) / dt
                    else:
                        along_mu, along_d = nodes[:, :, :, 0]
                    ahead = value + (along_d if steepness is None else steepness * along_d)
                    if bend is not None:
                        assert steepness is not None
                        force = -square * bend * (along_mu * ahead + steepness * along_mu * along_d)
                        if feature.source is Source.CONTROL:
                            control[:, :, feature.channel] += force
                        elif feature.source is Source.RATE:
                            control[:, :, feature.channel, 1:] += force / dt
                            control[:, :, feature.channel, :-1] -= force / dt
                        else:
                            node[:, :, 0] += force
                    along_mu = along_mu if steepness is None else steepness * along_mu
            own[name] = -2.0 * weight[..., 0] * (along_mu * ahead).flatten(2).sum(-1)
        by_pair = self._pull_pairs(moved, position)
        after = self._after(position)
        along_e, along_left = (
            (direction[:, :, None] * after).sum(3) for direction in (self.unit, self.left)
        )  # [S, N, 3, K]
        faster, turned = nodes.movedim(0, 2).unbind(3)  # [S, N, 2, K]
        speed = self.x[:, :, SPEED]
        node[:, :, 0] += along_e[:, :, 0] + (turned * along_left[:, :, 1:]).sum(2)
        node[:, :, 1] += speed * (along_left[:, :, 0] - (turned * along_e[:, :, 1:]).sum(2))
        node[:, :, 1] += (faster * along_left[:, :, 1:]).sum(2)
        return control + dt * _suffix(node), own, by_pair, goals

    def _pull_steering(
        self,
        angle: Tensor,
        by_turn_rate: Tensor | None,
        by_speed: Tensor | None,
        square: Tensor,
        changes: Tensor,
        nodes: Tensor,
        control: Tensor,
        node: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Add what steering contributes beyond its stiffness along the diagonal."""
        assert by_turn_rate is not None
        assert by_speed is not None
        turned = changes[:, :, :, TURN_RATE]
        faster = torch.nn.functional.pad(nodes[:, :, :, 0, :-1], (1, 0))
        along_mu, along_d = by_turn_rate * turned + by_speed * faster
        ahead = angle + along_d
        twice, mixed, by_speeds = steering_curvatures(*self._steered())
        turn_bend = twice * turned + mixed * faster
        speed_bend = mixed * turned + by_speeds * faster
        cross = square * by_turn_rate * by_speed
        control[:, :, TURN_RATE] -= square * (ahead * turn_bend[0] + along_mu * turn_bend[1]) + cross * faster[0]
        by_node = square * (ahead * speed_bend[0] + along_mu * speed_bend[1]) + cross * turned[0]
        node[:, :, 0, :-1] -= by_node[..., 1:]
        return along_mu, ahead

    def _pull_pairs(self, moved: Tensor, position: Tensor) -> dict[str, Tensor]:
        """Add the forces that phi exerts through the pairs; returns its gradient by their weights, [S, P]."""
        edges = self.edges
        by_weight: dict[str, Tensor] = {}
        declared = [read for read in self.pair_reads if read[1].source is Source.DISTANCE]
        if not declared:
            return by_weight
        at_steps = self.of.at_pair_steps(moved.movedim(0, 2).transpose(-1, -2)).transpose(-1, -2)
        apart = edges.difference(at_steps)  # [E, 2, xy, L]
        closing = (self.normal[:, None] * apart).sum(2)
        along_mu, along_d = closing.unbind(1)
        outward, with_mu, with_d = (torch.zeros_like(self.distance) for _ in range(3))
        for name, _, weight, (value, steepness, bend) in declared:
            assert steepness is not None
            square = weight.square()
            ahead = value + steepness * along_d
            slid = steepness * along_mu
            gain = steepness * slid
            if bend is not None:
                outward -= square * bend * (along_mu * ahead + slid * along_d)
            outward -= square * gain
            with_mu -= square * steepness * ahead
            with_d -= square * gain
            weighed = -2.0 * weight[:, 0] * (slid * ahead).sum(-1)
            if not edges.every:
                rows = weighed.new_zeros(self.samples * self.agents * (self.agents - 1) // 2)
                weighed = rows.index_copy_(0, edges.pair, weighed)
            by_weight[name] = weighed.view(self.samples, -1)
        turning = (apart - closing[:, :, None] * self.normal[:, None]) * self.nearness[:, None, None]
        force = outward[:, None] * self.normal + with_mu[:, None] * turning[:, 0] + with_d[:, None] * turning[:, 1]
        forces = torch.stack((force, with_mu[:, None] * self.normal, with_d[:, None] * self.normal), 1)
        forces = self._every_step(forces.flatten(1, 2)).view(-1, 3, 2, self.steps)
        edges.spread_(position, forces, -forces)
        return by_weight
