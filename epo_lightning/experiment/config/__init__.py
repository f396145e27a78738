"""Configurations: how Hydra composes them, and the checked settings that code reads."""
