// Solves a game by the functions of recursion.hpp twice: with one thread, as on a CPU, and with BLOCK threads, as on a GPU.
// `test_recursion.py` writes the functions, defines the sizes, and compares the results.
#include <algorithm>
#include <cmath>
#include <condition_variable>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <iterator>
#include <mutex>
#include <string>
#include <thread>
#include <utility>
#include <vector>

template <class Number>
struct Array {
    Number* data;
};

constexpr int CONTROL = CONTROL_ITEMS * AGENTS, OWN = 20 * AGENTS, ROW = 4 * AGENTS * AGENTS;  // numbers of a step
constexpr int CHANGES = 2 * AGENTS * HORIZON;

struct Game {
    double controls[HORIZON][CONTROL], own[HORIZON][OWN], rows[PAIRS][HORIZON][ROW];
    double terms[CHANGES];  // another right-hand side
};
struct Memory {
    alignas(64) NUMBER fast[FAST_NUMBERS];
    alignas(64) NUMBER factors[HORIZON * FACTOR_NUMBERS];
    alignas(64) NUMBER linear[CHANGES];
    NUMBER changes[2 * CHANGES];
    int positive[BLOCK];
};
Game game;
Memory memory;
std::string left_out;  // "barriers", "exchange" or "copies": what many threads do without

struct OneThread {
    static constexpr int threads = 1;
    static void meet() {}
#define WP_TILE_BLOCK_DIM 1
#define WP_TILE_THREAD_IDX 0
#define WP_TILE_SYNC()
#include "functions.hpp"
#undef WP_TILE_BLOCK_DIM
#undef EPO_SYNC
#undef EPO_SYNC_LANES
};

// Only one thread runs at a time, from barrier to barrier, in the order of their numbers or in the opposite one. Without a
// barrier, it would read what a later one has yet to write; in the opposite order, what an earlier one has.
namespace gpu {
constexpr int WARP = 32;

struct Index {
    unsigned x;
};
thread_local Index threadIdx;

int direction = 1, turn = 0;
std::mutex turns;
std::condition_variable called[BLOCK];
int lines[BLOCK];  // of the barriers at which threads wait

void give_turn(int thread) {
    {
        const std::lock_guard<std::mutex> lock(turns);
        turn = thread;
    }
    called[thread].notify_one();
}

void await_turn() {
    std::unique_lock<std::mutex> lock(turns);
    called[threadIdx.x].wait(lock, [] { return turn == int(threadIdx.x); });
}

void require(bool condition, const char* message, int line) {
    if (condition) return;
    std::fprintf(stderr, "functions.hpp:%d: thread %u %s\n", line, threadIdx.x, message);
    std::_Exit(1);
}

// A barrier of `members` threads: the last one to come lets the first one go on. A GPU may hang if one waits elsewhere.
void meet(int members, int line) {
    const int me = threadIdx.x, among = me % members, place = direction > 0 ? among : members - 1 - among;
    lines[me] = line;
    require(place == 0 || lines[me - direction] == line, "is not where the one before it waits", line);
    give_turn(place + 1 < members ? me + direction : me - direction * place);
    await_turn();
}

void __syncthreads(int line = __builtin_LINE()) {
    if (left_out != "barriers") meet(BLOCK, line);
}

void __syncwarp(int line = __builtin_LINE()) {
    if (left_out != "barriers") meet(WARP, line);
}

NUMBER __shfl_sync(unsigned, NUMBER value, int lane, int line = __builtin_LINE()) {
    static NUMBER sent[BLOCK];
    sent[threadIdx.x] = value;
    meet(WARP, line);
    const NUMBER received = sent[threadIdx.x / WARP * WARP + unsigned(lane) % WARP];
    meet(WARP, line);
    return left_out == "exchange" ? value : received;
}

// A copy may be carried out at any time between its request and the wait for it: from the request on, the old numbers are
// gone, and the new ones are not there before the wait.
struct Copy {
    void* to;
    const void* from;
};
constexpr int BYTES = 16;
thread_local std::vector<Copy> requested;
thread_local std::deque<std::vector<Copy>> committed;

unsigned __cvta_generic_to_shared(const void* place) { return (const char*)place - (const char*)memory.fast; }
const void* __cvta_generic_to_global(const void* place) { return place; }

void request_copy(unsigned to, const void* from, int line = __builtin_LINE()) {
    require(to + BYTES <= sizeof(memory.fast), "copies to a place outside of shared memory", line);
    require(to % BYTES == 0 && std::uintptr_t(from) % BYTES == 0, "copies 16 bytes from or to a place between them", line);
    requested.push_back({(char*)memory.fast + to, from});
    std::memset(requested.back().to, 0xff, BYTES);  // no number
}

void commit_copies() { committed.push_back(std::exchange(requested, {})); }

void wait_for_copies(unsigned pending) {
    for (; committed.size() > pending; committed.pop_front()) {
        for (const Copy& copy : committed.front()) {
            if (left_out != "copies") std::memcpy(copy.to, copy.from, BYTES);
        }
    }
}

template <class Number>
Number rsqrt(Number x) {
    return 1 / std::sqrt(x);
}

struct ManyThreads {
    static constexpr int threads = BLOCK;
    static void meet() { gpu::meet(BLOCK, 0); }
#define __CUDA_ARCH__ 900
#define WP_TILE_BLOCK_DIM BLOCK
#include "functions.hpp"
};
}  // namespace gpu

// What is not written again is no number.
template <class Part>
void forget(Part& part) {
    std::memset(&part, 0xff, sizeof part);
}

template <class Functions>
void solve(int thread) {
    Functions functions;
    const Array<NUMBER> fast{memory.fast}, factors{memory.factors}, work{memory.linear}, changes{memory.changes};
    const NUMBER dt = 0.2;
    functions.begin(fast, HORIZON);
    memory.positive[thread] = 1;
    for (int last = HORIZON, first; last > 0; last = first) {
        first = std::max(last - FAST_STEPS, 0);
        if (thread == 0) {
            for (int k = first; k < last; ++k) {
                const int place = k % (FAST_STEPS + 1) * CONTROL;
                std::copy(std::begin(game.controls[k]), std::end(game.controls[k]), memory.fast + FAST_CONTROL + place);
            }
            std::copy(game.own[0] + first * OWN, game.own[0] + last * OWN, memory.fast + FAST_OWN);
            for (int f = 0; f < PAIRS; ++f) {
                const double* const rows = game.rows[f][0];
                std::copy(rows + first * ROW, rows + last * ROW, memory.fast + FAST_ROWS + f * FAST_STEPS * ROW);
            }
        }
        functions.meet();
        if (!functions.eliminate(work, 0, fast, factors, 1, PAIRS, first, last, HORIZON, dt)) memory.positive[thread] = 0;
    }
    functions.push(work, 0, fast, factors, HORIZON, dt, changes, 0, 1, {}, AGENTS, HORIZON);
    if (thread == 0) {  // as in a later launch, which finds nothing of this one in fast memory
        forget(memory.fast);
        std::copy(std::begin(game.terms), std::end(game.terms), memory.linear);
    }
    functions.meet();
    functions.pull(work, 0, fast, factors, HORIZON, dt);
    functions.push(work, 0, fast, factors, HORIZON, dt, changes, CHANGES, 1, {}, AGENTS, HORIZON);
}

void solve_by_turns(int thread) {
    gpu::threadIdx.x = thread;
    gpu::await_turn();
    solve<gpu::ManyThreads>(thread);
    gpu::give_turn((thread + gpu::direction + BLOCK) % BLOCK);
}

void print(int threads) {
    std::printf("%ld", long(std::count(memory.positive, memory.positive + threads, 1)));
    for (const NUMBER change : memory.changes) std::printf(" %.17g", double(change));
    std::printf("\n");
}

// Arguments: 1 or -1 for the order of the threads, and what is left out. Prints a line of one thread's results and one of
// many's: how many threads found all pivots positive, the step, and that for the other right-hand side.
int main(int, char** arguments) {
    gpu::direction = std::atoi(arguments[1]);
    left_out = arguments[2];
    if (std::fread(&game, sizeof game, 1, stdin) != 1) return 1;

    forget(memory);
    solve<OneThread>(0);
    print(1);

    forget(memory);
    gpu::turn = gpu::direction > 0 ? 0 : BLOCK - 1;
    std::vector<std::thread> threads;
    for (int thread = 0; thread < BLOCK; ++thread) threads.emplace_back(solve_by_turns, thread);
    for (std::thread& thread : threads) thread.join();
    print(BLOCK);
}
