"""Fused kernels in NVIDIA Warp: a game per warp of 32 threads, all steps in one launch, and their adjoint in another one.

Every module has a function that makes its part for one type of numbers. Warp compiles the same source for CPUs, where a
game has one thread. See :mod:`epo_lightning.solvers.gauss_newton.fused` for the backend.
"""
