"""Feedback equilibria of a game: agents that react to each other's deviations.

Read :mod:`.lq_game` (linear-quadratic games and their equilibria) first, then :mod:`.stages` (the LQ game around a
trajectory), :mod:`.iteration` (iterated LQ games) and :mod:`.solver` (the solver ``feedback``).
"""
