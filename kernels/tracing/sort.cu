// Sorts points by cell along a Morton curve (Morton 1966), by one pass of a counting sort with a prefix sum in two levels.
//
// 1. sort_count: each point's bucket and, from the counter's previous value, its rank within the bucket.
// 2. scan_*: bucket starts from bucket counts.
// 3. sort_place: writes {x, y, z, index} at start + rank.
// Buckets are ranges of the Morton curve that hold a few points each, so that a warp reads the same cells as after a full sort. Atomics decide
// the order within a bucket, which differs from run to run. Results are written by index and do not depend on it.
#include "common/base.cuh"

using namespace rw;

struct SortFrame {
    // Cell along axis k: (point[k] - first[k]) * per_cell[k], clamped to [0, last_cell[k]].
    float first[3];
    float per_cell[3];
    // Bits of the cell index along each axis; 0 for unused axes.
    int bits[3];
    // Low bits of the Morton key that the bucket drops.
    int shift;
    float last_cell[3];
};

__device__ __forceinline__ uint32_t bucket_of(const SortFrame& f, float x, float y, float z) {
    const float p[3] = {x, y, z};
    uint32_t cell[3];
#pragma unroll
    for (int k = 0; k < 3; k++) {
        // NaN goes to cell 0.
        cell[k] = uint32_t(fminf(fmaxf((p[k] - f.first[k]) * f.per_cell[k], 0.0f), f.last_cell[k]));
    }
    uint32_t key = 0;
    int at = 0;
    for (int bit = 0; bit < 16; bit++) {
#pragma unroll
        for (int k = 0; k < 3; k++) if (bit < f.bits[k]) key |= (cell[k] >> bit & 1u) << at++;
    }
    return key >> f.shift;
}

// counts: zero on entry. place: {bucket, rank} of each point.
extern "C" __global__ void __launch_bounds__(256)
sort_count(const float* __restrict__ points, uint32_t n, SortFrame frame, uint32_t* counts, uint2* __restrict__ place) {
    uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    uint32_t bucket = bucket_of(frame, points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2]);
    place[i] = make_uint2(bucket, atomicAdd(counts + bucket, 1u));
}

constexpr uint32_t SCAN_BLOCK = 256, SCAN_EACH = 16, SCAN_TILE = SCAN_BLOCK * SCAN_EACH;

// Exclusive prefix sum over the block's threads; `total` is the sum of all.
__device__ uint32_t block_exclusive(uint32_t value, uint32_t& total) {
    __shared__ uint32_t sums[SCAN_BLOCK / 32];
    uint32_t lane = threadIdx.x & 31u, warp = threadIdx.x >> 5, inclusive = value;
    for (uint32_t d = 1; d < 32; d <<= 1) {
        uint32_t other = __shfl_up_sync(0xffffffffu, inclusive, d);
        if (lane >= d) inclusive += other;
    }
    if (lane == 31) sums[warp] = inclusive;
    __syncthreads();
    uint32_t before = 0;
    total = 0;
    for (uint32_t w = 0; w < SCAN_BLOCK / 32; w++) {
        if (w < warp) before += sums[w];
        total += sums[w];
    }
    __syncthreads();
    return before + inclusive - value;
}

// Sum of each tile of counts.
extern "C" __global__ void __launch_bounds__(SCAN_BLOCK) scan_tiles(const uint32_t* __restrict__ counts, uint32_t n, uint32_t* __restrict__ tiles) {
    uint32_t sum = 0;
    for (uint32_t k = 0; k < SCAN_EACH; k++) {
        uint32_t i = blockIdx.x * SCAN_TILE + k * SCAN_BLOCK + threadIdx.x;
        if (i < n) sum += counts[i];
    }
    uint32_t total;
    block_exclusive(sum, total);
    if (threadIdx.x == 0) tiles[blockIdx.x] = total;
}

// Exclusive prefix sum of the tiles, in place, by one block.
extern "C" __global__ void __launch_bounds__(SCAN_BLOCK) scan_sums(uint32_t* tiles, uint32_t n) {
    uint32_t tangential_velocity = 0;
    for (uint32_t from = 0; from < n; from += SCAN_BLOCK) {
        uint32_t i = from + threadIdx.x, total;
        uint32_t before = block_exclusive(i < n ? tiles[i] : 0u, total);
        if (i < n) tiles[i] = tangential_velocity + before;
        tangential_velocity += total;
    }
}

// Exclusive prefix sum of the counts, in place.
extern "C" __global__ void __launch_bounds__(SCAN_BLOCK) scan_apply(uint32_t* counts, uint32_t n, const uint32_t* __restrict__ tiles) {
    uint32_t first = blockIdx.x * SCAN_TILE + threadIdx.x * SCAN_EACH, mine[SCAN_EACH], sum = 0;
#pragma unroll
    for (uint32_t k = 0; k < SCAN_EACH; k++) {
        mine[k] = first + k < n ? counts[first + k] : 0u;
        sum += mine[k];
    }
    uint32_t total, before = block_exclusive(sum, total) + tiles[blockIdx.x];
#pragma unroll
    for (uint32_t k = 0; k < SCAN_EACH; k++) {
        if (first + k < n) counts[first + k] = before;
        before += mine[k];
    }
}

// sorted: {x, y, z, index as bits}.
extern "C" __global__ void __launch_bounds__(256)
sort_place(const float* __restrict__ points, uint32_t n, const uint32_t* __restrict__ starts, const uint2* __restrict__ place, float4* __restrict__ sorted) {
    uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    uint2 p = place[i];
    sorted[starts[p.x] + p.y] = make_float4(points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2], __uint_as_float(i));
}
