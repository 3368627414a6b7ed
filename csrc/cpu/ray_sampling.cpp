#include "kernels/ray_sampling.h"

#include <vector>

#include "launch/ray_sampling.h"

namespace spslam {

template <class Device, class T>
void sample_along_rays(Device, PhiloxKey key, const RaySampling<T>& sampling, const T* depth, std::int64_t num_rays,
                       T* out) {
  constexpr std::int64_t kRayGrain = 32;
  const std::int64_t count = sampling.num_samples();
  parallel_for(num_rays, kRayGrain, [&](std::int64_t begin, std::int64_t end) {
    std::vector<T> scratch(static_cast<std::size_t>(sample_ray_scratch(sampling)));
    for (std::int64_t r = begin; r < end; ++r) {
      sample_ray(key, sampling, r, depth[r], scratch.data(), out + r * count);
    }
  });
}

SPS_INSTANTIATE_RAY_SAMPLING(Cpu)
}  // namespace spslam
