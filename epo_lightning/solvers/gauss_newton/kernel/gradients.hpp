// Gradients of W games by their parameters, and their way into the arrays of a call.
#pragma once

#include <algorithm>
#include <cstdint>

#include "group.hpp"

namespace EPO_LEVEL {

/// Gradients of W games of n agents by their parameters, zero at first.
template <class T>
struct ParameterGradients {
    Vec<T>*own, *pair, *margin;               // [OWN_COUNT, n], [PAIR_COUNT, pairs] twice
    Vec<T>*goal_x, *goal_y, *goal_heading;    // [n]
    Vec<T>*reference_turn, *reference_thrust;  // [n, K], only for features of reference controls

    ParameterGradients(Arena<T>& arena, int n, int K, int pairs) {
        const auto zeros = [&](int count) {
            Vec<T>* const values = arena.take(count);
            std::fill(values, values + count, Vec<T>{});
            return values;
        };
        own = zeros(OWN_COUNT * n);
        pair = zeros(PAIR_COUNT * pairs);
        margin = zeros(PAIR_COUNT * pairs);
        goal_x = zeros(n);
        goal_y = zeros(n);
        goal_heading = zeros(n);
        reference_turn = zeros(n * K);
        reference_thrust = zeros(n * K);
    }
};

/// Adds the gradients of the games in the lanes whose bit is set in `lanes` to the results of the call.
template <class T>
void add_gradients(const Games<T>& games, const ParameterGradients<T>& by, uint32_t lanes, const EpoGradients& gradients) {
    const EpoGame& game = games.game;
    const int n = games.n;
    const int64_t P = game.N * (game.N - 1) / 2;
    const bool known = knows_pairs(game);
    for (int lane = 0; lane < Lanes<T>::W; ++lane) {
        if (!(lanes >> lane & 1)) continue;
        int pair = 0;
        for (int i = 0; i < n; ++i) {
            const int64_t row = games.row_of(i, lane);
            for (int f = 0; f < OWN_COUNT; ++f)
                if (game.own[f]) static_cast<T*>(gradients.own[f])[row] += by.own[f * n + i][lane];
            if (game.own[GOAL]) {
                static_cast<T*>(gradients.goals)[2 * row] += by.goal_x[i][lane];
                static_cast<T*>(gradients.goals)[2 * row + 1] += by.goal_y[i][lane];
            }
            if (game.own[HEADING]) static_cast<T*>(gradients.goal_headings)[row] += by.goal_heading[i][lane];
            for (int64_t k = 0; gradients.reference_controls && k < game.K; ++k) {
                T* const by_step = static_cast<T*>(gradients.reference_controls) + 2 * (row * game.K + k);
                by_step[ACCELERATION] += by.reference_thrust[i * game.K + k][lane];
                by_step[TURN_RATE] += by.reference_turn[i * game.K + k][lane];
            }
            for (int j = i + 1; known && j < n; ++j, ++pair) {
                const int64_t a = games.agent[i * Lanes<T>::W + lane], c = games.agent[j * Lanes<T>::W + lane];
                const int64_t entry = games.problem[lane] * P + games.pair_of(a, c);
                for (int f = 0; f < PAIR_COUNT; ++f) {
                    if (game.pair[f]) static_cast<T*>(gradients.pair[f])[entry] += by.pair[f * games.pairs + pair][lane];
                    if (gradients.margins[f])
                        static_cast<T*>(gradients.margins[f])[entry] += by.margin[f * games.pairs + pair][lane];
                }
            }
        }
    }
}

}  // namespace EPO_LEVEL
