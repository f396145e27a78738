"""What the layer costs, measured: ``python -m benchmarks.epo_layer`` and ``python -m benchmarks.training_step``."""
