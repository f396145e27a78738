// Feedback equilibria of driving games at one level of instructions: the problems first .. last of a call.
#pragma once

#include <cstdint>

#include "game.hpp"

namespace EPO_LEVEL {

/// Iterates LQ games to feedback equilibria.
void feedback(const EpoGame* game, const EpoFeedback* run, int64_t first, int64_t last);

/// Adds the derivative of solutions, as fixed points of the iteration, to the gradients by the parameters.
void feedback_pull_back(const EpoGame* game, const EpoFeedback* run, const EpoGradients* gradients, int64_t first, int64_t last);

}  // namespace EPO_LEVEL
