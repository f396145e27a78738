"""Suite of every model of motion."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
import torch

from epo_lightning.game.dynamics import Dynamics
from epo_lightning.registry import build

DT = 0.1


class DynamicsSuite:
    """Dynamics turn controls into states, causally, each agent's independently, with the right derivative.

    Attributes:
        config: ``name`` and arguments of the part.
    """

    config: ClassVar[dict[str, Any]]

    @pytest.fixture
    def dynamics(self) -> Dynamics:
        return build("dynamics", self.config)

    @staticmethod
    def motion() -> tuple[torch.Tensor, torch.Tensor]:
        """States x_0 [B, 1, N, 4] and controls [B, M, N, K, 2]."""
        return torch.randn(2, 1, 3, 4, dtype=torch.float64), torch.randn(2, 2, 3, 5, 2, dtype=torch.float64)

    def test_rollouts_have_the_declared_shape(self, dynamics):
        initial, controls = self.motion()
        assert dynamics.rollout(initial, controls, DT).shape == (2, 2, 3, 5, 4)

    def test_a_control_changes_only_later_states(self, dynamics):
        initial, controls = self.motion()
        before = dynamics.rollout(initial, controls, DT)
        controls[..., 3, :] += 1.0
        after = dynamics.rollout(initial, controls, DT)
        assert torch.equal(after[..., :3, :], before[..., :3, :])
        assert (after[..., 3:, :] != before[..., 3:, :]).any(-1).all()

    def test_agents_modes_and_scenes_are_independent(self, dynamics):
        initial, controls = self.motion()
        states = dynamics.rollout(initial, controls, DT)
        for scene, mode, agent in torch.cartesian_prod(*map(torch.arange, controls.shape[:3])).tolist():
            alone = dynamics.rollout(initial[scene, 0, agent], controls[scene, mode, agent], DT)
            torch.testing.assert_close(alone, states[scene, mode, agent], rtol=0, atol=1e-13)

    def test_the_tangent_is_the_derivative_of_the_rollout(self, dynamics):
        if not hasattr(dynamics, "tangent"):
            pytest.skip("the energies that take these dynamics ask for no tangent")
        initial, controls = self.motion()
        direction = torch.randn_like(controls)
        step = 1e-6
        ahead, behind = (dynamics.rollout(initial, controls + sign * step * direction, DT) for sign in (1, -1))
        tangent = dynamics.tangent(dynamics.rollout(initial, controls, DT), direction[None], DT)[0]
        torch.testing.assert_close(tangent, (ahead - behind) / (2 * step), rtol=1e-6, atol=1e-7)
