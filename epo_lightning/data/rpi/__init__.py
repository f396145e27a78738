"""The robot-pedestrian interaction: a two-player game, its equilibria, and the data set made of them."""
