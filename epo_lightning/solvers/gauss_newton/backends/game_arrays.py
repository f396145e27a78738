"""Driving games as the compiled kernel reads them: addresses and strides of their tensors, and arrays for the gradients."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from epo_lightning.forecast import GameParameters
from epo_lightning.game.feature_energy import FeatureEnergy
from epo_lightning.scene import Scene
from epo_lightning.solvers.gauss_newton.kernel.interface import OWN, PAIR, SIGNALS, EpoGame, EpoGradients


class GameArrays:
    """The tensors of B M games, and the structure with their addresses.

    Attributes:
        game: the structure. It is valid as long as this object exists.
        inputs: the tensors by which solutions have derivatives: weights, margins and targets.
        kept: all other tensors that the kernel reads.
    """

    def __init__(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters, controls: Tensor) -> None:
        """Collect the tensors, as numbers of the type of ``controls``.

        Args:
            energy, scene, parameters: the games.
            controls: any controls [B, M, N, K, 2].

        Raises:
            ValueError: parameters that are not those of B scenes and M modes, or tensors on another device.
        """
        self._controls = controls
        like = controls.dtype
        weights = parameters.own_weights
        if _has_gaps(energy, scene):  # the weight of a line that does not exist is zero
            weights = {**weights, "lane": energy.own_weight(scene, parameters, "lane")}
        self._own = [as_type(like, weights[name]) for name in energy.own]
        self._pair = [as_type(like, parameters.pair_weights[name]) for name in energy.pair]
        self._margins = [as_type(like, parameters.margins[name]) for name in energy.decoded_margins]
        self._targets = {name: as_type(like, getattr(parameters, name)) for name in energy.targets}
        self.inputs = (*self._own, *self._pair, *self._margins, *self._targets.values())
        wrong = [list(tensor.shape) for tensor in self.inputs if tensor.shape[:2] != controls.shape[:2]]
        if wrong:
            raise ValueError(f"parameters of the shape {wrong[0]} for controls of the shape {list(controls.shape)}")
        self._slots = [OWN.index(name) for name in energy.own]
        self._pair_slots = [PAIR.index(name) for name in energy.pair]
        self._margin_slots = [PAIR.index(name) for name in energy.decoded_margins]
        self.kept: list[Tensor] = []
        self.game = self._describe(energy, scene, parameters)
        if not all(tensor.is_cpu for tensor in (*self.inputs, *self.kept)):
            raise ValueError(
                f"the controls are on the CPU, and {', '.join(_elsewhere(scene, parameters))} on another device: move scene "
                "and parameters to one device, for example by scene.to(device)"
            )

    def _hold(self, tensor: Tensor) -> Tensor:
        # The kernel gets the address alone: the tensor has to live as long as this object.
        self.kept.append(tensor)
        return tensor

    def _describe(self, energy: FeatureEnergy, scene: Scene, parameters: GameParameters) -> EpoGame:
        batch, modes, agents, horizon, _ = self._controls.shape
        like, hold = self._controls.dtype, self._hold
        game = EpoGame(B=batch, M=modes, N=agents, K=horizon, dt=scene.dt, lane_slides=energy.lane_slides)
        game.pair_stride = min(energy.pair_stride, horizon + 1)
        for index, name in enumerate(SIGNALS):
            if not isinstance(bound := energy.bounds.get(name, {}), Mapping):
                game.bounds[index][:] = bound
        initial = as_type(like, scene.current)
        initial = hold(initial if initial.stride(-1) == 1 else initial.contiguous())
        game.initial, (game.initial_b, game.initial_n) = initial.data_ptr(), initial.stride()[:2]
        game.present = hold(scene.agent_mask.contiguous()).data_ptr()
        if scene.size is not None:
            game.size = hold(as_type(like, scene.size).contiguous()).data_ptr()
        for slot, weight in zip(self._slots, self._own, strict=True):
            game.own[slot], game.own_strides[slot][:] = weight.data_ptr(), weight.stride()
        if agents > 1:
            for slot, weight in zip(self._pair_slots, self._pair, strict=True):
                game.pair[slot], game.pair_strides[slot][:] = weight.data_ptr(), weight.stride()
            margins = dict(zip(self._margin_slots, self._margins, strict=True))
            for name in energy.margins.keys() & set(energy.pair):
                fixed = hold(self._controls.new_tensor(energy.margins[name]))
                margins[PAIR.index(name)] = fixed.expand(batch, modes, agents * (agents - 1) // 2)
            for slot, margin in margins.items():
                game.margins[slot], game.margin_strides[slot][:] = margin.data_ptr(), margin.stride()
        if (goals := self._targets.get("goals")) is not None:
            game.goals = goals.data_ptr()
            game.goals_b, game.goals_m, game.goals_n, game.goals_x = goals.stride()
        if (headings := self._targets.get("goal_headings")) is not None:
            game.goal_headings, game.goal_heading_strides[:] = headings.data_ptr(), headings.stride()
        if (references := self._targets.get("reference_controls")) is not None:
            game.reference_controls = hold(references.contiguous()).data_ptr()
        if scene.game_steps is not None:
            game.ends = hold(as_type(torch.int64, scene.game_steps).contiguous()).data_ptr()
        if "lane" in energy.own:
            assert scene.references is not None
            assert parameters.reference is not None
            references = as_type(like, scene.references)
            if _has_gaps(energy, scene):
                references = torch.where(scene.reference_mask[..., None, None], references, 0.0)  # type: ignore[index]
            game.references = hold(references.contiguous()).data_ptr()
            game.reference = hold(as_type(torch.int64, parameters.reference).contiguous()).data_ptr()
            game.lines, game.points = scene.references.shape[2:4]
        if "velref" in energy.own:
            assert scene.reference_speed is not None
            game.reference_speed = hold(as_type(like, scene.reference_speed).contiguous()).data_ptr()
        return game

    def new_gradients(self) -> tuple[EpoGradients, list[Tensor]]:
        """A structure with the addresses of new gradients, which are zero, and these gradients in the order of ``inputs``.

        The caller sets the cotangents of the structure.
        """
        batch, modes, agents = self._controls.shape[:3]
        new = self._controls.new_zeros
        own = new((len(self._own), batch, modes, agents)).unbind(0)
        shared = (batch, modes, agents * (agents - 1) // 2)
        pair, margins = new((len(self._pair), *shared)).unbind(0), new((len(self._margins), *shared)).unbind(0)
        targets = {name: new(tensor.shape) for name, tensor in self._targets.items()}
        gradients = EpoGradients()
        for slots, addresses, tensors in (
            (self._slots, gradients.own, own),
            (self._pair_slots, gradients.pair, pair),
            (self._margin_slots, gradients.margins, margins),
        ):
            for slot, tensor in zip(slots, tensors, strict=True):
                addresses[slot] = tensor.data_ptr()
        for name, tensor in targets.items():
            setattr(gradients, name, tensor.data_ptr())
        return gradients, [*own, *pair, *margins, *targets.values()]


def as_type(dtype: torch.dtype, tensor: Tensor) -> Tensor:
    """The tensor as numbers of a type."""
    # `to` takes a microsecond even if the type is right already, and there are twenty tensors.
    return tensor if tensor.dtype == dtype else tensor.to(dtype)


def _elsewhere(scene: Scene, parameters: GameParameters) -> Iterator[str]:
    """Names of the tensors of a game that are not on the CPU."""
    for owner, fields in (("scene", vars(scene)), ("parameters", vars(parameters))):
        for name, value in fields.items():
            named = value.items() if isinstance(value, Mapping) else [(None, value)]
            for key, tensor in named:
                if isinstance(tensor, Tensor) and not tensor.is_cpu:
                    yield f"{owner}.{name}" + (f"[{key!r}]" if key else "")


def _has_gaps(energy: FeatureEnergy, scene: Scene) -> bool:
    """Whether some reference lines are masked out."""
    return "lane" in energy.own and scene.reference_mask is not None and not scene.reference_mask.all()
