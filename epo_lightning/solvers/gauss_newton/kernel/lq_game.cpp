// Feedback Nash equilibria of linear-quadratic games by the coupled Riccati recursion (Basar and Olsder, Dynamic Noncooperative
// Game Theory, Corollary 6.1), their derivative, and trajectories that follow policies. W games are solved side by side.
//
// The games and the letters are those of `solvers/feedback/lq_game.py`: n = 4N joint states, m = 2N joint controls. Matrices with
// one more column hold a matrix and a vector: [V | v] the cost-to-go of an agent, [G | f] a policy, [F | B f] with F = A + B G the
// dynamics under it.

#include "lq_game.hpp"

#include <algorithm>
#include <cmath>

#include "buffers.hpp"
#include "lanes.hpp"
#include "riccati.hpp"

namespace EPO_LEVEL {
namespace {

using V = Vec<double>;
using M = Mask<double>;

constexpr int W = Lanes<double>::W;
constexpr int kState = 4, kControl = 2;
constexpr double kSingular = 1e-12;  // the least size of a pivot

/// A matrix to read: entry (r, c) is at[r * row + c * column].
struct View {
    const V* at;
    int row, column;
    View transposed() const { return {at, column, row}; }
};

template <int R, int S>
INLINE void add_tile(V* to, int stride, View a, View b, int depth) {
    V sum[R][S];
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) sum[i][j] = to[i * stride + j];
    for (int k = 0; k < depth; ++k)
        for (int i = 0; i < R; ++i)
            for (int j = 0; j < S; ++j) sum[i][j] += a.at[i * a.row + k * a.column] * b.at[k * b.row + j * b.column];
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) to[i * stride + j] = sum[i][j];
}

/// Adds a b to the matrix `to`, whose rows are `stride` apart and even in number.
INLINE void add_product(V* to, int stride, int rows, int columns, View a, View b, int depth) {
    for (int i = 0; i < rows; i += 2) {
        const View left{a.at + i * a.row, a.row, a.column};
        int j = 0;
        for (; j + 4 <= columns; j += 4) add_tile<2, 4>(to + i * stride + j, stride, left, {b.at + j * b.column, b.row, b.column}, depth);
        for (int rest = columns % 4; rest > 0; --rest, ++j)
            add_tile<2, 1>(to + i * stride + j, stride, left, {b.at + j * b.column, b.row, b.column}, depth);
    }
}

INLINE void clear(V* values, int count) {
    for (int e = 0; e < count; ++e) values[e] = V{};
}

/// W games of a call. Lanes that are not in use repeat the last game, and are not written.
template <int N>
struct Block {
    const Count<N> count;
    const int K, filled;
    int64_t game[W];

    Block(int64_t agents, int64_t horizon, int64_t start, int64_t last)
        : count{int(agents)}, K(int(horizon)), filled(int(std::min<int64_t>(W, last - start))) {
        for (int lane = 0; lane < W; ++lane) game[lane] = start + std::min(lane, filled - 1);
    }
    int agents() const { return count.agents(); }
    int pairs() const { return agents() * (agents() - 1) / 2; }
    int states() const { return kState * agents(); }
    int controls() const { return kControl * agents(); }
    int width() const { return states() + 1; }

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
};

/// One time step of W games, or the derivative of a loss by it.
template <int N>
struct Stage {
    V *A, *B, *own_cost, *pair_cost, *effort, *push;  // [N, 4, 4], [N, 4, 2], [N, 4, 5], [P, 8, 9], [N, 2, 2], [N, 2]
    M* free;                                          // [N]
    V rho;                                            // zero after the end of a game

    Stage(Arena<double>& arena, const Block<N>& block)
        : A(arena.take(16 * block.agents())), B(arena.take(8 * block.agents())), own_cost(arena.take(20 * block.agents())),
          pair_cost(arena.take(72 * block.pairs())), effort(arena.take(4 * block.agents())), push(arena.take(2 * block.agents())),
          free(reinterpret_cast<M*>(arena.take(block.agents()))), rho{} {}

    /// Calls call(i, rows, row) for every agent i: step k of the agent is row `row` of the `rows` rows that a game has in an array.
    template <class Call>
    static INLINE void for_each_row(const Block<N>& block, int k, const Call& call) {
        const int n = block.agents(), K = block.K;
        for (int i = 0; i < n; ++i) call(i, int64_t(n) * K, int64_t(i) * K + k);
    }

    INLINE void read_dynamics(const EpoLQGames& games, const Block<N>& block, int k) {
        for_each_row(block, k, [&](int i, int64_t rows, int64_t row) INLINE_LAMBDA {
            block.read(games.A, rows, row, 16, A + 16 * i);
            block.read(games.B, rows, row, 8, B + 8 * i);
        });
    }

    INLINE void read(const EpoLQGames& games, const Block<N>& block, int k) {
        read_dynamics(games, block, k);
        M going{};
        for_each_row(block, k, [&](int i, int64_t rows, int64_t row) INLINE_LAMBDA {
            block.read(games.own_cost, rows, row, 20, own_cost + 20 * i);
            block.read(games.effort, rows, row, 4, effort + 4 * i);
            block.read(games.push, rows, row, 2, push + 2 * i);
            for (int lane = 0; lane < W; ++lane) free[i][lane] = games.free[block.game[lane] * rows + row] ? -1 : 0;
            going |= free[i];
        });
        for (int p = 0; p < block.pairs(); ++p)
            block.read(games.pair_cost, int64_t(block.pairs()) * block.K, int64_t(p) * block.K + k, 72, pair_cost + 72 * p);
        rho = going ? splat<double>(games.rho) : V{};
    }
};

/// The entry of the joint state that is entry `a` of the states of the pair (i, j).
INLINE int place(int i, int j, int a) { return a < kState ? kState * i + a : kState * (j - 1) + a; }

/// Adds the costs of a stage to the costs-to-go [N, n, n + 1].
template <int N>
INLINE void add_costs(const Block<N>& block, const Stage<N>& stage, V* value) {
    const int agents = block.agents(), n = block.states(), width = block.width();
    for (int i = 0; i < agents; ++i) {
        V* of = value + i * n * width;
        for (int a = 0; a < n; ++a) of[a * width + a] += stage.rho;
        for (int a = 0; a < kState; ++a) {
            const V* cost = stage.own_cost + 20 * i + 5 * a;
            V* row = of + (kState * i + a) * width;
            for (int b = 0; b < kState; ++b) row[kState * i + b] += cost[b];
            row[n] += cost[kState];
        }
    }
    const V* cost = stage.pair_cost;
    for (int i = 0; i < agents; ++i)
        for (int j = i + 1; j < agents; ++j, cost += 72)
            for (const int member : {i, j})
                for (int a = 0; a < 2 * kState; ++a) {
                    V* row = value + (member * n + place(i, j, a)) * width;
                    for (int b = 0; b < 2 * kState; ++b) row[place(i, j, b)] += cost[9 * a + b];
                    row[n] += cost[9 * a + 8];
                }
}

/// B_i' [V_i | v_i] for the controls of every agent [m, n + 1].
template <int N>
INLINE void find_slopes(const Block<N>& block, const Stage<N>& stage, const V* value, V* slope) {
    const int n = block.states(), width = block.width();
    clear(slope, block.controls() * width);
    for (int i = 0; i < block.agents(); ++i)
        add_product(
            slope + kControl * i * width, width, kControl, width, View{stage.B + 8 * i, kControl, 1}.transposed(),
            {value + (i * n + kState * i) * width, width, 1}, kState);
}

/// The linear system of all agents' stationarity conditions, matrix [G | f] = right.
template <int N>
INLINE void stationarity(const Block<N>& block, const Stage<N>& stage, double rho, const V* slope, V* matrix, V* right) {
    const int agents = block.agents(), n = block.states(), m = block.controls(), width = block.width();
    clear(matrix, m * m);
    clear(right, m * width);
    for (int j = 0; j < agents; ++j) {
        const View by_states{slope + kState * j, width, 1};
        add_product(matrix + kControl * j, m, m, kControl, by_states, {stage.B + 8 * j, kControl, 1}, kState);
        add_product(right + kState * j, width, m, kState, by_states, {stage.A + 16 * j, kState, 1}, kState);
    }
    for (int i = 0; i < agents; ++i)
        for (int r = 0; r < kControl; ++r) {
            const int row = kControl * i + r;
            V *of = matrix + row * m, *wanted = right + row * width;
            wanted[n] = slope[row * width + n] + stage.push[2 * i + r];
            for (int c = 0; c < kControl; ++c) of[kControl * i + c] += stage.effort[4 * i + 2 * r + c];
            of[row] += rho;
            for (int e = 0; e < m; ++e) of[e] = stage.free[i] ? of[e] : splat<double>(double(e == row));
            for (int e = 0; e < width; ++e) wanted[e] = stage.free[i] ? -wanted[e] : V{};
        }
}

INLINE V size_of(V x) { return x < 0 ? -x : x; }

/// Overwrites `right` [m, width] with matrix^-1 right, by elimination with row pivoting. Returns the lanes whose matrix is regular.
INLINE M solve(int m, int width, V* matrix, V* right) {
    M regular = V{} == V{};
    for (int j = 0; j < m; ++j) {
        V *row = matrix + j * m, *wanted = right + j * width;
        for (int i = j + 1; i < m; ++i) {
            V *other = matrix + i * m, *others = right + i * width;
            const M larger = size_of(other[j]) > size_of(row[j]);
            if (!any<double>(larger)) continue;
            const auto swap = [&](V& a, V& b) INLINE_LAMBDA {
                const V kept = a;
                a = larger ? b : a;
                b = larger ? kept : b;
            };
            for (int c = j; c < m; ++c) swap(row[c], other[c]);
            for (int c = 0; c < width; ++c) swap(wanted[c], others[c]);
        }
        regular &= size_of(row[j]) > kSingular;
        const V inverse = 1.0 / row[j];
        for (int c = j; c < m; ++c) row[c] *= inverse;
        for (int c = 0; c < width; ++c) wanted[c] *= inverse;
        for (int i = 0; i < m; ++i) {
            if (i == j) continue;
            V *other = matrix + i * m, *others = right + i * width;
            const V factor = other[j];
            for (int c = j; c < m; ++c) other[c] -= factor * row[c];
            for (int c = 0; c < width; ++c) others[c] -= factor * wanted[c];
        }
    }
    return regular;
}

/// The dynamics under a policy, [F | B f].
template <int N>
INLINE void close(const Block<N>& block, const Stage<N>& stage, const V* policy, V* closed) {
    const int width = block.width();
    clear(closed, block.states() * width);
    for (int i = 0; i < block.agents(); ++i) {
        for (int a = 0; a < kState; ++a)
            for (int b = 0; b < kState; ++b) closed[(kState * i + a) * width + kState * i + b] = stage.A[16 * i + kState * a + b];
        add_product(
            closed + kState * i * width, width, kState, width, {stage.B + 8 * i, kControl, 1},
            {policy + kControl * i * width, width, 1}, kControl);
    }
}

/// [V F | V B f + v], the gradient of a cost-to-go at the next state, as a function of the state.
INLINE void carry(int n, const V* value, const V* closed, V* ahead) {
    const int width = n + 1;
    clear(ahead, n * width);
    for (int a = 0; a < n; ++a) ahead[a * width + n] = value[a * width + n];
    add_product(ahead, width, n, width, {value, width, 1}, {closed, width, 1}, n);
}

/// R_i [G_i | f_i] + [0 | r_i], the gradient of an agent's cost by its controls [2, n + 1].
INLINE void spend(int n, const V* effort, const V* push, const V* own, V* spent) {
    const int width = n + 1;
    clear(spent, kControl * width);
    for (int r = 0; r < kControl; ++r) spent[r * width + n] = push[r];
    add_product(spent, width, kControl, width, {effort, kControl, 1}, {own, width, 1}, kControl);
}

/// Overwrites the cost-to-go [V | v] of agent i by that of the state before. `ahead` [n, n + 1] and `spent` [m, n + 1] are scratch.
template <int N>
INLINE void cost_to_go(
    const Block<N>& block, const Stage<N>& stage, int i, double rho, const V* policy, const V* closed, V* value, V* ahead, V* spent) {
    const int n = block.states(), m = block.controls(), width = block.width();
    V* own = spent + kControl * i * width;
    carry(n, value, closed, ahead);
    clear(spent, m * width);
    spend(n, stage.effort + 4 * i, stage.push + 2 * i, policy + kControl * i * width, own);
    for (int e = 0; e < m * width; ++e) spent[e] += rho * policy[e];
    clear(value, n * width);
    add_product(value, width, n, width, View{closed, width, 1}.transposed(), {ahead, width, 1}, n);
    add_product(value, width, n, width, View{policy, width, 1}.transposed(), {spent, width, 1}, m);
}

template <int N>
NOINLINE void equilibria(const EpoLQGames& games, Arena<double>& arena, const Block<N>& block) {
    const int agents = block.agents(), n = block.states(), m = block.controls(), width = block.width(), K = block.K;
    Stage<N> stage(arena, block);
    V *value = arena.take(agents * n * width), *ahead = arena.take(n * width), *closed = arena.take(n * width);
    V *matrix = arena.take(m * m), *policy = arena.take(m * width), *spent = arena.take(m * width), *slope = arena.take(m * width);
    clear(value, agents * n * width);
    M unique = V{} == V{};
    for (int k = K - 1; k >= 0; --k) {
        stage.read(games, block, k);
        add_costs(block, stage, value);
        find_slopes(block, stage, value, slope);
        stationarity(block, stage, games.rho, slope, matrix, policy);
        unique &= solve(m, width, matrix, policy);
        for (int e = 0; e < m * width; ++e) policy[e] = unique ? policy[e] : V{};
        block.write([&](int e) { return policy[e / n * width + e % n]; }, K, k, m * n, games.gains);
        block.write([&](int r) { return policy[r * width + n]; }, K, k, m, games.offsets);
        close(block, stage, policy, closed);
        for (int i = 0; i < agents; ++i)
            cost_to_go(block, stage, i, games.rho, policy, closed, value + i * n * width, ahead, spent);
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

/// Arrays that the derivative of a stage works in. A bar marks the derivative of a loss by an array: `closed_bar` is that by `closed`.
struct Scratch {
    V *closed, *closed_bar, *ahead, *ahead_bar, *by_value, *by_values;      // [n, n + 1]
    V *policy, *policy_bar, *spent, *spent_bar, *right_bar, *slope, *slope_bar, *read;  // [m, n + 1]
    V *matrix, *matrix_bar, *turned;                                        // [m, m]

    Scratch(Arena<double>& arena, int n, int m) {
        for (V** square : {&closed, &closed_bar, &ahead, &ahead_bar, &by_value, &by_values}) *square = arena.take(n * (n + 1));
        for (V** rows : {&policy, &policy_bar, &spent, &spent_bar, &right_bar, &slope, &slope_bar, &read}) *rows = arena.take(m * (n + 1));
        for (V** small : {&matrix, &matrix_bar, &turned}) *small = arena.take(m * m);
    }
};

/// The derivative of one stage of the recursion. `value` are the costs-to-go of the state after the stage. `value_bar` is the
/// derivative by those of the state before it, and is overwritten by that of `value`. `offset_bar` [m] is the derivative by f that
/// does not come from later stages. The derivatives by the arrays of the stage are written to `bar`.
template <int N>
INLINE void pull_back_stage(
    const Block<N>& block, const Stage<N>& stage, double rho, const V* value, const V* offset_bar, V* value_bar, const Stage<N>& bar,
    const Scratch& s) {
    const int agents = block.agents(), n = block.states(), m = block.controls(), width = block.width(), all = n * width;
    const View closed{s.closed, width, 1}, policy{s.policy, width, 1}, by_value{s.by_value, width, 1}, by_values{s.by_values, width, 1};
    close(block, stage, s.policy, s.closed);
    clear(s.policy_bar, m * width);
    for (int r = 0; r < m; ++r) s.policy_bar[r * width + n] = offset_bar[r];
    clear(s.closed_bar, all);
    clear(s.by_values, all);
    // [V | v] = F' ahead + G_i' (R_i [G_i | f_i] + [0 | r_i]) + rho G' [G | f], with ahead = V [F | B f] + [0 | v].
    for (int i = 0; i < agents; ++i) {
        const V* ahead_value = value + i * all;
        V* of = value_bar + i * all;
        for (int e = 0; e < all; ++e) {
            s.by_value[e] = of[e];
            s.by_values[e] += of[e];
        }
        carry(n, ahead_value, s.closed, s.ahead);
        clear(s.ahead_bar, all);
        add_product(s.ahead_bar, width, n, width, closed, by_value, n);
        add_product(s.closed_bar, width, n, n, {s.ahead, width, 1}, by_value.transposed(), width);
        clear(of, all);
        add_product(of, width, n, n, {s.ahead_bar, width, 1}, closed.transposed(), width);
        for (int a = 0; a < n; ++a) of[a * width + n] = s.ahead_bar[a * width + n];
        add_product(s.closed_bar, width, n, width, View{ahead_value, width, 1}.transposed(), {s.ahead_bar, width, 1}, n);
        const V* own = s.policy + kControl * i * width;
        V* own_bar = s.policy_bar + kControl * i * width;
        spend(n, stage.effort + 4 * i, stage.push + 2 * i, own, s.spent);
        clear(s.spent_bar, kControl * width);
        add_product(s.spent_bar, width, kControl, width, {own, width, 1}, by_value, n);
        for (int r = 0; r < kControl; ++r) bar.push[2 * i + r] = s.spent_bar[r * width + n];
        clear(bar.effort + 4 * i, 4);
        add_product(bar.effort + 4 * i, kControl, kControl, kControl, {s.spent_bar, width, 1}, View{own, width, 1}.transposed(), width);
        add_product(own_bar, width, kControl, width, View{stage.effort + 4 * i, kControl, 1}.transposed(), {s.spent_bar, width, 1}, kControl);
        add_product(own_bar, width, kControl, n, {s.spent, width, 1}, by_value.transposed(), width);
    }
    clear(s.right_bar, m * width);
    add_product(s.right_bar, width, m, n, policy, by_values.transposed(), width);
    add_product(s.right_bar, width, m, width, policy, by_values, n);
    for (int e = 0; e < m * width; ++e) s.policy_bar[e] += rho * s.right_bar[e];
    // [F | B f] = [A | 0] + B [G | f].
    for (int i = 0; i < agents; ++i) {
        const View rows{s.closed_bar + kState * i * width, width, 1};
        for (int a = 0; a < kState; ++a)
            for (int b = 0; b < kState; ++b) bar.A[16 * i + kState * a + b] = rows.at[a * width + kState * i + b];
        clear(bar.B + 8 * i, 8);
        add_product(
            bar.B + 8 * i, kControl, kState, kControl, rows, View{s.policy + kControl * i * width, width, 1}.transposed(), width);
        add_product(
            s.policy_bar + kControl * i * width, width, kControl, width, View{stage.B + 8 * i, kControl, 1}.transposed(), rows, kState);
    }
    // matrix [G | f] = right.
    find_slopes(block, stage, value, s.slope);
    stationarity(block, stage, rho, s.slope, s.matrix, s.right_bar);
    for (int r = 0; r < m; ++r)
        for (int c = 0; c < m; ++c) s.turned[r * m + c] = s.matrix[c * m + r];
    solve(m, width, s.turned, s.policy_bar);
    for (int r = 0; r < m; ++r)
        for (int e = 0; e < width; ++e)
            s.right_bar[r * width + e] = stage.free[r / kControl] ? -s.policy_bar[r * width + e] : V{};
    clear(s.matrix_bar, m * m);
    add_product(s.matrix_bar, m, m, m, {s.right_bar, width, 1}, policy.transposed(), width);
    // matrix = S B + R and -right = S [A | 0] + [0 | s + r], with [S | s] the slopes; `right_bar` is the derivative by -right.
    clear(s.slope_bar, m * width);
    for (int r = 0; r < m; ++r) s.slope_bar[r * width + n] = s.right_bar[r * width + n];
    for (int j = 0; j < agents; ++j) {
        const View matrix_bar{s.matrix_bar + kControl * j, m, 1}, right_bar{s.right_bar + kState * j, width, 1};
        const View by_states = View{s.slope + kState * j, width, 1}.transposed();
        V* slope_bar = s.slope_bar + kState * j;
        add_product(slope_bar, width, m, kState, matrix_bar, View{stage.B + 8 * j, kControl, 1}.transposed(), kControl);
        add_product(slope_bar, width, m, kState, right_bar, View{stage.A + 16 * j, kState, 1}.transposed(), kState);
        add_product(bar.B + 8 * j, kControl, kState, kControl, by_states, matrix_bar, m);
        add_product(bar.A + 16 * j, kState, kState, kState, by_states, right_bar, m);
    }
    // [S_i | s_i] = B_i' [V_i | v_i].
    for (int i = 0; i < agents; ++i) {
        const View slope_bar{s.slope_bar + kControl * i * width, width, 1};
        const int at = i * all + kState * i * width;
        add_product(value_bar + at, width, kState, width, {stage.B + 8 * i, kControl, 1}, slope_bar, kControl);
        add_product(bar.B + 8 * i, kControl, kState, kControl, {value + at, width, 1}, slope_bar.transposed(), width);
        for (int r = 0; r < kControl; ++r) {
            const int row = kControl * i + r;
            bar.push[2 * i + r] += s.right_bar[row * width + n];
            for (int c = 0; c < kControl; ++c) bar.effort[4 * i + 2 * r + c] += s.matrix_bar[row * m + kControl * i + c];
        }
    }
    // The derivative of `add_costs`.
    for (int i = 0; i < agents; ++i)
        for (int a = 0; a < kState; ++a) {
            const V* row = value_bar + i * all + (kState * i + a) * width;
            for (int b = 0; b < kState; ++b) bar.own_cost[20 * i + 5 * a + b] = row[kState * i + b];
            bar.own_cost[20 * i + 5 * a + kState] = row[n];
        }
    V* cost_bar = bar.pair_cost;
    for (int i = 0; i < agents; ++i)
        for (int j = i + 1; j < agents; ++j, cost_bar += 72)
            for (int a = 0; a < 2 * kState; ++a) {
                const V *first = value_bar + (i * n + place(i, j, a)) * width, *second = value_bar + (j * n + place(i, j, a)) * width;
                for (int b = 0; b < 2 * kState; ++b) cost_bar[9 * a + b] = first[place(i, j, b)] + second[place(i, j, b)];
                cost_bar[9 * a + 8] = first[n] + second[n];
            }
}

/// Overwrites the derivative [K, m] by the controls that policies choose from x_0 = 0 on by that by their offsets.
template <int N>
INLINE void pull_back_controls(
    const EpoLQGames& games, const Block<N>& block, Arena<double>& arena, Stage<N>& stage, const Scratch& s, V* offset_bar) {
    const int n = block.states(), m = block.controls(), width = block.width();
    V *state_bar = arena.take(n), *before = arena.take(n);
    clear(state_bar, n);
    for (int k = block.K - 1; k >= 0; --k, std::swap(state_bar, before)) {
        stage.read_dynamics(games, block, k);
        read_policy(games, block, k, s.read, s.policy);
        V* bar = offset_bar + k * m;
        clear(before, n);
        for (int i = 0; i < block.agents(); ++i)
            for (int a = 0; a < kState; ++a) {
                const V entry = state_bar[kState * i + a];
                for (int c = 0; c < kControl; ++c) bar[kControl * i + c] += stage.B[8 * i + kControl * a + c] * entry;
                for (int b = 0; b < kState; ++b) before[kState * i + b] += stage.A[16 * i + kState * a + b] * entry;
            }
        for (int r = 0; r < m; ++r)
            for (int b = 0; b < n; ++b) before[b] += s.policy[r * width + b] * bar[r];
    }
}

template <int N>
NOINLINE void pull_back(const EpoLQGames& games, const EpoLQGradients& gradients, Arena<double>& arena, const Block<N>& block) {
    const int agents = block.agents(), n = block.states(), m = block.controls(), width = block.width(), K = block.K;
    const int all = agents * n * width;
    Stage<N> stage(arena, block), bar(arena, block);
    Scratch s(arena, n, m);
    V *values = arena.take(K * all), *value = arena.take(all), *offset_bar = arena.take(K * m);
    M unique;
    for (int lane = 0; lane < W; ++lane) unique[lane] = games.unique[block.game[lane]] ? -1 : 0;
    clear(value, all);
    for (int k = K - 1; k >= 0; --k) {
        stage.read(games, block, k);
        read_policy(games, block, k, s.read, s.policy);
        add_costs(block, stage, value);
        std::copy(value, value + all, values + k * all);
        close(block, stage, s.policy, s.closed);
        for (int i = 0; i < agents; ++i)
            cost_to_go(block, stage, i, games.rho, s.policy, s.closed, value + i * n * width, s.ahead, s.spent);
    }
    for (int k = 0; k < K; ++k) block.read(gradients.controls, K, k, m, offset_bar + k * m);
    pull_back_controls(games, block, arena, stage, s, offset_bar);
    clear(value, all);
    for (int k = 0; k < K; ++k) {
        stage.read(games, block, k);
        read_policy(games, block, k, s.read, s.policy);
        pull_back_stage(block, stage, games.rho, values + k * all, offset_bar + k * m, value, bar, s);
        const auto write = [&](const V* from, int64_t rows, int64_t row, int length, double* to) {
            block.write([&](int e) { return unique ? from[e] : V{}; }, rows, row, length, to);
        };
        Stage<N>::for_each_row(block, k, [&](int i, int64_t rows, int64_t row) {
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
