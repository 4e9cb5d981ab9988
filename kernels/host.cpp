// The numerics as host C++, for the test that holds them against the Rust reference. Compiled with the macros of a kernel, and
// RW_CLOSED where it is that of a closed form.
#if RW_CLOSED
#include "closed_variant.cuh"
using Data = ClosedData<RW_REAL>;
using Times = Constants<RW_REAL>;
#else
#include "grid_variant.cuh"
using Data = GridData<RW_REAL>;
using Times = GridStep<RW_REAL>;
#endif

// The other side of these numbers is in src/engine/cuda/layout.rs.
static_assert(sizeof(Outputs) == 40 && sizeof(Verdict) == 12, "layout");
#if !RW_CLOSED
static_assert(sizeof(AxisData<float>) == 64 && sizeof(AxisData<double>) == 80, "layout");
static_assert(sizeof(GridData<float>) == 336 && sizeof(GridData<double>) == 488, "layout");
static_assert(sizeof(GridStep<float>) == 64 && sizeof(GridStep<double>) == 72, "layout");
#else
static_assert(sizeof(ClosedData<float>) == 56 && sizeof(ClosedData<double>) == 104, "layout");
#endif

extern "C" void host_trace(const Data* data, const Times* times, const RW_REAL* h, double gap, const Verdict* verdict, const float* seeds,
                           uint32_t n, const Outputs* out) {
    for (uint32_t i = 0; i < n; i++) {
        const float seed[3] = {seeds[3 * size_t(i)], seeds[3 * size_t(i) + 1], seeds[3 * size_t(i) + 2]};
#if RW_CLOSED
        const Flow flow(*data, times, seed);
#else
        const Flow flow{*data, times};
#endif
        one(flow, *h, gap, *verdict, seed, i, *out);
    }
}

extern "C" float host_half(float x) { return from_half(to_half(x)); }
