"""The game: dynamics, features of trajectories, and the energies that are made of them.

In the shapes of this folder, D is also a number of directions, L the number of steps at which pair features are evaluated,
and E a number of games. The other letters are those of :mod:`epo_lightning.scene`.
"""
