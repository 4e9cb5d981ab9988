// Who answers at a collision (see `engine::answers`), and which traced answers are kept as labels to learn from.
#pragma once
#include "gate.cuh"
#include "land.cuh"
#include "rng.cuh"

namespace rw {

// Lower corner and edge lengths of the domain (see `field::Domain::to_unit`).
struct UnitBox {
    double min[3], extent[3];
};

RW_FN void to_unit(const UnitBox& box, const float point[3], float (&unit)[3]) {
    for (int k = 0; k < 3; ++k) unit[k] = min_(max_((float)(((double)point[k] - box.min[k]) / box.extent[k]), 0.0f), 1.0f);
}

enum Answerer {
    NOBODY,             // there is no value on land
    SURROGATE,          // it is trusted here
    SURROGATE_UNASKED,  // it is not, but the tracing budget is spent
    RUNGE_KUTTA
};

struct Choice {
    UnitBox domain;
    Gate gate;
    Land land;
    int budget_spent;
    int pad;
};
static_assert(sizeof(Choice) == 176, "layout");

// `unit`: the point in unit coordinates, unless nobody answers.
RW_FN Answerer choose(const Choice& choice, const float point[3], float (&unit)[3]) {
    if (is_land(choice.land, point)) return NOBODY;
    to_unit(choice.domain, point, unit);
    if (!choice.gate.trusted) return RUNGE_KUTTA;
    if (trusts(choice.gate, unit)) return SURROGATE;
    return choice.budget_spent ? SURROGATE_UNASKED : RUNGE_KUTTA;
}

// Whether the label at a point belongs to the kept share of 1 in 2^shift: a function of the point alone, so that what is kept does not
// depend on the order in which threads come.
RW_FN bool keeps_label(const float point[3], uint32_t shift) {
    if (shift == 0) return true;
    const Words random = philox(float_bits(point[0]), float_bits(point[1]), float_bits(point[2]), 0u, 0u, 0u);
    return shift < 32 && random.w[0] >> (32 - shift) == 0u;
}

}  // namespace rw
