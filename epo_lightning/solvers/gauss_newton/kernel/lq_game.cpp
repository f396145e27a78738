// Feedback Nash equilibria of linear-quadratic games, their derivative, and trajectories that follow policies. The games come from
// the caller, stage by stage; `feedback.cpp` has those of a driving game.

#include "lq_game.hpp"

#include <algorithm>

#include "lq_recursion.hpp"

namespace EPO_LEVEL {
namespace {

using namespace lq;

/// W games of a call. Lanes that are not in use repeat the last game, and are not written.
template <int N>
struct Block : Sizes<N> {
    const int K, filled;
    int64_t game[W];

    Block(int64_t agents, int64_t horizon, int64_t start, int64_t last)
        : Sizes<N>(int(agents)), K(int(horizon)), filled(int(std::min<int64_t>(W, last - start))) {
        for (int lane = 0; lane < W; ++lane) game[lane] = start + std::min(lane, filled - 1);
    }

    /// Row `row` of the `rows` rows that every game has in an array.
    INLINE void read(const double* from, int64_t rows, int64_t row, int length, V* to) const {
        const double* lanes[W];
        for (int lane = 0; lane < W; ++lane) lanes[lane] = from + (game[lane] * rows + row) * length;
        gather<double>(lanes, length, [&](int e, V value) { to[e] = value; });
    }
    template <class Get>
    INLINE void write(const Get& get, int64_t rows, int64_t row, int length, double* to) const {
        double* lanes[W];
        for (int lane = 0; lane < W; ++lane) lanes[lane] = lane < filled ? to + (game[lane] * rows + row) * length : nullptr;
        scatter<double>(get, length, lanes);
    }

    /// Calls call(i, rows, row) for every agent i: step k of the agent is row `row` of the `rows` rows that a game has in an array.
    template <class Call>
    INLINE void for_each_row(int k, const Call& call) const {
        const int n = this->agents();
        for (int i = 0; i < n; ++i) call(i, int64_t(n) * K, int64_t(i) * K + k);
    }
};

template <int N>
INLINE void read_dynamics(const EpoLQGames& games, const Block<N>& block, int k, Stage<N>& stage) {
    block.for_each_row(k, [&](int i, int64_t rows, int64_t row) INLINE_LAMBDA {
        block.read(games.A, rows, row, 16, stage.A + 16 * i);
        block.read(games.B, rows, row, 8, stage.B + 8 * i);
    });
}

template <int N>
INLINE void read_stage(const EpoLQGames& games, const Block<N>& block, int k, Stage<N>& stage) {
    read_dynamics(games, block, k, stage);
    M going{};
    block.for_each_row(k, [&](int i, int64_t rows, int64_t row) INLINE_LAMBDA {
        block.read(games.own_cost, rows, row, 20, stage.own_cost + 20 * i);
        block.read(games.effort, rows, row, 4, stage.effort + 4 * i);
        block.read(games.push, rows, row, 2, stage.push + 2 * i);
        for (int lane = 0; lane < W; ++lane) stage.free[i][lane] = games.free[block.game[lane] * rows + row] ? -1 : 0;
        going |= stage.free[i];
    });
    for (int p = 0; p < block.pairs(); ++p)
        block.read(games.pair_cost, int64_t(block.pairs()) * block.K, int64_t(p) * block.K + k, 72, stage.pair_cost + 72 * p);
    stage.rho = going ? splat<double>(games.rho) : V{};
}

template <int N>
NOINLINE void equilibria(const EpoLQGames& games, Arena<double>& arena, const Block<N>& block) {
    const int n = block.states(), m = block.controls(), width = block.width(), K = block.K, all = block.agents() * n * width;
    Stage<N> stage(arena, block);
    const Work work(arena, block);
    V *value = arena.take(all), *policy = arena.take(m * width);
    clear(value, all);
    M unique = V{} == V{};
    for (int k = K - 1; k >= 0; --k) {
        read_stage(games, block, k, stage);
        add_costs(block, stage, value);
        find_policy(block, stage, games.rho, value, work, unique, policy);
        block.write([&](int e) { return policy[e / n * width + e % n]; }, K, k, m * n, games.gains);
        block.write([&](int r) { return policy[r * width + n]; }, K, k, m, games.offsets);
        step_back(block, stage, games.rho, policy, work, value);
    }
    for (int lane = 0; lane < block.filled; ++lane) games.unique[block.game[lane]] = unique[lane] != 0;
}

/// Reads the policy [G | f] of step k.
template <int N>
INLINE void read_policy(const EpoLQGames& games, const Block<N>& block, int k, V* read, V* policy) {
    const int n = block.states(), m = block.controls(), width = block.width();
    block.read(games.gains, block.K, k, m * n, read);
    for (int r = 0; r < m; ++r)
        for (int b = 0; b < n; ++b) policy[r * width + b] = read[r * n + b];
    block.read(games.offsets, block.K, k, m, read);
    for (int r = 0; r < m; ++r) policy[r * width + n] = read[r];
}

template <int N>
NOINLINE void pull_back(const EpoLQGames& games, const EpoLQGradients& gradients, Arena<double>& arena, const Block<N>& block) {
    const int n = block.states(), m = block.controls(), width = block.width(), K = block.K, all = block.agents() * n * width;
    Stage<N> stage(arena, block), bar(arena, block);
    const Work work(arena, block);
    Scratch s(arena, n, m);
    V *values = arena.take(std::size_t(K) * all), *value = arena.take(all), *bars = arena.take(K * m);
    V *state_bar = arena.take(n), *before = arena.take(n);
    M unique;
    for (int lane = 0; lane < W; ++lane) unique[lane] = games.unique[block.game[lane]] ? -1 : 0;
    clear(value, all);
    clear(state_bar, n);
    for (int k = K - 1; k >= 0; --k) {
        read_stage(games, block, k, stage);
        read_policy(games, block, k, s.read, s.policy);
        add_costs(block, stage, value);
        std::copy(value, value + all, values + std::size_t(k) * all);
        step_back(block, stage, games.rho, s.policy, work, value);
        block.read(gradients.controls, K, k, m, bars + k * m);
        pull_back_controls(block, stage, s.policy, state_bar, before, bars + k * m);
    }
    clear(value, all);
    for (int k = 0; k < K; ++k) {
        read_stage(games, block, k, stage);
        read_policy(games, block, k, s.read, s.policy);
        pull_back_stage(block, stage, games.rho, values + std::size_t(k) * all, bars + k * m, value, bar, s);
        const auto write = [&](const V* from, int64_t rows, int64_t row, int length, double* to) {
            block.write([&](int e) { return unique ? from[e] : V{}; }, rows, row, length, to);
        };
        block.for_each_row(k, [&](int i, int64_t rows, int64_t row) {
            write(bar.A + 16 * i, rows, row, 16, gradients.A);
            write(bar.B + 8 * i, rows, row, 8, gradients.B);
            write(bar.own_cost + 20 * i, rows, row, 20, gradients.own_cost);
            write(bar.effort + 4 * i, rows, row, 4, gradients.effort);
            write(bar.push + 2 * i, rows, row, 2, gradients.push);
        });
        for (int p = 0; p < block.pairs(); ++p)
            write(bar.pair_cost + 72 * p, int64_t(block.pairs()) * K, int64_t(p) * K + k, 72, gradients.pair_cost);
    }
}

template <int N>
NOINLINE void follow(const EpoPolicies& policies, Arena<double>& arena, const Block<N>& block) {
    const int agents = block.agents(), n = block.states(), m = block.controls(), K = block.K;
    const int64_t rows = int64_t(agents) * K;
    V *now = arena.take(n), *given = arena.take(n), *away = arena.take(n), *gains = arena.take(m * n), *offsets = arena.take(m);
    V *controls = arena.take(m), length;
    const V dt = splat<double>(policies.dt), beta = splat<double>(policies.beta);
    block.read(policies.length, 1, 0, 1, &length);
    for (int i = 0; i < agents; ++i) block.read(policies.start, agents, i, kState, now + kState * i);
    clear(away, n);
    for (int k = 0; k < K; ++k) {
        block.read(policies.gains, K, k, m * n, gains);
        block.read(policies.offsets, K, k, m, offsets);
        for (int i = 0; i < agents; ++i) {
            const int64_t row = i * int64_t(K) + k;
            V* chosen = controls + kControl * i;
            block.read(policies.controls, rows, row, kControl, chosen);
            for (int c = 0; c < kControl; ++c) {
                V change = length * offsets[kControl * i + c];
                for (int a = 0; a < n; ++a) change += gains[(kControl * i + c) * n + a] * away[a];
                chosen[c] += change;
            }
            block.write([&](int c) { return chosen[c]; }, rows, row, kControl, policies.chosen);
        }
        for (int i = 0; i < agents; ++i) {
            const int64_t row = i * int64_t(K) + k;
            V *state = now + kState * i, sine, cosine, turned_sine, turned_cosine;
            const V heading = state[2], speed = state[3];
            const V turned = heading + dt * controls[kControl * i + 1], faster = speed + dt * controls[kControl * i];
            sincos<double>(heading, sine, cosine);
            sincos<double>(turned, turned_sine, turned_cosine);
            state[0] += dt * (beta * speed * cosine + (1.0 - beta) * faster * turned_cosine);
            state[1] += dt * (beta * speed * sine + (1.0 - beta) * faster * turned_sine);
            state[2] = turned;
            state[3] = faster;
            block.write([&](int a) { return state[a]; }, rows, row, kState, policies.visited);
            block.read(policies.states, rows, row, kState, given + kState * i);
            for (int a = 0; a < kState; ++a) away[kState * i + a] = state[a] - given[kState * i + a];
        }
    }
}

/// Calls call(arena, block) for the games first .. last, W at a time. The number of agents is known at compile time for two of them.
template <class Call>
void for_each_block(int64_t agents, int64_t horizon, int64_t first, int64_t last, const Call& call) {
    Arena<double> arena;
    for (int64_t start = first; start < last; start += W) {
        arena.clear();
        if (agents == 2)
            call(arena, Block<2>(agents, horizon, start, last));
        else
            call(arena, Block<0>(agents, horizon, start, last));
    }
}

}  // namespace

void lq_equilibria(const EpoLQGames* games, int64_t first, int64_t last) {
    for_each_block(games->N, games->K, first, last, [&](Arena<double>& arena, const auto& block) { equilibria(*games, arena, block); });
}

void lq_pull_back(const EpoLQGames* games, const EpoLQGradients* gradients, int64_t first, int64_t last) {
    for_each_block(games->N, games->K, first, last, [&](Arena<double>& arena, const auto& block) {
        pull_back(*games, *gradients, arena, block);
    });
}

void lq_follow(const EpoPolicies* policies, int64_t first, int64_t last) {
    for_each_block(policies->N, policies->K, first, last, [&](Arena<double>& arena, const auto& block) {
        follow(*policies, arena, block);
    });
}

}  // namespace EPO_LEVEL
