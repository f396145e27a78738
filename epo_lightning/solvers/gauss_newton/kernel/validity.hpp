// Problems that cannot be solved because of their inputs.
#pragma once

#include <cstdint>

#include "group.hpp"

namespace EPO_LEVEL {

template <class T>
INLINE bool finite(T value) {
    return value - value == 0;
}

/// Whether a length or width is finite and not negative.
template <class T>
INLINE bool sound(T size) {
    return size >= 0 && finite(size);
}

/// Whether the reference lines of a problem exist and its inputs are finite. It checks the inputs whose NaN may not show in the
/// result, such as the weight of a pair that never touches, or points of a line that are never the nearest.
template <class T>
bool valid(const EpoGame& game, int64_t problem) {
    const bool coupled = knows_pairs(game);
    const int64_t b = problem / game.M, m = problem % game.M;
    const uint8_t* present = game.present + b * game.N;
    int64_t pair = 0;
    for (int64_t i = 0; i < game.N; ++i) {
        const int64_t row = b * game.N + i;
        if (present[i]) {
            const T* start = static_cast<const T*>(game.initial) + b * game.initial_b + i * game.initial_n;
            for (int e = 0; e < 4; ++e)
                if (!finite(start[e])) return false;
            if ((coupled || game.own[STEER]) && !sound(static_cast<const T*>(game.size)[2 * row])) return false;
            if (has_state_pairs(game) && !sound(static_cast<const T*>(game.size)[2 * row + 1])) return false;
            if (game.reference) {
                const int64_t line = game.reference[problem * game.N + i];
                if (line < 0 || line >= game.lines) return false;
                const T* point = static_cast<const T*>(game.references) + (row * game.lines + line) * game.points * 2;
                bool all = true;
                for (int64_t e = 0; e < 2 * game.points; ++e) all &= finite(point[e]);
                if (!all) return false;
            }
        }
        for (int64_t j = i + 1; coupled && j < game.N; ++j, ++pair)
            for (int f = 0; f < PAIR_COUNT; ++f) {
                if (!present[i] || !present[j] || !game.pair[f]) continue;
                if (!finite(of_pair<T>(game.pair[f], game.pair_strides[f], b, m, pair))) return false;
                if (game.margins[f] && !finite(of_pair<T>(game.margins[f], game.margin_strides[f], b, m, pair))) return false;
            }
    }
    return true;
}

}  // namespace EPO_LEVEL
