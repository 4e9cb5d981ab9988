// The tracing kernels' numerics as host C++, for the test that compares them with the Rust reference. Compiled with the macros of a kernel, and
// with RW_CLOSED for a closed form.
#if RW_CLOSED
#include "tracing/closed_variant.cuh"
static_assert(sizeof(ClosedData<float>) == 56 && sizeof(ClosedData<double>) == 104, "layout");
#else
#include "tracing/grid_variant.cuh"
static_assert(sizeof(AxisData<float>) == 64 && sizeof(AxisData<double>) == 80, "layout");
static_assert(sizeof(GridData<float>) == 336 && sizeof(GridData<double>) == 488, "layout");
static_assert(sizeof(GridStep<float>) == 64 && sizeof(GridStep<double>) == 72, "layout");
#endif
// layout.rs asserts the same sizes.
static_assert(sizeof(Outputs) == 40 && sizeof(ResultPolicy) == 12, "layout");

extern "C" void host_trace(const FlowData* data, const FlowTimes* times, const RW_REAL* h, double difference_step, const ResultPolicy* policy,
                           const float* seeds, uint32_t n, const Outputs* out) {
    for (uint32_t i = 0; i < n; i++) {
        const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
        trace_seed(Flow(*data, times, seed), *h, difference_step, *policy, seed, i, *out);
    }
}

extern "C" float host_half(float x) { return from_half(to_half(x)); }
