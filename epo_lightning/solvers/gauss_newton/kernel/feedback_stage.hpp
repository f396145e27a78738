// One stage of the LQ games around trajectories of driving games: dynamics and costs of every agent, and the derivative of a loss by
// trajectories and parameters through them. Costs leave out second derivatives of residuals (Gauss-Newton).
#pragma once

#include "gradients.hpp"
#include "group.hpp"
#include "lq_recursion.hpp"

namespace EPO_LEVEL {
namespace lq {

using Game = Games<double>;

/// Entries of the states of a pair, in the order of `Slope`: those on which an overlap of discs depends.
constexpr int kPositions[] = {X1, Y1, X2, Y2};

/// Calls call(feature, pair, i, j) for every pair feature that counts at a state, and every pair within its range there.
template <class Call>
INLINE void for_each_contact(const Game& g, int state, const Call& call) {
    if (!g.pairs_count_at(state)) return;
    for (int feature = 0; feature < PAIR_COUNT; ++feature) {
        if (!g.has_pair(feature)) continue;
        int pair = 0;
        for (int i = 0; i < g.n; ++i)
            for (int j = i + 1; j < g.n; ++j, ++pair)
                if (g.in_range(feature, pair, i, j, state)) call(feature, pair, i, j);
    }
}

/// Adds half the square of a residual to the cost [8, 9] of a pair, from its derivatives by E entries of the two states.
template <int E>
INLINE void add_residual(const int (&at)[E], const V (&slopes)[E], V residual, V* cost) {
    for (int a = 0; a < E; ++a) {
        for (int b = 0; b < E; ++b) cost[9 * at[a] + at[b]] += slopes[a] * slopes[b];
        cost[9 * at[a] + 8] += slopes[a] * residual;
    }
}

NOINLINE inline void add_state_pair(const Game& g, int feature, int pair, int i, int j, int state, V* cost) {
    PairValue<V> found;
    const int entry = feature * g.pairs + pair;
    evaluate_pair<double, V>(feature, g.body(i, state), g.body(j, state), g.margin[entry], found);
    const int all[8] = {X1, Y1, HEADING1, SPEED1, X2, Y2, HEADING2, SPEED2};
    V slopes[8];
    for (int e = 0; e < 8; ++e) slopes[e] = g.pair_weight[entry] * found.by[e];
    add_residual(all, slopes, g.pair_weight[entry] * found.value, cost);
}

/// Writes the stage of step k: its dynamics, and the costs of its controls and of the state after it.
template <int N>
INLINE void expand(const Game& g, const Sizes<N>& size, double rho, int k, Stage<N>& stage) {
    const int agents = size.agents(), state = k + 1;
    const V dt = splat<double>(g.dt);
    g.set_weights(k);
    clear(stage.A, 16 * agents);
    clear(stage.B, 8 * agents);
    clear(stage.own_cost, 20 * agents);
    clear(stage.pair_cost, 72 * size.pairs());
    clear(stage.effort, 4 * agents);
    for (int i = 0; i < agents; ++i) {
        const Path<double>& p = g.path[i];
        V *A = stage.A + 16 * i, *B = stage.B + 8 * i, *cost = stage.own_cost + 20 * i;
        const V across = dt * p.speed[k];
        for (int a = 0; a < kState; ++a) A[5 * a] = splat(1.0);
        A[2] = -across * p.sine[k];
        A[3] = dt * p.cosine[k];
        A[6] = across * p.cosine[k];
        A[7] = dt * p.sine[k];
        B[2 * 2 + TURN_RATE] = dt;
        B[2 * 3 + ACCELERATION] = dt;
        const StateModels<double> own = g.state_models(i, state);
        const Model<double>* const models[kState] = {&own.x, &own.y, &own.heading, &own.speed};
        for (int a = 0; a < kState; ++a) {
            cost[6 * a] = models[a]->stiffness;
            cost[5 * a + 4] = models[a]->pull;
        }
        if (g.has(LANE) && g.game.lane_slides) {  // the nearest point of the line moves with the agent
            const int at = i * (g.K + 1) + state;
            const V tangent[2] = {g.own(LANE, i) * g.nearest.tangent_x[at], g.own(LANE, i) * g.nearest.tangent_y[at]};
            for (int a = 0; a < 2; ++a)
                for (int b = 0; b < 2; ++b) cost[5 * a + b] -= tangent[a] * tangent[b];
        }
        for (const int channel : {ACCELERATION, TURN_RATE}) {
            const Model<double> control = g.control_model(channel, i, k);
            stage.effort[4 * i + 3 * channel] = control.stiffness;
            stage.push[2 * i + channel] = control.pull;
        }
        stage.free[i] = g.cut ? g.has_step(k) : V{} == V{};
    }
    stage.rho = g.cut ? (g.has_step(k) ? splat(rho) : V{}) : splat(rho);
    for_each_contact(g, state, [&](int feature, int pair, int i, int j) {
        V* const cost = stage.pair_cost + 72 * pair;
        if (!of_discs(feature)) return add_state_pair(g, feature, pair, i, j, state, cost);
        const Contact<double> contact(
            g.path[i].x[state] - g.path[j].x[state], g.path[i].y[state] - g.path[j].y[state], g.reach[feature * g.pairs + pair]);
        const V weight = g.pair_weight[feature * g.pairs + pair], x = weight * contact.x, y = weight * contact.y;
        add_residual(kPositions, {-x, -y, x, y}, weight * contact.depth, cost);
    });
}

/// The derivative of a loss by one signal, from its derivatives by the stiffness and the pull of the signal's model. Adding a feature
/// also adds to the gradient by its weight.
struct ModelBar {
    V by_stiffness, by_pull, by_value{};
    INLINE void add(V weight, V value, V& by_weight) {
        by_value += weight * weight * by_pull;
        by_weight += 2.0 * weight * (by_stiffness + by_pull * value);
    }
    INLINE void add_bounded(V weight, V value, const double* bound, V& by_weight) {
        V excess, slope;
        violation<double>(value, bound, excess, slope);
        by_value += weight * weight * slope * slope * by_pull;
        by_weight += 2.0 * weight * slope * (slope * by_stiffness + by_pull * excess);
    }
};

/// The derivative of a loss by the trajectories: by their states [K + 1, N, 4], apart from what the states do to later ones, and by
/// their controls [K, m], apart from what these do to states.
struct TrajectoryBar {
    V *states, *controls;
};

/// The part of `pull_back_expansion` that belongs to an overlap of discs; `bar` is the derivative by the cost [8, 9] of the pair.
INLINE void pull_back_discs(
    const Game& g, int feature, int pair, int i, int j, int state, const V* bar, V* first, V* second,
    const ParameterGradients<double>& by) {
    const int entry = feature * g.pairs + pair;
    const Contact<double> contact(g.path[i].x[state] - g.path[j].x[state], g.path[i].y[state] - g.path[j].y[state], g.reach[entry]);
    // The loss is w^2 (n' Q n - depth n' q): Q and q are the derivatives by the cost, as a function of the relative position.
    const V n[2] = {contact.x, contact.y}, depth = contact.depth, w = contact.active ? g.pair_weight[entry] : V{}, squared = w * w;
    V q[2], turned[2], both{}, along{};  // turned = (Q + Q') n - depth q
    for (int a = 0; a < 2; ++a) {
        q[a] = bar[9 * a + 8] - bar[9 * (4 + a) + 8];
        turned[a] = -depth * q[a];
        for (int b = 0; b < 2; ++b) {
            const auto relative = [&](int r, int c) {
                return bar[9 * r + c] - bar[9 * r + 4 + c] - bar[9 * (4 + r) + c] + bar[9 * (4 + r) + 4 + c];
            };
            turned[a] += (relative(a, b) + relative(b, a)) * n[b];
            both += n[a] * relative(a, b) * n[b];
        }
        along += n[a] * q[a];
    }
    const V inverse = contact.active && contact.distance > 0 ? 1.0 / contact.distance : V{};
    const V projected = n[0] * turned[0] + n[1] * turned[1];
    for (int a = 0; a < 2; ++a) {
        const V slope = squared * (inverse * (turned[a] - projected * n[a]) + along * n[a]);
        first[a] += slope;
        second[a] -= slope;
    }
    by.pair[entry] += 2.0 * w * (both - depth * along);
    by.margin[entry] -= squared * along;
}

/// The part of `pull_back_expansion` that belongs to a pair feature of states; arguments as for `pull_back_discs`.
NOINLINE inline void pull_back_state_pair(
    const Game& g, int feature, int pair, int i, int j, int state, const V* bar, V* first, V* second,
    const ParameterGradients<double>& by) {
    const int entry = feature * g.pairs + pair;
    PairValue<V> found;
    evaluate_pair<double, V>(feature, g.body(i, state), g.body(j, state), g.margin[entry], found);
    const V w = found.value != 0 ? g.pair_weight[entry] : V{}, squared = w * w;
    // The loss is w^2 (d' Q d + f d' q) with the feature f and its gradient d. Its derivative by d is w^2 times `along`.
    V along[8], both{}, pull{};
    for (int a = 0; a < 8; ++a) {
        along[a] = found.value * bar[9 * a + 8];
        for (int b = 0; b < 8; ++b) {
            along[a] += (bar[9 * a + b] + bar[9 * b + a]) * found.by[b];
            both += found.by[a] * bar[9 * a + b] * found.by[b];
        }
        pull += found.by[a] * bar[9 * a + 8];
    }
    // The derivative of d along this direction of the states is the Hessian times the direction.
    const auto moved = [&](int agent, const V* way) -> Body<double, Dual<double>> {
        const Path<double>& p = g.path[agent];
        const V c = p.cosine[state], s = p.sine[state], none{};
        return {{p.x[state], way[0], none}, {p.y[state], way[1], none}, {c, -s * way[2], none}, {s, c * way[2], none},
                {p.speed[state], way[3], none}, g.length[agent], g.width[agent]};
    };
    PairValue<Dual<double>> d;
    evaluate_pair<double, Dual<double>>(feature, moved(i, along), moved(j, along + 4), Dual<double>{g.margin[entry], V{}, V{}}, d);
    for (int e = 0; e < 8; ++e) (e < 4 ? first : second)[e % 4] += squared * (d.by[e].a + pull * found.by[e]);
    by.margin[entry] += squared * (d.by[MARGIN].a + pull * found.by[MARGIN]);
    by.pair[entry] += 2.0 * w * (both + found.value * pull);
}

/// Adds the derivative of a loss by the stage of step k, `bar`, to those by the trajectories and by the parameters. Call
/// `expand` for the same step first: it sets the weights.
template <int N>
INLINE void pull_back_expansion(
    const Game& g, const Sizes<N>& size, int k, const Stage<N>& bar, const TrajectoryBar& to, const ParameterGradients<double>& by) {
    const int agents = size.agents(), state = k + 1;
    const V dt = splat<double>(g.dt);
    for (int i = 0; i < agents; ++i) {
        const Path<double>& p = g.path[i];
        const auto weigh = [&](int feature) INLINE_LAMBDA -> V& { return by.own[feature * agents + i]; };
        const V *A = bar.A + 16 * i, *cost = bar.own_cost + 20 * i, c = p.cosine[k], s = p.sine[k];
        V *before = to.states + (k * agents + i) * kState, *after = to.states + (state * agents + i) * kState;
        before[2] -= dt * (p.speed[k] * (c * A[2] + s * A[6]) + s * A[3] - c * A[7]);
        before[3] += dt * (c * A[6] - s * A[2]);
        // Positions: the costs of reference lines and of goals.
        ModelBar in[2] = {{cost[0], cost[4]}, {cost[6], cost[9]}};
        const V at[2] = {p.x[state], p.y[state]};
        if (g.has(LANE)) {
            const int near = i * (g.K + 1) + state;
            const V point[2] = {g.nearest.x[near], g.nearest.y[near]}, tangent[2] = {g.nearest.tangent_x[near], g.nearest.tangent_y[near]};
            V pulled = V{};
            for (int a = 0; a < 2; ++a) {
                in[a].add(g.own(LANE, i), at[a] - point[a], weigh(LANE));
                pulled += tangent[a] * in[a].by_value;
                for (int b = 0; b < 2 && g.game.lane_slides; ++b)
                    weigh(LANE) -= 2.0 * g.own(LANE, i) * tangent[a] * tangent[b] * cost[5 * a + b];
            }
            for (int a = 0; a < 2; ++a) in[a].by_value -= pulled * tangent[a];  // the point moves along the line with the agent
        }
        if (g.has(GOAL) && g.ends_at(state)) {
            const V weight = g.final_weight(GOAL, i, state), goal[2] = {g.goal_x[i], g.goal_y[i]};
            V* const by_goal[2] = {&by.goal_x[i], &by.goal_y[i]};
            for (int a = 0; a < 2; ++a) {
                in[a].add(weight, at[a] - goal[a], weigh(GOAL));
                *by_goal[a] -= weight * weight * in[a].by_pull;
            }
        }
        after[0] += in[0].by_value;
        after[1] += in[1].by_value;
        if (g.has(HEADING) && g.ends_at(state)) {
            ModelBar heading{cost[12], cost[14]};
            heading.add(g.final_weight(HEADING, i, state), p.heading[state] - g.goal_heading[i], weigh(HEADING));
            after[2] += heading.by_value;
            by.goal_heading[i] -= heading.by_value;
        }
        ModelBar speed{cost[18], cost[19]};
        if (g.has(VEL)) speed.add(g.own(VEL, i), p.speed[state], weigh(VEL));
        if (g.has(VELREF)) speed.add(g.own(VELREF, i), p.speed[state] - g.reference_speed[i], weigh(VELREF));
        if (g.has(VELB)) speed.add_bounded(g.own(VELB, i), p.speed[state], g.game.bounds[BOUND_VEL], weigh(VELB));
        after[3] += speed.by_value;
        for (const int channel : {ACCELERATION, TURN_RATE}) {
            const int plain = channel ? TURNR : ACC, bounded = channel ? TURNRB : ACCB, reference = channel ? TURNRREF : ACCREF;
            const V value = (channel ? g.turn : g.thrust)[i * g.K + k];
            const V by_stiffness = bar.effort[4 * i + 3 * channel], by_pull = bar.push[2 * i + channel];
            ModelBar control{by_stiffness, by_pull}, deviation{by_stiffness, by_pull};
            if (g.has(plain)) control.add(g.own(plain, i), value, weigh(plain));
            if (g.has(bounded))
                control.add_bounded(g.own(bounded, i), value, g.game.bounds[channel ? BOUND_TURNR : BOUND_ACC], weigh(bounded));
            if (g.has(reference)) {
                deviation.add(g.own(reference, i), g.deviation(channel, i, k), weigh(reference));
                (channel ? by.reference_turn : by.reference_thrust)[i * g.K + k] -= deviation.by_value;
            }
            to.controls[(k * agents + i) * kControl + channel] += control.by_value + deviation.by_value;
        }
    }
    for_each_contact(g, state, [&](int feature, int pair, int i, int j) {
        V *first = to.states + (state * agents + i) * kState, *second = to.states + (state * agents + j) * kState;
        const V* cost = bar.pair_cost + 72 * pair;
        (of_discs(feature) ? pull_back_discs : pull_back_state_pair)(g, feature, pair, i, j, state, cost, first, second, by);
    });
}

/// Takes the derivative by states through the rollout to the controls, and adds it to that by the controls.
INLINE void pull_back_rollout(const Game& g, const TrajectoryBar& bar) {
    const V dt = splat<double>(g.dt);
    for (int i = 0; i < g.n; ++i) {
        const Path<double>& p = g.path[i];
        V x{}, y{}, heading{}, speed{};
        for (int k = g.K - 1; k >= 0; --k) {
            const V* state = bar.states + ((k + 1) * g.n + i) * kState;
            V* control = bar.controls + (k * g.n + i) * kControl;
            x += state[0];
            y += state[1];
            heading += state[2];
            speed += state[3];
            control[TURN_RATE] += dt * heading;
            control[ACCELERATION] += dt * speed;
            heading += dt * p.speed[k] * (p.cosine[k] * y - p.sine[k] * x);
            speed += dt * (p.cosine[k] * x + p.sine[k] * y);
        }
    }
}

}  // namespace lq
}  // namespace EPO_LEVEL
