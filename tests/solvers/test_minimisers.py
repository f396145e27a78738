"""The suite of minimisers, for all built-in ones."""

from __future__ import annotations

from suites import SolverSuite

from epo_lightning.registry import parts


class TestLevenbergMarquardt(SolverSuite):
    config = {"name": "levenberg_marquardt", "steps": 2, "step_size": 0.3, "damping": 10.0, "backend": "pytorch"}
    converged = {"steps": 40, "step_size": 1.0, "damping": 1e-3, "adaptive": True}


class TestCompiledLevenbergMarquardt(TestLevenbergMarquardt):
    config = {**TestLevenbergMarquardt.config, "backend": "auto"}


class TestBothSides(SolverSuite):
    config = {"name": "both_sides"}


class TestFeedback(SolverSuite):
    """Agents that react to each other do not minimise the energy (`feedback/test_feedback.py`)."""

    config = {"name": "feedback"}
    test_a_solution_has_less_energy_than_its_start = None
    test_the_gradient_vanishes_at_converged_solutions = None


class TestFeedbackInPyTorch(TestFeedback):
    config = {"name": "feedback", "backend": "pytorch"}


class TestBestResponseAtOnce(SolverSuite):
    config = {"name": "best_response", "order": "at_once"}
    converged = {"rounds": 400, "tolerance": 0.0}


class TestBestResponseInTurn(SolverSuite):
    config = {"name": "best_response"}
    converged = {"rounds": 200, "tolerance": 0.0}
    test_solutions_are_equivariant_to_the_order_of_agents = None  # the order of agents is that of their turns


class TestAugmentedLagrangian(SolverSuite):
    """At its solutions the gradient of the Lagrangian vanishes, and not that of the energy, which may rise where a
    constraint is met (`gauss_newton/test_augmented_lagrangian.py`)."""

    config = {"name": "augmented_lagrangian", "rounds": 12}
    test_a_solution_has_less_energy_than_its_start = None
    test_the_gradient_vanishes_at_converged_solutions = None


class TestGradientDescent(SolverSuite):
    config = {"name": "gradient_descent", "steps": 4, "step_size": 0.05}
    converged = {"steps": 200}
    remaining = 0.1


class TestLBFGS(SolverSuite):
    config = {"name": "lbfgs"}
    tolerance = 1e-5


class TestNewton(SolverSuite):
    config = {"name": "newton"}
    tolerance = 1e-6


class TestLangevin(SolverSuite):
    config = {"name": "langevin", "steps": 4}


class TestEnumeration(SolverSuite):
    config = {"name": "enumeration", "candidates": 4}


class TestSumProduct(SolverSuite):
    config = {"name": "sum_product", "candidates": 4}


def test_every_built_in_minimiser_has_its_suite():
    assert {suite.config["name"] for suite in SolverSuite.__subclasses__()} >= set(parts("solver"))
