"""Benchmarks of the layer, a training step, dashboards and extraction: see docs/benchmarks.md."""
