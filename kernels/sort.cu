// Puts points in the order of their cells along a Morton curve, by one pass of counting.
//
// 1. sort_count: each point's bucket and, from the counter's old value, its rank within the bucket.
// 2. scan_*: bucket starts from bucket counts.
// 3. sort_place: writes {x, y, z, index} at start + rank.
// Buckets are runs of the Morton curve holding a few points each: a warp then reads the same cells as with a full sort. The order within a
// bucket is that of the atomics and changes from run to run; results are written back by index, so that they do not.
#include "base.cuh"

using namespace rw;

struct SortFrame {
    // Cell along axis k: (point[k] - first[k]) * per_cell[k], held to [0, cells[k] - 1].
    float first[3];
    float per_cell[3];
    // Bits of the cell index along each axis; 0 for axes that play no part.
    int bits[3];
    // Bits of the Morton key that are dropped to get the bucket.
    int shift;
    float last_cell[3];
};

__device__ __forceinline__ uint32_t bucket_of(const SortFrame& f, float x, float y, float z) {
    const float p[3] = {x, y, z};
    uint32_t cell[3];
#pragma unroll
    for (int k = 0; k < 3; k++) {
        // NaN falls into cell 0.
        cell[k] = uint32_t(fminf(fmaxf((p[k] - f.first[k]) * f.per_cell[k], 0.0f), f.last_cell[k]));
    }
    uint32_t key = 0;
    int at = 0;
    for (int bit = 0; bit < 16; bit++) {
#pragma unroll
        for (int k = 0; k < 3; k++) {
            if (bit < f.bits[k]) key |= (cell[k] >> bit & 1u) << at++;
        }
    }
    return key >> f.shift;
}

// counts: zero before. place: {bucket, rank} of each point.
extern "C" __global__ void __launch_bounds__(256)
sort_count(const float* __restrict__ points, uint32_t n, SortFrame frame, uint32_t* counts, uint2* __restrict__ place) {
    uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    uint32_t bucket = bucket_of(frame, points[3 * size_t(i)], points[3 * size_t(i) + 1], points[3 * size_t(i) + 2]);
    place[i] = make_uint2(bucket, atomicAdd(counts + bucket, 1u));
}

constexpr uint32_t SCAN_BLOCK = 256, SCAN_EACH = 16, SCAN_TILE = SCAN_BLOCK * SCAN_EACH;

// Exclusive sum over the block's threads; total in `total`.
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

// Exclusive sums of the tiles, in place, by one block.
extern "C" __global__ void __launch_bounds__(SCAN_BLOCK) scan_sums(uint32_t* tiles, uint32_t n) {
    uint32_t carry = 0;
    for (uint32_t from = 0; from < n; from += SCAN_BLOCK) {
        uint32_t i = from + threadIdx.x, total;
        uint32_t before = block_exclusive(i < n ? tiles[i] : 0u, total);
        if (i < n) tiles[i] = carry + before;
        carry += total;
    }
}

// Exclusive sums of the counts, in place.
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
