"""Where scenes come from. Importing this package registers the data parts."""

from epo_lightning.data.rpi import scenes as _rpi  # noqa: F401
