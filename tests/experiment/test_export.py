"""Exported programs give the forecasts of their forecasters, in a process without this package."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jaxtyping
import pytest
import torch
from torch.torch_version import TorchVersion

import epo_lightning
from epo_lightning import pretrained
from epo_lightning.decoders import goals
from epo_lightning.decoders.gates import NearestGate
from epo_lightning.experiment.config.settings import ExportSettings
from epo_lightning.experiment.export import check_exportable, check_file, export, inputs_of, largest_difference
from epo_lightning.experiment.program_files import FORMATS
from epo_lightning.host import readable
from epo_lightning.registry import ConfigError
from epo_lightning.scene import Scene
from epo_lightning.solvers.general.lbfgs import LBFGS

EXAMPLE = Path(__file__).parents[2] / "examples" / "cpp"
ELSEWHERE = """
import sys, torch
about = {"about.json": ""}
program = torch.export.load(sys.argv[1], extra_files=about).module()
found = [program(given) for given in torch.load(sys.argv[2])]
assert not any(name.startswith("epo_lightning") for name in sys.modules)
torch.save(found, sys.argv[3])
print(about["about.json"])
"""


@pytest.fixture
def unchecked(monkeypatch: pytest.MonkeyPatch) -> None:
    """No runtime checks of annotations: sizes are symbols while a program is exported, and no ints."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def run_elsewhere(file: Path, batches: list[dict[str, torch.Tensor]]) -> tuple[list[dict[str, torch.Tensor]], Any]:
    """What a program gives in a process without this package, and its description."""
    given, found = file.with_name("given.pt"), file.with_name("found.pt")
    torch.save(batches, given)
    # -I: neither the working directory nor PYTHONPATH is searched for modules.
    words = [sys.executable, "-I", "-c", ELSEWHERE, str(file), str(given), str(found)]
    printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    return torch.load(found), json.loads(printed)


def with_absent_agents(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """The inputs with as many absent agents as there are agents."""
    return {name: torch.cat((value, torch.zeros_like(value)), 1) for name, value in tensors.items()}


@pytest.mark.parametrize(
    "name",
    [
        "rpi/v_lstm_sc",
        pytest.param("rpi/v_lstm_epo", marks=pytest.mark.slow),
        pytest.param("highway_sim/hivt_m_epo", marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("unchecked")
def test_a_program_gives_the_forecasts_of_its_forecaster_in_another_process(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))  # no data set: the scenes that ship with the run are the example
    settings = ExportSettings(run=name, out=str(tmp_path / "it.pt2"))
    told: list[str] = []
    file, difference = export(settings, tell=told.append)
    assert difference <= 1e-5
    assert len(told) == 1
    assert "is traced" in told[0]
    forecaster, scenes = epo_lightning.load(name), pretrained.examples(name)
    free = name == "rpi/v_lstm_sc"  # a game's program has one number of agents
    batches = [inputs_of(forecaster, scenes[slice(count)]) for count in (1, 7)]  # other batches than the example's
    batches += [with_absent_agents(batches[1])] if free else []
    found, about = run_elsewhere(file, batches)
    exact = epo_lightning.load(name).double()
    for outputs, batch in zip(found, batches, strict=True):
        scene = Scene(**batch, dt=scenes.dt)
        wanted, precise = forecaster.predict(scene), exact.predict(scene)
        # Where an agent is exactly at a bound, a Gauss-Newton step depends on the side to which numbers are rounded.
        smooth = torch.isclose(wanted.states, precise.states.float(), atol=1e-4, rtol=1e-5).flatten(1).all(1)
        assert (~smooth).sum() <= (0 if name == "rpi/v_lstm_sc" else 1)
        torch.testing.assert_close(outputs["states"], wanted.states, atol=1e-2, rtol=1e-5)
        torch.testing.assert_close(outputs["states"][smooth], wanted.states[smooth], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(outputs["probabilities"], wanted.probabilities, atol=1e-5, rtol=1e-5)
    assert about["dt"] == scenes.dt
    agents = "N" if free else scenes.history.shape[1]
    assert about["inputs"]["history"]["shape"] == ["B", agents, *scenes.history.shape[2:]]
    assert about["outputs"]["states"]["shape"][::2] == ["B", agents, 4]
    with pytest.raises(ConfigError, match=r"it\.pt2 exists: nothing is overwritten"):
        export(settings)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_onnx_gives_the_forecasts_of_the_forecaster(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runtime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnxscript")
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))
    name = "rpi/v_lstm_sc"
    file, _ = export(ExportSettings(run=name, format="onnx", out=str(tmp_path / "it.onnx")))
    forecaster, scenes = epo_lightning.load(name), pretrained.examples(name)[slice(3)]
    inputs = with_absent_agents(inputs_of(forecaster, scenes))
    session = runtime.InferenceSession(file)
    states, _ = session.run(["states", "probabilities"], {name: value.numpy() for name, value in inputs.items()})
    wanted = forecaster.predict(Scene(**inputs, dt=scenes.dt))
    torch.testing.assert_close(torch.from_numpy(states), wanted.states, atol=1e-5, rtol=1e-5)
    about = json.loads(session.get_modelmeta().custom_metadata_map["about"])
    assert about["inputs"]["history"]["shape"] == ["B", "N", *scenes.history.shape[2:]]


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", ["rpi/v_lstm_sc", "rpi/v_lstm_epo"])
def test_the_cpp_example_gives_the_forecasts_of_the_forecaster(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("cmake") is None:
        pytest.skip("no CMake on this machine")
    build = tmp_path / "build"
    prefix = f"-DCMAKE_PREFIX_PATH={torch.utils.cmake_prefix_path}"
    subprocess.run(["cmake", "-S", str(EXAMPLE), "-B", str(build), prefix], check=True)
    subprocess.run(["cmake", "--build", str(build)], check=True)
    monkeypatch.setenv("EPO_CACHE", str(tmp_path))
    export(ExportSettings(run=name, format="aoti", out=str(tmp_path / "it.pt2")))
    forecaster, scenes = epo_lightning.load(name), pretrained.examples(name)
    for count in (1, 5):
        torch.save(inputs_of(forecaster, scenes[slice(count)]), tmp_path / "scenes.pt")
        words = [str(build / "forecast"), *(str(tmp_path / name) for name in ("it.pt2", "scenes.pt", "found.pt"))]
        printed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
        assert f"one call for {count} scene(s)" in printed
        states, probabilities = torch.load(tmp_path / "found.pt")
        wanted = forecaster.predict(scenes[slice(count)])
        torch.testing.assert_close(states, wanted.states, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(probabilities, wanted.probabilities, atol=1e-5, rtol=1e-5)


def test_an_old_pytorch_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "__version__", TorchVersion("2.9.1+cu130"))
    forecaster = epo_lightning.load("rpi/v_lstm_sc")
    with pytest.raises(ConfigError, match=r"needs PyTorch 2\.11 or later, and 2\.9\.1\+cu130 is installed"):
        check_exportable(forecaster, "+SC", FORMATS["pt2"])


def test_what_takes_as_many_steps_as_the_values_need_is_refused() -> None:
    forecaster = epo_lightning.load("rpi/v_lstm_epo")
    check_exportable(forecaster, "two steps", FORMATS["aoti"])
    forecaster.gate = NearestGate()
    with pytest.raises(
        ConfigError,
        match=r"gated .* its gate chooses pairs by their values \(.*forecaster\.gate=null\)",
    ):
        check_exportable(forecaster, "gated", FORMATS["pt2"])
    forecaster.gate = None
    forecaster.solver = replace(forecaster.solver, adaptive=True)
    with pytest.raises(
        ConfigError, match=r"solved cannot be .* its solver takes adaptive steps, .*solver\.adaptive=false"
    ):
        check_exportable(forecaster, "solved", FORMATS["pt2"])
    forecaster.calibration = object()
    both = r"calibrated .* its calibration .*forecaster\.calibration=null\); its solver .*solver\.adaptive=false\)"
    with pytest.raises(ConfigError, match=both):
        check_exportable(forecaster, "calibrated", FORMATS["pt2"])
    forecaster.solver = LBFGS()
    with pytest.raises(ConfigError, match=r"its solver, LBFGS, takes as many steps .*solver=levenberg_marquardt"):
        check_exportable(forecaster, "minimised", FORMATS["pt2"])
    with pytest.raises(ConfigError, match=r"game cannot be exported as ONNX, .*: use format=pt2 or format=aoti"):
        check_exportable(forecaster, "game", FORMATS["onnx"])


def test_every_obstacle_of_the_shipped_row_that_is_refused_is_named_with_its_setting(tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        export(ExportSettings(run="rpi/v_lstm_epo_game_refined", out=str(tmp_path / "it.pt2")))
    message = str(refused.value)
    assert "forecaster.calibration=null" in message
    assert "solver.adaptive=false" in message
    assert "solver=levenberg_marquardt" not in message, "it is this solver"
    forecaster = epo_lightning.load("rpi/v_lstm_epo_game_refined")
    forecaster.calibration, forecaster.solver = None, replace(forecaster.solver, adaptive=False)
    check_exportable(forecaster, "with these settings", FORMATS["pt2"])


def test_a_file_has_the_suffix_of_its_format_and_packages_that_are_missing_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("epo_lightning.experiment.export.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"out=it\.pt2 must end in \.onnx"):
        check_file(Path("it.pt2"), FORMATS["onnx"])
    with pytest.raises(ConfigError, match=r"needs onnx, onnxscript, onnxruntime: pip install 'epo_lightning\[onnx\]'"):
        check_file(Path("it.onnx"), FORMATS["onnx"])


def test_a_file_that_cannot_be_written_is_named_before_the_program_is_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"out=.*file/it\.pt2 cannot be written .*choose another out="):
        check_file(tmp_path / "file" / "it.pt2", FORMATS["pt2"])
    check_file(tmp_path / "new" / "it.pt2", FORMATS["pt2"])
    assert not list((tmp_path / "new").iterdir())


def test_differences_are_relative_for_large_values_and_nan_is_one() -> None:
    given = {"x": torch.tensor([[0.5], [100.0]])}
    assert largest_difference(lambda given: given, given, given) == 0.0
    assert largest_difference(lambda given: {"x": given["x"] + 0.25}, given, given) == 0.25
    assert largest_difference(lambda given: {"x": given["x"] * 1.5}, given, given) == 0.5
    assert largest_difference(lambda _: given, given, given) == torch.inf  # two scenes, also where one is given
    assert not largest_difference(lambda given: {"x": given["x"] * torch.nan}, given, given) <= 1e-5


@pytest.mark.parametrize("difference", [0.0, 2e-5, torch.nan])
def test_a_program_that_differs_from_its_forecaster_is_not_written(
    difference: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EPO_CACHE", str(tmp_path / "cache"))
    here = "epo_lightning.experiment.export."
    form = replace(FORMATS["pt2"], write=lambda program, about, path: path.touch(), load=lambda path: None)
    monkeypatch.setattr(f"{here}FORMATS", {"pt2": form})
    monkeypatch.setattr(f"{here}program_of", lambda *_: None)
    monkeypatch.setattr(f"{here}describe", lambda _: {})
    monkeypatch.setattr(f"{here}largest_difference", lambda *_: difference)
    settings = ExportSettings(run="rpi/v_lstm_sc", out=str(tmp_path / "new" / "it.pt2"))
    if difference == 0.0:
        assert export(settings) == (tmp_path / "new" / "it.pt2", 0.0)
        return
    with pytest.raises(ConfigError, match=rf"differs from its forecaster by {difference:.2g}: it is not written"):
        export(settings)
    assert not list((tmp_path / "new").iterdir())


def test_values_are_not_readable_on_other_devices_and_while_a_program_is_exported() -> None:
    assert readable(torch.zeros(1))
    assert not readable(torch.zeros(1, device="meta"))

    class Asked(torch.nn.Module):
        def forward(self, given: torch.Tensor) -> torch.Tensor:
            return given + (1.0 if readable(given) else 2.0)

    program = torch.export.export(Asked(), (torch.zeros(2),))
    assert program.module()(torch.zeros(2)).tolist() == [2.0, 2.0]


def test_logits_of_all_goal_candidates_are_those_of_the_existing_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "highway_sim/hivt_m_epo"
    forecaster, scene = epo_lightning.load(name).eval(), pretrained.examples(name)
    with torch.no_grad():
        z = forecaster.backbone(scene)
        compact = forecaster.goals.logits(z, scene)
        monkeypatch.setattr(goals, "readable", lambda tensor: False)
        torch.testing.assert_close(forecaster.goals.logits(z, scene), compact, atol=1e-5, rtol=0)
