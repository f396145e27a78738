"""Minimisers of energies that are sums of squares: damped Gauss-Newton steps, in PyTorch and in C++."""
