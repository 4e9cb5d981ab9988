// Answers the collisions of a wave: stream compaction into one list for the surrogate and one for the RK4 tracer, then a scatter back.
//
// 1. answer_split: each point goes to one of two lists; points in missing cells get NaN at once.
// 2. The surrogate predicts its list (unit coordinates); the tracer sorts and traces its own (domain coordinates).
// 3. answer_join: values go to their collisions, and a share of the traced ones to the labels.
// Atomics decide the order within a list, which differs from run to run. No result depends on it.
#include "rendering/answer.cuh"
#include "rendering/tracking.cuh"

using namespace rw;

// Both lists share one array of `capacity` entries: the surrogate's grows from the front, the tracer's from the back.
struct Lists {
    float* points;  // three per entry
    uint32_t* places;
    float* values;
    const float* arrivals;   // three per entry of the tracer's list; null: not wanted
    const float* jacobians;  // nine per entry of the tracer's list; null: not wanted
    uint32_t* lengths;       // of the surrogate's list and of the tracer's
    uint32_t capacity;
    uint32_t pad;
};
static_assert(sizeof(Lists) == 56, "layout");

struct Labels {
    Float4* at;        // domain point, log-stretch
    float* arrivals;   // three per label; null: not kept
    float* jacobians;  // nine per label; null: not kept
    uint32_t* length;
    uint32_t capacity;
    uint32_t shift;
};
static_assert(sizeof(Labels) == 40, "layout");

extern "C" __global__ void __launch_bounds__(256)
answer_split(const __grid_constant__ Choice choice, const float* __restrict__ points, uint32_t count, float* __restrict__ log_stretch,
             unsigned char* __restrict__ by, Lists lists) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= count) return;
    const float point[3] = {points[3 * (size_t)i], points[3 * (size_t)i + 1], points[3 * (size_t)i + 2]};
    float unit_point[3];
    const Answerer who = choose(choice, point, unit_point);
    by[i] = who == RUNGE_KUTTA ? TRACED : who == SURROGATE_UNASKED ? OVER_BUDGET : PREDICTED;
    if (who == NOBODY) {
        log_stretch[i] = not_a_number();
    } else if (who == RUNGE_KUTTA) {
        const uint32_t at = lists.capacity - 1 - reserve(&lists.lengths[1]);
        for (int k = 0; k < 3; ++k) lists.points[3 * (size_t)at + k] = point[k];
        lists.places[at] = i;
    } else {
        const uint32_t at = reserve(&lists.lengths[0]);
        for (int k = 0; k < 3; ++k) lists.points[3 * (size_t)at + k] = unit_point[k];
        lists.places[at] = i;
    }
}

extern "C" __global__ void __launch_bounds__(256)
answer_join(Lists lists, uint32_t predicted, uint32_t traced, float* __restrict__ log_stretch, Labels labels) {
    const uint32_t i = blockIdx.x * 256u + threadIdx.x;
    if (i >= predicted + traced) return;
    const uint32_t at = i < predicted ? i : lists.capacity - 1 - (i - predicted);
    const float value = lists.values[at];
    log_stretch[lists.places[at]] = value;
    if (i < predicted || labels.capacity == 0u) return;
    const float* point = lists.points + 3 * (size_t)at;
    if (!keeps_label(point, labels.shift)) return;
    const uint32_t label = reserve(labels.length);
    if (label >= labels.capacity) return;
    labels.at[label] = {point[0], point[1], point[2], value};
    for (int k = 0; k < 3 && labels.arrivals; ++k) labels.arrivals[3 * (size_t)label + k] = lists.arrivals[3 * (size_t)at + k];
    for (int k = 0; k < 9 && labels.jacobians; ++k) labels.jacobians[9 * (size_t)label + k] = lists.jacobians[9 * (size_t)at + k];
}
