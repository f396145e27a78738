"""Runs -> tables with the paper's values beside (``tables``), pages (``write``) and figures (``figures``, with matplotlib).

This file imports nothing: labels of settings are needed by commands that must not wait for matplotlib.
"""
