// The stages of linear-quadratic games: the coupled Riccati recursion (Basar and Olsder, Dynamic Noncooperative Game Theory,
// Corollary 6.1) and its derivative. W games are solved side by side.
//
// The games and the letters are those of `solvers/feedback/lq_game.py`: n = 4N joint states, m = 2N joint controls. Matrices with
// one more column hold a matrix and a vector: [V | v] the cost-to-go of an agent, [G | f] a policy, [F | B f] with F = A + B G the
// dynamics under it.
#pragma once

#include <algorithm>

#include "buffers.hpp"
#include "lanes.hpp"
#include "riccati.hpp"

namespace EPO_LEVEL {
namespace lq {

using V = Vec<double>;
using M = Mask<double>;

constexpr int W = Lanes<double>::W;
constexpr int kState = 4, kControl = 2;
constexpr double kSingular = 1e-12;  // the least size of a pivot

/// Sizes of a joint game.
template <int N>
struct Sizes : Count<N> {
    INLINE explicit Sizes(int agents) : Count<N>{agents} {}
    INLINE int pairs() const { return this->agents() * (this->agents() - 1) / 2; }
    INLINE int states() const { return kState * this->agents(); }
    INLINE int width() const { return this->states() + 1; }
};

/// A matrix to read: entry (r, c) is at[r * row + c * column].
struct View {
    const V* at;
    int row, column;
    View transposed() const { return {at, column, row}; }
};

template <int R, int S, bool FRESH>
INLINE void add_tile(V* to, int stride, View a, View b, int depth) {
    V sum[R][S];
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) sum[i][j] = FRESH ? V{} : to[i * stride + j];
    for (int k = 0; k < depth; ++k)
        for (int i = 0; i < R; ++i)
            for (int j = 0; j < S; ++j) sum[i][j] += a.at[i * a.row + k * a.column] * b.at[k * b.row + j * b.column];
    for (int i = 0; i < R; ++i)
        for (int j = 0; j < S; ++j) to[i * stride + j] = sum[i][j];
}

/// Adds a b to the matrix `to`, whose rows are `stride` apart and even in number; with FRESH, its old values count as zero. Eight sums
/// at a time hide the latency of one.
template <bool FRESH = false>
INLINE void add_product(V* to, int stride, int rows, int columns, View a, View b, int depth) {
    const int whole = columns / 4 * 4;
    for (int i = 0; i < rows; i += 2)
        for (int j = 0; j < whole; j += 4)
            add_tile<2, 4, FRESH>(
                to + i * stride + j, stride, {a.at + i * a.row, a.row, a.column}, {b.at + j * b.column, b.row, b.column}, depth);
    for (int j = whole; j < columns; ++j) {
        const View right{b.at + j * b.column, b.row, b.column};
        int i = 0;
        for (; i + 8 <= rows; i += 8) add_tile<8, 1, FRESH>(to + i * stride + j, stride, {a.at + i * a.row, a.row, a.column}, right, depth);
        for (; i < rows; i += 2) add_tile<2, 1, FRESH>(to + i * stride + j, stride, {a.at + i * a.row, a.row, a.column}, right, depth);
    }
}

/// Overwrites the matrix `to` by a b.
INLINE void set_product(V* to, int stride, int rows, int columns, View a, View b, int depth) {
    add_product<true>(to, stride, rows, columns, a, b, depth);
}

INLINE void clear(V* values, int count) {
    for (int e = 0; e < count; ++e) values[e] = V{};
}

/// One time step of W games, or the derivative of a loss by it.
template <int N>
struct Stage {
    V *A, *B, *own_cost, *pair_cost, *effort, *push;  // [N, 4, 4], [N, 4, 2], [N, 4, 5], [P, 8, 9], [N, 2, 2], [N, 2]
    M* free;                                          // [N]
    V rho;                                            // zero after the end of a game

    Stage(Arena<double>& arena, const Sizes<N>& size)
        : A(arena.take(16 * size.agents())), B(arena.take(8 * size.agents())), own_cost(arena.take(20 * size.agents())),
          pair_cost(arena.take(72 * size.pairs())), effort(arena.take(4 * size.agents())), push(arena.take(2 * size.agents())),
          free(reinterpret_cast<M*>(arena.take(size.agents()))), rho{} {}
};

/// The entry of the joint state that is entry `a` of the states of the pair (i, j).
INLINE int place(int i, int j, int a) { return a < kState ? kState * i + a : kState * (j - 1) + a; }

/// Adds the costs of a stage to the costs-to-go [N, n, n + 1].
template <int N>
INLINE void add_costs(const Sizes<N>& size, const Stage<N>& stage, V* value) {
    const int agents = size.agents(), n = size.states(), width = size.width();
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
INLINE void find_slopes(const Sizes<N>& size, const Stage<N>& stage, const V* value, V* slope) {
    const int n = size.states(), width = size.width();
    for (int i = 0; i < size.agents(); ++i)
        set_product(
            slope + kControl * i * width, width, kControl, width, View{stage.B + 8 * i, kControl, 1}.transposed(),
            {value + (i * n + kState * i) * width, width, 1}, kState);
}

/// The linear system of all agents' stationarity conditions, matrix [G | f] = right.
template <int N>
INLINE void stationarity(const Sizes<N>& size, const Stage<N>& stage, double rho, const V* slope, V* matrix, V* right) {
    const int agents = size.agents(), n = size.states(), m = size.controls(), width = size.width();
    for (int j = 0; j < agents; ++j) {
        const View by_states{slope + kState * j, width, 1};
        set_product(matrix + kControl * j, m, m, kControl, by_states, {stage.B + 8 * j, kControl, 1}, kState);
        set_product(right + kState * j, width, m, kState, by_states, {stage.A + 16 * j, kState, 1}, kState);
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
INLINE void close(const Sizes<N>& size, const Stage<N>& stage, const V* policy, V* closed) {
    const int width = size.width();
    for (int i = 0; i < size.agents(); ++i) {
        V* const rows = closed + kState * i * width;
        set_product(rows, width, kState, width, {stage.B + 8 * i, kControl, 1}, {policy + kControl * i * width, width, 1}, kControl);
        for (int a = 0; a < kState; ++a)
            for (int b = 0; b < kState; ++b) rows[a * width + kState * i + b] += stage.A[16 * i + kState * a + b];
    }
}

/// [V F | V B f + v], the gradient of a cost-to-go at the next state, as a function of the state.
INLINE void carry(int n, const V* value, const V* closed, V* ahead) {
    const int width = n + 1;
    set_product(ahead, width, n, width, {value, width, 1}, {closed, width, 1}, n);
    for (int a = 0; a < n; ++a) ahead[a * width + n] += value[a * width + n];
}

/// Adds R_i [G_i | f_i] + [0 | r_i], the gradient of an agent's cost by its controls [2, n + 1].
INLINE void spend(int n, const V* effort, const V* push, const V* own, V* spent) {
    const int width = n + 1;
    for (int r = 0; r < kControl; ++r) spent[r * width + n] += push[r];
    add_product(spent, width, kControl, width, {effort, kControl, 1}, {own, width, 1}, kControl);
}

/// Overwrites the cost-to-go [V | v] of agent i by that of the state before. `ahead` [n, n + 1] and `spent` [m, n + 1] are scratch.
template <int N>
INLINE void cost_to_go(
    const Sizes<N>& size, const Stage<N>& stage, int i, double rho, const V* policy, const V* closed, V* value, V* ahead, V* spent) {
    const int n = size.states(), m = size.controls(), width = size.width();
    V* own = spent + kControl * i * width;
    carry(n, value, closed, ahead);
    for (int e = 0; e < m * width; ++e) spent[e] = rho * policy[e];
    spend(n, stage.effort + 4 * i, stage.push + 2 * i, policy + kControl * i * width, own);
    set_product(value, width, n, width, View{closed, width, 1}.transposed(), {ahead, width, 1}, n);
    add_product(value, width, n, width, View{policy, width, 1}.transposed(), {spent, width, 1}, m);
}

/// Memory in which a stage of the recursion works.
struct Work {
    V *ahead, *closed;                // [n, n + 1]
    V *spent, *slope, *matrix;        // [m, n + 1] twice, [m, m]

    template <int N>
    Work(Arena<double>& arena, const Sizes<N>& size)
        : ahead(arena.take(size.states() * size.width())), closed(arena.take(size.states() * size.width())),
          spent(arena.take(size.controls() * size.width())), slope(arena.take(size.controls() * size.width())),
          matrix(arena.take(size.controls() * size.controls())) {}
};

/// Takes the recursion over one stage: from the costs-to-go `value` [N, n, n + 1] of the state after it to those of the state before
/// it. The former include the costs of the stage.
template <int N>
INLINE void step_back(const Sizes<N>& size, const Stage<N>& stage, double rho, const V* policy, const Work& work, V* value) {
    close(size, stage, policy, work.closed);
    for (int i = 0; i < size.agents(); ++i)
        cost_to_go(size, stage, i, rho, policy, work.closed, value + i * size.states() * size.width(), work.ahead, work.spent);
}

/// Writes the policy [m, n + 1] of a stage, given the costs-to-go of the state after it, which include those of the stage. Lanes of
/// `unique` become false where the equilibrium is not unique; policies of these lanes are zero.
template <int N>
INLINE void find_policy(const Sizes<N>& size, const Stage<N>& stage, double rho, const V* value, const Work& work, M& unique, V* policy) {
    find_slopes(size, stage, value, work.slope);
    stationarity(size, stage, rho, work.slope, work.matrix, policy);
    unique &= solve(size.controls(), size.width(), work.matrix, policy);
    for (int e = 0; e < size.controls() * size.width(); ++e) policy[e] = unique ? policy[e] : V{};
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
    const Sizes<N>& size, const Stage<N>& stage, double rho, const V* value, const V* offset_bar, V* value_bar, const Stage<N>& bar,
    const Scratch& s) {
    const int agents = size.agents(), n = size.states(), m = size.controls(), width = size.width(), all = n * width;
    const View closed{s.closed, width, 1}, policy{s.policy, width, 1}, by_value{s.by_value, width, 1}, by_values{s.by_values, width, 1};
    close(size, stage, s.policy, s.closed);
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
        set_product(s.ahead_bar, width, n, width, closed, by_value, n);
        add_product(s.closed_bar, width, n, n, {s.ahead, width, 1}, by_value.transposed(), width);
        set_product(of, width, n, n, {s.ahead_bar, width, 1}, closed.transposed(), width);
        for (int a = 0; a < n; ++a) of[a * width + n] = s.ahead_bar[a * width + n];
        add_product(s.closed_bar, width, n, width, View{ahead_value, width, 1}.transposed(), {s.ahead_bar, width, 1}, n);
        const V* own = s.policy + kControl * i * width;
        V* own_bar = s.policy_bar + kControl * i * width;
        clear(s.spent, kControl * width);
        spend(n, stage.effort + 4 * i, stage.push + 2 * i, own, s.spent);
        set_product(s.spent_bar, width, kControl, width, {own, width, 1}, by_value, n);
        for (int r = 0; r < kControl; ++r) bar.push[2 * i + r] = s.spent_bar[r * width + n];
        set_product(bar.effort + 4 * i, kControl, kControl, kControl, {s.spent_bar, width, 1}, View{own, width, 1}.transposed(), width);
        add_product(own_bar, width, kControl, width, View{stage.effort + 4 * i, kControl, 1}.transposed(), {s.spent_bar, width, 1}, kControl);
        add_product(own_bar, width, kControl, n, {s.spent, width, 1}, by_value.transposed(), width);
    }
    set_product(s.right_bar, width, m, width, policy, by_values, n);
    add_product(s.right_bar, width, m, n, policy, by_values.transposed(), width);
    for (int e = 0; e < m * width; ++e) s.policy_bar[e] += rho * s.right_bar[e];
    // [F | B f] = [A | 0] + B [G | f].
    for (int i = 0; i < agents; ++i) {
        const View rows{s.closed_bar + kState * i * width, width, 1};
        for (int a = 0; a < kState; ++a)
            for (int b = 0; b < kState; ++b) bar.A[16 * i + kState * a + b] = rows.at[a * width + kState * i + b];
        set_product(
            bar.B + 8 * i, kControl, kState, kControl, rows, View{s.policy + kControl * i * width, width, 1}.transposed(), width);
        add_product(
            s.policy_bar + kControl * i * width, width, kControl, width, View{stage.B + 8 * i, kControl, 1}.transposed(), rows, kState);
    }
    // matrix [G | f] = right.
    find_slopes(size, stage, value, s.slope);
    stationarity(size, stage, rho, s.slope, s.matrix, s.right_bar);
    for (int r = 0; r < m; ++r)
        for (int c = 0; c < m; ++c) s.turned[r * m + c] = s.matrix[c * m + r];
    solve(m, width, s.turned, s.policy_bar);
    for (int r = 0; r < m; ++r)
        for (int e = 0; e < width; ++e)
            s.right_bar[r * width + e] = stage.free[r / kControl] ? -s.policy_bar[r * width + e] : V{};
    set_product(s.matrix_bar, m, m, m, {s.right_bar, width, 1}, policy.transposed(), width);
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

/// Takes the derivative by the controls that policies choose from x_0 = 0 on one stage back: `state_bar` [n] is the derivative by the
/// state after the stage, and becomes that by the state before it; `bar` [m] is the derivative by the controls, and becomes that by
/// the offsets. `before` [n] is scratch.
template <int N>
INLINE void pull_back_controls(const Sizes<N>& size, const Stage<N>& stage, const V* policy, V* state_bar, V* before, V* bar) {
    const int n = size.states(), m = size.controls(), width = size.width();
    clear(before, n);
    for (int i = 0; i < size.agents(); ++i)
        for (int a = 0; a < kState; ++a) {
            const V entry = state_bar[kState * i + a];
            for (int c = 0; c < kControl; ++c) bar[kControl * i + c] += stage.B[8 * i + kControl * a + c] * entry;
            for (int b = 0; b < kState; ++b) before[kState * i + b] += stage.A[16 * i + kState * a + b] * entry;
        }
    for (int r = 0; r < m; ++r)
        for (int b = 0; b < n; ++b) before[b] += policy[r * width + b] * bar[r];
    std::copy(before, before + n, state_bar);
}

}  // namespace lq
}  // namespace EPO_LEVEL
