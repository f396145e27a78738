"""Two processes give the numbers of one, wherever they are started from, and end together."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from experiment.conftest import Epo
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from epo_lightning import cli
from epo_lightning.experiment import distributed
from epo_lightning.experiment.callbacks import RandomStates
from epo_lightning.experiment.distributed import DDP, Place
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder, read_json

ROOT = Path(__file__).parents[2]
FIXTURE = ROOT / "tests" / "fixtures" / "exid_sim"
RPI = ("data.games=6", "data.placements=1")
HIGHWAY = (f"data.folder={FIXTURE}", "data.batch_size=4")
QUIET = ("budget=smoke", "callbacks.progress=none", "trainer.limit_val_batches=1.0")
DOUBLE = "trainer.precision=64-true"
TWO = "trainer.devices=2"


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Small data of both tasks, generated as anybody would."""
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EPO_CACHE", str(folder))
        cli.main(["generate", "data=rpi", *RPI, "workers=1", "progress=false"])
        cli.main(["generate", "data=exid", *HIGHWAY, "workers=1", "progress=false"])
        yield folder


@pytest.fixture(autouse=True)
def unchanged(cache: Path) -> Iterator[None]:
    """A run on several devices leaves nothing behind in the process that led it."""
    before = dict(os.environ)
    yield
    names = ("LOCAL_RANK", "NODE_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")
    assert {name: os.environ.get(name) for name in names} == {name: before.get(name) for name in names}
    assert not dist.is_initialized()
    assert rank_zero_only.rank == 0
    assert not followers()


def followers(of: int | None = None) -> list[int]:
    """Processes that follow a leader (of this process, if no other is named), found as `ps` finds them."""
    found = []
    for process in Path("/proc").iterdir():
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
        except (OSError, ValueError, IndexError):
            continue
        if b"epo_lightning.experiment.follower" in words and parent == (of or os.getpid()):
            found.append(int(process.name))
    return found


def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.05)


def alive(process: int) -> bool:
    try:
        return (Path("/proc") / str(process) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def log(folder: str | Path) -> dict[tuple[str, str], float]:
    """Everything that a run logged, by step and name."""
    with (Path(folder) / "logs" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {(row["step"], key): float(value) for row in rows for key, value in row.items() if value and key != "step"}


def same(one: str | Path, other: str | Path, tolerance: float) -> None:
    left, right = log(one), log(other)
    assert left.keys() == right.keys()
    assert len(left) > 10
    for key, value in left.items():
        assert right[key] == pytest.approx(value, rel=tolerance, abs=tolerance, nan_ok=True), key


def steps(count: int) -> tuple[str, ...]:
    return ("trainer.max_epochs=2", f"trainer.limit_train_batches={count}")


@pytest.mark.parametrize("row", ["rpi/v_lstm_sc", "rpi/v_lstm_epo", "exid/v_lstm_epo"])
def test_two_processes_give_the_numbers_of_one(epo: Epo, row: str) -> None:
    data = RPI if row.startswith("rpi") else HIGHWAY
    words = ("train", f"experiment={row}", *QUIET, *data, DOUBLE, *steps(3))
    assert epo(*words, "run_dir=one") == 0
    assert epo(*words, "run_dir=two", TWO) == 0
    same("one", "two", 1e-10)
    one, two = (RunFolder(Path(name)).record for name in ("one", "two"))
    assert (one["identity"], one["steps"]) == (two["identity"], two["steps"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("row", "precision"),
    [
        *((row, "32-true") for row in ("rpi/v_lstm_sc", "rpi/v_lstm_epo", "exid/v_lstm_sc", "exid/hivt_m_epo")),
        *((row, "64-true") for row in ("rpi/v_lstm_epo", "exid/v_lstm", "exid/vibes_epo", "exid/hivt_m_epo")),
    ],
)
def test_two_processes_give_the_scores_of_one(epo: Epo, row: str, precision: str) -> None:
    """In single precision at the paper's learning rate: a greater one makes much of a rounding error, in one process too."""
    data = RPI if row.startswith("rpi") else HIGHWAY
    words = ("train", f"experiment={row}", *QUIET, *data, *steps(12), "optimizer.lr=5e-5", "score=test")
    for name, devices in (("one", 1), ("two", 2)):
        assert epo(*words, f"trainer.precision={precision}", f"run_dir={name}", f"trainer.devices={devices}") == 0
        assert epo("evaluate", f"run={name}", "split=val") == 0
    if precision == "64-true":
        same("one", "two", 1e-10)
    for split in ("test", "val"):
        one, two = (read_json(RunFolder(Path(name)).metrics_file(split))["metrics"] for name in ("one", "two"))
        assert two == pytest.approx(one, rel=1e-5, abs=1e-5, nan_ok=True)


def sweep(epo: Epo, *more: str) -> None:
    words = ("train", "experiment=rpi/v_lstm_sc", *QUIET, *RPI, DOUBLE, *steps(2))
    for seed in (0, 1):
        assert epo(*words, f"seed={seed}", f"run_dir=one-{seed}") == 0
    assert epo("train", "-m", *words[1:], TWO, "seed=0,1", "run_dir=two-${seed}", *more) == 0
    for seed in (0, 1):
        same(f"one-{seed}", f"two-{seed}", 1e-10)
    with pytest.raises(AssertionError):
        same("two-0", "two-1", 1e-10)


def test_the_jobs_of_a_sweep_train_one_after_the_other(epo: Epo) -> None:
    sweep(epo)


@pytest.mark.slow
def test_the_jobs_of_a_sweep_train_in_workers(epo: Epo) -> None:
    sweep(epo, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")


LONG = ("train", "experiment=rpi/v_lstm_sc", *QUIET, *RPI, DOUBLE, "optimizer.lr=5e-5")


def test_a_run_on_one_device_continues_on_two(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> None:
    words = (*LONG, "trainer.max_epochs=4")
    assert epo(*words, "run_dir=whole") == 0

    def stop(self: RandomStates, trainer: object, module: object) -> None:
        if trainer.current_epoch == 2:  # type: ignore[attr-defined]
            raise OSError("power failure")

    with monkeypatch.context() as patch:
        patch.setattr(RandomStates, "on_train_epoch_start", stop)
        assert epo(*words, "run_dir=parts") == 1
    assert epo(*words, "run_dir=parts", TWO, "existing=continue") == 0
    same("whole", "parts", 1e-10)


def test_followers_end_when_the_leader_raises(epo: Epo, monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []

    def stop(self: RandomStates, trainer: object, module: object) -> None:
        seen.extend(followers())
        raise ZeroDivisionError("a mistake")

    monkeypatch.setattr(RandomStates, "on_train_epoch_start", stop)
    with pytest.raises(ZeroDivisionError, match="a mistake"):
        epo(*LONG, "run_dir=run", TWO, "trainer.max_epochs=40")
    assert len(seen) == 1
    assert not alive(seen[0])
    assert RunFolder(Path("run")).state == "failed"


def test_the_leader_fails_when_a_follower_is_killed(epo: Epo) -> None:
    last = Path("run/checkpoints/last.ckpt").resolve()

    def kill() -> None:
        until(last.is_file)
        os.kill(followers()[0], signal.SIGKILL)

    assassin = threading.Thread(target=kill)
    assassin.start()
    with pytest.raises(RuntimeError, match="process 1 of the run's 2 was killed by signal 9"):
        epo(*LONG, "run_dir=run", TWO, "trainer.max_epochs=40")
    assassin.join()
    assert "killed by signal 9" in RunFolder(Path("run")).record["error"]


def test_the_leader_reports_the_error_of_a_follower() -> None:
    processes = DDP(Place(world=2), task='{"run": "nowhere"').processes
    with pytest.raises(RuntimeError, match=r"process 1 of the run's 2 ended with exit status 1: .*JSONDecodeError"):
        processes.launch(processes.meet)


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_followers_end_with_the_leader_and_the_run_can_continue(epo: Epo, how: signal.Signals) -> None:
    assert epo(*LONG, "run_dir=whole", "trainer.max_epochs=12") == 0
    words = [*LONG, "run_dir=parts", TWO, "trainer.max_epochs=12"]
    leader = subprocess.Popen(
        [sys.executable, "-m", "epo_lightning.cli", *words], env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    until(Path("parts/checkpoints/last.ckpt").is_file)
    (follower,) = followers(leader.pid)
    leader.send_signal(how)
    assert leader.wait(30) != 0
    until(lambda: not alive(follower), 5)
    assert not RunFolder(Path("parts")).finished, "the run ended before it could be stopped"
    assert epo("train", "resume=parts") == 0
    same("whole", "parts", 1e-10)


def test_forecasters_that_learn_nothing_use_one_process(epo: Epo) -> None:
    assert epo("train", "experiment=rpi/const_vel", *QUIET, *RPI, TWO, "run_dir=run") == 0
    assert RunFolder(Path("run")).finished


def test_a_batch_that_devices_cannot_share_is_refused_before_anything_is_made(refused: Callable[..., str]) -> None:
    message = refused("train", "experiment=rpi/v_lstm_sc", *RPI, "data.batch_size=15", TWO)
    assert "data.batch_size is 15, which trainer.devices=2 do not divide evenly" in message


def test_the_tasks_of_a_slurm_step_are_the_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    assert distributed.here(2) == Place(0, 2)
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    monkeypatch.setenv("SLURM_PROCID", "1")
    monkeypatch.setenv("SLURM_JOB_ID", "4711")
    assert distributed.here(2) == Place(1, 2, 19711)
    assert distributed.here(1) == Place(0, 1)
    with pytest.raises(ConfigError, match=r"trainer\.devices is 4, but Slurm has started 2 tasks"):
        distributed.here(4)


BATCH_NORM = """
import sys, torch, torch.distributed as dist
from epo_lightning.decoders.mlp import MLP

rank = int(sys.argv[1])
dist.init_process_group("gloo", init_method="file://" + sys.argv[2], rank=rank, world_size=3)
given = torch.load(sys.argv[3])
mlp = MLP(5, 7, 2, norm="batch").double()
mlp.load_state_dict(given["weights"])
learned = [parameter for parameter in mlp.parameters() if parameter.requires_grad]
for features, mask in given["batches"]:
    mlp.zero_grad()
    share = features[rank::3].requires_grad_()
    result = mlp(share, mask[rank::3])
    (result.square() * mask[rank::3, ..., None]).sum().backward()
    for parameter in learned:
        dist.all_reduce(parameter.grad)
torch.save({"state": mlp.state_dict(), "gradients": [p.grad for p in learned], "result": result.detach(),
            "input": share.grad}, f"{sys.argv[3]}.{rank}")
"""


def test_batch_normalisation_is_that_of_all_rows_together(tmp_path: Path) -> None:
    """Three processes with unequal numbers of present rows, one with none, against one process with all of them."""
    from epo_lightning.decoders.mlp import MLP

    reference = MLP(5, 7, 2, norm="batch").double()
    batches = []
    for _ in range(3):
        mask = torch.rand(9, 4) < 0.6
        mask[2::3] = False
        batches.append((torch.randn(9, 4, 5).double() * 100 + 1e4, mask))
    torch.save({"weights": reference.state_dict(), "batches": batches}, tmp_path / "given")
    words = [sys.executable, "-c", BATCH_NORM]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    places = [str(tmp_path / "meeting"), str(tmp_path / "given")]
    processes = [subprocess.Popen([*words, str(rank), *places], env=environment) for rank in range(3)]
    for features, mask in batches:
        reference.zero_grad()
        whole = features.requires_grad_()
        result = reference(whole, mask)
        (result.square() * mask[..., None]).sum().backward()
    assert [process.wait(60) for process in processes] == [0, 0, 0]
    assert whole.grad is not None
    for rank in range(3):
        found = torch.load(tmp_path / f"given.{rank}")
        torch.testing.assert_close(found["state"], dict(reference.state_dict()))
        learned = [parameter for parameter in reference.parameters() if parameter.requires_grad]
        for gradient, parameter in zip(found["gradients"], learned, strict=True):
            torch.testing.assert_close(gradient, parameter.grad, rtol=1e-7, atol=1e-9)
        present = batches[-1][1][rank::3]
        torch.testing.assert_close(found["result"][present], result[rank::3][present].detach())
        torch.testing.assert_close(found["input"][present], whole.grad[rank::3][present], rtol=1e-6, atol=1e-9)
