"""Suite of every backbone."""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

import pytest
import torch
from games import pad, random_scene, reordered

from epo_lightning.registry import build, lookup
from epo_lightning.scene import Scene

PADDING: dict[str, tuple[dict[str, int], str]] = {
    "absent agents": ({"agents": 3}, "scene.agent_mask"),
    "unobserved steps": ({"steps": 4}, "scene.history_mask"),
    "absent lanes": ({"lanes": 2}, "scene.lane_mask"),
    "absent vectors of lanes": ({"vectors": 3}, "scene.lane_mask"),
    "all of these": ({"agents": 3, "steps": 4, "lanes": 2, "vectors": 3}, "a mask"),
}
"""What is added to a scene, and the mask that leaves it out."""


class BackboneSuite:
    """A backbone gives every agent a feature, which depends on its scene alone, whether or not it reads a map."""

    config: ClassVar[dict[str, Any]]

    @pytest.fixture(params=[False, True], ids=["no map", "map"])
    def backbone(self, request: pytest.FixtureRequest) -> torch.nn.Module:
        torch.manual_seed(1)
        self.reads_map = request.param
        if not self.reads_map:
            return build("backbone", self.config).eval()
        if "map_input" not in inspect.signature(lookup("backbone", self.config["name"])).parameters:
            pytest.skip("this backbone reads no map")
        return build("backbone", self.config, map_input=True).eval()

    def test_shape_and_gradient_flow(self, backbone):
        z = backbone(random_scene(3, 4, lanes=5))
        assert z.shape == (3, 4, backbone.width)
        z.square().sum().backward()
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in backbone.parameters())

    def test_every_agent_sees_every_other_one(self, backbone):
        scene = random_scene(1, 3, lanes=5)
        before = backbone(scene)
        scene.history[0, 2] += 1.0
        assert (backbone(scene) - before)[0].abs().amax(1).gt(1e-6).all()

    @pytest.mark.parametrize("lane", range(3))
    def test_every_agent_sees_every_lane_and_nothing_else_of_the_map(self, backbone, lane):
        scene = random_scene(1, 3, lanes=3)
        scene.lane_mask[0, :, 1:3] = torch.tensor([True, False])
        before = backbone(scene)
        scene.lanes[0, lane, 2] = torch.nan
        assert torch.equal(backbone(scene), before)
        scene.lanes[0, lane, 1] += 1.0
        assert (backbone(scene) - before)[0].abs().amax(1).gt(1e-6).all() == self.reads_map

    @pytest.mark.parametrize("filling", [0.0, 1e6, float("nan")])
    @pytest.mark.parametrize("padding", PADDING)
    def test_padding_independence(self, backbone, padding, filling):
        """Nothing that a mask leaves out has an effect."""
        amount, mask = PADDING[padding]
        scene = random_scene(3, 2, lanes=5)
        padded = backbone(pad(scene, **{"agents": 0, **amount}, filling=filling))
        advice = f"the features of agents depend on {padding}, which {mask} leaves out"
        torch.testing.assert_close(
            padded[:, :2], backbone(scene), rtol=0, atol=1e-5, msg=lambda found: f"{advice}:\n{found}"
        )

    def test_padding_does_not_change_gradients(self, backbone):
        scene = random_scene(3, 2, lanes=5)
        gradients = []
        for given in (scene, pad(scene, agents=3, steps=4, lanes=2, vectors=3)):
            backbone.zero_grad()
            backbone(given)[:, :2].square().sum().backward()
            gradients.append([p.grad.clone() for p in backbone.parameters()])
        torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-4)

    def test_batch_independence(self, backbone):
        scene = random_scene(4, 2, lanes=5)
        together = backbone(scene)
        for index in range(4):
            torch.testing.assert_close(backbone(scene[index])[0], together[index], rtol=0, atol=1e-5)

    def test_a_scene_without_lanes_has_finite_features(self, backbone):
        scene = random_scene(3, 2, lanes=5)
        scene.lane_mask[1] = False
        scene.lanes[1] = torch.nan
        z = backbone(scene)
        z.square().sum().backward()
        assert z.isfinite().all()
        assert all(p.grad.isfinite().all() for p in backbone.parameters())
        torch.testing.assert_close(z[1], backbone(scene[1])[0], rtol=0, atol=1e-5)

    def test_features_are_equivariant_to_agents_and_invariant_to_lanes_and_vectors(self, backbone):
        scene = random_scene(3, 4, lanes=5)
        z = backbone(scene)
        torch.testing.assert_close(backbone(reordered(scene, [2, 0, 3, 1])), z[:, [2, 0, 3, 1]], rtol=0, atol=1e-5)
        lanes, vectors = torch.randperm(5), torch.randperm(4)
        shuffled = {name: getattr(scene, name)[:, lanes][:, :, vectors] for name in ("lanes", "lane_mask")}
        torch.testing.assert_close(backbone(Scene(**{**vars(scene), **shuffled})), z, rtol=0, atol=1e-5)
