"""A page on which inferred games are changed by hand and solved anew (``epo explore``).

:mod:`~epo_lightning.explore.edit` describes the changes of one game, :mod:`~epo_lightning.explore.session` applies them,
solves the game and reports it as plain values, and :mod:`~epo_lightning.explore.server` offers both to the page.
"""
