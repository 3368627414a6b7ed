// Random pixel draws and samples along rays.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/types/ray_sampling.h"

namespace spslam {

// out[e] = uniform in [0, 1) for counter element e.
template <class Device>
void philox_uniform(Device device, PhiloxKey key, std::int64_t count, float* out);

// out[e] = uniform integer in [0, upper) for counter element e; upper in [1, 2^32].
template <class Device>
void sample_indices(Device device, PhiloxKey key, std::int64_t upper, std::int64_t count, std::int64_t* out);

// out[r] = the ascending depths of ray r's samples; zeros where depth[r] is not positive and finite. Sample s of ray r
// draws counter element r * S + s, which must fit 32 bits.
template <class Device, class T>
void sample_along_rays(Device device, PhiloxKey key, const RaySampling<T>& sampling, const T* depth,
                       std::int64_t num_rays, T* out);

}  // namespace spslam
