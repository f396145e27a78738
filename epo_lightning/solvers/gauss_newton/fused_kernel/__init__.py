"""Fused kernels in NVIDIA Warp: one launch takes all steps of all games, and another one computes their adjoint.

Every module has a function that makes its part for one type of numbers and one number of agents. A block of threads solves a
game: first the costs at all times (`games`, `residuals`, `pairs`, `expansion`, `totals`), then the recursion (`recursion`),
and for the adjoint the same way back (`trajectories`, `pair_adjoint`, `adjoint`, `products`). Warp compiles the same source
for CPUs, where a game has one thread. See :mod:`epo_lightning.solvers.gauss_newton.fused` for the backend.
"""
