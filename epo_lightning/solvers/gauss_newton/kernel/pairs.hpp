// Pair features of the states of two agents, each with its gradient in closed form.
//
// Every feature is written once, for any type of numbers. With plain vectors it gives the value and the gradient. With dual
// numbers it also gives their derivatives along two directions of the states, which the adjoint needs: the derivative of the
// gradient along a direction is the Hessian times that direction. See `circles.py` and `vehicles.py` for the features.
#pragma once

#include "game.hpp"
#include "lanes.hpp"

namespace EPO_LEVEL {

/// A number with its derivatives along two directions.
template <class T>
struct Dual {
    using V = Vec<T>;
    V v, a, b;
    friend INLINE Dual operator+(Dual x, Dual y) { return {x.v + y.v, x.a + y.a, x.b + y.b}; }
    friend INLINE Dual operator-(Dual x, Dual y) { return {x.v - y.v, x.a - y.a, x.b - y.b}; }
    friend INLINE Dual operator*(Dual x, Dual y) { return {x.v * y.v, x.v * y.a + x.a * y.v, x.v * y.b + x.b * y.v}; }
    friend INLINE Dual operator+(Dual x, V y) { return {x.v + y, x.a, x.b}; }
    friend INLINE Dual operator-(Dual x, V y) { return {x.v - y, x.a, x.b}; }
    friend INLINE Dual operator-(V x, Dual y) { return {x - y.v, -y.a, -y.b}; }
    friend INLINE Dual operator*(V x, Dual y) { return {x * y.v, x * y.a, x * y.b}; }
    friend INLINE Dual operator-(Dual x) { return {-x.v, -x.a, -x.b}; }
};

template <class T>
INLINE Vec<T> value_of(Vec<T> x) { return x; }
template <class T>
INLINE Vec<T> value_of(Dual<T> x) { return x.v; }

template <class T>
INLINE Vec<T> inverse(Vec<T> x) { return T(1) / x; }
template <class T>
INLINE Dual<T> inverse(Dual<T> x) {
    const Vec<T> r = T(1) / x.v, slope = -r * r;
    return {r, slope * x.a, slope * x.b};
}

template <class T>
INLINE Vec<T> positive_root(Vec<T> x) { return root<T>(x); }
template <class T>
INLINE Dual<T> positive_root(Dual<T> x) {
    const Vec<T> r = root<T>(x.v), slope = T(0.5) / r;
    return {r, slope * x.a, slope * x.b};
}

template <class T>
INLINE Vec<T> choose(Mask<T> mask, Vec<T> x, Vec<T> y) { return mask ? x : y; }
template <class T>
INLINE Dual<T> choose(Mask<T> mask, Dual<T> x, Dual<T> y) {
    return {mask ? x.v : y.v, mask ? x.a : y.a, mask ? x.b : y.b};
}

/// An agent at one step. `cosine` and `sine` belong to its heading; length and width are constants.
template <class T, class S>
struct Body {
    S x, y, cosine, sine, speed;
    Vec<T> length, width;
};

/// Indices of the gradient of a pair feature: states of the first and of the second agent, and the margin.
enum Slope { X1, Y1, HEADING1, SPEED1, X2, Y2, HEADING2, SPEED2, MARGIN, SLOPES };

/// A pair feature at one step with its gradient; both are zero where the feature is not active.
template <class S>
struct PairValue {
    S value, by[SLOPES];
};

template <class T, class S>
INLINE PairValue<S> where(Mask<T> active, PairValue<S> found) {
    const S zero{};
    found.value = choose<T>(active, found.value, zero);
    for (S& slope : found.by) slope = choose<T>(active, slope, zero);
    return found;
}

/// Overlap of two rows of circles: that of the two circles whose centres are nearest to each other.
template <class T, class S>
INLINE PairValue<S> circles(const Body<T, S>& p, const Body<T, S>& q) {
    constexpr int kSlots = 5;
    const Vec<T> zero{}, one = splat<T>(1);
    Vec<T> places[2][kSlots], ahead[2][kSlots][2];
    const Body<T, S>* bodies[2] = {&p, &q};
    for (int side = 0; side < 2; ++side) {
        const Body<T, S>& body = *bodies[side];
        const Vec<T> end = T(0.5) * (body.length - body.width);
        const Vec<T> middle = body.length < T(kThreeFrom) ? end : zero, between = body.length < T(kFiveFrom) ? end : T(0.5) * end;
        const Vec<T> slots[kSlots] = {middle, between, -between, end, -end};
        for (int k = 0; k < kSlots; ++k) {
            places[side][k] = slots[k];
            ahead[side][k][0] = slots[k] * value_of<T>(body.cosine);
            ahead[side][k][1] = slots[k] * value_of<T>(body.sine);
        }
    }
    const Vec<T> apart_x = value_of<T>(p.x) - value_of<T>(q.x), apart_y = value_of<T>(p.y) - value_of<T>(q.y);
    Vec<T> best = splat<T>(T(INFINITY)), a = zero, b = zero;
    for (int i = 0; i < kSlots; ++i)
        for (int j = 0; j < kSlots; ++j) {
            const Vec<T> x = apart_x + ahead[0][i][0] - ahead[1][j][0], y = apart_y + ahead[0][i][1] - ahead[1][j][1];
            const Vec<T> squared = x * x + y * y;
            const Mask<T> nearer = squared < best;  // the first ones on a tie
            best = nearer ? squared : best;
            a = nearer ? places[0][i] : a;
            b = nearer ? places[1][j] : b;
        }
    const S x = p.x - q.x + a * p.cosine - b * q.cosine, y = p.y - q.y + a * p.sine - b * q.sine;
    const S squared = x * x + y * y;
    const Mask<T> separate = value_of<T>(squared) > 0;
    const S distance = positive_root<T>(choose<T>(separate, squared, S{} + one));
    const Vec<T> reach = T(0.70710678118654752440) * (p.width + q.width);
    const S depth = reach - choose<T>(separate, distance, S{});
    const Mask<T> active = value_of<T>(depth) > 0;
    // The direction between two centres at the same point is undefined: the feature has the gradient zero there.
    const S scale = choose<T>(separate, inverse<T>(distance), S{}), nx = x * scale, ny = y * scale;
    PairValue<S> found{depth, {}};
    found.by[X1] = -nx;
    found.by[Y1] = -ny;
    found.by[X2] = nx;
    found.by[Y2] = ny;
    found.by[HEADING1] = a * (nx * p.sine - ny * p.cosine);
    found.by[HEADING2] = b * (ny * q.cosine - nx * q.sine);
    return where<T>(active, found);
}

/// The largest of zero and x, and its derivative, 1 or 0.
template <class T, class S>
INLINE S ramp(S x, Vec<T>& slope) {
    const Mask<T> above = value_of<T>(x) > 0;
    slope = above ? splat<T>(1) : Vec<T>{};
    return choose<T>(above, x, S{});
}

/// Missing distance along (LONGITUDINAL, HEADWAY) or across (LATERAL) the common axis of two agents; see `vehicles.py`.
template <class T, int FEATURE, class S>
INLINE PairValue<S> clearance_of_boxes(const Body<T, S>& p, const Body<T, S>& q, S margin) {
    const Vec<T> zero{}, one = splat<T>(1), half = splat<T>(T(0.5)), least = splat<T>(T(kLeastSize));
    const Vec<T> length = half * (p.length + q.length), width = half * (p.width + q.width);
    const S cosine = p.cosine * q.cosine + p.sine * q.sine, sine = p.sine * q.cosine - p.cosine * q.sine;
    const Vec<T> sign = value_of<T>(cosine) < 0 ? -one : one;
    const S aligned = sign * cosine;
    const S scale = inverse<T>(positive_root<T>((one + one) * (aligned + one)));
    const S ex = (p.cosine + sign * q.cosine) * scale, ey = (p.sine + sign * q.sine) * scale;
    const S dx = p.x - q.x, dy = p.y - q.y;
    const S along = ex * dx + ey * dy, across = ex * dy - ey * dx;
    constexpr bool kAcross = FEATURE == LATERAL, kFollows = FEATURE == HEADWAY;
    const S main = kAcross ? across : along, other = kAcross ? along : across;
    const Vec<T> extent = kAcross ? width : length, side = kAcross ? length : width;
    // The speed of the agent behind, and the share of the first agent in it.
    S rear{}, share{};
    Vec<T> blending{};
    const Vec<T> per_length = one / most<T>(length, least);
    if (kFollows) {
        const S raw = half - (half * per_length) * along;
        const Mask<T> inside = value_of<T>(raw) > 0 && value_of<T>(raw) < 1;
        blending = inside ? one : zero;
        share = choose<T>(inside, raw, S{} + (value_of<T>(raw) > 0 ? one : zero));
        rear = q.speed + share * (p.speed - q.speed);
    }
    const Vec<T> gap = splat<T>(T(kTimeGap));
    const Vec<T> at = value_of<T>(main), direction = at > 0 ? one : (at < 0 ? -one : zero);
    S room = margin + extent - direction * main;
    if (kFollows) room = room + gap * rear;
    const Vec<T> per_side = one / most<T>(side, least);
    const S ratio = per_side * other, rest = one - ratio * ratio, window = rest * rest;
    const Mask<T> active = value_of<T>(room) > 0 && value_of<T>(rest) > 0 && (kFollows ? value_of<T>(cosine) > 0 : Mask<T>(~Mask<T>{}));
    const S weighed = aligned * window;
    S by_main = -direction * weighed;
    if (kFollows) by_main = by_main - (blending * half * per_length * gap) * (weighed * (p.speed - q.speed));
    const S by_other = (T(-4) * per_side) * (aligned * room * rest * ratio), by_cosine = sign * (window * room);
    const S by_along = kAcross ? by_other : by_main, by_across = kAcross ? by_main : by_other;
    PairValue<S> found{weighed * room, {}};
    found.by[X1] = by_along * ex - by_across * ey;
    found.by[Y1] = by_along * ey + by_across * ex;
    found.by[X2] = -found.by[X1];
    found.by[Y2] = -found.by[Y1];
    const S turned = half * (by_along * across - by_across * along), spread = by_cosine * sine;
    found.by[HEADING1] = turned - spread;
    found.by[HEADING2] = turned + spread;
    if (kFollows) {
        found.by[SPEED1] = gap * (weighed * share);
        found.by[SPEED2] = gap * weighed - found.by[SPEED1];
    }
    found.by[MARGIN] = weighed;
    return where<T>(active, found);
}

/// Overlap at the closest approach of two agents that keep their velocities, less the later it is.
template <class T, class S>
INLINE PairValue<S> conflict(const Body<T, S>& p, const Body<T, S>& q, S margin) {
    const Vec<T> zero{}, one = splat<T>(1), limit = splat<T>(T(kConflictTime)), per_limit = splat<T>(T(1.0 / kConflictTime));
    const S dx = p.x - q.x, dy = p.y - q.y;
    const S vx = p.speed * p.cosine - q.speed * q.cosine, vy = p.speed * p.sine - q.speed * q.sine;
    const S per_square = inverse<T>(vx * vx + vy * vy + splat<T>(T(kSlow)));
    const S raw = -(dx * vx + dy * vy) * per_square;
    const Mask<T> moving = value_of<T>(raw) > 0 && value_of<T>(raw) < limit;
    const S time = choose<T>(moving, raw, S{} + (value_of<T>(raw) > 0 ? limit : zero));
    const S x = dx + time * vx, y = dy + time * vy, squared = x * x + y * y;
    const Mask<T> separate = value_of<T>(squared) > 0;
    const S distance = positive_root<T>(choose<T>(separate, squared, S{} + one));
    const S scale = choose<T>(separate, inverse<T>(distance), S{}), nx = x * scale, ny = y * scale;
    const S room = margin + T(0.5) * (p.width + q.width) - choose<T>(separate, distance, S{});
    const S soon = one - per_limit * time;
    const Mask<T> active = value_of<T>(room) > 0 && value_of<T>(soon) > 0;
    // Derivatives by the time of the closest approach, of that time by offset and velocity, and then of the feature.
    const S by_time = choose<T>(moving, -(soon * (nx * vx + ny * vy)) - per_limit * room, S{});
    const S step = -(by_time * per_square);
    const Vec<T> two = one + one;
    const S by_x = step * vx - soon * nx, by_y = step * vy - soon * ny;
    const S by_vx = step * (dx + two * (time * vx)) - soon * nx * time, by_vy = step * (dy + two * (time * vy)) - soon * ny * time;
    PairValue<S> found{soon * room, {}};
    found.by[X1] = by_x;
    found.by[Y1] = by_y;
    found.by[X2] = -by_x;
    found.by[Y2] = -by_y;
    found.by[HEADING1] = p.speed * (by_vy * p.cosine - by_vx * p.sine);
    found.by[HEADING2] = q.speed * (by_vx * q.sine - by_vy * q.cosine);
    found.by[SPEED1] = by_vx * p.cosine + by_vy * p.sine;
    found.by[SPEED2] = -(by_vx * q.cosine + by_vy * q.sine);
    found.by[MARGIN] = soon;
    return where<T>(active, found);
}

/// Value and gradient of a pair feature of states. It is no inline function, because it is used for every size of groups.
template <class T, class S>
NOINLINE void evaluate_pair(int feature, const Body<T, S>& p, const Body<T, S>& q, const S& margin, PairValue<S>& found) {
    switch (feature) {
        case CIRCLES: found = circles<T, S>(p, q); break;
        case HEADWAY: found = clearance_of_boxes<T, HEADWAY, S>(p, q, margin); break;
        case LONGITUDINAL: found = clearance_of_boxes<T, LONGITUDINAL, S>(p, q, margin); break;
        case LATERAL: found = clearance_of_boxes<T, LATERAL, S>(p, q, margin); break;
        default: found = conflict<T, S>(p, q, margin);
    }
}

/// Whether a pair feature is one of the distance of discs.
INLINE constexpr bool of_discs(int feature) { return feature == PROXIMITY || feature == CLEARANCE; }

/// The time [s] for which a pair feature looks ahead: its range grows with the agents' speeds times this.
INLINE double look_ahead(int feature) { return feature == HEADWAY ? kTimeGap : feature == TIME_TO_CONFLICT ? kConflictTime : 0.0; }

/// A distance [m] from which on a pair feature is zero for agents that do not move; for discs, exactly that of their contact.
/// Sizes are length and width.
template <class T>
INLINE T range_of(int feature, const T* first, const T* second, T margin) {
    const T length = T(0.5) * first[0] + T(0.5) * second[0], width = T(0.5) * first[1] + T(0.5) * second[1];
    switch (feature) {
        case PROXIMITY: return length;
        case CLEARANCE: return length + margin;
        case CIRCLES: {
            const T ends = T(0.5) * std::abs(first[0] - first[1]) + T(0.5) * std::abs(second[0] - second[1]);
            return T(1.001) * (ends + T(1.41421356237309504880) * width);
        }
        default: return T(1.001) * (length + width + margin);
    }
}

/// Whether there is a pair feature of states.
inline bool has_state_pairs(const EpoGame& game) {
    for (int f = 0; f < PAIR_COUNT; ++f)
        if (game.pair[f] && !of_discs(f)) return true;
    return false;
}

}  // namespace EPO_LEVEL
