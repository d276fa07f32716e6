// What cuda.cu uses of CUDA, on the CPU: the lanes of a warp are coroutines that take turns, a shuffle is where
// they wait for each other. One thread, so atomics are plain. Linux (ucontext).
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <vector>

#define __global__
#define __device__
using std::isfinite;
using std::min;

struct Index {
    unsigned x, y;
};
static Index blockIdx, blockDim, threadIdx;


static unsigned __float_as_uint(float value) {
    unsigned bits;
    std::memcpy(&bits, &value, 4);
    return bits;
}

static long long __float2ll_rn(float value) { return std::llrint(value); }

static void atomicAdd(unsigned long long* at, unsigned long long value) { *at += value; }

static void atomicMin(unsigned long long* at, unsigned long long value) { *at = std::min(*at, value); }

namespace emulator {

const int WARP = 32;
const size_t STACK = 64 * 1024;

struct Lane {
    ucontext_t context;
    std::vector<char> stack = std::vector<char>(STACK);
    bool done;
};

static Lane lanes[WARP];
static float slots[WARP];
static int current, arrived;
static ucontext_t scheduler;
static const std::function<void()>* body;

static void enter() {
    (*body)();
    lanes[current].done = true;
}

static void wait() { swapcontext(&lanes[current].context, &scheduler); }

static void run_warp(unsigned first_thread) {
    for (Lane& lane : lanes) {
        getcontext(&lane.context);
        lane.context.uc_stack.ss_sp = lane.stack.data();
        lane.context.uc_stack.ss_size = STACK;
        lane.context.uc_link = &scheduler;
        lane.done = false;
        makecontext(&lane.context, enter, 0);
    }
    for (int left = WARP; left > 0;) {
        arrived = left = 0;
        for (current = 0; current < WARP; ++current) {
            if (lanes[current].done) continue;
            threadIdx.x = first_thread + current;
            swapcontext(&scheduler, &lanes[current].context);
            left += !lanes[current].done;
        }
        if (arrived != 0 && arrived != WARP) {
            std::fprintf(stderr, "a shuffle was reached by %d of %d lanes\n", arrived, WARP);
            std::abort();
        }
    }
}

// Every thread of every block; `backwards` runs blocks and warps in the opposite order.
static void run(unsigned grid_x, unsigned grid_y, unsigned block, bool backwards, const std::function<void()>& thread) {
    body = &thread;
    blockDim = {block, 1};
    const unsigned warps = block / WARP, total = grid_x * grid_y * warps;
    for (unsigned k = 0; k < total; ++k) {
        const unsigned at = backwards ? total - 1 - k : k;
        blockIdx = {at / warps % grid_x, at / warps / grid_x};
        run_warp(at % warps * WARP);
    }
}

}  // namespace emulator

static float __shfl_xor_sync(unsigned, float value, int step) {
    const int lane = emulator::current;
    emulator::slots[lane] = value;
    ++emulator::arrived;
    emulator::wait();
    const float other = emulator::slots[lane ^ step];
    emulator::wait();
    return other;
}
