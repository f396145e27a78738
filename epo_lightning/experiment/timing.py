"""Time of one joint forecast: network and layer, one scene at a time, as in a deployment."""

from __future__ import annotations

import platform
import statistics
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from epo_lightning.experiment.config.settings import Settings
from epo_lightning.experiment.opening import open_checkpoint, open_data
from epo_lightning.files import write_json
from epo_lightning.run_folder import RunFolder

SAMPLES, WARM_UP = 100, 10
"""Number of measured scenes, as in the paper; and number of forecasts before them, which are not measured (warm-up)."""


def measure(run: RunFolder, settings: Settings, devices: int | list[int] = 1) -> dict[str, Any]:
    """Time joint forecasts of single scenes of the test split by the best checkpoint, and write the run's ``runtime.json``.

    Nothing but the forecast is timed: the scene is on its device already, and no metric is computed.

    Args:
        run: a finished run, trained or not.
        settings: settings of the run.
        devices: the device to compute on, as :func:`.gpus.placed` yields it.

    Raises:
        ConfigError: the checkpoint or the data is missing or has changed.
    """
    device = _device(settings.trainer.accelerator, devices)
    torch.set_num_threads(settings.trainer.threads)
    forecaster = open_checkpoint(settings, run.checkpoint("best")).to(device)
    data = open_data(run, settings)
    split = data.dataset("test")
    # If the split has fewer scenes than SAMPLES, some are measured more than once.
    scenes = [forecaster.as_input(split[torch.tensor([index % len(split)])]) for index in range(SAMPLES)]
    seconds = []
    with torch.no_grad():
        for number in range(-WARM_UP, SAMPLES):
            _wait(device)
            started = time.perf_counter()
            forecast = forecaster(scenes[number])
            _wait(device)
            if number >= 0:
                seconds.append(time.perf_counter() - started)
    solver = None if forecaster.solver is None else forecaster.solver.for_test()
    measured = {
        "agents": scenes[0].history.shape[1],
        "steps": getattr(solver, "steps", None),
        "modes": forecast.states.shape[1],
        "batch": 1,
        "samples": SAMPLES,
        "seconds": {
            "mean": statistics.fmean(seconds),
            "median": statistics.median(seconds),
            "p10": float(np.percentile(seconds, 10)),
            "p90": float(np.percentile(seconds, 90)),
        },
        "device": device.type,
        "machine": _machine(device),
        "threads": settings.trainer.threads,
        "data_digest": data.digest,
    }
    write_json(run.metrics_file("time"), measured)
    return measured


def _device(accelerator: str, devices: int | list[int]) -> torch.device:
    if accelerator == "cpu" or not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", devices[0] if isinstance(devices, list) else 0)


def _wait(device: torch.device) -> None:
    """Wait until a GPU has finished: its kernels run asynchronously, so the clock would stop too early."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _machine(device: torch.device) -> str:
    """The name of the processor that computes."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return _machine_of_macos() or platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def _machine_of_macos() -> str:
    """The name of the processor where `sysctl` knows it; empty elsewhere."""
    try:
        asked = ["sysctl", "-n", "machdep.cpu.brand_string"]
        return subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
