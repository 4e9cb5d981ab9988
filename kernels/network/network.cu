// Kernels shared by networks of all sizes: Adam (Kingma and Ba 2015), running mean and rounding of parameters, samples. Prediction and gradients
// are in network_fused.cu and network_batched.cu.
#include "network/network_data.cuh"

using namespace rw;

// Factors of one Adam step; the arithmetic equals burn's (see adam.rs).
struct Adam {
    float rate, epsilon, correction;
    float gradient;  // factor of the gradient
};
static_assert(sizeof(Adam) == 16, "layout");

RW_FN float adam_step(const Adam& adam, float gradient, float* parameter, float* first, float* second) {
    const float g = gradient * adam.gradient, m = *first * 0.9f + g * (1.0f - 0.9f), v = *second * 0.999f + g * g * (1.0f - 0.999f);
    const float p = *parameter - m * adam.correction / (sqrtf(v) + adam.epsilon) * adam.rate;
    *first = m;
    *second = v;
    return *parameter = p;
}

// Finds the index in burn's tables of value `i` of the padded tables. Returns false in the padding.
RW_FN bool table_index(const Grid& grid, size_t i, size_t* at) {
    const uint32_t entry = uint32_t(i / FEATURES);
    int level = 0;
    for (int next = 1; next < LEVELS; ++next) level = entry >= grid.levels[next].offset ? next : level;
    const uint32_t inside = entry - grid.levels[level].offset;
    *at = size_t(grid.levels[level].start + inside) * FEATURES + i % FEATURES;
    return inside < grid.levels[level].entries;
}

// One thread per value of the padded tables, `n` in all. With `lazy`, groups of 16 values without a gradient are skipped (see lazy_step in
// adam.rs).
extern "C" __global__ void __launch_bounds__(256)
network_adam_tables(const __grid_constant__ Grid grid, const Adam adam, uint64_t n, uint32_t lazy, float* __restrict__ gradient,
                    float* __restrict__ parameters, float* __restrict__ first, float* __restrict__ second, uint16_t* __restrict__ halves) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    const float g = i < n ? gradient[i] : 0.0f;
    const uint32_t line = __ballot_sync(0xffffffffu, g != 0.0f) >> (threadIdx.x & 16u) & 0xffffu;
    size_t at;
    if (i >= n || (lazy && line == 0u) || !table_index(grid, i, &at)) return;
    gradient[i] = 0.0f;
    halves[i] = to_half(adam_step(adam, g, parameters + at, first + at, second + at));
}

extern "C" __global__ void __launch_bounds__(256)
network_adam_layers(const Adam adam, uint32_t n, float* __restrict__ gradient, float* __restrict__ parameters, float* __restrict__ first,
                    float* __restrict__ second) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    adam_step(adam, gradient[i], parameters + i, first + i, second + i);
    gradient[i] = 0.0f;
}

// Exponential running mean of the parameters.
extern "C" __global__ void __launch_bounds__(256)
network_average(float share, uint64_t n, const float* __restrict__ parameters, float* __restrict__ average) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    if (i < n) average[i] += (parameters[i] - average[i]) * share;
}

// Rounds burn's tables to half precision and pads them.
extern "C" __global__ void __launch_bounds__(256)
network_halves(const __grid_constant__ Grid grid, uint64_t n, const float* __restrict__ tables, uint16_t* __restrict__ halves) {
    const size_t i = blockIdx.x * size_t(256) + threadIdx.x;
    size_t at;
    if (i < n) halves[i] = table_index(grid, i, &at) ? to_half(tables[at]) : uint16_t(0);
}

// Uniform points of the domain (domain coordinates), numbered from `first` on.
extern "C" __global__ void __launch_bounds__(256)
network_points(const __grid_constant__ UnitBox domain, uint64_t seed, uint64_t first, uint32_t n, float* __restrict__ points) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= n) return;
    float unit[3], point[3];
    for (int k = 0; k < 3; ++k) unit[k] = float(mix(seed, 3 * (first + i) + k) >> 40) / float(1u << 24);
    from_unit(domain, unit, point);
    for (int k = 0; k < 3; ++k) points[3 * size_t(i) + k] = point[k];
}

// Turns traced points and their labels into samples, as `write_sample` does. One thread per point.
extern "C" __global__ void __launch_bounds__(256)
network_samples(const __grid_constant__ UnitBox domain, const __grid_constant__ Reading reading, const float* __restrict__ points,
                const float* __restrict__ labels, uint32_t n, uint32_t held_back, Float4* __restrict__ samples,
                const float* __restrict__ jacobians) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i < n) write_sample(domain, reading, points, labels, jacobians, i, held_back, samples);
}

// Adds the number of samples with targets to `count`.
extern "C" __global__ void __launch_bounds__(256)
network_usable(const Float4* __restrict__ samples, uint32_t n, uint32_t* __restrict__ count) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    // One sum a block: a sum of each warp would wait for the others at the one counter.
    const int usable = __syncthreads_count(i < n && is_usable(load_sample(samples + (i < n ? i : 0u) * size_t(SAMPLE_FLOAT4S))));
    if (threadIdx.x == 0u && usable) atomicAdd(count, uint32_t(usable));
}

// The penalty on the difference of a batch's means needs all outputs before any gradient. `network_drawn` writes the batch's points (`points`
// and `further`, see Reading); after a prediction at them, `network_means` compares predictions with labels, both in linear scale.
extern "C" __global__ void __launch_bounds__(256)
network_drawn(const __grid_constant__ Draw draw, float* __restrict__ points, float* __restrict__ further) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= draw.batch) return;
    const Sample sample = drawn_sample(draw, i);
    RW_UNROLL for (int k = 0; k < PLACES; ++k) {
        if (k < 3) points[3 * size_t(i) + k] = sample.place[k];
        else further[(PLACES - 3) * size_t(i) + k - 3] = sample.place[k];
    }
}

extern "C" __global__ void __launch_bounds__(256)
network_means(const __grid_constant__ Draw draw, const float* __restrict__ predicted, Means* __restrict__ means) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    double difference = 0.0;
    bool usable = false;
    if (i < draw.batch) {
        const Sample sample = drawn_sample(draw, i);
        usable = is_usable(sample);
        const float label = copysignf(expm1f(fabsf(sample.target[0])), sample.target[0]);
        difference = usable ? double(predicted[i]) - double(label) : 0.0;
    }
    const uint32_t all = __ballot_sync(0xffffffffu, usable);
    difference = warp_sum(difference);
    if ((threadIdx.x & 31u) == 0u && all) {
        atomicAdd(&means->difference, difference);
        atomicAdd(&means->usable, double(__popc(all)));
    }
}
