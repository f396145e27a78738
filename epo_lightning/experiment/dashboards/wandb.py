"""Weights & Biases: online where it can be reached, else offline, to be sent later with ``wandb sync``."""

from __future__ import annotations

import netrc
import os
import socket
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

from epo_lightning.experiment.dashboards.base import ARTIFACTS, Dashboard, Ending, Facts, Row
from epo_lightning.experiment.settings import WandbSettings

QUIET = {
    "console": "off",  # what is printed belongs to the terminal
    "silent": True,
    "disable_git": True,  # run.json has the commit
    "disable_code": True,
    "save_code": False,
    "x_save_requirements": False,  # run.json has the versions that matter
    "init_timeout": 20.0,
    "finish_timeout_raises": True,
}
"""What W&B would do by itself and what costs time at every start, or prints into other runs' lines."""


class WandB(Dashboard):
    """See the module.

    Its step is the optimisation step. A continued run tells all of its rows again: online, those that W&B has are left
    out; offline, each process leaves a folder of the same run, each one whole up to its end.
    """

    label = "W&B"

    def __init__(self, facts: Facts, settings: WandbSettings) -> None:
        super().__init__(facts)
        self._settings = settings

    def open(self) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")  # its service process reads nothing else
        wanted: str = self._settings.mode
        if wanted == "auto":
            wanted = os.environ.get("WANDB_MODE", "auto")
        if wanted not in ("auto", "online"):
            self._begin(wanted)
        elif not has_key() or not (wanted == "online" or answers()):
            self._offline("no key" if not has_key() else "the server does not answer")
        else:
            try:
                self._begin("online")
            except Exception as error:
                self._offline(" ".join(str(error).split())[:200])

    def _offline(self, why: str) -> None:
        self._begin("offline")
        folders = self.facts.folder / "logs" / "wandb" / f"offline-run-*-{self.facts.id}"
        print(f"W&B: offline ({why}); send it later: wandb sync {folders}")

    def _begin(self, mode: str) -> None:
        import wandb

        self._run: Any = wandb.init(
            project=self._settings.project,
            entity=self._settings.entity,
            id=self.facts.id,
            resume="allow",
            name=self.facts.name,
            group=self.facts.group or self.facts.config.get("experiment") or None,
            job_type="train",
            tags=list(self._settings.tags),
            config={**self.facts.config, **self.facts.tags},
            dir=(self.facts.folder / "logs").resolve(),  # W&B's service keeps the working folder of its first run
            reinit="create_new",  # several runs of one process are several runs
            settings=wandb.Settings(mode=mode, finish_timeout=0.8 * self._settings.patience, **QUIET),  # type: ignore[arg-type]
        )

    def log(self, rows: Sequence[Row]) -> None:
        known = self._run.step
        for step, metrics in rows:
            if step >= known:
                self._run.log(dict(metrics), step=step)

    def close(self, ending: Ending) -> None:
        import wandb

        pictures = ending.pictures[: self._settings.pictures]
        if pictures:
            self._run.log({path.stem: wandb.Image(str(path)) for path in pictures})
        self._run.summary.update(dict(ending.summary))
        if self._settings.artifacts and not ending.failed:
            artifact = wandb.Artifact(f"run-{self.facts.id}", "model")
            for name in ARTIFACTS:
                artifact.add_file(str((self.facts.folder / name).resolve()), policy="immutable")  # no copy of its own
            self._run.log_artifact(artifact)
        self._run.finish(exit_code=int(ending.failed))


def server() -> str:
    """Where W&B is, from the environment or what ``wandb login --host`` has noted."""
    if "WANDB_BASE_URL" in os.environ:
        return os.environ["WANDB_BASE_URL"]
    import wandb

    return str(wandb.setup().settings.base_url)


def has_key() -> bool:
    """Whether a key lies in the environment, or where ``wandb login`` puts it."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    try:
        return netrc.netrc(os.environ.get("NETRC")).authenticators(urlsplit(server()).hostname or "") is not None
    except (OSError, netrc.NetrcParseError):
        return False


def answers(patience: float = 2.0) -> bool:
    """Whether W&B can be reached. With a key but no network its own start takes two minutes before it gives up."""
    target = urlsplit(server())
    proxy = getproxies().get(target.scheme)
    if proxy and not proxy_bypass(target.hostname or ""):
        target = urlsplit(proxy if "//" in proxy else f"//{proxy}")
    try:
        port = target.port or (443 if target.scheme == "https" else 80)
        socket.create_connection((target.hostname or "", port), timeout=patience).close()
    except OSError:
        return False
    return True
