// W independent games of n agents side by side: their parameters, trajectories and features, step by step.
#pragma once

#include <algorithm>
#include <cstddef>
#include <vector>

#include "buffers.hpp"
#include "game.hpp"
#include "lanes.hpp"
#include "pairs.hpp"
#include "riccati.hpp"

namespace EPO_LEVEL {

/// A trajectory: heading, speed, sine and cosine of the heading, position, at steps 0 .. K.
template <class T>
struct Path {
    Vec<T>*heading, *speed, *sine, *cosine, *x, *y;
};

/// Sums of the changes of an agent's state since the start. The changes are summed on their own and then added to the initial state:
/// if each small change were added to a large coordinate, most of its digits would be lost to rounding.
template <class T>
struct Moved {
    Vec<T> x{}, y{}, turned{}, faster{};

    /// Writes the sine and cosine at step k of a trajectory, and the state after the step.
    INLINE void advance(const Path<T>& p, int k, T dt, Vec<T> turn, Vec<T> thrust) {
        sincos<T>(p.heading[k], p.sine[k], p.cosine[k]);
        x += dt * p.speed[k] * p.cosine[k];
        y += dt * p.speed[k] * p.sine[k];
        turned += dt * turn;
        faster += dt * thrust;
        p.x[k + 1] = p.x[0] + x;
        p.y[k + 1] = p.y[0] + y;
        p.heading[k + 1] = p.heading[0] + turned;
        p.speed[k + 1] = p.speed[0] + faster;
    }
};

/// Tangent of a trajectory: its derivative along a direction of the controls.
template <class T>
struct Tangent {
    Vec<T>*turn, *thrust;                // the direction [K]
    Vec<T>*heading, *speed, *x, *y;      // [K + 1]
};

/// Violation of the bounds [low, high] by a signal, and its derivative: 1 above, -1 below, 0 within.
template <class T>
INLINE void violation(Vec<T> value, const double* bound, Vec<T>& excess, Vec<T>& slope) {
    const T low = T(bound[0]), high = T(bound[1]);
    const Vec<T> zero{}, one = splat<T>(1);
    excess = most<T>(value - high, zero) + most<T>(low - value, zero);
    slope = (value > high ? one : zero) - (value < low ? one : zero);
}

/// Index of a control of agent i among the m unknowns of a step, which are in the order (heading, speed).
INLINE int unknown(int i, int channel) { return 2 * i + (channel == ACCELERATION); }

/// Gauss-Newton model of half the sum of squared residuals of one signal: the energy, its first derivative (pull) and its second
/// derivative (stiffness).
template <class T>
struct Model {
    Vec<T> energy{}, pull{}, stiffness{};
    INLINE void add(Vec<T> weight, Vec<T> value) {
        const Vec<T> w = weight * weight;
        energy += T(0.5) * w * value * value;
        pull += w * value;
        stiffness += w;
    }
    INLINE void add_bounded(Vec<T> weight, Vec<T> value, const double* bound) {
        Vec<T> excess, slope;
        violation<T>(value, bound, excess, slope);
        const Vec<T> w = weight * weight;
        energy += T(0.5) * w * excess * excess;
        pull += w * slope * excess;
        stiffness += w * slope * slope;
    }
};

/// Models of the costs of one state of an agent by its position, heading and speed.
template <class T>
struct StateModels {
    Model<T> x, y, heading, speed;
};

/// Derivative of phi = -<J mu, r + J d> by one signal (the cotangent of the signal). Adding a feature also adds to the gradient by
/// its weight.
template <class T>
struct Adjoint {
    Vec<T> along_mu, along_d, cotangent{};
    INLINE void add(Vec<T> weight, Vec<T> value, Vec<T>& by_weight) {
        cotangent -= weight * weight * along_mu;
        by_weight -= T(2) * weight * along_mu * (value + along_d);
    }
    INLINE void add_bounded(Vec<T> weight, Vec<T> value, const double* bound, Vec<T>& by_weight) {
        Vec<T> excess, slope;
        violation<T>(value, bound, excess, slope);
        cotangent -= weight * weight * slope * slope * along_mu;
        by_weight -= T(2) * weight * slope * along_mu * (excess + slope * along_d);
    }
};

/// Equivalent steering angle atan(q omega), q = wheelbase / max(v, kSlowestSteering), with its first two derivatives.
template <class T>
struct Steering {
    Vec<T> value, by_turn, by_speed, turn_turn, turn_speed, speed_speed;
    INLINE Steering(Vec<T> wheelbase, Vec<T> turn, Vec<T> speed) {
        const Vec<T> one = splat<T>(1), slowest = splat<T>(T(kSlowestSteering)), zero{};
        const Mask<T> moving = speed > slowest;
        const Vec<T> inverse = one / (moving ? speed : slowest), q = wheelbase * inverse, t = q * turn;
        const Vec<T> d = one / (one + t * t);
        value = arctan<T>(t);
        by_turn = q * d;
        turn_turn = T(-2) * q * q * t * d * d;
        by_speed = moving ? -t * d * inverse : zero;
        turn_speed = moving ? q * d * inverse * (T(2) * t * t * d - one) : zero;
        speed_speed = moving ? T(2) * t * d * d * inverse * inverse : zero;
    }
};

/// Overlap of two agents at one step: its depth, and the unit vector from the second agent to the first.
template <class T>
struct Contact {
    Mask<T> active;
    Vec<T> distance, depth, x, y;
    INLINE Contact(Vec<T> dx, Vec<T> dy, Vec<T> reach) {
        const Vec<T> zero{}, one = splat<T>(1);
        const Vec<T> squared = dx * dx + dy * dy;
        const Mask<T> apart = squared > 0;
        const Vec<T> safe = root<T>(apart ? squared : one);
        distance = apart ? safe : zero;
        active = reach > distance;
        // The direction between two agents at the same point is undefined: the feature has derivative zero there.
        const Vec<T> inverse = apart && active ? one / safe : zero;
        depth = active ? reach - distance : zero;
        x = dx * inverse;
        y = dy * inverse;
    }
};

/// Nearest points on the agents' reference lines, and the unit tangents along which they move (zero at corners).
template <class T>
struct Nearest {
    Vec<T>*x, *y, *tangent_x, *tangent_y;  // [n, K + 1], of which states 1 .. K are in use
    static std::size_t size(int n, int K) { return std::size_t(4) * n * (K + 1); }
    static Nearest at(Vec<T>* memory, int n, int K) {
        const int each = n * (K + 1);
        return {memory, memory + each, memory + 2 * each, memory + 3 * each};
    }
};

/// Whether a game has pair features that the kernel knows.
inline bool knows_pairs(const EpoGame& game) {
    for (const void* weights : game.pair)
        if (weights) return true;
    return false;
}

/// Whether a game has pair features.
inline bool interacts(const EpoGame& game) { return game.given_pairs || knows_pairs(game); }

/// Entry of an array [B, M, P] with strides.
template <class T>
INLINE T of_pair(const void* values, const int64_t* strides, int64_t b, int64_t m, int64_t pair) {
    return static_cast<const T*>(values)[b * strides[0] + m * strides[1] + pair * strides[2]];
}

/// W independent games of n agents, of which the first `movers` move; the others are held, and count only by their pairs with
/// agents that move. What it does does not gain from a number of agents that is known at compile time, so that it is compiled once
/// for all numbers.
template <class T>
struct Games {
    static constexpr int W = Lanes<T>::W;
    const EpoGame& game;
    const int movers, n, K, pairs;        // `pairs`: those with an agent that moves
    const bool coupled;                   // whether there is a pair feature
    const bool state_pairs;               // whether there is one of states, and not only of distances
    const bool cut;                       // whether games may end before step K
    const T dt;
    Arena<T>& arena;
    int problem[W], scene[W], mode[W], *agent;  // agent[i * W + lane]
    Vec<T>*weight;                        // [movers, OWN_COUNT]
    Vec<T>*pair_weight, *reach, *margin;  // [PAIR_COUNT, pairs]
    Vec<T>*length, *width;                // [n], only for pair features of states
    Vec<T>* whole;                        // the weights of agents and pairs, of which `enter` sets some to zero; only where `cut`
    Vec<T> end;                           // numbers of steps of the games; only where `cut`
    Vec<T>*goal_x, *goal_y, *goal_heading, *reference_speed, *wheelbase;  // [movers]
    Nearest<T> nearest;                   // of the movers: from `find_nearest`, or kept by an earlier call
    Vec<T>*turn, *thrust;                 // controls [n, K]
    Vec<T>*reference_turn, *reference_thrust;  // [movers, K], only for features of reference controls
    Vec<T>* given;                        // [movers, K, R, GIVEN_COUNT], only if there are given residuals
    Vec<T>* given_pairs;                  // [pairs, K / pair_stride, R', GIVEN_PAIR_COUNT], only if there are given ones of pairs
    Vec<T>*given_curvature, *given_pair_curvature;  // as in `EpoGame`, for steps with the Hessian
    std::vector<Path<T>> path;

    Vec<T> own(int feature, int i) const { return weight[i * OWN_COUNT + feature]; }
    bool has(int feature) const { return game.own[feature] != nullptr; }
    bool has_pair(int feature) const { return game.pair[feature] != nullptr; }

    /// Whether a game of some lane ends with this state, and the weight of a feature of the last state in these lanes.
    INLINE bool ends_at(int state) const { return cut ? any<T>(end == splat<T>(T(state))) : state == K; }
    INLINE Vec<T> final_weight(int feature, int i, int state) const {
        return cut ? (end == splat<T>(T(state)) ? own(feature, i) : Vec<T>{}) : own(feature, i);
    }

    /// The lanes whose games have a step k.
    INLINE Mask<T> has_step(int k) const { return end > splat<T>(T(k)); }

    /// Sets the weights to zero in lanes whose game has ended before step k, and to their values in the others. All costs of step k and
    /// of the state after it, and the rate from step k - 1 to step k, then vanish after the end of a game.
    INLINE void set_weights(int k) const {
        const Mask<T> live = has_step(k);
        for (int e = 0; cut && e < OWN_COUNT * movers + PAIR_COUNT * pairs; ++e) weight[e] = live ? whole[e] : Vec<T>{};
    }

    /// The same, in a loop over all steps that goes backwards.
    INLINE void enter(int k) const {
        if (cut && (k + 1 == K || any<T>(end == splat<T>(T(k + 1))))) set_weights(k);
    }

    /// Lane `lane` holds the row items[lane * (n + 1)]: the problem, then its agents. Lanes that are not in use repeat the rows
    /// in their order.
    NOINLINE Games(const EpoGame& game, Arena<T>& arena, int movers, int n, const int32_t* items, int filled, const T* controls)
        : game(game), movers(movers), n(n), K(int(game.K)), pairs(movers * n - movers * (movers + 1) / 2),
          coupled(interacts(game)), state_pairs(has_state_pairs(game)), cut(game.ends != nullptr), dt(T(game.dt)), arena(arena) {
        owners_.resize(n * W);
        agent = owners_.data();
        for (int lane = 0; lane < W; ++lane) {
            const int32_t* item = items + lane % filled * (n + 1);
            problem[lane] = item[0];
            scene[lane] = int(item[0] / game.M);
            mode[lane] = int(item[0] % game.M);
            for (int i = 0; i < n; ++i) agent[i * W + lane] = item[1 + i];
        }
        turn = arena.take(n * K);
        thrust = arena.take(n * K);
        load(n, controls, turn, thrust);
        for (int i = 0; i < n; ++i) path.push_back(new_path());
        start(path);
        roll(turn, thrust, path);
        for (int i = 0; state_pairs && i < n; ++i) sincos<T>(path[i].heading[K], path[i].sine[K], path[i].cosine[K]);
    }

    /// Read the first agents of [B, M, N, K, 2] into [agents, K] vectors.
    NOINLINE void load(int agents, const T* from, Vec<T>* turns, Vec<T>* thrusts) const {
        for (int i = 0; i < agents; ++i) {
            const T* rows[W];
            for (int lane = 0; lane < W; ++lane) rows[lane] = from + row_of(i, lane) * K * 2;
            gather<T>(rows, 2 * K, [&](int e, Vec<T> value) { (e % 2 ? turns : thrusts)[i * K + e / 2] = value; });
        }
    }

    /// Write [movers, K] vectors of the lanes whose bit is set in `lanes` to [B, M, N, K, 2].
    NOINLINE void store(const Vec<T>* turns, const Vec<T>* thrusts, uint32_t lanes, T* to) const {
        for (int i = 0; i < movers; ++i) {
            T* rows[W];
            for (int lane = 0; lane < W; ++lane)
                rows[lane] = lanes >> lane & 1 ? to + row_of(i, lane) * K * 2 : nullptr;
            scatter<T>([&](int e) { return (e % 2 ? turns : thrusts)[i * K + e / 2]; }, 2 * K, rows);
        }
    }

    /// Write the states 1 .. K of the first lanes to [B, M, N, K, 4].
    NOINLINE void store_states(int filled, T* to) const {
        for (int i = 0; i < n; ++i) {
            const Vec<T>* const entries[4] = {path[i].x, path[i].y, path[i].heading, path[i].speed};
            T* rows[W];
            for (int lane = 0; lane < W; ++lane) rows[lane] = lane < filled ? to + row_of(i, lane) * K * 4 : nullptr;
            scatter<T>([&](int e) { return entries[e % 4][e / 4 + 1]; }, 4 * K, rows);
        }
    }

    int64_t row_of(int i, int lane) const { return int64_t(problem[lane]) * game.N + agent[i * W + lane]; }

    /// Index of the pair of the agents a < c of a game among its P pairs.
    int64_t pair_of(int64_t a, int64_t c) const { return a * game.N - a * (a + 1) / 2 + c - a - 1; }

    Path<T> new_path() const {
        const int steps = K + 1;
        return {arena.take(steps), arena.take(steps), arena.take(steps), arena.take(steps), arena.take(steps), arena.take(steps)};
    }

    Tangent<T> new_tangent(Vec<T>* turns, Vec<T>* thrusts) const {
        const int steps = K + 1;
        return {turns, thrusts, arena.take(steps), arena.take(steps), arena.take(steps), arena.take(steps)};
    }

    /// Writes the states of all paths from the initial ones on, and the sines and cosines before the last state.
    NOINLINE void roll(const Vec<T>* turns, const Vec<T>* thrusts, const std::vector<Path<T>>& paths) const {
        for (int i = 0; i < n; ++i) {
            Moved<T> moved;
            for (int k = 0; k < K; ++k) moved.advance(paths[i], k, dt, turns[i * K + k], thrusts[i * K + k]);
        }
    }

    /// Writes the initial states of all paths.
    NOINLINE void start(const std::vector<Path<T>>& paths) const {
        for (int i = 0; i < n; ++i) {
            const Path<T>& p = paths[i];
            for (int lane = 0; lane < W; ++lane) {
                const T* initial =
                    static_cast<const T*>(game.initial) + scene[lane] * game.initial_b + agent[i * W + lane] * game.initial_n;
                p.x[0][lane] = initial[0];
                p.y[0][lane] = initial[1];
                p.heading[0][lane] = initial[2];
                p.speed[0][lane] = initial[3];
            }
        }
    }

    /// Computes the tangent of agent i's trajectory along its direction of the controls.
    void roll_tangent(int i, const Tangent<T>& t) const {
        const Path<T>& p = path[i];
        t.heading[0] = t.speed[0] = t.x[0] = t.y[0] = Vec<T>{};
        for (int k = 0; k < K; ++k) {
            const Vec<T> across = p.speed[k] * t.heading[k];
            t.x[k + 1] = t.x[k] + dt * (t.speed[k] * p.cosine[k] - across * p.sine[k]);
            t.y[k + 1] = t.y[k] + dt * (t.speed[k] * p.sine[k] + across * p.cosine[k]);
            t.heading[k + 1] = t.heading[k] + dt * t.turn[k];
            t.speed[k + 1] = t.speed[k] + dt * t.thrust[k];
        }
    }

    /// The matrix Z of step k for every agent that moves.
    void motions(int k, Motion<T>* Z) const {
        for (int i = 0; i < movers; ++i) {
            const Path<T>& p = path[i];
            const Vec<T> along = dt * p.speed[k];
            Z[i] = {-along * p.sine[k], along * p.cosine[k], dt * p.cosine[k], dt * p.sine[k]};
        }
    }

    /// Computes the nearest points of the movers' reference lines, with TANGENTS also the unit tangents there, and writes them to
    /// `found`.
    template <bool TANGENTS>
    NOINLINE void find_nearest(const Nearest<T>& found) {
        nearest = found;
        Vec<T>* segments = arena.take((game.points - 1) * 5);
        // Four states at a time: each segment is loaded once for all four, and the processor can overlap their comparisons.
        for (int i = 0; i < movers; ++i) {
            load_line(i, segments);
            int k = 1;
            for (; k + 4 <= K + 1; k += 4) find_nearest_at<TANGENTS, 4>(i, k, segments);
            for (; k <= K; ++k) find_nearest_at<TANGENTS, 1>(i, k, segments);
        }
    }

    bool pairs_count_at(int state) const { return coupled && state % game.pair_stride == 0; }

    /// Whether a pair may be within the range of a pair feature of states in some lane.
    INLINE bool in_range(int feature, int pair, int i, int j, int state) const {
        const Path<T>&p = path[i], &q = path[j];
        const Vec<T> dx = p.x[state] - q.x[state], dy = p.y[state] - q.y[state];
        const Vec<T> moving = most<T>(p.speed[state], -p.speed[state]) + most<T>(q.speed[state], -q.speed[state]);
        const Vec<T> range = reach[feature * pairs + pair] + T(look_ahead(feature)) * moving;
        return any<T>(dx * dx + dy * dy < range * range);
    }

    INLINE Body<T, Vec<T>> body(int i, int state) const {
        const Path<T>& p = path[i];
        return {p.x[state], p.y[state], p.cosine[state], p.sine[state], p.speed[state], length[i], width[i]};
    }

    /// The same with its derivatives by the entries `e` and `e + 1` of x, y, heading, speed; other numbers stand for no entry.
    INLINE Body<T, Dual<T>> shifted_body(int i, int state, int e) const {
        const Path<T>& p = path[i];
        const Vec<T> c = p.cosine[state], s = p.sine[state], one = splat<T>(1), zero{};
        const bool moves = e == 0, turns = e == 2;
        return {{p.x[state], moves ? one : zero, zero}, {p.y[state], zero, moves ? one : zero},
                {c, turns ? -s : zero, zero}, {s, turns ? c : zero, zero},
                {p.speed[state], zero, turns ? one : zero}, length[i], width[i]};
    }

    /// The same with its derivatives along the directions of two tangents.
    INLINE Body<T, Dual<T>> body(int i, int state, const Tangent<T>& a, const Tangent<T>& b) const {
        const Path<T>& p = path[i];
        const Vec<T> c = p.cosine[state], s = p.sine[state], turned_a = a.heading[state], turned_b = b.heading[state];
        return {{p.x[state], a.x[state], b.x[state]}, {p.y[state], a.y[state], b.y[state]},
                {c, -s * turned_a, -s * turned_b}, {s, c * turned_a, c * turned_b},
                {p.speed[state], a.speed[state], b.speed[state]}, length[i], width[i]};
    }

    INLINE Vec<T> rate(const Vec<T>* control, int k) const { return (control[k] - control[k - 1]) * (T(1) / dt); }

    /// The control of step k minus the reference control.
    INLINE Vec<T> deviation(int channel, int i, int k) const {
        return channel ? turn[i * K + k] - reference_turn[i * K + k] : thrust[i * K + k] - reference_thrust[i * K + k];
    }

    INLINE Model<T> control_model(int channel, int i, int k) const {
        Model<T> model;
        const Vec<T> value = channel ? turn[i * K + k] : thrust[i * K + k];
        const int plain = channel ? TURNR : ACC, bounded = channel ? TURNRB : ACCB, reference = channel ? TURNRREF : ACCREF;
        if (has(plain)) model.add(own(plain, i), value);
        if (has(reference)) model.add(own(reference, i), deviation(channel, i, k));
        if (has(bounded)) model.add_bounded(own(bounded, i), value, game.bounds[channel ? BOUND_TURNR : BOUND_ACC]);
        return model;
    }

    INLINE Model<T> rate_model(int channel, int i, int k) const {
        Model<T> model;
        const int plain = channel ? TURNACC : JERK, bounded = channel ? TURNACCB : JERKB;
        if (k > 0) {
            const Vec<T> value = rate((channel ? turn : thrust) + i * K, k);
            if (has(plain)) model.add(own(plain, i), value);
            if (has(bounded)) model.add_bounded(own(bounded, i), value, game.bounds[channel ? BOUND_TURNACC : BOUND_JERK]);
        }
        model.pull *= T(1) / dt;
        model.stiffness *= T(1) / (dt * dt);
        return model;
    }

    INLINE Model<T> speed_model(int i, int state) const {
        Model<T> model;
        const Vec<T> value = path[i].speed[state];
        if (has(VEL)) model.add(own(VEL, i), value);
        if (has(VELREF)) model.add(own(VELREF, i), value - reference_speed[i]);
        if (has(VELB)) model.add_bounded(own(VELB, i), value, game.bounds[BOUND_VEL]);
        return model;
    }

    /// The costs of a state that an agent has by itself. The nearest point of a reference line is held.
    INLINE StateModels<T> state_models(int i, int state) const {
        StateModels<T> models;
        models.speed = speed_model(i, state);
        if (has(LANE)) {
            models.x.add(own(LANE, i), path[i].x[state] - nearest.x[i * (K + 1) + state]);
            models.y.add(own(LANE, i), path[i].y[state] - nearest.y[i * (K + 1) + state]);
        }
        if (has(GOAL) && ends_at(state)) {
            const Vec<T> weight = final_weight(GOAL, i, state);
            models.x.add(weight, path[i].x[state] - goal_x[i]);
            models.y.add(weight, path[i].y[state] - goal_y[i]);
        }
        if (has(HEADING) && ends_at(state))
            models.heading.add(final_weight(HEADING, i, state), path[i].heading[state] - goal_heading[i]);
        return models;
    }

    /// Loads weights, goals and radii, which the features need and a bare rollout does not.
    NOINLINE void load_parameters() {
        const int weights = OWN_COUNT * movers + PAIR_COUNT * pairs;
        weight = arena.take(weights);
        pair_weight = weight + OWN_COUNT * movers;
        for (int f = 0; f < OWN_COUNT; ++f) {
            if (!game.own[f]) continue;
            for (int lane = 0; lane < W; ++lane) {
                const int64_t* strides = game.own_strides[f];
                const T* from = static_cast<const T*>(game.own[f]) + scene[lane] * strides[0] + mode[lane] * strides[1];
                for (int i = 0; i < movers; ++i) weight[i * OWN_COUNT + f][lane] = from[agent[i * W + lane] * strides[2]];
            }
        }
        if (game.reference_controls) {
            reference_turn = arena.take(movers * K);
            reference_thrust = arena.take(movers * K);
            load(movers, static_cast<const T*>(game.reference_controls), reference_turn, reference_thrust);
        }
        load_given();
        goal_x = arena.take(movers);
        goal_y = arena.take(movers);
        goal_heading = arena.take(movers);
        reference_speed = arena.take(movers);
        wheelbase = arena.take(movers);
        reach = arena.take(PAIR_COUNT * pairs);
        margin = arena.take(PAIR_COUNT * pairs);
        length = arena.take(n);
        width = arena.take(n);
        for (int lane = 0; lane < W; ++lane) {
            const int64_t b = scene[lane], m = mode[lane];
            const T* size = static_cast<const T*>(game.size);
            for (int i = 0; state_pairs && i < n; ++i) {
                const int64_t row = b * game.N + agent[i * W + lane];
                length[i][lane] = size[2 * row];
                width[i][lane] = size[2 * row + 1];
            }
            for (int i = 0; i < movers; ++i) {
                const int64_t a = agent[i * W + lane], row = b * game.N + a;
                if (has(GOAL)) {
                    const T* goal = static_cast<const T*>(game.goals) + b * game.goals_b + m * game.goals_m + a * game.goals_n;
                    goal_x[i][lane] = goal[0];
                    goal_y[i][lane] = goal[game.goals_x];
                }
                if (has(HEADING)) {
                    const int64_t* strides = game.goal_heading_strides;
                    goal_heading[i][lane] =
                        static_cast<const T*>(game.goal_headings)[b * strides[0] + m * strides[1] + a * strides[2]];
                }
                if (has(VELREF)) reference_speed[i][lane] = static_cast<const T*>(game.reference_speed)[row];
                if (has(STEER)) wheelbase[i][lane] = T(kWheelbase) * size[2 * row];
            }
            int p = 0;
            for (int i = 0; knows_pairs(game) && i < movers; ++i)
                for (int j = i + 1; j < n; ++j, ++p) {
                    const int64_t a = std::min(agent[i * W + lane], agent[j * W + lane]);
                    const int64_t c = std::max(agent[i * W + lane], agent[j * W + lane]), pair = pair_of(a, c);
                    const T *first = size + 2 * (b * game.N + a), *second = size + 2 * (b * game.N + c);
                    for (int f = 0; f < PAIR_COUNT; ++f) {
                        if (!has_pair(f)) continue;
                        pair_weight[f * pairs + p][lane] = of_pair<T>(game.pair[f], game.pair_strides[f], b, m, pair);
                        const T wider = game.margins[f] ? of_pair<T>(game.margins[f], game.margin_strides[f], b, m, pair) : T(0);
                        margin[f * pairs + p][lane] = wider;
                        reach[f * pairs + p][lane] = range_of(f, first, second, wider);
                    }
                }
        }
        if (!cut) return;
        whole = arena.take(weights);
        std::copy(weight, weight + weights, whole);
        for (int lane = 0; lane < W; ++lane) end[lane] = T(game.ends[scene[lane]]);
    }

  private:
    std::vector<int> owners_;

    /// Loads what the caller gives of features that the kernel does not know.
    void load_given() {
        const int states = int(K / game.pair_stride);
        given = load_rows(game.given, int(K * game.given_count) * GIVEN_COUNT);
        given_curvature = load_rows(game.given_curvature, K * GIVEN_CURVATURE);
        given_pairs = load_pair_rows(game.given_pairs, int(states * game.given_pair_count) * GIVEN_PAIR_COUNT);
        given_pair_curvature = load_pair_rows(game.given_pair_curvature, states * GIVEN_PAIR_CURVATURE);
    }

    /// The rows of the movers in an array [B, M, N, each], as [movers, each]; null for no array.
    Vec<T>* load_rows(const void* from, int each) {
        if (!from) return nullptr;
        Vec<T>* to = arena.take(movers * each);
        const T* rows[W];
        for (int i = 0; i < movers; ++i) {
            for (int lane = 0; lane < W; ++lane) rows[lane] = static_cast<const T*>(from) + row_of(i, lane) * each;
            gather<T>(rows, each, [&](int e, Vec<T> value) { to[i * each + e] = value; });
        }
        return to;
    }

    /// The rows of the pairs in an array [B, M, P, each], as [pairs, each]; null for no array.
    Vec<T>* load_pair_rows(const void* from, int each) {
        if (!from) return nullptr;
        Vec<T>*to = arena.take(pairs * each), *next = to;
        const T* rows[W];
        for (int i = 0; i < movers; ++i)
            for (int j = i + 1; j < n; ++j, next += each) {
                for (int lane = 0; lane < W; ++lane) {
                    const int64_t first = problem[lane] * game.N * (game.N - 1) / 2;
                    rows[lane] = static_cast<const T*>(from) + (first + pair_of(agent[i * W + lane], agent[j * W + lane])) * each;
                }
                gather<T>(rows, each, [&](int e, Vec<T> value) { next[e] = value; });
            }
        return to;
    }

    template <bool TANGENTS, int STATES>
    INLINE void find_nearest_at(int i, int k, const Vec<T>* s) {
        const Vec<T> zero{}, one = splat<T>(1);
        const Vec<T>*x = path[i].x + k, *y = path[i].y + k;
        const int at = i * (K + 1) + k;
        Vec<T> best[STATES], near_x[STATES], near_y[STATES], inside[STATES], ahead_x[STATES], ahead_y[STATES];
        for (int q = 0; q < STATES; ++q) {
            best[q] = splat<T>(T(INFINITY));
            // If no comparison below is true, an input is NaN, and the nearest point stays NaN.
            near_x[q] = near_y[q] = splat<T>(T(NAN));
            inside[q] = ahead_x[q] = ahead_y[q] = zero;
        }
        for (int64_t part = 0; part + 1 < game.points; ++part, s += 5)
            for (int q = 0; q < STATES; ++q) {
                const Vec<T> raw = ((x[q] - s[0]) * s[2] + (y[q] - s[1]) * s[3]) * s[4];
                const Vec<T> along = least<T>(most<T>(raw, zero), one);
                const Vec<T> at_x = s[0] + along * s[2], at_y = s[1] + along * s[3];
                const Vec<T> dx = x[q] - at_x, dy = y[q] - at_y, squared = dx * dx + dy * dy;
                const Mask<T> nearer = squared < best[q];
                best[q] = nearer ? squared : best[q];
                near_x[q] = nearer ? at_x : near_x[q];
                near_y[q] = nearer ? at_y : near_y[q];
                if (TANGENTS) {
                    inside[q] = nearer ? (along == raw ? s[4] : zero) : inside[q];
                    ahead_x[q] = nearer ? s[2] : ahead_x[q];
                    ahead_y[q] = nearer ? s[3] : ahead_y[q];
                }
            }
        for (int q = 0; q < STATES; ++q) {
            nearest.x[at + q] = near_x[q];
            nearest.y[at + q] = near_y[q];
            if (TANGENTS) {
                const Vec<T> scale = root<T>(inside[q]);
                nearest.tangent_x[at + q] = ahead_x[q] * scale;
                nearest.tangent_y[at + q] = ahead_y[q] * scale;
            }
        }
    }

    /// The reference line of agent i as segments [Q - 1, 5]: start, direction, 1 / length^2.
    void load_line(int i, Vec<T>* s) {
        const int points = int(game.points);
        const T* rows[W];
        for (int lane = 0; lane < W; ++lane) {
            const int a = agent[i * W + lane];
            const int64_t line = game.reference[int64_t(problem[lane]) * game.N + a];
            const bool exists = line >= 0 && line < game.lines;  // otherwise the problem is STOPPED, see `valid`
            rows[lane] = static_cast<const T*>(game.references) +
                         ((int64_t(scene[lane]) * game.N + a) * game.lines + (exists ? line : 0)) * points * 2;
        }
        Vec<T>* at = arena.take(2 * points);
        gather<T>(rows, 2 * points, [&](int e, Vec<T> value) { at[e] = value; });
        for (int part = 0; part + 1 < points; ++part, s += 5, at += 2) {
            const Vec<T> dx = at[2] - at[0], dy = at[3] - at[1], squared = dx * dx + dy * dy;
            s[0] = at[0];
            s[1] = at[1];
            s[2] = dx;
            s[3] = dy;
            s[4] = squared > 0 ? T(1) / squared : Vec<T>{};
        }
    }
};

/// Games whose number of agents that move the compiler knows (N = 0: it does not).
template <class T, int N>
struct Group : Games<T> {
    const Count<N> count;

    Group(const EpoGame& game, Arena<T>& arena, Count<N> count, int n, const int32_t* items, int filled, const T* controls)
        : Games<T>(game, arena, count.agents(), n, items, filled, controls), count(count) {}
};

}  // namespace EPO_LEVEL
