// Combines the marched picture with the correction. First combine_guides, combine_filter with spacings 1 and 2, combine_normal and combine_solve. For
// each half: combine_rest, then per level combine_rows, combine_columns, combine_box (energies) and
// combine_gains; combine_last stands in for the first two on the last level. Then combine_tiles, and, once the host has the tiles' sums,
// combine_errors.
#include "rendering/regression.cuh"

using namespace rw;

extern "C" __global__ void __launch_bounds__(256) combine_guides(const Regression regression) {
    const size_t at = size_t(blockIdx.x) * 256u + threadIdx.x;
    if (at < size_t(regression.width) * regression.height) put_guides(regression, at);
}

// Blocks of 32 x 8 pixels. GUIDES planes each.
extern "C" __global__ void __launch_bounds__(256)
combine_filter(const float* __restrict__ from, float* __restrict__ to, int width, int height, int spacing) {
    const int x = int(blockIdx.x * 32u + (threadIdx.x & 31u)), y = int(blockIdx.y * 8u + threadIdx.x / 32u);
    if (x < width && y < height) filter_guides(from, to, width, height, x, y, spacing);
}

extern "C" __global__ void __launch_bounds__(256) combine_normal(const Regression regression) {
    __shared__ float memory[STRIP_MEMORY];
    sum_normal(Block{}, regression, int(blockIdx.x), memory);
}

// One block.
extern "C" __global__ void __launch_bounds__(256) combine_solve(const Regression regression) {
    __shared__ double memory[SOLVE_MEMORY];
    solve_normal(Block{}, regression, memory);
}

// rest: 6 planes; correction: 3 planes.
extern "C" __global__ void __launch_bounds__(256)
combine_rest(const Regression regression, int half, float* __restrict__ rest, float* __restrict__ correction) {
    const size_t at = size_t(blockIdx.x) * 256u + threadIdx.x;
    if (at < size_t(regression.width) * regression.height) put_rest(regression, half, at, rest, correction);
}

// Blocks of 32 x 8 pixels. rows: 8 planes, those of `fine` filtered along rows.
extern "C" __global__ void __launch_bounds__(256)
combine_rows(const Quarters fine, float* __restrict__ rows, int width, int height, int spacing) {
    const int x = int(blockIdx.x * 32u + (threadIdx.x & 31u)), y = int(blockIdx.y * 8u + threadIdx.x / 32u);
    if (x >= width || y >= height) return;
    const size_t pixels = size_t(width) * height, row = size_t(y) * width;
    const Taps along = taps(x, width, spacing, 1);
    RW_UNROLL
    for (int k = 0; k < 8; ++k) rows[k * pixels + row + x] = b3(fine.planes[k / 4][k % 4] + row, along);
}

// Blocks of 32 x 8 pixels.
extern "C" __global__ void __launch_bounds__(256)
combine_columns(const Quarters fine, const float* __restrict__ rows, float* __restrict__ coarse, const Level level, int spacing) {
    const int x = int(blockIdx.x * 32u + (threadIdx.x & 31u)), y = int(blockIdx.y * 8u + threadIdx.x / 32u);
    if (x < level.width && y < level.height) split_level(fine, rows, coarse, level, x, y, spacing);
}

extern "C" __global__ void __launch_bounds__(256) combine_last(const Quarters coarse, const Level level) {
    const int at = int(blockIdx.x * 256u + threadIdx.x);
    if (at < level.width * level.height) last_level(coarse, level, at);
}

// Sums along rows of the planes 0 and 1. Blocks of BOX_ROW pixels; grid: along the row, rows, planes.
extern "C" __global__ void __launch_bounds__(256)
combine_box(const float* __restrict__ from, float* __restrict__ to, int width, int height, int radius) {
    __shared__ float memory[BOX_ROW_MEMORY];
    const size_t plane = size_t(blockIdx.z) * width * height;
    box_row(Block{}, from + plane, to + plane, width, int(blockIdx.x) * BOX_ROW, int(blockIdx.y), radius, memory);
}

// Blocks of BOX_LINES x BOX_COLUMN pixels.
extern "C" __global__ void __launch_bounds__(256, 4)
combine_gains(const Level level, const float* __restrict__ sums, int radius, float* __restrict__ half) {
    __shared__ float memory[BOX_COLUMN_MEMORY];
    add_level(Block{}, level, sums, int(blockIdx.x) * BOX_LINES, int(blockIdx.y) * BOX_COLUMN, radius, half, memory);
}

// A block a tile.
extern "C" __global__ void __launch_bounds__(256) combine_tiles(const Combine combine) {
    __shared__ float memory[TILE_MEMORY];
    finish_tile(Block{}, combine, int(blockIdx.x), int(blockIdx.y), memory);
}

// Blocks of 32 x 8 pixels.
extern "C" __global__ void __launch_bounds__(256) combine_errors(const Combine combine, float marched) {
    const int x = int(blockIdx.x * 32u + (threadIdx.x & 31u)), y = int(blockIdx.y * 8u + threadIdx.x / 32u);
    if (x < combine.width && y < combine.height) finish_error(combine, x, y, marched);
}
