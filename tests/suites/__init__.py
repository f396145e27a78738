"""Test suites for each kind of part: subclass the suite of the kind, name the part, and inherit its tests."""

from .backbone import BackboneSuite
from .dynamics import DynamicsSuite
from .energy import EnergySuite, FeatureSuite
from .forecaster import ForecasterSuite, HighwaySuite
from .models import IMITATION, LOSS_WEIGHTS, OWN, highway_model, model, untrained
from .objective import ObjectiveSuite
from .solver import SolverSuite

__all__ = [
    "IMITATION",
    "LOSS_WEIGHTS",
    "OWN",
    "BackboneSuite",
    "DynamicsSuite",
    "EnergySuite",
    "FeatureSuite",
    "ForecasterSuite",
    "HighwaySuite",
    "ObjectiveSuite",
    "SolverSuite",
    "highway_model",
    "model",
    "untrained",
]
