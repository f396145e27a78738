"""Data sets: sources of scenes, their cache and their data modules."""
