// What the iteration of LQ games and its derivative share: the games of a call, W at a time, the policies around their trajectories,
// and least squares.
#pragma once

#include <algorithm>
#include <vector>

#include "feedback_stage.hpp"
#include "plan.hpp"
#include "validity.hpp"

namespace EPO_LEVEL {
namespace lq {

/// The plan for the problems first .. last for which wanted(problem) is true: a row for each, with its present agents.
template <class Wanted>
Plan plan_of(const EpoGame& game, int64_t first, int64_t last, const Wanted& wanted) {
    Plan plan(game.N, false);
    for (int64_t problem = first; problem < last; ++problem) {
        if (!wanted(problem)) continue;
        const uint8_t* present = game.present + problem / game.M * game.N;
        auto& rows = plan.rows({int(game.N - std::count(present, present + game.N, 0)), 0});
        rows.push_back(int32_t(problem));
        for (int64_t i = 0; i < game.N; ++i)
            if (present[i]) rows.push_back(int32_t(i));
    }
    return plan;
}

/// Calls call(games, size, lanes in use) for every W problems of a plan. The number of agents is known at compile time for two of
/// them.
template <class Call>
void for_each_game(const EpoGame& game, Arena<double>& arena, const Plan& plan, const double* controls, const Call& call) {
    for (int kind = 1; kind < plan.kinds(); ++kind) {
        const int agents = plan.size(kind).agents();
        for (int64_t start = 0; start < plan.count(kind); start += W) {
            const int filled = int(std::min<int64_t>(W, plan.count(kind) - start));
            arena.clear();
            Game g(game, arena, agents, agents, plan.rows(kind).data() + start * (agents + 1), filled, controls);
            g.load_parameters();
            if (game.own[LANE])
                g.template find_nearest<true>(Nearest<double>::at(arena.take(Nearest<double>::size(agents, g.K)), agents, g.K));
            if (agents == 2)
                call(g, Sizes<2>(agents), filled);
            else
                call(g, Sizes<0>(agents), filled);
        }
    }
}

INLINE V dot(const V* a, const V* b, int length) {
    V sum{};
    for (int e = 0; e < length; ++e) sum += a[e] * b[e];
    return sum;
}

/// Subtracts `factor` times a vector from another one.
INLINE void subtract(V* from, V factor, const V* vector, int length) {
    for (int e = 0; e < length; ++e) from[e] -= factor * vector[e];
}

/// Writes the x that minimises |columns x - wanted|^2 to `shares`, by Gram-Schmidt. A column that depends on those before it, but for a
/// part of `dependent` of its norm, has a share of zero. `columns` and `wanted` are overwritten.
inline void least_squares(
    Arena<double>& arena, double dependent, const std::vector<V*>& columns, V* wanted, int length, V* shares) {
    const int count = int(columns.size());
    V *R = arena.take(count * count), *inverse = arena.take(count);
    for (int c = 0; c < count; ++c) {
        V* const column = columns[c];
        const V whole = dot(column, column, length);
        for (int d = 0; d < c; ++d) {
            R[d * count + c] = dot(columns[d], column, length);
            subtract(column, R[d * count + c], columns[d], length);
        }
        const V rest = dot(column, column, length);
        const M independent = rest > dependent * dependent * whole;
        inverse[c] = independent ? 1.0 / root<double>(rest) : V{};
        for (int e = 0; e < length; ++e) column[e] = independent ? column[e] * inverse[c] : V{};
        shares[c] = dot(column, wanted, length);
        subtract(wanted, shares[c], column, length);
    }
    for (int c = count - 1; c >= 0; --c) {
        for (int d = c + 1; d < count; ++d) shares[c] -= R[c * count + d] * shares[d];
        shares[c] *= inverse[c];
    }
}

/// The backward recursion at the trajectories of W games: writes the policies [K, m, n + 1], and returns the lanes whose LQ game has a
/// unique equilibrium. `values` [K, N, n, n + 1], unless it is null, gets the costs-to-go of the states 1 .. K.
template <int N>
NOINLINE M find_policies(const Game& g, const Sizes<N>& size, double rho, V* policies, V* values) {
    const int all = size.agents() * size.states() * size.width();
    Stage<N> stage(g.arena, size);
    const Work work(g.arena, size);
    V* value = g.arena.take(all);
    clear(value, all);
    M unique = V{} == V{};
    for (int k = g.K - 1; k >= 0; --k) {
        V* const policy = policies + k * size.controls() * size.width();
        expand(g, size, rho, k, stage);
        add_costs(size, stage, value);
        if (values) std::copy(value, value + all, values + std::size_t(k) * all);
        find_policy(size, stage, rho, value, work, unique, policy);
        step_back(size, stage, rho, policy, work, value);
    }
    return unique;
}

}  // namespace lq
}  // namespace EPO_LEVEL
