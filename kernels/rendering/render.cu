// Wavefront path tracing (Laine, Karras and Aila 2013): flights advance to their next tentative collisions, which are answered in one batch.
//
// 1. render_start: every slot starts its first path and queues its first collisions.
// 2. The collisions are answered: all by the tracer (trace_grid.cu, trace_closed.cu), or some by a surrogate (answer.cu).
// 3. render_advance: every live slot takes its answers, ends and starts paths, and queues its next collisions. Steps 2 and 3 repeat until no
//    slot is live.
// 4. render_film: sums to pixels.
// Atomics decide the order within a list, which differs from run to run. No result depends on it.
#include "rendering/wavefront.cuh"

using namespace rw;

// The host sets `live` and `length` to 0 before each wave; the totals are those of the frame.
struct Control {
    uint32_t live;    // slots in the list of the next wave
    uint32_t length;  // collisions in the queue
    unsigned long long totals[COUNTS];
};
static_assert(sizeof(Control) == 56, "layout");

// Adds a warp's counts to the totals. All threads of the warp must call it.
__device__ __forceinline__ void add_counts(const Counts& counts, Control* control) {
    const uint32_t each[COUNTS] = {counts.queries, counts.traced, counts.missing, counts.exceeded, counts.paths, counts.over_budget};
    RW_UNROLL
    for (int k = 0; k < COUNTS; ++k) {
        const uint32_t sum = warp_sum(each[k]);
        if ((threadIdx.x & 31u) == 0u && sum != 0u) atomicAdd(&control->totals[k], (unsigned long long)sum);
    }
}

extern "C" __global__ void __launch_bounds__(128)
render_start(const __grid_constant__ FrameScene scene, MajorantGrid grid, Watch watch, Band band, Slots slots, Queue queue,
             uint32_t* __restrict__ live, uint32_t ahead, Control* control) {
    const uint32_t slot = blockIdx.x * 128u + threadIdx.x;
    Counts counts = {};
    if (slot < band.pixels * band.parts && advance(scene, grid, watch, band, slots, queue, slot, true, ahead, ahead, counts)) {
        live[reserve(&control->live)] = slot;
    }
    add_counts(counts, control);
}

extern "C" __global__ void __launch_bounds__(128)
render_advance(const __grid_constant__ FrameScene scene, MajorantGrid grid, Watch watch, Band band, Slots slots, Queue queue,
               const uint32_t* __restrict__ before, uint32_t count, uint32_t* __restrict__ live, uint32_t ahead_camera,
               uint32_t ahead_shadow, Control* control) {
    const uint32_t i = blockIdx.x * 128u + threadIdx.x;
    Counts counts = {};
    if (i < count) {
        const uint32_t slot = before[i];
        if (advance(scene, grid, watch, band, slots, queue, slot, false, ahead_camera, ahead_shadow, counts)) {
            live[reserve(&control->live)] = slot;
        }
    }
    add_counts(counts, control);
}

// The colours of all pixels of the band, then a plane for each of the other values, in the order of `Filled::Tracked` of films.rs.
extern "C" __global__ void __launch_bounds__(256) render_film(Band band, Slots slots, float* __restrict__ film) {
    const uint32_t pixel = blockIdx.x * 256u + threadIdx.x;
    if (pixel >= band.pixels) return;
    const PixelValue value = finished(band, slots, pixel);
    const float rest[6] = {value.ftle_mean, value.traced, value.missing, value.queries, value.samples, value.variance};
    reinterpret_cast<float4*>(film)[pixel] = make_float4(value.rgba[0], value.rgba[1], value.rgba[2], value.rgba[3]);
    for (uint32_t k = 0; k < 6u; ++k) film[(size_t)(4u + k) * band.pixels + pixel] = rest[k];
}
