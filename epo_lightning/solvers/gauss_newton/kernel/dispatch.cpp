// The functions that Python calls, in the best version that this processor can run.

#include <new>
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

/// A tape, and who knows how to read it.
struct Handle {
    const EpoLevel* level;
    bool doubles;
    void* tape;
};

}  // namespace

extern "C" {

/// Of the sources, so that a stale library is noticed.
int64_t epo_fingerprint() { return EPO_FINGERPRINT; }

int64_t epo_levels() { return int64_t(levels.size()); }

/// Use level 0 (plain) to `epo_levels() - 1` (the best, as at the start) from now on. Tests compare them.
void epo_choose(int64_t level) { chosen = levels[level]; }

int64_t epo_lanes() { return chosen->lanes; }

/// Solve problems [first, last). `tape` becomes what `epo_differentiate` needs, or null; it must be released.
/// Returns 0, or 1 where there was not enough memory.
int64_t epo_solve(int64_t doubles, const EpoGame* game, const EpoRun* run, int64_t first, int64_t last, void** tape) {
    *tape = nullptr;
    try {
        void* made = (doubles ? chosen->solve_double : chosen->solve_float)(game, run, first, last);
        if (made) *tape = new Handle{chosen, doubles != 0, made};
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

int64_t epo_differentiate(const void* tape, const EpoGame* game, const EpoRun* run, const EpoGradients* gradients) {
    const Handle& handle = *static_cast<const Handle*>(tape);
    try {
        (handle.doubles ? handle.level->differentiate_double : handle.level->differentiate_float)(handle.tape, game, run, gradients);
        return 0;
    } catch (const std::bad_alloc&) {
        return 1;
    }
}

void epo_release(void* tape) {
    Handle* handle = static_cast<Handle*>(tape);
    (handle->doubles ? handle->level->release_double : handle->level->release_float)(handle->tape);
    delete handle;
}
}
