"""Minimisers that ask an energy for no more than its value: Newton, quasi-Newton, gradient descent, sampling."""
