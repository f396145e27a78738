"""The data module ``highway_sim``: recordings are simulated once and then extracted like any others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from epo_lightning.data import cache, simulate
from epo_lightning.data.recorded.parts import Launch
from epo_lightning.data.recorded.recordings import RecordedData
from epo_lightning.data.recorded.tracks import Recording, RecordingSource
from epo_lightning.registry import ConfigError, register

TRAFFIC = {"highway_sim": "free", "highway_sim_dense": "dense"}
"""Style of the traffic of every simulated data set in ``conf/data``."""


@register("data", "highway_sim")
class SimulatedHighway(RecordedData):
    """Scenes from simulated traffic on motorway ramps. The simulation writes recordings in exiD's format.

    Args:
        recordings: number of recordings per layout.
        minutes: duration of each recording.
        layouts: ids of the layouts; null for all.
        traffic: ``free`` or ``dense``: more vehicles, shorter headways, and drivers that brake more often.
        dataset, windows, test, val_share, val_by, frame, scale, root, batch_size, share: as in
            :class:`~epo_lightning.data.recorded.recordings.RecordedData`.
        seed: seed of the traffic and of the splits, and of the order of batches unless a run sets its own.
    """

    def __init__(
        self,
        windows: Mapping[str, Any],
        recordings: int = 3,
        minutes: float = 9.0,
        layouts: Sequence[int] | None = None,
        traffic: str = "free",
        dataset: str = "highway_sim",
        test: Sequence[str] | None = ("0",),
        val_share: float = 0.18,
        val_by: str = "recording",
        frame: str = "aligned",
        scale: float = 20.0,
        root: str | None = None,
        seed: int = 0,
        batch_size: int = 32,
        share: float = 1.0,
    ) -> None:
        self.traffic = traffic
        self.simulation = simulate.config(seed, recordings, minutes, layouts, traffic)
        home = Path(root).expanduser() if root else cache.default_root()
        super().__init__(
            dataset=dataset,
            format="exid",
            folder=str(home / f"{dataset}-recordings-{cache.digest(self.simulation)[:12]}"),
            windows=windows,
            test=test,
            val_share=val_share,
            val_by=val_by,
            frame=frame,
            scale=scale,
            root=root,
            seed=seed,
            batch_size=batch_size,
            share=share,
        )

    def sources(self) -> list[RecordingSource]:
        """The recordings that the simulation makes, whether or not they exist already."""
        layouts = [str(layout) for layout in self.simulation["layouts"] for _ in range(self.simulation["recordings"])]
        return [RecordingSource(f"{number:02d}", layout, (), self._not_yet) for number, layout in enumerate(layouts)]

    @cached_property
    def config(self) -> dict[str, Any]:
        """Configuration of the data set: all values that its files depend on. The recordings need not exist."""
        sources = self.sources()
        return self._config_of(sources, self.identity(sources))

    @property
    def own_words(self) -> list[str]:
        """Overrides that choose this data set."""
        defaults = {"recordings": 3, "minutes": 9.0, "layouts": [layout.id for layout in simulate.LAYOUTS], "seed": 0}
        words = [f"data={self.dataset_name}"]
        for name, value in defaults.items():
            if self.simulation[name] != value:
                words.append(f"data.{name}={self.simulation[name]}".replace(" ", ""))
        if self.traffic != TRAFFIC.get(self.dataset_name, "free"):
            words.append(f"++data.traffic={self.traffic}")  # whether or not its file has this setting
        if self.root != cache.default_root():
            words.append(f"data.root={self.root}")
        return words

    def recordings(self) -> list[RecordingSource]:
        """The simulated recordings, listed by the reader of exiD's format."""
        return super().sources()

    def _not_yet(self) -> Recording:
        raise ConfigError(f"this recording is not simulated yet: {self.command}")

    def identity(self, sources: Sequence[RecordingSource]) -> Any:
        """Configuration of the simulation: the same configuration makes the same recordings."""
        return self.simulation

    def generate(
        self, workers: int | None = None, progress: bool = True, strict: bool = True, launch: Launch | None = None
    ) -> Path:
        """Simulate the recordings and extract the scenes, unless that was done before, and return the data set's folder.

        A simulated recording that cannot be read is always an error, whatever ``strict`` is.
        """
        if not self.folder.exists():
            simulate.make_recordings(self.folder_of_recordings, self.simulation, workers, progress)
        return super().generate(workers, progress, strict=True, launch=launch)
