// S steps for a range of problems, and their adjoint. Compiled once for every level of instructions; see dispatch.cpp.
//
// In each step, every problem is split into groups of agents that overlap at the current iterate: the connected components of the
// graph of active pairs. Each group has a factorisation of its own. Groups of the same size are solved together, one per lane of
// the vector registers.

#include <algorithm>
#include <cstring>
#include <memory>

#include "step.hpp"

namespace EPO_LEVEL {
namespace {

static_assert(kMostAgents == 8 * sizeof(uint64_t), "contacts are a mask of one bit per agent");

/// Groups of agents in contact by size: items[n] holds rows of a problem and its n agents, in ascending order.
struct Plan {
    std::vector<std::vector<int32_t>> items;
    int64_t groups(int n, int lanes) const { return (int64_t(items[n].size()) / (n + 1) + lanes - 1) / lanes; }
};

/// Contacts between the agents of W problems: bit j of touching[i * W + lane] is set where i and j overlap.
template <class T>
void find_contacts(const EpoGame& game, Arena<T>& arena, const int* problems, const T* controls, uint64_t* touching) {
    constexpr int W = Lanes<T>::W;
    const int N = int(game.N), K = int(game.K);
    // Only the states at which pairs are evaluated are kept.
    const int stride = int(game.pair_stride), kept = K / stride;
    Vec<T>*x = arena.take(N * kept), *y = arena.take(N * kept), *box = arena.take(4 * N), *radius = arena.take(N);
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
        for (int k = 0; k < K; ++k) {
            Vec<T> sine, cosine;
            const Vec<T> speed = start_speed + faster;
            sincos<T>(start_heading + turned, sine, cosine);
            moved_x += dt * speed * cosine;
            moved_y += dt * speed * sine;
            turned += dt * given[2 * k + 1];
            faster += dt * given[2 * k];
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
    std::memset(touching, 0, sizeof(uint64_t) * N * W);
    int pair = 0;
    for (int i = 0; i < N; ++i)
        for (int j = i + 1; j < N; ++j, ++pair) {
            Vec<T> reach = radius[i] + radius[j];
            for (int f = 0; f < PAIR_COUNT; ++f) {
                if (!game.margins[f]) continue;
                Vec<T> wider;
                for (int lane = 0; lane < W; ++lane)
                    wider[lane] = of_pair<T>(game.margins[f], game.margin_strides[f], problems[lane] / game.M, problems[lane] % game.M, pair);
                reach = most<T>(reach, radius[i] + radius[j] + wider);
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

template <class T>
Plan make_plan(const EpoGame& game, Arena<T>& arena, int64_t first, int64_t last, const T* controls) {
    constexpr int W = Lanes<T>::W;
    const int N = int(game.N);
    Plan plan;
    plan.items.resize(N + 1);
    std::vector<uint64_t> touching(std::size_t(N) * W, 0);
    for (int64_t start = first; start < last; start += W) {
        const int filled = int(std::min<int64_t>(W, last - start));
        if (interacts(game)) {
            int problems[W];
            for (int lane = 0; lane < W; ++lane) problems[lane] = int(start + std::min(lane, filled - 1));
            arena.clear();
            find_contacts<T>(game, arena, problems, controls, touching.data());
        }
        for (int lane = 0; lane < filled; ++lane) {
            uint64_t left = 0;
            for (int i = 0; i < N; ++i) left |= uint64_t(game.present[(start + lane) / game.M * N + i] != 0) << i;
            while (left) {
                uint64_t group = left & -left, border = group;
                while (border) {
                    const int i = __builtin_ctzll(border);
                    border &= border - 1;
                    const uint64_t fresh = touching[std::size_t(i) * W + lane] & ~group;
                    group |= fresh;
                    border |= fresh;
                }
                left &= ~group;
                auto& items = plan.items[__builtin_popcountll(group)];
                items.push_back(int32_t(start + lane));
                for (uint64_t rest = group; rest; rest &= rest - 1) items.push_back(__builtin_ctzll(rest));
            }
        }
    }
    return plan;
}

/// Data of one step for its adjoint.
template <class T>
struct StepTape {
    Plan plan;
    std::vector<Buffer<T>> factors, nearest;  // by group size, group after group
    std::vector<char> taken;               // by problem of the range: whether it took the step
};

template <class T>
struct Tape {
    int64_t first, last;
    std::vector<StepTape<T>> steps;
};

/// Calls body(group, index, lanes in use) for every W groups of the same size; `index` counts these calls, from 0 for each size. For up
/// to 4 agents, the number of agents is known at compile time.
template <class T, class Body>
void for_each_group(const EpoGame& game, Arena<T>& arena, const Plan& plan, const T* controls, const Body& body) {
    constexpr int W = Lanes<T>::W;
    for (int n = 1; n < int(plan.items.size()); ++n) {
        const auto& items = plan.items[n];
        const int64_t count = int64_t(items.size()) / (n + 1);
        for (int64_t start = 0; start < count; start += W) {
            const int32_t* rows = items.data() + start * (n + 1);
            const int filled = int(std::min<int64_t>(W, count - start));
            arena.clear();
            const auto call = [&](auto size) {
                using Size = decltype(size);
                auto group = Group<T, Size::value>(game, arena, Count<Size::value>{n}, rows, filled, controls);
                body(group, start / W, filled);
            };
            switch (n) {
                case 1: call(std::integral_constant<int, 1>{}); break;
                case 2: call(std::integral_constant<int, 2>{}); break;
                case 3: call(std::integral_constant<int, 3>{}); break;
                case 4: call(std::integral_constant<int, 4>{}); break;
                default: call(std::integral_constant<int, 0>{});
            }
        }
    }
}

template <class T>
INLINE bool finite(T value) {
    return value - value == 0;
}

/// Whether the reference lines of a problem exist and its inputs are finite. It checks the inputs whose NaN may not show in the
/// result, such as the weight of a pair that never touches, or points of a line that are never the nearest.
template <class T>
bool valid(const EpoGame& game, int64_t problem) {
    const bool coupled = interacts(game);
    const int64_t b = problem / game.M, m = problem % game.M;
    const uint8_t* present = game.present + b * game.N;
    int64_t pair = 0;
    for (int64_t i = 0; i < game.N; ++i) {
        const int64_t row = b * game.N + i;
        if (present[i]) {
            const T* start = static_cast<const T*>(game.initial) + b * game.initial_b + i * game.initial_n;
            for (int e = 0; e < 4; ++e)
                if (!finite(start[e])) return false;
            if ((coupled || game.own[STEER]) && !finite(static_cast<const T*>(game.size)[2 * row])) return false;
            if (game.reference) {
                const int64_t line = game.reference[problem * game.N + i];
                if (line < 0 || line >= game.lines) return false;
                const T* point = static_cast<const T*>(game.references) + (row * game.lines + line) * game.points * 2;
                bool all = true;
                for (int64_t e = 0; e < 2 * game.points; ++e) all &= finite(point[e]);
                if (!all) return false;
            }
        }
        for (int64_t j = i + 1; coupled && j < game.N; ++j, ++pair)
            for (int f = 0; f < PAIR_COUNT; ++f) {
                if (!present[i] || !present[j] || !game.pair[f]) continue;
                if (!finite(of_pair<T>(game.pair[f], game.pair_strides[f], b, m, pair))) return false;
                if (game.margins[f] && !finite(of_pair<T>(game.margins[f], game.margin_strides[f], b, m, pair))) return false;
            }
    }
    return true;
}

template <class T>
std::unique_ptr<Tape<T>> solve(const EpoGame& game, const EpoRun& run, int64_t first, int64_t last) {
    constexpr int W = Lanes<T>::W;
    const int64_t row = game.K * 2, size = game.N * row;
    const bool record = run.record != 0, has_lines = game.own[LANE] != nullptr;
    auto tape = std::make_unique<Tape<T>>(Tape<T>{first, last, {}});
    T* const energies[2] = {static_cast<T*>(run.initial_energy), static_cast<T*>(run.energy)};
    T* const norm = static_cast<T*>(run.gradient_norm);
    Arena<T> arena;
    std::vector<Buffer<T>> reused(game.N + 1);
    std::vector<char> inputs_valid(last - first);
    for (int64_t problem = first; problem < last; ++problem) {
        inputs_valid[problem - first] = valid<T>(game, problem);
        run.status[problem] = inputs_valid[problem - first] ? SOLVED : STOPPED;
    }
    for (int64_t problem = first; problem < last; ++problem)
        for (int64_t i = 0; i < game.N; ++i) {
            const T* from = static_cast<const T*>(run.start) + problem * size + i * row;
            T* to = static_cast<T*>(run.iterates) + problem * size + i * row;
            if (game.present[problem / game.M * game.N + i])
                std::copy(from, from + row, to);
            else
                std::fill(to, to + row, T(0));
        }
    for (int64_t s = 0; s < run.steps; ++s) {
        T* const controls = static_cast<T*>(run.iterates) + s * run.iterate_stride;
        T* const next = controls + run.iterate_stride;
        T* const directions = static_cast<T*>(run.directions) + (record ? s * game.B * game.M * size : 0);
        StepTape<T> step;
        step.plan = make_plan<T>(game, arena, first, last, controls);
        step.factors.resize(game.N + 1);
        step.nearest.resize(game.N + 1);
        step.taken = inputs_valid;
        for (int n = 1; n <= game.N; ++n) {
            const std::size_t groups = step.plan.groups(n, W);
            if (groups && (record || !reused[n]))
                (record ? step.factors : reused)[n] = Buffer<T>((record ? groups : 1) * Factors<T>::size(n, game.K));
            if (groups && record && has_lines) step.nearest[n] = Buffer<T>(groups * Nearest<T>::size(n, game.K));
        }
        if (s == 0) std::fill(energies[0] + first, energies[0] + last, T(0));
        for_each_group<T>(game, arena, step.plan, controls, [&](auto& group, int64_t index, int filled) {
            const int n = group.count.agents();
            group.load_parameters();
            if (has_lines && record)
                group.template find_nearest<true>(Nearest<T>::at(step.nearest[n].data() + index * Nearest<T>::size(n, game.K), n, game.K));
            else if (has_lines)
                group.template find_nearest<false>(Nearest<T>::at(arena.take(Nearest<T>::size(n, game.K)), n, game.K));
            Vec<T>* memory = record ? step.factors[n].data() + index * Factors<T>::size(n, game.K) : reused[n].data();
            const auto factors = Factors<T>::at(memory, n, game.K);
            Vec<T>*turn = arena.take(n * game.K), *thrust = arena.take(n * game.K), energy;
            Vec<T>*given = arena.take(n), *damping = arena.take(n), *raised = arena.take(n);
            for (int i = 0; i < n; ++i) {
                for (int lane = 0; lane < W; ++lane)
                    given[i][lane] = static_cast<const T*>(
                        run.damping)[group.problem[lane] * run.damping_problem + group.agent[i * W + lane] * run.damping_agent];
                damping[i] = given[i];
                raised[i] = most<T>(given[i], splat<T>(T(kLeastRaisedDamping)));
            }
            Mask<T> positive, failed{};
            for (int attempt = 0;; ++attempt) {
                solve_step(group, damping, factors, turn, thrust, energy, positive);
                if (attempt == kRetries || !any<T>(~positive)) break;
                failed |= ~positive;
                for (int i = 0; i < n; ++i) {
                    raised[i] *= T(10);
                    damping[i] = positive ? damping[i] : given[i] + raised[i];
                }
            }
            for (int lane = 0; lane < filled; ++lane) {
                const int problem = group.problem[lane];
                if (failed[lane]) run.status[problem] = std::max<int64_t>(run.status[problem], DAMPED);
                if (!positive[lane]) step.taken[problem - first] = 0;
                if (s == 0) energies[0][problem] += energy[lane];
            }
            group.store(turn, thrust, filled, directions, [](int) { return true; });
        });
        for (int64_t problem = first; problem < last; ++problem) {
            T *d = directions + problem * size, *from = controls + problem * size, *to = next + problem * size;
            const T alpha = T(run.step_size);
            // Absent agents are in no group, so no direction was stored for them.
            const uint8_t* present = game.present + problem / game.M * game.N;
            for (int64_t i = 0; i < game.N; ++i)
                if (!present[i]) std::fill(d + i * row, d + (i + 1) * row, T(0));
            bool taken = step.taken[problem - first];
            for (int64_t e = 0; e < size; ++e) taken &= finite(from[e] + alpha * d[e]);
            step.taken[problem - first] = taken;
            if (!taken) run.status[problem] = STOPPED;
            for (int64_t e = 0; e < size; ++e) to[e] = taken ? from[e] + alpha * d[e] : from[e];
        }
        if (record) tape->steps.push_back(std::move(step));
    }
    T* const controls = static_cast<T*>(run.iterates) + run.steps * run.iterate_stride;
    std::fill(energies[1] + first, energies[1] + last, T(0));
    std::fill(norm + first, norm + last, T(0));
    std::memset(static_cast<T*>(run.states) + first * size * 2, 0, sizeof(T) * (last - first) * size * 2);
    for_each_group<T>(game, arena, make_plan<T>(game, arena, first, last, controls), controls, [&](auto& group, int64_t, int filled) {
        const int n = group.count.agents();
        group.load_parameters();
        if (has_lines) group.template find_nearest<false>(Nearest<T>::at(arena.take(Nearest<T>::size(n, game.K)), n, game.K));
        Vec<T> energy, squared;
        evaluate(group, energy, squared);
        for (int lane = 0; lane < filled; ++lane) {
            energies[1][group.problem[lane]] += energy[lane];
            norm[group.problem[lane]] += squared[lane];
        }
        for (int i = 0; i < n; ++i) {
            const auto& path = group.path[i];
            const Vec<T>* const entries[4] = {path.x, path.y, path.heading, path.speed};
            T* rows[W];
            for (int lane = 0; lane < W; ++lane)
                rows[lane] = lane < filled ? static_cast<T*>(run.states) + group.row_of(i, lane) * game.K * 4 : nullptr;
            scatter<T>([&](int e) { return entries[e % 4][e / 4 + 1]; }, 4 * group.K, rows);
        }
    });
    for (int64_t problem = first; problem < last; ++problem) norm[problem] = std::sqrt(norm[problem]);
    if (run.steps == 0) std::copy(energies[1] + first, energies[1] + last, energies[0] + first);
    return record ? std::move(tape) : nullptr;
}

/// Adds the pullback of a cotangent of the states x_1 .. x_K to the cotangent of the controls.
template <class T>
void pull_states(const EpoGame& game, Arena<T>& arena, int64_t first, int64_t last, const T* controls, const T* states, T* bar) {
    Plan single;
    single.items.resize(2);
    for (int64_t problem = first; problem < last; ++problem)
        for (int64_t i = 0; i < game.N; ++i)
            if (game.present[problem / game.M * game.N + i]) single.items[1].insert(single.items[1].end(), {int32_t(problem), int32_t(i)});
    for_each_group<T>(game, arena, single, controls, [&](auto& group, int64_t, int filled) {
        const int K = group.K;
        const auto& path = group.path[0];
        Vec<T>*turn = arena.take(K), *thrust = arena.take(K), *given = arena.take(4 * K), x{}, y{}, heading{}, speed{};
        group.load(bar, turn, thrust);
        const T* rows[Lanes<T>::W];
        for (int lane = 0; lane < Lanes<T>::W; ++lane) rows[lane] = states + group.row_of(0, lane) * K * 4;
        gather<T>(rows, 4 * K, [&](int e, Vec<T> value) { given[e] = value; });
        for (int k = K - 1; k >= 0; --k) {
            const Vec<T> c = path.cosine[k + 1], s = path.sine[k + 1];
            if (k + 1 < K) {
                heading += group.dt * path.speed[k + 1] * (c * y - s * x);
                speed += group.dt * (c * x + s * y);
            }
            x += given[4 * k];
            y += given[4 * k + 1];
            heading += given[4 * k + 2];
            speed += given[4 * k + 3];
            turn[k] += group.dt * heading;
            thrust[k] += group.dt * speed;
        }
        group.store(turn, thrust, filled, bar, [](int) { return true; });
    });
}

/// The adjoint of `solve`: from the last step to the first.
template <class T>
void differentiate_all(const Tape<T>& tape, const EpoGame& game, const EpoRun& run, const EpoGradients& gradients) {
    const int64_t first = tape.first, last = tape.last, size = game.N * game.K * 2, all = game.B * game.M * size;
    const int64_t P = game.N * (game.N - 1) / 2;
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
            group.load(bar, bar_turn, bar_thrust);
            group.load(static_cast<const T*>(run.directions) + s * all, d_turn, d_thrust);
            for (int e = 0; e < n * K; ++e) {
                mu_turn[e] = T(run.step_size) * bar_turn[e];
                mu_thrust[e] = T(run.step_size) * bar_thrust[e];
            }
            solve_adjoint(group, factors, mu_turn, mu_thrust);
            const int shared = PAIR_COUNT * group.pairs;
            const ParameterGradients<T> by{
                arena.take(OWN_COUNT * n), arena.take(shared), arena.take(shared), arena.take(n), arena.take(n), arena.take(n)};
            for (int e = 0; e < OWN_COUNT * n; ++e) by.own[e] = Vec<T>{};
            for (int e = 0; e < shared; ++e) by.pair[e] = by.margin[e] = Vec<T>{};
            for (int e = 0; e < n; ++e) by.goal_x[e] = by.goal_y[e] = by.goal_heading[e] = Vec<T>{};
            differentiate(group, mu_turn, mu_thrust, d_turn, d_thrust, bar_turn, bar_thrust, by);
            // A step that was not taken passes its cotangent on unchanged.
            const auto taken = [&](int lane) { return step.taken[group.problem[lane] - first] != 0; };
            group.store(bar_turn, bar_thrust, filled, bar, taken);
            for (int lane = 0; lane < filled; ++lane) {
                if (!taken(lane)) continue;
                int pair = 0;
                for (int i = 0; i < n; ++i) {
                    const int64_t row = group.row_of(i, lane);
                    for (int f = 0; f < OWN_COUNT; ++f)
                        if (game.own[f]) static_cast<T*>(gradients.own[f])[row] += by.own[f * n + i][lane];
                    if (game.own[GOAL]) {
                        static_cast<T*>(gradients.goals)[2 * row] += by.goal_x[i][lane];
                        static_cast<T*>(gradients.goals)[2 * row + 1] += by.goal_y[i][lane];
                    }
                    if (game.own[HEADING]) static_cast<T*>(gradients.goal_headings)[row] += by.goal_heading[i][lane];
                    for (int j = i + 1; group.coupled && j < n; ++j, ++pair) {
                        const int64_t a = group.agent[i * Lanes<T>::W + lane], c = group.agent[j * Lanes<T>::W + lane];
                        const int64_t entry = group.problem[lane] * P + a * game.N - a * (a + 1) / 2 + c - a - 1;
                        for (int f = 0; f < PAIR_COUNT; ++f) {
                            if (game.pair[f]) static_cast<T*>(gradients.pair[f])[entry] += by.pair[f * group.pairs + pair][lane];
                            if (gradients.margins[f])
                                static_cast<T*>(gradients.margins[f])[entry] += by.margin[f * group.pairs + pair][lane];
                        }
                    }
                }
            }
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
        Lanes<float>::W,
    };
    return functions;
}

}  // namespace EPO_LEVEL
