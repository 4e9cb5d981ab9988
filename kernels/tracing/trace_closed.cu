// Log-stretch of seeds in a closed-form flow: RK4 of the path and its variational equation, or central differences (Shadden et al. 2005).
#include "tracing/closed_variant.cuh"
