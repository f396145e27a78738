// Linear-quadratic games at one level of instructions: the games first .. last of a call.
#pragma once

#include <cstdint>

#include "game.hpp"

namespace EPO_LEVEL {

/// Writes the feedback Nash equilibria, and whether they are unique. Policies are zero from the last stage on at which one is not.
void lq_equilibria(const EpoLQGames* games, int64_t first, int64_t last);

/// Writes the derivative by the games of <controls, u>, where u are the controls that the equilibria's policies choose from x_0 = 0
/// on. It is right where all offsets are zero: there u is zero, and depends on the gains and the dynamics only through the offsets.
/// Games without a unique equilibrium have zeros.
void lq_pull_back(const EpoLQGames* games, const EpoLQGradients* gradients, int64_t first, int64_t last);

/// Writes the trajectories of unicycles that follow policies around given trajectories.
void lq_follow(const EpoPolicies* policies, int64_t first, int64_t last);

}  // namespace EPO_LEVEL
