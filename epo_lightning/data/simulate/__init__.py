"""Simulated motorway traffic as recordings in exiD's format: see ``docs/highway_sim.md``."""

from epo_lightning.data.simulate.generate import config, make_recordings
from epo_lightning.data.simulate.layout import LAYOUTS

__all__ = ["LAYOUTS", "config", "make_recordings"]
