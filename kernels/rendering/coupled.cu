// Coupled paths in waves, as in render.cu, of the pixels of a list (see coupled.cuh).
//
// 1. coupled_list: the pixels that get a pair of paths in this frame.
// 2. coupled_advance: every live slot takes its answers, flies on and queues collisions; in the first wave every slot begins its path.
// 3. The collisions are answered. Steps 2 and 3 repeat until no slot is live.
// 4. coupled_add: the results of all paths go to the sums of their pixels, which no earlier step changes.
// Atomics decide the order within the queue, which differs from run to run. No result depends on it.
#include "rendering/coupled.cuh"

using namespace rw;

// The host sets all but the totals to 0 before each wave; the totals are those of the frame.
struct CoupledControl {
    uint32_t live;     // slots in the list of the next wave
    uint32_t length;   // collisions in the queue
    uint32_t guesses;  // asked for by the look-ahead, granted or not
    uint32_t pad;
    unsigned long long totals[COUNTS];
};
static_assert(sizeof(CoupledControl) == 64, "layout");

// Sum of a flag over the earlier threads of a block of TILE_PIXELS. All of them must call it.
__device__ __forceinline__ uint32_t flagged_before(bool flag) {
    __shared__ uint32_t in_warp[TILE_PIXELS / 32];
    const uint32_t votes = __ballot_sync(0xffffffffu, flag), lane = threadIdx.x & 31u, warp = threadIdx.x / 32u;
    if (lane == 0u) in_warp[warp] = uint32_t(__popc(votes));
    __syncthreads();
    uint32_t before = uint32_t(__popc(votes & ((1u << lane) - 1u)));
    for (uint32_t other = 0; other < warp; ++other) before += in_warp[other];
    return before;
}

// One block a tile.
extern "C" __global__ void __launch_bounds__(256)
coupled_list(uint32_t width, uint32_t height, const PairTile* __restrict__ tiles, uint32_t* __restrict__ list) {
    const PairTile tile = tiles[blockIdx.x];
    const uint32_t pixel = listed_pixel(width, height, tile, blockIdx.x, threadIdx.x);
    const uint32_t before = flagged_before(pixel != LAST);
    if (pixel != LAST) list[tile.offset + before] = pixel;
}

// `before` lists `count` live slots; null: the slots 0 to `count` begin their paths.
extern "C" __global__ void __launch_bounds__(128)
coupled_advance(const __grid_constant__ FrameScene scene, MajorantGrid grid, Watch watch, const __grid_constant__ Surrogate surrogate,
                CoupledWork work, CoupledSlots slots, CoupledQueue queue, const uint32_t* __restrict__ before, uint32_t count,
                uint32_t* __restrict__ live, CoupledControl* control) {
    const uint32_t i = blockIdx.x * 128u + threadIdx.x;
    Counts counts = {};
    if (i < count) {
        const uint32_t slot = before ? before[i] : i;
        const CoupledFrame frame = {scene, grid, watch, surrogate};
        if (advance_coupled(frame, work, slots, queue, slot, before == nullptr, counts)) live[reserve(&control->live)] = slot;
    }
    const uint32_t each[COUNTS] = {counts.queries, counts.traced, counts.missing, counts.exceeded, counts.paths, counts.over_budget};
    RW_UNROLL
    for (int k = 0; k < COUNTS; ++k) {
        const uint32_t sum = warp_sum(each[k]);
        if ((threadIdx.x & 31u) == 0u && sum != 0u) atomicAdd(&control->totals[k], (unsigned long long)sum);
    }
}

extern "C" __global__ void __launch_bounds__(256) coupled_add(CoupledWork work, float* __restrict__ sums) {
    const uint32_t entry = blockIdx.x * 256u + threadIdx.x;
    if (entry < work.entries) add_pair(work, sums, entry);
}
