"""Residuals of an energy as one tensor, and game parameters with changes."""

from __future__ import annotations

import dataclasses

import torch


def stacked(energy, scene, parameters, controls):
    return torch.cat([r.flatten(2) for r in energy.residuals(scene, parameters, controls).values()], -1)


def replaced(parameters, **changes):
    return dataclasses.replace(parameters, **changes)
