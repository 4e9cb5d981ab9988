// Mending of marched rays (`Medium::mended_ray`), for `combine = "sum"`: mend_list, then mend_pixels, for each ray of a pass, behind march_pixels. Rays that
// are mended are few and of very different lengths, so that each has a block.
#include "rendering/march.cuh"

using namespace rw;

// Lists the pixels whose ray `number` is mended. The order does not matter, since a pixel is listed once.
extern "C" __global__ void __launch_bounds__(256)
mend_list(const __grid_constant__ FrameScene scene, uint32_t number, uint32_t pixels, uint32_t* __restrict__ length, uint32_t* __restrict__ list) {
    const uint32_t pixel = blockIdx.x * 256u + threadIdx.x;
    float drawn[2] = {1.0f, 0.0f};
    if (pixel < pixels) mend_draws(scene, pixel, number, drawn);
    const bool mended = drawn[0] < HALVED;
    const uint32_t ballot = __ballot_sync(0xffffffffu, mended), lane = threadIdx.x & 31u;
    uint32_t first = 0;
    if (lane == 0 && ballot) first = atomicAdd(length, __popc(ballot));
    first = __shfl_sync(0xffffffffu, first, 0);
    if (mended) list[first + __popc(ballot & ((1u << lane) - 1u))] = pixel;
}

// Adds what mends ray `number` of the listed pixels to their sums.
extern "C" __global__ void __launch_bounds__(128)
mend_pixels(const __grid_constant__ FrameScene scene, const __grid_constant__ March march, uint32_t number, const uint32_t* __restrict__ length,
            const uint32_t* __restrict__ list, double* __restrict__ sums) {
    __shared__ float memory[MEND_MEMORY];
    const size_t pixels = size_t(scene.width) * scene.height;
    for (uint32_t i = blockIdx.x; i < *length; i += gridDim.x) {
        const uint32_t pixel = list[i];
        mend_ray(Block{}, scene, march, pixel, number, march.step, memory);
        Block{}.each(3, [&](int k) { sums[k * pixels + pixel] += double(memory[MEND_MEMORY - 3 + k]); });
    }
}

// A block a ray of an audit, as the picture has it. found: radiance and opacity of each.
extern "C" __global__ void __launch_bounds__(128)
mend_checks(const __grid_constant__ FrameScene scene, const __grid_constant__ March march, const Check* __restrict__ checks, float* __restrict__ found) {
    __shared__ float memory[MEND_MEMORY];
    const Check check = checks[blockIdx.x];
    mend_ray(Block{}, scene, march, check.pixel, check.ray, check.step, memory);
    Block{}.each(4, [&](int k) { found[4 * blockIdx.x + k] = memory[CHECK_MEMORY + k] + (k < 3 ? memory[MEND_MEMORY - 3 + k] : 0.0f); });
}
