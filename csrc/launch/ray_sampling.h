// Launches of ray_sampling, the same for every device.
#pragma once

#include "core/for_each.h"
#include "spslam/ray_sampling.h"

namespace spslam {

template <class Device>
void philox_uniform(Device device, PhiloxKey key, std::int64_t count, float* out) {
  for_each(device, count,
           [=] SPS_HOST_DEVICE(std::int64_t i) { out[i] = philox_uniform(key, static_cast<std::uint32_t>(i)); });
}

template <class Device>
void sample_indices(Device device, PhiloxKey key, std::int64_t upper, std::int64_t count, std::int64_t* out) {
  for_each(device, count, [=] SPS_HOST_DEVICE(std::int64_t i) {
    out[i] = philox_index(key, static_cast<std::uint32_t>(i), static_cast<std::uint64_t>(upper));
  });
}

#define SPS_INSTANTIATE_RAY_SAMPLING(Device)                                                                    \
  template void philox_uniform<Device>(Device, PhiloxKey, std::int64_t, float*);                                \
  template void sample_indices<Device>(Device, PhiloxKey, std::int64_t, std::int64_t, std::int64_t*);           \
  template void sample_along_rays<Device, float>(Device, PhiloxKey, const RaySampling<float>&, const float*,    \
                                                 std::int64_t, float*);                                         \
  template void sample_along_rays<Device, double>(Device, PhiloxKey, const RaySampling<double>&, const double*, \
                                                  std::int64_t, double*);

}  // namespace spslam
