"""Implementations of damped Gauss-Newton steps, each a module with the name of its setting ``solver.backend``.

:mod:`.choice` takes one of them for a game; :mod:`.assisted` is :mod:`.compiled` with features of the user.
"""
