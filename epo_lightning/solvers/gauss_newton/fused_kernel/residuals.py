"""Single residuals and their derivatives: the excess over bounds, the steering angle, and the energy of a residual."""

from types import SimpleNamespace
from typing import Any, no_type_check

import warp as wp

from epo_lightning.game.features import SLOWEST_STEERING


@no_type_check
def make(T: Any, games: SimpleNamespace) -> SimpleNamespace:
    """The functions for numbers of type ``T``."""
    Game = games.Game

    @wp.func
    def excess(g: Game, signal: int, value: T):
        """How far a signal is outside of its bounds; zero inside."""
        low = g.bounds[2 * signal]
        high = g.bounds[2 * signal + 1]
        return wp.max(value - high, T(0.0)) + wp.max(low - value, T(0.0))

    @wp.func
    def excess_slope(g: Game, signal: int, value: T):
        """The derivative of the excess by the signal: 1 above, -1 below, 0 between the bounds."""
        low = g.bounds[2 * signal]
        high = g.bounds[2 * signal + 1]
        return wp.where(value > high, T(1.0), T(0.0)) - wp.where(value < low, T(1.0), T(0.0))

    @wp.func
    def add_residual(w: T, value: T, slope: T, energy: T, force: T, stiffness: T):
        """Energy, first and second derivative with those of another residual of the same signal."""
        square = w * w
        return (
            energy + T(0.5) * square * value * value,
            force + square * slope * value,
            stiffness + square * slope * slope,
        )

    @wp.func
    def steering(wheelbase: T, turn: T, speed: T):
        """The angle atan(q omega), q = wheelbase / max(v, slowest), its two first and three second derivatives by turn rate
        and speed."""
        moving = speed > T(SLOWEST_STEERING)
        inverse = T(1.0) / wp.where(moving, speed, T(SLOWEST_STEERING))
        q = wheelbase * inverse
        t = q * turn
        d = T(1.0) / (T(1.0) + t * t)
        turn_turn = T(-2.0) * q * q * t * d * d
        by_speed = wp.where(moving, -t * d * inverse, T(0.0))
        turn_speed = wp.where(moving, q * d * inverse * (T(2.0) * t * t * d - T(1.0)), T(0.0))
        speed_speed = wp.where(moving, T(2.0) * t * d * d * inverse * inverse, T(0.0))
        return wp.atan(t), q * d, by_speed, turn_turn, turn_speed, speed_speed

    return SimpleNamespace(
        excess=excess,
        excess_slope=excess_slope,
        add_residual=add_residual,
        steering=steering,
    )
