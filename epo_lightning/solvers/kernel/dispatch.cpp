// The functions that Python calls, in the best version that this processor can run.

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

const EpoLevel& best() {
#ifdef EPO_X86
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512cd"))
        return epo_v4::level();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return epo_v3::level();
#endif
    return epo_plain::level();
}

const EpoLevel& chosen = best();

}  // namespace

extern "C" {

/// Of the sources, so that a stale library is noticed.
int64_t epo_fingerprint() { return EPO_FINGERPRINT; }

int64_t epo_lanes() { return chosen.lanes; }

/// Solve problems [first, last); the tape that comes back, if any, is for `epo_differentiate` and must be released.
void* epo_solve(int64_t doubles, const EpoGame* game, const EpoRun* run, int64_t first, int64_t last) {
    return (doubles ? chosen.solve_double : chosen.solve_float)(game, run, first, last);
}

void epo_differentiate(int64_t doubles, const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
    (doubles ? chosen.differentiate_double : chosen.differentiate_float)(tape, game, run, gradients);
}

void epo_release(int64_t doubles, void* tape) { (doubles ? chosen.release_double : chosen.release_float)(tape); }
}
