"""Minimisers of any differentiable energy: Newton, quasi-Newton, gradient descent, Langevin sampling."""
