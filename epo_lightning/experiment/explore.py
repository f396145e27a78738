"""The page of a run's games, served on this machine."""

from __future__ import annotations

import socket
from collections.abc import Callable, Sequence

from epo_lightning.experiment import assembly
from epo_lightning.experiment.config.settings import ExploreSettings
from epo_lightning.experiment.opening import open_checkpoint, settings_of
from epo_lightning.experiment.predict import scenes_of
from epo_lightning.explore.session import Session
from epo_lightning.registry import ConfigError
from epo_lightning.run_folder import RunFolder

HOST = "127.0.0.1"
"""Address of the page: it cannot be reached from other machines."""


def open_session(settings: ExploreSettings, overrides: Sequence[str]) -> Session:
    """The games of a run, with the scenes that the settings choose.

    Args:
        settings: the run and the scenes.
        overrides: the user's overrides; settings of other data that they name do not follow the run.

    Raises:
        ConfigError: no run, checkpoint or data; or a run without a game.
    """
    run = RunFolder.open(settings.run)
    of_run = settings_of(run)
    forecaster = open_checkpoint(of_run, run.checkpoint(settings.checkpoint))
    chosen = scenes_of(run, of_run, settings, forecaster, overrides)
    return Session(forecaster, chosen.scenes, of_run.title, tuple(chosen.about["subsets"]))


def explore(settings: ExploreSettings, overrides: Sequence[str], tell: Callable[[str], None]) -> None:
    """Serve the page until it is interrupted.

    Args:
        settings: the run, the scenes and the port.
        overrides: the user's overrides; settings of other data that they name do not follow the run.
        tell: called with the page's address as soon as the page can be opened.

    Raises:
        ConfigError: missing packages, run, checkpoint or data; a run without a game; or a port that is taken.
    """
    try:
        import uvicorn

        from epo_lightning.explore.server import application
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"epo explore needs the package {error.name}: pip install 'epo_lightning[explore]'"
        ) from error
    assembly.quiet()
    session = open_session(settings, overrides)
    with socket.socket() as bound:
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            bound.bind((HOST, settings.port))
        except OSError as error:
            raise ConfigError(
                f"port {settings.port} cannot be used ({error.strerror}): choose another port=<number>"
            ) from error
        bound.listen()
        tell(f"http://{HOST}:{bound.getsockname()[1]}")
        uvicorn.Server(uvicorn.Config(application(session), log_level="warning")).run(sockets=[bound])
