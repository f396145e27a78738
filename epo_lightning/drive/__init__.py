"""Closed-loop driving: a forecaster plans for one agent while the others react (``epo drive``).

A :class:`~epo_lightning.drive.world.World` holds a batch of episodes and moves them step by step. At every step a planner
(:mod:`~epo_lightning.drive.planners`) reads the scenes and plans the motion of the planned agent, of which the first step is
executed (:mod:`~epo_lightning.drive.episodes`). :mod:`~epo_lightning.drive.measures` scores what happened.
"""
