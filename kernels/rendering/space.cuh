// Transforms between three coordinate systems (see `render::space`): the domain (data coordinates), the scene (lengths; camera, light and
// extinction use them) and the grid (majorant cells). Rays meet the box by the slab method (Kay and Kajiya 1986).
#pragma once
#include "common/atomics.cuh"

namespace rw {

struct SceneBox {
    double min[3], max[3];   // corners, scene units
    double domain_min[3];    // lower corner, domain coordinates
    double cell_edge[3];     // scene units per cell
    double cell_extent[3];   // domain units per cell
    float inward_min[3], inward_max[3];  // the closed box in f32, rounded inward
    int cells[3];
    int pad;
};

// Distances at which a ray enters and leaves the box. Returns false if it misses the box or the box is behind it.
RW_FN bool intersect(const SceneBox& box, const double origin[3], const double direction[3], double& enter, double& leave) {
    enter = 0.0;
    leave = infinity();
    for (int k = 0; k < 3; ++k) {
        if (direction[k] == 0.0) {
            if (origin[k] < box.min[k] || origin[k] > box.max[k]) return false;
            continue;
        }
        const double a = (box.min[k] - origin[k]) / direction[k], b = (box.max[k] - origin[k]) / direction[k];
        enter = fmax(enter, fmin(a, b));
        leave = fmin(leave, fmax(a, b));
    }
    return enter < leave;
}

RW_FN void grid_point(const SceneBox& box, const double scene[3], float grid[3]) {
    for (int k = 0; k < 3; ++k) {
        const float g = (float)((scene[k] - box.min[k]) / box.cell_edge[k]);
        grid[k] = fminf(fmaxf(g, 0.0f), (float)box.cells[k]);
    }
}

// Cells per scene length along a scene direction.
RW_FN void grid_direction(const SceneBox& box, const double direction[3], float grid[3]) {
    for (int k = 0; k < 3; ++k) grid[k] = (float)(direction[k] / box.cell_edge[k]);
}

RW_FN void scene_point(const SceneBox& box, const float grid[3], double scene[3]) {
    for (int k = 0; k < 3; ++k) scene[k] = box.min[k] + (double)grid[k] * box.cell_edge[k];
}

// Domain point of grid coordinates, clamped to the box.
RW_FN void domain_point(const SceneBox& box, const float grid[3], float domain[3]) {
    for (int k = 0; k < 3; ++k) {
        const float x = (float)(box.domain_min[k] + (double)grid[k] * box.cell_extent[k]);
        domain[k] = fminf(fmaxf(x, box.inward_min[k]), box.inward_max[k]);
    }
}

// Scene length along `direction` from `from` (both in grid coordinates) to the point where it leaves the grid.
RW_FN float exit_length(const SceneBox& box, const float from[3], const float direction[3]) {
    float leave = infinity();
    for (int k = 0; k < 3; ++k) {
        if (direction[k] != 0.0f) {
            const float wall = direction[k] > 0.0f ? (float)box.cells[k] : 0.0f;
            leave = fminf(leave, (wall - from[k]) / direction[k]);
        }
    }
    return fmaxf(leave, 0.0f);
}

RW_FN double length3(const double v[3]) { return sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]); }

}  // namespace rw
