"""Minimisers of energies that are sums of squares: damped Gauss-Newton steps, in PyTorch and in C++.

A *problem* is the game of one scene in one mode. In the shapes of this folder, `problems` is their number B M, E the
number of pairs of agents that are evaluated (edges), L the number of steps at which they are, D the number of directions,
and C the number of sets of agents. The other letters are those of :mod:`epo_lightning.scene`.
"""
