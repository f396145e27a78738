"""Fused kernels in NVIDIA Warp: one launch takes all steps of all games, and another one computes their adjoint.

Every module has a function that makes its part for one type of numbers and one number of agents. A block of threads solves a
game (`games`): the `trajectories`, then backwards in time the costs of a few steps (`residuals`, `pairs`, `pair_expansion`,
`expansion`) at their `places`, and the recursion over them (`recursion`), with their sums (`totals`); for the adjoint the
way back (`trajectories`, `pair_adjoint`, `position_adjoint`, `adjoint`, `products`). `layout` says which arrays are in
shared memory. Warp compiles the same source for CPUs, where a game has one thread. See
:mod:`epo_lightning.solvers.gauss_newton.backends.warp` for the backend.
"""
