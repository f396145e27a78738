"""Weights & Biases: online where it can be reached, else offline, to be sent later with ``wandb sync``."""

from __future__ import annotations

import json
import netrc
import os
import ssl
import subprocess
from collections.abc import Sequence
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from epo_lightning.experiment.config.settings import WandbSettings
from epo_lightning.experiment.dashboards.base import ARTIFACTS, Dashboard, Ending, Facts, Row
from epo_lightning.registry import one_line

PATIENCE = 2.0
"""Longest wait for an answer of W&B [s]."""
STEP = "trainer/global_step"
"""The x axis of all curves. W&B's own step counts rows, which has no meaning after `wandb sync` has joined several files."""
QUIET = {
    "console": "off",  # do not upload what is printed
    "silent": True,
    "disable_git": True,  # run.json has the commit
    "disable_code": True,
    "save_code": False,
    "x_save_requirements": False,  # run.json has the versions that matter
    "x_transaction_log_flush_interval": 1.0,  # seconds whose rows are lost at most if the process is killed
    "finish_timeout_raises": True,
}
"""Features of W&B that are switched off because they cost time at every start, or print into other runs' lines."""


class WandB(Dashboard):
    """W&B dashboard. A continued run sends only the rows that neither the server nor the run's offline folders have."""

    label = "W&B"

    def __init__(self, facts: Facts, settings: WandbSettings) -> None:
        super().__init__(facts)
        self._settings = settings
        self._logs = (facts.folder / "logs").resolve()  # W&B's service keeps the working folder of its first run
        self._told = -1  # the last step that is there already
        self._last = -1

    def open(self) -> None:
        os.environ.setdefault(
            "WANDB_SILENT", "true"
        )  # W&B's service process reads only this variable, not the settings
        wanted: str = self._settings.mode
        if wanted == "auto":
            wanted = os.environ.get("WANDB_MODE", "auto")
        if wanted not in ("auto", "online"):
            self._begin(wanted)
        elif not has_key():
            self._offline("no key")
        elif wanted == "auto" and not answers():
            self._offline("the server does not answer")
        else:
            try:
                self._begin("online")
            except Exception as error:
                self._offline(one_line(error, 200))

    def _offline(self, why: str) -> None:
        self._begin("offline")
        folders = self.facts.folder / "logs" / "wandb" / f"offline-run-*-{self.facts.id}*"
        print(f"W&B: offline ({why}); send it later: wandb sync {folders}")

    def _begin(self, mode: str) -> None:
        import wandb

        told_here = self._told_here()
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
            dir=self._logs,
            reinit="create_new",  # several runs of one process are several runs
            settings=wandb.Settings(
                mode=mode,  # type: ignore[arg-type]
                init_timeout=max(self._settings.patience, 1.0),
                finish_timeout=max(0.8 * self._settings.patience, 0.1),  # 0 would be for ever
                **QUIET,  # type: ignore[arg-type]
            ),
        )
        self._run.define_metric(STEP)
        self._run.define_metric("*", step_metric=STEP)
        self._told = int(self._run.summary.get(STEP, -1)) if mode == "online" else told_here

    def _told_here(self) -> int:
        """The last step in the files that earlier processes of the run have left."""
        from wandb.util import get_core_path

        told = -1
        for file in self._logs.glob(f"wandb/*run-*-{self.facts.id}*/run-{self.facts.id}.wandb"):
            words = [get_core_path(), "leet", "inspect", "--no-observability", "--summary", "--json"]
            words += ["--run-file", str(file), str(self._logs / "wandb")]
            try:
                read = subprocess.run(words, capture_output=True, text=True, timeout=10, check=True).stdout
                told = max(told, int(json.loads(read)["summary"][STEP]))
            except (OSError, subprocess.SubprocessError, ValueError, KeyError):
                continue  # empty or unreadable: its rows are sent again, which is better than losing them
        return told

    def log(self, rows: Sequence[Row]) -> None:
        for step, metrics in rows:
            if step > self._told:
                self._run.log({**metrics, STEP: step})
                self._last = step

    def close(self, ending: Ending) -> None:
        pictures = ending.pictures[: self._settings.pictures]
        if self._last >= 0 and pictures:
            import wandb

            images = {f"forecasts/{path.stem}": wandb.Image(str(path)) for path in pictures}
            self._run.log({**images, STEP: self._last})
        self._run.summary.update(dict(ending.summary))
        if self._last >= 0 and self._settings.artifacts and not ending.failed:
            self._artifact()
        self._run.finish(exit_code=int(ending.failed))

    def _artifact(self) -> None:
        import wandb

        artifact = wandb.Artifact(f"run-{self.facts.id}", "model")
        for name in ARTIFACTS:  # immutable: W&B makes no copy of its own
            artifact.add_file(str((self.facts.folder / name).resolve()), policy="immutable")
        self._run.log_artifact(artifact)


def server() -> str:
    """Address of W&B, from the environment or what ``wandb login --host`` has noted."""
    if "WANDB_BASE_URL" in os.environ:
        return os.environ["WANDB_BASE_URL"]
    import wandb

    return str(wandb.setup().settings.base_url)


def has_key() -> bool:
    """Whether there is an API key or a token in the environment, or a key in the file that ``wandb login`` writes.

    W&B writes the server's address with its port there.
    """
    if os.environ.get("WANDB_API_KEY") or os.environ.get("WANDB_IDENTITY_TOKEN_FILE"):
        return True
    try:
        return netrc.netrc(os.environ.get("NETRC")).authenticators(urlsplit(server()).netloc) is not None
    except (OSError, netrc.NetrcParseError):
        return False


def answers() -> bool:
    """Whether W&B can be reached. With a key but no network its own start takes two minutes before it gives up."""
    try:
        urlopen(Request(server(), method="HEAD"), timeout=PATIENCE).close()
    except HTTPError:
        return True
    except URLError as error:
        return isinstance(error.reason, ssl.SSLError)  # its certificate is W&B's business
    except (OSError, ValueError):
        return False
    return True
