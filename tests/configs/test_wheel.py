"""The wheel contains the configuration tree and the compiled layer."""

from __future__ import annotations

import platform
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from epo_lightning.solvers.gauss_newton.kernel import build

ROOT = Path(__file__).parents[2]

_SOLVE = """
import sys
sys.path.insert(0, {site!r})
from pathlib import Path
from epo_lightning.solvers.gauss_newton.backends import compiled
from epo_lightning.solvers.gauss_newton.kernel import interface
print(Path(compiled.__file__).parents[4], interface.library().epo_levels() > 0)
"""


def test_on_macos_the_wheel_is_for_its_system_and_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python's own names there are refused by pip (macosx-14.5-arm64), or promise other processors (universal2)."""
    assert build.platform_tag() == sysconfig.get_platform().replace("-", "_").replace(".", "_")
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(platform, "system", lambda: "Darwin")
    monkeypatch.setattr(platform, "mac_ver", lambda: ("14.5", ("", "", ""), "arm64"))
    assert build.platform_tag() == "macosx_14_0_arm64"


@pytest.mark.slow
def test_an_installed_wheel_works_from_any_folder(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", str(tmp_path), str(ROOT)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    program = f"import sys; sys.path.insert(0, {str(site)!r}); from epo_lightning import cli; cli.main()"
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()

    def epo(*words: str) -> str:
        done = subprocess.run(
            [sys.executable, "-P", "-c", program, *words], cwd=elsewhere, check=True, capture_output=True, text=True
        )
        return done.stdout

    # One wheel per platform, for every version of Python and PyTorch.
    assert "-py3-none-" in wheel.name
    program_of_kernel = [sys.executable, "-P", "-c", _SOLVE.format(site=str(site))]
    solved = subprocess.run(program_of_kernel, cwd=elsewhere, check=True, capture_output=True, text=True)
    assert solved.stdout.split() == [str(site), "True"]

    assert "title: V-LSTM + EPO" in epo("config", "experiment=rpi/v_lstm_epo")
    assert "is valid" in epo("config", "check", "experiment=rpi/v_lstm_epo_goal", "budget=reduced")
    assert "rpi_main" in epo("train", "--help")
    assert "title: VIBES + EPO" in epo("config", "experiment=us101/vibes_epo")
    assert {"page.html.j2", "page.css", "page.js"} <= {path.name for path in (site / "epo_lightning/report").iterdir()}
    shipped = [path for path in (ROOT / "epo_lightning" / "pretrained").rglob("*") if "__pycache__" not in path.parts]
    assert len(shipped) > 20
    assert all((site / path.relative_to(ROOT)).exists() for path in shipped)
    assert not list(elsewhere.iterdir())
    assert "wrote predictions/forecasts.safetensors" in epo("predict", "run=rpi/v_lstm_epo", "scenes=4", "figures=1")
