// The scene's single light, directional or a point (see `render::light`).
#pragma once
#include "rendering/space.cuh"

namespace rw {

struct Light {
    double vector[3];   // directional: unit vector toward the light; point: its position, scene units
    float radiance[3];  // directional: radiance; point: radiant intensity
    int is_point;
};

// Unit vector toward the light, distance to it, and the unattenuated radiance that arrives at `point`.
RW_FN void light_seen_from(const Light& light, const double point[3], double toward[3], double& distance, float radiance[3]) {
    if (!light.is_point) {
        for (int k = 0; k < 3; ++k) {
            toward[k] = light.vector[k];
            radiance[k] = light.radiance[k];
        }
        distance = infinity();
        return;
    }
    for (int k = 0; k < 3; ++k) toward[k] = light.vector[k] - point[k];
    // A scattering event exactly at the light has probability 0; the floor keeps its values finite.
    distance = fmax(length3(toward), 1e-12);
    const double falloff = 1.0 / (distance * distance), inverse = 1.0 / distance;
    for (int k = 0; k < 3; ++k) {
        toward[k] *= inverse;
        radiance[k] = (float)((double)light.radiance[k] * falloff);
    }
}

}  // namespace rw
