// Feedback equilibria of driving games by iterated linear-quadratic games. The method, and the reasons for its constants, are in
// `solvers/feedback/iteration.py`, which does the same in PyTorch for all energies.

#include "feedback.hpp"

#include <algorithm>
#include <limits>

#include "feedback_games.hpp"

namespace EPO_LEVEL {
namespace {

using namespace lq;

/// Controls [n, K] and the states that they lead to.
struct Trajectory {
    V *turn, *thrust;
    std::vector<Path<double>> path;

    explicit Trajectory(const Game& g) : turn(g.arena.take(g.n * g.K)), thrust(g.arena.take(g.n * g.K)) {
        for (int i = 0; i < g.n; ++i) path.push_back(g.new_path());
        g.start(path);
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
        for (auto* memory : {&points_, &deviations_})
            memory->assign(run.remembered, std::vector<double>(std::size_t((last - first) * row_)));
    }

    void solve() {
        for (int64_t problem = first_; problem < last_; ++problem) {
            const uint8_t* present = game_.present + problem / game_.M * game_.N;
            const bool empty = std::count(present, present + game_.N, 0) == game_.N;
            run_.status[problem] = !valid<double>(game_, problem) ? STOPPED : empty ? COMPLETED : DAMPED;
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
        for (int64_t attempt = 0; attempt < run_.trials; ++attempt) {
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
        g.roll(next.turn, next.thrust, next.path);
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
                run_.status[problem] = COMPLETED;
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
        least_squares(g.arena, run_.dependent, columns, wanted, 2 * cells, shares);
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

}  // namespace

void feedback(const EpoGame* game, const EpoFeedback* run, int64_t first, int64_t last) { Iteration(*game, *run, first, last).solve(); }

}  // namespace EPO_LEVEL
