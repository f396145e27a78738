// The functions that Python calls; each uses the best instructions that this processor has.
//
// A call starts threads, distributes its problems over them, and waits until they have ended. An interrupt cannot end the call
// earlier, because Python handles signals only between two of its own instructions, and the call is a single instruction. The
// threads write to arrays of the caller; these arrays therefore exist until the threads have ended.

#include <algorithm>
#include <atomic>
#include <memory>
#include <thread>
#include <vector>

#include "layout.hpp"

#define DECLARE(name) \
    namespace name { \
    const EpoLevel& level(); \
    }
DECLARE(epo_plain)
DECLARE(epo_v3)
DECLARE(epo_v4)

namespace {

/// The levels in this library that the processor can run, best last. `build.py` defines a macro for every level in the library.
std::vector<const EpoLevel*> runnable() {
    std::vector<const EpoLevel*> levels;
#ifdef HAS_EPO_PLAIN
    levels.push_back(&epo_plain::level());
#endif
#if defined(HAS_EPO_V3) || defined(HAS_EPO_V4)
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#endif
#ifdef HAS_EPO_V3
    if (v3) levels.push_back(&epo_v3::level());
#endif
#ifdef HAS_EPO_V4
    if (v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd"))
        levels.push_back(&epo_v4::level());
#endif
    return levels;
}

const std::vector<const EpoLevel*> levels = runnable();
const EpoLevel* chosen = levels.empty() ? nullptr : levels.back();

/// The tapes of one call, one per range of problems, and the level that reads them.
struct Handle {
    const EpoLevel* level;
    bool doubles;
    std::vector<void*> tapes;

    ~Handle() {
        for (void* tape : tapes)
            if (tape) (doubles ? level->release_double : level->release_float)(tape);
    }
};

/// Runs body(0) .. body(count - 1) in parallel and waits until all have ended. Returns 0, or 1 if there was not enough memory. The
/// calling thread runs body(0), and every body for which the system cannot start another thread.
template <class Body>
int64_t in_parallel(int64_t count, const Body& body) {
    std::atomic<int64_t> outcome{0};
    const auto run = [&](int64_t index) noexcept {
        try {
            body(index);
        } catch (...) {  // allocations are all that can fail
            outcome = 1;
        }
    };
    std::vector<std::thread> threads(std::size_t(count - 1));
    for (int64_t index = 1; index < count; ++index) {
        try {
            threads[index - 1] = std::thread(run, index);
        } catch (...) {
            run(index);
        }
    }
    run(0);
    for (std::thread& thread : threads)
        if (thread.joinable()) thread.join();
    return outcome;
}

/// Whole registers of problems for every thread.
struct Ranges {
    int64_t problems, lanes, registers, count;
    Ranges(int64_t problems, int64_t lanes, int64_t threads)
        : problems(problems), lanes(lanes), registers((problems + lanes - 1) / lanes),
          count(std::max<int64_t>(1, std::min(threads, registers))) {}
    int64_t edge(int64_t range) const { return std::min(problems, lanes * (registers * range / count)); }
};

/// Runs body(first, last) in parallel for ranges of problems, and returns as `in_parallel` does.
template <class Body>
int64_t in_ranges(int64_t problems, int64_t threads, const Body& body) {
    try {
        const Ranges ranges(problems, chosen->lanes, threads);
        return in_parallel(ranges.count, [&](int64_t range) { body(ranges.edge(range), ranges.edge(range + 1)); });
    } catch (...) {
        return 1;
    }
}

}  // namespace

extern "C" {

/// Hash of the sources from which the library was built.
int64_t epo_fingerprint() { return EPO_FINGERPRINT; }

/// Number of levels that the processor can run; a library without any must not be called.
int64_t epo_levels() { return int64_t(levels.size()); }

/// Number of levels in the library.
int64_t epo_built() {
    int64_t built = 0;
#ifdef HAS_EPO_PLAIN
    ++built;
#endif
#ifdef HAS_EPO_V3
    ++built;
#endif
#ifdef HAS_EPO_V4
    ++built;
#endif
    return built;
}

/// Sizes, offsets and constants, up to an entry without a name.
const EpoLayoutEntry* epo_layout() { return kLayout; }

/// Chooses the level of instructions for all later calls: 0 (plain) to `epo_levels() - 1` (the best, and the default). Tests use it
/// to compare the levels.
void epo_choose(int64_t level) { chosen = levels[level]; }

/// Solves all problems on up to `threads` threads. Every thread gets whole registers of problems, so that results do not depend on
/// the number of threads. `*tape` becomes the data for `epo_differentiate`, or null if nothing is recorded; `epo_release` frees it.
/// Returns 0, or 1 if there was not enough memory; in that case there is no tape.
int64_t epo_solve(int64_t doubles, const EpoGame* game, const EpoRun* run, int64_t threads, void** tape) {
    *tape = nullptr;
    try {
        const EpoLevel& level = *chosen;
        const Ranges ranges(game->B * game->M, level.lanes, threads);
        std::unique_ptr<Handle> handle(new Handle{&level, doubles != 0, std::vector<void*>(std::size_t(ranges.count))});
        const int64_t outcome = in_parallel(ranges.count, [&](int64_t range) {
            const auto solve = doubles ? level.solve_double : level.solve_float;
            handle->tapes[range] = solve(game, run, ranges.edge(range), ranges.edge(range + 1));
        });
        if (outcome == 0 && run->record) *tape = handle.release();
        return outcome;
    } catch (...) {
        return 1;
    }
}

/// The adjoint of a call of `epo_solve`, on the same number of threads. Returns 0, or 1 if there was not enough memory.
int64_t epo_differentiate(const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
    const Handle& handle = *static_cast<const Handle*>(tape);
    const auto differentiate = handle.doubles ? handle.level->differentiate_double : handle.level->differentiate_float;
    try {
        return in_parallel(int64_t(handle.tapes.size()), [&](int64_t range) { differentiate(handle.tapes[range], game, run, gradients); });
    } catch (...) {
        return 1;
    }
}

/// Writes the equilibria of linear-quadratic games. Returns 0, or 1 if there was not enough memory; so do the next two functions.
int64_t epo_lq_equilibria(const EpoLQGames* games, int64_t threads) {
    return in_ranges(games->games, threads, [&](int64_t first, int64_t last) { chosen->lq_equilibria(games, first, last); });
}

/// The adjoint of a call of `epo_lq_equilibria`.
int64_t epo_lq_pull_back(const EpoLQGames* games, const EpoLQGradients* gradients, int64_t threads) {
    return in_ranges(games->games, threads, [&](int64_t first, int64_t last) { chosen->lq_pull_back(games, gradients, first, last); });
}

/// Writes the trajectories that follow policies.
int64_t epo_lq_follow(const EpoPolicies* policies, int64_t threads) {
    return in_ranges(policies->games, threads, [&](int64_t first, int64_t last) { chosen->lq_follow(policies, first, last); });
}

/// Solves driving games for feedback equilibria. Returns as the functions above, and so does the next one.
int64_t epo_feedback(const EpoGame* game, const EpoFeedback* run, int64_t threads) {
    return in_ranges(game->B * game->M, threads, [&](int64_t first, int64_t last) { chosen->feedback(game, run, first, last); });
}

/// The derivative of solutions of `epo_feedback`. `gradients->controls` is the cotangent, which is read.
int64_t epo_feedback_pull_back(const EpoGame* game, const EpoFeedback* run, const EpoGradients* gradients, int64_t threads) {
    return in_ranges(game->B * game->M, threads, [&](int64_t first, int64_t last) {
        chosen->feedback_pull_back(game, run, gradients, first, last);
    });
}

void epo_release(void* tape) { delete static_cast<Handle*>(tape); }
}
