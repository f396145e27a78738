// S steps for a range of problems, and their adjoint. Compiled once for every level of instructions; see dispatch.cpp.
//
// In each step, every problem is split into groups of agents that overlap at the current iterate: the connected components of the
// graph of active pairs. Each group has a factorisation of its own. Groups of the same size are solved together, one per lane of
// the vector registers. Adaptive steps leave held agents out of the factorisations: these agents connect no others.

#include <algorithm>
#include <cstring>
#include <limits>
#include <memory>

#include "feedback.hpp"
#include "lq_game.hpp"
#include "plan.hpp"
#include "step.hpp"
#include "validity.hpp"

namespace EPO_LEVEL {
namespace {

static_assert(kMostAgents == 8 * sizeof(uint64_t), "contacts are a mask of one bit per agent");

/// Adds the contacts of given residuals to those of W problems: of present agents with a residual that is not zero, or of which a
/// derivative is not.
template <class T>
void find_given_contacts(const EpoGame& game, const int* problems, uint64_t* touching) {
    constexpr int W = Lanes<T>::W;
    const int64_t N = game.N, each = game.K / game.pair_stride * game.given_pair_count * GIVEN_PAIR_COUNT;
    for (int lane = 0; lane < W; ++lane) {
        const uint8_t* present = game.present + problems[lane] / game.M * N;
        const T* row = static_cast<const T*>(game.given_pairs) + problems[lane] * (N * (N - 1) / 2) * each;
        for (int64_t i = 0; i < N; ++i)
            for (int64_t j = i + 1; j < N; ++j, row += each) {
                if (!present[i] || !present[j] || std::all_of(row, row + each, [](T entry) { return entry == 0; })) continue;
                touching[i * W + lane] |= uint64_t(1) << j;
                touching[j * W + lane] |= uint64_t(1) << i;
            }
    }
}

/// Contacts between the agents of W problems: bit j of touching[i * W + lane] is set where i and j overlap. Contacts between two
/// agents of the mask `held` are not looked for.
template <class T>
void find_contacts(
    const EpoGame& game, Arena<T>& arena, const int* problems, uint64_t held, const T* controls, uint64_t* touching) {
    constexpr int W = Lanes<T>::W;
    const int N = int(game.N), K = int(game.K);
    const bool state_pairs = has_state_pairs(game);
    // Only the states at which pairs are evaluated are kept.
    const int stride = int(game.pair_stride), kept = K / stride;
    Vec<T>*x = arena.take(N * kept), *y = arena.take(N * kept), *box = arena.take(4 * N), *radius = arena.take(N);
    Vec<T>* fastest = arena.take(N);  // largest speed after the first step
    Vec<T>* given = arena.take(2 * K);
    const T dt = T(game.dt);
    Mask<T>* present = reinterpret_cast<Mask<T>*>(arena.take(N));
    Vec<T> end{};
    for (int lane = 0; game.ends && lane < W; ++lane) end[lane] = T(game.ends[problems[lane] / game.M]);
    for (int i = 0; i < N; ++i) {
        Vec<T> start_x, start_y, start_heading, start_speed, moved_x{}, moved_y{}, turned{}, faster{};
        const T* rows[W];
        for (int lane = 0; lane < W; ++lane) {
            const int64_t b = problems[lane] / game.M;
            const T* start = static_cast<const T*>(game.initial) + b * game.initial_b + i * game.initial_n;
            start_x[lane] = start[0];
            start_y[lane] = start[1];
            start_heading[lane] = start[2];
            start_speed[lane] = start[3];
            radius[i][lane] = T(0.5) * static_cast<const T*>(game.size)[2 * (b * N + i)];
            present[i][lane] = game.present[b * N + i] ? -1 : 0;
            rows[lane] = controls + (int64_t(problems[lane]) * N + i) * K * 2;
        }
        gather<T>(rows, 2 * K, [&](int e, Vec<T> value) { given[e] = value; });
        Vec<T>*low_x = box + 4 * i, *low_y = low_x + 1, *high_x = low_x + 2, *high_y = low_x + 3;
        *low_x = *low_y = splat<T>(T(INFINITY));
        *high_x = *high_y = splat<T>(-T(INFINITY));
        fastest[i] = Vec<T>{};
        for (int k = 0; k < K; ++k) {
            Vec<T> sine, cosine;
            const Vec<T> speed = start_speed + faster;
            sincos<T>(start_heading + turned, sine, cosine);
            moved_x += dt * speed * cosine;
            moved_y += dt * speed * sine;
            turned += dt * given[2 * k + 1];
            faster += dt * given[2 * k];
            if (state_pairs) fastest[i] = most<T>(fastest[i], most<T>(start_speed + faster, -start_speed - faster));
            const Vec<T> px = start_x + moved_x, py = start_y + moved_y;
            if ((k + 1) % stride) continue;
            const int at = i * kept + (k + 1) / stride - 1;
            x[at] = px;
            y[at] = py;
            *low_x = least<T>(*low_x, px);
            *low_y = least<T>(*low_y, py);
            *high_x = most<T>(*high_x, px);
            *high_y = most<T>(*high_y, py);
        }
    }
    int pair = 0;
    for (int i = 0; i < N; ++i)
        for (int j = i + 1; j < N; ++j, ++pair) {
            if (held >> i & held >> j & 1) continue;
            Vec<T> reach = radius[i] + radius[j];
            for (int f = CLEARANCE; f < PAIR_COUNT; ++f) {
                if (!game.pair[f]) continue;
                Vec<T> range;
                for (int lane = 0; lane < W; ++lane) {
                    const int64_t b = problems[lane] / game.M, m = problems[lane] % game.M;
                    const T* size = static_cast<const T*>(game.size) + 2 * b * N;
                    const T wider = game.margins[f] ? of_pair<T>(game.margins[f], game.margin_strides[f], b, m, pair) : T(0);
                    range[lane] = range_of(f, size + 2 * i, size + 2 * j, wider);
                }
                if (look_ahead(f) > 0) range += T(look_ahead(f)) * (fastest[i] + fastest[j]);
                reach = most<T>(reach, range);
            }
            const Vec<T>*a = box + 4 * i, *c = box + 4 * j;
            const Mask<T> near = present[i] && present[j] && a[0] - c[2] < reach && c[0] - a[2] < reach &&
                                 a[1] - c[3] < reach && c[1] - a[3] < reach;
            if (!any<T>(near)) continue;
            const Vec<T> squared = reach * reach;
            Mask<T> touch{};
            for (int k = 0; k < kept; ++k) {
                const Vec<T> dx = x[i * kept + k] - x[j * kept + k], dy = y[i * kept + k] - y[j * kept + k];
                const Mask<T> here = dx * dx + dy * dy < squared;
                touch |= game.ends ? here & (end >= splat<T>(T((k + 1) * stride))) : here;
            }
            touch &= near;
            for (int lane = 0; lane < W; ++lane) {
                if (!touch[lane]) continue;
                const int64_t b = problems[lane] / game.M, m = problems[lane] % game.M;
                bool matters = false;
                for (int f = 0; f < PAIR_COUNT; ++f)
                    matters |= game.pair[f] && of_pair<T>(game.pair[f], game.pair_strides[f], b, m, pair) != 0;
                if (!matters) continue;
                touching[i * W + lane] |= uint64_t(1) << j;
                touching[j * W + lane] |= uint64_t(1) << i;
            }
        }
}

/// The plan for the problems first .. last, without those that are marked in `done`. `held` is a mask of agents for each problem, or
/// empty if no agent is held.
template <class T>
Plan make_plan(
    const EpoGame& game, Arena<T>& arena, int64_t first, int64_t last, const std::vector<char>& done,
    const std::vector<uint64_t>& held, const T* controls) {
    constexpr int W = Lanes<T>::W;
    const int N = int(game.N);
    Plan plan(game.N, !held.empty());
    std::vector<uint64_t> touching(std::size_t(N) * W, 0);
    for (int64_t start = first; start < last; start += W) {
        const int filled = int(std::min<int64_t>(W, last - start));
        if (interacts(game)) {
            int problems[W];
            uint64_t held_in_all = held.empty() ? 0 : ~uint64_t(0);
            for (int lane = 0; lane < W; ++lane) {
                problems[lane] = int(start + std::min(lane, filled - 1));
                if (!held.empty()) held_in_all &= held[problems[lane] - first];
            }
            arena.clear();
            std::fill(touching.begin(), touching.end(), 0);
            if (knows_pairs(game)) find_contacts<T>(game, arena, problems, held_in_all, controls, touching.data());
            if (game.given_pairs) find_given_contacts<T>(game, problems, touching.data());
        }
        for (int lane = 0; lane < filled; ++lane) {
            if (done[start + lane - first]) continue;
            const uint64_t still = held.empty() ? 0 : held[start + lane - first];
            uint64_t left = 0;
            for (int i = 0; i < N; ++i) left |= uint64_t(game.present[(start + lane) / game.M * N + i] != 0) << i;
            left &= ~still;
            while (left) {
                uint64_t group = left & -left, border = group, beside = 0;
                while (border) {
                    const int i = __builtin_ctzll(border);
                    border &= border - 1;
                    const uint64_t reached = touching[std::size_t(i) * W + lane], fresh = reached & ~(group | still);
                    beside |= reached & still;
                    group |= fresh;
                    border |= fresh;
                }
                left &= ~group;
                auto& rows = plan.rows({__builtin_popcountll(group), __builtin_popcountll(beside)});
                rows.push_back(int32_t(start + lane));
                for (const uint64_t agents : {group, beside})
                    for (uint64_t rest = agents; rest; rest &= rest - 1) rows.push_back(__builtin_ctzll(rest));
            }
        }
    }
    return plan;
}

/// Data of one step for its adjoint.
template <class T>
struct StepTape {
    Plan plan;
    std::vector<Buffer<T>> factors, nearest;  // by number of agents, group after group
    std::vector<char> taken;               // by problem of the range: whether it took the step
};

template <class T>
struct Tape {
    int64_t first, last;
    std::vector<StepTape<T>> steps;
};

/// The problems first .. last of a call, with the memory that its steps share.
template <class T>
class Range {
  public:
    Range(const EpoGame& game, const EpoRun& run, int64_t first, int64_t last)
        : game_(game), run_(run), first_(first), last_(last), row_(game.K * 2), size_(game.N * row_), reused_(game.N + 1),
          valid_(last - first), done_(last - first, 0) {
        for (int64_t problem = first; problem < last; ++problem) {
            valid_[problem - first] = valid<T>(game, problem);
            run.status[problem] = valid_[problem - first] ? COMPLETED : STOPPED;
        }
        for (int64_t problem = first; problem < last; ++problem)
            for (int64_t i = 0; i < game.N; ++i) {
                const T* from = static_cast<const T*>(run.start) + problem * size_ + i * row_;
                T* to = iterate(0) + problem * size_ + i * row_;
                if (game.present[problem / game.M * game.N + i])
                    std::copy(from, from + row_, to);
                else
                    std::fill(to, to + row_, T(0));
            }
    }

    T* iterate(int64_t index) const { return static_cast<T*>(run_.iterates) + index * run_.iterate_stride; }

    /// Takes one step from `controls` to `next`. Unless they are null, `energy` becomes that of `controls`, and `predicted` its decrease
    /// according to the quadratic model. `status` is raised where a step needed more damping or was not possible. `directions` are
    /// written as well.
    StepTape<T> step(const T* controls, T* next, T* directions, T* energy, T* predicted, int64_t* status) {
        constexpr int W = Lanes<T>::W;
        const bool record = run_.record != 0, has_lines = game_.own[LANE] != nullptr, exact = run_.exact != 0;
        StepTape<T> step{make_plan<T>(game_, arena_, first_, last_, done_, held_, controls), {}, {}, valid_};
        step.factors.resize(game_.N + 1);
        step.nearest.resize(game_.N + 1);
        for (int kind = 0; kind < step.plan.kinds(); ++kind) {
            const int n = step.plan.size(kind).movers;
            const std::size_t groups = (step.plan.count(kind) + W - 1) / W;
            if (groups && (record || !reused_[n]))
                (record ? step.factors : reused_)[n] = Buffer<T>((record ? groups : 1) * Factors<T>::size(n, game_.K));
            if (groups && record && has_lines) step.nearest[n] = Buffer<T>(groups * Nearest<T>::size(n, game_.K));
        }
        if (energy) std::fill(energy + first_, energy + last_, T(0));
        if (predicted) std::fill(predicted + first_, predicted + last_, T(0));
        for_each_group<T>(game_, arena_, step.plan, controls, [&](auto& group, int64_t index, int filled) {
            const int n = group.movers;
            group.load_parameters();
            if (has_lines && record)
                group.template find_nearest<true>(Nearest<T>::at(step.nearest[n].data() + index * Nearest<T>::size(n, game_.K), n, game_.K));
            else if (has_lines && (exact || game_.lane_slides))
                group.template find_nearest<true>(Nearest<T>::at(arena_.take(Nearest<T>::size(n, game_.K)), n, game_.K));
            else if (has_lines)
                group.template find_nearest<false>(Nearest<T>::at(arena_.take(Nearest<T>::size(n, game_.K)), n, game_.K));
            Vec<T>* memory = record ? step.factors[n].data() + index * Factors<T>::size(n, game_.K) : reused_[n].data();
            const auto factors = Factors<T>::at(memory, n, game_.K);
            Vec<T>*turn = arena_.take(n * game_.K), *thrust = arena_.take(n * game_.K), found, decrease;
            Vec<T>* damping = arena_.take(n);
            // Lanes that are not in use repeat the groups with the dampings of the next attempts. The adjoint needs the factors of a group in
            // one place, so that there are no copies if they are recorded, and lanes with a direction are computed again.
            const int copies = record ? 1 : int(std::min<int64_t>(kRetries + 1, W / filled));
            uint32_t open = first_lanes(filled), failed = 0;  // groups without a direction, and groups that needed more damping
            for (int64_t first = 0; open && first <= kRetries; first += copies) {
                Mask<T> positive{};
                for (int lane = 0; lane < W; ++lane) {
                    const int64_t attempt = first + lane / filled;
                    const bool tries = (open >> lane % filled & 1) && lane < filled * copies && attempt <= kRetries;
                    positive[lane] = record || tries ? -1 : 0;
                    if (!tries && first) continue;
                    for (int i = 0; i < n; ++i) damping[i][lane] = raised_damping(group, i, lane, tries ? attempt : 0);
                }
                solve_step(group, exact, damping, factors, turn, thrust, energy ? &found : nullptr, decrease, positive);
                uint32_t fresh = 0;
                for (int lane = 0; lane < filled * copies; ++lane) {
                    const uint32_t one = uint32_t(1) << lane % filled;
                    if (!(open & one)) continue;
                    if (!positive[lane]) {
                        failed |= one;
                        continue;
                    }
                    open &= ~one;
                    fresh |= uint32_t(1) << lane;
                    if (predicted) predicted[group.problem[lane]] += decrease[lane];
                }
                group.store(turn, thrust, fresh, directions);
            }
            if (open) group.store(turn, thrust, open, directions);
            for (int lane = 0; lane < filled; ++lane) {
                const int problem = group.problem[lane];
                if (failed >> lane & 1) status[problem] = std::max<int64_t>(status[problem], DAMPED);
                if (open >> lane & 1) {
                    step.taken[problem - first_] = 0;
                    if (predicted) predicted[problem] = T(INFINITY);
                }
                if (energy) energy[problem] += found[lane];
            }
        });
        for (int64_t problem = first_; problem < last_; ++problem) {
            T *d = directions + problem * size_, *to = next + problem * size_;
            const T *from = controls + problem * size_, alpha = T(run_.step_size);
            // Absent and held agents are in no group that moves them, so no direction was stored for them.
            const uint8_t* present = game_.present + problem / game_.M * game_.N;
            const uint64_t still = held_.empty() ? 0 : held_[problem - first_];
            for (int64_t i = 0; i < game_.N; ++i)
                if (!present[i] || still >> i & 1) std::fill(d + i * row_, d + (i + 1) * row_, T(0));
            bool taken = step.taken[problem - first_];
            for (int64_t e = 0; e < size_; ++e) taken &= finite(from[e] + alpha * d[e]);
            step.taken[problem - first_] = taken;
            if (!taken) status[problem] = STOPPED;
            for (int64_t e = 0; e < size_; ++e) to[e] = taken ? from[e] + alpha * d[e] : from[e];
        }
        return step;
    }

    /// Writes the energy of `controls` and, unless `states` is null, the norm of its gradient and the states to the results of the call.
    /// With masks of held agents, it is the energy of those that move, given the held ones.
    void measure(const T* controls, T* energy, T* states, const std::vector<uint64_t>& held = {}) {
        T* const norm = static_cast<T*>(run_.gradient_norm);
        std::fill(energy + first_, energy + last_, T(0));
        if (states) {
            std::fill(norm + first_, norm + last_, T(0));
            std::memset(states + first_ * size_ * 2, 0, sizeof(T) * (last_ - first_) * size_ * 2);
        }
        const Plan plan = make_plan<T>(game_, arena_, first_, last_, done_, held, controls);
        for_each_group<T>(game_, arena_, plan, controls, [&](auto& group, int64_t, int filled) {
            const int n = group.movers;
            group.load_parameters();
            if (game_.own[LANE])
                group.template find_nearest<false>(Nearest<T>::at(arena_.take(Nearest<T>::size(n, game_.K)), n, game_.K));
            Vec<T> found, squared;
            evaluate(group, found, squared);
            for (int lane = 0; lane < filled; ++lane) energy[group.problem[lane]] += found[lane];
            if (!states) return;
            for (int lane = 0; lane < filled; ++lane) norm[group.problem[lane]] += squared[lane];
            group.store_states(filled, states);
        });
        for (int64_t problem = first_; states && problem < last_; ++problem) norm[problem] = std::sqrt(norm[problem]);
    }

    /// S steps in a row.
    std::unique_ptr<Tape<T>> solve() {
        auto tape = std::make_unique<Tape<T>>(Tape<T>{first_, last_, {}});
        T *const before = static_cast<T*>(run_.initial_energy), *const after = static_cast<T*>(run_.energy);
        for (int64_t s = 0; s < run_.steps; ++s) {
            T* directions = static_cast<T*>(run_.directions) + (run_.record ? s * game_.B * game_.M * size_ : 0);
            StepTape<T> taken = step(iterate(s), iterate(s + 1), directions, s == 0 ? before : nullptr, nullptr, run_.status);
            if (run_.record) tape->steps.push_back(std::move(taken));
        }
        if (after) measure(iterate(run_.steps), after, static_cast<T*>(run_.states));
        if (run_.steps == 0) std::copy(after + first_, after + last_, before + first_);
        return run_.record ? std::move(tape) : nullptr;
    }

    /// At most S steps, each accepted or rejected by every problem. An accepted step lowers the energy and divides the damping by 10;
    /// a rejected one multiplies it by 10; infinite damping stays. A problem is done once a step cannot lower its energy by more than
    /// the rounding of it.
    void descend() {
        T *const controls = iterate(0), *const trial = iterate(1);
        T *const before = static_cast<T*>(run_.initial_energy), *const after = static_cast<T*>(run_.energy);
        const int64_t count = last_ - first_;
        std::vector<int64_t> tried(count);
        std::vector<T> best(count), found(count), predicted(count);  // energies of the agents that move
        find_held();
        measure(controls, before, nullptr);
        if (held_.empty())
            std::copy(before + first_, before + last_, best.begin());
        else
            measure(controls, best.data() - first_, nullptr, held_);
        for (int64_t s = 0; s < run_.steps; ++s) {
            for (int64_t at = 0; at < count; ++at) tried[at] = valid_[at] ? COMPLETED : STOPPED;
            step(controls, trial, static_cast<T*>(run_.directions), nullptr, predicted.data() - first_, tried.data() - first_);
            measure(trial, found.data() - first_, nullptr, held_);
            bool all = true;
            for (int64_t at = 0; at < count; ++at) {
                const int64_t problem = first_ + at;
                if (done_[at]) continue;
                // The decrease is that with damping: only with little of it is a small decrease a sign of a minimum.
                done_[at] = predicted[at] <= std::numeric_limits<T>::epsilon() * best[at] && damping(problem) <= T(kLightDamping);
                all &= done_[at] != 0;
                if (found[at] < best[at]) {
                    std::copy(trial + problem * size_, trial + (problem + 1) * size_, controls + problem * size_);
                    best[at] = found[at];
                    change_damping(problem, [](T value) { return std::max(value / T(10), T(kLeastDamping)); });
                    run_.status[problem] = std::max(run_.status[problem], tried[at]);
                } else {
                    change_damping(problem, [](T value) { return std::min(value * T(10), T(kMostDamping)); });
                }
            }
            if (all) break;
        }
        std::fill(done_.begin(), done_.end(), 0);
        measure(controls, after, static_cast<T*>(run_.states));
        for (int64_t problem = first_; problem < last_; ++problem)
            if (!finite(after[problem])) run_.status[problem] = STOPPED;
    }

  private:
    /// Finds the agents with infinite damping, which keep their controls.
    void find_held() {
        if (!run_.damping_agent) return;
        held_.assign(last_ - first_, 0);
        for (int64_t problem = first_; problem < last_; ++problem)
            for (int64_t i = 0; i < game_.N; ++i) {
                const T given = static_cast<const T*>(run_.damping)[problem * run_.damping_problem + i * run_.damping_agent];
                held_[problem - first_] |= uint64_t(!finite(given)) << i;
            }
    }

    /// The damping of an agent of a group in an attempt to take a step; the first attempt has the number 0.
    T raised_damping(const Games<T>& group, int agent, int lane, int64_t attempt) const {
        constexpr int W = Lanes<T>::W;
        const T given = static_cast<const T*>(
            run_.damping)[group.problem[lane] * run_.damping_problem + group.agent[agent * W + lane] * run_.damping_agent];
        if (attempt == 0) return given;
        T added = std::max(given, T(kLeastRaisedDamping));
        for (int64_t repetition = 0; repetition < attempt; ++repetition) added *= T(10);
        return given + added;
    }

    /// Applies a function to the damping of the agents of a problem that move.
    template <class Change>
    void change_damping(int64_t problem, Change change) {
        T* const values = static_cast<T*>(run_.damping) + problem * run_.damping_problem;
        for (int64_t i = 0; i < (run_.damping_agent ? game_.N : 1); ++i) {
            T& value = values[i * run_.damping_agent];
            if (finite(value)) value = change(value);
        }
    }

    /// Largest damping of the agents of a problem that move.
    T damping(int64_t problem) {
        T most = 0;
        change_damping(problem, [&most](T value) { return most = std::max(most, value), value; });
        return most;
    }

    const EpoGame& game_;
    const EpoRun& run_;
    const int64_t first_, last_, row_, size_;
    Arena<T> arena_;
    std::vector<Buffer<T>> reused_;
    std::vector<char> valid_, done_;  // by problem
    std::vector<uint64_t> held_;      // by problem: mask of the held agents; empty if steps move all agents
};

template <class T>
std::unique_ptr<Tape<T>> solve(const EpoGame& game, const EpoRun& run, int64_t first, int64_t last) {
    Range<T> range(game, run, first, last);
    if (!run.adaptive) return range.solve();
    range.descend();
    return nullptr;
}

/// Adds the pullback of a cotangent of the states x_1 .. x_K to the cotangent of the controls.
template <class T>
void pull_states(const EpoGame& game, Arena<T>& arena, int64_t first, int64_t last, const T* controls, const T* states, T* bar) {
    constexpr int W = Lanes<T>::W;
    std::vector<int32_t> items;  // a problem and one of its agents
    for (int64_t problem = first; problem < last; ++problem)
        for (int64_t i = 0; i < game.N; ++i)
            if (game.present[problem / game.M * game.N + i]) items.insert(items.end(), {int32_t(problem), int32_t(i)});
    const int count = int(items.size()) / 2;
    for (int start = 0; start < count; start += W) {
        const int filled = std::min(W, count - start);
        arena.clear();
        const Games<T> games(game, arena, 1, 1, items.data() + 2 * start, filled, controls);
        const int K = games.K;
        const auto& path = games.path[0];
        Vec<T>*turn = arena.take(K), *thrust = arena.take(K), *given = arena.take(4 * K), x{}, y{}, heading{}, speed{};
        games.load(1, bar, turn, thrust);
        const T* rows[W];
        for (int lane = 0; lane < W; ++lane) rows[lane] = states + games.row_of(0, lane) * K * 4;
        gather<T>(rows, 4 * K, [&](int e, Vec<T> value) { given[e] = value; });
        for (int k = K - 1; k >= 0; --k) {
            const Vec<T> c = path.cosine[k + 1], s = path.sine[k + 1];
            if (k + 1 < K) {
                heading += games.dt * path.speed[k + 1] * (c * y - s * x);
                speed += games.dt * (c * x + s * y);
            }
            x += given[4 * k];
            y += given[4 * k + 1];
            heading += given[4 * k + 2];
            speed += given[4 * k + 3];
            turn[k] += games.dt * heading;
            thrust[k] += games.dt * speed;
        }
        games.store(turn, thrust, first_lanes(filled), bar);
    }
}

/// The adjoint of `solve`: from the last step to the first.
template <class T>
void differentiate_all(const Tape<T>& tape, const EpoGame& game, const EpoRun& run, const EpoGradients& gradients) {
    const int64_t first = tape.first, last = tape.last, size = game.N * game.K * 2, all = game.B * game.M * size;
    T* const bar = static_cast<T*>(gradients.controls);
    Arena<T> arena;
    const auto add_iterate = [&](int64_t s) {
        if (!gradients.iterates) return;
        const T* given = static_cast<const T*>(gradients.iterates) + s * all;
        for (int64_t e = first * size; e < last * size; ++e) bar[e] += given[e];
    };
    if (gradients.states)
        pull_states<T>(
            game, arena, first, last, static_cast<const T*>(run.iterates) + run.steps * run.iterate_stride,
            static_cast<const T*>(gradients.states), bar);
    add_iterate(run.steps);
    for (int64_t s = run.steps - 1; s >= 0; --s) {
        const StepTape<T>& step = tape.steps[s];
        const T* controls = static_cast<const T*>(run.iterates) + s * run.iterate_stride;
        for_each_group<T>(game, arena, step.plan, controls, [&](auto& group, int64_t index, int filled) {
            const int n = group.count.agents(), K = group.K;
            group.load_parameters();
            if (game.own[LANE]) group.nearest = Nearest<T>::at(step.nearest[n].data() + index * Nearest<T>::size(n, K), n, K);
            const auto factors = Factors<T>::at(step.factors[n].data() + index * Factors<T>::size(n, K), n, K);
            Vec<T>*bar_turn = arena.take(n * K), *bar_thrust = arena.take(n * K);
            Vec<T>*mu_turn = arena.take(n * K), *mu_thrust = arena.take(n * K);
            Vec<T>*d_turn = arena.take(n * K), *d_thrust = arena.take(n * K);
            group.load(n, bar, bar_turn, bar_thrust);
            group.load(n, static_cast<const T*>(run.directions) + s * all, d_turn, d_thrust);
            for (int e = 0; e < n * K; ++e) {
                mu_turn[e] = T(run.step_size) * bar_turn[e];
                mu_thrust[e] = T(run.step_size) * bar_thrust[e];
            }
            solve_adjoint(group, factors, mu_turn, mu_thrust);
            uint32_t taken = 0;
            for (int lane = 0; lane < filled; ++lane) taken |= uint32_t(step.taken[group.problem[lane] - first] != 0) << lane;
            if (gradients.adjoint) group.store(mu_turn, mu_thrust, taken, static_cast<T*>(gradients.adjoint));
            const ParameterGradients<T> by(arena, n, K, group.pairs);
            differentiate(group, mu_turn, mu_thrust, d_turn, d_thrust, bar_turn, bar_thrust, by);
            // A step that was not taken passes its cotangent on unchanged.
            group.store(bar_turn, bar_thrust, taken, bar);
            add_gradients<T>(group, by, taken, gradients);
        });
        add_iterate(s);
    }
    for (int64_t row = first * game.N; row < last * game.N; ++row)
        if (!game.present[row / (game.M * game.N) * game.N + row % game.N])
            std::fill(bar + row * game.K * 2, bar + (row + 1) * game.K * 2, T(0));
}

}  // namespace

const EpoLevel& level() {
    static const EpoLevel functions = {
        [](const EpoGame* game, const EpoRun* run, int64_t first, int64_t last) -> void* {
            return solve<float>(*game, *run, first, last).release();
        },
        [](const EpoGame* game, const EpoRun* run, int64_t first, int64_t last) -> void* {
            return solve<double>(*game, *run, first, last).release();
        },
        [](const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
            differentiate_all(*static_cast<const Tape<float>*>(tape), *game, *run, *gradients);
        },
        [](const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
            differentiate_all(*static_cast<const Tape<double>*>(tape), *game, *run, *gradients);
        },
        [](void* tape) { delete static_cast<Tape<float>*>(tape); },
        [](void* tape) { delete static_cast<Tape<double>*>(tape); },
        lq_equilibria,
        lq_pull_back,
        lq_follow,
        feedback,
        feedback_pull_back,
        Lanes<float>::W,
    };
    return functions;
}

}  // namespace EPO_LEVEL
