"""How close a joint strategy is to an equilibrium of its game."""
