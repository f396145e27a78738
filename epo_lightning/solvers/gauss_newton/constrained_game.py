"""Games with hard constraints: h, its Jacobian, the Lagrangian, and the augmented Lagrangian as a feature energy.

The equations are those of :mod:`~epo_lightning.solvers.gauss_newton.augmented_lagrangian`, whose rounds solve these games.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.circles import separation
from epo_lightning.game.feature_derivatives import Bounds, signal_and_change
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.game.pairs import pairs
from epo_lightning.scene import Scene
from epo_lightning.solvers.general import dense


@dataclass(frozen=True)
class ConstrainedGame:
    """The games of a batch with hard constraints h(u) <= 0.

    Attributes:
        energy: features of E, and those that are constraints.
        names: names of the latter.
        scene, parameters: the games. A constraint holds where the weight of its feature is not zero.
    """

    energy: FeatureEnergy
    names: Sequence[str]
    scene: Scene
    parameters: GameParameters

    def of(self, rows: Tensor) -> ConstrainedGame:
        """The games of some scenes."""
        return dataclasses.replace(self, scene=self.scene[rows], parameters=self.parameters[rows])

    @property
    def objective(self) -> FeatureEnergy:
        """The energy without the features that are constraints."""
        own, pair = ([name for name in part if name not in self.names] for part in (self.energy.own, self.energy.pair))
        return dataclasses.replace(self.energy, own=own, pair=pair)

    def excess(self, controls: Tensor) -> dict[str, Float[Tensor, "B M R steps"]]:
        """h by constraint, positive where it is violated, and -inf where there is none; a bound has two entries."""
        return {name: value for name, value, _ in self._signals(controls, controls.new_zeros(0, *controls.shape))}

    def jacobian(self, controls: Tensor) -> Float[Tensor, "B M C n"]:
        """dh/du of all constraints, in the order of :meth:`excess`; zero where there is none."""
        signals = self._signals(controls, dense.units(controls))
        return torch.cat([change.flatten(3) for *_, change in signals], -1).permute(1, 2, 3, 0)

    def _signals(self, controls: Tensor, directions: Tensor) -> list[tuple[str, Tensor, Tensor]]:
        """Name, h, and its changes along directions of controls, of every constraint."""
        energy, scene, parameters = self.energy, self.scene, self.parameters
        states = energy.dynamics.rollout(energy.current_states(scene), controls, scene.dt)
        change = energy.dynamics.tangent(states, directions, scene.dt)
        around, found = energy.surroundings(scene, parameters), []
        for name in self.names:
            if name in energy.own:
                feature = energy.own_features[name]
                signal, along = signal_and_change(feature, states, controls, change, directions, around)
                exists = (energy.own_weight(scene, parameters, name) != 0)[..., None]
                mask = energy.residual_mask(scene, feature, controls.shape[3])
                exists = exists if mask is None else exists & mask
                lower, upper = around.bounds[feature.signal]
                found.append((f"{name}, lower", *_where(exists, lower - signal, -along)))
                found.append((f"{name}, upper", *_where(exists, signal - upper, along)))
            else:
                first, second = pairs(controls.shape[2], controls.device)
                at, moving = energy.at_pair_steps(states[..., :2]), energy.at_pair_steps(change[..., :2])
                distance, normal = separation(at[:, :, first], at[:, :, second])
                closing = (normal * (moving[:, :, :, first] - moving[:, :, :, second])).sum(-1)
                exists = (energy.pair_weight(scene, parameters, name) != 0)[..., None]
                exists = exists & energy.pair_exists(scene, energy.pair_features[name], distance.shape[-1])
                reach = energy.reach(scene, parameters, name)
                found.append((name, *_where(exists, reach - distance, -closing)))
        return found

    def slope(self, multipliers: Tensor, controls: Tensor) -> Float[Tensor, "B M N K 2"]:
        """The gradient by the controls of E + sum of lambda h, differentiable."""
        with torch.enable_grad():
            leaf = controls if controls.requires_grad else controls.detach().requires_grad_()
            excess = torch.cat([value.flatten(2) for value in self.excess(leaf).values()], -1)
            pushing = (multipliers * torch.where(multipliers > 0, excess, 0.0)).sum()
            value = self.objective(self.scene, self.parameters, leaf).sum() + pushing
            return torch.autograd.grad(value, leaf, create_graph=True)[0]

    def hessian(self, multipliers: Tensor, controls: Tensor) -> Float[Tensor, "B M n n"]:
        """The Hessian of E + sum of lambda h, with ones on the diagonal for controls on which nothing depends."""
        return dense.slope_change(lambda at: self.slope(multipliers, at), self.scene, controls)

    def augmented(
        self, multipliers: Mapping[str, Tensor], penalty: Tensor, controls: Tensor
    ) -> tuple[FeatureEnergy, Scene, GameParameters]:
        """The game of a round: its energy is the augmented Lagrangian, but for a constant."""
        weight = penalty.sqrt()[..., None]

        def weights(given: Mapping[str, Tensor]) -> dict[str, Tensor]:
            return {
                name: torch.where(value != 0, weight, 0.0) if name in self.names else value
                for name, value in given.items()
            }

        shifts = {name: value / penalty[..., None, None] for name, value in multipliers.items()}
        energy = ShiftedEnergy(
            **{one.name: getattr(self.energy, one.name) for one in dataclasses.fields(self.energy)}, shifts=shifts
        )
        parameters = dataclasses.replace(
            self.parameters,
            own_weights=weights(self.parameters.own_weights),
            pair_weights=weights(self.parameters.pair_weights),
            initial_controls=controls,
        )
        return energy, self.scene, parameters


@dataclass(frozen=True)
class ShiftedEnergy(FeatureEnergy):
    """A feature energy whose limits are moved inwards, for every pair, agent and step.

    Attributes:
        shifts: by constraint, how far.
    """

    shifts: Mapping[str, Tensor] = field(default_factory=dict)

    def validate(self, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Nothing: the game was checked before its limits were moved."""

    def of_scenes(self, rows: Tensor | slice) -> FeatureEnergy:
        """The energy with the limits of some scenes."""
        return dataclasses.replace(self, shifts={name: shift[rows] for name, shift in self.shifts.items()})

    @property
    def bounded_by_kind(self) -> Sequence[str]:
        return [name.partition("b, ")[0] for name in self.shifts if name.endswith("lower")]

    def _bounds_of(self, scene: Scene) -> Bounds:
        found = dict(super()._bounds_of(scene))
        for name in self.bounded_by_kind:
            lower, upper = found[name]
            down, up = self.shifts[f"{name}b, lower"], self.shifts[f"{name}b, upper"]
            upper = upper - up
            # Of limits that have passed each other, the one with a multiplier counts.
            lower = torch.where(up > 0, (lower + down).minimum(upper), lower + down)
            found[name] = lower, upper.maximum(lower)
        return found

    def reach(self, scene: Scene, parameters: GameParameters, name: str) -> Tensor:
        reach = super().reach(scene, parameters, name)
        return reach + self.shifts[name] if name in self.shifts else reach

    def extent(self, scene: Scene) -> Tensor | None:
        extent = super().extent(scene)
        moved = [self.shifts[name].amax() for name in self.pair if name in self.shifts and self.shifts[name].numel()]
        return extent if extent is None or not moved else extent + torch.stack(moved).amax() / 2


def _where(exists: Tensor, value: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """h and its changes, with -inf and zero where there is no constraint."""
    return torch.where(exists, value, -torch.inf), torch.where(exists, change, 0.0)
