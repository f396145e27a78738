// The functions that Python calls, in the best version that this processor can run.

#include <vector>

#include "game.hpp"

#define DECLARE(name) \
    namespace name { \
    const EpoLevel& level(); \
    }
DECLARE(epo_plain)
#ifdef EPO_X86
DECLARE(epo_v3)
DECLARE(epo_v4)
#endif

namespace {

/// The levels that this processor can run, best last.
std::vector<const EpoLevel*> runnable() {
    std::vector<const EpoLevel*> levels = {&epo_plain::level()};
#ifdef EPO_X86
    __builtin_cpu_init();
    const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
    if (v3) levels.push_back(&epo_v3::level());
    if (v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd"))
        levels.push_back(&epo_v4::level());
#endif
    return levels;
}

const std::vector<const EpoLevel*> levels = runnable();
const EpoLevel* chosen = levels.back();

}  // namespace

extern "C" {

/// Of the sources, so that a stale library is noticed.
int64_t epo_fingerprint() { return EPO_FINGERPRINT; }

int64_t epo_levels() { return int64_t(levels.size()); }

/// Use level 0 (plain) to `epo_levels() - 1` (the best, as at the start) from now on. Tests compare them.
void epo_choose(int64_t level) { chosen = levels[level]; }

int64_t epo_lanes() { return chosen->lanes; }

/// Solve problems [first, last); the tape that comes back, if any, is for `epo_differentiate` and must be released.
void* epo_solve(int64_t doubles, const EpoGame* game, const EpoRun* run, int64_t first, int64_t last) {
    return (doubles ? chosen->solve_double : chosen->solve_float)(game, run, first, last);
}

void epo_differentiate(int64_t doubles, const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
    (doubles ? chosen->differentiate_double : chosen->differentiate_float)(tape, game, run, gradients);
}

void epo_release(int64_t doubles, void* tape) { (doubles ? chosen->release_double : chosen->release_float)(tape); }
}
