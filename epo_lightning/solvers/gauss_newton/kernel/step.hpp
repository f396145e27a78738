// One Levenberg-Marquardt step of a group, the factors that it keeps for its adjoint, and that adjoint.
#pragma once

#include "gradients.hpp"
#include "group.hpp"

namespace EPO_LEVEL {

/// Factors of one group and step: L [K, m, m] and G [K, m, 3m], of which G[0] is never used.
template <class T>
struct Factors {
    Vec<T>*L, *G;
    static std::size_t size(int n, int64_t K) { return std::size_t(K) * (4 * n * n + 12 * n * n); }
    static Factors at(Vec<T>* memory, int n, int64_t K) { return {memory, memory + std::size_t(K) * 4 * n * n}; }
};

/// Adds the costs of an overlap of discs at one state; arguments as for `add_state_costs`.
template <class T, int N>
INLINE void add_disc_costs(const Group<T, N>& g, int feature, int state, bool exact, Vec<T>* P, Vec<T>* y, Vec<T>& energy) {
    const int n = g.count.agents(), m = 2 * n, ld = 3 * m;
    int pair = feature * g.pairs;
    for (int i = 0; i < n; ++i)
        for (int j = i + 1; j < g.n; ++j, ++pair) {
            const Vec<T> dx = g.path[i].x[state] - g.path[j].x[state], dy = g.path[i].y[state] - g.path[j].y[state];
            const Vec<T> reach = g.reach[pair];
            if (!any<T>(dx * dx + dy * dy < reach * reach)) continue;
            const Contact<T> contact(dx, dy, reach);
            const bool both = j < n;
            const Vec<T> weight = g.pair_weight[pair], pushed = weight * weight * contact.depth;
            energy += T(0.5) * pushed * contact.depth;
            const Vec<T> push_x = pushed * contact.x, push_y = pushed * contact.y;
            y[2 * i] -= push_x;
            y[2 * i + 1] -= push_y;
            if (both) {
                y[2 * j] += push_x;
                y[2 * j + 1] += push_y;
            }
            if (!P) continue;
            const Vec<T> nx = weight * contact.x, ny = weight * contact.y;
            // Each product goes straight into its sum, so that the compiler can fuse them whether or not `exact` adds more.
            const auto add = [&](Vec<T> xx, Vec<T> xy, Vec<T> yy) INLINE_LAMBDA {
                for (const int a : {i, j}) {
                    if (a >= n) return;
                    P[2 * a * ld + 2 * a] += xx;
                    P[(2 * a + 1) * ld + 2 * a] += xy;
                    P[(2 * a + 1) * ld + 2 * a + 1] += yy;
                }
                P[2 * j * ld + 2 * i] -= xx;
                P[2 * j * ld + 2 * i + 1] -= xy;
                P[(2 * j + 1) * ld + 2 * i] -= xy;
                P[(2 * j + 1) * ld + 2 * i + 1] -= yy;
            };
            add(nx * nx, nx * ny, ny * ny);
            if (!exact) continue;
            const Vec<T> turning = contact.active && contact.distance > 0 ? pushed / contact.distance : Vec<T>{};
            add(-turning * contact.y * contact.y, turning * contact.x * contact.y, -turning * contact.x * contact.x);
        }
}

/// Adds the products of the derivatives `row` of a residual to P, where `at` are the indices of their entries.
template <class T>
INLINE void add_products(const Vec<T>* row, const int* at, int count, int ld, Vec<T>* P) {
    for (int e = 0; e < count; ++e)
        for (int f = 0; f <= e; ++f) P[std::max(at[e], at[f]) * ld + std::min(at[e], at[f])] += row[e] * row[f];
}

/// Adds the entries of a symmetric matrix to P: those below and on its diagonal, row by row; arguments as for `add_products`.
template <class T>
INLINE void add_symmetric(const Vec<T>* entries, const int* at, int count, int ld, Vec<T>* P) {
    for (int e = 0; e < count; ++e)
        for (int f = 0; f <= e; ++f) P[std::max(at[e], at[f]) * ld + std::min(at[e], at[f])] += *entries++;
}

/// Indices of the entries of P and y that belong to position, heading and speed of two agents, in the order of `Slope`.
INLINE void entries_of(int i, int j, int m, int* at) {
    const int both[2] = {i, j};
    for (int side = 0; side < 2; ++side)
        for (int e = 0; e < 4; ++e) at[4 * side + e] = 2 * both[side] + e % 2 + (e < 2 ? 0 : m);
}

/// Adds the costs of the pair features of states at one state; arguments as for `add_state_costs`.
template <class T>
NOINLINE void add_state_pair_costs(const Games<T>& g, int state, bool exact, Vec<T>* P, Vec<T>* y, Vec<T>& energy) {
    const int n = g.movers, m = 2 * n, ld = 3 * m;
    for (int feature = 0; feature < PAIR_COUNT; ++feature) {
        if (of_discs(feature) || !g.has_pair(feature)) continue;
        int pair = 0;
        for (int i = 0; i < n; ++i)
            for (int j = i + 1; j < g.n; ++j, ++pair) {
                if (!g.in_range(feature, pair, i, j, state)) continue;
                PairValue<Vec<T>> d;
                const int unknowns = j < n ? 8 : 4;  // a held agent has none
                const int entry = feature * g.pairs + pair;
                evaluate_pair<T, Vec<T>>(feature, g.body(i, state), g.body(j, state), g.margin[entry], d);
                const Vec<T> weight = g.pair_weight[entry], pushed = weight * weight * d.value;
                if (!any<T>(pushed != 0)) continue;  // a feature that is not active has no derivatives either
                energy += T(0.5) * pushed * d.value;
                int at[8];
                entries_of(i, j, m, at);
                for (int e = 0; e < unknowns; ++e) y[at[e]] += pushed * d.by[e];
                if (!P) continue;
                Vec<T> row[8];
                for (int e = 0; e < unknowns; ++e) row[e] = weight * d.by[e];
                add_products<T>(row, at, unknowns, ld, P);
                // Two columns of the feature's Hessian at a time. Features depend on the difference of the two positions, so the
                // columns of the second one are those of the first with the other sign.
                PairValue<Dual<T>> of_position, of_motion;
                for (int e = 0; exact && e < unknowns; e += 2) {
                    PairValue<Dual<T>>& h = e == X1 || e == X2 ? of_position : of_motion;
                    const Dual<T> margin{g.margin[entry], Vec<T>{}, Vec<T>{}};
                    if (e != X2)
                        evaluate_pair<T, Dual<T>>(feature, g.shifted_body(i, state, e), g.shifted_body(j, state, e - 4), margin, h);
                    const Vec<T> factor = e == X2 ? -pushed : pushed;
                    for (int f = 0; f <= e; ++f) P[std::max(at[e], at[f]) * ld + std::min(at[e], at[f])] += factor * h.by[f].a;
                    for (int f = 0; f <= e + 1; ++f)
                        P[std::max(at[e + 1], at[f]) * ld + std::min(at[e + 1], at[f])] += factor * h.by[f].b;
                }
            }
    }
}

/// Adds the costs of given residuals at one state, which also depend on the controls of the step before it; arguments as for
/// `add_state_costs`.
template <class T>
NOINLINE void add_given_costs(const Games<T>& g, int state, bool exact, Vec<T>* P, Vec<T>* y, Vec<T>& energy) {
    const int m = 2 * g.movers, ld = 3 * m, count = int(g.game.given_count);
    for (int i = 0; i < g.movers; ++i) {
        const Vec<T>* row = g.given + (i * g.K + state - 1) * count * GIVEN_COUNT;
        // Entries of P and y for the derivatives of a residual, in their order.
        const int at[] = {2 * i, 2 * i + 1, m + 2 * i, m + 2 * i + 1, 2 * m + unknown(i, ACCELERATION), 2 * m + unknown(i, TURN_RATE)};
        for (int r = 0; r < count; ++r, row += GIVEN_COUNT) {
            const Vec<T> value = row[GIVEN_VALUE], *by = row + GIVEN_X;
            energy += T(0.5) * value * value;
            for (int e = 0; e < 6; ++e) y[at[e]] += value * by[e];
            if (P) add_products<T>(by, at, 6, ld, P);
        }
        if (P && exact) add_symmetric<T>(g.given_curvature + (i * g.K + state - 1) * GIVEN_CURVATURE, at, 6, ld, P);
    }
}

/// Adds the costs of given residuals of pairs at one state; arguments as for `add_state_costs`.
template <class T>
NOINLINE void add_given_pair_costs(const Games<T>& g, int state, bool exact, Vec<T>* P, Vec<T>* y, Vec<T>& energy) {
    const int m = 2 * g.n, ld = 3 * m, count = int(g.game.given_pair_count);
    const int stride = int(g.game.pair_stride), states = g.K / stride;
    int place = state / stride - 1;  // among the evaluated states of all pairs
    for (int i = 0; i < g.n; ++i)
        for (int j = i + 1; j < g.n; ++j, place += states) {
            int at[8];
            entries_of(i, j, m, at);
            const Vec<T>* row = g.given_pairs + place * count * GIVEN_PAIR_COUNT;
            for (int r = 0; r < count; ++r, row += GIVEN_PAIR_COUNT) {
                const Vec<T>*by = row + GIVEN_PAIR_FIRST, value = row[GIVEN_PAIR_VALUE];
                Vec<T> all = value * value;  // zero where the residual and all its derivatives are
                for (int e = 0; e < 8; ++e) all += by[e] * by[e];
                if (!any<T>(all != 0)) continue;
                energy += T(0.5) * value * value;
                for (int e = 0; e < 8; ++e) y[at[e]] += value * by[e];
                if (P) add_products<T>(by, at, 8, ld, P);
            }
            if (P && exact) add_symmetric<T>(g.given_pair_curvature + place * GIVEN_PAIR_CURVATURE, at, 8, ld, P);
        }
}

/// Adds the second derivatives of the costs of a state to P [3m, 3m] (unless it is null) and their gradient to y [3m]; returns
/// their energy. Unless `exact`, the second derivatives of residuals are left out (Gauss-Newton).
template <class T, int N>
INLINE Vec<T> add_state_costs(const Group<T, N>& g, int state, bool exact, Vec<T>* P, Vec<T>* y) {
    const int n = g.count.agents(), m = 2 * n, ld = 3 * m;
    Vec<T> energy{};
    for (int i = 0; i < n; ++i) {
        const StateModels<T> own = g.state_models(i, state);
        energy = energy + own.speed.energy + own.heading.energy + (own.x.energy + own.y.energy);
        y[2 * i] += own.x.pull;
        y[2 * i + 1] += own.y.pull;
        y[m + 2 * i] += own.heading.pull;
        y[m + 2 * i + 1] += own.speed.pull;
        if (P) {
            P[2 * i * ld + 2 * i] += own.x.stiffness;
            P[(2 * i + 1) * ld + 2 * i + 1] += own.y.stiffness;
            P[(m + 2 * i) * ld + m + 2 * i] += own.heading.stiffness;
            P[(m + 2 * i + 1) * ld + m + 2 * i + 1] += own.speed.stiffness;
        }
        if (P && (exact || g.game.lane_slides) && g.has(LANE)) {  // the nearest point of the line moves with the agent
            const int at = i * (g.K + 1) + state;
            const Vec<T> x = g.own(LANE, i) * g.nearest.tangent_x[at], y_ = g.own(LANE, i) * g.nearest.tangent_y[at];
            P[2 * i * ld + 2 * i] -= x * x;
            P[(2 * i + 1) * ld + 2 * i] -= x * y_;
            P[(2 * i + 1) * ld + 2 * i + 1] -= y_ * y_;
        }
    }
    if (g.game.given) add_given_costs<T>(g, state, exact, P, y, energy);
    if (!g.pairs_count_at(state)) return energy;
    for (const int feature : {PROXIMITY, CLEARANCE})
        if (g.has_pair(feature)) add_disc_costs(g, feature, state, exact, P, y, energy);
    if (g.state_pairs) add_state_pair_costs<T>(g, state, exact, P, y, energy);
    if (g.game.given_pairs) add_given_pair_costs<T>(g, state, exact, P, y, energy);
    return energy;
}

/// First and second derivatives (pull and stiffness) of the costs of step k: of its controls, of their change since the step
/// before, and of the steering angle, which depends on the turn rate and on the speed before the step.
template <class T>
struct ControlCosts {
    Vec<T>*pull, *rate_pull, *stiffness, *rate_stiffness;  // [m]; pull and stiffness include those of rates
    Vec<T>*speed_pull, *speed_stiffness, *coupling;        // [n], of steering angles
    Vec<T> energy;

    ControlCosts(Arena<T>& arena, int n)
        : pull(arena.take(2 * n)), rate_pull(arena.take(2 * n)), stiffness(arena.take(2 * n)), rate_stiffness(arena.take(2 * n)),
          speed_pull(arena.take(n)), speed_stiffness(arena.take(n)), coupling(arena.take(n)) {}

    template <int N>
    INLINE void set(const Group<T, N>& g, int k, bool exact) {
        energy = Vec<T>{};
        for (int i = 0; i < g.count.agents(); ++i) {
            for (const int channel : {ACCELERATION, TURN_RATE}) {
                const int r = unknown(i, channel);
                const Model<T> control = g.control_model(channel, i, k), rate = g.rate_model(channel, i, k);
                energy += control.energy + rate.energy;
                pull[r] = control.pull + rate.pull;
                rate_pull[r] = rate.pull;
                stiffness[r] = control.stiffness + rate.stiffness;
                rate_stiffness[r] = rate.stiffness;
            }
            speed_pull[i] = speed_stiffness[i] = coupling[i] = Vec<T>{};
            if (!g.has(STEER)) continue;
            const Steering<T> steer(g.wheelbase[i], g.turn[i * g.K + k], g.path[i].speed[k]);
            const Vec<T> squared = g.own(STEER, i) * g.own(STEER, i), value = squared * steer.value;
            energy += T(0.5) * value * steer.value;
            pull[unknown(i, TURN_RATE)] += value * steer.by_turn;
            stiffness[unknown(i, TURN_RATE)] += squared * steer.by_turn * steer.by_turn;
            speed_pull[i] = value * steer.by_speed;
            speed_stiffness[i] = squared * steer.by_speed * steer.by_speed;
            coupling[i] = squared * steer.by_turn * steer.by_speed;
            if (!exact) continue;
            stiffness[unknown(i, TURN_RATE)] += value * steer.turn_turn;
            speed_stiffness[i] += value * steer.speed_speed;
            coupling[i] += value * steer.turn_speed;
        }
    }
};

/// The forward recursion: from L^-1 h [K, m] to the direction [n, K].
template <class T, int N>
INLINE void push(const Group<T, N>& g, const Factors<T>& factors, const Vec<T>* h, Vec<T>* turn, Vec<T>* thrust) {
    const int n = g.count.agents(), m = 2 * n, ld = 3 * m;
    Vec<T>*x = g.arena.take(ld), *c = g.arena.take(m);
    Motion<T>* Z = reinterpret_cast<Motion<T>*>(g.arena.take(4 * n));
    for (int e = 0; e < ld; ++e) x[e] = Vec<T>{};
    for (int k = 0; k < g.K; ++k) {
        g.motions(k, Z);
        push_state(g.count, factors.L + std::size_t(k) * m * m, factors.G + std::size_t(k) * m * ld, g.dt, Z, k == 0, h + k * m, x, c);
        for (int i = 0; i < n; ++i) {
            turn[i * g.K + k] = c[2 * i];
            thrust[i * g.K + k] = c[2 * i + 1];
        }
    }
}

/// Computes the damped Gauss-Newton direction (or, if `exact`, the damped Newton direction) of every lane: the changes [n, K] of turn
/// rates (`turn`) and accelerations (`thrust`). Also writes the factors, the decrease of the energy that the damped quadratic model
/// predicts and, unless it is null, the energy. Where agents are held, it is the energy of those that move, given the held ones.
///
/// `positive` is the mask of the lanes that are wanted; it becomes the mask of those of them in which the damped matrix is positive
/// definite. If there is none, directions are zero, and what is left of the recursion is left out unless the energy is wanted.
///
/// Every agent has its own damping [n]. Infinite damping makes the reciprocal pivots zero, and therefore the direction as well.
template <class T, int N>
void solve_step(
    const Group<T, N>& g, bool exact, const Vec<T>* damping, const Factors<T>& factors, Vec<T>* turn, Vec<T>* thrust,
    Vec<T>* energy, Vec<T>& predicted, Mask<T>& positive) {
    const int n = g.count.agents(), m = 2 * n, ld = 3 * m;
    Vec<T>*P = g.arena.take(ld * ld), *y = g.arena.take(ld), *h = g.arena.take(g.K * m), *damped = g.arena.take(m);
    Motion<T>* Z = reinterpret_cast<Motion<T>*>(g.arena.take(4 * n));
    ControlCosts<T> costs(g.arena, n);
    for (int e = 0; e < ld * ld; ++e) P[e] = Vec<T>{};
    for (int e = 0; e < ld; ++e) y[e] = Vec<T>{};
    // Only if `exact`: the gradient of the energy by a common shift of all later positions of an agent, and y before a state.
    Vec<T>*shift = g.arena.take(m), *before = g.arena.take(m);
    for (int e = 0; e < m; ++e) shift[e] = Vec<T>{};
    Vec<T> found = predicted = Vec<T>{};
    for (int k = g.K - 1; k >= 0; --k) {
        if (!energy && !any<T>(positive)) break;
        Vec<T>*L = factors.L + std::size_t(k) * m * m, *G = factors.G + std::size_t(k) * m * ld, *linear = h + k * m;
        g.enter(k);
        for (int e = 0; exact && e < m; ++e) before[e] = y[e];
        found += add_state_costs(g, k + 1, exact, P, y);
        for (int e = 0; exact && e < m; ++e) shift[e] += y[e] - before[e];
        costs.set(g, k, exact);
        found += costs.energy;
        g.motions(k, Z);
        for (int r = 0; r < m; ++r) damped[r] = costs.stiffness[r] + damping[r / 2];
        if (g.cut)  // steps after the end of a game have no costs: a unit matrix keeps them regular without damping
            for (int r = 0; r < m; ++r) damped[r] = g.has_step(k) ? damped[r] : splat<T>(1);
        control_block(g.count, P, g.dt, damped, L);
        factorise<T>(g.count, L, positive);
        if (k > 0) {
            transition(g.count, P, g.dt, Z, costs.coupling, costs.rate_stiffness, G);
            eliminate_controls<T>(g.count, L, costs.rate_stiffness, G, P);
        }
        for (int r = 0; r < m; ++r) linear[r] = costs.pull[r];
        pull_linear(g.count, L, G, g.dt, Z, k == 0, y, linear);
        for (int r = 0; r < m; ++r) predicted += T(0.5) * linear[r] * linear[r];
        for (int r = 0; r < m; ++r) y[2 * m + r] -= costs.rate_pull[r];
        for (int i = 0; i < n; ++i) {
            const int v = m + 2 * i + 1;
            y[v] += costs.speed_pull[i];
            P[v * ld + v] += costs.speed_stiffness[i];
            if (!exact) continue;
            // The second derivatives of the step's displacement dt v (cos, sin) by heading and speed.
            const Vec<T> x = shift[2 * i], y_ = shift[2 * i + 1];
            P[(v - 1) * ld + v - 1] -= g.path[i].speed[k] * (x * Z[i].x_speed + y_ * Z[i].y_speed);
            P[v * ld + v - 1] += y_ * Z[i].x_speed - x * Z[i].y_speed;
        }
    }
    if (energy) *energy = found;
    if (any<T>(positive)) return push(g, factors, h, turn, thrust);
    for (int e = 0; e < n * g.K; ++e) turn[e] = thrust[e] = Vec<T>{};
}

/// Overwrites a cotangent v [n, K] of turn rates and accelerations with mu = H^-1 v, zero after the end of a game.
template <class T, int N>
void solve_adjoint(const Group<T, N>& g, const Factors<T>& factors, Vec<T>* turn, Vec<T>* thrust) {
    const int n = g.count.agents(), m = 2 * n, ld = 3 * m;
    Vec<T>*y = g.arena.take(ld), *h = g.arena.take(g.K * m);
    Motion<T>* Z = reinterpret_cast<Motion<T>*>(g.arena.take(4 * n));
    for (int e = 0; e < ld; ++e) y[e] = Vec<T>{};
    for (int k = g.K - 1; k >= 0; --k) {
        g.motions(k, Z);
        for (int i = 0; i < n; ++i) {
            h[k * m + 2 * i] = -turn[i * g.K + k];
            h[k * m + 2 * i + 1] = -thrust[i * g.K + k];
        }
        if (g.cut)
            for (int r = 0; r < m; ++r) h[k * m + r] = g.has_step(k) ? h[k * m + r] : Vec<T>{};
        pull_linear(
            g.count, factors.L + std::size_t(k) * m * m, factors.G + std::size_t(k) * m * ld, g.dt, Z, k == 0, y, h + k * m);
    }
    push(g, factors, h, turn, thrust);
}

/// Computes the energy and the squared norm of its gradient.
template <class T, int N>
void evaluate(const Group<T, N>& g, Vec<T>& energy, Vec<T>& squared_norm) {
    const int n = g.count.agents(), m = 2 * n;
    Vec<T>* y = g.arena.take(3 * m);  // gradients by positions, by (heading, speed) and by the controls before the state
    Motion<T>* Z = reinterpret_cast<Motion<T>*>(g.arena.take(4 * n));
    ControlCosts<T> costs(g.arena, n);
    for (int e = 0; e < 3 * m; ++e) y[e] = Vec<T>{};
    energy = squared_norm = Vec<T>{};
    for (int k = g.K - 1; k >= 0; --k) {
        g.enter(k);
        energy += add_state_costs<T, N>(g, k + 1, false, nullptr, y);
        costs.set(g, k, false);
        energy += costs.energy;
        g.motions(k, Z);
        for (int r = 0; r < m; ++r) {
            const Vec<T> slope = costs.pull[r] + y[2 * m + r] + g.dt * y[m + r];
            squared_norm += slope * slope;
            y[2 * m + r] = -costs.rate_pull[r];
        }
        for (int i = 0; i < n; ++i) {
            y[m + 2 * i] += Z[i].x_heading * y[2 * i] + Z[i].y_heading * y[2 * i + 1];
            y[m + 2 * i + 1] += Z[i].x_speed * y[2 * i] + Z[i].y_speed * y[2 * i + 1] + costs.speed_pull[i];
        }
    }
}

/// The part of `differentiate` that belongs to an overlap of discs, at one state: adds to the cotangents `sums` [n, 6] of positions
/// and to the gradients by the pairs' weights and margins.
template <class T, int N>
INLINE void differentiate_discs(
    const Group<T, N>& g, int feature, int state, const std::vector<Tangent<T>>& first, const std::vector<Tangent<T>>& second,
    Vec<T>* sums, const ParameterGradients<T>& by) {
    const int n = g.count.agents();
    int pair = feature * g.pairs;
    for (int i = 0; i < n; ++i)
        for (int j = i + 1; j < n; ++j, ++pair) {
            const Vec<T> dx = g.path[i].x[state] - g.path[j].x[state], dy = g.path[i].y[state] - g.path[j].y[state];
            const Vec<T> reach = g.reach[pair];
            if (!any<T>(dx * dx + dy * dy < reach * reach)) continue;
            const Contact<T> contact(dx, dy, reach);
            const Vec<T> nx = contact.x, ny = contact.y, zero{};
            const Vec<T> inverse = contact.active && contact.distance > 0 ? T(1) / contact.distance : zero;
            const Vec<T> q1x = first[i].x[state] - first[j].x[state], q1y = first[i].y[state] - first[j].y[state];
            const Vec<T> q2x = second[i].x[state] - second[j].x[state], q2y = second[i].y[state] - second[j].y[state];
            const Vec<T> t1 = nx * q1x + ny * q1y, t2 = nx * q2x + ny * q2y;
            const Vec<T> w = g.pair_weight[pair], squared = w * w, h = contact.active ? contact.depth - t2 : zero;
            const Vec<T> turn1 = squared * h * inverse, turn2 = squared * t1 * inverse, push = squared * t1;
            const Vec<T> P[6] = {
                turn1 * (q1x - t1 * nx) - turn2 * (q2x - t2 * nx) - push * nx,
                turn1 * (q1y - t1 * ny) - turn2 * (q2y - t2 * ny) - push * ny,
                squared * h * nx, squared * h * ny, -push * nx, -push * ny};
            for (int e = 0; e < 6; ++e) {
                sums[6 * i + e] += P[e];
                sums[6 * j + e] -= P[e];
            }
            by.pair[pair] += T(2) * w * t1 * h;
            by.margin[pair] += push;
        }
}

/// The part of `differentiate` that belongs to the pair features of states, at one state; also adds to the cotangents `nodes` [n, 2]
/// of headings and speeds.
template <class T>
NOINLINE void differentiate_state_pairs(
    const Games<T>& g, int state, const std::vector<Tangent<T>>& first, const std::vector<Tangent<T>>& second, Vec<T>* sums,
    Vec<T>* nodes, const ParameterGradients<T>& by) {
    const int n = g.n;
    for (int feature = 0; feature < PAIR_COUNT; ++feature) {
        if (of_discs(feature) || !g.has_pair(feature)) continue;
        int pair = 0;
        for (int i = 0; i < n; ++i)
            for (int j = i + 1; j < n; ++j, ++pair) {
                if (!g.in_range(feature, pair, i, j, state)) continue;
                PairValue<Dual<T>> d;
                const int entry = feature * g.pairs + pair;
                evaluate_pair<T, Dual<T>>(
                    feature, g.body(i, state, first[i], second[i]), g.body(j, state, first[j], second[j]),
                    Dual<T>{g.margin[entry], Vec<T>{}, Vec<T>{}}, d);
                // phi = -w^2 (g mu) (f + g d) with the gradient g of the feature f.
                const Vec<T> w = g.pair_weight[entry], squared = w * w, along_mu = d.value.a, ahead = d.value.v + d.value.b;
                const auto slope = [&](int e) { return -squared * (d.by[e].a * ahead + along_mu * (d.by[e].v + d.by[e].b)); };
                const int both[2] = {i, j};
                for (int side = 0; side < 2; ++side) {
                    Vec<T>* s = sums + 6 * both[side];
                    for (int axis = 0; axis < 2; ++axis) {
                        const int e = 4 * side + axis;
                        s[axis] += slope(e);
                        s[2 + axis] -= squared * ahead * d.by[e].v;
                        s[4 + axis] -= squared * along_mu * d.by[e].v;
                        nodes[2 * both[side] + axis] += slope(e + 2);
                    }
                }
                by.pair[entry] -= T(2) * w * along_mu * ahead;
                by.margin[entry] += slope(MARGIN);
            }
    }
}

/// Adds the gradient of phi = -<J mu, r + J d>, with mu and d held constant: by the controls to the cotangent [n, K] (`bar_turn`,
/// `bar_thrust`), and by the parameters to `by`.
///
/// The loop runs backwards in time. It sums the derivatives of phi by positions (P), by the tangents of positions along mu (P1) and
/// along d (P2), and by speeds. These suffix sums are backpropagated through the rollout to the controls.
template <class T, int N>
void differentiate(
    const Group<T, N>& g, Vec<T>* mu_turn, Vec<T>* mu_thrust, Vec<T>* d_turn, Vec<T>* d_thrust, Vec<T>* bar_turn,
    Vec<T>* bar_thrust, const ParameterGradients<T>& by) {
    const int n = g.count.agents(), K = g.K;
    const T dt = g.dt, per_dt = T(1) / dt;
    std::vector<Tangent<T>> first, second;  // along mu, along d
    for (int i = 0; i < n; ++i) {
        first.push_back(g.new_tangent(mu_turn + i * K, mu_thrust + i * K));
        second.push_back(g.new_tangent(d_turn + i * K, d_thrust + i * K));
        g.roll_tangent(i, first[i]);
        g.roll_tangent(i, second[i]);
    }
    Vec<T>* sums = g.arena.take(6 * n);  // suffix sums of P, P1, P2 (x, y)
    Vec<T>* nodes = g.arena.take(2 * n);  // suffix sums of the cotangents of headings and speeds
    for (int e = 0; e < 6 * n; ++e) sums[e] = Vec<T>{};
    for (int e = 0; e < 2 * n; ++e) nodes[e] = Vec<T>{};
    for (int k = K - 1; k >= 0; --k) {
        const int state = k + 1;
        g.enter(k);
        for (int i = 0; i < n; ++i) {
            const Path<T>& p = g.path[i];
            const Tangent<T>&t1 = first[i], &t2 = second[i];
            Vec<T>* s = sums + 6 * i;
            const auto weigh = [&](int feature) -> Vec<T>& { return by.own[feature * n + i]; };
            if (state < K) {
                // The heading and speed at `state` affect all later positions, whose derivatives have been summed so far.
                const Vec<T> c = p.cosine[state], si = p.sine[state], v = p.speed[state];
                const Vec<T> along0 = c * s[0] + si * s[1], across0 = c * s[1] - si * s[0];
                const Vec<T> along1 = c * s[2] + si * s[3], across1 = c * s[3] - si * s[2];
                const Vec<T> along2 = c * s[4] + si * s[5], across2 = c * s[5] - si * s[4];
                nodes[2 * i] += dt * (v * (across0 - along1 * t1.heading[state] - along2 * t2.heading[state]) +
                                      across1 * t1.speed[state] + across2 * t2.speed[state]);
                nodes[2 * i + 1] += dt * (along0 + across1 * t1.heading[state] + across2 * t2.heading[state]);
            }
            Adjoint<T> speed{t1.speed[state], t2.speed[state]};
            if (g.has(VEL)) speed.add(g.own(VEL, i), p.speed[state], weigh(VEL));
            if (g.has(VELREF)) speed.add(g.own(VELREF, i), p.speed[state] - g.reference_speed[i], weigh(VELREF));
            if (g.has(VELB)) speed.add_bounded(g.own(VELB, i), p.speed[state], g.game.bounds[BOUND_VEL], weigh(VELB));
            nodes[2 * i + 1] += speed.cotangent;
            const auto pull_to = [&](int feature, Vec<T> w, Vec<T> x, Vec<T> y, Vec<T> tangent_x, Vec<T> tangent_y, bool slides) {
                // The nearest point of a reference line moves along the line with the agent. Along the line, the residual therefore
                // has the derivative zero. The Jacobian J has it as well if `slides`.
                const Vec<T> squared = w * w;
                const Vec<T> along_line = t1.x[state] * tangent_x + t1.y[state] * tangent_y;
                const Vec<T> across_x = t1.x[state] - along_line * tangent_x, across_y = t1.y[state] - along_line * tangent_y;
                Vec<T> mu_x = t1.x[state], mu_y = t1.y[state], gap_x = p.x[state] - x + t2.x[state], gap_y = p.y[state] - y + t2.y[state];
                if (slides) {
                    const Vec<T> ahead = t2.x[state] * tangent_x + t2.y[state] * tangent_y;
                    mu_x = across_x;
                    mu_y = across_y;
                    gap_x -= ahead * tangent_x;
                    gap_y -= ahead * tangent_y;
                }
                s[0] -= squared * across_x;
                s[1] -= squared * across_y;
                s[2] -= squared * gap_x;
                s[3] -= squared * gap_y;
                s[4] -= squared * mu_x;
                s[5] -= squared * mu_y;
                weigh(feature) -= T(2) * w * (mu_x * gap_x + mu_y * gap_y);
            };
            if (g.has(LANE)) {
                const int at = i * (K + 1) + state;
                pull_to(
                    LANE, g.own(LANE, i), g.nearest.x[at], g.nearest.y[at], g.nearest.tangent_x[at], g.nearest.tangent_y[at],
                    g.game.lane_slides != 0);
            }
            if (g.has(GOAL) && g.ends_at(state)) {
                const Vec<T> w = g.final_weight(GOAL, i, state);
                pull_to(GOAL, w, g.goal_x[i], g.goal_y[i], Vec<T>{}, Vec<T>{}, false);
                const Vec<T> squared = w * w;
                by.goal_x[i] += squared * t1.x[state];
                by.goal_y[i] += squared * t1.y[state];
            }
            if (g.has(HEADING) && g.ends_at(state)) {
                const Vec<T> w = g.final_weight(HEADING, i, state);
                Adjoint<T> heading{t1.heading[state], t2.heading[state]};
                heading.add(w, p.heading[state] - g.goal_heading[i], weigh(HEADING));
                nodes[2 * i] += heading.cotangent;
                by.goal_heading[i] -= heading.cotangent;
            }
        }
        if (g.pairs_count_at(state))
            for (const int feature : {PROXIMITY, CLEARANCE})
                if (g.has_pair(feature)) differentiate_discs(g, feature, state, first, second, sums, by);
        if (g.state_pairs && g.pairs_count_at(state)) differentiate_state_pairs<T>(g, state, first, second, sums, nodes, by);
        for (int i = 0; i < n; ++i) {
            const Tangent<T>&t1 = first[i], &t2 = second[i];
            const auto weigh = [&](int feature) -> Vec<T>& { return by.own[feature * n + i]; };
            bar_turn[i * K + k] += dt * nodes[2 * i];
            bar_thrust[i * K + k] += dt * nodes[2 * i + 1];
            for (const int channel : {ACCELERATION, TURN_RATE}) {
                const Vec<T>* control = (channel ? g.turn : g.thrust) + i * K;
                const Vec<T>*along_mu = channel ? t1.turn : t1.thrust, *along_d = channel ? t2.turn : t2.thrust;
                Vec<T>* bar = (channel ? bar_turn : bar_thrust) + i * K;
                const int plain = channel ? TURNR : ACC, bounded = channel ? TURNRB : ACCB, reference = channel ? TURNRREF : ACCREF;
                Adjoint<T> own{along_mu[k], along_d[k]};
                if (g.has(plain)) own.add(g.own(plain, i), control[k], weigh(plain));
                if (g.has(reference)) {
                    Adjoint<T> deviation{along_mu[k], along_d[k]};
                    deviation.add(g.own(reference, i), g.deviation(channel, i, k), weigh(reference));
                    own.cotangent += deviation.cotangent;
                    (channel ? by.reference_turn : by.reference_thrust)[i * K + k] -= deviation.cotangent;
                }
                if (g.has(bounded))
                    own.add_bounded(g.own(bounded, i), control[k], g.game.bounds[channel ? BOUND_TURNR : BOUND_ACC], weigh(bounded));
                bar[k] += own.cotangent;
                if (k == 0) continue;
                const int rate = channel ? TURNACC : JERK, rate_bounded = channel ? TURNACCB : JERKB;
                const Vec<T> value = g.rate(control, k);
                Adjoint<T> change{(along_mu[k] - along_mu[k - 1]) * per_dt, (along_d[k] - along_d[k - 1]) * per_dt};
                if (g.has(rate)) change.add(g.own(rate, i), value, weigh(rate));
                if (g.has(rate_bounded))
                    change.add_bounded(g.own(rate_bounded, i), value, g.game.bounds[channel ? BOUND_TURNACC : BOUND_JERK], weigh(rate_bounded));
                bar[k] += per_dt * change.cotangent;
                bar[k - 1] -= per_dt * change.cotangent;
            }
            if (!g.has(STEER)) continue;
            const Steering<T> steer(g.wheelbase[i], g.turn[i * K + k], g.path[i].speed[k]);
            const Vec<T> w = g.own(STEER, i), squared = w * w;
            const Vec<T> s1 = steer.by_turn * t1.turn[k] + steer.by_speed * t1.speed[k];
            const Vec<T> s2 = steer.by_turn * t2.turn[k] + steer.by_speed * t2.speed[k];
            const Vec<T> value = steer.value + s2;
            const auto slope = [&](Vec<T> by_self, Vec<T> by_turn, Vec<T> by_speed) {
                const Vec<T> s1_moves = by_turn * t1.turn[k] + by_speed * t1.speed[k];
                const Vec<T> s2_moves = by_turn * t2.turn[k] + by_speed * t2.speed[k];
                return -squared * (s1_moves * value + s1 * (by_self + s2_moves));
            };
            bar_turn[i * K + k] += slope(steer.by_turn, steer.turn_turn, steer.turn_speed);
            // The next iteration of the loop backpropagates the derivative by the speed before this step. The first speed is given.
            if (k > 0) nodes[2 * i + 1] += slope(steer.by_speed, steer.turn_speed, steer.speed_speed);
            weigh(STEER) -= T(2) * w * s1 * value;
        }
    }
}

}  // namespace EPO_LEVEL
