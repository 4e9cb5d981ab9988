// Routing of log-stretch queries: the surrogate answers where the gate trusts it, the RK4 tracer elsewhere (see `backend`).
#pragma once
#include "common/domain.cuh"
#include "rendering/gate.cuh"
#include "tracing/missing_cells.cuh"

namespace rw {

enum Answerer {
    NOBODY,             // the point is in a missing cell: no value exists
    SURROGATE,          // the gate trusts it here
    SURROGATE_UNASKED,  // the gate does not trust it here, but the tracing budget is spent
    RUNGE_KUTTA
};

struct Choice {
    UnitBox domain;
    Gate gate;
    MissingCells missing_cells;
    int budget_spent;
    int pad;
};
static_assert(sizeof(Choice) == 200, "layout");

// Sets `unit` to the point in unit coordinates, unless nobody answers.
RW_FN Answerer choose(const Choice& choice, const float point[3], float (&unit)[3]) {
    if (is_missing(choice.missing_cells, point)) return NOBODY;
    to_unit(choice.domain, point, unit);
    if (!choice.gate.trusted) return RUNGE_KUTTA;
    if (trusts(choice.gate, unit)) return SURROGATE;
    return choice.budget_spent ? SURROGATE_UNASKED : RUNGE_KUTTA;
}

}  // namespace rw
