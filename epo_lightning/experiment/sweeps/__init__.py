"""Sweeps: their definition, their start, their state while they run."""
