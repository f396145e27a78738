// Feedback equilibria of driving games by iterated linear-quadratic games, and their derivative. The method, and the reasons for its
// constants, are in `solvers/feedback/iteration.py` and `derivative.py`, which do the same in PyTorch for all energies.

#include "feedback.hpp"

#include <limits>

#include "feedback_stage.hpp"
#include "plan.hpp"

namespace EPO_LEVEL {
namespace {

using namespace lq;

constexpr double kDependent = 1e-12;  // part of a column, relative to its norm, from which on it is independent of other columns

/// The plan for all problems first .. last for which wanted(problem) is true: a row for each, with its present agents.
template <class Wanted>
Plan plan_of(const EpoGame& game, int64_t first, int64_t last, const Wanted& wanted) {
    Plan plan(game.N, false);
    for (int64_t problem = first; problem < last; ++problem) {
        if (!wanted(problem)) continue;
        const uint8_t* present = game.present + problem / game.M * game.N;
        auto& rows = plan.rows({int(std::count_if(present, present + game.N, [](uint8_t one) { return one != 0; })), 0});
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
            if (game.own[LANE]) g.template find_nearest<true>(Nearest<double>::at(arena.take(Nearest<double>::size(agents, g.K)), agents, g.K));
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

/// Writes the x that minimises |columns x - wanted|^2 to `shares`, by Gram-Schmidt. A column that depends on those before it has a
/// share of zero. `columns` and `wanted` are overwritten.
void least_squares(Arena<double>& arena, const std::vector<V*>& columns, V* wanted, int length, V* shares) {
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
        const M independent = rest > kDependent * kDependent * whole;
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

/// Controls [n, K] and the states that they lead to.
struct Trajectory {
    V *turn, *thrust;
    std::vector<Path<double>> path;

    explicit Trajectory(const Game& g) : turn(g.arena.take(g.n * g.K)), thrust(g.arena.take(g.n * g.K)) {
        for (int i = 0; i < g.n; ++i) path.push_back(g.new_path());
        for (int i = 0; i < g.n; ++i) {
            path[i].x[0] = g.path[i].x[0];
            path[i].y[0] = g.path[i].y[0];
            path[i].heading[0] = g.path[i].heading[0];
            path[i].speed[0] = g.path[i].speed[0];
        }
    }

    V& control(int i, int K, int k, int channel) const { return (channel ? turn : thrust)[i * K + k]; }
};

/// The trajectories of agents that follow policies, whose offsets are multiplied by `length`.
template <int N>
NOINLINE void follow(const Game& g, const Sizes<N>& size, const V* policies, V length, const Trajectory& to) {
    const int agents = size.agents(), n = size.states(), m = size.controls(), width = size.width();
    V* away = g.arena.take(n);
    std::vector<Moved<double>> moved(agents);
    clear(away, n);
    for (int k = 0; k < g.K; ++k) {
        const V* const policy = policies + k * m * width;
        for (int i = 0; i < agents; ++i)
            for (const int channel : {ACCELERATION, TURN_RATE}) {
                const V* const row = policy + (kControl * i + channel) * width;
                V change = length * row[n];
                for (int a = 0; a < n; ++a) change += row[a] * away[a];
                to.control(i, g.K, k, channel) = (channel ? g.turn : g.thrust)[i * g.K + k] + change;
            }
        for (int i = 0; i < agents; ++i) {
            const Path<double>&p = to.path[i], &given = g.path[i];
            moved[i].advance(p, k, g.dt, to.turn[i * g.K + k], to.thrust[i * g.K + k]);
            V* const one = away + kState * i;
            one[0] = p.x[k + 1] - given.x[k + 1];
            one[1] = p.y[k + 1] - given.y[k + 1];
            one[2] = p.heading[k + 1] - given.heading[k + 1];
            one[3] = p.speed[k + 1] - given.speed[k + 1];
        }
    }
}

/// The trajectories of the controls of `to`.
NOINLINE void roll(const Game& g, const Trajectory& to) {
    for (int i = 0; i < g.n; ++i) {
        Moved<double> moved;
        for (int k = 0; k < g.K; ++k) moved.advance(to.path[i], k, g.dt, to.turn[i * g.K + k], to.thrust[i * g.K + k]);
    }
}

/// The largest change of a state up to the end of a game; NaN where a change is.
NOINLINE V change_of(const Game& g, const Trajectory& other) {
    V largest{};
    for (int k = 1; k <= g.K; ++k) {
        const M counts = g.cut ? g.has_step(k - 1) : V{} == V{};
        for (int i = 0; i < g.n; ++i) {
            const Path<double>&p = g.path[i], &q = other.path[i];
            for (const V change : {q.x[k] - p.x[k], q.y[k] - p.y[k], q.heading[k] - p.heading[k], q.speed[k] - p.speed[k]}) {
                const V size = size_of(change);
                const M larger = (size > largest) | (size != size);
                largest = counts & larger ? size : largest;
            }
        }
    }
    return largest;
}

/// The iterations of the problems first .. last.
class Iteration {
  public:
    Iteration(const EpoGame& game, const EpoFeedback& run, int64_t first, int64_t last)
        : game_(game), run_(run), first_(first), last_(last), row_(game.N * game.K * 2), length_(last - first, 1.0),
          before_(last - first, std::numeric_limits<double>::infinity()), known_(last - first, 0) {
        for (auto* memory : {&points_, &deviations_}) memory->assign(run.remembered, std::vector<double>(std::size_t((last - first) * row_)));
    }

    void solve() {
        for (int64_t problem = first_; problem < last_; ++problem) {
            const uint8_t* present = game_.present + problem / game_.M * game_.N;
            run_.status[problem] = std::find(present, present + game_.N, 1) == present + game_.N ? SOLVED : DAMPED;
        }
        for (int64_t number = 0; number < run_.iterations; ++number) {
            const Plan plan = plan_of(game_, first_, last_, [&](int64_t problem) { return run_.status[problem] == DAMPED; });
            for_each_game(game_, arena_, plan, run_.controls, [&](const Game& g, const auto& size, int filled) {
                take_step(g, size, filled, int(number % run_.remembered));
            });
        }
    }

  private:
    /// One iteration of W games, which is remembered in `slot`.
    template <int N>
    void take_step(const Game& g, const Sizes<N>& size, int filled, int slot) {
        const int cells = g.n * g.K;
        V* const policies = g.arena.take(g.K * size.controls() * size.width());
        const M unique = find_policies<N>(g, size, run_.rho, policies, nullptr);
        V length, before;
        for (int lane = 0; lane < W; ++lane) {
            length[lane] = length_[g.problem[lane] - first_];
            before[lane] = before_[g.problem[lane] - first_];
        }
        // The step that the policies suggest, halved until it changes no state by too much.
        const Trajectory trial(g), next(g);
        V taken = length, change;
        M far{};
        for (int64_t halving = 0; halving < run_.halvings; ++halving) {
            taken = far ? 0.5 * taken : taken;
            follow(g, size, policies, taken, trial);
            change = change_of(g, trial);
            far = ~(change <= run_.largest_move);
            if (!any<double>(far)) break;
        }
        const M usable = unique & ~far;
        const V wanted = usable ? change / taken : splat(std::numeric_limits<double>::infinity());
        // Policies that answer each other may oscillate: acceleration begins anew, and steps without it are shorter.
        const M slower = ~(wanted < before);
        length = slower ? most<double>(0.5 * length, splat(run_.shortest)) : length;
        for (int lane = 0; lane < filled; ++lane)
            if (slower[lane]) known_[g.problem[lane] - first_] = 0;
        V *turned = g.arena.take(2 * cells), *thrust = turned + cells;  // the deviations
        for (int e = 0; e < cells; ++e) {
            turned[e] = usable ? (trial.turn[e] - g.turn[e]) / taken : V{};
            thrust[e] = usable ? (trial.thrust[e] - g.thrust[e]) / taken : V{};
        }
        accelerate(g, slot, turned, next);
        roll(g, next);
        const M near = change_of(g, next) <= run_.largest_move;
        const auto choose = [&](V guessed, V stepped, V given) { return near ? guessed : (usable ? stepped : given); };
        for (int e = 0; e < cells; ++e) {
            next.turn[e] = choose(next.turn[e], trial.turn[e], g.turn[e]);
            next.thrust[e] = choose(next.thrust[e], trial.thrust[e], g.thrust[e]);
        }
        const uint32_t lanes = first_lanes(filled);
        g.store(g.turn, g.thrust, lanes, of(points_[slot]));
        g.store(turned, thrust, lanes, of(deviations_[slot]));
        g.store(next.turn, next.thrust, lanes, run_.controls);
        for (int lane = 0; lane < filled; ++lane) {
            const int64_t problem = g.problem[lane], at = problem - first_;
            length_[at] = length[lane];
            before_[at] = wanted[lane];
            known_[at] |= uint64_t(1) << slot;
            if (!usable[lane])
                run_.status[problem] = STOPPED;
            else if (wanted[lane] < run_.tolerance)
                run_.status[problem] = SOLVED;
        }
    }

    /// The controls that Anderson acceleration guesses, from the deviations of this iteration and the remembered ones.
    void accelerate(const Game& g, int slot, const V* deviations, const Trajectory& next) const {
        const int cells = g.n * g.K, remembered = int(run_.remembered);
        V *wanted = g.arena.take(2 * cells), *shares = g.arena.take(remembered);
        std::vector<V*> by_points, by_deviations, columns;
        std::copy(deviations, deviations + 2 * cells, wanted);
        for (int age = 1; age <= remembered; ++age) {  // the newest first
            const int old = (slot - age + remembered) % remembered;
            M known;
            for (int lane = 0; lane < W; ++lane) known[lane] = known_[g.problem[lane] - first_] >> old & 1 ? -1 : 0;
            for (auto* arrays : {&by_points, &by_deviations, &columns}) arrays->push_back(g.arena.take(2 * cells));
            g.load(g.n, of(points_[old]), by_points.back(), by_points.back() + cells);
            g.load(g.n, of(deviations_[old]), by_deviations.back(), by_deviations.back() + cells);
            for (int e = 0; e < 2 * cells; ++e) {
                const V point = e < cells ? g.turn[e] : g.thrust[e - cells];
                by_points.back()[e] = known ? point - by_points.back()[e] : V{};
                by_deviations.back()[e] = columns.back()[e] = known ? deviations[e] - by_deviations.back()[e] : V{};
            }
        }
        least_squares(g.arena, columns, wanted, 2 * cells, shares);
        for (int e = 0; e < 2 * cells; ++e) {
            V guess = (e < cells ? g.turn[e] : g.thrust[e - cells]) + deviations[e];
            for (int h = 0; h < remembered; ++h) guess -= (by_points[h][e] + by_deviations[h][e]) * shares[h];
            (e < cells ? next.turn[e] : next.thrust[e - cells]) = guess;
        }
    }

    double* of(std::vector<double>& memory) { return memory.data() - first_ * row_; }
    const double* of(const std::vector<double>& memory) const { return memory.data() - first_ * row_; }

    const EpoGame& game_;
    const EpoFeedback& run_;
    const int64_t first_, last_, row_;
    Arena<double> arena_;
    std::vector<std::vector<double>> points_, deviations_;  // by slot of the memory
    std::vector<double> length_, before_;
    std::vector<uint64_t> known_;  // a bit for every slot
};

/// The derivative at the solutions of W games.
template <int N>
class Derivative {
  public:
    Derivative(const Game& g, const Sizes<N>& size, double rho)
        : g_(g), size_(size), rho_(rho), all_(size.agents() * size.states() * size.width()),
          policies_(g.arena.take(g.K * size.controls() * size.width())), values_(g.arena.take(std::size_t(g.K) * all_)),
          value_bar_(g.arena.take(all_)), offsets_(g.arena.take(cells())), state_bar_(g.arena.take(2 * size.states())),
          states_(g.arena.take((g.K + 1) * size.states())), stage_(g.arena, size), bar_(g.arena, size),
          scratch_(g.arena, size.states(), size.controls()) {
        unique_ = find_policies<N>(g, size, rho, policies_, values_);
    }

    int cells() const { return g_.K * size_.controls(); }
    M unique() const { return unique_; }

    /// Writes the derivative of <covector, D> by the controls [K, m], and adds that by the parameters. D are the deviations of the
    /// controls that the policies want.
    NOINLINE void pull_back(const V* covector, V* by_controls, const ParameterGradients<double>& by) {
        const int n = size_.states(), m = size_.controls(), K = g_.K;
        std::copy(covector, covector + cells(), offsets_);
        clear(state_bar_, n);
        for (int k = K - 1; k >= 0; --k) {
            expand(g_, size_, rho_, k, stage_);
            pull_back_controls(size_, stage_, policy(k), state_bar_, state_bar_ + n, offsets_ + k * m);
        }
        clear(value_bar_, all_);
        clear(states_, (K + 1) * n);
        clear(by_controls, cells());
        const TrajectoryBar to{states_, by_controls};
        for (int k = 0; k < K; ++k) {
            expand(g_, size_, rho_, k, stage_);
            std::copy(policy(k), policy(k) + m * size_.width(), scratch_.policy);
            pull_back_stage(size_, stage_, rho_, values_ + std::size_t(k) * all_, offsets_ + k * m, value_bar_, bar_, scratch_);
            pull_back_expansion(g_, size_, k, bar_, to, by);
        }
        pull_back_rollout(g_, to);
    }

  private:
    const V* policy(int k) const { return policies_ + k * size_.controls() * size_.width(); }

    const Game& g_;
    const Sizes<N>& size_;
    const double rho_;
    const int all_;
    V *policies_, *values_, *value_bar_, *offsets_, *state_bar_, *states_;
    Stage<N> stage_, bar_;
    Scratch scratch_;
    M unique_;
};

/// Overwrites a cotangent v [K, m] by the solution y of -D_u' y = v (GMRES).
template <int N>
void solve_fixed_point(Derivative<N>& derivative, const Game& g, int terms, V* cotangent) {
    const int length = derivative.cells();
    const ParameterGradients<double> unused(g.arena, g.n, g.K, g.pairs);
    std::vector<V*> basis, images;
    V* const shares = g.arena.take(terms);
    // Norms of very small or large cotangents would underflow or overflow.
    V largest{};
    for (int e = 0; e < length; ++e) largest = most<double>(largest, size_of(cotangent[e]));
    largest = largest > 0 ? largest : splat(1.0);
    V* const next = g.arena.take(length);
    for (int e = 0; e < length; ++e) next[e] = cotangent[e] /= largest;
    for (int t = 0; t < terms; ++t) {
        for (const V* other : basis) subtract(next, dot(next, other, length), other, length);
        const V squared = dot(next, next, length), norm = root<double>(squared > 0 ? squared : splat(1.0));
        basis.push_back(g.arena.take(length));
        images.push_back(g.arena.take(length));
        for (int e = 0; e < length; ++e) basis[t][e] = next[e] / norm;
        derivative.pull_back(basis[t], next, unused);
        for (int e = 0; e < length; ++e) images[t][e] = next[e] = -next[e];
    }
    least_squares(g.arena, images, cotangent, length, shares);
    for (int e = 0; e < length; ++e) {
        V sum{};
        for (int t = 0; t < terms; ++t) sum += basis[t][e] * shares[t];
        cotangent[e] = largest * sum;
    }
}

}  // namespace

void feedback(const EpoGame* game, const EpoFeedback* run, int64_t first, int64_t last) { Iteration(*game, *run, first, last).solve(); }

void feedback_pull_back(const EpoGame* game, const EpoFeedback* run, const EpoGradients* gradients, int64_t first, int64_t last) {
    const double* const cotangent = static_cast<const double*>(gradients->controls);
    const int64_t row = game->N * game->K * 2;
    Arena<double> arena;
    const Plan plan = plan_of(*game, first, last, [&](int64_t problem) {
        const double* of = cotangent + problem * row;
        return run->status[problem] == SOLVED && std::any_of(of, of + row, [](double entry) { return entry != 0; });
    });
    for_each_game(*game, arena, plan, run->controls, [&](const Game& g, const auto& size, int filled) {
        Derivative derivative(g, size, run->rho);
        const int n = g.n, K = g.K;
        V *given = arena.take(2 * n * K), *wanted = arena.take(derivative.cells()), *unused = arena.take(derivative.cells());
        g.load(n, cotangent, given, given + n * K);
        for (int k = 0; k < K; ++k)
            for (int i = 0; i < n; ++i)
                for (const int channel : {ACCELERATION, TURN_RATE}) {
                    const V entry = given[(channel ? 0 : n * K) + i * K + k];
                    wanted[(k * n + i) * kControl + channel] = g.cut ? (g.has_step(k) ? entry : V{}) : entry;
                }
        solve_fixed_point(derivative, g, int(run->terms), wanted);
        const ParameterGradients<double> by(arena, n, K, g.pairs);
        derivative.pull_back(wanted, unused, by);
        uint32_t regular = 0;
        for (int lane = 0; lane < filled; ++lane) regular |= uint32_t(derivative.unique()[lane] != 0) << lane;
        add_gradients<double>(g, by, regular, *gradients);
    });
}

}  // namespace EPO_LEVEL
