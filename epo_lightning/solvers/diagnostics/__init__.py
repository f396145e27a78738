"""Distance of joint strategies from an equilibrium of their game."""
